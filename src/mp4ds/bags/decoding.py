"""Messages as objects with fields, decoded by their recorded definitions."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

from rosbags.typesys.msg import normalize_msgtype

from mp4ds.bags.types import (
    MAX_TAIL,
    by_library,
    has_empty_items,
    make_store,
    ros1_world,
    ros2_world,
    sizes_of,
    types_of,
)
from mp4ds.errors import OptionError, Refused
from mp4ds.messages.wire import WireError
from mp4ds.records import Channel

Decoder = Callable[[memoryview], Any]
"""Makes an object from a payload.

Raises:
    WireError: The payload is not of its channel's type.
"""

_DISTRIBUTION = "humble"  # its standard types replace definitions that were not recorded
_ADVICE = "use its raw bytes instead, `RecordedMessage.raw`"


def decoder_of(channel: Channel) -> Decoder:
    """The decoder for a channel's messages.

    ROS 1 and ROS 2 give rosbags' objects, whose attributes are the fields; protobuf its own
    messages; JSON what `json.loads` gives.

    Raises:
        OptionError: They cannot be decoded: for lack of a definition, or of a decoder.
    """
    make = _DECODERS.get(channel.message_encoding)
    if make is None:
        known = ", ".join(_DECODERS)
        raise _undecodable(
            channel, f"their encoding is {channel.message_encoding or 'unknown'}, not {known}"
        )
    return make(channel)


def _undecodable(channel: Channel, problem: str) -> OptionError:
    return OptionError(f"messages of {channel.topic} cannot be decoded: {problem}; {_ADVICE}")


def _ros(channel: Channel) -> Decoder:
    schema = channel.schema
    if schema is None or not schema.name:
        raise _undecodable(channel, "its message type is not known")
    is_ros1 = channel.message_encoding == "ros1"
    world = ros1_world() if is_ros1 else ros2_world(_DISTRIBUTION)
    try:
        types = types_of(schema, world)
        if has_empty_items(types, sizes_of(types)):
            raise _undecodable(channel, f"{schema.name} has arrays of a type without fields")
        store = make_store(types, world)
        # compiled now, to fail before any message
        definition = store.get_msgdef(normalize_msgtype(schema.name))
    except Refused as reason:
        raise _undecodable(channel, str(reason)) from None

    def decode(payload: memoryview) -> Any:
        start, read = 0, definition.deserialize_ros1
        if not is_ros1:
            if len(payload) < 4 or payload[0] != 0 or payload[1] > 1:
                raise WireError(f"it is not a {schema.name}")
            start = 4
            read = definition.deserialize_cdr_le if payload[1] else definition.deserialize_cdr_be
        try:
            args = (payload[start:], 0, definition.cls, store)
            message, end = by_library(f"it is not a {schema.name}", read, *args)
        except Refused as reason:
            raise WireError(str(reason)) from None
        if len(payload) - start - end > MAX_TAIL:
            raise WireError(f"it is not a {schema.name}")
        return message

    return decode


def _json(channel: Channel) -> Decoder:
    def decode(payload: memoryview) -> Any:
        try:
            return json.loads(bytes(payload))
        except (ValueError, RecursionError):
            raise WireError("it is not JSON") from None

    return decode


def _protobuf(channel: Channel) -> Decoder:
    schema = channel.schema
    if schema is None or schema.encoding != "protobuf":
        raise _undecodable(channel, "they are protobuf, and their definition is unknown")
    try:
        decoder = protobuf_decoder(schema.name, schema.data)
    except WireError as error:
        raise _undecodable(channel, str(error)) from None

    return lambda payload: decoder(bytes(payload))


_DECODERS: Mapping[str, Callable[[Channel], Decoder]] = {
    "ros1": _ros,
    "cdr": _ros,
    "json": _json,
    "protobuf": _protobuf,
}


def protobuf_decoder(type_name: str, schema: bytes) -> Callable[[bytes], Any]:
    """A decoder of serialized messages; it raises WireError for invalid ones.

    Args:
        type_name: Full name of the message's type.
        schema: A serialized FileDescriptorSet that declares it and everything it refers to.

    Raises:
        WireError: It does not.
    """
    # needed for recordings with protobuf only
    from google.protobuf.message import DecodeError

    try:
        message_class = _message_class(type_name, schema)
    except (DecodeError, LookupError, ValueError, TypeError, RecursionError):
        raise WireError(f"its schema does not declare {type_name}") from None

    def decode(data: bytes) -> Any:
        try:
            return message_class.FromString(data)
        except (DecodeError, ValueError):  # the latter by protobuf's pure Python
            raise WireError(f"it is not a {type_name}") from None

    return decode


def _message_class(type_name: str, schema: bytes) -> Any:
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message_factory import GetMessageClass

    waiting = {file.name: file for file in FileDescriptorSet.FromString(schema).file}
    pool = DescriptorPool()

    def add(name: str) -> None:
        """Add a file, after those it imports."""
        file = waiting.pop(name, None)
        if file is not None:
            for dependency in file.dependency:
                add(dependency)
            pool.Add(file)

    while waiting:
        add(next(iter(waiting)))
    return GetMessageClass(pool.FindMessageTypeByName(type_name))
