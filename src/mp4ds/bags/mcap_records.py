"""The records of an MCAP file, framed and checked (https://mcap.dev/spec)."""

from __future__ import annotations

import io
import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

from mcap import records as mcap_records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode

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
from mp4ds.errors import SourceError
from mp4ds.files.ranges import expect
from mp4ds.records import Attachment, Channel, Loss, Message, MetadataRecord, Schema

MAGIC = b"\x89MCAP0\r\n"
MAX_RECORD_BYTES = 4 * 2**30
FOOTER_BYTES = 9 + 20 + len(MAGIC)
PRIVATE_OPCODE = 0x80
OF_SUMMARY = frozenset(
    {
        Opcode.SCHEMA,
        Opcode.CHANNEL,
        Opcode.STATISTICS,
        Opcode.CHUNK_INDEX,
        Opcode.ATTACHMENT_INDEX,
        Opcode.METADATA_INDEX,
        Opcode.SUMMARY_OFFSET,
    }
)
CUT_SHORT_REMEDY = f"The recording was cut short: use `mcap recover`, or {SALVAGE}"
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
        start: Byte offset of the record that was read last.
    """

    def __init__(self, path: Path, most: int) -> None:
        self._stream = open_source(path)
        self.path = path
        self.size = self._stream.seek(0, os.SEEK_END)
        self._stream.seek(0)
        self._most = most
        self._offset = 0
        self.start = 0

    def close(self) -> None:
        """Close the stream."""
        self._stream.close()

    def tell(self) -> int:
        """Bytes of the file consumed."""
        return self._offset

    def seek(self, offset: int) -> None:
        """Continue at a byte offset that an index gave."""
        if offset > self.size:
            raise DamageError(f"an index points to byte {offset}, past the end")
        self._stream.seek(offset)
        self._offset = offset

    def expect(self, ranges: Iterable[tuple[int, int]]) -> None:
        """Announce which byte ranges will be read, and in which order."""
        expect(self._stream, ranges)

    def read_magic(self) -> None:
        """Read the magic bytes at the beginning and end of a file."""
        at_start = self._offset == 0
        found = self.read(len(MAGIC))
        if found != MAGIC and at_start:
            raise other_begin(self.path, "an MCAP file", MAGIC, found)
        if found != MAGIC:
            raise self.cut_short()

    def read(self, length: int) -> bytes:
        """Read exactly that many bytes."""
        if length > self.size - self._offset:
            raise self.cut_short()
        try:
            data = self._stream.read(length)
        except OSError as error:
            raise SourceError(self.path, f"cannot be read: {error.strerror or error}") from None
        if len(data) != length:
            raise self.cut_short()
        self._offset += length
        return data

    def next(self) -> tuple[int, bytes]:
        """Read one record.

        Returns:
            Its opcode and its body.
        """
        opcode, length = self._frame()
        if length > MAX_RECORD_BYTES:
            raise SourceError(
                self.path,
                f"holds a record of {length} bytes at byte {self.start}: it is damaged",
                SALVAGE_REMEDY,
            )
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
        self.seek(self._offset + length)
        return opcode

    def _frame(self) -> tuple[int, int]:
        self.start = self._offset
        opcode, length = FRAME.unpack(self.read(FRAME.size))
        return opcode, length

    def cut_short(self) -> SourceError:
        """The error for a file that ends before it should."""
        return SourceError(self.path, "ends before its footer", CUT_SHORT_REMEDY)

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
    content = unpack(compression, data, size) if compression else data
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
            raise DamageError(
                f"channel {record.id} ({record.topic}) is defined twice and differently"
            )
        if record.id not in self.channels:
            self.channels[record.id] = Channel(
                record.id,
                record.topic,
                record.message_encoding,
                self.schemas.get(record.schema_id) if record.schema_id else None,
                record.metadata,
            )

    def add_summary(
        self,
        schemas: Mapping[int, mcap_records.Schema],
        channels: Mapping[int, mcap_records.Channel],
    ) -> None:
        """Add what a summary lists, except channels of which the data alone has the schema."""
        for schema in schemas.values():
            self.add_schema(schema)
        for channel in channels.values():
            if not channel.schema_id or channel.schema_id in schemas:
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
            is_whole = kind in _OUTSIDE and size <= min(MAX_RECORD_BYTES, end - source.tell())
            body = source.read(size) if is_whole else b""
            if not is_whole:
                losses.append(Loss(piece.name, offset, end - offset, "it ends within a record"))
                break
            try:
                if kind == Opcode.CHUNK:
                    unpack_chunk(memoryview(body))
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
