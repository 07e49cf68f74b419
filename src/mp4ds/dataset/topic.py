"""The frames of a topic, by number and by time."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from operator import index as as_integer
from reprlib import repr as shortened
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from mp4ds.dataset.images import Images, Integers, PredictedFrames, VerbatimImages
from mp4ds.dataset.stream import Layer, Stream
from mp4ds.dataset.views import Crop, Resize, View, output
from mp4ds.errors import Mp4dsError, OptionError
from mp4ds.format.models import Calibration
from mp4ds.messages.encodings import ENCODINGS, Picture, Pixels
from mp4ds.times import StampIndex
from mp4ds.video.access import FrameReader

Indices = Sequence[int] | NDArray[np.int64]


@dataclass(frozen=True)
class Frame:
    """One image of a topic.

    Attributes:
        data: Pixels in the encoding, shape as in `Encoding.shape`, native byte order.
        index: Number of the frame in its topic.
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


@dataclass(slots=True)
class _Opened:
    """What a process has open of a topic.

    Attributes:
        lock: Held while anything of it is used: two threads in one decoder crash.
        readers: The decoders for frames by number, by part.
        views: The last view of each part, with its key.
        inherited: Iterators of another process, kept as they are: to free their decoders would
            be to wait for threads that a fork does not copy.
    """

    lock: threading.RLock = field(default_factory=threading.RLock)
    readers: dict[int, FrameReader | PredictedFrames | VerbatimImages] = field(default_factory=dict)
    views: dict[int, tuple[str, View]] = field(default_factory=dict)
    inherited: list[object] = field(default_factory=list)


class Topic:
    """The frames of a topic in recorded order, decoded on demand.

    ``len(topic)``, ``topic[i]``, ``topic[-1]``, ``topic[a:b]`` and iteration work as on a list.
    Threads that share it wait for each other; a process made by a fork opens the video itself. An
    iterator belongs to one thread of one process.

    A topic that changes its size or encoding has several streams, and images that no video could
    hold are stored verbatim: all are its frames, each with its own size, encoding and intrinsics.
    Properties of all frames (`shape`, `dtype`, `encoding`, `image_size`, and the array of `read`)
    are available only if they are common to all: `read` may need a `resize` to width and height,
    and a `format`, that make them equal.

    Options for returning frames other than as recorded:

    * ``format``: ``"native"`` in their ROS encoding; ``"rgb"`` and ``"bgr"``, shape (H, W, 3);
      ``"gray"``, shape (H, W). 16 bits stay 16 bits, a Bayer mosaic is interpolated, alpha is
      dropped. Depths and other measurements are available as ``"native"``; depths also as
      ``"depth_m"``, float32 in metres, shape (H, W). Missing depths are 0 or NaN, as recorded.
    * ``crop``: x, y, width and height in pixels of the image, applied first.
    * ``resize``: a factor, or width and height. Images are shrunk by area averaging and enlarged by
      bicubic interpolation; depths and other measurements use the nearest pixel. The frame's
      `intrinsics` are adjusted to match.

    Attributes:
        parts: Its streams, then the images that are stored verbatim; or a third-party video.

    Args:
        parts: Of one topic, at least one.
    """

    def __init__(self, parts: Sequence[Images]) -> None:
        self.parts = list(parts)
        # What other processes opened stays in it, for the reason given at `_Opened`.
        self._processes: dict[int, _Opened] = {}
        self._layers: dict[Layer, Topic] = {}

    def __repr__(self) -> str:
        found = [f"{len(self)} frame{'s' * (len(self) != 1)}"]
        with suppress(Mp4dsError):  # of frames that differ
            found.append("{}x{} {}".format(*self.image_size, self.encoding))
        with suppress(Mp4dsError):  # of a damaged sidecar, which is reported when it is used
            found.append(f"{np.ptp(self.log_times) / 1e9:.1f} s")
        return f"<Topic {self.topic!r}: {', '.join(found)}>"

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_processes": {}}

    @property
    def _opened(self) -> _Opened:
        process = os.getpid()
        return self._processes.get(process) or self._processes.setdefault(process, _Opened())

    def close(self) -> None:
        """Close its videos; they are opened again when needed."""
        opened = self._opened
        with opened.lock:
            while opened.readers:
                opened.readers.popitem()[1].close()
        for topic in self._layers.values():
            topic.close()

    # ------------------------------------------------------------ what they are

    @property
    def topic(self) -> str:
        """Topic of the images; of a third-party video, the file name without extension."""
        return self.parts[0].topic

    @property
    def streams(self) -> list[Stream]:
        """The streams of those frames that are in videos with a sidecar."""
        return [part for part in self.parts if isinstance(part, Stream)]

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
    def shape(self) -> tuple[int, ...]:
        """Shape of a frame's pixels as recorded: (H, W), or (H, W, channels).

        Raises:
            OptionError: They differ.
        """
        return ENCODINGS[self.encoding].shape(*self.image_size)

    @property
    def dtype(self) -> np.dtype[np.generic]:
        """Type of a frame's samples as recorded, native byte order.

        Raises:
            OptionError: They differ.
        """
        return np.dtype(ENCODINGS[self.encoding].dtype)

    @property
    def calibrations(self) -> Sequence[Calibration]:
        """All calibrations, in the order in which they were first seen; none if unknown."""
        found: list[Calibration] = []
        for part in self.parts:
            found += [item for item in part.calibrations if item not in found]
        return found

    def intrinsics_at(self, index: int) -> Calibration | None:
        """The calibration that applied when a frame was recorded.

        That is the last one recorded before the frame, else the first.

        Args:
            index: 0 <= index < frames.
        """
        return self.place_of(index)[0].calibration_at(int(self.log_times[index]))

    def __len__(self) -> int:
        return sum(map(len, self.parts))

    # ------------------------------------------------------------ which part has which

    def place_of(self, index: int) -> tuple[Images, int]:
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

    @cached_property
    def _owners(self) -> Integers:
        """For each frame, the number of its part.

        Messages of a channel are in the order of their ordinals. Several channels of the topic
        are merged by log time, as `Dataset.records` merges them.
        """
        if len(self.parts) == 1:
            return np.zeros(len(self), np.int64)
        channels: dict[object, list[int]] = {}
        for number, part in enumerate(self.parts):
            channels.setdefault(part.channel and part.channel.identity, []).append(number)
        owners, times = [], []
        for numbers in channels.values():
            own = [self.parts[number] for number in numbers]
            order = np.argsort(
                np.concatenate([part.columns.ordinal for part in own]), kind="stable"
            )
            owners.append(np.repeat(numbers, list(map(len, own)))[order])
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
        if len(columns) == 1:
            return columns[0]
        found = np.empty(len(self), np.int64)
        for owner, column in enumerate(columns):
            found[self._owners == owner] = column
        return found

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

    @overload
    def __getitem__(self, index: int) -> Frame: ...

    @overload
    def __getitem__(self, index: slice) -> list[Frame]: ...

    def __getitem__(self, index: int | slice) -> Frame | list[Frame]:
        if isinstance(index, slice):
            return self.get(range(*index.indices(len(self))))
        return self.get((index,))[0]

    def __iter__(self) -> Iterator[Frame]:
        parts: dict[int, Iterator[Frame]] = {}
        for owner, part in enumerate(self.parts):
            view = self._view(owner, "native", None, None)
            parts[owner] = self._one_by_one(owner, view, part.pictures(scale=view.scale))
        return self._merged(np.arange(len(self)), parts)

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
            format: See `Topic`.
            resize: See `Topic`.
            crop: See `Topic`.

        Returns:
            One frame for each index, each with its own pixels.

        Raises:
            IndexError: There is no such frame.
            OptionError: The format, crop or size is invalid, or not available for these frames.
            VideoError: A frame cannot be decoded.
        """
        numbers = self._checked(indices)
        found: dict[int, Frame] = {}
        with self._opened.lock:
            view_of = partial(self._view, format=format, resize=resize, crop=crop)
            for owner, number, index, picture in self._pictures(sorted(set(numbers)), view_of, {}):
                found[index] = self._frame(owner, number, index, picture, view_of(owner))
        given: set[int] = set()
        frames = []
        for number in numbers:
            frame = found[number]
            frames.append(replace(frame, data=frame.data.copy()) if number in given else frame)
            given.add(number)
        return frames

    def in_layer(self, layer: Layer) -> Topic:
        """The same frames of a layer: ``exact``, or those that the ``view`` shows.

        Raises:
            OptionError: The exact frames are not here.
        """
        if layer not in self._layers:
            self._layers[layer] = Topic(
                [part.in_layer(layer) if isinstance(part, Stream) else part for part in self.parts]
            )
        return self._layers[layer]

    def read(
        self,
        indices: Indices,
        *,
        format: str = "rgb",  # noqa: A002
        resize: Resize = None,
        crop: Crop = None,
        layer: Layer | None = None,
        out: Pixels | None = None,
    ) -> Pixels:
        """Pixels of frames by number, in one array.

        Args:
            indices: As for `get`.
            format: See `Topic`.
            resize: See `Topic`.
            crop: See `Topic`.
            layer: See `in_layer`; None: as the dataset was opened.
            out: Where to write them, or None for a new array. Shape and type as returned.

        Returns:
            Shape (indices, H, W) or (indices, H, W, channels); `out`, if it was given.

        Raises:
            IndexError: There is no such frame.
            OptionError: As for `get`; or `out` has the wrong shape or type; or the topic's frames
                would differ, including those not requested.
            VideoError: A frame cannot be decoded.
        """
        if layer is not None:
            return self.in_layer(layer).read(
                indices, format=format, resize=resize, crop=crop, out=out
            )
        numbers = self._checked(indices)
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
        """Like `read`, but each frame into its own array.

        Args:
            indices: As for `get`.
            outs: An array for each, with the shape and type of a row returned by `read`.
            format: See `Topic`.
            resize: See `Topic`.
            crop: See `Topic`.

        Raises:
            IndexError: There is no such frame.
            OptionError: As for `read`.
            VideoError: A frame cannot be decoded.
        """
        numbers = self._checked(indices)
        views = self._views_alike(format, resize, crop)
        if len(outs) != len(numbers):
            raise OptionError(f"outs has {len(outs)} arrays for {len(numbers)} frames")
        for out in outs:
            output(out, views[0].shape, views[0].dtype)
        self._write(numbers, views, outs)

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
            format: See `Topic`.
            resize: See `Topic`.
            crop: See `Topic`.

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
            format: See `Topic`.
            resize: See `Topic`.
            crop: See `Topic`.

        Raises:
            OptionError: An option is wrong; see `get`.
            VideoError: A frame cannot be decoded.
        """
        indices = self._by_stamp.between(start_ns, end_ns)
        parts = {}
        for owner in np.unique(self._owners[indices]).tolist() or [0]:  # see `_pictures`
            own = self._numbers[indices[self._owners[indices] == owner]]
            view = self._view(owner, format, resize, crop)
            parts[owner] = self._in_order(owner, own, view)
        return self._merged(indices, parts)

    # ------------------------------------------------------------ how they are decoded

    def _checked(self, indices: Indices) -> list[int]:
        """Frame numbers from 0 on; negative ones count from the end.

        Raises:
            IndexError: There is no such frame.
            TypeError: One is not an integer.
        """
        if not isinstance(indices, Iterable):
            raise TypeError(
                f"frames of {self.topic} are read by a list of numbers: use [{indices!r}]"
            )
        numbers, count = [], len(self)
        for index in indices.tolist() if isinstance(indices, np.ndarray) else indices:
            if isinstance(index, bool):
                raise TypeError(
                    "frames are selected by number: for a mask, give np.flatnonzero(mask)"
                )
            try:
                asked = as_integer(index)
            except TypeError:
                raise TypeError(
                    f"frames of {self.topic} are selected by integers, not {shortened(index)}: "
                    "read([0, 5]) and get([0, 5]) take several, at(stamp_ns) a time"
                ) from None
            number = asked + count if asked < 0 else asked
            if not 0 <= number < count:
                raise IndexError(
                    f"{self.topic} has no frame {asked}: its {count} frames are 0 to {count - 1}, "
                    f"or {-count} to -1 from the end"
                )
            numbers.append(number)
        return numbers

    def _pictures(
        self, numbers: Sequence[int], view_of: Callable[[int], View], outs: Mapping[int, Pixels]
    ) -> Iterator[tuple[int, int, int, Picture]]:
        """Pictures of some frames, part by part; the lock is held.

        Args:
            numbers: Of the frames, increasing; so are those in each part.
            view_of: How those of a part are returned; asked also if there are no frames, so that
                it is checked.
            outs: Where the decoder may write a picture of the view's scale, by number.

        Yields:
            The part, the frame's number there and in the topic, and its picture.
        """
        chosen, readers = np.array(numbers, np.int64), self._opened.readers
        owners = self._owners[chosen]
        for owner in sorted(set(owners.tolist())) or [0]:
            scale, places = view_of(owner).scale, chosen[owners == owner]
            if not len(places):
                return
            own: list[int] = self._numbers[places].tolist()
            if owner not in readers:
                readers[owner] = self.parts[owner].open_reader()
            given = {n: outs[i] for n, i in zip(own, places.tolist(), strict=True) if i in outs}
            with self.parts[owner].naming_frames():
                pictures = readers[owner].pictures_of(own, scale, given if scale else None)
                for index, (number, picture) in zip(places.tolist(), pictures, strict=True):
                    yield owner, number, index, picture

    def _write(self, numbers: Sequence[int], views: Sequence[View], out: Sequence[Pixels]) -> None:
        """Write the pixels of frames.

        Args:
            numbers: 0 <= number < frames, in any order, with repetitions.
            views: The view of each part.
            out: An array for each.

        Raises:
            VideoError: A frame cannot be decoded.
        """
        places: dict[int, list[int]] = {}
        for place, number in enumerate(numbers):
            places.setdefault(number, []).append(place)
        outs = {index: out[first] for index, (first, *_) in places.items()}
        with self._opened.lock:
            pictures = self._pictures(sorted(places), views.__getitem__, outs)
            for owner, number, index, picture in pictures:
                self.parts[owner].pixels(picture, views[owner], number, outs[index])
                for place in places[index][1:]:
                    np.copyto(out[place], outs[index])

    def _in_order(self, owner: int, own: Integers, view: View) -> Iterator[Frame]:
        """Frames of a part in a given order; increasing runs are decoded in one go."""
        falls = np.flatnonzero(np.diff(own) < 0) + 1
        part = self.parts[owner]
        with closing(part.open_reader()) as reader:  # a separate one: more may be read meanwhile
            for run in np.split(own, falls):
                pictures = reader.pictures_of(run.tolist(), view.scale)
                yield from self._one_by_one(owner, view, pictures)

    def _one_by_one(
        self, owner: int, view: View, pictures: Iterable[tuple[int, Picture]]
    ) -> Iterator[Frame]:
        """The frames of a part from its pictures; their index is that in the part."""
        process = os.getpid()
        try:
            with self.parts[owner].naming_frames():
                for number, picture in pictures:
                    yield self._frame(owner, number, number, picture, view)
                    if os.getpid() != process:
                        self._opened.inherited.append(pictures)
                        raise RuntimeError(
                            f"an iterator over {self.topic} that process {process} began cannot "
                            f"go on in process {os.getpid()}, a fork of it: begin it again there"
                        )
        finally:
            # closes its decoder: Python 3.10's contextlib leaves this frame in a cycle with what
            # ended it, until the next collection of garbage
            del pictures

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

    # ------------------------------------------------------------ how they are given

    def _view(self, owner: int, format: str, resize: Resize, crop: Crop) -> View:  # noqa: A002
        """The view of a part's frames for a format, size and crop.

        Raises:
            OptionError: The format, crop or size is invalid, or not available for these frames.
        """
        key, views = repr((format, resize, crop)), self._opened.views
        # no more than one of each part: each holds its own tables
        if owner not in views or views[owner][0] != key:
            views[owner] = key, self.parts[owner].view(format, resize, crop)
        return views[owner][1]

    def _views_alike(self, format: str, resize: Resize, crop: Crop) -> list[View]:  # noqa: A002
        views = [self._view(owner, format, resize, crop) for owner in range(len(self.parts))]
        self._check_alike([(view.encoding.name, view.shape) for view in views])
        return views

    def _frame(self, owner: int, number: int, index: int, picture: Picture, view: View) -> Frame:
        """A frame.

        Args:
            owner: Its part.
            number: Its number there.
            index: Its number in the topic.
            picture: Its picture.
            view: How it is returned.
        """
        part = self.parts[owner]
        with self._opened.lock:  # a view has tables that one thread uses at a time
            data = part.pixels(picture, view, number)
        log_time = int(part.log_times[number])
        return Frame(
            data=data,
            index=index,
            stamp_ns=int(part.stamps[number]),
            log_time_ns=log_time,
            frame_id=part.frame_id(number),
            encoding=view.encoding.name,
            intrinsics=view.calibration(part.calibration_at(log_time)),
        )
