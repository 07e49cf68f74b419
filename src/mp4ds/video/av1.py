"""AV1 temporal units: key frames, what an mp4 keeps of them, and what frames refer to."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

from mp4ds.errors import Refused
from mp4ds.messages.encodings import check_size
from mp4ds.video.coded import (
    BitReader,
    CodedFrame,
    CodedPicture,
    NoPicture,
    StreamParser,
    UnknownStructure,
)

DELIMITER = b"\x12\0"
"""A temporal delimiter OBU."""

DELIMITED = "td"
"""Framing of a temporal unit that begins with a delimiter; empty for others."""

_SEQUENCE_HEADER, _DELIMITER, _FRAME_HEADER, _TILE_GROUP, _METADATA, _FRAME = 1, 2, 3, 4, 5, 6
_KEPT = frozenset((_SEQUENCE_HEADER, _FRAME_HEADER, _TILE_GROUP, _METADATA, _FRAME))
_DROPPED = {
    2: "a temporal delimiter inside",
    7: "a redundant frame header",
    8: "a tile list",
    15: "padding",
}
_MAX_OBUS = 4096


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
        Refused: They do not fill it, or one does not state its size.
    """
    data = memoryview(data)
    offset = 0
    for _ in range(_MAX_OBUS):
        if offset == len(data):
            return
        header = data[offset]
        if header & 0x81:
            raise Refused("it is not AV1: reserved bits are set")
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


def sequence_header(data: bytes | memoryview) -> bytes:
    """The sequence header OBU of a temporal unit; empty if it has none.

    Raises:
        Refused: The OBUs do not add up.
    """
    for obu in obus(data):
        if obu.kind == _SEQUENCE_HEADER:
            return bytes(memoryview(data)[obu.start : obu.end])
    return b""


# ---------------------------------------------------------------- headers

_PADDING = 15
_KEY, _INTER, _INTRA_ONLY, _SWITCH = range(4)
_SLOTS = 8
_ALL_SLOTS = 0xFF
_CHOSEN = 2  # by each frame
# what a frame header and a sequence header take at most, as far as they are read
_FRAME_HEADER_BYTES = 40
_SEQUENCE_BYTES = 512


@dataclass(frozen=True, slots=True)
class _Sequence:
    """The part of a sequence header that determines how frame headers are read (5.5.1).

    Attributes:
        unfit: Why what its frames refer to is not understood; empty if it is.
        size: Width and height.
    """

    unfit: str
    size: tuple[int, int]
    still: bool
    layers: int
    id_bits: int
    delta_id_bits: int
    screen_content: int
    integer_mv: int
    order_bits: int


@lru_cache(maxsize=16)  # it is the same in the track and before each key frame
def _parse_sequence(payload: bytes) -> _Sequence:
    reader = BitReader(payload[:_SEQUENCE_BYTES])
    reader.bits(4)
    still = reader.flag()
    layers, unfit = 0, ""
    if still:
        reader.bits(5)
    else:
        layers, unfit = _parse_operating_points(reader)
    width_bits, height_bits = reader.bits(4) + 1, reader.bits(4) + 1
    size = reader.bits(width_bits) + 1, reader.bits(height_bits) + 1
    check_size(*size)
    id_bits = delta_id_bits = 0
    if not still and reader.flag():
        delta_id_bits = reader.bits(4) + 2
        id_bits = reader.bits(3) + delta_id_bits + 1
    reader.bits(3)
    screen_content = integer_mv = _CHOSEN
    order_bits = 0
    if not still:
        reader.bits(4)
        ordered = reader.flag()
        if ordered:
            reader.bits(2)
        if not reader.flag():
            screen_content = reader.bits(1)
        if screen_content and not reader.flag():
            integer_mv = reader.bits(1)
        if ordered:
            order_bits = reader.bits(3) + 1
    return _Sequence(
        *(unfit, size, still, layers),
        *(id_bits, delta_id_bits, screen_content, integer_mv, order_bits),
    )


def _parse_operating_points(reader: BitReader) -> tuple[int, str]:
    """The layers that decoders use, those of the first operating point; 0: all. And see `unfit`."""
    unfit = ""
    delay_bits = 0
    if reader.flag():
        reader.bits(64)
        if reader.flag():
            reader.ue()
        if reader.flag():
            delay_bits = reader.bits(5) + 1
            reader.bits(42)
            unfit = "its AV1 tells the times of a decoder"
    display_delay = reader.flag()
    layers: list[int] = []
    for _ in range(reader.bits(5) + 1):
        layers.append(reader.bits(12))
        if reader.bits(5) > 7:
            reader.flag()
        if delay_bits and reader.flag():
            reader.bits(2 * delay_bits + 1)
        if display_delay and reader.flag():
            reader.bits(4)
    if layers[0] and layers[0] >> 8 != 1:
        unfit = unfit or "its AV1 has spatial layers"
    return layers[0], unfit


class _Header(NamedTuple):
    """The part of a frame header that concerns references.

    Attributes:
        kind: `frame_type`; None if it only shows a frame.
        shown: Whether a picture comes out.
        used: Slots of the frames it needs.
        filled: Slots that hold it afterwards, as bits.
    """

    kind: int | None
    shown: bool
    used: Iterable[int]
    filled: int

    @property
    def is_key(self) -> bool:
        """Whether decoding can begin here."""
        return self.kind == _KEY and self.shown


def _parse_header(data: memoryview, obu: Obu, sequence: _Sequence) -> _Header:
    """Read the uncompressed header of a frame up to the slots that it uses (5.9.2)."""
    if sequence.still:
        return _Header(_KEY, shown=True, used=(), filled=_ALL_SLOTS)
    end = min(obu.end, obu.payload + _FRAME_HEADER_BYTES)
    reader = BitReader(bytes(data[obu.payload : end]))
    if reader.flag():
        return _Header(None, shown=True, used=(reader.bits(3),), filled=0)
    kind = reader.bits(2)
    shown = reader.flag()
    if not shown:
        reader.flag()
    if kind == _KEY and shown:
        return _Header(kind, shown, used=(), filled=_ALL_SLOTS)
    intra = kind in (_KEY, _INTRA_ONLY)
    resilient = kind == _SWITCH or reader.flag()
    reader.flag()
    screen_content = sequence.screen_content
    if screen_content == _CHOSEN:
        screen_content = reader.bits(1)
    if screen_content and sequence.integer_mv == _CHOSEN:
        reader.flag()
    # the frame's id, whether it has a size of its own, and its place in the order shown
    reader.bits(sequence.id_bits + (kind != _SWITCH) + sequence.order_bits)
    if not (intra or resilient):
        reader.bits(3)
    filled = _ALL_SLOTS if kind == _SWITCH else reader.bits(_SLOTS)
    if intra:
        return _Header(kind, shown, used=(), filled=filled)
    if resilient:
        reader.bits(_SLOTS * sequence.order_bits)
    if sequence.order_bits and reader.flag():
        # its slots are chosen by the order of the frames in all of them (7.8)
        return _Header(kind, shown, used=range(_SLOTS), filled=filled)
    used = set()
    for _ in range(7):
        used.add(reader.bits(3))
        reader.bits(sequence.delta_id_bits)
    return _Header(kind, shown, used, filled)


# ---------------------------------------------------------------- parser


class Av1(StreamParser):
    """Temporal units."""

    def __init__(self, configuration: bytes | None = None) -> None:
        self._parameters = b""
        self._sequence: _Sequence | None = None
        self._sequence_bytes = b""  # of the one by which references are found
        self._changed = False  # since the last key frame
        self._number = 0  # of the next coded frame
        self._start = 0  # number of the key frame where decoding began
        self._slots: list[tuple[int, int | None]] = []  # number and kind; none before a key frame
        super().__init__(configuration)

    # -------- packets of messages

    @property
    def parameters(self) -> bytes:
        """The sequence header OBU seen last."""
        return self._parameters

    def _picture(self, body: memoryview) -> CodedPicture:
        is_delimited = bytes(body[:2]) == DELIMITER
        data = body[2:] if is_delimited else body
        shown = frames = 0
        keyframe = has_header = False
        for obu in obus(data):
            if obu.kind in _DROPPED:
                raise Refused(f"it has {_DROPPED[obu.kind]}, which no mp4 keeps")
            if obu.kind not in _KEPT:
                raise Refused(f"it has an AV1 unit of the unknown kind {obu.kind}")
            if obu.kind == _SEQUENCE_HEADER:
                self._sequence = _parse_sequence(bytes(data[obu.payload : obu.end]))
                self._parameters = bytes(data[obu.start : obu.end])
                has_header = True
            elif obu.kind in (_FRAME_HEADER, _FRAME):
                if self._sequence is None:
                    raise Refused("its sequence header was not sent before it")
                header = _parse_header(data, obu, self._sequence)
                # decoders begin only where the header is too (AV1 in ISOBMFF, 2.4)
                keyframe |= header.is_key and has_header and not frames
                frames += 1
                shown += header.shown
        if not frames or self._sequence is None:
            raise NoPicture("it holds no picture, only parameters or remarks")
        if shown != 1:
            raise Refused("it shows no picture" if not shown else "it holds more than one picture")
        return CodedPicture(*self._sequence.size, keyframe, DELIMITED if is_delimited else "")

    # -------- packets of an mp4

    @staticmethod
    def units_of(configuration: bytes) -> list[bytes]:
        """What stands in ``av1C`` (AV1 in ISOBMFF, 2.3)."""
        return [configuration[4:]]

    def _take_unit(self, unit: bytes) -> None:
        for obu in obus(unit):
            if obu.kind == _SEQUENCE_HEADER:
                self._take_sequence(unit[obu.payload : obu.end])

    def _forget(self) -> None:
        self._slots = []

    def _frames(self, data: memoryview, *, key: bool) -> list[CodedFrame]:
        frames: list[CodedFrame] = []
        open_header = False  # whether the tiles of the last frame are yet to come
        is_existing = False  # whether the last frame only shows another one
        for obu in obus(data):
            kind = obu.kind
            if kind in (_FRAME, _FRAME_HEADER):
                if open_header:
                    raise UnknownStructure("its AV1 has a frame without tiles")
                frame, is_existing = self._frame(data, obu, key=key and not frames)
                frames.append(frame)
                open_header = kind == _FRAME_HEADER and not is_existing
            elif kind == _TILE_GROUP:
                if not frames or is_existing:
                    raise UnknownStructure("its AV1 has tiles without a frame")
                open_header = False
            elif kind == _SEQUENCE_HEADER:
                self._take_sequence(bytes(data[obu.payload : obu.end]))
            elif kind not in (_METADATA, _PADDING, _DELIMITER):
                raise UnknownStructure(f"it has an AV1 unit of the kind {kind}")
        if not frames or open_header:
            raise UnknownStructure("it holds no whole picture")
        return frames

    def _take_sequence(self, payload: bytes) -> None:
        if payload != self._sequence_bytes:
            self._sequence, self._sequence_bytes = None, b""
            sequence = _parse_sequence(payload)
            if sequence.unfit:
                raise UnknownStructure(sequence.unfit)
            self._sequence = sequence
            self._sequence_bytes = payload
            self._changed = True

    def _frame(self, data: memoryview, obu: Obu, *, key: bool) -> tuple[CodedFrame, bool]:
        """A frame, and whether it only shows another one."""
        sequence = self._sequence
        if sequence is None:
            raise UnknownStructure("its sequence header was not sent before it")
        if data[obu.start] & 4:  # decoders skip it, or show it together with another (5.3.3)
            temporal, spatial = data[obu.start + 1] >> 5, data[obu.start + 1] >> 3 & 3
            if spatial or (sequence.layers and not sequence.layers >> temporal & 1):
                raise UnknownStructure("its AV1 has layers that decoders leave out")
        header = _parse_header(data, obu, sequence)
        number = self._number
        begins = header.is_key
        if begins:
            self._start = number
            self._changed = False
            self._slots = [(number, _KEY)] * _SLOTS
        elif key:
            raise UnknownStructure("it is marked as a key frame and does not begin with one")
        elif not self._slots:
            raise UnknownStructure("it comes before the first key frame")
        elif self._changed:
            raise UnknownStructure("its sequence header changes between key frames")
        self._number += 1
        references = () if begins else self._references(header, number)
        return CodedFrame(references, header.shown), header.kind is None

    def _references(self, header: _Header, number: int) -> tuple[int, ...]:
        """The distances of what a frame needs, after which it is in its slots."""
        kind, filled = header.kind, header.filled
        if kind is None:
            (slot,) = header.used
            # a key frame that is shown only now fills all slots, as if it came now (7.21)
            if self._slots[slot][1] == _KEY:
                kind, filled = _KEY, _ALL_SLOTS
        needed = {self._slots[slot][0] for slot in header.used}
        if not needed:
            needed = {self._start}  # it needs no other frame, and yet is no place to begin
        for slot in range(_SLOTS):
            if filled >> slot & 1:
                self._slots[slot] = (number, kind)
        return tuple(number - n for n in sorted(needed, reverse=True))

    @staticmethod
    def spans(packet: bytes) -> list[tuple[int, int, int]]:
        """Those of the frames of a temporal unit."""
        frames: list[tuple[int, int, int]] = []
        header = -1
        for obu in obus(packet):
            if obu.kind == _SEQUENCE_HEADER:
                header = obu.start
            elif obu.kind in (_FRAME, _FRAME_HEADER):
                frames.append((obu.start if header < 0 else header, obu.start, obu.end))
                header = -1
            elif obu.kind == _TILE_GROUP:
                if not frames:
                    raise UnknownStructure("its AV1 has tiles without a frame")
                frames[-1] = (*frames[-1][:2], obu.end)
        return frames

    # -------- from one to the other

    @staticmethod
    def plain(body: bytes | memoryview) -> bytes:
        """Without the delimiter, which no mp4 has."""
        return bytes(body).removeprefix(DELIMITER)

    @staticmethod
    def body(packet: bytes, framing: str | None) -> bytes:
        """With the delimiter, if it had one."""
        if framing and framing != DELIMITED:
            raise Refused(f"{framing[:40]!r} is no framing of AV1")
        return DELIMITER + packet if framing else packet

    @classmethod
    def stand_alone(cls, packet: bytes, units: list[bytes]) -> bytes:
        """With the delimiter and, before a key frame, the sequence header."""
        needed = [] if units and sequence_header(packet) else units
        return b"".join((DELIMITER, *needed, packet))

    @classmethod
    def has_parameters(cls, plain: bytes) -> bool:
        """Whether it has a sequence header."""
        return bool(sequence_header(plain))
