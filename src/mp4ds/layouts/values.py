"""What a picture holds for each sample of an image: the first half of a layout.

Each class is a bijection between the samples that it does not refuse and unsigned integers. It
works on bit patterns, so that NaN payloads and negative zeros return (spec/index.md, "Layouts").
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mp4ds.layouts.encodings import Encoding, Pixels

Samples = NDArray[Any]
"""Unsigned integers in native byte order, shape of the pixels."""

DEPTHS = (8, 10, 12, 14)
"""Bits per sample of pictures, other than 16."""


@dataclass(frozen=True, slots=True)
class Parameters:
    """What a layout needs to know of a stream; a layout has all of its own and no other.

    Attributes:
        bits: Bits per sample of the picture.
        shift: Zero bits below them in each sample of the image.
        low: How many of the bits are low ones, folded and stored apart.
        table: The bit patterns that occur, in increasing order.
        entries: Length of the list of values in each picture.
        hole: Bit pattern of the float that stands for no measurement.
        scale: One of `mp4ds.layouts.SCALES`.
        alpha: Bit pattern of every pixel's alpha.
    """

    bits: int | None = None
    shift: int | None = None
    low: int | None = None
    table: tuple[int, ...] | None = None
    entries: int | None = None
    hole: int | None = None
    scale: str | None = None
    alpha: int | None = None

    @property
    def names(self) -> frozenset[str]:
        """Names of those that are there."""
        return frozenset(f.name for f in fields(self) if getattr(self, f.name) is not None)

    def to_values(self) -> dict[str, Any]:
        """As JSON has it, without those that are not there."""
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name in self.names}
        return values | ({"table": list(self.table)} if self.table is not None else {})

    @classmethod
    def from_values(cls, values: Mapping[str, Any]) -> Parameters:
        """The parameters of `to_values`; `mp4ds.layouts.bind` checks what they say.

        Raises:
            ValueError: A name is unknown.
        """
        known = {f.name for f in fields(cls)}
        if unknown := sorted(set(values) - known):
            raise ValueError(f"unknown layout parameter {unknown[0]!r}")
        given = dict(values)
        if isinstance(given.get("table"), list):
            given["table"] = tuple(given["table"])
        return cls(**given)


NO_PARAMETERS = Parameters()


class Values(Protocol):
    """A bijection between samples of an image and those of its picture."""

    @property
    def bits(self) -> int:
        """Bits per sample of the picture."""

    @property
    def is_identity(self) -> bool:
        """Whether the picture's samples have the bit patterns of the image's."""

    def shape(self, pixels: Pixels) -> tuple[int, ...]:
        """Shape of the samples of pixels."""

    def encode(self, pixels: Pixels) -> Samples:
        """Samples of pixels that are not refused; may be a view."""

    def decode(self, samples: Samples, out: Pixels) -> None:
        """Write the pixels of samples into ``out``, in its byte order."""

    def refuses(self, pixels: Pixels) -> str | None:
        """Why these pixels would not come back, or None if they do."""


def patterns(pixels: Pixels) -> Samples:
    """The bit patterns of pixels as a view, in their byte order."""
    return pixels.view(pixels.dtype.str.replace(pixels.dtype.kind, "u"))


def native(pixels: Pixels) -> Samples:
    """The bit patterns of pixels in native byte order; a view where possible."""
    found = patterns(pixels)
    return found.astype(found.dtype.newbyteorder("="), copy=False)


@dataclass(frozen=True, slots=True)
class Whole:
    """Samples as they are; of signed integers the top bit is inverted, which keeps their order.

    Attributes:
        encoding: The image's.
    """

    encoding: Encoding

    @property
    def bits(self) -> int:
        """All of the sample's."""
        return 8 * self.encoding.bytes_per_sample

    @property
    def is_identity(self) -> bool:
        """Unless there are signs."""
        return not self.encoding.is_signed

    def shape(self, pixels: Pixels) -> tuple[int, ...]:
        """That of the pixels."""
        return pixels.shape

    def encode(self, pixels: Pixels) -> Samples:
        """A view where possible."""
        samples = native(pixels)
        return samples if self.is_identity else samples ^ samples.dtype.type(1 << (self.bits - 1))

    def decode(self, samples: Samples, out: Pixels) -> None:
        """Write the pixels."""
        top = 0 if self.is_identity else 1 << (self.bits - 1)
        patterns(out)[...] = samples ^ samples.dtype.type(top) if top else samples

    def refuses(self, pixels: Pixels) -> str | None:
        """Never."""
        return None


@dataclass(frozen=True, slots=True)
class Narrow:
    """The bits of 16 that are in use.

    Attributes:
        bits: Bits per sample, one of `DEPTHS` or 16.
        shift: Zero bits below them.
        signed: Half of the range is added first.
    """

    bits: int
    shift: int
    signed: bool

    @property
    def is_identity(self) -> bool:
        """Where only the picture's format differs."""
        return self.bits > 8 and not self.shift and not self.signed

    @property
    def _half(self) -> int:
        return 1 << (self.bits + self.shift - 1) if self.signed else 0

    def _shifted(self, pixels: Pixels) -> Samples:
        samples = native(pixels)
        return samples + np.uint16(self._half) if self.signed else samples  # wraps, as it must

    def shape(self, pixels: Pixels) -> tuple[int, ...]:
        """That of the pixels."""
        return pixels.shape

    def encode(self, pixels: Pixels) -> Samples:
        """A view where possible."""
        samples = self._shifted(pixels)
        if self.shift:
            samples = samples >> np.uint16(self.shift)
        return samples.astype(np.uint8) if self.bits == 8 else samples

    def decode(self, samples: Samples, out: Pixels) -> None:
        """Write the pixels."""
        wide = samples.astype(np.uint16, copy=False)
        if self.shift:
            wide = wide << np.uint16(self.shift)
        patterns(out)[...] = wide - np.uint16(self._half) if self.signed else wide

    def refuses(self, pixels: Pixels) -> str | None:
        """A bit outside of those that are kept."""
        used = int(np.bitwise_or.reduce(self._shifted(pixels), axis=None))
        kept = ((1 << self.bits) - 1) << self.shift
        if used & ~kept:
            below = f" above {self.shift} zero bits" if self.shift else ""
            return f"a value does not fit into {self.bits} bits{below}"
        return None

    @classmethod
    def fit(cls, encoding: Encoding, samples: Sequence[Pixels]) -> Parameters | None:
        """The least bits for values that end at the highest bit, or at the twelfth.

        At the highest bit, the zeros below tell the sensor's depth. Elsewhere a scene may just
        be dark, so that fewer than 12 bits are taken for granted only where a value has them all.
        """
        used = most = 0
        for pixels in samples:
            used |= int(np.bitwise_or.reduce(native(pixels), axis=None))
            most = max(most, int(native(pixels).max()))
        if not used:
            return None
        zeros = (used & -used).bit_length() - 1
        bits = (used >> zeros).bit_length()
        if not encoding.is_signed and bits in DEPTHS and most >> zeros == (1 << bits) - 1:
            return Parameters(bits=bits, shift=zeros)
        for top, least in ((16, 4), (12, 0), (16, 2)):  # where the values end, by the zeros below
            bits = next((depth for depth in DEPTHS if depth >= top - zeros), 16)
            narrow = cls(bits, top - bits, encoding.is_signed)
            if zeros >= least and bits < 16 and not any(map(narrow.refuses, samples)):
                return Parameters(bits=bits, shift=top - bits)
        return None


@dataclass(frozen=True, slots=True)
class Opaque:
    """The colours of pixels that all have the same alpha, of 8 bits.

    Attributes:
        alpha: Of every pixel.
    """

    alpha: int

    @property
    def bits(self) -> int:
        """Always 8."""
        return 8

    @property
    def is_identity(self) -> bool:
        """Never."""
        return False

    def shape(self, pixels: Pixels) -> tuple[int, ...]:
        """Three channels."""
        return (*pixels.shape[:2], 3)

    def encode(self, pixels: Pixels) -> Samples:
        """A copy, since a frame has no gaps between its pixels."""
        return np.ascontiguousarray(pixels[..., :3])

    def decode(self, samples: Samples, out: Pixels) -> None:
        """Write the pixels."""
        out[..., :3] = samples
        out[..., 3] = self.alpha

    def refuses(self, pixels: Pixels) -> str | None:
        """Another alpha."""
        if (pixels[..., 3] != self.alpha).any():
            return f"an alpha that is not the stream's, {self.alpha}"
        return None

    @classmethod
    def fit(cls, encoding: Encoding, samples: Sequence[Pixels]) -> Parameters | None:
        """The alpha of the first pixel, if it is that of all."""
        alpha = int(samples[0][0, 0, 3])
        if any(cls(alpha).refuses(pixels) for pixels in samples):
            return None
        return Parameters(alpha=alpha)
