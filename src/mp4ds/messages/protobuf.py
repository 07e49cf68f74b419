"""Foxglove's camera messages in protobuf, by the field numbers of the recorded schema."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from mp4ds.messages.wire import (
    MAX_BLANK,
    NS,
    CalibrationFields,
    CodedFields,
    Fields,
    ImageFields,
    Parts,
    Slots,
    WireError,
    check_floats,
    join_stamp,
    text,
)

Kind = Literal["time", "text", "u32", "doubles", "data"]
Span = tuple[int, int]

_HEADER: dict[str, Kind] = {"timestamp": "time", "frame_id": "text"}
_SIZE: dict[str, Kind] = {"width": "u32", "height": "u32"}
_CODED: dict[str, Kind] = {**_HEADER, "data": "data", "format": "text"}
_MATRIX_SIZES = {"K": 9, "R": 9, "P": 12}
_MAX_DISTORTION = 1024
_INT64 = 1 << 63

TYPES: Mapping[str, Mapping[str, Kind]] = {
    "foxglove.RawImage": {**_HEADER, **_SIZE, "encoding": "text", "step": "u32", "data": "data"},
    "foxglove.CompressedImage": _CODED,
    "foxglove.CompressedVideo": _CODED,
    "foxglove.CameraCalibration": {
        **_HEADER,
        **_SIZE,
        "distortion_model": "text",
        "D": "doubles",
        "K": "doubles",
        "R": "doubles",
        "P": "doubles",
    },
}
"""The fields of each type and what they hold (spec/registry.md, "Message types")."""


def fields_of_type(type_name: str) -> Mapping[str, Kind]:
    """Names and kinds of the fields of a message type.

    Raises:
        WireError: It is not one of `TYPES`.
    """
    if type_name not in TYPES:
        raise WireError(f"type {type_name!r} is not modelled")
    return TYPES[type_name]


def join_fields(type_name: str, values: Mapping[str, Any]) -> Fields:
    """A message's fields besides its header and body.

    Args:
        type_name: One of `TYPES`.
        values: All its text, number and number-list fields, by name.

    Raises:
        WireError: A calibration cannot be modelled.
    """
    if type_name == "foxglove.RawImage":
        return ImageFields(
            encoding=values["encoding"],
            width=values["width"],
            height=values["height"],
            step=values["step"],
            is_bigendian=0,
        )
    if type_name != "foxglove.CameraCalibration":
        return CodedFields(values["format"])
    for name, size in _MATRIX_SIZES.items():
        if len(values[name]) != size:
            raise WireError(f"it has {len(values[name])} values in {name}, not {size}")
    if len(values["D"]) > _MAX_DISTORTION:
        raise WireError(f"it has {len(values['D'])} distortion parameters")
    check_floats((*values["D"], *values["K"], *values["R"], *values["P"]))
    return CalibrationFields(
        height=values["height"],
        width=values["width"],
        distortion_model=values["distortion_model"],
        d=tuple(values["D"]),
        k=tuple(values["K"]),
        r=tuple(values["R"]),
        p=tuple(values["P"]),
    )


def join_wide_stamp(sec: int, nanosec: int) -> int:
    """Nanoseconds, where seconds may be out of a column's range.

    Raises:
        WireError: The stamp cannot be restored from them, or needs more than 64 bits.
    """
    stamp = join_stamp(sec, nanosec)
    if not -_INT64 <= stamp < _INT64:
        raise WireError("its stamp is beyond 64-bit nanoseconds")
    return stamp


@dataclass(frozen=True, slots=True)
class Pieces:
    """A message cut at its slots.

    Attributes:
        between: The bytes before, between and after the slots.
        names: The slots in order; ``body`` is the last before the body.
    """

    between: tuple[bytes, ...]
    names: tuple[str, ...]

    @classmethod
    def cut(cls, data: memoryview, spans: Mapping[str, Span]) -> Pieces:
        """Cut a message.

        Args:
            data: The message.
            spans: Start and end of each slot, in order.
        """
        ends = (0, *(end for _, end in spans.values()))
        starts = (*(start for start, _ in spans.values()), len(data))
        between = tuple(bytes(data[end:start]) for end, start in zip(ends, starts, strict=True))
        return cls(between, tuple(spans))

    def fill(self, values: Mapping[str, bytes]) -> tuple[bytes, bytes]:
        """The bytes before and after the body, with slots filled."""
        head, parts = b"", [self.between[0]]
        for name, piece in zip(self.names, self.between[1:], strict=True):
            parts.append(values[name])
            if name == "body":
                head, parts = b"".join(parts), []
            parts.append(piece)
        rest = b"".join(parts)
        return (head, rest) if "body" in self.names else (rest, b"")


def check_around(size: int) -> None:
    """Refuse a message that holds too much besides its data.

    Args:
        size: Bytes around its data.

    Raises:
        WireError: They are more than a blank may have.
    """
    if size > MAX_BLANK:
        raise WireError(f"it has {size} bytes besides its data")


# ---------------------------------------------------------------- protobuf

_VARINT, _I64, _LEN, _I32 = 0, 1, 2, 5  # wire types
_UINT64 = (1 << 64) - 1
_BLANK = {"stamp": b"\0", "body": b"\0"}
_SLOTS: Mapping[Kind, str] = {"time": "stamp", "data": "body"}
_EMPTY: Mapping[Kind, Any] = {"text": "", "u32": 0}  # fields with this value are omitted

# FieldDescriptorProto.Type -> the wire types in which such a field is written
_DOUBLE, _FIXED32, _STRING, _MESSAGE, _BYTES, _UINT32 = 1, 7, 9, 11, 12, 13
_TYPES: Mapping[Kind, Mapping[int, tuple[int, ...]]] = {
    "time": {_MESSAGE: (_LEN,)},
    "text": {_STRING: (_LEN,)},
    "u32": {_FIXED32: (_I32,), _UINT32: (_VARINT,)},
    "doubles": {_DOUBLE: (_LEN, _I64)},
    "data": {_BYTES: (_LEN,)},
}
_REPEATED = 3
_TIMESTAMPS = ("google.protobuf.Timestamp", ".google.protobuf.Timestamp")


@dataclass(frozen=True, slots=True)
class _Declared:
    """A field declared by the schema."""

    name: str
    kind: Kind
    wire_types: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class _Field:
    """A field of a message: `at` follows its tag, `start` to `end` is its value."""

    number: int
    wire_type: int
    at: int
    start: int
    end: int


@dataclass(frozen=True, slots=True)
class _Read:
    """The contents of a message, and the positions of its slots."""

    stamp: int
    frame_id: str
    fields: Fields
    body: Span
    spans: Mapping[str, Span]


class ProtobufForm:
    """One of Foxglove's message types in protobuf. See `mp4ds.messages.wire.Form`.

    Args:
        type_name: One of `mp4ds.messages.protobuf.TYPES`.
        schema: A serialized FileDescriptorSet that declares it.

    Raises:
        WireError: The type differs, or the schema does not declare it with its fields.
    """

    def __init__(self, type_name: str, schema: bytes) -> None:
        self._type_name = type_name
        self._kinds = fields_of_type(type_name)
        self._declared = _declared(type_name, schema, self._kinds)

    @property
    def wire(self) -> str:
        """See `Form.wire`."""
        return "protobuf"

    def split(self, data: memoryview) -> Parts:
        """See `Form.split`."""
        read = self._read(data)
        start, end = read.body
        return Parts(
            stamp=read.stamp,
            seq=None,
            pts=None,
            frame_id=read.frame_id,
            fields=read.fields,
            body=data[start:end],
            blank=b"".join(Pieces.cut(data, read.spans).fill(_BLANK)),
        )

    def template(self, blank: bytes) -> ProtobufTemplate:
        """See `Form.template`."""
        view = memoryview(blank)
        read = self._read(view)
        if any(view[at:end] != _BLANK[name] for name, (at, end) in read.spans.items()):
            raise WireError("a blank message has a timestamp or data")
        return ProtobufTemplate(Pieces.cut(view, read.spans))

    def plain(self, frame_id: str, fields: Fields) -> bytes | None:
        """See `Form.plain`."""
        return None

    def _read(self, data: memoryview) -> _Read:
        values: dict[str, Any] = {
            name: [] if kind == "doubles" else _EMPTY.get(kind)
            for name, kind in self._kinds.items()
        }
        spans: dict[str, Span] = {}
        body = (len(data), len(data))
        for field in _fields(data):
            declared = self._declared.get(field.number)
            slot = _SLOTS.get(declared.kind) if declared else None
            if declared and slot in spans:
                raise WireError(f"it has its {declared.name} twice")
            if slot == "body":
                body = field.start, field.end
            check_around(field.end - (body[1] - body[0]))  # also bounds the number of fields
            if declared is None:
                continue
            if field.wire_type not in declared.wire_types:
                raise WireError(f"its field {declared.name} is not of the declared type")
            if slot:
                spans[slot] = field.at, field.end
            _take(values, declared, field, data)
        for name, kind in self._kinds.items():
            if kind in _SLOTS and _SLOTS[kind] not in spans:
                raise WireError(f"it has no {name}")
        return _Read(
            stamp=values["timestamp"],
            frame_id=values["frame_id"],
            fields=join_fields(self._type_name, values),
            body=body,
            spans=spans,
        )


class ProtobufTemplate:
    """A blank in protobuf. See `mp4ds.messages.wire.Template`."""

    def __init__(self, pieces: Pieces) -> None:
        self._pieces = pieces

    def around(self, slots: Slots, body_size: int) -> tuple[bytes, bytes]:
        """See `Template.around`."""
        timestamp = _timestamp(slots.stamp)
        stamp = _varint_bytes(len(timestamp)) + timestamp
        return self._pieces.fill({"stamp": stamp, "body": _varint_bytes(body_size)})

    def padding(self, body_size: int) -> int:
        """See `Template.padding`: never."""
        return 0


def _declared(type_name: str, schema: bytes, kinds: Mapping[str, Kind]) -> Mapping[int, _Declared]:
    """The modelled fields by their numbers in the schema."""
    declared = {field.name: field for field in _declaration(type_name, schema).field}
    by_number: dict[int, _Declared] = {}
    for name, kind in kinds.items():
        field = declared.get(name)
        if field is None:
            if name == "frame_id":  # older image schemas have none
                continue
            raise WireError(f"its schema has no field {name!r}")
        is_repeated = field.label == _REPEATED
        if field.type not in _TYPES[kind] or is_repeated != (kind == "doubles"):
            raise WireError(f"field {name!r} of its schema is not of Foxglove's type")
        if kind == "time" and field.type_name not in _TIMESTAMPS:
            raise WireError(f"field {name!r} of its schema is not a google.protobuf.Timestamp")
        by_number[field.number] = _Declared(name, kind, _TYPES[kind][field.type])
    return by_number


def _declaration(type_name: str, schema: bytes) -> Any:
    """The DescriptorProto of a type."""
    # only recordings with protobuf need it
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.message import DecodeError

    try:
        files = FileDescriptorSet.FromString(schema).file
    except (DecodeError, ValueError):  # the latter by protobuf's pure Python
        raise WireError("its schema is not a FileDescriptorSet") from None
    name = tuple(type_name.rsplit(".", 1))
    # compared one by one: names that are not UTF-8 come as bytes
    found = [
        message
        for file in files
        for message in file.message_type
        if (file.package, message.name) == name
    ]
    if len(found) != 1:
        raise WireError(f"its schema declares {type_name} {len(found)} times")
    return found[0]


def _fields(data: memoryview) -> Iterator[_Field]:
    """The fields of a message, one after another."""
    at = 0
    while at < len(data):
        tag, at = _varint(data, at)
        number, wire_type = tag >> 3, tag & 7
        if number == 0 or tag >> 32:
            raise WireError("it has an invalid tag")
        start = at
        if wire_type == _VARINT:
            end = _varint(data, at)[1]
        elif wire_type == _LEN:
            size, start = _varint(data, at)
            end = start + size
        elif wire_type in (_I64, _I32):
            end = at + (8 if wire_type == _I64 else 4)
        else:
            raise WireError(f"it has a field of wire type {wire_type}")
        if end > len(data):
            raise WireError(f"it ends at byte {len(data)}, but a field extends to byte {end}")
        yield _Field(number, wire_type, at, start, end)
        at = end


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    """A varint of at most 64 bits, and where it ends."""
    value = 0
    for index, byte in enumerate(data[at : at + 10]):
        value |= (byte & 0x7F) << (7 * index)
        if byte < 0x80:
            if value > _UINT64:
                break
            return value, at + index + 1
    raise WireError("a number in it is cut short")


def _varint_bytes(value: int) -> bytes:
    """A varint in as few bytes as possible."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _take(values: dict[str, Any], declared: _Declared, field: _Field, data: memoryview) -> None:
    """Add a field's value to the others."""
    raw = data[field.start : field.end]
    if declared.kind == "time":
        values[declared.name] = _stamp(raw)
    elif declared.kind == "text":
        values[declared.name] = text(raw)
    elif field.wire_type == _VARINT:
        values[declared.name] = _varint(raw, 0)[0] & 0xFFFFFFFF
    elif declared.kind == "u32":
        values[declared.name] = struct.unpack("<I", raw)[0]
    elif declared.kind == "doubles":
        if len(raw) % 8:
            raise WireError("a list of numbers in it is cut short")
        values[declared.name] += struct.unpack(f"<{len(raw) // 8}d", raw)


def _stamp(raw: memoryview) -> int:
    """Nanoseconds of a google.protobuf.Timestamp."""
    values = {1: 0, 2: 0}
    for field in _fields(raw):
        if field.number in values:
            if field.wire_type != _VARINT:
                raise WireError("its timestamp is not of the declared type")
            value = _varint(raw, field.start)[0]
            values[field.number] = value - (value >> 63 << 64)
    return join_wide_stamp(values[1], values[2])


def _timestamp(stamp: int) -> bytes:
    """A google.protobuf.Timestamp as serializers write it."""
    sec, nanos = divmod(stamp, NS)
    if not -(1 << 63) <= sec < 1 << 63:
        raise WireError("a time is beyond what its message has bits for")
    out = b"\x08" + _varint_bytes(sec & _UINT64) if sec else b""
    return out + (b"\x10" + _varint_bytes(nanos) if nanos else b"")
