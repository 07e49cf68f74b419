"""What the coded frames of a stream refer to, so that one can be decoded without the others."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from array import array
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO, Protocol

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import Refused, VideoError
from mp4ds.files.outputs import digest_file
from mp4ds.messages.coded import CodedFrame, UnknownStructure
from mp4ds.video.codecs import CODECS, part_of
from mp4ds.video.mp4 import SampleTable, read_sample_table
from mp4ds.video.nal import parameter_units

_MAX_SETS = 64


class Chain:
    """Codecs each of whose frames refers to the last one that may be referred to."""

    def __init__(self) -> None:
        self._back = 0  # from the next frame; 0: decoding has not begun

    def forget(self) -> None:
        """Wait for a key frame."""
        self._back = 0

    def link(self, size: int, *, begins: bool, kept: bool = True, key: bool) -> list[CodedFrame]:
        """The frame of a packet.

        Args:
            size: Of the packet.
            begins: Whether nothing from here on refers to anything earlier.
            kept: Whether later frames may need something of the packet.
            key: Whether the file says that decoding can begin here.

        Raises:
            UnknownStructure: Decoding cannot begin at it, and would have to.
        """
        if key and not begins:
            raise UnknownStructure(
                "it is marked as a key frame, and later pictures refer to earlier ones"
            )
        if not begins and not self._back:
            raise UnknownStructure("it comes before the first key frame")
        references = () if begins else (self._back,)
        self._back = 1 if kept or begins else self._back + 1
        return [CodedFrame(0, size, references, shown=True, existing=False)]


class UnitChain(Chain, ABC):
    """H.264 and H.265.

    Args:
        codec: Name in the registry.
        configuration: Of the track.
    """

    def __init__(self, codec: str, configuration: bytes) -> None:
        super().__init__()
        self._checked: set[bytes] = set()
        self.unfit = ""  # why no picture that these parameters describe is taken
        for unit in parameter_units(codec, configuration):
            self.take_parameters(unit)

    def take_parameters(self, unit: bytes) -> None:
        """Look at a parameter set, unless it is known."""
        if unit in self._checked:
            return
        self.check_parameters(unit)
        if len(self._checked) >= _MAX_SETS:
            self._checked.clear()
        self._checked.add(unit)

    @abstractmethod
    def check_parameters(self, unit: bytes) -> None:
        """Set `unfit` if pictures with these parameters are not understood."""

    def only(self, pictures: int, kinds: set[int]) -> int:
        """The kind of slices of the only picture of a packet.

        Args:
            pictures: Number of slices that begin a picture.
            kinds: Of all slices.

        Raises:
            UnknownStructure: There is another number of pictures, or its parameters are `unfit`.
        """
        if len(kinds) != 1 or pictures != 1:
            raise UnknownStructure("it does not hold one picture")
        if self.unfit:
            raise UnknownStructure(self.unfit)
        return kinds.pop()


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


class Intra(Chain):
    """Codecs all of whose frames are key frames."""

    def __init__(self, configuration: bytes) -> None:
        super().__init__()
        del configuration

    def packet(self, data: memoryview, *, key: bool) -> list[CodedFrame]:
        """The frame of a packet."""
        return self.link(len(data), begins=True, key=key)


class Ffv1References(Chain):
    """FFV1 keeps its context states from frame to frame."""

    def __init__(self, configuration: bytes) -> None:
        super().__init__()
        del configuration

    def packet(self, data: memoryview, *, key: bool) -> list[CodedFrame]:
        """The frame of a packet.

        Key frames are known by the first value that a frame codes, its `keyframe` (RFC 9043, 4.3).
        A range coder of even odds (3.8.1.1) gives 1 where the first 16 bits are in the upper half
        of its range, 0xFF00.
        """
        if len(data) < 2:
            raise UnknownStructure("it is not FFV1: it is too short")
        is_key = int.from_bytes(data[:2], "big") >= _FFV1_KEY
        return self.link(len(data), begins=is_key, key=key)


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
    if not CODECS[codec].split:
        return packet
    found = part_of(CODECS[codec].split)(packet)
    if len(found) != parts:
        raise UnknownStructure(f"it holds {len(found)} coded frames, {parts} are due")
    header, start, end = found[part]
    return packet[header if key else start : end]


# ---------------------------------------------------------------- chains

KEPT_FRAMES = 50_000  # coded frames whose references are kept in memory


@dataclass(frozen=True, slots=True)
class Piece:
    """A coded frame: the part of a packet to pass to a decoder.

    Attributes:
        sample: Number of the packet.
        part: Number of the coded frame in it.
        needs: Numbers, within its group, of the pieces that it refers to.
        span: Its first byte in the packet and the one after its last; None until it is read.
    """

    sample: int
    part: int
    needs: tuple[int, ...]
    span: tuple[int, int] | None


@dataclass(slots=True)
class Group:
    """The coded frames from one key frame to the next, as far as known.

    Attributes:
        first: Number of the key frame's packet.
        end: Number of the next group's.
        parser: Of its packets; None if nothing needs to be parsed.
        pieces: In the order coded.
        shows: For each known packet, the number of the piece that outputs its picture.
    """

    first: int
    end: int
    parser: ReferenceParser | None
    pieces: list[Piece] = field(default_factory=list)
    shows: list[int] = field(default_factory=list)

    def chain(self, samples: Iterable[int]) -> list[int]:
        """Numbers of the pieces that output the pictures of packets, and of what they depend on."""
        pending = [self.shows[sample - self.first] for sample in samples]
        found = set(pending)
        while pending:
            for number in self.pieces[pending.pop()].needs:
                if number not in found:
                    found.add(number)
                    pending.append(number)
        return sorted(found)


class Chains:
    """The groups of a video; each is analysed when it is first needed.

    Args:
        table: The video's index.
        codec: Name in the registry.
        read: Gives a packet by its number.
        recorded: What the frames refer to, if that was recorded; it matches the index.

    Raises:
        UnknownStructure: The codec's references are not known.
    """

    def __init__(
        self,
        table: SampleTable,
        codec: str,
        read: Callable[[int], bytes],
        recorded: Structures | None = None,
    ) -> None:
        self._table = table
        self._codec = codec
        self._read = read
        self._recorded = recorded
        self._keys = np.flatnonzero(table.sync)
        self._groups: OrderedDict[int, Group] = OrderedDict()
        self._kept = 0  # coded frames of these
        ReferenceParser(codec, table.configuration)

    def group(self, sample: int, last: int) -> Group:
        """The group that a packet is in, known up to another one of it.

        Raises:
            UnknownStructure: What its frames refer to is not known.
            StructureError: The recorded structure contradicts itself.
        """
        place = self._place(sample)
        group = self._groups.pop(place, None)
        if group is None:
            group = self._begin(place)
        else:
            self._kept -= len(group.pieces)
        if group.parser is not None:
            self._parse(group, group.parser, last)
        while self._groups and self._kept + len(group.pieces) > KEPT_FRAMES:
            _, forgotten = self._groups.popitem(last=False)
            self._kept -= len(forgotten.pieces)
        self._groups[place] = group
        self._kept += len(group.pieces)
        return group

    def cut(self, group: Group, piece: Piece, packet: bytes) -> bytes:
        """Extract the bytes of a piece from its packet.

        Raises:
            Refused: It does not hold the coded frames recorded for it.
        """
        if piece.span is not None:
            start, end = piece.span
            return packet if (start, end) == (0, len(packet)) else packet[start:end]
        last = group.pieces[group.shows[piece.sample - group.first]]
        return frame_bytes(
            self._codec, packet, part=piece.part, parts=last.part + 1, key=not piece.needs
        )

    def unknown(self, sample: int, last: int) -> range:
        """Numbers of the packets that `group` would have to read."""
        if self._recorded is not None:
            return range(0)
        place = self._place(sample)
        group = self._groups.get(place)
        first = self._first(place) if group is None else group.first + len(group.shows)
        return range(first, last + 1)

    def _place(self, sample: int) -> int:
        return int(np.searchsorted(self._keys, sample, side="right")) - 1

    def _first(self, place: int) -> int:
        return int(self._keys[place]) if place >= 0 else 0

    def split(self, samples: list[int]) -> Iterator[list[int]]:
        """Packets by group; those of a group must be consecutive."""
        places = np.searchsorted(self._keys, np.array(samples, np.int64), side="right")
        bounds = [0, *(np.flatnonzero(np.diff(places)) + 1).tolist(), len(samples)]
        for start, end in pairwise(bounds):
            yield samples[start:end]

    def _begin(self, place: int) -> Group:
        count = len(self._table.sizes)
        following = self._keys[place + 1] if place + 1 < len(self._keys) else count
        group = Group(self._first(place), int(following), None)
        if self._recorded is None:
            group.parser = ReferenceParser(self._codec, self._table.configuration)
            return group
        text = self._recorded.texts[int(self._recorded.groups[place])]
        for sample, frames in enumerate(read_structure(text), group.first):
            for part, needs in enumerate(frames):
                group.pieces.append(Piece(sample, part, needs, None))
            group.shows.append(len(group.pieces) - 1)
        return group

    def _parse(self, group: Group, parser: ReferenceParser, last: int) -> None:
        for sample in range(group.first + len(group.shows), last + 1):
            frames = parser.packet(self._read(sample), key=sample == group.first)
            shown = -1
            for part, frame in enumerate(frames):
                number = len(group.pieces)
                needs = tuple(number - distance for distance in frame.references)
                group.pieces.append(Piece(sample, part, needs, (frame.start, frame.end)))
                if frame.shown:
                    shown = number
            group.shows.append(shown)


# ---------------------------------------------------------------- digest

_BLOCK = 2**20


@dataclass(frozen=True, eq=False)
class VideoDigest:
    """Of a whole file.

    Attributes:
        size: Bytes.
        sha256: Hexadecimal.
        structures: What its frames refer to, if known.
    """

    size: int
    sha256: str
    structures: Structures | None


def digest_video(path: Path, codec: str) -> VideoDigest:
    """Hash a video, and find what its frames refer to in the same bytes.

    Memory is one packet, and the video's index.

    Args:
        path: An mp4.
        codec: Name in the registry.

    Raises:
        OSError: It cannot be read.
    """
    table = _table(path) if codec in CODECS and CODECS[codec].is_free else None
    if table is None:
        return VideoDigest(*digest_file(path), None)
    recorder = StructureRecorder(codec, table.configuration)
    digest = hashlib.sha256()
    size = 0
    with path.open("rb") as file:
        number = 0
        for is_packet, data in _parts(file, table):
            digest.update(data)
            size += len(data)
            if is_packet:
                recorder.add(data, key=bool(table.sync[number]))
                number += 1
    return VideoDigest(size, digest.hexdigest(), recorder.finish())


def packets_in_groups(path: Path) -> NDArray[np.int64]:
    """How many packets each group of pictures of a video has, shape (groups,).

    Raises:
        VideoError: Its index is damaged.
        Refused: Its index is not read.
        OSError: It cannot be read.
    """
    with path.open("rb") as file:
        return packets_of_groups(read_sample_table(file, path.stat().st_size, str(path)))


def packets_of_groups(table: SampleTable) -> NDArray[np.int64]:
    """How many packets each group of pictures has, shape (groups,)."""
    return np.diff(np.append(np.flatnonzero(table.sync), len(table.sync)))


def _table(path: Path) -> SampleTable | None:
    """The index of a video whose packets are contiguous; None if that is unknown."""
    try:
        with path.open("rb") as file:
            table = read_sample_table(file, path.stat().st_size, str(path))
    except (VideoError, Refused):
        return None
    ends = table.places + table.sizes
    return table if np.all(table.places[1:] >= ends[:-1]) else None


def _parts(file: BinaryIO, table: SampleTable) -> Iterator[tuple[bool, bytes]]:
    """All bytes of a file: its packets, and blocks of what is between them."""
    place = 0
    for start, size in zip(table.places.tolist(), table.sizes.tolist(), strict=True):
        while place < start:
            data = file.read(min(_BLOCK, start - place))
            if not data:
                return  # it became shorter meanwhile
            place += len(data)
            yield False, data
        yield True, file.read(size)
        place += size
    while data := file.read(_BLOCK):
        yield False, data
