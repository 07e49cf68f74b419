"""Reads MCAP files (https://mcap.dev/spec), whole or in part, and writes them."""

from __future__ import annotations

import zlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing, suppress
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import mcap
import numpy as np
import zstandard
from mcap import records as mcap_records
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from mp4ds._version import __version__
from mp4ds.bags import protocols
from mp4ds.bags.files import SALVAGE_REMEDY, DamageError, most_unpacked
from mp4ds.bags.mcap_records import (
    FRAME,
    MAGIC,
    MAX_RECORD_BYTES,
    PRIVATE_OPCODE,
    ChunkEntry,
    Declared,
    McapSummary,
    RecordStream,
    chunk_records,
    parse,
    read_summary,
    unpack_chunk,
)
from mp4ds.bags.protocols import BagReader, BagWriter, HoldBack, sorted_times
from mp4ds.errors import ConversionError, Mp4dsError, SourceError
from mp4ds.records import (
    EVERYTHING,
    Attachment,
    Channel,
    ChannelStats,
    Excerpt,
    Loss,
    Message,
    MetadataRecord,
    Record,
    Schema,
)


class McapReader(BagReader):
    """Reads an MCAP file.

    Where the file lists its chunks, messages come in log-time order, ties in file order;
    else they come in file order. Every pass reopens the file, so that several may run.

    Args:
        path: The file.
        most: Bytes that a record may have.

    Raises:
        SourceError: The file is missing, not an MCAP file, or cut short.
    """

    format = "mcap"

    def __init__(self, path: Path, *, most: int = MAX_RECORD_BYTES) -> None:
        self.path = path
        self.files = [path]
        self._most = most
        self._declared = declared = Declared()
        self._channels = declared.channels
        self._schemas = declared.schemas.values()
        self._skipped = declared.skipped
        self._pass: RecordStream | None = None
        self._position = 0
        self._summary: McapSummary | None = None
        with closing(self._start_pass()) as stream:
            try:
                opcode, body = stream.next()
                if opcode != Opcode.HEADER:
                    raise DamageError("it is in the place of the header")
                header = parse(mcap_records.Header, body)
                self.profile, self.library = header.profile, header.library
                self._summary = read_summary(stream)
                if self._summary:
                    declared.add_summary(self._summary)
            except DamageError as error:
                raise stream.damaged(error) from None

    def _start_pass(self) -> RecordStream:
        stream = RecordStream(self.path, self._most)
        try:
            stream.read_magic()
        except BaseException:
            stream.close()
            raise
        return stream

    @property
    def span(self) -> tuple[int, int] | None:
        """Earliest and latest log time in nanoseconds, from the summary; None if not stated."""
        return self._summary.span() if self._summary else None

    @property
    def position(self) -> int:
        """Bytes of the file that `records` has consumed."""
        return self._pass.offset if self._pass else self._position

    @property
    def is_indexed(self) -> bool:
        """Whether the summary is complete and consistent, and chunks can be read by their times."""
        return (
            self._summary is not None
            and self._summary.chunks.most_held(by_start=True) <= protocols.HOLD_BYTES
            and self.has_whole_index
        )

    @cached_property
    def has_whole_index(self) -> bool:
        """Whether the summary lists all channels, schemas and chunks, and how many messages."""
        if self._summary is None or not self._summary.is_consistent:
            return False
        with closing(self._start_pass()) as stream:
            return self._summary.look_between(stream)

    def _records(self, excerpt: Excerpt) -> Iterator[Record]:
        """Read everything once, or a part of it."""
        return self._one_pass(lambda stream: self._read(stream, excerpt))

    def as_it_stands(self) -> Iterator[Record]:
        """Read everything once, messages in file order, whatever their log times."""
        return self._one_pass(lambda stream: self._read_through(stream, None))

    def _one_pass(self, read: Callable[[RecordStream], Iterator[Record]]) -> Iterator[Record]:
        stream = self._start_pass()
        self._pass = stream
        self._declared.skipped.clear()
        try:
            yield from read(stream)
            self._position = self.path.stat().st_size
        finally:
            self._pass = None
            stream.close()

    def _read(self, stream: RecordStream, excerpt: Excerpt) -> Iterator[Record]:
        summary = self._summary
        if summary and self.is_indexed:
            # the whole in file order, which no index that lies can spoil, unless that is too far
            # from log-time order
            held_most = summary.chunks.most_held(by_start=False)
            if excerpt != EVERYTHING or held_most > protocols.HOLD_BYTES:
                yield from self._read_chunks(stream, excerpt, summary)
                return
        # a buffer that sorts messages, if the file states its chunks' times
        held = HoldBack() if summary and summary.chunks.has_messages else None
        yield from filter(excerpt.has, self._read_through(stream, held))

    def _read_chunks(
        self, stream: RecordStream, excerpt: Excerpt, summary: McapSummary
    ) -> Iterator[Record]:
        """Read an excerpt from the chunks that it needs, by their start times, in any file order.

        Messages come by log time, ties in file order; attachments and metadata records at their
        places among the chunks.
        """
        declared = self._declared
        others = deque(summary.others if excerpt.others else ())
        if excerpt.others:
            for opcode, count in summary.private.items():
                declared.skip(opcode, count)
        unwanted = {
            key for key in summary.channels if not excerpt.has_topic(declared.channels[key].topic)
        }
        held = HoldBack()
        count = 0
        select = partial(summary.chunks.select, excerpt, unwanted)
        stream.expect((chunk.offset, chunk.offset + chunk.length) for chunk, _ in select())
        for chunk, following in select() if excerpt.has_messages else ():
            while others and others[0] < chunk.offset:
                yield self._other_at(stream, others.popleft())
            counts_private = excerpt.has_time(chunk.start)  # by one of several spans
            try:
                for kind, part in _records_in(stream, chunk):
                    if kind == Opcode.MESSAGE:
                        message = declared.message(part)
                        _check(message, chunk, summary)
                        count += 1
                        if excerpt.has(message):
                            held.add(message, chunk.offset)
                    elif kind < PRIVATE_OPCODE or counts_private:
                        declared.take(kind, part)
            except DamageError as error:
                raise stream.damaged(error) from None
            # Of messages at the very start of the next chunk, some may be before this one.
            until = None if following is None else following - 1
            yield from held.release(until)
        for place in others:
            yield self._other_at(stream, place)
        if excerpt == EVERYTHING and not summary.covers(count):
            problem = f"its chunks hold {count} messages, which its statistics contradict"
            raise SourceError(self.path, f"is damaged: {problem}", SALVAGE_REMEDY)

    def _other_at(self, stream: RecordStream, place: int) -> Attachment | MetadataRecord:
        stream.seek(place)
        try:
            record = self._declared.other(*stream.next())
        except DamageError as error:
            raise stream.damaged(error) from None
        if record is None:
            raise stream.damaged(DamageError("it differs from the one read before"))
        return record

    def _read_through(self, stream: RecordStream, held: HoldBack | None) -> Iterator[Record]:
        declared = self._declared
        stream.expect([(stream.offset, stream.size)])
        read = 0
        while True:
            opcode, body = stream.next()
            if opcode == Opcode.FOOTER:
                break
            try:
                for part in self._messages(opcode, body):
                    read += 1
                    message = declared.message(part, f"message {read}")
                    if held is None:
                        yield message
                    else:
                        held.add(message)
                record = declared.other(opcode, body)
            except DamageError as error:
                raise stream.damaged(error) from None
            if held is not None and self._summary:
                until = self._summary.chunks.later(stream.start)
                yield from held.release(until)
            if record:
                yield record
        stream.read_magic()
        if held is not None:
            yield from held.release(None)

    def _messages(self, opcode: int, body: bytes) -> Iterator[bytes | memoryview]:
        """The messages of a top-level record; schemas and channels are declared on the way."""
        if opcode == Opcode.MESSAGE:
            yield body
        elif opcode == Opcode.CHUNK:
            for kind, part in chunk_records(unpack_chunk(body)):
                if kind == Opcode.MESSAGE:
                    yield part
                else:
                    self._declared.take(kind, part)

    def _stats(self) -> Mapping[int, ChannelStats]:
        """Counts from the statistics record, spans from the chunks that hold the channel."""
        return self._summary.stats() if self._summary else {}

    def _times(self) -> Mapping[int, NDArray[np.int64]]:
        """Log times by channel id; those past the year 2262 do not fit and are clamped."""
        pieces: dict[int, list[NDArray[np.uint64]]] = {}
        if self._summary and self._summary.chunks.has_messages:
            with closing(self._start_pass()) as stream:
                try:
                    for channel_id, times in self._summary.log_times(stream):
                        pieces.setdefault(channel_id, []).append(times)
                except DamageError as error:
                    raise stream.damaged(error) from None
            indexed = sum(len(piece) for found in pieces.values() for piece in found)
            if self._summary.covers(indexed):
                return {key: sorted_times(np.concatenate(found)) for key, found in pieces.items()}
        return super()._times()

    def close(self) -> None:
        """Close the file."""
        if self._pass:
            self._pass.close()


def _records_in(stream: RecordStream, chunk: ChunkEntry) -> Iterator[tuple[int, memoryview]]:
    """Opcode and body of each record in a chunk."""
    stream.seek(chunk.offset)
    opcode, body = stream.next()
    if opcode != Opcode.CHUNK or stream.offset != chunk.offset + chunk.length:
        raise DamageError("it is not the chunk that the index lists there")
    content = unpack_chunk(body)
    if len(content) > chunk.size:
        raise DamageError(f"it unpacks to {len(content)} bytes, more than its index says")
    return chunk_records(content)


def _check(message: Message, chunk: ChunkEntry, summary: McapSummary) -> None:
    """Refuse a message that would be missing from an excerpt without this chunk."""
    channel_id = message.channel.id
    listed = chunk.channels or summary.channels.keys()
    problem = ""
    if not chunk.start <= message.log_time <= chunk.end:
        problem = f"of log time {message.log_time}"
    elif channel_id not in listed or channel_id not in summary.channels:
        problem = f"of channel {channel_id}"
    if problem:
        raise DamageError(f"it holds a message {problem} that its index does not list")


# ---------------------------------------------------------------- the writer

CHUNK_BYTES = 2**20
MAX_CHANNELS = 2**16 - 1
_COMPRESSION = "_Writer__compression"  # no public name lets one chunk be compressed otherwise


class McapWriter(BagWriter):
    """Writes an MCAP file with chunks, indexes and checksums.

    Memory is bounded by one chunk, or by one message if that is larger.

    Args:
        path: The file, which is replaced.
        profile: Profile of the header.
        library: Library string of the header; if empty, this library's own.
        compression: Of the chunks: ``zstd``, ``lz4`` or ``none``.

    Raises:
        Mp4dsError: The installed mcap is too new.
        OSError: It cannot be written.
    """

    def __init__(
        self, path: Path, *, profile: str, library: str = "", compression: str = "zstd"
    ) -> None:
        super().__init__()
        self.path = path
        self._compresses = compression != "none"
        self._channel_ids: dict[int, int] = {}
        self._schema_ids: dict[Schema, int] = {}
        self._file = path.open("wb")
        try:
            kind = CompressionType[compression.upper()]
            self._writer: Any = Writer(self._file, chunk_size=CHUNK_BYTES, compression=kind)
            if not hasattr(self._writer, _COMPRESSION):  # else noticed at the first large message
                remedy = f"Install an older one: pip install 'mcap<{mcap.__version__}'"
                problem = f"mcap {mcap.__version__} is newer than this mp4ds supports"
                raise Mp4dsError(f"{path}: {problem}. {remedy}")
            self._writer.start(profile=profile, library=library or f"mp4ds {__version__}")
        except BaseException:
            self.abandon()
            raise

    @staticmethod
    def check_message(message: Message) -> None:
        """Refuse a message that MCAP cannot hold.

        Raises:
            ConversionError: A time is negative or beyond 64 bits, or the sequence number beyond 32.
        """
        times = message.log_time, message.publish_time
        if not (min(times) >= 0 and max(times) < 2**64 and 0 <= message.sequence < 2**32):
            problem = "has a time or sequence number that MCAP cannot hold"
            raise ConversionError(message.channel.topic, problem)

    def add_schema(self, schema: Schema) -> None:
        """Write a definition, whether a channel refers to it or not."""
        self._schema_id(schema)

    def _schema_id(self, schema: Schema) -> int:
        if schema not in self._schema_ids:
            if len(self._schema_ids) >= MAX_CHANNELS:
                raise ConversionError(schema.name, f"MCAP holds at most {MAX_CHANNELS} schemas")
            self._schema_ids[schema] = self._writer.register_schema(
                schema.name, schema.encoding, schema.data
            )
        return self._schema_ids[schema]

    def add_channel(self, channel: Channel) -> None:
        """Declare a channel, with its schema."""
        if channel.id in self._channel_ids:
            return
        if len(self._channel_ids) >= MAX_CHANNELS:
            raise ConversionError(channel.topic, f"MCAP holds at most {MAX_CHANNELS} channels")
        schema_id = self._schema_id(channel.schema) if channel.schema else 0
        self._channel_ids[channel.id] = self._writer.register_channel(
            channel.topic, channel.message_encoding, schema_id, dict(channel.metadata)
        )

    def write(self, message: Message) -> None:
        """Append a message, payload verbatim."""
        self.check_message(message)
        before = getattr(self._writer, _COMPRESSION)
        # Readers could suspect a chunk that is compressed too well of claiming more than it holds.
        # Such a message is larger than a chunk, and so completes the one that it is in.
        size = 2 * len(message.data)
        is_large = self._compresses and size > most_unpacked(0)
        if is_large and size > most_unpacked(compressed_size([message.data])):
            setattr(self._writer, _COMPRESSION, CompressionType.NONE)
        self._writer.add_message(
            self._channel_ids[message.channel.id],
            message.log_time,
            message.data,
            message.publish_time,
            message.sequence,
        )
        setattr(self._writer, _COMPRESSION, before)

    def flush(self) -> None:
        """Give the system all that was written, so that a reader of damaged files has it."""
        self._writer.flush()

    def add_attachment(self, attachment: Attachment) -> None:
        """Append an attachment."""
        self._writer.add_attachment(
            attachment.create_time,
            attachment.log_time,
            attachment.name,
            attachment.media_type,
            attachment.data,
        )

    def add_metadata(self, record: MetadataRecord) -> None:
        """Append a metadata record."""
        self._writer.add_metadata(record.name, dict(record.metadata))

    def finish(self) -> None:
        """Write the last chunk and the summary, and close the file."""
        self._writer.finish()
        self._file.close()

    def abandon(self) -> None:
        """Close the file as it is."""
        with suppress(OSError):
            self._file.close()


def compressed_size(payloads: Iterable[bytes | memoryview]) -> int:
    """Approximate size of messages in the chunks of an MCAP file, in bytes.

    Args:
        payloads: Of the messages, each as large as a chunk or nearly so.
    """
    return sum(len(zstandard.compress(bytes(payload))) for payload in payloads)


# ---------------------------------------------------------------- copies

_OUTSIDE = {*(Opcode.HEADER, Opcode.METADATA, Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.DATA_END)}
"""What a recorder writes outside of chunks, before the summary."""


def copy_verified(piece: Path, copy: Path) -> list[Loss]:
    """Copy what a recorder wrote, as far as it is certainly that: a power cut may leave zeros.

    Salvage keeps what it can of a chunk that does not match its checksum. Of a recorder's own
    chunks, half a second each, none is worth an image that is not the camera's.

    Args:
        piece: A file of `McapWriter`, perhaps incomplete.
        copy: The file to make.

    Returns:
        What was left out.
    """
    losses: list[Loss] = []
    end = piece.stat().st_size
    with piece.open("rb") as source, copy.open("wb") as target:
        target.write(source.read(len(MAGIC)))
        while head := source.read(FRAME.size):
            offset = source.tell() - len(head)
            kind, size = FRAME.unpack(head.ljust(FRAME.size, b"\0"))
            if kind not in _OUTSIDE or size > min(MAX_RECORD_BYTES, end - source.tell()):
                losses.append(Loss(piece.name, offset, end - offset, "it ends within a record"))
                break
            body = source.read(size)
            try:
                if kind == Opcode.CHUNK:
                    unpack_chunk(body)
            except DamageError:
                problem = "a chunk does not match its checksum"
                losses.append(Loss(piece.name, offset, len(head) + size, problem))
                continue
            target.write(head + body)
            if kind == Opcode.DATA_END:
                place, summary = source.tell(), source.read(MAX_RECORD_BYTES)
                checksum = int.from_bytes(summary[-len(MAGIC) - 4 : -len(MAGIC)], "little")
                if zlib.crc32(summary[: -len(MAGIC) - 4]) == checksum:
                    target.write(summary)
                else:
                    losses.append(Loss(piece.name, place, end - place, "its summary is damaged"))
                break
    return losses
