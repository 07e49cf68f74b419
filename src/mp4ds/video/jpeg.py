"""JPEG files as libjpeg decodes them: to the pixels that OpenCV and image_transport have, too."""

from __future__ import annotations

import errno
import io
import struct
from collections.abc import Iterable, Iterator
from typing import Any

import av
import numpy as np
from av.error import InvalidDataError
from numpy.typing import NDArray

from mp4ds.coded import Refused

_ENCODINGS = {"L": "mono8", "RGB": "rgb8"}
_FORMATS = {"mono8": "gray", "rgb8": "rgb24"}


def jpeg_pixels(data: bytes | memoryview, size: tuple[int, int]) -> tuple[str, NDArray[np.uint8]]:
    """The pixels of a file, turned by no tag and converted by no profile.

    Args:
        data: The file.
        size: Its width and height; nothing larger is unpacked.

    Returns:
        The ROS encoding, ``mono8`` or ``rgb8``, and pixels of shape (H, W) or (H, W, 3).

    Raises:
        Refused: It does not decode, or is of another size or kind.
    """
    from PIL.JpegImagePlugin import JpegImageFile

    try:
        with JpegImageFile(io.BytesIO(data)) as image:
            if image.mode not in _ENCODINGS:
                raise ValueError(f"it has colours of another kind ({image.mode})")
            if image.size != size:
                raise ValueError(f"it has {image.width}x{image.height} pixels")
            return _ENCODINGS[image.mode], np.asarray(image)
    except MemoryError:
        raise
    except (OSError, SyntaxError, ValueError, EOFError, LookupError, struct.error) as error:
        raise Refused(f"its JPEG does not decode: {error}") from None


class JpegDecoder:
    """Takes the place of ffmpeg's decoder of JPEG files, as much of it as is used.

    Args:
        size: Width and height of the frames.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._size = size

    def decode(self, packet: Any) -> list[av.VideoFrame]:
        """The frame of a packet; none of the empty one that ends a video.

        Raises:
            InvalidDataError: It does not decode.
        """
        if packet is None or not packet.size:
            return []
        try:
            encoding, pixels = jpeg_pixels(bytes(packet), self._size)
        except Refused as error:
            raise InvalidDataError(errno.EINVAL, str(error)) from None
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), _FORMATS[encoding])
        frame.pts = packet.pts
        if packet.time_base:
            frame.time_base = packet.time_base
        return [frame]

    def frames(self, packets: Iterable[Any]) -> Iterator[av.VideoFrame]:
        """The frames of packets, in order."""
        for packet in packets:
            yield from self.decode(packet)

    def flush_buffers(self) -> None:
        """There is nothing to forget."""
