"""4:2:0 of 8 bits in 10 and back, and both out of 16.

An encoder that computes with 10 bits needs fewer for the same picture (benchmarks/recipe.py). The
levels of a sample are the same ones, of 1023 instead of 255 where the full range is used, so that
there and back is what it was.
"""

from __future__ import annotations

from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

TEN_BITS = "yuv420p10le"
"""Pixel format of the videos."""

_EIGHT_BITS, _SIXTEEN_BITS = "yuv420p", "yuv420p16le"
_FULL_RANGE = 2  # in a frame's tags
_LUMA, _CHROMA = 0, 1


def _tables(full_range: bool) -> tuple[list[NDArray[np.uint16]], list[NDArray[np.uint8]]]:
    """Level of 8 bits -> of 10, and back, each of luma and of chroma."""
    eight, ten = np.arange(256), np.arange(1024)
    factor = 1023 / 255 if full_range else 4  # the limited range is 16 to 235, and 64 to 940
    there, back = [], []
    for middle in (0, 128):  # chroma is around the middle
        wide = np.rint(4 * middle + (eight - middle) * factor).clip(0, 1023)
        narrow = np.rint(middle + (ten - 4 * middle) / factor).clip(0, 255)
        there.append(wide.astype(np.uint16))
        back.append(narrow.astype(np.uint8))
    return there, back


_WIDER, _NARROWER = zip(*(_tables(full_range) for full_range in (False, True)), strict=True)


def widened(frame: av.VideoFrame, *, full_range: bool) -> av.VideoFrame:
    """The picture of 4:2:0 and 8 bits in 10.

    Args:
        frame: Of ``yuv420p``.
        full_range: Whether its samples use their full range.
    """
    made = av.VideoFrame(frame.width, frame.height, TEN_BITS)
    for index in range(3):
        table = _WIDER[full_range][_LUMA if index == 0 else _CHROMA]
        samples(made, index)[...] = table[samples(frame, index)]
    return made


def narrowed(frame: av.VideoFrame) -> av.VideoFrame:
    """The picture of 4:2:0 and 10 bits in 8, rounded; its tag tells the range."""
    made = av.VideoFrame(frame.width, frame.height, _EIGHT_BITS)
    is_full = frame.color_range == _FULL_RANGE
    for index in range(3):
        table = _NARROWER[is_full][_LUMA if index == 0 else _CHROMA]
        samples(made, index)[...] = table[samples(frame, index)]
    made.colorspace, made.color_range = frame.colorspace, frame.color_range
    return made


def rounded(frame: av.VideoFrame, pixel_format: str) -> av.VideoFrame:
    """4:2:0 of 16 bits and full range, which are lost, rounded to 8 or 10.

    libswscale puts the middle of chroma that uses the full range between two values. In 8 bits
    that makes all chroma half a level low, a tint of -0.8 levels of red, 0.3 of green, -0.9 of
    blue; in 16 bits it is nothing.

    Args:
        frame: Of ``yuv420p16le``.
        pixel_format: ``yuv420p`` or ``yuv420p10le``.
    """
    made = av.VideoFrame(frame.width, frame.height, pixel_format)
    for index in range(3):
        wide = samples(frame, index)
        if pixel_format == TEN_BITS:  # 65535 / 1023 is 64 * 1024 / 1023, to a millionth
            half = 64 if index else 32  # chroma's middle is 32767.5, and 512
            wide -= wide >> 10
            np.minimum(wide, 65535 - half, out=wide)
            wide += half
            wide >>= 6
        else:
            half = 257 if index else 128  # 257 are a level; chroma's middle is 128
            np.minimum(wide, 65535 - half, out=wide)
            wide += half
            wide //= 257
        samples(made, index)[...] = wide
    made.colorspace, made.color_range = frame.colorspace, frame.color_range
    return made


def samples(frame: av.VideoFrame, index: int) -> NDArray[Any]:
    """A plane as a view of shape (rows, columns), uint8 or uint16."""
    plane: Any = frame.planes[index]  # a buffer, which its type does not tell
    dtype = np.uint8 if frame.format.components[0].bits == 8 else np.dtype("<u2")
    rows: NDArray[Any] = np.frombuffer(plane, dtype).reshape(plane.height, -1)
    return rows[:, : plane.width]
