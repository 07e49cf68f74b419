"""How the pixels of a ROS image become the picture in a video, and back.

A picture is the encoder's input, in one of FFmpeg's pixel formats; the codec is not chosen here. A
layout is a step on the values (`mp4ds.messages.encodings`) and an arrangement of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from itertools import product

import numpy as np

from mp4ds.errors import OptionError
from mp4ds.messages.encodings import (
    ENCODINGS,
    MAX_ROW_PADDING,
    MAX_SIDE,
    NO_PARAMETERS,
    Arrangement,
    Encoding,
    LayoutParameters,
    Narrow,
    NarrowFolded,
    Opaque,
    Picture,
    Pixels,
    Prediction,
    Samples,
    Values,
    Whole,
    add_prediction,
    difference,
    patterns,
)
from mp4ds.messages.numbers import Few, Metres, Palette, PatternTable, Tone
from mp4ds.messages.sources import Converted, ConvertedTall, Demosaiced
from mp4ds.messages.wire import ImageFields

# ---------------------------------------------------------------- arrangements


@dataclass(frozen=True, slots=True)
class Packed(Arrangement):
    """The array itself.

    Attributes:
        packed_format: Pixel format; empty: grey.
    """

    packed_format: str = ""

    def pixel_format(self, bits: int) -> str:
        """Its own or grey."""
        return self.packed_format or Arrangement.pixel_format(self, bits)

    def arrange(self, samples: Samples) -> Picture:
        """A view."""
        return (samples,)


@dataclass(frozen=True, slots=True)
class Mosaic(Arrangement):
    """Four half-size pictures, one per position in the 2 x 2 block, in a 2 x 2 grid.

    Neighbours then hold the same colour, which is what predictors expect. An odd last row or
    column of a tile repeats its neighbour.
    """

    def picture_size(self, width: int, height: int) -> tuple[int, int]:
        """Even."""
        return width + width % 2, height + height % 2

    def arrange(self, samples: Samples) -> Picture:
        """A copy."""
        width, height = self.picture_size(samples.shape[1], samples.shape[0])
        picture = np.empty((height, width), samples.dtype)
        for tile, part in self._tiles(picture, samples):
            if not part.size:
                part = samples[:1, :1]
            missing = np.subtract(tile.shape, part.shape)
            tile[...] = np.pad(part, [(0, n) for n in missing], "edge") if any(missing) else part
        return (picture,)

    def restore(self, picture: Picture, samples: Samples) -> None:
        """Copy."""
        for tile, part in self._tiles(picture[0], samples):
            part[...] = tile[: part.shape[0], : part.shape[1]]

    def _tiles(self, picture: Samples, samples: Samples) -> Iterator[tuple[Samples, Samples]]:
        """Views of each tile, and of the samples in it."""
        height, width = picture.shape
        tiles = picture.reshape(2, height // 2, 2, width // 2)
        for row, column in product((0, 1), (0, 1)):
            yield tiles[row, :, column], samples[row::2, column::2]


@dataclass(frozen=True, slots=True)
class PlanarRgb(Arrangement):
    """One plane per colour, in ffmpeg's order: G, B, R and alpha.

    Attributes:
        order: The channels of the image, such as ``bgra``.
    """

    order: str

    def pixel_format(self, bits: int) -> str:
        """By alpha and depth; there are none of 8 bits."""
        if bits == 8:
            raise ValueError("no layout has planes of 8 bits")
        return f"{'gbrap' if 'a' in self.order else 'gbrp'}{bits}le"

    def arrange(self, samples: Samples) -> Picture:
        """Views."""
        channels = map(self.order.index, "gbra"[: len(self.order)])
        return tuple(samples[..., channel] for channel in channels)


@dataclass(frozen=True, slots=True)
class Fold(Arrangement):
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
        return Arrangement.pixel_format(self, 8 if self.bits - self.low <= 8 else 10)

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
class Stack(Arrangement):
    """The channels of an image, stacked vertically; of large samples each byte, in two rows.

    These have two or four pictures side by side, highest byte first. So each slice of the codec has
    bytes of one kind, and the smooth high bytes do not share statistics with the low ones.

    Attributes:
        channels: Of the image.
        size: Bytes of a sample, 4 or 8; 1 for samples that stay whole.
    """

    channels: int
    size: int = 1

    @property
    def _grid(self) -> tuple[int, int]:
        """Rows and columns of pictures for each channel."""
        return (1, 1) if self.size == 1 else (2, self.size // 2)

    def pixel_format(self, bits: int) -> str:
        """Grey, 8 bits for each byte."""
        return Arrangement.pixel_format(self, bits if self.size == 1 else 8)

    def picture_size(self, width: int, height: int) -> tuple[int, int]:
        """Of all these pictures."""
        down, across = self._grid
        return across * width, self.channels * down * height

    def _tiles(self, picture: Samples, samples: Samples) -> Samples:
        """A picture as a view of shape (H, W, channels, rows of pictures, pictures in a row)."""
        (height, width), (down, across) = samples.shape[:2], self._grid
        return picture.reshape(self.channels, down, height, across, width).transpose(2, 4, 0, 1, 3)

    def _parts(self, samples: Samples) -> Samples:
        """Samples, contiguous and big-endian where each byte is a part, as a view of that shape."""
        parts = samples if self.size == 1 else samples.view(np.uint8)
        return parts.reshape(*samples.shape[:2], self.channels, *self._grid)

    def arrange(self, samples: Samples) -> Picture:
        """A copy."""
        width, height = self.picture_size(samples.shape[1], samples.shape[0])
        if self.size > 1:
            samples = np.ascontiguousarray(samples, f">u{self.size}")
        parts = self._parts(samples)
        picture = np.empty((height, width), parts.dtype)
        self._tiles(picture, samples)[...] = parts
        return (picture,)

    def restore(self, picture: Picture, samples: Samples) -> None:
        """Copy."""
        whole = samples if self.size == 1 else np.empty(samples.shape, f">u{self.size}")
        parts, tiles = self._parts(whole), self._tiles(picture[0], samples)
        for part in np.ndindex(parts.shape[2:]):  # a fifth of the time of all at once
            parts[(..., *part)] = tiles[(..., *part)]
        if whole is not samples:
            samples[...] = whole


# ---------------------------------------------------------------- chroma

CHROMA_SHIFTS = {"yuv420p": (1, 1), "yuv422p": (1, 0), "yuv444p": (0, 0)}
"""Planar pixel formats: how often width and height of the chroma planes are halved."""


@dataclass(frozen=True, slots=True)
class Packed422(Arrangement):
    """Planes Y, U and V, from two-byte pixels that share U and V with a neighbour.

    Attributes:
        luma: Which of the two bytes is Y; in the other, U and V alternate.
    """

    luma: int

    def pixel_format(self, bits: int) -> str:
        """Chroma of half the width."""
        return "yuv422p"

    def arrange(self, samples: Samples) -> Picture:
        """Views."""
        chroma = samples[..., 1 - self.luma]
        return samples[..., self.luma], chroma[:, 0::2], chroma[:, 1::2]


@dataclass(frozen=True, slots=True)
class SemiPlanar(Arrangement):
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

    def arrange(self, samples: Samples) -> Picture:
        """Views if rows are contiguous."""
        height = self._luma_rows(samples)
        both = samples[height:].reshape(height >> self.halved, -1, 2)
        u = 0 if self.first == "u" else 1
        return samples[:height], both[..., u], both[..., 1 - u]

    def restore(self, picture: Picture, samples: Samples) -> None:
        """Copy."""
        height = self._luma_rows(samples)
        u = 0 if self.first == "u" else 1
        both = np.empty((*picture[1].shape, 2), samples.dtype)
        both[..., u], both[..., 1 - u] = picture[1], picture[2]
        samples[:height] = picture[0]
        samples[height:] = both.reshape(-1, samples.shape[1])

    def _luma_rows(self, samples: Samples) -> int:
        """Rows of the image."""
        return int(samples.shape[0] * 2 // 3 if self.halved else samples.shape[0] // 3)


@dataclass(frozen=True, slots=True)
class Halved(Arrangement):
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
        height, width = self.full.arrange(samples)[0].shape
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


# ---------------------------------------------------------------- table


def _rgb_order(encoding: Encoding) -> str:
    """Unnamed channels are blue, green, red and alpha, as in OpenCV."""
    return encoding.name.rstrip("1680") if encoding.name[0] in "rb" else "bgra"[: encoding.channels]


def _yuv(encoding: Encoding) -> Packed422 | SemiPlanar:
    if encoding.name.startswith("nv"):
        return SemiPlanar(encoding.even[1] == 2, "v" if encoding.name == "nv21" else "u")
    return Packed422(1 if encoding.name in ("yuv422", "uyvy") else 0)


def _toned(encoding: Encoding) -> Packed:
    """As images of 8 bits are shown."""
    if encoding.mosaic:
        return Packed(f"bayer_{encoding.mosaic}8")
    return Packed("gray" if encoding.channels == 1 else f"{_rgb_order(encoding)}24")


def _fold(parameters: LayoutParameters, first: Mosaic | Packed = Packed()) -> Fold:
    return Fold(parameters.bits or 16, parameters.low or 8, first)


def _numbers(count: int) -> Arrangement:
    """Those of a list of so many entries; of more than a byte, they are folded."""
    return Packed() if count <= 256 else Fold(16, 8)


@dataclass(frozen=True, slots=True)
class LayoutKind:
    """A layout of the registry.

    Attributes:
        arrangement: Makes the placement of values.
        values: The step on them, which knows its parameters.
        is_exact: Whether the pixels are restored if the picture is.
        is_shown: Whether the picture looks like the image, so that its colours are tagged.
    """

    arrangement: Callable[[Encoding, LayoutParameters], Arrangement]
    values: type[Values] = Whole
    is_exact: bool = True
    is_shown: bool = False

    @property
    def parameters(self) -> frozenset[str]:
        """Names of all the parameters it needs."""
        return self.values.parameters


_shown = partial(LayoutKind, is_shown=True)
_COLOURS = {"rgba": "rgb24", "bgra": "bgr24"}  # without their alpha

LAYOUTS: dict[str, LayoutKind] = {
    "gray8": _shown(lambda e, p: Packed()),
    "gray16": LayoutKind(lambda e, p: Packed()),
    "gray_bits": LayoutKind(lambda e, p: Packed(), Narrow),
    "fold": LayoutKind(lambda e, p: _fold(p), NarrowFolded),
    "rgb24": _shown(lambda e, p: Packed("rgb24")),
    "bgr24": _shown(lambda e, p: Packed("bgr24")),
    "rgba": _shown(lambda e, p: Packed("rgba")),
    "bgra": _shown(lambda e, p: Packed("bgra")),
    "opaque": _shown(lambda e, p: Packed(_COLOURS[_rgb_order(e)]), Opaque),
    "gbr16": _shown(lambda e, p: PlanarRgb(_rgb_order(e))),
    "gbr_bits": _shown(lambda e, p: PlanarRgb(_rgb_order(e)), Narrow),
    "gbra16": _shown(lambda e, p: PlanarRgb(_rgb_order(e))),
    "gbra_bits": _shown(lambda e, p: PlanarRgb(_rgb_order(e)), Narrow),
    "mosaic8": LayoutKind(lambda e, p: Mosaic()),
    "mosaic16": LayoutKind(lambda e, p: Mosaic()),
    "mosaic_bits": LayoutKind(lambda e, p: Mosaic(), Narrow),
    "mosaic_fold": LayoutKind(lambda e, p: _fold(p, Mosaic()), NarrowFolded),
    "from_mosaic8": LayoutKind(lambda e, p: Mosaic(), Demosaiced),
    "from_yuv420": _shown(lambda e, p: SemiPlanar(halved=True, first="u"), ConvertedTall),
    "from_yuv422": _shown(lambda e, p: Packed422(0), Converted),
    # demosaicing is done by the video's converter; resampling restores the mosaic
    "demosaic8": _shown(lambda e, p: Packed(f"bayer_{e.mosaic}8"), is_exact=False),
    "tone": _shown(lambda e, p: _toned(e), Tone, is_exact=False),
    "planar422": _shown(lambda e, p: _yuv(e)),
    "planar420": _shown(lambda e, p: _yuv(e)),
    "planar444": _shown(lambda e, p: _yuv(e)),
    "halved420": _shown(lambda e, p: Halved(_yuv(e)), is_exact=False),
    "stack8": LayoutKind(lambda e, p: Stack(e.channels)),
    "stack16": LayoutKind(lambda e, p: Stack(e.channels)),
    "table": LayoutKind(lambda e, p: _numbers(len(p.table or ())), PatternTable),
    "palette": LayoutKind(
        lambda e, p: Palette(p.entries or 0, e.bytes_per_sample, _numbers(p.entries or 0)), Few
    ),
    "metres16": LayoutKind(lambda e, p: Packed(), Metres),
    "metres_fold": LayoutKind(lambda e, p: _fold(p), Metres),
    "bytes": LayoutKind(lambda e, p: Stack(e.channels, e.bytes_per_sample)),
}


# ---------------------------------------------------------------- layouts bound to encodings


@dataclass(frozen=True, slots=True)
class Layout:
    """A way of arranging a stream's pixels as pictures.

    Attributes:
        name: Its name in the registry.
        encoding: Of the images.
        parameters: Of the layout.
        is_exact: Whether the pixels are restored if the picture is.
        is_shown: Whether the picture looks like the image, so that its colours are tagged.
        pixel_format: ffmpeg's name of the picture's format.
        values: The step on values.
    """

    name: str
    encoding: Encoding
    parameters: LayoutParameters
    is_exact: bool
    is_shown: bool
    pixel_format: str
    values: Values = field(compare=False)  # the others say which, too
    _arrangement: Arrangement = field(compare=False)

    @property
    def used_bits(self) -> int:
        """Of each sample of the images, which may have zeros above."""
        if self.parameters.bits is not None:
            return self.parameters.bits + (self.parameters.shift or 0)
        return 8 * self.encoding.bytes_per_sample

    @property
    def is_source(self) -> bool:
        """Whether its samples are what the colours of the images were made of."""
        return self.values.is_source

    def picture_size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height of the image -> of the picture.

        Raises:
            ValueError: A side is odd, where the layout halves chroma.
        """
        across, down = CHROMA_SHIFTS.get(self.pixel_format, (0, 0))
        if self.is_exact and (width % (1 << across) or height % (1 << down)):
            raise ValueError(f"{width}x{height} pixels, where chroma needs even sides")
        return self._arrangement.picture_size(width, height)

    def to_picture(self, pixels: Pixels, prediction: Prediction | None = None) -> Picture:
        """The picture of accepted pixels; may be a view of them.

        Args:
            pixels: As `mp4ds.messages.encodings.pixel_view` gives them.
            prediction: The picture is of the difference to this.

        Returns:
            One array of shape (rows, columns) or (rows, columns, channels), or one per plane.
        """
        if prediction is not None and not self.is_source:
            pixels, prediction = difference(pixels, *prediction), None
        return self.arrange(self.values.encode(pixels), prediction)

    def arrange(self, samples: Samples, prediction: Prediction | None = None) -> Picture:
        """As `to_picture`, of what `Values.prove` gave."""
        if prediction is not None:
            samples = difference(samples, self.values.predicted(prediction[0]), prediction[1])
        return self._arrangement.arrange(samples)

    def to_pixels(
        self, picture: Picture, out: Pixels, prediction: Prediction | None = None
    ) -> None:
        """Write the pixels of a picture.

        Args:
            picture: Of the size and format of this layout.
            out: Shape `Encoding.shape`; its type is the encoding's, in any byte order.
            prediction: As for `to_picture`.
        """
        if self.values.is_identity:
            self._arrangement.restore(picture, patterns(out))
        else:
            samples = np.empty(self.values.shape(out), f"u{(self.values.bits + 7) // 8}")
            self._arrangement.restore(picture, samples)
            if prediction is not None and self.is_source:
                add_prediction(samples, self.values.predicted(prediction[0]), prediction[1])
            self.values.decode(samples, out)
        if prediction is not None and not self.is_source:
            add_prediction(out, *prediction)


def bind(name: str, encoding: Encoding, parameters: LayoutParameters = NO_PARAMETERS) -> Layout:
    """The layout with that name for the images of a stream.

    Args:
        name: One allowed for the encoding.
        encoding: Of the images.
        parameters: Exactly those that the layout needs.

    Raises:
        ValueError: The encoding does not allow it, or the parameters are not those it needs.
    """
    if name not in (*encoding.exact, encoding.lossy):
        raise ValueError(f"layout {name} does not carry {encoding.name} images")
    kind = LAYOUTS[name]
    if parameters.values.keys() != kind.parameters:
        needed = ", ".join(sorted(kind.parameters)) or "none"
        given = ", ".join(sorted(parameters.values)) or "none"
        raise ValueError(f"layout {name} needs the parameters {needed} and was given {given}")
    values = kind.values(encoding, parameters)
    arrangement = kind.arrangement(encoding, parameters)
    pixel_format = arrangement.pixel_format(values.bits)
    shown = kind.is_exact, kind.is_shown, pixel_format
    return Layout(name, encoding, parameters, *shown, values, arrangement)


def fit(name: str, encoding: Encoding, samples: Sequence[Pixels]) -> Layout | None:
    """The layout with parameters that suit samples of a stream, or None if there are none.

    Args:
        name: One allowed for the encoding.
        encoding: Of the images.
        samples: Pixels of some of its images, at least one.

    Returns:
        A layout that refuses none of the samples.
    """
    parameters = LAYOUTS[name].values.fit(encoding, samples)
    return None if parameters is None else bind(name, encoding, parameters)


def layout_for(encoding: Encoding, *, lossless: bool) -> Layout:
    """The layout that carries every image of an encoding, for a lossless or lossy codec.

    Raises:
        OptionError: There is no lossy layout, or it depends on the images.
    """
    name = encoding.general if lossless else encoding.lossy
    if name is None or LAYOUTS[name].parameters:
        raise OptionError(f"{encoding.name} images are only stored losslessly")
    return bind(name, encoding)


@lru_cache(maxsize=256)  # the images of a stream share one geometry
def why_not(image: ImageFields, size: int | None = None) -> str | None:
    """Why no layout carries an image, or None if one does.

    Args:
        image: Its fields.
        size: Bytes of all rows, the last of which may end with its pixels; None: as many as due.
    """
    width, height, step = image.width, image.height, image.step
    encoding = ENCODINGS.get(image.encoding)
    if encoding is None:
        return f"no layout for encoding {image.encoding!r} yet"
    if width == 0 or height == 0:
        return f"an image of {width}x{height} pixels"
    if step < width * encoding.pixel_bytes:
        return f"step {step} is shorter than a row of {width} {encoding.name} pixels"
    if width % encoding.even[0] or height % encoding.even[1]:
        return f"an image of {width}x{height} pixels, where {encoding.name} needs even sides"
    due = encoding.size(step, height)
    if size not in (None, due, due - (step - width * encoding.pixel_bytes)):
        rows = "step x height" if encoding.rows == 1 else f"step x height x {encoding.rows}"
        return f"{size} bytes of pixels where {rows} says {due}"
    if width > MAX_SIDE or height > MAX_SIDE:
        return f"an image of {width}x{height} pixels, beyond {MAX_SIDE}"
    size_of_picture = layout_for(encoding, lossless=True).picture_size(width, height)
    if max(size_of_picture) > MAX_SIDE:
        picture = "whose picture of {}x{}".format(*size_of_picture)
        return f"an image of {width}x{height} pixels, {picture} is beyond {MAX_SIDE}"
    if step > width * encoding.pixel_bytes + MAX_ROW_PADDING:
        return f"more than {MAX_ROW_PADDING} bytes of padding in a row"
    return None
