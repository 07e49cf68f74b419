"""Reads MCAP files (https://mcap.dev/spec)."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from types import TracebackType

import numpy as np
from mcap import records as mcap_records
from mcap.opcode import Opcode
from numpy.typing import NDArray

from mp4ds.bags.mcap_index import Summary, read_summary
from mp4ds.bags.mcap_records import (
    PRIVATE_OPCODE,
    ByteStream,
    DamageError,
    MessageHead,
    RecordStream,
    chunk_record,
    chunk_records,
    open_source,
    parse,
    parse_attachment,
    parse_message,
    unpack_chunk,
)
from mp4ds.bags.mcap_write import McapWriter
from mp4ds.bags.ordering import HoldBack
from mp4ds.bags.protocols import Format
from mp4ds.records import (
    Attachment,
    Channel,
    ChannelStats,
    Message,
    MetadataRecord,
    Record,
    Schema,
)

__all__ = ["McapReader", "McapWriter"]

_INT64_MAX = np.uint64(2**63 - 1)


class McapReader:
    """Reads an MCAP file. See `BagReader`.

    Where the file lists its chunks, messages come in log-time order, ties in file order;
    else they come in file order. Every pass opens the file anew, so that several may run.

    Args:
        path: The file.
        open_stream: Opens what to read instead of the file itself: its content decompressed,
            not seekable, whose ``tell()`` counts bytes of the file.
        message_decompress: Makes the payload of a message from what the file holds; raises
            `DamageError` for what it cannot read.
        in_file_order: Give messages as they stand in the file, whatever their log times.

    Raises:
        SourceError: The file is missing, no MCAP file, or cut short.
    """

    format: Format = "mcap"

    def __init__(
        self,
        path: Path,
        *,
        open_stream: Callable[[], ByteStream] | None = None,
        message_decompress: Callable[[memoryview], bytes] | None = None,
        in_file_order: bool = False,
    ) -> None:
        self.path = path
        self.files: Sequence[Path] = [path]
        self._open_stream = open_stream
        self._decompress = message_decompress
        self._in_file_order = in_file_order
        self._schemas: dict[int, mcap_records.Schema] = {}
        self._channel_records: dict[int, mcap_records.Channel] = {}
        self._channels: dict[int, Channel] = {}
        self._skipped: Counter[str] = Counter()
        self._first: dict[int, Message] | None = None
        self._pass: RecordStream | None = None
        self._position = 0
        self._summary: Summary | None = None
        with closing(self._start_pass()) as stream:
            try:
                self._read_ends(stream)
            except DamageError as error:
                raise stream.damaged(error) from None

    def _read_ends(self, stream: RecordStream) -> None:
        opcode, body = stream.next()
        if opcode != Opcode.HEADER:
            raise DamageError("it stands where the header should")
        header = parse(mcap_records.Header, body)
        self.profile: str = header.profile
        self.library: str = header.library
        self._summary = read_summary(stream)
        if self._summary:
            self._schemas.update(self._summary.schemas)
            for channel in self._summary.channels.values():
                if not channel.schema_id or channel.schema_id in self._schemas:
                    self._add_channel(channel)  # else its schema stands in the data alone

    def _start_pass(self) -> RecordStream:
        if self._open_stream:
            stream = RecordStream(self._open_stream(), self.path, None)
        else:
            file = open_source(self.path)
            stream = RecordStream(file, self.path, os.fstat(file.fileno()).st_size)
        try:
            stream.read_magic()
        except BaseException:
            stream.close()
            raise
        return stream

    @property
    def channels(self) -> Sequence[Channel]:
        """All channels known so far: those of the summary, then those met while reading."""
        return list(self._channels.values())

    @property
    def unused_schemas(self) -> Sequence[Schema]:
        """Schemas that no channel refers to, known so far."""
        used = {channel.schema for channel in self._channels.values()}
        unused = (_schema(record) for record in self._schemas.values())
        return list(dict.fromkeys(schema for schema in unused if schema not in used))

    @property
    def skipped(self) -> Mapping[str, int]:
        """Records that only the application that wrote them understands: name -> count."""
        return dict(self._skipped)

    @property
    def has_statistics(self) -> bool:
        """Whether the file tells how many messages it has."""
        return self._summary is not None and self._summary.statistics is not None

    @property
    def start(self) -> int | None:
        """The earliest log time in nanoseconds as the summary tells; None where it does not."""
        return self._summary.start if self._summary else None

    @property
    def position(self) -> int:
        """Bytes of the file that `records` has consumed."""
        return self._pass.tell() if self._pass else self._position

    def records(self) -> Iterator[Record]:
        """Read everything once. See `BagReader.records`."""
        stream = self._start_pass()
        self._pass = stream
        try:
            yield from self._read(stream)
            self._position = self.path.stat().st_size
        finally:
            self._pass = None
            stream.close()

    def _read(self, stream: RecordStream) -> Iterator[Record]:
        in_time_order = self._summary and self._summary.is_indexed and not self._in_file_order
        held = HoldBack() if in_time_order else None
        self._skipped.clear()
        number = 0
        while True:
            opcode, body = stream.next()
            if opcode == Opcode.FOOTER:
                break
            try:
                for message in self._messages(opcode, body):
                    number += 1
                    read = self._message(message, number)
                    if held is None:
                        yield read
                    else:
                        held.add(read)
                record = self._other(opcode, body)
            except DamageError as error:
                raise stream.damaged(error) from None
            if held is not None and self._summary:
                yield from held.release(self._summary.later_start(stream.start))
            if record:
                yield record
        stream.read_magic()
        if held is not None:
            yield from held.release(None)

    def _messages(self, opcode: int, body: bytes) -> Iterator[MessageHead]:
        """The messages of a top-level record, declaring what stands between them."""
        if opcode == Opcode.MESSAGE:
            yield parse_message(body)
        elif opcode == Opcode.CHUNK:
            for _, kind, part in chunk_records(unpack_chunk(body)):
                if kind == Opcode.MESSAGE:
                    yield parse_message(part)
                else:
                    self._declare(kind, part)

    def _other(self, opcode: int, body: bytes) -> Attachment | MetadataRecord | None:
        """A top-level record that is no message, to pass on."""
        if opcode == Opcode.ATTACHMENT:
            found = parse_attachment(body)
            return Attachment(
                found.name, found.media_type, found.create_time, found.log_time, found.data
            )
        if opcode == Opcode.METADATA:
            record = parse(mcap_records.Metadata, body)
            return MetadataRecord(record.name, record.metadata)
        self._declare(opcode, body)
        return None

    def _declare(self, opcode: int, body: bytes | memoryview) -> None:
        if opcode == Opcode.SCHEMA:
            schema = parse(mcap_records.Schema, body)
            if self._schemas.setdefault(schema.id, schema) != schema:
                raise DamageError(f"schema {schema.id} is defined twice and differently")
        elif opcode == Opcode.CHANNEL:
            self._add_channel(parse(mcap_records.Channel, body))
        elif opcode >= PRIVATE_OPCODE:
            self._skipped[f"private MCAP records (opcode 0x{opcode:02x})"] += 1

    def _add_channel(self, record: mcap_records.Channel) -> None:
        if self._channel_records.setdefault(record.id, record) != record:
            raise DamageError(
                f"channel {record.id} ({record.topic}) is defined twice and differently"
            )
        if record.id not in self._channels:
            schema = self._schemas.get(record.schema_id) if record.schema_id else None
            self._channels[record.id] = Channel(
                record.id,
                record.topic,
                record.message_encoding,
                _schema(schema) if schema else None,
                record.metadata,
            )

    def _message(self, head: MessageHead, number: int) -> Message:
        channel = self._channels.get(head.channel_id)
        if channel is None:
            raise DamageError(
                f"message {number} is of channel {head.channel_id}, which is not defined"
            )
        return self._payload(channel, head, f"message {number}")

    def _payload(self, channel: Channel, head: MessageHead, place: str) -> Message:
        data: bytes | memoryview = head.data
        if self._decompress:
            try:
                data = self._decompress(head.data)
            except DamageError as error:
                raise DamageError(f"{place}, topic {channel.topic}: {error}") from None
        return Message(channel, head.log_time, head.publish_time, head.sequence, data)

    def stats(self) -> Mapping[int, ChannelStats]:
        """Counts by the statistics record, spans by the chunks that hold the channel."""
        return self._summary.stats() if self._summary else {}

    def times(self) -> Mapping[int, NDArray[np.int64]]:
        """Log times by channel id. See `BagReader.times`.

        Times past the year 2262 do not fit and are given as the last one that does.
        """
        pieces: dict[int, list[NDArray[np.uint64]]] = {}
        if self._summary and self._summary.is_indexed:
            with closing(self._start_pass()) as stream:
                try:
                    for entries in self._summary.entries(stream):
                        pieces.setdefault(entries.channel_id, []).append(entries.log_times)
                except DamageError as error:
                    raise stream.damaged(error) from None
            indexed = sum(len(piece) for found in pieces.values() for piece in found)
            if self._summary.covers(indexed):
                return {key: _sorted(np.concatenate(found)) for key, found in pieces.items()}
        return self._times_by_reading()

    def _times_by_reading(self) -> dict[int, NDArray[np.int64]]:
        found: dict[int, list[int]] = {}
        with closing(self._start_pass()) as stream:
            for record in self._read(stream):
                if isinstance(record, Message):
                    found.setdefault(record.channel.id, []).append(record.log_time)
        return {key: _sorted(np.array(times, dtype=np.uint64)) for key, times in found.items()}

    def first(self, channel: Channel) -> Message | None:
        """The channel's first message by log time, or None.

        Without an index this reads the file, once for all channels.
        """
        if self._first is None:
            self._first = self._first_by_index()
        if self._first is None:
            self._first = self._first_by_reading()
        return self._first.get(channel.id)

    def _first_by_index(self) -> dict[int, Message] | None:
        if not self._summary or not self._summary.is_indexed:
            return None
        places: dict[int, tuple[int, int, int]] = {}
        count = 0
        with closing(self._start_pass()) as stream:
            try:
                for entries in self._summary.entries(stream):
                    count += len(entries.log_times)
                    if len(entries.log_times):
                        row = int(np.argmin(entries.log_times))
                        place = (
                            int(entries.log_times[row]),
                            entries.chunk,
                            int(entries.offsets[row]),
                        )
                        known = places.get(entries.channel_id, place)
                        places[entries.channel_id] = min(known, place)
                if not self._summary.covers(count) or not places.keys() <= self._channels.keys():
                    return None
                return dict(self._read_places(stream, places))
            except DamageError as error:
                raise stream.damaged(error) from None

    def _read_places(
        self, stream: RecordStream, places: Mapping[int, tuple[int, int, int]]
    ) -> Iterator[tuple[int, Message]]:
        by_chunk = sorted((chunk, offset, key) for key, (_, chunk, offset) in places.items())
        content: bytes | memoryview = b""
        at = None
        for chunk, offset, channel_id in by_chunk:
            if chunk != at:
                stream.seek(chunk)
                opcode, body = stream.next()
                if opcode != Opcode.CHUNK:
                    raise DamageError("it stands where a chunk should")
                content, at = unpack_chunk(body), chunk
            kind, part, _ = chunk_record(memoryview(content), offset)
            head = parse_message(part) if kind == Opcode.MESSAGE else None
            if head is None or head.channel_id != channel_id:
                raise DamageError("its message index points beside the messages")
            message = self._payload(self._channels[channel_id], head, "the first message")
            yield channel_id, _own_payload(message)

    def _first_by_reading(self) -> dict[int, Message]:
        first: dict[int, Message] = {}
        with closing(self._start_pass()) as stream:
            for record in self._read(stream):
                if isinstance(record, Message):
                    known = first.get(record.channel.id)
                    if known is None or record.log_time < known.log_time:
                        first[record.channel.id] = _own_payload(record)
        return first

    def __enter__(self) -> McapReader:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        tb: TracebackType | None,
    ) -> None:
        if self._pass:
            self._pass.close()


def _schema(record: mcap_records.Schema) -> Schema:
    return Schema(record.name, record.encoding, record.data)


def _own_payload(message: Message) -> Message:
    # A view would keep the whole chunk in memory for as long as the message is kept.
    return Message(
        message.channel,
        message.log_time,
        message.publish_time,
        message.sequence,
        bytes(message.data),
    )


def _sorted(times: NDArray[np.uint64]) -> NDArray[np.int64]:
    return np.sort(np.minimum(times, _INT64_MAX)).astype(np.int64)
