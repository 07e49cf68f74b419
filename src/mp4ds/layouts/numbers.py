"""Numbers for samples of few values, and for metres that are whole millimetres.

Further bijections as in `mp4ds.layouts.values`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from mp4ds.layouts.encodings import Encoding, Pixels
from mp4ds.layouts.values import Parameters, Samples, native, patterns

MAX_TABLE = 4096
"""Most values of a table; bounds what a sidecar can hold."""

SCALES = ("product", "quotient")
"""How metres were made of millimetres: ``k * 0.001f`` or ``k / 1000``."""


@dataclass(frozen=True, slots=True)
class Table:
    """The number of each bit pattern in a list of those that occur.

    Attributes:
        table: The patterns, increasing, uint16 or uint32.
    """

    table: Samples

    @property
    def bits(self) -> int:
        """What its numbers need, in whole bytes."""
        return 8 if len(self.table) <= 256 else 16

    @property
    def is_identity(self) -> bool:
        """Never."""
        return False

    def _numbers(self, samples: Samples) -> Samples:
        """For each sample the number of the last pattern that is not greater, or 0."""
        if samples.dtype.itemsize == 2:
            every = np.arange(65536, dtype=np.uint16)
            numbers = np.searchsorted(self.table, every, side="right")
            return (np.maximum(numbers, 1) - 1).astype(np.uint16)[samples]
        numbers = np.searchsorted(self.table, samples, side="right")
        return (np.maximum(numbers, 1) - 1).astype(np.uint16)

    def shape(self, pixels: Pixels) -> tuple[int, ...]:
        """That of the pixels."""
        return pixels.shape

    def encode(self, pixels: Pixels) -> Samples:
        """New samples."""
        numbers = self._numbers(native(pixels))
        return numbers.astype(np.uint8) if self.bits == 8 else numbers

    def decode(self, samples: Samples, out: Pixels) -> None:
        """Write the pixels; numbers beyond the table, of a damaged video, are the last."""
        patterns(out)[...] = np.take(self.table, samples, mode="clip")

    def refuses(self, pixels: Pixels) -> str | None:
        """A pattern that is not in the table."""
        samples = native(pixels)
        unknown = self.table[self._numbers(samples)] != samples
        if unknown.any():
            value = np.ascontiguousarray(pixels[unknown][:1]).item()
            return f"value {value} is not one of the {len(self.table)} in the stream's table"
        return None

    @classmethod
    def fit(cls, encoding: Encoding, samples: Sequence[Pixels]) -> Parameters | None:
        """The patterns of the samples, where they are few, and sparse if they are integers.

        Where the second half of the samples has patterns that the first has not, later images
        would have others again.
        """
        half = (len(samples) + 1) // 2
        found: Samples = np.empty(0, f"u{encoding.bytes_per_sample}")
        for number, pixels in enumerate(samples):
            patterns_here, before = native(pixels), len(found)
            for part in (patterns_here[::16, ::16], patterns_here):  # most refusals are cheap
                found = np.union1d(found, part)
                if len(found) > MAX_TABLE or (number >= half and len(found) > before):
                    return None
        values = found.tolist()
        if not encoding.is_float and values[-1] - values[0] + 1 < 2 * len(values):
            return None  # a plain picture has hardly more values
        return Parameters(table=tuple(values))


_EXPONENT = 0x7F800000  # all ones in NaN and infinity


@cache
def _metres(scale: str) -> Samples:
    """Bit patterns of 0 to 65535 millimetres in metres, as float32; not to be written to."""
    counts = np.arange(65536, dtype=np.float32)
    thousand = np.float32(1000)
    metres = counts * np.float32(0.001) if scale == "product" else counts / thousand
    found: Samples = metres.astype(np.float32).view(np.uint32)
    found.flags.writeable = False
    return found


@dataclass(frozen=True, slots=True)
class Metres:
    """Whole millimetres, of floats that hold them in metres; 0 is the hole.

    Attributes:
        hole: Bit pattern of a float32: 0, a NaN or an infinity.
        scale: One of `SCALES`.
    """

    hole: int
    scale: str

    @property
    def bits(self) -> int:
        """Always 16."""
        return 16

    @property
    def is_identity(self) -> bool:
        """Never."""
        return False

    def _table(self) -> Samples:
        table: Samples = _metres(self.scale).copy()
        table[0] = self.hole
        return table

    def shape(self, pixels: Pixels) -> tuple[int, ...]:
        """That of the pixels."""
        return pixels.shape

    def encode(self, pixels: Pixels) -> Samples:
        """New samples."""
        with np.errstate(invalid="ignore", over="ignore"):
            metres = pixels.astype(np.float32, copy=False)
            counts = np.rint(metres * np.float32(1000))
            counts[~((counts >= 0) & (counts < 65536))] = 0  # NaN compares as false
        found: Samples = counts.astype(np.uint16)
        return found

    def decode(self, samples: Samples, out: Pixels) -> None:
        """Write the pixels."""
        patterns(out)[...] = self._table()[samples]

    def refuses(self, pixels: Pixels) -> str | None:
        """A float that is neither the hole nor a whole number of millimetres."""
        other = self._table()[self.encode(pixels)] != native(pixels)
        if other.any():
            value = np.ascontiguousarray(pixels[other][:1]).item()
            return f"value {value} is neither whole millimetres nor the stream's mark of a hole"
        return None

    @classmethod
    def fit(cls, encoding: Encoding, samples: Sequence[Pixels]) -> Parameters | None:
        """The scale, and the hole that occurs."""
        hole = 0
        for pixels in samples:
            found = native(pixels)
            holes = found[(found == 0) | (found & _EXPONENT == _EXPONENT)]
            if holes.size:
                hole = int(holes[0])
                break
        for scale in SCALES:
            metres = cls(hole, scale)
            if not any(metres.refuses(pixels[::16, ::16]) for pixels in samples) and not any(
                metres.refuses(pixels) for pixels in samples
            ):
                return Parameters(hole=hole, scale=scale)
        return None
