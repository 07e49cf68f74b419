"""H.265 access units: key frames, picture size, and whether pictures are sent in order.

Sections are those of ITU-T H.265 (08/2021).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mp4ds.errors import Refused
from mp4ds.messages.coded import REORDERED, BitReader, CodedFrame, UnknownStructure, check_size
from mp4ds.video.nal import UnitPictures, split_length_prefixed, unescape
from mp4ds.video.references import UnitChain

VPS, SPS, PPS, AUD = 32, 33, 34, 35
_SLICES = range(32)
_LEADING = range(6, 10)  # RADL and RASL: shown before the key frame that they follow
_IRAP = range(16, 24)
_IDR = (19, 20)
_RESTARTS_ORDER = range(16, 21)  # BLA and IDR
_HEADER_BYTES = 1024
_SLICE_HEADER_BYTES = 64


def unit_type(unit: bytes | memoryview) -> int:
    """Type of a NAL unit (7.4.2.2)."""
    return (unit[0] >> 1) & 0x3F


def _is_of_another_layer(unit: bytes | memoryview) -> bool:
    """Whether it is of another view, or more detail, which decoders leave out.

    Raises:
        Refused: It is too short to tell.
    """
    if len(unit) < 2:
        raise Refused("it holds a NAL unit without a header")
    return bool((unit[0] & 1) << 5 | unit[1] >> 3)


def has_parameters(units: Sequence[bytes | memoryview]) -> bool:
    """Whether NAL units include all kinds of parameter sets."""
    return {VPS, SPS, PPS} <= set(map(unit_type, units))


@dataclass(frozen=True, slots=True)
class Sps:
    """The fields of a sequence parameter set that are needed.

    Attributes:
        number: Its id.
        width: Columns shown.
        height: Rows shown.
        planes: Whether the colour planes are coded separately.
        poc_bits: Bits of the picture order count.
        reorder: Maximum number of pictures sent before one shown earlier.
    """

    number: int
    width: int
    height: int
    planes: bool
    poc_bits: int
    reorder: int


@dataclass(frozen=True, slots=True)
class _Pps:
    sps: int
    output_flag: bool
    extra_bits: int


def parse_sps(unit: bytes) -> Sps:
    """Parse a sequence parameter set (7.3.2.2.1).

    Raises:
        Refused: It is malformed.
    """
    reader = BitReader(unescape(unit[2:_HEADER_BYTES]))
    reader.bits(4)
    sub_layers = reader.bits(3)
    reader.flag()
    _skip_profile(reader, sub_layers)
    number, chroma = reader.ue(), reader.ue()
    if number > 15 or chroma > 3:
        raise Refused("its H.265 parameters are malformed")
    planes = chroma == 3 and reader.flag()
    width, height = reader.ue(), reader.ue()
    if reader.flag():
        left, right, top, bottom = (reader.ue() for _ in range(4))
        width -= (left + right) * (2 if chroma in (1, 2) else 1)
        height -= (top + bottom) * (2 if chroma == 1 else 1)
    check_size(width, height)
    reader.ue()
    reader.ue()
    poc_bits = reader.ue() + 4
    if poc_bits > 16:
        raise Refused("its H.265 parameters are malformed")
    reorder = 0
    for _ in range(sub_layers + 1 if reader.flag() else 1):
        reader.ue()
        reorder = reader.ue()
        reader.ue()
    return Sps(number, width, height, planes, poc_bits, reorder)


def _skip_profile(reader: BitReader, sub_layers: int) -> None:
    """Skip `profile_tier_level` (7.3.3)."""
    reader.bits(96)
    present = [(reader.flag(), reader.flag()) for _ in range(sub_layers)]
    if sub_layers:
        reader.bits(2 * (8 - sub_layers))
    for profile, level in present:
        reader.bits(88 * profile + 8 * level)


class H265Pictures(UnitPictures):
    """The pictures of one stream, access unit by access unit."""

    _kinds = frozenset((VPS, SPS, PPS))

    def __init__(self) -> None:
        super().__init__()
        self._sps: dict[int, Sps] = {}
        self._pps: dict[int, _Pps] = {}

    def _picture(self, units: Sequence[bytes]) -> tuple[tuple[int, int], bool]:
        slices: list[bytes] = []
        for unit in units:
            if _is_of_another_layer(unit):
                continue
            kind = unit_type(unit)
            if kind == VPS:
                self._sets[VPS, unit[2] >> 4 if len(unit) > 2 else 0] = unit
            elif kind == SPS:
                sps = parse_sps(unit)
                self._sps[sps.number] = sps
                self._sets[SPS, sps.number] = unit
            elif kind == PPS:
                self._take_pps(unit)
            elif kind in _SLICES:
                slices.append(unit)
        first = self._first(slices, header=2)
        sps = self._check_order(first)
        return (sps.width, sps.height), unit_type(first) in _IRAP

    def _take_pps(self, unit: bytes) -> None:
        reader = BitReader(unescape(unit[2:_SLICE_HEADER_BYTES]))
        number, sps = reader.ue(), reader.ue()
        reader.flag()
        if number > 63 or sps > 15:
            raise Refused("its H.265 parameters are malformed")
        self._pps[number] = _Pps(sps, output_flag=reader.flag(), extra_bits=reader.bits(3))
        self._sets[PPS, number] = unit

    def _check_order(self, unit: bytes) -> Sps:
        """Compare the picture's place in the order shown with the last one's (8.3.1)."""
        kind = unit_type(unit)
        reader = BitReader(unescape(unit[2:_SLICE_HEADER_BYTES]))
        reader.flag()
        if kind in _IRAP:
            reader.flag()
        pps = self._pps.get(reader.ue())
        sps = self._sps.get(pps.sps) if pps else None
        if pps is None or sps is None:
            raise Refused("its parameter sets were not sent before it")
        reader.bits(pps.extra_bits)
        reader.ue()
        if pps.output_flag and not reader.flag():
            raise Refused("its picture is not to be shown")
        if sps.planes:
            reader.bits(2)
        if kind in _LEADING:
            self._order.is_broken = True
        elif sps.reorder:
            lsb = 0 if kind in _IDR else reader.bits(sps.poc_bits)
            if kind in _RESTARTS_ORDER or not self._order.has_begun:
                self._order.restart(lsb)
            self._order.take(lsb, sps.poc_bits)
        if self._order.is_broken:
            raise Refused(REORDERED)
        return sps


# ---------------------------------------------------------------- references


class H265References(UnitChain):
    """What the coded frames of a stream refer to."""

    _AFTER = range(8)  # refer to nothing before the last IDR picture: trailing ones and RADL
    _UNREFERRED = (0, 2, 4, 6)  # TRAIL_N, TSA_N, STSA_N, RADL_N

    def __init__(self, configuration: bytes) -> None:
        self._highest = 0  # TemporalId that there may be
        super().__init__("h265", configuration)

    def packet(self, data: memoryview, *, key: bool) -> list[CodedFrame]:
        """The frame of a packet."""
        pictures = 0
        kinds: set[int] = set()
        kept = False
        for unit in split_length_prefixed(data):
            if _is_of_another_layer(unit):
                continue
            kind = unit[0] >> 1
            if kind < VPS:
                kinds.add(kind)
                pictures += len(unit) > 2 and unit[2] >> 7  # its first slice
                # of a lower TemporalId, pictures of a higher one may refer to it (7.4.2.2)
                kept |= kind not in self._UNREFERRED or (unit[1] & 7) - 1 != self._highest
            elif kind <= PPS:
                self.take_parameters(bytes(unit))
                kept = True
        kind = self.only(pictures, kinds)
        if kind not in _IDR and kind not in self._AFTER:
            raise UnknownStructure(
                "its key frames may be followed by pictures that refer to what is before"
            )
        return self.link(len(data), begins=kind in _IDR, kept=kept, key=key)

    def check_parameters(self, unit: bytes) -> None:
        """Refuse pictures that are not shown."""
        if len(unit) < 3:
            raise UnknownStructure("its H.265 parameters are malformed")
        kind = unit_type(unit)
        if kind == SPS:
            self._highest = max(self._highest, unit[2] >> 1 & 7)
        elif kind == PPS:
            reader = BitReader(unescape(unit[2:_SLICE_HEADER_BYTES]))
            reader.ue()
            reader.ue()
            reader.flag()
            if reader.flag():
                self.unfit = "it may hold pictures that are not shown"
