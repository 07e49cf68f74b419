"""PNG: unpacked into pixels and a recipe, from which the same file is rebuilt."""

from __future__ import annotations

import base64
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from mp4ds.errors import Refused
from mp4ds.messages.encodings import MAX_IMAGE_BYTES, check_size

Bytes = NDArray[np.uint8]
_Wide = NDArray[np.int16]

_NONE, _SUB, _UP, _AVERAGE, _PAETH = range(5)
_BAND_BYTES = 2**17  # of pixels filtered at once, to stay in the cache
BAND_BYTES = 2**26  # of pixels unfiltered at once


@dataclass(frozen=True, slots=True)
class Rule:
    """How an encoder chooses the filter of each row.

    Attributes:
        kinds: The filters to try, in order. The one whose bytes, taken as signed, have the smallest
            sum of absolute values is used; the first of equals.
        first: Filter of the first row, if it is always the same.
        weight: How much a filter's number adds to its sum.
        narrow: Whether filters are skipped for images of one row or column, as in libpng.
    """

    kinds: tuple[int, ...]
    first: int | None = None
    weight: int = 0
    narrow: bool = False


RULES = MappingProxyType(
    {
        "libpng": Rule((0, 1, 2, 3, 4), narrow=True),
        "libpng-fast": Rule((0, 1, 2), narrow=True),
        "pillow": Rule((0, 2, 1, 4)),
        "pillow-optimize": Rule((0, 2, 1, 3, 4)),
        "ffmpeg-mixed": Rule((0, 1, 2, 3, 4), first=_SUB, weight=1),
        **{str(kind): Rule((kind,)) for kind in range(5)},
        **{f"1,{kind}": Rule((kind,), first=_SUB) for kind in range(2, 5)},
    }
)
"""Name of a rule -> the rule. A number is the filter of all rows; after ``1,`` of the others."""


def unfilter(rows: Bytes, pixel_bytes: int) -> Bytes:
    """Undo the filters.

    Args:
        rows: Shape (H, 1 + bytes of a row): a filter number before each row.
        pixel_bytes: Bytes of a pixel.

    Returns:
        Shape (H, bytes of a row).

    Raises:
        Refused: A filter number is unknown.
    """
    kinds = rows[:, 0]
    if kinds.max() > _PAETH:
        raise Refused(f"its PNG uses the unknown filter {kinds.max()}")
    if kinds.max() <= _UP:
        return _unfilter_simple(rows, pixel_bytes)
    out = np.empty((rows.shape[0], rows.shape[1] - 1), np.uint8)
    above = np.zeros(out.shape[1], np.uint8)
    band = max(64, BAND_BYTES // (4 * out.shape[1]))
    for start in range(0, len(rows), band):
        part = out[start : start + band]
        _unfilter_front(rows[start : start + band], above, pixel_bytes, part)
        above = part[-1]
    return out


def _unfilter_simple(rows: Bytes, pixel_bytes: int) -> Bytes:
    """Undo filters that need at most one neighbour."""
    out: Bytes = rows[:, 1:].copy()
    kinds = rows[:, 0]
    subs = np.flatnonzero(kinds == _SUB)
    pixels = out[subs].reshape(len(subs), out.shape[1] // pixel_bytes, pixel_bytes)
    out[subs] = np.cumsum(pixels, axis=1, dtype=np.uint8).reshape(len(subs), out.shape[1])
    for row in np.flatnonzero(kinds == _UP):
        if row:
            out[row] += out[row - 1]
    return out


def _unfilter_front(rows: Bytes, above: Bytes, pixel_bytes: int, out: Bytes) -> None:
    """Undo any filters, along a front that moves over all rows at once.

    A pixel needs its left, upper, and upper left neighbours. Pixels on a front, whose column and
    row have the same sum, do not need each other.
    """
    height, width = len(rows), (rows.shape[1] - 1) // pixel_bytes
    steps = height + width - 1
    coded = np.zeros((steps, height, pixel_bytes), np.uint8)
    _slanted(coded, width)[...] = rows[:, 1:].reshape(height, width, pixel_bytes)
    # fronts[d + 2, y + 1] is the pixel (d - y, y); the row above is at y = -1
    fronts = np.zeros((steps + 2, height + 1, pixel_bytes), np.int16)
    fronts[1 : width + 1, 0] = above.reshape(width, pixel_bytes)
    kinds = rows[:, 0][:, None]
    paeth = kinds == _PAETH
    all_paeth, any_paeth = bool(paeth.all()), bool(paeth.any())
    take_left = np.isin(kinds, (_SUB, _AVERAGE)).astype(np.int16)
    take_above = np.isin(kinds, (_UP, _AVERAGE)).astype(np.int16)
    halve = (kinds == _AVERAGE).astype(np.int16)
    for step in range(steps):
        left, up = fronts[step + 1, 1:], fronts[step + 1, :-1]
        if any_paeth:
            predicted = _paeth(left, up, fronts[step, :-1])
        if not all_paeth:
            linear = (left * take_left + up * take_above) >> halve
            predicted = np.where(paeth, predicted, linear) if any_paeth else linear
        np.bitwise_and(coded[step] + predicted, 255, out=fronts[step + 2, 1:])
    out[...] = _slanted(fronts[2:, 1:], width).reshape(height, -1)


def _slanted(fronts: NDArray[Any], width: int) -> NDArray[Any]:
    """Fronts, shape (steps, H, bytes), as the rows that cross them, shape (H, width, bytes)."""
    step, row, byte = fronts.strides
    return as_strided(fronts, (fronts.shape[1], width, fronts.shape[2]), (step + row, step, byte))


def _paeth(left: _Wide, above: _Wide, corner: _Wide) -> _Wide:
    """The neighbour nearest to left + above - corner; the first of equally near ones."""
    from_left = above - corner
    from_above = left - corner
    from_corner = np.abs(from_left + from_above)
    np.abs(from_left, out=from_left)
    np.abs(from_above, out=from_above)
    nearest: _Wide = np.where(from_above <= from_corner, above, corner)
    is_left = from_left <= from_above
    is_left &= from_left <= from_corner
    np.copyto(nearest, left, where=is_left)
    return nearest


def filter_rows(pixels: Bytes, pixel_bytes: int, rule: Rule) -> Bytes:
    """Filter rows by a rule.

    Args:
        pixels: Shape (H, bytes of a row).
        pixel_bytes: Bytes of a pixel.
        rule: One of `RULES`.

    Returns:
        Shape (H, 1 + bytes of a row), with the filter number before each row.
    """
    height, row_bytes = pixels.shape
    out = np.empty((height, 1 + row_bytes), np.uint8)
    kinds = _kinds(rule, height, row_bytes // pixel_bytes)
    nothing, rows = np.zeros_like(pixels[:1]), max(1, _BAND_BYTES // row_bytes)
    for start in range(0, height, rows):
        stop = min(start + rows, height)
        band, shifted = pixels[start:stop], pixels[start - 1 : stop - 1]
        if not start:
            shifted = np.concatenate((nothing, pixels[: stop - 1]))
        if len(kinds) == 1:
            out[start:stop, 0] = kinds[0]
            out[start:stop, 1:] = _filtered(band, shifted, pixel_bytes, kinds[0])
            continue
        tried = np.stack([_filtered(band, shifted, pixel_bytes, kind) for kind in kinds])
        sums = np.minimum(tried, -tried).sum(axis=2, dtype=np.int64)
        chosen = np.argmin(sums + rule.weight * np.array(kinds)[:, None], axis=0)
        out[start:stop, 0] = np.array(kinds, np.uint8)[chosen]
        out[start:stop, 1:] = tried[chosen, np.arange(stop - start)]
    if rule.first is not None:
        out[0, 0] = rule.first
        out[0, 1:] = _filtered(pixels[:1], nothing, pixel_bytes, rule.first)[0]
    return out


def find_rule(kinds: Bytes, pixels: Bytes, pixel_bytes: int) -> str | None:
    """The name of a rule that chooses these filters for these rows, or None.

    Args:
        kinds: The filter of each row.
        pixels: Shape (H, bytes of a row).
        pixel_bytes: Bytes of a pixel.
    """
    first, rest = int(kinds[0]), kinds[1:]
    if (kinds == first).all():
        return str(first)
    if first == _SUB and (rest == rest[0]).all() and f"1,{rest[0]}" in RULES:
        return f"1,{rest[0]}"
    sample = min(len(kinds), 1 + _BAND_BYTES // pixels.shape[1])
    for name, rule in RULES.items():
        if len(rule.kinds) > 1 and all(
            np.array_equal(filter_rows(pixels[:rows], pixel_bytes, rule)[:, 0], kinds[:rows])
            for rows in (sample, len(kinds))
        ):
            return name
    return None


def _kinds(rule: Rule, height: int, width: int) -> tuple[int, ...]:
    """The filters that a rule tries for an image of a size."""
    left_out: set[int] = set()
    if rule.narrow and height == 1:
        left_out |= {_UP, _AVERAGE, _PAETH}
    if rule.narrow and width == 1:
        left_out |= {_SUB, _AVERAGE, _PAETH}
    return tuple(kind for kind in rule.kinds if kind not in left_out)


def _filtered(band: Bytes, above: Bytes, pixel_bytes: int, kind: int) -> Bytes:
    if kind == _NONE:
        return band
    if kind == _UP:
        return band - above
    left = _moved(band, pixel_bytes)
    if kind == _SUB:
        return band - left
    if kind == _AVERAGE:
        # the mean, rounded down, without overflow
        return band - ((left & above) + ((left ^ above) >> 1))
    corner = _moved(above, pixel_bytes)
    wide = (part.astype(np.int16) for part in (left, above, corner))
    return band - _paeth(*wide).astype(np.uint8)


def _moved(rows: Bytes, pixel_bytes: int) -> Bytes:
    """Rows moved right by a pixel."""
    moved = np.zeros_like(rows)
    moved[:, pixel_bytes:] = rows[:, :-pixel_bytes]
    return moved


# ---------------------------------------------------------------- png

SIGNATURE = b"\x89PNG\r\n\x1a\n"
Pixels = NDArray[np.uint8] | NDArray[np.uint16]

_CHANNELS = {0: 1, 2: 3, 4: 2, 6: 4}  # colour type -> samples of a pixel (11.2.1)
_COLOR_TYPES = {channels: color for color, channels in _CHANNELS.items()}
_PALETTE = 3
PNG_ENCODINGS = {
    (1, 1): "mono8",
    (1, 2): "8UC2",
    (1, 3): "rgb8",
    (1, 4): "rgba8",
    (2, 1): "16UC1",
    (2, 2): "16UC2",
    (2, 3): "rgb16",
    (2, 4): "rgba16",
}
"""Bytes of a sample and samples of a pixel -> the ROS image encoding that a PNG is taken as."""
_MAX_AROUND = 2**16  # bytes of other chunks
_MAX_CHUNKS = 2**17
_MIN_CHUNK = 256
_MAX_RATIO = 1032  # deflate does not compress further
_PROBE_BYTES = 2**17
_FINGERPRINT_BYTES = 2**16
_NO_REBUILD = "its PNG does not rebuild byte for byte"

# FLEVEL of the zlib header (RFC 1950) -> levels and strategies that write it, likeliest first
_DEFAULT, _FILTERED, _HUFFMAN, _RLE, _FIXED = range(5)
_CODINGS = {
    0: [(1, _RLE), (1, _DEFAULT), (1, _FILTERED), (1, _HUFFMAN), (1, _FIXED)],
    1: [(level, strategy) for level in (5, 4, 3, 2) for strategy in (_DEFAULT, _FILTERED)],
    2: [(6, _DEFAULT), (6, _FILTERED)],
    3: [(level, strategy) for level in (9, 8, 7) for strategy in (_DEFAULT, _FILTERED)],
}
_MEMORY_LEVELS = (8, 9)


@dataclass(frozen=True, slots=True)
class PngInfo:
    """A PNG's header (11.2.1).

    Attributes:
        width: Columns.
        height: Rows.
        bit_depth: Bits of a sample.
        color_type: 0 grey, 2 RGB, 3 palette, 4 grey and alpha, 6 RGB and alpha.
        interlaced: Whether the rows come in seven passes.
    """

    width: int
    height: int
    bit_depth: int
    color_type: int
    interlaced: bool

    @property
    def pixel_bytes(self) -> int:
        """Bytes of a pixel, for whole bytes."""
        return _CHANNELS[self.color_type] * self.bit_depth // 8


@dataclass(frozen=True, slots=True)
class PngRecipe:
    """How to make a PNG from its pixels.

    Attributes:
        filters: Name of one of `RULES`.
        level: Deflate's level, 1 to 9.
        strategy: Deflate's strategy, 0 to 4.
        memory_level: Deflate's memory level, 8 or 9.
        window_bits: Deflate's window, 9 to 15.
        zlib_header: The two bytes before the deflated data, in hexadecimal.
        chunk_bytes: Image data in each IDAT chunk except the last; 0: one chunk.
        before: Chunks between the header and the image data, in base64.
        after: What follows the image data, in base64.
    """

    filters: str
    level: int
    strategy: int
    memory_level: int
    window_bits: int
    zlib_header: str
    chunk_bytes: int
    before: str
    after: str


def zlib_fingerprint() -> str:
    """A checksum of the output of the zlib in use for a fixed input.

    If two machines have the same one, PNGs unpacked on one can be rebuilt on the other: zlib
    1.2.8 to 1.3.1 have the same, zlib-ng another.

    Returns:
        Eight hexadecimal digits.
    """
    noise, data = 1, bytearray()
    for place in range(_FINGERPRINT_BYTES):
        noise = (noise * 69069 + 1) % 2**32  # a slope with three bits of noise
        data.append((place * place >> 14) + (noise >> 29) & 255)
    checksum = 0
    for level in (1, 3, 6, 9):
        for strategy in (_DEFAULT, _FILTERED, _HUFFMAN, _RLE):
            compressor = zlib.compressobj(level, zlib.DEFLATED, 15, 8, strategy)
            checksum = zlib.crc32(compressor.compress(data) + compressor.flush(), checksum)
    return f"{checksum:08x}"


def parse(data: bytes | memoryview) -> PngInfo:
    """Read a PNG's header.

    Raises:
        Refused: It is not a PNG, or has a size that no video can have.
    """
    head = bytes(data[:33])
    if head[:8] != SIGNATURE or head[8:16] != b"\0\0\0\rIHDR" or len(head) < 33:
        raise Refused("it is not a PNG: it does not begin with a header")
    if zlib.crc32(head[12:29]) != int.from_bytes(head[29:33], "big"):
        raise Refused("its PNG's header has a wrong checksum")
    width, height = (int.from_bytes(head[at : at + 4], "big") for at in (16, 20))
    bit_depth, color_type, compression, filtering, interlace = head[24:29]
    if compression or filtering or interlace > 1 or color_type not in (*_CHANNELS, _PALETTE):
        raise Refused("its PNG's header holds unknown values")
    check_size(width, height)
    return PngInfo(width, height, bit_depth, color_type, bool(interlace))


def pixels_of(data: bytes | memoryview) -> Pixels:
    """The pixels of a PNG, whether or not it could be rebuilt. See `decode`.

    Raises:
        Refused: It is incomplete, or of an unsupported kind.
    """
    info, _, deflated, _, _ = _split(data)
    return _to_pixels(unfilter(_inflate(deflated, info), info.pixel_bytes), info)


def decode(data: bytes | memoryview, hint: PngRecipe | None = None) -> tuple[Pixels, PngRecipe]:
    """Unpack a PNG that can be rebuilt byte for byte, which is verified.

    Args:
        data: The whole PNG, with whatever follows it.
        hint: Recipe of another image from the same encoder, tried first.

    Returns:
        Pixels of shape (H, W), or (H, W, C) with 2 to 4 channels in the file's order, uint8 or
        uint16 in the machine's byte order; and the recipe with which `rebuild` restores the data.

    Raises:
        Refused: It is incomplete, of an unsupported kind, or cannot be rebuilt.
    """
    info, first, deflated, chunk_bytes, last = _split(data)
    rows = _inflate(deflated, info)
    pixel_rows = unfilter(rows, info.pixel_bytes)
    pixels = _to_pixels(pixel_rows, info)
    header = deflated[:2].hex()
    before, after = (base64.b64encode(part).decode() for part in (first, last))
    # what need not be computed comes first
    if hint and hint.zlib_header == header and chunk_bytes in (0, hint.chunk_bytes):
        recipe = replace(hint, before=before, after=after)
        if rebuild(pixels, recipe) == data:
            return pixels, recipe
    rule = find_rule(rows[:, 0], pixel_rows, info.pixel_bytes)
    if rule is None:
        raise Refused(f"{_NO_REBUILD}: its filters follow no known rule")
    for level, strategy, memory_level, window_bits in _codings(deflated, rows):
        recipe = PngRecipe(
            rule, level, strategy, memory_level, window_bits, header, chunk_bytes, before, after
        )
        if rebuild(pixels, recipe) == data:
            return pixels, recipe
    raise Refused(f"{_NO_REBUILD}: not compressed by zlib as usual")


def rebuild(pixels: Pixels, recipe: PngRecipe) -> bytes:
    """Make a PNG from its pixels.

    Args:
        pixels: As `decode` gave them.
        recipe: As `decode` gave it.

    Raises:
        Refused: The recipe is not valid, or no PNG can have such pixels.
    """
    rule = RULES.get(recipe.filters)
    if rule is None or not (recipe.chunk_bytes == 0 or recipe.chunk_bytes >= _MIN_CHUNK):
        raise Refused("its PNG recipe holds unknown values")
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    if channels not in _COLOR_TYPES or pixels.dtype.itemsize > 2 or not pixels.size:
        raise Refused("no PNG holds such pixels")
    height, width = pixels.shape[:2]
    kind = 8 * pixels.dtype.itemsize, _COLOR_TYPES[channels], 0, 0, 0
    header = b"IHDR" + struct.pack(">II5B", width, height, *kind)
    order = pixels.dtype.newbyteorder(">")
    pixel_rows = np.ascontiguousarray(pixels, order).reshape(height, -1).view(np.uint8)
    rows = filter_rows(pixel_rows, channels * pixels.dtype.itemsize, rule)
    try:
        before, after = (base64.b64decode(text) for text in (recipe.before, recipe.after))
        deflated = bytes.fromhex(recipe.zlib_header) + _deflate(rows, recipe)
    except (ValueError, zlib.error, OverflowError):
        raise Refused("its PNG recipe holds unknown values") from None
    size = recipe.chunk_bytes or len(deflated)
    chunks = (
        _chunk(b"IDAT" + deflated[start : start + size]) for start in range(0, len(deflated), size)
    )
    return b"".join((SIGNATURE, _chunk(header), before, *chunks, after))


_NOISE = PngRecipe("0", 1, _RLE, 9, 15, "7801", 0, "", "AAAAAElFTkSuQmCC")
"""Huffman codes alone: no filter, and no search for repetitions, makes noise any smaller."""


def noise_file(pixels: Pixels) -> bytes:
    """A PNG of pixels that hardly depend on their neighbours.

    Args:
        pixels: As for `rebuild`.
    """
    return rebuild(pixels, _NOISE)


def _deflate(rows: NDArray[np.uint8], recipe: PngRecipe) -> bytes:
    """Deflate rows, without the two bytes of zlib's header."""
    window, memory = recipe.window_bits, recipe.memory_level
    compressor = zlib.compressobj(recipe.level, zlib.DEFLATED, window, memory, recipe.strategy)
    return (compressor.compress(rows.data) + compressor.flush())[2:]


def _chunk(body: bytes) -> bytes:
    """A chunk from its type and data (5.3)."""
    size, checksum = len(body) - 4, zlib.crc32(body)
    return b"".join((size.to_bytes(4, "big"), body, checksum.to_bytes(4, "big")))


def _split(data: bytes | memoryview) -> tuple[PngInfo, bytes, bytes, int, bytes]:
    """Split a PNG.

    Returns:
        Its header; the chunks before its image data; these, joined; bytes of their chunks, 0 for
        one; and what follows them.
    """
    info = parse(data)
    if info.color_type == _PALETTE or info.bit_depth not in (8, 16):
        raise Refused(f"its PNG has a palette, or {info.bit_depth} bits a sample")
    if info.interlaced:
        raise Refused("its PNG is interlaced")
    view = memoryview(data)
    start = end = 33
    sizes: list[int] = []
    parts: list[memoryview] = []
    for kind, begin, stop in _chunks(view, start):
        if kind != b"IDAT":
            if sizes:
                break
            start = stop
            continue
        if zlib.crc32(view[begin + 4 : stop - 4]) != int.from_bytes(view[stop - 4 : stop], "big"):
            raise Refused("its PNG's image data have a wrong checksum")
        parts.append(view[begin + 8 : stop - 4])
        sizes.append(stop - begin - 12)
        end = stop
    if not sizes:
        raise Refused("its PNG holds no image data")
    if start - 33 > _MAX_AROUND or len(data) - end > _MAX_AROUND:
        raise Refused(f"its PNG has more than {_MAX_AROUND} bytes besides the image")
    return info, bytes(view[33:start]), b"".join(parts), _chunk_rule(sizes), bytes(view[end:])


def _chunks(data: memoryview, offset: int) -> Iterator[tuple[bytes, int, int]]:
    """Type, start and end of chunks, up to the one that ends a PNG."""
    for _ in range(_MAX_CHUNKS):
        if offset >= len(data):
            break
        size = int.from_bytes(data[offset : offset + 4], "big")
        end = offset + 12 + size
        if end > len(data):
            raise Refused("its PNG is cut short")
        kind = bytes(data[offset + 4 : offset + 8])
        yield kind, offset, end
        if kind == b"IEND":
            return
        offset = end
    raise Refused("its PNG is cut short: it has no end")


def _chunk_rule(sizes: list[int]) -> int:
    """Size of IDAT chunks, 0 if there is only one."""
    size = sizes[0] if len(sizes) > 1 else 0
    if size and (set(sizes[:-1]) != {size} or not 0 < sizes[-1] <= size or size < _MIN_CHUNK):
        raise Refused(f"{_NO_REBUILD}: its chunks follow no rule")
    return size


def _inflate(deflated: bytes, info: PngInfo) -> NDArray[np.uint8]:
    """The filtered rows, shape (H, 1 + bytes of a row); never more than the header declares."""
    row_bytes = 1 + info.width * info.pixel_bytes
    size = row_bytes * info.height
    if size > MAX_IMAGE_BYTES or size > _MAX_RATIO * (len(deflated) + 1):
        raise Refused(f"its PNG promises {size} bytes of pixels, which it cannot hold")
    inflater = zlib.decompressobj()
    try:
        rows = inflater.decompress(deflated, size + 1)
    except zlib.error:
        raise Refused("its PNG's image data are damaged") from None
    if len(rows) != size or not inflater.eof or inflater.unused_data:
        raise Refused("its PNG's image data are cut short, or more than its header says")
    return np.frombuffer(rows, np.uint8).reshape(info.height, row_bytes)


def _to_pixels(rows: NDArray[np.uint8], info: PngInfo) -> Pixels:
    channels = _CHANNELS[info.color_type]
    shape = (info.height, info.width) + ((channels,) if channels > 1 else ())
    if info.bit_depth == 8:
        return rows.reshape(shape)
    return rows.view(">u2").astype(np.uint16).reshape(shape)


def _codings(deflated: bytes, rows: NDArray[np.uint8]) -> Iterator[tuple[int, int, int, int]]:
    """Deflate parameters that reproduce the beginning: level, strategy, memory and window."""
    probe = rows.data.cast("B")[:_PROBE_BYTES]
    window = (deflated[0] >> 4) + 8
    # libpng uses a window just larger than a small image, and a smaller one in the header
    windows = sorted({max(9, window), min(15, max(9, window + 1)), 15})
    for level, strategy in _CODINGS[deflated[1] >> 6]:
        for memory_level in _MEMORY_LEVELS:
            for window_bits in windows:
                compressor = zlib.compressobj(
                    level, zlib.DEFLATED, window_bits, memory_level, strategy
                )
                coded = compressor.compress(probe)[2:]
                if deflated.startswith(coded, 2):
                    yield level, strategy, memory_level, window_bits
