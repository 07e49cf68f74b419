"""The YAML of sidecars and manifests (spec/index.md, "The YAML subset").

A file is the JSON-compatible core of YAML 1.2: maps, lists, strings, integers, floats, true,
false and null; no anchors, tags, dates, duplicate keys or other spellings of booleans.
Long columns are block scalars at the end and are cut out before parsing, so that parsing costs as
much as the structure, not the columns. The last line is a checksum of all bytes before it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from typing import Any

import xxhash
import yaml

from mp4ds.errors import FormatError

MAX_BYTES = 512 * 2**20  # the sidecar of a day at 60 Hz has about 100 MB
MAX_STRUCTURE_BYTES = 16 * 2**20
MAX_DEPTH = 32
MAX_EVENTS = 10**6
MAX_ALIASED = 10**4
_MAX_DIGITS = 4300  # Python's limit for converting integers
_TEXT_OF_A_VALUE = 32  # characters that count as a value when an alias repeats them
_PLAIN_TAGS = ("tag:yaml.org,2002:str", "!")

_CHECKSUM = re.compile(rb'(?:\A|\n)checksum: "xxh64:([0-9a-f]{16})"\n\Z')
_COLUMN = re.compile(rb"^( +)values: \|\n", re.MULTILINE)
_MARK = "mp4ds column "
_COLUMN_LINE = re.compile(r"^ *values: [|]", re.MULTILINE)

_Parser: type[Any] = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_BaseDumper: type[Any] = yaml.SafeDumper
_NUMBER = re.compile(r"[-+]?(?:0|[1-9][0-9]*)(\.[0-9]+)?([eE][-+]?[0-9]+)?")
WORDS = {"": None, "null": None, "~": None, "true": True, "false": False}
"""Plain scalars that are no strings."""


class PlainDumper(_BaseDumper):  # type: ignore[misc]
    """Writes no anchors."""

    def ignore_aliases(self, data: Any) -> bool:
        """Whether a value is written again where it repeats: any."""
        return True


class _Dumper(PlainDumper):
    """Writes the subset: lists indented, multi-line texts as literal blocks."""

    def increase_indent(self, flow: bool = False, indentless: bool = False) -> Any:
        return super().increase_indent(flow, False)

    def analyze_scalar(self, scalar: str) -> Any:
        analysis = super().analyze_scalar(scalar)
        # PyYAML quotes a text with spaces before a line break; a literal block keeps them too.
        if analysis.multiline and re.fullmatch(r"[\n\x20-\x7e]+", scalar) and scalar.strip():
            analysis.allow_block = True
        return analysis


def _represent_str(dumper: _Dumper, text: str) -> Any:
    plain_block = bool(re.fullmatch(r"[^\s][\n\x20-\x7e\xa0-\u2027\u2030-\ud7ff]*", text))
    # a text without a final newline, or that looks like a column's first line, is quoted: readers
    # may cut it out
    plain_block &= "\n" in text and not text.endswith("\n\n") and not _COLUMN_LINE.search(text)
    style = "|" if plain_block else None
    if not plain_block and _needs_quotes(text):
        style = '"'
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=style)


def _needs_quotes(text: str) -> bool:
    # What YAML 1.1 readers take for something else: yes, no, on, 1_000, 12:30:00, 2024-01-01 ...
    # and the line breaks of Unicode, which a plain or quoted scalar would fold.
    pattern = r"[-+.0-9~]|(?i:y|n|yes|no|on|off|true|false|null)$|.*[\x85\u2028\u2029]|$"
    return bool(re.match(pattern, text, re.DOTALL))


def _represent_float(dumper: _Dumper, value: float) -> Any:
    text = repr(value)
    if "e" in text and "." not in text:
        text = text.replace("e", ".0e")
    return dumper.represent_scalar("tag:yaml.org,2002:float", text)


def _represent_list(dumper: _Dumper, items: list[Any]) -> Any:
    flow = all(isinstance(item, (int, float)) for item in items)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", items, flow_style=flow)


_Dumper.add_representer(str, _represent_str)
_Dumper.add_representer(float, _represent_float)
_Dumper.add_representer(list, _represent_list)


def dump(document: dict[str, Any], *, comment: str = "") -> bytes:
    """Write a document of the subset, ending with its checksum line.

    Args:
        document: JSON-like values; keys keep their order.
        comment: One line for human readers at the top.

    Returns:
        UTF-8 bytes.
    """
    body = yaml.dump(
        document, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=100, indent=2
    )
    if comment:
        body = f"# {comment}\n{body}"
    data = body.encode()
    return data + b'checksum: "xxh64:%s"\n' % xxhash.xxh64(data).hexdigest().encode()


def load(data: bytes, place: str) -> dict[str, Any]:
    """Read a document of the subset and verify its checksum, if it has one.

    Args:
        data: The file's bytes.
        place: The file's name, for errors.

    Returns:
        The document, without the checksum.

    Raises:
        FormatError: ``yaml-invalid`` or ``checksum-mismatch``.
    """
    if len(data) > MAX_BYTES:
        raise FormatError("yaml-invalid", place, f"is larger than {MAX_BYTES} bytes")
    end = len(data)  # of the document; nothing large is copied to get at its columns
    match = _CHECKSUM.search(data, max(0, end - 64))
    if match:
        end = match.start() + 1 if match.start() or data[:1] == b"\n" else 0
        if xxhash.xxh64(memoryview(data)[:end]).hexdigest().encode() != match.group(1):
            problem = "does not match the checksum in its last line: it was damaged or edited"
            problem += "; if the edit was intended, remove that line"
            raise FormatError("checksum-mismatch", place, problem)
    structure, columns = _slice_columns(data, end)
    if len(structure) > MAX_STRUCTURE_BYTES:
        raise FormatError("yaml-invalid", place, "has too many values outside its columns")
    document = _parse(structure, place)
    marks = structure.count(_MARK.encode())
    if columns and not marks == _restore_columns(document, columns) == len(columns):
        document = _parse(data[:end], place)  # what looked like a column was inside a text
    return document


def _parse(data: bytes, place: str) -> dict[str, Any]:
    try:
        document = _build(yaml.parse(data.decode(), Loader=_Parser), _scalar, is_subset=True)
    except (yaml.YAMLError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        is_at_end = mark is not None and mark.index >= len(data.decode(errors="replace"))
        problem = f"is not valid YAML of the subset{', perhaps cut short' if is_at_end else ''}"
        raise FormatError("yaml-invalid", place, f"{problem}: {_reason(error)}") from None
    if not isinstance(document, dict):
        raise FormatError("yaml-invalid", place, "is not a mapping")
    return document


def build(text: str, scalar: Callable[[Any], Any]) -> Any:
    """Read a third-party YAML document, in bounded time and memory.

    Keys are strings, as written. An alias counts as much as its value.

    Args:
        text: One document.
        scalar: Converts a scalar event to a value.

    Raises:
        ValueError: It is not YAML, has tags other than ``!!str``, keys that are not strings or are
            repeated, or is too large or too deeply nested.
    """
    try:
        return _build(yaml.parse(text, Loader=_Parser), scalar, is_subset=False)
    except yaml.YAMLError as error:
        raise ValueError(_reason(error)) from None


def _reason(error: Exception) -> str:
    """What a parser says, with the line, in one sentence."""
    mark = getattr(error, "problem_mark", None)
    if isinstance(error, yaml.MarkedYAMLError) and mark and error.problem:
        return f"line {mark.line + 1}: {error.problem}"
    return " ".join(str(error).split()) or type(error).__name__


class _Node:
    """A map or list being read.

    Attributes:
        value: What has been read so far.
        key: In a map, the key of the next value; None if a key comes next.
        anchor: Its name for aliases, if it has one.
        before: Size of everything before it.
        height: Levels below it.
    """

    __slots__ = ("anchor", "before", "height", "key", "value")

    def __init__(self, value: dict[str, Any] | list[Any], anchor: str | None, before: int) -> None:
        self.value = value
        self.key: str | None = None
        self.anchor = anchor
        self.before = before
        self.height = 0


def _build(events: Iterable[Any], scalar: Callable[[Any], Any], *, is_subset: bool) -> Any:
    """Build values from parser events: the loop has no recursion that input could exhaust."""
    root: list[Any] = []
    open_nodes = [_Node(root, None, 0)]
    anchored: dict[str, tuple[Any, int, int]] = {}  # name -> value, size, height
    size = aliased = 0
    for event in events:
        size += 1
        if isinstance(event, (yaml.MappingEndEvent, yaml.SequenceEndEvent)):
            done = open_nodes.pop()
            open_nodes[-1].height = max(open_nodes[-1].height, done.height + 1)
            if done.anchor is not None:
                anchored[done.anchor] = done.value, size - done.before, done.height + 1
            continue
        if not isinstance(event, yaml.NodeEvent):
            continue
        line, height = _line(event), 0
        tag = getattr(event, "tag", None)
        if is_subset and (isinstance(event, yaml.AliasEvent) or event.anchor is not None):
            raise ValueError(f"line {line}: anchors and aliases are not allowed")
        if tag is not None and (is_subset or tag not in _PLAIN_TAGS):
            raise ValueError(f"line {line}: tags are not allowed")
        parent = open_nodes[-1]
        value: Any
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in anchored or _wants_key(parent):
                raise ValueError(f"line {line}: alias {event.anchor!r} stands for no value")
            value, weight, height = anchored[event.anchor]
            size, aliased = size + weight, aliased + weight
            if aliased > MAX_ALIASED:
                raise ValueError(f"its aliases stand for more than {MAX_ALIASED} values")
        elif isinstance(event, yaml.ScalarEvent):
            as_text = tag == _PLAIN_TAGS[0] or (_wants_key(parent) and not is_subset)
            value = event.value if as_text else scalar(event)
            if event.anchor is not None:
                anchored[event.anchor] = value, 1 + len(event.value) // _TEXT_OF_A_VALUE, 0
        else:
            value = {} if isinstance(event, yaml.MappingStartEvent) else []
        _attach(parent, value, line)
        parent.height = max(parent.height, height)
        if size > MAX_EVENTS:
            raise ValueError(f"has more than {MAX_EVENTS} values")
        if isinstance(event, yaml.CollectionStartEvent):
            open_nodes.append(_Node(value, event.anchor, size))
            height = 0
        if len(open_nodes) + height > MAX_DEPTH + 1:  # the first encloses the document
            raise ValueError(f"line {line}: is nested deeper than {MAX_DEPTH} levels")
    if len(root) != 1:
        raise ValueError("has several documents" if root else "is empty")
    return root[0]


def _wants_key(node: _Node) -> bool:
    return isinstance(node.value, dict) and node.key is None


def _line(event: Any) -> int:
    return int(event.start_mark.line) + 1


def _attach(parent: _Node, value: Any, line: int) -> None:
    if isinstance(parent.value, list):
        parent.value.append(value)
    elif parent.key is not None:
        parent.value[parent.key] = value
        parent.key = None
    elif not isinstance(value, str):
        raise ValueError(f"line {line}: key {value!r} is not a string")
    elif value in parent.value:
        raise ValueError(f"line {line}: key {value!r} is repeated")
    else:
        parent.key = value


def _scalar(event: Any) -> Any:
    text: str = event.value
    if event.style not in (None, ""):
        return text
    if text in WORDS:
        return WORDS[text]
    number = _NUMBER.fullmatch(text)
    if not number:
        return text
    if len(text) > _MAX_DIGITS:
        raise ValueError(f"line {_line(event)}: an integer of {len(text)} digits")
    if not number.group(1) and not number.group(2):
        return int(text)
    value = float(text)
    if value - value != 0:
        raise ValueError(f"line {_line(event)}: {text} is not a finite number")
    return value


def _slice_columns(data: bytes, end: int) -> tuple[bytes, list[str]]:
    """Cut the literal blocks of columns out, leaving a numbered placeholder for each.

    Returns:
        The document's structure, and the columns without their indentation; if a block is not in
        the form that we write, the whole document and no columns, for the parser to judge.
    """
    pieces: list[bytes] = []
    columns: list[str] = []
    done = 0
    while match := _COLUMN.search(data, done, end):
        start = match.end()
        indent = b" " * (len(match.group(1)) + 2)
        last = re.compile(rb"\n(?!" + indent + rb")").search(data, start - 1, end)
        stop = last.end() if last else end
        first = start + len(indent)
        if not data.startswith(indent, start) or data[first : first + 1].isspace():
            return data[:end], []
        try:
            text = str(memoryview(data)[first:stop], "ascii")
        except UnicodeDecodeError:
            return data[:end], []
        pieces += [data[done:start], indent, f"{_MARK}{len(columns)}\n".encode()]
        columns.append(text.replace(f"\n{indent.decode()}", "\n"))
        done = stop
    pieces.append(data[done:end])
    return b"".join(pieces), columns


def _restore_columns(node: Any, columns: list[str]) -> int:
    """Put the columns back in place of their placeholders; returns how many there were."""
    restored = 0
    if isinstance(node, dict):
        values = node.get("values")
        if isinstance(values, str) and values.startswith(_MARK):
            number = values[len(_MARK) :].strip()
            if number.isdigit() and int(number) < len(columns):
                node["values"] = columns[int(number)]
                restored += 1
        return restored + sum(_restore_columns(child, columns) for child in node.values())
    if isinstance(node, list):
        return sum(_restore_columns(child, columns) for child in node)
    return 0
