"""The serializations of camera messages; that of ROS 1 and ROS 2's CDR are here.

The two differ in order, alignment and header. ROS 1: little-endian, unaligned, header with seq,
strings without NUL (wiki.ros.org/msg, "Fields"). CDR: a four-byte encapsulation, primitives
aligned to their size from there, strings with NUL (OMG DDSI-RTPS 2.5, 10; plain CDR only).
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any, NamedTuple

from mp4ds.errors import Refused
from mp4ds.messages.protobuf import FOXGLOVE_TYPES, ProtobufForm
from mp4ds.messages.wire import (
    MAX_DISTORTION,
    NS,
    CalibrationFields,
    CodedFields,
    Fields,
    Form,
    ImageFields,
    Parts,
    PrimitiveReader,
    PrimitiveWriter,
    Reading,
    Slots,
    Span,
    WireError,
    join_stamp,
    make_fields,
)
from mp4ds.records import Channel, Message


class _RosWire(NamedTuple):
    """One of the three plain serializations of ROS.

    Attributes:
        prefix: The encapsulation at the start of a payload.
        order: Byte order, in struct's notation.
        ros2: Whether it is CDR: aligned, NUL-terminated, without seq.
    """

    prefix: bytes
    order: str
    ros2: bool


_ROS_WIRES = {
    "ros1": _RosWire(b"", "<", ros2=False),
    "cdr-le": _RosWire(b"\x00\x01\x00\x00", "<", ros2=True),
    "cdr-be": _RosWire(b"\x00\x00\x00\x00", ">", ros2=True),
}
_PROTOBUF = "protobuf"
_ZSTD = b"\x28\xb5\x2f\xfd"  # magic of zstd

WIRES = (*_ROS_WIRES, _PROTOBUF)
"""Serializations, by the names that sidecars use (spec/registry.md, "Wires")."""


# ---------------------------------------------------------------- ROS

# (name, code): struct codes, s for a string, d* for a length-prefixed array of doubles
_HEADER = (("header", ""),)
_TIME = (("time", ""), ("frame_id", "s"))
_BODY = ("body", "")
_SIZE = (("width", "I"), ("height", "I"))
_MATRICES = (("distortion_model", "s"), ("d", "d*"), ("k", "9d"), ("r", "9d"), ("p", "12d"))
_BINNING = (("binning_x", "I"), ("binning_y", "I"))
_ROI = (("roi", "4I"), ("roi_do_rectify", "B"))  # x_offset, y_offset, height, width

_Layout = tuple[tuple[str, str], ...]
_PACKET = "ffmpeg_image_transport_msgs/FFMPEGPacket"

ROS_TYPES: Mapping[str, tuple[type[Fields], _Layout]] = {
    "sensor_msgs/Image": (
        ImageFields,
        (*_HEADER, *_SIZE[::-1], ("encoding", "s"), ("is_bigendian", "B"), ("step", "I"), _BODY),
    ),
    "sensor_msgs/CompressedImage": (CodedFields, (*_HEADER, ("format", "s"), _BODY)),
    "sensor_msgs/CameraInfo": (
        CalibrationFields,
        (*_HEADER, *_SIZE[::-1], *_MATRICES, *_BINNING, *_ROI),
    ),
    _PACKET: (
        CodedFields,
        (
            *_HEADER,
            *(("width", "i"), ("height", "i"), ("format", "s"), ("pts", "Q")),
            *(("flags", "B"), ("is_bigendian", "B"), _BODY),
        ),
    ),
    "foxglove_msgs/RawImage": (
        ImageFields,
        (*_TIME, *_SIZE, ("encoding", "s"), ("step", "I"), _BODY),
    ),
    "foxglove_msgs/CompressedImage": (CodedFields, (*_TIME, _BODY, ("format", "s"))),
    "foxglove_msgs/CompressedVideo": (CodedFields, (*_TIME, _BODY, ("format", "s"))),
    "foxglove_msgs/CameraCalibration": (CalibrationFields, (*_TIME, *_SIZE, *_MATRICES)),
}
"""The fields of each type, in the order of its definition (spec/registry.md, "Message types")."""

# ROS 1 has another type of this name, which is written only: such messages are kept verbatim
_ROS1_PACKET = (
    *(*_HEADER, _BODY, ("width", "i"), ("height", "i"), ("format", "s")),
    *(("pts", "Q"), ("flags", "B")),
)


class RosForm(Form):
    """A message type in a ROS serialization.

    Args:
        wire: ``ros1``, ``cdr-le`` or ``cdr-be``.
        type_name: One of `ROS_TYPES`.
        layout: Its fields, if they differ from those there.
    """

    def __init__(self, wire: str, type_name: str, layout: _Layout | None = None) -> None:
        self.wire = wire
        self._prefix, self._order, self._ros2 = _ROS_WIRES[wire]
        self._kind, known = ROS_TYPES[type_name]
        self._layout = layout or known
        self._sec_code = "i" if self._ros2 else "I"
        names = [name for name, _ in self._layout]
        has_tail = "body" in names and names[-1] != "body"
        if self._ros2 and has_tail:
            self.body_alignment = 4  # of strings
        self._is_plain = "pts" not in names and not has_tail

    def read(self, data: memoryview) -> Reading:
        """Read a message."""
        if bytes(data[: len(self._prefix)]) != self._prefix:
            raise WireError("it does not begin like a plain serialization of its kind")
        reader = PrimitiveReader(data, len(self._prefix), self._order, is_cdr=self._ros2)
        values: dict[str, Any] = {}
        spans: dict[str, Span] = {}
        body = len(data), len(data)
        for name, code in self._layout:
            if name in ("header", "time"):
                if name == "header" and not self._ros2:
                    values["seq"] = reader.integer("I")
                    spans["seq"] = reader.offset - 4, reader.offset
                start = reader.align(4)
                spans["stamp"] = start, start + 8
                values["stamp"] = reader.integer(self._sec_code), reader.integer("I")
                if name == "header":
                    values["frame_id"] = reader.string()
            elif name == "body":
                size = reader.integer("I")
                body = reader.offset, reader.offset + size
                spans["body"] = reader.offset - 4, body[1]
                reader.raw(size)
            else:
                values[name] = _take(reader, code)
                if name == "pts":
                    spans["pts"] = reader.offset - 8, reader.offset
        parts = {
            "stamp": join_stamp(*values["stamp"]),
            "seq": values.get("seq"),
            "pts": values.get("pts"),
            "frame_id": values["frame_id"],
            "fields": make_fields(self._kind, values),
        }
        return Reading(parts, spans, body)

    def slot(self, name: str, slots: Slots, body_size: int) -> bytes:
        """The bytes of a slot."""
        try:
            if name == "stamp":
                return struct.pack(f"{self._order}{self._sec_code}I", *divmod(slots.stamp, NS))
            if name == "pts":
                return struct.pack(f"{self._order}Q", slots.pts or 0)
            value = body_size if name == "body" else slots.seq
            return struct.pack(f"{self._order}I", value or 0)
        except struct.error:
            raise WireError("a time or number is beyond what its message has bits for") from None

    def plain(self, frame_id: str, fields: Fields) -> bytes | None:
        """The blank as ROS writes it; None for types whose other fields are not modelled."""
        return self.blank(frame_id, fields) if self._is_plain else None

    def blank(self, frame_id: str, fields: Fields, *, flags: int = 0) -> bytes:
        """A message as ROS writes it, with zeros for its slots.

        Args:
            frame_id: Coordinate frame.
            fields: Its fields.
            flags: Of a packet.
        """
        writer = PrimitiveWriter(self._prefix, self._order, is_cdr=self._ros2)
        for name, code in self._layout:
            if name in ("header", "time"):
                if name == "header" and not self._ros2:
                    writer.put("I", 0)
                writer.put("I", 0, 0)
                if name == "header":
                    writer.string(frame_id)
            elif name == "body":
                writer.put("I", 0)
            elif name in ("pts", "flags") or (name, self._kind) == ("is_bigendian", CodedFields):
                writer.put(code, flags if name == "flags" else 0)
            elif name == "frame_id":
                writer.string(frame_id)
            else:
                _put(writer, code, getattr(fields, name))
        return writer.getvalue()


def _take(reader: PrimitiveReader, code: str) -> Any:
    if code == "s":
        return reader.string()
    if code == "d*":
        count = reader.integer("I")
        if count > MAX_DISTORTION:
            raise WireError(f"it has {count} distortion parameters")
        return reader.take("d", count)
    if len(code) > 1:
        return reader.take(code[-1], int(code[:-1]))
    return reader.integer(code)


def _put(writer: PrimitiveWriter, code: str, value: Any) -> None:
    if code == "s":
        writer.string(value)
    elif code == "d*":
        writer.put("I", len(value))
        writer.put("d", *value)
    elif len(code) > 1:
        writer.put(code[-1], *value)
    else:
        writer.put(code, value)


def _ros_type(name: str) -> str:
    return name.replace("/msg/", "/")


# ---------------------------------------------------------------- all


def kind_of(channel: Channel) -> type[Fields] | None:
    """The kind of a channel's messages: raw images, coded images, or calibrations.

    Returns:
        The class of their fields; None for a channel that is not a camera's.
    """
    is_ros = channel.message_encoding in ("ros1", "cdr")
    types = ROS_TYPES if is_ros else FOXGLOVE_TYPES
    entry = types.get(_ros_type(channel.type_name) if is_ros else channel.type_name)
    return entry[0] if entry else None


def is_camera(channel: Channel) -> bool:
    """Whether the channel's messages are images, raw or coded."""
    return kind_of(channel) in (ImageFields, CodedFields)


def is_calibration(channel: Channel) -> bool:
    """Whether the channel's messages are calibrations."""
    return kind_of(channel) is CalibrationFields


INFO_NAMES = ("camera_info", "calibration")
"""Last words of calibration topics, in ROS and in Foxglove's examples."""


TRANSPORTS = frozenset({"compressed", "compressedDepth", "ffmpeg", "foxglove"})
"""Last words of topics that transport the images of the topic before it."""


def calibration_topics(topic: str) -> list[str]:
    """Usual topics for the calibrations of a topic of images.

    They are next to that of the images: ``/cam/image_raw`` or ``/cam/image_raw/compressed`` has
    them on ``/cam/camera_info``.
    """
    base, _, last = topic.rpartition("/")
    parent = (base if last in TRANSPORTS else topic).rpartition("/")[0]
    return [f"{parent}/{name}" for name in INFO_NAMES]


def wire_of(message_encoding: str, data: memoryview) -> str:
    """Name of the wire of a payload.

    Args:
        message_encoding: The channel's.
        data: The payload; CDR has its byte order in its first bytes.

    Raises:
        WireError: No wire has this serialization.
    """
    if message_encoding in ("ros1", _PROTOBUF):
        return message_encoding
    if message_encoding == "cdr":
        for name, wire in _ROS_WIRES.items():
            if wire.ros2 and data[:4] == wire.prefix:
                return name
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
    if wire == _PROTOBUF:
        return ProtobufForm(type_name, schema)
    name = _ros_type(type_name)
    if wire not in _ROS_WIRES or name not in ROS_TYPES:
        raise WireError(f"type {type_name!r} is not modelled")
    return RosForm(wire, name)


def plain_message(
    wire: str,
    type_name: str,
    frame_id: str,
    fields: Fields,
    slots: Slots,
    body: bytes | memoryview,
    *,
    flags: int = 0,
) -> bytes:
    """A camera message as written by a plain ROS serializer.

    Args:
        wire: A ROS wire.
        type_name: As spelled in either ROS.
        frame_id: Coordinate frame.
        fields: Its fields.
        slots: Its times.
        body: Pixels or coded picture; empty for a calibration.
        flags: Of a packet: 1 if decoding can begin with it.

    Raises:
        WireError: The type cannot represent a value.
    """
    name = _ros_type(type_name)
    form = RosForm(wire, name, _ROS1_PACKET if (wire, name) == ("ros1", _PACKET) else None)
    template = form.template(form.blank(frame_id, fields, flags=flags))
    head, tail = template.around(slots, len(body))
    gap = bytes(template.padding(len(body)))  # what follows a body is aligned in CDR
    return b"".join((head, body, gap, tail))


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
