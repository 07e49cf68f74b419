"""What the coded frames of a stream refer to, so that one can be decoded without the others."""

from __future__ import annotations

import hashlib
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import Refused, VideoError
from mp4ds.files.outputs import digest_file
from mp4ds.video.codecs import CODECS
from mp4ds.video.coded import CodedFrame, StreamParser, UnknownStructure
from mp4ds.video.mp4 import SampleTable, sample_table_of

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
        configuration: Of the track, as for its `StreamParser`.
    """

    def __init__(self, codec: str, configuration: bytes) -> None:
        self._codec = codec
        self._configuration = configuration
        self._is_known = codec in CODECS and CODECS[codec].is_free
        self._parser: StreamParser | None = None
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
                self._parser = CODECS[self._codec].parser(self._configuration)
            if self._parser is None:
                raise UnknownStructure("it comes before the first key frame")
            frames = self._parser.frames(packet, key=key)
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


# ---------------------------------------------------------------- digest

_BLOCK = 2**20


def digest_video(path: Path, codec: str) -> tuple[int, str, Structures | None]:
    """Hash a video, and find what its frames refer to in the same bytes.

    Memory is one packet, and the video's index.

    Args:
        path: An mp4.
        codec: Name in the registry.

    Returns:
        Bytes of the file, its SHA-256, and what its frames refer to, if known.

    Raises:
        OSError: It cannot be read.
    """
    table = _table(path) if codec in CODECS and CODECS[codec].is_free else None
    if table is None:
        return *digest_file(path), None
    recorder = StructureRecorder(codec, table.entry.configuration)
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
    return size, digest.hexdigest(), recorder.finish()


def packets_in_groups(path: Path) -> NDArray[np.int64]:
    """How many packets each group of pictures of a video has, shape (groups,).

    Raises:
        VideoError: Its index is damaged.
        Refused: Its index is not read.
        OSError: It cannot be read.
    """
    return packets_of_groups(sample_table_of(path))


def packets_of_groups(table: SampleTable) -> NDArray[np.int64]:
    """How many packets each group of pictures has, shape (groups,)."""
    return np.diff(np.append(np.flatnonzero(table.sync), len(table.sync)))


def _table(path: Path) -> SampleTable | None:
    """The index of a video whose packets are contiguous; None if that is unknown."""
    try:
        table = sample_table_of(path)
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
