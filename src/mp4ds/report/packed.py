"""Columns of integers as text for the page: differences, in as few bytes as they need."""

from __future__ import annotations

import base64

import numpy as np
from numpy.typing import NDArray

_BITS = 7
_MOST_BYTES = 10


def pack_column(values: NDArray[np.int64]) -> dict[str, str]:
    """A column of 64-bit integers, exactly.

    ``value[0] = start`` and ``value[i] = value[i-1] + step + residual[i-1]``, modulo 2^64. A
    residual is stored as an unsigned number, twice its value or, if it is negative, twice its
    absolute value less one, in groups of seven bits, the lowest first.

    Args:
        values: At least one.

    Returns:
        ``start`` and ``step`` in decimal digits, since a number of a page has 53 bits, and
        ``values`` in base64.
    """
    with np.errstate(over="ignore"):
        steps = np.diff(values)
        step = np.partition(steps, len(steps) // 2)[len(steps) // 2] if len(steps) else np.int64(0)
        residuals = steps - step
        unsigned = (residuals << 1 ^ residuals >> 63).view(np.uint64)
    return {
        "start": str(int(values[0])),
        "step": str(int(step)),
        "values": base64.b64encode(_varints(unsigned)).decode(),
    }


def _varints(values: NDArray[np.uint64]) -> bytes:
    lengths = np.ones(len(values), np.int64)
    for count in range(1, _MOST_BYTES):
        lengths += values >= np.uint64(1 << _BITS * count)
    starts = np.cumsum(lengths) - lengths
    out = np.zeros(int(lengths.sum()), np.uint8)
    for count in range(int(lengths.max(initial=0))):
        has = lengths > count
        groups = (values[has] >> np.uint64(_BITS * count)) & np.uint64(0x7F)
        more = np.where(lengths[has] > count + 1, 0x80, 0)
        out[starts[has] + count] = groups.astype(np.uint8) | more.astype(np.uint8)
    return out.tobytes()


def pack_floats(values: NDArray[np.float32]) -> str:
    """Numbers of 32 bits, little-endian, in base64; NaN where there is none."""
    return base64.b64encode(np.asarray(values, "<f4").tobytes()).decode()
