"""The summary of an MCAP file and the places of its chunks, without reading messages."""

from __future__ import annotations

import struct
from array import array
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from mcap import records as mcap_records
from mcap.opcode import Opcode
from numpy.typing import NDArray

from mp4ds.bags.files import DamageError
from mp4ds.bags.mcap_records import (
    FOOTER_BYTES,
    MAGIC,
    MAX_RECORD_BYTES,
    OF_SUMMARY,
    PRIVATE_OPCODE,
    RecordStream,
    parse,
)
from mp4ds.bags.protocols import later_starts
from mp4ds.errors import SourceError
from mp4ds.records import ChannelStats, Excerpt

_HEAD = struct.Struct("<QQQQI")
_CHANNEL = np.dtype([("id", "<u2"), ("offset", "<u8")])
_LATEST = 2**64 - 1
_MAX_OFFSET = 2**62  # sums of three do not wrap
_OTHERS = (Opcode.ATTACHMENT, Opcode.METADATA)


class ChunkEntry(NamedTuple):
    """A chunk listed in the summary.

    Attributes:
        offset: Byte offset of its record in the file.
        length: Bytes of its record.
        start: Earliest log time of its messages, nanoseconds; 0 without messages.
        end: Latest log time of its messages, nanoseconds; 0 without messages.
        size: Bytes of its content, decompressed.
        channels: Ids of the channels with messages in it; empty if not stated, or without messages.
    """

    offset: int
    length: int
    start: int
    end: int
    size: int
    channels: frozenset[int]


class ChunkTable:
    """All chunks listed in a summary, in arrays: a long recording has many.

    Fill it with `add`, then call `finish` before any query.

    Attributes:
        later: Returns the earliest log time in the chunks after a byte offset; None after the last.
    """

    def __init__(self) -> None:
        self._added = array("Q")
        self._ids = array("H")
        self._counts = array("I")
        self.finish()

    def __len__(self) -> int:
        return len(self._counts)

    def add(self, body: bytes) -> None:
        """Add a chunk index record.

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
        """Sort the chunks by their place in the file."""
        columns = np.array(self._added, np.uint64).reshape(-1, 6)
        self._added = array("Q")
        order = np.argsort(columns[:, 0], kind="stable")
        self._offsets, self._lengths, self._index_lengths, self._starts, self._ends, self._sizes = (
            np.ascontiguousarray(columns[order].T)
        )
        counts = np.array(self._counts, np.int64)
        self._held = counts[order]
        self._first = (np.cumsum(counts) - counts)[order]
        self._channels = np.array(self._ids, np.uint16)
        self._owners = np.repeat(np.argsort(order).astype(np.int32), counts)
        # A chunk without messages has start 0, which would hold back everything before it.
        self._empty = (self._held == 0) & (self._starts == 0) & (self._ends == 0)
        self._known_starts = np.where(self._empty, np.uint64(_LATEST), self._starts)
        self.later = later_starts(self._offsets, self._known_starts)

    @property
    def has_messages(self) -> bool:
        """Whether it lists a chunk with messages."""
        return not self._empty.all()

    @property
    def is_sound(self) -> bool:
        """Whether the stated places of the chunks are possible."""
        places = self._offsets, self._lengths, self._index_lengths
        if any(column.max(initial=0) > _MAX_OFFSET for column in places):
            return False
        ends = self._offsets + self._lengths + self._index_lengths
        return bool(
            (ends[:-1] <= self._offsets[1:]).all()
            and (self._starts <= self._ends).all()
            and (self._sizes <= MAX_RECORD_BYTES).all()
        )

    def span(self) -> tuple[int, int] | None:
        """Earliest and latest log time of all chunks; None without messages."""
        return (int(self._known_starts.min()), int(self._ends.max())) if self.has_messages else None

    def spans(self) -> dict[int, tuple[int, int]]:
        """Earliest and latest log time of the chunks that hold a channel, by its id.

        Empty if a chunk does not state which channels it holds.
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
        """Maximum bytes held back for earlier messages if chunks are read in file order."""
        return self._most_held(np.arange(len(self)))

    def held_in_time_order(self) -> int:
        """Maximum bytes held back for earlier messages if chunks are read by start time."""
        return self._most_held(self._by_start(np.arange(len(self))))

    def _by_start(self, numbers: NDArray[np.intp]) -> NDArray[np.intp]:
        return numbers[np.argsort(self._starts[numbers], kind="stable")]

    def _most_held(self, order: NDArray[np.intp]) -> int:
        if not len(order):
            return 0
        following = np.minimum.accumulate(self._known_starts[order][::-1])[::-1][1:]
        sizes = np.where(self._empty, 0, self._sizes).astype(np.int64)
        by_end = np.argsort(self._ends)
        gone = np.concatenate(([0], np.cumsum(sizes[by_end])))
        past = gone[np.searchsorted(self._ends[by_end], following)]
        return int((np.cumsum(sizes[order])[:-1] - past).max(initial=0))

    def select(
        self, excerpt: Excerpt, unwanted: Collection[int]
    ) -> Iterator[tuple[ChunkEntry, int | None]]:
        """The chunks that may hold messages of an excerpt, by start time.

        Chunks listed without messages are included: whether that is true shows when they are read.

        Args:
            excerpt: The excerpt, of which the span is used.
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


# ---------------------------------------------------------------- the summary


@dataclass
class McapSummary:
    """A summary section.

    Attributes:
        offset: Byte offset of its first record; 0 if there is none.
        schemas: Schema records by id.
        channels: Channel records by id.
        statistics: The statistics record, if there is one.
        chunks: The chunks that it lists.
        private: How many records of each private opcode it holds, and those between the chunks
            once these were looked at.
        others: Byte offsets of the attachments and metadata records, once these were looked at.
    """

    offset: int = 0
    schemas: dict[int, mcap_records.Schema] = field(default_factory=dict)
    channels: dict[int, mcap_records.Channel] = field(default_factory=dict)
    statistics: mcap_records.Statistics | None = None
    chunks: ChunkTable = field(default_factory=ChunkTable)
    private: Counter[int] = field(default_factory=Counter)
    others: array[int] = field(default_factory=lambda: array("Q"))

    def add(self, opcode: int, body: bytes) -> None:
        """Add a record.

        Raises:
            DamageError: It is damaged.
        """
        if opcode == Opcode.CHUNK_INDEX:
            self.chunks.add(body)
        elif opcode == Opcode.SCHEMA:
            schema = parse(mcap_records.Schema, body)
            self.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = parse(mcap_records.Channel, body)
            self.channels[channel.id] = channel
        elif opcode == Opcode.STATISTICS:
            self.statistics = parse(mcap_records.Statistics, body)
        elif opcode >= PRIVATE_OPCODE:
            self.private[opcode] += 1

    def span(self) -> tuple[int, int] | None:
        """The earliest and latest log time stated anywhere; None without messages."""
        statistics, listed = self.statistics, self.chunks.span()
        if not statistics or not statistics.message_count:
            return listed
        first, last = statistics.message_start_time, statistics.message_end_time
        return (min(first, listed[0]), max(last, listed[1])) if listed else (first, last)

    @property
    def is_consistent(self) -> bool:
        """Whether its parts agree that it lists all channels, schemas and chunks."""
        statistics = self.statistics
        if statistics is None:
            return False
        counts = statistics.channel_message_counts
        schemas = {channel.schema_id for channel in self.channels.values()} - {0}
        return (
            self.covers(sum(counts.values()))
            and counts.keys() <= self.channels.keys()
            and schemas <= self.schemas.keys()
            and statistics.channel_count == len(self.channels)
            and statistics.schema_count == len(self.schemas)
            and statistics.chunk_count == len(self.chunks)
            and self.chunks.is_sound
        )

    def stats(self) -> dict[int, ChannelStats]:
        """Counts and spans by channel id; empty if the counts do not add up."""
        statistics = self.statistics
        if not statistics:
            return {}
        counts = statistics.channel_message_counts
        if not self.covers(sum(counts.values())):
            return {}
        whole, spans = self.span() or (0, 0), self.chunks.spans()
        stats = {}
        for channel_id in self.channels.keys() | counts.keys():
            count = counts.get(channel_id, 0)
            span = spans.get(channel_id, whole) if count else (0, 0)
            stats[channel_id] = ChannelStats(count, *span)
        return stats

    def log_times(self, stream: RecordStream) -> Iterator[tuple[int, NDArray[np.uint64]]]:
        """Channel id and log times in ns, from each message index in the order of the file.

        Raises:
            DamageError: An index record is damaged.
        """
        stream.expect((first, end) for _, first, end in self.chunks.places())
        for _, first, end in self.chunks.places():
            stream.seek(first)
            while stream.tell() < end:
                opcode, body = stream.next()
                if opcode != Opcode.MESSAGE_INDEX:
                    raise DamageError("it is in the place of a message index")
                try:
                    channel_id, length = struct.unpack_from("<HI", body)
                    pairs = np.frombuffer(body, "<u8", count=length // 8, offset=6)
                    yield channel_id, pairs.reshape(-1, 2)[:, 0]
                except (struct.error, ValueError):
                    raise DamageError("a message index is shorter than its fields") from None

    def look_between(self, stream: RecordStream) -> bool:
        """Look at the records between the chunks, which must be sound.

        The stream's position is undefined afterwards.

        Returns:
            Whether the chunks are where they are listed, with no messages outside of them.
        """
        place = len(MAGIC)
        gaps = []
        for start, _, end in self.chunks.places():
            gaps.append((place, start))
            place = end
        try:
            return all(self._look(stream, *gap) for gap in [*gaps, (place, self.offset)])
        except (DamageError, SourceError):
            return False  # reading everything will show what is wrong

    def _look(self, stream: RecordStream, place: int, end: int) -> bool:
        if place < end:
            stream.seek(place)
        while place < end:
            opcode = stream.skip_record()
            if opcode in _OTHERS:
                self.others.append(place)
            elif opcode >= PRIVATE_OPCODE:
                self.private[opcode] += 1
            elif opcode in (Opcode.MESSAGE, Opcode.CHUNK, Opcode.FOOTER):
                return False
            place = stream.tell()
        return place == end

    def covers(self, count: int) -> bool:
        """Whether this count is all messages of the file."""
        return self.statistics is not None and self.statistics.message_count == count


def summary_place(stream: RecordStream) -> tuple[int, int]:
    """Where a summary begins, 0 if there is none, and its checksum, 0 if it has none.

    Raises:
        SourceError: The file does not end as an MCAP file does.
    """
    if stream.size < len(MAGIC) + FOOTER_BYTES:
        raise stream.cut_short()
    stream.seek(stream.size - FOOTER_BYTES)
    # Read separately from its record: in a file cut short, it is not a length.
    tail = stream.read(FOOTER_BYTES)
    if tail[-len(MAGIC) :] != MAGIC or tail[0] != Opcode.FOOTER:
        raise stream.cut_short()
    summary_start, _, checksum = struct.unpack_from("<QQI", tail, 9)
    return summary_start, checksum


def read_summary(stream: RecordStream, summary: McapSummary | None = None) -> McapSummary | None:
    """Read the summary section of a file; the stream's position is undefined afterwards.

    Args:
        stream: The file.
        summary: An empty one to read into, which keeps what comes before damage.

    Returns:
        The summary, or None if the file has none, or it does not begin where the footer says.

    Raises:
        SourceError: The file does not end as an MCAP file does.
        DamageError: A record of the summary is damaged.
    """
    summary_start, _ = summary_place(stream)
    if not summary_start:
        return None
    stream.seek(summary_start)
    summary = summary or McapSummary()
    summary.offset = summary_start
    while True:
        opcode, body = stream.next()
        if opcode == Opcode.FOOTER:
            break
        if opcode not in OF_SUMMARY and opcode < PRIVATE_OPCODE:
            return None  # bytes between records of the data do not make a complete file
        summary.add(opcode, body)
    summary.chunks.finish()
    return summary
