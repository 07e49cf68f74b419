"""What the coded frames of a stream refer to, so that one can be decoded without the others."""

from __future__ import annotations

import hashlib
from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
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

_BLOCK = 2**20
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


def find_structures(
    codec: str, configuration: bytes, packets: Iterable[tuple[bytes, bool]]
) -> Structures | None:
    """The structures of a video.

    Memory is bounded by `MAX_CHARS` and eight bytes per group of pictures.

    Args:
        codec: Name in the registry.
        configuration: Of the track, as for its `StreamParser`.
        packets: As the mp4 holds them, each with whether the file says that decoding can begin
            there, in the order coded.

    Returns:
        None if the references of a frame are not known, or there are too many structures, or they
        are too long.
    """
    numbers: dict[str, int] = {}
    groups = array("q")
    try:
        for text in _texts(codec, configuration, packets):
            groups.append(numbers.setdefault(text, len(numbers)))
            if len(numbers) > MAX_STRUCTURES or sum(map(len, numbers)) > MAX_CHARS:
                return None
    except UnknownStructure:
        return None
    return Structures(tuple(numbers), np.array(groups, np.int64)) if groups else None


def _texts(
    codec: str, configuration: bytes, packets: Iterable[tuple[bytes, bool]]
) -> Iterator[str]:
    """The structure of each group."""
    parser: StreamParser | None = None
    texts: list[str] = []
    for packet, is_key in packets:
        if is_key:
            if texts:
                yield " ".join(texts)
            texts, parser = [], CODECS[codec].parser(configuration)
            chars = 0
        if parser is None:
            raise UnknownStructure("it comes before the first key frame")
        texts.append(write_packet(parser.frames(packet, key=is_key)))
        chars += len(texts[-1]) + 1
        if chars > MAX_STRUCTURE_CHARS:
            raise UnknownStructure("its structure is too long")
    if texts:
        yield " ".join(texts)


# ---------------------------------------------------------------- digest


def digest_video(path: Path, codec: str) -> tuple[int, str, Structures | None]:
    """Hash a video, and find what its frames refer to.

    Memory is one packet, and the video's index.

    Args:
        path: An mp4.
        codec: Name in the registry.

    Returns:
        Bytes of the file, its SHA-256, and what its frames refer to, if known.

    Raises:
        OSError: It cannot be read.
    """
    table = _table(path, codec)
    if table is None:
        return *digest_file(path), None
    digest = hashlib.sha256()
    with path.open("rb") as file:  # read once: it may be large, and far away
        found = find_structures(
            codec, table.entry.configuration, _packets(file, table, digest.update)
        )
        _pass(file, digest.update)
        return file.tell(), digest.hexdigest(), found


def _table(path: Path, codec: str) -> SampleTable | None:
    if codec not in CODECS or not CODECS[codec].is_free:
        return None
    try:
        table = sample_table_of(path)
    except (VideoError, Refused):
        return None
    if np.any(table.places[1:] < (table.places + table.sizes)[:-1]):
        return None  # a forged index could have the whole file read for each packet
    return table


def _packets(
    file: BinaryIO, table: SampleTable, seen: Callable[[bytes], object]
) -> Iterator[tuple[bytes, bool]]:
    columns = (table.places.tolist(), table.sizes.tolist(), table.sync.tolist())
    for place, size, is_key in zip(*columns, strict=True):
        _pass(file, seen, place)
        packet = file.read(size)
        seen(packet)
        yield packet, is_key


def _pass(file: BinaryIO, seen: Callable[[bytes], object], end: int | None = None) -> None:
    """Show what there is up to a place, or to the end of the file."""
    while block := file.read(_BLOCK if end is None else min(_BLOCK, end - file.tell())):
        seen(block)


def packets_of_groups(table: SampleTable) -> NDArray[np.int64]:
    """How many packets each group of pictures has, shape (groups,)."""
    return np.diff(np.append(np.flatnonzero(table.sync), len(table.sync)))
