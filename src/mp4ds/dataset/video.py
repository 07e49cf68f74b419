"""Third-party videos, without a sidecar."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.dataset.frames import DecodedFrames
from mp4ds.format.models import Calibration
from mp4ds.messages.arrangements import Picture
from mp4ds.messages.encodings import Pixels
from mp4ds.video.pixels import Scale
from mp4ds.video.reader import FrameReader, VideoFile, open_file_frames


class Video(DecodedFrames):
    """The frames of an mp4 without a sidecar. See `Frames`.

    Its topic is the file name without extension. Frames are ``rgb8``, converted by the video's
    colour tags, in coded orientation; stamps are presentation times, the first usually 0.

    Args:
        path: The video.
        track: Which of several video tracks, from 0.

    Raises:
        VideoError: It cannot be read, or has several video tracks and none was chosen.
        OptionError: It has no such track.
    """

    def __init__(self, path: Path, track: int | None = None) -> None:
        super().__init__()
        self.path = path
        self._track = track
        with VideoFile(path, track) as file:
            self._codec, self._size, self._times = file.codec, file.size, file.times

    @property
    def topic(self) -> str:
        """The file name without extension."""
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

    def _open_reader(self) -> FrameReader:
        return open_file_frames(
            self.path,
            codec=self._codec,
            size=self._size,
            frames=len(self),
            track=self._track,
        )

    def _pictures(self, scale: Scale | None) -> Iterator[Picture]:
        with VideoFile(self.path, self._track) as file:
            for number in range(len(self)):
                yield file.picture(number, scale)

    @property
    def _shows_colours(self) -> bool:
        return True

    def _write_pixels(self, picture: Picture, out: Pixels) -> None:
        np.copyto(out, picture[0])

    def frame_id(self, index: int) -> str:
        """The coordinate frame of a frame's header; empty if unknown."""
        return ""
