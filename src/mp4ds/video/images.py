"""Single images as files: PNG through the library of the videos, JPEG through libjpeg."""

from __future__ import annotations

import io
from fractions import Fraction
from typing import Any

import av
import numpy as np

from mp4ds.errors import OptionError
from mp4ds.layouts import CHROMA_SHIFTS, ENCODINGS, Encoding, Layout, Pixels, bind
from mp4ds.video.convert import Converter, plain_frame

_PNG_FORMATS = {
    "gray": "gray",
    "gray16le": "gray16be",
    "rgb24": "rgb24",
    "bgr24": "rgb24",
    "rgba": "rgba",
    "bgra": "rgba",
    "gbrp16le": "rgb48be",
    "gbrap16le": "rgba64be",
    **dict.fromkeys(CHROMA_SHIFTS, "rgb24"),
}


class ImageFile:
    """Encodes images of one ROS encoding.

    PNG keeps every sample, but YUV becomes RGB: a Bayer mosaic stays a mosaic in grey, 16 bits
    stay 16 bits. JPEG is for looking at: Bayer is demosaiced, alpha is left out; grey images
    have one component, as decoders expect of them.

    Args:
        encoding: ROS image encoding.
        image_format: ``png`` or ``jpeg``.
        quality: Of JPEG, 1 to 100, as libjpeg has it.

    Raises:
        OptionError: The format cannot hold the encoding, or there is no such quality.
    """

    def __init__(self, encoding: str, image_format: str, *, quality: int = 95) -> None:
        known = ENCODINGS[encoding]
        self._jpeg = image_format == "jpeg"
        if known.dtype not in ("u1", "u2") or known.general.startswith("stack"):
            raise OptionError(
                f"{image_format} cannot hold {encoding} images: it has neither signs, floats nor "
                "two channels. Unpack to a recording."
            )
        if self._jpeg and known.bytes_per_sample == 2:
            raise OptionError(f"JPEG cannot hold {encoding} images; use png")
        if not 1 <= quality <= 100:
            raise OptionError(f"a JPEG quality of {quality}: use 1 to 100")
        self._quality = quality
        self._layout = _layout(known, demosaic=self._jpeg)
        self._is_yuv = self._layout.pixel_format in CHROMA_SHIFTS
        self._from_yuv = Converter("smpte170m", source_full_range=False)
        self._converter = Converter("smpte170m")
        self._pixel_format = _PNG_FORMATS.get(self._layout.pixel_format, "rgb24")
        if self._jpeg and self._pixel_format != "gray":
            self._pixel_format = "rgb24"  # libjpeg knows no alpha

    def encode(self, pixels: Pixels) -> bytes:
        """The file's bytes for an image as `mp4ds.layouts.pixel_view` gives it."""
        frame = plain_frame(self._layout.to_picture(pixels), self._layout.pixel_format)
        if self._is_yuv:
            frame = self._from_yuv.convert(frame, "rgb24")
        elif frame.format.name.startswith("bayer_"):
            frame = self._converter.convert(frame, "rgb24")
        if frame.format.name != self._pixel_format:
            frame = self._converter.convert(frame, self._pixel_format)
        return self._jpeg_file(frame) if self._jpeg else _png_file(frame)

    def _jpeg_file(self, frame: av.VideoFrame) -> bytes:
        from PIL import Image

        channels = 1 if self._pixel_format == "gray" else 3
        plane: Any = frame.planes[0]
        rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)
        packed = np.ascontiguousarray(rows[: frame.height, : channels * frame.width])
        mode, size = ("L" if channels == 1 else "RGB"), (frame.width, frame.height)
        file = io.BytesIO()
        # full chroma: what is published as colour was often demosaiced, and is sharp in it
        Image.frombuffer(mode, size, packed, "raw", mode, 0, 1).save(
            file, "JPEG", quality=self._quality, subsampling=0
        )
        return file.getvalue()


def _png_file(frame: av.VideoFrame) -> bytes:
    frame.pts = 0
    context: Any = av.CodecContext.create("png", "w")
    context.width, context.height = frame.width, frame.height
    context.pix_fmt = frame.format.name
    context.time_base = Fraction(1, 25)
    return b"".join(map(bytes, [*context.encode(frame), *context.encode(None)]))


def _layout(encoding: Encoding, *, demosaic: bool) -> Layout:
    """A layout whose pictures look like the images, or like their mosaic."""
    if not encoding.mosaic:
        return bind(encoding.general, encoding)
    if demosaic and encoding.lossy:
        return bind(encoding.lossy, encoding)
    plain = ENCODINGS["mono8" if encoding.bytes_per_sample == 1 else "mono16"]
    return bind(plain.general, plain)
