"""Writes ROS 1 bags of format 2.0 (wiki.ros.org/Bags/Format/2.0)."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, Literal

import lz4.frame
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag1,
    MessageDefinition,
    MessageDefinitionFormat,
)
from rosbags.rosbag1 import Writer
from rosbags.rosbag1.writer import WriteChunk

from mp4ds.bags.ros1_records import MAX_TIME, UINT32, Op, join_header, make_header
from mp4ds.errors import ConversionError, OptionError, TargetExistsError
from mp4ds.records import Attachment, Channel, Message, MetadataRecord, Schema

_MAX_PAYLOAD = 2**32 - 2**24  # lengths are uint32; leaves room for the rest of the chunk
_CHUNK_BYTES = 2**20
_MESSAGE_HEAD = struct.Struct("<II3sBI5sII5sIII")  # op, conn, time, and the payload's length


def check_channel(channel: Channel) -> None:
    """Refuse a channel that a bag cannot hold.

    Raises:
        ConversionError: It is not of ROS 1.
    """
    if channel.message_encoding != "ros1":
        raise ConversionError(
            channel.topic,
            f"its messages are {channel.message_encoding or 'of no known encoding'}, "
            "and a ROS 1 bag holds only those of ROS 1",
            "Exclude the topic with `exclude`, or unpack to mcap, which keeps it as it is.",
        )


def check_message(message: Message) -> None:
    """Refuse a message that a bag cannot hold.

    Raises:
        ConversionError: It is too long, or of a time that ROS 1 does not have.
    """
    topic = message.channel.topic
    if not 0 <= message.log_time < MAX_TIME:
        raise ConversionError(
            topic,
            f"has a log time of {message.log_time} ns, and ROS 1 can hold 0 to 2^32 seconds",
            "Unpack to mcap, which keeps it as it is.",
        )
    if len(message.data) > _MAX_PAYLOAD:
        raise ConversionError(topic, "has a message of more bytes than a ROS 1 bag can hold")


class Ros1Writer:
    """Writes a ROS 1 bag. See `BagWriter`.

    Args:
        path: The file, which must not exist.
        compression: Of the chunks: ``none``, ``bz2`` or ``lz4``.

    Raises:
        OptionError: The compression is unknown.
        TargetExistsError: The file exists.
        OSError: The disk refused.
    """

    format = "bag"

    def __init__(self, path: Path, compression: Literal["none", "bz2", "lz4"] = "none") -> None:
        if compression not in ("none", "bz2", "lz4"):
            raise OptionError(f"compression {compression!r} is not known. Use none, bz2 or lz4.")
        if path.exists():
            raise TargetExistsError(path)
        self._numbers: dict[int, int] = {}
        self._omitted: Counter[str] = Counter()
        self._bag = _BagWriter(path)
        if compression != "none":
            self._bag.set_compression(Writer.CompressionFormat[compression.upper()])
        if compression == "lz4":
            self._bag.compressor = _pack_lz4
        self._bag.open()

    @property
    def omitted(self) -> Mapping[str, int]:
        """What a bag has no place for. See `BagWriter.omitted`."""
        return dict(self._omitted)

    def add_channel(self, channel: Channel) -> None:
        """Declare a channel. See `BagWriter.add_channel`."""
        check_channel(channel)
        if channel.id not in self._numbers:
            self._numbers[channel.id] = self._bag.declare(*make_header(channel))

    def add_schema(self, schema: Schema) -> None:
        """Count a definition that no channel refers to as omitted."""
        self._omitted["definitions that no topic uses"] += 1

    def write(self, message: Message) -> None:
        """Append a message, payload verbatim."""
        check_message(message)
        if message.publish_time != message.log_time:
            self._omitted["publish times that differ from the log time"] += 1
        if message.sequence:
            self._omitted["sequence numbers of messages"] += 1
        self._bag.append(self._numbers[message.channel.id], message.log_time, message.data)

    def add_attachment(self, attachment: Attachment) -> None:
        """Count an attachment as omitted."""
        self._omitted["attachments"] += 1

    def add_metadata(self, record: MetadataRecord) -> None:
        """Count a metadata record as omitted."""
        self._omitted["metadata records"] += 1

    def __enter__(self) -> Ros1Writer:
        return self

    def __exit__(self, exc_type: type[BaseException] | None, *_: object) -> None:
        try:
            if exc_type is None:
                self._bag.close()
        finally:
            if self._bag.bio:
                with suppress(OSError):
                    self._bag.bio.close()


class _Connection(Connection):
    """A connection of rosbags that knows its own record."""

    record: bytes


class _BagWriter(Writer):
    """rosbags' writer, with verbatim connection headers and an index of bounded size."""

    def declare(self, topic: bytes, header: Sequence[tuple[bytes, bytes]]) -> int:
        """Add a connection by its header, and return its number."""
        connection = _Connection(
            len(self.connections),
            "",
            "",
            MessageDefinition(MessageDefinitionFormat.NONE, ""),
            "",
            0,
            ConnectionExtRosbag1(None, None),
            self,
        )
        number = UINT32.pack(connection.id)
        record = ((b"op", bytes([Op.CONNECTION])), (b"conn", number), (b"topic", topic))
        connection.record = join_header(record) + join_header(header)
        self.write_connection(connection, self.chunks[-1].data)
        self.connections.append(connection)
        return connection.id

    @staticmethod
    def write_connection(connection: Connection, bio: BinaryIO) -> None:
        """Write a connection record."""
        if isinstance(connection, _Connection):
            bio.write(connection.record)

    def append(self, number: int, time: int, data: bytes | memoryview) -> None:
        """Write a message; rosbags' own method searches all connections for each."""
        chunk = self.chunks[-1]
        chunk.connections[number].append((time, chunk.data.tell()))
        chunk.start, chunk.end = min(chunk.start, time), max(chunk.end, time)
        op, conn = (4, b"op=", Op.MESSAGE), (9, b"conn=", number)
        stamp = (13, b"time=", *divmod(time, 10**9))
        chunk.data.write(_MESSAGE_HEAD.pack(38, *op, *conn, *stamp, len(data)))
        chunk.data.write(data)
        if chunk.data.tell() > _CHUNK_BYTES:
            self.write_chunk(chunk)

    def write_chunk(self, chunk: WriteChunk) -> None:
        """Write a chunk, and keep of its index only the counts, which `close` needs."""
        super().write_chunk(chunk)
        counts: Any = {number: range(len(found)) for number, found in chunk.connections.items()}
        chunk.connections = counts


def _pack_lz4(data: bytes) -> bytes:
    """LZ4 as ROS 1 reads it: independent blocks, a checksum of the content, no size.

    rosbags writes frames that ROS 1 refuses (roslz4, lz4s.c).
    """
    packed: bytes = lz4.frame.compress(
        data,
        block_size=lz4.frame.BLOCKSIZE_MAX1MB,
        block_linked=False,
        content_checksum=True,
        store_size=False,
    )
    return packed
