"""Digests of the blocks of images that a redaction left as they were (spec/index.md)."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable, Iterator
from typing import Any

import numpy as np

from mp4ds.messages import png
from mp4ds.messages.encodings import Encoding, Pixels
from mp4ds.messages.wire import CodedFields, ImageFields, Parts

SIDE = 64
"""Columns and rows of a block; those at the right and at the bottom may have fewer."""

Rectangle = tuple[int, int, int, int]
"""x, y, width and height in pixels of the image."""
Image = tuple[Encoding, Pixels]
_Digests = list[Any]


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
