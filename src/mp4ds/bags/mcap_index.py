"""What the summary section of an MCAP file tells without reading its messages."""

from __future__ import annotations

import bisect
import struct
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from mcap import records as mcap_records
from mcap.opcode import Opcode
from numpy.typing import NDArray

from mp4ds.bags.mcap_records import FOOTER_BYTES, MAGIC, DamageError, RecordStream, parse
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
    """A summary section, without what grows with each chunk and channel together.

    Attributes:
        schemas: Schema records by id.
        channels: Channel records by id.
        statistics: The statistics record, if there is one.
        spans: Least and greatest log time of the chunks that hold a channel, by its id.
    """

    schemas: dict[int, mcap_records.Schema] = field(default_factory=dict)
    channels: dict[int, mcap_records.Channel] = field(default_factory=dict)
    statistics: mcap_records.Statistics | None = None
    spans: dict[int, tuple[int, int]] = field(default_factory=dict)
    _chunks: list[tuple[int, int, int, int]] = field(default_factory=list)
    _offsets: array[int] = field(default_factory=lambda: array("Q"))
    _later_starts: array[int] = field(default_factory=lambda: array("Q"))

    @property
    def is_indexed(self) -> bool:
        """Whether the file's chunks are listed."""
        return bool(self._chunks)

    @property
    def start(self) -> int | None:
        """The earliest log time, or None without messages or without knowing."""
        if self.statistics and self.statistics.message_count:
            return self.statistics.message_start_time
        return self._later_starts[0] if self._later_starts else None

    def add_chunk(self, index: mcap_records.ChunkIndex) -> None:
        """Take in what a chunk index tells."""
        holds_channels = index.message_index_offsets
        start, end = index.message_start_time, index.message_end_time
        if not holds_channels and not start and not end:
            return  # no messages: its start of 0 would hold back everything before it
        first = index.chunk_start_offset + index.chunk_length
        self._chunks.append((index.chunk_start_offset, start, first, index.message_index_length))
        for channel_id in holds_channels:
            known = self.spans.get(channel_id, (start, end))
            self.spans[channel_id] = (min(known[0], start), max(known[1], end))

    def finish(self) -> None:
        """Order the chunks as they lie in the file."""
        self._chunks.sort()
        self._offsets = array("Q", (chunk[0] for chunk in self._chunks))
        starts = np.array([chunk[1] for chunk in self._chunks], dtype=np.uint64)
        self._later_starts = array("Q", np.minimum.accumulate(starts[::-1])[::-1].tobytes())

    def later_start(self, offset: int) -> int | None:
        """The earliest log time in the chunks after a byte offset; None after the last."""
        position = bisect.bisect_right(self._offsets, offset)
        return self._later_starts[position] if position < len(self._later_starts) else None

    def stats(self) -> dict[int, ChannelStats]:
        """Counts and spans by channel id; empty where the counts do not add up."""
        statistics = self.statistics
        if not statistics:
            return {}
        counts = statistics.channel_message_counts
        if sum(counts.values()) != statistics.message_count:
            return {}
        whole = statistics.message_start_time, statistics.message_end_time
        stats = {}
        for channel_id in self.channels.keys() | counts.keys():
            count = counts.get(channel_id, 0)
            span = self.spans.get(channel_id, whole) if count else (0, 0)
            stats[channel_id] = ChannelStats(count, *span)
        return stats

    def entries(self, stream: RecordStream) -> Iterator[IndexEntries]:
        """Read the message indexes of all chunks, in the order of the file.

        Raises:
            DamageError: An index record is damaged.
        """
        for chunk, _, first, length in self._chunks:
            stream.seek(first)
            end = first + length
            while stream.tell() < end:
                opcode, body = stream.next()
                if opcode != Opcode.MESSAGE_INDEX:
                    raise DamageError("it stands where a message index should")
                yield _parse_entries(chunk, body)

    def covers(self, count: int) -> bool:
        """Whether so many indexed messages are all that the file has."""
        return self.statistics is not None and self.statistics.message_count == count


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
        The summary, or None where the file has none.

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
    summary = Summary()
    while True:
        opcode, body = stream.next()
        if opcode == Opcode.FOOTER:
            break
        _add(summary, opcode, body)
    summary.finish()
    return summary


def _add(summary: Summary, opcode: int, body: bytes) -> None:
    if opcode == Opcode.SCHEMA:
        schema = parse(mcap_records.Schema, body)
        summary.schemas[schema.id] = schema
    elif opcode == Opcode.CHANNEL:
        channel = parse(mcap_records.Channel, body)
        summary.channels[channel.id] = channel
    elif opcode == Opcode.STATISTICS:
        summary.statistics = parse(mcap_records.Statistics, body)
    elif opcode == Opcode.CHUNK_INDEX:
        summary.add_chunk(parse(mcap_records.ChunkIndex, body))
