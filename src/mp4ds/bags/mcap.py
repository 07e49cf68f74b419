"""Reads MCAP files (https://mcap.dev/spec), whole or in part, and writes them."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
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
from mp4ds.bags.files import (
    SALVAGE_REMEDY,
    DamageError,
    most_held,
    most_unpacked,
    open_source,
    unreadable,
)
from mp4ds.bags.mcap_index import (
    Between,
    ChunkEntry,
    McapSummary,
    look_between,
    read_summary,
)
from mp4ds.bags.mcap_records import (
    MAX_RECORD_BYTES,
    PRIVATE_OPCODE,
    Declared,
    MessageHead,
    RecordStream,
    chunk_records,
    parse,
    parse_message,
    unpack_chunk,
)
from mp4ds.bags.protocols import (
    BagReader,
    BagWriter,
    HoldBack,
    sorted_times,
)
from mp4ds.errors import ConversionError, Mp4dsError, OptionError, SourceError
from mp4ds.records import (
    EVERYTHING,
    Attachment,
    Channel,
    ChannelStats,
    Excerpt,
    Message,
    MetadataRecord,
    Record,
    Schema,
)


def _other_at(stream: RecordStream, place: int, declared: Declared) -> Attachment | MetadataRecord:
    stream.seek(place)
    try:
        record = declared.other(*stream.next())
    except DamageError as error:
        raise stream.damaged(error) from None
    if record is None:
        raise stream.damaged(DamageError("it differs from the one read before"))
    return record


def read_chunks(
    stream: RecordStream,
    excerpt: Excerpt,
    summary: McapSummary,
    between: Between,
    declared: Declared,
) -> Iterator[Record]:
    """Read an excerpt from the chunks that it needs, by their start times, in any file order.

    Args:
        stream: The file.
        excerpt: What to read.
        summary: The file's summary.
        between: The records between its chunks.
        declared: What the file declares, starting with its summary.

    Yields:
        Messages by log time, ties in file order, payloads as stored; attachments and metadata
        records at their places among the chunks.

    Raises:
        SourceError: The file is damaged, or its messages differ from its index.
    """
    others = deque(between.others if excerpt.others else ())
    if excerpt.others:
        for opcode, count in between.private.items():
            declared.skip(opcode, count)
    known = summary.channels.keys()
    unwanted = {key for key in known if not excerpt.has_topic(declared.channels[key].topic)}
    held = HoldBack()
    select = partial(summary.chunks.select, excerpt, unwanted)
    chunks = select() if excerpt.has_messages else ()
    stream.expect((chunk.offset, chunk.offset + chunk.length) for chunk, _ in select())
    for chunk, following in chunks:
        while others and others[0] < chunk.offset:
            yield _other_at(stream, others.popleft(), declared)
        counts_private = excerpt.has_time(chunk.start)  # by one of several spans
        try:
            for kind, part in _records(stream, chunk):
                if kind == Opcode.MESSAGE:
                    head = parse_message(part)
                    _check(head, chunk, summary)
                    if head.channel_id not in unwanted and excerpt.has_time(head.log_time):
                        held.add(declared.message(head, "it"), chunk.offset)
                elif kind < PRIVATE_OPCODE or counts_private:
                    declared.take(kind, part)
        except DamageError as error:
            raise stream.damaged(error) from None
        # Of messages at the very start of the next chunk, some may be before this one.
        yield from held.release(None if following is None else following - 1)
    for place in others:
        yield _other_at(stream, place, declared)


def _records(stream: RecordStream, chunk: ChunkEntry) -> Iterator[tuple[int, memoryview]]:
    """Opcode and body of each record in a chunk."""
    stream.seek(chunk.offset)
    opcode, body = stream.next()
    if opcode != Opcode.CHUNK or stream.tell() != chunk.offset + chunk.length:
        raise DamageError("it is not the chunk that the index lists there")
    content = unpack_chunk(body)
    if len(content) > chunk.size:
        raise DamageError(f"it unpacks to {len(content)} bytes, more than its index says")
    for _, kind, part in chunk_records(content):
        yield kind, part


def _check(head: MessageHead, chunk: ChunkEntry, summary: McapSummary) -> None:
    """Refuse a message that would be missing from an excerpt without this chunk."""
    if not chunk.start <= head.log_time <= chunk.end:
        problem = f"of log time {head.log_time}"
    elif head.channel_id not in summary.channels or (
        chunk.channels and head.channel_id not in chunk.channels
    ):
        problem = f"of channel {head.channel_id}"
    else:
        return
    raise DamageError(f"it holds a message {problem} that its index does not list")


# ---------------------------------------------------------------- the reader


class McapReader(BagReader):
    """Reads an MCAP file.

    Where the file lists its chunks, messages come in log-time order, ties in file order;
    else they come in file order. Every pass reopens the file, so that several may run.

    Args:
        path: The file.
        shown: Its name in errors, where it is a decompressed copy.
        message_decompress: Decompresses the payload of a message; raises `DamageError` if it
            cannot.

    Raises:
        SourceError: The file is missing, not an MCAP file, or cut short.
    """

    format = "mcap"

    def __init__(
        self,
        path: Path,
        *,
        shown: Path | None = None,
        message_decompress: Callable[[memoryview], bytes] | None = None,
    ) -> None:
        self.path = path
        self._shown = shown or path
        self.files = [self._shown]
        self._decompress = message_decompress
        self._declared = Declared()
        self._pass: RecordStream | None = None
        self._position = 0
        self._summary: McapSummary | None = None
        with closing(self._start_pass()) as stream:
            try:
                self._read_ends(stream)
            except DamageError as error:
                raise stream.damaged(error) from None

    def _read_ends(self, stream: RecordStream) -> None:
        opcode, body = stream.next()
        if opcode != Opcode.HEADER:
            raise DamageError("it is in the place of the header")
        header = parse(mcap_records.Header, body)
        self.profile: str = header.profile
        self.library: str = header.library
        self._summary = read_summary(stream)
        if self._summary:
            schemas = self._summary.schemas
            for schema in schemas.values():
                self._declared.add_schema(schema)
            for channel in self._summary.channels.values():
                if not channel.schema_id or channel.schema_id in schemas:
                    self._declared.add_channel(channel)  # otherwise its schema is only in the data

    def _start_pass(self) -> RecordStream:
        file = open_source(self.path, self._shown)
        size = file.seek(0, os.SEEK_END)
        file.seek(0)
        # a small compressed file may hold what claims to be large
        most = MAX_RECORD_BYTES if self._shown == self.path else most_held()
        stream = RecordStream(file, self._shown, size, most)
        try:
            stream.read_magic()
        except BaseException:
            stream.close()
            raise
        return stream

    @property
    def channels(self) -> Sequence[Channel]:
        """All channels known so far: those of the summary, then those found while reading."""
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
        """Whether the file states how many messages each of its channels has."""
        return self._summary is not None and self._summary.statistics is not None

    @property
    def span(self) -> tuple[int, int] | None:
        """Earliest and latest log time in nanoseconds, from the summary; None if not stated."""
        return self._summary.span() if self._summary else None

    @property
    def position(self) -> int:
        """Bytes of the file that `records` has consumed."""
        if self._pass is None or self._shown == self.path:
            return self._pass.tell() if self._pass else self._position
        return self._pass.tell() * self._shown.stat().st_size // max(1, self._pass.size)

    @property
    def is_indexed(self) -> bool:
        """Whether the summary is complete and consistent."""
        return self._between is not None

    @cached_property
    def _between(self) -> Between | None:
        """The records between the chunks, if excerpts can be read from chunks alone."""
        summary = self._summary
        if summary is None:
            return None
        if summary.chunks.held_in_time_order() > protocols.HOLD_BYTES:
            return None
        return self._found_between

    @cached_property
    def _found_between(self) -> Between | None:
        """The records between the chunks if everything is consistent, otherwise None."""
        summary = self._summary
        if summary is None or not summary.is_consistent:
            return None
        with closing(self._start_pass()) as stream:
            found = look_between(stream, summary)
        return found if found.is_sound else None

    @property
    def has_whole_index(self) -> bool:
        """Whether the summary lists all channels, schemas and chunks, and how many messages."""
        return self._found_between is not None

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
            self._position = self._shown.stat().st_size
        finally:
            self._pass = None
            stream.close()

    def _read(self, stream: RecordStream, excerpt: Excerpt) -> Iterator[Record]:
        if self._between and self._summary and self._needs_chunks_alone(self._summary, excerpt):
            yield from self._read_chunks(stream, excerpt, self._summary, self._between)
        else:
            yield from filter(excerpt.has, self._read_through(stream, self._hold_back()))

    @staticmethod
    def _needs_chunks_alone(summary: McapSummary, excerpt: Excerpt) -> bool:
        # The whole is read in file order, unless that is too far from log-time order.
        return excerpt != EVERYTHING or summary.chunks.held_in_file_order() > protocols.HOLD_BYTES

    def _read_chunks(
        self, stream: RecordStream, excerpt: Excerpt, summary: McapSummary, between: Between
    ) -> Iterator[Record]:
        count = 0
        for record in read_chunks(stream, excerpt, summary, between, self._declared):
            if isinstance(record, Message):
                count += 1
                yield self._unpacked(record)
            else:
                yield record
        if excerpt == EVERYTHING and not summary.covers(count):
            raise SourceError(
                self._shown,
                f"is damaged: its chunks hold {count} messages, which its statistics contradict",
                SALVAGE_REMEDY,
            )

    def _hold_back(self) -> HoldBack | None:
        """A buffer that sorts messages, if the file states its chunks' times."""
        return HoldBack() if self._summary and self._summary.chunks.has_messages else None

    def _read_through(self, stream: RecordStream, held: HoldBack | None) -> Iterator[Record]:
        declared = self._declared
        stream.expect([(stream.tell(), stream.size)])
        read = 0
        while True:
            opcode, body = stream.next()
            if opcode == Opcode.FOOTER:
                break
            try:
                for head in self._messages(opcode, body):
                    read += 1
                    message = declared.message(head, f"message {read}")
                    if held is None:
                        yield self._unpacked(message)
                    else:
                        held.add(message)
                record = declared.other(opcode, body)
            except DamageError as error:
                raise stream.damaged(error) from None
            if held is not None and self._summary:
                until = self._summary.chunks.later.after(stream.start)
                yield from map(self._unpacked, held.release(until))
            if record:
                yield record
        stream.read_magic()
        if held is not None:
            yield from map(self._unpacked, held.release(None))

    def _messages(self, opcode: int, body: bytes) -> Iterator[MessageHead]:
        """The messages of a top-level record; schemas and channels are declared on the way."""
        if opcode == Opcode.MESSAGE:
            yield parse_message(body)
        elif opcode == Opcode.CHUNK:
            for _, kind, part in chunk_records(unpack_chunk(body)):
                if kind == Opcode.MESSAGE:
                    yield parse_message(part)
                else:
                    self._declared.take(kind, part)

    def _unpacked(self, message: Message) -> Message:
        """A message with its individually compressed payload decompressed."""
        if self._decompress is None:
            return message
        try:
            data = self._decompress(memoryview(message.data))
        except DamageError as error:
            place = f": message of log time {message.log_time}, topic {message.channel.topic}"
            raise unreadable(self._shown, place, error, SALVAGE_REMEDY) from None
        return Message(
            message.channel, message.log_time, message.publish_time, message.sequence, data
        )

    def _stats(self) -> Mapping[int, ChannelStats]:
        """Counts from the statistics record, spans from the chunks that hold the channel."""
        return self._summary.stats() if self._summary else {}

    def _times(self) -> Mapping[int, NDArray[np.int64]]:
        """Log times by channel id. See `BagReader.times`.

        Times past the year 2262 do not fit and are clamped.
        """
        pieces: dict[int, list[NDArray[np.uint64]]] = {}
        if self._summary and self._summary.chunks.has_messages:
            with closing(self._start_pass()) as stream:
                try:
                    for entries in self._summary.entries(stream):
                        pieces.setdefault(entries.channel_id, []).append(entries.log_times)
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


# ---------------------------------------------------------------- the writer

CHUNK_BYTES = 2**20
MAX_CHANNELS = 2**16 - 1
_COMPRESSION = "_Writer__compression"  # no public name lets one chunk be compressed otherwise

_COMPRESSIONS = {
    "zstd": CompressionType.ZSTD,
    "lz4": CompressionType.LZ4,
    "none": CompressionType.NONE,
}


class McapWriter(BagWriter):
    """Writes an MCAP file with chunks, indexes and checksums.

    Memory is bounded by one chunk, or by one message if that is larger.

    Args:
        path: The file, which is replaced.
        profile: Profile of the header.
        library: Library string of the header; if empty, this library's own.
        compression: Of the chunks: ``zstd``, ``lz4`` or ``none``.
        chunk_size: Bytes of messages after which a chunk is closed.

    Raises:
        OptionError: The compression is unknown.
        Mp4dsError: The installed mcap is too new.
        OSError: It cannot be written.
    """

    format = "mcap"

    def __init__(
        self,
        path: Path,
        *,
        profile: str,
        library: str = "",
        compression: str = "zstd",
        chunk_size: int = CHUNK_BYTES,
    ) -> None:
        if compression not in _COMPRESSIONS:
            raise OptionError(
                f"compression {compression!r} is not known. Use {', '.join(_COMPRESSIONS)}."
            )
        super().__init__()
        self.path = path
        self._compresses = compression != "none"
        self._channel_ids: dict[int, int] = {}
        self._schema_ids: dict[Schema, int] = {}
        self._file = path.open("wb")
        try:
            self._writer: Any = Writer(
                self._file, chunk_size=chunk_size, compression=_COMPRESSIONS[compression]
            )
            if not hasattr(self._writer, _COMPRESSION):  # else noticed at the first large message
                raise Mp4dsError(
                    f"{path}: mcap {mcap.__version__} is newer than this mp4ds supports. Install "
                    f"an older one: pip install 'mcap<{mcap.__version__}'"
                )
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
            raise ConversionError(
                message.channel.topic, "has a time or sequence number that MCAP cannot hold"
            )

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
        is_large = self._compresses and 2 * len(message.data) > most_unpacked(0)
        if is_large and self._compresses_too_well(message.data):
            with self._uncompressed():
                self._add(message)
        else:
            self._add(message)

    @staticmethod
    def _compresses_too_well(data: bytes | memoryview) -> bool:
        """Whether readers could suspect its chunk of claiming more than it holds."""
        return 2 * len(data) > most_unpacked(compressed_size([data]))

    @contextmanager
    def _uncompressed(self) -> Iterator[None]:
        """Turn compression off for the chunk that a message larger than a chunk completes."""
        before = getattr(self._writer, _COMPRESSION)
        setattr(self._writer, _COMPRESSION, CompressionType.NONE)
        try:
            yield
        finally:
            setattr(self._writer, _COMPRESSION, before)

    def _add(self, message: Message) -> None:
        self._writer.add_message(
            self._channel_ids[message.channel.id],
            message.log_time,
            message.data,
            message.publish_time,
            message.sequence,
        )

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
