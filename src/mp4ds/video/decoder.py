"""Decoding pictures: of packets, of a stream's mp4, and of videos that other programs made."""

from __future__ import annotations

import errno
import io
import os
import struct
from collections import Counter, deque
from collections.abc import Generator, Iterable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Generic, TypeVar

import av
import numpy as np
from av.error import FFmpegError, InvalidDataError
from numpy.typing import NDArray

from mp4ds.errors import FormatError, Refused, SourceError, VideoError, reason_of
from mp4ds.messages.encodings import MAX_SIDE, Picture
from mp4ds.records import MetadataRecord
from mp4ds.video.codecs import CODECS, COPIED_CODECS
from mp4ds.video.coded import REORDERED, StreamParser
from mp4ds.video.media import Media, most_pixels, raise_if_scarce
from mp4ds.video.mp4 import SampleTable
from mp4ds.video.pixels import PictureMaker, Scale

_ENCODINGS = {"L": "mono8", "RGB": "rgb8"}
_FORMATS = {"mono8": "gray", "rgb8": "rgb24"}


def jpeg_pixels(data: bytes | memoryview, size: tuple[int, int]) -> tuple[str, NDArray[np.uint8]]:
    """The pixels of a file, ignoring orientation tags and colour profiles.

    Args:
        data: The file.
        size: Its width and height; nothing larger is unpacked.

    Returns:
        The ROS encoding, ``mono8`` or ``rgb8``, and pixels of shape (H, W) or (H, W, 3).

    Raises:
        Refused: It cannot be decoded, or is of another size or kind.
    """
    from PIL.JpegImagePlugin import JpegImageFile

    try:
        with JpegImageFile(io.BytesIO(data)) as image:
            if image.mode not in _ENCODINGS:
                raise ValueError(f"it has colours of another kind ({image.mode})")
            if image.size != size:
                raise ValueError(f"it has {image.width}x{image.height} pixels")
            return _ENCODINGS[image.mode], np.asarray(image)
    except MemoryError:
        raise
    except (OSError, SyntaxError, ValueError, EOFError, LookupError, struct.error) as error:
        raise Refused(f"its JPEG does not decode: {error}") from None


class JpegDecoder:
    """Replaces ffmpeg's decoder for JPEG files, as far as it is used here.

    Args:
        size: Width and height of the frames.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._size = size

    def decode(self, packet: Any) -> list[av.VideoFrame]:
        """The frame of a packet; none for the empty packet that ends a video.

        Raises:
            InvalidDataError: It cannot be decoded.
        """
        if packet is None or not packet.size:
            return []
        try:
            encoding, pixels = jpeg_pixels(bytes(packet), self._size)
        except Refused as error:
            raise InvalidDataError(errno.EINVAL, str(error)) from None
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), _FORMATS[encoding])
        frame.pts = packet.pts
        if packet.time_base:
            frame.time_base = packet.time_base
        return [frame]

    def flush_buffers(self) -> None:
        """There is nothing to forget."""


def open_packet_decoder(codec: str, size: tuple[int, int], configuration: bytes = b"") -> Any:
    """A decoder that is given packets one by one, on one thread.

    Args:
        codec: Name in the registry.
        size: Width and height of the frames.
        configuration: What it needs besides the packets.
    """
    if codec == "mjpeg":
        return JpegDecoder(size)
    name = "libdav1d" if codec == "av1" else CODECS[codec].ffmpeg
    context: Any = av.CodecContext.create(name, "r")
    context.width, context.height = size
    context.thread_count = 1
    context.thread_type = "SLICE"
    # AV1 has it before key frames, too; ffmpeg would refuse it for the largest size it allows
    if configuration and codec != "av1":
        context.extradata = configuration
    context.options = most_pixels(size)
    if codec == "av1":
        context.options["max_frame_delay"] = "1"
    return context


_MOST_WAITING = 64  # packets without a picture: more than any decoder holds back
_Item = TypeVar("_Item")


class PacketPictures(Generic[_Item]):
    """Pictures of packets that come one by one, as messages hold them.

    Each packet comes with an item, which is given back with its picture: in order, when that is
    complete; or with None for one that cannot be decoded.

    Args:
        codec: Name in the registry.
        picture_format: Pixel format of the pictures wanted.
        size: Their width and height.
    """

    def __init__(self, codec: str, picture_format: str, size: tuple[int, int]) -> None:
        self._parser = CODECS[codec].parser
        self._decoder = open_packet_decoder(codec, size)
        self._maker = PictureMaker(
            Path(), coded_size=size, picture_format=picture_format, picture_size=size, matrix=None
        )
        self._waiting: deque[_Item] = deque()
        self._next = 0  # number of the first that waits

    def of(
        self, item: _Item, body: bytes | memoryview, parameters: bytes
    ) -> Iterator[tuple[_Item, Picture | None]]:
        """The items that are done with one more packet, each with its picture.

        Args:
            item: Of the packet.
            body: As the message holds it.
            parameters: What decoding needs first, of a key frame; see `StreamParser.parameters`.
        """
        data = self._parser.plain(body)
        if not self._parser.has_parameters(data):
            data = parameters + data
        packet: Any = av.Packet(data)
        packet.pts = self._next + len(self._waiting)
        self._waiting.append(item)
        yield from self._decoded(packet)
        yield from self._without_pictures(len(self._waiting) - _MOST_WAITING)

    def rest(self) -> Iterator[tuple[_Item, Picture | None]]:
        """The items that are left at the end."""
        yield from self._decoded(None)
        yield from self._without_pictures(len(self._waiting))

    def _decoded(self, packet: Any) -> Iterator[tuple[_Item, Picture | None]]:
        try:
            frames = self._decoder.decode(packet)
        except FFmpegError as error:
            raise_if_scarce(error)
            return
        for frame in frames:
            try:
                picture = self._maker.make(frame, frame.pts)
            except VideoError:  # marked as corrupt, or of another size
                continue
            if frame.pts >= self._next:  # else it is a second one of a packet
                yield from self._without_pictures(frame.pts - self._next)
                self._next += 1
                yield self._waiting.popleft(), picture

    def _without_pictures(self, count: int) -> Iterator[tuple[_Item, None]]:
        for _ in range(count):
            self._next += 1
            yield self._waiting.popleft(), None


# ---------------------------------------------------------------- decoder

_MOST_THREADS = 16  # that ffmpeg chooses of itself
_ERRORS = (FFmpegError, OSError, ValueError)  # PyAV has the last for a codec without a decoder


class VideoDecoder:
    """One video file being read. A context manager.

    What the file's header promises is compared with what its sidecar says before anything is
    decoded, so that a forged header costs no memory.

    Args:
        path: The video.
        codec: Name in the registry.
        frames: Expected number of frames.
        maker: Makes pictures of its frames.
        sequential: Decode with all cores, for reading in order.
        file: What is known of a third-party video.

    Raises:
        VideoError: ``video-unreadable``, ``codec-mismatch`` or ``geometry-mismatch``.
    """

    def __init__(
        self,
        path: Path,
        *,
        codec: str,
        frames: int,
        maker: PictureMaker,
        sequential: bool = True,
        file: VideoFile | None = None,
    ) -> None:
        self._path = path
        self._frames = frames
        self._maker = maker
        self._file = file
        self._jpeg = JpegDecoder(maker.coded_size) if codec == "mjpeg" else None
        # frames that the decoder has begun beyond the last that it gave
        self._in_flight = min(os.cpu_count() or 1, _MOST_THREADS) + 1 if sequential else 1
        # the frames that come next, and the number of their first, if a call ended in between
        self._position: tuple[Iterator[av.VideoFrame], int] | None = None
        self._media = file.open() if file else Media(path, size=maker.coded_size)
        self._container = self._media.container
        try:
            self._media.check(codec, maker.coded_size)
            self._stream = self._media.track
            if codec == "av1":  # as in `open_packet_decoder`
                self._stream.codec_context.extradata = None
                if maker.is_view:
                    self._stream.codec_context.options["export_side_data"] = "film_grain"
            self._stream.thread_type = "AUTO" if sequential else "SLICE"
            if not sequential:
                self._stream.thread_count = 1  # threads inherited over a fork would never end
        except BaseException:
            self.close()
            raise

    @property
    def coded_frames(self) -> int:
        """Frames in the file's index, without those hidden by an edit list at the beginning."""
        return len(self._media.table.order)

    def pictures_at(
        self, indices: Iterable[int], scale: Scale | None = None
    ) -> Iterator[tuple[int, Picture]]:
        """Some pictures, each with its frame's number, as views that hold until the next one.

        Decoding begins at the key frame before the first one, or continues where an earlier call
        stopped. Frames in between are decoded, and left out at key frames that are far enough
        ahead; they are not made into pictures.

        Args:
            indices: 0 <= index < frames, increasing. The next one is asked for only when the
                picture before was done with.
            scale: See `PictureMaker.make`.

        Raises:
            VideoError: ``decode-failed`` with the frame's number, or ``frame-count``.
        """
        for index, frame in self._chosen(indices, is_strict=True):
            if frame is None:
                raise VideoError("decode-failed", self._path, "was not found", frame=index)
            yield index, self._maker.make(frame, index, scale)

    def decodable_pictures(
        self, indices: Iterable[int], scale: Scale | None = None
    ) -> Iterator[tuple[int, Picture | None]]:
        """Like `pictures_at`, but None for a picture that cannot be decoded.

        That is how third-party streams are read, of which a packet may have been lost before it was
        recorded, and damaged videos. For the latter decode on one core: with several, an error may
        take the picture before it along.
        """
        for index, frame in self._chosen(indices, is_strict=False):
            yield index, None if frame is None else self._maker.make(frame, index, scale)

    def _chosen(
        self, indices: Iterable[int], *, is_strict: bool
    ) -> Iterator[tuple[int, av.VideoFrame | None]]:
        """The frames with some numbers; None for one that the decoder does not output.

        Args:
            indices: The numbers, increasing.
            is_strict: Whether it is an error if a key frame cannot be sought, or a frame decoded.
        """
        ticks, keys = self._index
        # what went on in spite of errors is nothing to begin with
        position = self._position if is_strict else None
        frames, due = position or (iter(()), -self._in_flight - 1)
        frame: av.VideoFrame | None = None
        for index in indices:
            self._position = None  # until the frame is there
            tick = int(ticks[index])
            group = int(np.searchsorted(keys, index, side="right")) - 1
            start = keys[group] if group >= 0 else 0
            if index < due or start > due + self._in_flight:
                frames, frame = self._decoded_from(group, index, is_strict=is_strict), None
            frame = _shown_from(tick, frame, frames)
            # of others, a key frame is sought by decoding time, which may lead to a later one
            for earlier in range(group - 1, group - 1 - _TRIES, -1) if self._file else ():
                if earlier < -1 or (frame is not None and frame.pts == tick):
                    break
                frames = self._decoded_from(earlier, index, is_strict=is_strict)
                frame = _shown_from(tick, None, frames)
            due = index + 1
            if frame is None or frame.pts != tick:
                yield index, None
                continue
            if is_strict:
                self._position = frames, due
            yield index, frame
            frame = None  # the next one is another, even if it is shown at the same time

    def _decoded_from(self, group: int, index: int, *, is_strict: bool) -> Iterator[av.VideoFrame]:
        """The frames from a key frame on, of which one is wanted; -1: from the first."""
        ticks, keys = self._index
        first = int(keys[group]) if group >= 0 else 0
        try:
            self._container.seek(int(ticks[first]), stream=self._stream)
        except (FFmpegError, OSError) as error:
            raise_if_scarce(error)
            if is_strict:
                problem = f"cannot be reached: {reason_of(error)}"
                raise VideoError("decode-failed", self._path, problem, frame=index) from None
        return self._decoded(first, is_strict=is_strict)

    @cached_property
    def _index(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Presentation ticks of the frames, and numbers of those at which decoding can begin."""
        if self._file:
            return self._file.ticks, self._file.keys
        if self.coded_frames != self._frames:
            problem = f"has {self.coded_frames} frames, not {self._frames}"
            raise VideoError("frame-count", self._path, problem)
        return _times_and_keys(self._media.table)

    def _decoded(self, first: int, *, is_strict: bool) -> Iterator[av.VideoFrame]:
        """The frames from here on; the first one's number is for errors."""
        number = first
        try:
            for packet in self._container.demux(self._stream):
                try:
                    frames = self._jpeg.decode(packet) if self._jpeg else packet.decode()
                except FFmpegError as error:
                    raise_if_scarce(error)
                    if is_strict:
                        raise
                    continue
                for frame in frames:
                    if is_strict or not frame.is_corrupt:
                        yield frame
                        number += 1
        except _ERRORS as error:
            raise_if_scarce(error)
            if is_strict:
                problem = f"cannot be decoded: {reason_of(error)}"
                raise VideoError("decode-failed", self._path, problem, frame=number) from None
            # what comes after that is not there

    def close(self) -> None:
        """Close the file."""
        self._position = None  # which refers to this object
        self._media.close()

    def __enter__(self) -> VideoDecoder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _shown_from(
    tick: int, frame: av.VideoFrame | None, frames: Iterator[av.VideoFrame]
) -> av.VideoFrame | None:
    """The first frame shown at a tick or later, beginning with one that was decoded already."""
    while frame is None or frame.pts is None or frame.pts < tick:
        frame = next(frames, None)
        if frame is None:
            break
    return frame


# ---------------------------------------------------------------- third-party videos

_SECOND = 1_000_000_000
_LATEST = 2**63 // _SECOND - 1  # seconds
_TRIES = 3


@dataclass(frozen=True, eq=False, slots=True)
class VideoFile:
    """A video track of an mp4 or MOV file without a sidecar, of any known codec.

    Attributes:
        path: The video.
        codec: Name in the registry, or ffmpeg's.
        size: Width and height of its frames, as coded.
        ticks: Presentation times in ticks of the track, int64, shape (frames,), in order.
        keys: Numbers of the frames at which decoding can begin.
        times: Presentation times, nanoseconds, rounded down, int64, shape (frames,).
        is_reordered: Whether frames are coded in another order than they are shown.
        hidden: How many coded frames its edit list hides.
    """

    path: Path
    codec: str
    size: tuple[int, int]
    ticks: NDArray[np.int64]
    keys: NDArray[np.int64]
    times: NDArray[np.int64]
    is_reordered: bool
    hidden: int

    def open(self) -> Media:
        """Open it once more."""
        return Media(self.path, self.size)

    def maker(self, picture_format: str = "rgb24") -> PictureMaker:
        """Makes 8-bit RGB of its frames, by its colour tags; or of another format what they are."""
        return PictureMaker(
            self.path,
            coded_size=self.size,
            picture_format=picture_format,
            picture_size=self.size,
            matrix=None,
            full_range=False,
        )


def read_video_file(path: Path) -> VideoFile:
    """Find out what is in a video without a sidecar.

    Raises:
        VideoError: It cannot be read, or has several video tracks; lists them.
    """
    with closing(Media(path)) as media:
        context = media.track.codec_context
        table, entry = media.table, media.table.entry
        width, height = context.width, context.height
        if entry.codec == "av01" and (entry.width, entry.height) != (width, height):
            # its sequence header tells the largest size: SVT-AV1 16384x8704 with switch frames
            with suppress(FFmpegError, StopIteration):
                frame = next(media.container.decode(media.track))
                width, height = frame.width, frame.height
        if not 1 <= min(width, height) <= max(width, height) <= MAX_SIDE:
            raise VideoError("video-unreadable", path, f"has frames of {width}x{height} pixels")
        name = context.codec.canonical_name
        codec = next((key for key, value in CODECS.items() if value.ffmpeg == name), name)
        ticks, keys = _times_and_keys(table)
        base = media.track.time_base
        if np.abs(ticks[[0, -1]]).max() * base >= _LATEST or base.numerator != 1:
            raise VideoError("video-unreadable", path, "has times beyond 64 bits")
        whole, part = np.divmod(ticks, base.denominator)
        times = whole * _SECOND + part * _SECOND // base.denominator
        return VideoFile(
            path,
            codec,
            (width, height),
            ticks,
            keys,
            times,
            is_reordered=bool(np.any(np.diff(table.order) < 0)),
            hidden=len(table.sizes) - len(ticks),
        )


def _times_and_keys(table: SampleTable) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Presentation ticks of the frames, and numbers of those at which decoding can begin."""
    ticks = table.presentation[table.order]
    # a key frame may be hidden: the next one shown is decoded from it
    return ticks, np.unique(np.searchsorted(ticks, np.sort(table.presentation[table.sync])))


# ---------------------------------------------------------------- their frames as messages

_DECODE = "Give `decode`: its pictures then become images, which `quality` visual keeps small."
_KINDS = "Give an mp4, m4v or mov file; `ffmpeg -i FILE -c copy NEW.mp4` makes one."
_MOST_DELAY = 16  # frames, by which decoding times may precede those of showing


def open_video(path: Path) -> VideoFile:
    """What is in a video.

    Raises:
        SourceError: It cannot be read; says what to do.
    """
    try:
        return read_video_file(path)
    except FormatError as error:
        remedy = "" if "`ffmpeg" in error.problem else _KINDS
        raise SourceError(path, error.problem, remedy) from None


class Clip:
    """Consecutive frames of a video, by number.

    Args:
        file: The video.
        pictures: Pixel format of what its frames are decoded to; empty to copy packets.
        numbers: Those of the frames; None: all.

    Attributes:
        file: The video.
        is_decoded: Whether `body` gives pixels.
        numbers: Those of the frames.
        frame_bytes: Bytes of a frame in the file, on average.
        metadata: What its container says about it.
        left_out: What messages do not hold of it: a phrase -> how many.

    Raises:
        SourceError: It cannot be read, or its packets cannot be messages; says what to do.
    """

    def __init__(
        self, file: VideoFile, *, pictures: str = "", numbers: range | None = None
    ) -> None:
        self.file = file
        self.is_decoded, self._pictures = bool(pictures), pictures
        self.numbers = numbers or range(len(file.ticks))
        self.frame_bytes = file.path.stat().st_size // len(self.file.ticks)
        self._bodies: Iterator[bytes] = iter(())
        self._due = -1
        self._parser: type[StreamParser] = StreamParser
        self._units: list[bytes] = []
        if not pictures:
            self._check_packets()
        with self._reading(), closing(self.file.open()) as media:
            texts = {str(key): str(value) for key, value in media.container.metadata.items()}
            self.metadata = MetadataRecord("video", {**texts, "file": file.path.name})
            others = [one.type for one in media.container.streams if one is not media.track]
            self.left_out = Counter(f"{kind} tracks" for kind in others)
            if file.hidden:
                self.left_out["frames that its edit list hides"] = file.hidden
            self._count_lost_samples(media)
            with suppress(FFmpegError, StopIteration):  # a damaged one is copied, too
                if turned := next(media.container.decode(media.track)).rotation % 360:
                    self.left_out[f"turn by {turned} degrees, which players apply"] = 1

    def _count_lost_samples(self, media: Media) -> None:
        """Count what neither packets nor pictures hold of the pixels."""
        if self.is_decoded and media.track.codec_context.format:
            own = media.track.codec_context.format.components
            if any(one.is_alpha for one in own):
                self.left_out["alpha channels"] = 1
            bits = max(one.bits for one in av.VideoFormat(self._pictures).components)
            if (lost := max(one.bits for one in own) - bits) > 0:
                self.left_out[f"low bits of each sample, which {bits} bits do not hold"] = lost

    def _check_packets(self) -> None:
        """Refuse a video whose packets cannot be messages."""
        file = self.file
        if file.codec not in COPIED_CODECS:
            raise self._refusal(f"is coded as {file.codec}, not {', '.join(COPIED_CODECS)}")
        if file.is_reordered:
            raise self._refusal(f"cannot be copied: {REORDERED}")
        self._parser = CODECS[file.codec].parser
        with self._reading(), closing(file.open()) as media:
            extradata = bytes(media.track.codec_context.extradata or b"")
            self._units = self._parser.units_of(extradata) if extradata else []
        first = self.numbers[0]
        with self._reading(), closing(self._packets(first)) as packets:
            if not next(packets).is_keyframe:
                raise Refused(f"frame {first} is not a key frame, and earlier ones are left out")

    def _refusal(self, problem: str) -> SourceError:
        return SourceError(self.file.path, problem, _DECODE)

    @contextmanager
    def _reading(self) -> Iterator[None]:
        """Errors in the terms of a source."""
        try:
            yield
        except FormatError as error:
            raise SourceError(self.file.path, error.problem) from None
        except Refused as reason:
            raise self._refusal(f"cannot be copied: {reason}") from None
        except (FFmpegError, StopIteration) as error:
            raise_if_scarce(error)
            problem = reason_of(error) if error.args else "it ends early"
            raise SourceError(self.file.path, f"is damaged: {problem}") from None

    def body(self, number: int) -> bytes:
        """A frame: its packet as a message has it, or its pixels.

        Args:
            number: Of the frame in the clip; in order is fastest.

        Raises:
            SourceError: The video is damaged.
        """
        if number != self._due:
            self._bodies = self._bodies_from(self.numbers[number])
        self._due = number + 1
        with self._reading():
            return next(self._bodies)

    def _bodies_from(self, number: int) -> Iterator[bytes]:
        if not self.is_decoded:
            for packet in self._packets(number):
                units = self._units if packet.is_keyframe else []
                yield self._parser.stand_alone(bytes(packet), units)
            return
        file = self.file
        maker = file.maker(self._pictures)
        with VideoDecoder(
            file.path, codec=file.codec, frames=len(file.ticks), maker=maker, file=file
        ) as decoder:
            for _, (pixels,) in decoder.pictures_at(range(number, self.numbers[-1] + 1)):
                yield pixels.tobytes()

    def _packets(self, number: int) -> Generator[Any, None, None]:
        """The packets from a frame to the last one; they are in the order of the frames."""
        ticks = self.file.ticks
        with closing(self.file.open()) as media:
            if number:
                with suppress(FFmpegError):
                    before = int(ticks[max(0, number - _MOST_DELAY)])
                    media.container.seek(before, stream=media.track)
            for packet in media.container.demux(media.track):
                if packet.pts is None or packet.is_discard or packet.pts < ticks[number]:
                    continue
                if packet.pts != ticks[number]:
                    raise Refused(f"the packet of frame {number} is not where its index says")
                yield packet
                number += 1
                if number > self.numbers[-1]:
                    return
