"""The frames of one video: what streams and videos of others have in common."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import OptionError
from mp4ds.layouts import Picture, Pixels
from mp4ds.streams.frames import Frame, Frames, Indices
from mp4ds.streams.lookup import numbers_of
from mp4ds.streams.views import Crop, Resize, View, view_of


class DecodedFrames(Frames):
    """The frames of one video, all of one size and encoding. See `Frames`."""

    def __init__(self) -> None:
        self._views: dict[str, View] = {}

    # ------------------------------------------------------------ what makes them

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

    # ------------------------------------------------------------ by number

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
        """See `Frames.get`."""
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
        """See `Frames.read`."""
        numbers = numbers_of(self.topic, len(self), indices)
        view = self._view(format, resize, crop)
        out = output(out, (len(numbers), *view.shape), view.dtype)
        self._write(numbers, view, list(out))
        return out

    def _write(self, numbers: Sequence[int], view: View, out: Sequence[Pixels]) -> None:
        """Write the pixels of frames.

        Args:
            numbers: 0 <= number < frames, in any order, also several times.
            view: Of these frames.
            out: An array for each.

        Raises:
            VideoError: A frame cannot be decoded.
        """
        places: dict[int, list[int]] = {}
        for place, number in enumerate(numbers):
            places.setdefault(number, []).append(place)
        for number, picture in self.pictures_of(sorted(places)):
            first, *others = places[number]
            self._give(picture, view, out[first])
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
        """Frames in an order, of which what increases is decoded in one go."""
        falls = np.flatnonzero(np.diff(indices) < 0) + 1
        runs = (run.tolist() for run in np.split(indices, falls) if len(run))
        for index, picture in self._pictures_apart(runs):
            yield self._frame(index, picture, view)

    # ------------------------------------------------------------ how they are given

    def _view(self, format: str, resize: Resize, crop: Crop) -> View:  # noqa: A002
        """One way of giving the frames.

        Raises:
            OptionError: There is no such format, part or size, or not of these frames.
        """
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


def output(out: Pixels | None, shape: tuple[int, ...], dtype: np.dtype[np.generic]) -> Pixels:
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
