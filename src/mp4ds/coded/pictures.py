"""What is known of one coded picture of a stream, whatever its codec."""

from __future__ import annotations

from dataclasses import dataclass

from mp4ds.coded.base import Refused

REORDERED = "its stream shows pictures in another order than it sends them (B-frames)"


class NoPicture(Refused):
    """A packet without any picture, which no frame of a video can be made of."""


@dataclass(frozen=True, slots=True)
class Picture:
    """One coded picture.

    Attributes:
        width: Columns shown.
        height: Rows shown.
        keyframe: Whether decoding can begin here, given the parameters of the stream.
    """

    width: int
    height: int
    keyframe: bool
