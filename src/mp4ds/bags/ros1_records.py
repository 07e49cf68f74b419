"""The records of a ROS 1 bag, framed and checked (wiki.ros.org/Bags/Format/2.0)."""

from __future__ import annotations

import base64
import binascii
import re
import struct
from bz2 import BZ2Decompressor
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

import lz4.frame
from rosbags.rosbag1 import ReaderError
from rosbags.rosbag1.reader import Header, RecordType, read_uint32

from mp4ds.bags.inflate import most_unpacked
from mp4ds.bags.mcap_records import SALVAGE_REMEDY, open_source, other_begin
from mp4ds.errors import SourceError
from mp4ds.records import Channel, Schema

MAGIC = b"#ROSBAG V2.0\n"
MAX_TIME = 2**32 * 10**9
"""A ROS 1 time is two uint32, seconds and nanoseconds: from here on there are no times."""
UINT32 = struct.Struct("<I")
COPY_AGAIN = f"Copy it again, or repair it with `rosbag reindex`; {SALVAGE_REMEDY}"
DAMAGE = (
    ReaderError,
    AssertionError,
    struct.error,
    ValueError,
    LookupError,
    EOFError,
    OSError,
    RuntimeError,
    MemoryError,
)
"""What reading a damaged bag raises: rosbags checks some of its input by assertions."""

_TIME = struct.Struct("<II")
_MESSAGE_OP = UINT32.pack(4) + b"op=" + bytes([RecordType.MSGDATA])
_BASE64 = ";base64"  # marks a connection header field that is not UTF-8, as metadata must be


def check_bag(path: Path) -> int:
    """Refuse a file that is no readable bag.

    Returns:
        The file's size, bytes.

    Raises:
        SourceError: It is missing, empty, no bag, an old or encrypted one, or not indexed.
    """
    with open_source(path) as stream:
        size = path.stat().st_size
        start = stream.read(32)
        if not start.startswith(MAGIC):
            raise other_format(path, start)
        try:
            stream.seek(len(MAGIC))
            header = Header.read(stream, RecordType.BAGHEADER)
            index, encryptor = header.get_uint64("index_pos"), header.get("encryptor", b"")
        except DAMAGE as error:
            raise SourceError(path, f"is damaged: {reason(error)}", COPY_AGAIN) from None
    if encryptor:
        raise SourceError(path, "is encrypted", "Decrypt it with `rosbag decrypt` first.")
    if index == 0:
        raise SourceError(
            path,
            "is not indexed: the recording was cut short",
            f"Reindex it with `rosbag reindex` first; without that, {SALVAGE_REMEDY}",
        )
    if index > size:
        problem = f"is cut short: its index should begin at byte {index}, and it has {size} bytes"
        raise SourceError(path, problem, COPY_AGAIN)
    return size


def other_format(path: Path, start: bytes) -> SourceError:
    """The error for a file that is no bag of version 2.0.

    Args:
        path: The file.
        start: Its first bytes.
    """
    version = re.match(rb"#ROS(?:BAG|RECORD|LOG) V(\d+\.\d+)", start)
    if version and version[1] != b"2.0":
        return SourceError(
            path,
            f"is a ROS 1 bag of version {version[1].decode()}, and only 2.0 is read",
            "Rewrite it with `rosbag filter OLD NEW True` of ROS 1 first.",
        )
    return other_begin(path, "a ROS 1 bag", MAGIC, start)


def reason(error: BaseException) -> str:
    """What an error of `DAMAGE` means, as the end of a sentence."""
    if isinstance(error, struct.error):
        return "a record is cut short"
    if isinstance(error, MemoryError):
        return "a record has an impossible length"
    if isinstance(error, OSError) and error.strerror:
        return f"it cannot be read: {error.strerror}"
    if not isinstance(error, ReaderError):
        return "a record does not follow the format"
    text = re.sub(r"^Bag index looks damaged: \(.(.*).,\)$", r"\1", str(error)).rstrip(".")
    return text[:1].lower() + text[1:]


def split_header(raw: bytes) -> Iterator[tuple[bytes, bytes]]:
    """The fields of a record's header, in order.

    Raises:
        ReaderError: They do not fill the header.
        struct.error: As above.
    """
    offset = 0
    while offset < len(raw):
        (size,) = UINT32.unpack_from(raw, offset)
        offset += 4
        name, equals, value = raw[offset : offset + size].partition(b"=")
        offset += size
        if not equals or offset > len(raw):
            raise ReaderError("a record's header is damaged")
        yield name, value


def join_header(fields: Iterable[tuple[bytes, bytes]]) -> bytes:
    """A record's header, with its length, of fields in order."""
    pieces = [name + b"=" + value for name, value in fields]
    body = b"".join(UINT32.pack(len(piece)) + piece for piece in pieces)
    return UINT32.pack(len(body)) + body


def payload(chunk: memoryview, offset: int, number: int, time: int) -> memoryview:
    """The message at an offset of an unpacked chunk.

    Args:
        chunk: The chunk.
        offset: Where the index says that the message is.
        number: Number of the connection that it should be of.
        time: Log time that it should have, nanoseconds.

    Raises:
        ReaderError: Another message is there, or none.
        struct.error: The chunk ends before.
    """
    while True:
        (size,) = UINT32.unpack_from(chunk, offset)
        fields = dict(split_header(bytes(chunk[offset + 4 : offset + 4 + size])))
        (length,) = UINT32.unpack_from(chunk, offset + 4 + size)
        start = offset + 8 + size
        if fields.get(b"op") != bytes([RecordType.CONNECTION]):
            break
        offset = start + length  # some writers let the index point to the connection before it
    if fields.get(b"op") != bytes([RecordType.MSGDATA]):
        raise ReaderError("the index does not point to a message")
    found = (UINT32.unpack(fields[b"conn"])[0], *_TIME.unpack(fields[b"time"]))
    if found[0] != number or found[1] * 10**9 + found[2] != time:
        raise ReaderError("the index points to another message")
    if start + length > len(chunk):
        raise ReaderError("a message is longer than its chunk")
    return chunk[start : start + length]


def count_messages(chunk: memoryview) -> int:
    """How many messages an unpacked chunk holds, whatever the index says.

    Raises:
        struct.error: It ends within a record.
    """
    count = offset = 0
    while offset < len(chunk):
        (size,) = UINT32.unpack_from(chunk, offset)
        offset += 4 + size
        count += _MESSAGE_OP in bytes(chunk[offset - size : offset])
        (length,) = UINT32.unpack_from(chunk, offset)
        offset += 4 + length
    return count


def check_between(file: BinaryIO, place: int, end: int) -> None:
    """Refuse messages between two bytes of a bag, where the index lists none.

    Raises:
        ReaderError: There are some, or something that is no record.
    """
    while place < end:
        file.seek(place)
        if Header.read(file).get_uint8("op") in (RecordType.CHUNK, RecordType.MSGDATA):
            raise ReaderError(f"its index does not list what it holds at byte {place}")
        place = read_uint32(file) + file.tell()


def unpack_chunk(compression: str, size: int, data: bytes) -> bytes:
    """The content of a chunk.

    Args:
        compression: ``none``, ``bz2`` or ``lz4``.
        size: What it must unpack to; no more is unpacked, whatever it holds.
        data: As it is in the file.

    Raises:
        ReaderError: The data is damaged, or the compression is not known.
    """
    if compression == "none":
        unpacked = data
    elif compression in ("bz2", "lz4"):
        if size > most_unpacked(len(data)):
            raise ReaderError(f"it promises {size} bytes and has {len(data)}")
        machine = BZ2Decompressor() if compression == "bz2" else lz4.frame.LZ4FrameDecompressor()
        try:
            unpacked = machine.decompress(data, max_length=size + 1)
        except (OSError, RuntimeError):
            raise ReaderError(f"its {compression} data is damaged") from None
        if not machine.eof:
            raise ReaderError(f"its {compression} data does not unpack to {size} bytes")
    else:
        raise ReaderError(f"it is compressed by {compression!r}, which is not known")
    if len(unpacked) != size:
        raise ReaderError(f"it unpacks to {len(unpacked)} bytes instead of {size}")
    return unpacked


def make_channel(number: int, topic: bytes, header: Mapping[bytes, bytes]) -> Channel:
    """A connection as a channel.

    Its metadata holds ``topic`` only where that is not the record's: empty where the header
    has none, as in bags of RealSense cameras.

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
        topic = inner  # both are not UTF-8, and only the inner one was kept byte for byte
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
            pass  # a field that happens to be named so
    return key.encode(errors="surrogateescape"), value.encode(errors="surrogateescape")
