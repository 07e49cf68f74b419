"""Numbers of recorded messages as columns: states and actions; features as LeRobot has them."""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.dataset.dataset import Dataset
from mp4ds.dataset.topic import Topic
from mp4ds.errors import OptionError
from mp4ds.format.sidecars import FileNames
from mp4ds.messages.encodings import Pixels
from mp4ds.times import nearest, sound_times

Integers = NDArray[np.int64]
Floats = NDArray[np.float64]

Fields = str | Mapping[str, str | Sequence[str] | None]
"""``/topic``, ``/topic:field,field``, or topic -> its fields; None: what its type is known for."""

_KNOWN_FOR = {
    "sensor_msgs/JointState": "position",
    "std_msgs/Float64MultiArray": "data",
    "std_msgs/Float32MultiArray": "data",
}
_PART = re.compile(r"\.?([^.\[\]]+)(?:\[([^\[\]]+)\])?")
_STAMPS = (("sec", "nanosec"), ("seconds", "nanos"), ("sec", "nsec"))  # ROS, protobuf, JSON
_NS = 10**9
_DEEPEST = 12  # fields of fields: definitions of protobuf may contain themselves
_MOST_LISTED = 24
_NONE: tuple[str, ...] = ()


def fields_of(given: Fields, option: str) -> dict[str, tuple[str, ...]]:
    """Topic -> its fields; none: what its type is known for.

    Args:
        given: As users write it.
        option: That it is the value of, for errors.

    Raises:
        OptionError: It is neither text nor a mapping of text, or names no topic.
    """
    if isinstance(given, str):
        topic, _, listed = given.partition(":")
        given = {topic: listed.split(",") if listed else None}
    found: dict[str, tuple[str, ...]] = {}
    for topic, paths in given.items() if isinstance(given, Mapping) else ():
        several = [paths] if isinstance(paths, str) else paths or []
        if not topic or not isinstance(several, Sequence):
            break
        for path in several:
            if not isinstance(path, str) or not re.fullmatch(f"(?:{_PART.pattern})+", path):
                raise OptionError(
                    f"{option} {topic} has the field {path!r}, which is not like pose.position.x, "
                    "position[0:6] or position[elbow]."
                )
        found[topic] = tuple(several)
    if not found or len(found) < len(given):
        raise OptionError(
            f"{option} is {given!r}, not a topic, or a mapping such as "
            '{"/joint_states": "position"}.'
        )
    return found


@dataclass(frozen=True, eq=False)
class Vectors:
    """Numbers of a topic's messages, in the order of their times.

    Attributes:
        topic: The topic.
        names: Of the numbers; those of joints where messages have them.
        times: Header stamps (``timestamp`` of Foxglove's messages), or log times where messages
            have none or most of them do not increase; nanoseconds, int64, shape (messages,).
        values: float32, shape (messages, numbers).
    """

    topic: str
    names: tuple[str, ...]
    times: Integers
    values: NDArray[np.float32]

    def nearest(self, times: Integers) -> Integers:
        """Indices of the messages nearest to times of any shape."""
        return nearest(self.times, times)

    def previous(self, times: Integers) -> Integers:
        """Indices of the last messages at or before times, or of the first; of any shape."""
        found: Integers = np.searchsorted(self.times, times, side="right") - 1
        return np.maximum(found, 0)


def read_vectors(
    dataset: Dataset,
    topic: str,
    paths: Sequence[str],
    *,
    like: Vectors | None = None,
    most: int | None = None,
    alias: str | None = None,
) -> Vectors:
    """Read numbers of a topic.

    Args:
        dataset: The dataset.
        topic: The topic.
        paths: Fields, as in `fields_of`.
        like: Of another recording, whose names are required, in that order.
        most: How many messages to read; None: all.
        alias: What the dataset calls the topic; None: the same.

    Raises:
        OptionError: There is no such topic or field, it has no message, or messages differ in how
            many numbers they have, or in their names.
        SourceError: A message does not match its topic's type.
        FormatError: The dataset breaks a rule of the format.
    """
    stamps, log_times, values = array("q"), array("q"), array("f")
    names: Sequence[str] | None = like.names if like else None
    read: _Reader | None = None
    for message in islice(dataset.messages([alias or topic]), most):
        decoded, log_time = message.decoded, message.log_time_ns
        if read is None:
            read = _Reader(f"{dataset.path}: {alias or topic}", topic, message.type_name, paths)
        own, numbers = read(decoded)
        names = names if names is not None else own
        if own != names:
            numbers = numbers[read.order(own, names)]
        with np.errstate(over="ignore"):
            values.frombytes(numbers.astype(np.float32).tobytes())
        log_times.append(log_time)
        stamps.append(_stamp(decoded, log_time))
    if names is None:
        raise OptionError(f"{dataset.path}: {alias or topic} has no message.")
    times = sound_times(np.frombuffer(stamps, np.int64), np.frombuffer(log_times, np.int64))
    order = np.argsort(times, kind="stable")
    rows = np.frombuffer(values, np.float32).reshape(len(times), len(names))
    return Vectors(topic, tuple(names), times[order], rows[order])


def _stamp(message: Any, log_time: int) -> int:
    stamp = _child(_child(message, "header"), "stamp") or _child(message, "timestamp")
    for names in _STAMPS:
        seconds, rest = (_child(stamp, name) for name in names)
        if seconds is not None and rest is not None:
            return int(seconds) * _NS + int(rest)
    return log_time


class _Reader:
    """Reads numbers from messages of a topic.

    Args:
        where: The dataset and topic, for errors.
        topic: The topic, as its users call it.
        type_name: Its type.
        paths: The fields.
    """

    def __init__(self, where: str, topic: str, type_name: str, paths: Sequence[str]) -> None:
        self._where, self._type = where, type_name
        self._last = topic.strip("/").rpartition("/")[2]
        known = _KNOWN_FOR.get(type_name.replace("/msg/", "/"))
        self._paths = tuple(paths) or ((known,) if known else ())
        self._parts = [_PART.findall(path) for path in self._paths]
        self._named: dict[tuple[object, ...], tuple[str, ...]] = {}

    def __call__(self, message: Any) -> tuple[tuple[str, ...], Floats]:
        """Names and numbers of a message.

        Raises:
            OptionError: It has no such field, or no numbers there.
        """
        if not self._paths:
            raise self._refused(message, f"is of type {self._type or 'unknown'}; name its fields")
        found = [
            self._field(message, path, parts)
            for path, parts in zip(self._paths, self._parts, strict=True)
        ]
        shape = tuple((names, len(numbers)) for names, numbers in found)
        if shape not in self._named:  # mostly, all messages have the same
            self._named[shape] = self._names(shape)
        return self._named[shape], np.concatenate([numbers for _, numbers in found])

    def _field(
        self, message: Any, path: str, parts: Sequence[tuple[str, str]]
    ) -> tuple[tuple[str, ...], Floats]:
        """Names, if it has any of its own, and numbers of a field."""
        value, names = message, _NONE
        for name, item in parts:
            parent, value = value, _child(value, name)
            if value is None:
                raise self._refused(message, f"has no field {path}")
            names = _names_beside(parent, value)
            if item:
                try:
                    value, names = _items(value, names, item)
                except (LookupError, TypeError, ValueError):
                    among = f" among {', '.join(names)}" if names else ""
                    raise self._refused(message, f"has no {path}{among}") from None
        leaves = [*_leaves(value, "")]
        if not leaves:
            raise self._refused(message, f"has no numbers in {path}")
        if len(leaves) > 1 or leaves[0][0]:
            sizes = (np.size(leaf) for _, leaf in leaves)
            names = tuple(
                f"{path}{below}" + (f"_{n}" if size > 1 else "")
                for (below, _), size in zip(leaves, sizes, strict=True)
                for n in range(size)
            )
        numbers = [np.asarray(leaf, np.float64).reshape(-1) for _, leaf in leaves]
        return names, np.concatenate(numbers)

    def _names(self, shape: Sequence[tuple[tuple[str, ...], int]]) -> tuple[str, ...]:
        found: list[str] = []
        for path, (names, count) in zip(self._paths, shape, strict=True):
            base = self._last if path == "data" else path
            numbered = [f"{base}_{n}" for n in range(count)]
            own = names or ([path] if count == 1 and path != "data" else numbered)
            if len(self._paths) > 1 and names and not names[0].startswith(path):
                field = path.rpartition("[")[0] if path.endswith("]") else path
                own = [f"{field}.{name}" for name in names]  # joints have several numbers
            found += own
        return tuple(found)

    def order(self, own: Sequence[str], names: Sequence[str]) -> list[int]:
        """Places of the numbers that have these names.

        Raises:
            OptionError: They are not the same names.
        """
        if len(own) != len(names):
            problem = f"has messages of {len(names)} and of {len(own)} numbers"
            raise OptionError(f"{self._where} {problem}; each must have the same.")
        if sorted(own) != sorted(names):
            other = next(name for name in own if name not in names)
            raise OptionError(
                f"{self._where} has a number named {other}, which is not one of "
                f"{', '.join(names)}: messages and recordings must have the same names."
            )
        return [own.index(name) for name in names]

    def _refused(self, message: Any, problem: str) -> OptionError:
        listed = [
            f"{path[1:]} ({np.size(leaf)})" if np.size(leaf) != 1 else path[1:]
            for path, leaf in islice(_leaves(message, ""), _MOST_LISTED)
        ]
        return OptionError(
            f"{self._where} {problem}. Fields with numbers: {', '.join(listed) or 'none'}."
        )


def _child(value: Any, name: str) -> Any:
    return value.get(name) if isinstance(value, Mapping) else getattr(value, name, None)


def _names_beside(parent: Any, value: Any) -> tuple[str, ...]:
    """The names of an array's items, which messages such as JointState have beside it."""
    names = _child(parent, "name")
    if isinstance(names, Sequence) and not isinstance(names, str) and np.ndim(value) == 1:
        return tuple(map(str, names)) if len(names) == len(value) else ()
    return ()


def _items(value: Any, names: tuple[str, ...], item: str) -> tuple[Any, tuple[str, ...]]:
    """An item of an array by number or name, or several by a slice or names."""
    if item in names:
        place = names.index(item)
        return value[place], (item,)
    first, colon, end = item.partition(":")
    if not colon:
        return value[int(item)], names[int(item) : int(item) + 1]
    chosen = slice(int(first or 0), int(end or len(value)))
    if not 0 <= chosen.start < chosen.stop <= len(value):
        raise IndexError
    return value[chosen], names[chosen]


def _leaves(value: Any, path: str, depth: int = 0) -> Iterator[tuple[str, Any]]:
    """The numbers, and arrays of numbers, in a message, each with its path."""
    if isinstance(value, (bool, int, float, np.number, np.bool_)):
        yield path, value
    elif isinstance(value, np.ndarray):
        if value.dtype.kind in "biuf" and value.size:
            yield path, value
    elif depth < _DEEPEST and not isinstance(value, (str, bytes)):
        yield from _below(value, path, depth + 1)


def _below(value: Any, path: str, depth: int) -> Iterator[tuple[str, Any]]:
    if isinstance(value, Sequence) or hasattr(value, "append"):  # that of protobuf, too
        if len(value) and all(isinstance(item, (bool, int, float)) for item in value):
            yield path, value
            return
        for number, item in enumerate(value):
            yield from _leaves(item, f"{path}[{number}]", depth)
        return
    if isinstance(value, Mapping):
        names = [*value]
    elif is_dataclass(value):
        names = [field.name for field in fields(value)]
    else:
        named = getattr(getattr(value, "DESCRIPTOR", None), "fields", ())
        names = [f.name for f in named if f.message_type is None or _is_set(value, f.name)]
    for name in names:
        yield from _leaves(_child(value, name), f"{path}.{name}", depth)


def _is_set(message: Any, name: str) -> bool:
    """Whether a message of protobuf has a field that is a message."""
    try:
        return bool(message.HasField(name))
    except ValueError:
        return True  # it is repeated


# ---------------------------------------------------------------- features of LeRobotDataset v3

Feature = dict[str, Any]

_STEP_FROM, _SIDE = 300, 150  # pixels of a side from which pixels are subsampled, to about this

STATE, ACTION = "observation.state", "action"
SAMPLES = 100  # frames of an episode used for a camera's statistics

COLUMNS: Mapping[str, Feature] = {
    "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    **{
        name: {"dtype": "int64", "shape": [1], "names": None}
        for name in ("frame_index", "episode_index", "index", "task_index")
    },
}
"""The features that every dataset has."""


def image_features(topics: Sequence[str]) -> list[str]:
    """Names of the features that are videos, by topic."""
    names = FileNames()
    return [f"observation.images.{names.name_for(topic)}" for topic in topics]


def video_feature(
    size: tuple[int, int],
    fps: int,
    info: Mapping[str, str],
    depths: Mapping[str, Any] | None = None,
) -> Feature:
    """Of a camera.

    Args:
        size: Width and height, pixels.
        fps: Frames per second.
        info: More that is known of the videos.
        depths: What is known of the depths that they show, if they are that.
    """
    (width, height), channels = size, 1 if depths else 3
    return {
        "dtype": "video",
        "shape": [height, width, channels],
        "names": ["height", "width", "channels"],
        "info": {
            "video.height": height,
            "video.width": width,
            "video.fps": fps,
            "video.channels": channels,
            "has_audio": False,
            **info,
            **(depths or {"video.is_depth_map": False}),
        },
    }


def vector_feature(names: Sequence[str]) -> Feature:
    """Of a state or an action."""
    return {"dtype": "float32", "shape": [len(names)], "names": [*names]}


# ---------------------------------------------------------------- statistics

Statistics = Mapping[str, NDArray[Any]]
"""``min``, ``max``, ``mean`` and ``std`` of a feature, and ``count``, as LeRobot names them."""


def statistics_of(values: NDArray[Any]) -> Statistics:
    """Statistics of rows, shape (rows, numbers)."""
    rows = values.astype(np.float64)
    return {
        "min": rows.min(0),
        "max": rows.max(0),
        "mean": rows.mean(0),
        "std": rows.std(0),
        "count": np.array([len(rows)]),
    }


def picture_statistics(pixels: Pixels) -> Statistics:
    """Statistics of a picture's colours from 0 to 1, or depths, subsampled if it is large.

    Args:
        pixels: uint8, shape (H, W, 3); depths: shape (H, W).
    """
    side = max(pixels.shape[:2])
    step = side // _SIDE if side >= _STEP_FROM else 1
    is_depth = pixels.ndim == 2
    rows = pixels[::step, ::step].reshape(-1, 1 if is_depth else 3)
    found = statistics_of(np.nan_to_num(rows) if is_depth else rows / 255.0)
    shaped = {name: value.reshape(-1, 1, 1) for name, value in found.items() if name != "count"}
    return {**shaped, "count": np.array([1])}


def merged(parts: Sequence[Statistics]) -> Statistics:
    """The statistics of all parts combined."""
    counts = np.concatenate([part["count"] for part in parts])
    weights = counts / counts.sum()
    means = np.stack([part["mean"] for part in parts])
    mean = np.tensordot(weights, means, 1)
    squares = np.stack([part["std"] for part in parts]) ** 2 + (means - mean) ** 2
    return {
        "min": np.stack([part["min"] for part in parts]).min(0),
        "max": np.stack([part["max"] for part in parts]).max(0),
        "mean": mean,
        "std": np.sqrt(np.tensordot(weights, squares, 1)),
        "count": counts.sum(keepdims=True),
    }


def sampled_statistics(topic: Topic, numbers: Integers, most: int, **view: Any) -> Statistics:
    """The statistics of some frames' pixels, 0 to 1, by colour.

    Args:
        topic: Of the frames.
        numbers: Those to choose from, int64, shape (frames,).
        most: How many are taken.
        **view: How they look, as in `Topic.read`.
    """
    count = min(most, len(numbers))
    chosen = np.unique(np.linspace(0, len(numbers) - 1, count).astype(np.int64))
    return merged(
        [picture_statistics(topic.read([n], **view)[0]) for n in numbers[chosen].tolist()]
    )
