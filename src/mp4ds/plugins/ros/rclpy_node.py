"""A node of the ROS 2 that is sourced, with any of its middlewares."""

from __future__ import annotations

import json
import math
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import rclpy
from ament_index_python.packages import get_package_share_directory
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)
from rosidl_runtime_py.utilities import get_message, get_service

from mp4ds.errors import ConversionError, Refused, RemoteError
from mp4ds.plugins.ros.node import NodeOptions, Service
from mp4ds.plugins.ros.ros2 import (
    DURATIONS,
    Qos,
    Ros2Node,
    finite,
    installed_definition,
    recorded_hash,
    standard_definition,
)
from mp4ds.records import Channel

_EVENT = "_Event"
_SPIN_S = 0.1
_NO_SUPPORT = ("UnsupportedTypeSupport", "NoTypeSupportImportedException")
"""Errors of a type without compiled type support, by name: their module differs by distro."""


class _RclpyWriter:
    def __init__(self, topic: str, publisher: Any) -> None:
        self._topic = topic
        self._publisher = publisher

    def write(self, payload: bytes) -> None:
        try:
            self._publisher.publish(payload)
        except Exception as error:  # rclpy's errors have no common base
            raise RemoteError(self._topic, f"ROS 2 refuses a message: {error}") from None

    def wait(self, seconds: float) -> bool:
        left = -1.0 if math.isinf(seconds) else seconds  # rclpy takes a negative one for infinite
        return bool(self._publisher.wait_for_all_acked(Duration(seconds=left)))

    def subscribers(self) -> int:
        return int(self._publisher.get_subscription_count())


class RclpyNode(Ros2Node):
    """A node by rclpy. The packages with the message types have to be installed.

    Args:
        options: How it takes part.
        name: Its name, if the options have none.
    """

    def __init__(self, options: NodeOptions, name: str) -> None:
        super().__init__(options)
        self._context = Context()
        rclpy.init(args=[], context=self._context)
        names = options.names
        self._node = rclpy.create_node(
            names.node or name, context=self._context, namespace=names.namespace or None
        )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._compared: set[str] = set()
        self._start(self._spin)

    def _spin(self) -> None:
        try:
            while not self._ended.is_set() and self._context.ok():
                self._executor.spin_once(timeout_sec=_SPIN_S)
        except ExternalShutdownException:
            pass

    @property
    def address(self) -> str:
        """Its name."""
        return f"ROS 2, as node {self._node.get_name()} (rclpy)"

    # ------------------------------------------------------------ publishing

    def advertise(self, channel: Channel) -> None:
        """Announce a channel; warn if the installed type differs from the recorded one."""
        super().advertise(channel)
        kind = channel.type_name
        if kind in self._compared:
            return
        self._compared.add(kind)
        installed = _installed_hash(kind)
        recorded = recorded_hash(channel) if installed else ""
        if recorded and recorded != installed:
            warnings.warn(
                f"{channel.topic}: the installed type {kind} differs from the recorded one, so "
                "subscribers may read garbage; install the version of its package that was used "
                "for the recording.",
                stacklevel=2,
            )

    def _make_writer(self, channel: Channel, qos: Qos) -> _RclpyWriter:
        topic, type_name = channel.topic, channel.type_name
        kind = _installed_class(topic, type_name)
        try:
            return _RclpyWriter(topic, self._node.create_publisher(kind, topic, _profile(qos)))
        except InvalidTopicNameException:
            remedy = "Rename it with `remap`."
            raise ConversionError(topic, "its name is not valid in ROS 2", remedy) from None
        except Exception as error:  # rclpy's errors have no common base
            if type(error).__name__ not in _NO_SUPPORT:
                raise ConversionError(topic, f"ROS 2 refuses it: {error}") from None
            raise Refused(f"the type {type_name!r} has an incomplete package: {error}") from None

    # ------------------------------------------------------------ receiving

    def _read(
        self, topic: str, kind: str, qos: Qos, on_message: Callable[[bytes, int], object]
    ) -> Any:
        # rclpy passes the source timestamp only to callbacks of exactly two arguments
        def callback(raw: bytes, info: Any) -> None:
            on_message(raw, info["source_timestamp"])

        message_class = _installed_class(topic, kind)
        try:
            return self._node.create_subscription(
                message_class, topic, callback, _profile(qos), raw=True
            )
        except Exception as error:  # rclpy's errors have no common base
            raise Refused(f"ROS 2 refuses the subscription: {error}") from None

    def _kinds_of(self, topic: str) -> Sequence[str]:
        own = self._node.get_name()
        found = self._node.get_publishers_info_by_topic(topic)
        return [one.topic_type for one in found if one.node_name != own]

    def _complain(self, text: str) -> None:
        self._node.get_logger().error(text)

    def topics(self, is_wanted: Callable[[str, str], bool]) -> Mapping[str, Sequence[str]]:
        """Topics that are published; on request, also the others."""
        return {
            topic: wanted
            for topic, kinds in self._node.get_topic_names_and_types()
            if (wanted := [kind for kind in kinds if is_wanted(topic, kind)])
            and (self._options.unpublished or self._node.get_publishers_info_by_topic(topic))
        }

    def subscribed_topics(self, node: str = "") -> frozenset[str]:
        """Topics with subscribers."""
        found = self._node.get_topic_names_and_types()
        return frozenset(topic for topic, _ in found if self._node.count_subscribers(topic))

    def _announced(self, topic: str, kind: str) -> tuple[list[Qos], str, str]:
        publishers = self._node.get_publishers_info_by_topic(topic)
        told: Any = publishers and getattr(publishers[0], "topic_type_hash", None)  # since Jazzy
        value = bytes(getattr(told, "value", None) or b"")
        type_hash = f"RIHS{told.version:02}_{value.hex()}" if any(value) else ""
        share = [Path(p, "share") for p in os.environ.get("AMENT_PREFIX_PATH", "").split(":") if p]
        definition = installed_definition(kind, share) or standard_definition(kind, type_hash)
        return [_offered_by(one.qos_profile) for one in publishers], type_hash, definition

    def serve(self, services: Sequence[Service]) -> None:
        """Offer services, if rosbag2_interfaces is installed."""
        try:
            import rosbag2_interfaces.srv as kinds
        except ImportError:
            return
        for service in services:
            if kind := getattr(kinds, service.kind, None):  # older versions have fewer
                self._node.create_service(kind, f"~/{service.name}", partial(_answer, service))

    # ------------------------------------------------------------ the end

    @property
    def is_alive(self) -> bool:
        """Whether the node was not shut down."""
        return not self._ended.is_set() and bool(self._context.ok())

    def close(self) -> None:
        """Wait for acknowledgements, and leave."""
        if self._ended.is_set():
            return
        if self._context.ok():
            self._part()
        self._end_threads()
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()


def _answer(service: Service, request: Any, response: Any) -> Any:
    for key, value in service.answer(request).items():
        setattr(response, key, value)
    return response


def _installed_class(topic: str, type_name: str) -> Any:
    """The message class of a topic.

    Raises:
        Refused: The type is not installed.
        ConversionError: It is no type of ROS 2.
    """
    try:
        if "/srv/" in type_name and type_name.endswith(_EVENT):  # a part of the service's type
            return get_service(type_name.removesuffix(_EVENT)).Event
        return get_message(type_name)
    except (AttributeError, ModuleNotFoundError):
        raise Refused(f"the type {type_name!r} is not installed in this ROS 2") from None
    except ValueError:
        problem = f"{type_name!r} is not a ROS 2 message type"
        raise ConversionError(topic, problem, "Leave the topic out.") from None
    except Exception as error:  # the package cannot be imported
        raise Refused(f"the type {type_name!r} has an incomplete package: {error}") from None


def _installed_hash(type_name: str) -> str:
    """The hash of an installed type, RIHS01_...; empty if there is none, as before Iron."""
    try:
        package, *rooms = type_name.split("/")
        path = Path(get_package_share_directory(package), *rooms).with_suffix(".json")
        hashes = json.loads(path.read_bytes())["type_hashes"]
        found = [one["hash_string"] for one in hashes if one["type_name"] == type_name]
        return str(found[0])
    except (LookupError, OSError, TypeError, ValueError):
        return ""


# ---------------------------------------------------------------- QoS


_NAMED = {
    "history": HistoryPolicy,
    "reliability": ReliabilityPolicy,
    "durability": DurabilityPolicy,
    "liveliness": LivelinessPolicy,
}


def _profile(qos: Qos) -> Any:
    if qos.liveliness == "manual_by_node":  # it was removed from ROS 2
        qos = replace(qos, liveliness="automatic")
    policies = asdict(qos)
    for key in DURATIONS:
        policies[key] = Duration(nanoseconds=policies[key] or 0)  # 0 means no limit
    for key, kind in _NAMED.items():
        policies[key] = kind[policies[key].upper()]
    return QoSProfile(**policies)


def _offered_by(profile: Any) -> Qos:
    found: dict[str, Any] = {key: getattr(profile, key).name.lower() for key in _NAMED}
    if found["history"] not in ("keep_last", "keep_all"):  # discovery does not tell
        found["history"] = "keep_last"
    if not found["liveliness"].startswith("manual"):
        found["liveliness"] = "automatic"
    for key in DURATIONS:
        found[key] = finite(getattr(profile, key).nanoseconds)
    return Qos(depth=max(1, profile.depth), **found)
