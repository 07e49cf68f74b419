"""Poses of sensors as matrices, and as the transforms of ROS."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mp4ds.wire.transforms import Transform

_TOLERANCE = 1e-2  # of a rotation that a file gives with few digits

Matrix = NDArray[np.float64]


def quaternion(rotation: Matrix) -> tuple[float, float, float, float]:
    """The unit quaternion x, y, z, w of a rotation, w not negative.

    It is the eigenvector of the largest eigenvalue of a symmetric matrix (I. Bar-Itzhack, 2000),
    which is the nearest rotation to a matrix with rounded digits.

    Args:
        rotation: Shape (3, 3).

    Raises:
        ValueError: It is none.
    """
    m = rotation
    is_near = np.abs(m @ m.T - np.eye(3)).max(initial=0) < _TOLERANCE
    if not np.isfinite(m).all() or not is_near or np.linalg.det(m) < 0:
        raise ValueError("its rotation is none")
    symmetric = np.empty((4, 4))
    symmetric[:3, :3] = m + m.T - np.trace(m) * np.eye(3)
    vector = [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]]
    symmetric[3, :3] = symmetric[:3, 3] = vector
    symmetric[3, 3] = np.trace(m)
    found = np.linalg.eigh(symmetric)[1][:, -1]
    x, y, z, w = (found if found[3] >= 0 else -found).tolist()
    return x, y, z, w


def transform(parent: str, child: str, rotation: Matrix, translation: Matrix) -> Transform:
    """The pose of a frame in another: a point p of the child is rotation * p + translation there.

    Args:
        parent: The frame in which the child is.
        child: The frame that is placed.
        rotation: Shape (3, 3).
        translation: Metres, shape (3,).

    Raises:
        ValueError: The rotation is none.
    """
    if not np.isfinite(translation).all():
        raise ValueError("its translation is not finite")
    x, y, z = (translation + 0.0).tolist()  # without negative zeros
    return Transform(parent, child, (x, y, z), quaternion(rotation))
