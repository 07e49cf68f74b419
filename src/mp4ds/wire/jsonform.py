"""Foxglove's camera messages in JSON: an object, its data in base64, its timestamp an object.

Positions are those of bytes: the text is scanned as Latin-1, which has a character for each byte,
since all that JSON itself is made of is ASCII (RFC 8259). Values are read as UTF-8. What the
blank does not tell, such as base64 in another spelling than that of RFC 4648, section 4, does not
come back, and the caller's proof says so.
"""

from __future__ import annotations

import json
import re
from binascii import Error as Base64Error
from binascii import a2b_base64, b2a_base64
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from mp4ds.wire.forms import MAX_BLANK, NS, Fields, Parts, Slots, WireError, text
from mp4ds.wire.foxglove import (
    Kind,
    Pieces,
    Span,
    check_around,
    fields_of_type,
    join_fields,
    join_wide_stamp,
)

_SPACE = r"[ \t\n\r]*"
_OPEN = re.compile(_SPACE + r"\{" + _SPACE)
_COLON = re.compile(_SPACE + ":" + _SPACE)
_COMMA = re.compile(_SPACE + "," + _SPACE)
_INTEGER = re.compile("-?[0-9]+")
_BLANK = {"sec": b"0", "nsec": b"0", "body": b""}


@dataclass(frozen=True, slots=True)
class _Read:
    """What is in a message without its data, and where its slots are."""

    stamp: int
    frame_id: str
    fields: Fields
    spans: Mapping[str, Span]


class JsonForm:
    """One of Foxglove's message types in JSON. See `mp4ds.wire.forms.Form`.

    Args:
        type_name: One of `mp4ds.wire.foxglove.TYPES`.
        schema: Not read, and often empty: a message tells the names and types of its members.

    Raises:
        WireError: The type is another.
    """

    def __init__(self, type_name: str, schema: bytes) -> None:
        self._type_name = type_name
        self._kinds = fields_of_type(type_name)

    @property
    def wire(self) -> str:
        """See `Form.wire`."""
        return "json"

    def split(self, data: memoryview) -> Parts:
        """See `Form.split`."""
        body, (start, end) = self._body(data)
        check_around(len(data) - (end - start))
        rest = b"".join((data[:start], data[end:]))
        read = self._read(rest)
        return Parts(
            stamp=read.stamp,
            seq=None,
            pts=None,
            frame_id=read.frame_id,
            fields=read.fields,
            body=memoryview(body),
            blank=b"".join(Pieces.cut(memoryview(rest), read.spans).fill(_BLANK)),
        )

    def template(self, blank: bytes) -> JsonTemplate:
        """See `Form.template`."""
        check_around(len(blank))
        read = self._read(blank)
        if any(blank[at:end] != _BLANK[name] for name, (at, end) in read.spans.items()):
            raise WireError("a blank message has a timestamp or data")
        return JsonTemplate(Pieces.cut(memoryview(blank), read.spans))

    def plain(self, frame_id: str, fields: Fields) -> bytes | None:
        """See `Form.plain`."""
        return None

    def _body(self, data: memoryview) -> tuple[bytes, Span]:
        """The decoded data, and where its base64 begins and ends."""
        if "data" not in self._kinds:
            return b"", (len(data), len(data))
        head = str(data[:MAX_BLANK], "latin-1")
        try:
            start = next((at for name, at in _members(head) if name == "data"), None)
        except WireError:
            if len(data) <= MAX_BLANK:
                raise
            start = None  # it may be the cut that is no JSON
        if start is None:
            raise WireError(f"it has no member data that begins in its first {MAX_BLANK} bytes")
        coded = bytes(data[start + 1 :])
        size = coded.find(b'"')
        if head[start : start + 1] != '"' or size < 0:
            raise WireError("its data is no string")
        coded = coded[:size]
        return _decoded(coded), (start + 1, start + 1 + size)

    def _read(self, rest: bytes) -> _Read:
        """Read a message without its data."""
        values = _loads(text(memoryview(rest)))
        for name, kind in self._kinds.items():
            if name == "frame_id":
                values.setdefault(name, "")
            if name not in values:
                raise WireError(f"it has no member {name}")
            values[name] = _checked(name, kind, values[name])
        scanned = str(rest, "latin-1")
        spans: dict[str, Span] = {}
        for name, at in _members(scanned):
            if self._kinds.get(name) == "time":
                spans.update(_time_spans(scanned, at))
            elif self._kinds.get(name) == "data":
                spans["body"] = (at + 1, _value(scanned, at)[1] - 1)
        return _Read(
            stamp=values["timestamp"],
            frame_id=values["frame_id"],
            fields=join_fields(self._type_name, values),
            spans=spans,
        )


class JsonTemplate:
    """A blank in JSON. See `mp4ds.wire.forms.Template`."""

    keeps_body = False

    def __init__(self, pieces: Pieces) -> None:
        self._pieces = pieces

    def around(self, slots: Slots, body_size: int) -> tuple[bytes, bytes]:
        """See `Template.around`."""
        sec, nsec = divmod(slots.stamp, NS)
        return self._pieces.fill({"sec": b"%d" % sec, "nsec": b"%d" % nsec, "body": b""})

    def padding(self, body_size: int) -> int:
        """See `Template.padding`: never."""
        return 0

    def encode_body(self, body: memoryview) -> bytes:
        """See `Template.encode_body`."""
        return b2a_base64(body, newline=False)


def _members(scanned: str, at: int = 0) -> Iterator[tuple[str, int]]:
    """The members of the object at an offset: their names, and where their values begin.

    Raises:
        WireError: A member is not JSON; elsewhere the iteration ends.
    """
    found = _OPEN.match(scanned, at)
    while found and scanned[found.end() : found.end() + 1] == '"':
        name, at = _value(scanned, found.end())
        found = _COLON.match(scanned, at)
        if not found:
            return
        yield name, found.end()
        _, at = _value(scanned, found.end())
        found = _COMMA.match(scanned, at)


def _value(scanned: str, at: int) -> tuple[Any, int]:
    """The value at an offset, and where it ends."""
    try:
        return json.JSONDecoder().raw_decode(scanned, at)
    except (ValueError, RecursionError):
        raise WireError("it is not JSON that can be read") from None


def _time_spans(scanned: str, at: int) -> Iterator[tuple[str, Span]]:
    """Where the integers of the timestamp at an offset are."""
    for name, start in _members(scanned, at):
        number = _INTEGER.match(scanned, start)
        if name in ("sec", "nsec") and number:
            yield name, number.span()


def _loads(message: str) -> dict[str, Any]:
    """The members of a message."""
    try:
        values = json.loads(message, object_pairs_hook=_unique)
    except WireError:
        raise
    except (ValueError, RecursionError):
        raise WireError("it is not JSON that can be read") from None
    if not isinstance(values, dict):
        raise WireError("it is no JSON object")
    return values


def _unique(members: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object, if no two of its members have one name."""
    values = dict(members)
    if len(values) != len(members):
        raise WireError("two members of an object in it have one name")
    return values


def _decoded(coded: bytes) -> bytes:
    """The bytes that base64 spells."""
    try:
        body = a2b_base64(coded)
    except Base64Error:
        body = b""
    padding = coded[-2:].count(b"=")
    if len(coded) % 4 or len(body) != len(coded) // 4 * 3 - padding:
        raise WireError("its data is not base64 without line breaks")
    return body


def _checked(name: str, kind: Kind, value: Any) -> Any:
    """A member's value as `join_fields` takes it; of the timestamp its nanoseconds."""
    if kind == "time" and isinstance(value, dict):
        sec, nsec = value.get("sec"), value.get("nsec")
        if type(sec) is int and type(nsec) is int:
            return join_wide_stamp(sec, nsec)
    is_right = {
        "time": False,
        "data": isinstance(value, str),
        "text": isinstance(value, str) and _is_unicode(value),
        "u32": type(value) is int and 0 <= value < 1 << 32,
        "doubles": isinstance(value, list) and all(type(x) in (int, float) for x in value),
    }
    if not is_right[kind]:
        raise WireError(f"its member {name} is not what Foxglove's type has there")
    return [_double(item) for item in value] if kind == "doubles" else value


def _is_unicode(value: str) -> bool:
    """Whether a string has no half of a surrogate pair, which JSON can spell."""
    try:
        value.encode()
    except UnicodeEncodeError:
        return False
    return True


def _double(value: float) -> float:
    """A number as a double; beyond all doubles it is infinite, as JSON's decoder has it."""
    try:
        return float(value)
    except OverflowError:
        return float("inf")
