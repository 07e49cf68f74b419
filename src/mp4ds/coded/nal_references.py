"""What pictures of H.264 and H.265 refer to, as the headers of their NAL units tell.

Sections are those of ITU-T H.264 (08/2021) and H.265 (08/2021). A header tells whether any picture
may refer to this one, so pictures that none refers to can be left out. Which of the others a
picture refers to is not looked up: it is taken to need all of them since the key frame, as in
the streams of cameras it nearly always does.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator

from mp4ds.coded import h264, h265
from mp4ds.coded.annexb import MAX_UNITS, unescape
from mp4ds.coded.base import BitReader
from mp4ds.coded.coded_frame import CodedFrame, UnknownStructure
from mp4ds.coded.configuration import parameter_units

_MAX_SETS = 64
_PPS_BYTES = 64


def _units(data: memoryview) -> Iterator[memoryview]:
    """The NAL units of a packet, which stand behind lengths of four bytes."""
    at = 0
    for _ in range(MAX_UNITS):
        if at == len(data):
            return
        begin = at + 4
        at = begin + int.from_bytes(data[at:begin], "big")
        if at - begin < 2 or at > len(data):
            raise UnknownStructure("a NAL unit's length in the video is wrong")
        yield data[begin:at]
    raise UnknownStructure(f"it holds more than {MAX_UNITS} NAL units")


class _Chain(ABC):
    """Each picture refers to the last one before it that any may refer to."""

    def __init__(self) -> None:
        self._back = 0  # from the next picture; 0: decoding has not begun
        self._checked: set[bytes] = set()
        self._unfit = ""  # why no picture that these parameters describe is taken

    def forget(self) -> None:
        """Wait for a key frame."""
        self._back = 0

    def _link(self, size: int, *, begins: bool, kept: bool, key: bool) -> list[CodedFrame]:
        """The picture of a packet.

        Args:
            size: Of the packet.
            begins: Whether nothing from here on refers to anything before.
            kept: Whether later pictures may need something of the packet.
            key: Whether the file says that decoding can begin here.
        """
        if self._unfit:
            raise UnknownStructure(self._unfit)
        if key and not begins:
            raise UnknownStructure(
                "it is marked as a key frame, and later pictures refer to earlier ones"
            )
        if not begins and not self._back:
            raise UnknownStructure("it comes before the first key frame")
        references = () if begins else (self._back,)
        self._back = 1 if kept or begins else self._back + 1
        return [CodedFrame(0, size, references, shown=True, existing=False)]

    def _take_parameters(self, unit: bytes) -> None:
        if unit in self._checked:
            return
        self._check_parameters(unit)
        if len(self._checked) >= _MAX_SETS:
            self._checked.clear()
        self._checked.add(unit)

    @abstractmethod
    def _check_parameters(self, unit: bytes) -> None: ...


class H264References(_Chain):
    """The references of an H.264 stream; see `mp4ds.coded.references.ReferenceParser`."""

    def __init__(self, configuration: bytes) -> None:
        super().__init__()
        for unit in parameter_units("h264", configuration):
            self._take_parameters(unit)

    def packet(self, data: memoryview, *, key: bool) -> list[CodedFrame]:
        """The picture of a packet."""
        pictures = 0
        kinds: set[int] = set()
        kept = False
        for unit in _units(data):
            kind = unit[0] & 0x1F
            if kind in (h264.SLICE, h264.IDR):
                kinds.add(kind)
                pictures += unit[1] >> 7  # its first macroblock is 0
                kept |= bool(unit[0] & 0x60)  # nal_ref_idc (7.4.1)
            elif kind in (h264.SPS, h264.PPS):
                self._take_parameters(bytes(unit))
                kept = True
            elif kind in range(h264.PARTITION_A, h264.IDR):
                raise UnknownStructure("its slices are in partitions")
        if len(kinds) != 1 or pictures != 1:
            raise UnknownStructure("it does not hold one picture")
        return self._link(len(data), begins=h264.IDR in kinds, kept=kept, key=key)

    def _check_parameters(self, unit: bytes) -> None:
        if h264.unit_type(unit) == h264.SPS and not h264.parse_sps(unit).frames_only:
            self._unfit = "it may hold fields, halves of an interlaced picture"


class H265References(_Chain):
    """The references of an H.265 stream; see `mp4ds.coded.references.ReferenceParser`."""

    _IDR = (19, 20)
    _AFTER = range(8)  # refer to nothing before the last IDR picture: trailing ones and RADL
    _UNREFERRED = (0, 2, 4, 6)  # TRAIL_N, TSA_N, STSA_N, RADL_N

    def __init__(self, configuration: bytes) -> None:
        super().__init__()
        self._highest = 0  # TemporalId that there may be
        for unit in parameter_units("h265", configuration):
            self._take_parameters(unit)

    def packet(self, data: memoryview, *, key: bool) -> list[CodedFrame]:
        """The picture of a packet."""
        pictures = 0
        kinds: set[int] = set()
        kept = False
        for unit in _units(data):
            if (unit[0] & 1) << 5 | unit[1] >> 3:
                continue  # another layer, which decoders leave out
            kind = unit[0] >> 1
            if kind < h265.VPS:
                kinds.add(kind)
                pictures += len(unit) > 2 and unit[2] >> 7  # its first slice
                # of a lower TemporalId, pictures of a higher one may refer to it (7.4.2.2)
                kept |= kind not in self._UNREFERRED or (unit[1] & 7) - 1 != self._highest
            elif kind <= h265.PPS:
                self._take_parameters(bytes(unit))
                kept = True
        if len(kinds) != 1 or pictures != 1:
            raise UnknownStructure("it does not hold one picture")
        kind = kinds.pop()
        if kind not in self._IDR and kind not in self._AFTER:
            raise UnknownStructure(
                "its key frames may be followed by pictures that refer to what is before"
            )
        return self._link(len(data), begins=kind in self._IDR, kept=kept, key=key)

    def _check_parameters(self, unit: bytes) -> None:
        if len(unit) < 3:
            raise UnknownStructure("its H.265 parameters are malformed")
        kind = h265.unit_type(unit)
        if kind == h265.SPS:
            self._highest = max(self._highest, unit[2] >> 1 & 7)
        elif kind == h265.PPS:
            reader = BitReader(unescape(unit[2:_PPS_BYTES]))
            reader.ue()
            reader.ue()
            reader.flag()
            if reader.flag():
                self._unfit = "it may hold pictures that are not shown"
