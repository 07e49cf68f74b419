"""An mp4 opened with PyAV, and shortages of resources that ffmpeg reports badly."""

from __future__ import annotations

import errno
import os
from abc import ABC, abstractmethod
from contextlib import suppress
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import av
from av.error import FFmpegError
from av.stream import Disposition

from mp4ds.errors import Mp4dsError, Refused, RemoteError, VideoError
from mp4ds.files.urls import remote
from mp4ds.messages.encodings import MAX_SIDE
from mp4ds.times import TIMESCALE
from mp4ds.video.codecs import AV_VERSION, CODECS, check_pyav
from mp4ds.video.mp4 import EditedError, SampleTable, sample_table_of, why_unreadable

_ANEW = "-c:v libx264 -qp 0 -bf 0 -fps_mode passthrough -enc_time_base 1:1000000"
"""How ffmpeg encodes what is shown without loss, in packets that can be copied."""

_Writer = TypeVar("_Writer", bound="Mp4Writer")

_FILES = (errno.EMFILE, errno.ENFILE)
_ENOUGH_BYTES = 32 * 2**20


def raise_if_scarce(error: BaseException | None = None) -> None:
    """Raise if the system lacks a resource, which may be why ffmpeg failed or damaged a frame.

    Ffmpeg says that it has no memory of forged sizes, too, and of memory that is short it says all
    kinds of things. So it is tried.

    Raises:
        MemoryError: There is no memory left, or no thread may be started.
        OSError: Too many files are open.
    """
    number = getattr(error, "errno", None)
    if number in _FILES:
        raise OSError(number, os.strerror(number), getattr(error, "filename", None)) from None
    if number == errno.EAGAIN and "avcodec_open2" in str(error):  # of a thread
        raise MemoryError from None
    try:
        bytearray(_ENOUGH_BYTES)
    except MemoryError:
        raise MemoryError from None


# ---------------------------------------------------------------- media


def _described(track: Any) -> str:
    """Codec and size of a track."""
    context = track.codec_context
    return f"{context.name} {context.width}x{context.height}" if context else "an unknown codec"


# names and comments need not be UTF-8; PyAV 19 takes them as they are
_ANY_METADATA: dict[str, Any] = {"metadata_errors": "ignore"} if AV_VERSION < (19,) else {}


class Media:
    """An mp4 open for reading, with its one video track; `close` also closes its file.

    Args:
        path: The video.
        size: Width and height of its frames, if they should be known; see `most_pixels`.

    Attributes:
        container: PyAV's.
        track: The video track, with a codec that ffmpeg knows.

    Raises:
        VideoError: ``file-missing`` or ``video-unreadable``.
        RemoteError: It is at a URL, and cannot be read there.
    """

    def __init__(self, path: Path, size: tuple[int, int] | None = None) -> None:
        if not path.is_file():
            raise VideoError("file-missing", path, "does not exist")
        self._path = path
        self._file: _Source | None = None
        try:
            if remote(path):
                self._file = _Source(path.open("rb"))
            source = self._file or str(path.absolute())
            self.container: Any = open_input(source, size=size)
        except (FFmpegError, OSError) as error:
            self._close_file()
            raise_if_scarce(error)
            problem = why_unreadable(path) or f"cannot be read: {error.strerror or error}"
            raise VideoError("video-unreadable", path, problem) from None
        except BaseException:
            self._close_file()
            raise
        try:
            self.track = self._only_track()
            self.track.codec_context.options = most_pixels(size)
        except Mp4dsError:
            self.close()
            raise

    def _only_track(self) -> Any:
        # a picture of the cover comes as one more track
        streams = self.container.streams.video
        tracks = [one for one in streams if not one.disposition & Disposition.attached_pic]
        if len(tracks) != 1:
            problem = f"has {len(tracks)} video tracks, not one"
            if tracks:
                listed = ", ".join(map(_described, tracks))
                problem += f" ({listed}); `ffmpeg -i FILE -map 0:v:0 -c copy NEW.mp4` takes one out"
            problem = why_unreadable(self._path) or problem
            raise VideoError("video-unreadable", self._path, problem)
        (track,) = tracks
        if track.codec_context is None or track.codec_context.codec is None:
            problem = why_unreadable(self._path) or "has a video track with an unknown codec"
            raise VideoError("video-unreadable", self._path, problem)
        return track

    @cached_property
    def table(self) -> SampleTable:
        """The index of the track.

        Raises:
            VideoError: ``video-unreadable``.
        """
        try:
            return sample_table_of(self._path)
        except Refused as reason:
            how = _ANEW if isinstance(reason, EditedError) else "-c copy"
            problem = f"cannot be read: {reason}; `ffmpeg -i FILE {how} NEW.mp4` writes it anew"
            raise VideoError("video-unreadable", self._path, problem) from None
        except OSError as error:
            raise_if_scarce(error)
            problem = f"cannot be read: {error}"
            raise VideoError("video-unreadable", self._path, problem) from None

    def check(self, codec: str, coded_size: tuple[int, int] | None) -> None:
        """Compare the header with what a sidecar says.

        Args:
            codec: Name in the registry, or ffmpeg's.
            coded_size: Expected width and height, if known.

        Raises:
            VideoError: ``codec-mismatch`` or ``geometry-mismatch``.
        """
        context = self.track.codec_context
        found = context.codec.canonical_name
        if found != (CODECS[codec].ffmpeg if codec in CODECS else codec):
            raise VideoError(
                "codec-mismatch", self._path, f"is coded as {found}, but its sidecar says {codec}"
            )
        if coded_size is not None and (context.width, context.height) != coded_size:
            found, told = f"{context.width}x{context.height}", "{}x{}".format(*coded_size)
            problem = f"has {found} pixels, but its sidecar says {told}"
            raise VideoError("geometry-mismatch", self._path, problem)

    def close(self) -> None:
        """Close it."""
        self.container.close()
        self._close_file()

    def _close_file(self) -> None:
        if self._file:
            self._file.close()


def most_pixels(size: tuple[int, int] | None) -> dict[str, str]:
    """Options by which ffmpeg makes no frame that is much larger, whatever its packet says.

    A PNG file of 2 MB may say that it has 2 GB of pixels, and ffmpeg decodes one to open a video.

    Args:
        size: Width and height that a sidecar tells; None: those of the largest image.
    """
    width, height = size or (MAX_SIDE, MAX_SIDE)
    slack = 4 if size else 1  # so that the size of a slightly larger one is told
    return {"max_pixels": str(slack * (width + 64) * (height + 64))}


def open_input(source: Any, container: str = "mp4", *, size: tuple[int, int] | None = None) -> Any:
    """Open a video for reading with PyAV.

    Args:
        source: Path, absolute: ffmpeg takes a relative name with a colon for an address; or a file.
        container: ffmpeg's name of the demuxer. No other is tried, whatever the bytes look like.
        size: See `most_pixels`.

    Raises:
        FFmpegError, OSError: It cannot be read as that.
    """
    return av.open(source, "r", format=container, options=most_pixels(size), **_ANY_METADATA)


def pixel_format_of(context: Any) -> str:
    """The pixel format of a video's codec context, in ffmpeg; empty if unknown.

    PyAV 17, which Python 3.10 has, crashes where it is asked for `pix_fmt` then.
    """
    return str(context.format.name) if context.format else ""


class _Source:
    """A remote file for PyAV, which raises the first error of a file and prints later ones."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._has_failed = False
        self.seek = stream.seek
        self.tell = stream.tell
        self.close = stream.close

    def read(self, size: int = -1) -> bytes:
        """Read up to `size` bytes; none after an error."""
        if self._has_failed:
            return b""
        try:
            return self._stream.read(size)
        except RemoteError:
            self._has_failed = True
            raise


TIME_BASE = Fraction(1, TIMESCALE)
"""Of the tracks of all mp4 files that are written."""

_LOWEST_RATE, _USUAL_RATE, _HIGHEST_RATE = 0.1, 30.0, 240.0  # Hz, what every encoder takes


def rate_hint(rate: float | None) -> Fraction:
    """The frame rate to give to a new track: it becomes the duration of its last frame.

    Args:
        rate: Frames per second, if known.
    """
    hint = min(max(rate or _USUAL_RATE, _LOWEST_RATE), _HIGHEST_RATE)
    return Fraction(hint).limit_denominator(1000)


def new_mp4(path: Path) -> Any:
    """An mp4 to write to, its times in ticks of the track.

    Args:
        path: The file to make, when the first packet comes.

    Raises:
        Mp4dsError: As for `check_pyav`.
    """
    check_pyav()
    options = {
        "video_track_timescale": str(TIMESCALE),
        "movie_timescale": str(TIMESCALE),
        "avoid_negative_ts": "disabled",  # an edit list hides what comes before 0
    }
    # ffmpeg takes a relative name with a colon for an address
    return av.open(str(path.absolute()), "w", format="mp4", options=options)


class Mp4Writer(ABC):
    """One mp4 being written. A context manager; leaving it completes the file."""

    _container: Any = None

    @abstractmethod
    def close(self) -> None:
        """Finish the file."""

    def abandon(self) -> None:
        """Close the unfinished file; the caller removes it."""
        if self._container is not None:
            with suppress(FFmpegError, OSError):
                self._container.close()

    def __enter__(self: _Writer) -> _Writer:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            self.close()
        else:
            self.abandon()
