"""Poses of sensors, by static transforms."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from mp4ds.dataset import Dataset
from mp4ds.records import Message
from mp4ds.stamps import INT64_MIN
from mp4ds.wire.transforms import Transform, TransformCollector

Pose = NDArray[np.float64]
"""Shape (4, 4): a point p of a frame is pose @ p in another; metres."""


def rotation_matrix(quaternion: Iterable[float]) -> NDArray[np.float64]:
    """The rotation of a quaternion x, y, z, w, which need not be of length 1; shape (3, 3)."""
    x, y, z, w = np.array([*quaternion], np.float64)
    scale = 2.0 / (x * x + y * y + z * z + w * w)
    return np.array(
        [
            [1 - scale * (y * y + z * z), scale * (x * y - z * w), scale * (x * z + y * w)],
            [scale * (x * y + z * w), 1 - scale * (x * x + z * z), scale * (y * z - x * w)],
            [scale * (x * z - y * w), scale * (y * z + x * w), 1 - scale * (x * x + y * y)],
        ]
    )


def quaternion_of(rotation: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """The quaternion x, y, z, w of a rotation, shape (3, 3); w is not negative."""
    # the eigenvector of the largest eigenvalue: exact where a formula by cases loses digits
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation.tolist()
    matrix = np.array(
        [
            [xx - yy - zz, xy + yx, xz + zx, zy - yz],
            [xy + yx, yy - xx - zz, yz + zy, xz - zx],
            [xz + zx, yz + zy, zz - xx - yy, yx - xy],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    x, y, z, w = np.linalg.eigh(matrix / 3.0)[1][:, -1].tolist()
    sign = -1.0 if w < 0 else 1.0
    return sign * x, sign * y, sign * z, sign * w


def pose_matrix(translation: Iterable[float], quaternion: Iterable[float]) -> Pose:
    """The pose of x, y, z in metres and a quaternion x, y, z, w."""
    pose = np.eye(4)
    pose[:3, :3] = rotation_matrix(quaternion)
    pose[:3, 3] = [*translation]
    return pose


def inverse(pose: Pose) -> Pose:
    """The pose of the other frame in this one."""
    turned = pose[:3, :3].T
    found = np.eye(4)
    found[:3, :3] = turned
    found[:3, 3] = -turned @ pose[:3, 3]
    return found


class StaticTree:
    """Where frames are that do not move against each other.

    Args:
        transforms: Of child frames, the last of each.
    """

    def __init__(self, transforms: Iterable[Transform]) -> None:
        self._by_child: Mapping[str, Transform] = {
            item.child.removeprefix("/"): item for item in transforms
        }

    def chain(self, frame: str) -> list[Transform]:
        """The transforms from a frame up to the root of its tree."""
        found: list[Transform] = []
        name, seen = frame.removeprefix("/"), set[str]()
        while name in self._by_child and name not in seen:
            seen.add(name)
            found.append(self._by_child[name])
            name = found[-1].parent.removeprefix("/")
        return found

    def _in_root(self, frame: str) -> tuple[str, Pose]:
        pose, root = np.eye(4), frame.removeprefix("/")
        for item in self.chain(frame):
            pose = pose_matrix(item.translation, item.rotation) @ pose
            root = item.parent.removeprefix("/")
        return root, pose

    def pose(self, frame: str, within: str) -> Pose | None:
        """Pose of a frame in another one; None where no static transforms connect them."""
        if not frame or not within:
            return None
        if frame.removeprefix("/") == within.removeprefix("/"):
            return np.eye(4)
        root, own = self._in_root(frame)
        other_root, other = self._in_root(within)
        return inverse(other) @ own if root == other_root else None


def static_transforms(dataset: Dataset) -> list[Transform]:
    """The static transforms of a dataset: of its messages, and those that its manifest lists."""
    listed = dataset.manifest.transforms if dataset.manifest else []
    collector = TransformCollector(
        Transform(
            parent=item.parent,
            child=item.child,
            translation=(item.translation[0], item.translation[1], item.translation[2]),
            rotation=(item.rotation[0], item.rotation[1], item.rotation[2], item.rotation[3]),
        )
        for item in listed
    )
    topics = {channel.topic for channel in dataset.channels if collector.takes(channel)}
    if topics:
        for record in dataset.records(start=INT64_MIN, topics=topics):
            if isinstance(record, Message):
                collector.add(record.channel, record.data)
    return collector.transforms
