"""The records of an MCAP file, framed and checked, and its summary (https://mcap.dev/spec)."""

from __future__ import annotations

import io
import os
import struct
import zlib
from array import array
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from mcap import records as mcap_records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from numpy.typing import NDArray

from mp4ds.bags.files import (
    SALVAGE,
    SALVAGE_REMEDY,
    DamageError,
    OversizeError,
    open_source,
    other_begin,
    unpack,
    unreadable,
)
from mp4ds.bags.protocols import later_starts
from mp4ds.errors import SourceError
from mp4ds.files.ranges import expect
from mp4ds.records import (
    Attachment,
    Channel,
    ChannelStats,
    Excerpt,
    Message,
    MetadataRecord,
    Schema,
)

MAGIC = b"\x89MCAP0\r\n"
MAX_RECORD_BYTES = 4 * 2**30
FOOTER_BYTES = 9 + 20 + len(MAGIC)
PRIVATE_OPCODE = 0x80
_OF_SUMMARY = {
    *(Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS, Opcode.CHUNK_INDEX),
    *(Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX, Opcode.SUMMARY_OFFSET),
}
_CUT_SHORT_REMEDY = f"The recording was cut short: use `mcap recover`, or {SALVAGE}"
FRAME = struct.Struct("<BQ")
"""Of a record: its opcode, and the length of its body."""
_CHUNK_HEAD = struct.Struct("<QQQII")
MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Of a message: id of its channel, sequence number, log time, publish time."""

_RecordT = TypeVar("_RecordT", bound=mcap_records.McapRecord)


class RecordStream:
    """One pass over the records of an MCAP file.

    Args:
        path: The file.
        most: Bytes that a record may have.

    Attributes:
        size: Bytes of the file.
        offset: Bytes of the file consumed.
        start: Byte offset of the record that was read last.
    """

    def __init__(self, path: Path, most: int) -> None:
        self._stream = open_source(path)
        self.path = path
        self.size = self._stream.seek(0, os.SEEK_END)
        self._stream.seek(0)
        self._most = most
        self.offset = 0
        self.start = 0

    def close(self) -> None:
        """Close the stream."""
        self._stream.close()

    def seek(self, offset: int) -> None:
        """Continue at a byte offset that an index gave."""
        if offset > self.size:
            raise DamageError(f"an index points to byte {offset}, past the end")
        self._stream.seek(offset)
        self.offset = offset

    def expect(self, ranges: Iterable[tuple[int, int]]) -> None:
        """Announce which byte ranges will be read, and in which order."""
        expect(self._stream, ranges)

    def read_magic(self) -> None:
        """Read the magic bytes at the beginning and end of a file."""
        at_start = self.offset == 0
        found = self.read(len(MAGIC))
        if found != MAGIC:
            other = other_begin(self.path, "an MCAP file", MAGIC, found)
            raise other if at_start else self.cut_short()

    def read(self, length: int) -> bytes:
        """Read exactly that many bytes."""
        try:
            data = self._stream.read(length) if length <= self.size - self.offset else b""
        except OSError as error:
            raise SourceError(self.path, f"cannot be read: {error.strerror or error}") from None
        if len(data) != length:
            raise self.cut_short()
        self.offset += length
        return data

    def next(self) -> tuple[int, bytes]:
        """Read one record.

        Returns:
            Its opcode and its body.
        """
        opcode, length = self._frame()
        if length > MAX_RECORD_BYTES:
            problem = f"holds a record of {length} bytes at byte {self.start}: it is damaged"
            raise SourceError(self.path, problem, SALVAGE_REMEDY)
        if length > self._most:
            raise self.damaged(OversizeError(f"it declares {length} bytes", self._most))
        return opcode, self.read(length)

    def skip_record(self) -> int:
        """Go past one record, and return its opcode.

        Raises:
            DamageError: It is too long, or would end past the end of the file.
        """
        opcode, length = self._frame()
        if length > MAX_RECORD_BYTES:
            raise DamageError(f"it says it has {length} bytes")
        self.seek(self.offset + length)
        return opcode

    def _frame(self) -> tuple[int, int]:
        self.start = self.offset
        opcode, length = FRAME.unpack(self.read(FRAME.size))
        return opcode, length

    def cut_short(self) -> SourceError:
        """The error for a file that ends before it should."""
        return SourceError(self.path, "ends before its footer", _CUT_SHORT_REMEDY)

    def damaged(self, problem: DamageError) -> SourceError:
        """The error for a damaged record: the one that was read last."""
        place = f" in its record at byte {self.start}"
        return unreadable(self.path, place, problem, SALVAGE_REMEDY)


class _ExactStream(ReadDataStream):
    def read(self, length: int) -> bytes:
        try:
            data = super().read(length)
        except OverflowError:  # no file is that long
            raise EndOfFile from None
        if len(data) != length:
            raise EndOfFile
        return data


def parse(kind: type[_RecordT], body: bytes | memoryview) -> _RecordT:
    """Parse a small record with the mcap library, never beyond its end.

    Raises:
        DamageError: It lacks what its kind must hold, or does not match its checksum.
    """
    stream = _ExactStream(io.BytesIO(body))
    reader: Any = kind
    try:
        record: _RecordT = reader.read(stream)
    except (EndOfFile, struct.error, OverflowError):
        raise DamageError(f"a record of kind {kind.__name__} is shorter than its fields") from None
    except UnicodeDecodeError:
        problem = f"a record of kind {kind.__name__} holds text that is not UTF-8"
        raise DamageError(problem) from None
    if isinstance(record, mcap_records.Attachment):
        (crc,) = struct.unpack_from("<I", body, stream.count - 4)
        if crc and crc != zlib.crc32(memoryview(body)[: stream.count - 4]):
            raise DamageError(f"the attachment {record.name!r} does not match its checksum")
    return record


def unpack_chunk(body: bytes | memoryview) -> bytes | memoryview:
    """Decompress a chunk and verify its checksum, if it has one.

    Returns:
        The records of the chunk.

    Raises:
        DamageError: The chunk is damaged or compressed in an unknown way.
    """
    view = memoryview(body)
    try:
        *_, size, crc, length = _CHUNK_HEAD.unpack_from(view)
        compression = str(view[_CHUNK_HEAD.size :][:length], "utf-8")
        (data_length,) = struct.unpack_from("<Q", view, _CHUNK_HEAD.size + length)
    except (struct.error, UnicodeDecodeError):
        raise DamageError("a chunk is shorter than its fields") from None
    data = view[_CHUNK_HEAD.size + length + 8 :][:data_length]
    if len(data) != data_length:
        raise DamageError("a chunk is shorter than its fields")
    content = unpack(compression, data, size)[0] if compression else data
    if len(content) != size:
        raise DamageError(f"a chunk holds {len(content)} bytes instead of {size}")
    if crc and crc != zlib.crc32(content):
        raise DamageError("a chunk does not match its checksum")
    return content


def chunk_records(content: bytes | memoryview) -> Iterator[tuple[int, memoryview]]:
    """Walk the records of a decompressed chunk.

    Yields:
        Opcode and body of each; the bodies are views.

    Raises:
        DamageError: It ends within a record.
    """
    view = memoryview(content)
    offset = 0
    while offset < len(view):
        if offset + FRAME.size > len(view):
            raise DamageError("a chunk ends within a record")
        opcode, length = FRAME.unpack_from(view, offset)
        offset += FRAME.size
        if length > len(view) - offset:
            raise DamageError("a chunk ends within a record")
        yield opcode, view[offset : offset + length]
        offset += length


# ---------------------------------------------------------------- what was declared


class Declared:
    """Schemas and channels of one file.

    Attributes:
        channels: By their id in the file, in order of appearance.
        schemas: By their id in the file.
        skipped: Records that only the application that wrote them understands: name -> count.
    """

    def __init__(self) -> None:
        self.channels: dict[int, Channel] = {}
        self.skipped: Counter[str] = Counter()
        self.schemas: dict[int, Schema] = {}
        self._records: dict[int, mcap_records.Channel] = {}

    def take(self, opcode: int, body: bytes | memoryview) -> None:
        """Add a schema or channel, count a private record, ignore any other.

        Raises:
            DamageError: It is damaged, or contradicts what was declared before.
        """
        if opcode == Opcode.SCHEMA:
            self.add_schema(parse(mcap_records.Schema, body))
        elif opcode == Opcode.CHANNEL:
            self.add_channel(parse(mcap_records.Channel, body))
        elif opcode >= PRIVATE_OPCODE:
            self.skip(opcode)

    def add_schema(self, record: mcap_records.Schema) -> None:
        """Add a schema, which must not contradict another one."""
        schema = Schema(record.name, record.encoding, record.data)
        if self.schemas.setdefault(record.id, schema) != schema:
            raise DamageError(f"schema {record.id} is defined twice and differently")

    def add_channel(self, record: mcap_records.Channel) -> None:
        """Add a channel, which must not contradict another one."""
        if self._records.setdefault(record.id, record) != record:
            problem = f"channel {record.id} ({record.topic}) is defined twice and differently"
            raise DamageError(problem)
        if record.id not in self.channels:
            schema = self.schemas.get(record.schema_id) if record.schema_id else None
            self.channels[record.id] = Channel(
                record.id, record.topic, record.message_encoding, schema, record.metadata
            )

    def add_summary(self, summary: McapSummary) -> None:
        """Add what a summary lists, except channels of which the data alone has the schema."""
        for schema in summary.schemas.values():
            self.add_schema(schema)
        for channel in summary.channels.values():
            if not channel.schema_id or channel.schema_id in summary.schemas:
                self.add_channel(channel)

    def skip(self, opcode: int, count: int = 1) -> None:
        """Count private records."""
        self.skipped[f"private MCAP records (opcode 0x{opcode:02x})"] += count

    def message(self, body: bytes | memoryview, place: str = "it") -> Message:
        """A message, with its payload as stored, which is not copied.

        Args:
            body: What the file holds.
            place: Which message it is, for errors.

        Raises:
            DamageError: It is shorter than its fields, or its channel is not defined.
        """
        if len(body) < MESSAGE_HEAD.size:
            raise DamageError("a message is shorter than its fields")
        channel_id, sequence, log_time, publish_time = MESSAGE_HEAD.unpack_from(body)
        channel = self.channels.get(channel_id)
        if channel is None:
            raise DamageError(f"{place} belongs to channel {channel_id}, which is not defined")
        data = memoryview(body)[MESSAGE_HEAD.size :]
        return Message(channel, log_time, publish_time, sequence, data)

    def other(self, opcode: int, body: bytes | memoryview) -> Attachment | MetadataRecord | None:
        """A record that is not a message, to pass on; None if there is nothing to pass on.

        Raises:
            DamageError: It is damaged, or contradicts what was declared before.
        """
        if opcode == Opcode.ATTACHMENT:
            found = parse(mcap_records.Attachment, body)
            return Attachment(
                found.name, found.media_type, found.create_time, found.log_time, found.data
            )
        if opcode == Opcode.METADATA:
            record = parse(mcap_records.Metadata, body)
            return MetadataRecord(record.name, record.metadata)
        self.take(opcode, body)
        return None


# ---------------------------------------------------------------- the summary

_INDEX_HEAD = struct.Struct("<QQQQI")
_INDEX_CHANNEL = np.dtype([("id", "<u2"), ("offset", "<u8")])
_INDEX = np.dtype(
    [(name, np.uint64) for name in ("offset", "length", "indexes", "start", "end", "size")]
)
_LATEST = 2**64 - 1
_MAX_OFFSET = 2**62  # sums of three do not wrap


class ChunkEntry(NamedTuple):
    """A chunk listed in the summary.

    Attributes:
        channels: Ids of the channels with messages in it; empty if not stated, or without messages.
        offset: Byte offset of its record in the file.
        length: Bytes of its record.
        indexes: Bytes of the message indexes after it.
        start: Earliest log time of its messages, nanoseconds; 0 without messages.
        end: Latest log time of its messages, nanoseconds; 0 without messages.
        size: Bytes of its content, decompressed.
    """

    channels: frozenset[int]
    offset: int
    length: int
    indexes: int
    start: int
    end: int
    size: int


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
            start, end, offset, length, map_bytes = _INDEX_HEAD.unpack_from(body)
            after = _INDEX_HEAD.size + map_bytes
            ids = np.frombuffer(body[_INDEX_HEAD.size : after], _INDEX_CHANNEL)["id"]
            index_length, text_bytes = struct.unpack_from("<QI", body, after)
            _, size = struct.unpack_from("<QQ", body, after + 12 + text_bytes)
        except (struct.error, ValueError):
            raise DamageError("a chunk index is shorter than its fields") from None
        self._added.extend((offset, length, index_length, start, end, size))
        self._ids.frombytes(ids.astype(np.uint16).tobytes())
        self._counts.append(len(ids))

    def finish(self) -> None:
        """Sort the chunks by their place in the file."""
        rows = np.array(self._added, np.uint64).view(_INDEX)
        self._added = array("Q")
        order = np.argsort(rows["offset"], kind="stable")
        self._rows = rows[order]
        counts = np.array(self._counts, np.int64)
        self._held = counts[order]
        self._first = (np.cumsum(counts) - counts)[order]
        self._channels = np.array(self._ids, np.uint16)
        self._owners = np.repeat(np.argsort(order).astype(np.int32), counts)
        # A chunk without messages has start 0, which would hold back everything before it.
        starts, ends = self._rows["start"], self._rows["end"]
        self._empty = (self._held == 0) & (starts == 0) & (ends == 0)
        self._known_starts = np.where(self._empty, np.uint64(_LATEST), starts)
        self.later = later_starts(self._rows["offset"], self._known_starts)

    @property
    def has_messages(self) -> bool:
        """Whether it lists a chunk with messages."""
        return not self._empty.all()

    @property
    def is_sound(self) -> bool:
        """Whether the stated places of the chunks are possible."""
        rows = self._rows
        if any(rows[name].max(initial=0) > _MAX_OFFSET for name in ("offset", "length", "indexes")):
            return False
        ends = rows["offset"] + rows["length"] + rows["indexes"]
        return bool(
            (ends[:-1] <= rows["offset"][1:]).all()
            and (rows["start"] <= rows["end"]).all()
            and (rows["size"] <= MAX_RECORD_BYTES).all()
        )

    def span(self) -> tuple[int, int] | None:
        """Earliest and latest log time of all chunks; None without messages."""
        if not self.has_messages:
            return None
        return int(self._known_starts.min()), int(self._rows["end"].max())

    def spans(self) -> dict[int, tuple[int, int]]:
        """Earliest and latest log time of the chunks that hold a channel, by its id.

        Empty if a chunk does not state which channels it holds.
        """
        if ((self._held == 0) & ~self._empty).any():
            return {}
        first, last = np.full(2**16, _LATEST, np.uint64), np.zeros(2**16, np.uint64)
        np.minimum.at(first, self._channels, self._rows["start"][self._owners])
        np.maximum.at(last, self._channels, self._rows["end"][self._owners])
        keys = np.unique(self._channels).tolist()
        return {key: (int(first[key]), int(last[key])) for key in keys}

    def places(self) -> Iterator[tuple[int, int, int]]:
        """Byte offsets of each chunk, of its end, and of that of its message indexes."""
        for offset, length, indexes, *_ in self._rows.tolist():
            yield offset, offset + length, offset + length + indexes

    def _by_start(self, numbers: NDArray[np.intp]) -> NDArray[np.intp]:
        return numbers[np.argsort(self._rows["start"][numbers], kind="stable")]

    def most_held(self, *, by_start: bool) -> int:
        """Maximum bytes held back for earlier messages, if chunks are read by start or place."""
        if not len(self):
            return 0
        order = np.arange(len(self))
        if by_start:
            order = self._by_start(order)
        following = np.minimum.accumulate(self._known_starts[order][::-1])[::-1][1:]
        ends, sizes = self._rows["end"], self._rows["size"].astype(np.int64)
        sizes[self._empty] = 0
        by_end = np.argsort(ends)
        gone = np.concatenate(([0], np.cumsum(sizes[by_end])))
        past = gone[np.searchsorted(ends[by_end], following)]
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
        mask = np.ones(len(self), np.bool_)
        start, end = excerpt.start or 0, excerpt.end
        if start > _LATEST:
            mask[:] = False
        elif start > 0:
            mask &= self._rows["end"] >= np.uint64(start)
        if end is not None and end <= _LATEST:
            mask &= self._rows["start"] < np.uint64(max(end, 0))
        if unwanted:
            wanted = ~np.isin(self._channels, np.array(sorted(unwanted), np.uint16))
            holds = self._held == 0
            holds[self._owners[wanted]] = True
            mask &= holds
        order = self._by_start(np.flatnonzero(mask | self._empty))
        for place, number in enumerate(order, 1):
            following = int(self._rows["start"][order[place]]) if place < len(order) else None
            first = self._first[number]
            channels = self._channels[first : first + self._held[number]].tolist()
            yield ChunkEntry(frozenset(channels), *self._rows[number].tolist()), following


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
            while stream.offset < end:
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
        try:
            for start, _, end in (*self.chunks.places(), (self.offset, 0, 0)):
                if place < start:
                    stream.seek(place)
                while place < start:
                    opcode = stream.skip_record()
                    if opcode in (Opcode.ATTACHMENT, Opcode.METADATA):
                        self.others.append(place)
                    elif opcode >= PRIVATE_OPCODE:
                        self.private[opcode] += 1
                    elif opcode in (Opcode.MESSAGE, Opcode.CHUNK, Opcode.FOOTER):
                        return False
                    place = stream.offset
                if place != start:
                    return False
                place = end
        except (DamageError, SourceError):
            return False  # reading everything will show what is wrong
        return True

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
    place, _ = summary_place(stream)
    if not place:
        return None
    stream.seek(place)
    summary = summary or McapSummary()
    summary.offset = place
    while True:
        opcode, body = stream.next()
        if opcode == Opcode.FOOTER:
            break
        if opcode not in _OF_SUMMARY and opcode < PRIVATE_OPCODE:
            return None  # bytes between records of the data do not make a complete file
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
    summary.chunks.finish()
    return summary
