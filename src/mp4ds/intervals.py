"""Times between frames, and the frames that are missing by them; numpy only."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Integers = NDArray[np.int64]
Floats = NDArray[np.float64]

_LOST_FROM = 1.5  # usual intervals without a frame


def differences(later: Integers, earlier: Integers) -> Floats:
    """Differences of times in nanoseconds; exact below 2^53, and right in size beyond 2^63."""
    with np.errstate(over="ignore"):
        exact = later - earlier
    rough: Floats = later.astype(np.float64) - earlier.astype(np.float64)
    return np.where(np.abs(rough) < 2.0**62, exact.astype(np.float64), rough)


def nearest(times: Integers, wanted: Integers) -> Integers:
    """Places of the times that are nearest to others.

    Of two equally near ones it is the earlier, of several equal ones the first.

    Args:
        times: Increasing or equal, at least one.
        wanted: What is looked for, of any shape.
    """
    after = np.minimum(np.searchsorted(times, wanted), len(times) - 1)
    before = np.maximum(after - 1, 0)
    is_later = np.abs(differences(times[after], wanted)) < np.abs(
        differences(wanted, times[before])
    )
    return np.searchsorted(times, times[np.where(is_later, after, before)])


def intervals(times: Integers) -> Floats:
    """Nanoseconds from each frame to the next, shape (frames - 1,)."""
    return differences(times[1:], times[:-1])


def usual_interval(steps: Floats) -> float | None:
    """Median of the intervals that advance, nanoseconds; None where none does."""
    advancing = steps[steps > 0]
    return float(np.median(advancing)) if len(advancing) else None


def lost_frames(steps: Floats) -> Integers:
    """How many frames seem to be missing in each interval.

    An interval of more than 1.5 times the median is taken for as many as fit into it, rounded.
    Of it is taken off first what the intervals right before and after are shorter than the
    median: a frame that came late, or early, is not a lost one.
    """
    usual = usual_interval(steps)
    if usual is None:
        return np.zeros(len(steps), np.int64)
    short = np.pad(np.clip(usual - steps, 0, usual), 1)
    spread = steps - short[:-2] - short[2:]
    missing = np.floor(spread / usual + 0.5) - 1
    missing[spread <= _LOST_FROM * usual] = 0
    whole: Integers = np.minimum(missing, 2.0**53).astype(np.int64)
    return whole
