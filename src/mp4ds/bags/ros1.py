"""Reads and writes ROS 1 bags of format 2.0 (wiki.ros.org/Bags/Format/2.0).

Connection headers stay as recorded, the index is kept in arrays, and chunks are never decompressed
beyond their declared size.
"""

from __future__ import annotations

import bz2
import struct
from array import array
from collections import OrderedDict, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Literal, NamedTuple

import lz4.frame
import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.files import DamageError
from mp4ds.bags.protocols import BagReader, BagWriter
from mp4ds.bags.ros1_records import (
    CHUNK_COUNT,
    DAMAGE,
    INDEX_ENTRY,
    MAGIC,
    MAX_TIME,
    BagFile,
    Fields,
    Op,
    check_bag,
    check_between,
    count_messages,
    damaged,
    join_header,
    make_channel,
    make_header,
    payload,
    split_header,
    unpack_chunk,
)
from mp4ds.errors import ConversionError, OptionError, TargetExistsError
from mp4ds.files.ranges import expect
from mp4ds.records import Channel, Excerpt, Message, Record

CACHED_CHUNKS = 8
CACHED_BYTES = 64 * 2**20
"""Decompressed chunks are cached up to both limits, but always two: chunks may overlap in time."""

_LATEST = 2**63 - 1  # more than any time of a bag
_CHUNK_HEAD, _INDEX_HEAD = 96, 64  # maximum bytes of the records as usually written


class _Index(NamedTuple):
    """One connection's messages by log time, ties in source order."""

    times: NDArray[np.int64]
    chunks: NDArray[np.int32]
    offsets: NDArray[np.uint32]

    def within(self, excerpt: Excerpt) -> _Index:
        """The messages of an excerpt's span."""
        start, end = (
            None if time is None else int(np.searchsorted(self.times, min(max(time, 0), _LATEST)))
            for time in (excerpt.start, excerpt.end)
        )
        return _Index(self.times[start:end], self.chunks[start:end], self.offsets[start:end])


class Ros1Reader(BagReader):
    """Reads a ROS 1 bag.

    Messages come in log-time order, ties in file order. Payloads are slices of their decompressed
    chunk, which they keep in memory.

    Args:
        path: The file.

    Raises:
        SourceError: The file is missing, not a bag, not indexed, encrypted, or damaged.
    """

    format = "bag"
    profile = "ros1"
    position = 0
    is_indexed = True  # bags without an index are refused

    def __init__(self, path: Path) -> None:
        self.path = path
        self.files = [path]
        self._size = check_bag(path)
        self._chunks: OrderedDict[int, memoryview] = OrderedDict()
        try:
            self._bag = _Bag(path)
        except DAMAGE as error:
            raise damaged(path, error) from None
        try:
            self._index = self._bag.take_index()
            for number, chunk in enumerate(self._bag.chunks):
                if not any(chunk.counts.values()):
                    self._chunk(number)  # otherwise nothing would check whether it holds messages
        except DAMAGE as error:
            self.close()
            raise damaged(path, error) from None

    @property
    def channels(self) -> Sequence[Channel]:
        """All connections, in the order of the bag's index."""
        return list(self._bag.channels.values())

    def _records(self, excerpt: Excerpt) -> Iterator[Record]:
        """Messages in log-time order, from the chunks that hold them."""
        self.position = 0
        visited: set[int] = set()
        for channel, time, chunk, offset in self._entries(excerpt):
            if chunk not in visited:
                visited.add(chunk)
                self.position += self._bag.chunks[chunk].packed
            yield self._message(channel, time, chunk, offset)
        self.position = self._size

    def _entries(self, excerpt: Excerpt) -> Iterator[tuple[Channel, int, int, int]]:
        """Per message: channel, log time, chunk number, offset."""
        channels = [channel for channel in self.channels if excerpt.has_topic(channel.topic)]
        parts = [self._index[channel.id].within(excerpt) for channel in channels]
        if not parts:
            return
        times, chunks, offsets = (np.concatenate(column) for column in zip(*parts, strict=True))
        owners = np.repeat(np.arange(len(parts), dtype=np.int32), [len(p.times) for p in parts])
        order = np.lexsort((offsets, chunks, times))
        self._bag.expect(_first_seen(chunks[order]))
        for start in range(0, len(order), 4096):
            rows = order[start : start + 4096]
            columns = (column[rows].tolist() for column in (owners, times, chunks, offsets))
            for owner, time, chunk, offset in zip(*columns, strict=True):
                yield channels[owner], time, chunk, offset

    def _message(self, channel: Channel, time: int, chunk: int, offset: int) -> Message:
        try:
            data = payload(self._chunk(chunk), offset, channel.id, time)
        except DAMAGE as error:
            place = f": topic {channel.topic}, chunk at byte {self._bag.chunks[chunk].start}"
            raise damaged(self.path, error, place) from None
        return Message(channel, time, time, 0, data)

    def _chunk(self, number: int) -> memoryview:
        """A decompressed chunk, from the cache if possible."""
        if number in self._chunks:
            self._chunks.move_to_end(number)
            return self._chunks[number]
        size = self._bag.chunks[number].size + sum(map(len, self._chunks.values()))
        while len(self._chunks) > 1 and (len(self._chunks) >= CACHED_CHUNKS or size > CACHED_BYTES):
            size -= len(self._chunks.popitem(last=False)[1])
        unpacked = self._chunks[number] = self._bag.content(number)
        return unpacked

    def _times(self) -> Mapping[int, NDArray[np.int64]]:
        """Log times from the index."""
        return {key: index.times for key, index in self._index.items()}

    def close(self) -> None:
        """Close the file."""
        self._chunks.clear()
        self._bag.file.close()


def _first_seen(numbers: NDArray[np.int32]) -> list[int]:
    """The distinct numbers, in order of first appearance."""
    found, places = np.unique(numbers, return_index=True)
    ordered: list[int] = found[np.argsort(places)].tolist()
    return ordered


class _Chunk(NamedTuple):
    """A chunk, from the bag's index and its own header.

    Attributes:
        start: Byte where its record begins.
        counts: Its messages by connection.
        compression: Its name.
        size: Bytes of its content.
        place: Byte where its data begin.
        packed: Bytes of these.
    """

    start: int
    counts: Mapping[int, int]
    compression: str = ""
    size: int = 0
    place: int = 0
    packed: int = 0


class _Bag:
    """A bag and its index.

    Attributes:
        channels: By connection number, in the order of the bag's index.
        chunks: In the order of the index.

    Raises:
        DamageError: The index is damaged or incomplete.
    """

    def __init__(self, path: Path) -> None:
        self.file = BagFile(path)
        self.channels: dict[int, Channel] = {}
        self.chunks: list[_Chunk] = []
        # By connection: raw index entries; number of a chunk and of its entries, alternating.
        self._index_entries: defaultdict[int, bytearray] = defaultdict(bytearray)
        self._index_runs: defaultdict[int, array[int]] = defaultdict(partial(array, "I"))
        try:
            self._read()
        except BaseException:
            self.file.close()
            raise

    def _read(self) -> None:
        file = self.file
        file.seek(len(MAGIC))
        header = file.header(Op.BAG)
        first = file.length() + file.tell()
        index = header.number(b"index_pos", 8)
        file.seek(index)
        for _ in range(header.number(b"conn_count")):
            self._read_connection()
        start = file.tell()
        listed = [self._read_chunk_info() for _ in range(header.number(b"chunk_count"))]
        if self._goes_on():
            raise DamageError("its header declares fewer chunks than its index lists")
        expect(file.stream, self._index_ranges(listed, start))
        ends = {}
        for chunk in listed:
            self.chunks.append(self._read_chunk(chunk))
            for _ in chunk.counts:
                self._read_index()
            ends[chunk.start] = file.tell()
        if len(ends) < len(listed):
            raise DamageError("its index lists a chunk twice")
        # messages that the index does not list would be lost silently
        for chunk_start in sorted(ends):
            check_between(file, first, chunk_start)
            first = ends[chunk_start]
        # a bag without chunks is read to its end: there is no other way to find its index
        check_between(file, first, index if listed else file.size)

    def _goes_on(self) -> bool:
        """Whether a record follows the last one of the index that was read."""
        try:
            return b"op" in self.file.header()
        except DAMAGE:
            return False

    def _read_connection(self) -> None:
        record = self.file.header()
        if record.get(b"op") != bytes([Op.CONNECTION]):
            raise DamageError("a connection record is missing")
        number = record.number(b"conn")
        header = Fields(split_header(self.file.take(self.file.length())))
        channel = make_channel(number, record.get(b"topic", header.get(b"topic", b"")), header)
        self.channels.setdefault(number, channel)  # the first with a number counts, as in ROS

    def _read_chunk_info(self) -> _Chunk:
        header = self.file.header(Op.CHUNK_INFO)
        _check_version(header)
        self.file.length()
        counts = self.file.take(8 * header.number(b"count"))
        return _Chunk(header.number(b"chunk_pos", 8), dict(CHUNK_COUNT.iter_unpack(counts)))

    def _read_chunk(self, chunk: _Chunk) -> _Chunk:
        """A chunk with its header's fields; it will be decompressed to that size."""
        self.file.seek(chunk.start)
        header = self.file.header(Op.CHUNK)
        compression = header.get(b"compression", b"").decode(errors="replace")
        packed, place = self.file.length(), self.file.tell()
        self.file.seek(place + packed)
        return _Chunk(chunk.start, chunk.counts, compression, header.number(b"size"), place, packed)

    def _read_index(self) -> None:
        """Read the index of one connection in the last chunk."""
        header = self.file.header(Op.INDEX)
        _check_version(header)
        number, count = header.number(b"conn"), header.number(b"count")
        entries = self.file.take(self.file.length())
        chunk = self.chunks[-1]
        if (
            chunk.counts.get(number) != count
            or len(entries) != count * INDEX_ENTRY.itemsize
            or number not in self.channels
        ):
            problem = f"the index of the chunk at byte {chunk.start} contradicts the bag's index"
            raise DamageError(problem)
        self._index_entries[number] += entries
        self._index_runs[number].extend((len(self.chunks) - 1, count))

    @staticmethod
    def _index_ranges(chunks: Sequence[_Chunk], end: int) -> Iterator[tuple[int, int]]:
        """The byte ranges of the index: between the data of the chunks."""
        ends = [chunk.start for chunk in chunks[1:]] + [end]
        for chunk, next_start in zip(chunks, ends, strict=True):
            head = chunk.start + _CHUNK_HEAD
            yield chunk.start, head
            entries = (_INDEX_HEAD + INDEX_ENTRY.itemsize * n for n in chunk.counts.values())
            if head < next_start:
                yield max(head, next_start - sum(entries)), next_start

    def expect(self, chunks: Iterable[int]) -> None:
        """Announce which chunks will be read, by number, in order."""
        found = map(self.chunks.__getitem__, chunks)
        expect(self.file.stream, ((one.place, one.place + one.packed) for one in found))

    def content(self, number: int) -> memoryview:
        """A decompressed chunk.

        Raises:
            DamageError: It is damaged, or its number of messages differs from the index.
        """
        chunk = self.chunks[number]
        self.file.seek(chunk.place)
        packed = self.file.take(chunk.packed)
        unpacked = memoryview(unpack_chunk(chunk.compression, chunk.size, packed))
        listed = sum(chunk.counts.values())
        if (found := count_messages(unpacked)) != listed:
            raise DamageError(f"its index lists {listed} messages of {found}")
        return unpacked

    def take_index(self) -> dict[int, _Index]:
        """The index by connection number; frees the raw entries."""
        return {number: self._sorted_index(number) for number in self.channels}

    def _sorted_index(self, number: int) -> _Index:
        entries = np.frombuffer(self._index_entries.pop(number, b""), INDEX_ENTRY)
        runs = np.array(self._index_runs.pop(number, []), np.int64).reshape(-1, 2)
        chunks = np.repeat(runs[:, 0].astype(np.int32), runs[:, 1])
        times = entries["sec"].astype(np.int64) * 10**9 + entries["nsec"]
        if times.max(initial=0) >= MAX_TIME:
            raise DamageError(
                "it has a message with a time past 2^32 seconds, which ROS cannot represent"
            )
        places = chunks.astype(np.int64) << 32 | entries["offset"]
        if len(np.unique(places)) < len(places):
            raise DamageError("its index lists a message twice")
        order = np.lexsort((entries["offset"], chunks, times))
        index = _Index(times[order], chunks[order], entries["offset"][order])
        if np.logical_and.reduce([column[1:] == column[:-1] for column in index]).any():
            raise DamageError("its index lists a message twice")
        return index


def _check_version(header: Fields) -> None:
    if (version := header.number(b"ver")) != 1:
        raise DamageError(f"its index has the unknown version {version}")


# ---------------------------------------------------------------- the writer

_MAX_PAYLOAD = 2**32 - 2**24  # lengths are uint32; leaves room for the rest of the chunk
_CHUNK_BYTES = 2**20
_BAG_HEADER_BYTES = 4096  # padded, so that it can be rewritten at the end
_PAIR = struct.Struct("<II")
_ENTRY = struct.Struct("<III")  # seconds, nanoseconds, offset in the chunk
_MESSAGE_HEAD = struct.Struct("<II3sBI5sII5sIII")  # op, conn, time, and the payload's length


class Ros1Writer(BagWriter):
    """Writes a ROS 1 bag.

    Args:
        path: The file, which must not exist.
        compression: Of the chunks: ``none``, ``bz2`` or ``lz4``.

    Raises:
        OptionError: The compression is unknown.
        TargetExistsError: The file exists.
        OSError: It cannot be written.
    """

    format = "bag"

    def __init__(self, path: Path, compression: Literal["none", "bz2", "lz4"] = "none") -> None:
        if compression not in _COMPRESSORS:
            raise OptionError(f"compression {compression!r} is not known. Use none, bz2 or lz4.")
        if path.exists():
            raise TargetExistsError(path)
        super().__init__()
        self._numbers: dict[int, int] = {}
        self._bag = _BagFile(path, compression)

    @staticmethod
    def check_channel(channel: Channel) -> None:
        """Refuse a channel that a bag cannot hold.

        Raises:
            ConversionError: It is not a ROS 1 channel.
        """
        if channel.message_encoding != "ros1":
            raise ConversionError(
                channel.topic,
                f"its messages are {channel.message_encoding or 'in an unknown encoding'}, and a "
                "ROS 1 bag can only hold ROS 1 messages",
                "Exclude the topic with `exclude`, or unpack to mcap, which keeps it as it is.",
            )

    @staticmethod
    def check_message(message: Message) -> None:
        """Refuse a message that a bag cannot hold.

        Raises:
            ConversionError: It is too long, or its time is outside the range of ROS 1.
        """
        topic = message.channel.topic
        if not 0 <= message.log_time < MAX_TIME:
            raise ConversionError(
                topic,
                f"has a log time of {message.log_time} ns, and ROS 1 can hold 0 to 2^32 seconds",
                "Unpack to mcap, which keeps it as it is.",
            )
        if len(message.data) > _MAX_PAYLOAD:
            raise ConversionError(topic, "has a message too large for a ROS 1 bag")

    def add_channel(self, channel: Channel) -> None:
        """Declare a channel, which gets a connection."""
        self.check_channel(channel)
        if channel.id not in self._numbers:
            self._numbers[channel.id] = self._bag.connect(*make_header(channel))

    def write(self, message: Message) -> None:
        """Append a message, payload verbatim."""
        self.check_message(message)
        if message.publish_time != message.log_time:
            self._omitted["publish times that differ from the log time"] += 1
        if message.sequence:
            self._omitted["sequence numbers of messages"] += 1
        self._bag.append(self._numbers[message.channel.id], message.log_time, message.data)

    def finish(self) -> None:
        """Write the last chunk and the index, and close the file."""
        self._bag.finish()

    def abandon(self) -> None:
        """Close the file as it is."""
        with suppress(OSError):
            self._bag.file.close()


class _BagFile:
    """A bag being written: chunks, each with its index, then all connections and chunk infos.

    Args:
        path: The file, which must not exist.
        compression: A key of `_COMPRESSORS`.

    Attributes:
        file: What is written to.
    """

    def __init__(self, path: Path, compression: str) -> None:
        self._compression = compression
        self._connections: list[bytes] = []
        self._chunk_infos: list[bytes] = []
        self._chunk = BytesIO()
        self._index: dict[int, list[tuple[int, int]]] = {}  # connection -> times and offsets
        self.file = path.open("xb")
        self.file.write(MAGIC)
        self._write_bag_header(0)

    def _write_bag_header(self, index_pos: int) -> None:
        header = _header(
            Op.BAG,
            (b"index_pos", index_pos.to_bytes(8, "little")),
            (b"conn_count", _uint32(len(self._connections))),
            (b"chunk_count", _uint32(len(self._chunk_infos))),
        )
        padding = _BAG_HEADER_BYTES - 4 - len(header)
        self.file.write(header + _uint32(padding) + b" " * padding)

    def connect(self, topic: bytes, header: Iterable[tuple[bytes, bytes]]) -> int:
        """Add a connection with its own header, and return its number."""
        number = len(self._connections)
        record = _header(Op.CONNECTION, (b"conn", _uint32(number)), (b"topic", topic))
        self._connections.append(record + join_header(header))
        self._chunk.write(self._connections[-1])
        return number

    def append(self, number: int, time: int, data: bytes | memoryview) -> None:
        """Add a message of a connection, log time in nanoseconds."""
        self._index.setdefault(number, []).append((time, self._chunk.tell()))
        op, conn = (4, b"op=", Op.MESSAGE), (9, b"conn=", number)
        stamp = (13, b"time=", *divmod(time, 10**9))
        self._chunk.write(_MESSAGE_HEAD.pack(38, *op, *conn, *stamp, len(data)))
        self._chunk.write(data)
        if self._chunk.tell() > _CHUNK_BYTES:
            self._end_chunk()

    def _end_chunk(self) -> None:
        content, self._chunk = self._chunk.getvalue(), BytesIO()
        index, self._index = self._index, {}
        if not content:
            return
        place = self.file.tell()
        packed = _COMPRESSORS[self._compression](content)
        compression = (b"compression", self._compression.encode())
        self.file.write(_header(Op.CHUNK, compression, (b"size", _uint32(len(content)))))
        self.file.write(_uint32(len(packed)))
        self.file.write(packed)
        for number, entries in index.items():
            data = b"".join(_ENTRY.pack(*divmod(time, 10**9), offset) for time, offset in entries)
            counted = ((b"conn", _uint32(number)), (b"count", _uint32(len(entries))))
            self.file.write(_header(Op.INDEX, (b"ver", _uint32(1)), *counted))
            self.file.write(_uint32(len(data)) + data)
        times = [time for entries in index.values() for time, _ in entries] or [0]
        header = _header(
            Op.CHUNK_INFO,
            (b"ver", _uint32(1)),
            (b"chunk_pos", place.to_bytes(8, "little")),
            (b"start_time", _PAIR.pack(*divmod(min(times), 10**9))),
            (b"end_time", _PAIR.pack(*divmod(max(times), 10**9))),
            (b"count", _uint32(len(index))),
        )
        counts = b"".join(_PAIR.pack(number, len(entries)) for number, entries in index.items())
        self._chunk_infos.append(header + _uint32(len(counts)) + counts)

    def finish(self) -> None:
        """Write the last chunk and the index, and close the file."""
        self._end_chunk()
        place = self.file.tell()
        self.file.writelines(self._connections)
        self.file.writelines(self._chunk_infos)
        self.file.seek(len(MAGIC))
        self._write_bag_header(place)
        self.file.close()


def _header(op: Op, *fields: tuple[bytes, bytes]) -> bytes:
    return join_header([(b"op", bytes([op])), *fields])


def _uint32(number: int) -> bytes:
    return number.to_bytes(4, "little")


def _pack_lz4(data: bytes) -> bytes:
    """LZ4 as ROS 1 reads it: independent blocks, a checksum of the content, no size (lz4s.c)."""
    packed: bytes = lz4.frame.compress(
        data,
        block_size=lz4.frame.BLOCKSIZE_MAX1MB,
        block_linked=False,
        content_checksum=True,
        store_size=False,
    )
    return packed


_COMPRESSORS: Mapping[str, Callable[[bytes], bytes]] = {
    "none": bytes,
    "bz2": bz2.compress,
    "lz4": _pack_lz4,
}
