"""How a recording is divided into tasks: spans of time, and topics that fit into memory. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

GOPS_PER_WINDOW = 10
"""Groups of pictures of the busiest camera in a window: a cut costs at most one key frame."""


def cut_times(times: Sequence[NDArray[np.int64]], frames: int) -> list[int]:
    """Log times at which a recording is cut, each a message of a camera.

    The busiest camera is cut after so many of its frames each; so is any other within the
    windows in which it has more than twice as many.

    Args:
        times: Sorted log times of each camera's messages, ns.
        frames: Frames of a window.

    Returns:
        Increasing; each begins a window, and the first window begins before all.
    """
    cuts: list[int] = []
    for column in sorted(times, key=len, reverse=True):
        edges = [0, *np.searchsorted(column, np.array(cuts, np.int64)).tolist(), len(column)]
        new: list[int] = []
        for start, end in pairwise(edges):
            if end - start > (2 * frames if cuts else frames):
                new.extend(column[start + frames : end : frames].tolist())
        cuts = sorted({*cuts, *(time for time in new if time > int(column[0]))})
    return _without_short_end(cuts, times, frames)


def _without_short_end(
    cuts: list[int], times: Sequence[NDArray[np.int64]], frames: int
) -> list[int]:
    """Leave out a last cut after which little is left."""
    if not cuts:
        return cuts
    rest = max((len(column) - np.searchsorted(column, cuts[-1]) for column in times), default=0)
    return cuts[:-1] if rest < frames // 2 else cuts


def spans_of(cuts: Sequence[int]) -> list[tuple[int | None, int | None]]:
    """Half-open spans of log time, ns, between the cuts; None is open."""
    edges = [None, *cuts, None]
    return list(pairwise(edges))


def group_topics(costs: Mapping[str, int], budget: int) -> list[list[str]]:
    """Topics in groups of which each costs no more than a budget, where that can be.

    Args:
        costs: Bytes of memory that each topic takes while it is packed.
        budget: Bytes.

    Returns:
        At least one group; a topic beyond the budget has its own.
    """
    groups: list[list[str]] = []
    left: list[int] = []
    for topic in sorted(costs, key=lambda topic: (-costs[topic], topic)):
        place = next((n for n, room in enumerate(left) if costs[topic] <= room), None)
        if place is None:
            place = len(groups)
            groups.append([])
            left.append(budget)
        groups[place].append(topic)
        left[place] -= costs[topic]
    return groups or [[]]


def share(number: int, tasks: Sequence[tuple[str, ...]], shares: int) -> list[tuple[str, ...]]:
    """One share of tasks of several machines: every so many-th.

    Args:
        number: Of the share, from 1.
        tasks: All, in an order on which all machines agree.
        shares: How many there are.
    """
    return list(tasks[number - 1 :: shares])
