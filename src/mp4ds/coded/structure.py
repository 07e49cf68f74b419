"""What the frames of a video refer to, as text: written once, read instead of the packets.

Specified in spec/index.md, "References". A structure is that of a group of pictures, from a key
frame to the next. Encoders repeat theirs, so that few are distinct.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mp4ds.coded.coded_frame import CodedFrame, UnknownStructure
from mp4ds.coded.references import ReferenceParser

RECORDED_CODECS = ("h264", "h265", "av1")
"""Codecs in which a frame may do without the one before it."""

SPLIT_CODECS = ("av1",)
"""Codecs whose packets may hold several coded frames."""

MAX_STRUCTURES = 256
"""Distinct ones of a video: one that has more is not described."""

MAX_STRUCTURE_CHARS = 2**16
MAX_CHARS = 2**20
"""Of all structures of a video together."""

_FRAME = r"(k|[1-9][0-9]{0,5}(,[1-9][0-9]{0,5})*)"
_PACKET = rf"{_FRAME}(\+{_FRAME})*"
STRUCTURE_PATTERN = rf"^k(\+{_FRAME})*( {_PACKET})*$"

_KEY = "k"

Needs = tuple[int, ...]
"""Numbers of the coded frames that one refers to, counted from its key frame."""


class StructureError(ValueError):
    """A structure contradicts itself; the text says how."""


@dataclass(frozen=True, eq=False)
class Structures:
    """The structures of a video's groups of pictures.

    Attributes:
        texts: Those that occur.
        groups: For each group of pictures the number of its own, int64, shape (groups,).
    """

    texts: Sequence[str]
    groups: NDArray[np.int64]

    @property
    def is_plain(self) -> bool:
        """Whether every frame needs the one before it, so that none can be left out."""
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
        """Why these are not the structures of a video, in words; empty if they may be.

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
    """The part of a structure that is of one packet.

    Raises:
        UnknownStructure: It is not the last frame alone that is shown.
    """
    if [frame.shown for frame in frames] != [False] * (len(frames) - 1) + [True]:
        raise UnknownStructure("it does not end with the only picture that it shows")
    return "+".join(",".join(map(str, frame.references)) or _KEY for frame in frames)


class StructureRecorder:
    """Finds the structures of a video from its packets, in the order coded.

    Memory is bounded by `MAX_CHARS` and eight bytes a group of pictures.

    Args:
        codec: Name in the registry.
        configuration: As for `ReferenceParser`.
    """

    def __init__(self, codec: str, configuration: bytes) -> None:
        self._codec = codec
        self._configuration = configuration
        self._is_known = codec in RECORDED_CODECS
        self._parser: ReferenceParser | None = None
        self._packets: list[str] = []
        self._chars = 0
        self._numbers: dict[str, int] = {}
        self._groups = array("q")

    def add(self, packet: bytes | memoryview, *, key: bool) -> None:
        """Take the next packet.

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
        """What was found.

        Returns:
            None where the references of a frame are not known, or the structures are too many or
            too long.
        """
        try:
            self._end_group()
        except UnknownStructure:
            self._give_up()
        if not (self._is_known and self._groups):
            return None
        return Structures(tuple(self._numbers), np.array(self._groups, np.int64))


def frame_bytes(codec: str, packet: bytes, *, part: int, parts: int, key: bool) -> bytes:
    """A coded frame out of its packet, as `ReferenceParser` finds it there.

    Args:
        codec: Name in the registry.
        packet: As the mp4 holds it.
        part: Number of the frame in the packet.
        parts: How many frames there are due to be.
        key: Whether it needs no other, and so takes the sequence header before it along.

    Raises:
        UnknownStructure: There are more or fewer.
    """
    if codec not in SPLIT_CODECS:
        return packet
    from mp4ds.coded.av1_references import split_temporal_unit

    found = split_temporal_unit(packet)
    if len(found) != parts:
        raise UnknownStructure(f"it holds {len(found)} coded frames, {parts} are due")
    header, start, end = found[part]
    return packet[header if key else start : end]
