"""Reads what is left of a damaged MCAP file."""

from __future__ import annotations

import contextlib
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap import records as mcap_records
from mcap.opcode import Opcode

from mp4ds.bags.files import DamageError, most_held, open_source, recover
from mp4ds.bags.mcap_index import ChunkTable, McapSummary
from mp4ds.bags.mcap_records import (
    FOOTER_BYTES,
    MAGIC,
    MAX_RECORD_BYTES,
    MESSAGE_HEAD,
    OF_SUMMARY,
    Declared,
    chunk_records,
    parse,
    unpack_chunk,
)
from mp4ds.bags.salvage.losses import Draft, FilePass, FileSalvage, LossLog, lost_by
from mp4ds.bags.salvage.scan import MAX_LENGTH, McapFraming, RecordFrame, Scan, Window
from mp4ds.records import Attachment, Channel, ChannelStats, Message, MetadataRecord, Record, Schema

# ---------------------------------------------------------------- the summary

_MAX_SEARCHED = 256 * 2**20


@dataclass
class SalvagedSummary(McapSummary):
    """The readable part of a summary section.

    Attributes:
        is_verified: Whether it matches its checksum, if it has one.
        is_whole: Whether all of it could be read.
    """

    is_verified: bool = True
    is_whole: bool = True

    @property
    def doubtful(self) -> dict[int, mcap_records.Channel]:
        """Channels by id, if the summary does not match its checksum."""
        return {} if self.is_verified else self.channels

    def finish(self) -> None:
        """Finish after everything was added, and drop what depends on its being complete."""
        if not self.is_whole or not self.is_verified:
            self.chunks = ChunkTable()
            self.statistics = None
        self.chunks.finish()


def read_summary(path: Path) -> SalvagedSummary:
    """Read the summary of a file; empty if it has none or its place is unknown.

    Raises:
        SourceError: It cannot be read.
    """
    summary = SalvagedSummary()
    with Window.of_file(path) as window:
        size = window.size or 0
        tail = window.look(size - FOOTER_BYTES, FOOTER_BYTES) if size > FOOTER_BYTES else None
    if tail and tail[0] == Opcode.FOOTER and tail[-len(MAGIC) :] == MAGIC:
        (start,) = struct.unpack_from("<Q", tail, 9)
        if len(MAGIC) < start < size - FOOTER_BYTES:
            summary.is_verified = _matches(path, start, size - len(MAGIC) - 4)
            _read_from(path, start, summary)
    summary.finish()
    return summary


def _matches(path: Path, start: int, end: int) -> bool:
    """Whether the bytes of a summary, up to its checksum, match that."""
    if end - start > _MAX_SEARCHED:
        return True  # checking would take long
    with Window.of_file(path, start) as window:
        covered = window.peek(end - start)
        (told,) = struct.unpack("<I", window.look(end - start, 4) or bytes(4))
        return told in (0, zlib.crc32(covered))


def _read_from(path: Path, start: int, summary: SalvagedSummary) -> None:
    framing = McapFraming({})
    with Window.of_file(path, start) as window:
        is_there = framing.frame(window.peek(framing.lookahead)) is not None
        if not is_there and (window.left or 0) > _MAX_SEARCHED:
            return  # the rest may be anything
        summary.offset = start

        def lose(*_: object) -> None:
            summary.is_whole = False

        scan = Scan(window, framing, lose)
        while frame := scan.next():
            if frame.kind == Opcode.FOOTER:
                return
            if frame.kind not in OF_SUMMARY:
                break
            body = scan.body(frame)
            if body is not None:
                try:
                    summary.add(frame.kind, body)
                except DamageError:
                    summary.is_whole = False
        summary.is_whole = False


# ---------------------------------------------------------------- a pass

_CHUNK_HEAD = struct.Struct("<QQQII")
_MARGIN = 600 * 10**9  # ns; a damaged chunk may seem to end where the next one does
Found = Message | Attachment | MetadataRecord | None


class McapPass(FilePass):
    """One reading of an MCAP file.

    Args:
        path: Its name.
        window: At its start.
        log: Where losses are recorded.
        framing: Of its records.
        declared: Schemas and channels, those of the summary at first.
        summary: Its readable part.
        decompress: Decompresses the payload of a message, if necessary.
    """

    magic = MAGIC
    kind = "an MCAP file"

    def __init__(
        self,
        path: Path,
        window: Window,
        log: LossLog,
        framing: McapFraming,
        declared: Declared,
        summary: SalvagedSummary,
        decompress: Callable[[memoryview], bytes] | None,
    ) -> None:
        super().__init__(path, window, log, framing, declared.channels, summary.offset or None)
        self._declared = declared
        self._summary = summary
        self._decompress = decompress
        self._schemas = set[int]()
        if summary.is_verified:
            self._schemas.update(summary.schemas)
        self._undefined: dict[int, int] = {}
        self._plain: _Plain | None = None
        self.count = _message_count(summary.statistics)

    def records(self) -> Iterator[Found]:
        """All records in the order of the file; None after each of the file's own records."""
        if self._begins():
            self._read_header()
        ended = False
        while frame := self._scan.next():
            self.found += 1
            self.earliest = self._summary.chunks.later.after(self._window.offset)
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
        self._tally.close()
        for channel_id, schema_id in self._undefined.items():
            topic = self._topic_of(channel_id)
            if schema_id not in self._schemas and topic is not None:
                problem = f"the definition of its messages, schema {schema_id}, is missing"
                self._log.lost(None, None, problem).add(0, [topic])

    def _read_header(self) -> None:
        window = self._window
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

    def _end(self, frame: RecordFrame) -> None:
        self._scan.body(frame)
        window = self._window
        if bytes(window.peek(len(MAGIC))) == MAGIC:
            window.skip(len(MAGIC))
        else:
            start = window.offset
            window.skip(len(MAGIC))
            self._lose(start, window.offset - start, "the last bytes are not those of an MCAP file")

    def _record(self, frame: RecordFrame) -> Iterator[Found]:
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
        channel_id = int.from_bytes(body[:2], "little")
        if is_doubtful and channel_id not in self._declared.channels:
            return
        message = self._message(channel_id, body, offset)
        if message and is_doubtful:
            self._tally.hold(channel_id, message)
        elif message:
            self._tally.gave(channel_id, message.log_time)
            yield message

    def _message(self, channel_id: int, body: bytes | memoryview, offset: int) -> Message | None:
        """A message; None if it is lost.

        Raises:
            DamageError: It is shorter than its fields.
        """
        if self._channel(channel_id) is None and len(body) >= MESSAGE_HEAD.size:
            problem = f"messages of channel {channel_id}, whose record is missing"
            self._lose_message(channel_id, offset, problem)
            return None
        message = self._declared.message(body)
        if self._decompress:
            topic = message.channel.topic
            try:
                message = replace(message, data=self._decompress(memoryview(message.data)))
            except DamageError as error:
                problem = f"messages of {topic} {lost_by(error)}"
                loss = self._lose_message(channel_id, offset, problem)
                loss.topics[topic] = None
                return None
        return message

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

    def _lose_message(self, channel_id: int, offset: int, problem: str) -> Draft:
        self._tally.stray(channel_id)
        loss = self._log.lost_of_kind(problem, offset, problem)
        loss.add(1, ())
        return loss

    def _chunk(self, frame: RecordFrame) -> Iterator[Found]:
        """The messages of a chunk, as far as it can be decompressed."""
        offset = self._window.offset
        have, proven = self._peek_chunk(frame)
        chunk = _Chunk.unpacked(have[frame.head :])
        self._tally.open(None, offset + frame.size, chunk.span)
        if chunk.is_plain and chunk.problem:
            # Its records are in the file like any other: damage to one does not hide the others.
            if chunk.is_doubtful:
                self._plain = _Plain(offset, offset + frame.size, chunk.problem)
            self._window.skip(frame.head + chunk.head)
            return
        problems = [chunk.problem] if chunk.problem else []
        yield from self._content(chunk, offset, problems)
        used = frame.head + chunk.used
        self._leave_chunk(frame, used, problems, proven=proven, whole=not chunk.problem)

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
        scanned = ((frame.kind, body) for frame, body in self._inside(chunk.content, problems))
        for kind, body in chunk.records or scanned:
            try:
                if kind != Opcode.MESSAGE:
                    self._other(kind, body)
                else:
                    yield from self._take(body, offset, is_doubtful=chunk.is_doubtful)
            except DamageError as error:
                problems.append(f"in a chunk, {error}")

    def _listed(self, body: bytes, offset: int) -> None:
        """Process a message index: what it lists was read, or is lost."""
        channel_id, length = struct.unpack_from("<HI", body)
        pairs = np.frombuffer(body, "<u8", count=min(length, len(body) - 6) // 8, offset=6)
        self._tally.listed(channel_id, pairs[::2], offset)


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
                found = list(chunk_records(content))
                used = records + 8 + length
                span = (start, end)
                return cls(content, is_plain, records + 8, used, "", False, span, found)
        unpacked = recover(compression, body[records + 8 :][:length], min(size, MAX_RECORD_BYTES))
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


# ---------------------------------------------------------------- the reader


class McapSalvage(FileSalvage):
    """Reads what is left of an MCAP file.

    Args:
        path: The file.
        shown: Its name in losses, if it is a decompressed copy, to which their offsets refer.
        is_alone: Whether it is an error, not just a loss, if nothing can be read.
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
        shown: Path | None = None,
        is_alone: bool = True,
        message_decompress: Callable[[memoryview], bytes] | None = None,
    ) -> None:
        super().__init__(path, shown=shown, is_alone=is_alone)
        open_source(path, shown).close()
        self._decompress = message_decompress
        self._declared = Declared()
        self._summary = read_summary(path)
        self._read_header()
        if self._summary.is_verified:
            self._declared.add_summary(self._summary.schemas, self._summary.channels)

    def _read_header(self) -> None:
        with Window.of_file(self.path) as window:
            frame = bytes(window.peek(2**16))
        if frame[len(MAGIC) : len(MAGIC) + 1] == bytes([Opcode.HEADER]):
            length = int.from_bytes(frame[9:17], "little")
            try:
                header = parse(mcap_records.Header, frame[17 : 17 + length])
            except DamageError:
                return
            self.profile, self.library = header.profile, header.library

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

    def _pass(self, log: LossLog) -> Iterator[Record]:
        self._declared.skipped.clear()
        with Window.of_file(self.path) as window:
            # a small compressed file may hold what claims to be large
            longest = MAX_LENGTH if self.path == self._shown else most_held()
            framing = McapFraming(self._declared.channels, longest)
            reading = McapPass(
                self.path, window, log, framing, self._declared, self._summary, self._decompress
            )
            is_indexed = self._summary.chunks.has_messages
            yield from self._in_order(window, reading, is_indexed=is_indexed)
