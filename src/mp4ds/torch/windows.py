"""Runs of samples that are read one after the other, cut where decoding can begin."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from mp4ds.torch.recordings import Collection, Recording

_T = TypeVar("_T")


def windows(collection: Collection, length: int) -> NDArray[np.int64]:
    """All windows, as recording and number in it; shape (windows, 2).

    Args:
        collection: The samples.
        length: Samples of a window.
    """
    counts = [-(-recording.rows // length) for recording in collection.recordings]
    return np.array(
        [(number, window) for number, count in enumerate(counts) for window in range(count)],
        np.int64,
    ).reshape(-1, 2)


def rows_of(
    recording: Recording, window: int, length: int, keys: NDArray[np.int64]
) -> NDArray[np.int64]:
    """The samples of a window.

    It begins with the first sample at or after ``window * length`` whose frame of the first
    camera comes first behind a key frame, and ends where the next one begins. So windows are a
    partition of the samples, whatever key frames there are, and some may be empty.

    Args:
        recording: Of the samples.
        window: Its number.
        length: Samples of a window.
        keys: Numbers of the key frames of the first camera, in order.
    """
    first = _start(recording, window * length, keys)
    return np.arange(first, _start(recording, (window + 1) * length, keys), dtype=np.int64)


def _start(recording: Recording, row: int, keys: NDArray[np.int64]) -> int:
    rows = recording.rows
    if row <= 0 or row >= rows:
        return min(max(row, 0), rows)
    frames = recording.frames(np.arange(row - 1, rows, dtype=np.int64), 0)
    groups = np.searchsorted(keys, frames, side="right")
    begins = np.flatnonzero(groups[1:] > groups[:-1])
    return row + int(begins[0]) if len(begins) else rows


def shuffled(samples: Iterator[_T], size: int, random: np.random.Generator) -> Iterator[_T]:
    """Samples in random order, as far as a buffer of `size` allows."""
    kept: list[_T] = []
    for sample in samples:
        if len(kept) < size:
            kept.append(sample)
            continue
        place = int(random.integers(size))
        kept[place], sample = sample, kept[place]
        yield sample
    random.shuffle(kept)
    yield from kept
