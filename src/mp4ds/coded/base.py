"""What the parsers of coded pictures share: their refusal, their bounds, and reading of bits."""

from __future__ import annotations

MAX_SIDE = 16384
"""Largest width and height of a coded picture: what video decoders take."""

MAX_IMAGE_BYTES = 2**28
"""Most bytes of pixels that are unpacked from one coded picture."""

_MAX_UE_BITS = 32


class Refused(ValueError):  # noqa: N818 - no failure: the message is stored verbatim
    """A coded picture that a video cannot be shown to carry; the text says why."""


def check_size(width: int, height: int) -> None:
    """Refuse a size that no video has.

    Raises:
        Refused: A side is zero or beyond `MAX_SIDE`.
    """
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        raise Refused(f"its picture has {width}x{height} pixels")


class BitReader:
    """Reads fields of bits, most significant first.

    Args:
        data: The bytes; a header's worth, since each read costs their length.
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
