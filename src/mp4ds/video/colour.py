"""RGB from luma and halved chroma, in integers: bit-identical on every machine.

See spec/index.md, "Colours". Where `colour.c` was compiled it takes a third to a sixth of
the time that libswscale would; elsewhere numpy takes several times as long.
"""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import av
import numpy as np
from numpy.typing import NDArray

MATRICES = {"bt709": (0.2126, 0.0722), "smpte170m": (0.299, 0.114)}
"""Shares of red and blue in luma, by ffmpeg's name of the matrix."""

BITS = {"yuv420p": 8, "yuvj420p": 8, "yuv420p10le": 10}
"""Bits of a sample, by pixel format."""

_TAPS = (0, 28), (1, 8), (-1, -3), (2, -1)  # distance from the nearest sample, and 32nds
_BAND = 64  # rows that numpy converts at a time: what is between fits the processor's cache


def samples(frame: av.VideoFrame, index: int = 0) -> NDArray[Any]:
    """A plane as a view, uint8 or uint16.

    Returns:
        Shape (rows, columns), or (rows, columns, channels) if the plane has several.
    """
    plane: Any = frame.planes[index]  # a buffer, which its type does not tell
    components = frame.format.components
    dtype = np.uint8 if components[0].bits == 8 else np.dtype("<u2")
    channels = sum(component.plane == index for component in components)
    rows: NDArray[Any] = np.frombuffer(plane, dtype).reshape(plane.height, -1)
    pixels = rows[:, : channels * plane.width]
    return pixels if channels == 1 else pixels.reshape(plane.height, plane.width, channels)


class Factors(NamedTuple):
    """What samples add to red, green and blue, of 2^15 for all; `black` is a sample."""

    black: int
    luma: int
    red: int
    green_u: int
    green_v: int
    blue: int


@cache
def factors(matrix: str, full_range: bool, bits: int) -> Factors:
    """The conversion factors for a kind of video.

    Args:
        matrix: One of `MATRICES`.
        full_range: Whether samples use their full range.
        bits: Of a sample.
    """
    red, blue = MATRICES[matrix]
    green = 1 - red - blue
    top, wider = 2**bits - 1, 2 ** (bits - 8)
    luma = 32 * 255 * 2**bits / (top if full_range else 219 * wider)
    chroma = 64 * 255 * 2**bits / (top if full_range else 224 * wider)
    return Factors(
        0 if full_range else 16 * wider,
        round(luma),
        round(chroma * (1 - red)),
        round(chroma * (1 - blue) * blue / green),
        round(chroma * (1 - red) * red / green),
        round(chroma * (1 - blue)),
    )


def rgb(
    frame: av.VideoFrame,
    matrix: str,
    *,
    full_range: bool,
    is_bgr: bool = False,
    out: NDArray[np.uint8] | None = None,
) -> NDArray[np.uint8]:
    """A frame in RGB.

    Args:
        frame: Of a format in `BITS`.
        matrix: One of `MATRICES`.
        full_range: Whether its samples use their full range.
        is_bgr: Whether blue comes first.
        out: Where to write it; a new array if None.

    Returns:
        Shape (rows, columns, 3).
    """
    bits = BITS[frame.format.name]
    used = factors(matrix, full_range, bits)
    if out is None:
        out = np.empty((frame.height, frame.width, 3), np.uint8)
    library = compiled()
    if library is None or out.strides[1:] != (3, 1):
        _by_numpy(frame, bits, used, out[:, :, ::-1] if is_bgr else out)
        return out
    planes: list[Any] = list(frame.planes)
    work = np.empty(8 * frame.width + 64, np.int16)
    library.mp4ds_rgb(
        (ctypes.c_void_p * 3)(*(plane.buffer_ptr for plane in planes)),
        (ctypes.c_ssize_t * 3)(*(plane.line_size for plane in planes)),
        frame.width,
        frame.height,
        bits,
        (ctypes.c_int16 * 6)(*used),
        is_bgr,
        ctypes.c_void_p(work.ctypes.data),
        ctypes.c_void_p(out.ctypes.data),
        ctypes.c_ssize_t(out.strides[0]),
    )
    return out


@cache
def compiled() -> ctypes.CDLL | None:
    """The compiled loops; None where the package was installed without them."""
    path = Path(__file__).with_name("_colour.so")
    try:
        return ctypes.CDLL(str(path))
    except OSError:
        return None


# ---------------------------------------------------------------- the same by numpy


def _by_numpy(frame: av.VideoFrame, bits: int, used: Factors, out: NDArray[np.uint8]) -> None:
    luma, u, v = (samples(frame, index) for index in range(3))
    levels = np.arange(2**bits, dtype=np.int16) - used.black
    light_of = _product(levels << (15 - bits), used.luma) + 16
    for start in range(0, frame.height, _BAND):
        light = light_of[luma[start : start + _BAND]]
        rows = np.arange(start, start + len(light))
        blue, red = (_interpolated(plane, rows, bits)[:, : frame.width] for plane in (u, v))
        channels = (
            light + _product(red, used.red),
            light - _product(blue, used.green_u) - _product(red, used.green_v),
            light + _product(blue, used.blue),
        )
        for number, channel in enumerate(channels):
            out[start : start + _BAND, :, number] = np.clip(channel >> 5, 0, 255)


def _product(a: NDArray[np.int16], b: int) -> NDArray[np.int16]:
    whole = a * np.int32(b)
    whole += 2**14
    whole >>= 15
    made: NDArray[np.int16] = whole.astype(np.int16)
    return made


def _interpolated(plane: NDArray[Any], rows: NDArray[np.int64], bits: int) -> NDArray[np.int16]:
    """Chroma at all columns of some rows of the picture, around 0, of 15 bits."""
    side = np.where(rows % 2, 1, -1)
    first, last = max(rows[0] // 2 - 2, 0), rows[-1] // 2 + 3
    around = plane[first:last].astype(np.int16) - 2 ** (bits - 1)
    half = np.full((len(rows), plane.shape[1]), 2 ** (bits - 6), np.int16)
    for far, weight in _TAPS:
        places = np.clip(rows // 2 + far * side - first, 0, len(around) - 1)
        half += around[places] * np.int16(weight)
    half >>= bits - 5
    columns = half.shape[1]
    wide = np.pad(half, ((0, 0), (2, 2)), mode="edge")
    whole = np.empty((len(rows), columns, 2), np.int16)
    for odd, side_x in enumerate((-1, 1)):
        whole[:, :, odd] = sum(
            wide[:, 2 + far * side_x : 2 + far * side_x + columns] * np.int16(weight)
            for far, weight in _TAPS
        )
    return whole.reshape(len(rows), -1)


# ---------------------------------------------------------------- planes of a mosaic


_MIDDLE = 128  # luma that leaves room for most chroma, so that the latter shows what it adds


def _padded(mosaic: NDArray[Any], *sides: tuple[int, int]) -> NDArray[Any]:
    """With more rows and columns, which continue the colours; those of a tiny image repeat."""
    is_tiny = min(mosaic.shape) <= max(max(side) for side in sides)
    return np.pad(mosaic, sides, mode="edge" if is_tiny else "reflect")


def mosaic_planes(mosaic: NDArray[np.uint8], pattern: str) -> tuple[NDArray[np.uint8], ...]:
    """Luma and chroma in which each site of a mosaic has its own colour again.

    Chroma is made of what red and blue differ from green at their sites, where green is
    interpolated with the gradient of the site's own colour (Malvar, He, Cutler, 2004). Luma is what
    `rgb` then needs to give the site's colour. Bilinear demosaicing would blur it.

    Args:
        mosaic: Shape (rows, columns), of any size.
        pattern: Colours of its upper left 2 x 2 sites, such as ``rggb``.

    Returns:
        Y, U and V, BT.709 in full range, of even size and half of that.
    """
    whole = _padded(mosaic, (0, mosaic.shape[0] % 2), (0, mosaic.shape[1] % 2))
    height, width = whole.shape
    wide: NDArray[np.int16] = _padded(whole.astype(np.int16), (2, 2), (2, 2))

    # numpy computes several times as fast where the sites of a colour are side by side
    sites = {(y, x): np.ascontiguousarray(wide[y::2, x::2]) for y in (0, 1) for x in (0, 1)}
    rows, columns = height // 2, width // 2

    def beyond_green(colour: str) -> NDArray[np.float32]:
        """What a colour differs from green, in the middle of each 2 x 2 sites, in 128ths.

        Of 8 bits, these are 32,640 at most: 16 bits hold them.
        """
        y, x = divmod(pattern.index(colour), 2)

        def at(down: int, right: int) -> NDArray[np.int16]:
            top, left = 2 + y + down, 2 + x + right
            place = slice(top // 2, top // 2 + rows), slice(left // 2, left // 2 + columns)
            return sites[top % 2, left % 2][place]

        near = at(-1, 0) + at(1, 0) + at(0, -1) + at(0, 1)
        far = at(-2, 0) + at(2, 0) + at(0, -2) + at(0, 2)
        own = np.pad(4 * at(0, 0) + far - 2 * near, 1, mode="edge")  # eighths
        down, right = 2 - 2 * y, 2 - 2 * x

        def part(top: int, left: int) -> NDArray[np.int16]:
            return own[top : top + rows, left : left + columns]

        beside = part(down, 1) + part(1, right)
        found: NDArray[np.int16] = 9 * part(1, 1) + 3 * beside + part(down, right)
        return found.astype(np.float32)

    red, blue = beyond_green("r"), beyond_green("b")
    of_red, of_blue = MATRICES["bt709"]
    frame = av.VideoFrame(width, height, "yuv420p")
    luma, *planes = (samples(frame, index) for index in range(3))
    for plane, own, share, other, its_share in (
        (planes[0], blue, of_blue, red, of_red),
        (planes[1], red, of_red, blue, of_blue),
    ):
        level = own * np.float32(1 / 256) - other * np.float32(its_share / (256 * (1 - share)))
        np.clip(np.rint(level) + 128, 0, 255, out=plane, casting="unsafe")
    luma[...] = _MIDDLE
    colours = rgb(frame, "bt709", full_range=True)
    added = np.empty((height, width), np.uint8)
    for site, colour in enumerate(pattern):
        y, x = divmod(site, 2)
        added[y::2, x::2] = colours[y::2, x::2, "rgb".index(colour)]
    own_light = wide[2:-2, 2:-2] - added + _MIDDLE
    np.clip(own_light, 0, 255, out=luma, casting="unsafe")
    return luma, *planes
