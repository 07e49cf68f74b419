"""How the records of an MCAP file begin (https://mcap.dev/spec)."""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from mp4ds.bags.mcap_records import MAGIC, PRIVATE_OPCODE
from mp4ds.bags.salvage.scan import Frame

_FRAME = struct.Struct("<BQ")
_HEAD = _FRAME.size
_CHUNK_FIXED = 40  # bytes of a chunk's fields, without its compression and its records
_MESSAGE_FIXED = 22
_MAX_LENGTH = 2**40
_COMPRESSIONS = (b"", b"lz4", b"zstd")


class McapFraming:
    """Records by opcode and length; MCAP has no marks to find them by.

    In order, what the format allows is a record. After damage one must be of a kind whose
    fields tell the same length as its frame, or a message of a channel that is known and that
    another record follows.

    Args:
        channels: Ids of the channels known, which may become more.
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

    def frame(self, view: memoryview) -> Frame[int] | None:
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
        return Frame(opcode, _HEAD, _HEAD + length)

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
        """Where an opcode stands before a length that is not too long."""
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
        """Whether messages at these places are of channels that are known."""
        low = np.minimum(places + _HEAD, len(data) - 1)
        high = np.minimum(places + _HEAD + 1, len(data) - 1)
        ids = data[low].astype(np.int64) | data[high].astype(np.int64) << 8
        # the last few may lie beyond what was looked at: the strict check decides
        return np.isin(ids, list(self._channels)) | (places + _HEAD + 1 >= len(data))

    def _sure_size(self, view: memoryview) -> int | None:
        """0 for a record beyond doubt, its size if another must follow, None for no record."""
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
    """Where a string, or a map, that begins at an offset ends."""
    return offset + 4 + int(struct.unpack_from("<I", body, offset)[0])


def _chunk_length(body: memoryview) -> int | None:
    """Bytes of a chunk's body by its fields, None where they are not those of a chunk."""
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


# Records that are not looked for have no possible length.
_SHORTEST_OF = _table(_SHORTEST, _MAX_LENGTH)
_LONGEST_OF = _table(
    {**dict.fromkeys(_SHORTEST, _MAX_LENGTH), Opcode.DATA_END: 4, Opcode.FOOTER: 20}, 0
)
