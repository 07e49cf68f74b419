"""Decoding single JPEG files."""

from __future__ import annotations

from typing import Any

import av
import numpy as np
from av.error import FFmpegError
from numpy.typing import NDArray

from mp4ds.coded import Refused
from mp4ds.video.convert import Converter
from mp4ds.video.scarcity import raise_if_scarce

_FORMATS = {"mono8": "gray", "rgb8": "rgb24"}


class JpegDecoder:
    """Decodes the JPEG files of one topic; not to be shared between threads."""

    def __init__(self) -> None:
        self._converter = Converter("smpte170m")  # what JFIF says

    def decode(self, data: bytes | memoryview, encoding: str) -> NDArray[np.uint8]:
        """The pixels of a file.

        Args:
            data: The file.
            encoding: ``mono8`` or ``rgb8``.

        Returns:
            Shape (H, W) or (H, W, 3).

        Raises:
            Refused: It does not decode.
        """
        context: Any = av.CodecContext.create("mjpeg", "r")
        try:
            frames = [*context.decode(av.Packet(bytes(data))), *context.decode(None)]
        except FFmpegError as error:
            raise_if_scarce(error)
            raise Refused(f"its JPEG does not decode: {error.strerror}") from None
        if len(frames) != 1 or frames[0].is_corrupt:
            raise Refused("its JPEG does not decode")
        frame = self._converter.convert(frames[0], _FORMATS[encoding])
        plane: Any = frame.planes[0]
        rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)
        if encoding == "mono8":
            return rows[: frame.height, : frame.width]
        return rows[: frame.height, : 3 * frame.width].reshape(frame.height, frame.width, 3)
