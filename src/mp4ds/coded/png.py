"""PNG: unpacked into pixels and a recipe, of which the same file is made again.

Sections are those of the PNG specification, third edition. The same pixels are coded in other
bytes by every encoder, so a recipe says how one went about it: its filters (`png_filters`), the
parameters of its deflate (RFC 1951), and what stands around the image data. It holds for all
images of that encoder, and is found by trying. It rests on deflate being done by the zlib of
its original authors, whose output has not changed in years; other implementations code otherwise.
"""

from __future__ import annotations

import base64
import binascii
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mp4ds.coded.base import MAX_IMAGE_BYTES, Refused, check_size
from mp4ds.coded.png_filters import RULES, filter_rows, find_rule, unfilter

SIGNATURE = b"\x89PNG\r\n\x1a\n"
Pixels = NDArray[np.uint8] | NDArray[np.uint16]

_CHANNELS = {0: 1, 2: 3, 4: 2, 6: 4}  # colour type -> samples of a pixel (11.2.1)
_COLOR_TYPES = {channels: color for color, channels in _CHANNELS.items()}
_PALETTE = 3
ENCODINGS = {
    (1, 1): "mono8",
    (1, 2): "8UC2",
    (1, 3): "rgb8",
    (1, 4): "rgba8",
    (2, 1): "16UC1",
    (2, 2): "16UC2",
    (2, 3): "rgb16",
    (2, 4): "rgba16",
}
"""Bytes of a sample and samples of a pixel -> the ROS image encoding that a PNG is taken for."""
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
    """What a PNG's header says (11.2.1).

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
    """How to make a PNG of its pixels.

    Attributes:
        filters: Name of a rule of `png_filters.RULES`.
        level: Deflate's level, 1 to 9.
        strategy: Deflate's strategy, 0 to 4.
        memory_level: Deflate's memory level, 8 or 9.
        window_bits: Deflate's window, 9 to 15.
        zlib_header: The two bytes before the deflated data, in hexadecimal.
        chunk_bytes: Image data in each IDAT chunk but the last; 0: one chunk.
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


@dataclass(frozen=True, slots=True)
class _Parts:
    info: PngInfo
    before: bytes
    deflated: bytes
    chunk_bytes: int
    after: bytes


def zlib_build() -> str:
    """The version of the zlib in use, which names other implementations where they say so."""
    return zlib.ZLIB_RUNTIME_VERSION


def zlib_fingerprint() -> str:
    """A checksum of what the zlib in use makes of a fixed input.

    Where two machines have the same one, PNGs taken apart on one rebuild on the other: zlib
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
        Refused: It is no PNG, or has a size that no video has.
    """
    head = bytes(data[:33])
    if head[:8] != SIGNATURE or head[8:16] != b"\0\0\0\rIHDR" or len(head) < 33:
        raise Refused("it is no PNG: it does not begin with a header")
    if zlib.crc32(head[12:29]) != int.from_bytes(head[29:33], "big"):
        raise Refused("its PNG's header has a wrong checksum")
    width, height = (int.from_bytes(head[at : at + 4], "big") for at in (16, 20))
    bit_depth, color_type, compression, filtering, interlace = head[24:29]
    if compression or filtering or interlace > 1 or color_type not in (*_CHANNELS, _PALETTE):
        raise Refused("its PNG's header holds unknown values")
    check_size(width, height)
    return PngInfo(width, height, bit_depth, color_type, bool(interlace))


def check_whole(data: bytes | memoryview) -> None:
    """Refuse a PNG whose chunks do not reach its end.

    Raises:
        Refused: It is cut short.
    """
    view = memoryview(data)
    kinds = [kind for kind, _, _ in _chunks(view, len(SIGNATURE))]
    if b"IDAT" not in kinds:
        raise Refused("its PNG holds no image data")


def decode(data: bytes | memoryview, hint: PngRecipe | None = None) -> tuple[Pixels, PngRecipe]:
    """Unpack a PNG whose bytes can be made again, which is tried.

    Args:
        data: The whole PNG, with whatever follows it.
        hint: Recipe of another image of the same encoder, which is tried first.

    Returns:
        Pixels of shape (H, W), or (H, W, C) with 2 to 4 channels in the file's order, uint8 or
        uint16 in the machine's byte order; and the recipe with which `rebuild` gives the data.

    Raises:
        Refused: It is no whole PNG, of a kind that is not unpacked, or does not rebuild.
    """
    parts = _split(data)
    info = parts.info
    rows = _inflate(parts)
    pixel_rows = unfilter(rows, info.pixel_bytes)
    pixels = _to_pixels(pixel_rows, info)
    before, after = (base64.b64encode(part).decode() for part in (parts.before, parts.after))
    if hint is not None:
        recipe = replace(hint, before=before, after=after)
        if _holds(parts, recipe) and rebuild(pixels, recipe) == data:
            return pixels, recipe
    rule = find_rule(rows[:, 0], pixel_rows, info.pixel_bytes)
    if rule is None:
        raise Refused(f"{_NO_REBUILD}: its filters follow no known rule")
    for level, strategy, memory_level, window_bits in _codings(parts.deflated, rows):
        recipe = PngRecipe(
            filters=rule,
            level=level,
            strategy=strategy,
            memory_level=memory_level,
            window_bits=window_bits,
            zlib_header=parts.deflated[:2].hex(),
            chunk_bytes=parts.chunk_bytes,
            before=before,
            after=after,
        )
        if rebuild(pixels, recipe) == data:
            return pixels, recipe
    raise Refused(f"{_NO_REBUILD}: not compressed by zlib as usual")


def rebuild(pixels: Pixels, recipe: PngRecipe) -> bytes:
    """Make a PNG of its pixels.

    Args:
        pixels: As `decode` gave them.
        recipe: As `decode` gave it.

    Raises:
        Refused: The recipe is none, or the pixels are of a kind that no PNG has.
    """
    rule = RULES.get(recipe.filters)
    if rule is None or not (recipe.chunk_bytes == 0 or recipe.chunk_bytes >= _MIN_CHUNK):
        raise Refused("its PNG recipe holds unknown values")
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    if channels not in _COLOR_TYPES or pixels.dtype.itemsize > 2 or not pixels.size:
        raise Refused("no PNG holds such pixels")
    height, width = pixels.shape[:2]
    header = b"IHDR%b%b%b%b\0\0\0" % (
        width.to_bytes(4, "big"),
        height.to_bytes(4, "big"),
        bytes([8 * pixels.dtype.itemsize]),
        bytes([_COLOR_TYPES[channels]]),
    )
    order = pixels.dtype.newbyteorder(">")
    pixel_rows = np.ascontiguousarray(pixels, order).reshape(height, -1).view(np.uint8)
    rows = filter_rows(pixel_rows, channels * pixels.dtype.itemsize, rule)
    try:
        before, after = (base64.b64decode(text) for text in (recipe.before, recipe.after))
        deflated = bytes.fromhex(recipe.zlib_header) + _deflate(rows, recipe)
    except (ValueError, binascii.Error, zlib.error, OverflowError):
        raise Refused("its PNG recipe holds unknown values") from None
    size = recipe.chunk_bytes or len(deflated)
    chunks = (
        _chunk(b"IDAT" + deflated[start : start + size]) for start in range(0, len(deflated), size)
    )
    return b"".join((SIGNATURE, _chunk(header), before, *chunks, after))


def _deflate(rows: NDArray[np.uint8], recipe: PngRecipe) -> bytes:
    """Deflate rows, without the two bytes of zlib's header."""
    compressor = zlib.compressobj(
        recipe.level, zlib.DEFLATED, recipe.window_bits, recipe.memory_level, recipe.strategy
    )
    return (compressor.compress(rows.data) + compressor.flush())[2:]


def _chunk(body: bytes) -> bytes:
    """A chunk of its type and data (5.3)."""
    return b"%b%b%b" % (
        (len(body) - 4).to_bytes(4, "big"),
        body,
        zlib.crc32(body).to_bytes(4, "big"),
    )


def _split(data: bytes | memoryview) -> _Parts:
    """Take a PNG apart around its image data."""
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
    return _Parts(
        info, bytes(view[33:start]), b"".join(parts), _chunk_rule(sizes), bytes(view[end:])
    )


def _chunks(data: memoryview, offset: int) -> Iterator[tuple[bytes, int, int]]:
    """Type, begin and end of chunks, up to the one that ends a PNG."""
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
    """How much goes into an IDAT chunk, 0 where all is in one."""
    size = sizes[0] if len(sizes) > 1 else 0
    if size and (set(sizes[:-1]) != {size} or not 0 < sizes[-1] <= size or size < _MIN_CHUNK):
        raise Refused(f"{_NO_REBUILD}: its chunks follow no rule")
    return size


def _inflate(parts: _Parts) -> NDArray[np.uint8]:
    """The filtered rows, shape (H, 1 + bytes of a row); never more than the header promises."""
    info = parts.info
    row_bytes = 1 + info.width * info.pixel_bytes
    size = row_bytes * info.height
    if size > MAX_IMAGE_BYTES or size > _MAX_RATIO * (len(parts.deflated) + 1):
        raise Refused(f"its PNG promises {size} bytes of pixels, which it cannot hold")
    inflater = zlib.decompressobj()
    try:
        rows = inflater.decompress(parts.deflated, size + 1)
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


def _holds(parts: _Parts, recipe: PngRecipe) -> bool:
    """Whether a recipe fits what need not be computed."""
    same_chunks = recipe.chunk_bytes == parts.chunk_bytes or not parts.chunk_bytes
    return same_chunks and recipe.zlib_header == parts.deflated[:2].hex()


def _codings(deflated: bytes, rows: NDArray[np.uint8]) -> Iterator[tuple[int, int, int, int]]:
    """Deflate's parameters that code the beginning alike: level, strategy, memory and window."""
    probe = rows.data.cast("B")[:_PROBE_BYTES]
    window = (deflated[0] >> 4) + 8
    # libpng takes a window just larger than a small image, and shrinks what the header says
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
