"""The image encodings that a layout carries, and their pixels as arrays.

The names are those of ROS's `sensor_msgs/image_encodings.hpp`, to which Foxglove's schemas add
``nv12`` (spec/registry.md, "Encodings").
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAX_SIDE = 16384
"""Largest width and height of a picture in a video: what its codecs and decoders take."""

MAX_ROW_PADDING = 4096
"""Most bytes between two rows; bounds what a sidecar can make a reader allocate."""

Pixels = NDArray[Any]
"""Pixels of an image, shape (rows, columns) or (rows, columns, channels)."""


@dataclass(frozen=True, slots=True)
class Encoding:
    """A ROS image encoding that a layout carries.

    Attributes:
        name: As `sensor_msgs/image_encodings` spells it.
        channels: Samples per pixel of the array; 2 for the packed YUV, 1 for the semi-planar.
        dtype: numpy's kind and bytes of a sample: u1, i1, u2, i2, i4, f4 or f8.
        general: The exact layout without parameters that carries every image.
        exact: Exact layouts worth a try, in order of preference; `general` is among them.
        lossy: Layout for lossy codecs; None where a lossy codec would harm the meaning.
        mosaic: For Bayer, the colours of the 2 x 2 block by rows, such as ``rggb``.
        rows: Rows of the array per row of the image: more than 1 for the semi-planar YUV.
        even: Numbers that divide width and height, for chroma of half the resolution.
    """

    name: str
    channels: int
    dtype: str
    general: str
    exact: tuple[str, ...]
    lossy: str | None = None
    mosaic: str = ""
    rows: Fraction = Fraction(1)
    even: tuple[int, int] = (1, 1)

    @property
    def bytes_per_sample(self) -> int:
        """Bytes of a sample."""
        return int(self.dtype[1])

    @property
    def pixel_bytes(self) -> int:
        """Bytes per column of a row."""
        return self.channels * self.bytes_per_sample

    @property
    def is_signed(self) -> bool:
        """Whether samples are integers with a sign."""
        return self.dtype[0] == "i"

    @property
    def is_float(self) -> bool:
        """Whether samples are floats."""
        return self.dtype[0] == "f"

    def shape(self, width: int, height: int) -> tuple[int, ...]:
        """Shape of the pixels of an image whose sides `even` divides."""
        rows = int(height * self.rows)
        return (rows, width) if self.channels == 1 else (rows, width, self.channels)

    def size(self, step: int, height: int) -> int:
        """Bytes of all rows of an image, padding included."""
        return int(step * height * self.rows)


# general layouts by the number of channels, and what further ones may stand beside them
_OF_BYTES = {1: "gray8", 2: "stack8", 3: "bgr24", 4: "bgra"}
_OF_WORDS = {1: "gray16", 2: "stack16", 3: "gbr16", 4: "gbra16"}
_MORE = {
    "gray16": ("gray_bits", "fold", "table", "palette"),
    "gbr16": ("gbr_bits",),
    "gbra16": ("gbra_bits",),
}
_METRES = ("metres16", "metres_fold", "table", "palette")


def _of_samples(name: str, channels: int, dtype: str, lossy: str | None = None) -> Encoding:
    """One to four channels without a meaning of their own, as OpenCV's matrices have them."""
    general = {"1": _OF_BYTES, "2": _OF_WORDS}.get(dtype[1], {}).get(channels, "bytes")
    more = _METRES if name == "32FC1" else _MORE.get(general, ())
    if name == "8UC4":
        more = ("opaque",)
    return Encoding(name, channels, dtype, general, (general, *more), lossy)


def _bayer16(mosaic: str) -> Encoding:
    exact = ("mosaic16", "mosaic_bits", "mosaic_fold")
    return Encoding(f"bayer_{mosaic}16", 1, "u2", "mosaic16", exact, None, mosaic)


def _encodings() -> list[Encoding]:
    bayer = ("rggb", "bggr", "gbrg", "grbg")
    sizes = {
        "8U": "u1",
        "8S": "i1",
        "16U": "u2",
        "16S": "i2",
        "32S": "i4",
        "32F": "f4",
        "64F": "f8",
    }
    lossy = {"8UC1": "gray8", "8UC3": "bgr24"}
    return [
        _of_samples("mono8", 1, "u1", "gray8"),
        _of_samples("mono16", 1, "u2"),
        Encoding("rgb8", 3, "u1", "rgb24", ("rgb24",), "rgb24"),
        Encoding("bgr8", 3, "u1", "bgr24", ("bgr24",), "bgr24"),
        Encoding("rgba8", 4, "u1", "rgba", ("rgba", "opaque")),
        Encoding("bgra8", 4, "u1", "bgra", ("bgra", "opaque")),
        *(_of_samples(f"{order}16", len(order), "u2") for order in ("rgb", "bgr", "rgba", "bgra")),
        *(
            Encoding(f"bayer_{mosaic}8", 1, "u1", "mosaic8", ("mosaic8",), "demosaic8", mosaic)
            for mosaic in bayer
        ),
        *(
            _bayer16(mosaic)
            for mosaic in bayer
        ),
        *(
            _of_samples(f"{size}C{channels}", channels, dtype, lossy.get(f"{size}C{channels}"))
            for size, dtype in sizes.items()
            for channels in range(1, 5)
        ),
        *(
            Encoding(name, 2, "u1", "planar422", ("planar422",), "halved420", even=(2, 1))
            for name in ("yuv422", "uyvy", "yuyv", "yuv422_yuy2")
        ),
        *(
            Encoding(
                name, 1, "u1", "planar420", ("planar420",), "planar420",
                rows=Fraction(3, 2), even=(2, 2),
            )
            for name in ("nv12", "nv21")
        ),
        Encoding("nv24", 1, "u1", "planar444", ("planar444",), "halved420", rows=Fraction(3)),
    ]  # fmt: skip


ENCODINGS: dict[str, Encoding] = {encoding.name: encoding for encoding in _encodings()}


def pixel_view(
    data: memoryview | bytearray,
    encoding: Encoding,
    *,
    width: int,
    height: int,
    step: int,
    is_bigendian: bool,
) -> Pixels:
    """The pixels of an image message, without a copy.

    Args:
        data: At least step * height * encoding.rows bytes.
        encoding: The image's encoding.
        width: Columns.
        height: Rows.
        step: Bytes per row, at least width * pixel bytes.
        is_bigendian: Byte order of samples of more than one byte.

    Returns:
        Array of `Encoding.shape`, of the encoding's type in the message's byte order; writable
        where the data is. ``yuv422`` and its like give (height, width, 2); ``nv12`` and ``nv21``
        (height * 3 / 2, width), luma over interleaved chroma; ``nv24`` (height * 3, width), where
        two rows hold the chroma of one.
    """
    size = encoding.bytes_per_sample
    code = np.dtype(encoding.dtype).newbyteorder(">" if is_bigendian else "<")
    shape = encoding.shape(width, height)
    strides = (step, encoding.pixel_bytes, size)[: len(shape)]
    pixels: Pixels = np.ndarray(shape, code, buffer=data, strides=strides)
    return pixels


def row_padding(
    data: memoryview, encoding: Encoding, *, width: int, height: int, step: int
) -> bytes | None:
    """The bytes after the pixels of each row; None where all rows have them, and all are zero.

    Args:
        data: Of an image for which `why_not` knows no reason.
        encoding: The image's encoding.
        width: Columns.
        height: Rows of the image.
        step: Bytes per row.
    """
    row_bytes = width * encoding.pixel_bytes
    if step == row_bytes:
        return None
    count = encoding.shape(width, height)[0]
    whole = len(data) // step  # the last row may have none
    rows = np.frombuffer(data, np.uint8, count=step * whole).reshape(whole, step)[:, row_bytes:]
    return rows.tobytes() if whole < count or rows.any() else None


def put_padding(data: bytearray | memoryview, padding: bytes, *, row_bytes: int, step: int) -> None:
    """Write what `row_padding` gave after the pixels of each row.

    Args:
        data: All rows, to be changed.
        padding: Of all rows, or of all but the last.
        row_bytes: Of the pixels of a row.
        step: Bytes per row.
    """
    whole = len(padding) // (step - row_bytes)
    rows = np.frombuffer(data, np.uint8, count=step * whole).reshape(whole, step)
    rows[:, row_bytes:] = np.frombuffer(padding, np.uint8).reshape(whole, step - row_bytes)
