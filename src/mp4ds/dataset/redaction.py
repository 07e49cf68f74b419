"""What to redact in images, what becomes of their pixels, and the proof that others stayed."""

from __future__ import annotations

import hashlib
import math
import operator
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import OptionError
from mp4ds.files.urls import location
from mp4ds.format.sidecars import LEAST_SQUARE, PROVEN_TOGETHER, Rule, load_rules
from mp4ds.messages import png
from mp4ds.messages.encodings import Encoding, Pixels
from mp4ds.messages.wire import CodedFields, ImageFields, Parts

Rectangle = tuple[int, int, int, int]
"""x, y, width and height in pixels of the image."""


@dataclass(frozen=True, slots=True)
class Box:
    """A part of an image, and what becomes of it.

    Attributes:
        x: Columns to its left, pixels; a fraction is rounded so that the box gets larger.
        y: Rows above it.
        width: Its columns.
        height: Its rows.
        fill: A value for all its samples, or a value per channel, in the order red, green, blue
            where they are colours.
        blur: Side of the squares that get their mean, pixels, at least 8; None to fill it.
    """

    x: float
    y: float
    width: float
    height: float
    fill: float | Sequence[float] = 0
    blur: int | None = None


Find = Callable[[str, int, Pixels], Iterable[Box | Sequence[float]]]
"""Finds what to redact in an image: topic, log time in ns, and pixels -> boxes, or x, y, width and
height of those to fill with 0."""


@dataclass(frozen=True)
class Redaction:
    """What to redact.

    Attributes:
        name: Of the file, or of the function.
        sha256: Of the file; None of a function.
        text: The file, if manifests are to have it.
        rules: Of the file.
        find: The function.
        proof: Changed images of which untouched blocks are proven together; 0 for no proof.
    """

    name: str
    sha256: str | None = None
    text: str | None = None
    rules: Sequence[Rule] = ()
    find: Find | None = None
    proof: int = PROVEN_TOGETHER

    def __str__(self) -> str:  # as the note of a plan has it: a file may have moved
        return f"rules with SHA-256 {self.sha256}" if self.sha256 else f"function {self.name}"

    def called(self, number: int) -> str:
        """A rule as errors call it, by its number from 0."""
        return f"{self.name}: rule {number + 1} ({self.rules[number].topic})"

    @property
    def told(self) -> dict[str, str]:
        """What a manifest says of it."""
        return {"rules_sha256": self.sha256} if self.sha256 else {"function": self.name}


def parse_redaction(value: Redaction | Find | Path | str) -> Redaction:
    """The redaction by a function, or by the rules of a file.

    Raises:
        OptionError: The file cannot be read, or is not valid; says where.
    """
    if isinstance(value, Redaction):
        return value
    if callable(value):
        kind = value if hasattr(value, "__qualname__") else type(value)
        return Redaction(f"{kind.__module__}:{kind.__qualname__}", find=value)
    place = location(value)
    found, data = load_rules(place)
    return Redaction(
        str(place),
        hashlib.sha256(data).hexdigest(),
        data.decode() if found.keep_rules else None,
        tuple(found.rules),
        proof=found.proof,
    )


# ---------------------------------------------------------------- pixels


def placed(
    box: Box, encoding: Encoding, size: tuple[int, int], *, widened: bool
) -> Rectangle | None:
    """Where a box is in an image.

    Args:
        box: The box.
        encoding: Of the image.
        size: Its width and height.
        widened: Limit it to the image, and widen it to whole pixels, to all that share their
            colours with some in it, and to the least square of a blur; None if it is outside.

    Raises:
        OptionError: It is not as it would be made by `widened`; says what is wrong.
    """
    numbers = box.x, box.y, box.width, box.height
    if not all(map(math.isfinite, numbers)) or min(box.width, box.height) <= 0:
        raise OptionError(f"box {list(numbers)} has no area")
    ends = []
    for start, length, side, step in zip(
        numbers[:2], numbers[2:], size, encoding.even, strict=True
    ):
        first = max(0, math.floor(start) // step * step)
        last = min(side, -(-math.ceil(start + length) // step) * step)
        if box.blur is not None and first < last < first + LEAST_SQUARE:
            first = max(0, min(first, side - LEAST_SQUARE))
            last = min(side, first + LEAST_SQUARE)
        ends.append((first, last - first))
    (x, width), (y, height) = ends
    made = x, y, width, height
    if widened:
        return made if min(width, height) > 0 else None
    if box.blur is not None and min(box.width, box.height) < LEAST_SQUARE:
        raise OptionError(
            f"box {list(numbers)} is smaller than {LEAST_SQUARE}x{LEAST_SQUARE} pixels: give fill"
        )
    if numbers[0] + numbers[2] > size[0] or numbers[1] + numbers[3] > size[1]:
        raise OptionError(f"box {list(numbers)} is not inside the {size[0]}x{size[1]} image")
    if made != numbers:
        raise OptionError(
            f"box {list(numbers)} cuts through pixels that share their chroma: in {encoding.name} "
            f"images, use {list(made)}"
        )
    return made


def check_change(box: Box, encoding: Encoding, *, is_depth: bool) -> None:
    """Refuse what cannot become of a part of an image.

    Raises:
        OptionError: Says why.
    """
    if box.blur is None:
        _values(encoding, box.fill, 0, 0, 0)
    elif is_depth:
        raise OptionError(
            f"blur of {encoding.name} images would make up distances: give fill, where 0 is none"
        )
    elif operator.index(box.blur) < LEAST_SQUARE:
        raise OptionError(f"blur {box.blur} is below {LEAST_SQUARE}")


def regions(encoding: Encoding, pixels: Pixels, part: Rectangle) -> list[Pixels]:
    """Views of the pixels of a part of an image; of semi-planar YUV, of its luma and its chroma.

    Args:
        encoding: Of the image.
        pixels: Contiguous, of `Encoding.shape`.
        part: Of the image, with sides that the encoding's `even` divides.
    """
    x, y, width, height = part
    rows = int(pixels.shape[0] / encoding.rows)
    found = [pixels[y : y + height, x : x + width]]
    if encoding.rows == 3:
        found.append(pixels[rows:].reshape(rows, -1)[y : y + height, 2 * x : 2 * (x + width)])
    elif encoding.rows != 1:
        found.append(pixels[rows + y // 2 : rows + (y + height) // 2, x : x + width])
    return found


def redact(pixels: Pixels, encoding: Encoding, box: Box, part: Rectangle) -> None:
    """Change a part of an image.

    Args:
        pixels: Contiguous, in native byte order.
        encoding: Of the image.
        box: What becomes of it.
        part: Where it is; see `placed`.
    """
    x, y, *_ = part
    for number, region in enumerate(regions(encoding, pixels, part)):
        # samples of one colour are this many rows and columns apart
        is_packed = encoding.rows == 1 and encoding.even != (1, 1)
        down = 2 if encoding.mosaic else 1
        across = 2 if encoding.mosaic or number or is_packed else 1
        for row in range(down):
            for column in range(across):
                own = region[row::down, column::across]
                if box.blur:
                    _pixelate(own, box.blur // down, box.blur // across)
                else:
                    phase = (y + row) % down, (column if number else x + column) % across
                    own[...] = _values(encoding, box.fill, number, *phase)


def _pixelate(pixels: Pixels, rows: int, columns: int) -> None:
    """Give each rectangle of so many rows and columns its mean; the last ones have what remains."""
    height, width = pixels.shape[:2]
    if not pixels.size:
        return
    # a rectangle of its own for the rest might be a single pixel, which is its own mean
    tops, lefts = (
        np.arange(max(1, length // side)) * min(side, length)
        for length, side in ((height, rows), (width, columns))
    )
    sums = np.add.reduceat(np.add.reduceat(pixels.astype(np.float64), tops, 0), lefts, 1)
    heights, widths = np.diff(tops, append=height), np.diff(lefts, append=width)
    areas = np.outer(heights, widths)
    means = sums / (areas if sums.ndim == 2 else areas[..., None])
    if pixels.dtype.kind != "f":
        means = np.rint(means)
    pixels[...] = means.repeat(heights, 0).repeat(widths, 1)


def _values(
    encoding: Encoding, fill: float | Sequence[float], number: int, row: int, column: int
) -> NDArray[Any]:
    """The samples of a filled pixel.

    Args:
        encoding: Of the image.
        fill: As of a box.
        number: Of its region.
        row: Its number modulo that of rows between those of one colour.
        column: As of rows.

    Raises:
        OptionError: They do not exist.
    """
    name, channels = encoding.name, encoding.channels
    is_yuv = encoding.even != (1, 1) or encoding.rows != Fraction(1)
    is_coloured = is_yuv or bool(encoding.mosaic) or name[:3] in ("rgb", "bgr")
    due = 3 if is_coloured else channels
    colour = list(fill) if isinstance(fill, Sequence) else [fill] * due
    if len(colour) != due:
        numbers = f"{due} values" if due > 1 else "a single value"
        raise OptionError(f"fill {colour} does not fit: {name} images need {numbers}")
    wanted = np.array(colour, np.float64)
    bounds: Any = (np.finfo if encoding.is_float else np.iinfo)(encoding.dtype)
    low, high = (0, 255) if is_yuv else (bounds.min, bounds.max)
    fits = (wanted >= low) & (wanted <= high)
    fits = fits | ~np.isfinite(wanted) if encoding.is_float else fits & (wanted == np.rint(wanted))
    if not fits.all():
        shown = f"{fill:g}" if isinstance(fill, float) else fill
        raise OptionError(f"fill {shown} is out of range for {name} images ({low} to {high})")
    made: Any = colour
    if is_yuv:
        matrix = [[65.481, 128.553, 24.966], [-37.797, -74.203, 112.0], [112.0, -93.786, -18.214]]
        y, u, v = np.rint(np.array(matrix) @ np.array(colour, float) / 255 + [16, 128, 128])
        chroma = ((v, u) if name == "nv21" else (u, v))[column % 2]
        if encoding.rows != 1:
            made = chroma if number else y
        else:
            made = [chroma, y] if name in ("uyvy", "yuv422") else [y, chroma]
    elif encoding.mosaic:
        made = colour["rgb".index(encoding.mosaic[2 * row + column])]
    elif name[:3] in ("rgb", "bgr"):
        made = colour[::-1] if name.startswith("bgr") else colour
        made = [*made, bounds.max][:channels] if channels == 4 else made
    elif channels == 1:
        made = colour[0]
    return np.array(made, np.float64).astype(encoding.dtype)


# ---------------------------------------------------------------- proof (spec/index.md)

SIDE = 64
"""Columns and rows of a block; those at the right and at the bottom may have fewer."""

Image = tuple[Encoding, Pixels]
_Digests = list[Any]


def holds_pixels(parts: Parts) -> bool:
    """Whether a message has every sample of its image: it is raw, a PNG or a compressed depth."""
    if isinstance(parts.fields, ImageFields):
        return True
    is_depth = isinstance(parts.fields, CodedFields) and "compressedDepth" in parts.fields.format
    return is_depth or bytes(parts.body[: len(png.SIGNATURE)]) == png.SIGNATURE


def _grid(image: Image) -> tuple[int, int, int, int]:
    """Columns and rows of blocks, width and height of the image."""
    encoding, pixels = image
    width, height = pixels.shape[1], int(pixels.shape[0] / encoding.rows)
    return -(-width // SIDE), -(-height // SIDE), width, height


def _add(image: Image, digests: _Digests) -> None:
    """Add an image to the digests of its blocks; None stands for a block that is left out."""
    columns, _, width, height = _grid(image)
    encoding, pixels = image
    plain = np.ascontiguousarray(pixels, pixels.dtype.newbyteorder("<"))
    for number, digest in enumerate(digests):
        if digest is not None:
            y, x = (SIDE * place for place in divmod(number, columns))
            part = x, y, min(SIDE, width - x), min(SIDE, height - y)
            for region in regions(encoding, plain, part):
                digest.update(region.tobytes())


def _summed(digests: _Digests) -> str:
    kept = (digest.digest() for digest in digests if digest is not None)
    return hashlib.sha256(b"".join(kept)).hexdigest()


class UntouchedBlocks:
    """Digests of what a redaction leaves as it was, made while the images pass.

    Args:
        changed: Changed images of a span: those of one are proven together.
    """

    def __init__(self, changed: int) -> None:
        self._most = changed
        self._lines: list[str] = []
        self._kind: object = None
        self._digests: _Digests = []
        self._frames = self._changed = 0

    def add(self, image: Image, parts: Collection[Rectangle]) -> None:
        """Add an image as recorded, and what of it will be changed."""
        columns, rows, *size = _grid(image)
        if (kind := (image[0].name, *size)) != self._kind or self._changed == self._most:
            self._end()
            self._kind, self._digests = kind, [hashlib.sha256() for _ in range(columns * rows)]
        for x, y, width, height in parts:
            for row in range(y // SIDE, -(-(y + height) // SIDE)):
                for column in range(x // SIDE, -(-(x + width) // SIDE)):
                    self._digests[row * columns + column] = None
        self._frames += 1
        self._changed += bool(parts)
        _add(image, self._digests)

    def _end(self) -> None:
        if self._frames:
            kept = np.packbits([digest is not None for digest in self._digests]).tobytes()
            self._lines.append(f"{self._frames} {kept.hex()} {_summed(self._digests)}\n")
        self._frames = self._changed = 0

    @property
    def values(self) -> str:
        """A line per span: number of images, bits of untouched blocks, and their digest."""
        self._end()
        self._kind = None
        return "".join(self._lines)


def differences(values: str, images: Iterable[Image]) -> Iterator[str]:
    """What of images is not as it was, in words.

    Args:
        values: As `UntouchedBlocks.values`.
        images: All that have been added there, with what was changed.
    """
    remaining, first = iter(images), 0
    for line in values.splitlines():
        count, bits, due = line.split(" ")
        digests: _Digests = []
        for number in range(int(count)):
            image = next(remaining, None)
            if image is None:
                yield f"has {first + number} images, but its digests are of more"
                return
            if not number:
                columns, rows, *_ = _grid(image)
                kept = np.unpackbits(np.frombuffer(bytes.fromhex(bits), np.uint8))
                if len(kept) != -(-columns * rows // 8) * 8:
                    yield f"has digests of another number of blocks than image {first}"
                    return
                digests = [hashlib.sha256() if bit else None for bit in kept[: columns * rows]]
            _add(image, digests)
        if _summed(digests) != due:
            last = first + int(count) - 1
            yield f"has blocks in images {first} to {last} that are not as they were recorded"
        first += int(count)
    if next(remaining, None) is not None:
        yield f"has more images than the {first} of its digests"
