"""Depth as LeRobot stores it: codes of 12 bits on a logarithmic scale, in a lossless video.

The constants and the steps in single precision are LeRobot's (0.6.1), so that codes are its own.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.messages.encodings import Pixels

DEPTH_FORMAT = "gray12le"
"""Pixel format of the videos."""

_UNITS = {"16UC1": ("mm", 1.0), "32FC1": ("m", 1000.0)}
"""Encoding -> unit of its numbers, in LeRobot's words, and millimetres in it."""

# metres: others would do, but datasets with different ones cannot be merged
_NEAR, _FAR, _SHIFT = 0.01, 10.0, 3.5
_MOST = 2**12 - 1
_MM = 1000.0


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
            "video.depth_min": _NEAR,
            "video.depth_max": _FAR,
            "video.shift": _SHIFT,
            "video.use_log": True,
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
        off = np.abs(restored(codes)[is_within] - depth[is_within].astype(np.float64) * self._in_mm)
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


def restored(codes: NDArray[np.uint16]) -> NDArray[np.float32]:
    """The depths that LeRobot gives for codes, in whole millimetres."""
    low, high = math.log(_NEAR + _SHIFT), math.log(_FAR + _SHIFT)
    scale, offset = np.float32((high - low) / _MOST), np.float32(low)
    depth = np.exp(np.arange(_MOST + 1, dtype=np.float32) * scale + offset) - np.float32(_SHIFT)
    table: NDArray[np.float32] = np.rint(depth.clip(_NEAR, _FAR) * np.float32(_MM))
    return table[codes]
