"""Types of ROS 2 in DDS: classes of messages for Eclipse Cyclone DDS, which has to be installed."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from operator import getitem
from typing import Any, get_args

from cyclonedds.core import DDSException
from cyclonedds.dynamic import get_types_for_typeid
from cyclonedds.idl import make_idl_struct, types

from mp4ds.bags.types import FieldShape, by_library, field_shape
from mp4ds.errors import ConversionError, Refused
from mp4ds.plugins.ros.ros2 import (
    described_definition,
    full_name,
    hash_of,
    is_topic,
    recorded_hash,
    types_in,
)
from mp4ds.records import Channel, Schema

FILLER = "structure_needs_at_least_one_member"
_NO_DDS_TYPE = "DDS has no such type"
_NAME = re.compile(r"[A-Za-z]\w*(?:/[A-Za-z]\w*)+", re.ASCII)
_DDS_NAME = re.compile(r"(?:\w+(?:::|\.))+dds_(?:::|\.)\w+_")
_MAX_NESTING = 50
_MAX_SIZE = 2**28  # bytes of fixed-size parts: the library counts them in 32 bits
_TYPE_PATIENCE = 2_000_000_000  # ns to wait for another participant to describe a type
_FEW, _MANY = 32, 1000
"""Messages kept for slow subscribers: a second of a camera, and of types without blobs."""

_BLOBS = ("byte", "char", "int8", "octet", "uint8", "int16", "uint16", "float32")
_LARGE = 1000  # elements
_BASES = {
    "bool": "bool",
    "octet": "byte",
    "byte": "byte",
    "char": "uint8",
    **{f"{sign}int{bits}": f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)},
    "float32": "float32",
    "float64": "float64",
    "string": "string",
}


@dataclass(frozen=True, slots=True)
class DdsType:
    """How messages of a channel are written.

    Attributes:
        writes: The class of the messages, which are created from bytes.
        type_hash: ``RIHS01_...``; empty if the definition is unknown.
        is_real: Whether it announces the real type.
        is_empty: Whether it has no fields: messages have one byte, which some recordings lack.
        unacknowledged: How many messages to keep for subscribers that do not have them yet.
    """

    writes: Any
    type_hash: str
    is_real: bool
    is_empty: bool
    unacknowledged: int


# ---------------------------------------------------------------- names


def dds_topic(topic: str, *, bare: bool = False) -> str | None:
    """The DDS name of a topic, such as ``rt/camera/image``; None if it is not valid in ROS 2.

    Args:
        topic: The ROS name.
        bare: Without the prefix of ROS.
    """
    if not is_topic(topic):
        return None
    return topic.strip("/") if bare else f"rt/{topic.strip('/')}"


def dds_name(type_name: str) -> str:
    """The DDS name of a type: ``std_msgs/msg/String`` -> ``std_msgs.msg.dds_.String_``."""
    *rooms, name = type_name.split("/")
    return ".".join((*rooms, "dds_", f"{name}_"))


def ros_type(dds_name: str) -> str:
    """The ROS name of a DDS type such as ``std_msgs::msg::dds_::String_``; empty for others."""
    if not _DDS_NAME.fullmatch(dds_name):
        return ""
    *rooms, _, name = dds_name.replace("::", ".").split(".")
    return "/".join((*rooms, name.removesuffix("_")))


# ---------------------------------------------------------------- classes of messages


def as_is(kind: Any) -> Any:
    """Make the messages of a class hold serialized CDR, including the header of 4 bytes.

    The class is patched, since the library takes a base class for an IDL type.
    """

    def make(self: Any, payload: bytes) -> None:
        self.payload = payload

    def serialize(
        self: Any, buffer: Any = None, endianness: Any = None, use_version_2: Any = None
    ) -> bytes:
        return bytes(self.payload)

    def deserialize(
        cls: Any, data: bytes, has_header: bool = True, use_version_2: Any = None
    ) -> Any:
        return cls(data)

    kind.__init__ = make
    kind.serialize = serialize
    kind.deserialize = classmethod(deserialize)
    kind.deserialize_key = classmethod(deserialize)  # called when a writer has left
    return kind


def _opaque_type(name: str) -> Any:
    """A class for messages of a type of which only the DDS name, with dots, is known."""
    return as_is(make_idl_struct(name.rpartition(".")[2], name, {}, dataclassify=False))


def message_type(channel: Channel) -> DdsType:
    """How messages of a channel are written.

    Raises:
        ConversionError: The name of the type is not valid in ROS 2.
    """
    name = full_name(channel.type_name)
    if not _NAME.fullmatch(name):
        problem = f"{channel.type_name!r} is not a ROS 2 message type"
        raise ConversionError(channel.topic, problem, "Leave the topic out.")
    type_hash = recorded_hash(channel)
    try:
        found = types_in(channel.schema)
        real = as_is(make_struct(found, name))
    except Refused:
        return DdsType(_opaque_type(dds_name(name)), type_hash, False, False, _FEW)
    is_empty = found[name][1][0][0] == FILLER
    shapes = (field_shape(desc) for _, fields in found.values() for _, desc in fields)
    is_large = any(
        one.base in _BLOBS
        and (one.bound == 0 or (one.bound or 0) > _LARGE or (one.length or 0) > _LARGE)
        for one in shapes
    )
    return DdsType(real, type_hash, True, is_empty, _FEW if is_large else _MANY)


def publisher_type(participant: Any, endpoint: Any) -> Any:
    """The class of a publisher's messages. If it announces its type, readers need the same.

    Args:
        participant: Our participant.
        endpoint: The publisher, as discovered.
    """
    if endpoint.type_id is not None:
        try:
            return as_is(get_types_for_typeid(participant, endpoint.type_id, _TYPE_PATIENCE)[0])
        except DDSException:
            pass  # the name is all that ROS compares
    return _opaque_type(endpoint.type_name.replace("::", "."))


def make_struct(known: dict[str, Any], name: str, *, has_fields: bool = False) -> Any:
    """Create the class of a type, after those of the types it refers to.

    Args:
        known: All definitions.
        name: Which one.
        has_fields: Whether messages have fields; otherwise, only their bytes.

    Raises:
        Refused: DDS cannot have this type.
    """
    sized: dict[str, tuple[Any, int]] = {}
    begun: list[str] = []

    def struct(name: str) -> tuple[Any, int]:
        """The class of a type, and the size of its fixed-size parts in bytes."""
        if name in sized:
            return sized[name]
        if name in begun or len(begun) >= _MAX_NESTING or not _NAME.fullmatch(name):
            raise Refused(_NO_DDS_TYPE)
        begun.append(name)
        fields: dict[str, Any] = {}
        total = 0
        for field, desc in known[name][1]:
            if field in fields or field.startswith("__"):
                raise Refused(_NO_DDS_TYPE)
            fields[field], size = kind_of(desc)
            total += size
        if total > _MAX_SIZE:
            raise Refused(_NO_DDS_TYPE)
        begun.pop()
        short = f"{name.rpartition('/')[2]}_"
        make = partial(make_idl_struct, dataclassify=has_fields)
        sized[name] = by_library(_NO_DDS_TYPE, make, short, dds_name(name), fields), total
        return sized[name]

    def kind_of(desc: Any) -> tuple[Any, int]:
        """The type of a field, and its size."""
        shape = field_shape(desc)
        kind, size = struct(shape.message) if shape.message else (_base(shape), 8)
        if shape.length is not None:
            made = by_library(_NO_DDS_TYPE, getitem, types.array, (kind, shape.length))
            return made, size * shape.length
        if shape.bound is not None:
            bounded = (kind, shape.bound) if shape.bound else kind
            return by_library(_NO_DDS_TYPE, getitem, types.sequence, bounded), 24
        return kind, size

    return struct(name)[0]


def _base(shape: FieldShape) -> Any:
    if shape.base not in _BASES:
        raise Refused(_NO_DDS_TYPE)
    if shape.base == "string":
        return types.bounded_str[shape.text_bound] if shape.text_bound else str
    return bool if shape.base == "bool" else getattr(types, _BASES[shape.base])


# ---------------------------------------------------------------- services

_HEADER = "uint64 client_guid\nint64 sequence_number\n"


def service_types(name: str, definition: str) -> tuple[dict[str, Any], str]:
    """The types of a request or response with what goes before it, and its type hash.

    Args:
        name: Its type, such as ``rosbag2_interfaces/srv/Seek_Request``.
        definition: Its fields, as of a message.
    """
    short = name.replace("/srv/", "/msg/")  # as definitions of messages are parsed
    definition = definition or f"uint8 {FILLER}"
    found = types_in(Schema(short, "ros2msg", definition.encode()))
    found[name] = found.pop(short)
    whole = types_in(Schema(short, "ros2msg", (_HEADER + definition).encode()))
    whole[name] = whole.pop(short)
    return whole, hash_of(found, name)


# ---------------------------------------------------------------- definitions


def announced_definition(kind: Any, type_hash: str) -> str:
    """The definition of a type as announced by a publisher.

    Args:
        kind: Its class, an IDL structure.
        type_hash: As announced by the publisher, which the definition must have.

    Returns:
        The text, with the definitions of its parts; empty if it is not proven by the hash.
    """
    try:
        texts = dict(_structures(kind))
    except (AttributeError, TypeError, ValueError):
        return ""
    return described_definition(texts, next(iter(texts)), type_hash)


def _structures(kind: Any) -> Iterator[tuple[str, str]]:
    """Name and fields of a structure, then those of its parts."""
    parts: list[Any] = []
    lines = [f"{_spelled(hint, parts)} {name}" for name, hint in kind.__annotations__.items()]
    yield ros_type(kind.__idl_typename__), "\n".join(lines) + "\n"
    for part in parts:
        yield from _structures(part)


def _spelled(hint: Any, parts: list[Any]) -> str:
    """A field's type as written in a ``.msg`` file."""
    inner, *notes = get_args(hint) or (hint,)
    note = notes[0] if notes else None
    if isinstance(note, types.array):
        return f"{_spelled(note.subtype, parts)}[{note.length}]"
    if isinstance(note, types.sequence):
        bound = f"<={note.max_length}" if note.max_length else ""
        return f"{_spelled(note.subtype, parts)}[{bound}]"
    if isinstance(note, types.bounded_str):
        return f"string<={note.max_length}"
    if isinstance(note, str):
        return note
    if inner in (str, bool):
        return {str: "string", bool: "bool"}[inner]
    name = ros_type(inner.__idl_typename__)
    if not name:
        raise Refused("it has a part that is not a message of ROS")
    parts.append(inner)
    return name.replace("/msg/", "/")
