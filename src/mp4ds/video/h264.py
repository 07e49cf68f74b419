"""NAL units, which H.264 and H.265 share, and H.264: key frames, size, order and references.

Sections are those of ITU-T H.264 (08/2021).
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from mp4ds.errors import Refused
from mp4ds.messages.encodings import check_size
from mp4ds.video.coded import (
    REORDERED,
    BitReader,
    CodedFrame,
    CodedPicture,
    NoPicture,
    StreamParser,
    UnknownStructure,
)

MAX_UNITS = 512
"""Maximum number of NAL units in one packet."""

MAX_ZEROS = 4096
"""Maximum number of consecutive zero bytes between NAL units."""

START_CODE = b"\0\0\0\1"
_START = b"\0\0\1"
_FRAMING = re.compile(r"[0-9]{1,4}(?: [0-9]{1,4})*(?: \+[0-9]{1,4})?")


def split(data: bytes | memoryview) -> tuple[list[bytes], str]:
    """Split a packet into its NAL units and their framing; `join` undoes it.

    Args:
        data: One access unit.

    Returns:
        The NAL units, none empty or ending in a zero byte, and the framing.

    Raises:
        Refused: It does not begin with a start code, a NAL unit is empty, or there are more NAL
            units or zero bytes than in any camera's packet.
    """
    data = bytes(data)
    start = data.find(_START)
    if start < 0 or data[:start].strip(b"\0"):
        raise Refused("it does not begin with a start code")
    units: list[bytes] = []
    lengths: list[int] = []
    zeros = start
    while True:
        begin = start + len(_START)
        start = data.find(_START, begin)
        padded = data[begin : start if start >= 0 else len(data)]
        unit = padded.rstrip(b"\0")
        if not unit:
            raise Refused("it holds an empty NAL unit")
        units.append(unit)
        lengths.append(zeros + len(_START))
        zeros = len(padded) - len(unit)
        if zeros > MAX_ZEROS or lengths[-1] > MAX_ZEROS:
            raise Refused(f"it holds more than {MAX_ZEROS} zero bytes in a row")
        if len(units) > MAX_UNITS:
            raise Refused(f"it holds more than {MAX_UNITS} NAL units")
        if start < 0:
            return units, " ".join(map(str, lengths)) + (f" +{zeros}" if zeros else "")


def join(units: Sequence[bytes | memoryview], framing: str) -> bytes:
    """Put start codes before NAL units according to a framing.

    Raises:
        Refused: The framing is not valid, or is for another number of NAL units.
    """
    lengths, trailing = _lengths(framing)
    if len(lengths) != len(units):
        raise Refused(f"it has {len(units)} NAL units where its framing has {len(lengths)}")
    parts: list[bytes | memoryview] = []
    for unit, length in zip(units, lengths, strict=True):
        parts += (bytes(length - 1), b"\1", unit)
    return b"".join((*parts, bytes(trailing)))


def join_plain(units: Sequence[bytes | memoryview]) -> bytes:
    """NAL units, each after a start code of four bytes."""
    return b"".join(part for unit in units for part in (START_CODE, unit))


def split_length_prefixed(packet: bytes | memoryview) -> list[memoryview]:
    """The NAL units of an mp4's packet, each preceded by a length of four bytes, as views.

    Raises:
        Refused: The lengths do not add up, or there are too many.
    """
    packet = memoryview(packet)
    units: list[memoryview] = []
    offset = 0
    while offset < len(packet):
        length = int.from_bytes(packet[offset : offset + 4], "big")
        end = offset + 4 + length
        if not length or end > len(packet):
            raise Refused("a NAL unit's length in the video is wrong")
        if len(units) == MAX_UNITS:
            raise Refused(f"it holds more than {MAX_UNITS} NAL units")
        units.append(packet[offset + 4 : end])
        offset = end
    return units


def _lengths(framing: str) -> tuple[list[int], int]:
    if not _FRAMING.fullmatch(framing):
        raise Refused(f"{framing[:40]!r} is no framing of NAL units")
    tokens = framing.split(" ")
    trailing = int(tokens.pop()) if tokens[-1].startswith("+") else 0
    lengths = list(map(int, tokens))
    if min(lengths) < len(_START) or max(*lengths, trailing) > MAX_ZEROS:
        raise Refused(f"{framing[:40]!r} is no framing of NAL units")
    return lengths, trailing


def unescape(unit: bytes) -> bytes:
    """A NAL unit without its emulation prevention bytes (H.264, 7.3.1; H.265, 7.3.1.1)."""
    return unit.replace(b"\0\0\3", b"\0\0")


class PictureOrder:
    """Whether pictures are sent in the order shown, by their picture order counts.

    Slices state their low bits; the high ones are counted (H.264, 8.2.1.1; H.265, 8.3.1).

    Attributes:
        is_broken: Whether one was sent after another that is shown later.
        last: The count of the last picture since the order was restarted; None: there is none.
    """

    def __init__(self) -> None:
        self._msb = self._lsb = 0
        self.last: int | None = None
        self.is_broken = False

    def restart(self, lsb: int = 0) -> None:
        """Start over, from low bits."""
        self._msb, self._lsb, self.last = 0, lsb, None

    def take(self, lsb: int, bits: int, *, counts: bool = True) -> None:
        """Compare a picture with the last one.

        Args:
            lsb: Its low bits.
            bits: How many there are.
            counts: Whether the high bits of later pictures are counted from it.
        """
        msb, half = self._msb, 1 << (bits - 1)
        if lsb < self._lsb and self._lsb - lsb >= half:
            msb += 2 * half
        elif lsb > self._lsb and lsb - self._lsb > half:
            msb -= 2 * half
        order = msb + lsb
        if counts:
            self._msb, self._lsb = msb, lsb
        if self.last is not None and order <= self.last:
            self.is_broken = True
        self.last = order


# ---------------------------------------------------------------- parsers of units


@dataclass(frozen=True, slots=True)
class Sps:
    """The fields of a sequence parameter set that are needed.

    Attributes:
        number: Its id.
        width: Columns shown.
        height: Rows shown.
        planes: Whether the colour planes are coded separately.
        poc_bits: Bits of the picture order count; of H.264, for type 0.
        reorder: Maximum number of pictures sent before one shown earlier; None if not stated.
        frames_only: Whether no picture is a field.
        frame_num_bits: Bits of `frame_num`, of H.264.
        poc_type: How the picture order is coded, of H.264, 0 to 2.
    """

    number: int
    width: int
    height: int
    planes: bool
    poc_bits: int
    reorder: int | None
    frames_only: bool = True
    frame_num_bits: int = 0
    poc_type: int = 0


class UnitParser(StreamParser, ABC):
    """H.264 and H.265.

    Attributes:
        parameter_kinds: Types of the parameter sets, all of which a picture needs.
        slices: Types of the units of pictures.
        delimiter: Type of the unit that comes before them, if it is there.
        slice_at: Bytes of a NAL unit's header.
    """

    parameter_kinds: ClassVar[frozenset[int]]
    slices: ClassVar[frozenset[int]]
    delimiter: ClassVar[int]
    slice_at: ClassVar[int]

    def __init__(self, configuration: bytes | None = None) -> None:
        self._sets: dict[tuple[int, int], bytes] = {}
        self._sps: dict[int, Sps] = {}
        self._order = PictureOrder()
        self._unfit = ""  # why references of pictures with these parameters are not understood
        super().__init__(configuration)

    @staticmethod
    @abstractmethod
    def unit_type(unit: bytes | memoryview) -> int:
        """Type of a NAL unit."""

    @property
    def parameters(self) -> bytes:
        """The parameter sets seen so far, as Annex B; empty unless there are all kinds."""
        if {kind for kind, _ in self._sets} != self.parameter_kinds:
            return b""
        return join_plain([self._sets[key] for key in sorted(self._sets)])

    def _picture(self, body: memoryview) -> CodedPicture:
        units, framing = split(body)
        slices = [unit for unit in units if self._is_slice(unit)]
        if not slices:
            raise NoPicture("it holds no picture, only parameters or remarks")
        first = [
            unit for unit in slices if len(unit) > self.slice_at and unit[self.slice_at] & 0x80
        ]
        if len(first) != 1:
            raise Refused("it holds more than one picture, or a part of one")
        sps = self._check_order(first[0], slices)
        if not self.parameters:
            raise Refused("its parameter sets were not sent before it")
        return CodedPicture(sps.width, sps.height, self._is_key(first[0], slices), framing)

    def _is_slice(self, unit: bytes) -> bool:
        """Whether a NAL unit is one of a picture; if it is a parameter set, keep it."""
        kind = self._kind(unit)
        if kind in self.parameter_kinds:
            self._sets[kind, self._keep(kind, unit)] = unit
        return kind in self.slices

    @abstractmethod
    def _keep(self, kind: int, unit: bytes) -> int:
        """Keep what pictures need of a parameter set; returns its id."""

    @abstractmethod
    def _check_order(self, first: bytes, slices: Sequence[bytes]) -> Sps:
        """Compare a picture's place in the order shown with the last one's.

        Args:
            first: The slice that begins it.
            slices: All of them.

        Returns:
            Its sequence parameter set.

        Raises:
            Refused: It is sent out of the order shown, or its parameters were not sent.
        """

    @abstractmethod
    def _is_key(self, first: bytes, slices: Sequence[bytes]) -> bool:
        """Whether decoding can begin at a picture, by the arguments of `_check_order`."""

    def _frames(self, data: memoryview, *, key: bool) -> list[CodedFrame]:
        pictures, kinds, kept = 0, set[int](), False
        for unit in split_length_prefixed(data):
            kind = self._kind(unit)
            if kind in self.slices:
                kinds.add(kind)
                # the first slice of a picture
                pictures += len(unit) > self.slice_at and unit[self.slice_at] >> 7
                kept |= self._is_referred_to(unit, kind)
            elif kind in self.parameter_kinds:
                self._take_unit(bytes(unit))
                kept = True
        if len(kinds) != 1 or pictures != 1:
            raise UnknownStructure("it does not hold one picture")
        if self._unfit:
            raise UnknownStructure(self._unfit)
        return self._link(begins=self._begins(kinds.pop()), kept=kept, key=key)

    def _kind(self, unit: bytes | memoryview) -> int:
        """Type of a NAL unit; -1 for one that decoders leave out."""
        return self.unit_type(unit)

    @abstractmethod
    def _is_referred_to(self, unit: memoryview, kind: int) -> bool:
        """Whether later pictures may refer to that of a slice."""

    @abstractmethod
    def _begins(self, kind: int) -> bool:
        """Whether nothing refers beyond a picture of slices of a kind.

        Raises:
            UnknownStructure: That is not known.
        """

    @staticmethod
    def plain(body: bytes | memoryview) -> bytes:
        """With start codes of four bytes."""
        return join_plain(split(body)[0])

    @staticmethod
    def body(packet: bytes, framing: str | None) -> bytes:
        """With start codes instead of lengths."""
        units = split_length_prefixed(packet)
        return join_plain(units) if framing is None else join(units, framing)

    @classmethod
    def stand_alone(cls, packet: bytes, units: list[bytes]) -> bytes:
        """With start codes of four bytes and, before a key frame, parameter sets."""
        own: list[bytes | memoryview] = [*split_length_prefixed(packet)]
        if units and not cls._are_there(own):
            at = 1 if own and cls.unit_type(own[0]) == cls.delimiter else 0
            own[at:at] = units
        return join_plain(own)

    @classmethod
    def has_parameters(cls, plain: bytes) -> bool:
        """Whether it includes all kinds of parameter sets."""
        return cls._are_there(split(plain)[0])

    @classmethod
    def _are_there(cls, units: Sequence[bytes | memoryview]) -> bool:
        return cls.parameter_kinds <= set(map(cls.unit_type, units))


_CUT_SHORT = "the parameters of the track are cut short"


def check_configuration(configuration: bytes, *, lengths_at: int) -> None:
    """Refuse a track's configuration that is cut short, or whose lengths are not of four bytes.

    Args:
        configuration: ``avcC`` or ``hvcC`` (ISO/IEC 14496-15, 5.3.3 and 8.3.3).
        lengths_at: The byte that says how long lengths are.

    Raises:
        Refused: It is one of these.
    """
    if len(configuration) < lengths_at + 2 or configuration[0] != 1:
        raise Refused(_CUT_SHORT)
    if configuration[lengths_at] & 3 != 3:
        raise Refused("its NAL units do not have lengths of four bytes")


def sized_units(configuration: bytes, at: int, count: int) -> tuple[list[bytes], int]:
    """NAL units behind lengths of two bytes, and the offset after them.

    Raises:
        Refused: They are cut short.
    """
    units: list[bytes] = []
    for _ in range(count):
        size = int.from_bytes(configuration[at : at + 2], "big")
        at += 2 + size
        if not size or at > len(configuration):
            raise Refused(_CUT_SHORT)
        units.append(configuration[at - size : at])
    return units, at


# ---------------------------------------------------------------- H.264

SLICE, PARTITION_A, IDR, SPS, PPS, AUD = 1, 2, 5, 7, 8, 9
_HEADER_BYTES = 1024
SLICE_HEADER_BYTES = 64
_B_SLICE = 1
# profiles whose SPS tells the chroma format (7.3.2.1.1)
_HIGH_PROFILES = frozenset((44, 83, 86, 100, 110, 118, 122, 128, 134, 135, 138, 139, 244))


def parse_sps(unit: bytes) -> Sps:
    """Parse a sequence parameter set (7.3.2.1.1).

    Raises:
        Refused: It is malformed.
    """
    reader = BitReader(unescape(unit[1:_HEADER_BYTES]))
    profile = reader.bits(8)
    reader.bits(16)
    number = reader.ue()
    chroma, planes = 1, False
    if profile in _HIGH_PROFILES:
        chroma = reader.ue()
        if chroma > 3:
            raise Refused("its H.264 parameters are malformed")
        planes = chroma == 3 and reader.flag()
        reader.ue()
        reader.ue()
        reader.flag()
        if reader.flag():
            _skip_scaling_matrix(reader, 12 if chroma == 3 else 8)
    frame_num_bits = reader.ue() + 4
    poc_type, poc_bits = _picture_order(reader)
    reader.ue()
    reader.flag()
    width_units, height_units = reader.ue() + 1, reader.ue() + 1
    frames_only = reader.flag()
    if not frames_only:
        reader.flag()
    reader.flag()
    crop = [reader.ue() for _ in range(4)] if reader.flag() else [0] * 4
    rows = 1 if frames_only else 2
    crop_x = 2 if chroma in (1, 2) and not planes else 1
    crop_y = rows * (2 if chroma == 1 else 1)
    width = 16 * width_units - crop_x * (crop[0] + crop[1])
    height = 16 * rows * height_units - crop_y * (crop[2] + crop[3])
    check_size(width, height)
    if number > 31 or frame_num_bits > 16 or poc_bits > 16:
        raise Refused("its H.264 parameters are malformed")
    reorder = None
    if reader.flag():
        try:
            reorder = _vui_reorder(reader)
        except Refused:  # encoders of graphics cards cut it short
            reorder = None
    return Sps(
        number, width, height, planes, poc_bits, reorder, frames_only, frame_num_bits, poc_type
    )


def _picture_order(reader: BitReader) -> tuple[int, int]:
    poc_type = reader.ue()
    if poc_type == 0:
        return poc_type, reader.ue() + 4
    if poc_type == 1:
        reader.flag()
        reader.se()
        reader.se()
        count = reader.ue()
        if count > 255:
            raise Refused("its H.264 parameters are malformed")
        for _ in range(count):
            reader.se()
    elif poc_type != 2:
        raise Refused("its H.264 parameters are malformed")
    return poc_type, 0


def _skip_scaling_matrix(reader: BitReader, lists: int) -> None:
    for index in range(lists):
        if reader.flag():
            last = following = 8
            for _ in range(16 if index < 6 else 64):
                if following:
                    following = (last + reader.se()) % 256
                last = following or last


def _vui_reorder(reader: BitReader) -> int | None:
    """`max_num_reorder_frames` of the usability information (annex E.1.1)."""
    if reader.flag() and reader.bits(8) == 255:
        reader.bits(32)
    if reader.flag():
        reader.flag()
    if reader.flag():
        reader.bits(4)
        if reader.flag():
            reader.bits(24)
    if reader.flag():
        reader.ue()
        reader.ue()
    if reader.flag():
        reader.bits(65)
    buffers = 0
    for _ in range(2):
        if reader.flag():
            _skip_buffering(reader)
            buffers += 1
    if buffers:
        reader.flag()
    reader.flag()
    if not reader.flag():
        return None
    reader.flag()
    for _ in range(4):
        reader.ue()
    return reader.ue()


def _skip_buffering(reader: BitReader) -> None:
    """Skip `hrd_parameters` (annex E.1.2)."""
    count = reader.ue() + 1
    if count > 32:
        raise Refused("its H.264 parameters are malformed")
    reader.bits(8)
    for _ in range(count):
        reader.ue()
        reader.ue()
        reader.flag()
    reader.bits(20)


class H264(UnitParser):
    """Access units of H.264."""

    parameter_kinds = frozenset((SPS, PPS))
    slices = frozenset((SLICE, PARTITION_A, IDR))
    delimiter = AUD
    slice_at = 1

    def __init__(self, configuration: bytes | None = None) -> None:
        self._sps_of_pps: dict[int, int] = {}
        super().__init__(configuration)

    @staticmethod
    def unit_type(unit: bytes | memoryview) -> int:
        """Type of a NAL unit (7.4.1)."""
        return unit[0] & 0x1F

    @staticmethod
    def units_of(configuration: bytes) -> list[bytes]:
        """The parameter sets in ``avcC``."""
        check_configuration(configuration, lengths_at=4)
        units, at = sized_units(configuration, 6, configuration[5] & 31)
        if at >= len(configuration):
            raise Refused(_CUT_SHORT)
        return units + sized_units(configuration, at + 1, configuration[at])[0]

    def _keep(self, kind: int, unit: bytes) -> int:
        if kind == SPS:
            sps = parse_sps(unit)
            self._sps[sps.number] = sps
            return sps.number
        reader = BitReader(unescape(unit[1:SLICE_HEADER_BYTES]))
        number, of = reader.ue(), reader.ue()
        if number > 255 or of > 31:
            raise Refused("its H.264 parameters are malformed")
        self._sps_of_pps[number] = of
        return number

    def _is_key(self, first: bytes, slices: Sequence[bytes]) -> bool:
        return all(self.unit_type(unit) == IDR for unit in slices)

    def _check_order(self, first: bytes, slices: Sequence[bytes]) -> Sps:
        """By picture order counts (8.2.1)."""
        reader = BitReader(unescape(first[1:SLICE_HEADER_BYTES]))
        reader.ue()
        reader.ue()
        sps = self._sps.get(self._sps_of_pps.get(reader.ue(), -1))
        if sps is None:
            raise Refused("its parameter sets were not sent before it")
        if sps.planes:
            reader.bits(2)
        reader.bits(sps.frame_num_bits)
        if not sps.frames_only and reader.flag():
            raise Refused("it holds a field, half of an interlaced picture")
        if sps.poc_type == 2 or sps.reorder == 0:
            return sps
        if sps.poc_type == 1:
            self._order.is_broken |= any(map(_is_b_slice, slices))
        else:
            if self.unit_type(first) == IDR:
                reader.ue()
                self._order.restart()
            # only pictures that others refer to are counted from
            self._order.take(reader.bits(sps.poc_bits), sps.poc_bits, counts=bool(first[0] & 0x60))
        if self._order.is_broken:
            raise Refused(REORDERED)
        return sps

    def _is_referred_to(self, unit: memoryview, kind: int) -> bool:
        return bool(unit[0] & 0x60)  # nal_ref_idc (7.4.1)

    def _begins(self, kind: int) -> bool:
        if kind not in (SLICE, IDR):
            raise UnknownStructure("its slices are in partitions")
        return kind == IDR

    def _take_unit(self, unit: bytes) -> None:
        if self.unit_type(unit) == SPS and not parse_sps(unit).frames_only:
            self._unfit = "it may hold fields, halves of an interlaced picture"


def _is_b_slice(unit: bytes) -> bool:
    reader = BitReader(unescape(unit[1:SLICE_HEADER_BYTES]))
    reader.ue()
    return reader.ue() % 5 == _B_SLICE
