"""Foxglove's camera messages in FlatBuffers, by the field ids of the recorded schema.

A message is walked by hand (flatbuffers.dev, "FlatBuffer Internals"). Its root table stands
before its data, as offsets only point forward. In its blank the data has no bytes, and what
points across the data points as if there were none; what follows the data, padding too, is as
it was.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mp4ds.wire.forms import NS, Fields, Parts, Slots, WireError, join_stamp, text
from mp4ds.wire.foxglove import Kind, check_around, fields_of_type, join_fields

# reflection.BaseType, reflection/reflection.fbs: a field's type, and that of a vector's elements
_UBYTE, _UINT, _DOUBLE, _STRING, _VECTOR, _OBJECT = 4, 8, 12, 13, 14, 15
_TYPES: Mapping[Kind, tuple[int, int]] = {
    "time": (_OBJECT, 0),
    "text": (_STRING, 0),
    "u32": (_UINT, 0),
    "doubles": (_VECTOR, _DOUBLE),
    "data": (_VECTOR, _UBYTE),
}
_MAX_DECLARED = 4096
_MAX_NAME = 256


@dataclass(frozen=True, slots=True)
class _Vector:
    """A vector or string.

    Attributes:
        place: Where the offset to it stands.
        start: Where its elements begin; their number stands in the four bytes before.
        count: How many there are.
        end: Where they end.
    """

    place: int
    start: int
    count: int
    end: int


@dataclass(frozen=True, slots=True)
class _Table:
    """A table: where it stands, where its vtable does, and the bytes of both."""

    data: memoryview
    at: int
    size: int
    vtable: int
    vtable_size: int

    @classmethod
    def behind(cls, data: memoryview, place: int) -> _Table:
        """The table that the offset at a place points to."""
        at = place + _number(data, "I", place)
        vtable = at - _number(data, "i", at)
        vtable_size, size = _number(data, "H", vtable), _number(data, "H", vtable + 2)
        if vtable_size < 4 or vtable_size % 2 or size < 4:
            raise WireError("a table in it is not one")
        _check_end(data, vtable + vtable_size)
        _check_end(data, at + size)
        return cls(data, at, size, vtable, vtable_size)

    def place(self, field_id: int, size: int) -> int | None:
        """Where a field of that many bytes stands; None where the table has it not."""
        entry = 4 + 2 * field_id
        if entry + 2 > self.vtable_size:
            return None
        offset = _number(self.data, "H", self.vtable + entry)
        if offset == 0:
            return None
        if offset < 4 or offset + size > self.size:
            raise WireError("a field stands outside of its table")
        return self.at + offset

    def number(self, field_id: int, code: str) -> int:
        """A field that is a number, 0 where the table has it not."""
        place = self.place(field_id, struct.calcsize(f"<{code}"))
        return 0 if place is None else _number(self.data, code, place)

    def vector(self, field_id: int, item_size: int = 1) -> _Vector | None:
        """A field that is a vector or string; None where the table has it not."""
        place = self.place(field_id, 4)
        if place is None:
            return None
        at = place + _number(self.data, "I", place)
        count = _number(self.data, "I", at)
        end = at + 4 + count * item_size
        _check_end(self.data, end)
        return _Vector(place, at + 4, count, end)


@dataclass(frozen=True, slots=True)
class _Places:
    """Where a message's slots are, bytes from its start.

    Attributes:
        stamp: Of the two numbers of its timestamp.
        body: Of its data; None where the type has none.
        crossing: Of each offset that points across the data, with its value if there were none.
    """

    stamp: int
    body: int | None
    crossing: tuple[tuple[int, int], ...]

    def fill(self, message: bytearray, slots: Slots, body_size: int) -> None:
        """Write all slots into the part of a message that ends where its data begins."""
        try:
            struct.pack_into("<II", message, self.stamp, *divmod(slots.stamp, NS))
            if self.body is not None:
                struct.pack_into("<I", message, self.body - 4, body_size)
            for place, offset in self.crossing:
                struct.pack_into("<I", message, place, offset + body_size)
        except struct.error:
            raise WireError("a time or number is beyond what its message has bits for") from None


@dataclass(frozen=True, slots=True)
class _Read:
    """What is in a message, and where its slots are."""

    stamp: int
    frame_id: str
    fields: Fields
    body_size: int
    places: _Places


class FlatbufferForm:
    """One of Foxglove's message types in FlatBuffers. See `mp4ds.wire.forms.Form`.

    Args:
        type_name: One of `mp4ds.wire.foxglove.TYPES`.
        schema: A binary schema (bfbs) that declares it.

    Raises:
        WireError: The type is another, or the schema does not declare it with its fields.
    """

    def __init__(self, type_name: str, schema: bytes) -> None:
        self._type_name = type_name
        self._kinds = fields_of_type(type_name)
        self._ids = _declared_ids(type_name, memoryview(schema), self._kinds)

    @property
    def wire(self) -> str:
        """See `Form.wire`."""
        return "flatbuffer"

    def split(self, data: memoryview) -> Parts:
        """See `Form.split`."""
        read = self._read(data)
        start = len(data) if read.places.body is None else read.places.body
        end = start + read.body_size
        head = bytearray(data[:start])
        read.places.fill(head, Slots(0), 0)
        return Parts(
            stamp=read.stamp,
            seq=None,
            pts=None,
            frame_id=read.frame_id,
            fields=read.fields,
            body=data[start:end],
            blank=bytes(head + data[end:]),
        )

    def template(self, blank: bytes) -> FlatbufferTemplate:
        """See `Form.template`."""
        read = self._read(memoryview(blank))
        if read.body_size or read.stamp:
            raise WireError("a blank message has a timestamp or data")
        return FlatbufferTemplate(blank, read.places)

    def plain(self, frame_id: str, fields: Fields) -> bytes | None:
        """See `Form.plain`."""
        return None

    def _read(self, data: memoryview) -> _Read:
        table = _Table.behind(data, 0)
        body = self._body(table)
        check_around(len(data) - (body.count if body else 0))
        values: dict[str, Any] = {"frame_id": ""}
        crossing: list[tuple[int, int]] = []
        for name, field_id in self._ids.items():
            kind = self._kinds[name]
            if kind == "u32":
                values[name] = table.number(field_id, "I")
            elif kind == "text":
                vector = table.vector(field_id)
                if vector and body and _is_behind(vector, body):
                    offset = _number(data, "I", vector.place)
                    crossing.append((vector.place, offset - body.count))
                values[name] = text(data[vector.start : vector.end]) if vector else ""
            elif kind == "doubles":
                vector = table.vector(field_id, 8)
                count, start = (vector.count, vector.start) if vector else (0, 0)
                values[name] = struct.unpack_from(f"<{count}d", data, start)
        stamp_at = table.place(self._ids["timestamp"], 8)
        if stamp_at is None:
            raise WireError("it has no timestamp")
        return _Read(
            stamp=join_stamp(_number(data, "I", stamp_at), _number(data, "I", stamp_at + 4)),
            frame_id=values["frame_id"],
            fields=join_fields(self._type_name, values),
            body_size=body.count if body else 0,
            places=_Places(stamp_at, body.start if body else None, tuple(crossing)),
        )

    def _body(self, table: _Table) -> _Vector | None:
        """The data; None where the type has none."""
        if "data" not in self._ids:
            return None
        body = table.vector(self._ids["data"])
        if body is None:
            raise WireError("it has no data")
        if max(table.at + table.size, table.vtable + table.vtable_size) > body.start - 4:
            raise WireError("its table does not stand before its data")
        return body


class FlatbufferTemplate:
    """A blank in FlatBuffers. See `mp4ds.wire.forms.Template`."""

    keeps_body = True

    def __init__(self, blank: bytes, places: _Places) -> None:
        self._places = places
        split = len(blank) if places.body is None else places.body
        self._head, self._tail = blank[:split], blank[split:]

    def around(self, slots: Slots, body_size: int) -> tuple[bytes, bytes]:
        """See `Template.around`."""
        head = bytearray(self._head)
        self._places.fill(head, slots, body_size)
        return bytes(head), self._tail

    def padding(self, body_size: int) -> int:
        """See `Template.padding`."""
        for place, offset in self._places.crossing:  # strings behind it stand at multiples of 4
            return -(place + offset + body_size) % 4
        return 0

    def encode_body(self, body: memoryview) -> memoryview:
        """See `Template.encode_body`."""
        return body


def _number(data: memoryview, code: str, at: int) -> int:
    """A little-endian integer of a struct code."""
    if at < 0:
        raise WireError("an offset points before its first byte")
    _check_end(data, at + struct.calcsize(f"<{code}"))
    return int(struct.unpack_from(f"<{code}", data, at)[0])


def _check_end(data: memoryview, end: int) -> None:
    if end > len(data):
        raise WireError(f"it ends at byte {len(data)} where a field needs {end}")


def _is_behind(vector: _Vector, body: _Vector) -> bool:
    """Whether a string follows the data, or is before it.

    Raises:
        WireError: Neither.
    """
    if vector.end > body.start - 4 and vector.start - 4 < body.end:
        raise WireError("a string stands within its data")
    return vector.start > body.start


def _declared_ids(type_name: str, schema: memoryview, kinds: Mapping[str, Kind]) -> dict[str, int]:
    """The ids of the modelled fields by their names (reflection/reflection.fbs)."""
    if bytes(schema[4:8]) != b"BFBS":
        raise WireError("its schema is no binary FlatBuffers schema")
    objects = _tables(_Table.behind(schema, 0), 0)
    declared = next((item for item in objects if _name(item) == type_name), None)
    if declared is None:
        raise WireError(f"its schema does not declare {type_name}")
    by_name = {_name(field).lower(): field for field in _tables(declared, 1)}
    ids: dict[str, int] = {}
    for name, kind in kinds.items():
        field = by_name.get(name.lower())
        if field is None:
            if name == "frame_id":  # as in the older schemas of other serializations
                continue
            raise WireError(f"its schema has no field {name!r}")
        base_type, element, index = _type(field)
        is_time = kind != "time" or (0 <= index < len(objects) and _is_time(objects[index]))
        if (base_type, element) != _TYPES[kind] or not is_time:
            raise WireError(f"field {name!r} of its schema is of another type than Foxglove's")
        ids[name] = field.number(2, "H")
    return ids


def _is_time(declared: _Table) -> bool:
    """Whether a declared object is a struct of seconds and nanoseconds, in this order."""
    places = {
        _name(field): (_type(field)[0], field.number(3, "H")) for field in _tables(declared, 1)
    }
    # only in a struct is a field's offset 0: in a table it is that of its entry in the vtable
    return places == {"sec": (_UINT, 0), "nsec": (_UINT, 4)}


def _type(field: _Table) -> tuple[int, int, int]:
    """Base type, element type and object index of a declared field."""
    place = field.place(1, 4)
    if place is None:
        raise WireError("a field of its schema has no type")
    declared = _Table.behind(field.data, place)
    index_at = declared.place(2, 4)
    index = -1 if index_at is None else _number(field.data, "i", index_at)
    return declared.number(0, "B"), declared.number(1, "B"), index


def _tables(table: _Table, field_id: int) -> list[_Table]:
    """A field of a schema that is a vector of tables."""
    vector = table.vector(field_id, 4)
    if vector is None:
        return []
    if vector.count > _MAX_DECLARED:
        raise WireError(f"its schema declares {vector.count} things at once")
    return [_Table.behind(table.data, place) for place in range(vector.start, vector.end, 4)]


def _name(declared: _Table) -> str:
    """The name of something that a schema declares; a long one is cut."""
    vector = declared.vector(0)
    if vector is None:
        return ""
    return text(declared.data[vector.start : min(vector.end, vector.start + _MAX_NAME)])
