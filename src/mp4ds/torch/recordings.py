"""The samples of datasets: which frames of which cameras and when, and their states and actions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray

from mp4ds.dataset.dataset import Dataset, datasets_in, open_dataset
from mp4ds.dataset.messages import MessagesFile
from mp4ds.dataset.stream import Layer, open_stream
from mp4ds.dataset.topic import Topic
from mp4ds.dataset.vectors import Fields, Vectors, fields_of, read_vectors
from mp4ds.errors import Mp4dsError, OptionError, SampleError
from mp4ds.files.urls import location, spelled
from mp4ds.format.fields import MESSAGES_NAME
from mp4ds.format.sidecars import MANIFEST_NAME, load_manifest
from mp4ds.times import constant_rate, intervals, nearest, sound_times, synchronize, usual_interval

_T = TypeVar("_T")

Paths = Path | str | Sequence[Path | str]
"""Datasets: folders, videos next to their sidecars, or URLs of these."""

RESERVED = ("stamp_ns", "index", "dataset")
"""Sample keys that cannot be topic names."""


@dataclass(frozen=True, slots=True)
class CameraSource:
    """A camera of a recording.

    Attributes:
        topic: Of its images.
        name: Of its file, without extension.
        place: Path or URL of the sidecar, or of a video without one.
        frames: Number of its frames.
        layer: Which of them are read.
    """

    topic: str
    name: str
    place: str
    frames: int
    layer: Layer


@dataclass(frozen=True, slots=True)
class Recording:
    """The samples of one dataset, in order: its rows.

    Attributes:
        path: As given by the user.
        sources: Its cameras, in the order of the topics.
        matches: Frame numbers, int64 of shape (rows, cameras); None: row n is frame n of the only
            camera.
        unmatched: Frame numbers that are not in any row, by topic.
        times: Of the rows, nanoseconds, int64, shape (rows,), beyond which nothing belongs to it;
            None: the stamps of the first camera's frames.
        task: What is done in it, if it says so.
    """

    path: str
    sources: tuple[CameraSource, ...]
    matches: NDArray[np.int64] | None
    unmatched: dict[str, NDArray[np.int64]]
    times: NDArray[np.int64] | None = None
    task: str = ""

    @property
    def rows(self) -> int:
        """Number of its samples."""
        return self.sources[0].frames if self.matches is None else len(self.matches)

    def frames(self, rows: NDArray[np.int64], camera: int) -> NDArray[np.int64]:
        """A camera's frame numbers for rows; the same shape."""
        return rows if self.matches is None else self.matches[rows, camera]

    def within(self, times: NDArray[np.int64]) -> NDArray[np.int64]:
        """Times, or its first or last one where they are beyond them."""
        return times if self.times is None else times.clip(self.times[0], self.times[-1])

    @classmethod
    def of(
        cls,
        path: str,
        sources: tuple[CameraSource, ...],
        topics: Sequence[str],
        matches: NDArray[np.int64],
        times: NDArray[np.int64],
        task: str = "",
    ) -> Recording:
        """With the frames that are not in any row."""
        unmatched = {
            topic: np.setdiff1d(np.arange(source.frames), column)
            for topic, source, column in zip(topics, sources, matches.T, strict=True)
        }
        return cls(path, sources, matches, unmatched, times, task)


def recordings_of(
    paths: Paths,
    topics: Sequence[str] | None,
    tolerance_ns: int,
    layer: Layer,
    *,
    rename: Mapping[str, str],
    fps: int | None,
    timed: bool,
) -> tuple[tuple[str, ...], list[Recording]]:
    """The samples of several datasets, one after another.

    For a dataset with one camera only the manifest is read; to match several cameras, also their
    stamps.

    Args:
        paths: The datasets, or folders of them.
        topics: Topics or names of streams; None: those of the first dataset. All must have them.
        tolerance_ns: Maximum distance of the header stamps of a match, nanoseconds.
        layer: Which frames are read of cameras that have a view.
        rename: What a recording calls a topic -> what it is called here.
        fps: Rows per second, each of the frames nearest to its time; None: matched frames.
        timed: Whether rows have times.

    Returns:
        The topics, and the datasets.

    Raises:
        OptionError: A topic does not exist, there are no samples, or exact frames are not here.
        FormatError: A manifest or sidecar breaks a rule of the format.
        SourceError: A path is not a dataset.
    """
    if not isinstance(paths, (str, Path)) and not list(paths):
        raise OptionError("There are no datasets: the list of paths is empty.")
    if isinstance(topics, str):
        raise OptionError(f"topics is a list of topics, such as [{topics!r}].")
    at_least(0, sync_tolerance_ns=tolerance_ns)
    if topics is not None and not topics:
        raise OptionError("topics is empty; use None for all cameras of the first dataset.")
    given = datasets_in(paths)
    one_of("layer", layer, get_args(Layer))
    known = _sources(given[0], layer, rename)
    chosen = tuple(topics) if topics is not None else tuple(source.topic for source in known)
    _check_topics(chosen, given[0])
    recordings = []
    for number, path in enumerate(given):
        there = known if number == 0 else _sources(path, layer, rename)
        sources = tuple(_choose(there, topic, path) for topic in chosen)
        if fps is None:
            recordings.append(_matched(path, sources, chosen, tolerance_ns, timed=timed))
        else:
            recordings.append(_at_rate(path, sources, chosen, fps))
    if not any(recording.rows for recording in recordings):
        raise OptionError(
            f"{given[0]}: no frames of {', '.join(chosen)} have header stamps within "
            f"{tolerance_ns} ns of each other. Use a larger sync_tolerance_ns, or one "
            f"camera: topics=[{chosen[0]!r}]."
        )
    return chosen, recordings


def _matched(
    path: Path,
    sources: tuple[CameraSource, ...],
    topics: Sequence[str],
    tolerance_ns: int,
    *,
    timed: bool,
) -> Recording:
    if len(sources) == 1 and not timed:
        if sources[0].layer == "exact":
            _ = open_source(sources[0]).stamps  # its frames may not be here
        return Recording(str(path), sources, None, {sources[0].topic: np.empty(0, np.int64)})
    stamps = {}
    for topic, source in zip(topics, sources, strict=True):
        with closing(open_source(source)) as stream:
            stamps[topic] = stream.stamps
    sync = synchronize(stamps, tolerance_ns=tolerance_ns)
    times = sync.stamps[:, 0] if timed else None
    return Recording(str(path), sources, sync.indices, sync.unmatched, times)


def _at_rate(
    path: Path, sources: tuple[CameraSource, ...], topics: Sequence[str], fps: int
) -> Recording:
    """Rows at a constant rate, of the frames that are nearest in time."""
    columns, numbers = [], []
    for source in sources:
        with closing(open_source(source)) as stream:
            times = sound_times(stream.stamps, stream.log_times)
        order = np.argsort(times, kind="stable")
        order = order[order >= np.maximum.accumulate(order)]  # without those that go back in time
        numbers.append(order)
        columns.append(times[order])
    rows = constant_rate(columns, fps, path)
    found = [own[nearest(times, rows)] for own, times in zip(numbers, columns, strict=True)]
    return Recording.of(str(path), sources, topics, np.column_stack(found).astype(np.int64), rows)


def usual_rate(
    paths: Paths, topics: Sequence[str] | None, layer: Layer, rename: Mapping[str, str]
) -> int:
    """Frames per second of the first camera of the first dataset; at least 1."""
    first = datasets_in(paths)[0]
    known = _sources(first, layer, rename)
    _check_topics([source.topic for source in known][:1], first)
    source = _choose(known, topics[0], first) if topics else known[0]
    with closing(open_source(source)) as stream:
        times = np.sort(sound_times(stream.stamps, stream.log_times))
    usual = usual_interval(intervals(times))
    return max(1, round(1e9 / usual)) if usual else 1


def open_source(source: CameraSource) -> Topic:
    """The frames of a camera; others of its dataset are not touched.

    Args:
        source: Which.

    Raises:
        FormatError: It breaks a rule of the format.
    """
    path = location(source.place)
    if path.suffix == ".yaml":
        return Topic([open_stream(path, source.layer)])
    return Topic(open_dataset(path).parts)


def _sources(path: Path | str, layer: Layer, rename: Mapping[str, str]) -> list[CameraSource]:
    """The cameras of a dataset, from its manifest, without reading the sidecars."""
    folder = location(path)
    if folder.name == MANIFEST_NAME:
        folder = folder.parent
    if (folder / MANIFEST_NAME).exists():
        entries = load_manifest(folder / MANIFEST_NAME).streams
        found = [(entry.topic, folder / entry.sidecar, entry.frames) for entry in entries]
    else:
        with open_dataset(path) as dataset:
            found = [(one.topic, one.path, len(one)) for one in dataset.parts]
    return [
        CameraSource(rename.get(topic, topic), place.stem, spelled(place), frames, layer)
        for topic, place, frames in found
    ]


def _check_topics(topics: Sequence[str], path: Path | str) -> None:
    if not topics:
        raise OptionError(f"{path}: has no camera; without topics, the first dataset needs one.")
    twice = [topic for topic in topics if topics.count(topic) > 1]
    if twice:
        raise OptionError(
            f"{path}: {twice[0]} is given twice among the topics. If it has several streams, "
            "choose one by its file name."
        )
    taken = [topic for topic in topics if topic in RESERVED]
    if taken:
        raise OptionError(f"{path}: a topic named {taken[0]!r} cannot be a key of a sample.")


def _choose(sources: list[CameraSource], topic: str, path: Path | str) -> CameraSource:
    found = [s for s in sources if topic in (s.topic, s.name)]
    if not found:
        known = ", ".join(dict.fromkeys(s.topic for s in sources)) or "none"
        raise OptionError(f"{path}: has no topic {topic!r}; there are: {known}.")
    if len(found) > 1:
        names = ", ".join(s.name for s in found)
        raise OptionError(
            f"{path}: {topic} changes its size or encoding and has {len(found)} streams; choose "
            f"one of {names}."
        )
    return found[0]


# ---------------------------------------------------------------- states and actions

Pick = Literal["nearest", "previous"]


class VectorReader:
    """The numbers of samples under one key: ``state`` or ``action``.

    Messages of a recording are read when the first sample of it is; then they are kept, also by
    copies for other processes: 4 bytes for each number and 8 for each message.

    Args:
        key: The key.
        given: Topics and fields.
        recordings: All that are read; each must have the topics.
        pick: Which message a sample gets.
        tolerance_ns: How far a message may be from its time; None: twice the usual interval.
        rename: What recordings call a topic -> what it is called here.

    Attributes:
        names: Of the numbers.

    Raises:
        OptionError: A topic or field does not exist, or has no messages.
    """

    def __init__(
        self,
        key: str,
        given: Fields,
        recordings: Sequence[Recording],
        *,
        pick: Pick,
        tolerance_ns: int | None,
        rename: Mapping[str, str],
    ) -> None:
        self._pick, self._tolerance_ns = pick, tolerance_ns
        self._fields = fields_of(given, key)
        self._read: dict[str, list[Vectors]] = {}
        # now, rather than in a worker
        self._called = {
            recording.path: [called(recording.path, topic, rename) for topic in self._fields]
            for recording in recordings
        }
        self._like: list[Vectors | None] = [None] * len(self._fields)
        self._like = [*self._vectors(recordings[0].path, most=1)]
        names = [name for one in self._like if one for name in one.names]
        if len(set(names)) < len(names):
            names = [f"{one.topic}.{name}" for one in self._like if one for name in one.names]
        self.names = tuple(names)

    def at(
        self, recording: Recording, times: NDArray[np.int64]
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Numbers at times, and which of them are too far away.

        Args:
            recording: The recording.
            times: Nanoseconds, of any shape.

        Returns:
            float32, of that shape and one dimension more; and bool, of that shape.

        Raises:
            SampleError: Messages cannot be read.
            OptionError: Messages differ in their numbers.
        """
        path = recording.path
        if path not in self._read:
            self._read[path] = self._vectors(path)
        values, is_far = [], np.zeros(times.shape, np.bool_)
        for one in self._read[path]:
            places = one.nearest(times) if self._pick == "nearest" else one.previous(times)
            usual = usual_interval(intervals(one.times)) or 0.0
            tolerance = 2 * usual if self._tolerance_ns is None else self._tolerance_ns
            away = times - one.times[places]
            is_far |= np.abs(away) > tolerance
            if self._pick == "previous":
                is_far |= away < 0
            values.append(one.values[places])
        return np.concatenate(values, axis=-1), is_far

    def _vectors(self, path: str, most: int | None = None) -> list[Vectors]:
        try:
            with Dataset(path) as dataset:
                return [
                    read_vectors(dataset, topic, paths, like=like, alias=alias, most=most)
                    for (topic, paths), like, alias in zip(
                        self._fields.items(), self._like, self._called[path], strict=True
                    )
                ]
        except OptionError:
            raise
        except Mp4dsError as error:
            raise SampleError(f"{path}: {error}") from None


def called(path: str, topic: str, rename: Mapping[str, str]) -> str:
    """What a dataset calls a topic of recorded messages.

    Raises:
        OptionError: It has no such topic, or several.
        FormatError: Its messages cannot be read.
    """
    folder = location(path)
    file = MessagesFile(folder / MESSAGES_NAME if folder.is_dir() else None)
    known = list(dict.fromkeys(channel.topic for channel in file.channels))
    found = [one for one in known if rename.get(one, one) == topic]
    if not found:
        listed = ", ".join(known) or "none"
        raise OptionError(f"{path}: has no messages of {topic!r}; there are: {listed}.")
    if len(found) > 1:
        raise OptionError(f"{path}: `rename` makes {' and '.join(found)} the same topic.")
    return found[0]


# ---------------------------------------------------------------- episodes


def episodes_of(recording: Recording, topic: str, rename: Mapping[str, str]) -> list[Recording]:
    """The parts of a recording in which a topic has the same value.

    There is none before its first message, nor where it is false, negative or without text.

    Args:
        recording: The recording, whose samples have times.
        topic: Of type std_msgs/String, Bool or a number.
        rename: What recordings call a topic -> what it is called here.

    Raises:
        OptionError: There is no such topic, or it is of another type.
        SourceError: A message does not match its topic's type.
        FormatError: The dataset breaks a rule of the format.
    """
    if recording.times is None or recording.matches is None:
        raise ValueError("the samples have no times")
    name = called(recording.path, topic, rename)
    times, values = [], []
    with Dataset(recording.path) as dataset:
        for message in dataset.messages([name]):
            times.append(message.log_time_ns)
            values.append(getattr(message.decoded, "data", None))
            if not isinstance(values[-1], (str, bool, int, float)):
                raise OptionError(
                    f"{recording.path}: {name} is of type {message.type_name}, but episodes are "
                    "told by std_msgs/String, Bool or a number."
                )
    runs = np.cumsum([0, 1, *(one != other for one, other in pairwise(values))])
    before = np.searchsorted(np.array(times, np.int64), recording.times, side="right")
    edges = np.flatnonzero(np.diff(runs[before])) + 1  # the first run is that before all messages
    found = []
    for start, end in pairwise([0, *edges.tolist(), recording.rows]):
        value = values[before[start] - 1] if before[start] else False
        if bool(value) if isinstance(value, (str, bool)) else value >= 0:
            found.append(
                Recording.of(
                    recording.path,
                    recording.sources,
                    [*recording.unmatched],
                    recording.matches[start:end],
                    recording.times[start:end],
                    value if isinstance(value, str) else "",
                )
            )
    return found


# ---------------------------------------------------------------- options


def one_of(name: str, value: str, known: Sequence[str]) -> None:
    """Refuse an unknown value of an argument."""
    if value not in known:
        raise OptionError(f"{name} is {value!r}, not one of {', '.join(known)}.")


def at_least(least: int, **numbers: float | None) -> None:
    """Refuse numbers of arguments that are smaller."""
    for name, value in numbers.items():
        if value is not None and value < least:
            raise OptionError(f"{name} is {value}, but must be at least {least}.")


def each(name: str, given: _T | Mapping[str, _T], topics: Sequence[str], default: _T) -> list[_T]:
    """A value for each topic, from one for all or a mapping."""
    if not isinstance(given, Mapping):
        return [given] * len(topics)
    unknown = [topic for topic in given if topic not in topics]
    if unknown:
        raise OptionError(
            f"{name} is given for {unknown[0]!r}, which is not among the topics: "
            f"{', '.join(topics)}."
        )
    return [given.get(topic, default) for topic in topics]
