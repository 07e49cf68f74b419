"""A node of ROS: publishes, subscribes, offers services; there is a class for each library."""

from __future__ import annotations

import logging
import os
import sys
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Literal, TypeVar, cast, get_args

from mp4ds.errors import OptionError, RemoteError
from mp4ds.plugins.ros.names import PLAIN, NodeNames
from mp4ds.plugins.ros.qos import Qos
from mp4ds.records import Channel

World = Literal["ros1", "ros2"]
CLOCK = "/clock"
_Node = TypeVar("_Node", bound="Node")

Receive = Callable[[Channel, bytes, int], None]
"""Called with the channel of a message, the message, and when it was sent, 0 if that is not known.

Each channel has an id of its own.
"""


@dataclass(frozen=True, slots=True)
class Service:
    """A service in the style of rosbag2.

    Attributes:
        name: Its name below the node.
        request: Definition of a request; empty if it has no fields.
        response: Definition of a response; empty if it has no fields.
        answer: Called with a request; carries it out, and returns the fields of the response.
    """

    name: str
    request: str
    response: str
    answer: Callable[[Any], Mapping[str, Any]]

    @property
    def kind(self) -> str:
        """Its type in ``rosbag2_interfaces/srv``."""
        return "".join(map(str.capitalize, self.name.split("_")))


def action(name: str, act: Callable[[], object]) -> Service:
    """A service whose requests and responses have no fields."""

    def answer(_: Any) -> Mapping[str, Any]:
        act()
        return {}

    return Service(name, "", "", answer)


@dataclass(frozen=True)
class NodeOptions:
    """How a node takes part.

    Attributes:
        node: Its name, if `names` has none.
        names: Name, namespace and remappings.
        overrides: QoS profiles to use instead of the usual ones, by topic (ROS 2).
        parting_s: How long to wait at the end for acknowledgements (ROS 2), may be infinite; topics
            that are not acknowledged by then are named in a warning. None: 3 s, without a warning.
        queue_size: Messages that may wait for each subscriber of a topic, as with ``rosbag play
            --queue`` (ROS 1); 0 for any number. There is a limit of bytes in any case.
        wait_s: How many seconds to wait for a subscriber that receives nothing and has a full
            queue, before its oldest message is dropped (ROS 1). Above 0, publishing without pacing
            is as fast as the subscribers, which lose nothing. After a timeout, a subscriber is not
            waited for again until it has caught up.
        unpublished: Whether `Node.topics` has those without a publisher, too (rclpy).
    """

    node: str
    names: NodeNames = PLAIN
    overrides: Mapping[str, Qos] = field(default_factory=dict)
    parting_s: float | None = None
    queue_size: int = 0
    wait_s: float = 0.0
    unpublished: bool = False


class Node(ABC):
    """A node. A context manager; one thread publishes, callbacks come from any thread.

    Args:
        options: How it takes part.

    Attributes:
        world: Its ROS.
        discovery_s: How long `topics` takes to find all topics that there are.
        poll_s: The least time between two calls of `topics`.
        lost: Messages that were lost on their way here, as far as that is known, by topic.
    """

    world: World
    discovery_s = 0.0
    poll_s = 0.01

    def __init__(self, options: NodeOptions) -> None:
        self._options = options
        self.lost: Counter[str] = Counter()

    @property
    @abstractmethod
    def address(self) -> str:
        """Where it is, for display."""

    # ------------------------------------------------------------ publishing

    @abstractmethod
    def advertise(self, channel: Channel) -> None:
        """Announce a channel before its first message. Several channels may have one topic.

        Latching (ROS 1) and QoS (ROS 2) are those of its metadata.

        Raises:
            Refused: Its message type is not installed.
            ConversionError: It cannot be published; names the topic.
            RemoteError: The connection is lost.
        """

    @abstractmethod
    def publish(self, channel: Channel, payload: bytes | memoryview, time_ns: int) -> None:
        """Publish a message of an advertised channel.

        Args:
            channel: The same object that was advertised.
            payload: The serialized message; not kept after the call.
            time_ns: Recording time, nanoseconds.

        Raises:
            ConversionError: The message is not of its type.
            RemoteError: The connection is lost.
        """

    @abstractmethod
    def clock(self, time_ns: int) -> None:
        """Publish a recording time as /clock, which the first call advertises."""

    @abstractmethod
    def subscribers(self, channel: Channel) -> int:
        """How many subscribers a channel's topic has now."""

    # ------------------------------------------------------------ receiving

    @property
    def wants_clock(self) -> bool:
        """Whether all nodes are configured to use simulated time (ROS 1: /use_sim_time)."""
        return False

    @abstractmethod
    def follow_clock(self, on_time: Callable[[int], None]) -> None:
        """Call back with each time, in nanoseconds, that another node publishes as /clock."""

    @abstractmethod
    def listen(self, topic: str, on_message: Callable[[int | None], None]) -> None:
        """Call back for each message of any type on another node's topic.

        Args:
            topic: The topic, which may have no publisher yet.
            on_message: Called with the header stamp of the message, in nanoseconds; with None if
                it has no header, or that is not known.

        Raises:
            OptionError: There cannot be such a topic.
        """

    @abstractmethod
    def topics(self, is_wanted: Callable[[str, str], bool]) -> Mapping[str, Sequence[str]]:
        """Other nodes' topics that can be subscribed to now.

        Args:
            is_wanted: Called with the name and a type of each topic.

        Returns:
            Topic -> its wanted types.

        Raises:
            RemoteError: Nobody who knows the topics responds.
        """

    def subscribed_topics(self) -> set[str]:
        """Topics that other nodes subscribe to (ROS 2)."""
        raise NotImplementedError

    @abstractmethod
    def subscribe(self, topic: str, kind: str, name: str, receive: Receive) -> Channel | None:
        """Subscribe to a topic.

        Args:
            topic: One of `topics`.
            kind: One of its types.
            name: Topic of the channels of its messages.
            receive: Called with each message.

        Returns:
            Its channel, if that is known before the first message.

        Raises:
            Refused: It cannot be received; says why.
        """

    @abstractmethod
    def serve(self, services: Sequence[Service]) -> None:
        """Offer remote control as is usual here."""

    # ------------------------------------------------------------ the end

    @property
    @abstractmethod
    def is_alive(self) -> bool:
        """Whether it can still publish; False once it was shut down from outside."""

    @abstractmethod
    def close(self) -> None:
        """Send what is still waiting, for a limited time, and leave."""

    def __enter__(self: _Node) -> _Node:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


# ---------------------------------------------------------------- opening

_NODES = {
    "ros1": (
        "ros1",
        "Ros1Node",
        "source the setup.bash of ROS 1, or install python3-rospy and use a virtual environment "
        "made with python3 -m venv --system-site-packages",
    ),
    "rclpy": ("rclpy_node", "RclpyNode", "source ROS 2 again: its rclpy is not whole"),
    "dds": ("dds_node", "DdsNode", "source ROS 2, or run: pip install 'mp4ds[dds]'"),
}
"""Module and class of each library, and what to do if it is missing."""


def chosen_world(command: str, asked: str | None) -> World:
    """The ROS that was asked for, or else the one that is sourced.

    Args:
        command: The command, for the error.
        asked: ``ros1`` or ``ros2``, if any.

    Raises:
        OptionError: There is no such ROS.
        RemoteError: Neither is sourced.
    """
    version = asked or f"ros{os.environ.get('ROS_VERSION', '')}"
    if version in get_args(World):
        return cast(World, version)
    if asked:
        raise OptionError(f"there is no ROS {asked!r}. Use ros1 or ros2.")
    libraries: Mapping[str, World] = {"rclpy": "ros2", "rospy": "ros1", "cyclonedds": "ros2"}
    for module, world in libraries.items():
        if find_spec(module) is not None:
            return world
    raise RemoteError(
        command,
        "no ROS is sourced: source its setup file, or choose `ros1`, `ros2` (works without ROS "
        "after pip install 'mp4ds[dds]')",
    )


def open_node(world: World, options: NodeOptions) -> Node:
    """Open a node.

    Args:
        world: For ROS 2, rclpy is used if it is installed, else Cyclone DDS.
        options: How it takes part.

    Raises:
        OptionError: An option is not valid.
        RemoteError: Something is missing: a library, a network or a master.
    """
    kind = world if world == "ros1" else "rclpy" if find_spec("rclpy") is not None else "dds"
    module, name, remedy = _NODES[kind]
    before = logging.getLoggerClass()
    try:
        node: type[Node] = getattr(import_module(f"mp4ds.plugins.ros.{module}"), name)
    except ImportError as error:
        raise RemoteError(kind, f"{error}; {remedy}") from None
    finally:
        logging.setLoggerClass(before)  # rosgraph sets its own for the whole process
    return node(options)


# ---------------------------------------------------------------- threads

_SWITCH_S = 0.001


@contextmanager
def quick_switches() -> Iterator[None]:
    """Lets waiting threads have the interpreter sooner than Python does by default."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before)
