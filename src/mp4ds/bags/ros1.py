"""Reads ROS 1 bags of format 2.0 (wiki.ros.org/Bags/Format/2.0), and takes their records apart.

Connection headers stay as recorded, the index is kept in arrays, and chunks are never decompressed
beyond their declared size.
"""

from __future__ import annotations

import base64
import re
import struct
from array import array
from collections import OrderedDict, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from enum import IntEnum
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.files import SALVAGE, DamageError, open_source, other_begin, unpack, unreadable
from mp4ds.bags.protocols import BagReader
from mp4ds.errors import SourceError
from mp4ds.files.ranges import expect
from mp4ds.records import Channel, Excerpt, Message, Record, Schema

MAGIC = b"#ROSBAG V2.0\n"
MAX_TIME = 2**32 * 10**9
"""A ROS 1 time is two uint32, seconds and nanoseconds: times must be below this."""
UINT32 = struct.Struct("<I")
CHUNK_COUNT = struct.Struct("<II")
"""Of a chunk, in the index: a connection, and its messages."""
INDEX_ENTRY = np.dtype([("sec", "<u4"), ("nsec", "<u4"), ("offset", "<u4")])
"""Of a message, in the index of its chunk: log time, and its place in the content."""
BASE64 = ";base64"
"""Ending of the key of a connection header field that is not UTF-8, as metadata must be."""

_COPY_AGAIN = f"Copy it again, repair it with `rosbag reindex`, or {SALVAGE}"
_DAMAGE = (DamageError, OSError)  # raised while reading a damaged bag, or from a damaged disk

# ---------------------------------------------------------------- records


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


def _number(data: bytes | memoryview, offset: int) -> int:
    try:
        return int(UINT32.unpack_from(data, offset)[0])
    except struct.error:
        raise DamageError("a record is cut short") from None


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


def _payload(chunk: memoryview, offset: int, number: int, time: int) -> memoryview:
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


def _count_messages(chunk: memoryview) -> int:
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


def other_format(path: Path, start: bytes) -> SourceError:
    """The error for a file that is not a bag of version 2.0.

    Args:
        path: The file.
        start: Its first bytes.
    """
    version = re.match(rb"#ROS(?:BAG|RECORD|LOG) V(\d+\.\d+)", start)
    if version and version[1] != b"2.0":
        problem = f"is a ROS 1 bag of version {version[1].decode()}; only version 2.0 is supported"
        remedy = "Convert it first, with `rosbag filter OLD NEW True` of ROS 1."
        return SourceError(path, problem, remedy)
    return other_begin(path, "a ROS 1 bag", MAGIC, start)


def _damaged(path: Path, error: DamageError | OSError, place: str = "") -> SourceError:
    """What to raise for an error of `_DAMAGE`.

    Args:
        path: The bag.
        error: What was raised.
        place: Where in it; comes after "is damaged".
    """
    if isinstance(error, OSError) and error.strerror:
        error = DamageError(f"it cannot be read: {error.strerror}")
    return unreadable(path, place, error, _COPY_AGAIN)


def times_in(entries: NDArray[Any]) -> NDArray[np.int64]:
    """The log times in an index, nanoseconds."""
    times: NDArray[np.int64] = entries["sec"].astype(np.int64) * 10**9 + entries["nsec"]
    return times


def connection_of(record: Fields, body: bytes) -> Channel:
    """The channel that a connection record declares.

    Args:
        record: Its header.
        body: The connection's own header.

    Raises:
        DamageError: It is not one.
    """
    header = dict(split_header(body))
    topic = record.get(b"topic", header.get(b"topic", b""))
    return make_channel(record.number(b"conn"), topic, header)


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
        key, text = text_of(name), text_of(value)
        if name == b"message_definition":
            continue
        if text.encode() != value:
            metadata[key + BASE64] = base64.b64encode(value).decode()
        elif name != b"type" and (name, value) != (b"topic", topic):
            metadata[key] = text
    schema = None
    if b"type" in header or b"message_definition" in header:
        encoding = "ros1msg" if b"message_definition" in header else ""
        definition = header.get(b"message_definition", b"")
        schema = Schema(text_of(header.get(b"type", b"")), encoding, definition)
    return Channel(number, text_of(topic), "ros1", schema, metadata)


def text_of(raw: bytes) -> str:
    """A field as text; what is not UTF-8 in it is escaped."""
    return raw.decode(errors="backslashreplace")


# ---------------------------------------------------------------- the reader

CACHED_CHUNKS = 8
CACHED_BYTES = 64 * 2**20
"""Decompressed chunks are cached up to both limits, but always two: chunks may overlap in time."""

_LATEST = 2**63 - 1  # more than any time of a bag
_CHUNK_HEAD, _INDEX_HEAD = 96, 64  # maximum bytes of the records as usually written


_PLACE = np.dtype([("time", np.int64), ("chunk", np.int32), ("offset", np.uint32)])
"""Of a message: its log time, and its place."""


class _Chunk(NamedTuple):
    """A chunk.

    Attributes:
        start: Byte where its record begins.
        counts: Its messages by connection, from the bag's index.
        compression: The name of that, from its own header as all that follows.
        size: Bytes of its content.
        place: Byte where its data begin.
        packed: Bytes of these.
    """

    start: int
    counts: Mapping[int, int]
    compression: str
    size: int
    place: int
    packed: int


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
        self._stream = open_source(path)
        self._size = path.stat().st_size
        self._channels: dict[int, Channel] = {}  # by connection, in the order of the index
        self._chunks: list[_Chunk] = []
        self._unpacked: OrderedDict[int, memoryview] = OrderedDict()
        try:
            self._index = self._read_index(self._read_header())
            for number, chunk in enumerate(self._chunks):
                if not any(chunk.counts.values()):
                    self._content(number)  # otherwise nothing would check whether it holds messages
        except _DAMAGE as error:
            self.close()
            raise _damaged(path, error) from None
        except BaseException:
            self.close()
            raise

    # ------------------------------------------------------------ the file

    def _seek(self, place: int) -> None:
        """Seek to a byte.

        Raises:
            DamageError: The file ends before.
        """
        if place > self._size:
            raise DamageError(f"it has no byte {place}")
        self._stream.seek(place)

    def _take(self, size: int) -> bytes:
        """The next bytes.

        Raises:
            DamageError: There are fewer.
        """
        data = self._stream.read(size) if size <= self._size else b""
        if len(data) != size:
            raise DamageError("a record is cut short")
        return data

    def _length(self) -> int:
        """The length of what follows."""
        return int.from_bytes(self._take(4), "little")

    def _header(self, op: Op | None = None) -> Fields:
        """The header of the next record.

        Args:
            op: Expected kind; None for any.

        Raises:
            DamageError: It is of another kind, or cut short.
        """
        fields = Fields(split_header(self._take(self._length())))
        if op is not None and fields.op != op:
            raise DamageError(f"a record of kind {fields.op} is where {op.name} should be")
        return fields

    # ------------------------------------------------------------ the index

    def _read_header(self) -> Fields:
        """The bag's header, if its index can be where that says.

        Raises:
            SourceError: It is not a bag, an old or encrypted one, or not indexed.
        """
        path = self.path
        start = self._stream.read(32)
        if not start.startswith(MAGIC):
            raise other_format(path, start)
        self._seek(len(MAGIC))
        header = self._header(Op.BAG)
        index = header.number(b"index_pos", 8)
        if header.get(b"encryptor"):
            raise SourceError(path, "is encrypted", "Decrypt it with `rosbag decrypt` first.")
        if index == 0:
            remedy = f"Run `rosbag reindex` on it first, or {SALVAGE}"
            raise SourceError(path, "is not indexed: the recording was cut short", remedy)
        if index > self._size:
            problem = f"is cut short: its index should begin at byte {index}, and it has "
            raise SourceError(path, f"{problem}{self._size} bytes", _COPY_AGAIN)
        return header

    def _read_index(self, header: Fields) -> dict[int, NDArray[Any]]:
        """The messages of each connection, from the index at the end and those of the chunks."""
        first = self._length() + self._stream.tell()
        index = header.number(b"index_pos", 8)
        self._seek(index)
        for _ in range(header.number(b"conn_count")):
            record = self._header()
            if record.get(b"op") != bytes([Op.CONNECTION]):
                raise DamageError("a connection record is missing")
            channel = connection_of(record, self._take(self._length()))
            self._channels.setdefault(channel.id, channel)  # the first counts, as in ROS
        start = self._stream.tell()
        listed = []
        for _ in range(header.number(b"chunk_count")):
            info = self._header(Op.CHUNK_INFO)
            _check_version(info)
            self._length()
            counts = self._take(8 * info.number(b"count"))
            listed.append((info.number(b"chunk_pos", 8), dict(CHUNK_COUNT.iter_unpack(counts))))
        if self._goes_on():
            raise DamageError("its header declares fewer chunks than its index lists")
        expect(self._stream, _index_ranges(listed, start))
        # By connection: raw index entries; number of a chunk and of its entries, alternating.
        entries: defaultdict[int, bytearray] = defaultdict(bytearray)
        runs: defaultdict[int, array[int]] = defaultdict(partial(array, "I"))
        ends = {}
        for number, (place, counted) in enumerate(listed):
            self._chunks.append(self._read_chunk(place, counted))
            for _ in counted:
                connection, found = self._read_entries(self._chunks[-1])
                entries[connection] += found
                runs[connection].extend((number, len(found) // INDEX_ENTRY.itemsize))
            ends[place] = self._stream.tell()
        if len(ends) < len(listed):
            raise DamageError("its index lists a chunk twice")
        # messages that the index does not list would be lost silently
        for chunk_start in sorted(ends):
            self._check_between(first, chunk_start)
            first = ends[chunk_start]
        # a bag without chunks is read to its end: there is no other way to find its index
        self._check_between(first, index if listed else self._size)
        return {
            key: _sorted_index(entries.pop(key, b""), runs.pop(key, [])) for key in self._channels
        }

    def _goes_on(self) -> bool:
        """Whether a record follows the last one of the index that was read."""
        try:
            return b"op" in self._header()
        except _DAMAGE:
            return False

    def _read_chunk(self, start: int, counts: Mapping[int, int]) -> _Chunk:
        """The chunk whose record begins at a byte; it will be decompressed to its header's size."""
        self._seek(start)
        header = self._header(Op.CHUNK)
        compression = header.get(b"compression", b"").decode(errors="replace")
        packed, place = self._length(), self._stream.tell()
        self._seek(place + packed)
        return _Chunk(start, counts, compression, header.number(b"size"), place, packed)

    def _read_entries(self, chunk: _Chunk) -> tuple[int, bytes]:
        """A connection, and its messages in a chunk, of which the next index is."""
        header = self._header(Op.INDEX)
        _check_version(header)
        number, count = header.number(b"conn"), header.number(b"count")
        entries = self._take(self._length())
        if (
            chunk.counts.get(number) != count
            or len(entries) != count * INDEX_ENTRY.itemsize
            or number not in self._channels
        ):
            problem = f"the index of the chunk at byte {chunk.start} contradicts the bag's index"
            raise DamageError(problem)
        return number, entries

    def _check_between(self, place: int, end: int) -> None:
        """Refuse messages in a range of bytes where the index lists none."""
        while place < end:
            self._seek(place)
            if self._header().op in (Op.CHUNK, Op.MESSAGE):
                raise DamageError(f"its index does not list what it holds at byte {place}")
            place = self._length() + self._stream.tell()

    # ------------------------------------------------------------ messages

    def _records(self, excerpt: Excerpt) -> Iterator[Record]:
        """Messages in log-time order, from the chunks that hold them."""
        channels = [channel for channel in self.channels if excerpt.has_topic(channel.topic)]
        parts = [_within(self._index[channel.id], excerpt) for channel in channels]
        index = np.concatenate([np.empty(0, _PLACE), *parts])
        owners = np.repeat(np.arange(len(parts), dtype=np.int32), [len(part) for part in parts])
        order = np.lexsort((index["offset"], index["chunk"], index["time"]))
        numbers = index["chunk"][order]
        first_seen = np.sort(np.unique(numbers, return_index=True)[1])
        needed = (self._chunks[number] for number in numbers[first_seen].tolist())
        expect(self._stream, ((one.place, one.place + one.packed) for one in needed))
        self.position = 0
        visited: set[int] = set()
        for start in range(0, len(order), 4096):
            rows = order[start : start + 4096]
            places = zip(owners[rows].tolist(), index[rows].tolist(), strict=True)
            for owner, (time, number, offset) in places:
                channel, chunk = channels[owner], self._chunks[number]
                if number not in visited:
                    visited.add(number)
                    self.position += chunk.packed
                try:
                    data = _payload(self._content(number), offset, channel.id, time)
                except _DAMAGE as error:
                    place = f": topic {channel.topic}, chunk at byte {chunk.start}"
                    raise _damaged(self.path, error, place) from None
                yield Message(channel, time, time, 0, data)
        self.position = self._size

    def _content(self, number: int) -> memoryview:
        """A decompressed chunk, from the cache if possible.

        Raises:
            DamageError: It is damaged, or its number of messages differs from the index.
        """
        if number in self._unpacked:
            self._unpacked.move_to_end(number)
            return self._unpacked[number]
        chunk = self._chunks[number]
        size = chunk.size + sum(map(len, self._unpacked.values()))
        while len(self._unpacked) > 1 and (
            len(self._unpacked) >= CACHED_CHUNKS or size > CACHED_BYTES
        ):
            size -= len(self._unpacked.popitem(last=False)[1])
        self._seek(chunk.place)
        data = self._take(chunk.packed)
        if chunk.compression != "none":
            data, _ = unpack(chunk.compression, data, chunk.size)
        elif len(data) != chunk.size:
            raise DamageError(f"it holds {len(data)} bytes instead of {chunk.size}")
        content = memoryview(data)
        listed = sum(chunk.counts.values())
        if (found := _count_messages(content)) != listed:
            raise DamageError(f"its index lists {listed} messages of {found}")
        self._unpacked[number] = content
        return content

    def _times(self) -> Mapping[int, NDArray[np.int64]]:
        """Log times from the index."""
        return {key: index["time"].copy() for key, index in self._index.items()}

    def close(self) -> None:
        """Close the file."""
        self._unpacked.clear()
        self._stream.close()


def _index_ranges(
    chunks: Sequence[tuple[int, Mapping[int, int]]], end: int
) -> Iterator[tuple[int, int]]:
    """The byte ranges of the index: between the data of the chunks."""
    ends = [start for start, _ in chunks[1:]] + [end]
    for (start, counts), next_start in zip(chunks, ends, strict=True):
        head = start + _CHUNK_HEAD
        yield start, head
        entries = (_INDEX_HEAD + INDEX_ENTRY.itemsize * n for n in counts.values())
        if head < next_start:
            yield max(head, next_start - sum(entries)), next_start


def _sorted_index(raw: bytes | bytearray, chunk_runs: Sequence[int]) -> NDArray[Any]:
    """One connection's messages by log time, ties in source order, as `_PLACE`."""
    entries = np.frombuffer(raw, INDEX_ENTRY)
    runs = np.array(chunk_runs, np.int64).reshape(-1, 2)
    index = np.empty(len(entries), _PLACE)
    index["time"], index["offset"] = times_in(entries), entries["offset"]
    index["chunk"] = np.repeat(runs[:, 0], runs[:, 1])
    if index["time"].max(initial=0) >= MAX_TIME:
        problem = "it has a message with a time past 2^32 seconds, which ROS cannot represent"
        raise DamageError(problem)
    places = index["chunk"].astype(np.int64) << 32 | index["offset"]
    if len(np.unique(places)) < len(places):
        raise DamageError("its index lists a message twice")
    return index[np.lexsort((index["offset"], index["chunk"], index["time"]))]


def _within(index: NDArray[Any], excerpt: Excerpt) -> NDArray[Any]:
    """The messages of an excerpt's span."""
    start, end = (
        None if time is None else int(np.searchsorted(index["time"], min(max(time, 0), _LATEST)))
        for time in (excerpt.start, excerpt.end)
    )
    return index[start:end]


def _check_version(header: Fields) -> None:
    if (version := header.number(b"ver")) != 1:
        raise DamageError(f"its index has the unknown version {version}")
