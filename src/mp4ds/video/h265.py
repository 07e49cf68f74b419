"""H.265 access units: key frames, size, order and references.

Sections are those of ITU-T H.265 (08/2021).
"""

from __future__ import annotations

from collections.abc import Sequence

from mp4ds.errors import Refused
from mp4ds.messages.encodings import check_size
from mp4ds.video.coded import REORDERED, BitReader, UnknownStructure
from mp4ds.video.h264 import (
    SLICE_HEADER_BYTES,
    Sps,
    UnitParser,
    check_configuration,
    sized_units,
    unescape,
)

VPS, SPS, PPS, AUD = 32, 33, 34, 35
_LEADING = range(6, 10)  # RADL and RASL: shown before the key frame that they follow
_IRAP = range(16, 24)
_IDR = (19, 20)
_RESTARTS_ORDER = range(16, 21)  # BLA and IDR
_AFTER = range(8)  # refer to nothing before the last IDR picture: trailing ones and RADL
_UNREFERRED = (0, 2, 4, 6)  # TRAIL_N, TSA_N, STSA_N, RADL_N
_HEADER_BYTES = 1024


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


def _is_of_another_layer(unit: bytes | memoryview) -> bool:
    """Whether it is of another view, or more detail, which decoders leave out.

    Raises:
        Refused: It is too short to tell.
    """
    if len(unit) < 2:
        raise Refused("it holds a NAL unit without a header")
    return bool((unit[0] & 1) << 5 | unit[1] >> 3)


class H265(UnitParser):
    """Access units of H.265."""

    parameter_kinds = frozenset((VPS, SPS, PPS))
    slices = frozenset(range(VPS))
    delimiter = AUD
    slice_at = 2

    def __init__(self, configuration: bytes | None = None) -> None:
        # by id: that of its sequence parameters, whether slices say if they are shown, extra bits
        self._pps: dict[int, tuple[int, bool, int]] = {}
        self._highest = 0  # TemporalId that there may be
        super().__init__(configuration)

    @staticmethod
    def unit_type(unit: bytes | memoryview) -> int:
        """Type of a NAL unit (7.4.2.2)."""
        return (unit[0] >> 1) & 0x3F

    @staticmethod
    def units_of(configuration: bytes) -> list[bytes]:
        """The parameter sets in ``hvcC``."""
        check_configuration(configuration, lengths_at=21)
        units: list[bytes] = []
        at = 23
        for _ in range(configuration[22]):
            count = int.from_bytes(configuration[at + 1 : at + 3], "big")
            found, at = sized_units(configuration, at + 3, count)
            units += found
        return units

    def _keep(self, kind: int, unit: bytes) -> int:
        if kind == VPS:
            return unit[2] >> 4 if len(unit) > 2 else 0
        if kind == SPS:
            sps = parse_sps(unit)
            self._sps[sps.number] = sps
            return sps.number
        reader = BitReader(unescape(unit[2:SLICE_HEADER_BYTES]))
        number, of = reader.ue(), reader.ue()
        reader.flag()
        if number > 63 or of > 15:
            raise Refused("its H.265 parameters are malformed")
        self._pps[number] = of, reader.flag(), reader.bits(3)
        return number

    def _is_key(self, first: bytes, slices: Sequence[bytes]) -> bool:
        return self.unit_type(first) in _IRAP

    def _check_order(self, first: bytes, slices: Sequence[bytes]) -> Sps:
        """By picture order counts (8.3.1)."""
        kind = self.unit_type(first)
        reader = BitReader(unescape(first[2:SLICE_HEADER_BYTES]))
        reader.flag()
        if kind in _IRAP:
            reader.flag()
        number, may_be_hidden, extra_bits = self._pps.get(reader.ue(), (-1, False, 0))
        sps = self._sps.get(number)
        if sps is None:
            raise Refused("its parameter sets were not sent before it")
        reader.bits(extra_bits)
        reader.ue()
        if may_be_hidden and not reader.flag():
            raise Refused("its picture is not to be shown")
        if sps.planes:
            reader.bits(2)
        if kind in _LEADING:
            self._order.is_broken = True
        elif sps.reorder:
            lsb = 0 if kind in _IDR else reader.bits(sps.poc_bits)
            if kind in _RESTARTS_ORDER or self._order.last is None:
                self._order.restart(lsb)
            self._order.take(lsb, sps.poc_bits)
        if self._order.is_broken:
            raise Refused(REORDERED)
        return sps

    def _kind(self, unit: bytes | memoryview) -> int:
        return -1 if _is_of_another_layer(unit) else self.unit_type(unit)

    def _is_referred_to(self, unit: memoryview, kind: int) -> bool:
        # of a lower TemporalId, pictures of a higher one may refer to it (7.4.2.2)
        return kind not in _UNREFERRED or (unit[1] & 7) - 1 != self._highest

    def _begins(self, kind: int) -> bool:
        if kind not in _IDR and kind not in _AFTER:
            raise UnknownStructure(
                "its key frames may be followed by pictures that refer to what is before"
            )
        return kind in _IDR

    def _take_unit(self, unit: bytes) -> None:
        if len(unit) < 3:
            raise UnknownStructure("its H.265 parameters are malformed")
        kind = self.unit_type(unit)
        if kind == SPS:
            self._highest = max(self._highest, unit[2] >> 1 & 7)
        elif kind == PPS:
            reader = BitReader(unescape(unit[2:SLICE_HEADER_BYTES]))
            reader.ue()
            reader.ue()
            reader.flag()
            if reader.flag():
                self._unfit = "it may hold pictures that are not shown"
