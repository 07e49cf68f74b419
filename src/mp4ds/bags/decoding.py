"""Messages as objects with fields, by the definitions that were recorded with them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

from rosbags.typesys.msg import normalize_msgtype

from mp4ds.bags.type_sizes import has_empty_items, sizes_of
from mp4ds.bags.typedefs import (
    BAD_DEFINITION,
    BAD_PAYLOAD,
    MAX_TAIL,
    make_store,
    ros1_world,
    ros2_world,
    types_of,
)
from mp4ds.errors import OptionError
from mp4ds.records import Channel
from mp4ds.wire import WireError
from mp4ds.wire.protobuf_objects import protobuf_decoder

Decoder = Callable[[memoryview], Any]
"""Makes an object of a payload.

Raises:
    WireError: The payload is not of the type that its channel tells.
"""

_DISTRIBUTION = "humble"  # whose standard types stand in for definitions that were not recorded
_ADVICE = "take its bytes instead, `RecordedMessage.raw`"


def decoder_of(channel: Channel) -> Decoder:
    """What makes objects of a channel's messages.

    ROS 1 and ROS 2 give rosbags' objects, whose attributes are the fields; protobuf its own
    messages; JSON what `json.loads` gives.

    Raises:
        OptionError: They cannot be decoded: for want of a definition, or of a decoder.
    """
    make = _DECODERS.get(channel.message_encoding)
    if make is None:
        known = ", ".join(_DECODERS)
        raise _undecodable(
            channel, f"they are {channel.message_encoding or 'of no known'} encoding, not {known}"
        )
    return make(channel)


def _undecodable(channel: Channel, problem: str) -> OptionError:
    return OptionError(f"messages of {channel.topic} cannot be decoded: {problem}; {_ADVICE}")


def _ros(channel: Channel) -> Decoder:
    schema = channel.schema
    if schema is None or not schema.name:
        raise _undecodable(channel, "the type of its messages is not known")
    is_ros1 = channel.message_encoding == "ros1"
    world = ros1_world() if is_ros1 else ros2_world(_DISTRIBUTION)
    name = normalize_msgtype(schema.name)
    try:
        types = types_of(schema, world)
        if has_empty_items(types, sizes_of(types)):
            raise _undecodable(channel, f"{schema.name} has arrays of a type without fields")
        store = make_store(types, world)
        definition = store.get_msgdef(name)  # compiled now, to fail before any message
    except OptionError:
        raise
    except BAD_DEFINITION:
        raise _undecodable(
            channel, f"no definition of type {schema.name} is known, or it cannot be understood"
        ) from None

    def decode(payload: memoryview) -> Any:
        start, read = 0, definition.deserialize_ros1
        if not is_ros1:
            if len(payload) < 4 or payload[0] != 0 or payload[1] > 1:
                raise WireError(f"it is no {schema.name}")
            start = 4
            read = definition.deserialize_cdr_le if payload[1] else definition.deserialize_cdr_be
        try:
            message, end = read(payload[start:], 0, definition.cls, store)
        except BAD_PAYLOAD:
            raise WireError(f"it is no {schema.name}") from None
        if len(payload) - start - end > MAX_TAIL:
            raise WireError(f"it is no {schema.name}")
        return message

    return decode


def _json(channel: Channel) -> Decoder:
    def decode(payload: memoryview) -> Any:
        try:
            return json.loads(bytes(payload))
        except (ValueError, RecursionError):
            raise WireError("it is no JSON") from None

    return decode


def _protobuf(channel: Channel) -> Decoder:
    schema = channel.schema
    if schema is None or schema.encoding != "protobuf":
        raise _undecodable(channel, "they are protobuf, and their definition is not known")
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
