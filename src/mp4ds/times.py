"""Integer nanoseconds: columns as text, presentation times, intervals, cuts, and matching cameras.

numpy only (spec/index.md, "Columns" and "Presentation times").
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from operator import index as as_integer
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import FrameNotFoundError, OptionError

TIMESCALE = 1_000_000
"""Ticks per second of every video track: microseconds."""

MAX_GAP_NS = 1_000 * 10**9
"""Longer gaps are shown with this length: past 2,147 s the container breaks."""

_NS = 10**9
NS_PER_TICK = _NS // TIMESCALE
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
        ``start``, ``step`` and ``values``: residuals as text, 32 per line, where ``r*n``
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
        count: Required number of values, at least one.

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
        raise ValueError("holds something other than integers")
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
            raise ValueError("holds something other than integers") from None
    if not raw.strip():
        values = values[:0]
    if len(values) != count:
        raise ValueError(f"holds {len(values) + 1} values, not {count + 1}")
    # numpy silently saturates what does not fit
    if len(values) and (values.max() == INT64_MAX or values.min() == INT64_MIN):
        raise ValueError("holds an integer beyond 64 bits")
    return values


def _decode_runs(text: str, count: int) -> NDArray[np.int64]:
    if not _TOKENS.fullmatch(text):
        raise ValueError("holds something other than integers and runs")
    tokens = [token.partition("*") for token in text.split()]
    values, lengths = [int(value) for value, _, _ in tokens], [int(n or 1) for _, _, n in tokens]
    if 0 in lengths:
        raise ValueError("holds a run of no values")
    if sum(lengths) != count:
        raise ValueError(f"does not hold {count + 1} values")
    if any(not INT64_MIN <= value <= INT64_MAX for value in values):
        raise ValueError("holds an integer beyond 64 bits")
    return np.repeat(np.array(values, dtype=np.int64), lengths)


class PresentationClock:
    """Turns stamps into strictly increasing ticks for players.

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
        # clamping up counts as elapsed, so that a burst does not delay later frames twice
        self._elapsed = max(self._elapsed, self._tick * NS_PER_TICK)
        return self._tick


# ---------------------------------------------------------------- intervals

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
    """Indices of the nearest times.

    Of two equally near ones it is the earlier, of several equal ones the first.

    Args:
        times: Sorted, at least one.
        wanted: The times to look for, of any shape.
    """
    after = np.minimum(np.searchsorted(times, wanted), len(times) - 1)
    before = np.maximum(after - 1, 0)
    is_later = np.abs(differences(times[after], wanted)) < np.abs(
        differences(wanted, times[before])
    )
    found: Integers = np.searchsorted(times, times[np.where(is_later, after, before)])
    return found


def constant_rate(columns: Sequence[Integers], fps: int, path: Path | str) -> Integers:
    """Times at a constant rate, from when all columns have begun until one ends.

    Args:
        columns: Sorted times of cameras, nanoseconds, at least one each.
        fps: Times per second.
        path: The dataset, for the error.

    Raises:
        OptionError: The columns do not overlap.
    """
    start, end = max(int(times[0]) for times in columns), min(int(times[-1]) for times in columns)
    if end < start:
        raise OptionError(f"{path}: its cameras do not overlap in time. Select some with `topics`.")
    length = ((end - start) * fps + _NS // 2) // _NS + 1
    # integers throughout: floats would shift late frames
    found: Integers = start + (np.arange(length, dtype=np.int64) * _NS + fps // 2) // fps
    return found


def intervals(times: Integers) -> Floats:
    """Nanoseconds from each frame to the next, shape (frames - 1,)."""
    return differences(times[1:], times[:-1])


def sound_times(stamps: Integers, log_times: Integers) -> Integers:
    """The stamps, or the log times if most stamps do not increase: some drivers leave them zero."""
    steps = np.diff(stamps)
    return stamps if 2 * int((steps > 0).sum()) >= len(steps) else log_times


def usual_interval(steps: Floats) -> float | None:
    """Median of the positive intervals, nanoseconds; None if there are none."""
    advancing = steps[steps > 0]
    return float(np.median(advancing)) if len(advancing) else None


class RateLimit:
    """Which frames of a camera to keep for a maximum rate.

    A grid of points, 1 / rate apart, begins at the first frame. For each point the first frame is
    kept that comes less than half of the camera's usual interval (and of the grid's) before it, or
    after it. So a 30 Hz camera loses nothing at 30 Hz, even if its frames come a little early or
    late, and keeps two of three frames at 20 Hz. After a gap, or when time goes backwards, the grid
    starts over.

    Args:
        rate: Hz.
        usual: The usual interval, nanoseconds; None if unknown.
    """

    def __init__(self, rate: float, usual: float | None) -> None:
        self._period = max(1, round(_NS / rate))
        self._early = min(self._period, int(usual or self._period)) // 2
        self._due: int | None = None

    def keeps(self, time: int) -> bool:
        """Whether to keep the next frame, by its time in nanoseconds."""
        due, period, early = self._due, self._period, self._early
        if due is None or time >= due + period or time < due - period - early:
            due = time
        elif time < due - early:
            return False
        self._due = due + period
        return True


def at_most(rate: float, times: Integers) -> NDArray[np.bool_]:
    """Which frames of a camera to keep for a maximum rate; see `RateLimit`.

    Args:
        rate: Hz.
        times: Nanoseconds, shape (frames,).
    """
    limit = RateLimit(rate, usual_interval(intervals(times)))
    return np.array([limit.keeps(time) for time in times.tolist()], np.bool_)


def lost_frames(steps: Floats) -> Integers:
    """Estimated number of lost frames in each interval.

    An interval of more than 1.5 times the median counts as the number of medians that fit into it,
    rounded. Before that it is reduced by the amounts by which the intervals just before and after
    fall short of the median: a late or early frame is not a lost one.
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


# ---------------------------------------------------------------- sync


_MOST = 2**64 - 1  # no two stamps can be farther apart, nanoseconds


@dataclass(frozen=True, eq=False)
class Sync:
    """Matches of the frames of several topics. ``len()`` is the number of matches.

    A match has one frame of each topic, and no frame is in two matches. Each topic is matched with
    the reference separately: a frame of one and a frame of the other can be matched if no frame of
    these two topics has a stamp between theirs. The pair nearest in time is taken first, the
    earlier of equally near ones, and neither frame is used again.

    Attributes:
        topics: Names of the topics, in the order of the columns.
        reference: The topic that the others were matched with.
        tolerance_ns: Maximum nanoseconds between a frame and the reference frame.
        indices: Frame numbers, int64, shape (matches, topics), by stamp of the reference.
        stamps: Stamps of these frames, nanoseconds, int64, shape (matches, topics).
        unmatched: Numbers of the unmatched frames, int64, increasing, by topic.
    """

    topics: tuple[str, ...]
    reference: str
    tolerance_ns: int
    indices: Integers
    stamps: Integers
    unmatched: dict[str, Integers]

    def __len__(self) -> int:
        return len(self.indices)


def nanoseconds(value: int, what: str, example: str = "half a second is 500_000_000") -> int:
    """A time as users give it.

    Raises:
        TypeError: It is not an integer: seconds, in most cases.
    """
    try:
        return as_integer(value)
    except TypeError:
        raise TypeError(f"{what} is an integer, in nanoseconds, not {value!r}: {example}") from None


def _tolerance(value: int) -> int:
    tolerance = nanoseconds(value, "tolerance_ns")
    if tolerance < 0:
        raise OptionError(f"tolerance is {tolerance} ns: use 0 or more")
    return tolerance


def synchronize(
    stamps: Mapping[str, Integers], *, tolerance_ns: int, reference: str | None = None
) -> Sync:
    """Match frames by their stamps; see `Sync`.

    Args:
        stamps: Stamps of each topic's frames, nanoseconds; may be unsorted and repeated.
        tolerance_ns: Maximum nanoseconds between a frame and the reference frame.
        reference: One of the topics; None: the one with the fewest frames, or the first of several.

    Raises:
        OptionError: There is no topic, no such reference, or the tolerance is negative.
    """
    tolerance = _tolerance(tolerance_ns)
    if not stamps:
        raise OptionError("there are no topics to match")
    if reference is None:
        reference = min(stamps, key=lambda topic: len(stamps[topic]))
    if reference not in stamps:
        raise OptionError(f"reference {reference!r} is not one of {', '.join(stamps)}")
    own = stamps[reference]
    columns = [
        np.arange(len(own)) if topic == reference else match(own, other, tolerance_ns=tolerance)
        for topic, other in stamps.items()
    ]
    indices = np.column_stack(columns).astype(np.int64, copy=False)
    indices = indices[(indices >= 0).all(axis=1)]
    place = list(stamps).index(reference)
    indices = indices[np.argsort(own[indices[:, place]], kind="stable")]
    unmatched = {}
    for column, (topic, times) in zip(indices.T, stamps.items(), strict=True):
        is_left = np.ones(len(times), np.bool_)
        is_left[column] = False
        unmatched[topic] = np.flatnonzero(is_left).astype(np.int64, copy=False)
    found = np.column_stack(
        [times[column] for times, column in zip(stamps.values(), indices.T, strict=True)]
    )
    return Sync(tuple(stamps), reference, tolerance, indices, found, unmatched)


def match(reference: Integers, other: Integers, *, tolerance_ns: int) -> Integers:
    """The frame of the other topic matched with each reference frame; see `Sync`.

    Args:
        reference: Stamps, nanoseconds.
        other: Stamps, nanoseconds.
        tolerance_ns: Maximum nanoseconds between the two.

    Returns:
        Frame numbers, int64, shape of `reference`; -1 where there is none.
    """
    times, numbers, is_other = _merged(reference, other)
    # unsigned numbers, since times may be more than 2^63 apart
    unsigned: NDArray[np.uint64] = times.view(np.uint64)
    gaps = unsigned[1:] - unsigned[:-1]
    may_go = (is_other[1:] != is_other[:-1]) & (gaps <= np.uint64(min(tolerance_ns, _MOST)))
    first = np.flatnonzero(_nearest_first(gaps, may_go))
    found = np.full(len(reference), -1, np.int64)
    swapped = is_other[first]
    found[numbers[np.where(swapped, first + 1, first)]] = numbers[
        np.where(swapped, first, first + 1)
    ]
    return found


def _merged(reference: Integers, other: Integers) -> tuple[Integers, Integers, NDArray[np.bool_]]:
    """Both topics by stamp: stamps, frame numbers, and which are of the other topic.

    Among frames with equal stamps, reference frames and other frames alternate.
    """
    parts = [_ranked(reference), _ranked(other)]
    times, numbers, ranks = (np.concatenate(same) for same in zip(*parts, strict=True))
    is_other = np.arange(len(times)) >= len(reference)
    order = np.argsort(times, kind="stable")
    if ranks.any():
        order = np.lexsort((is_other, ranks, times))
    return times[order], numbers[order], is_other[order]


def _ranked(stamps: Integers) -> tuple[Integers, Integers, Integers]:
    """Stamps in order, their frames' numbers, and how many equal ones are before each."""
    numbers = np.argsort(stamps, kind="stable").astype(np.int64, copy=False)
    times = stamps[numbers]
    places = np.arange(len(times))
    is_new = np.append(True, times[1:] != times[:-1])[: len(times)]
    return times, numbers, places - np.maximum.accumulate(np.where(is_new, places, 0))


def _nearest_first(gaps: NDArray[np.uint64], may_go: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which pairs of neighbours are taken, nearest first, using each frame once.

    A pair waits for neighbouring pairs that are nearer. So from each pair that waits for none,
    along pairs that each wait for the previous one, every other pair is taken; where two such runs
    meet, the last pair is taken if both runs would take it.

    Args:
        gaps: Time between each frame and the next one.
        may_go: Whether the two can be matched.
    """
    both = may_go[1:] & may_go[:-1]
    is_later_nearer = gaps[1:] < gaps[:-1]
    waits_before = np.append(False, both & ~is_later_nearer)[: len(gaps)]
    waits_after = np.append(both & is_later_nearer, False)[: len(gaps)]
    is_due = _run_lengths(waits_before) % 2 == 0
    is_due &= _run_lengths(waits_after[::-1])[::-1] % 2 == 0
    found: NDArray[np.bool_] = may_go & is_due
    return found


def _run_lengths(waits: NDArray[np.bool_]) -> Integers:
    """Distance of each from the last one before it that does not wait."""
    places = np.arange(len(waits))
    lengths: Integers = places - np.maximum.accumulate(np.where(waits, 0, places))
    return lengths


# ---------------------------------------------------------------- by stamp

_WANTED = {
    "nearest": "near",
    "before": "at or before",
    "after": "at or after",
    "exact": "of exactly",
}


class StampIndex:
    """Finds frames by stamp; the first of several with the same stamp.

    Args:
        topic: For errors.
        stamps: Nanoseconds, shape (frames,), at least one.
    """

    def __init__(self, topic: str, stamps: NDArray[np.int64]) -> None:
        self._topic = topic
        self._order = np.argsort(stamps, kind="stable")
        self._sorted = stamps[self._order]

    def find(self, stamp_ns: int, *, mode: str, tolerance_ns: int | None) -> int:
        """Number of the frame for a time.

        Args:
            stamp_ns: Nanoseconds.
            mode: ``nearest``, the earlier of two equally near; ``before``: the
                last at or before the time; ``after``: the first at or after it; ``exact``.
            tolerance_ns: Maximum nanoseconds between them, or None for no limit.

        Raises:
            FrameNotFoundError: There is none.
            OptionError: There is no such mode or tolerance.
        """
        if mode not in _WANTED:
            raise OptionError(f"mode {mode!r} is not known: use {', '.join(_WANTED)}")
        stamp = self._time(stamp_ns)
        tolerance = None if tolerance_ns is None else _tolerance(tolerance_ns)
        most = 0 if mode == "exact" else tolerance
        # the first at or after the time, and the last at or before it
        after = self._place(stamp)
        later = [after] if after < len(self._sorted) else []
        earlier = [self._place(self._stamp(after - 1))] if after else []
        if later and self._stamp(after) == stamp:
            earlier = later

        def distance(place: int) -> int:
            return abs(self._stamp(place) - stamp)

        nearest = min((*earlier, *later), key=distance)
        for place in {"before": earlier, "after": later}.get(mode, [nearest]):
            if most is None or distance(place) <= most:
                return int(self._order[place])
        within = "" if tolerance is None else f"within {tolerance} ns "
        near = self._stamp(nearest)
        raise FrameNotFoundError(self._topic, stamp, f"{within}{_WANTED[mode]}", near)

    def between(self, start_ns: int, end_ns: int) -> NDArray[np.int64]:
        """Numbers of the frames with start_ns <= stamp < end_ns, by stamp."""
        first, last = (self._place(self._time(time)) for time in (start_ns, end_ns))
        return self._order[first : max(first, last)]

    def _time(self, time: int) -> int:
        example = "half a second after the first frame is stamps[0] + 500_000_000"
        return nanoseconds(time, f"a time of {self._topic}", example)

    def _place(self, stamp: int) -> int:
        """How many stamps are smaller."""
        if stamp > INT64_MAX:
            return len(self._sorted)
        value = np.int64(max(stamp, INT64_MIN))
        return int(np.searchsorted(self._sorted, value, side="left"))

    def _stamp(self, place: int) -> int:
        return int(self._sorted[place])


# ---------------------------------------------------------------- cuts


def cut_times(times: Sequence[NDArray[np.int64]], frames: int) -> list[int]:
    """Log times at which to cut a recording, each that of a camera message.

    The busiest camera is cut after that many of its frames; so is any other camera within windows
    in which it has more than twice as many.

    Args:
        times: Sorted log times of each camera's messages, ns.
        frames: Frames of a window.

    Returns:
        Increasing; each begins a window, and the first window begins before all of them.
    """
    cuts: list[int] = []
    for column in sorted(times, key=len, reverse=True):
        edges = [0, *np.searchsorted(column, np.array(cuts, np.int64)).tolist(), len(column)]
        new: list[int] = []
        for start, end in pairwise(edges):
            if end - start > (2 * frames if cuts else frames):
                new.extend(column[start + frames : end : frames].tolist())
        cuts = sorted({*cuts, *(time for time in new if time > int(column[0]))})
    if cuts:
        # a last cut that leaves little after it is dropped
        rest = max((len(column) - np.searchsorted(column, cuts[-1]) for column in times), default=0)
        return cuts[:-1] if rest < frames // 2 else cuts
    return cuts
