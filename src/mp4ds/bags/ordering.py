"""Log-time order out of files that are nearly in it, and out of several of them."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from mp4ds.records import Message, Record

HOLD_BYTES = 256 * 2**20
"""Payload bytes held back at most; what is out of order by more comes as early as it can."""


class HoldBack:
    """Sorts messages by log time, ties in source order, holding back only what it must."""

    def __init__(self) -> None:
        self._heap: list[tuple[int, int, int, Message]] = []
        self._added = 0
        self._bytes = 0

    def __len__(self) -> int:
        return len(self._heap)

    def add(self, message: Message, place: int = 0) -> None:
        """Take a message in.

        Args:
            message: The message.
            place: Where it stands in the source, if messages are not added in source order;
                ties of one place come in the order in which they were added.
        """
        self._added += 1
        self._bytes += len(message.data)
        heapq.heappush(self._heap, (message.log_time, place, self._added, message))

    def release(self, until: int | None) -> Iterator[Message]:
        """Give out, in order, what no later message can precede.

        Args:
            until: No message added later precedes one of this log time, in nanoseconds; None
                when no message follows at all.
        """
        while self._heap and (
            until is None or self._heap[0][0] <= until or self._bytes > HOLD_BYTES
        ):
            message = heapq.heappop(self._heap)[-1]
            self._bytes -= len(message.data)
            yield message


class Part(NamedTuple):
    """One of several sources that are read as one.

    Attributes:
        start: None of its messages has an earlier log time, nanoseconds.
        records: Begins to read it.
    """

    start: int
    records: Callable[[], Iterator[Record]]


def merged(parts: Sequence[Part]) -> Iterator[Record]:
    """Several sources in log-time order, each being read from when its time has come.

    Ties come in the order of `parts`. Attachments and metadata records do not wait.

    Args:
        parts: Each in log-time order; one that is not comes as it is.
    """
    waiting = sorted(
        range(len(parts)), key=lambda number: (parts[number].start, number), reverse=True
    )
    heads: list[tuple[int, int, Message, Iterator[Record]]] = []

    def is_next(time: int, number: int) -> bool:
        if waiting and parts[waiting[-1]].start <= time:
            return False
        return not heads or (time, number) < heads[0][:2]

    while waiting or heads:
        if waiting and (not heads or parts[waiting[-1]].start <= heads[0][0]):
            number = waiting.pop()
            records = parts[number].records()
        else:
            _, number, message, records = heapq.heappop(heads)
            yield message
        for record in records:
            if isinstance(record, Message) and not is_next(record.log_time, number):
                heapq.heappush(heads, (record.log_time, number, record, records))
                break
            yield record
