"""All frames of a topic with several streams."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mp4ds.dataset.frames import Frame, Frames, Indices, numbers_of
from mp4ds.dataset.stream import Stream
from mp4ds.dataset.views import Crop, Resize, View, check_outputs, output
from mp4ds.errors import OptionError
from mp4ds.format.models import Calibration
from mp4ds.messages.encodings import Pixels

Integers = NDArray[np.int64]


class TopicFrames(Frames):
    """All frames of a topic that changes its size or encoding. See `Frames`.

    They are in recorded order, each with its own size, encoding and intrinsics; a `crop` or a
    factor applies to each frame. Properties of all frames (`shape`, `dtype`, `encoding`,
    `image_size`, and the array of `read`) are available only if they are common to all: `read`
    needs a `resize` to width and height, and a `format`, that make them equal.

    Attributes:
        streams: Their streams.

    Args:
        streams: The streams of one topic, at least one.
    """

    def __init__(self, streams: Sequence[Stream]) -> None:
        self.streams = list(streams)

    # ------------------------------------------------------------ what they are

    @property
    def topic(self) -> str:
        """Topic of the images."""
        return self.streams[0].topic

    @cached_property
    def stamps(self) -> Integers:
        """Header stamps, nanoseconds, shape (frames,)."""
        return self._gathered([stream.stamps for stream in self.streams])

    @cached_property
    def log_times(self) -> Integers:
        """Log times, nanoseconds, shape (frames,)."""
        return self._gathered([stream.log_times for stream in self.streams])

    @property
    def encoding(self) -> str:
        """ROS image encoding of the frames as recorded.

        Raises:
            OptionError: They differ.
        """
        self._check_alike([stream.encoding for stream in self.streams])
        return self.streams[0].encoding

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height of the images, pixels.

        Raises:
            OptionError: They differ.
        """
        self._check_alike([stream.image_size for stream in self.streams])
        return self.streams[0].image_size

    @property
    def calibrations(self) -> Sequence[Calibration]:
        """All calibrations, stream by stream."""
        found: list[Calibration] = []
        for stream in self.streams:
            found += [item for item in stream.calibrations if item not in found]
        return found

    def intrinsics_at(self, index: int) -> Calibration | None:
        """The calibration that held when a frame was recorded.

        Args:
            index: 0 <= index < frames.
        """
        owner, number = self.place_of(index)
        return owner.intrinsics_at(number)

    def place_of(self, index: int) -> tuple[Stream, int]:
        """The stream of a frame, and the frame's number there.

        Args:
            index: 0 <= index < frames.
        """
        return self.streams[int(self._owners[index])], int(self._numbers[index])

    def __len__(self) -> int:
        return sum(map(len, self.streams))

    def close(self) -> None:
        """Close what is open of videos."""
        for stream in self.streams:
            stream.close()

    # ------------------------------------------------------------ which stream has which

    @cached_property
    def _owners(self) -> Integers:
        """For each frame, the number of its stream.

        Messages of a channel are in the order of their ordinals. Several channels of the topic
        are merged by log time, as `Dataset.records` merges them.
        """
        channels: dict[object, list[int]] = {}
        for number, stream in enumerate(self.streams):
            identity = stream.sidecar.channel.to_record(0).identity
            channels.setdefault(identity, []).append(number)
        owners, times = [], []
        for numbers in channels.values():
            columns = [self.streams[number].columns for number in numbers]
            ordinals = [np.maximum.accumulate(column.ordinal) for column in columns]
            order = np.argsort(np.concatenate(ordinals), kind="stable")
            owners.append(np.repeat(numbers, [len(part) for part in ordinals])[order])
            log_times = np.concatenate([column.log_time for column in columns])[order]
            times.append(np.maximum.accumulate(log_times))
        order = np.argsort(np.concatenate(times), kind="stable")
        return np.concatenate(owners)[order].astype(np.int64, copy=False)

    @cached_property
    def _numbers(self) -> Integers:
        """For each frame, its number in its stream."""
        return self._gathered([np.arange(len(stream)) for stream in self.streams])

    def _gathered(self, columns: Sequence[Integers]) -> Integers:
        """Values for all frames, from those of each stream."""
        found = np.empty(len(self), np.int64)
        for owner, column in enumerate(columns):
            found[self._owners == owner] = column
        return found

    def _by_stream(self, numbers: Sequence[int]) -> Iterator[tuple[Stream, Integers, Integers]]:
        """For each stream: which positions of a list of frames it has, and their numbers there."""
        chosen = np.array(numbers, np.int64)
        owners = self._owners[chosen]
        for owner in np.unique(owners).tolist():
            places = np.flatnonzero(owners == owner)
            yield self.streams[owner], places, self._numbers[chosen[places]]

    def _check_alike(self, values: Sequence[object]) -> None:
        if all(value == values[0] for value in values):
            return
        kinds = ["{}x{} {}".format(*stream.image_size, stream.encoding) for stream in self.streams]
        names = ", ".join(stream.path.stem for stream in self.streams)
        raise OptionError(
            f"{self.topic} changes its size or encoding: {', '.join(dict.fromkeys(kinds))}. Check "
            "each frame, read them with resize=(width, height) and format='rgb' or 'gray', or "
            f"choose one of the streams {names}"
        )

    # ------------------------------------------------------------ by number

    def __iter__(self) -> Iterator[Frame]:
        parts = {owner: iter(stream) for owner, stream in enumerate(self.streams)}
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
        for stream, places, own in self._by_stream(numbers):
            frames = stream.get(own, format=format, resize=resize, crop=crop)
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
        views = [stream._view(format, resize, crop) for stream in self.streams]
        self._check_alike([(view.encoding.name, view.shape) for view in views])
        return views

    def _write(self, numbers: Sequence[int], views: Sequence[View], outs: Sequence[Pixels]) -> None:
        for stream, places, own in self._by_stream(numbers):
            view = views[self.streams.index(stream)]
            stream._write(own.tolist(), view, [outs[place] for place in places])

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
            stream = self.streams[owner]
            view = stream._view(format, resize, crop)
            parts[owner] = stream._in_order(self._numbers[indices[owners == owner]], view)
        return self._merged(indices, parts)

    def _merged(self, indices: Integers, parts: Mapping[int, Iterator[Frame]]) -> Iterator[Frame]:
        """Frames in a given order, with an iterator for each stream.

        Each iterator is exhausted after its last frame, so that its decoder is closed.
        """
        owners: list[int] = self._owners[indices].tolist()
        last = {owner: place for place, owner in enumerate(owners)}
        for place, (index, owner) in enumerate(zip(indices.tolist(), owners, strict=True)):
            yield replace(next(parts[owner]), index=index)
            if last[owner] == place:
                next(parts[owner], None)
