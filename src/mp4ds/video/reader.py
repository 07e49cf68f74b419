"""Frames of a video by number, as cheaply as its codec allows; third-party videos."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

import av
import numpy as np
from av.error import FFmpegError
from numpy.typing import NDArray

from mp4ds.errors import Refused, VideoError, reason_of
from mp4ds.messages.arrangements import Picture
from mp4ds.messages.coded import UnknownStructure
from mp4ds.messages.encodings import MAX_SIDE, Pixels
from mp4ds.video.access import FrameAccess
from mp4ds.video.codecs import CODECS
from mp4ds.video.decoder import JpegDecoder, VideoDecoder
from mp4ds.video.media import Media, raise_if_scarce
from mp4ds.video.mp4 import read_sample_table
from mp4ds.video.pixels import PictureMaker, Scale
from mp4ds.video.references import RecordedReferences


class Seeking(Protocol):
    """A decoder that reaches a frame by decoding from the key frame before it."""

    def picture(self, index: int, scale: Scale | None = None) -> Picture:
        """The picture of a frame; see `PictureMaker.make`."""

    def close(self) -> None:
        """Close the file."""


class FrameReader:
    """Gives frames by number; others are decoded only if necessary.

    A context manager. One thread at a time may use it, in the process that opened it.

    Args:
        open_access: Opens the decoder of single frames and their references; None if there is none.
        open_decoder: Opens the decoder from key frames, used where that is impossible.

    Raises:
        VideoError: Neither can be opened; the error of the latter.
    """

    def __init__(
        self, open_access: Callable[[], FrameAccess] | None, open_decoder: Callable[[], Seeking]
    ) -> None:
        self._open_decoder = open_decoder
        self._access: FrameAccess | None = None
        self._decoder: Seeking | None = None
        if open_access is not None:
            # ffmpeg reads more, and tells what it does not
            with suppress(UnknownStructure, VideoError, OSError):
                self._access = open_access()
        if self._access is None:
            self._decoder = open_decoder()

    def pictures_of(
        self,
        numbers: Sequence[int],
        scale: Scale | None = None,
        outs: Mapping[int, Pixels] | None = None,
    ) -> Iterator[tuple[int, Picture]]:
        """Pictures of some frames, each with its number.

        Args:
            numbers: 0 <= number < frames, increasing.
            scale: See `PictureMaker.make`.
            outs: Its `out`, by frame; it may stay unused.

        Yields:
            Views that are valid until the next one is requested.

        Raises:
            VideoError: One cannot be decoded.
        """
        done = 0
        if self._access is not None:
            try:
                for pair in self._access.pictures_of(numbers, scale, outs):
                    done += 1
                    yield pair
                return
            except UnknownStructure:
                self._access.close()
                self._access = None
        if self._decoder is None:
            self._decoder = self._open_decoder()
        for number in numbers[done:]:
            yield number, self._decoder.picture(number, scale)

    def close(self) -> None:
        """Close the file."""
        for part in (self._access, self._decoder):
            if part is not None:
                part.close()

    def __enter__(self) -> FrameReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def open_frames(
    path: Path,
    *,
    codec: str,
    coded_size: tuple[int, int],
    frames: int,
    picture_format: str,
    picture_size: tuple[int, int],
    matrix: str | None,
    full_range: bool,
    references: RecordedReferences | None = None,
) -> FrameReader:
    """The frames of a video for which all arguments of `VideoDecoder` are known.

    `references` is what the sidecar says about the references of its frames.

    Raises:
        VideoError: As for `VideoDecoder`.
        FormatError: ``references-invalid``: they do not fit the video.
    """

    def open_access() -> FrameAccess:
        maker = PictureMaker(
            path,
            coded_size=coded_size,
            picture_format=picture_format,
            picture_size=picture_size,
            matrix=matrix,
            full_range=full_range,
        )
        return FrameAccess(path, codec=codec, frames=frames, maker=maker, references=references)

    def open_decoder() -> VideoDecoder:
        return VideoDecoder(
            path,
            codec=codec,
            coded_size=coded_size,
            frames=frames,
            picture_format=picture_format,
            picture_size=picture_size,
            matrix=matrix,
            full_range=full_range,
            sequential=False,
        )

    return FrameReader(open_access, open_decoder)


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
            self._maker = _maker_of(path, self.size)
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


def open_file_frames(
    path: Path, *, codec: str, size: tuple[int, int], frames: int, track: int | None
) -> FrameReader:
    """The frames of a third-party video by number, as 8-bit RGB.

    Args:
        path: The video.
        codec: As in `VideoFile`.
        size: As in `VideoFile`.
        frames: How many there are.
        track: As in `VideoFile`.

    Raises:
        VideoError: It cannot be read.
    """
    return FrameReader(
        lambda: FrameAccess(
            path, codec=codec, frames=frames, maker=_maker_of(path, size), track=track
        ),
        lambda: VideoFile(path, track),
    )


def _maker_of(path: Path, size: tuple[int, int]) -> PictureMaker:
    return PictureMaker(
        path,
        coded_size=size,
        picture_format="rgb24",
        picture_size=size,
        matrix=None,
        full_range=False,
    )
