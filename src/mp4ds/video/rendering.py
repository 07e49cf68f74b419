"""Pixels of ROS encodings as RGB, BGR or grey, and in another size, by libswscale."""

from __future__ import annotations

import re
from typing import Any

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace, VideoReformatter
from numpy.typing import NDArray

from mp4ds.layouts import CHROMA_SHIFTS, ENCODINGS, Encoding, Pixels, bind
from mp4ds.video.convert import Converter, plain_frame

# libswscale's flags, as in `mp4ds.video.convert`: full chroma, accurate rounding, bit-exact
_CARE = 0x2000 | 0x4000 | 0x40000 | 0x80000
_AREA, _BICUBIC = 0x20 | _CARE, 0x4 | _CARE

# channels and samples of packed formats
_PACKED = {
    "gray": (1, "u1"),
    "rgb24": (3, "u1"),
    "bgr24": (3, "u1"),
    "rgba": (4, "u1"),
    "bgra": (4, "u1"),
    "gray16le": (1, "<u2"),
    "rgb48le": (3, "<u2"),
    "bgr48le": (3, "<u2"),
    "rgba64le": (4, "<u2"),
    "bgra64le": (4, "<u2"),
}
# numbers of channels that are colours by the registry: blue, green, red and alpha
_NAMED = {"mono8": "gray", "mono16": "gray16le", "8UC1": "gray", "8UC3": "bgr24", "8UC4": "bgra",
          "16UC3": "bgr48le", "16UC4": "bgra64le"}  # fmt: skip
_BY_BITS = {
    8: {"rgb": "rgb24", "bgr": "bgr24", "gray": "gray"},
    16: {"rgb": "rgb48le", "bgr": "bgr48le", "gray": "gray16le"},
}
_ENCODING_OF = {
    "rgb24": "rgb8",
    "bgr24": "bgr8",
    "gray": "mono8",
    "rgb48le": "rgb16",
    "bgr48le": "bgr16",
    "gray16le": "mono16",
}


def shown_format(encoding: Encoding) -> str | None:
    """Name in ffmpeg of what the pixels look like, or None where they are no light.

    Depths, signed numbers, floats, and pairs of channels are data. A Bayer mosaic is its own
    format, and YUV its planes.
    """
    if encoding.mosaic:
        return f"bayer_{encoding.name[6:10]}" + ("8" if encoding.bytes_per_sample == 1 else "16le")
    if encoding.even != (1, 1) or encoding.rows != 1:
        return bind(encoding.general, encoding).pixel_format
    if encoding.name in _NAMED:
        return _NAMED[encoding.name]
    found = re.fullmatch("(rgba?|bgra?)(8|16)", encoding.name)
    if found is None:
        return None
    order, bits = found.groups()
    if bits == "8":
        return order if len(order) == 4 else f"{order}24"
    return f"{order}{16 * len(order)}le"


def encoding_as(encoding: Encoding, colours: str) -> str | None:
    """The ROS encoding of pixels made into ``rgb``, ``bgr`` or ``gray``; 16 bits stay 16 bits.

    Returns:
        None where the pixels are no light.
    """
    if shown_format(encoding) is None:
        return None
    return _ENCODING_OF[_BY_BITS[8 * encoding.bytes_per_sample][colours]]


class Renderer:
    """Makes pixels of one encoding into another, of another size; not for several threads.

    Mosaics are interpolated, camera YUV is BT.601 of limited range, alpha is left out, and grey is
    the luma of BT.601. Sizes are reduced by area and enlarged by bicubic interpolation.

    Args:
        encoding: Of the pixels; one that `shown_format` knows.
        target: ROS encoding to make: one of `encoding_as`, or the same encoding where it is
            neither a mosaic nor YUV.
        crop: x, y, width and height of the part to take first, or None for all of it.
        size: Width and height of what is made.
    """

    def __init__(
        self,
        encoding: Encoding,
        target: str,
        *,
        crop: tuple[int, int, int, int] | None,
        size: tuple[int, int],
    ) -> None:
        shown = shown_format(encoding)
        if shown is None:
            raise ValueError(f"{encoding.name} images show nothing")
        self._encoding = encoding
        self._source = shown
        self._target = shown_format(ENCODINGS[target])
        self._crop = crop
        self._size = size
        self._layout = bind(encoding.general, encoding) if shown in CHROMA_SHIFTS else None
        self._camera = Converter("smpte170m", source_full_range=False)
        self._colours = Converter("smpte170m")
        self._reformatter = VideoReformatter()

    def render(self, pixels: Pixels, out: Pixels) -> None:
        """Write what the pixels become.

        Args:
            pixels: Of the encoding, native byte order.
            out: Of the target's shape and type.
        """
        array, pixel_format = self._packed(pixels)
        if self._crop is not None:
            x, y, width, height = self._crop
            array = array[y : y + height, x : x + width]
        height, width = array.shape[:2]
        if pixel_format == self._target and (width, height) == self._size:
            np.copyto(out, array)
            return
        is_smaller = self._size[0] * self._size[1] < width * height
        frame = self._reformatter.reformat(
            _frame(array, pixel_format),
            width=self._size[0],
            height=self._size[1],
            format=self._target,
            src_colorspace=Colorspace.ITU601,
            dst_colorspace=Colorspace.ITU601,
            src_color_range=ColorRange.JPEG,
            dst_color_range=ColorRange.JPEG,
            interpolation=_AREA if is_smaller else _BICUBIC,
            threads=1,  # a pool inherited over fork would never end
        )
        np.copyto(out, _array(frame))

    def _packed(self, pixels: Pixels) -> tuple[NDArray[Any], str]:
        """The image in one array, and ffmpeg's name of its format; YUV and mosaics as RGB."""
        if self._layout is not None:
            frame = plain_frame(self._layout.to_picture(pixels), self._source)
            return _array(self._camera.convert(frame, "rgb24")), "rgb24"
        if self._encoding.mosaic:
            height, width = pixels.shape
            frame = plain_frame((_even_mosaic(pixels),), self._source)
            made = "rgb24" if self._encoding.bytes_per_sample == 1 else "rgb48le"
            return _array(self._colours.convert(frame, made))[:height, :width], made
        return pixels, self._source


def _even_mosaic(pixels: Pixels) -> Pixels:
    """Whole blocks of the pattern: what is missing repeats the same colour's last row or column."""
    pad = [(0, side % 2) for side in pixels.shape]
    if not any(after for _, after in pad):
        return pixels
    return np.pad(pixels, pad, mode="reflect" if min(pixels.shape) > 1 else "edge")


def _frame(array: NDArray[Any], pixel_format: str) -> av.VideoFrame:
    if pixel_format in ("gray", "gray16le") or _PACKED[pixel_format][1] == "u1":
        return plain_frame((array,), pixel_format)
    frame = av.VideoFrame(array.shape[1], array.shape[0], pixel_format)
    _array(frame)[...] = array
    return frame


def _array(frame: av.VideoFrame) -> NDArray[Any]:
    """The pixels of a packed frame as a view of shape (H, W) or (H, W, C)."""
    channels, samples = _PACKED[frame.format.name]
    plane: Any = frame.planes[0]  # a buffer, which its type does not tell
    rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)
    row_bytes = frame.width * channels * np.dtype(samples).itemsize
    pixels = rows[: frame.height, :row_bytes].view(samples)
    return pixels if channels == 1 else pixels.reshape(frame.height, frame.width, channels)
