"""Make what is made from the code: schemas/, the field tables in spec/index.md, docs/options.md.

    python tools/generate.py            write the draft schemas, the tables and the options
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

from mp4ds.cli.options import flags_of
from mp4ds.format.fields import FORMAT_VERSION
from mp4ds.format.sidecars import generate_schema
from mp4ds.options import Options, shown_of
from mp4ds.packing.options import ImageFolder, PackOptions
from mp4ds.plugins.evaluating.options import EvaluateOptions
from mp4ds.plugins.exporting.job import ExportOptions
from mp4ds.plugins.playing.play import PlayOptions
from mp4ds.plugins.reporting.report import ReportOptions
from mp4ds.plugins.reporting.stills import StillOptions
from mp4ds.unpacking.unpack import UnpackOptions

ROOT = Path(__file__).resolve().parents[1]
KINDS = ("stream", "dataset")
COMMANDS: dict[str, type[Options]] = {
    "pack": PackOptions,
    "unpack": UnpackOptions,
    "import images": ImageFolder,
    "export": ExportOptions,
    "play": PlayOptions,
    "evaluate": EvaluateOptions,
    "report": ReportOptions,
    "frames": StillOptions,
}
NOT_OF_THE_COMMAND = {("pack", "images"), ("play", "to"), ("play", "clock")}
"""Options that the command line has in another form."""

HEAD = """# All options

On the command line, and in Python as fields of the dataclass of each command; made by
`tools/generate.py` of where they are declared. `mp4ds COMMAND --help` shows them with what else a
command takes.
"""


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
    texts[ROOT / "docs" / "options.md"] = options_page()
    return texts


def options_page() -> str:
    """The options of all commands, as tables."""
    parts = [HEAD]
    for command, kind in COMMANDS.items():
        parts.append(f"\n## {command}: `{kind.__name__}`\n\n{option_table(command, kind)}")
    parts.append("\n`import images` also takes those of `pack` that are not about recordings.\n")
    return "".join(parts)


def option_table(command: str, kind: type[Options]) -> str:
    """A Markdown table of a command's options."""
    rows = ["| option | in Python | default | |", "| --- | --- | --- | --- |"]
    for name, shown in shown_of(kind).items():
        if (command, name) in NOT_OF_THE_COMMAND:
            continue
        flags = ", ".join(f"`{flag}`" for flag in flags_of(name, shown))
        default = getattr(kind, name)
        text = shown.default or ("" if default in (None, False, (), "") else str(default))
        help_text = shown.help.replace("|", "\\|")
        rows.append(f"| {flags} | `{name}` | {text} | {help_text} |")
    return "\n".join(rows) + "\n"


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
