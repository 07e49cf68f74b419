"""Images of one topic, size and encoding, wherever they are stored."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.dataset.views import Crop, Resize, View, view_of
from mp4ds.errors import FormatError, OptionError, Refused, VideoError
from mp4ds.format.fields import Choice, DecodedColumns, everything
from mp4ds.format.models import Calibration
from mp4ds.messages import depth, png
from mp4ds.messages.encodings import ENCODINGS, Picture, Pixels, pixel_view
from mp4ds.messages.layouts import why_not
from mp4ds.messages.serializations import MessageSplitter
from mp4ds.messages.wire import CodedFields, ImageFields, Parts
from mp4ds.options import seconds_text
from mp4ds.records import Channel, Excerpt, Message
from mp4ds.video.access import FrameReader
from mp4ds.video.decoder import read_video_file
from mp4ds.video.images import coded_pixels
from mp4ds.video.pixels import Scale

Integers = NDArray[np.int64]
NumberedPictures = Iterator[tuple[int, Picture | None]]
"""Pictures with the numbers of their frames; None for one that cannot be decoded."""


class Images(ABC):
    """Images of one topic, all of one size and encoding; `Topic` reads their frames.

    Attributes:
        topic: Topic of the images.
        channel: Their channel, whose id has no meaning; None of a third-party video.
        path: Their file: a sidecar, a video without one, or messages.mcap.
        video_path: The file with the images: a video, or messages.mcap.
        encoding: ROS image encoding of the frames as recorded.
        image_size: Width and height of the images, pixels.
        file_suffix: ``jpg`` or ``png`` if messages hold such files, which can be had byte for byte.
        is_lossy: Whether they differ from those recorded.
        shows_colours: Whether the decoder can make RGB directly, in any size; see
            `mp4ds.video.pixels.shows_colours`.
    """

    topic: str
    channel: Channel | None
    path: Path
    video_path: Path
    _columns: DecodedColumns
    encoding: str
    image_size: tuple[int, int]
    file_suffix = ""
    is_lossy = False
    shows_colours = False

    def __repr__(self) -> str:
        size, encoding = "{}x{}".format(*self.image_size), self.encoding
        frames = f"{len(self)} frame{'s' * (len(self) != 1)}"
        return f"<{type(self).__name__} {self.topic!r}: {frames}, {size} {encoding}>"

    @property
    def columns(self) -> DecodedColumns:
        """One value per frame; of a third-party video, all times are presentation times."""
        return self._columns

    def __len__(self) -> int:
        return len(self.columns.stamp)

    @property
    def stamps(self) -> Integers:
        """Header stamps, nanoseconds, shape (frames,)."""
        return self.columns.stamp

    @property
    def log_times(self) -> Integers:
        """Log times, nanoseconds, shape (frames,)."""
        return self.columns.log_time

    @property
    def calibrations(self) -> Sequence[Calibration]:
        """All calibrations, in the order in which they were first seen; none if unknown."""
        return []

    def calibration_at(self, log_time: int) -> Calibration | None:
        """The calibration that applied at a log time, nanoseconds; None if unknown."""
        return None

    def frame_id(self, index: int) -> str:
        """The coordinate frame of a frame's header; empty if unknown."""
        return ""

    # ------------------------------------------------------------ pictures

    @abstractmethod
    def open_reader(self) -> FrameReader | PredictedFrames | VerbatimImages:
        """A separate decoder for frames by number, to be closed."""

    def pictures(
        self, choice: Choice = everything, scale: Scale | None = None, *, is_strict: bool = True
    ) -> Iterator[tuple[int, Picture]]:
        """The wanted pictures in order, each with its number, from a separate decoder.

        Each is valid until the next one is requested. One that cannot be decoded is an error; or is
        left out if it was recorded as a packet, and `is_strict` is not set.
        """
        with closing(self.open_reader()) as reader:
            yield from reader.pictures_of(list(choice(self.columns)), scale)

    def write_pixels(self, picture: Picture, out: Pixels) -> None:
        """Write the pixels of a picture, as recorded."""
        np.copyto(out, picture[0])

    def recorded_pixels(self, picture: Picture) -> Pixels:
        """A new array of the pixels of a picture, as recorded."""
        encoding = ENCODINGS[self.encoding]
        pixels: Pixels = np.empty(encoding.shape(*self.image_size), encoding.dtype)
        self.write_pixels(picture, pixels)
        return pixels

    def depth_header(self, index: int) -> bytes:
        """What gives the quantised depths of a frame in metres; empty for all others.

        Raises:
            OptionError: It is not known.
        """
        return b""

    # ------------------------------------------------------------ views

    def view(
        self,
        format: str = "native",  # noqa: A002 - as users write it
        resize: Resize = None,
        crop: Crop = None,
    ) -> View:
        """A way of returning the frames.

        Args:
            format: See `Topic`.
            resize: See `Topic`.
            crop: See `Topic`.

        Raises:
            OptionError: The format, crop or size is invalid, or not available for these frames.
        """
        if format == "depth_m" and self.is_lossy and self.encoding in depth.DEPTHS:
            raise OptionError(
                f"{self.topic} has no exact frames here, and what a view shows of depths cannot be "
                "measured: format='depth_m' is not available"
            )
        return view_of(
            self.topic,
            ENCODINGS[self.encoding],
            self.image_size,
            format=format,
            resize=resize,
            crop=crop,
            shows_colours=self.shows_colours,
        )

    def pixels(self, picture: Picture, view: View, index: int, out: Pixels | None = None) -> Pixels:
        """The pixels of a frame in a view.

        Args:
            picture: Of the frame, decoded with the view's scale.
            view: See `view`.
            index: Number of the frame.
            out: Where to write them; None for an array of their own.
        """
        if view.scale:
            if out is None:
                return picture[0]
            if picture[0] is not out:  # the decoder may have written there already
                np.copyto(out, picture[0])
            return out
        made: Pixels = np.empty(view.shape, view.dtype) if out is None else out
        if view.is_plain:
            self.write_pixels(picture, made)
            return made
        pixels = self.recorded_pixels(picture)
        if view.in_metres:
            pixels = depth.metres_of(pixels, self.depth_header(index))
        view.give(pixels, made)
        return made

    # ------------------------------------------------------------ damage

    @contextmanager
    def naming_frames(self) -> Iterator[None]:
        """Give errors that have the number of a frame its topic and times."""
        try:
            yield
        except FormatError as error:
            named = self.named(error)
            if named is error:
                raise
            raise named from None

    def named(self, error: FormatError, last: int | None = None) -> FormatError:
        """An error of a frame, or of several in a row up to the last, with topic and times.

        It stays as it is if it names its frame already, or is of none.
        """
        # a damaged video may have more frames than its sidecar
        if error.frame is None or error.name or error.frame >= len(self.stamps):
            return error
        ends = [error.frame] if last in (None, error.frame) else [error.frame, last]
        frames = f"frame{'s' * (len(ends) - 1)} {' to '.join(map(str, ends))}"
        stamps, times = (
            " to ".join(seconds_text(int(column[index])) for index in ends)
            for column in (self.stamps, self.log_times)
        )
        name = f"{frames} of {self.topic} (stamp {stamps}, log time {times})"
        return type(error)(error.code, error.place, error.what, frame=error.frame, name=name)


class PredictedFrames:
    """Frames by number, made of two videos.

    Args:
        own: Reads the stream's video.
        shown: Reads its view.
        combine: Makes pictures of those of both.
    """

    def __init__(
        self,
        own: FrameReader | PredictedFrames,
        shown: FrameReader | PredictedFrames,
        combine: Callable[[NumberedPictures, NumberedPictures], NumberedPictures],
    ) -> None:
        self._own, self._shown, self._combine = own, shown, combine

    def pictures_of(
        self,
        numbers: Sequence[int],
        scale: Scale | None = None,
        outs: Mapping[int, Pixels] | None = None,
    ) -> Iterator[tuple[int, Picture]]:
        """Pictures of some frames, in their own size; see `FrameReader.pictures_of`."""
        own, shown = (reader.pictures_of(numbers) for reader in (self._own, self._shown))
        for index, picture in self._combine(own, shown):
            if picture is not None:
                yield index, picture

    def close(self) -> None:
        """Close both files."""
        self._own.close()
        self._shown.close()


class VideoImages(Images):
    """The frames of an mp4 without a sidecar.

    Frames are ``rgb8``, converted by the video's colour tags, in coded orientation; stamps are
    presentation times, the first usually 0.

    Args:
        path: The video.

    Raises:
        VideoError: It cannot be read, or has several video tracks.
    """

    channel = None
    encoding = "rgb8"
    shows_colours = True

    def __init__(self, path: Path) -> None:
        self.path = self.video_path = path
        self.topic = path.stem
        self._file = file = read_video_file(path)
        self.image_size = file.size
        self._columns = DecodedColumns.of_frames(file.times, file.times)

    def open_reader(self) -> FrameReader:
        """A separate decoder for frames by number."""
        file = self._file
        return FrameReader(
            file.path, codec=file.codec, frames=len(self), maker=file.maker(), file=file
        )


# ---------------------------------------------------------------- in messages.mcap

Recorded = Callable[[Excerpt], Iterator[Message]]
"""Yields the messages of a channel within an excerpt, by log time."""

_SUFFIXES = {b"\xff\xd8\xff": "jpg", png.SIGNATURE[:3]: "png"}  # by how a file begins


@dataclass(frozen=True, slots=True)
class Shown:
    """What a message shows.

    Attributes:
        encoding: ROS image encoding.
        pixels: Shape `Encoding.shape`, native byte order.
        header: Of quantised depths, what gives them in metres; else empty.
        file: The message's file; empty if it has none.
    """

    encoding: str
    pixels: Pixels
    header: bytes = b""
    file: bytes | memoryview = b""

    @property
    def kind(self) -> tuple[str, tuple[int, ...], str]:
        """What frames have in common that are together in one `VerbatimImages`."""
        return self.encoding, self.pixels.shape, _SUFFIXES.get(bytes(self.file[:3]), "")


def shown_by(channel: Channel, parts: Parts) -> Shown:
    """What a camera message shows, whether or not it could be rebuilt from a video.

    Raises:
        Refused: It has no picture of its own; says why.
    """
    fields = parts.fields
    if isinstance(fields, ImageFields):
        raw = ENCODINGS.get(fields.encoding)
        due = raw.size(fields.step, fields.height) if raw else 0
        reason = why_not(fields, min(len(parts.body), due))
        if raw is None or reason:
            raise Refused(reason)
        view = pixel_view(parts.body, fields)
        return Shown(raw.name, view.astype(view.dtype.newbyteorder("="), copy=False))
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
        return Shown("16UC1", pixels, header if is_inverse else b"", body)
    return Shown(*coded_pixels(parts.body), file=parts.body)


_Entry = tuple[int, int, int, int, str]
"""Of a message that is a frame: its ordinal among the messages of its channel; log time; how many
messages of the channel in messages.mcap have this log time and come before; stamp; frame ID."""


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
        kind: tuple[str, tuple[int, ...], str],
        entries: Sequence[_Entry],
        recorded: Recorded,
        calibrated: Images | None,
    ) -> None:
        self.path = self.video_path = path
        self.channel, self.topic = channel, channel.topic
        self.encoding, (rows, width, *_), self.file_suffix = kind
        self.image_size = width, int(rows / ENCODINGS[self.encoding].rows)
        self._recorded, self._calibrated = recorded, calibrated
        numbers = np.array([entry[:4] for entry in entries], np.int64).reshape(-1, 4)
        ordinals, log_times, self._ties, stamps = numbers.T
        self._columns = DecodedColumns.of_frames(stamps, log_times, ordinal=ordinals)
        self._frame_ids = [entry[4] for entry in entries]
        self._last: tuple[int, Shown] | None = None

    @property
    def calibrations(self) -> Sequence[Calibration]:
        """Those of the topic's streams; none if they are in messages.mcap, too."""
        return self._calibrated.calibrations if self._calibrated else []

    def calibration_at(self, log_time: int) -> Calibration | None:
        """The calibration that applied at a log time, nanoseconds; None if unknown."""
        return self._calibrated.calibration_at(log_time) if self._calibrated else None

    def frame_id(self, index: int) -> str:
        """The coordinate frame of a frame's header; empty if unknown."""
        return self._frame_ids[index]

    def shown(self, index: int) -> Shown:
        """What a message shows.

        Args:
            index: 0 <= index < frames.

        Raises:
            VideoError: ``decode-failed``: it cannot be decoded.
            FormatError: messages.mcap is damaged.
        """
        time, tie = int(self.log_times[index]), int(self._ties[index])
        span = Excerpt(time, time + 1, frozenset([self.topic]), others=False)
        message = next(islice(self._recorded(span), tie, None), None)
        if message is None:
            error = VideoError("decode-failed", self.path, "was not found", frame=index)
            raise self.named(error)
        with self.naming_frames():
            try:
                return shown_by(self.channel, MessageSplitter(self.channel).split(message)[1])
            except Refused as error:
                raise VideoError("decode-failed", self.path, str(error), frame=index) from None

    # ------------------------------------------------------------ as a decoder

    def open_reader(self) -> VerbatimImages:
        """Itself: nothing has to be open."""
        return self

    def pictures_of(self, numbers: Sequence[int], *_: object) -> Iterator[tuple[int, Picture]]:
        """Pixels of some frames as recorded, each with its number; see `FrameReader.pictures_of`.

        They have no other scale.
        """
        for number in numbers:
            self._last = number, self.shown(number)
            yield number, (self._last[1].pixels,)

    def close(self) -> None:
        """Nothing stays open."""

    def depth_header(self, index: int) -> bytes:
        """What gives the quantised depths of a frame in metres; empty for all others."""
        number, shown = self._last or (-1, None)
        return shown.header if shown and number == index else self.shown(index).header


def verbatim_images(
    path: Path,
    channel: Channel,
    numbered: Iterable[tuple[int, Message]],
    recorded: Recorded,
    calibrated: Images | None,
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
    entries: dict[tuple[str, tuple[int, ...], str], list[_Entry]] = {}
    without = Counter[str]()
    for ordinal, message in numbered:
        time = message.log_time
        try:
            _, parts = splitter.split(message)
            kind = shown_by(channel, parts).kind
        except Refused as error:
            without[str(error)] += 1
        else:
            entry = ordinal, time, ties[time], parts.stamp, parts.frame_id
            entries.setdefault(kind, []).append(entry)
        ties[time] += 1
    made = [
        VerbatimImages(path, channel, kind, found, recorded, calibrated)
        for kind, found in entries.items()
    ]
    return made, without
