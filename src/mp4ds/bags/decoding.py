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
from mp4ds.messages.descriptors import decoder_of_schema
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
        return decoder_of_schema(schema.name, schema.data)
    except WireError as error:
        raise _undecodable(channel, str(error)) from None


_DECODERS: Mapping[str, Callable[[Channel], Decoder]] = {
    "ros1": _ros,
    "cdr": _ros,
    "json": _json,
    "protobuf": _protobuf,
}
