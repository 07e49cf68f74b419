"""Frames of a video by number, at the least cost that its codec allows."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Protocol

from mp4ds.coded.references import UnknownStructure
from mp4ds.errors import VideoError
from mp4ds.layouts import Picture
from mp4ds.sidecar import References
from mp4ds.video.access import FrameAccess
from mp4ds.video.decoder import VideoDecoder
from mp4ds.video.pictures import PictureMaker


class Seeking(Protocol):
    """A decoder that gets at a frame by decoding from the key frame before it."""

    def picture(self, index: int) -> Picture:
        """The picture of a frame."""

    def close(self) -> None:
        """Close the file."""


class FrameReader:
    """Gives frames by number; those that are not needed for them are decoded only if they must.

    A context manager. Not to be shared between threads or over a fork.

    Args:
        open_access: Opens what decodes the chains of frames.
        open_decoder: Opens what decodes from key frames, for where that cannot be done.

    Raises:
        VideoError: Neither can be opened; what the latter says.
    """

    def __init__(
        self, open_access: Callable[[], FrameAccess], open_decoder: Callable[[], Seeking]
    ) -> None:
        self._open_decoder = open_decoder
        self._access: FrameAccess | None = None
        self._decoder: Seeking | None = None
        try:
            self._access = open_access()
        except (UnknownStructure, VideoError, OSError):
            self._decoder = open_decoder()  # ffmpeg reads more, and tells what it does not

    def pictures_of(self, numbers: Sequence[int]) -> Iterator[tuple[int, Picture]]:
        """Pictures of some frames, each with its number.

        Args:
            numbers: 0 <= number < frames, increasing.

        Yields:
            Views that hold until the next one is asked for.

        Raises:
            VideoError: One cannot be decoded.
        """
        done = 0
        if self._access is not None:
            try:
                for pair in self._access.pictures_of(numbers):
                    done += 1
                    yield pair
                return
            except UnknownStructure:
                self._access.close()
                self._access = None
        if self._decoder is None:
            self._decoder = self._open_decoder()
        for number in numbers[done:]:
            yield number, self._decoder.picture(number)

    def close(self) -> None:
        """Close the file."""
        for part in (self._access, self._decoder):
            if part is not None:
                part.close()

    def __enter__(self) -> FrameReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def open_frames(
    path: Path,
    *,
    codec: str,
    coded_size: tuple[int, int],
    frames: int,
    picture_format: str,
    picture_size: tuple[int, int],
    matrix: str | None,
    full_range: bool,
    fast_colour: bool = False,
    references: References | None = None,
) -> FrameReader:
    """The frames of a video of which all is known that `VideoDecoder` asks for.

    `references` is what its sidecar tells of what its frames refer to.

    Raises:
        VideoError: As for `VideoDecoder`.
        FormatError: ``references-invalid``: they do not fit the video.
    """

    def open_access() -> FrameAccess:
        maker = PictureMaker(
            path,
            coded_size=coded_size,
            picture_format=picture_format,
            picture_size=picture_size,
            matrix=matrix,
            full_range=full_range,
            fast_colour=fast_colour,
        )
        return FrameAccess(path, codec=codec, frames=frames, maker=maker, references=references)

    def open_decoder() -> VideoDecoder:
        return VideoDecoder(
            path,
            codec=codec,
            coded_size=coded_size,
            frames=frames,
            picture_format=picture_format,
            picture_size=picture_size,
            matrix=matrix,
            full_range=full_range,
            fast_colour=fast_colour,
            sequential=False,
        )

    return FrameReader(open_access, open_decoder)
