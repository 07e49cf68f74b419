"""Encoding a stream's pictures to one mp4."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
from av.error import FFmpegError

from mp4ds.errors import EncoderRefusedError
from mp4ds.messages.arrangements import Picture
from mp4ds.times import TIMESCALE
from mp4ds.video.codecs import Recipe
from mp4ds.video.media import new_mp4, raise_if_scarce
from mp4ds.video.pixels import PictureConverter, picture_to_frame

_THREADS = Path("/proc/self/task")


@contextmanager
def ordinary_scheduling() -> Iterator[None]:
    """Give threads created or changed in this block the caller's scheduling.

    SVT-AV1, where it may, puts its threads and the one that opens it above everything else on the
    machine (SCHED_FIFO). On a robot, or with other work beside it, that stops the others; and what
    is started from such a thread inherits it. Nothing is done where the system has no such classes.
    """
    if not _THREADS.is_dir():
        yield
        return
    own = os.sched_getscheduler(0), os.sched_getparam(0)
    before = _classes()
    try:
        yield
    finally:
        with suppress(OSError):
            os.sched_setscheduler(0, *own)
        for thread, scheduler in _classes().items():
            if scheduler != before.get(thread, own[0]):
                with suppress(OSError):  # it has ended, or may not be changed
                    os.sched_setscheduler(thread, *own)


def _classes() -> dict[int, int]:
    """Number of the scheduling class of each thread of this process."""
    found = {}
    for thread in _THREADS.iterdir():
        with suppress(OSError):  # it has ended
            found[int(thread.name)] = os.sched_getscheduler(int(thread.name))
    return found


# ---------------------------------------------------------------- encoder

_TIME_BASE = Fraction(1, TIMESCALE)
_MATRICES = {"gbr": 0, "bt709": 1, "smpte170m": 6}  # as H.273 numbers them
_BT709 = 1  # of primaries and transfer characteristics
_LOWEST_RATE, _USUAL_RATE, _HIGHEST_RATE = 0.1, 30.0, 240.0  # Hz, what every encoder takes
_NARROW = 64  # columns
_SLICE_BYTES = 10_000_000  # of samples, chroma counted whole; FFV1 takes some 14 million
_SLICE_COUNTS = sorted({rows * n for rows in range(1, 17) for n in range(rows, 2 * rows + 1)})


class VideoEncoder:
    """One mp4 file being written. A context manager; leaving it completes the file.

    Args:
        path: The file to make.
        recipe: Codec and options.
        picture_format: Pixel format of the pictures.
        width: Columns of a picture.
        height: Rows of a picture.
        gop: Maximum distance of key frames, in frames.
        threads: Threads of the encoder.
        rate: Frames per second, if known; a hint for the encoder's look-ahead.

    Raises:
        EncoderRefusedError: The codec does not take such pictures.
    """

    def __init__(
        self,
        path: Path,
        recipe: Recipe,
        *,
        picture_format: str,
        width: int,
        height: int,
        gop: int,
        threads: int,
        rate: float | None,
    ) -> None:
        self.recipe = recipe
        self.frames = 0
        self._picture_format = picture_format
        # a camera's own YUV keeps its range
        self._converter = PictureConverter(
            source_full_range=recipe.full_range, full_range=recipe.full_range
        )
        self.width, self.height = coded_size(recipe, width, height)
        self.options = {**_options(recipe, self.width, self.height), "g": str(gop)}
        self._container = new_mp4(path)
        try:
            self._open_stream(threads, rate)
        except MemoryError:  # which FFmpegError may be, too: no fault of the pictures
            self._container.close()
            raise
        except (FFmpegError, ValueError) as error:
            self._container.close()
            raise_if_scarce(error)
            raise EncoderRefusedError(
                f"{recipe.encoder} does not take pictures of {width}x{height}"
            ) from None

    def _open_stream(self, threads: int, rate: float | None) -> None:
        # the rate gives the last frame its duration: one of no ticks would be cut off
        hint = min(max(rate or _USUAL_RATE, _LOWEST_RATE), _HIGHEST_RATE)
        stream: Any = self._container.add_stream(
            self.recipe.encoder,
            rate=Fraction(hint).limit_denominator(1000),
            options=dict(self.options),
        )
        stream.time_base = _TIME_BASE
        context = stream.codec_context
        context.time_base = _TIME_BASE
        open_encoder(context, self.recipe, self.width, self.height, threads=threads)
        self._stream = stream

    def write(self, picture: Picture, tick: int) -> None:
        """Encode the next picture.

        Args:
            picture: Of the size and format given above; must not be changed afterwards.
            tick: Presentation time in ticks, greater than the last.

        Raises:
            OSError: It cannot be written.
        """
        frame = picture_to_frame(
            picture,
            self._picture_format,
            self.recipe.pixel_format,
            self._converter,
            full_range=self.recipe.full_range,
        )
        frame.pts = tick
        frame.time_base = _TIME_BASE
        frame.color_range = color_range(self.recipe)
        self._mux(self._encoded(frame))
        self.frames += 1

    def _mux(self, packets: Sequence[Any]) -> None:
        for packet in packets:
            self._container.mux(packet)

    def _encoded(self, frame: av.VideoFrame | None) -> Sequence[Any]:
        try:
            packets: Sequence[Any] = self._stream.encode(frame)
        except FFmpegError as error:
            raise_if_scarce(error)
            raise
        return packets

    def close(self) -> None:
        """Finish the file.

        Raises:
            OSError: It cannot be written.
        """
        try:
            self._mux(self._encoded(None))
        finally:
            self._container.close()

    def abandon(self) -> None:
        """Close the unfinished file; the caller removes it."""
        try:
            self._container.close()
        except (FFmpegError, OSError):
            return

    def __enter__(self) -> VideoEncoder:
        return self

    def __exit__(self, exc_type: type[BaseException] | None, *_: object) -> None:
        if exc_type is None:
            self.close()
        else:
            self.abandon()


def coded_size(recipe: Recipe, width: int, height: int) -> tuple[int, int]:
    """Size of the coded pictures, which is even where chroma is halved."""
    if recipe.pixel_format.startswith("yuv420p"):
        return width + width % 2, height + height % 2
    return width, height


def _options(recipe: Recipe, width: int, height: int) -> Mapping[str, str]:
    """The options of a recipe; FFV1 refuses large slices, so it gets enough of them."""
    if recipe.encoder != "ffv1":
        return recipe.options
    components = av.VideoFormat(recipe.pixel_format, width, height).components
    size = width * height * sum(-(-component.bits // 8) for component in components)
    usual = int(recipe.options["slices"])
    enough = (n for n in _SLICE_COUNTS if n >= usual and size <= n * _SLICE_BYTES)
    return {**recipe.options, "slices": str(next(enough, _SLICE_COUNTS[-1]))}


def color_range(recipe: Recipe) -> int:
    """The number of the range of the samples, in ffmpeg."""
    return 2 if recipe.full_range else 1


def open_encoder(context: Any, recipe: Recipe, width: int, height: int, *, threads: int) -> None:
    """Configure an encoder, whose options are already set, and open it.

    Args:
        context: PyAV's context of the encoder, not open yet.
        recipe: Codec and options.
        width: Columns of the coded pictures.
        height: Rows of the coded pictures.
        threads: Threads of the encoder.

    Raises:
        FFmpegError: The encoder does not take such pictures.
        ValueError: The encoder would damage such pictures.
    """
    if recipe.encoder == "libx265" and width < _NARROW:
        # its look-ahead writes beyond its buffers: seen to crash at 48 columns,
        # and to give wrong pictures up to 32
        raise ValueError("too narrow")
    context.width, context.height = width, height
    context.pix_fmt = recipe.pixel_format
    context.thread_count = threads
    context.colorspace = _MATRICES[recipe.matrix]
    context.color_primaries = _BT709
    context.color_trc = _BT709
    context.color_range = color_range(recipe)
    if recipe.encoder == "libsvtav1":
        # it prints to stderr by itself; errors reach us as return codes
        os.environ.setdefault("SVT_LOG", "0")
        given = context.options.get("svtav1-params")
        parameters = f"{given}:lp={threads}" if given else f"lp={threads}"
        context.options = {**context.options, "svtav1-params": parameters}
    if recipe.encoder == "libx265":
        # it would write its threads and the processor beside the parameter sets
        parameters = f"{context.options['x265-params']}:info=0"
        context.options = {**context.options, "x265-params": parameters}
    with ordinary_scheduling():
        context.open()


def tool_versions() -> Mapping[str, str]:
    """Versions of the tools that write and read the videos."""
    return {
        "av": av.__version__,
        "libavcodec": ".".join(map(str, av.library_versions["libavcodec"])),
    }
