"""All frames of a topic that has several streams, or images that are stored verbatim."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mp4ds.dataset.frames import Frame, Frames, Indices, numbers_of
from mp4ds.dataset.stream import Stream
from mp4ds.dataset.verbatim import VerbatimFrames
from mp4ds.dataset.views import Crop, Resize, View, check_outputs, output
from mp4ds.errors import OptionError
from mp4ds.format.models import Calibration
from mp4ds.messages.encodings import Pixels

Integers = NDArray[np.int64]
Part = Stream | VerbatimFrames


class TopicFrames(Frames):
    """All frames of a topic that changes its size or encoding, or has some verbatim. See `Frames`.

    They are in recorded order, each with its own size, encoding and intrinsics; a `crop` or a
    factor applies to each frame. Properties of all frames (`shape`, `dtype`, `encoding`,
    `image_size`, and the array of `read`) are available only if they are common to all: `read`
    needs a `resize` to width and height, and a `format`, that make them equal.

    Attributes:
        parts: Their streams, then those that are stored verbatim.

    Args:
        parts: Of one topic, at least one.
    """

    def __init__(self, parts: Sequence[Part]) -> None:
        self.parts = list(parts)

    @property
    def streams(self) -> list[Stream]:
        """The streams of those that are in videos."""
        return [part for part in self.parts if isinstance(part, Stream)]

    # ------------------------------------------------------------ what they are

    @property
    def topic(self) -> str:
        """Topic of the images."""
        return self.parts[0].topic

    @cached_property
    def stamps(self) -> Integers:
        """Header stamps, nanoseconds, shape (frames,)."""
        return self._gathered([part.stamps for part in self.parts])

    @cached_property
    def log_times(self) -> Integers:
        """Log times, nanoseconds, shape (frames,)."""
        return self._gathered([part.log_times for part in self.parts])

    @property
    def encoding(self) -> str:
        """ROS image encoding of the frames as recorded.

        Raises:
            OptionError: They differ.
        """
        self._check_alike([part.encoding for part in self.parts])
        return self.parts[0].encoding

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height of the images, pixels.

        Raises:
            OptionError: They differ.
        """
        self._check_alike([part.image_size for part in self.parts])
        return self.parts[0].image_size

    @property
    def calibrations(self) -> Sequence[Calibration]:
        """All calibrations, part by part."""
        found: list[Calibration] = []
        for part in self.parts:
            found += [item for item in part.calibrations if item not in found]
        return found

    def intrinsics_at(self, index: int) -> Calibration | None:
        """The calibration that held when a frame was recorded.

        Args:
            index: 0 <= index < frames.
        """
        owner, number = self.place_of(index)
        return owner.intrinsics_at(number)

    def place_of(self, index: int) -> tuple[Part, int]:
        """The part that has a frame, and the frame's number there.

        Args:
            index: 0 <= index < frames.
        """
        return self.parts[int(self._owners[index])], int(self._numbers[index])

    def numbers_of(self, part: int) -> Integers:
        """Numbers of the frames of a part, in its order.

        Args:
            part: Index into `parts`.
        """
        return np.flatnonzero(self._owners == part)

    def __len__(self) -> int:
        return sum(map(len, self.parts))

    def close(self) -> None:
        """Close what is open of videos."""
        for part in self.parts:
            part.close()

    # ------------------------------------------------------------ which stream has which

    @cached_property
    def _owners(self) -> Integers:
        """For each frame, the number of its part.

        Messages of a channel are in the order of their ordinals. Several channels of the topic
        are merged by log time, as `Dataset.records` merges them.
        """
        channels: dict[object, list[int]] = {}
        for number, part in enumerate(self.parts):
            channels.setdefault(part.channel.identity, []).append(number)
        owners, times = [], []
        for numbers in channels.values():
            own = [self.parts[number] for number in numbers]
            ordinals = [np.maximum.accumulate(part.ordinals) for part in own]
            order = np.argsort(np.concatenate(ordinals), kind="stable")
            owners.append(np.repeat(numbers, [len(part) for part in ordinals])[order])
            log_times = np.concatenate([part.log_times for part in own])[order]
            times.append(np.maximum.accumulate(log_times))
        order = np.argsort(np.concatenate(times), kind="stable")
        found: Integers = np.concatenate(owners)[order].astype(np.int64, copy=False)
        return found

    @cached_property
    def _numbers(self) -> Integers:
        """For each frame, its number in its part."""
        return self._gathered([np.arange(len(part)) for part in self.parts])

    def _gathered(self, columns: Sequence[Integers]) -> Integers:
        """Values for all frames, from those of each part."""
        found = np.empty(len(self), np.int64)
        for owner, column in enumerate(columns):
            found[self._owners == owner] = column
        return found

    def _by_part(self, numbers: Sequence[int]) -> Iterator[tuple[int, Integers, Integers]]:
        """For each part: which positions of a list of frames it has, and their numbers there."""
        chosen = np.array(numbers, np.int64)
        owners = self._owners[chosen]
        for owner in np.unique(owners).tolist():
            places = np.flatnonzero(owners == owner)
            yield owner, places, self._numbers[chosen[places]]

    def _check_alike(self, values: Sequence[object]) -> None:
        if all(value == values[0] for value in values):
            return
        kinds = ["{}x{} {}".format(*part.image_size, part.encoding) for part in self.parts]
        names = ", ".join(stream.path.stem for stream in self.streams) or "none"
        raise OptionError(
            f"{self.topic} changes its size or encoding: {', '.join(dict.fromkeys(kinds))}. Check "
            "each frame, read them with resize=(width, height) and format='rgb' or 'gray', or "
            f"choose one of the streams {names}"
        )

    # ------------------------------------------------------------ by number

    def __iter__(self) -> Iterator[Frame]:
        parts = {owner: iter(part) for owner, part in enumerate(self.parts)}
        return self._merged(np.arange(len(self)), parts)

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
        found: dict[int, Frame] = {}
        for owner, places, own in self._by_part(numbers):
            frames = self.parts[owner].get(own, format=format, resize=resize, crop=crop)
            for place, frame in zip(places.tolist(), frames, strict=True):
                found[place] = replace(frame, index=numbers[place])
        return [found[place] for place in range(len(numbers))]

    def read(
        self,
        indices: Indices,
        *,
        format: str = "rgb",  # noqa: A002
        resize: Resize = None,
        crop: Crop = None,
        out: Pixels | None = None,
    ) -> Pixels:
        """See `Frames.read`.

        Raises:
            OptionError: As for `Frames.read`; or the topic's frames would differ, including those
                not requested.
        """
        numbers = numbers_of(self.topic, len(self), indices)
        views = self._views_alike(format, resize, crop)
        out = output(out, (len(numbers), *views[0].shape), views[0].dtype)
        self._write(numbers, views, list(out))
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
        views = self._views_alike(format, resize, crop)
        check_outputs(outs, len(numbers), views[0])
        self._write(numbers, views, outs)

    def _views_alike(self, format: str, resize: Resize, crop: Crop) -> list[View]:  # noqa: A002
        views = [part._view(format, resize, crop) for part in self.parts]
        self._check_alike([(view.encoding.name, view.shape) for view in views])
        return views

    def _write(self, numbers: Sequence[int], views: Sequence[View], outs: Sequence[Pixels]) -> None:
        for owner, places, own in self._by_part(numbers):
            self.parts[owner]._write(own.tolist(), views[owner], [outs[place] for place in places])

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
        indices = self._by_stamp.between(start_ns, end_ns)
        owners = self._owners[indices]
        parts = {}
        for owner in np.unique(owners).tolist():
            part = self.parts[owner]
            view = part._view(format, resize, crop)
            parts[owner] = part._in_order(self._numbers[indices[owners == owner]], view)
        return self._merged(indices, parts)

    def _merged(self, indices: Integers, parts: Mapping[int, Iterator[Frame]]) -> Iterator[Frame]:
        """Frames in a given order, with an iterator for each part.

        Each iterator is exhausted after its last frame, so that its decoder is closed.
        """
        owners: list[int] = self._owners[indices].tolist()
        last = {owner: place for place, owner in enumerate(owners)}
        for place, (index, owner) in enumerate(zip(indices.tolist(), owners, strict=True)):
            yield replace(next(parts[owner]), index=index)
            if last[owner] == place:
                next(parts[owner], None)
