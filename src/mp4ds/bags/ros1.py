"""Reads ROS 1 bags of format 2.0 (wiki.ros.org/Bags/Format/2.0).

rosbags frames the records. What it normalises or bounds too late is done here: connection
headers stay as recorded, the index is kept in arrays, chunks unpack to their declared size.
"""

from __future__ import annotations

import os
from array import array
from collections import OrderedDict, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag1,
    MessageDefinition,
    MessageDefinitionFormat,
)
from rosbags.rosbag1 import Reader, ReaderError
from rosbags.rosbag1.reader import (
    Chunk,
    ChunkInfo,
    Header,
    IndexData,
    RecordType,
    read_bytes,
    read_uint32,
)

from mp4ds.bags.protocols import Format
from mp4ds.bags.ros1_records import (
    COPY_AGAIN,
    DAMAGE,
    MAGIC,
    MAX_TIME,
    UINT32,
    check_bag,
    check_between,
    count_messages,
    make_channel,
    payload,
    reason,
    split_header,
    unpack_chunk,
)
from mp4ds.errors import SourceError
from mp4ds.records import EVERYTHING, Channel, ChannelStats, Excerpt, Message, Record, Schema
from mp4ds.remote import expect

CACHED_CHUNKS = 8
CACHED_BYTES = 64 * 2**20
"""Unpacked chunks are kept up to both limits, but always two: chunks may overlap in time."""

_LATEST = 2**63 - 1  # more than any time of a bag
_CHUNK_HEAD, _INDEX_HEAD = 96, 64  # bytes at most, of the records as everybody writes them
_INDEX_ENTRY = np.dtype([("sec", "<u4"), ("nsec", "<u4"), ("offset", "<u4")])


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


class Ros1Reader:
    """Reads a ROS 1 bag. See `BagReader`.

    Messages come in log-time order, ties in file order. Payloads are slices of their
    unpacked chunk, which they keep in memory for as long as they live.

    Args:
        path: The file.

    Raises:
        SourceError: The file is missing, no bag, not indexed, encrypted, or damaged.
    """

    format: Format = "bag"
    profile = "ros1"
    library = ""
    unused_schemas: Sequence[Schema] = ()
    skipped: Mapping[str, int] = MappingProxyType({})

    def __init__(self, path: Path) -> None:
        self.path = path
        self.files: Sequence[Path] = [path]
        self._position = 0
        self._size = check_bag(path)
        self._chunks: OrderedDict[int, memoryview] = OrderedDict()
        self._bag = _Bag(path)
        try:
            self._bag.open()
            self._index = self._bag.take_index()
            for number, info in enumerate(self._bag.chunk_infos):
                if not any(info.connection_counts.values()):
                    self._chunk(number)  # nobody else will see whether it holds messages
        except DAMAGE as error:
            self._close()
            raise SourceError(path, f"is damaged: {reason(error)}", COPY_AGAIN) from None

    @property
    def channels(self) -> Sequence[Channel]:
        """All connections, in the order of the bag's index."""
        return list(self._bag.channels.values())

    @property
    def position(self) -> int:
        """Bytes of the chunks that `records` has come to; the file's size at its end."""
        return self._position

    @property
    def is_indexed(self) -> bool:
        """See `BagReader.is_indexed`: a bag without an index is not read at all."""
        return True

    def records(self, excerpt: Excerpt = EVERYTHING) -> Iterator[Record]:
        """Messages in log-time order, from the chunks that hold them. See `BagReader.records`."""
        self._position = 0
        visited: set[int] = set()
        for channel, time, chunk, offset, is_last in self._entries(excerpt):
            if chunk not in visited:
                visited.add(chunk)
                self._position += self._bag.chunk_at(chunk).datasize
            yield self._message(channel, time, chunk, offset)
            if is_last:
                self._chunks.pop(chunk, None)
        self._position = self._size

    def _entries(self, excerpt: Excerpt) -> Iterator[tuple[Channel, int, int, int, bool]]:
        """Of every message: channel, log time, chunk number, offset, if it ends its chunk's use."""
        channels = [channel for channel in self.channels if excerpt.has_topic(channel.topic)]
        parts = [self._index[channel.id].within(excerpt) for channel in channels]
        if not parts:
            return
        times, chunks, offsets = (np.concatenate(column) for column in zip(*parts, strict=True))
        owners = np.repeat(np.arange(len(parts), dtype=np.int32), [len(p.times) for p in parts])
        order = np.lexsort((offsets, chunks, times))
        self._bag.expect(_first_seen(chunks[order]))
        last = np.full(len(self._bag.chunk_infos), -1)
        last[chunks[order]] = np.arange(len(order))
        for start in range(0, len(order), 4096):
            rows = order[start : start + 4096]
            ends = last[chunks[rows]] == np.arange(start, start + len(rows))
            columns = (column[rows].tolist() for column in (owners, times, chunks, offsets))
            for owner, time, chunk, offset, is_last in zip(*columns, ends.tolist(), strict=True):
                yield channels[owner], time, chunk, offset, is_last

    def _message(self, channel: Channel, time: int, chunk: int, offset: int) -> Message:
        try:
            data = payload(self._chunk(chunk), offset, channel.id, time)
        except DAMAGE as error:
            place = f"topic {channel.topic}, chunk at byte {self._bag.chunk_infos[chunk].pos}"
            raise SourceError(
                self.path, f"is damaged: {place}: {reason(error)}", COPY_AGAIN
            ) from None
        return Message(channel, time, time, 0, data)

    def _chunk(self, number: int) -> memoryview:
        """An unpacked chunk, from the cache where it is there."""
        if number in self._chunks:
            self._chunks.move_to_end(number)
            return self._chunks[number]
        chunk = self._bag.chunk_at(number)
        self._bag.file.seek(chunk.datapos)
        packed = read_bytes(self._bag.file, chunk.datasize)
        unpacked = memoryview(chunk.decompressor(packed))
        listed = sum(self._bag.chunk_infos[number].connection_counts.values())
        if (found := count_messages(unpacked)) != listed:
            raise ReaderError(f"its index lists {listed} messages of {found}")
        size = len(unpacked) + sum(map(len, self._chunks.values()))
        while len(self._chunks) > 1 and (len(self._chunks) >= CACHED_CHUNKS or size > CACHED_BYTES):
            size -= len(self._chunks.popitem(last=False)[1])
        self._chunks[number] = unpacked
        return unpacked

    def stats(self) -> Mapping[int, ChannelStats]:
        """Counts and spans by the index; a channel without messages has times of 0."""
        return {
            key: ChannelStats(len(times), *(map(int, times[[0, -1]]) if len(times) else (0, 0)))
            for key, times in self.times().items()
        }

    def times(self) -> Mapping[int, NDArray[np.int64]]:
        """Log times by the index."""
        return {key: index.times for key, index in self._index.items()}

    def first(self, channel: Channel) -> Message | None:
        """The channel's first message by log time, or None."""
        index = self._index[channel.id]
        if not len(index.times):
            return None
        time, chunk, offset = (int(column[0]) for column in index)
        return self._message(channel, time, chunk, offset)

    def __enter__(self) -> Ros1Reader:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def _close(self) -> None:
        self._chunks.clear()
        if self._bag.bio:
            self._bag.bio.close()


def _first_seen(numbers: NDArray[np.int32]) -> list[int]:
    """Each number once, where it comes first."""
    found, places = np.unique(numbers, return_index=True)
    ordered: list[int] = found[np.argsort(places)].tolist()
    return ordered


class _Bag(Reader):
    """rosbags' reader, with connections as `Channel` and the index in arrays.

    Attributes:
        channels: By connection number, in the order of the bag's index.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.channels: dict[int, Channel] = {}
        self._index_start = self._index_end = 0
        self._chunk_ends: dict[int, int] = {}  # by where they begin, with their index records
        # By connection: raw index entries; number of a chunk and of its entries, alternating.
        self._index_entries: defaultdict[int, bytearray] = defaultdict(bytearray)
        self._index_runs: defaultdict[int, array[int]] = defaultdict(partial(array, "I"))

    @property
    def file(self) -> BinaryIO:
        """The open file."""
        if self.bio is None:
            raise ReaderError("the recording is closed")
        return self.bio

    def chunk_at(self, number: int) -> Chunk:
        """Where a chunk is."""
        return self.chunks[self.chunk_infos[number].pos]

    def open(self) -> None:
        """Read the bag's index, also where there are connections without any chunk."""
        super().open()
        if not self.chunk_infos:
            self.file.seek(len(MAGIC))
            header = Header.read(self.file, RecordType.BAGHEADER)
            self.file.seek(header.get_uint64("index_pos"))
            for _ in range(header.get_uint32("conn_count")):
                self.read_connection()
            self._index_end = self.file.tell()
        if self._goes_on():
            raise ReaderError("its header counts fewer chunks than its index lists")
        self._check_unlisted()

    def _check_unlisted(self) -> None:
        """Refuse messages that the index does not list: they would be lost without a word."""
        if len(self.chunks) < len(self.chunk_infos):
            raise ReaderError("its index lists a chunk twice")
        self.file.seek(len(MAGIC))
        header = Header.read(self.file, RecordType.BAGHEADER)
        place = read_uint32(self.file) + self.file.tell()
        for start in sorted(self._chunk_ends):
            check_between(self.file, place, start)
            place = self._chunk_ends[start]
        # a bag without chunks is read to its end: nothing else tells where its index is
        end = header.get_uint64("index_pos") if self.chunks else self.file.seek(0, os.SEEK_END)
        check_between(self.file, place, end)

    def _goes_on(self) -> bool:
        """Whether a record follows the last one of the index that was read."""
        self.file.seek(self._index_end)
        try:
            return "op" in Header.read(self.file)
        except DAMAGE:
            return False

    def read_chunk_info(self) -> ChunkInfo:
        """Read the summary of a chunk."""
        info = super().read_chunk_info()
        self._index_end = self.file.tell()
        return info

    def read_connection(self) -> Connection:
        """Read a connection record, keeping its header verbatim."""
        if not self.channels:
            self._index_start = self.file.tell()
        record = dict(split_header(read_bytes(self.file, read_uint32(self.file))))
        if record.get(b"op") != bytes([RecordType.CONNECTION]):
            raise ReaderError("a connection record is missing")
        (number,) = UINT32.unpack(record[b"conn"])
        header = dict(split_header(read_bytes(self.file, read_uint32(self.file))))
        channel = make_channel(number, record.get(b"topic", header.get(b"topic", b"")), header)
        self.channels.setdefault(number, channel)  # the first of a number counts, as in ROS
        return Connection(
            number,
            channel.topic,
            channel.type_name,
            MessageDefinition(MessageDefinitionFormat.NONE, ""),
            "",
            0,
            ConnectionExtRosbag1(None, None),
            self,
        )

    def expect(self, chunks: Iterable[int]) -> None:
        """Tell which chunks will be read, by their numbers, in that order."""
        places = map(self.chunk_at, chunks)
        expect(self.file, ((chunk.datapos, chunk.datapos + chunk.datasize) for chunk in places))

    def _index_ranges(self) -> Iterator[tuple[int, int]]:
        """Where the index lies: between the data of the chunks."""
        infos = self.chunk_infos
        ends = [info.pos for info in infos[1:]] + [self._index_start]
        for info, end in zip(infos, ends, strict=True):
            head = info.pos + _CHUNK_HEAD
            yield info.pos, head
            size = sum(
                _INDEX_HEAD + _INDEX_ENTRY.itemsize * count
                for count in info.connection_counts.values()
            )
            if head < end:
                yield max(head, end - size), end

    def read_chunk(self) -> Chunk:
        """Read a chunk's header; it will unpack to the size that this tells."""
        if not self.chunks:
            expect(self.file, self._index_ranges())
        header = Header.read(self.file, RecordType.CHUNK)
        unpack = partial(unpack_chunk, header.get_string("compression"), header.get_uint32("size"))
        size = read_uint32(self.file)
        start = self.file.tell()
        self._chunk_ends[self.chunk_infos[len(self.chunks)].pos] = start + size
        self.file.seek(start + size)
        return Chunk(size, start, unpack)

    def read_index_data(self, pos: int, indexes: dict[int, list[IndexData]]) -> None:
        """Read what the chunk at `pos` holds of one connection."""
        header = Header.read(self.file, RecordType.IDXDATA)
        if (version := header.get_uint32("ver")) != 1:
            raise ReaderError(f"its index has the unknown version {version}")
        number, count = header.get_uint32("conn"), header.get_uint32("count")
        entries = read_bytes(self.file, read_uint32(self.file))
        chunk = len(self.chunks) - 1
        info = self.chunk_infos[chunk]
        if (
            info.pos != pos
            or info.connection_counts.get(number) != count
            or len(entries) != count * _INDEX_ENTRY.itemsize
            or number not in self.channels
        ):
            raise ReaderError(f"the index of the chunk at byte {pos} contradicts that of the bag")
        self._chunk_ends[pos] = self.file.tell()
        self._index_entries[number] += entries
        self._index_runs[number].extend((chunk, count))

    def take_index(self) -> dict[int, _Index]:
        """The index by connection number; drops what it was made from."""
        return {number: self._sorted_index(number) for number in self.channels}

    def _sorted_index(self, number: int) -> _Index:
        entries = np.frombuffer(self._index_entries.pop(number, b""), _INDEX_ENTRY)
        runs = np.array(self._index_runs.pop(number, []), np.int64).reshape(-1, 2)
        chunks = np.repeat(runs[:, 0].astype(np.int32), runs[:, 1])
        times = entries["sec"].astype(np.int64) * 10**9 + entries["nsec"]
        if times.max(initial=0) >= MAX_TIME:
            raise ReaderError("it has a message of a time past 2^32 seconds, which is none of ROS")
        places = chunks.astype(np.int64) << 32 | entries["offset"]
        if len(np.unique(places)) < len(places):
            raise ReaderError("its index lists a message twice")
        order = np.lexsort((entries["offset"], chunks, times))
        index = _Index(times[order], chunks[order], entries["offset"][order])
        if np.logical_and.reduce([column[1:] == column[:-1] for column in index]).any():
            raise ReaderError("its index lists a message twice")
        return index
