"""A node of ROS: publishes, subscribes, offers services. Its names and options; opening it."""

from __future__ import annotations

import logging
import os
import re
import struct
import sys
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, TypeVar, cast, get_args

import yaml

from mp4ds.errors import OptionError, RemoteError
from mp4ds.options import Options, argument, where
from mp4ds.records import Channel

World = Literal["ros1", "ros2"]
_Loader: type[Any] = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
CLOCK = "/clock"
_Node = TypeVar("_Node", bound="Node")


# ---------------------------------------------------------------- names

SERVICE_EVENTS = "/_service_event"
"""What follows the name of a service in that of the topic of its events, in ROS 2."""

_NODE = re.compile(r"[A-Za-z_]\w*", re.ASCII)
_NAMESPACE = re.compile(r"/?(?:[A-Za-z_]\w*/?)*", re.ASCII)
_RULE = re.compile(r"(?:[A-Za-z_]\w*:(?!=))?([^:=\s]+):=(\S+)")
_OTHER = re.compile(r"_(?!_(?:node|name|ns):=).*:=.*", re.DOTALL)
"""Handled by ROS itself, such as ``__log:=``, or a private parameter."""

_BARE = re.compile(r"[~/A-Za-z_][\w/~]*:=.*", re.ASCII)
_VALUED = {
    "-r": "remap",
    "--remap": "remap",
    "--log-level": "log_level",
    "-p": "parameter",
    "--param": "parameter",
    "--params-file": "file",
    "--log-config-file": "",
    "-e": "",
    "--enclave": "",
}
"""ROS 2 arguments that take a value -> what it is; empty for those that are ignored."""

_SIM_TIME = "use_sim_time"
_MOST_BYTES = 2**20  # of a file
_FLAG = re.compile(r"--(?:enable|disable)-[\w-]+-logs")
LOG_LEVELS = ("debug", "info", "warn", "error", "fatal")


@dataclass(frozen=True)
class NodeNames:
    """The ROS arguments of a node.

    Attributes:
        node: Its name; empty for the default.
        namespace: Its namespace, such as ``/robot``; empty for the root.
        rules: Remappings of topics: old name, new name.
        log_level: The log level, as in ROS 2; empty if not given.
        use_sim_time: The parameter of this name; None if not given.
    """

    node: str = ""
    namespace: str = ""
    rules: tuple[tuple[str, str], ...] = ()
    log_level: str = ""
    use_sim_time: bool | None = None

    def in_world(self, world: str | None) -> NodeNames:
        """The same for a ROS version: in ROS 1 the environment may set the namespace."""
        namespace = os.environ.get("ROS_NAMESPACE", "") if world == "ros1" else ""
        return replace(self, namespace=namespace) if namespace and not self.namespace else self

    def of_node(self, node: str) -> str:
        """The node's name with its namespace, such as ``robot/player``; `node` is the default."""
        return "/".join(filter(None, (self.namespace.strip("/"), self.node or node)))

    def renamed(self, topic: str) -> str:
        """The name of a topic after remapping; unchanged if no rule applies."""
        found = {self.resolved(old): new for old, new in self.rules}.get(self.resolved(topic))
        return topic if found is None else self.resolved(found)

    def resolved(self, name: str) -> str:
        """The absolute name, such as ``/robot/imu``."""
        root = "/" + self.namespace.strip("/")
        if name.startswith("/"):
            return name
        if name.startswith("~"):
            name = f"{self.node}/{name[1:].lstrip('/')}"
        return f"{root.rstrip('/')}/{name}"


PLAIN = NodeNames()
"""No ROS arguments."""


def node_arguments(
    words: Sequence[str], *, rules_of: Sequence[str] = ("--remap", "-m")
) -> tuple[list[str], NodeNames]:
    """Separate the ROS arguments from the others of a command line.

    ROS 2 arguments are between ``--ros-args`` and ``--`` or the end, ROS 1 arguments anywhere:
    ``__name:=x``, ``__ns:=/y``, ``_parameter:=1``, ``/topic:=/other``. Parameters other than
    ``use_sim_time`` are ignored.

    Args:
        words: The command line.
        rules_of: Options of the command itself that take remappings.

    Returns:
        The other arguments, and the ROS arguments.

    Raises:
        OptionError: A ROS argument is not valid.
    """
    rest: list[str] = []
    names = NodeNames()
    parameters: list[tuple[str, str]] = []
    left = iter(words)
    is_own = False
    for word in left:
        if word == "--ros-args":
            names = _ros2(left, names, parameters)
        elif word == "--":
            rest += [word, *left]
        elif _BARE.fullmatch(word) and not is_own:
            names = _with_rule(names, word)
        else:
            is_own = word in rules_of or (is_own and ":=" in word)
            rest.append(word)
    for kind, value in parameters:  # last, as files have sections for node names
        if kind == "file":
            for node, found in _nodes(load_map(Path(value), "nodes to parameters"), ""):
                if node in ("**", names.of_node("")) and _SIM_TIME in found:
                    names = replace(names, use_sim_time=_truth(found[_SIM_TIME], value))
            continue
        name, is_given, text = value.partition(":=")
        if not is_given:
            raise OptionError(f"{value!r} is not a ROS parameter; write it as name:=value.")
        if name.rpartition(":")[2] == _SIM_TIME:
            names = replace(names, use_sim_time=_truth(text, "--ros-args"))
    return rest, names


def _ros2(words: Iterator[str], names: NodeNames, parameters: list[tuple[str, str]]) -> NodeNames:
    for word in words:
        name, has_value, value = word.partition("=")
        if word == "--":
            break
        if _FLAG.fullmatch(word):
            continue
        if name not in _VALUED:
            known = ", ".join(_VALUED)
            raise OptionError(f"--ros-args {word} is not known. Use {known}; end them with --.")
        if not (has_value and name.startswith("--")):
            value = next(words, "")
        if _VALUED[name] == "remap":
            names = _with_rule(names, value)
        elif _VALUED[name] == "log_level":
            names = replace(names, log_level=value if value in LOG_LEVELS else "")
        elif _VALUED[name]:
            parameters.append((_VALUED[name], value))
    return names


def load_map(path: Path, of: str) -> dict[Any, Any]:
    """Read a small YAML file of the user's.

    Args:
        path: The file; an empty one is an empty map.
        of: What it maps, for errors.

    Raises:
        OptionError: It cannot be read, or is not a map.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise OptionError(f"{path}: cannot be read: {error.strerror}.") from None
    if len(data) > _MOST_BYTES:
        raise OptionError(f"{path}: is larger than {_MOST_BYTES} bytes, too large to map {of}.")
    try:
        document = yaml.load(data.decode(), Loader=_Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise OptionError(f"{path}: is not valid YAML: {reason}.") from None
    if document is None:
        return {}
    if not isinstance(document, dict):
        raise OptionError(f"{path}: does not map {of}.")
    return document


def _nodes(found: Mapping[Any, Any], place: str) -> Iterator[tuple[str, Mapping[Any, Any]]]:
    for key, value in found.items():
        if isinstance(value, dict) and key == "ros__parameters":
            yield place, value
        elif isinstance(value, dict):
            yield from _nodes(value, f"{place}/{key}".replace("//", "/").strip("/"))


def _truth(value: Any, place: str) -> bool:
    known = {"true": True, "false": False}
    if str(value).lower() in known:
        return known[str(value).lower()]
    raise OptionError(f"{place}: {_SIM_TIME} must be true or false, not {value!r}.")


def _with_rule(names: NodeNames, rule: str) -> NodeNames:
    if _OTHER.fullmatch(rule):
        return names
    match = _RULE.fullmatch(rule)
    if not match:
        raise OptionError(f"{rule!r} is not a remapping; write it as /old/topic:=/new/topic.")
    old, new = match.groups()
    if old in ("__node", "__name"):
        if not _NODE.fullmatch(new):
            raise OptionError(f"{rule!r}: {new!r} is not a valid node name.")
        return replace(names, node=new)
    if old == "__ns":
        if not _NAMESPACE.fullmatch(new):
            raise OptionError(f"{rule!r}: {new!r} is not a valid namespace, such as /robot.")
        return replace(names, namespace=new)
    return replace(names, rules=(*names.rules, (old, new)))


# ---------------------------------------------------------------- the node


@dataclass(frozen=True, kw_only=True)
class NodeOptions(Options):
    """How a node takes part; the options of a player and of a recorder are such options."""

    to: str | None = argument("ros1 or ros2; default: the ROS that is sourced.")
    qos_overrides: Path | None = where(
        "QoS profiles by topic (ROS 2).",
        None,
        "--qos-profile-overrides-path",
        metavar="YAML",
        only=("ros2",),
    )
    names: NodeNames = argument("Name, namespace and remappings of the ROS node.", PLAIN)

    # for those without the option
    queue = 0
    unpublished = False

    @property
    def parting_s(self) -> float | None:
        """How long to wait at the end for acknowledgements (ROS 2), may be infinite; None: 3 s.

        Topics that are not acknowledged by then are named in a warning.
        """
        return None

    @property
    def wait_s(self) -> float:
        """How long to wait for a subscriber that receives nothing and has a full queue (ROS 1).

        Then its oldest message is dropped. Above 0, publishing without pacing is as fast as the
        subscribers, which lose nothing. After a timeout, a subscriber is not waited for again until
        it has caught up.
        """
        return 0.0


Receive = Callable[[Channel, bytes, int], None]
"""Called with the channel of a message, the message, and when it was sent, 0 if that is not known.

Each channel has an id of its own.
"""

Follower = Callable[[Channel], Callable[[bytes], object]]
"""Called with a channel once it is known; returns what is called with each of its messages."""


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

    def listen(self, topic: str, on_message: Callable[[int | None], None]) -> None:
        """Call back with the header stamp of each message on another node's topic.

        Args:
            topic: As for `follow`.
            on_message: Called with nanoseconds; with None if there is no header, or that is not
                known.

        Raises:
            OptionError: There cannot be such a topic.
        """
        self.follow(topic, lambda channel: lambda data: on_message(_header_stamp(channel, data)))

    @abstractmethod
    def follow(self, topic: str, follower: Follower) -> None:
        """Follow another node's topic, whatever its type.

        Args:
            topic: The topic, which may have no publisher yet.
            follower: Called with each of its channels.

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

    @abstractmethod
    def subscribed_topics(self, node: str = "") -> frozenset[str]:
        """Topics that other nodes subscribe to, or only this one (ROS 1)."""

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


_HEADER = re.compile(rb"(?:\s|#[^\n]*\n)*(?:std_msgs/)?Header\s")
_STAMP = struct.Struct("<4xII")


def _header_stamp(channel: Channel, data: bytes) -> int | None:
    """The stamp of a ROS 1 message that begins with a header, nanoseconds."""
    definition = channel.schema.data if channel.schema else b""
    has_header = channel.message_encoding == "ros1" and _HEADER.match(definition)
    if not has_header or len(data) < _STAMP.size:
        return None
    seconds, nanoseconds = _STAMP.unpack_from(data)
    return int(seconds * 10**9 + nanoseconds)


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


def open_node(world: World, options: NodeOptions, name: str) -> Node:
    """Open a node.

    Args:
        world: For ROS 2, rclpy is used if it is installed, else Cyclone DDS.
        options: How it takes part.
        name: Its name, if the options have none.

    Raises:
        OptionError: An option is not valid, or does not work with this ROS.
        RemoteError: Something is missing: a library, a network or a master.
    """
    options.check_for(world)
    kind = world if world == "ros1" else "rclpy" if find_spec("rclpy") is not None else "dds"
    module, class_name, remedy = _NODES[kind]
    before = logging.getLoggerClass()
    try:
        found = import_module(f"mp4ds.plugins.ros.{module}")
    except ImportError as error:
        raise RemoteError(kind, f"{error}; {remedy}") from None
    finally:
        logging.setLoggerClass(before)  # rosgraph sets its own for the whole process
    node: Node = getattr(found, class_name)(options, name)
    return node


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
