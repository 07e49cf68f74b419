"""Reads what is there of a damaged ROS 1 bag."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from rosbags.rosbag1.reader import RecordType

from mp4ds.bags.mcap_records import open_source
from mp4ds.bags.ordering import HOLD_BYTES, HoldBack
from mp4ds.bags.protocols import BagReader, Format
from mp4ds.bags.ros1 import Ros1Reader
from mp4ds.bags.ros1_records import (
    DAMAGE,
    MAGIC,
    MAX_TIME,
    UINT32,
    make_channel,
    other_format,
    split_header,
)
from mp4ds.bags.salvage.losses import LossLog
from mp4ds.bags.salvage.reader import FileSalvage
from mp4ds.bags.salvage.ros1_framing import Ros1Framing, number, time
from mp4ds.bags.salvage.ros1_index import BagIndex, read_index
from mp4ds.bags.salvage.scan import MAX_UNPROVEN, Frame, Scan
from mp4ds.bags.salvage.tally import Tally
from mp4ds.bags.salvage.unpack import unpack
from mp4ds.bags.salvage.window import Window
from mp4ds.errors import SourceError
from mp4ds.records import Channel, ChannelStats, Message, Record

_MOST_PACKED = 16  # times smaller than its content a chunk is taken to be at most
_INDEX_ENTRY = np.dtype([("sec", "<u4"), ("nsec", "<u4"), ("offset", "<u4")])


class Ros1Salvage(FileSalvage):
    """Reads what is there of a ROS 1 bag. See `SalvageReader`.

    Args:
        path: The file.

    Raises:
        SourceError: The file is missing, empty, encrypted, of another version, or no bag.
    """

    format: Format = "bag"
    profile = "ros1"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        with open_source(path) as stream:
            start = stream.read(32)
        self._has_magic = start.startswith(MAGIC)
        if not self._has_magic and re.match(rb"#ROS(BAG|RECORD|LOG) V1\.\d\n", start):
            raise other_format(path, start)
        self._index = read_index(path)
        self._channels: dict[int, Channel] = dict(self._index.channels)

    @property
    def channels(self) -> Sequence[Channel]:
        """Connections of the bag's index, then those met while reading."""
        return list(self._channels.values())

    def stats(self) -> Mapping[int, ChannelStats]:
        """Counts and spans of the chunks by the bag's index, with what is lost; else empty."""
        return self._index.stats(self._channels)

    @property
    def _orderly(self) -> Callable[[], BagReader] | None:
        is_far_out = self._index.held_in_file_order() > HOLD_BYTES // _MOST_PACKED
        return partial(Ros1Reader, self.path) if is_far_out else None

    def _pass(self, log: LossLog) -> Iterator[Record]:
        with Window.of_file(self.path) as window:
            reading = _Pass(self.path, window, log, self._index, self._channels)
            held = HoldBack() if self._index.chunks else None
            for message in reading.messages():
                self._position = window.offset
                if held is None:
                    yield message
                    continue
                if reading.is_at_new_chunk:
                    reading.is_at_new_chunk = False
                    yield from held.release(reading.earliest)
                held.add(message)
            if held:
                yield from held.release(None)
            self._position = window.offset
            if self.is_alone and not reading.found and not self._channels:
                raise SourceError(self.path, "holds no record of a ROS 1 bag")


class _Pass:
    """One reading of a bag.

    Attributes:
        found: Records of a bag that were met.
        is_at_new_chunk: Whether a chunk began since this was last reset.
        earliest: No message from here on has an earlier log time, ns, by the bag's index.
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
            if frame.kind != RecordType.IDXDATA:
                yield from self._tally.settle()
            yield from self._record(frame)
        yield from self._tally.settle()
        if (self._index.due or 0) > self._window.offset:
            problem = (
                f"the file ends before its index, which should begin at byte {self._index.due}"
            )
            self._tally.lost(self._window.offset, None, problem)
        self._tally.close()

    def _record(self, frame: Frame[int]) -> Iterator[Message]:
        offset = self._window.offset
        if frame.kind == RecordType.CHUNK:
            (length,) = UINT32.unpack(self._window.peek(frame.head)[-4:])
            self._enter(offset, offset + frame.head + length)
            if frame.fields[b"compression"] == b"none":
                self._window.skip(frame.size)
            else:
                yield from self._compressed(frame)
        elif frame.kind == RecordType.MSGDATA:
            body = self._scan.body(frame)
            if body is not None:
                message = self._message(frame, body, offset)
                if message:
                    self._tally.gave(number(frame.fields[b"conn"]), message.log_time)
                    yield message
        elif frame.kind == RecordType.CONNECTION:
            body = self._scan.body(frame)
            if body is not None and not self._connect(frame, body):
                self._lose(offset, frame.size, "a connection record is damaged")
        elif frame.kind == RecordType.IDXDATA:
            body = self._scan.body(frame)
            if body is not None:
                self._listed(frame, body, offset)
        elif frame.kind == RecordType.BAGHEADER and not self._scan.is_followed(frame.size):
            self._scan.resync(offset, "the header of the bag is damaged", passed=frame.head)
        else:
            self._scan.body(frame)

    def _message(self, frame: Frame[int], body: bytes, offset: int) -> Message | None:
        """A message; None where it is lost."""
        connection, log_time = number(frame.fields[b"conn"]), time(frame.fields[b"time"])
        channel = self._channels.get(connection)
        if log_time >= MAX_TIME:
            self._lose(offset, frame.size, "a message has a time past 2^32 seconds, none of ROS")
            return None
        if channel is None:
            self._tally.stray(connection, log_time)
            problem = f"messages of connection {connection}, of which no record tells"
            loss = self._log.lost_of_kind(connection, offset, problem)
            loss.add(1, ())
            return None
        return Message(channel, log_time, log_time, 0, body)

    def _connect(self, frame: Frame[int], body: bytes, *, is_sure: bool = False) -> bool:
        connection = number(frame.fields[b"conn"])
        try:
            header = dict(split_header(body))
        except DAMAGE:
            return connection in self._channels
        topic = frame.fields.get(b"topic", header.get(b"topic", b""))
        channel = make_channel(connection, topic, header)
        if self._channels.setdefault(connection, channel).identity != channel.identity:
            if is_sure:  # a channel of its own: messages may have been given of the other one
                key = connection, channel.identity
                other = replace(channel, id=2**32 + len(self._others))
                self._channels[connection] = self._others.setdefault(key, other)
            problem = f"records of connection {connection} ({channel.topic}) contradict each other"
            if connection not in self._contradicted:
                self._contradicted.add(connection)
                self._log.lost(None, None, problem).add(0, ())
        return True

    def _compressed(self, frame: Frame[int]) -> Iterator[Message]:
        """The messages of a compressed chunk, as far as it can be unpacked."""
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
            if part.kind == RecordType.MSGDATA:
                message = self._message(part, body, offset)
                connection = number(part.fields[b"conn"])
                if message and unpacked.is_sound:
                    self._tally.gave(connection, message.log_time)
                    yield message
                elif message:
                    self._tally.hold(connection, message)
            elif part.kind == RecordType.CONNECTION and not self._connect(
                part, body, is_sure=not problems
            ):
                problems.append("a connection record is damaged")
        end = frame.head + unpacked.used
        if not unpacked.problem and end != frame.size and scan.is_followed(end):
            window.skip(end)  # the content is whole: the length of the record is what is wrong
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

    def _listed(self, frame: Frame[int], body: bytes, offset: int) -> None:
        connection, count = number(frame.fields[b"conn"]), number(frame.fields[b"count"])
        if self._tally.count_matches(connection, count, offset):
            return
        entries = np.frombuffer(body, _INDEX_ENTRY, count=len(body) // _INDEX_ENTRY.itemsize)
        times = entries["sec"].astype(np.int64) * 10**9 + entries["nsec"]
        found, counts = np.unique(times, return_counts=True)
        self._tally.listed(connection, dict(zip(found.tolist(), counts.tolist(), strict=True)))

    def _enter(self, offset: int, end: int) -> None:
        """A chunk begins that should end at a byte."""
        self._pass_listed(offset)
        starts = self._index.chunks
        if self._next_listed < len(starts) and starts[self._next_listed] == offset:
            self._next_listed += 1
        self._tally.open(self._index.counts(offset), end, self._index.span(offset))
        self.is_at_new_chunk = True
        self.earliest = self._index.start_from(offset)

    def _pass_listed(self, end: int) -> None:
        """Chunks that the index lists before a byte and that were not met are lost here."""
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
