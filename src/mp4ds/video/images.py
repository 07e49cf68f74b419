"""Single images as PNG or JPEG files, through the same library as the videos."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import av
import numpy as np

from mp4ds.errors import OptionError
from mp4ds.layouts import ENCODINGS, Pixels
from mp4ds.video.convert import Converter

_JPEG_QUALITY_SCALE = 2  # ffmpeg's qscale: 2 is its best usual quality, near JPEG 95


class ImageFile:
    """Encodes images of one ROS encoding.

    PNG keeps every sample: a Bayer mosaic stays a mosaic in grey, 16 bits stay 16 bits. JPEG is
    for looking at: Bayer is demosaiced, and 16-bit images are refused.

    Args:
        encoding: ROS image encoding.
        image_format: ``png`` or ``jpeg``.

    Raises:
        OptionError: JPEG cannot hold the encoding.
    """

    def __init__(self, encoding: str, image_format: str) -> None:
        known = ENCODINGS[encoding]
        self._jpeg = image_format == "jpeg"
        if self._jpeg and known.bytes_per_sample == 2:
            raise OptionError(f"JPEG cannot hold {encoding} images; use png")
        self._converter = Converter("smpte170m")
        if known.bytes_per_sample == 2:
            self._source, self._pixel_format = "gray16le", "gray16be"
        elif known.channels == 3:
            self._source = "rgb24" if encoding == "rgb8" else "bgr24"
            self._pixel_format = "rgb24"
        else:
            self._source = self._pixel_format = "gray"
        if self._jpeg:
            if known.mosaic:
                self._source = f"bayer_{known.mosaic}8"
            self._pixel_format = "yuvj444p"

    def encode(self, pixels: Pixels) -> bytes:
        """The file's bytes for an image of shape (H, W) or (H, W, C)."""
        contiguous: Any = np.ascontiguousarray(pixels)
        frame = av.VideoFrame.from_numpy_buffer(contiguous, format=self._source)
        if self._source.startswith("bayer_"):
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
            context.qmin = context.qmax = _JPEG_QUALITY_SCALE
        packets = [*context.encode(frame), *context.encode(None)]
        return b"".join(bytes(packet) for packet in packets)
