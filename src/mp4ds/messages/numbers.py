"""Images whose values are few, or whole millimetres: their numbers in a list or table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from mp4ds.errors import Refused
from mp4ds.messages.encodings import (
    MAX_TABLE,
    NO_PARAMETERS,
    Arrangement,
    Encoding,
    LayoutParameters,
    Narrow,
    Picture,
    Pixels,
    Samples,
    Values,
    Whole,
    native,
    patterns,
    refuse_beyond,
)

SCALES = ("product", "quotient")
"""How metres were made from millimetres: ``k * 0.001f`` or ``k / 1000``."""


class PatternTable(Values):
    """The index of each bit pattern in a list of those that occur, in one or two bytes.

    Attributes:
        table: The patterns, increasing, uint16 or uint32.
    """

    parameters = frozenset({"table"})

    def __init__(self, encoding: Encoding, given: LayoutParameters) -> None:
        super().__init__(encoding, given)
        table, top = given.table or (), 2**self.bits - 1
        if not table:
            raise ValueError("a table of 0 values")
        if max(table) > top:
            raise ValueError(f"a table with values beyond 0 to {top}")
        self.table = np.array(table, f"u{encoding.bytes_per_sample}")
        if (self.table[1:] <= self.table[:-1]).any():
            raise ValueError("a table that does not increase")
        self.bits = 8 if len(table) <= 256 else 16

    def _numbers(self, samples: Samples) -> Samples:
        """For each sample the index of the last pattern that is not greater, or 0."""
        numbers = np.searchsorted(self.table, samples, side="right")
        return (np.maximum(numbers, 1) - 1).astype(np.uint16)

    @cached_property
    def _numbers_of_words(self) -> Samples:
        """Those of each pattern of 16 bits."""
        return self._numbers(np.arange(65536, dtype=np.uint16))

    def encode(self, pixels: Pixels) -> Samples:
        """New samples."""
        samples = native(pixels)
        is_word = samples.dtype.itemsize == 2
        numbers = self._numbers_of_words[samples] if is_word else self._numbers(samples)
        return numbers.astype(np.uint8, copy=False) if self.bits == 8 else numbers

    def decode(self, samples: Samples, out: Pixels) -> None:
        """Write the pixels; indices beyond the table, from a damaged video, mean the last entry."""
        patterns(out)[...] = np.take(self.table, samples, mode="clip")

    def prove(self, pixels: Pixels) -> None:
        """Prove that all patterns are in the table."""
        unknown = self.table[self.encode(pixels)] != native(pixels)
        if unknown.any():
            value = np.ascontiguousarray(pixels[unknown][:1]).item()
            raise Refused(f"value {value} is {self._unknown()}")

    def _unknown(self) -> str:
        return f"not one of the {len(self.table)} in the stream's table"

    @classmethod
    def fit(cls, encoding: Encoding, samples: Sequence[Pixels]) -> LayoutParameters | None:
        """The patterns of the samples, if they are few; integers must also be sparse.

        If the second half of the samples has patterns missing in the first, later images would have
        yet others.
        """
        half = (len(samples) + 1) // 2
        found: Samples = np.empty(0, f"u{encoding.bytes_per_sample}")
        for number, pixels in enumerate(samples):
            patterns_here, before = native(pixels), len(found)
            for part in (patterns_here[::16, ::16], patterns_here):  # makes most refusals cheap
                found = np.union1d(found, part)
                if len(found) > MAX_TABLE or (number >= half and len(found) > before):
                    return None
        values = found.tolist()
        if not encoding.is_float and values[-1] - values[0] + 1 < 2 * len(values):
            return None  # a plain picture has hardly more values
        return LayoutParameters(table=tuple(values))


_DARK, _BRIGHT = 16, 239  # levels between which values are shown that are close together


class Tone(PatternTable):
    """Levels of 8 bits that stand for patterns of more bits; a sample gets the nearest: not exact.

    Attributes:
        table: The patterns of the 256 levels.
    """

    parameters = frozenset({"bits", "shift", "table"})

    def __init__(self, encoding: Encoding, given: LayoutParameters) -> None:
        super().__init__(encoding, given)
        self._used = bits, shift = given.bits or 0, given.shift or 0
        if bits < 8 or bits + shift > 16:
            raise ValueError(f"no layout shows {bits} bits above {shift} zero bits")
        if len(self.table) != 256:
            raise ValueError(f"a table of {len(self.table)} values, not of 256")
        refuse_beyond(self.table, bits, shift)
        wide = self.table.astype(np.uint32)
        self._between = (wide[:-1] + wide[1:] + 1) // 2

    def _numbers(self, samples: Samples) -> Samples:
        found: Samples = np.searchsorted(self._between, samples, side="right").astype(np.uint8)
        return found

    def prove(self, pixels: Pixels) -> None:
        """Prove that no bit is outside the kept ones."""
        refuse_beyond(native(pixels), *self._used)

    @classmethod
    def fit(cls, encoding: Encoding, samples: Sequence[Pixels]) -> LayoutParameters | None:
        """The bits in use, and a curve.

        The median is shown in the middle, as far as that is between a linear curve and a quadratic
        one, whose steps grow with a sensor's noise. Both are from black to white, whatever the
        samples have, since a camera may start in the dark. Only values that are close together, far
        from both, as temperatures are, get most of the levels.
        """
        used = Narrow.used_bits(encoding, samples) or LayoutParameters(bits=16, shift=0)
        bits, shift = used.bits or 16, used.shift or 0
        values = np.concatenate([native(pixels)[::3, ::3].ravel() for pixels in samples]) >> shift
        low, middle, high = map(float, np.quantile(values, (0.001, 0.5, 0.999)))
        top = 2**bits - 1
        level = np.arange(256)
        margin = max(high - low, top / 64, 128)
        if high - low < top / 16 and low > 2 * margin and high + 2 * margin < top:
            knots = [0, low - margin, high + margin, top]
            curve = np.interp(level, [0, _DARK, _BRIGHT, 255], knots)
        else:
            share = min(max(4 * middle / top - 1, 255 / top), 1)
            curve = top * (share * level / 255 + (1 - share) * (level / 255) ** 2)
        table = ((curve + 0.5).astype(int) << shift).tolist()
        return LayoutParameters(bits=bits, shift=shift, table=tuple(table))


_EXPONENT = 0x7F800000  # all ones in NaN and infinity


@cache
def _metres(scale: str) -> Samples:
    """Bit patterns of 0 to 65535 millimetres in metres, as float32; read-only."""
    counts = np.arange(65536, dtype=np.float32)
    thousand = np.float32(1000)
    metres = counts * np.float32(0.001) if scale == "product" else counts / thousand
    found: Samples = metres.astype(np.float32).view(np.uint32)
    found.flags.writeable = False
    return found


class Metres(PatternTable):
    """Whole millimetres, from floats in metres; 0 is the hole: 0, a NaN or an infinity."""

    parameters = frozenset({"hole", "scale"})

    def __init__(self, encoding: Encoding, given: LayoutParameters) -> None:
        Values.__init__(self, encoding, given)
        if given.scale not in SCALES:
            raise ValueError(f"scale {given.scale!r} is not one of {', '.join(SCALES)}")
        self.bits = 16
        self.table = _metres(given.scale).copy()
        self.table[0] = given.hole or 0

    def encode(self, pixels: Pixels) -> Samples:
        """New samples."""
        with np.errstate(invalid="ignore", over="ignore"):
            metres = pixels.astype(np.float32, copy=False)
            counts = np.rint(metres * np.float32(1000))
            counts[~((counts >= 0) & (counts < 65536))] = 0  # NaN compares as false
        found: Samples = counts.astype(np.uint16)
        return found

    def _unknown(self) -> str:
        return "neither whole millimetres nor the stream's mark of a hole"

    @classmethod
    def fit(cls, encoding: Encoding, samples: Sequence[Pixels]) -> LayoutParameters | None:
        """The scale, and the hole that occurs."""
        hole = 0
        for pixels in samples:
            found = native(pixels)
            holes = found[(found == 0) | (found & _EXPONENT == _EXPONENT)]
            if holes.size:
                hole = int(holes[0])
                break
        candidates = [LayoutParameters(hole=hole, scale=scale) for scale in SCALES]
        likely = cls.first_fitting(encoding, [one[::16, ::16] for one in samples], *candidates)
        return cls.first_fitting(encoding, samples, *candidates) if likely else None


# ---------------------------------------------------------------- few values in an image

FEWEST_ENTRIES, MOST_ENTRIES = 256, MAX_TABLE
"""Bounds of a list's length, which is a power of two."""

_ROOM = 3 / 2  # entries per value of a sample image


class Few(Whole):
    """Samples of a limited number of different values in each image."""

    parameters = frozenset({"entries"})

    def __init__(self, encoding: Encoding, given: LayoutParameters) -> None:
        super().__init__(encoding, given)
        self._entries = given.entries or 0
        if self._entries < FEWEST_ENTRIES or self._entries & (self._entries - 1):
            problem = f"is no power of two from {FEWEST_ENTRIES} on"
            raise ValueError(f"a list of {self._entries} values, which {problem}")

    def prove(self, pixels: Pixels) -> None:
        """Prove that there are not too many values."""
        count = len(distinct(native(pixels)))
        if count > self._entries:
            more = f"more than the {self._entries} of the stream's list"
            raise Refused(f"{count} different values, {more}")

    @classmethod
    def fit(cls, encoding: Encoding, samples: Sequence[Pixels]) -> LayoutParameters | None:
        """Allow for half as many values again; integers must be sparse."""
        most = 0
        for pixels in samples:
            if len(distinct(native(pixels)[::8, ::8])) > MOST_ENTRIES / _ROOM:
                return None
            values = distinct(Whole(encoding, NO_PARAMETERS).encode(pixels))
            if not encoding.is_float and int(values[-1]) - int(values[0]) + 1 < 2 * len(values):
                return None  # a plain picture hardly has more
            most = max(most, len(values))
        entries = FEWEST_ENTRIES
        while entries < most * _ROOM:
            entries *= 2
        return LayoutParameters(entries=entries) if entries <= MOST_ENTRIES else None


def distinct(samples: Samples) -> Samples:
    """The patterns that occur, increasing."""
    if samples.dtype.itemsize > 2:
        return np.unique(samples)
    occurs = np.zeros(65536, bool)
    occurs[samples] = True
    return np.flatnonzero(occurs).astype(np.uint16)


@dataclass(frozen=True, slots=True)
class Palette(Arrangement):
    """The index of each sample in a list, and the list itself below.

    Numbers of more than 8 bits are folded. The list is increasing, its last entry repeated;
    first come the highest bytes of all entries, then the next ones, by rows of the picture.

    Attributes:
        entries: Of the list.
        size: Bytes of a sample.
        numbers: Arrangement of the numbers.
    """

    entries: int
    size: int
    numbers: Arrangement

    def pixel_format(self, bits: int) -> str:
        """Grey, 8 bits."""
        return "gray"

    def picture_size(self, width: int, height: int) -> tuple[int, int]:
        """Taller by the list."""
        _, rows = self.numbers.picture_size(width, height)
        return width, rows + -(-self.entries * self.size // width)

    def arrange(self, samples: Samples) -> Picture:
        """A copy."""
        height, width = samples.shape
        values = distinct(samples)
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
        (upper,) = self.numbers.arrange(numbers)
        picture[: len(upper)] = upper
        entries = np.full(self.entries, values[-1], f">u{self.size}")
        entries[: len(values)] = values
        listed = entries.view(np.uint8).reshape(-1, self.size).T.ravel()
        picture[len(upper) :].reshape(-1)[: listed.size] = listed
        return (picture,)

    def restore(self, picture: Picture, samples: Samples) -> None:
        """Copy; indices beyond the list, from a damaged video, mean its last entry."""
        height, width = samples.shape
        _, upper = self.numbers.picture_size(width, height)
        numbers = np.empty((height, width), np.uint8 if self.entries <= 256 else np.uint16)
        self.numbers.restore((picture[0][:upper],), numbers)
        listed = picture[0][upper:].reshape(-1)[: self.entries * self.size]
        entries = np.ascontiguousarray(listed.reshape(self.size, -1).T).view(f">u{self.size}")
        samples[...] = np.take(entries.ravel(), numbers, mode="clip")
