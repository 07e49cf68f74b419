"""The samples of a video as its codec defines them, in whatever form a decoder gives them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.error import FFmpegError
from numpy.typing import NDArray

from mp4ds.errors import VideoError
from mp4ds.video.media import Media
from mp4ds.video.scarcity import raise_if_scarce

# where green, blue, red and alpha stand in a pixel of packed formats
_PACKED = {
    "rgb24": (1, 2, 0),
    "bgr24": (1, 0, 2),
    "rgb0": (1, 2, 0),
    "bgr0": (1, 0, 2),
    "rgba": (1, 2, 0, 3),
    "bgra": (1, 0, 2, 3),
}
_DEEP = ("le", "be")


@dataclass(frozen=True, slots=True)
class RawPicture:
    """A decoded picture, one array for each of its planes.

    Attributes:
        pixel_format: ffmpeg's name of the planar format: a grey, YUV or GBR one.
        planes: Arrays of shape (rows, columns), uint8 or little-endian uint16.
    """

    pixel_format: str
    planes: tuple[NDArray[Any], ...]

    def tobytes(self) -> bytes:
        """The planes one after the other, by rows without padding."""
        return b"".join(plane.tobytes() for plane in self.planes)


def raw_pictures(path: Path, *, is_gray: bool) -> Iterator[RawPicture]:
    """Every picture of a video, in order; memory is that of one.

    Args:
        path: An mp4 with one video track.
        is_gray: Whether chroma is no part of it: decoders make it up for a grey video, or do not.

    Yields:
        Views that hold until the next one is asked for.

    Raises:
        VideoError: ``file-missing``, ``video-unreadable`` or ``decode-failed``.
    """
    media = Media(path)
    number = 0
    try:
        for frame in media.container.decode(media.track):
            if frame.is_corrupt:
                raise VideoError("decode-failed", path, f"frame {number} is marked as corrupt")
            yield _raw(frame, is_gray=is_gray)
            number += 1
    except (FFmpegError, OSError) as error:
        raise_if_scarce(error)
        raise VideoError(
            "decode-failed", path, f"frame {number} cannot be decoded: {error}"
        ) from None
    finally:
        media.close()


def _raw(frame: av.VideoFrame, *, is_gray: bool) -> RawPicture:
    name = frame.format.name
    if name in _PACKED:
        places = _PACKED[name]
        rows = _samples(frame, 0)
        pixels = rows[:, : len(rows[0]) // _stride(name) * _stride(name)]
        pixels = pixels.reshape(len(rows), -1, _stride(name))[:, : frame.width]
        planes = tuple(pixels[..., place] for place in places)
        return RawPicture("gbrap" if len(places) == 4 else "gbrp", planes)
    name = name.replace("yuvj", "yuv")  # full range, told by name
    if is_gray and name.startswith("yuv"):
        bits = name.partition("p")[2]
        name = f"gray{bits}" if bits else "gray"
    count = 1 if name.startswith("gray") else len(frame.planes)
    planes = tuple(_samples(frame, index)[:, : frame.planes[index].width] for index in range(count))
    return RawPicture(name, planes)


def _stride(name: str) -> int:
    return 3 if name.endswith("24") else 4


def _samples(frame: av.VideoFrame, index: int) -> NDArray[Any]:
    """The rows of a plane as samples, padding included."""
    plane: Any = frame.planes[index]  # a buffer, which its type does not tell
    rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[: plane.height]
    return rows.view("<u2") if frame.format.name.endswith(_DEEP) else rows
