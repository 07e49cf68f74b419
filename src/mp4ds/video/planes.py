"""Pictures and videos as planes of luma and chroma: the input and output of lossy encoders."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
from av.error import FFmpegError
from numpy.typing import NDArray

from mp4ds.errors import VideoError
from mp4ds.messages.encodings import Picture
from mp4ds.video.codecs import TEN_BITS, Recipe
from mp4ds.video.colour import samples
from mp4ds.video.media import Media, raise_if_scarce
from mp4ds.video.pixels import PictureConverter, narrowed, picture_to_frame

PLANES_FORMAT = "yuv420p"
"""Pixel format of the planes."""

Planes = tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint8]]
"""Luma, and chroma of half the width and height."""


class PlaneMaker:
    """Converts pictures to a lossy encoder's input; not thread-safe.

    Args:
        picture_format: Pixel format of the pictures.
    """

    def __init__(self, picture_format: str) -> None:
        self._picture_format = picture_format
        self._converter = PictureConverter()

    def make(self, picture: Picture) -> Planes:
        """The planes of a picture, in new memory; odd sides are padded."""
        frame = picture_to_frame(picture, self._picture_format, PLANES_FORMAT, self._converter)
        y, u, v = (plane.copy() for plane in planes_of(frame))
        rows, columns = y.shape
        if rows % 2 or columns % 2:
            y = np.pad(y, ((0, rows % 2), (0, columns % 2)), mode="edge")
        return y, u, v


def planes_of(frame: av.VideoFrame) -> Planes:
    """The planes of a frame of `PLANES_FORMAT`, as views of it."""
    y, u, v = (samples(frame, index) for index in range(3))
    return y, u, v


def planes_in(frame: NDArray[np.uint8], width: int, height: int) -> Planes:
    """The planes of a frame, stored one after another, as views.

    Args:
        frame: uint8, shape (width * height * 3 / 2,).
        width: Columns, even.
        height: Rows, even.
    """
    luma = width * height
    return (
        frame[:luma].reshape(height, width),
        frame[luma : luma * 5 // 4].reshape(height // 2, width // 2),
        frame[luma * 5 // 4 :].reshape(height // 2, width // 2),
    )


def decoded_planes(path: Path) -> Iterator[Planes]:
    """The frames of a video in order, decoded by one thread.

    Args:
        path: A video with halved chroma, of 8 bits, or of 10, which are rounded.

    Yields:
        Views that are valid until the next one is requested.

    Raises:
        VideoError: It cannot be decoded, or has another format.
    """
    media = Media(path)
    try:
        media.track.thread_count = 1
        for frame in media.container.decode(media.track):
            if frame.format.name == TEN_BITS:
                frame = narrowed(frame)
            if frame.format.name not in (PLANES_FORMAT, f"yuvj{PLANES_FORMAT[3:]}"):
                raise VideoError(
                    "codec-mismatch", path, f"decodes to {frame.format.name}, not {PLANES_FORMAT}"
                )
            yield planes_of(frame)
    except FFmpegError as error:
        raise_if_scarce(error)
        raise VideoError("decode-failed", path, f"cannot be decoded: {error}") from None
    finally:
        media.close()


def rgb_of(planes: Planes, recipe: Recipe) -> NDArray[np.uint8]:
    """The colours in which planes are displayed, shape (H, W, 3).

    Args:
        planes: Of a picture, or of a part of it that begins at an even place.
        recipe: States how its colours are coded.
    """
    rows, columns = planes[0].shape
    frame = av.VideoFrame(columns, rows, PLANES_FORMAT)
    for target, plane in zip(planes_of(frame), planes, strict=True):
        np.copyto(target, plane)
    converter = PictureConverter(recipe.matrix, source_full_range=recipe.full_range)
    return np.asarray(converter.convert(frame, "rgb24").to_ndarray(), np.uint8)


# ---------------------------------------------------------------- spool


class PlaneSpool:
    """The planes of a few frames, in a file; only one is in memory at a time.

    Args:
        path: The file to make; the caller removes it.
        width: Columns of a frame, even.
        height: Rows of a frame, even.
        frames: How many frames an existing file has, to read it again; None: make a new one.
    """

    def __init__(self, path: Path, width: int, height: int, *, frames: int | None = None) -> None:
        self.width, self.height = width, height
        self._size = width * height * 3 // 2
        self._file = path.open("w+b" if frames is None else "rb", buffering=0)
        self._count = frames or 0

    def __len__(self) -> int:
        return self._count

    def append(self, planes: Planes) -> None:
        """Add a frame.

        Raises:
            OSError: It cannot be written.
        """
        self._file.seek(self._count * self._size)
        for plane in planes:
            data = np.ascontiguousarray(plane).data.cast("B")
            while data:
                data = data[self._file.write(data) :]
        self._count += 1

    def __iter__(self) -> Iterator[Planes]:
        return map(self.frame, range(self._count))

    def frame(self, number: int) -> Planes:
        """The planes of one frame, in new memory.

        Raises:
            OSError: The file cannot be read.
        """
        data = np.empty(self._size, np.uint8)
        rest = data.data
        self._file.seek(number * self._size)
        while rest:
            count = self._file.readinto(rest)
            if not count:
                raise OSError("frames kept on disk were truncated")
            rest = rest[count:]
        return planes_in(data, self.width, self.height)

    def clear(self) -> None:
        """Drop all frames."""
        self._count = 0

    def close(self) -> None:
        """Close the file."""
        self._file.close()
