"""Measurements of an IMU, poses and vectors, read from the messages of a dataset."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from mp4ds.dataset import Dataset
from mp4ds.errors import OptionError
from mp4ds.recorded import RecordedMessage

Row = tuple[int, tuple[float, ...]]
"""Time in nanoseconds, and values."""

_NS = 10**9
_WINDOW = 1000  # messages that may come too early
_ROS = ("ros1", "cdr")


def ros_type(dataset: Dataset, topic: str) -> str:
    """Type of a ROS topic as ``package/Name``; empty for other serializations and topics."""
    for channel in dataset.channels:
        if channel.topic == topic and channel.message_encoding in _ROS:
            return channel.type_name.replace("/msg/", "/")
    return ""


def topics_of(dataset: Dataset, type_name: str, chosen: Callable[[str], bool]) -> list[str]:
    """The chosen topics that have a ROS type."""
    topics = dict.fromkeys(channel.topic for channel in dataset.channels)
    return [topic for topic in topics if chosen(topic) and ros_type(dataset, topic) == type_name]


def stamp_of(header: Any) -> int:
    """Stamp of a message's header, nanoseconds."""
    return int(header.stamp.sec) * _NS + int(header.stamp.nanosec)


def frame_of(dataset: Dataset, topic: str) -> str:
    """Coordinate frame of the first message of a topic; empty where there is none."""
    first = next(dataset.messages([topic]), None)
    return "" if first is None else str(first.decoded.header.frame_id)


def imu_rows(dataset: Dataset, topic: str) -> Iterator[Row]:
    """Angular velocity x, y, z in rad/s, then acceleration x, y, z in m/s^2, of an IMU.

    Raises:
        SourceError: A message is not of the type that its topic tells.
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
        body: Frame that is placed; empty where messages do not say.

    Raises:
        OptionError: The topic is not there, or of another type.
    """

    def __init__(self, dataset: Dataset, topic: str) -> None:
        self._dataset = dataset
        self.topic = topic
        name = ros_type(dataset, topic)
        if name not in POSES:
            known = ", ".join(POSES)
            raise OptionError(
                f"--poses {topic} is {f'of type {name}' if name else 'no topic of ROS'} in "
                f"{dataset.path}. Give one of {known}."
            )
        self._parts = POSES[name]
        first = next(dataset.messages([topic]), None)
        self.body = "" if first is None else str(getattr(first.decoded, "child_frame_id", ""))

    def rows(self) -> Iterator[Row]:
        """Position x, y, z in metres, then the quaternion x, y, z, w.

        Raises:
            SourceError: A message is not of the type that its topic tells.
        """
        for message in self._dataset.messages([self.topic]):
            values = message.decoded
            at, turn = self._parts(values)
            yield stamp_of(values.header), (at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w)


class Vectors:
    """Numbers of a topic: positions of joints, or an array.

    Attributes:
        topic: The topic.
        names: Of the numbers of the first message, as far as it tells.

    Raises:
        OptionError: The topic is not there, of another type, or has no message.
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
                f"{option} {topic} is {f'of type {name}' if name else 'no topic of ROS'} in "
                f"{dataset.path}. Give one of {', '.join(self._TYPES)}."
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
            SourceError: A message is not of the type that its topic tells.
        """
        for message in self._dataset.messages([self.topic]):
            time = stamp_of(message.decoded.header) if self._is_joints else message.log_time_ns
            yield time, self._values(message)


def in_order(rows: Iterable[Row], window: int = _WINDOW) -> Iterator[Row]:
    """Rows by time, of which each comes at most so many rows too early.

    Args:
        rows: In the order of the recording.
        window: Rows that are held back.
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
