"""A video of others, which has no sidecar, as a sequence of frames."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.layouts import Picture, Pixels
from mp4ds.sidecar import Calibration
from mp4ds.streams.decoded import DecodedFrames
from mp4ds.video import FrameReader, VideoFile, open_file_frames


class Video(DecodedFrames):
    """The frames of an mp4 that has no sidecar. See `Frames`.

    Its topic is the file's name without ending. Frames are ``rgb8``, as the video's colours are
    tagged, in the orientation in which they are coded; stamps are the presentation times, the
    first one's usually 0.

    Args:
        path: The video.
        fast_colour: Of videos with halved chroma give it to frames as it is, several times as
            fast as interpolating it as `mp4ds.unpack` does. Messages are not changed by it.

    Raises:
        VideoError: It cannot be read, or has not one video track.
    """

    def __init__(self, path: Path, *, fast_colour: bool = False) -> None:
        super().__init__()
        self.path = path
        self._fast_colour = fast_colour
        self._reader: FrameReader | None = None
        with VideoFile(path) as file:
            self._codec, self._size, self._times = file.codec, file.size, file.times

    @property
    def topic(self) -> str:
        """The file's name without ending."""
        return self.path.stem

    @property
    def video_path(self) -> Path:
        """The video."""
        return self.path

    @property
    def stamps(self) -> NDArray[np.int64]:
        """Presentation times, nanoseconds, shape (frames,)."""
        return self._times

    @property
    def log_times(self) -> NDArray[np.int64]:
        """Presentation times, nanoseconds, shape (frames,)."""
        return self._times

    @property
    def encoding(self) -> str:
        """``rgb8``."""
        return "rgb8"

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height of the frames, pixels."""
        return self._size

    def intrinsics_at(self, index: int) -> Calibration | None:
        """None: a video has no calibration.

        Args:
            index: 0 <= index < frames.
        """
        return None

    def __len__(self) -> int:
        return len(self._times)

    def pictures_of(self, indices: Sequence[int]) -> Iterator[tuple[int, Picture]]:
        """See `DecodedFrames.pictures_of`."""
        if self._reader is None:
            self._reader = self._open_reader()
        return self._reader.pictures_of(indices)

    def _pictures_apart(self, runs: Iterable[Sequence[int]]) -> Iterator[tuple[int, Picture]]:
        with self._open_reader() as reader:
            for run in runs:
                yield from reader.pictures_of(run)

    def _open_reader(self) -> FrameReader:
        return open_file_frames(
            self.path,
            codec=self._codec,
            size=self._size,
            frames=len(self),
            fast_colour=self._fast_colour,
        )

    def _pictures(self) -> Iterator[Picture]:
        with VideoFile(self.path, fast_colour=self._fast_colour) as file:
            yield from map(file.picture, range(len(self)))

    def _write_pixels(self, picture: Picture, out: Pixels) -> None:
        np.copyto(out, picture[0])

    def _frame_id(self, index: int) -> str:
        return ""

    def close(self) -> None:
        """Close the video, if it is open."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None
