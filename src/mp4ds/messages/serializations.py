"""The tables of serializations and their message types."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from mp4ds.errors import Refused
from mp4ds.messages.ros import LAYOUTS, RosForm, RosWire
from mp4ds.messages.wire import (
    CalibrationFields,
    CodedFields,
    Fields,
    Form,
    ImageFields,
    Parts,
    Slots,
    WireError,
)
from mp4ds.records import Channel, Message

_ROS = {
    wire.name: wire
    for wire in (
        RosWire("ros1", b"", "<", ros2=False),
        RosWire("cdr-le", b"\x00\x01\x00\x00", "<", ros2=True),
        RosWire("cdr-be", b"\x00\x00\x00\x00", ">", ros2=True),
    )
}
_ZSTD = b"\x28\xb5\x2f\xfd"  # magic of zstd
_FOXGLOVE: Mapping[str, type[Fields]] = {
    "foxglove.RawImage": ImageFields,
    "foxglove.CompressedImage": CodedFields,
    "foxglove.CompressedVideo": CodedFields,
    "foxglove.CameraCalibration": CalibrationFields,
}


def _protobuf(type_name: str, schema: bytes) -> Form:
    from mp4ds.messages.protobuf import ProtobufForm

    return ProtobufForm(type_name, schema)


_OTHERS: Mapping[str, Callable[[str, bytes], Form]] = {"protobuf": _protobuf}

WIRES = (*_ROS, *_OTHERS)
"""Serializations, by the names that sidecars use (spec/registry.md, "Wires")."""


def kind_of(channel: Channel) -> type[Fields] | None:
    """The kind of a channel's messages: raw images, coded images, or calibrations.

    Returns:
        The class of their fields; None for a channel that is not a camera's.
    """
    if channel.message_encoding not in ("ros1", "cdr"):
        return _FOXGLOVE.get(channel.type_name)
    entry = LAYOUTS.get(_ros_type(channel.type_name))
    return entry[0] if entry else None


def is_camera(channel: Channel) -> bool:
    """Whether the channel's messages are images, raw or coded."""
    return kind_of(channel) in (ImageFields, CodedFields)


def is_calibration(channel: Channel) -> bool:
    """Whether the channel's messages are calibrations."""
    return kind_of(channel) is CalibrationFields


def wire_of(message_encoding: str, data: memoryview) -> str:
    """Name of the wire of a payload.

    Args:
        message_encoding: The channel's.
        data: The payload; CDR has its byte order in its first bytes.

    Raises:
        WireError: No wire has this serialization.
    """
    if message_encoding == "ros1" or message_encoding in _OTHERS:
        return message_encoding
    if message_encoding == "cdr":
        for wire in _ROS.values():
            if wire.ros2 and data[:4] == wire.prefix:
                return wire.name
        if data[:4] == _ZSTD:
            raise WireError(
                "it is compressed by zstd, as rosbag2 does in its compression mode MESSAGE: pack "
                "the folder with its metadata.yaml"
            )
        if len(data) < 4:
            raise WireError("it is too short for a CDR encapsulation")
        raise WireError(f"its CDR encapsulation is {bytes(data[:4]).hex()}, which is not plain CDR")
    raise WireError(f"serialization {message_encoding!r} is not modelled")


def form_of(wire: str, type_name: str, schema: bytes) -> Form:
    """The form of a message type in a serialization.

    Args:
        wire: One of `WIRES`.
        type_name: As the source spells it.
        schema: The recorded definition.

    Raises:
        WireError: The type is not modelled in that serialization.
    """
    if wire in _OTHERS:
        return _OTHERS[wire](type_name, schema)
    name = _ros_type(type_name)
    if wire not in _ROS or name not in LAYOUTS:
        raise WireError(f"type {type_name!r} is not modelled")
    return RosForm(_ROS[wire], name)


def plain_message(
    wire: str, type_name: str, frame_id: str, fields: Fields, slots: Slots, body: bytes | memoryview
) -> bytes:
    """A camera message as written by a plain ROS serializer.

    Args:
        wire: A ROS wire.
        type_name: As spelled in either ROS.
        frame_id: Coordinate frame.
        fields: Its fields.
        slots: Its times.
        body: Pixels or coded picture; empty for a calibration.

    Raises:
        WireError: The type has no plain form, or cannot represent a value.
    """
    form = form_of(wire, type_name, b"")
    blank = form.plain(frame_id, fields)
    if blank is None:
        raise WireError(f"{type_name} has no plain form")
    head, tail = form.template(blank).around(slots, len(body))
    return b"".join((head, body, tail))


def _ros_type(name: str) -> str:
    return name.replace("/msg/", "/")


class MessageSplitter:
    """Splits the messages of one channel; its serialization may change between messages."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._forms: dict[str, Form] = {}

    def split(self, message: Message) -> tuple[Form, Parts]:
        """The form of a message and its parts.

        Raises:
            Refused: It does not parse, or is not modelled.
        """
        data = memoryview(message.data)
        schema = self._channel.schema
        try:
            wire = wire_of(self._channel.message_encoding, data)
            if wire not in self._forms:
                definition = schema.data if schema else b""
                self._forms[wire] = form_of(wire, self._channel.type_name, definition)
            form = self._forms[wire]
            return form, form.split(data)
        except WireError as error:
            raise Refused(f"it does not parse: {error}") from None


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
