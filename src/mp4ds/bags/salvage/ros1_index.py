"""What the index at the end of a ROS 1 bag tells, as far as it can be read."""

from __future__ import annotations

import bisect
import struct
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from rosbags.rosbag1.reader import RecordType

from mp4ds.bags.ros1_records import DAMAGE, MAGIC, make_channel, split_header
from mp4ds.bags.salvage.ros1_framing import Ros1Framing, number, time
from mp4ds.bags.salvage.scan import Frame, Scan
from mp4ds.bags.salvage.window import Window
from mp4ds.errors import SourceError
from mp4ds.records import Channel, ChannelStats

_COUNT = struct.Struct("<II")
_SEARCHED = 16 * 2**20
_OF_INDEX = (RecordType.CONNECTION, RecordType.CHUNK_INFO)


class BagIndex:
    """Connections and chunks that the index of a bag lists.

    Attributes:
        channels: By connection number, in the order of the index.
        chunks: Byte offsets of the chunks, sorted.
        due: Byte where the index should begin by the header of the bag, None where not known.
        offset: The same, where there is an index.
    """

    def __init__(self) -> None:
        self.channels: dict[int, Channel] = {}
        self.chunks: list[int] = []
        self.due: int | None = None
        self.offset: int | None = None
        self._infos: dict[int, tuple[int, int, bytes]] = {}
        self._places: list[int] = []
        self._later: list[int] = []

    def add(self, frame: Frame[int], body: bytes) -> None:
        """Take a record of the index in."""
        if frame.kind == RecordType.CHUNK_INFO:
            fields = frame.fields
            span = time(fields[b"start_time"]), time(fields[b"end_time"])
            self._infos[number(fields[b"chunk_pos"])] = (*span, body[: len(body) // 8 * 8])
            return
        connection = number(frame.fields[b"conn"])
        try:
            header = dict(split_header(body))
        except DAMAGE:
            return
        topic = frame.fields.get(b"topic", header.get(b"topic", b""))
        self.channels.setdefault(connection, make_channel(connection, topic, header))

    def finish(self, *, chunks: int | None) -> bool:
        """All that there is was added: where that is not all chunks, it tells of none.

        Args:
            chunks: How many there are by the header of the bag, None where it does not tell.

        Returns:
            Whether all chunks are there.
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
        """Messages by connection of the chunk at a byte; None where it is not listed."""
        if chunk not in self._infos:
            return None
        found: dict[int, int] = {}
        for connection, count in _COUNT.iter_unpack(self._infos[chunk][2]):
            found[connection] = found.get(connection, 0) + count
        return found

    def span(self, chunk: int) -> tuple[int, int] | None:
        """First and last log time of the chunk at a byte, ns; None where it is not listed."""
        info = self._infos.get(chunk)
        return (info[0], info[1]) if info else None

    def held_in_file_order(self) -> int:
        """Bytes of chunks, as they are in the file, that wait at most for earlier messages."""
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
        """Counts and spans of the chunks by connection; empty where no chunk is listed."""
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
    """The index of a bag: all of it, or else what connections the end of the file tells.

    Raises:
        SourceError: The bag is encrypted, or the disk does not give it.
    """
    index = BagIndex()
    framing = Ros1Framing()
    with Window.of_file(path) as window:
        window.skip(len(MAGIC))
        header = framing.frame(window.peek(framing.lookahead))
        size = window.size or 0
    chunks = None
    if header and header.kind == RecordType.BAGHEADER:
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
    """Read an index that stands where it should."""
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
    """Look for connections from a byte on, where the index may stand elsewhere."""
    framing = Ros1Framing()
    with Window.of_file(path, offset) as window:
        scan = Scan(window, framing, lambda *_: None)
        if offset > len(MAGIC):
            scan.resync(offset, "", passed=0)
        while frame := scan.next():
            body = scan.body(frame)
            if body is not None and frame.kind == RecordType.CONNECTION:
                index.add(frame, body)
