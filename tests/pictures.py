"""Moving pictures in every image encoding of ROS, and what numpy sees in a raw image message.

Encodings are those of `sensor_msgs/image_encodings`, and ``nv12`` of foxglove.RawImage. Nothing
here uses mp4ds, so that its tests have an independent source.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

BAYER = [f"bayer_{order}8" for order in ("rggb", "bggr", "gbrg", "grbg")]
COMMON = ["mono8", "rgb8", "bgr8", *BAYER, "mono16", "16UC1"]
PACKED_YUV = ["yuv422", "uyvy", "yuyv", "yuv422_yuy2"]
PLANAR_YUV = ["nv12", "nv21", "nv24"]
YUV = [*PACKED_YUV, *PLANAR_YUV]
GENERIC = [
    f"{kind}C{channels}"
    for kind in ("8U", "8S", "16U", "16S", "32S", "32F", "64F")
    for channels in (1, 2, 3, 4)
]
# Those of COMMON come first: their places seed the noise of recordings.
ENCODINGS = [
    *COMMON,
    *("rgba8", "bgra8", "rgb16", "bgr16", "rgba16", "bgra16"),
    *(f"{name[:-1]}16" for name in BAYER),
    *YUV,
    *(name for name in GENERIC if name not in COMMON),
]

_WORDS = [name for name in ENCODINGS if re.search("16$|^16U", name)]
_METRES = [name for name in ENCODINGS if "F" in name]
CONTENTS: dict[str, list[str]] = {
    "full": ENCODINGS,
    "12-bit": _WORDS,
    "12-bit-high": _WORDS,
    "few-values": [*_WORDS, *_METRES],
    "millimetres": _METRES,
    "millimetres-product": _METRES,
}
"""What samples hold -> encodings that may hold it.

``12-bit-high`` has its zero bits below the value; the two of millimetres are ``k / 1000`` with
NaN where nothing was seen, and ``k * 0.001`` as the sample type rounds it, with 0 there.
"""

_SAMPLES = {
    "8U": "u1", "8S": "i1", "16U": "u2", "16S": "i2", "32S": "i4", "32F": "f4", "64F": "f8"
}  # fmt: skip
_COLOURS = {"mono": 1, "rgb": 3, "bgr": 3, "rgba": 4, "bgra": 4}


# libswscale: bicubic, accurate rounding, full chroma in and out; older PyAV has no names for them
CAREFUL: Any = 0x4 | 0x40000 | 0x2000 | 0x4000


def sample_format(encoding: str) -> tuple[np.dtype[Any], int]:
    """Native type of a sample, and samples per pixel; 1 for planar YUV."""
    if match := re.fullmatch(r"(\d+[USF])C(\d)", encoding):
        return np.dtype(_SAMPLES[match[1]]), int(match[2])
    if encoding in YUV:
        return np.dtype("u1"), 2 if encoding in PACKED_YUV else 1
    name, bits = re.fullmatch(r"(.*?)(8|16)", encoding).groups()  # type: ignore[union-attr]
    return np.dtype(f"u{int(bits) // 8}"), _COLOURS.get(name, 1)


def rows_of(encoding: str, height: int) -> int:
    """Rows of data of an image; planes of chroma stand below the image."""
    return {"nv12": 3 * height // 2, "nv21": 3 * height // 2, "nv24": 3 * height}.get(
        encoding, height
    )


def pixels(values: Mapping[str, Any]) -> NDArray[Any]:
    """What numpy sees in the fields of a raw image message, in native byte order.

    Returns:
        ``(rows, width)`` or ``(rows, width, samples)``, as `picture` made it.
    """
    dtype, samples = sample_format(values["encoding"])
    height, width = rows_of(values["encoding"], values["height"]), values["width"]
    rows = np.frombuffer(bytes(values["data"]), np.uint8).reshape(height, values["step"])
    stored = dtype.newbyteorder(">" if values.get("is_bigendian") else "<")
    found = np.ascontiguousarray(rows[:, : width * samples * dtype.itemsize]).view(stored)
    native: NDArray[Any] = found.astype(dtype)
    return native.reshape(height, width, samples) if samples > 1 else native


def picture(
    encoding: str,
    *,
    frame: int,
    width: int,
    height: int,
    rng: np.random.Generator | None,
    content: str = "full",
) -> NDArray[Any]:
    """A moving pattern with edges and slopes; by default it uses all bits of its samples.

    Floating point samples are metres, with NaN where nothing was seen and infinity where it was
    too far; ``16UC1`` has zeros there.

    Args:
        encoding: One of `ENCODINGS`; YUV of even width and height.
        frame: Number of the picture.
        width: Pixels.
        height: Pixels.
        rng: Of the sensor noise; None for none.
        content: One of `CONTENTS`.

    Returns:
        ``(rows, width)`` or ``(rows, width, samples)`` of the encoding's samples; see `rows_of`.
    """
    colour = _colour(frame, width, height, rng)
    if encoding in YUV:
        return _yuv(encoding, colour)
    dtype, samples = sample_format(encoding)
    y, x = np.mgrid[:height, :width]
    if match := re.fullmatch("bayer_(....)(?:8|16)", encoding):
        return _mosaic(_scaled(colour, dtype, content), match[1])
    if dtype.kind == "f":
        metres = _channels(colour, samples) / 255 * 20 + 0.4
        hole, far = (x + frame) % 17 == 0, (y + 2 * frame) % 23 == 0
        return _metres(metres, hole, far, dtype, content)
    if encoding.startswith("bgr"):
        colour = colour[..., ::-1]
    made = _scaled(_channels(colour, samples), dtype, content)
    if encoding == "16UC1":
        made[(x + frame) % 17 == 0] = 0  # holes, as depth cameras leave them
    return made


def _colour(
    frame: int, width: int, height: int, rng: np.random.Generator | None
) -> NDArray[np.float64]:
    """Red, green and blue of about 0 to 255, shape ``(height, width, 3)``."""
    y, x = np.mgrid[:height, :width].astype(float)
    colours = [
        128 + 100 * np.sin((x + 2 * frame) / 9),
        128 + 100 * np.sin((y - frame) / 7),
        255 * ((x + y + 3 * frame) % 40) / 40,
    ]
    colour: NDArray[np.float64] = np.stack(colours, axis=-1)
    left = (5 * frame) % max(1, width - width // 4)
    colour[height // 3 : height // 2, left : left + width // 4] = (250, 30, 90)
    if rng is not None:
        colour += rng.normal(0, 3, colour.shape)
    return colour


def _channels(colour: NDArray[np.float64], samples: int) -> NDArray[np.float64]:
    """Grey, two of the colours, all three, or with an alpha that fades to the borders."""
    if samples == 1:
        return np.clip(colour.mean(axis=-1), 0, 255)
    clipped: NDArray[np.float64] = np.clip(colour, 0, 255)
    if samples < 4:
        return clipped[..., :samples]
    height, width, _ = colour.shape
    y, x = np.mgrid[:height, :width].astype(float)
    border = np.minimum(np.minimum(x, width - 1 - x), np.minimum(y, height - 1 - y))
    return np.dstack([clipped, np.clip(border * 31.7, 0, 255)])


def _scaled(colour: NDArray[np.float64], dtype: np.dtype[Any], content: str) -> NDArray[Any]:
    """0 to 255 as integers of the whole range of their type."""
    if dtype == np.uint8:
        return np.clip(colour, 0, 255).astype(dtype)
    range_ = np.iinfo(dtype)
    made: NDArray[Any] = np.clip(colour, 0, 255) / 255 * (range_.max - range_.min) + range_.min
    made = made.astype(dtype)
    if content == "12-bit":
        return made >> 4
    if content == "12-bit-high":
        return made & 0xFFF0
    return made // 1637 * 1637 if content == "few-values" else made


def _metres(
    metres: NDArray[np.float64],
    hole: NDArray[np.bool_],
    far: NDArray[np.bool_],
    dtype: np.dtype[Any],
    content: str,
) -> NDArray[Any]:
    thousand = np.round(metres * 1000)
    if content == "millimetres-product":
        made = thousand.astype(dtype) * dtype.type(0.001)
        made[hole] = 0
        return made
    if content == "millimetres":
        made = (thousand / 1000).astype(dtype)
    else:
        made = (np.round(metres * 4) / 4 if content == "few-values" else metres).astype(dtype)
        made[far] = np.inf
    made[hole] = np.nan
    return made


def _mosaic(colour: NDArray[Any], order: str) -> NDArray[Any]:
    mosaic = np.empty(colour.shape[:2], colour.dtype)
    for place, letter in enumerate(order):
        rows, columns = slice(place // 2, None, 2), slice(place % 2, None, 2)
        mosaic[rows, columns] = colour[rows, columns, "rgb".index(letter)]
    return mosaic


def _yuv(encoding: str, colour: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Limited range of ITU-R BT.601, chroma the mean of the pixels that share it."""
    height, width, _ = colour.shape
    matrix = [[65.481, 128.553, 24.966], [-37.797, -74.203, 112.0], [112.0, -93.786, -18.214]]
    float_yuv = np.clip(colour, 0, 255) / 255 @ np.array(matrix).T + (16, 128, 128)
    luma = np.round(float_yuv[..., 0]).astype(np.uint8)
    down, across = {"nv24": (1, 1), "nv12": (2, 2), "nv21": (2, 2)}.get(encoding, (1, 2))
    blocks = float_yuv[..., 1:].reshape(height // down, down, width // across, across, 2)
    chroma = np.round(blocks.mean(axis=(1, 3))).astype(np.uint8)
    if encoding in PLANAR_YUV:
        pairs = chroma[..., ::-1] if encoding == "nv21" else chroma
        return np.vstack([luma, pairs.reshape(-1, width)])
    order = (luma, chroma.reshape(height, width))
    return np.stack(order if encoding in ("yuyv", "yuv422_yuy2") else order[::-1], axis=-1)


def blocks(picture: NDArray[Any]) -> NDArray[np.float64]:
    """Mean colours of a grid of 8 x 6 blocks."""
    height, width = picture.shape[0] // 6, picture.shape[1] // 8
    part = picture[: 6 * height, : 8 * width].astype(float)
    means: NDArray[np.float64] = part.reshape(6, height, 8, width, 3).mean(axis=(1, 3))
    return means
