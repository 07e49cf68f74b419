"""A recording whose images are made smaller or fewer while it is read, for `pack --resize`.

Whatever it is read from gives messages, so a dataset and a recording are reduced in the same way.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain, islice

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.protocols import BagReader, with_own_payload
from mp4ds.dataset.images import Shown, shown_by
from mp4ds.dataset.views import View, view_of
from mp4ds.errors import ConversionError, OptionError, Refused
from mp4ds.format.manifest import ReducedImages
from mp4ds.format.models import Calibration
from mp4ds.messages.depth import metres_of
from mp4ds.messages.encodings import ENCODINGS, Picture, Pixels
from mp4ds.messages.serializations import (
    MessageSplitter,
    is_calibration,
    is_camera,
    kind_of,
    plain_message,
)
from mp4ds.messages.wire import CalibrationFields, CodedFields, Fields, Form, Parts, Slots
from mp4ds.options import Selection
from mp4ds.packing.inspection import (
    CameraMessage,
    MessageInspector,
    choose_pairs,
    pair_camera_infos,
)
from mp4ds.packing.options import PackOptions
from mp4ds.records import EVERYTHING, Channel, ChannelStats, Excerpt, Message, Record
from mp4ds.times import RateLimit, intervals, usual_interval
from mp4ds.unpacking.pictures import Kind, named_encoding, raw_image
from mp4ds.unpacking.republish import Types
from mp4ds.video.decoder import PacketPictures

_MOST_LOOKED_AT = 1000  # messages of a topic for an image that can be decoded
_MOST_BEFORE = 1000  # packets before a slice that are held
_INFO = Kind("sensor_msgs/msg/CameraInfo", "info", "calibrations", None)
PACKETS = ("CompressedVideo", "FFMPEGPacket")
"""Ends of the names of types of video packets."""

_Kind = tuple[str, tuple[int, int]]
"""Encoding, or codec, and width and height of images."""


class ChangedReader(BagReader):
    """A recording of which some messages are changed while it is read.

    Args:
        reader: The recording; closed with this one.
    """

    is_indexed: bool = False

    def __init__(self, reader: BagReader) -> None:
        self._reader = reader
        self.path, self.files, self.format = reader.path, reader.files, reader.format
        self.profile, self.library, self.tables = reader.profile, reader.library, reader.tables
        self.begin, self.slice = reader.begin, reader.slice
        known = reader.stats().keys()
        if not (reader.is_indexed or (known and known <= {one.id for one in reader.channels})):
            deque(reader.records(Excerpt(others=False)), maxlen=0)  # which declares them

    @property
    def channels(self) -> Sequence[Channel]:
        """All channels, as their messages are given."""
        return self._reader.channels

    unused_schemas = property(lambda self: self._reader.unused_schemas)
    skipped = property(lambda self: self._reader.skipped)
    losses = property(lambda self: self._reader.losses)
    position = property(lambda self: self._reader.position)
    redaction = property(lambda self: self._reader.redaction)

    def times(self) -> Mapping[int, NDArray[np.int64]]:
        """Log times of the messages that are given, nanoseconds, sorted, by channel id."""
        return self._reader.times()

    def stats(self) -> Mapping[int, ChannelStats]:
        """Counts and time spans by channel id, of channels of which they are known."""
        return self._reader.stats()

    def _records(self, excerpt: Excerpt) -> Iterator[Record]:
        return self.records(excerpt)

    def close(self) -> None:
        """Close the recording."""
        self._reader.close()


class ReducedReader(ChangedReader):
    """A recording with smaller or fewer images.

    Coded images that change become raw ones, on their topic. A message without a picture that can
    be decoded is given as recorded, and so is a calibration of no images.

    Args:
        reader: The recording; closed with this one.
        options: What to do to its images; of which topics.

    Raises:
        OptionError: A pair of calibrations and images, or a pattern of topics, is not possible.
    """

    def __init__(self, reader: BagReader, options: PackOptions) -> None:
        super().__init__(reader)
        self.options = options
        chosen = [channel for channel in reader.channels if options.selected(channel.topic)]
        self._cameras = {channel.id: channel for channel in filter(is_camera, chosen)}
        for pattern in options.nearest:
            topics = [channel.topic for channel in self._cameras.values()]
            if not any(map(Selection([pattern]), topics)):
                listed = ", ".join(topics) or "none"
                problem = f"`nearest` {pattern!r} matches no topic of images"
                raise OptionError(f"{problem}. Topics of images: {listed}.")
        self.videos = {key for key, one in self._cameras.items() if one.type_name.endswith(PACKETS)}
        self.remade = set(self.videos)
        if options.resize is not None or options.crop is not None:
            self.remade |= self._cameras.keys() | {one.id for one in chosen if is_calibration(one)}
        self._types: dict[int, Types] = {}
        self._given: dict[int, Channel] = {}
        for one in chosen:
            # messages that are made anew are of these types, too
            keeps_type = one.message_encoding in ("ros1", "cdr") and kind_of(one) is not CodedFields
            if one.id in self.remade and not keeps_type:
                world = "ros1" if one.message_encoding == "ros1" else "ros2"
                types = Types(world, "raw", _INFO if is_calibration(one) else None)
                self._types[one.id] = types
                self._given[one.id] = types.channel(one, one.id, one.topic)
        self.is_indexed = reader.is_indexed and options.max_rate is None and not self.videos
        pairs = choose_pairs(options.camera_info, chosen)
        self.pairs = self._images = pair_camera_infos(chosen, chosen=pairs)
        self._views: dict[tuple[str, _Kind], View] = {}
        self._originals: dict[int, _Kind] = {}
        images = []
        for key, one in self._cameras.items():
            if key in self.remade and (original := self._original(one)):
                self._originals[key] = encoding, (width, height) = original
                told = ReducedImages(
                    topic=one.topic,
                    type=one.type_name,
                    encoding=encoding,
                    width=width,
                    height=height,
                )
                images.append(told)
        self.reduction = {**options.reduction, "images": images}

    def _original(self, channel: Channel) -> _Kind | None:
        """Encoding and size of the first image of a channel; None if there is none."""
        splitter, inspector = MessageSplitter(channel), MessageInspector(channel)
        excerpt = Excerpt(topics=frozenset([channel.topic]), others=False)
        records = chain(
            self._reader.records_before(self._videos_in(excerpt)), self._reader.records(excerpt)
        )
        for record in islice(records, _MOST_LOOKED_AT):
            if not isinstance(record, Message) or record.channel.id != channel.id:
                continue
            with suppress(Refused):
                if channel.id in self.videos:
                    key = inspector.inspect(record).key
                    return key.encoding, (key.width, key.height)
                _, parts = splitter.split(record)
                return _kind_of(parts, shown_by(channel, parts))
        return None

    # ------------------------------------------------------------ as a reader

    @property
    def channels(self) -> Sequence[Channel]:
        """All channels, as their messages are given."""
        return [self._given.get(channel.id, channel) for channel in self._reader.channels]

    def times(self) -> Mapping[int, NDArray[np.int64]]:
        """Log times of the messages that are given, nanoseconds, sorted, by channel id."""
        if self.options.max_rate is not None:
            return super().times()
        every = dict.fromkeys(self._cameras, self.options.every)
        return {key: times[:: every.get(key, 1)] for key, times in self._reader.times().items()}

    def stats(self) -> Mapping[int, ChannelStats]:
        """Counts and time spans by channel id, of channels of which they are known."""
        known = dict(self._reader.stats())
        for key in known.keys() & self._cameras.keys() if self.options.leaves_out else ():
            own = known.pop(key)
            if self.options.max_rate is None:
                known[key] = replace(own, count=-(-own.count // self.options.every))
        return known

    def _videos_in(self, excerpt: Excerpt) -> list[str]:
        """Topics of packets, of which those before a slice may be needed to decode those in it."""
        videos = {one.topic for key, one in self._cameras.items() if key in self.videos}
        return [topic for topic in videos if excerpt.start is None and excerpt.has_topic(topic)]

    def records(self, excerpt: Excerpt = EVERYTHING) -> Iterator[Record]:
        """Read an excerpt, with images as they are wanted; see `BagReader.records`."""
        cameras: dict[int, _Camera] = {}
        if videos := self._videos_in(excerpt):
            for record in self._reader.records_before(videos):
                if isinstance(record, Message) and record.channel.id in self.videos:
                    key = record.channel.id
                    if key not in cameras:
                        cameras[key] = self._camera(record.channel, excerpt.start)
                    cameras[key].precede(record)
        splitters: dict[int, MessageSplitter] = {}
        for record in self._reader.records(excerpt):
            channel = record.channel if isinstance(record, Message) else None
            if not isinstance(record, Message) or channel is None:
                yield record
            elif channel.id in self._cameras:
                if channel.id not in cameras:
                    cameras[channel.id] = self._camera(channel, excerpt.start)
                yield from cameras[channel.id].take(record)
            elif channel.id in self.remade:
                splitter = splitters.setdefault(channel.id, MessageSplitter(channel))
                yield self._calibration(record, splitter)
            else:
                yield record
        for camera in cameras.values():
            yield from camera.rest()

    def _camera(self, channel: Channel, start: int | None) -> _Camera:
        before, usual, rate = 0, None, self.options.max_rate
        if self.options.leaves_out and self._reader.is_indexed:
            times = self._reader.times()[channel.id]
            before = 0 if start is None else int(np.searchsorted(times, start))
            usual = usual_interval(intervals(times[:: self.options.every]))
        return _Camera(self, channel, before, None if rate is None else RateLimit(rate, usual))

    # ------------------------------------------------------------ messages

    def _view(self, topic: str, of: _Kind) -> View:
        """How images of an encoding and size are given.

        Raises:
            OptionError: They cannot be cropped or resized so.
        """
        if (topic, of) not in self._views:
            encoding, size, crop = ENCODINGS[of[0]], of[1], self.options.crop
            smaller = self.options.size_of(topic, (crop[2], crop[3]) if crop else size)
            is_native = encoding.is_plain or (bool(encoding.mosaic) and not smaller)
            self._views[topic, of] = view_of(
                topic,
                encoding,
                size,
                format="native" if is_native else "rgb",
                resize=smaller,
                crop=crop,
                nearest=any(Selection([glob])(topic) for glob in self.options.nearest),
            )
        return self._views[topic, of]

    def image(self, message: Message, form: Form, parts: Parts, shown: Shown) -> Message:
        """The message of an image as it is given.

        Raises:
            OptionError: It cannot be cropped or resized so.
            ConversionError: Its stamp cannot be written.
        """
        pixels = metres_of(shown.pixels, shown.header) if shown.header else shown.pixels
        view = self._view(message.channel.topic, _kind_of(parts, shown))
        made: Pixels = np.empty(view.shape, view.dtype)
        view.give(np.ascontiguousarray(pixels), made)
        given = raw_image(made, encoding=view.encoding.name)
        return self._written(message, form, parts, given.fields, given.body)

    def _calibration(self, message: Message, splitter: MessageSplitter) -> Message:
        """A calibration, for the images as they are given."""
        images = self._images.get(message.channel.id, -1)
        with suppress(Refused):
            form, parts = splitter.split(message)
            if images in self._originals and isinstance(parts.fields, CalibrationFields):
                view = self._view(self._cameras[images].topic, self._originals[images])
                recorded = Calibration.of(parts.frame_id, parts.fields, None)
                fields = (view.calibration(recorded) or recorded).fields
                return self._written(message, form, parts, fields, b"")
        return self.as_recorded(message)

    def _written(
        self, message: Message, form: Form, parts: Parts, fields: Fields, body: bytes | memoryview
    ) -> Message:
        channel, frame_id = message.channel, parts.frame_id
        slots, types = Slots(parts.stamp, parts.seq), self._types.get(message.channel.id)
        try:
            if types:
                data = types.message(slots, frame_id, fields, body)
            else:
                data = plain_message(form.wire, channel.type_name, frame_id, fields, slots, body)
        except Refused as error:
            problem = f"the message logged at {message.log_time} ns: {error}"
            raise ConversionError(channel.topic, problem) from None
        return replace(message, channel=self._given.get(channel.id, channel), data=data)

    def as_recorded(self, message: Message) -> Message:
        """A message that is not changed; on a channel of its own if the others are of a type."""
        channel = message.channel
        if channel.id not in self._given:
            return message
        return message.of_channel(replace(channel, id=-1 - channel.id))


def _kind_of(parts: Parts, shown: Shown) -> _Kind:
    """What the image of a message is; of quantised depths, in metres."""
    rows, width = shown.pixels.shape[:2]
    size = width, int(rows / ENCODINGS[shown.encoding].rows)
    told = parts.fields.format if isinstance(parts.fields, CodedFields) else None
    return "32FC1" if shown.header else named_encoding(shown.encoding, told), size


class _Camera:
    """The images of a channel on their way through a reader.

    Args:
        reader: The reader.
        channel: The channel.
        before: Images of it that come before the first that is taken.
        limit: Which of every so many are kept, by their stamps; None for all.
    """

    def __init__(
        self, reader: ReducedReader, channel: Channel, before: int, limit: RateLimit | None
    ) -> None:
        self._reader, self._channel = reader, channel
        self._count, self._limit, self._stamp = before, limit, 0
        self._splitter = MessageSplitter(channel)
        self._inspector = MessageInspector(channel) if channel.id in reader.videos else None
        # of packets, and whether they are kept
        self._pictures: PacketPictures[tuple[bool, CameraMessage]] | None = None
        self._kind: _Kind | None = None  # of these pictures
        self._before: deque[CameraMessage] = deque()  # since the last key frame

    def precede(self, message: Message) -> None:
        """Note a packet of before those that are taken, which may need it."""
        if self._inspector is None:
            return
        with suppress(Refused):
            seen = self._inspector.inspect(with_own_payload(message))
            if seen.keyframe:
                self._before.clear()
            self._before.append(seen)
        if len(self._before) > _MOST_BEFORE:
            deque(self._decoded(self._before.popleft(), is_kept=False), maxlen=0)

    def take(self, message: Message) -> Iterator[Message]:
        """The messages that are ready with one more."""
        is_kept = self._count % self._reader.options.every == 0
        self._count += 1
        if not (is_kept or self._inspector):
            return
        while self._before:
            yield from self._decoded(self._before.popleft(), is_kept=False)
        try:
            form, parts = self._splitter.split(message)
            is_later, self._stamp = parts.stamp > self._stamp, parts.stamp  # some are always zero
            if is_kept and self._limit:
                is_kept = self._limit.keeps(parts.stamp if is_later else message.log_time)
            if self._inspector:
                seen = self._inspector.inspect(with_own_payload(message))
                yield from self._decoded(seen, is_kept=is_kept)
            elif is_kept and self._channel.id in self._reader.remade:
                shown = shown_by(self._channel, parts)
                yield self._reader.image(message, form, parts, shown)
            elif is_kept:
                yield message
        except Refused:
            if is_kept:
                yield self._reader.as_recorded(message)

    def _decoded(self, seen: CameraMessage, *, is_kept: bool) -> Iterator[Message]:
        kind = seen.key.codec, (seen.key.width, seen.key.height)
        if self._pictures is None or kind != self._kind:
            yield from self.rest()
            self._pictures, self._kind = PacketPictures(kind[0], "rgb24", kind[1]), kind
        parameters = seen.parameters if seen.keyframe else b""
        yield from self._shown(self._pictures.of((is_kept, seen), seen.parts.body, parameters))

    def _shown(
        self, pictures: Iterator[tuple[tuple[bool, CameraMessage], Picture | None]]
    ) -> Iterator[Message]:
        for (is_kept, seen), picture in pictures:
            if is_kept and picture is None:
                yield self._reader.as_recorded(seen.message)
            elif is_kept and picture is not None:
                shown = Shown("rgb8", picture[0])
                yield self._reader.image(seen.message, seen.form, seen.parts, shown)

    def rest(self) -> Iterator[Message]:
        """What is left at the end."""
        if self._pictures:
            yield from self._shown(self._pictures.rest())
