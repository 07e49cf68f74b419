"""How the pixels of a ROS image become the picture that a video holds, and return.

numpy only. A picture is what the encoder is given, in one of ffmpeg's pixel formats; the
codec is not chosen here. Exact layouts are bijections, so that a lossless codec gives the
pixels back; the colour layout is for lossy profiles (spec/registry.md, "Layouts").
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import OptionError

MAX_SIDE = 16384
"""Largest width and height of an image in a video: what its codecs and decoders take."""

MAX_ROW_PADDING = 4096
"""Most bytes between two rows; bounds what a sidecar can make a reader allocate."""

Pixels = NDArray[np.uint8] | NDArray[np.uint16]


@dataclass(frozen=True, slots=True)
class Encoding:
    """A ROS image encoding that a layout carries.

    Attributes:
        name: As `sensor_msgs/image_encodings` spells it.
        channels: Samples per pixel.
        bytes_per_sample: 1 or 2.
        exact: Layout for lossless codecs.
        lossy: Layout for lossy codecs; None where a lossy codec would harm the meaning.
        mosaic: For Bayer, the colours of the 2 x 2 block by rows, such as ``rggb``.
    """

    name: str
    channels: int
    bytes_per_sample: int
    exact: str
    lossy: str | None
    mosaic: str = ""

    @property
    def pixel_bytes(self) -> int:
        """Bytes per pixel."""
        return self.channels * self.bytes_per_sample


ENCODINGS: dict[str, Encoding] = {
    encoding.name: encoding
    for encoding in (
        Encoding("mono8", 1, 1, "gray8", "gray8"),
        Encoding("rgb8", 3, 1, "rgb24", "rgb24"),
        Encoding("bgr8", 3, 1, "bgr24", "bgr24"),
        *(
            Encoding(f"bayer_{mosaic}8", 1, 1, "mosaic8", "demosaic8", mosaic)
            for mosaic in ("rggb", "bggr", "gbrg", "grbg")
        ),
        Encoding("mono16", 1, 2, "gray16", None),
        Encoding("16UC1", 1, 2, "gray16", None),
    )
}


@dataclass(frozen=True, slots=True)
class Layout:
    """One way of laying pixels out as a picture.

    Attributes:
        name: As the registry spells it.
        pixel_format: ffmpeg's name of the picture's format; ``bayer_`` is completed with
            the stream's mosaic.
        picture_size: (width, height) of the image -> of the picture.
        to_picture: Pixels, shape (H, W) or (H, W, C) -> picture. May be a view.
        to_pixels: (picture, out) writes the pixels into ``out``.
    """

    name: str
    pixel_format: str
    picture_size: Callable[[int, int], tuple[int, int]]
    to_picture: Callable[[Pixels], Pixels]
    to_pixels: Callable[[Pixels, Pixels], None]


def _same_size(width: int, height: int) -> tuple[int, int]:
    return width, height


def _even_size(width: int, height: int) -> tuple[int, int]:
    return width + width % 2, height + height % 2


def _same(pixels: Pixels) -> Pixels:
    return pixels


def _copy(picture: Pixels, out: Pixels) -> None:
    np.copyto(out, picture)


def _tile_mosaic(pixels: Pixels) -> Pixels:
    """Four half-size pictures, one per place in the 2 x 2 block, in a 2 x 2 grid.

    Neighbours then hold the same colour, which is what predictors expect. An odd last row or
    column of a tile repeats its neighbour.
    """
    height, width = pixels.shape
    half_height, half_width = (height + 1) // 2, (width + 1) // 2
    picture = np.empty((2 * half_height, 2 * half_width), dtype=pixels.dtype)
    for row in (0, 1):
        for column in (0, 1):
            part = pixels[row::2, column::2] if pixels[row::2, column::2].size else pixels[:1, :1]
            tile = picture[
                row * half_height : (row + 1) * half_height,
                column * half_width : (column + 1) * half_width,
            ]
            tile[: part.shape[0], : part.shape[1]] = part
            tile[part.shape[0] :, : part.shape[1]] = part[-1:]
            tile[:, part.shape[1] :] = tile[:, part.shape[1] - 1 : part.shape[1]]
    return picture


def _untile_mosaic(picture: Pixels, out: Pixels) -> None:
    height, width = out.shape
    half_height, half_width = (height + 1) // 2, (width + 1) // 2
    for row in (0, 1):
        for column in (0, 1):
            target = out[row::2, column::2]
            target[...] = picture[
                row * half_height : row * half_height + target.shape[0],
                column * half_width : column * half_width + target.shape[1],
            ]


LAYOUTS: dict[str, Layout] = {
    layout.name: layout
    for layout in (
        Layout("gray8", "gray", _same_size, _same, _copy),
        Layout("gray16", "gray16le", _same_size, _same, _copy),
        Layout("rgb24", "rgb24", _same_size, _same, _copy),
        Layout("bgr24", "bgr24", _same_size, _same, _copy),
        Layout("mosaic8", "gray", _even_size, _tile_mosaic, _untile_mosaic),
        # demosaicing is done by the video's converter; sampling it again gives the mosaic
        Layout("demosaic8", "bayer_", _same_size, _same, _copy),
    )
}


def layout_for(encoding: Encoding, *, lossless: bool) -> Layout:
    """The layout of an encoding for a lossless or lossy codec.

    Raises:
        OptionError: No lossy layout exists.
    """
    name = encoding.exact if lossless else encoding.lossy
    if name is None:
        raise OptionError(f"{encoding.name} images are only stored losslessly")
    return LAYOUTS[name]


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
        data: At least step * height bytes.
        encoding: The image's encoding.
        width: Columns.
        height: Rows.
        step: Bytes per row, at least width * pixel bytes.
        is_bigendian: Byte order of 16-bit samples.

    Returns:
        Array of shape (height, width) or (height, width, channels), uint8 or uint16 in the
        message's byte order; writable where the data is.
    """
    code = "u1" if encoding.bytes_per_sample == 1 else ">u2" if is_bigendian else "<u2"
    shape: tuple[int, ...] = (height, width)
    strides: tuple[int, ...] = (step, encoding.pixel_bytes)
    if encoding.channels > 1:
        shape += (encoding.channels,)
        strides += (encoding.bytes_per_sample,)
    pixels: Pixels = np.ndarray(shape, code, buffer=data, strides=strides)
    return pixels


def padding_is_zero(data: memoryview, *, row_bytes: int, step: int, height: int) -> bool:
    """Whether all bytes between the rows are zero, which is what a rebuilt image has there."""
    if step == row_bytes:
        return True
    rows = np.frombuffer(data, np.uint8, count=step * height).reshape(height, step)
    return not rows[:, row_bytes:].any()


def why_not(encoding_name: str, *, width: int, height: int, step: int, size: int) -> str | None:
    """Why no layout carries an image of this geometry, or None if one does."""
    encoding = ENCODINGS.get(encoding_name)
    if encoding is None:
        return f"no layout for encoding {encoding_name!r} yet"
    if width == 0 or height == 0:
        return f"an image of {width}x{height} pixels"
    if step < width * encoding.pixel_bytes:
        return f"step {step} is shorter than a row of {width} {encoding.name} pixels"
    if size != step * height:
        return f"{size} bytes of pixels where step x height says {step * height}"
    if width > MAX_SIDE or height > MAX_SIDE:
        return f"an image of {width}x{height} pixels, beyond {MAX_SIDE}"
    if step > width * encoding.pixel_bytes + MAX_ROW_PADDING:
        return f"more than {MAX_ROW_PADDING} bytes of padding in a row"
    return None
