"""Message types of ROS 2 as Cyclone DDS knows them, made of recorded definitions.

A writer takes serialized messages as they are. Where the definition is known its real type is
announced, so that tools of DDS can read it; ROS itself goes by the name and the type hash.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from mp4ds.bags.typedefs import (
    BAD_DEFINITION,
    World,
    field_shape,
    make_store,
    types_of,
)
from mp4ds.errors import ConversionError
from mp4ds.records import HASH_KEY, Channel

Types = dict[str, Any]
"""Definitions by name, as `types_of` finds them."""

_FILLER = "structure_needs_at_least_one_member"
_NAME = re.compile(r"[A-Za-z]\w*(?:/[A-Za-z]\w*)+", re.ASCII)
_TOPIC = re.compile(r"/?[A-Za-z_]\w*(?:/[A-Za-z_]\w*)*", re.ASCII)
_HASH = re.compile(r"RIHS01_[0-9a-f]{64}")
_MAX_NESTING = 50
_MAX_SIZE = 2**28  # bytes of what has a fixed size: the library counts them in 32 bits
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


def as_is(kind: Any) -> Any:
    """Let messages of a class be made of, and become, ready CDR with its header of 4 bytes.

    Set from outside: the library takes a base class for one of IDL.
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
    kind.deserialize_key = classmethod(deserialize)  # of what tells that a writer has left
    return kind


class UnsuitableTypeError(Exception):
    """There is no such type in DDS, or not one that the library can take."""


@dataclass(frozen=True, slots=True)
class MessageType:
    """How messages of a channel are written.

    Attributes:
        writes: The class of messages: made of bytes.
        type_hash: ``RIHS01_...``; empty where the definition is not known.
        is_real: Whether it announces the real type.
        is_empty: Whether it has no field: messages have one byte, which some recordings lack.
    """

    writes: Any
    type_hash: str
    is_real: bool
    is_empty: bool


def dds_topic(topic: str, *, bare: bool = False) -> str | None:
    """The DDS name of a topic, such as ``rt/camera/image``; None where ROS 2 has no such topic.

    Args:
        topic: As ROS spells it.
        bare: Without the prefix of ROS.
    """
    if not _TOPIC.fullmatch(topic) or "__" in topic:
        return None
    return topic.strip("/") if bare else f"rt/{topic.strip('/')}"


def dds_name(type_name: str) -> str:
    """The DDS name of a type: ``std_msgs/msg/String`` -> ``std_msgs.msg.dds_.String_``."""
    *rooms, name = type_name.split("/")
    return ".".join((*rooms, "dds_", f"{name}_"))


def opaque_type(name: str) -> Any:
    """A class of messages of a type of which only the DDS name is known, with dots."""
    from cyclonedds.idl import make_idl_struct

    short = name.rpartition(".")[2]
    return as_is(make_idl_struct(short, name, {}, dataclassify=False))


def message_type(channel: Channel, world: World) -> MessageType:
    """How messages of a channel are written.

    Raises:
        ConversionError: The type has no name that ROS 2 could have.
    """
    name = _full_name(channel.type_name)
    if not _NAME.fullmatch(name):
        problem = f"{channel.type_name!r} is no message type of ROS 2"
        raise ConversionError(channel.topic, problem, "Leave the topic out.")
    recorded = channel.metadata.get(HASH_KEY, "")
    type_hash = recorded if _HASH.fullmatch(recorded) else ""
    try:
        types = _known_types(channel, world)
        type_hash = type_hash or make_store(types, world).hash_rihs01(name)
        real = as_is(make_struct(types, name))
    except (*BAD_DEFINITION, UnsuitableTypeError):
        return MessageType(opaque_type(dds_name(name)), type_hash, False, False)
    is_empty = types[name][1][0][0] == _FILLER
    return MessageType(real, type_hash, True, is_empty)


def _full_name(name: str) -> str:
    """A name as ROS 2 has it: ``std_msgs/String`` is short for ``std_msgs/msg/String``."""
    rooms = name.split("/")
    return f"{rooms[0]}/msg/{rooms[1]}" if len(rooms) == 2 else name


def _known_types(channel: Channel, world: World) -> Types:
    if channel.schema is None:
        raise UnsuitableTypeError
    return {
        name: (constants, fields or [_filler(world)])
        for name, (constants, fields) in types_of(channel.schema, world).items()
    }


def _filler(world: World) -> Any:
    return world.standard["std_msgs/msg/Empty"][1][0]


def make_struct(types: Types, name: str, *, has_fields: bool = False) -> Any:
    """The class of a type, made after those of its parts.

    Args:
        types: The definitions, complete.
        name: Which one.
        has_fields: Whether messages are made of and taken apart into fields.

    Raises:
        UnsuitableTypeError: There is no such type in DDS.
    """
    return _StructMaker(types, has_fields).struct(name)[0]


class _StructMaker:
    def __init__(self, types: Types, has_fields: bool) -> None:
        self._types = types
        self._has_fields = has_fields
        self._made: dict[str, tuple[Any, int]] = {}
        self._open: list[str] = []

    def struct(self, name: str) -> tuple[Any, int]:
        """The class of a type, and bytes of what has a fixed size."""
        from cyclonedds.idl import make_idl_struct

        if name in self._made:
            return self._made[name]
        if name in self._open or len(self._open) >= _MAX_NESTING or not _NAME.fullmatch(name):
            raise UnsuitableTypeError
        self._open.append(name)
        fields: dict[str, Any] = {}
        total = 0
        for field, desc in self._types[name][1]:
            if field in fields or field.startswith("__"):
                raise UnsuitableTypeError
            fields[field], size = self._field(desc)
            total += size
        if total > _MAX_SIZE:
            raise UnsuitableTypeError
        self._open.pop()
        short = f"{name.rpartition('/')[2]}_"
        made = make_idl_struct(short, dds_name(name), fields, dataclassify=self._has_fields)
        self._made[name] = made, total
        return made, total

    def _field(self, desc: Any) -> tuple[Any, int]:
        from cyclonedds.idl import types

        shape = field_shape(desc)
        if shape.message:
            kind, size = self.struct(shape.message)
        else:
            kind, size = _base(shape.base, shape.text_bound), 8
        if shape.length is not None:
            return types.array[kind, shape.length], size * shape.length
        if shape.bound is not None:
            bounded = (kind, shape.bound) if shape.bound else kind
            return types.sequence[bounded], 24
        return kind, size


def _base(name: str, bound: int) -> Any:
    from cyclonedds.idl import types

    if name not in _BASES:
        raise UnsuitableTypeError
    if name == "string":
        return types.bounded_str[bound] if bound else str
    return bool if name == "bool" else getattr(types, _BASES[name])
