"""Decoding a stream's pictures from its mp4."""

from __future__ import annotations

import errno
import io
import os
import struct
from collections.abc import Callable, Iterable, Iterator
from contextlib import nullcontext, suppress
from functools import cached_property
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.error import FFmpegError, InvalidDataError
from numpy.typing import NDArray

from mp4ds.errors import Refused, VideoError, reason_of
from mp4ds.messages.encodings import MAX_SIDE, Picture
from mp4ds.video.codecs import CODECS
from mp4ds.video.media import Media, raise_if_scarce
from mp4ds.video.mp4 import read_sample_table
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

    def frames(self, packets: Iterable[Any]) -> Iterator[av.VideoFrame]:
        """The frames of packets, in order."""
        for packet in packets:
            yield from self.decode(packet)

    def flush_buffers(self) -> None:
        """There is nothing to forget."""


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
    ) -> None:
        self._path = path
        self._frames = frames
        self._maker = maker
        self._jpeg = JpegDecoder(maker.coded_size) if codec == "mjpeg" else None
        self._ticks: NDArray[np.int64] | None = None
        self._media = Media(path)
        self._container = self._media.container
        try:
            self._media.check(codec, maker.coded_size)
            self._stream = self._media.track
            self._stream.thread_type = "AUTO" if sequential else "SLICE"
            if not sequential:
                self._stream.thread_count = 1  # threads inherited over a fork would never end
        except BaseException:
            self.close()
            raise

    @property
    def coded_frames(self) -> int:
        """Frames in the file's index, without those hidden by an edit list at the beginning."""
        return len(self._stream.index_entries) - self._media.hidden

    def pictures(self, scale: Scale | None = None) -> Iterator[Picture]:
        """All pictures in order, as views that are valid until the next one is requested.

        Args:
            scale: See `PictureMaker.make`.

        Raises:
            VideoError: ``decode-failed`` with the frame's number, or ``frame-count`` when the
                video ends early or continues.
        """
        self._seek(0, 0)
        number = 0
        for frame in self._decoded(0):
            if number == self._frames:
                raise VideoError("frame-count", self._path, f"has more than {self._frames} frames")
            yield self._maker.make(frame, number, scale)
            number += 1
        if number != self._frames:
            raise VideoError(
                "frame-count", self._path, f"ends after {number} of {self._frames} frames"
            )

    def pictures_at(
        self, indices: Iterable[int], scale: Scale | None = None
    ) -> Iterator[tuple[int, Picture]]:
        """Some pictures, each with its frame's number, as views that hold until the next one.

        Decoding begins at the key frame before the first one. Frames in between are decoded, and
        left out at key frames that are far enough ahead; they are not made into pictures.

        Args:
            indices: 0 <= index < frames, increasing. The next one is asked for only when the
                picture before was done with.
            scale: See `PictureMaker.make`.

        Raises:
            VideoError: ``decode-failed`` with the frame's number, or ``frame-count``.
        """
        for index, frame in self._chosen(indices, self._decoded):
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
        for index, frame in self._chosen(indices, lambda _: self._decodable(), is_strict=False):
            yield index, None if frame is None else self._maker.make(frame, index, scale)

    def _chosen(
        self,
        indices: Iterable[int],
        decode: Callable[[int], Iterator[av.VideoFrame]],
        *,
        is_strict: bool = True,
    ) -> Iterator[tuple[int, av.VideoFrame | None]]:
        """The frames with some numbers; None for one that the decoder does not output.

        Args:
            indices: The numbers.
            decode: Decodes from the key frame with a number on.
            is_strict: Whether it is an error if a key frame cannot be sought.
        """
        ticks, keys = self._presentation_ticks(), self._key_numbers
        in_flight = min(os.cpu_count() or 1, _MOST_THREADS) + 1
        frames: Iterator[av.VideoFrame] = iter(())
        frame: av.VideoFrame | None = None
        due = -in_flight - 1
        for index in indices:
            at = int(np.searchsorted(keys, index, side="right"))
            key = int(keys[at - 1]) if at else 0
            if key > due + in_flight:  # the decoder has begun the frames up to there
                with nullcontext() if is_strict else suppress(VideoError):
                    self._seek(int(ticks[index]), index)
                frames, frame = decode(key), None
            tick = int(ticks[index])
            while frame is None or frame.pts is None or frame.pts < tick:
                frame = next(frames, None)
                if frame is None:
                    break
            due = index + 1
            yield index, frame if frame is not None and frame.pts == tick else None

    def picture(self, index: int, scale: Scale | None = None) -> Picture:
        """One picture, by seeking to the key frame before it.

        Args:
            index: 0 <= index < frames.
            scale: See `PictureMaker.make`.

        Raises:
            VideoError: It cannot be decoded.
        """
        return next(self.pictures_at([index], scale))[1]

    def _seek(self, tick: int, index: int) -> None:
        try:
            self._container.seek(tick, stream=self._stream)
        except (FFmpegError, OSError) as error:
            raise_if_scarce(error)
            problem = f"cannot be reached: {reason_of(error)}"
            raise VideoError("decode-failed", self._path, problem, frame=index) from None

    def _presentation_ticks(self) -> NDArray[np.int64]:
        if self._ticks is None:
            # without B-frames the index's decoding times are the presentation times
            ticks = [entry.timestamp for entry in self._stream.index_entries][self._media.hidden :]
            if len(ticks) != self._frames:
                raise VideoError(
                    "frame-count", self._path, f"has {len(ticks)} frames, not {self._frames}"
                )
            self._ticks = np.sort(np.array(ticks, dtype=np.int64))
        return self._ticks

    @cached_property
    def _key_numbers(self) -> NDArray[np.int64]:
        keys = [entry.is_keyframe for entry in self._stream.index_entries]
        return np.flatnonzero(keys[self._media.hidden :])

    def _decoded(self, first: int) -> Iterator[av.VideoFrame]:
        number = first
        try:
            for frame in self._frames_from_here():
                yield frame
                number += 1
        except _ERRORS as error:
            raise_if_scarce(error)
            problem = f"cannot be decoded: {reason_of(error)}"
            raise VideoError("decode-failed", self._path, problem, frame=number) from None

    def _frames_from_here(self) -> Iterator[av.VideoFrame]:
        if self._jpeg is None:
            yield from self._container.decode(self._stream)
        else:
            yield from self._jpeg.frames(self._container.demux(self._stream))

    def _decodable(self) -> Iterator[av.VideoFrame]:
        try:
            for packet in self._container.demux(self._stream):
                try:
                    frames = self._jpeg.decode(packet) if self._jpeg else packet.decode()
                except FFmpegError as error:
                    raise_if_scarce(error)
                    continue
                yield from (frame for frame in frames if not frame.is_corrupt)
        except _ERRORS as error:
            raise_if_scarce(error)  # what comes after that is not there

    def close(self) -> None:
        """Close the file."""
        self._media.close()

    def __enter__(self) -> VideoDecoder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


# ---------------------------------------------------------------- third-party videos

_SECOND = 1_000_000_000
_LATEST = 2**63 // _SECOND - 1  # seconds
_TRIES = 3


class VideoFile:
    """A video track of an mp4, of any known codec. A context manager.

    Args:
        path: The video.
        track: Which video track, from 0; None: there is only one.

    Attributes:
        codec: Name in the registry, or ffmpeg's.
        size: Width and height of its frames, as coded.
        times: Presentation times, nanoseconds, rounded down, int64, shape (frames,), in order.

    Raises:
        VideoError: It cannot be read, or has several video tracks; lists them.
        OptionError: It has no such track.
    """

    def __init__(self, path: Path, track: int | None = None) -> None:
        self._path = path
        self._track = track
        self._frames: Iterator[av.VideoFrame] = iter(())
        self._last: int | None = None
        self._media = Media(path, track, "; `mp4ds.open` takes the number of one as `track`")
        try:
            self._stream = self._media.track
            context: Any = self._stream.codec_context
            self.size: tuple[int, int] = context.width, context.height
            name = context.codec.canonical_name
            self.codec = next((key for key, value in CODECS.items() if value.ffmpeg == name), name)
            if not 1 <= min(self.size) <= max(self.size) <= MAX_SIDE:
                width, height = self.size
                raise VideoError("video-unreadable", path, f"has frames of {width}x{height} pixels")
            self._stream.thread_count = 1  # threads inherited over a fork would never end
            self._maker = maker_of(path, self.size)
            self._ticks, self._keys = self._read_ticks()
            if not len(self._ticks):
                raise VideoError("video-unreadable", path, "has no frames")
            self.times = self._nanoseconds()
        except BaseException:
            self.close()
            raise

    def _read_ticks(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Presentation ticks of the frames, and those of the key frames."""
        try:
            with self._path.open("rb") as file:
                size = self._path.stat().st_size
                table = read_sample_table(file, size, str(self._path), self._track)
        except Refused:
            return self._read_packets()
        except OSError as error:
            raise VideoError("video-unreadable", self._path, f"cannot be read: {error}") from None
        ticks = table.presentation[table.order]
        return ticks, np.sort(table.presentation[table.sync])

    def _read_packets(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Like `_read_ticks`, from the packets, all of which are read."""
        ticks, keys = [], []
        try:
            for packet in self._media.container.demux(self._stream):
                if packet.pts is None:
                    continue
                if packet.is_keyframe:
                    keys.append(packet.pts)
                if not packet.is_discard:
                    ticks.append(packet.pts)
        except (FFmpegError, OSError) as error:
            raise_if_scarce(error)
            raise VideoError("video-unreadable", self._path, f"cannot be read: {error}") from None
        return np.sort(np.array(ticks, np.int64)), np.sort(np.array(keys, np.int64))

    def _nanoseconds(self) -> NDArray[np.int64]:
        base = self._stream.time_base
        latest = np.abs(self._ticks[[0, -1]]).max()
        if latest * base >= _LATEST or base.numerator != 1:
            raise VideoError("video-unreadable", self._path, "has times beyond 64 bits")
        whole, part = np.divmod(self._ticks, base.denominator)
        times: NDArray[np.int64] = whole * _SECOND + part * _SECOND // base.denominator
        return times

    def picture(self, index: int, scale: Scale | None = None) -> Picture:
        """One frame as 8-bit RGB; the next ones continue decoding, others seek to their key frame.

        Args:
            index: 0 <= index < frames.
            scale: See `PictureMaker.make`.

        Returns:
            One array of shape (H, W, 3), valid until the next one is requested.

        Raises:
            VideoError: It cannot be decoded.
        """
        tick = int(self._ticks[index])
        group = self._group(tick)
        if (
            self._last is None
            or index <= self._last
            or group != self._group(self._tick(self._last))
        ):
            self._seek(group, index)
        self._last = None
        frame = self._next_at(tick, index)
        for _ in range(_TRIES):
            if frame is not None or group < 0:
                break
            # sought by decoding time, which may have led to a later key frame
            group -= 1
            self._seek(group, index)
            frame = self._next_at(tick, index)
        if frame is None:
            raise VideoError("decode-failed", self._path, "was not found", frame=index)
        picture = self._maker.make(frame, index, scale)
        self._last = index
        return picture

    def _tick(self, index: int) -> int:
        return int(self._ticks[index])

    def _group(self, tick: int) -> int:
        """Number of the last key frame shown by then, or -1."""
        return int(np.searchsorted(self._keys, tick, side="right")) - 1

    def _seek(self, group: int, index: int) -> None:
        container = self._media.container
        try:
            container.seek(
                int(self._keys[group] if group >= 0 else self._ticks[0]), stream=self._stream
            )
            if self.codec == "mjpeg":
                self._frames = JpegDecoder(self.size).frames(container.demux(self._stream))
            else:
                self._frames = container.decode(self._stream)
        except (FFmpegError, OSError) as error:
            raise_if_scarce(error)
            problem = f"cannot be reached: {reason_of(error)}"
            raise VideoError("decode-failed", self._path, problem, frame=index) from None

    def _next_at(self, tick: int, index: int) -> av.VideoFrame | None:
        try:
            for frame in self._frames:
                if frame.pts is not None and frame.pts >= tick:
                    return frame if frame.pts == tick else None
        except (FFmpegError, OSError) as error:
            raise_if_scarce(error)
            problem = f"cannot be decoded: {reason_of(error)}"
            raise VideoError("decode-failed", self._path, problem, frame=index) from None
        return None

    def close(self) -> None:
        """Close the file."""
        self._media.close()

    def __enter__(self) -> VideoFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def maker_of(path: Path, size: tuple[int, int]) -> PictureMaker:
    """Makes 8-bit RGB of the frames of a third-party video, by its colour tags."""
    return PictureMaker(
        path,
        coded_size=size,
        picture_format="rgb24",
        picture_size=size,
        matrix=None,
        full_range=False,
    )
