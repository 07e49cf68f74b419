"""Log-time order out of files that are nearly in it."""

from __future__ import annotations

import heapq
from collections.abc import Iterator

from mp4ds.records import Message

HOLD_BYTES = 256 * 2**20
"""Payload bytes held back at most; what is out of order by more comes as early as it can."""


class HoldBack:
    """Sorts messages by log time, ties in source order, holding back only what it must."""

    def __init__(self) -> None:
        self._heap: list[tuple[int, int, Message]] = []
        self._added = 0
        self._bytes = 0

    def __len__(self) -> int:
        return len(self._heap)

    def add(self, message: Message) -> None:
        """Take a message in."""
        self._added += 1
        self._bytes += len(message.data)
        heapq.heappush(self._heap, (message.log_time, self._added, message))

    def release(self, until: int | None) -> Iterator[Message]:
        """Give out, in order, what no later message can precede.

        Args:
            until: No message added later has a smaller log time, in nanoseconds; None when
                no message follows at all.
        """
        while self._heap and (
            until is None or self._heap[0][0] <= until or self._bytes > HOLD_BYTES
        ):
            message = heapq.heappop(self._heap)[2]
            self._bytes -= len(message.data)
            yield message
