"""Statistics of features, by which LeRobot normalizes them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.layouts import Pixels

_STEP_FROM = 300  # pixels of a side, from which on fewer are looked at
_SIDE = 150

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Statistics:
    """Least, greatest, mean and standard deviation of each number of a feature.

    Attributes:
        least: Shape of the feature; (3, 1, 1) of pictures.
        most: The same.
        mean: The same.
        deviation: The same.
        count: Rows, or pictures.
    """

    least: Floats
    most: Floats
    mean: Floats
    deviation: Floats
    count: int

    @classmethod
    def of(cls, values: NDArray[Any]) -> Statistics:
        """Of rows, shape (rows, numbers)."""
        rows = values.astype(np.float64)
        return cls(rows.min(0), rows.max(0), rows.mean(0), rows.std(0), len(rows))

    @classmethod
    def of_picture(cls, pixels: Pixels) -> Statistics:
        """Of a picture's colours from 0 to 1, of a part of its pixels where it is large.

        Args:
            pixels: uint8, shape (H, W, 3).
        """
        side = max(pixels.shape[:2])
        step = side // _SIDE if side >= _STEP_FROM else 1
        flat = pixels[::step, ::step].reshape(-1, 3) / 255.0
        found = cls.of(flat)
        shape = (3, 1, 1)
        return cls(
            found.least.reshape(shape),
            found.most.reshape(shape),
            found.mean.reshape(shape),
            found.deviation.reshape(shape),
            count=1,
        )

    def as_lists(self) -> dict[str, Any]:
        """By the names that LeRobot has."""
        return {
            "min": self.least.tolist(),
            "max": self.most.tolist(),
            "mean": self.mean.tolist(),
            "std": self.deviation.tolist(),
            "count": [self.count],
        }


def merged(parts: Sequence[Statistics]) -> Statistics:
    """The statistics of all that the parts are of."""
    counts = np.array([part.count for part in parts], np.float64)
    weights = counts / counts.sum()
    means = np.stack([part.mean for part in parts])
    mean = np.tensordot(weights, means, 1)
    squares = np.stack([part.deviation for part in parts]) ** 2 + (means - mean) ** 2
    return Statistics(
        np.stack([part.least for part in parts]).min(0),
        np.stack([part.most for part in parts]).max(0),
        mean,
        np.sqrt(np.tensordot(weights, squares, 1)),
        sum(part.count for part in parts),
    )
