"""Frames of images that are stored verbatim in messages.mcap."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from pathlib import Path

import numpy as np

from mp4ds.dataset.images import Images, Integers
from mp4ds.dataset.stream import Stream
from mp4ds.errors import Refused, VideoError
from mp4ds.format.models import Calibration
from mp4ds.messages import depth, png
from mp4ds.messages.encodings import ENCODINGS, Picture, Pixels, pixel_view
from mp4ds.messages.layouts import why_not
from mp4ds.messages.serializations import MessageSplitter
from mp4ds.messages.wire import CodedFields, ImageFields, Parts
from mp4ds.records import Channel, Excerpt, Message
from mp4ds.video.access import FrameReader
from mp4ds.video.images import coded_pixels
from mp4ds.video.pixels import Scale

Recorded = Callable[[Excerpt], Iterator[Message]]
"""Yields the messages of a channel within an excerpt, by log time."""

_JPEG = b"\xff\xd8\xff"


@dataclass(frozen=True, slots=True)
class Shown:
    """What a message shows.

    Attributes:
        encoding: ROS image encoding.
        pixels: Shape `Encoding.shape`, native byte order.
        header: Of quantised depths, what gives them in metres; else empty.
        file: The message's JPEG file; None if it has none.
    """

    encoding: str
    pixels: Pixels
    header: bytes = b""
    file: memoryview | None = None

    @property
    def kind(self) -> tuple[str, tuple[int, ...], bool]:
        """What frames have in common that are together in one `VerbatimImages`."""
        return self.encoding, self.pixels.shape, self.file is not None


def shown_by(channel: Channel, parts: Parts) -> Shown:
    """What a camera message shows, whether or not it could be rebuilt from a video.

    Raises:
        Refused: It has no picture of its own; says why.
    """
    fields = parts.fields
    if isinstance(fields, ImageFields):
        return _raw(parts.body, fields)
    if not isinstance(fields, CodedFields):
        raise Refused("it holds no image")
    if not channel.type_name.endswith("CompressedImage"):
        raise Refused("it is a packet of a video, which cannot be decoded on its own")
    if "compressedDepth" in fields.format and bytes(parts.body[:8]) != png.SIGNATURE:
        header, body = bytes(parts.body[: depth.HEADER_BYTES]), parts.body[depth.HEADER_BYTES :]
        is_png = bytes(body[:8]) == png.SIGNATURE
        pixels: Pixels = png.pixels_of(body) if is_png else depth.decode_rvl(body)
        if pixels.dtype != np.uint16 or pixels.ndim != 2:
            raise Refused("its depth image is not grey with 16 bits")
        is_inverse = depth.is_quantised(fields.format, header)
        return Shown("16UC1", pixels, header if is_inverse else b"")
    encoding, pixels = coded_pixels(parts.body)
    is_jpeg = bytes(parts.body[: len(_JPEG)]) == _JPEG
    return Shown(encoding, pixels, file=parts.body if is_jpeg else None)


def _raw(body: memoryview, fields: ImageFields) -> Shown:
    encoding = ENCODINGS.get(fields.encoding)
    size = {"width": fields.width, "height": fields.height, "step": fields.step}
    due = encoding.size(fields.step, fields.height) if encoding else 0
    if reason := why_not(fields.encoding, **size, size=min(len(body), due)):
        raise Refused(reason)
    is_bigendian = bool(fields.is_bigendian)
    view = pixel_view(body, ENCODINGS[fields.encoding], **size, is_bigendian=is_bigendian)
    return Shown(fields.encoding, view.astype(view.dtype.newbyteorder("="), copy=False))


@dataclass(frozen=True, slots=True)
class _Entry:
    """A message that is a frame.

    Attributes:
        ordinal: Among the messages of its channel.
        log_time: Nanoseconds.
        tie: How many messages of the channel in messages.mcap have this log time and come before.
        stamp: Nanoseconds.
        frame_id: Of its header.
    """

    ordinal: int
    log_time: int
    tie: int
    stamp: int
    frame_id: str


class VerbatimImages(Images):
    """Images of a channel in messages.mcap, all of one size and encoding.

    Args:
        path: messages.mcap.
        channel: Their channel.
        kind: See `Shown.kind`.
        entries: Their messages, by ordinal.
        recorded: Reads messages of the channel.
        calibrated: A stream of the topic that has its calibrations, if any.
    """

    channel: Channel

    def __init__(
        self,
        path: Path,
        channel: Channel,
        kind: tuple[str, tuple[int, ...], bool],
        entries: Sequence[_Entry],
        recorded: Recorded,
        calibrated: Stream | None,
    ) -> None:
        self.path = self.video_path = path
        self.channel, self.topic = channel, channel.topic
        self._kind, self._entries = kind, entries
        self._recorded, self._calibrated = recorded, calibrated
        self._last: tuple[int, Shown] | None = None

    @cached_property
    def stamps(self) -> Integers:
        """Header stamps, nanoseconds, shape (frames,)."""
        return np.array([entry.stamp for entry in self._entries], np.int64)

    @cached_property
    def log_times(self) -> Integers:
        """Log times, nanoseconds, shape (frames,)."""
        return np.array([entry.log_time for entry in self._entries], np.int64)

    @cached_property
    def ordinals(self) -> Integers:
        """Numbers among the messages of the channel, shape (frames,)."""
        return np.array([entry.ordinal for entry in self._entries], np.int64)

    @property
    def encoding(self) -> str:
        """ROS image encoding of the frames as recorded."""
        return self._kind[0]

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height of the images, pixels."""
        rows, width = self._kind[1][:2]
        return width, int(rows / ENCODINGS[self.encoding].rows)

    @property
    def are_jpeg_files(self) -> bool:
        """Whether the messages hold JPEG files."""
        return self._kind[2]

    @property
    def calibrations(self) -> Sequence[Calibration]:
        """Those of the topic's streams; none if they are in messages.mcap, too."""
        return self._calibrated.calibrations if self._calibrated else []

    def calibration_at(self, log_time: int) -> Calibration | None:
        """The calibration that applied at a log time, nanoseconds; None if unknown."""
        return self._calibrated.calibration_at(log_time) if self._calibrated else None

    def __len__(self) -> int:
        return len(self._entries)

    def shown(self, index: int) -> Shown:
        """What a message shows.

        Args:
            index: 0 <= index < frames.

        Raises:
            VideoError: ``decode-failed``: it cannot be decoded.
            FormatError: messages.mcap is damaged.
        """
        entry = self._entries[index]
        span = Excerpt(entry.log_time, entry.log_time + 1, frozenset([self.topic]), others=False)
        message = next(islice(self._recorded(span), entry.tie, None), None)
        if message is None:
            error = VideoError("decode-failed", self.path, "was not found", frame=index)
            raise self.named(error)
        return self._shown(index, MessageSplitter(self.channel), message)

    def all_shown(self) -> Iterator[tuple[int, Shown]]:
        """What all messages show, each with its number, in one pass: by log time.

        Raises:
            VideoError: ``decode-failed``: one cannot be decoded.
            FormatError: messages.mcap is damaged.
        """
        numbers = {(entry.log_time, entry.tie): n for n, entry in enumerate(self._entries)}
        splitter, ties = MessageSplitter(self.channel), Counter[int]()
        for message in self._recorded(Excerpt(topics=frozenset([self.topic]), others=False)):
            index = numbers.get((message.log_time, ties[message.log_time]))
            ties[message.log_time] += 1
            if index is not None:
                yield index, self._shown(index, splitter, message)

    def _shown(self, index: int, splitter: MessageSplitter, message: Message) -> Shown:
        with self.naming_frames():
            try:
                _, parts = splitter.split(message)
                return shown_by(self.channel, parts)
            except Refused as error:
                raise VideoError("decode-failed", self.path, str(error), frame=index) from None

    # ------------------------------------------------------------ as a decoder

    def open_reader(self) -> FrameReader:
        """A reader that gives the pixels as recorded; they are decoded by `picture`."""
        return FrameReader(None, lambda: self)

    def picture(self, index: int, scale: Scale | None = None) -> Picture:
        """The pixels of a frame, as recorded."""
        self._last = index, self.shown(index)
        return (self._last[1].pixels,)

    def close(self) -> None:
        """Nothing stays open."""

    def depth_header(self, index: int) -> bytes:
        """What gives the quantised depths of a frame in metres; empty for all others."""
        number, shown = self._last or (-1, None)
        return shown.header if shown and number == index else self.shown(index).header

    def frame_id(self, index: int) -> str:
        """The coordinate frame of a frame's header; empty if unknown."""
        return self._entries[index].frame_id


def verbatim_images(
    path: Path,
    channel: Channel,
    numbered: Iterable[tuple[int, Message]],
    recorded: Recorded,
    calibrated: Stream | None,
) -> tuple[list[VerbatimImages], Counter[str]]:
    """The frames that the messages of a channel in messages.mcap are; each is decoded once.

    Args:
        path: messages.mcap.
        channel: A camera channel.
        numbered: All its messages there, each with its ordinal, increasing.
        recorded: Reads messages of the channel.
        calibrated: A stream of the topic that has its calibrations, if any.

    Returns:
        The frames of each size and encoding, and how many messages have no picture, by reason.
    """
    splitter, ties = MessageSplitter(channel), Counter[int]()
    entries: dict[tuple[str, tuple[int, ...], bool], list[_Entry]] = {}
    without = Counter[str]()
    for ordinal, message in numbered:
        time = message.log_time
        try:
            _, parts = splitter.split(message)
            kind = shown_by(channel, parts).kind
        except Refused as error:
            without[str(error)] += 1
        else:
            entry = _Entry(ordinal, time, ties[time], parts.stamp, parts.frame_id)
            entries.setdefault(kind, []).append(entry)
        ties[time] += 1
    made = [
        VerbatimImages(path, channel, kind, found, recorded, calibrated)
        for kind, found in entries.items()
    ]
    return made, without
