"""Integer nanoseconds: columns of them as text, and the presentation times made from them.

Specified in spec/index.md, "Columns" and "Presentation times".
"""

from __future__ import annotations

import re
import warnings
from array import array
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

TIMESCALE = 1_000_000
"""Ticks per second of every video track: microseconds."""

MAX_GAP_NS = 1_000 * 10**9
"""A longer gap is shown as this long: past 2,147 s the container breaks."""

NS_PER_TICK = 10**9 // TIMESCALE
INT64_MIN, INT64_MAX = -(2**63), 2**63 - 1
_PER_LINE = 32
_MINUS, _ZERO = ord("-"), ord("0")
_TOKENS = re.compile(r"\s*-?[0-9]+(?:\*[0-9]+)?(?:\s+-?[0-9]+(?:\*[0-9]+)?)*\s*")
_COLUMN_BYTES = b"0123456789-* \n"


def encode_column(values: Sequence[int] | NDArray[np.int64]) -> dict[str, int | str]:
    """Encode integers as a start, a step and the residuals of their differences.

    ``value[0] = start`` and ``value[i] = value[i-1] + step + residual[i-1]``.

    Args:
        values: At least one 64-bit integer.

    Returns:
        ``start``, ``step`` and ``values``: residuals as text, 32 a line, where ``r*n``
        stands for n times r.
    """
    column = np.asarray(values, dtype=np.int64)
    with np.errstate(over="ignore"):
        differences = np.diff(column)  # wraps around like the sum that undoes it
        middle = len(differences) // 2
        step = int(np.partition(differences, middle)[middle]) if len(differences) else 0
        residuals = differences - np.int64(step)
    return {"start": int(column[0]), "step": step, "values": _encode_residuals(residuals)}


def _encode_residuals(residuals: NDArray[np.int64]) -> str:
    if not len(residuals):
        return ""
    edges = np.flatnonzero(np.diff(residuals)) + 1
    if len(edges) < len(residuals) // 4 or not len(edges):
        starts = np.concatenate(([0], edges))
        lengths = np.diff(np.concatenate((starts, [len(residuals)])))
        tokens = [
            f"{value}*{count}" if count > 1 else str(value)
            for value, count in zip(residuals[starts].tolist(), lengths.tolist(), strict=True)
        ]
    else:
        tokens = list(map(str, residuals.tolist()))
        if residuals.max() == INT64_MAX or residuals.min() == INT64_MIN:
            tokens[0] += "*1"  # runs are read without saturation
    lines = (" ".join(tokens[i : i + _PER_LINE]) for i in range(0, len(tokens), _PER_LINE))
    return "\n".join(lines) + "\n"


def decode_column(start: int, step: int, text: str, count: int) -> NDArray[np.int64]:
    """Decode what `encode_column` wrote.

    Args:
        start: First value.
        step: Common difference.
        text: Residuals.
        count: Number of values that the column must have, at least one.

    Returns:
        int64 array of shape (count,).

    Raises:
        ValueError: The text is not a column of that length; says why.
    """
    residuals = _decode_residuals(text, count - 1)
    column = np.empty(count, dtype=np.int64)
    column[0] = start
    with np.errstate(over="ignore"):
        residuals += np.int64(step)  # in place: a fresh array costs more than the sum
        np.cumsum(residuals, out=column[1:])
        column[1:] += np.int64(start)
    return column


def _decode_residuals(text: str, count: int) -> NDArray[np.int64]:
    raw = text.encode("ascii", "replace")
    if raw.translate(None, _COLUMN_BYTES):
        raise ValueError("holds something else than integers")
    codes = np.frombuffer(raw, np.uint8)
    signs = codes[:-1] == _MINUS
    signs &= codes[1:] < _ZERO
    if raw.endswith(b"-") or signs.any():
        raise ValueError("holds a sign without digits")
    if b"*" in raw:
        return _decode_runs(text, count)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # numpy warns where it stops early
        try:
            values = np.fromstring(text, dtype=np.int64, sep=" ")
        except (DeprecationWarning, ValueError):
            raise ValueError("holds something else than integers") from None
    if not raw.strip():
        values = values[:0]
    if len(values) != count:
        raise ValueError(f"holds {len(values) + 1} values where {count + 1} are due")
    # numpy saturates what does not fit, without a word
    if len(values) and (values.max() == INT64_MAX or values.min() == INT64_MIN):
        raise ValueError("holds an integer beyond 64 bits")
    return values


def _decode_runs(text: str, count: int) -> NDArray[np.int64]:
    if not _TOKENS.fullmatch(text):
        raise ValueError("holds something else than integers and runs")
    values: list[int] = []
    lengths: list[int] = []
    total = 0
    for token in text.split():
        value, _, length = token.partition("*")
        values.append(int(value))
        lengths.append(int(length or 1))
        if not lengths[-1]:
            raise ValueError("holds a run of no values")
        total += lengths[-1]
        if total > count:
            break
    if total != count:
        raise ValueError(f"does not hold the {count + 1} values that are due")
    if any(not INT64_MIN <= value <= INT64_MAX for value in values):
        raise ValueError("holds an integer beyond 64 bits")
    return np.repeat(np.array(values, dtype=np.int64), lengths)


class PresentationClock:
    """Turns stamps into the strictly increasing ticks that a player shows.

    The first frame is shown at 0. The time between two frames is that of their header stamps
    where these advance by at most `MAX_GAP_NS`, else that of their log times, else one tick.
    """

    def __init__(self) -> None:
        self._stamp: int | None = None
        self._log_time = 0
        self._elapsed = 0
        self._tick = -1

    def tick(self, stamp: int, log_time: int) -> int:
        """Presentation time of the next frame, in ticks of 1 / `TIMESCALE` s."""
        if self._stamp is not None:
            gap = stamp - self._stamp
            if not 0 < gap <= MAX_GAP_NS:
                gap = min(max(log_time - self._log_time, 0), MAX_GAP_NS)
            self._elapsed += gap
        self._stamp, self._log_time = stamp, log_time
        self._tick = max(self._elapsed // NS_PER_TICK, self._tick + 1)
        # clamping up counts as elapsed, so that a burst does not make later frames late twice
        self._elapsed = max(self._elapsed, self._tick * NS_PER_TICK)
        return self._tick


class Int64Column:
    """A growing column that takes eight bytes a value."""

    def __init__(self) -> None:
        self._values = array("q")

    def append(self, value: int) -> None:
        """Append a value.

        Raises:
            OverflowError: It does not fit into 64 bits.
        """
        self._values.append(value)

    def __len__(self) -> int:
        return len(self._values)

    def to_numpy(self) -> NDArray[np.int64]:
        """A view of the values; do not append while it is in use."""
        return (
            np.frombuffer(self._values, dtype=np.int64) if self._values else np.empty(0, np.int64)
        )
