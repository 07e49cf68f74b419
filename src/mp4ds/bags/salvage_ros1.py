"""Reads what is left of a damaged ROS 1 bag."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from mp4ds.bags.files import DamageError, open_source, recover
from mp4ds.bags.protocols import later_starts
from mp4ds.bags.ros1 import (
    CHUNK_COUNT,
    INDEX_ENTRY,
    MAGIC,
    MAX_TIME,
    UINT32,
    Fields,
    Op,
    connection_of,
    other_format,
    split_header,
    times_in,
)
from mp4ds.bags.salvage_scan import FileSalvage, Lose, RecordFrame, Scan, Window
from mp4ds.errors import SourceError
from mp4ds.records import Channel, ChannelStats, Message, Record

# ---------------------------------------------------------------- finding records

_MAX_HEADER = 2**16
"""Maximum size of a record's header: a few fields, and the topic of a connection."""

_ROS1_OP = re.compile(rb"\x04\x00\x00\x00op=[\x02\x04-\x07]")
_MAX_BEFORE_OP = 512
_MAX_FOUND_HEADER = 4096

# Sizes of the fields that a record of a kind must have.
_FIELDS: Mapping[int, Mapping[bytes, int]] = {
    Op.MESSAGE: {b"conn": 4, b"time": 8},
    Op.BAG: {b"index_pos": 8},
    Op.INDEX: {b"ver": 4, b"conn": 4, b"count": 4},
    Op.CHUNK: {b"size": 4},
    Op.CHUNK_INFO: {b"chunk_pos": 8, b"count": 4, b"start_time": 8, b"end_time": 8},
    Op.CONNECTION: {b"conn": 4},
}


class _Scan(Scan):
    """Finds records by the fields of their headers.

    An uncompressed chunk is framed by its header alone, so that its records are read like any other
    in the file: damage to one does not hide the others.
    """

    lookahead = _MAX_HEADER + 8
    outer: Collection[int] = frozenset({Op.CHUNK, Op.INDEX, Op.CHUNK_INFO})

    def frame(self, view: memoryview) -> RecordFrame | None:
        """The record at the start of these bytes; its header has all fields of its kind."""
        if len(view) < 8:
            return None
        (length,) = UINT32.unpack_from(view)
        if length > _MAX_HEADER or length + 8 > len(view):
            return None
        try:
            fields = Fields(split_header(bytes(view[4 : 4 + length])))
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
        self, view: memoryview, end: int, ahead: int = 0, kinds: Collection[int] | None = None
    ) -> int | None:
        """The start of the first record: a header with all its fields is proof enough."""
        for match in _ROS1_OP.finditer(view):
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


_SEARCHED = 16 * 2**20


# ---------------------------------------------------------------- the reader


class Ros1Salvage(FileSalvage):
    """Reads what is left of a ROS 1 bag.

    Raises:
        SourceError: The file is missing, empty, encrypted, of another version, or not a bag.
    """

    format = "bag"
    profile = "ros1"
    magic = MAGIC
    kind = "a ROS 1 bag"

    def __init__(self, path: Path, *, is_alone: bool = True) -> None:
        super().__init__(path, is_alone=is_alone)
        with open_source(path) as stream:
            start = stream.read(32)
        if re.match(rb"#ROS(BAG|RECORD|LOG) V1\.\d\n", start):
            raise other_format(path, start)
        self._channels: dict[int, Channel] = {}  # by connection, in the order of the index
        # chunks that the index lists, by the byte where each begins, in this order: first and last
        # log time in ns, and messages by connection
        self._infos: dict[int, tuple[tuple[int, int], dict[int, int]]] = {}
        self._due: int | None = None  # where the index should begin, if the bag's header tells
        self._read_index()
        self._is_timed = bool(self._infos)

    def _scan_of(self, window: Window, lose: Lose) -> Scan:
        return _Scan(window, lose)

    def _read_index(self) -> None:
        """Read the index: all of it, or at least the connections found at the end of the file.

        An incomplete list of chunks is dropped.

        Raises:
            SourceError: The bag is encrypted, or cannot be read.
        """
        with Window.of_file(self.path) as window:
            window.skip(len(MAGIC))
            header, size = _Scan(window).here(), window.size
        chunks = None
        if header and header.kind == Op.BAG:
            if header.fields.get(b"encryptor"):
                problem, remedy = "is encrypted", "Decrypt it with `rosbag decrypt` first."
                raise SourceError(self.path, problem, remedy)
            self._due = header.fields.number(b"index_pos", 8)
            chunks = int.from_bytes(header.fields.get(b"chunk_count", b""), "little")
            if len(MAGIC) + header.size <= self._due < size:
                for frame, body in self._records_from(self._due):
                    if frame.kind == Op.CONNECTION:
                        self._declare(frame, body)
                    elif frame.kind == Op.CHUNK_INFO:
                        span = frame.fields.time(b"start_time"), frame.fields.time(b"end_time")
                        counts = body[: len(body) // CHUNK_COUNT.size * CHUNK_COUNT.size]
                        place = frame.fields.number(b"chunk_pos", 8)
                        self._infos[place] = span, dict(CHUNK_COUNT.iter_unpack(counts))
                    else:
                        break
        is_whole = chunks == len(self._infos) and self._index_offset is not None
        self._infos = dict(sorted(self._infos.items())) if is_whole else {}
        starts = {place: span[0] for place, (span, counts) in self._infos.items() if counts}
        places = np.array(list(starts), np.uint64)
        self._later = later_starts(places, np.array(list(starts.values()), np.uint64))
        if not is_whole and self._due != 0:
            for frame, body in self._records_from(max(len(MAGIC), size - _SEARCHED), search=True):
                if frame.kind == Op.CONNECTION:
                    self._declare(frame, body)

    def _records_from(
        self, offset: int, *, search: bool = False
    ) -> Iterator[tuple[RecordFrame, bytes]]:
        """The readable records from a byte on: of the index, if it is there, or of a search."""
        with Window.of_file(self.path, offset) as window:
            scan = _Scan(window)
            if search and offset > len(MAGIC):
                scan.resync(offset, "", passed=0)
            elif not search:
                if scan.here() is None:
                    return
                self._index_offset = offset  # even if its first record is cut short
            while frame := scan.next():
                body = scan.body(frame)
                if body is not None:
                    yield frame, body

    def _declare(self, frame: RecordFrame, body: bytes) -> None:
        """Take a connection of the index, unless it is damaged; the first of a number counts."""
        with suppress(DamageError):
            channel = connection_of(frame.fields, body)
            self._channels.setdefault(channel.id, channel)

    def _stats(self) -> Mapping[int, ChannelStats]:
        """Counts and spans from the bag's index, including lost messages; otherwise empty."""
        if not self._infos:
            return {}
        total = {connection: ChannelStats(0, 0, 0) for connection in self._channels}
        for span, counts in self._infos.values():
            for connection, count in counts.items():
                if connection in total and count:
                    total[connection] = total[connection].plus(ChannelStats(count, *span))
        return total

    def _scanned(self) -> Iterator[Record | None]:
        """All messages, in the order of the file; None at each chunk."""
        self._listed_ahead = list(reversed(self._infos))
        self._contradicted: set[int] = set()
        self._others: dict[tuple[object, ...], Channel] = {}
        self._begins()
        while frame := self._scan.next():
            self._found += 1
            if frame.kind != Op.INDEX:
                yield from self._tally.settle()
            yield from self._record(frame)
        yield from self._tally.settle()
        if (self._due or 0) > self._window.offset:
            problem = f"the file ends before its index, which should begin at byte {self._due}"
            self._tally.skipped(self._window.offset, None, problem)
        self._tally.close()

    def _record(self, frame: RecordFrame) -> Iterator[Message | None]:
        offset = self._window.offset
        if frame.kind == Op.CHUNK:
            (length,) = UINT32.unpack(self._window.peek(frame.head)[-4:])
            self._enter(offset, offset + frame.head + length)
            yield None
            if frame.fields[b"compression"] == b"none":
                self._window.skip(frame.size)
            else:
                yield from self._compressed(frame)
            return
        if frame.kind == Op.BAG and not self._scan.is_followed(frame.size):
            self._scan.resync(offset, "the header of the bag is damaged", passed=frame.head)
            return
        body = self._scan.body(frame)
        if body is None:
            return
        if frame.kind == Op.MESSAGE:
            yield from self._message(frame, body, offset)
        elif frame.kind == Op.CONNECTION and not self._connect(frame, body):
            self._lose(offset, frame.size, "a connection record is damaged")
        elif frame.kind == Op.INDEX:
            self._listed(frame.fields, body, offset)

    def _message(
        self, frame: RecordFrame, body: bytes, offset: int, *, is_doubtful: bool = False
    ) -> Sequence[Message]:
        """A message, unless it is lost, or held until an index confirms it."""
        connection, log_time = frame.fields.number(b"conn"), frame.fields.time(b"time")
        channel = self._channels.get(connection)
        if log_time >= MAX_TIME:
            problem = "a message has a time past 2^32 seconds, which ROS cannot represent"
            self._lose(offset, frame.size, problem)
            return ()
        if channel is None:
            problem = f"messages of connection {connection}, whose record is missing"
            self._tally.stray(connection, offset, problem)
            return ()
        message = Message(channel, log_time, log_time, 0, body)
        return self._tally.take(connection, message, is_doubtful=is_doubtful)

    def _connect(self, frame: RecordFrame, body: bytes, *, is_sure: bool = False) -> bool:
        """Take a connection record; False if it is damaged."""
        try:
            channel = connection_of(frame.fields, body)
        except DamageError:
            return frame.fields.number(b"conn") in self._channels
        connection = channel.id
        if self._channels.setdefault(connection, channel).identity != channel.identity:
            # a separate channel: messages of the other one may have been yielded already
            if is_sure:
                key = connection, channel.identity
                other = replace(channel, id=2**32 + len(self._others))
                self._channels[connection] = self._others.setdefault(key, other)
            problem = f"records of connection {connection} ({channel.topic}) contradict each other"
            if connection not in self._contradicted:
                self._contradicted.add(connection)
                self._tally.lost(None, None, problem).add(0, ())
        return True

    def _compressed(self, frame: RecordFrame) -> Iterator[Message]:
        """The messages of a compressed chunk, as far as it can be decompressed."""
        offset = self._window.offset
        have, proven = self._peek_chunk(frame)
        compression = frame.fields[b"compression"].decode(errors="replace")
        size = frame.fields.number(b"size")
        content, used, problem, is_sound = recover(compression, have[frame.head :], size)
        problems = [problem] if problem else []
        for part, body in self._inside(content, problems):
            if part.kind == Op.MESSAGE:
                yield from self._message(part, body, offset, is_doubtful=not is_sound)
            elif part.kind == Op.CONNECTION and not self._connect(part, body, is_sure=not problems):
                problems.append("a connection record is damaged")
        used += frame.head
        self._leave_chunk(frame, used, problems, proven=proven, whole=not problem)

    def _listed(self, fields: Fields, body: bytes, offset: int) -> None:
        entries = np.frombuffer(body, INDEX_ENTRY, count=len(body) // INDEX_ENTRY.itemsize)
        self._tally.listed(fields.number(b"conn"), times_in(entries), offset)

    def _enter(self, offset: int, end: int) -> None:
        """Begin a chunk that should end at a byte."""
        self._pass_listed(offset)
        if self._listed_ahead and self._listed_ahead[-1] == offset:
            self._listed_ahead.pop()
        span, counts = self._infos.get(offset, (None, None))
        self._tally.open(counts, end, span)
        self._earliest = self._later(offset - 1)

    def _pass_listed(self, end: int) -> None:
        """Record as lost the chunks that the index lists before a byte but that were not found."""
        while self._listed_ahead and self._listed_ahead[-1] < end:
            _, counts = self._infos[self._listed_ahead.pop()]
            self._tally.extend(counts)

    def _lose(self, offset: int, size: int, problem: str) -> None:
        super()._lose(offset, size, problem)
        if self._index_offset is None or offset < self._index_offset:
            self._pass_listed(offset + size)
