"""Placement of pixel values in the planes of a picture; numpy only."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mp4ds.messages.encodings import Encoding, Parameters, Pixels, Samples, Whole, native

Picture = tuple[Samples, ...]
"""What the video holds: one array (rows, columns[, channels]), or one per plane."""


class Arrangement(Protocol):
    """A bijection between an array of samples and a picture."""

    def pixel_format(self, bits: int) -> str:
        """FFmpeg's name of the picture's format, for samples of that many bits."""

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
    """Four half-size pictures, one per position in the 2 x 2 block, in a 2 x 2 grid.

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
    """The channels of an image, stacked vertically.

    Attributes:
        channels: Number of channels.
    """

    channels: int

    def pixel_format(self, bits: int) -> str:
        """Grey."""
        return _gray(bits)

    def picture_size(self, width: int, height: int) -> tuple[int, int]:
        """Height times the number of channels."""
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
    """High bits over folded low bits, which are inverted where the high bits are odd.

    So the low bits stay continuous where a slope carries into the high bits, and their noise does
    not hide the high bits from prediction.

    Attributes:
        bits: Of a sample, at most 16.
        low: Number of low bits, at most 8.
        first: Arrangement applied to the samples first, into one array.
    """

    bits: int
    low: int
    first: Mosaic | Packed = Packed()

    @property
    def _mask(self) -> int:
        return (1 << self.low) - 1

    def pixel_format(self, bits: int) -> str:
        """Grey, with as many bits as the high bits need."""
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
        """All low bits set where the high bits are odd, else 0."""
        folds: Samples = (high & 1) * high.dtype.type(self._mask)
        return folds


@dataclass(frozen=True, slots=True)
class Bytes:
    """A picture for each byte of 32- or 64-bit samples, highest first: two or four side by side.

    In two rows, with channels stacked. So each slice of the codec has bytes of one kind, and the
    smooth high bytes do not share statistics with the low ones.

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


# ---------------------------------------------------------------- chroma

CHROMA_SHIFTS = {"yuv420p": (1, 1), "yuv422p": (1, 0), "yuv444p": (0, 0)}
"""Planar pixel formats: how often width and height of the chroma planes are halved."""


@dataclass(frozen=True, slots=True)
class Packed422:
    """Planes Y, U and V, from two-byte pixels that share U and V with a neighbour.

    Attributes:
        luma: Which of the two bytes is Y; in the other, U and V alternate.
    """

    luma: int

    def pixel_format(self, bits: int) -> str:
        """Chroma of half the width."""
        return "yuv422p"

    def picture_size(self, width: int, height: int) -> tuple[int, int]:
        """The same."""
        return width, height

    def luma_rows(self, samples: Samples) -> int:
        """Rows of the image."""
        return int(samples.shape[0])

    def arrange(self, samples: Samples) -> Picture:
        """Views."""
        chroma = samples[..., 1 - self.luma]
        return samples[..., self.luma], chroma[:, 0::2], chroma[:, 1::2]

    def restore(self, picture: Picture, samples: Samples) -> None:
        """Copy."""
        for plane, target in zip(picture, self.arrange(samples), strict=True):
            target[...] = plane


@dataclass(frozen=True, slots=True)
class SemiPlanar:
    """Planes Y, U and V, from a Y plane above a plane of alternating U and V.

    Attributes:
        halved: Whether chroma has half the width and height (nv12, nv21), or the full size (nv24).
        first: Which comes first, ``u`` or ``v``.
    """

    halved: bool
    first: str

    def pixel_format(self, bits: int) -> str:
        """By the chroma's size."""
        return "yuv420p" if self.halved else "yuv444p"

    def picture_size(self, width: int, height: int) -> tuple[int, int]:
        """The same."""
        return width, height

    def arrange(self, samples: Samples) -> Picture:
        """Views if rows are contiguous."""
        height = self.luma_rows(samples)
        both = samples[height:].reshape(height >> self.halved, -1, 2)
        u = 0 if self.first == "u" else 1
        return samples[:height], both[..., u], both[..., 1 - u]

    def restore(self, picture: Picture, samples: Samples) -> None:
        """Copy."""
        height = self.luma_rows(samples)
        u = 0 if self.first == "u" else 1
        both = np.empty((*picture[1].shape, 2), samples.dtype)
        both[..., u], both[..., 1 - u] = picture[1], picture[2]
        samples[:height] = picture[0]
        samples[height:] = both.reshape(-1, samples.shape[1])

    def luma_rows(self, samples: Samples) -> int:
        """Rows of the image."""
        return int(samples.shape[0] * 2 // 3 if self.halved else samples.shape[0] // 3)


@dataclass(frozen=True, slots=True)
class Halved:
    """Chroma averaged to half the width and height; not exact.

    The picture's sides are even; odd images repeat their last row and column.

    Attributes:
        full: The exact arrangement of the same encoding.
    """

    full: Packed422 | SemiPlanar

    def pixel_format(self, bits: int) -> str:
        """The format that every lossy encoder supports."""
        return "yuv420p"

    def picture_size(self, width: int, height: int) -> tuple[int, int]:
        """Even."""
        return width + width % 2, height + height % 2

    @property
    def _shifts(self) -> tuple[int, int]:
        """How often the chroma of the encoding itself is halved."""
        return CHROMA_SHIFTS[self.full.pixel_format(8)]

    def arrange(self, samples: Samples) -> Picture:
        """A copy."""
        luma, *chroma = self.full.arrange(samples)
        height, width = luma.shape
        across, down = (not shift for shift in self._shifts)
        return (
            np.pad(luma, ((0, height % 2), (0, width % 2)), mode="edge"),
            *(_mean(plane, down=down, across=across) for plane in chroma),
        )

    def restore(self, picture: Picture, samples: Samples) -> None:
        """Copy; chroma samples are repeated."""
        height, width = self.full.luma_rows(samples), samples.shape[1]
        across, down = self._shifts
        planes = [picture[0][:height, :width]]
        for plane in picture[1:]:
            tall = plane if down else np.repeat(plane, 2, axis=0)
            wide = tall if across else np.repeat(tall, 2, axis=1)
            planes.append(wide[: height >> down, : width >> across])
        self.full.restore(tuple(planes), samples)


def _mean(plane: Samples, *, down: bool, across: bool) -> Samples:
    """The rounded mean of two rows, two columns or both; odd sizes repeat the last one."""
    pad = ((0, down and plane.shape[0] % 2), (0, across and plane.shape[1] % 2))
    total = np.pad(plane, pad, mode="edge").astype(np.uint16)
    if down:
        total = total[0::2] + total[1::2]
    if across:
        total = total[:, 0::2] + total[:, 1::2]
    halvings = down + across
    return ((total + halvings) >> halvings).astype(np.uint8)


# ---------------------------------------------------------------- palette

FEWEST_ENTRIES, MOST_ENTRIES = 256, 4096
"""Bounds of a list's length, which is a power of two."""

_ROOM = 3 / 2  # entries per value of a sample image


def _values(samples: Samples) -> Samples:
    """The patterns that occur, increasing."""
    if samples.dtype.itemsize > 2:
        return np.unique(samples)
    occurs = np.zeros(65536, bool)
    occurs[samples] = True
    return np.flatnonzero(occurs).astype(np.uint16)


@dataclass(frozen=True, slots=True)
class Few:
    """Samples like those of `Whole`, with a limited number of different values.

    Attributes:
        whole: Maps each sample.
        entries: Maximum number of values of an image.
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
        """Allow for half as many values again; integers must be sparse."""
        most = 0
        for pixels in samples:
            if len(_values(native(pixels)[::8, ::8])) > MOST_ENTRIES / _ROOM:
                return None
            values = _values(Whole(encoding).encode(pixels))
            if not encoding.is_float and int(values[-1]) - int(values[0]) + 1 < 2 * len(values):
                return None  # a plain picture hardly has more
            most = max(most, len(values))
        entries = FEWEST_ENTRIES
        while entries < most * _ROOM:
            entries *= 2
        return Parameters(entries=entries) if entries <= MOST_ENTRIES else None


@dataclass(frozen=True, slots=True)
class Palette:
    """The index of each sample in a list, and the list itself below.

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
        """Taller by the list."""
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
        """Copy; indices beyond the list, from a damaged video, mean its last entry."""
        height, width = samples.shape
        _, upper = self._numbers.picture_size(width, height)
        numbers = np.empty((height, width), np.uint8 if self.entries <= 256 else np.uint16)
        self._numbers.restore((picture[0][:upper],), numbers)
        listed = picture[0][upper:].reshape(-1)[: self.entries * self.size]
        entries = np.ascontiguousarray(listed.reshape(self.size, -1).T).view(f">u{self.size}")
        samples[...] = np.take(entries.ravel(), numbers, mode="clip")
