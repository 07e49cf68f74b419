"""Make what is made from the code: schemas/, tables of spec/index.md, the picture of the floors.

    python tools/generate.py            write the draft schemas, the tables and the picture
    python tools/generate.py --check    fail where they differ from the models
    python tools/generate.py --release  also write the schemas of the released version

A released schema never changes: ``--release`` refuses to overwrite one.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from pathlib import Path
from typing import Any

from mp4ds.format.fields import FORMAT_VERSION
from mp4ds.format.sidecars import MODELS

ROOT = Path(__file__).resolve().parents[1]
KINDS = ("stream", "dataset")
_WIDE, _HIGH, _GAP = 820, 40, 12  # of the picture and its boxes


def outputs() -> dict[Path, str]:
    """Every generated file and its text."""
    texts = {
        ROOT / "schemas" / "draft" / f"{kind}.schema.json": generate_schema(kind) for kind in KINDS
    }
    spec = ROOT / "spec" / "index.md"
    text = spec.read_text()
    for kind in KINDS:
        schema = json.loads(generate_schema(kind))
        models = {kind: schema, **schema.get("$defs", {})}
        for name, model in models.items():
            text = replace_table(text, name, model)
    texts[spec] = text
    texts[ROOT / "docs" / "architecture.svg"] = floors_picture(
        (ROOT / "pyproject.toml").read_text()
    )
    return texts


def generate_schema(kind: str) -> str:
    """The JSON Schema that the models describe now."""
    schema = MODELS[kind].model_json_schema(by_alias=True, mode="validation")
    schema = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": f"urn:mp4ds:{FORMAT_VERSION}:{kind}",
        **schema,
    }
    return json.dumps(schema, indent=2) + "\n"


def floors_picture(text: str) -> str:
    """The floors of the code as a picture (SVG).

    Args:
        text: Of pyproject.toml, whose contract import-linter checks.
    """
    layers = text.rpartition("layers = [")[2].partition("\n]")[0]
    floors = [line.split(" | ") for line in re.findall(r'^  "([^"]*)"', layers, re.MULTILINE)]
    parts = []
    for row, names in enumerate(floors):
        width = (_WIDE - _GAP * (len(names) - 1)) / len(names)
        for place, name in enumerate(names):
            left, top = place * (width + _GAP), row * (_HIGH + _GAP)
            box = f'x="{left:.1f}" y="{top}" width="{width:.1f}" height="{_HIGH}" rx="6"'
            at = f'x="{left + width / 2:.1f}" y="{top + _HIGH / 2 + 5:g}"'
            parts.append(f"<rect {box}/><text {at}>{name}</text>")
    size = f"{_WIDE + 2} {len(floors) * (_HIGH + _GAP) - _GAP + 2}"
    style = (
        "rect{fill:#e8f0fe;stroke:#1d6ff2}"
        "text{font:15px system-ui,'DejaVu Sans',sans-serif;fill:#14233a;text-anchor:middle}"
    )
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="-1 -1 {size}" role="img">'
    return "\n".join([head, f"<style>{style}</style>", *parts, "</svg>", ""])


def replace_table(text: str, name: str, model: dict[str, Any]) -> str:
    """Fill the place between the markers of a model, where the text has them."""
    pattern = re.compile(rf"(<!-- fields: {name} -->\n).*?(<!-- end -->)", re.DOTALL)
    table = field_table(model)
    return pattern.sub(lambda match: match.group(1) + table + match.group(2), text)


def field_table(model: dict[str, Any]) -> str:
    """A Markdown table of a model's fields."""
    required = set(model.get("required", ()))
    rows = ["| key | type | | meaning |", "| --- | --- | --- | --- |"]
    for key, field in model.get("properties", {}).items():
        need = "required" if key in required else "optional"
        meaning = field.get("description", "").replace("|", "\\|")
        rows.append(f"| `{key}` | {type_text(field)} | {need} | {meaning} |")
    return "\n".join(rows) + "\n"


def type_text(field: dict[str, Any]) -> str:
    """A field's type in words."""
    if "anyOf" in field:
        kinds = [item for item in field["anyOf"] if item.get("type") != "null"]
        return " or ".join(map(type_text, kinds))
    if "$ref" in field:
        return field["$ref"].rpartition("/")[2]
    if "allOf" in field:
        return type_text(field["allOf"][0])
    if "const" in field:
        return f"`{field['const']}`"
    if "enum" in field:
        return " or ".join(f"`{value}`" for value in field["enum"])
    kind = str(field.get("type", "any"))
    if kind == "array":
        return f"list of {type_text(field.get('items', {}))}"
    if kind == "object":
        return "map of strings"
    return kind


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--release", action="store_true")
    arguments = parser.parse_args()
    texts = outputs()
    if arguments.release:
        for kind in KINDS:
            path = ROOT / "schemas" / f"v{FORMAT_VERSION}" / f"{kind}.schema.json"
            if path.exists():
                print(f"{path} is released and stays as it is", file=sys.stderr)
                return 1
            texts[path] = generate_schema(kind)
    stale = [path for path, text in texts.items() if not path.exists() or path.read_text() != text]
    if arguments.check:
        for path in stale:
            print(f"{path.relative_to(ROOT)} is not what the models say: run tools/generate.py")
        return 1 if stale else 0
    for path in stale:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(texts[path])
        print(f"wrote {path.relative_to(ROOT)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
