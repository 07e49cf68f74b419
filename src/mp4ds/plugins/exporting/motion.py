"""Poses of sensors by static transforms, and measurements of IMUs, poses and vectors."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.dataset.dataset import Dataset
from mp4ds.dataset.messages import RecordedMessage
from mp4ds.errors import OptionError
from mp4ds.messages.transforms import Transform, TransformCollector
from mp4ds.records import Message
from mp4ds.times import INT64_MIN

Pose = NDArray[np.float64]
"""Shape (4, 4): a point p of a frame is pose @ p in another; metres."""


def rotation_matrix(quaternion: Iterable[float]) -> NDArray[np.float64]:
    """The rotation of a quaternion x, y, z, w of any length; shape (3, 3)."""
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
    """Relative poses of static frames.

    Args:
        transforms: The last transform of each child frame.
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
        """Pose of a frame in another one; None if no static transforms connect them."""
        if not frame or not within:
            return None
        if frame.removeprefix("/") == within.removeprefix("/"):
            return np.eye(4)
        root, own = self._in_root(frame)
        other_root, other = self._in_root(within)
        return inverse(other) @ own if root == other_root else None


def static_transforms(dataset: Dataset) -> list[Transform]:
    """The static transforms of a dataset: from its messages and its manifest."""
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


# ---------------------------------------------------------------- motion

Row = tuple[int, tuple[float, ...]]
"""Time in nanoseconds, and values."""

_NS = 10**9
_WINDOW = 1000  # messages that may be out of order
_ROS = ("ros1", "cdr")


def ros_type(dataset: Dataset, topic: str) -> str:
    """Type of a ROS topic as ``package/Name``; empty for other serializations and topics."""
    for channel in dataset.channels:
        if channel.topic == topic and channel.message_encoding in _ROS:
            return channel.type_name.replace("/msg/", "/")
    return ""


def topics_of(dataset: Dataset, type_name: str, chosen: Callable[[str], bool]) -> list[str]:
    """The selected topics with a ROS type."""
    topics = dict.fromkeys(channel.topic for channel in dataset.channels)
    return [topic for topic in topics if chosen(topic) and ros_type(dataset, topic) == type_name]


def stamp_of(header: Any) -> int:
    """Stamp of a message's header, nanoseconds."""
    return int(header.stamp.sec) * _NS + int(header.stamp.nanosec)


def frame_of(dataset: Dataset, topic: str) -> str:
    """Coordinate frame of the first message of a topic; empty if there is none."""
    first = next(dataset.messages([topic]), None)
    return "" if first is None else str(first.decoded.header.frame_id)


def imu_rows(dataset: Dataset, topic: str) -> Iterator[Row]:
    """Angular velocity x, y, z in rad/s, then acceleration x, y, z in m/s^2, of an IMU.

    Raises:
        SourceError: A message does not match its topic's type.
    """
    for message in dataset.messages([topic]):
        values = message.decoded
        turn, pull = values.angular_velocity, values.linear_acceleration
        yield stamp_of(values.header), (turn.x, turn.y, turn.z, pull.x, pull.y, pull.z)


POSES: dict[str, Callable[[Any], tuple[Any, Any]]] = {
    "geometry_msgs/PoseStamped": lambda m: (m.pose.position, m.pose.orientation),
    "geometry_msgs/PoseWithCovarianceStamped": lambda m: (
        m.pose.pose.position,
        m.pose.pose.orientation,
    ),
    "nav_msgs/Odometry": lambda m: (m.pose.pose.position, m.pose.pose.orientation),
    "geometry_msgs/TransformStamped": lambda m: (m.transform.translation, m.transform.rotation),
}
"""Types of poses -> position and orientation of a message."""


class Poses:
    """The poses of a topic.

    Attributes:
        topic: The topic.
        body: Frame whose poses these are; empty if messages do not say.

    Raises:
        OptionError: The topic does not exist, or has the wrong type.
    """

    def __init__(self, dataset: Dataset, topic: str) -> None:
        self._dataset = dataset
        self.topic = topic
        name = ros_type(dataset, topic)
        if name not in POSES:
            known = ", ".join(POSES)
            raise OptionError(
                f"`poses` {topic} is {f'of type {name}' if name else 'not a ROS topic'} in "
                f"{dataset.path}. Use a topic of type {known}."
            )
        self._parts = POSES[name]
        first = next(dataset.messages([topic]), None)
        self.body = "" if first is None else str(getattr(first.decoded, "child_frame_id", ""))

    def rows(self) -> Iterator[Row]:
        """Position x, y, z in metres, then the quaternion x, y, z, w.

        Raises:
            SourceError: A message does not match its topic's type.
        """
        for message in self._dataset.messages([self.topic]):
            values = message.decoded
            at, turn = self._parts(values)
            yield stamp_of(values.header), (at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w)


class Vectors:
    """Numbers of a topic: positions of joints, or an array.

    Attributes:
        topic: The topic.
        names: Names of the numbers, from the first message, if it has them.

    Raises:
        OptionError: The topic does not exist, has the wrong type, or no message.
    """

    _TYPES = (
        "sensor_msgs/JointState",
        "std_msgs/Float64MultiArray",
        "std_msgs/Float32MultiArray",
    )

    def __init__(self, dataset: Dataset, topic: str, option: str) -> None:
        self._dataset = dataset
        self.topic = topic
        name = ros_type(dataset, topic)
        if name not in self._TYPES:
            raise OptionError(
                f"{option} {topic} is {f'of type {name}' if name else 'not a ROS topic'} in "
                f"{dataset.path}. Use a topic of type {', '.join(self._TYPES)}."
            )
        self._is_joints = name == self._TYPES[0]
        first = next(dataset.messages([topic]), None)
        if first is None:
            raise OptionError(f"{option} {topic} has no message in {dataset.path}.")
        count = len(self._values(first))
        told = [str(name) for name in first.decoded.name] if self._is_joints else []
        numbered = [f"{topic.strip('/').rpartition('/')[2]}_{number}" for number in range(count)]
        self.names: Sequence[str] = told if len(told) == count else numbered

    def _values(self, message: RecordedMessage) -> tuple[float, ...]:
        values = message.decoded.position if self._is_joints else message.decoded.data
        return tuple(float(value) for value in values)

    def rows(self) -> Iterator[Row]:
        """The numbers; an array has no stamp and gets its log time.

        Raises:
            SourceError: A message does not match its topic's type.
        """
        for message in self._dataset.messages([self.topic]):
            time = stamp_of(message.decoded.header) if self._is_joints else message.log_time_ns
            yield time, self._values(message)


def in_order(rows: Iterable[Row], window: int = _WINDOW) -> Iterator[Row]:
    """Sort rows by time, of which each is at most `window` rows out of order.

    Args:
        rows: In the order of the recording.
        window: Number of rows to hold back.
    """
    waiting: list[tuple[int, int, tuple[float, ...]]] = []
    for number, (time, values) in enumerate(rows):
        heapq.heappush(waiting, (time, number, values))  # the number keeps equal times in order
        if len(waiting) > window:
            time, _, values = heapq.heappop(waiting)
            yield time, values
    while waiting:
        time, _, values = heapq.heappop(waiting)
        yield time, values
