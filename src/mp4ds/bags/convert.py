"""Messages by their definitions: between ROS 1 and ROS 2, as objects, and of standard types."""

from __future__ import annotations

import base64
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, is_dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.msg import denormalize_msgtype, normalize_msgtype
from rosbags.typesys.store import Typestore

from mp4ds.bags.latched import LATCHED_QOS, is_latched
from mp4ds.bags.types import (
    BUILTIN,
    HEADER,
    MAX_TAIL,
    SCHEMA_ENCODINGS,
    by_library,
    closure,
    fields_of,
    has_empty_items,
    incomprehensible,
    make_store,
    ros1_types,
    ros2_types,
    same_wire,
    shapes_of,
    sizes_of,
    standard_of,
    translate,
    types_of,
)
from mp4ds.errors import ConversionError, OptionError, Refused
from mp4ds.messages.serializations import decoder_of_schema, from_json
from mp4ds.records import HASH_KEY, QOS_KEY, Channel, Schema

if TYPE_CHECKING:
    from rosbags.interfaces.typing import Typesdict

TIME = BUILTIN[0]


def begins_with_its_time(types: Typesdict, name: str) -> bool:
    """Whether messages of a type begin with a header, and have no other time."""
    shapes = shapes_of(types, name)
    if not shapes or shapes[0].message != HEADER or shapes[0].is_several:
        return False
    rest = [shape.message for shape in shapes[1:] if shape.message]
    return not any(TIME in closure(types, part, {}) for part in rest)


# ---------------------------------------------------------------- convert

_ROS1 = "ros1:"  # prefix of the keys that keep a ROS 1 connection header in ROS 2 metadata
_RENAMED = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}
_REMEDY = "Exclude the topic with `exclude`, or unpack to mcap, which keeps it as it is."


@dataclass(frozen=True, slots=True)
class _Plan:
    """How a type is converted.

    Attributes:
        name: The type as rosbags spells it.
        types: Its own definition and those it refers to.
        store: The same with the header of ROS 2, which rosbags uses to convert bytes.
        schema: Definition for the target.
        digest: md5sum for ROS 1, type hash for ROS 2.
        is_headed: Whether its messages `begins_with_its_time`.
        no_message: The error for a payload that is not a message of the type.
    """

    name: str
    types: Typesdict
    store: Typestore
    schema: Schema
    digest: str
    is_headed: bool
    no_message: str


ENCODINGS = {"ros1": "ros1", "ros2": "cdr"}
"""ROS -> encoding of its messages."""


class Converter:
    """Converts channels and their messages to ROS 1 or ROS 2.

    Args:
        target: ``ros1``, ``ros2``, or None to convert nothing.
    """

    def __init__(self, target: str | None) -> None:
        self._to = target
        self._plans: dict[Schema, _Plan] = {}
        self._omitted: Counter[str] = Counter()

    @property
    def omitted(self) -> Mapping[str, int]:
        """What was left out because the target cannot hold it: a phrase -> how many."""
        return dict(self._omitted)

    def channel(self, channel: Channel) -> Channel:
        """The channel for the target; the same object if nothing changes.

        Raises:
            ConversionError: It is not a ROS channel, or its definition is missing or damaged.
        """
        if self._is_done(channel):
            return self._completed(channel) if self._to == "ros1" else channel
        plan = self._plan(channel)
        if self._to == "ros1":
            return self._remembered(channel, plan) or self._ros1_channel(channel, plan)
        return _ros2_channel(channel, plan)

    def payload(self, channel: Channel, data: bytes | memoryview) -> bytes | memoryview:
        """A message of a source channel, converted for the target.

        Raises:
            ConversionError: It does not parse as the channel's type.
        """
        if self._is_done(channel):
            return data
        plan = self._plan(channel)
        try:
            return self._convert(plan, memoryview(data))
        except Refused as reason:
            raise ConversionError(channel.topic, str(reason), _REMEDY) from None

    def _completed(self, channel: Channel) -> Channel:
        """A ROS 1 channel with its md5sum, without which ROS 1 cannot open a bag.

        Only if the source has none (as in some MCAP files); a known standard type then also gets
        its definition, if it has none.
        """
        schema = channel.schema
        if schema is None or not schema.name or "md5sum" in channel.metadata:
            return channel
        try:
            store = make_store(types_of(schema, ros1_types()), ros1_types())
            name = normalize_msgtype(schema.name)
            problem = incomprehensible(schema.name)
            definition, digest = by_library(problem, store.generate_msgdef, name, 1)
        except Refused:
            return channel
        if not schema.data:
            schema = Schema(schema.name, SCHEMA_ENCODINGS["ros1"], definition.encode())
        return replace(channel, schema=schema, metadata={"md5sum": digest, **channel.metadata})

    def _is_done(self, channel: Channel) -> bool:
        return self._to is None or channel.message_encoding == ENCODINGS[self._to]

    def _plan(self, channel: Channel) -> _Plan:
        schema = channel.schema
        if channel.message_encoding not in ENCODINGS.values():  # it is not that of the target
            encoding = channel.message_encoding or "in an unknown encoding"
            problem = f"its messages are {encoding}, which has no equivalent in ROS"
            raise ConversionError(channel.topic, problem, _REMEDY)
        if schema is None or not schema.name:
            raise ConversionError(channel.topic, "its message type is not known", _REMEDY)
        if schema not in self._plans:
            try:
                self._plans[schema] = self._make_plan(schema)
            except Refused as reason:
                raise ConversionError(channel.topic, str(reason), _REMEDY) from None
        return self._plans[schema]

    def _make_plan(self, schema: Schema) -> _Plan:
        to_ros2 = self._to == "ros2"
        source, target = (ros1_types(), ros2_types()) if to_ros2 else (ros2_types(), ros1_types())
        problem = incomprehensible(schema.name)
        types = types_of(schema, source)
        name = normalize_msgtype(schema.name)
        new_name = _RENAMED.get(name, name) if to_ros2 else name
        made = make_store(translate(types, name, new_name, target), target)
        if to_ros2:
            definition, _ = by_library(problem, made.generate_msgdef, new_name, 2)
            digest = by_library(problem, made.hash_rihs01, new_name)
        else:
            definition, digest = by_library(problem, made.generate_msgdef, new_name, 1)
            new_name = by_library(problem, denormalize_msgtype, new_name)
        store = make_store(types, ros2_types())
        store.get_msgdef(name)  # compiled now, to fail before any message
        encoding = SCHEMA_ENCODINGS["cdr" if to_ros2 else "ros1"]
        made_schema = Schema(new_name, encoding, definition.encode())
        no_message = f"a message cannot be parsed as {schema.name}"
        is_headed = begins_with_its_time(types, name)
        return _Plan(name, types, store, made_schema, digest, is_headed, no_message)

    def _convert(self, plan: _Plan, raw: memoryview) -> memoryview:
        to_ros1 = self._to == "ros1"
        store, name = plan.store, plan.name
        problem = plan.no_message
        if to_ros1 and bytes(raw[:2]) == b"\0\0":
            # rosbags only converts little-endian CDR.
            message = by_library(problem, store.deserialize_cdr, raw, name)
            little_endian = partial(store.serialize_cdr, little_endian=True)
            raw = by_library(problem, little_endian, message, name)
        convert = store.cdr_to_ros1 if to_ros1 else store.ros1_to_cdr
        try:
            converted = by_library(problem, convert, raw, name)
        except Refused:
            # ROS itself ignores bytes after a message, which bags of RealSense cameras have.
            definition = store.get_msgdef(name)
            start, size = 0, definition.getsize_ros1_to_cdr
            if to_ros1:
                start, size = 4, definition.getsize_cdr_to_ros1
            end = start + by_library(problem, size, raw[start:], 0, None, 0, store)[0]
            if not (0 < len(raw) - end <= MAX_TAIL and fields_of(plan.types, name)):
                raise
            raw = raw[:end]
            converted = by_library(problem, convert, raw, name)
            self._omitted["messages with trailing bytes, which were dropped"] += 1
        seconds = _time_beyond(plan, raw if to_ros1 else converted)
        if seconds is not None:
            has = f"{seconds} s, and ROS 1 can hold 0 to 2^32 seconds"
            if not to_ros1:
                has = f"{seconds + 2**32} s, and ROS 2 can hold -2^31 to 2^31 seconds"
            raise Refused(f"a message has a time of {has}")
        if not to_ros1 and HEADER in plan.types:
            self._omitted["messages with a header sequence number, which ROS 2 does not have"] += 1
        return converted

    def _remembered(self, channel: Channel, plan: _Plan) -> Channel | None:
        """The ROS 1 channel that this one was made from, if recorded and still valid."""
        prefixed = (item for item in channel.metadata.items() if item[0].startswith(_ROS1))
        known = {key.removeprefix(_ROS1): value for key, value in prefixed}
        name, definition = known.pop("type", ""), known.pop("message_definition", None)
        encoded = known.pop("message_definition;base64", None)
        encoding = "" if definition is None and encoded is None else SCHEMA_ENCODINGS["ros1"]
        try:
            data = base64.b64decode(encoded) if encoded else (definition or "").encode()
            schema = Schema(name, encoding, data)
            types = types_of(schema, ros1_types())
            if not same_wire(plan.types, plan.name, types, normalize_msgtype(name)):
                return None
        except (ValueError, Refused):
            return None
        return replace(channel, message_encoding="ros1", schema=schema, metadata=known)

    def _ros1_channel(self, channel: Channel, plan: _Plan) -> Channel:
        qos = channel.metadata.get(QOS_KEY, "")
        metadata = {"md5sum": plan.digest}
        if is_latched(channel):
            metadata["latching"] = "1"
        elif qos:
            self._omitted["QoS profiles of topics, which ROS 1 does not have"] += 1
        return replace(channel, message_encoding="ros1", schema=plan.schema, metadata=metadata)


def _ros2_channel(channel: Channel, plan: _Plan) -> Channel:
    metadata = {
        QOS_KEY: LATCHED_QOS if is_latched(channel) else "",
        HASH_KEY: plan.digest,
        **{_ROS1 + key: value for key, value in channel.metadata.items()},
        _ROS1 + "type": channel.type_name,
    }
    if channel.schema and channel.schema.encoding:
        try:
            metadata[_ROS1 + "message_definition"] = channel.schema.data.decode()
        except UnicodeDecodeError:
            encoded = base64.b64encode(channel.schema.data).decode()
            metadata[_ROS1 + "message_definition;base64"] = encoded
    return replace(channel, message_encoding="cdr", schema=plan.schema, metadata=metadata)


def _time_beyond(plan: _Plan, data: bytes | memoryview) -> int | None:
    """Seconds of a time in a message that is negative in ROS 2 only, or None.

    Args:
        plan: Of its type.
        data: The message in little-endian CDR.
    """
    if plan.is_headed:
        seconds = struct.unpack_from("<i", data, 4)[0]
        return int(seconds) if seconds < 0 else None
    words = np.frombuffer(data, "<i4", count=len(data) // 4)
    if not (words < 0).any():  # as CDR has them: at multiples of four
        return None
    message = by_library(plan.no_message, plan.store.deserialize_cdr, data, plan.name)
    return next((sec for sec in _seconds(message) if sec < 0), None)


def _seconds(value: Any) -> Iterator[int]:
    if is_dataclass(value):
        if getattr(value, "__msgtype__", "") == TIME:
            yield int(getattr(value, "sec"))  # noqa: B009 - of rosbags' making
        for name in value.__dataclass_fields__:
            yield from _seconds(getattr(value, name))
    elif isinstance(value, list):
        for item in value:
            yield from _seconds(item)


# ---------------------------------------------------------------- standard definitions


def ros2_channel(channel_id: int, topic: str, type_name: str, qos: str = "") -> Channel:
    """A channel of a standard ROS 2 type, with its definition and type hash.

    Args:
        channel_id: Unique in the recording.
        topic: Topic name.
        type_name: Such as ``sensor_msgs/msg/Image``.
        qos: Its profile, such as `LATCHED_QOS`; empty if not known.
    """
    store = get_typestore(Stores.ROS2_HUMBLE)
    definition, _ = store.generate_msgdef(type_name, ros_version=2)
    schema = Schema(type_name, "ros2msg", definition.encode())
    metadata = {QOS_KEY: qos, HASH_KEY: store.hash_rihs01(type_name)}
    return Channel(channel_id, topic, "cdr", schema, metadata)


# ---------------------------------------------------------------- decoding

Decoder = Callable[[memoryview], Any]
"""Makes an object from a payload.

Raises:
    Refused: The payload is not of its channel's type.
"""

_ADVICE = "use its raw bytes instead, `RecordedMessage.raw`"


def decoder_of(channel: Channel) -> Decoder:
    """The decoder for a channel's messages.

    ROS 1 and ROS 2 give rosbags' objects, whose attributes are the fields; protobuf its own
    messages; JSON what `json.loads` gives.

    Raises:
        OptionError: They cannot be decoded: for lack of a definition, or of a decoder.
    """
    make = _DECODERS.get(channel.message_encoding)
    try:
        if make is None:
            encoding = channel.message_encoding or "unknown"
            raise Refused(f"their encoding is {encoding}, not {', '.join(_DECODERS)}")
        return make(channel)
    except Refused as reason:
        problem = f"messages of {channel.topic} cannot be decoded: {reason}"
        raise OptionError(f"{problem}; {_ADVICE}") from None


def _ros(channel: Channel) -> Decoder:
    schema = channel.schema
    if schema is None or not schema.name:
        raise Refused("its message type is not known")
    is_ros1 = channel.message_encoding == "ros1"
    standard = standard_of(channel.message_encoding)
    types = types_of(schema, standard)
    if has_empty_items(types, sizes_of(types)):
        raise Refused(f"{schema.name} has arrays of a type without fields")
    store = make_store(types, standard)
    # compiled now, to fail before any message
    definition = store.get_msgdef(normalize_msgtype(schema.name))

    def decode(payload: memoryview) -> Any:
        start, read = 0, definition.deserialize_ros1
        problem = f"it is not a {schema.name}"
        if not is_ros1:
            if len(payload) < 4 or payload[0] != 0 or payload[1] > 1:
                raise Refused(problem)
            start = 4
            read = definition.deserialize_cdr_le if payload[1] else definition.deserialize_cdr_be
        message, end = by_library(problem, read, payload[start:], 0, definition.cls, store)
        if len(payload) - start - end > MAX_TAIL:
            raise Refused(problem)
        return message

    return decode


def _protobuf(channel: Channel) -> Decoder:
    schema = channel.schema
    if schema is None or schema.encoding != "protobuf":
        raise Refused("they are protobuf, and their definition is unknown")
    return decoder_of_schema(schema)


_DECODERS: Mapping[str, Callable[[Channel], Decoder]] = {
    "ros1": _ros,
    "cdr": _ros,
    "json": lambda channel: from_json,
    "protobuf": _protobuf,
}
