"""What spec/registry.md lists is what the code has: names, tables, codes and reasons."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import pytest

from mp4ds.format.fields import Body
from mp4ds.format.models import VIDEO_CODECS
from mp4ds.messages.encodings import ENCODINGS, LayoutParameters
from mp4ds.messages.layouts import LAYOUTS, Layout, bind
from mp4ds.messages.numbers import SCALES
from mp4ds.messages.serializations import WIRES
from mp4ds.video.codecs import (
    COPIED_CODECS,
    PACKET_CODECS,
    codecs_to_try,
    recipe_for,
)

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "mp4ds"
MODULES = sorted(SOURCE.rglob("*.py"))
SPEC = ROOT / "spec"

Rows = list[list[str]]


def section(text: str, title: str) -> str:
    return text.split(f"\n## {title}\n", 1)[1].split("\n## ", 1)[0]


def registry(title: str) -> str:
    return section((SPEC / "registry.md").read_text(), title)


def first_cells(text: str) -> list[str]:
    """Names in backticks in the first cell of each row of a section's tables."""
    rows = re.findall(r"^\| ((?:`[^`]+` ?)+)\|", text, re.MULTILINE)
    return [name for row in rows for name in re.findall(r"`([^`]+)`", row)]


def tables(text: str) -> list[Rows]:
    """The tables of a section: their rows without the title row, as cells."""
    found: list[Rows] = []
    for block in re.findall(r"(?:^\|.*\n?)+", text, re.MULTILINE):
        lines = block.strip().split("\n")
        found.append([[cell.strip() for cell in line[1:-1].split("|")] for line in lines[2:]])
    return found


def quoted(cell: str) -> list[str]:
    """The names in backticks."""
    return re.findall(r"`([^`]+)`", cell)


# ---------------------------------------------------------------- problem codes

CODE = re.compile(r"[a-z0-9]+(-[a-z0-9]+)+")
CODED = {"FormatError", "VideoError", "Problem", "_failure"}
PASSED_ON = {"error.code", "problem.code", "code"}
"""What a code may be called that comes from elsewhere, such as the callers of `_failure`."""


def emitted_codes() -> dict[str, list[str]]:
    """Code -> places where it is the first argument of an error or a problem."""
    found: dict[str, list[str]] = {}
    for path in MODULES:
        for node in ast.walk(ast.parse(path.read_text())):
            if not (isinstance(node, ast.Call) and node.args):
                continue
            name = getattr(node.func, "id", getattr(node.func, "attr", ""))
            is_super = isinstance(node.func, ast.Attribute) and name == "__init__"
            first = node.args[0]
            if name not in CODED and not (is_super and path.name == "errors.py"):
                continue
            if isinstance(first, ast.Constant) and isinstance(first.value, str):
                if CODE.fullmatch(first.value):
                    found.setdefault(first.value, []).append(f"{path.name}:{node.lineno}")
            elif name in CODED and ast.unparse(first) not in PASSED_ON:
                # a code that is passed on must be one that is found elsewhere
                pytest.fail(f"{path.name}:{node.lineno}: the code is {ast.unparse(first)}")
    return found


def test_the_registry_lists_exactly_the_codes_of_the_code() -> None:
    codes = emitted_codes()
    listed = first_cells(registry("Problem codes"))
    assert len(listed) == len(set(listed))
    assert {code: places for code, places in codes.items() if code not in listed} == {}
    assert sorted(set(listed) - set(codes)) == []


def test_the_spec_uses_no_other_codes() -> None:
    listed = set(first_cells(registry("Problem codes")))
    text = (SPEC / "index.md").read_text()
    used = set(re.findall(r"\(`([a-z]+(?:-[a-z]+)+)`\)", text))
    assert used
    assert used <= listed


# ---------------------------------------------------------------- other registries

SAMPLES = {"u": "uint", "i": "int", "f": "float"}
# a set of parameters -> values that give every kind of picture of a layout with these
PARAMETERS: dict[frozenset[str], list[dict[str, Any]]] = {
    frozenset(): [{}],
    frozenset({"bits", "shift"}): [{"bits": bits, "shift": 0} for bits in (8, 10, 12, 14)],
    frozenset({"bits", "shift", "low"}): [
        {"bits": 12, "shift": 4, "low": 4},
        {"bits": 16, "shift": 0, "low": 6},
    ],
    frozenset({"bits", "shift", "table"}): [
        {"bits": 12, "shift": 0, "table": tuple(range(0, 4096, 16))}
    ],
    frozenset({"entries"}): [{"entries": 256}, {"entries": 1024}],
    frozenset({"table"}): [{"table": (3, 5)}, {"table": tuple(range(0, 900, 3))}],
    frozenset({"hole", "scale"}): [{"hole": 0, "scale": scale} for scale in SCALES],
    frozenset({"alpha"}): [{"alpha": 255}],
    frozenset({"mosaic"}): [{"mosaic": "grbg"}],
    frozenset({"rule"}): [{"rule": "opencv"}],
}


def test_the_registry_lists_exactly_the_encodings() -> None:
    listed: dict[str, tuple[str, str, list[str], list[str], str]] = {}
    (rows,) = tables(registry("Encodings"))
    for names, channels, samples, exact, lossy in rows:
        counts = channels.split(", ")
        for name, count in zip(
            quoted(names), counts * (len(quoted(names)) // len(counts)), strict=True
        ):
            assert name not in listed
            bold = re.findall(r"\*\*`(\w+)`\*\*", exact)
            listed[name] = (count, samples, bold, quoted(exact), lossy)
    assert listed == {
        name: (
            str(encoding.channels),
            f"{SAMPLES[encoding.dtype[0]]}{8 * encoding.bytes_per_sample}",
            [encoding.general],
            [encoding.general, *(other for other in encoding.exact if other != encoding.general)],
            f"`{encoding.lossy}`" if encoding.lossy else "none",
        )
        for name, encoding in ENCODINGS.items()
    }


def bound_layouts() -> Iterator[tuple[str, Layout]]:
    """Every layout, with every encoding that has it and parameters of each kind."""
    for encoding in ENCODINGS.values():
        for name in {*encoding.exact, encoding.lossy or encoding.general}:
            for values in PARAMETERS[LAYOUTS[name].parameters]:
                if name in ("gbr_bits", "gbra_bits") and values["bits"] == 8:
                    continue  # no planes of colours have 8 bits
                yield name, bind(name, encoding, LayoutParameters.model_validate(values))


def test_the_registry_lists_exactly_the_layouts() -> None:
    (rows,) = tables(registry("Layouts"))
    first = [row[0] for row in rows]
    assert list(map(quoted, first)) == [[name] for name in LAYOUTS]
    formats: dict[str, set[str]] = {}
    for name, layout in bound_layouts():
        formats.setdefault(name, set()).add(layout.pixel_format)
    for (name,), row in zip(map(quoted, first), rows, strict=True):
        kind = LAYOUTS[name]
        assert set(quoted(row[4])) == kind.parameters, name
        assert row[5:] == ["yes" if kind.is_exact else "no", "yes" if kind.is_shown else "no"]
        cell = row[1].replace("`*n*`", "N")
        listed = {text.replace("N", bits) for text in quoted(cell) for bits in ("10", "12", "14")}
        listed |= {"gray"} if "grayNle" in cell else set()  # of 8 bits
        assert formats[name] == listed, name
    described = section((SPEC / "index.md").read_text(), "Layouts")
    values, places = (
        {name for row in rows for name in quoted(row[0])} for rows in tables(described)
    )
    assert {name for row in rows for name in quoted(row[2])} == values
    assert {name for row in rows for name in quoted(row[3])} == places


def test_the_registry_lists_exactly_the_wires_and_bodies() -> None:
    assert first_cells(registry("Wires")) == list(WIRES)
    assert first_cells(registry("Bodies")) == list(get_args(Body))
    index = (SPEC / "index.md").read_text().split("\n### Bodies\n")[1]
    assert [quoted(row[0]) for row in tables(index)[0]] == [[body] for body in get_args(Body)]


def test_the_registry_lists_exactly_the_codecs() -> None:
    rows = tables(registry("Codecs"))[0]
    assert [quoted(row[0]) for row in rows] == [[codec] for codec in VIDEO_CODECS]
    for row in rows:
        (codec,) = quoted(row[0])
        made = {item.mode for item in codec_rows() if item.codec == codec}
        assert set(row[3].split(", ")) == (made or {"no"}), codec
        copied = "yes" if codec in COPIED_CODECS else "of 1.x"
        assert row[4] == (copied if codec in PACKET_CODECS else "no"), codec


@dataclass(frozen=True)
class CodecRow:
    """A row of the table of what encoders are given."""

    formats: list[str]
    mode: str
    codec: str
    default: bool
    tried: bool
    encoder: str
    pixel_format: str
    options: dict[str, str]


def codec_rows() -> Iterator[CodecRow]:
    for cells in tables(registry("Codecs"))[1]:
        (codec,) = quoted(cells[2])
        options = dict((*option.partition("=")[::2],) for option in quoted(cells[5]))
        same = cells[4] == "the same"
        yield CodecRow(
            quoted(cells[0]),
            cells[1],
            codec,
            cells[2].endswith("*"),
            not cells[2].startswith("("),
            cells[3],
            "" if same else quoted(cells[4])[0],
            options,
        )


def test_the_registry_has_the_codecs_and_their_defaults() -> None:
    for row in codec_rows():
        assert row.mode in ("lossless", "lossy")
        lossless = row.mode == "lossless"
        for name in row.formats:
            place = f"{name} {row.mode} {row.codec}"
            recipe = recipe_for(name, lossless=lossless, codec=row.codec, crf=20)
            assert recipe.encoder == row.encoder, place
            assert recipe.pixel_format == (row.pixel_format or name), place
            found = {
                key: text.removesuffix(":log-level=error") for key, text in recipe.options.items()
            }
            assert found == row.options | ({} if lossless else {"crf": "20"}), place
            assert row.default == (recipe_for(name, lossless=lossless, crf=20) == recipe), place
            assert row.tried == (not lossless or row.codec in codecs_to_try(name)), place


# ---------------------------------------------------------------- references


def references() -> Iterator[tuple[str, str, str]]:
    """Place, file and title of each section of the spec that the code or a table names."""
    for path in MODULES:
        text = re.sub(r"\s+#?\s*", " ", path.read_text())
        name = str(path.relative_to(SOURCE))
        for file, title in re.findall(r'spec/(\w+\.md), "([^"]+)"', text):
            yield name, file, title
        for title in re.findall(r"\(registry, ([A-Z][\w ]*)\)", text):
            yield name, "registry.md", title
