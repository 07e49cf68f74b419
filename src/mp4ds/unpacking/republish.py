"""A dataset's messages as they go out: for ROS 1 or ROS 2, with images in another form."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial

from mp4ds.bags.convert import ENCODINGS, Converter
from mp4ds.bags.types import SCHEMA_ENCODINGS, make_store, standard_of, types_of
from mp4ds.dataset.dataset import Dataset
from mp4ds.dataset.messages import ChannelGroup, MessageSource, Part
from mp4ds.dataset.rebuild import message_at
from mp4ds.dataset.stream import Stream
from mp4ds.errors import ConversionError, FormatError, Refused
from mp4ds.format.fields import Choice, everything
from mp4ds.messages.serializations import TRANSPORTS, is_camera, plain_message
from mp4ds.messages.wire import NS, Fields, Slots
from mp4ds.records import HASH_KEY, Channel, Message, Schema
from mp4ds.unpacking.pictures import (
    FAMILIES,
    KINDS,
    Conversion,
    Given,
    Kind,
    holds_files,
)


def republished_topic(topic: str, type_name: str, kind: str) -> str:
    """The topic that image_transport would have for a topic's images.

    Args:
        topic: As recorded.
        type_name: Of its messages, which must be a camera's.
        kind: One of `KINDS`.
    """
    family = FAMILIES[type_name.replace(".", "/").rpartition("/")[2]]
    stem, _, last = topic.rpartition("/")
    has_transport = family != "raw" and last in TRANSPORTS and stem != ""
    suffix = KINDS[kind].suffix
    if family == KINDS[kind].family and not (has_transport and last != suffix):
        return topic
    if not has_transport:
        stem = topic
    if suffix is None:
        return stem if has_transport else f"{topic}/raw"
    return f"{stem}/{suffix}"


# ---------------------------------------------------------------- republisher

_NOT_DECODED = "its picture cannot be decoded"
_OTHER_FORMS = "Use `images` raw, jpeg or png."


@dataclass(frozen=True)
class Republished:
    """The result for a topic.

    Attributes:
        topic: The new topic of its images.
        type_name: Of their messages.
        instead_of: The topic they would have had, if it is taken.
    """

    topic: str
    type_name: str
    instead_of: str = ""


class Republisher:
    """Converts the messages of a dataset: planned on creation, done while reading.

    Args:
        dataset: The dataset.
        world: ``ros1`` or ``ros2``: what new channels are for.
        selected: Whether a topic is wanted.
        converts_all: Whether other channels are converted to it, too.
        kind: What to convert images to, one of `KINDS`; None for as recorded.
        jpeg_quality: Of new JPEG files, 1 to 100.
        renamed: The name that a topic goes out by.

    Attributes:
        channels: The selected channels that are expected to have messages: those of the dataset,
            then the new ones.
        sources: Makes the messages of streams and calibrations; see `Dataset.records`.
        republished: The result for each topic.
        as_recorded: Camera topics with messages that stay as recorded: reason -> how many. Grows
            while the messages are read.
    """

    def __init__(
        self,
        dataset: Dataset,
        world: str,
        *,
        selected: Callable[[str], bool],
        converts_all: bool,
        kind: str | None = None,
        jpeg_quality: int = 95,
        renamed: Callable[[str], str] = lambda topic: topic,
    ) -> None:
        self._kind = kind
        self._world = world
        self._jpeg_quality = jpeg_quality
        self._renamed = renamed
        self._converter = Converter(world if converts_all else None)
        self._outgoing: dict[int, Channel] = {}  # by id of the channel in `channels`
        self._types: dict[tuple[str, str], Types] = {}
        self._made: set[int] = set()
        self.sources: dict[Part, MessageSource] = {}
        self.republished: dict[str, Republished] = {}
        self.as_recorded: defaultdict[str, Counter[str]] = defaultdict(Counter)
        chosen = [item for item in dataset.image_channels() if selected(item.channel.topic)]
        self._cameras = {item.channel.id for item in chosen}
        planned = [(item, [*map(self._conversion, item.streams)]) for item in chosen]
        emptied = {
            item.channel.id
            for item, conversions in planned
            if all(one and not one.in_place for one in conversions) and not item.recorded_count
        }
        staying = [channel for channel in dataset.channels if channel.id not in emptied]
        self.channels = [channel for channel in staying if selected(channel.topic)]
        self._declare(dataset, planned, {channel.topic for channel in staying})
        cameras = {channel.topic for channel in dataset.channels if is_camera(channel)}
        for entry in dataset.manifest.verbatim if kind and dataset.manifest else []:
            if entry.topic in cameras and selected(entry.topic):
                self.as_recorded[entry.topic][f"stored verbatim: {entry.reason}"] += entry.messages

    @property
    def omitted(self) -> Mapping[str, int]:
        """What the target cannot hold: a phrase -> how many."""
        new = (types.omitted for types in self._types.values())
        return sum(new, Counter(self._converter.omitted))

    def makes(self, channel: Channel) -> bool:
        """Whether a channel is one of the new ones."""
        return channel.id in self._made

    def outgoing(self, channel: Channel) -> Channel:
        """A channel as it goes out, always the same object.

        Raises:
            ConversionError: The target cannot hold its messages.
        """
        if channel.id not in self._outgoing:
            made = channel if self.makes(channel) else self._converter.channel(channel)
            self._outgoing[channel.id] = replace(made, topic=self._renamed(made.topic))
        return self._outgoing[channel.id]

    def converted(self, message: Message) -> Message:
        """A message, read with the `sources`, as it goes out.

        Raises:
            ConversionError: The target cannot hold it.
        """
        channel, data = self.outgoing(message.channel), message.data
        if not self.makes(message.channel):
            data = self._converter.payload(message.channel, data)
        return replace(message, channel=channel, data=data)

    def is_frame(self, message: Message) -> bool:
        """Whether a message that goes out is an image of a stream, converted or not."""
        channel = message.channel
        is_camera = self.makes(channel) or channel.id in self._cameras
        return is_camera and self._outgoing.get(channel.id) is channel

    # ------------------------------------------------------------ what is given how

    def _conversion(self, stream: Stream) -> Conversion | None:
        """How the images of a stream are converted; None: they stay as recorded."""
        is_replaced = stream.sidecar.replaces_packets
        kind = self._kind or (_kind_of(stream) if is_replaced else "")
        if not kind:
            return None
        is_done = self._is_done(stream, kind)
        try:
            if is_done and not is_replaced:
                raise Refused(f"they are already {KINDS[kind].noun}")
            world = self._world
            if is_done and stream.channel.message_encoding != ENCODINGS[world]:
                world = "ros2" if world == "ros1" else "ros1"
            quality = self._jpeg_quality
            return Conversion(stream, kind, world, jpeg_quality=quality, in_place=is_done)
        except Refused as reason:
            if is_replaced:
                problem = f"its view has no such form: {reason}"
                raise ConversionError(stream.topic, problem, _OTHER_FORMS) from None
            self.as_recorded[stream.topic][str(reason)] += stream.count()
            return None

    def _is_done(self, stream: Stream, kind: str) -> bool:
        """Whether the messages already have a kind, in either ROS."""
        sidecar, channel = stream.sidecar, stream.channel
        name = channel.type_name.replace("/msg/", "/")
        if channel.message_encoding not in ENCODINGS.values() or name != KINDS[kind].ros1_type:
            return False
        if kind == "ffmpeg":
            return channel.message_encoding == ENCODINGS[self._world]
        if kind in ("jpeg", "png"):
            is_file = holds_files(stream, kind) or (kind == "jpeg" and sidecar.body == "jpeg")
            return is_file and not any(header.prefix for header in sidecar.headers)
        return True

    # ------------------------------------------------------------ channels and sources

    def _types_of(self, world: str, kind: str) -> Types:
        if (world, kind) not in self._types:
            self._types[world, kind] = Types(world, kind)
        return self._types[world, kind]

    def _declare(
        self,
        dataset: Dataset,
        planned: list[tuple[ChannelGroup, list[Conversion | None]]],
        taken: set[str],
    ) -> None:
        """Make the new channels, whose topics are none of those taken, and sources for all."""
        next_id = 1 + max((channel.id for channel in dataset.channels), default=0)
        topics: dict[tuple[str, str], str] = {}
        for item, conversions in planned:
            recorded = item.channel
            made: dict[str, Channel] = {}
            for conversion in filter(None, conversions):
                kind = conversion.kind
                if not conversion.in_place and kind not in made:
                    wanted = republished_topic(recorded.topic, recorded.type_name, kind)
                    key = recorded.topic, kind
                    if key not in topics:
                        topics[key] = wanted
                        while topics[key] in taken:
                            topics[key] += "_" + kind.replace("-", "_")
                        taken.add(topics[key])
                    topic = topics[key]
                    types = self._types_of(self._world, kind)
                    made[kind] = types.channel(recorded, next_id + len(self._made), topic)
                    self._made.add(made[kind].id)
                    self.channels.append(made[kind])
                    instead_of = wanted if topic != wanted else ""
                    known = Republished(topic, made[kind].type_name, instead_of)
                    self.republished.setdefault(recorded.topic, known)
                channel = None if conversion.in_place else made[kind]
                self.sources[conversion.stream] = partial(self._messages, conversion, channel)

    # ------------------------------------------------------------ messages

    def _messages(
        self, conversion: Conversion, made: Channel | None, recorded: Channel, choice: Choice
    ) -> Iterator[tuple[int, Message]]:
        """The messages of a stream, each with its ordinal in the recorded channel."""
        stream = conversion.stream
        columns, headers = stream.columns, stream.sidecar.headers
        types = self._types_of(conversion.world, conversion.kind)
        count = 0
        for index, frame in conversion.frames(choice, choice is everything):
            count += 1
            ordinal = int(columns.ordinal[index])
            if not isinstance(frame, Given):
                self.as_recorded[recorded.topic][_NOT_DECODED] += 1
                yield ordinal, message_at(columns, index, recorded, frame)
                continue
            frame_id = headers[int(columns.variant[index])].frame_id
            slots = Slots(int(columns.stamp[index]), columns.slots(index).seq, index)
            try:
                payload = types.message(
                    slots, frame_id, frame.fields, frame.body, is_key=frame.is_key
                )
            except Refused as error:
                raise ConversionError(recorded.topic, f"message {index}: {error}") from None
            yield ordinal, message_at(columns, index, made or recorded, payload)
        due = stream.count()
        if choice is everything and count != due:
            problem = f"has {count} frames or more, not {due}"
            raise FormatError("frame-count", stream.video_path, problem)


def _kind_of(stream: Stream) -> str:
    """The kind of packets that a view replaces."""
    name = stream.channel.type_name.replace(".", "/").rpartition("/")[2]
    return next(kind for kind, own in KINDS.items() if own.type_name.endswith(f"/{name}"))


# ---------------------------------------------------------------- types

_WIRES = {"ros1": "ros1", "cdr": "cdr-le"}
_HASHES = {"ros1": "md5sum", "cdr": HASH_KEY}
_DEFINITION = "message_definition"
_REMEMBERED = "ros1:"  # begins keys that tell what a ROS 2 channel was in ROS 1
_OF_TYPE = ("type", "md5sum", _DEFINITION)


class Types:
    """Channels and messages of one kind for one target.

    Args:
        world: ``ros1`` or ``ros2``.
        kind: One of `KINDS`.
        made: The kind itself, for one that is not in `KINDS`.
    """

    def __init__(self, world: str, kind: str, made: Kind | None = None) -> None:
        self.encoding = ENCODINGS[world]
        self._kind = kind
        self._made = made or KINDS[kind]
        self._converter = Converter(world)
        self._has_seq = world == "ros1" and kind != "compressed-video"
        self._without_seq = 0

    @property
    def omitted(self) -> Counter[str]:
        """What was recorded and the target cannot hold: a phrase -> how many."""
        without = "ROS 2" if self.encoding == "cdr" else "CompressedVideo"
        no_seq = f"messages with a header sequence number, which {without} does not have"
        return Counter(self._converter.omitted) + Counter({no_seq: self._without_seq})

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
        if encoding not in ENCODINGS.values():
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
        kind, standard = self._made, standard_of(encoding)
        text = kind.definitions.get(encoding, "")
        schema = Schema(kind.type_name, SCHEMA_ENCODINGS[encoding] if text else "", text.encode())
        store = make_store(types_of(schema, standard), standard)
        if encoding == "ros1":
            text, digest = store.generate_msgdef(schema.name, 1)
            name = kind.ros1_type
        else:
            text, digest = store.generate_msgdef(schema.name, 2)[0], store.hash_rihs01(schema.name)
            name = schema.name
        return Schema(name, SCHEMA_ENCODINGS[encoding], text.encode()), digest

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
            Refused: The serialization cannot represent the stamp or a number.
        """
        self._without_seq += slots.seq is not None and not self._has_seq
        stamp = _wrapped(slots.stamp, signed=self.encoding == "cdr")
        slots = Slots(stamp, slots.seq, slots.pts)
        wire, name = _WIRES[self.encoding], self._made.type_name
        return plain_message(wire, name, frame_id, fields, slots, body, flags=int(is_key))


def _is_kept(key: str) -> bool:
    """Whether metadata belongs to the topic, and not to the type of its messages."""
    plain = key.removesuffix(";base64").removeprefix(_REMEMBERED)
    return plain not in (*_OF_TYPE, HASH_KEY) and key != "topic;base64"


def _wrapped(stamp: int, *, signed: bool) -> int:
    """A stamp whose seconds have the same bits as in the other ROS."""
    seconds, nanoseconds = divmod(stamp, NS)
    if -(2**31) <= seconds < 2**32:
        seconds %= 2**32
        if signed and seconds >= 2**31:
            seconds -= 2**32
    return seconds * NS + nanoseconds
