"""What an index would tell, by reading all messages."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mp4ds.records import Message, Record

_INT64_MAX = np.uint64(2**63 - 1)


def times_of(records: Iterable[Record]) -> dict[int, NDArray[np.int64]]:
    """Log times by channel id, sorted; see `sorted_times`."""
    found: dict[int, list[int]] = {}
    for record in records:
        if isinstance(record, Message):
            found.setdefault(record.channel.id, []).append(record.log_time)
    return {key: sorted_times(np.array(times, np.uint64)) for key, times in found.items()}


def sorted_times(times: NDArray[np.uint64]) -> NDArray[np.int64]:
    """Log times, sorted; those past the year 2262 as the last one that fits."""
    return np.sort(np.minimum(times, _INT64_MAX)).astype(np.int64)


def first_of(records: Iterable[Record]) -> dict[int, Message]:
    """The first message of each channel by log time, by channel id."""
    first: dict[int, Message] = {}
    for record in records:
        if isinstance(record, Message):
            known = first.get(record.channel.id)
            if known is None or record.log_time < known.log_time:
                first[record.channel.id] = with_own_payload(record)
    return first


def with_own_payload(message: Message) -> Message:
    """A message to be kept: a view would keep the whole chunk in memory."""
    return replace(message, data=bytes(message.data))
