"""Publishes in ROS 2 by the ROS that is installed: rclpy, with any of its middlewares."""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from mp4ds.errors import ConversionError, OptionError, PublishError
from mp4ds.plugins.publishing.dds_domain import dds_topic
from mp4ds.plugins.publishing.publisher import Controls
from mp4ds.plugins.publishing.ros2_writers import (
    CLOCK,
    CLOCK_QOS,
    CLOCK_TYPE,
    PARTING_S,
    PLAYER_SERVICES,
    Qos,
    Service,
    Writers,
    clock_message,
)
from mp4ds.records import Channel

_SECOND = 10**9
_LOOK = 0.1  # seconds between two looks for who publishes a topic


class RclpyPublisher:
    """A publisher of ROS 2 topics (`Publisher`) that is a node of the ROS that is sourced.

    The packages with the types of the messages have to be installed there.

    Args:
        overrides: Topic -> quality of service to offer instead of the recorded one.
        node: Name of the node.

    Raises:
        PublishError: No ROS 2 is sourced.
    """

    world: str | None = "ros2"

    def __init__(self, *, overrides: Mapping[str, Qos] = {}, node: str = "rosbag2_player") -> None:
        try:
            import rclpy
            from rclpy.context import Context
            from rclpy.executors import SingleThreadedExecutor
        except ImportError as error:
            problem = f"rclpy is missing ({error}); source a ROS 2 first"
            raise PublishError("ROS 2", problem) from None
        self._context = Context()
        rclpy.init(args=[], context=self._context)
        self._node = rclpy.create_node(node, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._writers: Writers[Any] = Writers(overrides)
        self._clock: Any = None
        self._ended = threading.Event()
        self._threads = [threading.Thread(target=self._spin, name="mp4ds-rclpy", daemon=True)]
        self._threads[0].start()

    @property
    def address(self) -> str:
        """Whose ROS it is, to be shown."""
        return f"ROS 2, by rclpy as {self._node.get_name()}"

    def advertise(self, channel: Channel) -> None:
        """Announce a channel before its first message; see `Publisher`."""
        kind = channel.type_name
        self._writers.add(channel, kind, partial(self._create, channel.topic, kind))

    def _create(self, topic: str, type_name: str, qos: Qos) -> Any:
        """A publisher of rclpy.

        Raises:
            ConversionError: The type is not installed, or the topic has no valid name.
        """
        from rclpy.exceptions import InvalidTopicNameException

        kind = message_class(topic, type_name)
        try:
            return self._node.create_publisher(kind, topic, qos_profile(qos))
        except InvalidTopicNameException:
            remedy = "Play it under another name."
            raise ConversionError(topic, "ROS 2 has no topics of such names", remedy) from None

    def publish(self, channel: Channel, payload: bytes | memoryview, time_ns: int) -> None:
        """Publish one message of a channel that was advertised; see `Publisher`."""
        self._send(self._writers[channel], channel.topic, bytes(payload))

    def _send(self, publisher: Any, topic: str, payload: bytes) -> None:
        try:
            publisher.publish(payload)
        except Exception as error:  # rclpy's errors have no common base
            raise PublishError(topic, f"ROS 2 does not take a message: {error}") from None

    def clock(self, time_ns: int) -> None:
        """Publish the time of the recording as /clock."""
        if self._clock is None:
            self._clock = self._create(CLOCK, CLOCK_TYPE, CLOCK_QOS)
        self._send(self._clock, CLOCK, clock_message(time_ns))

    def subscribers(self, channel: Channel) -> int:
        """How many subscribers a channel's topic has now."""
        return int(self._writers[channel].get_subscription_count())

    def follow_clock(self, on_time: Callable[[int], None]) -> None:
        """Call with each time, nanoseconds, that others publish as /clock."""
        self._subscribe(CLOCK, CLOCK_TYPE, CLOCK_QOS, lambda raw: on_time(_time_of(raw)))

    def listen(self, topic: str, on_message: Callable[[], None]) -> None:
        """Call for each message on a topic, from when somebody publishes it."""
        if dds_topic(topic) is None:
            raise OptionError(f"{topic!r} is no topic name of ROS 2.")
        thread = threading.Thread(target=self._seek, args=(topic, on_message), daemon=True)
        self._threads.append(thread)
        thread.start()

    def _seek(self, topic: str, on_message: Callable[[], None]) -> None:
        own = self._node.get_name()
        while not self._ended.wait(_LOOK):
            found = self._node.get_publishers_info_by_topic(topic)
            others = [one for one in found if one.node_name != own]
            if others:
                reliable = all(one.qos_profile.reliability.name == "RELIABLE" for one in others)
                qos = Qos(reliability="reliable" if reliable else "best_effort")
                try:
                    self._subscribe(topic, others[0].topic_type, qos, lambda _: on_message())
                except ConversionError as error:
                    self._node.get_logger().error(str(error))
                return

    def _subscribe(
        self, topic: str, type_name: str, qos: Qos, on_raw: Callable[[bytes], None]
    ) -> None:
        kind = message_class(topic, type_name)
        self._node.create_subscription(kind, topic, on_raw, qos_profile(qos), raw=True)

    def serve(self, controls: Controls) -> None:
        """Offer the services of `ros2 bag play`, where rosbag2_interfaces is installed."""
        try:
            import rosbag2_interfaces.srv as kinds
        except ImportError:
            return
        for service in PLAYER_SERVICES:
            kind = getattr(kinds, service.kind)
            answer = partial(_answer, service, controls)
            self._node.create_service(kind, f"~/{service.name}", answer)

    def _spin(self) -> None:
        from rclpy.executors import ExternalShutdownException

        try:
            while not self._ended.is_set() and self._context.ok():
                self._executor.spin_once(timeout_sec=_LOOK)
        except ExternalShutdownException:
            pass

    @property
    def wants_clock(self) -> bool:
        """False: in ROS 2 each node is told by itself to use a simulated time."""
        return False

    @property
    def is_alive(self) -> bool:
        """Whether the node was not shut down."""
        return not self._ended.is_set() and bool(self._context.ok())

    def close(self) -> None:
        """Wait until subscribers have what was sent, for 3 s at most, and leave."""
        from rclpy.duration import Duration

        if self._ended.is_set():
            return
        end = time.monotonic() + PARTING_S
        if self._context.ok():
            for publisher in self._writers:
                left = max(0.0, end - time.monotonic())
                publisher.wait_for_all_acked(Duration(seconds=left))
        self._ended.set()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join()
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def __enter__(self) -> RclpyPublisher:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def message_class(topic: str, type_name: str) -> Any:
    """The class of a topic's messages.

    Raises:
        ConversionError: The type is not installed.
    """
    from rosidl_runtime_py.utilities import get_message

    try:
        return get_message(type_name)
    except (AttributeError, ModuleNotFoundError, ValueError):
        problem = f"the type {type_name!r} is not installed in this ROS 2"
        raise ConversionError(topic, problem, "Install and source its package.") from None


def qos_profile(qos: Qos) -> Any:
    """A quality of service as rclpy has it."""
    from rclpy.duration import Duration
    from rclpy.qos import (
        DurabilityPolicy,
        HistoryPolicy,
        LivelinessPolicy,
        QoSProfile,
        ReliabilityPolicy,
    )

    def duration(nanoseconds: int | None) -> Any:
        return Duration(nanoseconds=nanoseconds or 0)  # 0 stands for no limit

    # manual_by_node is no more: it asserted the same for all publishers of a node
    liveliness = "AUTOMATIC" if qos.liveliness != "manual_by_topic" else "MANUAL_BY_TOPIC"
    return QoSProfile(
        history=HistoryPolicy[qos.history.upper()],
        depth=qos.depth,
        reliability=ReliabilityPolicy[qos.reliability.upper()],
        durability=DurabilityPolicy[qos.durability.upper()],
        deadline=duration(qos.deadline_ns),
        lifespan=duration(qos.lifespan_ns),
        liveliness=LivelinessPolicy[liveliness],
        liveliness_lease_duration=duration(qos.lease_ns),
        avoid_ros_namespace_conventions=qos.avoid_ros_namespace_conventions,
    )


def _answer(service: Service, controls: Controls, request: Any, response: Any) -> Any:
    for key, value in service.answer(controls, request).items():
        setattr(response, key, value)
    return response


def _time_of(raw: bytes) -> int:
    sec, nanosec = struct.unpack_from("<iI" if raw[1] & 1 else ">iI", raw, 4)
    return int(sec) * _SECOND + int(nanosec)
