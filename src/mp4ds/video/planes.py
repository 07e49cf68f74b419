"""Pictures and videos as planes of luma and chroma: what a lossy encoder is given, and gives."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np
from av.error import FFmpegError
from numpy.typing import NDArray

from mp4ds.errors import VideoError
from mp4ds.layouts import Picture
from mp4ds.video.codecs import Recipe
from mp4ds.video.convert import Converter, picture_to_frame
from mp4ds.video.depths import TEN_BITS, narrowed, samples
from mp4ds.video.media import Media
from mp4ds.video.scarcity import raise_if_scarce

PLANES_FORMAT = "yuv420p"
"""Pixel format of the planes."""

Planes = tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint8]]
"""Luma, and chroma of half its sides."""


class PlaneMaker:
    """Makes of pictures what the encoder of a lossy recipe is given; not for several threads.

    Args:
        picture_format: Pixel format of the pictures.
    """

    def __init__(self, picture_format: str) -> None:
        self._picture_format = picture_format
        self._converter = Converter()

    def make(self, picture: Picture) -> Planes:
        """The planes of a picture, of their own memory; sides that are odd are padded."""
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
    """The planes of a frame that stand one after the other, as views.

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
        Views that hold until the next one is asked for.

    Raises:
        VideoError: It does not decode, or to something else.
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
    """The colours that planes are shown in, shape (H, W, 3).

    Args:
        planes: Of a picture, or of a part of it that begins at an even place.
        recipe: Tells how its colours are coded.
    """
    rows, columns = planes[0].shape
    frame = av.VideoFrame(columns, rows, PLANES_FORMAT)
    for target, plane in zip(planes_of(frame), planes, strict=True):
        np.copyto(target, plane)
    converter = Converter(recipe.matrix, source_full_range=recipe.full_range)
    return np.asarray(converter.convert(frame, "rgb24").to_ndarray(), np.uint8)


@dataclass(frozen=True, slots=True)
class PacketSizes:
    """How the packets of a video share its bytes.

    Attributes:
        keys: Bytes of each frame at which decoding can begin.
        others: Bytes of each of the other ones.
    """

    keys: tuple[int, ...]
    others: tuple[int, ...]

    @property
    def total(self) -> int:
        """Bytes of all of them."""
        return sum(self.keys) + sum(self.others)

    def frame_bytes(self, gop: int) -> float:
        """Bytes of a frame of a long video: a clip has more key frames than its share.

        Args:
            gop: Frames from one key frame to the next.
        """
        key = sum(self.keys) / max(1, len(self.keys))
        if not self.others:
            return key
        return (key + (gop - 1) * sum(self.others) / len(self.others)) / gop


def packet_sizes(path: Path) -> PacketSizes:
    """The sizes of a video's packets.

    Raises:
        VideoError: It cannot be read.
    """
    keys: list[int] = []
    others: list[int] = []
    try:
        with closing(Media(path)) as media:
            for packet in media.container.demux(media.track):
                if packet.size:
                    (keys if packet.is_keyframe else others).append(packet.size)
    except (FFmpegError, OSError) as error:
        raise_if_scarce(error)
        raise VideoError("video-unreadable", path, f"cannot be read: {error}") from None
    return PacketSizes(tuple(keys), tuple(others))
