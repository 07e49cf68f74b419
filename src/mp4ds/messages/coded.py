"""Shared by the parsers of coded pictures: refusals, bounds, bit reading, and their results."""

from __future__ import annotations

from dataclasses import dataclass

from mp4ds.errors import Refused

MAX_SIDE = 16384
"""Maximum width and height of a coded picture, a limit of video decoders."""

MAX_IMAGE_BYTES = 2**28
"""Maximum bytes of pixels unpacked from one coded picture."""

_MAX_UE_BITS = 32


def check_size(width: int, height: int) -> None:
    """Refuse a size that no video can have.

    Raises:
        Refused: A side is zero or beyond `MAX_SIDE`.
    """
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        raise Refused(f"its picture has {width}x{height} pixels")


class BitReader:
    """Reads fields of bits, most significant first.

    Args:
        data: The bytes; only a header's worth, since each read costs their length.
    """

    def __init__(self, data: bytes) -> None:
        self._value = int.from_bytes(data, "big")
        self._left = 8 * len(data)

    def bits(self, count: int) -> int:
        """An unsigned integer of `count` bits.

        Raises:
            Refused: Fewer are left.
        """
        if count > self._left:
            raise Refused("it ends inside of a header")
        self._left -= count
        return (self._value >> self._left) & ((1 << count) - 1)

    def flag(self) -> bool:
        """One bit."""
        return bool(self.bits(1))

    def ue(self) -> int:
        """An unsigned Exp-Golomb code (H.264, 9.1)."""
        zeros = 0
        while not self.bits(1):
            zeros += 1
            if zeros > _MAX_UE_BITS:
                raise Refused("a header holds a number beyond 32 bits")
        return (1 << zeros) - 1 + self.bits(zeros)

    def se(self) -> int:
        """A signed Exp-Golomb code (H.264, 9.1.1)."""
        code = self.ue()
        return (code + 1) // 2 if code % 2 else -(code // 2)


# ---------------------------------------------------------------- pictures

REORDERED = "its stream shows pictures in another order than it sends them (B-frames)"


class NoPicture(Refused):
    """A packet without any picture, which cannot be a video frame."""


@dataclass(frozen=True, slots=True)
class CodedPicture:
    """One coded picture, and the packet that holds it.

    Attributes:
        width: Columns shown.
        height: Rows shown.
        keyframe: Whether decoding can begin here, given the parameters of the stream.
        framing: What an mp4 does not keep of the packet.
    """

    width: int
    height: int
    keyframe: bool
    framing: str = ""


# ---------------------------------------------------------------- coded frames


class UnknownStructure(Refused):
    """It is unknown what frames refer to: they are decoded from the key frame on."""


@dataclass(frozen=True, slots=True)
class CodedFrame:
    """One coded frame in a packet, and the frames a decoder needs before it.

    Frames are counted as coded, including those that are not shown or only show another one.

    Attributes:
        start: Offset of its first byte in the packet.
        end: Offset after its last byte.
        references: How many coded frames back each frame it needs is, 1 being the previous one;
            nearest first, without repetition. Empty for a key frame.
        shown: Whether a picture comes out.
        existing: Whether it has no picture of its own and only shows the one it refers to.
    """

    start: int
    end: int
    references: tuple[int, ...]
    shown: bool
    existing: bool
