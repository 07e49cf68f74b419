"""The boxes that an mp4 is made of (ISO/IEC 14496-12, 4.2)."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

_HEADER, _LONG_HEADER = 8, 16
_MOST_BOXES = 1_000  # beside each other; no video has a tenth of that


class DamagedBoxError(ValueError):
    """A box is missing or contradicts what is around it; the text says which."""


@dataclass(frozen=True, slots=True)
class Box:
    """A box's place.

    Attributes:
        kind: Its four letters.
        start: Byte of the file where its contents begin.
        end: Byte after them.
    """

    kind: bytes
    start: int
    end: int

    @property
    def size(self) -> int:
        """Bytes of its contents."""
        return self.end - self.start


def boxes(file: BinaryIO, start: int, end: int, *, outermost: bool = False) -> Iterator[Box]:
    """The boxes that lie beside each other; only their headers are read.

    Args:
        file: Where they are.
        start: Byte where the first begins.
        end: Byte after the last. Fewer than 8 bytes before it are no box, as in QuickTime.
        outermost: Whether they are in no other box, so that the last may have no size.

    Raises:
        DamagedBoxError: One does not lie within `start` and `end`, or they are too many.
    """
    for _ in range(_MOST_BOXES):
        if end - start < _HEADER:
            return
        file.seek(start)
        header = file.read(min(_LONG_HEADER, end - start))
        if len(header) < _HEADER:
            raise DamagedBoxError("the file ends before its last box")
        size, kind = struct.unpack_from(">I4s", header)
        head = _HEADER
        if size == 1 and len(header) == _LONG_HEADER:
            (size,) = struct.unpack_from(">Q", header, _HEADER)
            head = _LONG_HEADER
        elif size == 0 and outermost:
            size = end - start
        if not head <= size <= end - start:
            raise DamagedBoxError("a box is damaged")
        yield Box(kind, start + head, start + size)
        start += size
    raise DamagedBoxError(f"there are more than {_MOST_BOXES} boxes in one")


def find_box(file: BinaryIO, kind: bytes, start: int, end: int, *, outermost: bool = False) -> Box:
    """The first box of a kind; the arguments are those of `boxes`.

    Raises:
        DamagedBoxError: There is none, or one before it is damaged.
    """
    for box in boxes(file, start, end, outermost=outermost):
        if box.kind == kind:
            return box
    raise DamagedBoxError(f"box {kind.decode('latin-1')} is missing")
