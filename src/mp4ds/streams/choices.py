"""Which messages of a stream are wanted."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from mp4ds.streams.rebuild import DecodedColumns

Choice = Callable[[DecodedColumns], Iterator[int]]
"""Gives the numbers of the messages that are wanted, increasing.

It is asked for the next number only when the message before was made, so that it may leave out
those for which it is too late by then.
"""


def everything(columns: DecodedColumns) -> Iterator[int]:
    """All messages."""
    return iter(range(len(columns.log_time)))


def since(start: int, choice: Choice = everything) -> Choice:
    """Of the messages that are wanted those from a log time on, nanoseconds."""

    def choose(columns: DecodedColumns) -> Iterator[int]:
        times = columns.log_time
        return (index for index in choice(columns) if times[index] >= start)

    return choose


def last_of(end: int) -> Choice:
    """The last message before a log time, nanoseconds, if there is one."""

    def choose(columns: DecodedColumns) -> Iterator[int]:
        return iter(np.flatnonzero(columns.log_time < end)[-1:].tolist())

    return choose


def marked(is_wanted: NDArray[np.bool_], choice: Choice = everything) -> Choice:
    """Of the messages that are wanted those that are marked.

    Args:
        is_wanted: For each message, shape (messages,).
        choice: Says which are wanted.
    """

    def choose(columns: DecodedColumns) -> Iterator[int]:
        return (index for index in choice(columns) if is_wanted[index])

    return choose


def unbroken(
    indices: Iterable[int], keys: Sequence[int], *, from_key: bool = False
) -> Iterator[int]:
    """Packets of a video, and those between that must be decoded before them.

    Args:
        indices: Numbers of the packets that are wanted, increasing.
        keys: Numbers of the key frames, increasing.
        from_key: Begin with the key frame before the first one.
    """
    due: int | None = None
    for index in indices:
        at = bisect_right(keys, index)
        key = keys[at - 1] if at else 0
        if due is None:
            due = key if from_key else index
        yield from range(max(due, key), index + 1)
        due = index + 1
