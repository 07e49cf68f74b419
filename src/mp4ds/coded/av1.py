"""AV1 temporal units in the low-overhead format: what an mp4 keeps of them, and key frames.

Sections are those of the AV1 Bitstream & Decoding Process Specification 1.0.0 with errata 1. An
mp4 holds no temporal delimiters (AV1 in ISOBMFF, 2.4): whether a unit began with one is kept as
its framing. What a muxer would leave out besides is refused.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from mp4ds.coded.base import BitReader, Refused, check_size
from mp4ds.coded.pictures import NoPicture, Picture

DELIMITER = b"\x12\0"
"""A temporal delimiter OBU."""

DELIMITED = "td"
"""Framing of a temporal unit that begins with a delimiter; of others it is empty."""

_SEQUENCE_HEADER, _FRAME_HEADER, _TILE_GROUP, _METADATA, _FRAME = 1, 3, 4, 5, 6
_KEPT = frozenset((_SEQUENCE_HEADER, _FRAME_HEADER, _TILE_GROUP, _METADATA, _FRAME))
_DROPPED = {
    2: "a temporal delimiter inside",
    7: "a redundant frame header",
    8: "a tile list",
    15: "padding",
}
_MAX_OBUS = 4096
_HEADER_BYTES = 256


@dataclass(frozen=True, slots=True)
class Obu:
    """An open bitstream unit (5.3).

    Attributes:
        kind: `obu_type`.
        start: Offset of its header in the temporal unit.
        payload: Offset of what it holds.
        end: Offset after it.
    """

    kind: int
    start: int
    payload: int
    end: int


def obus(data: bytes | memoryview) -> Iterator[Obu]:
    """Walk the OBUs of a temporal unit.

    Raises:
        Refused: They do not fill it, or one does not tell its size.
    """
    data = memoryview(data)
    offset = 0
    for _ in range(_MAX_OBUS):
        if offset == len(data):
            return
        header = data[offset]
        if header & 0x81:
            raise Refused("it is no AV1: reserved bits are set")
        if not header & 2:
            raise Refused("it has an AV1 unit that does not tell its size")
        start = offset
        size, offset = _leb128(data, offset + (2 if header & 4 else 1))
        if size > len(data) - offset:
            raise Refused("its AV1 is cut short")
        yield Obu(header >> 3 & 15, start, offset, offset + size)
        offset += size
    raise Refused(f"it has more than {_MAX_OBUS} AV1 units")


def _leb128(data: memoryview, offset: int) -> tuple[int, int]:
    """A variable-length size (4.10.5), and the offset after it."""
    value = 0
    for index, byte in enumerate(data[offset : offset + 8]):
        value |= (byte & 0x7F) << (7 * index)
        if byte < 0x80:
            return value, offset + index + 1
    raise Refused("its AV1 is cut short")


def strip(data: bytes | memoryview) -> tuple[memoryview, str]:
    """What an mp4 holds of a temporal unit, and its framing."""
    data = memoryview(data)
    if bytes(data[:2]) == DELIMITER:
        return data[2:], DELIMITED
    return data, ""


def join(packet: bytes, framing: str) -> bytes:
    """The temporal unit as it was before it went into an mp4.

    Raises:
        Refused: The framing is none.
    """
    if framing not in ("", DELIMITED):
        raise Refused(f"{framing[:40]!r} is no framing of AV1")
    return DELIMITER + packet if framing else packet


def sequence_header(data: bytes | memoryview) -> bytes:
    """The sequence header OBU of a temporal unit; empty if it has none.

    Raises:
        Refused: The OBUs do not add up.
    """
    for obu in obus(data):
        if obu.kind == _SEQUENCE_HEADER:
            return bytes(memoryview(data)[obu.start : obu.end])
    return b""


class Av1Pictures:
    """The pictures of one stream, temporal unit by temporal unit."""

    def __init__(self) -> None:
        self._parameters = b""
        self._size = (0, 0)
        self._still = False

    @property
    def parameters(self) -> bytes:
        """The sequence header OBU seen last."""
        return self._parameters

    def picture(self, data: memoryview) -> Picture:
        """The picture in a temporal unit whose delimiter is taken off.

        Raises:
            NoPicture: There is none.
            Refused: There are several, an mp4 would lose a part of it, or it needs a sequence
                header that was not sent.
        """
        shown = frames = 0
        keyframe = has_header = False
        for obu in obus(data):
            if obu.kind in _DROPPED:
                raise Refused(f"it has {_DROPPED[obu.kind]}, which no mp4 keeps")
            if obu.kind not in _KEPT:
                raise Refused(f"it has an AV1 unit of the unknown kind {obu.kind}")
            payload = bytes(data[obu.payload : min(obu.end, obu.payload + _HEADER_BYTES)])
            if obu.kind == _SEQUENCE_HEADER:
                self._take_sequence_header(payload)
                self._parameters = bytes(data[obu.start : obu.end])
                has_header = True
            elif obu.kind in (_FRAME_HEADER, _FRAME):
                if not self._parameters:
                    raise Refused("its sequence header was not sent before it")
                is_shown, is_key = self._frame(payload)
                # decoders begin only where the header is too (AV1 in ISOBMFF, 2.4)
                keyframe |= is_key and has_header and not frames
                frames += 1
                shown += is_shown
        if not frames:
            raise NoPicture("it holds no picture, only parameters or remarks")
        if shown != 1:
            raise Refused("it shows no picture" if not shown else "it holds more than one picture")
        return Picture(*self._size, keyframe)

    def _frame(self, payload: bytes) -> tuple[bool, bool]:
        """Whether a frame is shown, and a key frame (5.9.2)."""
        if self._still:
            return True, True
        reader = BitReader(payload)
        if reader.flag():
            return True, False
        key = reader.bits(2) == 0
        shown = reader.flag()
        return shown, key and shown

    def _take_sequence_header(self, payload: bytes) -> None:
        """Read up to the picture size (5.5.1)."""
        reader = BitReader(payload)
        reader.bits(4)
        still = reader.flag()
        if still:
            reader.bits(5)
        else:
            _skip_operating_points(reader)
        width_bits, height_bits = reader.bits(4) + 1, reader.bits(4) + 1
        width, height = reader.bits(width_bits) + 1, reader.bits(height_bits) + 1
        check_size(width, height)
        self._size, self._still = (width, height), still


def _skip_operating_points(reader: BitReader) -> None:
    delay_bits = 0
    if reader.flag():
        reader.bits(64)
        if reader.flag():
            reader.ue()
        if reader.flag():
            delay_bits = reader.bits(5) + 1
            reader.bits(42)
    display_delay = reader.flag()
    for _ in range(reader.bits(5) + 1):
        reader.bits(12)
        if reader.bits(5) > 7:
            reader.flag()
        if delay_bits and reader.flag():
            reader.bits(2 * delay_bits + 1)
        if display_delay and reader.flag():
            reader.bits(4)
