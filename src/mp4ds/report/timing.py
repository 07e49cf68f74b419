"""What the times of frames tell: jitter, frames lost and repeated, offsets; numpy only."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mp4ds.intervals import (
    Floats,
    Integers,
    differences,
    intervals,
    lost_frames,
    nearest,
    usual_interval,
)

_MS = 1e6  # nanoseconds
_WIDER = 2  # times the span of the log times, beyond which stamps are of several clocks
_SLACK_NS = 10 * 10**9
_DAY_NS = 86_400 * 10**9
_NO_STAMPS, _OTHER_CLOCK = "no header stamps", "stamps of another clock"


@dataclass(frozen=True)
class Timing:
    """The times of one camera in figures. Milliseconds, None where there are too few frames.

    Attributes:
        frames: Number of frames.
        rate_hz: Mean rate by the median interval.
        median_ms: Median of the intervals between stamps that advance.
        jitter_ms: Standard deviation of the intervals.
        p99_ms: 99th percentile of how far an interval is from the median.
        longest_ms: Longest interval.
        lost: Frames missing by the stamps: see `lost_frames`.
        gaps: Places where they are missing.
        repeated: Frames with the stamp of the one before.
        backward: Frames with an earlier stamp than the one before.
        seq_missing: Numbers that the header's `seq` leaves out; None where there is no `seq`.
        delay_median_ms: Median of log time minus stamp.
        delay_least_ms: Least of them.
        delay_most_ms: Most of them.
    """

    frames: int
    rate_hz: float | None
    median_ms: float | None
    jitter_ms: float | None
    p99_ms: float | None
    longest_ms: float | None
    lost: int
    gaps: int
    repeated: int
    backward: int
    seq_missing: int | None
    delay_median_ms: float
    delay_least_ms: float
    delay_most_ms: float


def timing_of(stamps: Integers, log_times: Integers, seq: Integers | None) -> Timing:
    """The figures of one camera.

    Args:
        stamps: Header stamps, nanoseconds, at least one.
        log_times: Log times, nanoseconds.
        seq: Numbers in the headers, or None.
    """
    steps = intervals(stamps)
    usual = usual_interval(steps)
    lost = lost_frames(steps)
    delays = differences(log_times, stamps) / _MS
    return Timing(
        frames=len(stamps),
        rate_hz=1e9 / usual if usual else None,
        median_ms=usual / _MS if usual else None,
        jitter_ms=float(steps.std()) / _MS if len(steps) else None,
        p99_ms=float(np.percentile(np.abs(steps - usual), 99)) / _MS if usual else None,
        longest_ms=float(steps.max()) / _MS if len(steps) else None,
        lost=sum(lost[lost > 0].tolist()),
        gaps=int((lost > 0).sum()),
        repeated=int((steps == 0).sum()),
        backward=int((steps < 0).sum()),
        seq_missing=None if seq is None else _missing_numbers(seq),
        delay_median_ms=float(np.median(delays)),
        delay_least_ms=float(delays.min()),
        delay_most_ms=float(delays.max()),
    )


def _missing_numbers(seq: Integers) -> int:
    steps = np.diff(seq)
    return sum((steps[steps > 1] - 1).tolist())


def nearest_offsets(stamps: Integers, reference: Integers) -> Floats:
    """How much later each frame is than the reference's frame that is nearest, nanoseconds.

    Args:
        stamps: Of a camera.
        reference: Of the camera that it is compared with, at least one; in any order.
    """
    ordered = np.sort(reference)
    return differences(stamps, ordered[nearest(ordered, stamps)])


def untimed(cameras: Sequence[Mapping[str, Integers]]) -> list[str]:
    """Why the stamps of each camera cannot be compared with those of the others; empty: they can.

    Args:
        cameras: Columns ``stamp`` and ``log_time`` of each.
    """
    have_stamps = [bool(columns["stamp"].any()) for columns in cameras]
    is_far = [
        abs(float(np.median(differences(columns["log_time"], columns["stamp"])))) > _DAY_NS
        for columns in cameras
    ]
    # where all are far from the record times, as in a simulation, they are near each other
    pairs = list(zip(have_stamps, is_far, strict=True))
    has_near = (True, False) in pairs
    return [
        _NO_STAMPS if not has else _OTHER_CLOCK if far and has_near else "" for has, far in pairs
    ]


def axis_of(cameras: Sequence[Mapping[str, Integers]]) -> str:
    """By which times all cameras are shown together: ``stamp`` or ``log_time``.

    Stamps, where those of every camera mostly advance, and they are all of one clock.

    Args:
        cameras: Columns ``stamp`` and ``log_time`` of each.
    """
    for columns in cameras:
        steps = intervals(columns["stamp"])
        if 2 * int((steps > 0).sum()) < len(steps):
            return "log_time"
    spans = {name: _span([columns[name] for columns in cameras]) for name in ("stamp", "log_time")}
    is_one_clock = spans["stamp"] <= _WIDER * spans["log_time"] + _SLACK_NS
    return "stamp" if is_one_clock else "log_time"


def _span(columns: Sequence[Integers]) -> int:
    if not columns:
        return 0
    return max(int(c.max()) for c in columns) - min(int(c.min()) for c in columns)
