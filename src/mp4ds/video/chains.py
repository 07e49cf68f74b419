"""Which coded frames a decoder needs for a frame, so that it gets no others."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from mp4ds.coded.references import ReferenceParser
from mp4ds.coded.structure import Structures, frame_bytes, read_structure
from mp4ds.video.samples import SampleTable

_KEPT_FRAMES = 50_000  # coded frames whose references are kept in memory


@dataclass(frozen=True, slots=True)
class Piece:
    """A coded frame: a part of a packet that a decoder is to be given.

    Attributes:
        sample: Number of the packet.
        part: Number of the coded frame in it.
        needs: Numbers in its group of the pieces that it refers to.
        span: Its first byte in the packet and the one after its last; None until it is read.
    """

    sample: int
    part: int
    needs: tuple[int, ...]
    span: tuple[int, int] | None


@dataclass(slots=True)
class Group:
    """The coded frames from a key frame to the next, as far as they are known.

    Attributes:
        first: Number of the key frame's packet.
        end: Number of the next group's.
        parser: Of its packets; None where all is known without.
        pieces: In the order coded.
        shows: For each packet known the number of the piece that makes its picture come out.
    """

    first: int
    end: int
    parser: ReferenceParser | None
    pieces: list[Piece] = field(default_factory=list)
    shows: list[int] = field(default_factory=list)

    def chain(self, samples: Iterable[int]) -> list[int]:
        """Numbers of the pieces that show the pictures of packets, and of all that these need."""
        pending = [self.shows[sample - self.first] for sample in samples]
        found = set(pending)
        while pending:
            for number in self.pieces[pending.pop()].needs:
                if number not in found:
                    found.add(number)
                    pending.append(number)
        return sorted(found)


class Chains:
    """The groups of a video; what is in one is found out when it is first needed.

    Args:
        table: The video's index.
        codec: Name in the registry.
        read: Gives a packet by its number.
        recorded: What the frames refer to, where that was written down; it fits the index.

    Raises:
        UnknownStructure: Nothing is known of the references of the codec.
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
        ReferenceParser(codec, table.configuration)

    def group(self, sample: int, last: int) -> Group:
        """The group that a packet is in, known up to another one of it.

        Raises:
            UnknownStructure: What its frames refer to is not known.
            StructureError: What was written down of it contradicts itself.
        """
        place = self._place(sample)
        group = self._groups.get(place)
        if group is None:
            group = self._begin(place)
            self._groups[place] = group
        self._groups.move_to_end(place)
        if group.parser is not None:
            self._parse(group, group.parser, last)
        self._forget()
        return group

    def cut(self, group: Group, piece: Piece, packet: bytes) -> bytes:
        """The bytes of a piece out of its packet.

        Raises:
            Refused: It does not hold the coded frames that were written down of it.
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
        """Packets by the groups that they are in; those of a group must follow each other."""
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

    def _forget(self) -> None:
        while (
            len(self._groups) > 1
            and sum(len(group.pieces) for group in self._groups.values()) > _KEPT_FRAMES
        ):
            self._groups.popitem(last=False)
