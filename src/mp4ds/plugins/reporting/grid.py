"""A grid of straight lines as a calibrated camera sees it, to draw over its images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mp4ds.dataset.views import effective, lens_of
from mp4ds.format.models import Calibration
from mp4ds.times import Floats

_CELLS = 12  # over the width of the image
_POINTS = 97  # of a line
_MARGIN = 0.02  # of the image's sides, beyond which a line is cut
_REACH, _FARTHEST = 2.5, 5  # times the image without distortion, from its principal point
_MODELS = ("plumb_bob", "rational_polynomial", "equidistant")
_MOST_D = 12  # beyond are the tilts of a sensor


@dataclass(frozen=True)
class Overlay:
    """Lines over an image.

    Attributes:
        lines: Each a list of x, y, x, y ... as fractions of the image's width and height.
        axes: Indices of the `lines` through the principal point.
        center: x and y of the principal point, as fractions of the width and height.
        problem: Why there are no lines; empty if there are.
    """

    lines: list[list[float]]
    axes: list[int]
    center: list[float]
    problem: str = ""


def overlay_of(calibration: Calibration, image_size: tuple[int, int], topic: str) -> Overlay:
    """A grid of evenly spaced straight lines in a plane in front of the camera.

    Args:
        calibration: Of the camera.
        image_size: Width and height of the images, pixels.
        topic: Of the images: on image_proc's rectified topics P applies, without distortion.
    """
    k, p = (np.array(matrix) for matrix in effective(calibration.fields))
    is_rectified = any(part.startswith("image_rect") for part in topic.split("/"))
    matrix = p[:, :3] if is_rectified else k
    model, d = ("none", []) if is_rectified else lens_of(calibration)
    problem = _problem(calibration, matrix, model, d, image_size)
    if problem:
        return Overlay([], [], [], problem)
    width, height = image_size
    (fx, _, cx), (_, fy, cy) = matrix[0], matrix[1]
    step = width / fx / _CELLS
    lines: list[list[float]] = []
    axes: list[int] = []
    reach = [
        min(_REACH * max(center, side - center), _FARTHEST * side)
        for center, side in ((cx, width), (cy, height))
    ]
    ends = reach[0] / fx, reach[1] / fy
    for axis in (0, 1):
        along = np.linspace(-ends[1 - axis], ends[1 - axis], _POINTS)
        for number in range(-int(ends[axis] / step), int(ends[axis] / step) + 1):
            across = np.full(_POINTS, number * step)
            x, y = (across, along) if axis == 0 else (along, across)
            distorted_x, distorted_y, is_sound = _distort(x, y, model, d)
            u = (fx * distorted_x + matrix[0, 1] * distorted_y + cx + 0.5) / width
            v = (fy * distorted_y + cy + 0.5) / height
            for line in _inside(u, v, is_sound):
                axes += [len(lines)] if number == 0 else []
                lines.append(line)
    return Overlay(lines, axes, [round((cx + 0.5) / width, 5), round((cy + 0.5) / height, 5)])


def _problem(
    calibration: Calibration,
    matrix: Floats,
    model: str,
    d: Sequence[float],
    image_size: tuple[int, int],
) -> str:
    """Why no grid is possible."""
    size = calibration.width, calibration.height
    if not (np.isfinite(matrix).all() and matrix[0, 0] > 0 and matrix[1, 1] > 0):
        return "the camera is not calibrated"
    roi = calibration.roi
    cut = (roi.width or size[0], roi.height or size[1]) if roi else size
    seen = cut[0] // max(1, calibration.binning_x), cut[1] // max(1, calibration.binning_y)
    if 0 not in size and seen != image_size:
        return f"it is for images of {seen[0]}x{seen[1]}, these are {image_size[0]}x{image_size[1]}"
    if not any(d):
        return ""
    if model not in _MODELS:
        return f"the distortion model {model!r} is not supported here"
    if not np.isfinite(d).all() or any(d[_MOST_D:]):
        return "its sensor is tilted, which is not supported"
    return ""


def _distort(
    x: Floats, y: Floats, model: str, d: Sequence[float]
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Where a lens maps points of the plane at distance 1, and which of them are in view."""
    if not any(d):
        return x, y, np.ones(len(x), np.bool_)
    with np.errstate(all="ignore"):  # far outside the view
        if model == "equidistant":
            return _fisheye(x, y, d)
        return _polynomial(x, y, d)


def _fisheye(x: Floats, y: Floats, d: Sequence[float]) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    coefficients = [*d[:4], *[0.0] * (4 - len(d[:4]))]
    radius = np.hypot(x, y)
    angle = np.arctan(radius)
    square = angle * angle
    factor, slope = np.ones_like(angle), np.ones_like(angle)
    for power, value in enumerate(coefficients, 1):
        factor += value * square**power
        slope += (2 * power + 1) * value * square**power
    scale = np.where(radius > 0, angle * factor / np.where(radius > 0, radius, 1.0), 1.0)
    return x * scale, y * scale, (slope > 0) & (factor > 0)


def _polynomial(
    x: Floats, y: Floats, d: Sequence[float]
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = [*d[:_MOST_D], *[0.0] * (_MOST_D - len(d))][
        :_MOST_D
    ]
    square = x * x + y * y
    above = 1 + square * (k1 + square * (k2 + square * k3))
    below = 1 + square * (k4 + square * (k5 + square * k6))
    factor = above / below
    # beyond its turning point the polynomial is meaningless
    above_slope = k1 + square * (2 * k2 + square * 3 * k3)
    below_slope = k4 + square * (2 * k5 + square * 3 * k6)
    slope = factor + 2 * square * (above_slope * below - above * below_slope) / (below * below)
    distorted_x = x * factor + 2 * p1 * x * y + p2 * (square + 2 * x * x)
    distorted_y = y * factor + p1 * (square + 2 * y * y) + 2 * p2 * x * y
    distorted_x += square * (s1 + square * s2)
    distorted_y += square * (s3 + square * s4)
    return distorted_x, distorted_y, (slope > 0) & (below > 0)


def _inside(u: Floats, v: Floats, is_sound: NDArray[np.bool_]) -> list[list[float]]:
    """The parts of a line inside the image."""
    with np.errstate(invalid="ignore"):
        seen = is_sound & (np.abs(u - 0.5) < 0.5 + _MARGIN) & (np.abs(v - 0.5) < 0.5 + _MARGIN)
    edges = np.flatnonzero(np.diff(np.concatenate(([0], seen.astype(np.int8), [0]))))
    parts = []
    for start, end in edges.reshape(-1, 2):
        if end - start > 1:
            points = np.stack([u[start:end], v[start:end]], axis=1)
            parts.append(np.round(points, 5).ravel().tolist())
    return parts
