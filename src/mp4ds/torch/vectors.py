"""States and actions of samples: numbers of recorded messages at the times of frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mp4ds.dataset.dataset import Dataset
from mp4ds.dataset.messages import MessagesFile
from mp4ds.dataset.vectors import Fields, Vectors, fields_of, read_vectors
from mp4ds.errors import Mp4dsError, OptionError, SampleError
from mp4ds.files.urls import location
from mp4ds.format.fields import MESSAGES_NAME
from mp4ds.times import intervals, usual_interval
from mp4ds.torch.recordings import Recording

Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]
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

    def at(self, recording: Recording, times: Integers) -> tuple[NDArray[np.float32], Flags]:
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
