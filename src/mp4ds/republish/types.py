"""The message types of republished images: definitions, channels, serialized messages.

The types are those of sensor_msgs, and Foxglove's schema CompressedVideo
(docs.foxglove.dev, "CompressedVideo").
"""

from __future__ import annotations

from collections.abc import Mapping

from mp4ds.bags.convert import Converter
from mp4ds.bags.typedefs import World, make_store, ros1_world, ros2_world, types_of
from mp4ds.records import Channel, Schema
from mp4ds.wire import CodedFields, Fields, Slots, Template, WireError, form_of
from mp4ds.wire.cursor import Writer
from mp4ds.wire.forms import NS

_DISTRIBUTION = "humble"
_TYPES = {
    "raw": "sensor_msgs/msg/Image",
    "jpeg": "sensor_msgs/msg/CompressedImage",
    "png": "sensor_msgs/msg/CompressedImage",
    "compressed-video": "foxglove_msgs/msg/CompressedVideo",
}
_VIDEO_DEFINITION = """\
{time} timestamp
string frame_id
uint8[] data
string format
"""
_TIMES = {"ros1": "time", "cdr": "builtin_interfaces/Time"}
_WIRES = {"ros1": "ros1", "cdr": "cdr-le"}
_HASHES = {"ros1": "md5sum", "cdr": "topic_type_hash"}
_DEFINITION = "message_definition"
_REMEMBERED = "ros1:"  # begins keys that tell what a ROS 2 channel was in ROS 1
_OF_TYPE = ("type", "md5sum", _DEFINITION)


def type_of(kind: str) -> str:
    """The type that images of a kind have, as ROS 1 spells it."""
    return _TYPES[kind].replace("/msg/", "/")


class Types:
    """Channels and messages of one kind for one target.

    Args:
        encoding: Message encoding of the target: ``ros1`` or ``cdr``.
        kind: One of `mp4ds.republish.KINDS`.
    """

    def __init__(self, encoding: str, kind: str) -> None:
        self.encoding = encoding
        self._kind = kind
        self._worlds = {"ros1": ros1_world(), "cdr": ros2_world(_DISTRIBUTION)}
        self._converter = Converter({"ros1": "ros1", "cdr": "ros2"}[encoding])

    @property
    def omitted(self) -> Mapping[str, int]:
        """What the channels told and the target has no place for: a phrase -> how many."""
        return self._converter.omitted

    @property
    def has_seq(self) -> bool:
        """Whether the messages have a header with a sequence number."""
        return self.encoding == "ros1" and self._kind != "compressed-video"

    @property
    def no_seq(self) -> str:
        """What is left out where they have none."""
        without = "ROS 2" if self.encoding == "cdr" else "CompressedVideo"
        return f"messages with a header's sequence number, which {without} has not"

    def channel(self, source: Channel, channel_id: int, topic: str) -> Channel:
        """The channel for the images of another one.

        Latching, QoS and the publisher's name are kept, what belongs to the type is the new
        type's.

        Args:
            source: As recorded.
            channel_id: Of the channel to make.
            topic: Of the channel to make.
        """
        encoding = source.message_encoding
        if encoding not in self._worlds:
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
        made = Channel(channel_id, topic, encoding, schema, kept)
        return self._converter.channel(made)

    def _defined(self, encoding: str) -> tuple[Schema, str]:
        """The type's definition, and its md5sum or hash."""
        name, world = _TYPES[self._kind], self._worlds[encoding]
        text = ""
        if self._kind == "compressed-video":
            text = _VIDEO_DEFINITION.format(time=_TIMES[encoding])
        schema = Schema(name, world.schema_encoding if text else "", text.encode())
        return _generated(schema, world)

    def message(
        self, slots: Slots, frame_id: str, fields: Fields, body: bytes | memoryview
    ) -> bytes:
        """A message.

        Args:
            slots: Stamp, and the sequence number that ROS 1 has.
            frame_id: Coordinate frame.
            fields: Of the image.
            body: Its pixels, file or packet.

        Raises:
            WireError: The stamp or a number has no place in the serialization.
        """
        slots = Slots(_wrapped(slots.stamp, signed=self.encoding == "cdr"), slots.seq)
        if isinstance(fields, CodedFields) and self._kind == "compressed-video":
            return _video_message(self.encoding, slots, frame_id, fields.format, body)
        head, tail = self._template(frame_id, fields).around(slots, len(body))
        return b"".join((head, body, tail))

    def _template(self, frame_id: str, fields: Fields) -> Template:
        form = form_of(_WIRES[self.encoding], _TYPES[self._kind], b"")
        blank = form.plain(frame_id, fields)
        if blank is None:
            raise WireError(f"{_TYPES[self._kind]} has no plain form")
        return form.template(blank)


def _is_kept(key: str) -> bool:
    """Whether metadata belongs to the topic, and not to the type of its messages."""
    plain = key.removesuffix(";base64").removeprefix(_REMEMBERED)
    return plain not in (*_OF_TYPE, "topic_type_hash") and key != "topic;base64"


def _generated(schema: Schema, world: World) -> tuple[Schema, str]:
    store = make_store(types_of(schema, world), world)
    if world.encoding == "ros1":
        text, digest = store.generate_msgdef(schema.name, 1)
        name = schema.name.replace("/msg/", "/")  # as ROS 1 spells it
    else:
        text, digest = store.generate_msgdef(schema.name, 2)[0], store.hash_rihs01(schema.name)
        name = schema.name
    return Schema(name, world.schema_encoding, text.encode()), digest


def _wrapped(stamp: int, *, signed: bool) -> int:
    """A stamp whose seconds have the bits that they had in the other ROS."""
    seconds, nanoseconds = divmod(stamp, NS)
    if -(2**31) <= seconds < 2**32:
        seconds %= 2**32
        if signed and seconds >= 2**31:
            seconds -= 2**32
    return seconds * NS + nanoseconds


def _video_message(
    encoding: str, slots: Slots, frame_id: str, video_format: str, body: bytes | memoryview
) -> bytes:
    """A CompressedVideo: what follows the data is aligned in CDR."""
    is_cdr = encoding == "cdr"
    seconds, nanoseconds = divmod(slots.stamp, NS)
    head = Writer(b"\0\1\0\0" if is_cdr else b"", "<", aligned=is_cdr)
    if not (-(2**31) if is_cdr else 0) <= seconds < (2**31 if is_cdr else 2**32):
        raise WireError("its stamp is beyond what ROS has bits for")
    head.put("i" if is_cdr else "I", seconds)
    head.put("I", nanoseconds)
    head.string(frame_id, terminated=is_cdr)
    head.put("I", len(body))
    tail = Writer(b"", "<", aligned=False)
    tail.string(video_format, terminated=is_cdr)
    gap = bytes(-len(body) % 4 if is_cdr else 0)
    return b"".join((head.getvalue(), body, gap, tail.getvalue()))
