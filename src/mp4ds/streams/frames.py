"""Frames by number and by stamp: what streams and videos of others have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import overload

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import OptionError
from mp4ds.layouts import ENCODINGS, Encoding, Picture, Pixels
from mp4ds.sidecar import Calibration
from mp4ds.streams.lookup import StampIndex, numbers_of
from mp4ds.streams.views import Crop, Resize, View, view_of


@dataclass(frozen=True)
class Frame:
    """One image of a stream.

    Attributes:
        data: Pixels in the encoding, shape as `mp4ds.layouts.Encoding.shape`, native byte order.
        index: Number of the frame in its stream.
        stamp_ns: Header stamp, nanoseconds.
        log_time_ns: When it was recorded, nanoseconds.
        frame_id: Coordinate frame.
        encoding: ROS image encoding of `data`.
        intrinsics: The calibration of `data`, or None where the recording has none.
    """

    data: Pixels
    index: int
    stamp_ns: int
    log_time_ns: int
    frame_id: str
    encoding: str
    intrinsics: Calibration | None


Indices = Sequence[int] | NDArray[np.int64]


class Frames(ABC):
    """A sequence of frames, decoded when asked for.

    ``len(frames)``, ``frames[i]``, ``frames[-1]``, ``frames[a:b]`` and iteration work as on a
    list. Not to be shared between threads or over a fork.

    Where frames can be given otherwise than recorded:

    * ``format``: ``"native"`` in their ROS encoding; ``"rgb"`` and ``"bgr"``, shape (H, W, 3);
      ``"gray"``, shape (H, W). 16 bits stay 16 bits, a Bayer mosaic is interpolated, alpha is
      left out. Depths and other numbers are only given as ``"native"``.
    * ``crop``: x, y, width and height in pixels of the image, cut out first.
    * ``resize``: a factor, or width and height. Sizes are reduced by area and enlarged by bicubic
      interpolation; depths and other numbers take the nearest pixel. The frame's `intrinsics`
      are those of the picture given.
    """

    def __init__(self) -> None:
        self._views: dict[str, View] = {}

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
        """All calibrations, in the order in which they were first seen; none where not known."""
        return []

    @abstractmethod
    def intrinsics_at(self, index: int) -> Calibration | None:
        """The calibration that held when a frame was recorded.

        Args:
            index: 0 <= index < frames.
        """

    # ------------------------------------------------------------ what makes them

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def pictures_of(self, indices: Sequence[int]) -> Iterator[tuple[int, Picture]]:
        """Pictures of some frames, each with its number.

        Args:
            indices: 0 <= index < frames, increasing.

        Yields:
            Views that hold until the next one is asked for. Nothing else may be read meanwhile.

        Raises:
            VideoError: One cannot be decoded.
        """

    @abstractmethod
    def _pictures_apart(self, runs: Iterable[Sequence[int]]) -> Iterator[tuple[int, Picture]]:
        """As `pictures_of` for each run, by a decoder of its own: more may be read meanwhile."""

    @abstractmethod
    def _pictures(self) -> Iterator[Picture]:
        """All pictures in order, read by a decoder of their own."""

    @abstractmethod
    def _write_pixels(self, picture: Picture, out: Pixels) -> None:
        """Write the pixels of a picture, as recorded."""

    @abstractmethod
    def _frame_id(self, index: int) -> str: ...

    @abstractmethod
    def close(self) -> None:
        """Close the video, if it is open."""

    # ------------------------------------------------------------ by number

    @overload
    def __getitem__(self, index: int) -> Frame: ...

    @overload
    def __getitem__(self, index: slice) -> list[Frame]: ...

    def __getitem__(self, index: int | slice) -> Frame | list[Frame]:
        if isinstance(index, slice):
            return self.get(range(*index.indices(len(self))))
        return self.get((index,))[0]

    def __iter__(self) -> Iterator[Frame]:
        view = self._view("native", None, None)
        for index, picture in enumerate(self._pictures()):
            yield self._frame(index, picture, view)

    def get(
        self,
        indices: Indices,
        *,
        format: str = "native",  # noqa: A002 - as users write it
        resize: Resize = None,
        crop: Crop = None,
    ) -> list[Frame]:
        """Frames by number, decoded in the order that costs least.

        Args:
            indices: In any order, also several times; negative ones count from the end.
            format: See `Frames`.
            resize: See `Frames`.
            crop: See `Frames`.

        Returns:
            One frame for each index, whose pixels are its own.

        Raises:
            IndexError: There is no such frame.
            OptionError: There is no such format, part or size, or not of these frames.
            VideoError: A frame cannot be decoded.
        """
        numbers = numbers_of(self.topic, len(self), indices)
        view = self._view(format, resize, crop)
        found: dict[int, Frame] = {}
        for number, picture in self.pictures_of(sorted(set(numbers))):
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
            OptionError: As for `get`; or `out` has another shape or type.
            VideoError: A frame cannot be decoded.
        """
        numbers = numbers_of(self.topic, len(self), indices)
        view = self._view(format, resize, crop)
        out = _output(out, (len(numbers), *view.shape), view.dtype)
        places: dict[int, list[int]] = {}
        for place, number in enumerate(numbers):
            places.setdefault(number, []).append(place)
        for number, picture in self.pictures_of(sorted(places)):
            first, *others = places[number]
            self._give(picture, view, out[first])
            for place in others:
                np.copyto(out[place], out[first])
        return out

    # ------------------------------------------------------------ by stamp

    @cached_property
    def _by_stamp(self) -> StampIndex:
        return StampIndex(self.topic, self.stamps)

    def index_at(
        self, stamp_ns: int, *, mode: str = "nearest", tolerance_ns: int | None = None
    ) -> int:
        """Number of the frame that belongs to a time.

        Stamps need not be sorted. Of several frames with the same stamp it is the first in
        order, and of two that are equally near the earlier one.

        Args:
            stamp_ns: Nanoseconds.
            mode: ``nearest``; ``before``: the last at or before the time; ``after``: the first
                at or after it; ``exact``.
            tolerance_ns: Most nanoseconds between the frame and the time; None for any number.

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
        """The frame that belongs to a time.

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
        indices = self._by_stamp.between(start_ns, end_ns)
        return self._by_runs(indices, self._view(format, resize, crop))

    def _by_runs(self, indices: NDArray[np.int64], view: View) -> Iterator[Frame]:
        """Frames in an order, of which what increases is decoded in one go."""
        falls = np.flatnonzero(np.diff(indices) < 0) + 1
        runs = (run.tolist() for run in np.split(indices, falls) if len(run))
        for index, picture in self._pictures_apart(runs):
            yield self._frame(index, picture, view)

    # ------------------------------------------------------------ how they are given

    def _view(self, format: str, resize: Resize, crop: Crop) -> View:  # noqa: A002
        key = repr((format, resize, crop))
        view = self._views.get(key)
        if view is None:
            view = view_of(
                self.topic,
                self._known_encoding,
                self.image_size,
                format=format,
                resize=resize,
                crop=crop,
            )
            self._views = {key: view}  # the last one alone: it holds tables of its own
        return view

    def _give(self, picture: Picture, view: View, out: Pixels) -> None:
        if view.is_plain:
            self._write_pixels(picture, out)
            return
        pixels: Pixels = np.empty(self.shape, self.dtype)
        self._write_pixels(picture, pixels)
        view.give(pixels, out)

    def _frame(self, index: int, picture: Picture, view: View) -> Frame:
        data: Pixels = np.empty(view.shape, view.dtype)
        self._give(picture, view, data)
        return Frame(
            data=data,
            index=index,
            stamp_ns=int(self.stamps[index]),
            log_time_ns=int(self.log_times[index]),
            frame_id=self._frame_id(index),
            encoding=view.encoding.name,
            intrinsics=view.calibration(self.intrinsics_at(index)),
        )


def _output(out: Pixels | None, shape: tuple[int, ...], dtype: np.dtype[np.generic]) -> Pixels:
    """The array to write into.

    Raises:
        OptionError: It cannot take what is to be written.
    """
    if out is None:
        return np.empty(shape, dtype)
    if not isinstance(out, np.ndarray) or (out.shape, out.dtype) != (shape, dtype):
        found = f"{out.dtype} {out.shape}" if isinstance(out, np.ndarray) else type(out).__name__
        raise OptionError(f"out is {found} where an array of {dtype} {shape} is needed")
    if not out.flags.writeable:
        raise OptionError("out cannot be written to")
    return out
