"""Reads what is left of a damaged MCAP file."""

from __future__ import annotations

import contextlib
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap import records as mcap_records
from mcap.opcode import Opcode

from mp4ds.bags.files import DamageError, ZstdStream, open_source
from mp4ds.bags.mcap import McapReader
from mp4ds.bags.mcap_records import (
    MAGIC,
    MAX_RECORD_BYTES,
    Declared,
    chunk_records,
    parse,
    parse_message,
    unpack_chunk,
)
from mp4ds.bags.protocols import HOLD_BYTES, BagReader, HoldBack
from mp4ds.bags.salvage.losses import Draft, FileSalvage, LossLog, Tally
from mp4ds.bags.salvage.mcap_summary import McapFraming, SalvagedSummary, read_summary
from mp4ds.bags.salvage.scan import MAX_UNPROVEN, RecordFrame, Scan, Window, lost_by, unpack
from mp4ds.errors import SourceError
from mp4ds.records import Attachment, Channel, ChannelStats, Message, MetadataRecord, Record, Schema

_CHUNK_HEAD = struct.Struct("<QQQII")
_TIME_END = 14  # of the log time in a message
_MARGIN = 600 * 10**9  # ns; a damaged chunk may seem to end where the next one does
Found = Message | Attachment | MetadataRecord | None


class McapPass:
    """One reading of an MCAP file.

    Args:
        path: Its name.
        window: At its start.
        log: Where losses are recorded.
        declared: Schemas and channels, those of the summary at first.
        summary: Its readable part.
        decompress: Decompresses the payload of a message, if necessary.

    Attributes:
        offset: Byte where the record being read begins.
        found: Number of valid MCAP records found.
        count: Number of messages by the file's statistics; None if unknown.
    """

    def __init__(
        self,
        path: Path,
        window: Window,
        log: LossLog,
        declared: Declared,
        summary: SalvagedSummary,
        decompress: Callable[[memoryview], bytes] | None,
    ) -> None:
        self._path = path
        self._window = window
        self._log = log
        self._declared = declared
        self._summary = summary
        self._decompress = decompress
        self._tally = Tally(log, self._topic_of)
        self._framing = McapFraming(declared.channels)
        self._scan = Scan(window, self._framing, self._lose)
        self._schemas = set[int]()
        if summary.is_verified:
            self._schemas.update(summary.schemas)
        self._undefined: dict[int, int] = {}
        self._plain: _Plain | None = None
        self.offset = 0
        self.found = 0
        self.count = _message_count(summary.statistics)

    def _topic_of(self, channel_id: int) -> str | None:
        channel = self._declared.channels.get(channel_id)
        return channel.topic if channel else None

    def records(self) -> Iterator[Found]:
        """All records in the order of the file; None after each of the file's own records."""
        yield from self._begin()
        ended = False
        while frame := self._scan.next():
            self.found += 1
            self.offset = self._window.offset
            if frame.kind == Opcode.FOOTER:
                ended = True
                self._end(frame)
            else:
                ended = False
                yield from self._record(frame)
            if not self._tally.is_doubtful:
                yield None
        self._leave_plain(Opcode.FOOTER)
        yield from self._tally.settle()
        if not ended:
            self._tally.lost(self._window.offset, None, "the file ends before its footer")
        if problem := self._window.problem:
            self._log.lost(None, None, problem, join=False)
        self._tally.close()
        for channel_id, schema_id in self._undefined.items():
            topic = self._topic_of(channel_id)
            if schema_id not in self._schemas and topic is not None:
                problem = f"the definition of its messages, schema {schema_id}, is missing"
                self._log.lost(None, None, problem).add(0, [topic])

    def _begin(self) -> Iterator[Found]:
        window = self._window
        if bytes(window.peek(len(MAGIC))) == MAGIC:
            window.skip(len(MAGIC))
        else:
            self._scan.resync(0, "the first bytes are not those of an MCAP file", passed=0)
            return
        frame = self._framing.frame(window.peek(self._framing.lookahead))
        if frame is None or frame.kind != Opcode.HEADER or not self._scan.is_followed(frame.size):
            self._scan.resync(window.offset, "the header is damaged", passed=0)
            return
        self.found += 1
        body = self._scan.body(frame)
        try:
            parse(mcap_records.Header, body or b"")
        except DamageError:
            self._lose(len(MAGIC), frame.size, "the header is damaged")
        yield None

    def _end(self, frame: RecordFrame[int]) -> None:
        self._scan.body(frame)
        window = self._window
        if bytes(window.peek(len(MAGIC))) == MAGIC:
            window.skip(len(MAGIC))
        else:
            start = window.offset
            window.skip(len(MAGIC))
            self._lose(start, window.offset - start, "the last bytes are not those of an MCAP file")

    def _record(self, frame: RecordFrame[int]) -> Iterator[Found]:
        self._leave_plain(frame.kind)
        if frame.kind != Opcode.MESSAGE_INDEX and self._plain is None:
            yield from self._tally.settle()
        if frame.kind == Opcode.CHUNK:
            yield from self._chunk(frame)
            return
        offset = self._window.offset
        body = self._scan.body(frame)
        if body is None:
            return
        try:
            if frame.kind == Opcode.MESSAGE:
                yield from self._take(body, offset, is_doubtful=self._plain is not None)
            elif frame.kind == Opcode.MESSAGE_INDEX:
                self._listed(body, offset)
            else:
                yield self._other(frame.kind, body)
        except DamageError as error:
            self._lose(offset, frame.size, str(error))

    def _other(self, opcode: int, body: bytes | memoryview) -> Found:
        """Process a record that is neither message nor chunk.

        Raises:
            DamageError: It is damaged, or contradicts another one.
        """
        if opcode == Opcode.STATISTICS:
            self.count = _message_count(parse(mcap_records.Statistics, body))
        elif opcode == Opcode.SCHEMA:
            self._schemas.add(parse(mcap_records.Schema, body).id)
        elif opcode == Opcode.CHANNEL:
            channel = parse(mcap_records.Channel, body)
            if channel.schema_id and channel.schema_id not in self._schemas:
                self._undefined[channel.id] = channel.schema_id
        return self._declared.other(opcode, body)

    def _take(
        self, body: bytes | memoryview, offset: int, *, is_doubtful: bool
    ) -> Iterator[Message]:
        """Yield a message, or hold it until an index confirms it.

        Raises:
            DamageError: It is shorter than its fields.
        """
        channel_id, time = _key(body)
        if is_doubtful and channel_id not in self._declared.channels:
            return
        message = self._message(memoryview(body), offset)
        if message and is_doubtful:
            self._tally.hold(channel_id, message)
        elif message:
            self._tally.gave(channel_id, time)
            yield message

    def _message(self, body: memoryview, offset: int) -> Message | None:
        """A message; None if it is lost.

        Raises:
            DamageError: It is shorter than its fields.
        """
        head = parse_message(body)
        channel = self._channel(head.channel_id)
        data: bytes | memoryview = head.data
        if channel is None:
            problem = f"messages of channel {head.channel_id}, whose record is missing"
            self._lose_message(head.channel_id, head.log_time, offset, problem)
            return None
        if self._decompress:
            try:
                data = self._decompress(head.data)
            except DamageError as error:
                problem = f"messages of {channel.topic} {lost_by(error)}"
                loss = self._lose_message(head.channel_id, head.log_time, offset, problem)
                loss.topics[channel.topic] = None
                return None
        return Message(channel, head.log_time, head.publish_time, head.sequence, data)

    def _channel(self, channel_id: int) -> Channel | None:
        """The channel with an id; from a doubtful summary only as a last resort."""
        channels = self._declared.channels
        if channel_id not in channels and channel_id in self._summary.doubtful:
            record = self._summary.doubtful[channel_id]
            schema = self._summary.schemas.get(record.schema_id)
            if schema is not None and schema.id not in self._schemas:
                self._schemas.add(schema.id)
                self._declared.add_schema(schema)
            self._declared.add_channel(record)
        return channels.get(channel_id)

    def _lose_message(self, channel_id: int, time: int, offset: int, problem: str) -> Draft:
        self._tally.stray(channel_id, time)
        loss = self._log.lost_of_kind(problem, offset, problem)
        loss.add(1, ())
        return loss

    def _chunk(self, frame: RecordFrame[int]) -> Iterator[Found]:
        """The messages of a chunk, as far as it can be decompressed."""
        window, scan = self._window, self._scan
        offset = window.offset
        proven = scan.is_proven(frame)
        have = window.peek(frame.size if proven else min(frame.size, MAX_UNPROVEN))
        chunk = _Chunk.unpacked(have[frame.head :])
        self._tally.open(None, offset + frame.size, chunk.span)
        if chunk.is_plain and chunk.problem:
            # Its records are in the file like any other: damage to one does not hide the others.
            if chunk.is_doubtful:
                self._plain = _Plain(offset, offset + frame.size, chunk.problem)
            window.skip(frame.head + chunk.head)
            return
        problems = [chunk.problem] if chunk.problem else []
        yield from self._content(chunk, offset, problems)
        end = frame.head + chunk.used
        if proven and (not problems or scan.is_followed(frame.size)):
            window.skip(frame.size)
        elif not problems and scan.is_followed(end):
            window.skip(end)  # the content is complete: the record's length is wrong
        else:
            problem = problems[0] if problems else scan.cut_or_damaged(frame)
            scan.resync(offset, problem, passed=frame.head, kinds=self._framing.outer)
            return
        if problems:
            self._lose(offset, window.offset - offset, problems[0])
        else:
            self._tally.verified()

    def _leave_plain(self, kind: int) -> None:
        """At the end of a damaged uncompressed chunk, record the damage if nothing else did."""
        if self._plain is None:
            return
        start, end, problem = self._plain
        offset = self._window.offset
        if offset < end and kind not in self._framing.outer:
            return
        self._plain = None
        if not self._tally.has_losses:
            self._lose(start, min(offset, end) - start, problem)

    def _content(self, chunk: _Chunk, offset: int, problems: list[str]) -> Iterator[Found]:
        """The records of a chunk."""
        for kind, body in chunk.records or self._scanned(chunk.content, problems):
            try:
                if kind != Opcode.MESSAGE:
                    self._other(kind, body)
                else:
                    yield from self._take(body, offset, is_doubtful=chunk.is_doubtful)
            except DamageError as error:
                problems.append(f"in a chunk, {error}")

    def _scanned(
        self, content: bytes | memoryview, problems: list[str]
    ) -> Iterator[tuple[int, bytes]]:
        """Opcodes and bodies of an unverified chunk."""
        inner = Scan(
            Window.of_content(bytes(content), self._path),
            self._framing,
            lambda _offset, _size, problem: problems.append(f"in a chunk, {problem}"),
        )
        while frame := inner.next():
            body = inner.body(frame)
            if body is not None:
                yield frame.kind, body

    def _listed(self, body: bytes, offset: int) -> None:
        """Process a message index: what it lists was read, or is lost."""
        channel_id, length = struct.unpack_from("<HI", body)
        pairs = np.frombuffer(body, "<u8", count=min(length, len(body) - 6) // 8, offset=6)
        if not self._tally.count_matches(channel_id, len(pairs) // 2, offset):
            times, counts = np.unique(pairs[::2], return_counts=True)
            listed = dict(zip(times.tolist(), counts.tolist(), strict=True))
            self._tally.listed(channel_id, listed)

    def _lose(self, offset: int, size: int, problem: str) -> None:
        if 0 < self._summary.offset <= offset:
            self._log.lost(offset, size, problem).add(0, ())
        else:
            self._tally.lost(offset, size, problem)


class _Plain(NamedTuple):
    """A damaged uncompressed chunk: where it begins and ends, and what is wrong."""

    start: int
    end: int
    problem: str


@dataclass(frozen=True, slots=True)
class _Chunk:
    """The content recovered from a chunk.

    Attributes:
        content: Records.
        is_plain: Whether it is not compressed.
        head: Bytes of the chunk's body before its records.
        used: Bytes of the chunk's body that were used, as far as known.
        problem: What is wrong with it, a phrase; empty if nothing is.
        is_doubtful: Whether the content may differ from what was recorded.
        span: Earliest and latest log time that its messages can have, ns.
        records: Opcodes and bodies, if verified by its checksum; otherwise empty.
    """

    content: bytes | memoryview
    is_plain: bool
    head: int
    used: int
    problem: str
    is_doubtful: bool
    span: tuple[int, int]
    records: Sequence[tuple[int, memoryview]] = ()

    @classmethod
    def unpacked(cls, body: memoryview) -> _Chunk:
        """Decompress the body of a chunk, which may be cut short."""
        if len(body) < _CHUNK_HEAD.size + 8:
            return cls(b"", False, 0, 0, "a chunk is cut short", False, (0, 0))
        start, end, size, crc, name_length = _CHUNK_HEAD.unpack_from(body)
        compression = bytes(body[_CHUNK_HEAD.size :][:name_length]).decode(errors="replace")
        records = _CHUNK_HEAD.size + name_length
        length = int.from_bytes(body[records : records + 8], "little")
        is_plain = not compression
        if is_plain:
            start, end = start - _MARGIN, end + _MARGIN
        if crc:
            with contextlib.suppress(DamageError):
                content = unpack_chunk(body)
                found = [(kind, part) for _, kind, part in chunk_records(content)]
                used = records + 8 + length
                span = (start, end)
                return cls(content, is_plain, records + 8, used, "", False, span, found)
        unpacked = unpack(compression, body[records + 8 :][:length], min(size, MAX_RECORD_BYTES))
        problem = unpacked.problem
        if crc and zlib.crc32(unpacked.content) == crc:
            problem = ""
        elif crc and not problem:
            problem = (
                "a chunk does not match its checksum: its messages were kept, but some are altered"
            )
        used = records + 8 + unpacked.used if unpacked.used else 0
        is_doubtful = bool(problem) and (not unpacked.is_sound or not unpacked.problem)
        return cls(
            unpacked.content, is_plain, records + 8, used, problem, is_doubtful, (start, end)
        )


def _message_count(statistics: mcap_records.Statistics | None) -> int | None:
    """How many messages a file has; None if its statistics contradict themselves."""
    if statistics is None:
        return None
    counts, total = statistics.channel_message_counts, int(statistics.message_count)
    return total if total == sum(counts.values()) else None


def _key(message: bytes | memoryview) -> tuple[int, int]:
    """Channel id and log time of a message, ns."""
    return int.from_bytes(message[:2], "little"), int.from_bytes(message[6:_TIME_END], "little")


# ---------------------------------------------------------------- the reader


class McapSalvage(FileSalvage):
    """Reads what is left of an MCAP file.

    Args:
        path: The file.
        is_alone: See `FileSalvage`.
        is_compressed: Whether it is compressed with zstd as a whole. Offsets of losses then refer
            to its content.
        message_decompress: Decompresses the payload of a message; raises `DamageError` if it
            cannot.

    Raises:
        SourceError: The file is missing, empty, or unreadable.
    """

    format = "mcap"

    def __init__(
        self,
        path: Path,
        *,
        is_alone: bool = True,
        is_compressed: bool = False,
        message_decompress: Callable[[memoryview], bytes] | None = None,
    ) -> None:
        super().__init__(path, is_alone=is_alone)
        open_source(path).close()
        self._is_compressed = is_compressed
        self._decompress = message_decompress
        self._declared = Declared()
        self._given = 0
        self._count: int | None = None
        self._summary = SalvagedSummary() if is_compressed else read_summary(path)
        if is_compressed:
            self._summary.finish()
        self._read_header()
        if not self._summary.is_verified:
            return
        for schema in self._summary.schemas.values():
            self._declared.add_schema(schema)
        for channel in self._summary.channels.values():
            if not channel.schema_id or channel.schema_id in self._summary.schemas:
                self._declared.add_channel(channel)

    def _read_header(self) -> None:
        with self._window() as window:
            frame = bytes(window.peek(2**16))
        if frame[len(MAGIC) : len(MAGIC) + 1] == bytes([Opcode.HEADER]):
            length = int.from_bytes(frame[9:17], "little")
            try:
                header = parse(mcap_records.Header, frame[17 : 17 + length])
            except DamageError:
                return
            self.profile, self.library = header.profile, header.library

    def _window(self) -> Window:
        if self._is_compressed:
            return Window(ZstdStream(self.path, to_damage=True), self.path)
        return Window.of_file(self.path)

    @property
    def channels(self) -> Sequence[Channel]:
        """Channels of the summary, then those found while reading."""
        return list(self._declared.channels.values())

    @property
    def unused_schemas(self) -> Sequence[Schema]:
        """Schemas that no channel refers to, known so far."""
        return self._declared.unused_schemas

    @property
    def skipped(self) -> Mapping[str, int]:
        """Records that only the application that wrote them understands: name -> count."""
        return dict(self._declared.skipped)

    @property
    def has_all_channels(self) -> bool:
        """Whether the file states how many messages it has."""
        return self._summary.statistics is not None

    @property
    def span(self) -> tuple[int, int] | None:
        """Earliest and latest log time from the summary, ns; None if unknown."""
        return self._summary.span()

    def _stats(self) -> Mapping[int, ChannelStats]:
        """Counts and spans from the summary, including lost messages; otherwise empty."""
        return self._summary.stats()

    def _lost_in_all(self) -> int | None:
        return None if self._count is None else max(0, self._count - self._given)

    @property
    def _usual(self) -> Callable[[], BagReader] | None:
        if self._summary.chunks.held_in_file_order() <= HOLD_BYTES:
            return None
        return partial(McapReader, self.path, message_decompress=self._decompress)

    def _pass(self, log: LossLog) -> Iterator[Record]:
        self._declared.skipped.clear()
        self._given = 0
        chunks = self._summary.chunks
        held = HoldBack() if chunks.has_messages else None
        with self._window() as window:
            reading = McapPass(
                self.path, window, log, self._declared, self._summary, self._decompress
            )
            others: list[Record] = []
            for record in reading.records():
                self.position = window.position
                if isinstance(record, Message):
                    self._given += 1
                    if held is None:
                        yield record
                    else:
                        held.add(record)
                elif record is not None:
                    others.append(record)
                else:
                    if held is not None:
                        yield from held.release(chunks.later_start(reading.offset))
                    yield from others
                    others.clear()
            if held is not None:
                yield from held.release(None)
            self.position = window.position
            self._count = reading.count
            if self._is_alone and not reading.found and not self._declared.channels:
                raise SourceError(self.path, "holds no MCAP records")
