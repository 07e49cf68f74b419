"""The pictures of one video, out of its decoded frames."""

from __future__ import annotations

from pathlib import Path

import av

from mp4ds.errors import VideoError
from mp4ds.layouts import Picture
from mp4ds.video.convert import Converter, frame_to_picture
from mp4ds.video.scarcity import raise_if_scarce


class PictureMaker:
    """Makes pictures of decoded frames; not to be shared between threads.

    Args:
        path: The video, for errors.
        coded_size: Width and height of its frames.
        picture_format: Pixel format of the pictures wanted.
        picture_size: Width and height of the pictures wanted.
        matrix: Matrix coefficients of the video's colours; None where the video itself tells.
        full_range: Whether its samples use their full range, unless the video itself tells.
        fast_colour: See `Converter`.
    """

    def __init__(
        self,
        path: Path,
        *,
        coded_size: tuple[int, int],
        picture_format: str,
        picture_size: tuple[int, int],
        matrix: str | None,
        full_range: bool,
        fast_colour: bool = False,
    ) -> None:
        self._path = path
        self.coded_size = coded_size
        self._picture_format = picture_format
        self._picture_size = picture_size
        self._converter = Converter(matrix, source_full_range=full_range, fast=fast_colour)

    def make(self, frame: av.VideoFrame, number: int | None = None) -> Picture:
        """The picture in a frame; views of it where possible.

        Args:
            frame: As decoded.
            number: Of the frame, for errors.

        Raises:
            VideoError: ``decode-failed``: the decoder found damage; ``geometry-mismatch`` or
                ``codec-mismatch``: the frame is not what was promised.
        """
        name = "a frame" if number is None else f"frame {number}"
        if frame.is_corrupt:
            raise_if_scarce()
            raise VideoError("decode-failed", self._path, f"has {name} that is marked as corrupt")
        if (frame.width, frame.height) != self.coded_size:
            width, height = self.coded_size
            raise VideoError(
                "geometry-mismatch",
                self._path,
                f"has {name} of {frame.width}x{frame.height} pixels among others of "
                f"{width}x{height}",
            )
        return frame_to_picture(
            frame, self._picture_format, *self._picture_size, self._converter, str(self._path)
        )
