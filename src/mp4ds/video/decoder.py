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
from mp4ds.messages.arrangements import Picture
from mp4ds.video.media import Media, raise_if_scarce
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
        coded_size: Width and height of the coded pictures.
        frames: Expected number of frames.
        picture_format: Pixel format of the pictures wanted.
        picture_size: Width and height of the pictures wanted.
        matrix: Matrix coefficients of the video's colours; None to use the video's own tags.
        full_range: Whether its samples use their full range, unless the video is tagged.
        sequential: Decode with all cores, for reading in order.

    Raises:
        VideoError: ``video-unreadable``, ``codec-mismatch`` or ``geometry-mismatch``.
    """

    def __init__(
        self,
        path: Path,
        *,
        codec: str,
        coded_size: tuple[int, int],
        frames: int,
        picture_format: str,
        picture_size: tuple[int, int],
        matrix: str | None = "bt709",
        full_range: bool = True,
        sequential: bool = True,
    ) -> None:
        self._path = path
        self._frames = frames
        self._maker = PictureMaker(
            path,
            coded_size=coded_size,
            picture_format=picture_format,
            picture_size=picture_size,
            matrix=matrix,
            full_range=full_range,
        )
        self._jpeg = JpegDecoder(coded_size) if codec == "mjpeg" else None
        self._ticks: NDArray[np.int64] | None = None
        self._media = Media(path)
        self._container = self._media.container
        try:
            self._media.check(codec, coded_size)
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
        tick = int(self._presentation_ticks()[index])
        self._seek(tick, index)
        for frame in self._decoded(index):
            if frame.pts is not None and frame.pts >= tick:
                if frame.pts > tick:
                    break
                return self._maker.make(frame, index, scale)
        raise VideoError("decode-failed", self._path, "was not found", frame=index)

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
