"""Foxglove's camera messages in protobuf, by the field numbers of the recorded schema."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from mp4ds.messages.wire import (
    MAX_BLANK,
    MAX_DISTORTION,
    NS,
    CalibrationFields,
    CodedFields,
    Fields,
    Form,
    ImageFields,
    Reading,
    Slots,
    Span,
    WireError,
    join_stamp,
    make_fields,
    text,
)

Kind = Literal["time", "text", "u32", "doubles", "data"]

_HEADER: dict[str, Kind] = {"timestamp": "time", "frame_id": "text"}
_SIZE: dict[str, Kind] = {"width": "u32", "height": "u32"}
_CODED: dict[str, Kind] = {**_HEADER, "data": "data", "format": "text"}
_LENGTHS = {"K": 9, "R": 9, "P": 12}

FOXGLOVE_TYPES: Mapping[str, tuple[type[Fields], Mapping[str, Kind]]] = {
    "foxglove.RawImage": (
        ImageFields,
        {**_HEADER, **_SIZE, "encoding": "text", "step": "u32", "data": "data"},
    ),
    "foxglove.CompressedImage": (CodedFields, _CODED),
    "foxglove.CompressedVideo": (CodedFields, _CODED),
    "foxglove.CameraCalibration": (
        CalibrationFields,
        {
            **_HEADER,
            **_SIZE,
            "distortion_model": "text",
            **dict.fromkeys("DKRP", "doubles"),
        },
    ),
}
"""The fields of each type and what they hold (spec/registry.md, "Message types")."""

_VARINT, _I64, _LEN, _I32 = 0, 1, 2, 5  # wire types
_UINT64 = (1 << 64) - 1
_INT64 = 1 << 63
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


class ProtobufForm(Form):
    """One of Foxglove's message types.

    Args:
        type_name: One of `FOXGLOVE_TYPES`.
        schema: A serialized FileDescriptorSet that declares it.

    Raises:
        WireError: The type differs, or the schema does not declare it with its fields.
    """

    wire = "protobuf"

    def __init__(self, type_name: str, schema: bytes) -> None:
        if type_name not in FOXGLOVE_TYPES:
            raise WireError(f"type {type_name!r} is not modelled")
        self._kind, self._kinds = FOXGLOVE_TYPES[type_name]
        self._declared = _declared(type_name, schema, self._kinds)

    def read(self, data: memoryview) -> Reading:
        """Read a message."""
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
            if (around := field.end - (body[1] - body[0])) > MAX_BLANK:
                # before all were read: this bounds the number of fields
                raise WireError(f"it has {around} bytes besides its data")
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
        parts = {
            "stamp": values["timestamp"],
            "seq": None,
            "pts": None,
            "frame_id": values["frame_id"],
            "fields": make_fields(self._kind, _checked(values)),
        }
        return Reading(parts, spans, body)

    def slot(self, name: str, slots: Slots, body_size: int) -> bytes:
        """The bytes of a slot, with its length."""
        if name == "body":
            return _varint_bytes(body_size)
        timestamp = _timestamp(slots.stamp)
        return _varint_bytes(len(timestamp)) + timestamp


def _checked(values: dict[str, Any]) -> dict[str, Any]:
    """Values by their names in ROS, where lists have the right lengths."""
    for name, size in _LENGTHS.items():
        if name in values and len(values[name]) != size:
            raise WireError(f"it has {len(values[name])} values in {name}, not {size}")
    if len(values.get("D", ())) > MAX_DISTORTION:
        raise WireError(f"it has {len(values['D'])} distortion parameters")
    return {name.lower(): value for name, value in values.items()}


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
    stamp = join_stamp(values[1], values[2])
    if not -_INT64 <= stamp < _INT64:  # what a column holds
        raise WireError("its stamp is beyond 64-bit nanoseconds")
    return stamp


def _timestamp(stamp: int) -> bytes:
    """A google.protobuf.Timestamp as serializers write it."""
    sec, nanos = divmod(stamp, NS)
    if not -(1 << 63) <= sec < 1 << 63:
        raise WireError("a time is beyond what its message has bits for")
    out = b"\x08" + _varint_bytes(sec & _UINT64) if sec else b""
    return out + (b"\x10" + _varint_bytes(nanos) if nanos else b"")


# ---------------------------------------------------------------- other messages


def decoder_of_schema(type_name: str, schema: bytes) -> Callable[[memoryview], Any]:
    """A decoder of messages of any type; it raises WireError for invalid ones.

    Args:
        type_name: Full name of the messages' type.
        schema: A serialized FileDescriptorSet that declares it and everything it refers to.

    Raises:
        WireError: It does not.
    """
    # only recordings with protobuf need it
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message import DecodeError
    from google.protobuf.message_factory import GetMessageClass, GetMessages

    try:
        pool = DescriptorPool()
        GetMessages(FileDescriptorSet.FromString(schema).file, pool)
        # by name, as a type may be declared inside another one
        message_class = GetMessageClass(pool.FindMessageTypeByName(type_name))
    except (DecodeError, LookupError, ValueError, TypeError, RecursionError):
        raise WireError(f"its schema does not declare {type_name}") from None

    def decode(data: memoryview) -> Any:
        try:
            return message_class.FromString(bytes(data))
        except (DecodeError, ValueError):  # the latter by protobuf's pure Python
            raise WireError(f"it is not a {type_name}") from None

    return decode
