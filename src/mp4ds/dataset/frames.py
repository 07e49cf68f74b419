"""Frames by number and by stamp: the common interface of streams, third-party videos and topics."""

from __future__ import annotations

import os
import threading
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import index as as_integer
from reprlib import repr as shortened
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import NDArray

from mp4ds.dataset.stamps import StampIndex
from mp4ds.dataset.views import Crop, Resize, View, check_outputs, output, view_of
from mp4ds.errors import FormatError, Mp4dsError
from mp4ds.format.models import Calibration
from mp4ds.messages.arrangements import Picture
from mp4ds.messages.depth import metres_of
from mp4ds.messages.encodings import ENCODINGS, Encoding, Pixels
from mp4ds.options import seconds_text
from mp4ds.video.pixels import Scale
from mp4ds.video.reader import FrameReader


def seconds_of(first_ns: int, last_ns: int) -> str:
    """The time from one moment to another, for people."""
    return f"{(last_ns - first_ns) / 1e9:.1f} s"


def numbers_of(topic: str, count: int, indices: Sequence[int] | NDArray[np.int64]) -> list[int]:
    """Frame numbers; negative ones count from the end.

    Args:
        topic: For errors.
        count: Number of frames.
        indices: Any integers.

    Raises:
        IndexError: There is no such frame.
        TypeError: One is not an integer.
    """
    numbers = []
    if not isinstance(indices, Iterable):
        raise TypeError(f"frames of {topic} are read by a list of numbers: use [{indices!r}]")
    for index in indices.tolist() if isinstance(indices, np.ndarray) else indices:
        if isinstance(index, bool):
            raise TypeError("frames are selected by number: for a mask, give np.flatnonzero(mask)")
        try:
            asked = as_integer(index)
        except TypeError:
            raise TypeError(
                f"frames of {topic} are selected by integers, not {shortened(index)}: "
                "read([0, 5]) and get([0, 5]) take several, at(stamp_ns) a time"
            ) from None
        number = asked + count if asked < 0 else asked
        if not 0 <= number < count:
            raise IndexError(
                f"{topic} has no frame {asked}: its {count} frames are 0 to {count - 1}, or "
                f"{-count} to -1 from the end"
            )
        numbers.append(number)
    return numbers


# ---------------------------------------------------------------- frames


@dataclass(frozen=True)
class Frame:
    """One image of a stream.

    Attributes:
        data: Pixels in the encoding, shape as in `Encoding.shape`, native byte order.
        index: Number of the frame in its stream.
        stamp_ns: Header stamp, nanoseconds.
        log_time_ns: When it was recorded, nanoseconds.
        frame_id: Coordinate frame.
        encoding: ROS image encoding of `data`.
        intrinsics: The calibration of `data`, or None if the recording has none.
    """

    data: Pixels
    index: int
    stamp_ns: int
    log_time_ns: int
    frame_id: str
    encoding: str
    intrinsics: Calibration | None


Indices = Sequence[int] | NDArray[np.int64]

_ELSEWHERE = {
    "get_frame_at": "dataset[topic][7]",
    "get_frames_at": "dataset[topic].get([0, 5]), or read([0, 5]) for one array",
    "get_frames_in_range": "dataset[topic][2:12:3]",
    "get_frame_played_at": "dataset[topic].at(stamp_ns)",
    "get_frames_played_in_range": "dataset[topic].between(start_ns, end_ns)",
    "get_batch": "dataset[topic].read([0, 5])",
    "delta_timestamps": 'offsets=(-0.1, 0), offsets_in="seconds"',
    "tolerance_s": "tolerance_ns",
    "image_transforms": "transform",
}
"""Names of torchcodec, decord and LeRobot -> what does it here."""


def absent(owner: object, name: str) -> str:
    """What is wrong with a name that an object or a function does not have."""
    hint = f"; here it is {_ELSEWHERE[name]}" if name in _ELSEWHERE else ""
    return f"{type(owner).__name__} has no {name!r}{hint}"


def missing(owner: object, name: str) -> Any:
    """For ``__getattr__``: raises AttributeError."""
    if name in _ELSEWHERE:
        raise AttributeError(absent(owner, name))
    return object.__getattribute__(owner, name)  # again, for the error of a property


class Frames(ABC):
    """A sequence of frames, decoded on demand.

    ``len(frames)``, ``frames[i]``, ``frames[-1]``, ``frames[a:b]`` and iteration work as on a list.
    Threads that share it wait for each other; a process made by a fork opens the video itself. An
    iterator belongs to one thread of one process.

    Options for returning frames other than as recorded:

    * ``format``: ``"native"`` in their ROS encoding; ``"rgb"`` and ``"bgr"``, shape (H, W, 3);
      ``"gray"``, shape (H, W). 16 bits stay 16 bits, a Bayer mosaic is interpolated, alpha is
      dropped. Depths and other measurements are available as ``"native"``; depths also as
      ``"depth_m"``, float32 in metres, shape (H, W). Missing depths are 0 or NaN, as recorded.
    * ``crop``: x, y, width and height in pixels of the image, applied first.
    * ``resize``: a factor, or width and height. Images are shrunk by area averaging and enlarged by
      bicubic interpolation; depths and other measurements use the nearest pixel. The frame's
      `intrinsics` are adjusted to match.
    """

    if not TYPE_CHECKING:  # else every name would pass for known

        def __getattr__(self, name: str) -> Any:
            return missing(self, name)

    def __repr__(self) -> str:
        parts = [f"{len(self)} frame{'s' * (len(self) != 1)}"]
        with suppress(Mp4dsError):  # of frames that differ
            parts.append("{}x{} {}".format(*self.image_size, self.encoding))
        with suppress(Mp4dsError):  # of a damaged sidecar, which is reported when it is used
            parts.append(seconds_of(int(self.log_times.min()), int(self.log_times.max())))
        return f"<{type(self).__name__} {self.topic!r}: {', '.join(parts)}>"

    # ------------------------------------------------------------ what they are

    @property
    @abstractmethod
    def topic(self) -> str:
        """Topic of the images."""

    @property
    @abstractmethod
    def stamps(self) -> NDArray[np.int64]:
        """Header stamps, nanoseconds, shape (frames,)."""

    @property
    @abstractmethod
    def log_times(self) -> NDArray[np.int64]:
        """Log times, nanoseconds, shape (frames,)."""

    @property
    @abstractmethod
    def encoding(self) -> str:
        """ROS image encoding of the frames as recorded."""

    @property
    @abstractmethod
    def image_size(self) -> tuple[int, int]:
        """Width and height of the images, pixels."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of a frame's pixels as recorded: (H, W), or (H, W, channels)."""
        return self._known_encoding.shape(*self.image_size)

    @property
    def dtype(self) -> np.dtype[np.generic]:
        """Type of a frame's samples as recorded, native byte order."""
        return np.dtype(self._known_encoding.dtype)

    @property
    def _known_encoding(self) -> Encoding:
        return ENCODINGS[self.encoding]

    @property
    def calibrations(self) -> Sequence[Calibration]:
        """All calibrations, in the order in which they were first seen; none if unknown."""
        return []

    @abstractmethod
    def intrinsics_at(self, index: int) -> Calibration | None:
        """The calibration that applied when a frame was recorded.

        Args:
            index: 0 <= index < frames.
        """

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def close(self) -> None:
        """Close any open videos."""

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
            # a damaged video may have more frames than its sidecar
            if error.frame is None or error.name or error.frame >= len(self.stamps):
                raise
            raise self.named(error, error.frame) from None

    def named(self, error: FormatError, first: int, last: int | None = None) -> FormatError:
        """An error of a frame, or of several in a row, with their topic and times."""
        name = self.name_of(first, last)
        return type(error)(error.code, error.place, error.what, frame=first, name=name)

    # ------------------------------------------------------------ by number

    @overload
    def __getitem__(self, index: int) -> Frame: ...

    @overload
    def __getitem__(self, index: slice) -> list[Frame]: ...

    def __getitem__(self, index: int | slice) -> Frame | list[Frame]:
        if isinstance(index, slice):
            return self.get(range(*index.indices(len(self))))
        return self.get((index,))[0]

    @abstractmethod
    def __iter__(self) -> Iterator[Frame]: ...

    @abstractmethod
    def get(
        self,
        indices: Indices,
        *,
        format: str = "native",  # noqa: A002 - as users write it
        resize: Resize = None,
        crop: Crop = None,
    ) -> list[Frame]:
        """Frames by number, decoded in the cheapest order.

        Args:
            indices: In any order, with repetitions; negative ones count from the end.
            format: See `Frames`.
            resize: See `Frames`.
            crop: See `Frames`.

        Returns:
            One frame for each index, each with its own pixels.

        Raises:
            IndexError: There is no such frame.
            OptionError: The format, crop or size is invalid, or not available for these frames.
            VideoError: A frame cannot be decoded.
        """

    @abstractmethod
    def read(
        self,
        indices: Indices,
        *,
        format: str = "rgb",  # noqa: A002
        resize: Resize = None,
        crop: Crop = None,
        out: Pixels | None = None,
    ) -> Pixels:
        """Pixels of frames by number, in one array.

        Args:
            indices: As for `get`.
            format: See `Frames`.
            resize: See `Frames`.
            crop: See `Frames`.
            out: Where to write them, or None for a new array. Shape and type as returned.

        Returns:
            Shape (indices, H, W) or (indices, H, W, channels); `out`, if it was given.

        Raises:
            IndexError: There is no such frame.
            OptionError: As for `get`; or `out` has the wrong shape or type.
            VideoError: A frame cannot be decoded.
        """

    @abstractmethod
    def read_into(
        self,
        indices: Indices,
        outs: Sequence[Pixels],
        *,
        format: str = "rgb",  # noqa: A002
        resize: Resize = None,
        crop: Crop = None,
    ) -> None:
        """Like `read`, but each frame into its own array.

        Args:
            indices: As for `get`.
            outs: An array for each, with the shape and type of a row returned by `read`.
            format: See `Frames`.
            resize: See `Frames`.
            crop: See `Frames`.

        Raises:
            IndexError: There is no such frame.
            OptionError: As for `read`.
            VideoError: A frame cannot be decoded.
        """

    # ------------------------------------------------------------ by stamp

    @cached_property
    def _by_stamp(self) -> StampIndex:
        return StampIndex(self.topic, self.stamps)

    def index_at(
        self, stamp_ns: int, *, mode: str = "nearest", tolerance_ns: int | None = None
    ) -> int:
        """Number of the frame for a time.

        Stamps need not be sorted. Of several frames with the same stamp it is the first, and of two
        equally near it is the earlier.

        Args:
            stamp_ns: Nanoseconds.
            mode: ``nearest``; ``before``: the last at or before the time; ``after``: the first
                at or after it; ``exact``.
            tolerance_ns: Maximum nanoseconds between the frame and the time; None for no limit.

        Raises:
            FrameNotFoundError: There is no such frame.
            OptionError: There is no such mode or tolerance.
        """
        return self._by_stamp.find(stamp_ns, mode=mode, tolerance_ns=tolerance_ns)

    def at(
        self,
        stamp_ns: int,
        *,
        mode: str = "nearest",
        tolerance_ns: int | None = None,
        format: str = "native",  # noqa: A002
        resize: Resize = None,
        crop: Crop = None,
    ) -> Frame:
        """The frame for a time.

        Args:
            stamp_ns: See `index_at`.
            mode: See `index_at`.
            tolerance_ns: See `index_at`.
            format: See `Frames`.
            resize: See `Frames`.
            crop: See `Frames`.

        Raises:
            FrameNotFoundError: There is no such frame.
            OptionError: An option is wrong; see `get` and `index_at`.
            VideoError: The frame cannot be decoded.
        """
        index = self.index_at(stamp_ns, mode=mode, tolerance_ns=tolerance_ns)
        return self.get((index,), format=format, resize=resize, crop=crop)[0]

    @abstractmethod
    def between(
        self,
        start_ns: int,
        end_ns: int,
        *,
        format: str = "native",  # noqa: A002
        resize: Resize = None,
        crop: Crop = None,
    ) -> Iterator[Frame]:
        """The frames with ``start_ns <= stamp < end_ns``, by stamp, decoded one by one.

        Args:
            start_ns: Nanoseconds.
            end_ns: Nanoseconds.
            format: See `Frames`.
            resize: See `Frames`.
            crop: See `Frames`.

        Raises:
            OptionError: An option is wrong; see `get`.
            VideoError: A frame cannot be decoded.
        """


# ---------------------------------------------------------------- frames of one video


@dataclass(slots=True)
class _Opened:
    """What a process has open of a video.

    Attributes:
        lock: Held while anything of it is used: two threads in one decoder crash.
        reader: The decoder for frames by number.
        view: The last view, with its key.
        inherited: Iterators of another process, kept as they are: to free their decoders would
            be to wait for threads that a fork does not copy.
    """

    lock: threading.RLock = field(default_factory=threading.RLock)
    reader: FrameReader | None = None
    view: tuple[str, View] | None = None
    inherited: list[object] = field(default_factory=list)


class DecodedFrames(Frames):
    """The frames of one video, all of one size and encoding. See `Frames`."""

    def __init__(self) -> None:
        # What other processes opened stays in it, for the reason given above.
        self._processes: dict[int, _Opened] = {}

    @property
    def _opened(self) -> _Opened:
        process = os.getpid()
        return self._processes.get(process) or self._processes.setdefault(process, _Opened())

    def close(self) -> None:
        """Close the video, if it is open."""
        opened = self._opened
        with opened.lock:
            if opened.reader is not None:
                opened.reader.close()
                opened.reader = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_processes": {}}

    # ------------------------------------------------------------ what makes them

    @abstractmethod
    def _open_reader(self) -> FrameReader:
        """A separate decoder for frames by number."""

    @abstractmethod
    def _pictures(self, scale: Scale | None) -> Iterator[Picture]:
        """All pictures in order, from a separate decoder."""

    @property
    @abstractmethod
    def _shows_colours(self) -> bool:
        """See `mp4ds.video.pixels.shows_colours`."""

    @abstractmethod
    def _write_pixels(self, picture: Picture, out: Pixels) -> None:
        """Write the pixels of a picture, as recorded."""

    def _metres(self, index: int, pixels: Pixels) -> NDArray[np.float32]:
        """The depths of a frame in metres, from its pixels as recorded."""
        return metres_of(pixels)

    @abstractmethod
    def frame_id(self, index: int) -> str:
        """The coordinate frame of a frame's header; empty if unknown."""

    def pictures_of(
        self,
        indices: Sequence[int],
        scale: Scale | None = None,
        outs: Mapping[int, Pixels] | None = None,
    ) -> Iterator[tuple[int, Picture]]:
        """Pictures of some frames, each with its number; see `FrameReader.pictures_of`.

        Args:
            indices: 0 <= index < frames, increasing.
            scale: See `PictureMaker.make`.
            outs: Its `out`, by frame; may be left unused.

        Yields:
            Views that are valid until the next one is requested. Nothing else may be read
            meanwhile, so the caller holds the lock.

        Raises:
            VideoError: One cannot be decoded.
        """
        if not len(indices):
            return
        opened = self._opened
        if opened.reader is None:
            opened.reader = self._open_reader()
        with self.naming_frames():
            yield from opened.reader.pictures_of(indices, scale, outs)

    # ------------------------------------------------------------ by number

    def __iter__(self) -> Iterator[Frame]:
        view = self._view("native", None, None)
        yield from self._one_by_one(enumerate(self._pictures(view.scale)), view)

    def _one_by_one(self, pictures: Iterable[tuple[int, Picture]], view: View) -> Iterator[Frame]:
        process = os.getpid()
        for index, picture in pictures:
            yield self._frame(index, picture, view)
            if os.getpid() != process:
                self._opened.inherited.append(pictures)
                raise RuntimeError(
                    f"an iterator over {self.topic} that process {process} began cannot go on in "
                    f"process {os.getpid()}, a fork of it: begin it again there"
                )

    def get(
        self,
        indices: Indices,
        *,
        format: str = "native",  # noqa: A002 - as users write it
        resize: Resize = None,
        crop: Crop = None,
    ) -> list[Frame]:
        """See `Frames.get`."""
        numbers = numbers_of(self.topic, len(self), indices)
        view = self._view(format, resize, crop)
        found: dict[int, Frame] = {}
        with self._opened.lock:
            for number, picture in self.pictures_of(sorted(set(numbers)), view.scale):
                found[number] = self._frame(number, picture, view)
        given: set[int] = set()
        frames = []
        for number in numbers:
            frame = found[number]
            frames.append(replace(frame, data=frame.data.copy()) if number in given else frame)
            given.add(number)
        return frames

    def read(
        self,
        indices: Indices,
        *,
        format: str = "rgb",  # noqa: A002
        resize: Resize = None,
        crop: Crop = None,
        out: Pixels | None = None,
    ) -> Pixels:
        """See `Frames.read`."""
        numbers = numbers_of(self.topic, len(self), indices)
        view = self._view(format, resize, crop)
        out = output(out, (len(numbers), *view.shape), view.dtype)
        self._write(numbers, view, list(out))
        return out

    def read_into(
        self,
        indices: Indices,
        outs: Sequence[Pixels],
        *,
        format: str = "rgb",  # noqa: A002
        resize: Resize = None,
        crop: Crop = None,
    ) -> None:
        """See `Frames.read_into`."""
        numbers = numbers_of(self.topic, len(self), indices)
        view = self._view(format, resize, crop)
        check_outputs(outs, len(numbers), view)
        self._write(numbers, view, outs)

    def _write(self, numbers: Sequence[int], view: View, out: Sequence[Pixels]) -> None:
        """Write the pixels of frames.

        Args:
            numbers: 0 <= number < frames, in any order, with repetitions.
            view: The view of these frames.
            out: An array for each.

        Raises:
            VideoError: A frame cannot be decoded.
        """
        places: dict[int, list[int]] = {}
        for place, number in enumerate(numbers):
            places.setdefault(number, []).append(place)
        outs = {number: out[first] for number, (first, *_) in places.items()} if view.scale else {}
        with self._opened.lock:
            for number, picture in self.pictures_of(sorted(places), view.scale, outs):
                first, *others = places[number]
                self._give(number, picture, view, out[first])
                for place in others:
                    np.copyto(out[place], out[first])

    # ------------------------------------------------------------ by stamp

    def between(
        self,
        start_ns: int,
        end_ns: int,
        *,
        format: str = "native",  # noqa: A002
        resize: Resize = None,
        crop: Crop = None,
    ) -> Iterator[Frame]:
        """See `Frames.between`."""
        return self._in_order(
            self._by_stamp.between(start_ns, end_ns), self._view(format, resize, crop)
        )

    def _in_order(self, indices: NDArray[np.int64], view: View) -> Iterator[Frame]:
        """Frames in a given order; increasing runs are decoded in one go."""
        falls = np.flatnonzero(np.diff(indices) < 0) + 1
        runs = (run.tolist() for run in np.split(indices, falls) if len(run))
        with self._open_reader() as reader:  # a separate one: more may be read meanwhile
            for run in runs:
                yield from self._one_by_one(reader.pictures_of(run, view.scale), view)

    # ------------------------------------------------------------ how they are given

    def _view(self, format: str, resize: Resize, crop: Crop) -> View:  # noqa: A002
        """The view for a format, size and crop.

        Raises:
            OptionError: The format, crop or size is invalid, or not available for these frames.
        """
        key = repr((format, resize, crop))
        opened = self._opened
        last = opened.view  # no more than one: each holds its own tables
        if last is not None and last[0] == key:
            return last[1]
        view = view_of(
            self.topic,
            self._known_encoding,
            self.image_size,
            format=format,
            resize=resize,
            crop=crop,
            shows_colours=self._shows_colours,
        )
        opened.view = key, view
        return view

    def _give(self, number: int, picture: Picture, view: View, out: Pixels) -> None:
        if view.scale:
            if picture[0] is not out:
                np.copyto(out, picture[0])
            return
        if view.is_plain:
            self._write_pixels(picture, out)
            return
        pixels: Pixels = np.empty(self.shape, self.dtype)
        self._write_pixels(picture, pixels)
        view.give(self._metres(number, pixels) if view.in_metres else pixels, out)

    def _frame(self, index: int, picture: Picture, view: View) -> Frame:
        if view.scale:
            data: Pixels = picture[0]
        else:
            data = np.empty(view.shape, view.dtype)
            with self._opened.lock:
                self._give(index, picture, view, data)
        return Frame(
            data=data,
            index=index,
            stamp_ns=int(self.stamps[index]),
            log_time_ns=int(self.log_times[index]),
            frame_id=self.frame_id(index),
            encoding=view.encoding.name,
            intrinsics=view.calibration(self.intrinsics_at(index)),
        )
