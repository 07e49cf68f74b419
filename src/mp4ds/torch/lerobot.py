"""Datasets in the words of LeRobotDataset v3, for the training code of LeRobot."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import cached_property
from types import SimpleNamespace
from typing import Any, SupportsIndex

import numpy as np
import torch
from numpy.typing import NDArray

from mp4ds.dataset.stream import Layer
from mp4ds.dataset.vectors import (
    ACTION,
    COLUMNS,
    SAMPLES,
    STATE,
    Feature,
    Fields,
    Statistics,
    image_features,
    merged,
    statistics_of,
    vector_feature,
    video_feature,
)
from mp4ds.errors import OptionError
from mp4ds.files.urls import location
from mp4ds.torch.datasets import FrameDataset, Offsets, Sample
from mp4ds.torch.recordings import Paths, open_source, usual_rate

_TOLERANCE_S = 1e-4  # of a multiple of the period, as in LeRobot
_EVER = 2**62  # nanoseconds
_OTHERS = ("offsets", "offsets_in", "action_offsets", "format", "channels_first", "transform")
_IN_MM = {"16UC1": 1.0, "32FC1": 1000.0}
_FEWEST, _IN_ALL = 5, 2000  # frames for a camera's statistics, of an episode and of all


@dataclass
class Metadata:
    """What LeRobot reads in ``dataset.meta``.

    Attributes:
        repo_id: Name of the first dataset.
        fps: Samples per second.
        features: As in LeRobot's info.json.
        episodes: Columns: ``episode_index``, ``tasks``, ``length``, and the span of samples,
            ``dataset_from_index`` to ``dataset_to_index``; a value for each episode.
        tasks: Its ``index`` has the texts, by ``task_index``.
        measure: Called for `stats`.
    """

    repo_id: str
    fps: int
    features: dict[str, Feature]
    episodes: dict[str, list[Any]]
    tasks: SimpleNamespace
    measure: Callable[[], dict[str, dict[str, NDArray[Any]]]] = field(repr=False)

    robot_type = None
    has_language_columns = False
    image_keys: tuple[str, ...] = ()

    @cached_property
    def stats(self) -> dict[str, dict[str, NDArray[Any]]]:
        """``min``, ``max``, ``mean``, ``std`` and ``count`` of states, actions and colours.

        All messages are read for it, and of each camera 5 to 100 frames of an episode, 2000 in all.
        """
        return self.measure()

    @property
    def camera_keys(self) -> list[str]:
        """Features that are videos."""
        return [key for key, one in self.features.items() if one["dtype"] == "video"]

    video_keys = camera_keys

    @property
    def depth_keys(self) -> list[str]:
        """Those of depths."""
        return [key for key in self.camera_keys if self.features[key]["info"].get("is_depth_map")]

    @property
    def names(self) -> dict[str, Any]:
        """Names of a feature's dimensions."""
        return {key: one["names"] for key, one in self.features.items()}

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of features, of videos (H, W, C)."""
        return {key: one["shape"] for key, one in self.features.items()}

    @property
    def total_episodes(self) -> int:
        """Number of episodes."""
        return len(self.episodes["length"])

    @property
    def total_frames(self) -> int:
        """Number of samples of all episodes."""
        return int(sum(self.episodes["length"]))

    @property
    def total_tasks(self) -> int:
        """Number of different tasks."""
        return len(self.tasks.index)


class LeRobotDataset(FrameDataset):
    """Datasets as LeRobot's training code takes them, without converting anything.

    A sample has what ``lerobot.datasets.LeRobotDataset`` gives for an export of the same datasets:

        {"observation.images.left_image_raw": float32 (C, H, W), "observation.state": float32 (D,),
         "action": float32 (D,), "timestamp": seconds, "frame_index": ..., "episode_index": ...,
         "index": ..., "task_index": ..., "task": str}

    and for the keys of `delta_timestamps` (T, ...) with ``KEY_is_pad``: bool (T,). Samples are at
    a constant rate, of the frames and messages nearest in time. Depths (16UC1, 32FC1) are float32
    (1, H, W) in millimetres, 0 where there is no measurement. `meta`, `num_frames`,
    `num_episodes`, `episodes` and `absolute_to_relative_idx` are LeRobot's, too.

    Args:
        paths: As for `FrameDataset`; each dataset is an episode unless `episode_topic` is given.
        topics: Cameras; None: all of the first dataset.
        state: Topics and fields of ``observation.state``, as for `FrameDataset`.
        action: The same for ``action``.
        task: Of all episodes; None: what messages of `episode_topic` say if they are texts.
        fps: Samples per second; None: the usual rate of the first camera.
        episode_topic: As for `FrameDataset`.
        episodes: Numbers of the episodes to read; None: all. `meta` is always that of all.
        delta_timestamps: Key -> seconds from a sample's own time, multiples of 1 / fps.
        image_transforms: Called with the frames of each camera that has no depths.
        return_uint8: Whether frames are bytes instead of float32 from 0 to 1.
        rename: As for `FrameDataset`.
        layer: As for `FrameDataset`.
        **options: Others of `FrameDataset`: resize, crop, message, cache_files, backend, device.

    Attributes:
        episodes: The argument.
        meta: Features, episodes, statistics.

    Raises:
        OptionError: An option is wrong, or a topic is not there.
        SourceError: A path is not a dataset.
        FormatError: A manifest or sidecar breaks a rule of the format.
    """

    def __init__(
        self,
        paths: Paths,
        *,
        topics: Sequence[str] | None = None,
        state: Fields | None = None,
        action: Fields | None = None,
        task: str | None = None,
        fps: int | None = None,
        episode_topic: str | None = None,
        episodes: Sequence[int] | None = None,
        delta_timestamps: Mapping[str, Sequence[float]] | None = None,
        image_transforms: Callable[[torch.Tensor], torch.Tensor] | None = None,
        return_uint8: bool = False,
        rename: Mapping[str, str] | None = None,
        layer: Layer = "view",
        **options: Any,
    ) -> None:
        for name in _OTHERS:
            if name in options:
                raise TypeError(f"LeRobotDataset has no {name!r}: it gives what LeRobot does")
        rate = usual_rate(paths, topics, layer, rename or {}) if fps is None else fps
        options.setdefault("message_tolerance_ns", _EVER)  # LeRobot marks what is beyond an episode
        super().__init__(
            paths,
            topics=topics,
            state=state,
            action=action,
            fps=rate,
            episode_topic=episode_topic,
            rename=rename,
            layer=layer,
            dtype="native" if return_uint8 else "float32",
            **options,
        )
        self._images = dict(zip(image_features(self.topics), self.topics, strict=True))
        vectors = {STATE: "state", ACTION: "action"}
        self._keys = {key: own for key, own in vectors.items() if own in self._vectors}
        self._deltas = dict(delta_timestamps or {})
        for key, seconds in self._deltas.items():
            own = {**self._images, **self._keys}.get(key)
            if own is None:
                known = ", ".join([*self._images, *self._keys])
                raise OptionError(f"delta_timestamps has {key!r}, which is not one of {known}.")
            self._offsets[own] = Offsets(_steps(key, seconds, rate), "frames", None)
        self._transforms = image_transforms
        self._scales: dict[str, float] = {}  # of depths, to millimetres
        tasks = [task if task is not None else one.task for one in self.recordings]
        self._tasks = list(dict.fromkeys(tasks))
        edges = self._starts.tolist()
        self.meta = Metadata(
            location(self.paths[0]).name,
            rate,
            self._features(rate),
            {
                "episode_index": [*range(len(tasks))],
                "tasks": [[text] for text in tasks],
                "length": self.lengths,
                "dataset_from_index": edges[:-1],
                "dataset_to_index": edges[1:],
            },
            SimpleNamespace(index=self._tasks),
            self._measured,
        )
        self.episodes = None if episodes is None else [*episodes]
        self._selected: NDArray[np.int64] | None = None
        if self.episodes is not None:
            for number in self.episodes:
                if not 0 <= number < len(tasks):
                    raise OptionError(f"episodes has {number}, but there are {len(tasks)}, from 0.")
            if not self.episodes:
                raise OptionError("episodes is empty; use None for all.")
            spans = [np.arange(*edges[one : one + 2]) for one in sorted(set(self.episodes))]
            self._selected = np.concatenate(spans).astype(np.int64)

    def _features(self, fps: int) -> dict[str, Feature]:
        found: dict[str, Feature] = {}
        for number, key in enumerate(self._images):
            with closing(open_source(self.recordings[0].sources[number])) as topic:
                encoding = topic.encoding
            if encoding in _IN_MM:
                self._scales[key] = _IN_MM[encoding]
                self._cameras.views[number]["format"] = "native"
            with self._cameras.using(self.recordings[0], number) as camera:
                height, width = camera.none.shape[1:3]
            depths = {"is_depth_map": True, "depth_unit": "mm"} if key in self._scales else None
            found[key] = video_feature((width, height), fps, {}, depths)
        found |= {key: vector_feature(self.names[own]) for key, own in self._keys.items()}
        found |= COLUMNS
        return {key: {**one, "shape": tuple(one["shape"])} for key, one in found.items()}

    def _measured(self) -> dict[str, dict[str, NDArray[Any]]]:
        parts: dict[str, list[Statistics]] = {key: [] for key in [*self._images, *self._keys]}
        most = max(_FEWEST, min(SAMPLES, _IN_ALL // len(self.recordings)))
        for recording in self.recordings:
            for number, key in enumerate(self._images):
                used = np.unique(recording.frames(np.arange(recording.rows), number))
                with self._cameras.using(recording, number) as camera:
                    parts[key].append(camera.statistics(used, most))
            for key, own in self._keys.items():
                if recording.times is not None:
                    values, _ = self._vectors[own].at(recording, recording.times)
                    parts[key].append(statistics_of(values))
        stats = {key: dict(merged(found)) for key, found in parts.items()}
        for key, scale in self._scales.items():
            stats[key] |= {n: v * scale for n, v in stats[key].items() if n != "count"}
        return stats

    # ------------------------------------------------ samples

    def _read(self, numbers: Sequence[int], *, shared: bool) -> list[Any]:
        return [self._told(sample) for sample in super()._read(numbers, shared=shared)]

    def _told(self, sample: Sample) -> Sample:
        """The sample in the words of LeRobot."""
        found: Sample = {}
        for key, topic in self._images.items():
            image = sample[topic]
            if image.ndim == 4 and len(image) == 1:
                image = image[0]
            if key in self._scales:
                image = image.to(torch.float32).nan_to_num(0, posinf=0, neginf=0)
                image *= self._scales[key]
            elif self._transforms is not None:
                image = self._transforms(image)
            found[key] = image
        for key, own in self._keys.items():
            vector = sample[own]
            if key in self._deltas and self._offsets[own].is_single:
                vector = vector[None]
            found[key] = vector[..., 0] if vector.shape[-1] == 1 else vector
        for key in self._deltas:
            found[f"{key}_is_pad"] = sample[f"{({**self._images, **self._keys})[key]}_is_pad"]
        episode = sample["dataset"]
        row = sample["index"] - int(self._starts[episode])
        task = self.meta.episodes["tasks"][episode][0]
        found["timestamp"] = torch.tensor(row / self.meta.fps, dtype=torch.float32)
        numbers = (row, episode, sample["index"], self._tasks.index(task))
        names = ("frame_index", "episode_index", "index", "task_index")
        found |= {name: torch.tensor(one) for name, one in zip(names, numbers, strict=True)}
        return {**found, "task": task}

    def __len__(self) -> int:
        return super().__len__() if self._selected is None else len(self._selected)

    def _number(self, index: SupportsIndex) -> int:
        number = super()._number(index)
        return number if self._selected is None else int(self._selected[number])

    @property
    def num_frames(self) -> int:
        """Number of samples."""
        return len(self)

    @property
    def num_episodes(self) -> int:
        """Number of episodes that are read."""
        return self.meta.total_episodes if self.episodes is None else len(self.episodes)

    @property
    def absolute_to_relative_idx(self) -> dict[int, int] | None:
        """``index`` of a sample -> its number here, if only some episodes are read."""
        if self._selected is None:
            return None
        return {absolute: number for number, absolute in enumerate(self._selected.tolist())}


def _steps(key: str, seconds: Sequence[float], fps: int) -> list[int]:
    """Rows for times.

    Raises:
        OptionError: They are not multiples of the period.
    """
    found = [round(time * fps) for time in seconds]
    for time, step in zip(seconds, found, strict=True):
        if abs(time - step / fps) > _TOLERANCE_S:
            raise OptionError(
                f"delta_timestamps of {key} has {time} s, which is no multiple of 1 / {fps} s."
            )
    return found
