"""Pictures that carry their own list of values, for images of few values.

As stereo cameras make them: depth by the inverse of a whole number. The list of one image is
not that of the next, so that it stands below the numbers (spec/index.md, "Layouts").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mp4ds.layouts.arrangements import Fold, Packed, Picture
from mp4ds.layouts.encodings import Encoding, Pixels
from mp4ds.layouts.values import Parameters, Samples, Whole, native

FEWEST_ENTRIES, MOST_ENTRIES = 256, 4096
"""Bounds of the length of a list, which is a power of two."""

_ROOM = 3 / 2  # entries for each value of an image of the samples


def _values(samples: Samples) -> Samples:
    """The patterns that occur, increasing."""
    if samples.dtype.itemsize > 2:
        return np.unique(samples)
    occurs = np.zeros(65536, bool)
    occurs[samples] = True
    return np.flatnonzero(occurs).astype(np.uint16)


@dataclass(frozen=True, slots=True)
class Few:
    """Samples as `Whole` has them, of no more than so many values.

    Attributes:
        whole: What becomes of each.
        entries: Most values of an image.
    """

    whole: Whole
    entries: int

    @property
    def bits(self) -> int:
        """All of the sample's."""
        return self.whole.bits

    @property
    def is_identity(self) -> bool:
        """Unless there are signs."""
        return self.whole.is_identity

    def shape(self, pixels: Pixels) -> tuple[int, ...]:
        """That of the pixels."""
        return pixels.shape

    def encode(self, pixels: Pixels) -> Samples:
        """A view where possible."""
        return self.whole.encode(pixels)

    def decode(self, samples: Samples, out: Pixels) -> None:
        """Write the pixels."""
        self.whole.decode(samples, out)

    def refuses(self, pixels: Pixels) -> str | None:
        """Too many values."""
        count = len(_values(native(pixels)))
        if count > self.entries:
            return f"{count} different values, more than the {self.entries} of the stream's list"
        return None

    @classmethod
    def fit(cls, encoding: Encoding, samples: Sequence[Pixels]) -> Parameters | None:
        """Room for half as many values again, where they are sparse if they are integers."""
        most = 0
        for pixels in samples:
            if len(_values(native(pixels)[::8, ::8])) > MOST_ENTRIES / _ROOM:
                return None
            values = _values(Whole(encoding).encode(pixels))
            if not encoding.is_float and int(values[-1]) - int(values[0]) + 1 < 2 * len(values):
                return None  # a plain picture has hardly more
            most = max(most, len(values))
        entries = FEWEST_ENTRIES
        while entries < most * _ROOM:
            entries *= 2
        return Parameters(entries=entries) if entries <= MOST_ENTRIES else None


@dataclass(frozen=True, slots=True)
class Palette:
    """The number of each sample in a list, and below the list itself.

    Numbers of more than 8 bits are folded. The list is increasing, its last entry repeated;
    first come the highest bytes of all entries, then the next ones, by rows of the picture.

    Attributes:
        entries: Of the list.
        size: Bytes of a sample.
    """

    entries: int
    size: int

    @property
    def _numbers(self) -> Packed | Fold:
        return Packed() if self.entries <= 256 else Fold(16, 8)

    def pixel_format(self, bits: int) -> str:
        """Grey, 8 bits."""
        return "gray"

    def picture_size(self, width: int, height: int) -> tuple[int, int]:
        """Higher by the list."""
        _, rows = self._numbers.picture_size(width, height)
        return width, rows + -(-self.entries * self.size // width)

    def arrange(self, samples: Samples) -> Picture:
        """A copy."""
        height, width = samples.shape
        values = _values(samples)
        if self.size == 2:
            numbers_of = np.zeros(65536, np.uint16)
            numbers_of[values] = np.arange(len(values))
            numbers = numbers_of[samples]
        else:
            numbers = np.searchsorted(values, samples).astype(np.uint16)
        if self.entries <= 256:
            numbers = numbers.astype(np.uint8)
        _, rows = self.picture_size(width, height)
        picture = np.zeros((rows, width), np.uint8)
        (upper,) = self._numbers.arrange(numbers)
        picture[: len(upper)] = upper
        entries = np.full(self.entries, values[-1], f">u{self.size}")
        entries[: len(values)] = values
        listed = entries.view(np.uint8).reshape(-1, self.size).T.ravel()
        picture[len(upper) :].reshape(-1)[: listed.size] = listed
        return (picture,)

    def restore(self, picture: Picture, samples: Samples) -> None:
        """Copy; numbers beyond the list, of a damaged video, are its last entry."""
        height, width = samples.shape
        _, upper = self._numbers.picture_size(width, height)
        numbers = np.empty((height, width), np.uint8 if self.entries <= 256 else np.uint16)
        self._numbers.restore((picture[0][:upper],), numbers)
        listed = picture[0][upper:].reshape(-1)[: self.entries * self.size]
        entries = np.ascontiguousarray(listed.reshape(self.size, -1).T).view(f">u{self.size}")
        samples[...] = np.take(entries.ravel(), numbers, mode="clip")
