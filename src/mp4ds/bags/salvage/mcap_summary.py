"""What the summary of an MCAP file tells, as far as it can be read."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mcap import records as mcap_records
from mcap.opcode import Opcode

from mp4ds.bags.mcap_chunks import ChunkTable
from mp4ds.bags.mcap_records import FOOTER_BYTES, MAGIC, OF_SUMMARY, DamageError, parse
from mp4ds.bags.salvage.mcap_framing import McapFraming
from mp4ds.bags.salvage.scan import Scan
from mp4ds.bags.salvage.window import Window
from mp4ds.records import ChannelStats

_MAX_SEARCHED = 256 * 2**20


class SalvagedSummary:
    """A summary section. What counts on its being whole is left out where it is not.

    Attributes:
        offset: Byte where it begins, None where there is none.
        schemas: Schema records, in their order.
        channels: Channel records, in their order.
        statistics: The statistics record, if there is one.
        chunks: The chunks that it lists.
        is_verified: Whether it matches its checksum, if it has one.
    """

    def __init__(self) -> None:
        self.offset: int | None = None
        self.schemas: list[mcap_records.Schema] = []
        self.channels: list[mcap_records.Channel] = []
        self.statistics: mcap_records.Statistics | None = None
        self.chunks = ChunkTable()
        self.is_verified = True
        self._is_whole = True

    @property
    def doubtful(self) -> dict[int, mcap_records.Channel]:
        """Channels by id, where the summary does not match its checksum."""
        return {} if self.is_verified else {channel.id: channel for channel in self.channels}

    def add(self, opcode: int, body: bytes) -> None:
        """Take a record in."""
        takers: dict[int, Callable[[], Any]] = {
            Opcode.CHUNK_INDEX: lambda: self.chunks.add(body),
            Opcode.SCHEMA: lambda: self.schemas.append(parse(mcap_records.Schema, body)),
            Opcode.CHANNEL: lambda: self.channels.append(parse(mcap_records.Channel, body)),
            Opcode.STATISTICS: lambda: self._count(parse(mcap_records.Statistics, body)),
        }
        try:
            takers.get(opcode, lambda: None)()
        except DamageError:
            self.damaged()

    def _count(self, statistics: mcap_records.Statistics) -> None:
        self.statistics = statistics

    def damaged(self) -> None:
        """A part of it cannot be read."""
        self._is_whole = False

    def finish(self) -> None:
        """All that there is was added."""
        if not self._is_whole or not self.is_verified:
            self.chunks = ChunkTable()
            self.statistics = None
        self.chunks.finish()

    def stats(self) -> dict[int, ChannelStats]:
        """Counts and spans by channel id; empty where it does not tell."""
        if self.statistics is None:
            return {}
        whole = self.statistics.message_start_time, self.statistics.message_end_time
        spans = self.chunks.spans()
        counts = self.statistics.channel_message_counts
        found = {channel.id: ChannelStats(0, 0, 0) for channel in self.channels}
        for channel_id, count in counts.items():
            span = spans.get(channel_id, whole) if count else (0, 0)
            found[channel_id] = ChannelStats(count, *span)
        return found


def read_summary(path: Path) -> SalvagedSummary:
    """The summary of a file, empty where it has none or its place is not known.

    Raises:
        SourceError: The disk does not give it.
    """
    summary = SalvagedSummary()
    with Window.of_file(path) as window:
        size = window.size or 0
        tail = window.look(size - FOOTER_BYTES, FOOTER_BYTES) if size > FOOTER_BYTES else None
    if tail and tail[0] == Opcode.FOOTER and tail[-len(MAGIC) :] == MAGIC:
        (start,) = struct.unpack_from("<Q", tail, 9)
        if len(MAGIC) < start < size - FOOTER_BYTES:
            summary.is_verified = _matches(path, start, size - len(MAGIC) - 4)
            _read_from(path, start, summary)
    summary.finish()
    return summary


def _matches(path: Path, start: int, end: int) -> bool:
    """Whether the bytes of a summary, up to its checksum, match that."""
    if end - start > _MAX_SEARCHED:
        return True  # it would take long
    with Window.of_file(path, start) as window:
        covered = window.peek(end - start)
        (told,) = struct.unpack("<I", window.look(end - start, 4) or bytes(4))
        return told in (0, zlib.crc32(covered))


def _read_from(path: Path, start: int, summary: SalvagedSummary) -> None:
    framing = McapFraming({})
    with Window.of_file(path, start) as window:
        is_there = framing.frame(window.peek(framing.lookahead)) is not None
        if not is_there and (window.left or 0) > _MAX_SEARCHED:
            return  # what follows may be anything
        summary.offset = start
        scan = Scan(window, framing, lambda *_: summary.damaged())
        while frame := scan.next():
            if frame.kind == Opcode.FOOTER:
                return
            if frame.kind not in OF_SUMMARY:
                break
            body = scan.body(frame)
            if body is not None:
                summary.add(frame.kind, body)
        summary.damaged()
