"""What the package uses of rclpy, with its signatures, on a bus within the process.

`install` puts it where `import rclpy` finds it. Publishers and subscriptions meet as in ROS 2:
by topic, type and quality of service. As with rmw_cyclonedds, raw messages arrive padded to a
multiple of 4 bytes, and each publisher keeps as many for late subscribers as its own depth says.
"""

from __future__ import annotations

import enum
import inspect
import queue
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from rosbags.typesys import Stores, get_typestore

from waiting import WATCHDOG_S

INSTALLED = (
    "std_msgs/msg/Header",
    "std_msgs/msg/String",
    "rosgraph_msgs/msg/Clock",
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/Imu",
    "tf2_msgs/msg/TFMessage",
)

EVENT = "std_srvs/srv/Trigger_Event"


def _policies(name: str, *values: str) -> Any:
    return enum.IntEnum(name, ["SYSTEM_DEFAULT", *values], start=0)


HistoryPolicy = _policies("HistoryPolicy", "KEEP_LAST", "KEEP_ALL")
ReliabilityPolicy = _policies("ReliabilityPolicy", "RELIABLE", "BEST_EFFORT")
DurabilityPolicy = _policies("DurabilityPolicy", "TRANSIENT_LOCAL", "VOLATILE")


class LivelinessPolicy(enum.IntEnum):
    SYSTEM_DEFAULT = 0
    AUTOMATIC = 1
    MANUAL_BY_TOPIC = 3


class Duration:
    def __init__(self, *, seconds: float = 0, nanoseconds: int = 0) -> None:
        self.nanoseconds = int(seconds * 10**9) + nanoseconds


@dataclass(kw_only=True)
class QoSProfile:
    history: HistoryPolicy
    depth: int
    reliability: ReliabilityPolicy = ReliabilityPolicy.RELIABLE
    durability: DurabilityPolicy = DurabilityPolicy.VOLATILE
    deadline: Duration = field(default_factory=Duration)
    lifespan: Duration = field(default_factory=Duration)
    liveliness: LivelinessPolicy = LivelinessPolicy.AUTOMATIC
    liveliness_lease_duration: Duration = field(default_factory=Duration)
    avoid_ros_namespace_conventions: bool = False


class InvalidTopicNameException(Exception):  # noqa: N818 (rclpy's name)
    pass


class ExternalShutdownException(Exception):  # noqa: N818 (rclpy's name)
    pass


class UnsupportedTypeSupport(Exception):  # noqa: N818 (rosidl_generator_py's name)
    def __init__(self, pkg_name: str) -> None:
        super().__init__(f"Could not import 'rosidl_typesupport_c' for package '{pkg_name}'")


class Bus:
    def __init__(self) -> None:
        self.publishers: list[Publisher] = []
        self.subscriptions: list[Subscription] = []
        self.services: dict[str, tuple[Any, Callable[[Any, Any], Any], Node]] = {}
        self.errors: list[str] = []
        self.stopped: set[str] = set()  # topics of which nobody acknowledges a message
        self.kinds: dict[str, Any] = {}
        self.halves: set[str] = set()  # types of which only the Python half is installed
        self.share: Path | None = None  # where the definitions of types are installed

    def get_message(self, identifier: str) -> Any:
        package, *rooms = identifier.split("/")
        if len(rooms) != 2 or "srv" in rooms:
            raise ValueError(f"Expected the full name of a message, got {identifier}")
        return self._found(package, identifier)

    def get_service(self, identifier: str) -> Any:
        event = self._found(identifier.split("/")[0], f"{identifier}_Event")
        return SimpleNamespace(Event=event)

    def _found(self, package: str, name: str) -> Any:
        if name not in self.kinds:
            raise ModuleNotFoundError(f"No module named {package!r}")
        return self.kinds[name]

    def share_of(self, package: str) -> str:
        if self.share is None or not (self.share / package).is_dir():
            raise KeyError(f"package '{package}' not found")  # PackageNotFoundError is a KeyError
        return str(self.share / package)


class Publisher:
    def __init__(self, node: Node, kind: Any, topic: str, qos: QoSProfile) -> None:
        self.node, self.kind, self.topic, self.qos = node, kind, topic, qos
        self.kept: list[bytes] = []

    def publish(self, msg: Any) -> None:
        if not isinstance(msg, bytes):
            raise TypeError(f"Expected {self.kind}, got {type(msg)}")
        msg = msg.ljust((len(msg) + 3) // 4 * 4, b"\0")
        self.kept.append(msg)
        if self.qos.history != HistoryPolicy.KEEP_ALL:
            self.kept = self.kept[-self.qos.depth :]
        for subscription in self.node.bus.subscriptions:
            if subscription.matches(self):
                subscription.deliver(msg)

    def get_subscription_count(self) -> int:
        return sum(one.matches(self) for one in self.node.bus.subscriptions)

    def wait_for_all_acked(self, timeout: Duration = Duration(seconds=-1)) -> bool:  # noqa: B008
        return self.topic not in self.node.bus.stopped


class Subscription:
    def __init__(
        self, node: Node, kind: Any, topic: str, callback: Any, qos: QoSProfile, raw: bool
    ) -> None:
        self.node, self.kind, self.topic, self.callback = node, kind, topic, callback
        self.qos, self.raw = qos, raw

    def matches(self, publisher: Publisher) -> bool:
        offered, asked = publisher.qos, self.qos
        latched = DurabilityPolicy.TRANSIENT_LOCAL
        return (
            (publisher.topic, publisher.kind) == (self.topic, self.kind)
            and not (offered.reliability == 2 and asked.reliability == 1)
            and (asked.durability != latched or offered.durability == latched)
        )

    def deliver(self, msg: bytes) -> None:
        if not self.raw:
            raise TypeError("only raw subscriptions are part of this")
        try:  # as rclpy finds out what a callback takes
            inspect.signature(self.callback).bind(object())
            self.node.inbox.put(lambda: self.callback(msg))
        except TypeError:
            info = {"source_timestamp": time.time_ns(), "received_timestamp": time.time_ns()}
            self.node.inbox.put(lambda: self.callback(msg, info))


class Node:
    def __init__(
        self, bus: Bus, node_name: str, *, context: Context, namespace: str | None = None
    ) -> None:
        self.name, self.context, self.bus = node_name, context, bus
        self.namespace = f"/{namespace.strip('/')}" if namespace else ""
        self.inbox: queue.Queue[Callable[[], None]] = queue.Queue()

    def get_name(self) -> str:
        return self.name

    def get_logger(self) -> Any:
        return SimpleNamespace(error=self.bus.errors.append)

    def create_publisher(self, msg_type: Any, topic: str, qos_profile: QoSProfile) -> Publisher:
        if not topic.replace("/", "").replace("_", "").isalnum():
            raise InvalidTopicNameException(topic)
        if msg_type.type_name in self.bus.halves:
            raise UnsupportedTypeSupport(msg_type.type_name.partition("/")[0])
        self.bus.publishers.append(Publisher(self, msg_type, topic, qos_profile))
        return self.bus.publishers[-1]

    def create_subscription(
        self,
        msg_type: Any,
        topic: str,
        callback: Callable[[Any], None],
        qos_profile: QoSProfile,
        *,
        raw: bool = False,
    ) -> Subscription:
        subscription = Subscription(self, msg_type, topic, callback, qos_profile, raw)
        self.bus.subscriptions.append(subscription)
        for publisher in self.bus.publishers:
            both = {subscription.qos.durability, publisher.qos.durability}
            if subscription.matches(publisher) and both == {DurabilityPolicy.TRANSIENT_LOCAL}:
                for msg in publisher.kept[-qos_profile.depth :]:
                    subscription.deliver(msg)
        return subscription

    def create_service(self, srv_type: Any, srv_name: str, callback: Any) -> None:
        full = srv_name.replace("~", f"{self.namespace}/{self.name}")
        self.bus.services[full] = (srv_type, callback, self)

    def get_publishers_info_by_topic(self, topic_name: str) -> list[Any]:
        return [
            SimpleNamespace(
                node_name=one.node.name,
                topic_type=one.kind.type_name,
                topic_type_hash=getattr(one.kind, "type_hash", None),
                qos_profile=one.qos,
            )
            for one in self.bus.publishers
            if one.topic == topic_name
        ]

    def get_topic_names_and_types(self, no_demangle: bool = False) -> list[tuple[str, list[str]]]:
        found: dict[str, dict[str, None]] = {}
        for one in (*self.bus.publishers, *self.bus.subscriptions):
            found.setdefault(one.topic, {})[one.kind.type_name] = None
        return [(topic, [*kinds]) for topic, kinds in found.items()]

    def count_subscribers(self, topic_name: str) -> int:
        return sum(one.topic == topic_name for one in self.bus.subscriptions)

    def destroy_node(self) -> None:
        bus = self.bus
        bus.publishers = [one for one in bus.publishers if one.node is not self]
        bus.subscriptions = [one for one in bus.subscriptions if one.node is not self]


class Context:
    def __init__(self) -> None:
        self._is_up = False

    def ok(self) -> bool:
        return self._is_up

    def init(self) -> None:
        self._is_up = True

    def try_shutdown(self) -> None:
        self._is_up = False


class SingleThreadedExecutor:
    def __init__(self, *, context: Context) -> None:
        self._context = context
        self._nodes: list[Node] = []

    def add_node(self, node: Node) -> bool:
        self._nodes.append(node)
        return True

    def spin_once(self, timeout_sec: float | None = None) -> None:
        if not self._context.ok():
            raise ExternalShutdownException
        try:
            self._nodes[0].inbox.get(timeout=timeout_sec)()
        except queue.Empty:
            return

    def shutdown(self) -> bool:
        return True


def install(monkeypatch: pytest.MonkeyPatch) -> Bus:
    """Let `import rclpy` find this until the test ends."""
    bus = Bus()

    def init(*, args: Any = None, context: Context) -> None:
        context.init()

    bus.kinds = {
        name: SimpleNamespace(type_name=name, type_hash=_type_hash(name)) for name in INSTALLED
    }
    # of services only the events, which are messages
    bus.kinds[EVENT] = SimpleNamespace(type_name=EVENT)
    services = ("Pause", "Resume", "TogglePaused", "IsPaused", "GetRate", "SetRate")
    services += ("Play", "PlayNext", "Burst", "Seek", "Stop", "SplitBagfile", "Snapshot")
    modules: dict[str, dict[str, Any]] = {
        "rclpy": {"init": init, "create_node": partial(Node, bus)},
        "rclpy.context": {"Context": Context},
        "rclpy.executors": {
            "SingleThreadedExecutor": SingleThreadedExecutor,
            "ExternalShutdownException": ExternalShutdownException,
        },
        "rclpy.exceptions": {"InvalidTopicNameException": InvalidTopicNameException},
        "rclpy.duration": {"Duration": Duration},
        "rclpy.qos": {
            kind.__name__: kind
            for kind in (
                *(QoSProfile, HistoryPolicy, ReliabilityPolicy, DurabilityPolicy),
                LivelinessPolicy,
            )
        },
        "rosidl_runtime_py": {},
        "rosidl_runtime_py.utilities": {
            "get_message": bus.get_message,
            "get_service": bus.get_service,
        },
        "ament_index_python": {},
        "ament_index_python.packages": {"get_package_share_directory": bus.share_of},
        "rosbag2_interfaces": {},
        "rosbag2_interfaces.srv": {name: SimpleNamespace(name=name) for name in services},
    }
    monkeypatch.delitem(sys.modules, "mp4ds.plugins.ros.rclpy_node", raising=False)
    for name, content in modules.items():
        module = ModuleType(name)
        vars(module).update(content)
        module.__spec__ = ModuleSpec(name, None)  # by which others see that it is there
        monkeypatch.setitem(sys.modules, name, module)
        if "." in name:
            parent, _, child = name.rpartition(".")
            monkeypatch.setattr(sys.modules[parent], child, module, raising=False)
    return bus


def _type_hash(name: str) -> Any:
    """As Jazzy's rclpy tells it."""
    text = get_typestore(Stores.ROS2_JAZZY).hash_rihs01(name)
    return SimpleNamespace(version=1, value=bytes.fromhex(text.removeprefix("RIHS01_")))


class FakePeer:
    """Another node on the bus, with the commands of the peer in DDS."""

    def __init__(self, bus: Bus) -> None:
        context = Context()
        context.init()
        self._node = Node(bus, "peer", context=context)
        self._bus = bus
        self._seen: dict[str, list[bytes]] = {}
        self._lock = threading.Lock()

    def subscribe(
        self,
        topic: str,
        kind: str,
        *,
        reliable: bool = True,
        latched: bool = False,
        depth: int = 1000,
    ) -> None:
        seen = self._seen.setdefault(topic, [])
        qos = _profile(reliable, latched, depth)
        kinds = self._bus.kinds
        self._node.create_subscription(kinds[kind], topic, seen.append, qos, raw=True)

    def received(self, topic: str, count: int, seconds: float = WATCHDOG_S) -> list[bytes]:
        while not self._node.inbox.empty():
            self._node.inbox.get()()
        return self._seen[topic]

    def forget(self, topic: str) -> None:
        self._seen[topic].clear()

    @contextmanager
    def stopped(self, topic: str) -> Iterator[None]:
        self._bus.stopped.add(topic)
        yield

    def connected(self, topic: str, count: int) -> int:
        subscriptions = [one for one in self._bus.subscriptions if one.topic == topic]
        mine = [one for one in subscriptions if one.node is self._node]
        return sum(one.matches(publisher) for one in mine for publisher in self._bus.publishers)

    def advertise(self, topic: str, kind: str, *, reliable: bool = True) -> Publisher:
        known = [one for one in self._bus.publishers if one.topic == topic]
        mine = [one for one in known if one.node is self._node]
        qos = _profile(reliable, False, 10)
        return mine[0] if mine else self._node.create_publisher(self._bus.kinds[kind], topic, qos)

    def publish(self, topic: str, kind: str, message: bytes, *, reliable: bool = True) -> None:
        publisher = self.advertise(topic, kind, reliable=reliable)
        end = time.monotonic() + WATCHDOG_S
        while not publisher.get_subscription_count() and time.monotonic() < end:
            time.sleep(0.005)
        publisher.publish(message)

    def call(self, name: str, kind: str, request: dict[str, Any]) -> dict[str, Any]:
        found, callback, node = self._bus.services[name]
        if found.name != kind:
            raise TypeError(f"{name} is of type {found.name}")
        replies: queue.Queue[Any] = queue.Queue()
        node.inbox.put(lambda: replies.put(callback(SimpleNamespace(**request), SimpleNamespace())))
        return vars(replies.get(timeout=WATCHDOG_S))


def _profile(reliable: bool, latched: bool, depth: int) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
