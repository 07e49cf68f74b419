"""Reads what is left of a damaged ROS 1 bag."""

from __future__ import annotations

import bisect
import re
import struct
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from mp4ds.bags.files import DamageError, open_source
from mp4ds.bags.protocols import HOLD_BYTES, BagReader, HoldBack
from mp4ds.bags.ros1 import Ros1Reader
from mp4ds.bags.ros1_records import (
    MAGIC,
    MAX_TIME,
    UINT32,
    Op,
    make_channel,
    other_format,
    split_header,
)
from mp4ds.bags.salvage.losses import FileSalvage, LossLog, Tally
from mp4ds.bags.salvage.scan import MAX_UNPROVEN, RecordFrame, Scan, Window, unpack
from mp4ds.errors import SourceError
from mp4ds.records import Channel, ChannelStats, Message, Record

MAX_HEADER = 2**16
"""Maximum size of a record's header: a few fields, and the topic of a connection."""

_OP = re.compile(rb"\x04\x00\x00\x00op=[\x02\x04-\x07]")
_MAX_BEFORE_OP = 512
_MAX_FOUND_HEADER = 4096
_TIME = struct.Struct("<II")

# Sizes of the fields that a record of a kind must have.
_FIELDS: Mapping[int, Mapping[bytes, int]] = {
    Op.MESSAGE: {b"conn": 4, b"time": 8},
    Op.BAG: {b"index_pos": 8},
    Op.INDEX: {b"ver": 4, b"conn": 4, b"count": 4},
    Op.CHUNK: {b"size": 4},
    Op.CHUNK_INFO: {b"chunk_pos": 8, b"count": 4, b"start_time": 8, b"end_time": 8},
    Op.CONNECTION: {b"conn": 4},
}


class Ros1Framing:
    """Finds records by the fields of their headers. See `Framing`.

    An uncompressed chunk is framed by its header alone, so that its records are read like any other
    in the file: damage to one does not hide the others.
    """

    lookahead = MAX_HEADER + 8
    outer: Collection[int] = frozenset({Op.CHUNK, Op.INDEX, Op.CHUNK_INFO})

    def frame(self, view: memoryview) -> RecordFrame[int] | None:
        """See `Framing.frame`."""
        if len(view) < 8:
            return None
        (length,) = UINT32.unpack_from(view)
        if length > MAX_HEADER or length + 8 > len(view):
            return None
        try:
            fields = dict(split_header(bytes(view[4 : 4 + length])))
        except DamageError:
            return None
        op = fields.get(b"op", b"")
        needed = _FIELDS.get(op[0]) if len(op) == 1 else None
        if needed is None:
            return None
        if any(len(fields.get(name, b"")) != size for name, size in needed.items()):
            return None
        head = length + 8
        (body,) = UINT32.unpack_from(view, length + 4)
        if op[0] == Op.CHUNK:
            if b"compression" not in fields:
                return None
            if fields[b"compression"] == b"none":
                body = 0
        return RecordFrame(op[0], head, head + body, fields)

    def find(
        self,
        view: memoryview,
        end: int,
        is_followed: Callable[[int], bool],
        kinds: Collection[int] | None = None,
    ) -> int | None:
        """See `Framing.find`; a header with all its fields is proof enough."""
        for match in _OP.finditer(view):
            if kinds is None or view[match.end() - 1] in kinds:
                start = self._start(view, match.start())
                if start is not None and start < end:
                    return start
            if match.start() > end + _MAX_BEFORE_OP:
                break
        return None

    def _start(self, view: memoryview, op: int) -> int | None:
        """The start of the record whose field ``op`` is at a byte."""
        first = max(0, op - _MAX_BEFORE_OP)
        before = bytes(view[first:op])
        for start in range(len(before) - 4, -1, -1):
            if before[start + 2] or before[start + 3]:
                continue
            (length,) = UINT32.unpack_from(before, start)
            if not op - first - start + 4 <= length <= _MAX_FOUND_HEADER:
                continue
            if self.frame(view[first + start :]):
                return first + start
        return None


def number(field: bytes) -> int:
    """The value of an unsigned number field."""
    return int.from_bytes(field, "little")


def time(field: bytes) -> int:
    """The value of a time field, nanoseconds."""
    seconds, nanoseconds = _TIME.unpack(field)
    return int(seconds) * 10**9 + int(nanoseconds)


# ---------------------------------------------------------------- the index

_COUNT = struct.Struct("<II")
_SEARCHED = 16 * 2**20
_OF_INDEX = (Op.CONNECTION, Op.CHUNK_INFO)


class BagIndex:
    """Connections and chunks that the index of a bag lists.

    Attributes:
        channels: By connection number, in the order of the index.
        chunks: Byte offsets of the chunks, sorted.
        due: Byte where the index should begin according to the bag's header; None if unknown.
        offset: Byte where the index was found.
    """

    def __init__(self) -> None:
        self.channels: dict[int, Channel] = {}
        self.chunks: list[int] = []
        self.due: int | None = None
        self.offset: int | None = None
        self._infos: dict[int, tuple[int, int, bytes]] = {}
        self._places: list[int] = []
        self._later: list[int] = []

    def add(self, frame: RecordFrame[int], body: bytes) -> None:
        """Add a record of the index."""
        if frame.kind == Op.CHUNK_INFO:
            fields = frame.fields
            span = time(fields[b"start_time"]), time(fields[b"end_time"])
            self._infos[number(fields[b"chunk_pos"])] = (*span, body[: len(body) // 8 * 8])
            return
        connection = number(frame.fields[b"conn"])
        try:
            header = dict(split_header(body))
        except DamageError:
            return
        topic = frame.fields.get(b"topic", header.get(b"topic", b""))
        self.channels.setdefault(connection, make_channel(connection, topic, header))

    def finish(self, *, chunks: int | None) -> bool:
        """Finish after everything was added; an incomplete list of chunks is dropped.

        Args:
            chunks: Their number according to the bag's header; None if unknown.

        Returns:
            Whether all chunks are listed.
        """
        is_whole = chunks == len(self._infos) and self.offset is not None
        if not is_whole:
            self._infos.clear()
        self.chunks = sorted(self._infos)
        self._places = [chunk for chunk in self.chunks if self._infos[chunk][2]]
        starts = [self._infos[chunk][0] for chunk in self._places]
        self._later = np.minimum.accumulate(starts[::-1])[::-1].tolist() if starts else []
        return is_whole

    def counts(self, chunk: int) -> dict[int, int] | None:
        """Messages by connection in the chunk at a byte; None if it is not listed."""
        if chunk not in self._infos:
            return None
        found: dict[int, int] = {}
        for connection, count in _COUNT.iter_unpack(self._infos[chunk][2]):
            found[connection] = found.get(connection, 0) + count
        return found

    def span(self, chunk: int) -> tuple[int, int] | None:
        """First and last log time of the chunk at a byte, ns; None if it is not listed."""
        info = self._infos.get(chunk)
        return (info[0], info[1]) if info else None

    def held_in_file_order(self) -> int:
        """Maximum bytes of chunks, as stored, held back for earlier messages."""
        if not self._places:
            return 0
        ends = np.array([self._infos[chunk][1] for chunk in self._places])
        sizes = np.diff([*self._places, self.offset or self._places[-1]])
        by_end = np.argsort(ends)
        gone = np.concatenate(([0], np.cumsum(sizes[by_end])))
        past = gone[np.searchsorted(ends[by_end], np.array(self._later[1:], np.int64))]
        return int((np.cumsum(sizes)[:-1] - past).max(initial=0))

    def start_from(self, offset: int) -> int | None:
        """The earliest log time of the chunks from a byte on, ns; None after the last."""
        position = bisect.bisect_left(self._places, offset)
        return self._later[position] if position < len(self._later) else None

    def stats(self, connections: Iterable[int]) -> dict[int, ChannelStats]:
        """Counts and spans by connection, from the chunks; empty if no chunk is listed."""
        total = {connection: ChannelStats(0, 0, 0) for connection in connections}
        for chunk in self.chunks:
            start, end, _ = self._infos[chunk]
            for connection, count in (self.counts(chunk) or {}).items():
                old = total.get(connection)
                if old is None or not count:
                    continue
                first, last = (old.start, old.end) if old.count else (start, end)
                total[connection] = ChannelStats(
                    old.count + count, min(first, start), max(last, end)
                )
        return total if self.chunks else {}


def read_index(path: Path) -> BagIndex:
    """The index of a bag: all of it, or at least the connections found at the end of the file.

    Raises:
        SourceError: The bag is encrypted, or cannot be read.
    """
    index = BagIndex()
    framing = Ros1Framing()
    with Window.of_file(path) as window:
        window.skip(len(MAGIC))
        header = framing.frame(window.peek(framing.lookahead))
        size = window.size or 0
    chunks = None
    if header and header.kind == Op.BAG:
        if header.fields.get(b"encryptor"):
            raise SourceError(path, "is encrypted", "Decrypt it with `rosbag decrypt` first.")
        index.due = number(header.fields[b"index_pos"])
        chunks = number(header.fields.get(b"chunk_count", b""))
        if len(MAGIC) + header.size <= index.due < size:
            _read_records(path, index.due, index)
    if not index.finish(chunks=chunks) and index.due != 0:
        _search_connections(path, max(len(MAGIC), size - _SEARCHED), index)
    return index


def _read_records(path: Path, offset: int, index: BagIndex) -> None:
    """Read an index at its expected place."""
    framing = Ros1Framing()
    with Window.of_file(path, offset) as window:
        if framing.frame(window.peek(framing.lookahead)) is None:
            return
        index.offset = offset
        scan = Scan(window, framing, lambda *_: None)
        while frame := scan.next():
            if frame.kind not in _OF_INDEX:
                return
            body = scan.body(frame)
            if body is not None:
                index.add(frame, body)


def _search_connections(path: Path, offset: int, index: BagIndex) -> None:
    """Search for connections from a byte on, if the index is not at its expected place."""
    framing = Ros1Framing()
    with Window.of_file(path, offset) as window:
        scan = Scan(window, framing, lambda *_: None)
        if offset > len(MAGIC):
            scan.resync(offset, "", passed=0)
        while frame := scan.next():
            body = scan.body(frame)
            if body is not None and frame.kind == Op.CONNECTION:
                index.add(frame, body)


# ---------------------------------------------------------------- the reader

_MOST_PACKED = 16  # maximum assumed compression ratio of a chunk
_INDEX_ENTRY = np.dtype([("sec", "<u4"), ("nsec", "<u4"), ("offset", "<u4")])


class Ros1Salvage(FileSalvage):
    """Reads what is left of a ROS 1 bag.

    Raises:
        SourceError: The file is missing, empty, encrypted, of another version, or not a bag.
    """

    format = "bag"
    profile = "ros1"

    def __init__(self, path: Path, *, is_alone: bool = True) -> None:
        super().__init__(path, is_alone=is_alone)
        with open_source(path) as stream:
            start = stream.read(32)
        self._has_magic = start.startswith(MAGIC)
        if not self._has_magic and re.match(rb"#ROS(BAG|RECORD|LOG) V1\.\d\n", start):
            raise other_format(path, start)
        self._index = read_index(path)
        self._channels: dict[int, Channel] = dict(self._index.channels)

    @property
    def channels(self) -> Sequence[Channel]:
        """Connections of the bag's index, then those found while reading."""
        return list(self._channels.values())

    def _stats(self) -> Mapping[int, ChannelStats]:
        """Counts and spans from the bag's index, including lost messages; otherwise empty."""
        return self._index.stats(self._channels)

    @property
    def _usual(self) -> Callable[[], BagReader] | None:
        is_far_out = self._index.held_in_file_order() > HOLD_BYTES // _MOST_PACKED
        return partial(Ros1Reader, self.path) if is_far_out else None

    def _pass(self, log: LossLog) -> Iterator[Record]:
        with Window.of_file(self.path) as window:
            reading = _Pass(self.path, window, log, self._index, self._channels)
            held = HoldBack() if self._index.chunks else None
            for message in reading.messages():
                self.position = window.offset
                if held is None:
                    yield message
                    continue
                if reading.is_at_new_chunk:
                    reading.is_at_new_chunk = False
                    yield from held.release(reading.earliest)
                held.add(message)
            if held:
                yield from held.release(None)
            self.position = window.offset
            if self._is_alone and not reading.found and not self._channels:
                raise SourceError(self.path, "holds no ROS 1 bag records")


class _Pass:
    """One reading of a bag.

    Attributes:
        found: Number of valid records found.
        is_at_new_chunk: Whether a chunk began since this was last reset.
        earliest: Earliest log time, ns, of messages from here on, by the bag's index.
    """

    def __init__(
        self,
        path: Path,
        window: Window,
        log: LossLog,
        index: BagIndex,
        channels: dict[int, Channel],
    ) -> None:
        self._path = path
        self._window = window
        self._log = log
        self._index = index
        self._channels = channels
        self._tally = Tally(log, self._topic_of)
        self._framing = Ros1Framing()
        self._scan = Scan(window, self._framing, self._lose)
        self._next_listed = 0
        self._contradicted: set[int] = set()
        self._others: dict[tuple[object, ...], Channel] = {}
        self.found = 0
        self.is_at_new_chunk = False
        self.earliest: int | None = None

    def _topic_of(self, connection: int) -> str | None:
        channel = self._channels.get(connection)
        return channel.topic if channel else None

    def messages(self) -> Iterator[Message]:
        """All messages, in the order of the file."""
        start = bytes(self._window.peek(len(MAGIC)))
        if start == MAGIC:
            self._window.skip(len(MAGIC))
        else:
            self._scan.resync(0, "the first bytes are not those of a ROS 1 bag", passed=0)
        while frame := self._scan.next():
            self.found += 1
            if frame.kind != Op.INDEX:
                yield from self._tally.settle()
            yield from self._record(frame)
        yield from self._tally.settle()
        if (self._index.due or 0) > self._window.offset:
            problem = (
                f"the file ends before its index, which should begin at byte {self._index.due}"
            )
            self._tally.lost(self._window.offset, None, problem)
        self._tally.close()

    def _record(self, frame: RecordFrame[int]) -> Iterator[Message]:
        offset = self._window.offset
        if frame.kind == Op.CHUNK:
            (length,) = UINT32.unpack(self._window.peek(frame.head)[-4:])
            self._enter(offset, offset + frame.head + length)
            if frame.fields[b"compression"] == b"none":
                self._window.skip(frame.size)
            else:
                yield from self._compressed(frame)
        elif frame.kind == Op.MESSAGE:
            body = self._scan.body(frame)
            if body is not None:
                message = self._message(frame, body, offset)
                if message:
                    self._tally.gave(number(frame.fields[b"conn"]), message.log_time)
                    yield message
        elif frame.kind == Op.CONNECTION:
            body = self._scan.body(frame)
            if body is not None and not self._connect(frame, body):
                self._lose(offset, frame.size, "a connection record is damaged")
        elif frame.kind == Op.INDEX:
            body = self._scan.body(frame)
            if body is not None:
                self._listed(frame, body, offset)
        elif frame.kind == Op.BAG and not self._scan.is_followed(frame.size):
            self._scan.resync(offset, "the header of the bag is damaged", passed=frame.head)
        else:
            self._scan.body(frame)

    def _message(self, frame: RecordFrame[int], body: bytes, offset: int) -> Message | None:
        """A message; None if it is lost."""
        connection, log_time = number(frame.fields[b"conn"]), time(frame.fields[b"time"])
        channel = self._channels.get(connection)
        if log_time >= MAX_TIME:
            self._lose(
                offset,
                frame.size,
                "a message has a time past 2^32 seconds, which ROS cannot represent",
            )
            return None
        if channel is None:
            self._tally.stray(connection, log_time)
            problem = f"messages of connection {connection}, whose record is missing"
            loss = self._log.lost_of_kind(connection, offset, problem)
            loss.add(1, ())
            return None
        return Message(channel, log_time, log_time, 0, body)

    def _connect(self, frame: RecordFrame[int], body: bytes, *, is_sure: bool = False) -> bool:
        connection = number(frame.fields[b"conn"])
        try:
            header = dict(split_header(body))
        except DamageError:
            return connection in self._channels
        topic = frame.fields.get(b"topic", header.get(b"topic", b""))
        channel = make_channel(connection, topic, header)
        if self._channels.setdefault(connection, channel).identity != channel.identity:
            # a separate channel: messages of the other one may have been yielded already
            if is_sure:
                key = connection, channel.identity
                other = replace(channel, id=2**32 + len(self._others))
                self._channels[connection] = self._others.setdefault(key, other)
            problem = f"records of connection {connection} ({channel.topic}) contradict each other"
            if connection not in self._contradicted:
                self._contradicted.add(connection)
                self._log.lost(None, None, problem).add(0, ())
        return True

    def _compressed(self, frame: RecordFrame[int]) -> Iterator[Message]:
        """The messages of a compressed chunk, as far as it can be decompressed."""
        window, scan = self._window, self._scan
        offset = window.offset
        proven = scan.is_proven(frame)
        have = window.peek(frame.size if proven else min(frame.size, MAX_UNPROVEN))
        compression = frame.fields[b"compression"].decode(errors="replace")
        unpacked = unpack(compression, have[frame.head :], number(frame.fields[b"size"]))
        problems = [unpacked.problem] if unpacked.problem else []
        inner = Scan(
            Window.of_content(unpacked.content, self._path),
            self._framing,
            lambda _offset, _size, problem: problems.append(problem),
        )
        while part := inner.next():
            body = inner.body(part)
            if body is None:
                continue
            if part.kind == Op.MESSAGE:
                message = self._message(part, body, offset)
                connection = number(part.fields[b"conn"])
                if message and unpacked.is_sound:
                    self._tally.gave(connection, message.log_time)
                    yield message
                elif message:
                    self._tally.hold(connection, message)
            elif part.kind == Op.CONNECTION and not self._connect(part, body, is_sure=not problems):
                problems.append("a connection record is damaged")
        end = frame.head + unpacked.used
        if not unpacked.problem and end != frame.size and scan.is_followed(end):
            window.skip(end)  # the content is complete: the record's length is wrong
        elif proven and (not unpacked.problem or scan.is_followed(frame.size)):
            window.skip(frame.size)
        else:
            whole = unpacked.used and not problems
            scan.resync(
                offset + end if whole else offset,
                problems[0] if problems else scan.cut_or_damaged(frame),
                passed=end,
                kinds=self._framing.outer,
            )
            return
        if problems:
            self._lose(offset, window.offset - offset, problems[0])
        else:
            self._tally.verified()

    def _listed(self, frame: RecordFrame[int], body: bytes, offset: int) -> None:
        connection, count = number(frame.fields[b"conn"]), number(frame.fields[b"count"])
        if self._tally.count_matches(connection, count, offset):
            return
        entries = np.frombuffer(body, _INDEX_ENTRY, count=len(body) // _INDEX_ENTRY.itemsize)
        times = entries["sec"].astype(np.int64) * 10**9 + entries["nsec"]
        found, counts = np.unique(times, return_counts=True)
        self._tally.listed(connection, dict(zip(found.tolist(), counts.tolist(), strict=True)))

    def _enter(self, offset: int, end: int) -> None:
        """Begin a chunk that should end at a byte."""
        self._pass_listed(offset)
        starts = self._index.chunks
        if self._next_listed < len(starts) and starts[self._next_listed] == offset:
            self._next_listed += 1
        self._tally.open(self._index.counts(offset), end, self._index.span(offset))
        self.is_at_new_chunk = True
        self.earliest = self._index.start_from(offset)

    def _pass_listed(self, end: int) -> None:
        """Record as lost the chunks that the index lists before a byte but that were not found."""
        starts = self._index.chunks
        while self._next_listed < len(starts) and starts[self._next_listed] < end:
            self._tally.extend(self._index.counts(starts[self._next_listed]))
            self._next_listed += 1

    def _lose(self, offset: int, size: int, problem: str) -> None:
        if self._index.offset is not None and offset >= self._index.offset:
            self._log.lost(offset, size, problem).add(0, ())
            return
        self._tally.lost(offset, size, problem)
        self._pass_listed(offset + size)
