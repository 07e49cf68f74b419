"""Samples by number, in the order of the recordings."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from math import prod
from operator import index as as_integer
from pathlib import Path
from reprlib import repr as shortened
from typing import Any, Literal, SupportsIndex, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset, default_collate, get_worker_info

from mp4ds.dataset.stream import Layer
from mp4ds.dataset.vectors import Fields
from mp4ds.dataset.views import Crop, Resize
from mp4ds.errors import OptionError, counted
from mp4ds.torch.cameras import CACHE_BYTES, Backend, Dtype, FrameCache, OpenCamera, OpenCameras
from mp4ds.torch.recordings import (
    Paths,
    Pick,
    Recording,
    VectorReader,
    at_least,
    each,
    episodes_of,
    one_of,
    recordings_of,
)

Unit = Literal["frames", "seconds"]
_MOST_SECONDS = 10**9
_MOST_FPS = 1000


class Offsets:
    """Which frames a sample has, relative to its own row, in rows or by time.

    Args:
        values: The offsets.
        unit: ``frames`` or ``seconds``.
        tolerance_ns: How far a frame may be from its time; None: half a period of the camera.

    Attributes:
        steps: The offsets, in rows or nanoseconds.
        is_single: Whether a sample has its own frame alone, and no dimension for more.

    Raises:
        OptionError: There are none, or they are not valid in that unit.
    """

    def __init__(self, values: Sequence[float], unit: Unit, tolerance_ns: int | None) -> None:
        if not isinstance(values, Iterable):
            raise OptionError(f"offsets is {values!r}, but a list such as (-1, 0).")
        given = tuple(values)
        if not given:
            raise OptionError("offsets is empty; use (0,) for the sample's own frame alone.")
        one_of("offsets_in", unit, get_args(Unit))
        self._timed = unit == "seconds"
        self._tolerance_ns = tolerance_ns
        if not self._timed:
            if any(isinstance(value, bool) or value != int(value) for value in given):
                raise OptionError(
                    f"offsets are {given}, but offsets in frames must be integers; "
                    'for seconds, give offsets_in="seconds".'
                )
            if tolerance_ns is not None:
                raise OptionError('tolerance_ns belongs to offsets_in="seconds".')
        elif not all(abs(value) <= _MOST_SECONDS for value in given):
            raise OptionError(f"offsets are {given}, but offsets in seconds can be at most 1e9.")
        at_least(0, tolerance_ns=tolerance_ns)
        scale = 10**9 if self._timed else 1
        self.steps = np.array([round(value * scale) for value in given], np.int64)
        self.is_single = given == (0,) and not self._timed

    def frames(
        self, recording: Recording, camera: int, timeline: OpenCamera, rows: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Frame numbers of samples, and which of them are padding.

        Args:
            recording: Of the samples.
            camera: Number of the camera.
            timeline: The camera's stamps; not used unless offsets are times.
            rows: The samples, shape (N,).

        Returns:
            Two arrays of shape (N, offsets).
        """
        if not self._timed:
            wanted = rows[:, None] + self.steps
            there = np.minimum(np.maximum(wanted, 0), recording.rows - 1)
            return recording.frames(there, camera), there != wanted
        own = recording.frames(rows, camera)[:, None]
        times = timeline.times[own] + self.steps
        # with equal stamps, the frame nearest to its own time may be a different one
        found = np.where(self.steps == 0, own, timeline.nearest(recording.within(times)))
        tolerance = timeline.period_ns // 2 if self._tolerance_ns is None else self._tolerance_ns
        return found, np.abs(timeline.times[found] - times) > tolerance

    def times(
        self, recording: Recording, row_times: NDArray[np.int64], rows: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Times of the messages of samples, and which of them are padding.

        Args:
            recording: Of the samples.
            row_times: Of all its samples, nanoseconds.
            rows: The samples, shape (N,).

        Returns:
            Two arrays of shape (N, offsets).
        """
        if self._timed:
            wanted = row_times[rows][:, None] + self.steps
            times = recording.within(wanted)
            return times, times != wanted
        wanted = rows[:, None] + self.steps
        there = np.clip(wanted, 0, recording.rows - 1)
        return row_times[there], there != wanted


# ---------------------------------------------------------------- samples

Sample = dict[str, Any]
Transform = Callable[[Sample], Any]


def _whole(rows: Sequence[Any]) -> Any:
    """The tensor whose rows these are, in order; a new one if they are not."""
    first = rows[0]
    if not all(isinstance(row, torch.Tensor) for row in rows):
        return default_collate(rows)
    begin = first.storage_offset()
    step = rows[1].storage_offset() - begin if len(rows) > 1 else first.numel()
    kind = _kind(first)
    if step < first.numel() or any(
        _kind(row) != kind or row.storage_offset() != begin + number * step
        for number, row in enumerate(rows)
    ):
        return default_collate(rows)
    return first.as_strided((len(rows), *first.shape), (step, *first.stride()), begin)


def _kind(row: torch.Tensor) -> tuple[object, ...]:
    """What all rows of one tensor share."""
    return row.untyped_storage().data_ptr(), row.dtype, row.device, row.shape, row.stride()


def _new(like: torch.Tensor, *shape: int, shared: bool = False) -> torch.Tensor:
    """A new tensor of a type and place; shared with other processes if asked for."""
    if not shared or like.device.type != "cpu":
        return like.new_empty(shape)
    # as torch's own collate does in a worker
    storage = torch.UntypedStorage._new_shared(prod(shape) * like.itemsize)
    return like.new_empty(0).set_(storage, 0, shape)


class FrameDataset(Dataset):
    """Frames of datasets by number, for a shuffling DataLoader.

    ``FrameDataset("drives/*", resize=(224, 224))[7]`` is a dictionary, here of two cameras:

        {"/left": uint8 (C, H, W), "/right": ..., "/left_is_pad": bool (1,), ...,
         "stamp_ns": int, "index": int, "dataset": int}

    With `offsets`, tensors are (T, C, H, W), and ``is_pad`` marks those frames of T that do not
    exist and are padding; C is 1 for grey images. `state` and `action` add float32 (D,) or (T, D).
    ``stamp_ns`` is the header stamp of the first camera's frame, ``index`` the sample's number,
    ``dataset`` that of its path.

    Frames of several cameras are matched by header stamp (`mp4ds.Dataset.sync`), each at most once;
    `unmatched` has the others.

    A batch is decoded as a whole. Its samples are rows of one tensor per camera, which `collate`
    returns without copying: give it to the DataLoader as ``collate_fn``, and copy samples that
    you keep. A FrameDataset may be pickled and forked: each process opens videos itself when first
    needed.

    Args:
        paths: Datasets, one or several: folders, sidecars, videos, URLs; or folders of datasets
            and patterns such as ``drives/*``.
        topics: Cameras; None: all of the first dataset. The others must have them, too.
        format: ``rgb``, ``bgr``, ``gray``; ``native``: in their ROS encoding; ``depth_m``: depths
            in metres, float32. A mapping by topic gives each camera its own; so do mappings for
            `resize` and `crop`.
        resize: Factor, or width and height in pixels.
        crop: x, y, width, height in pixels; before `resize`.
        layer: Of lossless cameras, the ``view`` decodes faster and looks the same, but has only
            256 levels of 16 bits; ``exact``: the pixels recorded. Cameras without a view have one
            layer; mono16, which may be depths, is exact in both.
        dtype: ``native``: as decoded, uint8 except for cameras of more bits. ``uint8``: the same,
            but refused for those. ``float32``: 0 to 1; native pixels keep their values.
        channels_first: (C, H, W), not (H, W, C).
        transform: Called with each sample; its return value replaces the sample.
        offsets: Frames of a sample relative to its own: ``(-1, 0)`` is the previous one and itself.
            A mapping by topic gives each camera, and ``state``, its own.
        offsets_in: ``frames``: samples of the same recording before and after. ``seconds``: in
            each camera the frame whose stamp is nearest.
        tolerance_ns: With seconds, how far a stamp may be from its time before it counts as
            padding; None: half the median time between the camera's frames.
        sync_tolerance_ns: Maximum distance of the stamps of different cameras in a sample.
        state: Topics and their fields, such as ``{"/joint_states": "position"}``. Several are a
            list: ``["pose.position", "data[0:6]", "position[elbow]"]``. ``"/joint_states"`` alone
            stands for the positions of a JointState, or the data of an array. They are of the
            message at the time of the sample's first frame: its header stamp, or else log time.
        action: The same.
        action_offsets: Those of the action, in the unit of `offsets_in`.
        message: The ``nearest`` one to the time, or the ``previous``, which is not after it.
        message_tolerance_ns: How far it may be from the time before it counts as padding; None:
            twice the median time between the topic's messages.
        fps: Samples per second, at a constant rate while all cameras run, each of the frames
            nearest in time; None: the matched frames.
        episode_topic: Topic whose value (std_msgs/String, Bool, a number) tells episodes: each
            counts as a dataset of its own. Samples where it is false, empty, negative or not there
            are left out. None: a dataset is an episode.
        rename: What some recordings call a topic -> what it is called here:
            ``{"/cam_left/image": "/left/image_raw"}``.
        cache: Where to keep frames as they are returned, for later epochs: a folder that all
            workers and processes of a machine share. None: nowhere.
        cache_bytes: Maximum size of that, over all cameras; other frames are decoded each time.
        cache_files: Maximum number of open videos per process.
        backend: ``torchcodec`` decodes with torchcodec, whose colours differ slightly.
        device: With ``torchcodec``, where to decode and keep the tensors, such as ``cuda``.

    Attributes:
        topics: The cameras of a sample.
        recordings: The samples of each dataset, one after another.

    Raises:
        OptionError: An option is wrong, a topic is not there, or there is no sample.
        SourceError: A path is not a dataset.
        FormatError: A manifest or sidecar breaks a rule of the format.
    """

    def __init__(
        self,
        paths: Paths,
        *,
        topics: Sequence[str] | None = None,
        format: str | Mapping[str, str] = "rgb",  # noqa: A002 - as of Stream.read
        resize: Resize | Mapping[str, Resize] = None,
        crop: Crop | Mapping[str, Crop] = None,
        layer: Layer = "view",
        dtype: Dtype = "native",
        channels_first: bool = True,
        transform: Transform | None = None,
        offsets: Sequence[float] | Mapping[str, Sequence[float]] = (0,),
        offsets_in: Unit = "frames",
        tolerance_ns: int | None = None,
        sync_tolerance_ns: int = 20_000_000,
        state: Fields | None = None,
        action: Fields | None = None,
        action_offsets: Sequence[float] = (0,),
        message: Pick = "nearest",
        message_tolerance_ns: int | None = None,
        fps: int | None = None,
        episode_topic: str | None = None,
        rename: Mapping[str, str] | None = None,
        cache: str | Path | None = None,
        cache_bytes: int = CACHE_BYTES,
        cache_files: int = 16,
        backend: Backend = "mp4ds",
        device: str = "cpu",
    ) -> None:
        if fps is not None and not (isinstance(fps, int) and 1 <= fps <= _MOST_FPS):
            raise OptionError(f"fps is {fps!r}, but must be a whole number from 1 to {_MOST_FPS}.")
        names = rename or {}
        self.topics, self.recordings = recordings_of(
            paths,
            topics,
            sync_tolerance_ns,
            layer,
            rename=names,
            fps=fps,
            timed=episode_topic is not None,
        )
        if episode_topic is not None:
            first = self.recordings[0].path
            self.recordings = [
                part for one in self.recordings for part in episodes_of(one, episode_topic, names)
            ]
            if not self.recordings:
                raise OptionError(
                    f"{first}: no sample is in an episode: while all cameras run, {episode_topic} "
                    "is false, empty or not there."
                )
        given = {key: one for key, one in (("state", state), ("action", action)) if one is not None}
        one_of("message", message, get_args(Pick))
        at_least(0, message_tolerance_ns=message_tolerance_ns)
        for key in given.keys() & {*self.topics}:
            raise OptionError(f"a topic named {key!r} cannot be a key beside the {key}.")
        keys = [*self.topics, *(key for key in given if key != "action")]
        values = each("offsets", offsets, keys, (0,))
        self._offsets = {
            key: Offsets(steps, offsets_in, tolerance_ns)
            for key, steps in [*zip(keys, values, strict=True), ("action", action_offsets)]
        }
        self._vectors = {
            key: VectorReader(
                key,
                one,
                self.recordings,
                pick=message,
                tolerance_ns=message_tolerance_ns,
                rename=names,
            )
            for key, one in given.items()
        }
        starts = np.cumsum([0, *(recording.rows for recording in self.recordings)])
        self._starts: NDArray[np.int64] = starts.astype(np.int64)
        self._transform = transform
        self._channels_first = channels_first
        self._cameras = OpenCameras(
            self.topics,
            cache_files,
            format=format,
            resize=resize,
            crop=crop,
            dtype=dtype,
            backend=backend,
            device=device,
        )
        if cache is not None:
            if backend != "mp4ds":
                raise OptionError("cache needs backend='mp4ds'.")
            sources = {one for recording in self.recordings for one in recording.sources}
            frames = max(sum(one.frames for one in sources), 1)
            self._cameras.cache = FrameCache(cache, cache_bytes, frames)
        self._collates = False

    @property
    def names(self) -> dict[str, tuple[str, ...]]:
        """What the numbers of the state and action are called: joints, or fields."""
        return {key: reader.names for key, reader in self._vectors.items()}

    @property
    def paths(self) -> list[str]:
        """The datasets; a sample's ``dataset`` is an index into these."""
        return [recording.path for recording in self.recordings]

    @property
    def lengths(self) -> list[int]:
        """Number of samples of each dataset."""
        return [recording.rows for recording in self.recordings]

    @property
    def unmatched(self) -> list[dict[str, NDArray[np.int64]]]:
        """For each dataset, the numbers of the frames that are not in any sample, by topic."""
        return [recording.unmatched for recording in self.recordings]

    def __repr__(self) -> str:
        count = counted(len(self.recordings), "dataset")
        return f"<{type(self).__name__}: {len(self)} samples of {count}, {', '.join(self.topics)}>"

    def __len__(self) -> int:
        return int(self._starts[-1])

    def __getitem__(self, index: SupportsIndex) -> Any:
        return self.__getitems__([index])[0]

    def __getitems__(self, indices: Sequence[SupportsIndex]) -> list[Any]:
        """Samples, in the requested order.

        The frames of each camera are decoded in one pass, in the cheapest order.

        Raises:
            IndexError: There is no sample with a number.
            SampleError: A frame cannot be read.
        """
        wanted = [self._number(index) for index in indices]
        return self._read(wanted, shared=self._collates and get_worker_info() is not None)

    def _read(self, numbers: Sequence[int], *, shared: bool) -> list[Any]:
        """Samples; the frames of each camera of a recording are decoded in one pass.

        Their tensors are rows of one tensor for each camera, so that collating copies nothing.

        Args:
            numbers: 0 or more, less than the length; in any order.
            shared: Whether other processes need access.

        Raises:
            SampleError: A frame cannot be read.
        """
        wanted = np.array(numbers, np.int64)
        owners = np.searchsorted(self._starts, wanted, side="right") - 1
        samples: list[Sample] = [{} for _ in numbers]
        tensors: dict[str, torch.Tensor] = {}
        for owner in np.unique(owners).tolist():
            recording = self.recordings[owner]
            places = np.flatnonzero(owners == owner).tolist()
            rows = wanted[places] - self._starts[owner]
            columns: dict[str, torch.Tensor] = {}
            stamps: list[int] = []
            for number, topic in enumerate(self.topics):
                offsets = self._offsets[topic]
                with self._cameras.using(recording, number) as camera:
                    frames, padded = offsets.frames(recording, number, camera, rows)
                    like = camera.none
                    shape = (len(offsets.steps), *like.shape[1:])
                    if topic not in tensors:
                        tensors[topic] = _new(like, len(numbers), *shape, shared=shared)
                    outs = [tensors[topic][place] for place in places]
                    if (outs[0].shape, outs[0].dtype) != (shape, like.dtype):
                        outs = list(_new(like, len(places), *shape))  # it has other images
                    camera.read(frames.ravel().tolist(), [frame for row in outs for frame in row])
                    if number == 0:
                        stamps = camera.stamps[recording.frames(rows, 0)].tolist()
                        row_times = recording.times
                        if self._vectors and row_times is None:
                            row_times = camera.times[recording.frames(np.arange(recording.rows), 0)]
                columns[f"{topic}_is_pad"] = torch.from_numpy(padded)
                for place, out in zip(places, outs, strict=True):
                    shown = out.movedim(-1, -3) if self._channels_first else out
                    samples[place][topic] = shown[0] if offsets.is_single else shown
            for key, reader in self._vectors.items():
                offsets = self._offsets[key]
                times, padded = offsets.times(recording, row_times, rows)
                values, is_far = reader.at(recording, times)
                columns[key] = torch.from_numpy(values[:, 0] if offsets.is_single else values)
                columns[f"{key}_is_pad"] = torch.from_numpy(padded | is_far)
            for n, place in enumerate(places):
                samples[place] |= {name: column[n] for name, column in columns.items()}
                index = int(wanted[place])
                samples[place] |= {"stamp_ns": stamps[n], "index": index, "dataset": owner}
        return samples if self._transform is None else [self._transform(s) for s in samples]

    def load_messages(self) -> None:
        """Read the messages of states and actions of all recordings now.

        Workers of a DataLoader that start later need not read them. Otherwise each process reads
        those of a recording with its first sample.

        Raises:
            SampleError: Messages cannot be read.
            OptionError: Messages differ in their numbers.
        """
        for reader in self._vectors.values():
            for recording in self.recordings:
                reader.at(recording, np.empty(0, np.int64))

    def collate(self, samples: Sequence[Any]) -> Any:
        """Like `torch.utils.data.default_collate`, without copying frames.

        For ``DataLoader(dataset, collate_fn=dataset.collate)``. Samples of one batch are rows of
        one tensor per camera, which is returned as it is; with channels first, it has the memory
        format ``channels_last``. Workers then read into memory shared with the loader's process.
        Anything else, such as the results of a `transform`, is collated as usual.

        Args:
            samples: Of one batch.
        """
        self._collates = True  # read the next batch into its final place
        if not samples or not all(isinstance(sample, dict) for sample in samples):
            return default_collate(samples)
        return {key: _whole([sample[key] for sample in samples]) for key in samples[0]}

    def first_number(self, recording: int) -> int:
        """Number of the first sample of a dataset, by its number."""
        return int(self._starts[recording])

    def key_frames(self, recording: int) -> NDArray[np.int64]:
        """Numbers of the key frames of a dataset's first camera, in order.

        Raises:
            SampleError: Its video cannot be read.
        """
        with self._cameras.using(self.recordings[recording], 0) as camera:
            return camera.key_frames

    def _number(self, index: SupportsIndex) -> int:
        try:
            number = as_integer(index)
        except TypeError:
            raise TypeError(
                f"samples are selected by integers, not {shortened(index)}: for several, use "
                "torch.utils.data.Subset(dataset, [0, 5])"
            ) from None
        if not -len(self) <= number < len(self):
            raise IndexError(f"there are {len(self)} samples, and none with number {number}")
        return number % len(self)

    def close(self) -> None:
        """Close this process's videos; they are reopened when needed."""
        self._cameras.close()
