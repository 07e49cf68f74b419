"""PSNR and SSIM of two planes, as ffmpeg's and libvmaf's filters define them; numpy only."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Plane = NDArray[Any]
"""Samples of one plane, uint8 or uint16, shape (rows, columns)."""

MAX_PSNR = {8: 60.0, 10: 72.0}
"""PSNR of identical planes by bits of a sample, dB: libvmaf's bound, so that it is a number."""

_WEIGHTS = (0.01, 0.03)  # of the constants that keep SSIM's quotients from 0 / 0
_BLOCK = 4  # side of the blocks of which four make a window


def psnr(reference: Plane, decoded: Plane, *, bits: int = 8) -> float:
    """Peak signal-to-noise ratio of a plane, dB, at most `MAX_PSNR`.

    Args:
        reference: The original.
        decoded: Of the same shape and type.
        bits: Of a sample: 8 or 10.
    """
    difference = reference.astype(np.int32) - decoded
    error = float(np.mean(np.square(difference, dtype=np.int64)))
    if not error:
        return MAX_PSNR[bits]
    peak = 2**bits - 1
    return min(10 * float(np.log10(peak * peak / error)), MAX_PSNR[bits])


def ssim(reference: Plane, decoded: Plane, *, bits: int = 8) -> float:
    """Structural similarity of a plane: 1 where both are the same.

    The mean over windows of 8 x 8 samples, each 4 beside the last, as ffmpeg's ssim has it.

    Args:
        reference: The original, at least 8 samples high and wide.
        decoded: Of the same shape and type.
        bits: Of a sample: 8 or 10.
    """
    a, b = (_whole_blocks(plane) for plane in (reference, decoded))
    sum_a, sum_b = _window_sums(a), _window_sums(b)
    squares = _window_sums(a * a + b * b)
    products = _window_sums(a * b)
    count = (2 * _BLOCK) ** 2
    peak = 2**bits - 1
    # of sums over a window instead of means: by its count, or its count and count - 1
    c1 = int((_WEIGHTS[0] * peak) ** 2 * count + 0.5)
    c2 = int((_WEIGHTS[1] * peak) ** 2 * count * (count - 1) + 0.5)
    sums = sum_a * sum_a + sum_b * sum_b
    variances = count * squares - sums
    covariance = count * products - sum_a * sum_b
    luminance = (2.0 * sum_a * sum_b + c1) / (sums + c1)
    structure = (2.0 * covariance + c2) / (variances + c2)
    return float(np.mean(luminance * structure))


def _whole_blocks(plane: Plane) -> NDArray[np.int64]:
    """As integers that hold squares, without what makes no block."""
    rows, columns = (side // _BLOCK * _BLOCK for side in plane.shape)
    if min(rows, columns) < 2 * _BLOCK:
        raise ValueError(f"planes of {plane.shape[1]}x{plane.shape[0]} samples have no window")
    return plane[:rows, :columns].astype(np.int64)


def _window_sums(values: NDArray[np.int64]) -> NDArray[np.int64]:
    rows, columns = values.shape
    blocks = values.reshape(rows // _BLOCK, _BLOCK, columns // _BLOCK, _BLOCK).sum(axis=(1, 3))
    pairs = blocks[:, :-1] + blocks[:, 1:]
    found: NDArray[np.int64] = pairs[:-1] + pairs[1:]
    return found
