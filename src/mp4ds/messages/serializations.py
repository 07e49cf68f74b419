"""The serializations of camera messages: ROS 1, ROS 2's CDR, and Foxglove's in protobuf.

The first two differ in order, alignment and header. ROS 1: little-endian, unaligned, header with
seq, strings without NUL (wiki.ros.org/msg, "Fields"). CDR: a four-byte encapsulation, primitives
aligned to their size from there, strings with NUL (OMG DDSI-RTPS 2.5, 10; plain CDR only). Messages
in protobuf are read by the field numbers of the recorded schema.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Literal

from mp4ds.errors import Refused
from mp4ds.messages.wire import (
    MAX_BLANK,
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
    join_stamp,
    make_fields,
    text,
)
from mp4ds.records import Channel, Message, Schema

# name -> the encapsulation at the start of a payload, and the byte order in struct's notation
_ROS_WIRES = {
    "ros1": (b"", "<"),
    "cdr-le": (b"\x00\x01\x00\x00", "<"),
    "cdr-be": (b"\x00\x00\x00\x00", ">"),
}
_PROTOBUF = "protobuf"
_ZSTD = b"\x28\xb5\x2f\xfd"  # magic of zstd

WIRES = (*_ROS_WIRES, _PROTOBUF)
"""Serializations, by the names that sidecars use (spec/registry.md, "Wires")."""


# ---------------------------------------------------------------- ROS

# (name, code): struct codes, s for a string, d* for a length-prefixed array of doubles
_TIME = (("sec", "I"), ("nanosec", "I"), ("frame_id", "s"))
_HEADER = (("seq", "I"), *_TIME)  # ROS 2 has neither a sequence number nor unsigned seconds
_BODY = ("body", "I")  # its length
_SIZE = (("width", "I"), ("height", "I"))
_MATRICES = (("distortion_model", "s"), ("d", "d*"), ("k", "9d"), ("r", "9d"), ("p", "12d"))
_BINNING = (("binning_x", "I"), ("binning_y", "I"))
_PIXELS = (("encoding", "s"), ("step", "I"))
_FFMPEG = (("width", "i"), ("height", "i"), ("format", "s"), ("pts", "Q"), ("flags", "B"))
_ROI = (("roi", "4I"), ("roi_do_rectify", "B"))  # x_offset, y_offset, height, width

_INFO = (*_HEADER, *_SIZE[::-1], *_MATRICES, *_BINNING, *_ROI)

_Layout = tuple[tuple[str, str], ...]
_SLOT_FIELDS = {"seq": ("seq", 4), "sec": ("stamp", 8), "pts": ("pts", 8)}  # and bytes of the slots
_PACKET = "ffmpeg_image_transport_msgs/FFMPEGPacket"

ROS_TYPES: Mapping[str, tuple[type[Fields], _Layout]] = {
    "sensor_msgs/Image": (
        ImageFields,
        (*_HEADER, *_SIZE[::-1], _PIXELS[0], ("is_bigendian", "B"), _PIXELS[1], _BODY),
    ),
    "sensor_msgs/CompressedImage": (CodedFields, (*_HEADER, ("format", "s"), _BODY)),
    "sensor_msgs/CameraInfo": (CalibrationFields, _INFO),
    _PACKET: (CodedFields, (*_HEADER, *_FFMPEG, ("is_bigendian", "B"), _BODY)),
    "foxglove_msgs/RawImage": (ImageFields, (*_TIME, *_SIZE, *_PIXELS, _BODY)),
    "foxglove_msgs/CompressedImage": (CodedFields, (*_TIME, _BODY, ("format", "s"))),
    "foxglove_msgs/CompressedVideo": (CodedFields, (*_TIME, _BODY, ("format", "s"))),
    "foxglove_msgs/CameraCalibration": (CalibrationFields, (*_TIME, *_SIZE, *_MATRICES)),
}
"""The fields of each type, in the order of its definition (spec/registry.md, "Message types")."""

# ROS 1 has another type of this name, which is written only: such messages are kept verbatim
_ROS1_PACKET = (*_HEADER, _BODY, *_FFMPEG)


class RosForm(Form):
    """A message type in a ROS serialization.

    Args:
        wire: ``ros1``, ``cdr-le`` or ``cdr-be``.
        type_name: One of `ROS_TYPES`.
        layout: Its fields, if they differ from those there.
    """

    def __init__(self, wire: str, type_name: str, layout: _Layout | None = None) -> None:
        self.wire = wire
        self._prefix, self._order = _ROS_WIRES[wire]
        self._ros2 = wire != "ros1"  # CDR: aligned, NUL-terminated, without seq
        self._kind, known = ROS_TYPES[type_name]
        self._sec_code = "i" if self._ros2 else "I"
        self._layout = [
            (name, self._sec_code if name == "sec" else code)
            for name, code in layout or known
            if not (self._ros2 and name == "seq")
        ]
        names = [name for name, _ in self._layout]
        has_tail = "body" in names and names[-1] != "body"
        if self._ros2 and has_tail:
            self.body_alignment = 4  # of strings
        self._is_plain = "pts" not in names and not has_tail

    def read(self, data: memoryview) -> Reading:
        """Read a message."""
        if bytes(data[: len(self._prefix)]) != self._prefix:
            raise Refused("it does not begin like a plain serialization of its kind")
        reader = PrimitiveReader(data, len(self._prefix), self._order, is_cdr=self._ros2)
        values: dict[str, Any] = {}
        spans: dict[str, Span] = {}
        body = len(data), len(data)
        for name, code in self._layout:
            values[name] = _take(reader, code)
            if name == "body":
                body = reader.offset, reader.offset + values["body"]
                spans["body"] = reader.offset - 4, body[1]
                reader.raw(values["body"])
            elif name in _SLOT_FIELDS:
                slot, size = _SLOT_FIELDS[name]
                start = reader.offset - struct.calcsize(code)
                spans[slot] = start, start + size
        stamp = join_stamp(values["sec"], values["nanosec"])
        fields = make_fields(self._kind, values)
        found = stamp, values.get("seq"), values.get("pts"), values["frame_id"], fields
        return found, spans, body

    def slot(self, name: str, slots: Slots, body_size: int) -> bytes:
        """The bytes of a slot."""
        code, numbers = "I", [body_size if name == "body" else slots.seq or 0]
        if name == "stamp":
            code, numbers = f"{self._sec_code}I", [*divmod(slots.stamp, NS)]
        elif name == "pts":
            code, numbers = "Q", [slots.pts or 0]
        try:
            return struct.pack(self._order + code, *numbers)
        except struct.error:
            raise Refused("a time or number is beyond what its message has bits for") from None

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
        known = {"frame_id": frame_id, "flags": flags}
        for name, code in self._layout:
            _put(writer, code, known[name] if name in known else getattr(fields, name, 0))
        return writer.getvalue()


def _take(reader: PrimitiveReader, code: str) -> Any:
    if code == "s":
        return reader.string()
    if code == "d*":
        count = reader.integer("I")
        if count > MAX_DISTORTION:
            raise Refused(f"it has {count} distortion parameters")
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


def ros_type(name: str) -> str:
    """A type's name as ROS 1 spells it."""
    return name.replace("/msg/", "/")


# ---------------------------------------------------------------- protobuf

Kind = Literal["time", "text", "u32", "doubles", "data", "other"]
"""What a field holds; ``other`` if that is not modelled."""

_STAMPED: dict[str, Kind] = {"timestamp": "time", "frame_id": "text"}
_EXTENT: dict[str, Kind] = {"width": "u32", "height": "u32"}
_CODED: dict[str, Kind] = {**_STAMPED, "data": "data", "format": "text"}
_RAW: dict[str, Kind] = {**_STAMPED, **_EXTENT, "encoding": "text", "step": "u32", "data": "data"}
_LENGTHS = {"K": 9, "R": 9, "P": 12}

FOXGLOVE_TYPES: Mapping[str, tuple[type[Fields], Mapping[str, Kind]]] = {
    "foxglove.RawImage": (ImageFields, _RAW),
    "foxglove.CompressedImage": (CodedFields, _CODED),
    "foxglove.CompressedVideo": (CodedFields, _CODED),
    "foxglove.CameraCalibration": (
        CalibrationFields,
        {**_STAMPED, **_EXTENT, "distortion_model": "text", **dict.fromkeys("DKRP", "doubles")},
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


_Declared = tuple[str, Kind, tuple[int, ...]]
"""Name of a field, what it holds, and in which wire types."""

_OTHER: _Declared = "", "other", ()


class ProtobufForm(Form):
    """One of Foxglove's message types.

    Args:
        type_name: One of `FOXGLOVE_TYPES`.
        schema: A serialized FileDescriptorSet that declares it.

    Raises:
        Refused: The type differs, or the schema does not declare it with its fields.
    """

    wire = "protobuf"

    def __init__(self, type_name: str, schema: bytes) -> None:
        if type_name not in FOXGLOVE_TYPES:
            raise Refused(f"type {type_name!r} is not modelled")
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
        for number, wire_type, at, start, end in _fields(data):
            name, kind, wire_types = self._declared.get(number, _OTHER)
            slot = _SLOTS.get(kind)
            if slot in spans:
                raise Refused(f"it has its {name} twice")
            if slot == "body":
                body = start, end
            if (around := end - (body[1] - body[0])) > MAX_BLANK:
                # before all were read: this bounds the number of fields
                raise Refused(f"it has {around} bytes besides its data")
            if kind == "other":
                continue
            if wire_type not in wire_types:
                raise Refused(f"its field {name} is not of the declared type")
            if slot:
                spans[slot] = at, end
            value = None if kind == "data" else _value(kind, wire_type, data[start:end])
            if kind == "doubles":
                values[name] += value
            else:
                values[name] = value
        for name, kind in self._kinds.items():
            if kind in _SLOTS and _SLOTS[kind] not in spans:
                raise Refused(f"it has no {name}")
        fields = make_fields(self._kind, _checked(values))
        return (values["timestamp"], None, None, values["frame_id"], fields), spans, body

    def slot(self, name: str, slots: Slots, body_size: int) -> bytes:
        """The bytes of a slot, with its length."""
        if name == "body":
            return _varint_bytes(body_size)
        # a google.protobuf.Timestamp as serializers write it
        sec, nanos = divmod(slots.stamp, NS)
        if not -_INT64 <= sec < _INT64:
            raise Refused("a time is beyond what its message has bits for")
        timestamp = b"\x08" + _varint_bytes(sec & _UINT64) if sec else b""
        timestamp += b"\x10" + _varint_bytes(nanos) if nanos else b""
        return _varint_bytes(len(timestamp)) + timestamp


def _checked(values: dict[str, Any]) -> dict[str, Any]:
    """Values by their names in ROS, where lists have the right lengths."""
    for name, size in _LENGTHS.items():
        if name in values and len(values[name]) != size:
            raise Refused(f"it has {len(values[name])} values in {name}, not {size}")
    if len(values.get("D", ())) > MAX_DISTORTION:
        raise Refused(f"it has {len(values['D'])} distortion parameters")
    lists = {name.lower(): tuple(values[name]) for name in "DKRP" if name in values}
    return values | lists


def _declared(type_name: str, schema: bytes, kinds: Mapping[str, Kind]) -> Mapping[int, _Declared]:
    """The modelled fields by their numbers in the schema."""
    declared = {field.name: field for field in _declaration(type_name, schema).field}
    by_number: dict[int, _Declared] = {}
    for name, kind in kinds.items():
        field = declared.get(name)
        if field is None:
            if name == "frame_id":  # older image schemas have none
                continue
            raise Refused(f"its schema has no field {name!r}")
        is_repeated = field.label == _REPEATED
        if field.type not in _TYPES[kind] or is_repeated != (kind == "doubles"):
            raise Refused(f"field {name!r} of its schema is not of Foxglove's type")
        if kind == "time" and field.type_name not in _TIMESTAMPS:
            raise Refused(f"field {name!r} of its schema is not a google.protobuf.Timestamp")
        by_number[field.number] = name, kind, _TYPES[kind][field.type]
    return by_number


def _declaration(type_name: str, schema: bytes) -> Any:
    """The DescriptorProto of a type."""
    # only recordings with protobuf need it
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.message import DecodeError

    try:
        files = FileDescriptorSet.FromString(schema).file
    except (DecodeError, ValueError):  # the latter by protobuf's pure Python
        raise Refused("its schema is not a FileDescriptorSet") from None
    name = tuple(type_name.rsplit(".", 1))
    # compared one by one: names that are not UTF-8 come as bytes
    found = [
        message
        for file in files
        for message in file.message_type
        if (file.package, message.name) == name
    ]
    if len(found) != 1:
        raise Refused(f"its schema declares {type_name} {len(found)} times")
    return found[0]


def _fields(data: memoryview) -> Iterator[tuple[int, int, int, int, int]]:
    """The fields of a message: number, wire type, end of the tag, start and end of the value."""
    at = 0
    while at < len(data):
        tag, at = _varint(data, at)
        number, wire_type = tag >> 3, tag & 7
        if number == 0 or tag >> 32:
            raise Refused("it has an invalid tag")
        start = at
        if wire_type == _VARINT:
            end = _varint(data, at)[1]
        elif wire_type == _LEN:
            size, start = _varint(data, at)
            end = start + size
        elif wire_type in (_I64, _I32):
            end = at + (8 if wire_type == _I64 else 4)
        else:
            raise Refused(f"it has a field of wire type {wire_type}")
        if end > len(data):
            raise Refused(f"it ends at byte {len(data)}, but a field extends to byte {end}")
        yield number, wire_type, at, start, end
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
    raise Refused("a number in it is cut short")


def _varint_bytes(value: int) -> bytes:
    """A varint in as few bytes as possible."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _value(kind: Kind, wire_type: int, raw: memoryview) -> Any:
    """The value of a time, a text, a number or numbers."""
    if kind == "time":
        return _stamp(raw)
    if kind == "text":
        return text(raw)
    if kind == "u32":
        number = _varint(raw, 0)[0] if wire_type == _VARINT else int.from_bytes(raw, "little")
        return number & 0xFFFFFFFF
    if len(raw) % 8:
        raise Refused("a list of numbers in it is cut short")
    return struct.unpack(f"<{len(raw) // 8}d", raw)


def _stamp(raw: memoryview) -> int:
    """Nanoseconds of a google.protobuf.Timestamp."""
    values = {1: 0, 2: 0}
    for number, wire_type, _, start, _ in _fields(raw):
        if number in values:
            if wire_type != _VARINT:
                raise Refused("its timestamp is not of the declared type")
            value = _varint(raw, start)[0]
            values[number] = value - (value >> 63 << 64)
    stamp = join_stamp(values[1], values[2])
    if not -_INT64 <= stamp < _INT64:  # what a column holds
        raise Refused("its stamp is beyond 64-bit nanoseconds")
    return stamp


def from_json(data: memoryview) -> Any:
    """What a message in JSON holds.

    Raises:
        Refused: It is none.
    """
    try:
        return json.loads(bytes(data))
    except (ValueError, RecursionError) as error:
        raise Refused(f"it is not JSON: {error}") from None


def decoder_of_schema(schema: Schema) -> Callable[[memoryview], Any]:
    """A decoder of messages of any type; it raises Refused for invalid ones.

    Args:
        schema: A serialized FileDescriptorSet that declares the type and everything it refers to.

    Raises:
        Refused: It does not.
    """
    # only recordings with protobuf need it
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message import DecodeError
    from google.protobuf.message_factory import GetMessageClass, GetMessages

    try:
        pool = DescriptorPool()
        GetMessages(FileDescriptorSet.FromString(schema.data).file, pool)
        # by name, as a type may be declared inside another one
        message_class = GetMessageClass(pool.FindMessageTypeByName(schema.name))
    except (DecodeError, LookupError, ValueError, TypeError, RecursionError):
        raise Refused(f"its schema does not declare {schema.name}") from None

    def decode(data: memoryview) -> Any:
        try:
            return message_class.FromString(bytes(data))
        except (DecodeError, ValueError):  # the latter by protobuf's pure Python
            raise Refused(f"it is not a {schema.name}") from None

    return decode


# ---------------------------------------------------------------- all


def kind_of(channel: Channel) -> type[Fields] | None:
    """The kind of a channel's messages: raw images, coded images, or calibrations.

    Returns:
        The class of their fields; None for a channel that is not a camera's.
    """
    is_ros = channel.message_encoding in ("ros1", "cdr")
    types = ROS_TYPES if is_ros else FOXGLOVE_TYPES
    entry = types.get(ros_type(channel.type_name) if is_ros else channel.type_name)
    return entry[0] if entry else None


def is_camera(channel: Channel) -> bool:
    """Whether the channel's messages are images, raw or coded."""
    return kind_of(channel) in (ImageFields, CodedFields)


def is_calibration(channel: Channel) -> bool:
    """Whether the channel's messages are calibrations."""
    return kind_of(channel) is CalibrationFields


INFO_NAMES = ("camera_info", "calibration")
"""Last words of calibration topics, in ROS and in Foxglove's examples."""


TRANSPORTS = frozenset({"compressed", "compressedDepth", "ffmpeg", "foxglove", "compressed_video"})
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
        Refused: No wire has this serialization.
    """
    if message_encoding in ("ros1", _PROTOBUF):
        return message_encoding
    if message_encoding == "cdr":
        for name, (prefix, _) in _ROS_WIRES.items():
            if prefix and data[:4] == prefix:
                return name
        if data[:4] == _ZSTD:
            remedy = "pack the folder with its metadata.yaml"
            mode = "as rosbag2 does in its compression mode MESSAGE"
            raise Refused(f"it is compressed by zstd, {mode}: {remedy}")
        if len(data) < 4:
            raise Refused("it is too short for a CDR encapsulation")
        raise Refused(f"its CDR encapsulation is {bytes(data[:4]).hex()}, which is not plain CDR")
    raise Refused(f"serialization {message_encoding!r} is not modelled")


def form_of(wire: str, type_name: str, schema: bytes) -> Form:
    """The form of a message type in a serialization.

    Args:
        wire: One of `WIRES`.
        type_name: As the source spells it.
        schema: The recorded definition.

    Raises:
        Refused: The type is not modelled in that serialization.
    """
    if wire == _PROTOBUF:
        return ProtobufForm(type_name, schema)
    name = ros_type(type_name)
    if wire not in _ROS_WIRES or name not in ROS_TYPES:
        raise Refused(f"type {type_name!r} is not modelled")
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
        Refused: The type cannot represent a value.
    """
    name = ros_type(type_name)
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
        except Refused as error:
            raise Refused(f"it does not parse: {error}") from None
