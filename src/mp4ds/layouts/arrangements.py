"""Where a picture holds each sample of an image: the second half of a layout.

Each class moves unsigned integers from the array of an image into the planes of a picture and
back (spec/index.md, "Layouts").
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mp4ds.layouts.values import Samples

Picture = tuple[Samples, ...]
"""What the video holds: one array (rows, columns[, channels]), or one per plane."""


class Arrangement(Protocol):
    """A bijection between an array of samples and a picture."""

    def pixel_format(self, bits: int) -> str:
        """Name in ffmpeg of the picture's format, for samples of so many bits."""

    def picture_size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height of the image -> of the picture."""

    def arrange(self, samples: Samples) -> Picture:
        """The picture; may be a view."""

    def restore(self, picture: Picture, samples: Samples) -> None:
        """Write the samples of a picture of the right size."""


def _gray(bits: int) -> str:
    return "gray" if bits == 8 else f"gray{bits}le"


@dataclass(frozen=True, slots=True)
class Packed:
    """The array itself.

    Attributes:
        packed_format: Pixel format; empty: grey.
    """

    packed_format: str = ""

    def pixel_format(self, bits: int) -> str:
        """Its own or grey."""
        return self.packed_format or _gray(bits)

    def picture_size(self, width: int, height: int) -> tuple[int, int]:
        """The same."""
        return width, height

    def arrange(self, samples: Samples) -> Picture:
        """A view."""
        return (samples,)

    def restore(self, picture: Picture, samples: Samples) -> None:
        """Copy."""
        np.copyto(samples, picture[0])


@dataclass(frozen=True, slots=True)
class Mosaic:
    """Four half-size pictures, one per place in the 2 x 2 block, in a 2 x 2 grid.

    Neighbours then hold the same colour, which is what predictors expect. An odd last row or
    column of a tile repeats its neighbour.
    """

    def pixel_format(self, bits: int) -> str:
        """Grey."""
        return _gray(bits)

    def picture_size(self, width: int, height: int) -> tuple[int, int]:
        """Even."""
        return width + width % 2, height + height % 2

    def arrange(self, samples: Samples) -> Picture:
        """A copy."""
        height, width = samples.shape
        half_height, half_width = (height + 1) // 2, (width + 1) // 2
        picture = np.empty((2 * half_height, 2 * half_width), dtype=samples.dtype)
        for row in (0, 1):
            for column in (0, 1):
                part = samples[row::2, column::2]
                if not part.size:
                    part = samples[:1, :1]
                tile = picture[
                    row * half_height : (row + 1) * half_height,
                    column * half_width : (column + 1) * half_width,
                ]
                tile[: part.shape[0], : part.shape[1]] = part
                tile[part.shape[0] :, : part.shape[1]] = part[-1:]
                tile[:, part.shape[1] :] = tile[:, part.shape[1] - 1 : part.shape[1]]
        return (picture,)

    def restore(self, picture: Picture, samples: Samples) -> None:
        """Copy."""
        height, width = samples.shape
        half_height, half_width = (height + 1) // 2, (width + 1) // 2
        for row in (0, 1):
            for column in (0, 1):
                target = samples[row::2, column::2]
                target[...] = picture[0][
                    row * half_height : row * half_height + target.shape[0],
                    column * half_width : column * half_width + target.shape[1],
                ]


@dataclass(frozen=True, slots=True)
class Stack:
    """The channels of an image, one under the other.

    Attributes:
        channels: How many.
    """

    channels: int

    def pixel_format(self, bits: int) -> str:
        """Grey."""
        return _gray(bits)

    def picture_size(self, width: int, height: int) -> tuple[int, int]:
        """As many times as high."""
        return width, self.channels * height

    def arrange(self, samples: Samples) -> Picture:
        """A copy."""
        return (np.concatenate([samples[..., n] for n in range(self.channels)]),)

    def restore(self, picture: Picture, samples: Samples) -> None:
        """Copy."""
        height = samples.shape[0]
        for n in range(self.channels):
            samples[..., n] = picture[0][n * height : (n + 1) * height]


@dataclass(frozen=True, slots=True)
class PlanarRgb:
    """One plane per colour, in ffmpeg's order: G, B, R and alpha.

    Attributes:
        order: The channels of the image, such as ``bgra``.
    """

    order: str

    def pixel_format(self, bits: int) -> str:
        """By alpha and depth."""
        return f"{'gbrap' if 'a' in self.order else 'gbrp'}{bits}le"

    def picture_size(self, width: int, height: int) -> tuple[int, int]:
        """The same."""
        return width, height

    def _channels(self) -> Iterator[int]:
        return (self.order.index(colour) for colour in "gbra"[: len(self.order)])

    def arrange(self, samples: Samples) -> Picture:
        """Views."""
        return tuple(samples[..., channel] for channel in self._channels())

    def restore(self, picture: Picture, samples: Samples) -> None:
        """Copy."""
        for channel, plane in zip(self._channels(), picture, strict=True):
            samples[..., channel] = plane


@dataclass(frozen=True, slots=True)
class Fold:
    """High bits over low bits, these folded: all of them inverted where the high ones are odd.

    So a slope that carries into the high bits does not tear the low ones from end to end, and
    the noise of the low bits does not hide what the high ones predict.

    Attributes:
        bits: Of a sample, at most 16.
        low: How many of them are low, at most 8.
        first: What is done to the samples before, into one array.
    """

    bits: int
    low: int
    first: Mosaic | Packed = Packed()

    @property
    def _mask(self) -> int:
        return (1 << self.low) - 1

    def pixel_format(self, bits: int) -> str:
        """Grey, of as many bits as the high ones need."""
        return _gray(8 if self.bits - self.low <= 8 else 10)

    def picture_size(self, width: int, height: int) -> tuple[int, int]:
        """Twice as high."""
        columns, rows = self.first.picture_size(width, height)
        return columns, 2 * rows

    def arrange(self, samples: Samples) -> Picture:
        """A copy."""
        (plane,) = self.first.arrange(samples)
        height, width = plane.shape
        deep = self.pixel_format(self.bits) != "gray"
        picture = np.empty((2 * height, width), np.uint16 if deep else np.uint8)
        high, low = picture[:height], picture[height:]
        np.right_shift(plane, np.uint16(self.low), out=high, casting="unsafe")
        np.bitwise_and(plane, np.uint16(self._mask), out=low, casting="unsafe")
        low ^= self._folds(high)
        return (picture,)

    def restore(self, picture: Picture, samples: Samples) -> None:
        """Copy."""
        height = len(picture[0]) // 2
        high, folded = picture[0][:height], picture[0][height:]
        wide = high.astype(np.uint16) << np.uint16(self.low)
        self.first.restore((wide | (folded ^ self._folds(high)),), samples)

    def _folds(self, high: Samples) -> Samples:
        """All low bits where the high ones are odd, else 0."""
        folds: Samples = (high & 1) * high.dtype.type(self._mask)
        return folds


@dataclass(frozen=True, slots=True)
class Bytes:
    """A picture for each byte of 32 or 64 bits, the highest first: two or four side by side.

    In two rows; the channels one under the other. So each slice of the codec has bytes of one
    kind, and the high ones, which are smooth, do not share its statistics with the low ones.

    Attributes:
        size: Bytes of a sample, 4 or 8.
        channels: Of the image.
    """

    size: int
    channels: int

    def pixel_format(self, bits: int) -> str:
        """Grey, 8 bits."""
        return "gray"

    def picture_size(self, width: int, height: int) -> tuple[int, int]:
        """Two rows of pictures for each channel."""
        return self.size // 2 * width, 2 * self.channels * height

    def _tiles(self, picture: Samples, samples: Samples) -> Iterator[tuple[int, int, Samples]]:
        """Byte, channel, and its part of the picture."""
        height, width = samples.shape[:2]
        for channel in range(self.channels):
            for byte in range(self.size):
                row, column = divmod(byte, self.size // 2)
                top = (2 * channel + row) * height
                yield (
                    byte,
                    channel,
                    picture[top : top + height, column * width : (column + 1) * width],
                )

    def arrange(self, samples: Samples) -> Picture:
        """A copy."""
        width, height = self.picture_size(samples.shape[1], samples.shape[0])
        picture = np.empty((height, width), np.uint8)
        parts = _as_bytes(samples, self.channels)
        for byte, channel, tile in self._tiles(picture, samples):
            tile[...] = parts[:, :, channel, byte]
        return (picture,)

    def restore(self, picture: Picture, samples: Samples) -> None:
        """Copy."""
        whole = np.empty(samples.shape, f">u{self.size}")
        parts = _as_bytes(whole, self.channels)
        for byte, channel, tile in self._tiles(picture[0], samples):
            parts[:, :, channel, byte] = tile
        samples[...] = whole


def _as_bytes(samples: Samples, channels: int) -> Samples:
    """Shape (H, W, channels, bytes), the highest byte first; a view of contiguous big-endian."""
    size = samples.dtype.itemsize
    big = np.ascontiguousarray(samples, f">u{size}")
    return big.view(np.uint8).reshape(*samples.shape[:2], channels, size)
