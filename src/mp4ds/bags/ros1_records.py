"""The records of a ROS 1 bag, framed and checked (wiki.ros.org/Bags/Format/2.0)."""

from __future__ import annotations

import base64
import binascii
import re
import struct
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from enum import IntEnum
from pathlib import Path
from typing import BinaryIO

import numpy as np

from mp4ds.bags.files import (
    SALVAGE,
    DamageError,
    open_source,
    other_begin,
    unpack,
    unreadable,
)
from mp4ds.errors import SourceError
from mp4ds.records import Channel, Schema

MAGIC = b"#ROSBAG V2.0\n"
MAX_TIME = 2**32 * 10**9
"""A ROS 1 time is two uint32, seconds and nanoseconds: times must be below this."""
UINT32 = struct.Struct("<I")
CHUNK_COUNT = struct.Struct("<II")
"""Of a chunk, in the index: a connection, and its messages."""
INDEX_ENTRY = np.dtype([("sec", "<u4"), ("nsec", "<u4"), ("offset", "<u4")])
"""Of a message, in the index of its chunk: log time, and its place in the content."""
COPY_AGAIN = f"Copy it again, repair it with `rosbag reindex`, or {SALVAGE}"
DAMAGE = (DamageError, OSError)
"""Errors raised while reading a damaged bag, or from a damaged disk."""

_BASE64 = ";base64"  # marks a connection header field that is not UTF-8, as metadata must be


class Op(IntEnum):
    """Kinds of records."""

    MESSAGE = 2
    BAG = 3
    INDEX = 4
    CHUNK = 5
    CHUNK_INFO = 6
    CONNECTION = 7


_MESSAGE_OP = UINT32.pack(4) + b"op=" + bytes([Op.MESSAGE])


class Fields(dict[bytes, bytes]):
    """The fields of a record's header."""

    def number(self, name: bytes, size: int = 4) -> int:
        """A field that is an unsigned number.

        Raises:
            DamageError: It is missing, or has another size.
        """
        value = self.get(name, b"")
        if len(value) != size:
            raise DamageError(f"a record has no field {name.decode()!r} of {size} bytes")
        return int.from_bytes(value, "little")

    def time(self, name: bytes) -> int:
        """A field that is a time, nanoseconds.

        Raises:
            DamageError: It is missing, or has another size.
        """
        nanoseconds, seconds = divmod(self.number(name, 8), 2**32)
        return seconds * 10**9 + nanoseconds

    @property
    def op(self) -> int:
        """The record's kind."""
        return self.number(b"op", 1)


class BagFile:
    """A bag being read record by record.

    Args:
        path: The file.
    """

    def __init__(self, path: Path) -> None:
        self.stream: BinaryIO = open_source(path)
        self.size = path.stat().st_size

    def seek(self, place: int) -> None:
        """Seek to a byte.

        Raises:
            DamageError: The file ends before.
        """
        if place > self.size:
            raise DamageError(f"it has no byte {place}")
        self.stream.seek(place)

    def tell(self) -> int:
        """The position of the next byte to read."""
        return self.stream.tell()

    def take(self, size: int) -> bytes:
        """The next bytes.

        Raises:
            DamageError: There are fewer.
        """
        data = self.stream.read(size) if size <= self.size else b""
        if len(data) != size:
            raise DamageError("a record is cut short")
        return data

    def length(self) -> int:
        """The length of what follows."""
        return int.from_bytes(self.take(4), "little")

    def header(self, op: Op | None = None) -> Fields:
        """The header of the next record.

        Args:
            op: Expected kind; None for any.

        Raises:
            DamageError: It is of another kind, or cut short.
        """
        fields = Fields(split_header(self.take(self.length())))
        if op is not None and fields.op != op:
            raise DamageError(f"a record of kind {fields.op} is where {op.name} should be")
        return fields

    def close(self) -> None:
        """Close the file."""
        self.stream.close()


def _number(data: bytes | memoryview, offset: int) -> int:
    try:
        return int(UINT32.unpack_from(data, offset)[0])
    except struct.error:
        raise DamageError("a record is cut short") from None


def check_bag(path: Path) -> int:
    """Refuse a file that is not a readable bag.

    Returns:
        The file's size, bytes.

    Raises:
        SourceError: It is missing, empty, not a bag, an old or encrypted one, or not indexed.
    """
    with closing(BagFile(path)) as file:
        size = file.size
        start = file.stream.read(32)
        if not start.startswith(MAGIC):
            raise other_format(path, start)
        try:
            file.seek(len(MAGIC))
            header = file.header(Op.BAG)
            index, encryptor = header.number(b"index_pos", 8), header.get(b"encryptor", b"")
        except DAMAGE as error:
            raise damaged(path, error) from None
    if encryptor:
        raise SourceError(path, "is encrypted", "Decrypt it with `rosbag decrypt` first.")
    if index == 0:
        raise SourceError(
            path,
            "is not indexed: the recording was cut short",
            f"Run `rosbag reindex` on it first, or {SALVAGE}",
        )
    if index > size:
        problem = f"is cut short: its index should begin at byte {index}, and it has {size} bytes"
        raise SourceError(path, problem, COPY_AGAIN)
    return size


def other_format(path: Path, start: bytes) -> SourceError:
    """The error for a file that is not a bag of version 2.0.

    Args:
        path: The file.
        start: Its first bytes.
    """
    version = re.match(rb"#ROS(?:BAG|RECORD|LOG) V(\d+\.\d+)", start)
    if version and version[1] != b"2.0":
        return SourceError(
            path,
            f"is a ROS 1 bag of version {version[1].decode()}; only version 2.0 is supported",
            "Convert it first, with `rosbag filter OLD NEW True` of ROS 1.",
        )
    return other_begin(path, "a ROS 1 bag", MAGIC, start)


def damaged(path: Path, error: DamageError | OSError, place: str = "") -> SourceError:
    """What to raise for an error of `DAMAGE`.

    Args:
        path: The bag.
        error: What was raised.
        place: Where in it; comes after "is damaged".
    """
    if isinstance(error, OSError) and error.strerror:
        error = DamageError(f"it cannot be read: {error.strerror}")
    return unreadable(path, place, error, COPY_AGAIN)


def split_header(raw: bytes) -> Iterator[tuple[bytes, bytes]]:
    """The fields of a record's header, in order.

    Raises:
        DamageError: They do not fill the header.
    """
    offset = 0
    while offset < len(raw):
        size = _number(raw, offset)
        offset += 4
        name, equals, value = raw[offset : offset + size].partition(b"=")
        offset += size
        if not equals or offset > len(raw):
            raise DamageError("a record's header is damaged")
        yield name, value


def join_header(fields: Iterable[tuple[bytes, bytes]]) -> bytes:
    """A record's header with its length, from its fields in order."""
    pieces = [name + b"=" + value for name, value in fields]
    body = b"".join(UINT32.pack(len(piece)) + piece for piece in pieces)
    return UINT32.pack(len(body)) + body


def payload(chunk: memoryview, offset: int, number: int, time: int) -> memoryview:
    """The message at an offset in a decompressed chunk.

    Args:
        chunk: The chunk.
        offset: Where the index says that the message is.
        number: Expected connection number.
        time: Expected log time, nanoseconds.

    Raises:
        DamageError: There is another message, or none.
    """
    while True:
        size = _number(chunk, offset)
        fields = Fields(split_header(bytes(chunk[offset + 4 : offset + 4 + size])))
        length = _number(chunk, offset + 4 + size)
        start = offset + 8 + size
        if fields.op != Op.CONNECTION:
            break
        offset = start + length  # some writers let the index point to the connection before it
    if fields.op != Op.MESSAGE:
        raise DamageError("the index does not point to a message")
    if fields.number(b"conn") != number or fields.time(b"time") != time:
        raise DamageError("the index points to another message")
    if start + length > len(chunk):
        raise DamageError("a message is longer than its chunk")
    return chunk[start : start + length]


def count_messages(chunk: memoryview) -> int:
    """Number of messages in a decompressed chunk, whatever the index says.

    Raises:
        DamageError: It ends within a record.
    """
    count = offset = 0
    while offset < len(chunk):
        size = _number(chunk, offset)
        offset += 4 + size
        count += _MESSAGE_OP in bytes(chunk[offset - size : offset])
        offset += 4 + _number(chunk, offset)
    return count


def check_between(file: BagFile, place: int, end: int) -> None:
    """Refuse messages in a range of bytes where the index lists none.

    Raises:
        DamageError: There are some, or something that is not a record.
    """
    while place < end:
        file.seek(place)
        if file.header().op in (Op.CHUNK, Op.MESSAGE):
            raise DamageError(f"its index does not list what it holds at byte {place}")
        place = file.length() + file.tell()


def unpack_chunk(compression: str, size: int, data: bytes) -> bytes:
    """The content of a chunk.

    Args:
        compression: ``none``, ``bz2`` or ``lz4``.
        size: Its decompressed size; decompression never goes beyond it.
        data: The data, as stored.

    Raises:
        DamageError: The data is damaged, or the compression is not known.
    """
    if compression != "none":
        return unpack(compression, data, size)
    if len(data) != size:
        raise DamageError(f"it holds {len(data)} bytes instead of {size}")
    return data


def make_channel(number: int, topic: bytes, header: Mapping[bytes, bytes]) -> Channel:
    """A connection as a channel.

    Its metadata holds ``topic`` only if that differs from the record's: empty if the header has
    none, as in bags of RealSense cameras.

    Args:
        number: The connection's number.
        topic: Topic of the connection record.
        header: The connection's own header, whose topic may differ.
    """
    metadata = {} if b"topic" in header else {"topic": ""}
    for name, value in header.items():
        key, text = _text(name), _text(value)
        if name == b"message_definition":
            continue
        if text.encode() != value:
            metadata[key + _BASE64] = base64.b64encode(value).decode()
        elif name != b"type" and (name, value) != (b"topic", topic):
            metadata[key] = text
    schema = None
    if b"type" in header or b"message_definition" in header:
        encoding = "ros1msg" if b"message_definition" in header else ""
        definition = header.get(b"message_definition", b"")
        schema = Schema(_text(header.get(b"type", b"")), encoding, definition)
    return Channel(number, _text(topic), "ros1", schema, metadata)


def make_header(channel: Channel) -> tuple[bytes, list[tuple[bytes, bytes]]]:
    """The reverse of `make_channel`: topic of the record, and the connection's own header."""
    others = dict(_restored(key, value) for key, value in channel.metadata.items())
    topic = channel.topic.encode(errors="surrogateescape")
    inner = others.pop(b"topic", topic)
    if _text(inner) == channel.topic:
        topic = inner  # neither is UTF-8, and only the inner one was kept byte for byte
    header = {b"topic": inner} if inner else {}
    if channel.schema:
        name = channel.schema.name.encode(errors="surrogateescape")
        header[b"type"] = others.pop(b"type", name)
    if b"md5sum" in others:
        header[b"md5sum"] = others.pop(b"md5sum")
    if channel.schema and channel.schema.encoding:
        header[b"message_definition"] = channel.schema.data
    return topic, [*header.items(), *others.items()]


def _text(raw: bytes) -> str:
    return raw.decode(errors="backslashreplace")


def _restored(key: str, value: str) -> tuple[bytes, bytes]:
    if key.endswith(_BASE64):
        with_name = key[: -len(_BASE64)].encode(errors="surrogateescape")
        try:
            return with_name, base64.b64decode(value, validate=True)
        except binascii.Error:
            pass  # a field that happens to have that name
    return key.encode(errors="surrogateescape"), value.encode(errors="surrogateescape")
