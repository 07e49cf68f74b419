"""What the summary section of an MCAP file tells without reading its messages."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from mcap import records as mcap_records
from mcap.opcode import Opcode
from numpy.typing import NDArray

from mp4ds.bags.mcap_chunks import ChunkTable
from mp4ds.bags.mcap_records import (
    FOOTER_BYTES,
    MAGIC,
    OF_SUMMARY,
    PRIVATE_OPCODE,
    DamageError,
    RecordStream,
    parse,
)
from mp4ds.records import ChannelStats


class IndexEntries(NamedTuple):
    """The messages of one channel in one chunk.

    Attributes:
        channel_id: Id of the channel in the file.
        chunk: Byte offset of the chunk's record in the file.
        log_times: uint64 array, nanoseconds.
        offsets: uint64 array of byte offsets in the decompressed chunk.
    """

    channel_id: int
    chunk: int
    log_times: NDArray[np.uint64]
    offsets: NDArray[np.uint64]


@dataclass
class Summary:
    """A summary section.

    Attributes:
        offset: Byte offset of its first record.
        schemas: Schema records by id.
        channels: Channel records by id.
        statistics: The statistics record, if there is one.
        chunks: The chunks that it lists.
        private: How many records of each private opcode it holds.
    """

    offset: int
    schemas: dict[int, mcap_records.Schema] = field(default_factory=dict)
    channels: dict[int, mcap_records.Channel] = field(default_factory=dict)
    statistics: mcap_records.Statistics | None = None
    chunks: ChunkTable = field(default_factory=ChunkTable)
    private: Counter[int] = field(default_factory=Counter)

    @property
    def start(self) -> int | None:
        """The earliest log time, or None without messages or without knowing."""
        span = self._span()
        return span[0] if span else None

    def _span(self) -> tuple[int, int] | None:
        """The least and the greatest log time that anything tells of."""
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
        """Counts and spans by channel id; empty where the counts do not add up."""
        statistics = self.statistics
        if not statistics:
            return {}
        counts = statistics.channel_message_counts
        if not self.covers(sum(counts.values())):
            return {}
        whole, spans = self._span() or (0, 0), self.chunks.spans()
        stats = {}
        for channel_id in self.channels.keys() | counts.keys():
            count = counts.get(channel_id, 0)
            span = spans.get(channel_id, whole) if count else (0, 0)
            stats[channel_id] = ChannelStats(count, *span)
        return stats

    def entries(self, stream: RecordStream) -> Iterator[IndexEntries]:
        """Read the message indexes of all chunks, in the order of the file.

        Raises:
            DamageError: An index record is damaged.
        """
        stream.expect((first, end) for _, first, end in self.chunks.places())
        for chunk, first, end in self.chunks.places():
            stream.seek(first)
            while stream.tell() < end:
                opcode, body = stream.next()
                if opcode != Opcode.MESSAGE_INDEX:
                    raise DamageError("it stands where a message index should")
                yield _parse_entries(chunk, body)

    def covers(self, count: int) -> bool:
        """Whether so many messages are all that the file has."""
        return self.statistics is not None and self.statistics.message_count == count

    def first_places(self, stream: RecordStream) -> dict[int, tuple[int, int, int]] | None:
        """Where each channel's first message is, by the message indexes.

        Returns:
            Log time, byte offset of the chunk, and offset in its content, by the channel's id;
            None where the indexes do not have all messages.

        Raises:
            DamageError: An index record is damaged.
        """
        places: dict[int, tuple[int, int, int]] = {}
        count = 0
        for entries in self.entries(stream):
            count += len(entries.log_times)
            if len(entries.log_times):
                row = int(np.argmin(entries.log_times))
                place = int(entries.log_times[row]), entries.chunk, int(entries.offsets[row])
                places[entries.channel_id] = min(places.get(entries.channel_id, place), place)
        return places if self.covers(count) else None


def _parse_entries(chunk: int, body: bytes) -> IndexEntries:
    try:
        channel_id, length = struct.unpack_from("<HI", body)
        pairs = np.frombuffer(body, "<u8", count=length // 8, offset=6).reshape(-1, 2)
    except (struct.error, ValueError):
        raise DamageError("a message index is shorter than its fields") from None
    return IndexEntries(channel_id, chunk, pairs[:, 0], pairs[:, 1])


def read_summary(stream: RecordStream) -> Summary | None:
    """Read the summary section of a file, leaving the stream anywhere.

    Returns:
        The summary, or None where the file has none, or it does not begin where the footer says.

    Raises:
        SourceError: The file does not end as an MCAP file does.
        DamageError: A record of the summary is damaged.
    """
    size = stream.size
    if size is None:
        return None
    if size < 2 * len(MAGIC) + FOOTER_BYTES - len(MAGIC):
        raise stream.cut_short()
    stream.seek(size - FOOTER_BYTES)
    # Read apart from its record: what stands there in a file cut short is no length.
    tail = stream.read(FOOTER_BYTES)
    if tail[-len(MAGIC) :] != MAGIC or tail[0] != Opcode.FOOTER:
        raise stream.cut_short()
    summary_start, _ = struct.unpack_from("<QQ", tail, 9)
    if not summary_start:
        return None
    stream.seek(summary_start)
    summary = Summary(summary_start)
    while True:
        opcode, body = stream.next()
        if opcode == Opcode.FOOTER:
            break
        if opcode not in OF_SUMMARY and opcode < PRIVATE_OPCODE:
            return None  # what stands between records of the data tells of no whole file
        _add(summary, opcode, body)
    summary.chunks.finish()
    return summary


def _add(summary: Summary, opcode: int, body: bytes) -> None:
    if opcode == Opcode.CHUNK_INDEX:
        summary.chunks.add(body)
    elif opcode == Opcode.SCHEMA:
        schema = parse(mcap_records.Schema, body)
        summary.schemas[schema.id] = schema
    elif opcode == Opcode.CHANNEL:
        channel = parse(mcap_records.Channel, body)
        summary.channels[channel.id] = channel
    elif opcode == Opcode.STATISTICS:
        summary.statistics = parse(mcap_records.Statistics, body)
    elif opcode >= PRIVATE_OPCODE:
        summary.private[opcode] += 1
