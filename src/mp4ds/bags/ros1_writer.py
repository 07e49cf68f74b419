"""Writes ROS 1 bags of format 2.0 (wiki.ros.org/Bags/Format/2.0)."""

from __future__ import annotations

import base64
import binascii
import struct
from collections.abc import Iterable
from contextlib import suppress
from io import BytesIO
from pathlib import Path

from mp4ds.bags.protocols import BagWriter
from mp4ds.bags.ros1 import BASE64, MAGIC, MAX_TIME, UINT32, Op, text_of
from mp4ds.errors import ConversionError
from mp4ds.records import Channel, Message

_MAX_PAYLOAD = 2**32 - 2**24  # lengths are uint32; leaves room for the rest of the chunk
_CHUNK_BYTES = 2**20
_BAG_HEADER_BYTES = 4096  # padded, so that it can be rewritten at the end
_PAIR = struct.Struct("<II")
_ENTRY = struct.Struct("<III")  # seconds, nanoseconds, offset in the chunk
_MESSAGE_HEAD = struct.Struct("<II3sBI5sII5sIII")  # op, conn, time, and the payload's length


class Ros1Writer(BagWriter):
    """Writes a ROS 1 bag, whose chunks are not compressed.

    Args:
        path: The file, which must not exist.

    Raises:
        OSError: It cannot be written.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._numbers: dict[int, int] = {}  # of connections, by channel id
        self._connections: list[bytes] = []
        self._chunk_infos: list[bytes] = []
        self._chunk = BytesIO()
        self._index: dict[int, list[tuple[int, int]]] = {}  # connection -> times and offsets
        self._file = path.open("xb")
        self._file.write(MAGIC)
        self._write_bag_header(0)

    def _write_bag_header(self, index_pos: int) -> None:
        header = _header(
            Op.BAG,
            (b"index_pos", index_pos.to_bytes(8, "little")),
            (b"conn_count", UINT32.pack(len(self._connections))),
            (b"chunk_count", UINT32.pack(len(self._chunk_infos))),
        )
        padding = _BAG_HEADER_BYTES - 4 - len(header)
        self._file.write(header + UINT32.pack(padding) + b" " * padding)

    @staticmethod
    def check_channel(channel: Channel) -> None:
        """Refuse a channel that a bag cannot hold.

        Raises:
            ConversionError: It is not a ROS 1 channel.
        """
        if channel.message_encoding != "ros1":
            encoding = channel.message_encoding or "in an unknown encoding"
            problem = f"its messages are {encoding}, and a ROS 1 bag can only hold ROS 1 messages"
            remedy = "Exclude the topic with `exclude`, or unpack to mcap, which keeps it as it is."
            raise ConversionError(channel.topic, problem, remedy)

    @staticmethod
    def check_message(message: Message) -> None:
        """Refuse a message that a bag cannot hold.

        Raises:
            ConversionError: It is too long, or its time is outside the range of ROS 1.
        """
        topic = message.channel.topic
        if not 0 <= message.log_time < MAX_TIME:
            problem = (
                f"has a log time of {message.log_time} ns, and ROS 1 can hold 0 to 2^32 seconds"
            )
            raise ConversionError(topic, problem, "Unpack to mcap, which keeps it as it is.")
        if len(message.data) > _MAX_PAYLOAD:
            raise ConversionError(topic, "has a message too large for a ROS 1 bag")

    def add_channel(self, channel: Channel) -> None:
        """Declare a channel, which gets a connection."""
        if channel.id in self._numbers:
            return
        self.check_channel(channel)
        number = self._numbers[channel.id] = len(self._connections)
        topic, header = _make_header(channel)
        record = _header(Op.CONNECTION, (b"conn", UINT32.pack(number)), (b"topic", topic))
        self._connections.append(record + _join_header(header))
        self._chunk.write(self._connections[-1])

    def write(self, message: Message) -> None:
        """Append a message, payload verbatim."""
        self.check_message(message)
        if message.publish_time != message.log_time:
            self._omitted["publish times that differ from the log time"] += 1
        if message.sequence:
            self._omitted["sequence numbers of messages"] += 1
        number, time = self._numbers[message.channel.id], message.log_time
        self._index.setdefault(number, []).append((time, self._chunk.tell()))
        op, conn = (4, b"op=", Op.MESSAGE), (9, b"conn=", number)
        stamp = (13, b"time=", *divmod(time, 10**9))
        self._chunk.write(_MESSAGE_HEAD.pack(38, *op, *conn, *stamp, len(message.data)))
        self._chunk.write(message.data)
        if self._chunk.tell() > _CHUNK_BYTES:
            self._end_chunk()

    def _end_chunk(self) -> None:
        content, self._chunk = self._chunk.getvalue(), BytesIO()
        index, self._index = self._index, {}
        if not content:
            return
        place = self._file.tell()
        size = UINT32.pack(len(content))
        self._file.write(_header(Op.CHUNK, (b"compression", b"none"), (b"size", size)) + size)
        self._file.write(content)
        for number, entries in index.items():
            data = b"".join(_ENTRY.pack(*divmod(time, 10**9), offset) for time, offset in entries)
            counted = ((b"conn", UINT32.pack(number)), (b"count", UINT32.pack(len(entries))))
            self._file.write(_header(Op.INDEX, (b"ver", UINT32.pack(1)), *counted))
            self._file.write(UINT32.pack(len(data)) + data)
        times = [time for entries in index.values() for time, _ in entries] or [0]
        header = _header(
            Op.CHUNK_INFO,
            (b"ver", UINT32.pack(1)),
            (b"chunk_pos", place.to_bytes(8, "little")),
            (b"start_time", _PAIR.pack(*divmod(min(times), 10**9))),
            (b"end_time", _PAIR.pack(*divmod(max(times), 10**9))),
            (b"count", UINT32.pack(len(index))),
        )
        counts = b"".join(_PAIR.pack(number, len(entries)) for number, entries in index.items())
        self._chunk_infos.append(header + UINT32.pack(len(counts)) + counts)

    def finish(self) -> None:
        """Write the last chunk and the index, and close the file."""
        self._end_chunk()
        place = self._file.tell()
        self._file.writelines(self._connections)
        self._file.writelines(self._chunk_infos)
        self._file.seek(len(MAGIC))
        self._write_bag_header(place)
        self._file.close()

    def abandon(self) -> None:
        """Close the file as it is."""
        with suppress(OSError):
            self._file.close()


def _header(op: Op, *fields: tuple[bytes, bytes]) -> bytes:
    return _join_header([(b"op", bytes([op])), *fields])


def _join_header(fields: Iterable[tuple[bytes, bytes]]) -> bytes:
    """A record's header with its length, from its fields in order."""
    pieces = [name + b"=" + value for name, value in fields]
    body = b"".join(UINT32.pack(len(piece)) + piece for piece in pieces)
    return UINT32.pack(len(body)) + body


def _make_header(channel: Channel) -> tuple[bytes, list[tuple[bytes, bytes]]]:
    """The reverse of `make_channel`: topic of the record, and the connection's own header."""
    others = dict(_restored(key, value) for key, value in channel.metadata.items())
    topic = channel.topic.encode(errors="surrogateescape")
    inner = others.pop(b"topic", topic)
    if text_of(inner) == channel.topic:
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


def _restored(key: str, value: str) -> tuple[bytes, bytes]:
    if key.endswith(BASE64):
        with_name = key[: -len(BASE64)].encode(errors="surrogateescape")
        try:
            return with_name, base64.b64decode(value, validate=True)
        except binascii.Error:
            pass  # a field that happens to have that name
    return key.encode(errors="surrogateescape"), value.encode(errors="surrogateescape")
