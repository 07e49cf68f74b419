"""Depth images: ROS's compressedDepth, as PNG or RVL."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import Refused
from mp4ds.messages import png
from mp4ds.messages.encodings import MAX_IMAGE_BYTES, check_size

_HEADER = struct.Struct("<II")
_WORD_BYTES, _WORD_NIBBLES = 4, 8
_MAX_GROUPS = 11  # 33 bits: what a count or a difference takes at most

Depth = NDArray[np.uint16]
_Numbers = NDArray[np.int64]


def decode_rvl(data: bytes | memoryview) -> Depth:
    """Decode an RVL image.

    Args:
        data: Header and words, nothing after them.

    Returns:
        uint16 array of shape (rows, cols).

    Raises:
        Refused: It is not RVL, is cut short, or declares more pixels than it codes.
    """
    if len(data) < _HEADER.size or len(data) % _WORD_BYTES:
        raise Refused("it is not RVL: it has no whole number of words")
    columns, rows = _HEADER.unpack_from(data)
    check_size(columns, rows)
    if 2 * columns * rows > MAX_IMAGE_BYTES:
        raise Refused(f"its RVL image has {columns}x{rows} pixels")
    octets = np.frombuffer(data, "<u4", offset=_HEADER.size).astype(">u4").view(np.uint8)
    numbers = _read_numbers(np.stack((octets >> 4, octets & 15), axis=1).ravel())
    starts, lengths, first = _read_runs(numbers, columns * rows)
    # every number that is not a count is a difference
    is_difference = np.ones(first[-1] if len(first) else 0, bool)
    is_difference[first[:-1]] = False
    is_difference[first[:-1] + 1] = False
    zigzag = numbers[: len(is_difference)][is_difference]
    values = np.cumsum((zigzag >> 1) ^ -(zigzag & 1))
    if len(values) and (values.min() < 1 or values.max() > 0xFFFF):
        raise Refused("its RVL codes a depth beyond 16 bits")
    image = np.zeros(columns * rows, np.uint16)
    # all places of the runs, in order
    shifts = starts - (np.cumsum(lengths) - lengths)
    image[np.repeat(shifts, lengths) + np.arange(lengths.sum())] = values
    return image.reshape(rows, columns)


def encode_rvl(depth: Depth) -> bytes:
    """Encode an image of shape (rows, cols) as the reference does."""
    rows, columns = depth.shape
    flat = np.ascontiguousarray(depth).reshape(-1)
    filled = flat != 0
    edges = np.flatnonzero(np.diff(filled)) + 1
    bounds = np.concatenate(([0], edges, [len(flat)]))
    if filled[0]:
        bounds = np.concatenate(([0], bounds))  # the first count is of zeros
    if len(bounds) % 2 == 0:
        bounds = np.concatenate((bounds, [len(flat)]))  # and the last of what is not zero
    zeros, nonzeros = np.diff(bounds)[0::2], np.diff(bounds)[1::2]
    values = flat[filled].astype(np.int64)
    differences = np.diff(values, prepend=0)
    # each run's two counts are before its differences
    numbers = np.empty(len(values) + 2 * len(zeros), np.int64)
    first = np.cumsum(nonzeros) - nonzeros + 2 * np.arange(len(zeros))
    is_difference = np.ones(len(numbers), bool)
    is_difference[first] = is_difference[first + 1] = False
    numbers[first], numbers[first + 1] = zeros, nonzeros
    numbers[is_difference] = (differences << 1) ^ (differences >> 63)
    nibbles = _write_numbers(numbers)
    nibbles = np.pad(nibbles, (0, -len(nibbles) % _WORD_NIBBLES))
    octets = nibbles[0::2] << 4 | nibbles[1::2]
    return _HEADER.pack(columns, rows) + octets.view(">u4").astype("<u4").tobytes()


def _read_numbers(nibbles: NDArray[np.uint8]) -> _Numbers:
    """The numbers that nibbles code; ones cut off at the end are left out."""
    ends = np.flatnonzero(nibbles < 8)
    if not len(ends):
        raise Refused("its RVL codes no number")
    starts = np.concatenate(([0], ends[:-1] + 1))
    lengths = ends - starts + 1
    groups = int(lengths.max())
    if groups > _MAX_GROUPS:
        raise Refused("its RVL codes a number beyond 32 bits")
    numbers: _Numbers = (nibbles[starts] & 7).astype(np.int64)
    longer = np.arange(len(numbers))
    for group in range(1, groups):
        longer = longer[lengths[longer] > group]
        numbers[longer] |= (nibbles[starts[longer] + group] & 7).astype(np.int64) << 3 * group
    return numbers


def _write_numbers(numbers: _Numbers) -> NDArray[np.uint8]:
    lengths = np.ones(len(numbers), np.int64)
    bits = 3
    while (beyond := numbers >> bits > 0).any():
        lengths += beyond
        bits += 3
    ends = np.cumsum(lengths)
    starts = ends - lengths
    nibbles = np.empty(int(ends[-1]), np.uint8)
    longer = np.arange(len(numbers))
    for group in range(int(lengths.max())):
        longer = longer[lengths[longer] > group]
        nibbles[starts[longer] + group] = (numbers[longer] >> 3 * group & 7) | 8
    nibbles[ends - 1] &= 7
    return nibbles


def _read_runs(numbers: _Numbers, pixels: int) -> tuple[_Numbers, _Numbers, _Numbers]:
    """Runs of non-zero pixels, and the positions of their counts.

    Returns:
        First pixel and length of each run, and the place of its counts among the numbers, with
        the number of numbers used after the last.
    """
    counts = numbers.tolist()
    starts: list[int] = []
    lengths: list[int] = []
    places: list[int] = []
    place = pixel = 0
    while pixel < pixels:
        if place + 1 >= len(counts):
            raise Refused("its RVL is cut short")
        zeros, nonzeros = counts[place], counts[place + 1]
        places.append(place)
        starts.append(pixel + zeros)
        lengths.append(nonzeros)
        pixel += zeros + nonzeros
        place += 2 + nonzeros
    if pixel > pixels or place > len(counts):
        raise Refused("its RVL codes another number of pixels than it promises")
    places.append(place)
    return np.array(starts), np.array(lengths), np.array(places)


# ---------------------------------------------------------------- depth

HEADER_BYTES = 12
DEPTHS = ("16UC1", "mono16", "32FC1")
"""Encodings of depth images: of 16 bits in millimetres, of floats in metres (REP 118)."""

_PARAMETERS = slice(4, HEADER_BYTES)  # of quantised inverse depths, in the header: two floats


def told_encoding(format_: str | None) -> str:
    """The encoding at the beginning of a message's field ``format``."""
    return (format_ or "").partition(";")[0].strip()


def is_depth(format_: str | None, header: bytes) -> bool:
    """Whether an image is one of compressedDepth.

    Args:
        format_: Field ``format`` of its message.
        header: What is before the file in its data.
    """
    return bool(header) or "compressedDepth" in (format_ or "")


def is_quantised(format_: str | None, header: bytes) -> bool:
    """Whether it `is_depth` and holds inverse metres, quantised to 16 bits."""
    return is_depth(format_, header) and told_encoding(format_) == "32FC1"


def metres_of(pixels: NDArray[Any], header: bytes = b"") -> NDArray[np.float32]:
    """Depths in metres, shape (H, W); where there is none 0 or NaN, as recorded.

    Args:
        pixels: Of one of `DEPTHS`, shape (H, W).
        header: Of an image that `is_quantised`; empty for others.
    """
    if not header:
        per_metre = np.float32(1 if pixels.dtype.kind == "f" else 1000)
        made: NDArray[np.float32] = np.divide(pixels, per_metre, dtype=np.float32)
        return made
    a, b = np.frombuffer(header[_PARAMETERS], "<f4")
    with np.errstate(all="ignore"):  # as compressed_depth_image_transport computes them
        made = a / (pixels.astype(np.float32) - b)
    made[pixels == 0] = np.nan
    return made


def decode_depth(
    data: bytes | memoryview, hint: png.PngRecipe | None = None
) -> tuple[bytes, Depth, png.PngRecipe | None]:
    """Unpack the data of a message whose bytes can be made again, which is tried.

    Whether it is PNG or RVL is told by the content: formats such as ``16UC1; compressedDepth``
    do not say it.

    Args:
        data: The message's data.
        hint: Recipe of another image of the same topic.

    Returns:
        The header of twelve bytes, or none where an image stands without one; the values as they
        are coded, shape (H, W); and how the PNG is made again, None for RVL.

    Raises:
        Refused: It is neither, damaged, not of 16 bits, or does not rebuild.
    """
    view = memoryview(data)
    start = 0 if bytes(view[:8]) == png.SIGNATURE else HEADER_BYTES
    header, body = bytes(view[:start]), view[start:]
    if bytes(body[:8]) == png.SIGNATURE:
        pixels, recipe = png.decode(body, hint)
        if pixels.dtype != np.uint16 or pixels.ndim != 2:
            raise Refused("its depth image is not grey with 16 bits")
        return header, pixels.astype(np.uint16, copy=False), recipe
    depth = decode_rvl(body)
    if encode_rvl(depth) != body:
        raise Refused("its RVL does not rebuild byte for byte")
    return header, depth, None
