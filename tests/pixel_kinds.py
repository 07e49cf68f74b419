"""Pixels of every encoding: what the tests of layouts and of their codecs share.

Arrays are what `mp4ds.messages.encodings.pixel_view` gives of a message, made here from bytes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

import images
from mp4ds.messages.encodings import ENCODINGS, Encoding, pixel_view
from mp4ds.messages.layouts import LAYOUTS, Layout, bind, fit
from mp4ds.messages.sources import CONVERSIONS, MOSAICS
from mp4ds.messages.wire import ImageFields

Pixels = NDArray[Any]

KINDS = ["random", "smooth", "constant", "extreme"]
EXTREME_FLOATS = {
    "f4": [
        *(0x00000000, 0x80000000, 0x3F800000, 0xBF800000, 0x7F800000, 0xFF800000),
        *(0x7FC00000, 0xFFC00001, 0x7F800001, 0x7FFFFFFF, 0xFFFFFFFF),  # NaN, quiet and not
        *(0x00000001, 0x007FFFFF, 0x80000001, 0x00800000, 0x7F7FFFFF),  # denormal, least, most
    ],
    "f8": [
        *(0, 1 << 63, 0x3FF0000000000000, 0x7FF0000000000000, 0xFFF0000000000000),
        *(0x7FF8000000000000, 0xFFF8000000000001, 0x7FF0000000000001, 0xFFFFFFFFFFFFFFFF),
        *(1, 0x000FFFFFFFFFFFFF, 0x8000000000000001, 0x7FEFFFFFFFFFFFFF),
    ],
}


def rounded(encoding: Encoding, width: int, height: int) -> tuple[int, int]:
    """The sides, or the next ones that the encoding may have."""
    across, down = encoding.even
    return width + -width % across, height + -height % down


def values(encoding: Encoding, kind: str, width: int, height: int, seed: int = 0) -> Pixels:
    """Pixels in native byte order, contiguous."""
    shape = encoding.shape(width, height)
    rng = np.random.default_rng([seed, width, height, KINDS.index(kind)])
    size = encoding.bytes_per_sample
    dtype = np.dtype(encoding.dtype)
    if kind == "random":
        raw = rng.integers(0, 256, (*shape, size), np.uint8)
        return raw.view(dtype).reshape(shape)
    if kind == "extreme":
        if encoding.is_float:
            patterns = EXTREME_FLOATS[encoding.dtype]
        else:
            top = 256**size - 1
            patterns = [0, 1, top, top - 1, top // 2, top // 2 + 1, 255, top - 255]
        return rng.choice(np.array(patterns, f"u{size}"), shape).view(dtype)
    if kind == "constant":
        return np.full(shape, rng.integers(1, 100), dtype)
    y, x = np.mgrid[: shape[0], :width].astype(float)
    plane = np.sin(x / 9 + seed / 3) + np.cos(y / 7)
    picture = np.stack([plane * (1 + n / 5) for n in range(encoding.channels)], axis=-1)
    picture = picture.reshape(shape) / 4
    if encoding.is_float:
        return (picture * 10).astype(dtype)
    info = np.iinfo(dtype)
    half = 0 if encoding.is_signed else (info.max + 1) / 2
    return np.clip(picture * (info.max / 2) + half, info.min, info.max).astype(dtype)


def as_message(
    pixels: Pixels, encoding: Encoding, *, pad: int = 0, is_bigendian: bool = False
) -> Pixels:
    """The same pixels as a view of a message's data, with padding and byte order."""
    swapped = pixels.astype(pixels.dtype.newbyteorder(">" if is_bigendian else "<"))
    rows = swapped.view(np.uint8).reshape(len(pixels), -1)
    data = np.pad(rows, ((0, 0), (0, pad))).tobytes()
    width = pixels.shape[1]
    height, step = int(len(pixels) / encoding.rows), rows.shape[1] + pad
    fields = ImageFields(encoding.name, width, height, step, int(is_bigendian))
    return pixel_view(memoryview(data), fields)


def bits_of(pixels: Pixels) -> bytes:
    """All samples in little-endian order, which tells NaN from NaN."""
    return pixels.astype(pixels.dtype.newbyteorder("<")).tobytes()


def made_of(source: str, encoding: Encoding, width: int, height: int, seed: int) -> Pixels:
    """Colours of a random ``mosaic``, ``yuv420`` or ``yuv422``, as the spec's reader has them.

    A quarter of the colours of YUV are cut off at 0 or 255.
    """
    rng = np.random.default_rng([seed, width, height])
    if source == "mosaic":
        mosaic = rng.integers(0, 256, (height, width), np.uint8)
        planes = list(bind("mosaic8", ENCODINGS["bayer_rggb8"]).to_picture(mosaic))
        name, parameters = "from_mosaic8", {"mosaic": MOSAICS[seed % len(MOSAICS)]}
    else:
        halved = (height // 2 if source == "yuv420" else height, width // 2)
        planes = [
            rng.integers(0, 256, (height, width), np.uint8),
            *(rng.integers(100, 156, halved, np.uint8) for _ in range(2)),
        ]
        name, parameters = f"from_{source}", {"rule": [*CONVERSIONS][seed % len(CONVERSIONS)]}
    image = {"encoding": encoding.name, "width": width, "height": height}
    found: Pixels = images.pixels(image, {"layout": name, "parameters": parameters}, planes)
    return found


def suited(name: str, encoding: Encoding, width: int, height: int, seed: int = 0) -> Pixels:
    """Pixels that a layout with parameters does not refuse, and that use what it has."""
    rng = np.random.default_rng([seed, width, height])
    shape = encoding.shape(width, height)
    if name == "opaque":
        pixels = rng.integers(0, 256, shape, np.uint8)
        pixels[..., 3] = seed * 80 % 256
        return pixels
    if name.startswith("from_"):
        return made_of(name.removeprefix("from_").rstrip("8"), encoding, width, height, seed)
    if name.endswith("fold") and name != "metres_fold" and seed == 3:
        return values(encoding, "random", width, height, seed)
    if name.endswith("_bits") or name in ("fold", "mosaic_fold"):
        low = rng.integers(0, 4096, shape, np.uint16)
        if encoding.is_signed:
            return (low.astype(np.int16) - 2048).astype(encoding.dtype)
        return low << 4 if seed % 2 else low
    if name in ("table", "palette"):
        few = rng.integers(0, 2**32, 300, np.uint64).astype(f"u{encoding.bytes_per_sample}")
        return rng.choice(few, shape).view(encoding.dtype)
    if name in ("metres16", "metres_fold"):
        counts = rng.integers(1, 65536, shape).astype(np.float32)
        thousand, milli = np.float32(1000), np.float32(0.001)
        metres = counts / thousand if seed % 2 else counts * milli
        metres[rng.random(shape) < 0.2] = np.nan if seed % 3 else 0
        return metres
    return values(encoding, "random", width, height, seed)


def bound(name: str, encoding: Encoding, width: int = 9, height: int = 7, seed: int = 0) -> Layout:
    """A layout of an encoding, with parameters that `suited` pixels of the same seed give it."""
    if not LAYOUTS[name].parameters:
        return bind(name, encoding)
    width, height = rounded(encoding, max(width, 8), max(height, 8))
    layout = fit(name, encoding, [suited(name, encoding, width, height, seed)])
    assert layout is not None
    return layout


PAIRS = [(e.name, layout) for e in ENCODINGS.values() for layout in e.exact]
"""Every encoding with each of its exact layouts."""
