"""The YAML subset: everything that JSON can say returns, and nothing else is read."""

from __future__ import annotations

import math
from typing import Any

import pytest
import xxhash
import yaml
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from mp4ds import yamlio
from mp4ds.errors import FormatError

steady = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])

# What some YAML reader takes for something else, and what breaks careless writers and slicers.
NASTY = [
    *("", " ", "~", "null", "Null", "yes", "No", "on", "y", "N", "true", "True", "FALSE", "off"),
    *("010", "0o10", "0x10", "1_000", "1e3", "1.", ".5", "-.5", "+1", "-", "--", "---", "..."),
    *("12:30:00", "1:2", "2024-01-01", "2024-01-01T00:00:00Z", ".inf", "-.INF", ".nan", "=", "<<"),
    *("#", "a #b", "a: b", "a:", ": a", "- a", "? a", "[a", "{a", "a]", "a}", "a,b", "&a", "*a"),
    *("!a", "!!str a", "%a", "@a", "`a", "|", ">", "'a'", '"a"', "a'b", 'a"b', "\\", "a\\nb"),
    *(" a", "a ", "a\n", "\na", "a\n\n", "\n", "\n\n", "a\n b\n", " a\nb", "a \nb", "a\n \nb"),
    *("\t", "\ta", "a\tb\n", "a\r\nb\r\n", "\r", "a\x85b", "a\u2028b\n", "\u2029", "\ufeffa"),
    *("\x00", "\x07\n", "\x7f", "\x9f", "\ufffe", "\U0001f916\n\U0001f916", "\u00e4\n\u00f6"),
    *("x" * 300, "a b " * 60, "a b " * 60 + "\n" + "c " * 90, "- a\n- b", "# a\n# b"),
    *("values: |", "  values: |", "x\n  values: |\n    1 2\n", "x\nvalues: |\n  1 2"),
    *("  values: |\n    1 2\n", "x\n  values: |\n", "mp4ds column 0", "mp4ds column 0\n"),
    *("mp4ds column 1\n", "mp4ds column 99", "mp4ds column x", 'checksum: "xxh64:0"', "checksum"),
    'a\nchecksum: "xxh64:0123456789abcdef"\n',
    "mp4ds: 1\n...\n---\nb",
]
NASTY_KEYS = ["values", "start", "checksum", "mp4ds", "a"]
Texts = st.sampled_from(NASTY) | st.text(st.characters(exclude_categories=["Cs"]), max_size=40)
Keys = st.sampled_from(NASTY_KEYS) | Texts
Scalars = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.integers(-(2**63), 2**64)
    | st.floats(allow_nan=False, allow_infinity=False)
    | Texts
)
Values = st.recursive(
    Scalars,
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(Keys, inner, max_size=5),
    max_leaves=20,
)
Documents = st.dictionaries(Keys, Values, max_size=6)


def same(a: Any, b: Any) -> bool:
    """Equal in value and type, floats bit for bit, keys in order."""
    if type(a) is not type(b):
        return False
    if isinstance(a, float):
        return a == b and math.copysign(1, a) == math.copysign(1, b)
    if isinstance(a, list):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    return bool(a == b)


def load(text: str) -> Any:
    return yamlio.load(text.encode(), "some.yaml")


# ---------------------------------------------------------------- round trip


def load_back(document: dict[str, Any]) -> dict[str, Any]:
    return yamlio.load(yamlio.dump(document, comment="A comment."), "some.yaml")


@steady
@given(Documents)
def test_any_document_returns(document: dict[str, Any]) -> None:
    """Also by PyYAML, a reader of YAML 1.1, which takes more words for something else."""
    assert same(load_back(document), document)
    document = {"mp4ds": "1.0", **document}
    document.pop("checksum", None)
    data = yamlio.dump(document)
    read = yaml.safe_load(data)
    body = data[: data.rindex(b"checksum")]  # the last line is that of all before
    assert data == body + f'checksum: "xxh64:{xxhash.xxh64(body).hexdigest()}"\n'.encode()
    assert read.pop("checksum").startswith("xxh64:")
    assert same(read, document)


@pytest.mark.parametrize("place", ["value", "key", "item", "deep", "beside"])
def test_nasty_strings_return_everywhere(place: str) -> None:
    for text in NASTY:
        document: dict[str, Any] = {
            "value": {"a": text, "b": 1},
            "key": {text: text, "other": {text: 1}},
            "item": {"a": [text, [text], {"b": text}]},
            "deep": {"a": {"b": {"c": [{"values": text, "start": text}]}}},
            "beside": {
                "a": {"values": "1 2\n3\n"},
                "b": text,
                "values": text,
                "c": {"values": "4\n"},
            },
        }[place]
        assert same(load_back(document), document)


@steady
@given(
    st.lists(st.lists(st.integers(-(2**63), 2**63), min_size=1, max_size=40), max_size=4),
    st.sampled_from(NASTY),
)
@example([], "x\n  values: |\n    1 2\n")
def test_columns_are_literal_blocks_and_return(columns: list[list[int]], text: str) -> None:
    blocks = [
        "\n".join(" ".join(map(str, column[i : i + 4])) for i in range(0, len(column), 4)) + "\n"
        for column in columns
    ]
    document = {
        "text": text,
        "columns": {str(i): {"start": 0, "values": block} for i, block in enumerate(blocks)},
        "list": [{"values": block} for block in blocks],
    }
    data = yamlio.dump(document)
    assert same(yamlio.load(data, "some.yaml"), document)
    for block in blocks:
        if block.count("\n") > 1:
            assert b"values: |\n" in data


# ---------------------------------------------------------------- reading


@pytest.mark.parametrize(
    ("text", "value"),
    [
        *((text, None) for text in ("", "null", "~")),
        ("true", True),
        ("false", False),
        *(("0", 0), ("-0", 0), ("+7", 7), ("-12", -12), ("18446744073709551615", 2**64 - 1)),
        *(("1.5", 1.5), ("1e3", 1000.0), ("-0.0", -0.0), ("+1.0E-3", 0.001), ("5e-324", 5e-324)),
        *((text, text) for text in ("yes", "No", "on", "True", "NULL", "Null", "010", "0x10")),
        *((text, text) for text in ("1_000", ".5", "1.", ".inf", ".NaN", "12:30:00", "1e", "0o7")),
        *((text, text) for text in ("2024-01-01", "2024-01-01 10:00:00", "--1", "00", "0.5.1")),
        ("'1'", "1"),
        ('"true"', "true"),
        ("|\n  12\n", "12\n"),
        (">\n  1\n  2\n", "1 2\n"),
        ("[1, yes, {b: ~}]", [1, "yes", {"b": None}]),
        ("a  # comment", "a"),
    ],
)
def test_plain_scalars(text: str, value: Any) -> None:
    assert same(load(f"a: {text}\n"), {"a": value})


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: &x 1\nb: *x\n", "anchors"),
        ("a: *x\n", "anchors"),
        ("a: !!str 1\n", "tags"),
        ("a: !!python/object/apply:os.system [x]\n", "tags"),
        ("a: 1\na: 2\n", "is repeated"),
        ("1: a\n", "not a string"),
        ("? [a]\n: b\n", "not a string"),
        ("- a\n", "not a map"),
        ("a: 1\n---\nb: 1\n", "several"),
        ("", "is empty"),
        ("a: 1e999\n", "finite"),
        ("a: " + "9" * 5000 + "\n", "integer"),
        ("a: [1\n", "subset, perhaps cut short: line 2: did not find expected"),
        ("a: \x00\n", "not valid"),
        ("[" * 100_000, "nest"),  # PyYAML may refuse it itself, before it gives us 32 levels
        ("a: " + "{a: " * 100_000, "nest"),
        ("a:\n" + "".join(" " * n + "-\n" for n in range(1, 60)), "deeper than 32"),
    ],
)
def test_refused(text: str, words: str) -> None:
    with pytest.raises(FormatError) as caught:
        load(text)
    assert caught.value.code == "yaml-invalid"
    assert words in str(caught.value)
    assert str(caught.value).startswith("some.yaml: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        "c:\n    values: |\n      1 2\n\n      3\nd: 4\n",  # a blank line inside
        "c:\n    values: |\n        1 2\n        3\nd: 4\n",  # indented deeper
        "c:\n  values: |\n    1 2\n\nd: 4\n",
        "c:\n  values: |\n    1 2\n    # no comment\nd: 4\n",
        "c:\n  values: |\nd: 4\n",
        "c:\n  values: |\n    1 2",
        "c:\n  values: |\n   1 2\nd: 4\n",  # indented by one only
        "c:\n  values: |\n    \u00e4\nd: 4\n",
        "c:\n  values: |\n    1\n      2\nd: 4\n",
        "c:\n- values: |\n    1 2\n- values: |\n    3\n",
        "c:\n  values: |\r\n    1 2\r\nd: 4\r\n",
        *(
            f"c:\n  values:{style}\n    1 2\n    3\nd: 4\n"
            for style in ("", " |", " |-", " |+", " >")
        ),
    ],
)
def test_columns_written_otherwise(text: str) -> None:
    """Whatever the slicer does, the document is that of an ordinary parser."""
    assert same(load(text), yaml.safe_load(text))


# ---------------------------------------------------------------- checksum


@steady
@given(st.data())
def test_no_change_of_a_byte_goes_unnoticed(data: st.DataObject) -> None:
    document = {"a": {"values": "1 2 3\n4 5 6\n"}, "b": ["x", 1.5], "c": "one\ntwo\n"}
    raw = bytearray(yamlio.dump(document, comment="A comment."))
    place = data.draw(st.integers(0, len(raw) - 1))
    raw[place] ^= data.draw(st.integers(1, 255))
    try:
        assert yamlio.load(bytes(raw), "some.yaml") != document
    except FormatError as error:
        assert error.code in ("checksum-mismatch", "yaml-invalid")  # noqa: PT017


def test_without_its_line_an_edited_file_is_read() -> None:
    raw = yamlio.dump({"a": 1}).replace(b"a: 1", b"a: 2")
    with pytest.raises(FormatError) as caught:
        yamlio.load(raw, "some.yaml")
    assert caught.value.code == "checksum-mismatch"
    assert "remove that line" in str(caught.value)
    assert yamlio.load(raw[: raw.index(b"checksum")], "some.yaml") == {"a": 2}
