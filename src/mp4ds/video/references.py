"""What the coded frames of a stream refer to, so that one can be decoded without the others."""

from __future__ import annotations

from abc import ABC, abstractmethod
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import Refused
from mp4ds.messages.coded import BitReader, CodedFrame, UnknownStructure
from mp4ds.video import h264, h265
from mp4ds.video.codecs import CODECS, part_of
from mp4ds.video.nal import MAX_UNITS, parameter_units, unescape

_MAX_SETS = 64
_PPS_BYTES = 64


def _units(data: memoryview) -> Iterator[memoryview]:
    """The NAL units of a packet, each preceded by a length of four bytes."""
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
    """Each picture refers to the last reference picture before it."""

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
            begins: Whether nothing from here on refers to anything earlier.
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
    """The references of an H.264 stream; see `mp4ds.video.references.ReferenceParser`."""

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
    """The references of an H.265 stream; see `mp4ds.video.references.ReferenceParser`."""

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


# ---------------------------------------------------------------- references

_FFV1_KEY = 0x7F80
_SEVERAL = "mp4v"  # the entry of JPEG, and of MPEG-4 Part 2


class _Parser(Protocol):
    def packet(self, data: memoryview, *, key: bool) -> list[CodedFrame]: ...

    def forget(self) -> None: ...


class ReferenceParser:
    """Finds what the coded frames of one stream refer to, packet by packet.

    It may begin at any key packet. After a refusal, packets are refused up to the next key packet.

    Args:
        codec: Name in the registry (``h264``), or of a sample entry (``avc1``).
        configuration: The track's codec configuration: the payload of ``avcC``, ``hvcC`` or
            ``av1C``; ignored for other codecs.

    Raises:
        UnknownStructure: The references of that codec are not known, or the configuration is
            malformed.
    """

    def __init__(self, codec: str, configuration: bytes) -> None:
        known = [
            found
            for name, found in CODECS.items()
            if codec in (name, found.ffmpeg, *found.entries) and codec != _SEVERAL
        ]
        if not known:
            raise UnknownStructure(f"what frames of the codec {codec[:40]!r} refer to is not known")
        try:
            self._parser: _Parser = part_of(known[0].references)(bytes(configuration))
        except Refused as error:
            raise UnknownStructure(str(error)) from None

    def packet(self, data: bytes | memoryview, *, key: bool) -> list[CodedFrame]:
        """The coded frames of the next packet, in the order coded.

        Args:
            data: As the mp4 holds it.
            key: Whether the file says that decoding can begin here.

        Returns:
            At least one frame. Their ranges do not overlap. Of AV1 each is of one frame, with the
            sequence header just before a key frame, and what is in none (metadata, padding) is
            not needed to decode; of other codecs there is one frame, the whole packet.

        Raises:
            UnknownStructure: The references cannot be determined, they reach across the key packet,
                or decoding cannot begin where `key` says it can.
        """
        try:
            return self._parser.packet(memoryview(data), key=key)
        except Refused as error:
            self._parser.forget()
            raise UnknownStructure(str(error)) from None


class Intra:
    """Codecs all of whose frames are key frames."""

    def __init__(self, configuration: bytes) -> None:
        del configuration

    def packet(self, data: memoryview, *, key: bool) -> list[CodedFrame]:
        """See `ReferenceParser.packet`."""
        return [CodedFrame(0, len(data), (), shown=True, existing=False)]

    def forget(self) -> None:
        """There is nothing to forget."""


class _Chained(ABC):
    """Codecs whose frames depend on the state that the last one left in the decoder."""

    def __init__(self, configuration: bytes) -> None:
        del configuration
        self._begun = False

    @abstractmethod
    def is_key(self, data: memoryview) -> bool:
        """Whether a packet begins with a key frame."""

    def packet(self, data: memoryview, *, key: bool) -> list[CodedFrame]:
        """See `ReferenceParser.packet`."""
        is_key = self.is_key(data)
        if key and not is_key:
            raise UnknownStructure("it is marked as a key frame but is not one")
        if not is_key and not self._begun:
            raise UnknownStructure("it comes before the first key frame")
        self._begun = True
        return [CodedFrame(0, len(data), () if is_key else (1,), shown=True, existing=False)]

    def forget(self) -> None:
        """See `ReferenceParser.forget`."""
        self._begun = False


class Vp9References(_Chained):
    """VP9 keeps motion vectors, probabilities and segments from frame to frame."""

    def is_key(self, data: memoryview) -> bool:
        """By the headers of all frames of a packet (VP9, 6.2)."""
        from mp4ds.video.vp9 import split_superframe

        shown = 0
        keys = []
        for frame in split_superframe(data):
            head = int.from_bytes(frame[:2].tobytes().ljust(2, b"\0"), "big")
            if head >> 14 != 2:
                raise UnknownStructure("it is not VP9: a frame does not begin with its marker")
            bits = head << 1 if head >> 12 & 3 == 3 else head  # profile 3 has a reserved bit more
            existing = bool(bits & 0x800)
            keys.append(not existing and not bits & 0x400)
            shown += existing or bool(bits & 0x200)
        if shown != 1:
            raise UnknownStructure(
                "it shows no picture" if not shown else "it holds more than one picture"
            )
        return keys[0]


class Ffv1References(_Chained):
    """FFV1 keeps its context states."""

    def is_key(self, data: memoryview) -> bool:
        """By the first value that a frame codes, its `keyframe` (RFC 9043, 4.3).

        A range coder of even odds (3.8.1.1) gives 1 where the first 16 bits are in the upper half
        of its range, 0xFF00.
        """
        if len(data) < 2:
            raise UnknownStructure("it is not FFV1: it is too short")
        return int.from_bytes(data[:2], "big") >= _FFV1_KEY


# ---------------------------------------------------------------- structure

MAX_STRUCTURES = 256
"""Maximum number of distinct ones in a video; one that has more is not described."""

MAX_STRUCTURE_CHARS = 2**16
MAX_CHARS = 2**20
"""Maximum total length of all structures of a video."""

_FRAME = r"(k|[1-9][0-9]{0,5}(,[1-9][0-9]{0,5})*)"
_PACKET = rf"{_FRAME}(\+{_FRAME})*"
STRUCTURE_PATTERN = rf"^k(\+{_FRAME})*( {_PACKET})*$"

_KEY = "k"

Needs = tuple[int, ...]
"""Numbers of the coded frames that a frame refers to, counted from its key frame."""


class StructureError(ValueError):
    """A structure contradicts itself; the text says how."""


@dataclass(frozen=True, eq=False)
class Structures:
    """The structures of a video's groups of pictures.

    Attributes:
        texts: The distinct structures.
        groups: Number of each group's structure, int64, shape (groups,).
    """

    texts: Sequence[str]
    groups: NDArray[np.int64]

    @property
    def is_plain(self) -> bool:
        """Whether every frame needs the one before it, so that none can be skipped."""
        return all(
            frame.startswith("1,") or frame == "1"
            for text in self.texts
            for frame in text.replace("+", " ").split(" ")[1:]
        )

    def check(self) -> None:
        """Refuse a structure that contradicts itself.

        Raises:
            StructureError: One does; see `read_structure`.
        """
        for text in self.texts:
            read_structure(text)

    def mismatch(self, packets: NDArray[np.int64]) -> str:
        """Why these cannot be the structures of a video, in words; empty if they can.

        Args:
            packets: Of each group, shape (groups,).
        """
        if len(self.groups) != len(packets):
            return (
                f"they are of {len(self.groups)} groups of pictures, of which it has {len(packets)}"
            )
        if len(self.groups) and not 0 <= self.groups.min() <= self.groups.max() < len(self.texts):
            return "they name a structure that is not there"
        due = np.array([text.count(" ") + 1 for text in self.texts], np.int64)[self.groups]
        wrong = np.flatnonzero(due != packets)
        if len(wrong):
            first = int(wrong[0])
            return (
                f"they are of {due[first]} packets in group of pictures {first}, "
                f"which has {packets[first]}"
            )
        return ""


class RecordedReferences(Protocol):
    """What a sidecar records of a video's references."""

    def decode(self, packets: NDArray[np.int64]) -> Structures:
        """The structures of a video with so many packets in each group; ValueError if not its."""
        ...


def read_structure(text: str) -> list[list[Needs]]:
    """What the coded frames of each packet of a group need.

    Args:
        text: Matches `STRUCTURE_PATTERN`.

    Raises:
        StructureError: A frame needs one before the key frame, or distances do not increase.
    """
    packets: list[list[Needs]] = []
    number = 0
    for packet in text.split(" "):
        frames: list[Needs] = []
        for frame in packet.split("+"):
            distances = () if frame == _KEY else tuple(map(int, frame.split(",")))
            if any(one >= other for one, other in pairwise(distances)):
                raise StructureError(f"the distances {frame[:40]} do not increase")
            if distances and distances[-1] > number:
                raise StructureError(
                    f"packet {len(packets)} refers to {distances[-1]} frames back, "
                    f"before the key frame"
                )
            frames.append(tuple(number - distance for distance in distances))
            number += 1
        packets.append(frames)
    return packets


def write_packet(frames: Sequence[CodedFrame]) -> str:
    """The part of a structure that describes one packet.

    Raises:
        UnknownStructure: Not exactly the last frame is shown.
    """
    if [frame.shown for frame in frames] != [False] * (len(frames) - 1) + [True]:
        raise UnknownStructure("it does not end with the only picture that it shows")
    return "+".join(",".join(map(str, frame.references)) or _KEY for frame in frames)


class StructureRecorder:
    """Finds the structures of a video from its packets, in the order coded.

    Memory is bounded by `MAX_CHARS` and eight bytes per group of pictures.

    Args:
        codec: Name in the registry.
        configuration: As for `ReferenceParser`.
    """

    def __init__(self, codec: str, configuration: bytes) -> None:
        self._codec = codec
        self._configuration = configuration
        self._is_known = codec in CODECS and CODECS[codec].is_free
        self._parser: ReferenceParser | None = None
        self._packets: list[str] = []
        self._chars = 0
        self._numbers: dict[str, int] = {}
        self._groups = array("q")

    def add(self, packet: bytes | memoryview, *, key: bool) -> None:
        """Add the next packet.

        Args:
            packet: As the mp4 holds it.
            key: Whether the file says that decoding can begin here.
        """
        if not self._is_known:
            return
        try:
            if key:
                self._end_group()
                self._parser = ReferenceParser(self._codec, self._configuration)
            if self._parser is None:
                raise UnknownStructure("it comes before the first key frame")
            frames = self._parser.packet(packet, key=key)
            text = write_packet(frames)
        except UnknownStructure:
            self._give_up()
            return
        self._packets.append(text)
        self._chars += len(text) + 1
        if self._chars > MAX_STRUCTURE_CHARS:
            self._give_up()

    def _end_group(self) -> None:
        if not self._packets:
            return
        text = " ".join(self._packets)
        self._packets, self._chars = [], 0
        self._groups.append(self._numbers.setdefault(text, len(self._numbers)))
        if len(self._numbers) > MAX_STRUCTURES or sum(map(len, self._numbers)) > MAX_CHARS:
            raise UnknownStructure("it has too many structures")

    def _give_up(self) -> None:
        self._is_known = False
        self._packets, self._numbers, self._groups = [], {}, array("q")

    def finish(self) -> Structures | None:
        """The structures found.

        Returns:
            None if the references of a frame are not known, or there are too many structures, or
            they are too long.
        """
        try:
            self._end_group()
        except UnknownStructure:
            self._give_up()
        if not (self._is_known and self._groups):
            return None
        return Structures(tuple(self._numbers), np.array(self._groups, np.int64))


def frame_bytes(codec: str, packet: bytes, *, part: int, parts: int, key: bool) -> bytes:
    """Extract a coded frame from its packet, as `ReferenceParser` finds it.

    Args:
        codec: Name in the registry.
        packet: As the mp4 holds it.
        part: Number of the frame in the packet.
        parts: Expected number of frames.
        key: Whether it is a key frame, which includes the sequence header before it.

    Raises:
        UnknownStructure: There are more or fewer.
    """
    if not CODECS[codec].is_split:
        return packet
    from mp4ds.video.av1 import split_temporal_unit

    found = split_temporal_unit(packet)
    if len(found) != parts:
        raise UnknownStructure(f"it holds {len(found)} coded frames, {parts} are due")
    header, start, end = found[part]
    return packet[header if key else start : end]
