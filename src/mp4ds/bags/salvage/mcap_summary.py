"""The summary of a damaged MCAP file, as far as it can be read."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap import records as mcap_records
from mcap.opcode import Opcode
from numpy.typing import NDArray

from mp4ds.bags.files import DamageError
from mp4ds.bags.mcap_index import ChunkTable, McapSummary
from mp4ds.bags.mcap_records import (
    FOOTER_BYTES,
    MAGIC,
    OF_SUMMARY,
    PRIVATE_OPCODE,
)
from mp4ds.bags.salvage.scan import RecordFrame, Scan, Window

_FRAME = struct.Struct("<BQ")
_HEAD = _FRAME.size
_CHUNK_FIXED = 40  # bytes of a chunk's fields, without its compression and its records
_MESSAGE_FIXED = 22
_MAX_LENGTH = 2**40
_COMPRESSIONS = (b"", b"lz4", b"zstd")


class McapFraming:
    """Finds records by opcode and length; MCAP has no sync markers.

    In sequence, anything the format allows is a record. After damage, it must be of a kind whose
    fields match the length of its frame, or a message of a known channel followed by another
    record.

    Args:
        channels: Ids of the known channels; may grow.
    """

    lookahead = 2**16
    outer: Collection[int] = frozenset(
        {
            Opcode.CHUNK,
            Opcode.MESSAGE_INDEX,
            Opcode.ATTACHMENT,
            Opcode.METADATA,
            Opcode.DATA_END,
            Opcode.FOOTER,
        }
    )

    def __init__(self, channels: Collection[int]) -> None:
        self._channels = channels

    def frame(self, view: memoryview) -> RecordFrame[int] | None:
        """See `Framing.frame`."""
        if len(view) < _HEAD:
            return None
        opcode, length = _FRAME.unpack_from(view)
        if length >= _MAX_LENGTH or length < _SHORTEST.get(opcode, 0):
            return None
        if not 1 <= opcode <= Opcode.DATA_END and opcode < PRIVATE_OPCODE:
            return None
        if opcode == Opcode.CHUNK:
            needed = _chunk_length(view[_HEAD:])
            if needed is None or needed > length:
                return None
        return RecordFrame(opcode, _HEAD, _HEAD + length)

    def find(
        self,
        view: memoryview,
        end: int,
        is_followed: Callable[[int], bool],
        kinds: Collection[int] | None = None,
    ) -> int | None:
        """See `Framing.find`."""
        for start in self._candidates(view, end):
            if kinds is not None and view[start] not in kinds:
                continue
            size = self._sure_size(view[start:])
            if size == 0 or (size and is_followed(start + size)):
                return start
        return None

    def _candidates(self, view: memoryview, end: int) -> list[int]:
        """Places of an opcode followed by a plausible length."""
        data = np.frombuffer(view, np.uint8)[: end + _HEAD]
        if len(data) < _HEAD:
            return []
        kinds = data[: -_HEAD + 1]
        mask = (data[7 : len(data) - 1] == 0) & (data[8:] == 0)
        mask &= (kinds - np.uint8(Opcode.FOOTER)) <= Opcode.DATA_END - Opcode.FOOTER
        places = np.flatnonzero(mask)
        if not len(places):
            return []
        lengths = np.zeros(len(places), np.int64)
        for byte in range(6):
            lengths |= data[places + 1 + byte].astype(np.int64) << (8 * byte)
        found = kinds[places]
        keep = (lengths >= _SHORTEST_OF[found]) & (lengths <= _LONGEST_OF[found])
        keep[found == Opcode.MESSAGE] &= self._is_known(data, places[found == Opcode.MESSAGE])
        result: list[int] = places[keep & (places < end)].tolist()
        return result

    def _is_known(self, data: NDArray[np.uint8], places: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Whether messages at these places are of known channels."""
        low = np.minimum(places + _HEAD, len(data) - 1)
        high = np.minimum(places + _HEAD + 1, len(data) - 1)
        ids = data[low].astype(np.int64) | data[high].astype(np.int64) << 8
        # the last few may extend beyond the view: the strict check decides
        return np.isin(ids, list(self._channels)) | (places + _HEAD + 1 >= len(data))

    def _sure_size(self, view: memoryview) -> int | None:
        """0 for a certain record, its size if another must follow, None for no record."""
        frame = self.frame(view)
        if frame is None:
            return None
        body, length = view[_HEAD:], frame.size - _HEAD
        if frame.kind == Opcode.MESSAGE:
            is_known = int.from_bytes(body[:2], "little") in self._channels
            return frame.size if is_known else None
        if frame.kind == Opcode.FOOTER:
            return 0 if bytes(body[20 : 20 + len(MAGIC)]) == MAGIC else None
        if frame.kind == Opcode.DATA_END:
            return frame.size
        measure = _MEASURES.get(frame.kind)
        try:
            return 0 if measure is not None and measure(body) == length else None
        except struct.error:
            return None


def _string(body: memoryview, offset: int) -> int:
    """The end of a string or map that begins at an offset."""
    return offset + 4 + int(struct.unpack_from("<I", body, offset)[0])


def _chunk_length(body: memoryview) -> int | None:
    """Length of a chunk's body by its fields; None if they are not those of a chunk."""
    if len(body) < _CHUNK_FIXED:
        return None
    (length,) = struct.unpack_from("<I", body, 28)
    if length > 16 or bytes(body[32 : 32 + length]) not in _COMPRESSIONS:
        return None
    if len(body) < _CHUNK_FIXED + length:
        return None
    (records,) = struct.unpack_from("<Q", body, 32 + length)
    return int(_CHUNK_FIXED + length + records)


def _schema_length(body: memoryview) -> int:
    return _string(body, _string(body, _string(body, 2)))


def _channel_length(body: memoryview) -> int:
    return _string(body, _string(body, _string(body, 4)))


def _attachment_length(body: memoryview) -> int:
    data = _string(body, _string(body, 16))
    return data + 8 + int(struct.unpack_from("<Q", body, data)[0]) + 4


def _metadata_length(body: memoryview) -> int:
    return _string(body, _string(body, 0))


def _message_index_length(body: memoryview) -> int:
    end = _string(body, 2)
    return end if (end - 6) % 16 == 0 else -1


_MEASURES: dict[int, Callable[[memoryview], int | None]] = {
    Opcode.CHUNK: _chunk_length,
    Opcode.SCHEMA: _schema_length,
    Opcode.CHANNEL: _channel_length,
    Opcode.ATTACHMENT: _attachment_length,
    Opcode.METADATA: _metadata_length,
    Opcode.MESSAGE_INDEX: _message_index_length,
}
_SHORTEST: dict[int, int] = {
    Opcode.FOOTER: 20,
    Opcode.SCHEMA: 14,
    Opcode.CHANNEL: 16,
    Opcode.MESSAGE: _MESSAGE_FIXED,
    Opcode.CHUNK: _CHUNK_FIXED,
    Opcode.MESSAGE_INDEX: 6,
    Opcode.ATTACHMENT: 36,
    Opcode.METADATA: 8,
    Opcode.DATA_END: 4,
}


def _table(known: dict[int, int], other: int) -> NDArray[np.int64]:
    table = np.full(256, other, np.int64)
    for opcode, value in known.items():
        table[opcode] = value
    return table


# Records that are not searched for have no possible length.
_SHORTEST_OF = _table(_SHORTEST, _MAX_LENGTH)
_LONGEST_OF = _table(
    {**dict.fromkeys(_SHORTEST, _MAX_LENGTH), Opcode.DATA_END: 4, Opcode.FOOTER: 20}, 0
)


# ---------------------------------------------------------------- the summary

_MAX_SEARCHED = 256 * 2**20


@dataclass
class SalvagedSummary(McapSummary):
    """The readable part of a summary section.

    Attributes:
        is_verified: Whether it matches its checksum, if it has one.
        is_whole: Whether all of it could be read.
    """

    is_verified: bool = True
    is_whole: bool = True

    @property
    def doubtful(self) -> dict[int, mcap_records.Channel]:
        """Channels by id, if the summary does not match its checksum."""
        return {} if self.is_verified else self.channels

    def finish(self) -> None:
        """Finish after everything was added, and drop what depends on its being complete."""
        if not self.is_whole or not self.is_verified:
            self.chunks = ChunkTable()
            self.statistics = None
        self.chunks.finish()


def read_summary(path: Path) -> SalvagedSummary:
    """Read the summary of a file; empty if it has none or its place is unknown.

    Raises:
        SourceError: It cannot be read.
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
        return True  # checking would take long
    with Window.of_file(path, start) as window:
        covered = window.peek(end - start)
        (told,) = struct.unpack("<I", window.look(end - start, 4) or bytes(4))
        return told in (0, zlib.crc32(covered))


def _read_from(path: Path, start: int, summary: SalvagedSummary) -> None:
    framing = McapFraming({})
    with Window.of_file(path, start) as window:
        is_there = framing.frame(window.peek(framing.lookahead)) is not None
        if not is_there and (window.left or 0) > _MAX_SEARCHED:
            return  # the rest may be anything
        summary.offset = start

        def lose(*_: object) -> None:
            summary.is_whole = False

        scan = Scan(window, framing, lose)
        while frame := scan.next():
            if frame.kind == Opcode.FOOTER:
                return
            if frame.kind not in OF_SUMMARY:
                break
            body = scan.body(frame)
            if body is not None:
                try:
                    summary.add(frame.kind, body)
                except DamageError:
                    summary.is_whole = False
        summary.is_whole = False
