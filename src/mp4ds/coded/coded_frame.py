"""One coded frame in a packet of a video codec, and what it refers to."""

from __future__ import annotations

from dataclasses import dataclass

from mp4ds.coded.base import Refused


class UnknownStructure(Refused):
    """What frames refer to cannot be told: they are decoded from the key frame on."""


@dataclass(frozen=True, slots=True)
class CodedFrame:
    """One coded frame in a packet, and which frames a decoder must have had before it.

    Frames are counted as they are coded, those among them that are not shown, or only show
    another one.

    Attributes:
        start: Offset of its first byte in the packet.
        end: Offset after its last byte.
        references: How many coded frames back each frame is that it needs, 1 being the one just
            before; nearest first, none twice. Empty for a key frame.
        shown: Whether a picture comes out.
        existing: Whether it holds no picture and only shows the one that it refers to.
    """

    start: int
    end: int
    references: tuple[int, ...]
    shown: bool
    existing: bool
