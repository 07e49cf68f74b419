"""Frames of several cameras that were taken at the same time, by their stamps; numpy only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from operator import index as as_integer

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import OptionError

Integers = NDArray[np.int64]

_MOST = 2**64 - 1  # no two stamps are farther apart, nanoseconds


@dataclass(frozen=True, eq=False)
class Sync:
    """Matches of the frames of several topics. ``len()`` is the number of matches.

    A match has one frame of each topic, and no frame is in two matches. Each topic is matched
    with the reference by itself: a frame of the one and a frame of the other may go together
    where no frame of these two topics has a stamp between theirs. The pair that is nearest in
    time is taken first, of equally near ones the earlier, and neither of them again.

    Attributes:
        topics: Names of the topics, in the order of the columns.
        reference: The topic that the others were matched with.
        tolerance_ns: Most nanoseconds between a frame and that of the reference.
        indices: Frame numbers, int64, shape (matches, topics), by stamp of the reference.
        stamps: Stamps of these frames, nanoseconds, int64, shape (matches, topics).
        unmatched: Numbers of the frames that are in no match, int64, increasing, by topic.
    """

    topics: tuple[str, ...]
    reference: str
    tolerance_ns: int
    indices: Integers
    stamps: Integers
    unmatched: dict[str, Integers]

    def __len__(self) -> int:
        return len(self.indices)


def synchronize(
    stamps: Mapping[str, Integers], *, tolerance_ns: int, reference: str | None = None
) -> Sync:
    """Match frames by their stamps; see `Sync`.

    Args:
        stamps: Of each topic's frames, nanoseconds; unsorted and repeated as they may be.
        tolerance_ns: Most nanoseconds between a frame and that of the reference.
        reference: One of the topics; None: the one with the fewest frames, of several the first.

    Raises:
        OptionError: There is no topic, no such reference, or the tolerance is negative.
    """
    tolerance = as_integer(tolerance_ns)
    if tolerance < 0:
        raise OptionError(f"a tolerance of {tolerance} ns: use 0 or more")
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
    """The frame of the other topic that goes with each of the reference; see `Sync`.

    Args:
        reference: Stamps, nanoseconds.
        other: Stamps, nanoseconds.
        tolerance_ns: Most nanoseconds between both.

    Returns:
        Frame numbers, int64, shape of `reference`; -1 where there is none.
    """
    times, numbers, is_other = _merged(reference, other)
    # numbers without a sign, since times may be more than 2^63 apart
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

    Of frames with equal stamps, one of the reference is followed by one of the other.
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
    """Which pairs of neighbours are taken, if the nearest is taken first and then its two are not.

    A pair waits for the neighbouring pairs that are nearer. So from each pair that waits for
    none, along pairs that each wait for the one before, every other one is taken; where two
    such runs meet, the last pair if it is due in both.

    Args:
        gaps: Time between each frame and the next one.
        may_go: Whether the two may go together.
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
    """How many places each is after the last one that does not wait."""
    places = np.arange(len(waits))
    return places - np.maximum.accumulate(np.where(waits, 0, places))
