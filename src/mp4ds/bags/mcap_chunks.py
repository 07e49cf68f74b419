"""The chunks of an MCAP file as its summary lists them, and which of them an excerpt needs."""

from __future__ import annotations

import bisect
import struct
from array import array
from collections.abc import Collection, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.mcap_records import MAX_RECORD_BYTES, DamageError
from mp4ds.records import Excerpt

_HEAD = struct.Struct("<QQQQI")
_CHANNEL = np.dtype([("id", "<u2"), ("offset", "<u8")])
_LATEST = 2**64 - 1
_MAX_OFFSET = 2**62  # sums of three do not wrap


class ChunkEntry(NamedTuple):
    """A chunk that the summary lists.

    Attributes:
        offset: Byte offset of its record in the file.
        length: Bytes of its record.
        start: Earliest log time of its messages, nanoseconds; 0 without messages.
        end: Latest log time of its messages, nanoseconds; 0 without messages.
        size: Bytes of its content, decompressed.
        channels: Ids of the channels that it holds messages of; empty where the file does
            not tell, or without messages.
    """

    offset: int
    length: int
    start: int
    end: int
    size: int
    channels: frozenset[int]


class ChunkTable:
    """All chunks that a summary lists, in arrays: a long recording has many of them.

    It is filled by `add`, and may be asked after `finish`.
    """

    def __init__(self) -> None:
        self._added = array("Q")
        self._ids = array("H")
        self._counts = array("I")

    def __len__(self) -> int:
        return len(self._counts)

    def add(self, body: bytes) -> None:
        """Take in a chunk index record.

        Raises:
            DamageError: It does not hold what it must.
        """
        try:
            start, end, offset, length, map_bytes = _HEAD.unpack_from(body)
            after = _HEAD.size + map_bytes
            channels = np.frombuffer(body[_HEAD.size : after], _CHANNEL)
            index_length, text_bytes = struct.unpack_from("<QI", body, after)
            _, size = struct.unpack_from("<QQ", body, after + 12 + text_bytes)
        except (struct.error, ValueError):
            raise DamageError("a chunk index is shorter than its fields") from None
        self._added.extend((offset, length, index_length, start, end, size))
        self._ids.frombytes(channels["id"].astype(np.uint16).tobytes())
        self._counts.append(len(channels))

    def finish(self) -> None:
        """Order the chunks as they lie in the file."""
        columns = np.array(self._added, np.uint64).reshape(-1, 6)
        del self._added
        order = np.argsort(columns[:, 0], kind="stable")
        self._offsets, self._lengths, self._index_lengths, self._starts, self._ends, self._sizes = (
            np.ascontiguousarray(columns[order].T)
        )
        counts = np.array(self._counts, np.int64)
        self._held = counts[order]
        self._first = (np.cumsum(counts) - counts)[order]
        self._channels = np.array(self._ids, np.uint16)
        self._owners = np.repeat(np.argsort(order).astype(np.int32), counts)
        # A chunk without messages has the start 0, which would hold back everything before it.
        self._empty = (self._held == 0) & (self._starts == 0) & (self._ends == 0)
        self._later_starts = _later_starts(self._known_starts())
        self._places = array("Q", self._offsets.tobytes())

    def _known_starts(self) -> NDArray[np.uint64]:
        starts: NDArray[np.uint64] = self._starts.copy()
        starts[self._empty] = _LATEST
        return starts

    @property
    def has_messages(self) -> bool:
        """Whether it lists a chunk with messages."""
        return not self._empty.all()

    @property
    def is_sound(self) -> bool:
        """Whether the chunks can lie and follow each other as it tells."""
        places = self._offsets, self._lengths, self._index_lengths
        if any(column.max(initial=0) > _MAX_OFFSET for column in places):
            return False
        ends = self._offsets + self._lengths + self._index_lengths
        return bool(
            (ends[:-1] <= self._offsets[1:]).all()
            and (self._starts <= self._ends).all()
            and (self._sizes <= MAX_RECORD_BYTES).all()
        )

    def later_start(self, offset: int) -> int | None:
        """The earliest log time in the chunks after a byte offset; None after the last."""
        place = bisect.bisect_right(self._places, offset)
        return self._later_starts[place] if place < len(self._later_starts) else None

    def span(self) -> tuple[int, int] | None:
        """Least and greatest log time of all chunks; None without messages."""
        return (self._later_starts[0], int(self._ends.max())) if self.has_messages else None

    def spans(self) -> dict[int, tuple[int, int]]:
        """Least and greatest log time of the chunks that hold a channel, by its id.

        It is empty where a chunk does not tell which channels it holds.
        """
        if ((self._held == 0) & ~self._empty).any():
            return {}
        first, last = np.full(2**16, _LATEST, np.uint64), np.zeros(2**16, np.uint64)
        np.minimum.at(first, self._channels, self._starts[self._owners])
        np.maximum.at(last, self._channels, self._ends[self._owners])
        keys = np.unique(self._channels).tolist()
        return {key: (int(first[key]), int(last[key])) for key in keys}

    def places(self) -> Iterator[tuple[int, int, int]]:
        """Byte offsets of each chunk, of its end, and of that of its message indexes."""
        columns = self._offsets, self._lengths, self._index_lengths
        for offset, length, index_length in zip(*(c.tolist() for c in columns), strict=True):
            yield offset, offset + length, offset + length + index_length

    def held_in_file_order(self) -> int:
        """Bytes that wait at most for earlier messages, if chunks are read as they lie."""
        return self._most_held(np.arange(len(self)))

    def held_in_time_order(self) -> int:
        """Bytes that wait at most for earlier messages, if chunks are read by their starts."""
        return self._most_held(self._by_start(np.arange(len(self))))

    def _by_start(self, numbers: NDArray[np.intp]) -> NDArray[np.intp]:
        return numbers[np.argsort(self._starts[numbers], kind="stable")]

    def _most_held(self, order: NDArray[np.intp]) -> int:
        if not len(order):
            return 0
        following = np.array(_later_starts(self._known_starts()[order]), np.uint64)[1:]
        sizes = np.where(self._empty, 0, self._sizes).astype(np.int64)
        by_end = np.argsort(self._ends)
        gone = np.concatenate(([0], np.cumsum(sizes[by_end])))
        past = gone[np.searchsorted(self._ends[by_end], following)]
        return int((np.cumsum(sizes[order])[:-1] - past).max(initial=0))

    def select(
        self, excerpt: Excerpt, unwanted: Collection[int]
    ) -> Iterator[tuple[ChunkEntry, int | None]]:
        """The chunks that may hold messages of an excerpt, by their starts.

        Chunks that tell of no messages are among them: whether that is true shows when they
        are read.

        Args:
            excerpt: Its span counts.
            unwanted: Ids of the channels that are not part of it.

        Yields:
            Each chunk, and the start of the next one, None after the last.
        """
        mask = self._within(excerpt)
        if unwanted:
            wanted = ~np.isin(self._channels, np.array(sorted(unwanted), np.uint16))
            holds = self._held == 0
            holds[self._owners[wanted]] = True
            mask &= holds
        order = self._by_start(np.flatnonzero(mask | self._empty))
        for place, number in enumerate(order, 1):
            following = int(self._starts[order[place]]) if place < len(order) else None
            yield self._entry(int(number)), following

    def _within(self, excerpt: Excerpt) -> NDArray[np.bool_]:
        mask = np.ones(len(self), np.bool_)
        start, end = excerpt.start or 0, excerpt.end
        if start > _LATEST:
            mask[:] = False
        elif start > 0:
            mask &= self._ends >= np.uint64(start)
        if end is not None and end <= _LATEST:
            mask &= self._starts < np.uint64(max(end, 0))
        return mask

    def _entry(self, number: int) -> ChunkEntry:
        first = self._first[number]
        channels = self._channels[first : first + self._held[number]]
        return ChunkEntry(
            int(self._offsets[number]),
            int(self._lengths[number]),
            int(self._starts[number]),
            int(self._ends[number]),
            int(self._sizes[number]),
            frozenset(channels.tolist()),
        )


def _later_starts(starts: NDArray[np.uint64]) -> array[int]:
    """The least of each start and those after it."""
    return array("Q", np.minimum.accumulate(starts[::-1])[::-1].tobytes())
