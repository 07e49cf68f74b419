"""Images of one topic, size and encoding, wherever they are stored."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.dataset.views import Crop, Resize, View, view_of
from mp4ds.errors import FormatError
from mp4ds.format.models import Calibration
from mp4ds.messages.depth import metres_of
from mp4ds.messages.encodings import ENCODINGS, Picture, Pixels
from mp4ds.options import seconds_text
from mp4ds.records import Channel
from mp4ds.video.access import FrameReader, open_file_frames
from mp4ds.video.decoder import VideoFile
from mp4ds.video.pixels import Scale

Integers = NDArray[np.int64]


class Images(ABC):
    """Images of one topic, all of one size and encoding; `Topic` reads their frames.

    Attributes:
        topic: Topic of the images.
        channel: Their channel; None of a third-party video.
        path: Their file: a sidecar, a video without one, or messages.mcap.
        video_path: The file with the images: a video, or messages.mcap.
        shows_colours: Whether the decoder can make RGB directly, in any size; see
            `mp4ds.video.pixels.shows_colours`.
    """

    topic: str
    channel: Channel | None
    path: Path
    video_path: Path
    shows_colours = False

    def __repr__(self) -> str:
        size, encoding = "{}x{}".format(*self.image_size), self.encoding
        frames = f"{len(self)} frame{'s' * (len(self) != 1)}"
        return f"<{type(self).__name__} {self.topic!r}: {frames}, {size} {encoding}>"

    @abstractmethod
    def __len__(self) -> int: ...

    @property
    @abstractmethod
    def stamps(self) -> Integers:
        """Header stamps, nanoseconds, shape (frames,)."""

    @property
    @abstractmethod
    def log_times(self) -> Integers:
        """Log times, nanoseconds, shape (frames,)."""

    @property
    @abstractmethod
    def ordinals(self) -> Integers:
        """Numbers among the messages of the channel, increasing, shape (frames,)."""

    @property
    @abstractmethod
    def encoding(self) -> str:
        """ROS image encoding of the frames as recorded."""

    @property
    @abstractmethod
    def image_size(self) -> tuple[int, int]:
        """Width and height of the images, pixels."""

    @property
    def calibrations(self) -> Sequence[Calibration]:
        """All calibrations, in the order in which they were first seen; none if unknown."""
        return []

    def calibration_at(self, log_time: int) -> Calibration | None:
        """The calibration that applied at a log time, nanoseconds; None if unknown."""
        return None

    def frame_id(self, index: int) -> str:
        """The coordinate frame of a frame's header; empty if unknown."""
        return ""

    def count(self, is_wanted: NDArray[np.bool_] | None = None) -> int:
        """How many frames can be read, as far as is known.

        Args:
            is_wanted: Count only these, shape (frames,); None: all.
        """
        return len(self) if is_wanted is None else int(is_wanted.sum())

    @property
    def are_jpeg_files(self) -> bool:
        """Whether the messages hold JPEG files."""
        return False

    # ------------------------------------------------------------ pictures

    @abstractmethod
    def open_reader(self) -> FrameReader:
        """A separate decoder for frames by number."""

    def pictures(self, scale: Scale | None) -> Iterator[Picture]:
        """All pictures in order, from a separate decoder; each is valid until the next one."""
        with self.open_reader() as reader:
            for _, picture in reader.pictures_of(range(len(self)), scale):
                yield picture

    def write_pixels(self, picture: Picture, out: Pixels) -> None:
        """Write the pixels of a picture, as recorded."""
        np.copyto(out, picture[0])

    def recorded_pixels(self, picture: Picture) -> Pixels:
        """A new array of the pixels of a picture, as recorded."""
        encoding = ENCODINGS[self.encoding]
        pixels: Pixels = np.empty(encoding.shape(*self.image_size), encoding.dtype)
        self.write_pixels(picture, pixels)
        return pixels

    def depth_header(self, index: int) -> bytes:
        """What gives the quantised depths of a frame in metres; empty for all others.

        Raises:
            OptionError: It is not known.
        """
        return b""

    # ------------------------------------------------------------ views

    def view(
        self,
        format: str = "native",  # noqa: A002 - as users write it
        resize: Resize = None,
        crop: Crop = None,
        *,
        encoding: str | None = None,
    ) -> View:
        """A way of returning the frames.

        Args:
            format: See `Topic`.
            resize: See `Topic`.
            crop: See `Topic`.
            encoding: What the pixels are, if their messages tell that better than the images'
                encoding; of the same shape and type.

        Raises:
            OptionError: The format, crop or size is invalid, or not available for these frames.
        """
        return view_of(
            self.topic,
            ENCODINGS[encoding or self.encoding],
            self.image_size,
            format=format,
            resize=resize,
            crop=crop,
            shows_colours=self.shows_colours and encoding in (None, self.encoding),
        )

    def pixels(self, picture: Picture, view: View, index: int, out: Pixels | None = None) -> Pixels:
        """The pixels of a frame in a view.

        Args:
            picture: Of the frame, decoded with the view's scale.
            view: See `view`.
            index: Number of the frame.
            out: Where to write them; None for an array of their own.
        """
        if view.scale:
            if out is None:
                return picture[0]
            if picture[0] is not out:  # the decoder may have written there already
                np.copyto(out, picture[0])
            return out
        made: Pixels = np.empty(view.shape, view.dtype) if out is None else out
        if view.is_plain:
            self.write_pixels(picture, made)
            return made
        pixels = self.recorded_pixels(picture)
        view.give(metres_of(pixels, self.depth_header(index)) if view.in_metres else pixels, made)
        return made

    # ------------------------------------------------------------ damage

    def name_of(self, first: int, last: int | None = None) -> str:
        """What errors call a frame, or several in a row: by number, topic and times.

        Args:
            first: 0 <= first < frames.
            last: The last one; None for one frame.
        """
        ends = [first] if last in (None, first) else [first, last]
        frames = f"frame{'s' * (len(ends) - 1)} {' to '.join(map(str, ends))}"
        stamps, times = (
            " to ".join(seconds_text(int(column[index])) for index in ends)
            for column in (self.stamps, self.log_times)
        )
        return f"{frames} of {self.topic} (stamp {stamps}, log time {times})"

    @contextmanager
    def naming_frames(self) -> Iterator[None]:
        """Give errors that have the number of a frame its topic and times."""
        try:
            yield
        except FormatError as error:
            named = self.named(error)
            if named is error:
                raise
            raise named from None

    def named(self, error: FormatError, last: int | None = None) -> FormatError:
        """An error of a frame, or of several in a row up to the last, with topic and times.

        It stays as it is if it names its frame already, or is of none.
        """
        # a damaged video may have more frames than its sidecar
        if error.frame is None or error.name or error.frame >= len(self.stamps):
            return error
        name = self.name_of(error.frame, last)
        return type(error)(error.code, error.place, error.what, frame=error.frame, name=name)


class VideoImages(Images):
    """The frames of an mp4 without a sidecar.

    Frames are ``rgb8``, converted by the video's colour tags, in coded orientation; stamps are
    presentation times, the first usually 0.

    Args:
        path: The video.
        track: Which of several video tracks, from 0.

    Raises:
        VideoError: It cannot be read, or has several video tracks and none was chosen.
        OptionError: It has no such track.
    """

    channel = None
    shows_colours = True

    def __init__(self, path: Path, track: int | None = None) -> None:
        self.path = self.video_path = path
        self.topic = path.stem
        self._track = track
        with VideoFile(path, track) as file:
            self._codec, self._size, self._times = file.codec, file.size, file.times

    def __len__(self) -> int:
        return len(self._times)

    @property
    def stamps(self) -> Integers:
        """Presentation times, nanoseconds, shape (frames,)."""
        return self._times

    @property
    def log_times(self) -> Integers:
        """Presentation times, nanoseconds, shape (frames,)."""
        return self._times

    @property
    def ordinals(self) -> Integers:
        """Numbers of the frames."""
        return np.arange(len(self))

    @property
    def encoding(self) -> str:
        """``rgb8``."""
        return "rgb8"

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height of the frames, pixels."""
        return self._size

    def open_reader(self) -> FrameReader:
        """A separate decoder for frames by number."""
        return open_file_frames(
            self.path, codec=self._codec, size=self._size, frames=len(self), track=self._track
        )
