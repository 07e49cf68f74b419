"""Features of episodes as LeRobotDataset v3 has them, and their statistics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.dataset.topic import Topic
from mp4ds.format.sidecars import FileNames
from mp4ds.messages.encodings import Pixels

Integers = NDArray[np.int64]
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
