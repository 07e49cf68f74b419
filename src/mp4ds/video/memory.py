"""How much memory an encoder takes.

The constants are upper estimates of what benchmarks/encoder_memory.py measures. Encoders keep
pictures with a border, as many as they look ahead and refer back to, and for some of their
threads more. Longer groups of pictures than the look-ahead change nothing, shorter ones only
lessen it; so the estimates hold for every ``--gop``.
"""

from __future__ import annotations

import os

import av

from mp4ds.video.codecs import Recipe
from mp4ds.video.depths import TEN_BITS

_MB = 1_000_000
# code, tables and the mp4's index, which do not grow with the pictures, but differ by some MB
# between machines, which map more or less of a library at once
_BASE = 8 * _MB
_BORDER = 160  # columns, and rows, that borders and rounding add to a picture
_PICTURE = 9  # bytes of a pixel: a picture and its conversions, where all are made yuv420p

_SVT_LEVELS = 6
_SVT_SMALL = 1_500_000  # pixels from which SVT-AV1's preset 8 looks ahead no further than its 9
# by the last preset: MB, and bytes of a pixel, at each level of parallelism; all that it
# allocates, of which so many pictures are in use as there are processors to work on them
_SVT: tuple[tuple[int, tuple[tuple[int, int], ...]], ...] = (
    (2, ((4, 300), (42, 370), (106, 560), (172, 790), (200, 1090), (200, 1940))),
    (5, ((4, 290), (20, 365), (56, 500), (86, 720), (124, 920), (138, 1660))),
    (7, ((16, 240), (28, 310), (44, 410), (64, 590), (86, 770), (140, 1405))),
    (13, ((4, 150), (10, 195), (24, 305), (36, 430), (36, 555), (64, 890))),
)
_SVT_TEN_BITS = 1.25  # times the bytes of a pixel with 10 bits

# preset: frames looked ahead (with a lossy rate control), and referred to
_X264_PRESETS = {
    "ultrafast": (0, 1),
    "superfast": (0, 1),
    "veryfast": (10, 1),
    "faster": (20, 2),
    "fast": (30, 2),
    "medium": (40, 3),
    "slow": (50, 5),
    "slower": (60, 8),
    "veryslow": (60, 16),
}
_X264_TUNED_REFERENCES = 3  # of the lossless recipes' own tuning
# pixel format: bytes of a pixel for each reference, and besides them without loss
_X264_FRAMES = {
    "gray": (4.2, 7.5),
    "gray10le": (8.4, 18.0),
    "yuv420p": (4.7, 13.0),
    "yuv422p": (5.2, 17.0),
    "yuv444p": (12.5, 28.0),
    "rgb24": (12.5, 28.0),
    "bgr24": (12.5, 28.0),
}
_X264_AHEAD = 3.7  # bytes of a pixel for each frame looked ahead, all of them yuv420p
_X264_THREAD = 0.9

_X265_AHEAD = {
    "ultrafast": 5,
    "superfast": 10,
    "veryfast": 15,
    "faster": 15,
    "fast": 15,
    "medium": 20,
    "slow": 25,
    "slower": 40,
    "veryslow": 40,
}
_X265_FRAMES, _X265_FRAME_AHEAD, _X265_THREAD = 55.0, 4.6, 12.5  # bytes of a pixel
_X265_WORKER = 6 * _MB  # of a worker, of which there is one for each processor
_X265_HIGH = 1.4  # times as much with more than 8 bits

# not measured: a driver's own, and 32 pictures where a device has no memory but the machine's
_HARDWARE, _HARDWARE_PIXEL = 400 * _MB, 64.0  # bytes of a pixel

_FFV1_SAMPLE, _FFV1_BIT = 12.0, 2.3  # bytes of a sample, and more for each of its bits


def encoder_bytes(recipe: Recipe, width: int, height: int, threads: int) -> int:
    """Upper estimate of the peak of resident memory that a `VideoEncoder` takes.

    Above the interpreter, with the pictures that are on their way into the encoder.

    Args:
        recipe: Codec and options.
        width: Columns of a picture.
        height: Rows of a picture.
        threads: Threads of the encoder.

    Returns:
        Bytes.
    """
    threads = max(1, threads)
    pixels = width * height
    bordered = (width + _BORDER) * (height + _BORDER)
    needed: float
    if recipe.hardware:
        needed = _HARDWARE + _HARDWARE_PIXEL * pixels
    elif recipe.encoder == "libsvtav1":
        needed = _svt_bytes(recipe, pixels, bordered, threads)
    elif recipe.encoder == "libx265":
        needed = _x265_bytes(recipe, bordered, threads)
    elif recipe.encoder == "ffv1":
        needed = _ffv1_bytes(recipe, pixels)
    else:
        needed = _x264_bytes(recipe, bordered, threads)
    return _BASE + int(needed)


def svt_level(threads: int) -> int:
    """SVT-AV1's level of parallelism where so many threads are asked for, 1 to 6.

    The encoder is given the number of threads, and takes what is above its highest level for
    that one.
    """
    return min(max(1, threads), _SVT_LEVELS)


def _svt_bytes(recipe: Recipe, pixels: int, bordered: int, threads: int) -> float:
    preset = int(recipe.options["preset"])
    if preset == 8 and pixels < _SVT_SMALL:
        preset = 7
    levels = next(levels for last, levels in _SVT if preset <= last)
    megabytes, each = levels[svt_level(threads) - 1]
    times = _SVT_TEN_BITS if recipe.pixel_format == TEN_BITS else 1
    return megabytes * _MB + (times * each + _PICTURE) * bordered


def _x264_bytes(recipe: Recipe, bordered: int, threads: int) -> float:
    ahead, references = _X264_PRESETS[recipe.options["preset"]]
    reference, others = _X264_FRAMES[recipe.pixel_format]
    if recipe.lossless:
        ahead = 0  # without a rate control, nothing is looked for
        if "x264-params" in recipe.options:
            references = _X264_TUNED_REFERENCES
    each = references * reference + ahead * _X264_AHEAD + threads * _X264_THREAD + others
    return each * bordered


def _x265_bytes(recipe: Recipe, bordered: int, threads: int) -> float:
    ahead = _X265_AHEAD[recipe.options["preset"]]
    each = _X265_FRAMES + ahead * _X265_FRAME_AHEAD + threads * _X265_THREAD
    if recipe.pixel_format.endswith("le"):
        each *= _X265_HIGH
    return (os.cpu_count() or 1) * _X265_WORKER + each * bordered


def _ffv1_bytes(recipe: Recipe, pixels: int) -> float:
    pixel_format = av.VideoFormat(recipe.pixel_format)
    bits = pixel_format.bits_per_pixel
    samples = bits / pixel_format.components[0].bits
    return (samples * _FFV1_SAMPLE + bits * _FFV1_BIT) * pixels
