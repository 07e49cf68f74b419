"""Single images as PNG or JPEG files, through the same library as the videos."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import av

from mp4ds.coded import jpeg_gray
from mp4ds.errors import OptionError
from mp4ds.layouts import CHROMA_SHIFTS, ENCODINGS, Encoding, Layout, Pixels, bind
from mp4ds.video.convert import Converter, plain_frame

_COARSEST = 31  # of ffmpeg's quantiser scales for JPEG

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
        quality: Of JPEG, 1 to 100, as libjpeg has it; above 95 nothing is gained.

    Raises:
        OptionError: The format cannot hold the encoding, or there is no such quality.
    """

    def __init__(self, encoding: str, image_format: str, *, quality: int = 90) -> None:
        known = ENCODINGS[encoding]
        self._jpeg = image_format == "jpeg"
        if known.dtype not in ("u1", "u2") or known.general.startswith("stack"):
            raise OptionError(
                f"{image_format} cannot hold {encoding} images: it has neither signs, floats nor "
                "two channels. Unpack to a recording."
            )
        if self._jpeg and known.bytes_per_sample == 2:
            raise OptionError(f"JPEG cannot hold {encoding} images; use png")
        self._quality, self._scale = quality, _quantiser_scale(quality)
        self._layout = _layout(known, demosaic=self._jpeg)
        self._is_yuv = self._layout.pixel_format in CHROMA_SHIFTS
        self._from_yuv = Converter("smpte170m", source_full_range=False)
        self._converter = Converter("smpte170m")
        self._pixel_format = "yuvj444p" if self._jpeg else _PNG_FORMATS[self._layout.pixel_format]

    def encode(self, pixels: Pixels) -> bytes:
        """The file's bytes for an image as `mp4ds.layouts.pixel_view` gives it."""
        picture = self._layout.to_picture(pixels)
        if self._jpeg and self._layout.pixel_format == "gray":
            return jpeg_gray.encode(picture[0], self._quality)
        frame = plain_frame(picture, self._layout.pixel_format)
        if self._is_yuv:
            frame = self._from_yuv.convert(frame, "rgb24")
        elif frame.format.name.startswith("bayer_"):
            frame = self._converter.convert(frame, "rgb24")
        if frame.format.name != self._pixel_format:
            frame = self._converter.convert(frame, self._pixel_format)
        frame.pts = 0
        context: Any = av.CodecContext.create("mjpeg" if self._jpeg else "png", "w")
        context.width, context.height = frame.width, frame.height
        context.pix_fmt = self._pixel_format
        context.time_base = Fraction(1, 25)
        if self._jpeg:
            context.color_range = 2
            context.qmin = context.qmax = self._scale
        packets = [*context.encode(frame), *context.encode(None)]
        return b"".join(bytes(packet) for packet in packets)


def _quantiser_scale(quality: int) -> int:
    """The scale that makes files of about the size and error that libjpeg's have."""
    if not 1 <= quality <= 100:
        raise OptionError(f"a JPEG quality of {quality}: use 1 to 100")
    percent = 5000 / quality if quality < 50 else 200 - 2 * quality  # of libjpeg's tables
    return min(max(round(percent * 8 / 100), 1), _COARSEST)


def _layout(encoding: Encoding, *, demosaic: bool) -> Layout:
    """A layout whose pictures look like the images, or like their mosaic."""
    if not encoding.mosaic:
        return bind(encoding.general, encoding)
    if demosaic and encoding.lossy:
        return bind(encoding.lossy, encoding)
    plain = ENCODINGS["mono8" if encoding.bytes_per_sample == 1 else "mono16"]
    return bind(plain.general, plain)
