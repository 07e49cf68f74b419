"""Encoding a stream's pictures to one mp4, and trying which layout and codec is the best."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import chain, count
from operator import itemgetter
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.error import FFmpegError

from mp4ds.errors import EncoderRefusedError, OptionError
from mp4ds.messages import png
from mp4ds.messages.encodings import MAX_SIDE, Encoding, LayoutParameters, Picture, Pixels
from mp4ds.messages.layouts import LAYOUTS, Layout, bind, fit
from mp4ds.video.codecs import ARCHIVE, TRAINING, Recipe, codecs_to_try, lossless_codecs, recipe_for
from mp4ds.video.colour import samples
from mp4ds.video.decoder import open_packet_decoder
from mp4ds.video.media import TIME_BASE, Mp4Writer, new_mp4, raise_if_scarce, rate_hint
from mp4ds.video.pixels import PictureConverter, PictureMaker, picture_to_frame

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

_MATRICES = {"gbr": 0, "bt709": 1, "smpte170m": 6}  # as H.273 numbers them
_BT709 = 1  # of primaries and transfer characteristics
_NARROW = 64  # columns
_NARROW_AV1 = 64  # rows or columns; seen to hang up to 20, not from 32 on
_TINY_AV1 = 8  # rows and columns
_SLICE_BYTES = 10_000_000  # of samples, chroma counted whole; FFV1 takes some 14 million
_SLICE_COUNTS = sorted({rows * n for rows in range(1, 17) for n in range(rows, 2 * rows + 1)})


class VideoEncoder(Mp4Writer):
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
        coded: Called with each packet, in order.

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
        coded: Callable[[bytes], None] | None = None,
    ) -> None:
        self.recipe = recipe
        self._coded = coded
        self.frames = 0
        self._frame = _framer(recipe, picture_format)
        self.width, self.height = coded_size(recipe, width, height)
        self.options = {**_options(recipe, self.width, self.height), "g": str(gop)}
        self._container = new_mp4(path)
        try:
            with _refused(recipe, width, height):
                self._open_stream(threads, rate)
        except BaseException:
            self._container.close()
            raise

    def _open_stream(self, threads: int, rate: float | None) -> None:
        if self.recipe.codec == "png":
            size = {"width": self.width, "height": self.height}
            self._stream = self._container.add_mux_stream("png", rate=rate_hint(rate), **size)
            self._stream.time_base = TIME_BASE
            return
        stream: Any = self._container.add_stream(
            self.recipe.encoder,
            rate=rate_hint(rate),  # a last frame of no ticks would be cut off
            options=dict(self.options),
        )
        stream.time_base = TIME_BASE
        context = stream.codec_context
        context.time_base = TIME_BASE
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
        frame = self._frame(picture, tick)
        frame.time_base = TIME_BASE
        self._mux(self._encoded(frame))
        self.frames += 1

    def _mux(self, packets: Sequence[Any]) -> None:
        for packet in packets:
            if self._coded:
                self._coded(bytes(packet))
            self._container.mux(packet)

    def _encoded(self, frame: av.VideoFrame | None) -> Sequence[Any]:
        if self.recipe.codec == "png":
            return [_png_packet(frame, self._stream)] if frame else []
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

    @property
    def configuration(self) -> bytes:
        """What a decoder needs besides the packets."""
        return bytes(self._stream.codec_context.extradata or b"")


def _framer(recipe: Recipe, picture_format: str) -> Callable[[Picture, int], av.VideoFrame]:
    """Makes the frames that the encoder of a recipe takes, of pictures and their times."""
    is_full = recipe.full_range  # a camera's own YUV keeps its range
    converter = PictureConverter(source_full_range=is_full, full_range=is_full)

    def frame_of(picture: Picture, pts: int) -> av.VideoFrame:
        frame = picture_to_frame(
            picture, picture_format, recipe.pixel_format, converter, full_range=is_full
        )
        frame.pts, frame.color_range = pts, color_range(recipe)
        return frame

    return frame_of


@contextmanager
def _refused(recipe: Recipe, width: int, height: int) -> Iterator[None]:
    """Raise `EncoderRefusedError` where the encoder does not take pictures of a size."""
    try:
        yield
    except MemoryError:  # which FFmpegError may be, too: no fault of the pictures
        raise
    except (FFmpegError, ValueError) as error:
        raise_if_scarce(error)
        raise EncoderRefusedError(
            f"{recipe.encoder} does not take pictures of {width}x{height}"
        ) from None


def _png_packet(frame: av.VideoFrame, stream: Any = None) -> Any:
    """The PNG file of a frame: ffmpeg's encoder would look for repetitions in the noise."""
    packet: Any = av.Packet(png.noise_file(samples(frame)))
    packet.pts = packet.dts = frame.pts
    packet.is_keyframe = True
    if stream is not None:
        packet.stream, packet.time_base = stream, TIME_BASE
    return packet


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
    if recipe.encoder == "libsvtav1" and (
        min(width, height) < 4 or max(width, height) <= _TINY_AV1
    ):
        # SVT-AV1 4.2 has no minimum: it runs out of memory up to 2, and writes beyond its buffers
        # where no side has more than 8
        raise ValueError("too small")
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
        if min(width, height) < _NARROW_AV1:
            threads = 1  # with several, it never ends on some sizes, such as 70x20
        # it keeps room, and pictures, for one level more than it uses by itself; told so, it waits
        # forever in groups of two with presets up to 4. The last one of equal names counts
        levels = "hierarchical-levels=4" if int(context.options["g"]) > 2 else None
        parameters = ":".join(filter(None, (levels, given, f"lp={threads}")))
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


# ---------------------------------------------------------------- trials

NEAR = 1.02
"""An earlier candidate is preferred if it is larger by no more than this factor."""

_LARGEST = 800 * 600  # pixels of an image that are tried; of a larger one its middle


@dataclass(frozen=True, slots=True)
class Coding:
    """How the pixels of a stream are encoded.

    Attributes:
        layout: How they become pictures; it may refuse later images because of its parameters.
        recipe: Codec and options.
        gop: Most frames from one key frame to the next.
        bytes_per_frame: Estimated size of a coded image; 0 if it was not tried.
    """

    layout: Layout
    recipe: Recipe
    gop: int
    bytes_per_frame: float = 0.0

    def with_crf(self, crf: int) -> Coding:
        """The same at another crf."""
        options = {**self.recipe.options, "crf": str(crf)}
        return replace(self, recipe=replace(self.recipe, options=options))

    @property
    def crf(self) -> int:
        """The constant rate factor of a lossy one."""
        return int(self.recipe.options["crf"])

    @property
    def text(self) -> str:
        """All of it in words: the same for the same coding, in every process."""
        layout, recipe = self.layout, self.recipe
        values, options = layout.parameters.values, dict(recipe.options)
        return f"{layout.name} {values} {recipe.encoder} {options} gop {self.gop}"


def bytes_per_frame(sizes: Sequence[int], gop: int) -> float:
    """Mean bytes per frame of a long video with a key frame every `gop` frames.

    Args:
        sizes: Bytes of consecutive frames, of which only the first is a key frame: the others
            represent all others of a group of pictures.
        gop: The distance of key frames.
    """
    return (sizes[0] + (gop - 1) * float(np.mean(sizes[1:] or sizes))) / gop


def predictor(
    coding: Coding, size: tuple[int, int], configuration: bytes
) -> Callable[[bytes | None], Iterator[Pixels]]:
    """What a view shows of each image, decoded from the packets of its encoder.

    Args:
        coding: How the view is encoded.
        size: Columns and rows of the images.
        configuration: Of the encoder.

    Returns:
        Gives the images that are complete with one more packet; with None, those still due at the
        end.
    """
    recipe, layout = coding.recipe, coding.layout
    picture_size = layout.picture_size(*size)
    coded = coded_size(recipe, *picture_size)
    maker = PictureMaker(
        Path(),
        coded_size=coded,
        picture_format=layout.pixel_format,
        picture_size=picture_size,
        matrix=recipe.matrix,
        full_range=recipe.full_range,
    )
    decoder = open_packet_decoder(recipe.codec, coded, configuration)

    def images(packet: bytes | None) -> Iterator[Pixels]:
        for frame in decoder.decode(av.Packet(packet) if packet is not None else None):
            pixels: Pixels = np.empty(layout.encoding.shape(*size), layout.encoding.dtype)
            layout.to_pixels(maker.make(frame, 0), pixels)
            yield pixels

    return images


def encode_on_trial(
    pictures: Sequence[Picture], recipe: Recipe, *, picture_format: str, threads: int
) -> tuple[list[int], list[bytes], bytes]:
    """Encode pictures as one group of pictures.

    Args:
        pictures: Consecutive ones, at least one, all of one size.
        recipe: Codec and options.
        picture_format: Pixel format of the pictures.
        threads: Threads of the encoder.

    Returns:
        Bytes of each picture, the packets, and what a decoder needs besides these.

    Raises:
        EncoderRefusedError: The codec does not take such pictures.
    """
    rows, columns = pictures[0][0].shape[:2]
    frames = map(_framer(recipe, picture_format), pictures, count())
    configuration = b""
    if recipe.codec == "png":
        packets = list(map(_png_packet, frames))
    else:
        context: Any = av.CodecContext.create(recipe.encoder, "w")
        context.options = {**recipe.options, "g": str(len(pictures))}
        context.time_base, context.framerate = Fraction(1, 30), Fraction(30)
        with _refused(recipe, columns, rows):
            open_encoder(context, recipe, *coded_size(recipe, columns, rows), threads=threads)
            packets = [packet for f in chain(frames, [None]) for packet in context.encode(f)]
        configuration = bytes(context.extradata or b"")
    sizes = [0] * len(pictures)
    for packet in packets:
        sizes[packet.pts] += packet.size
    return sizes, list(map(bytes, packets)), configuration


_UNFILTERED = "enable-tf=0"  # SVT-AV1's option against temporal filtering


def predict_on_trial(
    samples: Sequence[Pixels], coding: Coding, threads: int
) -> tuple[list[int], list[Pixels]]:
    """Bytes of each frame of a view, and what it shows.

    Args:
        samples: Pixels of consecutive images, at least one.
        coding: How it is encoded.
        threads: Threads of the encoder.

    Raises:
        EncoderRefusedError: The codec does not take such pictures.
    """
    layout, recipe = coding.layout, coding.recipe
    if recipe.encoder == "libsvtav1":
        # which would make one picture of so few frames, and cost less than it does in a long video
        given = recipe.options.get("svtav1-params")
        parameters = f"{given}:{_UNFILTERED}" if given else _UNFILTERED
        recipe = replace(recipe, options={**recipe.options, "svtav1-params": parameters})
    pictures = list(map(layout.to_picture, samples))
    sizes, packets, configuration = encode_on_trial(
        pictures, recipe, picture_format=layout.pixel_format, threads=threads
    )
    rows, columns = samples[0].shape[:2]
    predicted = predictor(coding, (columns, int(rows / layout.encoding.rows)), configuration)
    return sizes, [pixels for packet in [*packets, None] for pixels in predicted(packet)]


_DISTANCES = (1, 2, 3, 5)
"""Of key frames, where reading is to be fast."""
_FASTER = 1.15
"""How much larger videos may become by that."""


def choose(
    samples: Sequence[Pixels],
    encoding: Encoding,
    *,
    codec: str | None,
    preset: str | None,
    gop: int,
    threads: int,
    purpose: str | None = None,
    differences: Sequence[tuple[Layout, Sequence[Picture]]] = (),
    h264_gop: int | None = None,
) -> Coding:
    """The best lossless layout, recipe and distance of key frames, found by trying each.

    Args:
        samples: Pixels of consecutive images, at least one; about six are enough.
        encoding: Of the images.
        codec: The only codec to try, or None for all.
        preset: The encoder's preset, or None for the default.
        gop: Most frames from one key frame to the next.
        threads: Threads of the encoder.
        purpose: What the video is for.
        differences: To what a view shows of the samples, by their layouts; to be coded instead.
        h264_gop: `gop` for H.264, whose frames all need the one before; None: the same.

    Returns:
        The first, in the order of the encoding's layouts and their codecs, within 2 % of the
        smallest; for ``archive``, the smallest. For ``training``, with as many key frames as make
        it at most 15 % larger.

    Raises:
        OptionError: The codec has no form for any layout of the encoding.
        EncoderRefusedError: No codec takes such pictures.
    """
    crops, share = _crops(samples, encoding)
    is_noise = bool(differences)
    tried: list[tuple[Coding, list[int]]] = []
    refusals: list[Exception] = []
    candidates = differences or (
        (layout, list(map(layout.to_picture, crops))) for layout in _candidates(samples, encoding)
    )
    for layout, pictures in candidates:
        picture_format = layout.pixel_format
        for name in codecs_to_try(picture_format, is_noise) if codec is None else [codec]:
            try:
                recipe = recipe_for(
                    picture_format, lossless=True, codec=name, preset=preset, is_noise=is_noise
                )
                sizes, *_ = encode_on_trial(
                    pictures, recipe, picture_format=picture_format, threads=threads
                )
            except (OptionError, EncoderRefusedError) as error:
                refusals.append(error)
            else:
                most = (h264_gop if name == "h264" else None) or gop
                size = bytes_per_frame(sizes, most) / share
                tried.append((Coding(layout, recipe, most, size), sizes))
    if not tried:
        # that an encoder refuses the size says more than that another has no such format
        raise next((e for e in refusals if isinstance(e, EncoderRefusedError)), refusals[0])
    smallest = min(choice.bytes_per_frame for choice, _ in tried)
    for distance in _DISTANCES if purpose == TRAINING else ():
        costs = [(bytes_per_frame(sizes, distance) / share, choice) for choice, sizes in tried]
        size, best = min(costs, key=itemgetter(0))
        if size <= _FASTER * smallest and distance < gop:
            return replace(best, gop=distance, bytes_per_frame=size)
    near = 1.0 if purpose == ARCHIVE else NEAR
    return next(choice for choice, _ in tried if choice.bytes_per_frame <= near * smallest)


def difference_layouts(view: Layout) -> list[Layout]:
    """The layouts that hold all differences of images to those of a view.

    Args:
        view: Layout of the view.

    Returns:
        In order of preference, with the general one.
    """
    encoding, of = view.encoding, view.parameters
    known = {
        "bits": of.bits,
        "shift": of.shift,
        "low": None if of.bits is None else of.bits - 8,  # two planes of 8 bits, as PNG files have
        "alpha": None if of.alpha is None else 128,  # that of no difference
    }
    found = []
    for name in encoding.exact:
        needed = {key: known.get(key) for key in LAYOUTS[name].parameters}
        if None not in needed.values():
            with suppress(ValueError):  # for so many bits
                found.append(bind(name, encoding, LayoutParameters.model_validate(needed)))
    return found


def choose_predicted(
    samples: Sequence[Pixels], layouts: Sequence[Layout], view: Coding, most: float, **options: Any
) -> tuple[Coding, float]:
    """The best coding of the differences of images to what a view shows.

    They are mostly noise. PNG files, in which nothing is predicted, are about as small as any other
    codec makes it, and decode in a tenth of the time.

    Args:
        samples: As for `choose`.
        layouts: Of the differences, at least one.
        view: How the view is encoded.
        most: Bytes of an image, with its view, that PNG files may take though others take fewer.
        **options: As for `choose`.

    Returns:
        As `choose`, where `bytes_per_frame` includes the view; and bytes of a frame of the view.

    Raises:
        OptionError: As for `choose`.
        EncoderRefusedError: No codec takes such pictures.
    """
    encoding = view.layout.encoding
    crops, share = _crops(samples, encoding)
    sizes, shown = predict_on_trial(crops, view, options["threads"])
    predictions = [(pixels, view.layout.used_bits) for pixels in shown]
    differences = [
        (layout, [layout.to_picture(*pair) for pair in zip(crops, predictions, strict=True)])
        for layout in layouts
    ]
    of_view = bytes_per_frame(sizes, view.gop)

    def tried(**changes: Any) -> Coding:
        asked = {**options, **changes}
        found = choose(crops, encoding, differences=differences, **asked)
        return replace(found, bytes_per_frame=(found.bytes_per_frame + of_view) / share)

    beside = of_view / share
    can_be_png = any("png" in lossless_codecs(layout.pixel_format) for layout in layouts)
    if options["codec"] is not None or not can_be_png:
        return tried(), beside
    is_archive = options["purpose"] == ARCHIVE
    simple = tried(codec="png")
    if not is_archive and simple.bytes_per_frame <= most:
        return simple, beside
    best = tried()
    near = 1.0 if is_archive else NEAR
    is_near = simple.bytes_per_frame <= near * best.bytes_per_frame
    return (simple if is_near else best), beside


def _candidates(samples: Sequence[Pixels], encoding: Encoding) -> list[Layout]:
    """The layouts that can hold the samples.

    That of what colours were made of, as it has the fewest samples; byte planes only if nothing
    else can.
    """
    found = []
    for name in encoding.exact:
        layout = fit(name, encoding, samples)
        rows, columns = samples[0].shape[:2]
        size = columns, int(rows / encoding.rows)
        if layout is None or max(layout.picture_size(*size)) > MAX_SIDE:
            continue
        if layout.is_source:
            return [layout]
        found.append(layout)
    return [layout for layout in found if layout.name != "bytes"] or found


def _crops(samples: Sequence[Pixels], encoding: Encoding) -> tuple[Sequence[Pixels], float]:
    """The middle of large images, at even coordinates, and its share of their pixels.

    Vertically stacked planes are left whole.
    """
    rows, columns = samples[0].shape[:2]
    if encoding.rows != 1 or rows * columns <= _LARGEST:
        return samples, 1.0
    scale = float(np.sqrt(_LARGEST / (rows * columns)))
    height, width = (max(2, int(side * scale) // 2 * 2) for side in (rows, columns))
    top, left = ((side - kept) // 4 * 2 for side, kept in ((rows, height), (columns, width)))
    middle = slice(top, top + height), slice(left, left + width)
    return [pixels[middle] for pixels in samples], height * width / (rows * columns)
