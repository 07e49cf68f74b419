"""The messages of republished images: definitions, channels, and their serialization."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from mp4ds.bags.convert import Converter
from mp4ds.bags.types import RosVersion, make_store, ros1_version, ros2_version, types_of
from mp4ds.format.models import StreamSidecar
from mp4ds.messages.encodings import ENCODINGS
from mp4ds.messages.serializations import plain_message
from mp4ds.messages.wire import NS, Fields, Slots
from mp4ds.records import HASH_KEY, Channel, Schema
from mp4ds.video.codecs import CODECS

# ---------------------------------------------------------------- kinds

_DISTRIBUTION = "humble"
_ENCODERS = {"h264": "libx264", "h265": "hevc_nvenc"}  # decoders in ROS 1 go by these
_VIDEO = "string frame_id\nuint8[] data\nstring format\n"


@dataclass(frozen=True, slots=True)
class Kind:
    """What images can be converted to.

    Attributes:
        type_name: Type of the messages, as ROS 2 spells it.
        family: ``raw``, ``file`` or ``video``.
        noun: What the images are, for people.
        suffix: Last part of the topic that image_transport gives them; None if it has none.
        definitions: Message encoding -> definition, of a type that is not standard.
    """

    type_name: str
    family: str
    noun: str
    suffix: str | None
    definitions: Mapping[str, str] = field(default_factory=dict)

    @property
    def ros1_type(self) -> str:
        """Type of the messages, as ROS 1 spells it."""
        return self.type_name.replace("/msg/", "/")


KINDS: Mapping[str, Kind] = {
    "raw": Kind("sensor_msgs/msg/Image", "raw", "raw images", None),
    "jpeg": Kind("sensor_msgs/msg/CompressedImage", "file", "JPEG files", "compressed"),
    "png": Kind("sensor_msgs/msg/CompressedImage", "file", "PNG files", "compressed"),
    "compressed-video": Kind(
        "foxglove_msgs/msg/CompressedVideo",
        "video",
        "CompressedVideo",
        "compressed_video",
        {
            "ros1": f"time timestamp\n{_VIDEO}",
            "cdr": f"builtin_interfaces/Time timestamp\n{_VIDEO}",
        },
    ),
    "ffmpeg": Kind(
        "ffmpeg_image_transport_msgs/msg/FFMPEGPacket",
        "video",
        "FFMPEGPackets",
        "ffmpeg",
        {
            "ros1": "Header header\nuint8[] data\nint32 img_width\nint32 img_height\n"
            "string encoding\nuint64 pts\nuint8 flags\n",
            "cdr": "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\n"
            "uint64 pts\nuint8 flags\nbool is_bigendian\nuint8[] data\n",
        },
    ),
}
"""Names of kinds, as users write them."""

FAMILIES = {kind.type_name.rpartition("/")[2]: kind.family for kind in KINDS.values()}
"""Last part of the name of a camera's type -> its family."""
FAMILIES["RawImage"] = FAMILIES["Image"]  # Foxglove's


def packet_format(kind: str, sidecar: StreamSidecar, pixel_format: str, *, ros1: bool) -> str:
    """What messages say about the coding of their packets.

    Args:
        kind: ``compressed-video`` or ``ffmpeg``.
        sidecar: Of the video.
        pixel_format: Of the video as ffmpeg calls it.
        ros1: Whether they are messages of ROS 1.
    """
    if kind == "compressed-video":
        return sidecar.video.codec
    codec = CODECS[sidecar.video.codec].ffmpeg
    if ros1:
        return _ENCODERS.get(sidecar.video.codec, codec)
    encoding = sidecar.image.encoding
    known = ENCODINGS[encoding]
    if known.channels == 1 and not known.mosaic and known.rows == 1:
        before = shown = "mono8"
    else:
        before = "bgr8"
        shown = "rgb8" if encoding.startswith("rgb") else "bgr8"
    pixel_format = pixel_format.replace("yuvj", "yuv")  # the video itself has its range
    return ";".join((codec, pixel_format, before, shown))


# ---------------------------------------------------------------- types

_WIRES = {"ros1": "ros1", "cdr": "cdr-le"}
_HASHES = {"ros1": "md5sum", "cdr": HASH_KEY}
_DEFINITION = "message_definition"
_REMEMBERED = "ros1:"  # begins keys that tell what a ROS 2 channel was in ROS 1
_OF_TYPE = ("type", "md5sum", _DEFINITION)


class Types:
    """Channels and messages of one kind for one target.

    Args:
        encoding: Message encoding of the target: ``ros1`` or ``cdr``.
        kind: One of `KINDS`.
    """

    def __init__(self, encoding: str, kind: str) -> None:
        self.encoding = encoding
        self._kind = kind
        self._versions = {"ros1": ros1_version(), "cdr": ros2_version(_DISTRIBUTION)}
        self._converter = Converter({"ros1": "ros1", "cdr": "ros2"}[encoding])

    @property
    def omitted(self) -> Mapping[str, int]:
        """What the channels had and the target cannot hold: a phrase -> how many."""
        return self._converter.omitted

    @property
    def has_seq(self) -> bool:
        """Whether the messages have a header with a sequence number."""
        return self.encoding == "ros1" and self._kind != "compressed-video"

    @property
    def no_seq(self) -> str:
        """What is left out if they have none."""
        without = "ROS 2" if self.encoding == "cdr" else "CompressedVideo"
        return f"messages with a header sequence number, which {without} does not have"

    def channel(self, source: Channel, channel_id: int, topic: str) -> Channel:
        """The channel for the images of another one.

        Latching, QoS and the publisher's name are kept; whatever belongs to the type is the new
        type's.

        Args:
            source: As recorded.
            channel_id: Of the channel to make.
            topic: Of the channel to make.
        """
        encoding = source.message_encoding
        if encoding not in self._versions:
            encoding = self.encoding
        schema, digest = self._defined(encoding)
        kept = {key: value for key, value in source.metadata.items() if _is_kept(key)}
        kept[_HASHES[encoding]] = digest
        for key in ("topic",) if encoding == "ros1" else (f"{_REMEMBERED}topic",):
            if key in kept:  # a ROS 1 connection header may repeat it
                kept[key] = topic
        if encoding == "cdr" and f"{_REMEMBERED}type" in source.metadata:
            known, md5sum = self._defined("ros1")
            values = (known.name, md5sum, known.data.decode())
            kept |= dict(zip((_REMEMBERED + key for key in _OF_TYPE), values, strict=True))
        made = self._converter.channel(Channel(channel_id, topic, encoding, schema, kept))
        if self._kind != "ffmpeg" or encoding == self.encoding:
            return made
        schema, digest = self._defined(self.encoding)  # the other ROS has a different type
        return replace(
            made, schema=schema, metadata={**made.metadata, _HASHES[self.encoding]: digest}
        )

    def _defined(self, encoding: str) -> tuple[Schema, str]:
        """The type's definition, and its md5sum or hash."""
        kind, version = KINDS[self._kind], self._versions[encoding]
        text = kind.definitions.get(encoding, "")
        schema = Schema(kind.type_name, version.schema_encoding if text else "", text.encode())
        return _generated(schema, version)

    def message(
        self,
        slots: Slots,
        frame_id: str,
        fields: Fields,
        body: bytes | memoryview,
        *,
        is_key: bool = False,
    ) -> bytes:
        """A message.

        Args:
            slots: Stamp, the sequence number that ROS 1 has, and the presentation time of
                packets.
            frame_id: Coordinate frame.
            fields: Of the image.
            body: Its pixels, file or packet.
            is_key: For a packet, whether decoding can begin with it.

        Raises:
            WireError: The serialization cannot represent the stamp or a number.
        """
        stamp = _wrapped(slots.stamp, signed=self.encoding == "cdr")
        slots = Slots(stamp, slots.seq, slots.pts)
        wire, name = _WIRES[self.encoding], KINDS[self._kind].type_name
        return plain_message(wire, name, frame_id, fields, slots, body, flags=int(is_key))


def _is_kept(key: str) -> bool:
    """Whether metadata belongs to the topic, and not to the type of its messages."""
    plain = key.removesuffix(";base64").removeprefix(_REMEMBERED)
    return plain not in (*_OF_TYPE, HASH_KEY) and key != "topic;base64"


def _generated(schema: Schema, version: RosVersion) -> tuple[Schema, str]:
    store = make_store(types_of(schema, version), version)
    if version.encoding == "ros1":
        text, digest = store.generate_msgdef(schema.name, 1)
        name = schema.name.replace("/msg/", "/")  # as ROS 1 spells it
    else:
        text, digest = store.generate_msgdef(schema.name, 2)[0], store.hash_rihs01(schema.name)
        name = schema.name
    return Schema(name, version.schema_encoding, text.encode()), digest


def _wrapped(stamp: int, *, signed: bool) -> int:
    """A stamp whose seconds have the same bits as in the other ROS."""
    seconds, nanoseconds = divmod(stamp, NS)
    if -(2**31) <= seconds < 2**32:
        seconds %= 2**32
        if signed and seconds >= 2**31:
            seconds -= 2**32
    return seconds * NS + nanoseconds
