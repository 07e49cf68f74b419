"""Depth as LeRobot stores it: codes of 12 bits on a logarithmic scale, in a lossless video.

The constants and the steps in single precision are LeRobot's (0.6.1), so that codes are its own.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mp4ds.messages.encodings import Pixels

DEPTH_FORMAT = "gray12le"
"""Pixel format of the videos."""

_UNITS = {"16UC1": ("mm", 1.0), "32FC1": ("m", 1000.0)}
"""Encoding -> unit of its numbers, in LeRobot's words, and millimetres in it."""

_MOST = 2**12 - 1
_MM = 1000.0


class DepthScale(NamedTuple):
    """What depths codes stand for, as LeRobot names it; metres."""

    depth_min: float = 0.01
    depth_max: float = 10.0
    shift: float = 3.5
    use_log: bool = True

    def table(self, *, in_metres: bool = False) -> NDArray[Any]:
        """The depths that LeRobot gives for codes, by code.

        Args:
            in_metres: Whether as float32 in metres; else as uint16 in millimetres.

        Raises:
            ValueError: There are no such codes.
        """
        near, far = float(self.depth_min), float(self.depth_max)
        shift = float(self.shift) if self.use_log else 0.0
        ends = [math.log(x + shift) if self.use_log else x for x in (near, far)]
        if not 0 <= near < far < math.inf:
            raise ValueError(f"depths from {near} to {far} m")
        scale, offset = np.float32((ends[1] - ends[0]) / _MOST), np.float32(ends[0])
        depth = np.arange(_MOST + 1, dtype=np.float32) * scale + offset
        depth = np.exp(depth) - np.float32(shift) if self.use_log else depth
        depth = depth.clip(near, far).astype(np.float32)
        return depth if in_metres else np.rint(depth * np.float32(_MM)).clip(0, 65535).astype("<u2")


# others would do, but datasets with different ones cannot be merged
LEROBOT_SCALE = DepthScale()
"""That of LeRobot's own recordings."""

_NEAR, _FAR, _SHIFT, _ = LEROBOT_SCALE
_RESTORED = LEROBOT_SCALE.table().astype(np.float64)


class DepthCodes:
    """The codes of a camera's depths, and how far off they are.

    Args:
        encoding: Of its images.
    """

    def __init__(self, encoding: str) -> None:
        self._unit, self._in_mm = _UNITS[encoding]
        self._measured = self._missing = self._outside = 0
        self._sum = self._most = 0.0

    @staticmethod
    def suit(encoding: str) -> bool:
        """Whether images of an encoding are depths; ``mono16`` may also be infrared."""
        return encoding in _UNITS

    @property
    def info(self) -> dict[str, Any]:
        """What LeRobot's loader has to know to make depths of the codes."""
        return {
            "is_depth_map": True,
            "depth_unit": self._unit,
            **{f"video.{name}": value for name, value in LEROBOT_SCALE._asdict().items()},
        }

    def of(self, pixels: Pixels) -> NDArray[np.uint16]:
        """The codes of an image, whose errors are counted.

        Args:
            pixels: Depths, shape (H, W).
        """
        depth = pixels.astype(np.float32)
        is_there = depth > 0  # not a number is no measurement, either
        depth[~is_there] = 0
        shift, near, far = (np.float32(x * _MM / self._in_mm) for x in (_SHIFT, _NEAR, _FAR))
        low, high = math.log(float(near + shift)), math.log(float(far + shift))
        scaled = (np.log(depth + shift) - low) / (high - low)
        codes: NDArray[np.uint16] = np.rint(scaled * _MOST).clip(0, _MOST).astype(np.uint16)
        is_within = (depth >= near) & (depth <= far)
        off = np.abs(_RESTORED[codes[is_within]] - depth[is_within].astype(float) * self._in_mm)
        self._measured += off.size
        self._missing += int((~is_there).sum())
        self._outside += int(is_there.sum()) - off.size
        self._sum += float(off.sum())
        self._most = max(self._most, float(off.max(initial=0)))
        return codes

    def __str__(self) -> str:
        total = max(1, self._measured + self._missing + self._outside)
        text = "its depths are LeRobot's codes of 12 bits, which it gives back "
        text += f"{self._sum / max(1, self._measured):.2f} mm off on average, at most "
        text += f"{self._most:.1f} mm"
        if self._missing:
            share = self._missing / total
            text += f"; {100 * share:.1f} % of the pixels have no measurement and become 10 mm"
        if self._outside:
            share = self._outside / total
            text += (
                f"; {100 * share:.1f} % are not from 10 mm to 10 m and become the nearer of these"
            )
        return text
