"""The ROS 2 publisher that uses rclpy, with any of its middlewares."""

from __future__ import annotations

import json
import math
import struct
import threading
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from mp4ds.errors import ConversionError, OptionError, PublishError, Refused
from mp4ds.plugins.publishing.dds_domain import dds_topic, recorded_hash
from mp4ds.plugins.publishing.names import PLAIN, NodeNames
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
_EVENT = "_Event"
_LOOK = 0.1  # seconds between two checks for publishers of a topic
_NO_SUPPORT = ("UnsupportedTypeSupport", "NoTypeSupportImportedException")
"""Errors of a type without compiled type support, by name: their module differs by distro."""


class RclpyPublisher:
    """Publishes to ROS 2, as a node of the ROS that is sourced.

    The packages with the message types have to be installed.

    Args:
        overrides: Topic -> QoS profile to offer instead of the recorded one.
        node: Name of the node, if `names` has none.
        names: Name, namespace and remappings of the node.
        parting_s: How long to wait at the end for acknowledgements, may be infinite; topics that
            are not acknowledged by then are named in a warning. None: 3 s, without a warning.

    Raises:
        PublishError: No ROS 2 is sourced.
    """

    world: str | None = "ros2"

    def __init__(
        self,
        *,
        overrides: Mapping[str, Qos] = {},
        node: str = "rosbag2_player",
        names: NodeNames = PLAIN,
        parting_s: float | None = None,
    ) -> None:
        try:
            import rclpy
            from rclpy.context import Context
            from rclpy.executors import SingleThreadedExecutor
        except ImportError as error:
            problem = f"rclpy is missing ({error}); source ROS 2 first"
            raise PublishError("ROS 2", problem) from None
        self._context = Context()
        rclpy.init(args=[], context=self._context)
        self._node = rclpy.create_node(
            names.node or node, context=self._context, namespace=names.namespace or None
        )
        self._clock_topic = names.renamed(CLOCK)
        self._parting_s = parting_s
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._writers: Writers[Any] = Writers(overrides)
        self._compared: set[str] = set()
        self._clock: Any = None
        self._ended = threading.Event()
        self._threads = [threading.Thread(target=self._spin, name="mp4ds-rclpy", daemon=True)]
        self._threads[0].start()

    @property
    def address(self) -> str:
        """Its node, for display."""
        return f"ROS 2, as node {self._node.get_name()} (rclpy)"

    def advertise(self, channel: Channel) -> None:
        """Announce a channel before its first message."""
        kind = channel.type_name
        self._writers.add(channel, kind, partial(self._create, channel.topic, kind))
        if kind not in self._compared:
            self._compared.add(kind)
            _compare(channel)

    def _create(self, topic: str, type_name: str, qos: Qos) -> Any:
        """A publisher of rclpy.

        Raises:
            Refused: The type is not installed.
            ConversionError: The name of the topic or the type is not valid.
        """
        from rclpy.exceptions import InvalidTopicNameException

        kind = _installed_class(topic, type_name)
        try:
            return self._node.create_publisher(kind, topic, qos_profile(qos))
        except InvalidTopicNameException:
            remedy = "Rename it with `remap`."
            raise ConversionError(topic, "its name is not valid in ROS 2", remedy) from None
        except Exception as error:  # rclpy's errors have no common base
            if type(error).__name__ not in _NO_SUPPORT:
                raise ConversionError(topic, f"ROS 2 refuses it: {error}") from None
            raise Refused(f"the type {type_name!r} has an incomplete package: {error}") from None

    def publish(self, channel: Channel, payload: bytes | memoryview, time_ns: int) -> None:
        """Publish a message of an advertised channel."""
        self._send(self._writers[channel], channel.topic, bytes(payload))

    def _send(self, publisher: Any, topic: str, payload: bytes) -> None:
        try:
            publisher.publish(payload)
        except Exception as error:  # rclpy's errors have no common base
            raise PublishError(topic, f"ROS 2 refuses a message: {error}") from None

    def clock(self, time_ns: int) -> None:
        """Publish a recording time as /clock."""
        if self._clock is None:
            self._clock = self._create(self._clock_topic, CLOCK_TYPE, CLOCK_QOS)
        self._send(self._clock, self._clock_topic, clock_message(time_ns))

    def subscribers(self, channel: Channel) -> int:
        """How many subscribers a channel's topic has now."""
        return int(self._writers[channel].get_subscription_count())

    def follow_clock(self, on_time: Callable[[int], None]) -> None:
        """Call back with each time, in nanoseconds, that another node publishes as /clock."""
        topic = self._clock_topic
        self._subscribe(topic, CLOCK_TYPE, CLOCK_QOS, lambda raw: on_time(_time_of(raw)))

    def listen(self, topic: str, on_message: Callable[[int | None], None]) -> None:
        """Call back for each message on a topic, as soon as it has a publisher."""
        if dds_topic(topic) is None:
            raise OptionError(f"{topic!r} is not a valid ROS 2 topic name.")
        thread = threading.Thread(target=self._seek, args=(topic, on_message), daemon=True)
        self._threads.append(thread)
        thread.start()

    def _seek(self, topic: str, on_message: Callable[[int | None], None]) -> None:
        own = self._node.get_name()
        while not self._ended.wait(_LOOK):
            found = self._node.get_publishers_info_by_topic(topic)
            others = [one for one in found if one.node_name != own]
            if others:
                reliable = all(one.qos_profile.reliability.name == "RELIABLE" for one in others)
                qos = Qos(reliability="reliable" if reliable else "best_effort")
                try:
                    self._subscribe(topic, others[0].topic_type, qos, lambda _: on_message(None))
                except ConversionError as error:
                    self._node.get_logger().error(str(error))
                return

    def _subscribe(
        self, topic: str, type_name: str, qos: Qos, on_raw: Callable[[bytes], None]
    ) -> None:
        kind = message_class(topic, type_name)
        self._node.create_subscription(kind, topic, on_raw, qos_profile(qos), raw=True)

    def serve(self, controls: Controls) -> None:
        """Offer the services of `ros2 bag play`, if rosbag2_interfaces is installed."""
        serve(self._node, PLAYER_SERVICES, controls)

    def _spin(self) -> None:
        from rclpy.executors import ExternalShutdownException

        try:
            while not self._ended.is_set() and self._context.ok():
                self._executor.spin_once(timeout_sec=_LOOK)
        except ExternalShutdownException:
            pass

    @property
    def wants_clock(self) -> bool:
        """False: in ROS 2, simulated time is configured for each node."""
        return False

    @property
    def is_alive(self) -> bool:
        """Whether the node was not shut down."""
        return not self._ended.is_set() and bool(self._context.ok())

    def close(self) -> None:
        """Wait until subscribers have what was sent, as long as they may take, and leave."""
        from rclpy.duration import Duration

        if self._ended.is_set():
            return
        is_asked = self._parting_s is not None
        end = time.monotonic() + (PARTING_S if self._parting_s is None else self._parting_s)

        def is_acknowledged(publisher: Any) -> bool:
            left = end - time.monotonic()  # rclpy takes a negative one for infinite
            left = -1.0 if math.isinf(left) else max(0.0, left)
            return bool(publisher.wait_for_all_acked(Duration(seconds=left)))

        if self._context.ok():
            self._writers.wait(is_acknowledged, warns=is_asked)
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
    """The message class of a topic.

    Raises:
        ConversionError: The type is not installed, or its name is not valid.
    """
    try:
        return _installed_class(topic, type_name)
    except Refused as reason:
        raise ConversionError(topic, str(reason), "Install and source its package.") from None


def _installed_class(topic: str, type_name: str) -> Any:
    from rosidl_runtime_py.utilities import get_message, get_service

    try:
        if "/srv/" in type_name and type_name.endswith(_EVENT):  # a part of the service's type
            return get_service(type_name.removesuffix(_EVENT)).Event
        return get_message(type_name)
    except (AttributeError, ModuleNotFoundError):
        raise Refused(f"the type {type_name!r} is not installed in this ROS 2") from None
    except ValueError:
        remedy = "Leave the topic out."
        problem = f"{type_name!r} is not a ROS 2 message type"
        raise ConversionError(topic, problem, remedy) from None
    except Exception as error:  # the package cannot be imported
        raise Refused(f"the type {type_name!r} has an incomplete package: {error}") from None


def _compare(channel: Channel) -> None:
    """Warn if the installed type differs from the recorded one of the same name."""
    installed = _installed_hash(channel.type_name)
    recorded = recorded_hash(channel) if installed else ""
    if recorded and recorded != installed:
        warnings.warn(
            f"{channel.topic}: the installed type {channel.type_name} differs from the recorded "
            "one, so subscribers may read garbage; install the version of its package that was "
            "used for the recording.",
            stacklevel=2,
        )


def _installed_hash(type_name: str) -> str:
    """The hash of an installed type, RIHS01_...; empty if there is none, as before Iron."""
    try:
        from ament_index_python.packages import get_package_share_directory

        package, *rooms = type_name.split("/")
        path = Path(get_package_share_directory(package), *rooms).with_suffix(".json")
        hashes = json.loads(path.read_bytes())["type_hashes"]
        found = [one["hash_string"] for one in hashes if one["type_name"] == type_name]
        return str(found[0])
    except (ImportError, LookupError, OSError, TypeError, ValueError):
        return ""


def qos_profile(qos: Qos) -> Any:
    """A QoS profile for rclpy."""
    from rclpy.duration import Duration
    from rclpy.qos import (
        DurabilityPolicy,
        HistoryPolicy,
        LivelinessPolicy,
        QoSProfile,
        ReliabilityPolicy,
    )

    def duration(nanoseconds: int | None) -> Any:
        return Duration(nanoseconds=nanoseconds or 0)  # 0 means no limit

    # manual_by_node was removed from ROS 2
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


def serve(node: Any, services: Sequence[Service], controls: Any) -> None:
    """Offer services of a node, if rosbag2_interfaces is installed.

    Args:
        node: The rclpy node.
        services: The services.
        controls: The player or recorder that they control.
    """
    try:
        import rosbag2_interfaces.srv as kinds
    except ImportError:
        return
    for service in services:
        if kind := getattr(kinds, service.kind, None):  # older versions have fewer
            answer = partial(_answer, service, controls)
            node.create_service(kind, f"~/{service.name}", answer)


def _answer(service: Service, controls: Any, request: Any, response: Any) -> Any:
    for key, value in service.answer(controls, request).items():
        setattr(response, key, value)
    return response


def _time_of(raw: bytes) -> int:
    sec, nanosec = struct.unpack_from("<iI" if raw[1] & 1 else ">iI", raw, 4)
    return int(sec) * _SECOND + int(nanosec)
