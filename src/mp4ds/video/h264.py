"""H.264 access units: key frames, picture size, and whether pictures are sent in order.

Sections are those of ITU-T H.264 (08/2021).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mp4ds.errors import Refused
from mp4ds.messages.coded import REORDERED, BitReader, CodedFrame, UnknownStructure, check_size
from mp4ds.video.nal import UnitPictures, split_length_prefixed, unescape
from mp4ds.video.references import UnitChain

SLICE, PARTITION_A, IDR, SPS, PPS, AUD = 1, 2, 5, 7, 8, 9
_HEADER_BYTES = 1024
_SLICE_HEADER_BYTES = 64
_B_SLICE = 1
# profiles whose SPS tells the chroma format (7.3.2.1.1)
_HIGH_PROFILES = frozenset((44, 83, 86, 100, 110, 118, 122, 128, 134, 135, 138, 139, 244))


def unit_type(unit: bytes | memoryview) -> int:
    """Type of a NAL unit (7.4.1)."""
    return unit[0] & 0x1F


def has_parameters(units: Sequence[bytes | memoryview]) -> bool:
    """Whether NAL units include both kinds of parameter sets."""
    return {SPS, PPS} <= set(map(unit_type, units))


@dataclass(frozen=True, slots=True)
class Sps:
    """The fields of a sequence parameter set that are needed.

    Attributes:
        number: Its id.
        width: Columns shown.
        height: Rows shown.
        planes: Whether the colour planes are coded separately.
        frames_only: Whether no picture is a field.
        frame_num_bits: Bits of `frame_num`.
        poc_type: How the picture order is coded, 0 to 2.
        poc_bits: Bits of the picture order count, for type 0.
        reorder: Maximum number of pictures sent before one shown earlier; None if not stated.
    """

    number: int
    width: int
    height: int
    planes: bool
    frames_only: bool
    frame_num_bits: int
    poc_type: int
    poc_bits: int
    reorder: int | None


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
        number, width, height, planes, frames_only, frame_num_bits, poc_type, poc_bits, reorder
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


class H264Pictures(UnitPictures):
    """The pictures of one stream, access unit by access unit."""

    _kinds = frozenset((SPS, PPS))

    def __init__(self) -> None:
        super().__init__()
        self._sps: dict[int, Sps] = {}
        self._sps_of_pps: dict[int, int] = {}

    def _picture(self, units: Sequence[bytes]) -> tuple[tuple[int, int], bool]:
        slices: list[bytes] = []
        for unit in units:
            kind = unit_type(unit)
            if kind == SPS:
                self._take_sps(unit)
            elif kind == PPS:
                self._take_pps(unit)
            elif kind in (SLICE, PARTITION_A, IDR):
                slices.append(unit)
        sps = self._check_order(self._first(slices, header=1), slices)
        return (sps.width, sps.height), all(unit_type(unit) == IDR for unit in slices)

    def _take_sps(self, unit: bytes) -> None:
        sps = parse_sps(unit)
        self._sps[sps.number] = sps
        self._sets[SPS, sps.number] = unit

    def _take_pps(self, unit: bytes) -> None:
        reader = BitReader(unescape(unit[1:_SLICE_HEADER_BYTES]))
        number, sps = reader.ue(), reader.ue()
        if number > 255 or sps > 31:
            raise Refused("its H.264 parameters are malformed")
        self._sps_of_pps[number] = sps
        self._sets[PPS, number] = unit

    def _check_order(self, unit: bytes, slices: Sequence[bytes]) -> Sps:
        """Compare the picture's place in the order shown with the last one's (8.2.1)."""
        reader = BitReader(unescape(unit[1:_SLICE_HEADER_BYTES]))
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
            if unit_type(unit) == IDR:
                reader.ue()
                self._order.restart()
            # only pictures that others refer to are counted from
            self._order.take(reader.bits(sps.poc_bits), sps.poc_bits, counts=bool(unit[0] & 0x60))
        if self._order.is_broken:
            raise Refused(REORDERED)
        return sps


def _is_b_slice(unit: bytes) -> bool:
    reader = BitReader(unescape(unit[1:_SLICE_HEADER_BYTES]))
    reader.ue()
    return reader.ue() % 5 == _B_SLICE


# ---------------------------------------------------------------- references


class H264References(UnitChain):
    """What the coded frames of a stream refer to."""

    def __init__(self, configuration: bytes) -> None:
        super().__init__("h264", configuration)

    def packet(self, data: memoryview, *, key: bool) -> list[CodedFrame]:
        """The frame of a packet."""
        pictures = 0
        kinds: set[int] = set()
        kept = False
        for unit in split_length_prefixed(data):
            kind = unit[0] & 0x1F
            if kind in (SLICE, IDR):
                kinds.add(kind)
                pictures += len(unit) > 1 and unit[1] >> 7  # its first macroblock is 0
                kept |= bool(unit[0] & 0x60)  # nal_ref_idc (7.4.1)
            elif kind in (SPS, PPS):
                self.take_parameters(bytes(unit))
                kept = True
            elif kind in range(PARTITION_A, IDR):
                raise UnknownStructure("its slices are in partitions")
        begins = self.only(pictures, kinds) == IDR
        return self.link(len(data), begins=begins, kept=kept, key=key)

    def check_parameters(self, unit: bytes) -> None:
        """Refuse interlaced pictures."""
        if unit_type(unit) == SPS and not parse_sps(unit).frames_only:
            self.unfit = "it may hold fields, halves of an interlaced picture"
