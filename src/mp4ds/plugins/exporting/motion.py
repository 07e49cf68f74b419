"""Poses of sensors by static transforms, and the numbers of IMUs, poses and vectors."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.dataset.dataset import Dataset
from mp4ds.errors import OptionError
from mp4ds.messages.transforms import TransformCollector
from mp4ds.records import Message
from mp4ds.times import INT64_MIN

Pose = NDArray[np.float64]
"""Shape (4, 4): a point p of a frame is pose @ p in another; metres."""


def pose_matrix(translation: Iterable[float], quaternion: Iterable[float]) -> Pose:
    """The pose of x, y, z in metres and a quaternion x, y, z, w of any length but 0."""
    x, y, z, w = np.array([*quaternion], np.float64)
    s = 2.0 / (x * x + y * y + z * z + w * w)
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
        [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
        [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)],
    ]
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
    """Relative poses of frames, by the static transforms of a dataset.

    Args:
        dataset: Its messages and its manifest have them.
    """

    def __init__(self, dataset: Dataset) -> None:
        listed = dataset.manifest.transforms if dataset.manifest else []
        collector = TransformCollector(item.to_record() for item in listed)
        topics = {channel.topic for channel in dataset.channels if collector.takes(channel)}
        if topics:
            for record in dataset.records(start=INT64_MIN, topics=topics):
                if isinstance(record, Message):
                    collector.add(record.channel, record.data)
        self._by_child = {item.child.removeprefix("/"): item for item in collector.transforms}

    def pose(self, frame: str, within: str) -> Pose | None:
        """Pose of a frame in another one; None if no static transforms connect them."""
        if not frame or not within:
            return None
        root, own = self._in_root(frame)
        other_root, other = self._in_root(within)
        return inverse(other) @ own if root == other_root else None

    def _in_root(self, frame: str) -> tuple[str, Pose]:
        """The root of a frame's tree, and the pose of the frame in it."""
        pose, name, seen = np.eye(4), frame.removeprefix("/"), set[str]()
        while name in self._by_child and name not in seen:  # a cycle has no root
            seen.add(name)
            item = self._by_child[name]
            pose = pose_matrix(item.translation, item.rotation) @ pose
            name = item.parent.removeprefix("/")
        return name, pose


# ---------------------------------------------------------------- numbers

Row = tuple[int, tuple[float, ...]]
"""Time in nanoseconds, and values."""

_NS = 10**9
_WINDOW = 1000  # messages that may be out of order
_ROS = ("ros1", "cdr")


def _pose(at: Any, turn: Any) -> Sequence[float]:
    return at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w


def _imu(message: Any) -> Sequence[float]:
    turn, pull = message.angular_velocity, message.linear_acceleration
    return turn.x, turn.y, turn.z, pull.x, pull.y, pull.z


IMU = "sensor_msgs/Imu"

# what is asked for -> types that have it -> its numbers in a message
_MEASURES: Mapping[str, Mapping[str, Callable[[Any], Sequence[float]]]] = {
    # angular velocity x, y, z in rad/s, then acceleration x, y, z in m/s^2
    "imu": {IMU: _imu},
    # position x, y, z in metres, then the quaternion x, y, z, w
    "poses": {
        "geometry_msgs/PoseStamped": lambda m: _pose(m.pose.position, m.pose.orientation),
        "geometry_msgs/PoseWithCovarianceStamped": lambda m: _pose(
            m.pose.pose.position, m.pose.pose.orientation
        ),
        "nav_msgs/Odometry": lambda m: _pose(m.pose.pose.position, m.pose.pose.orientation),
        "geometry_msgs/TransformStamped": lambda m: _pose(
            m.transform.translation, m.transform.rotation
        ),
    },
    "vector": {
        "sensor_msgs/JointState": lambda m: m.position,
        "std_msgs/Float64MultiArray": lambda m: m.data,
        "std_msgs/Float32MultiArray": lambda m: m.data,
    },
}


def ros_type(dataset: Dataset, topic: str) -> str:
    """Type of a ROS topic as ``package/Name``; empty for other serializations and topics."""
    for channel in dataset.channels:
        if channel.topic == topic and channel.message_encoding in _ROS:
            return channel.type_name.replace("/msg/", "/")
    return ""


class Measures:
    """The numbers of a topic.

    Args:
        dataset: The dataset.
        topic: The topic.
        kind: ``imu``, ``poses`` or ``vector``.
        option: That named the topic, for errors.

    Attributes:
        topic: The topic.
        first: Its first message, decoded; None if there is none.

    Raises:
        OptionError: The topic does not exist, or has the wrong type.
    """

    def __init__(self, dataset: Dataset, topic: str, kind: str, option: str = "topics") -> None:
        types, name = _MEASURES[kind], ros_type(dataset, topic)
        if name not in types:
            raise OptionError(
                f"`{option}` {topic} is {f'of type {name}' if name else 'not a ROS topic'} in "
                f"{dataset.path}. Use a topic of type {', '.join(types)}."
            )
        self._dataset = dataset
        self._values = types[name]
        self.topic = topic
        first = next(dataset.messages([topic]), None)
        self.first: Any = None if first is None else first.decoded

    @property
    def frame_id(self) -> str:
        """Coordinate frame of the first message; empty if there is none."""
        return str(self.first.header.frame_id) if hasattr(self.first, "header") else ""

    @property
    def body(self) -> str:
        """Frame whose poses these are; empty if messages do not say."""
        return str(getattr(self.first, "child_frame_id", ""))

    @property
    def names(self) -> Sequence[str]:
        """Names of the numbers, from the first message if it has them."""
        count = len(self._values(self.first)) if self.first else 0
        own = [str(name) for name in getattr(self.first, "name", ())]
        last = self.topic.strip("/").rpartition("/")[2]
        return own if len(own) == count else [f"{last}_{number}" for number in range(count)]

    def rows(self) -> Iterator[Row]:
        """The numbers by stamp; an array has none and gets its log time.

        Raises:
            SourceError: A message does not match its topic's type.
        """
        return in_order(self._rows())

    def _rows(self) -> Iterator[Row]:
        for message in self._dataset.messages([self.topic]):
            decoded, time = message.decoded, message.log_time_ns
            if hasattr(decoded, "header"):
                time = int(decoded.header.stamp.sec) * _NS + int(decoded.header.stamp.nanosec)
            yield time, tuple(map(float, self._values(decoded)))


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
