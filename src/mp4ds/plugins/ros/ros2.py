"""What nodes of ROS 2 have in common, whatever their library: QoS, writers, types."""

from __future__ import annotations

import re
import struct
import threading
import time
import warnings
from abc import abstractmethod
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, Protocol

from mp4ds.bags.latched import PLAYER_DEPTH, latched_depth
from mp4ds.bags.rosbag2_metadata import dump_yaml, native_qos
from mp4ds.bags.types import by_library, incomprehensible, make_store, ros2_types, types_of
from mp4ds.errors import ConversionError, OptionError, Refused
from mp4ds.plugins.ros.node import (
    CLOCK,
    SERVICE_EVENTS,
    Follower,
    Node,
    NodeOptions,
    Receive,
    load_map,
)
from mp4ds.records import HASH_KEY, QOS_KEY, Channel, Schema

CLOCK_TYPE = "rosgraph_msgs/msg/Clock"

_NS = 10**9
_PARTING_S = 3.0
_LOOK_S = 0.05  # between two checks for publishers of a topic that is listened to
_TOPIC = re.compile(r"/?[A-Za-z_]\w*(?:/[A-Za-z_]\w*)*", re.ASCII)


class Writer(Protocol):
    """Writes the messages of channels of the same topic, type and QoS."""

    def write(self, payload: bytes) -> None:
        """Send a message.

        Raises:
            ConversionError: It is not of its type.
            RemoteError: It cannot be sent.
        """

    def wait(self, seconds: float) -> bool:
        """Wait until reliable subscribers have all messages; returns whether they do."""

    def subscribers(self) -> int:
        """How many subscribers will get the next message."""


class Ros2Node(Node):
    """A node of ROS 2.

    Channels with the same topic, type and QoS share a writer; latched ones have one each, so that
    late subscribers get the last message of each, as from the recorded publishers.

    Args:
        options: How it takes part.

    Raises:
        OptionError: The file of QoS overrides cannot be read or is not valid.
    """

    world = "ros2"

    def __init__(self, options: NodeOptions) -> None:
        super().__init__(options)
        self._overrides = load_overrides(options.qos_overrides)
        self._clock_topic = options.names.renamed(CLOCK)
        self._clock: Writer | None = None
        self._channels: dict[int, tuple[Channel, Writer]] = {}  # by id()
        self._shared: dict[tuple[str, Hashable, Qos], Writer] = {}
        self._ended = threading.Event()
        self._threads: list[threading.Thread] = []
        self._received: dict[str, Any] = {}  # subscriptions of the library, by topic

    @abstractmethod
    def _make_writer(self, channel: Channel, qos: Qos) -> Writer:
        """A writer of a channel's messages.

        Raises:
            Refused: The type is not installed.
            ConversionError: The name of the topic or the type is not valid.
        """

    @abstractmethod
    def _read(
        self, topic: str, kind: str, qos: Qos, on_message: Callable[[bytes, int], object]
    ) -> Any:
        """Subscribe; calls back with each message and when it was sent. Returns the subscription.

        Raises:
            Refused: It cannot be received.
            ConversionError: There is no such type.
        """

    @abstractmethod
    def _announced(self, topic: str, kind: str) -> tuple[list[Qos], str, str]:
        """What publishers offer, and the hash and definition of their type, empty if unknown."""

    @abstractmethod
    def _kinds_of(self, topic: str) -> Sequence[str]:
        """Types of a topic that other nodes publish, with definitions as far as there are any."""

    def _complain(self, text: str) -> None:
        """Say that something does not work, where nodes say so."""

    def _start(self, work: Callable[..., None], *arguments: Any) -> threading.Thread:
        """Run something in a thread until it is done, or the node has ended."""
        thread = threading.Thread(target=work, args=arguments, name="mp4ds-ros2", daemon=True)
        self._threads.append(thread)
        thread.start()
        return thread

    def _end_threads(self) -> None:
        self._ended.set()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join()

    # ------------------------------------------------------------ publishing

    def advertise(self, channel: Channel) -> None:
        """Announce a channel."""
        if id(channel) in self._channels:
            return
        if channel.message_encoding != "cdr":
            encoding = channel.message_encoding or "unknown"
            raise ConversionError(channel.topic, f"its message encoding is {encoding}, not cdr")
        qos = offered_qos(channel, self._overrides)
        key = (channel.topic, channel.schema, qos)
        writer = None if qos.is_latched else self._shared.get(key)
        if writer is None:
            writer = self._shared[key] = self._make_writer(channel, qos)
        self._channels[id(channel)] = channel, writer

    def publish(self, channel: Channel, payload: bytes | memoryview, time_ns: int) -> None:
        """Publish a message."""
        self._channels[id(channel)][1].write(bytes(payload))

    def clock(self, time_ns: int) -> None:
        """Publish a recording time as /clock."""
        if self._clock is None:
            schema = Schema(CLOCK_TYPE, "", b"")
            self._clock = self._make_writer(
                Channel(0, self._clock_topic, "cdr", schema, {}), CLOCK_QOS
            )
        self._clock.write(b"\0\1\0\0" + struct.pack("<iI", *divmod(time_ns, _NS)))

    def subscribers(self, channel: Channel) -> int:
        """How many subscribers a channel's topic has now."""
        return self._channels[id(channel)][1].subscribers()

    def _part(self) -> None:
        """Wait until subscribers have what was sent, as long as they may take."""
        patience = self._options.parting_s
        end = time.monotonic() + (_PARTING_S if patience is None else patience)
        late: set[str] = set()
        for channel, writer in self._channels.values():
            if channel.topic not in late and not writer.wait(max(0.0, end - time.monotonic())):
                late.add(channel.topic)
        if late:
            topics = ", ".join(sorted(late))
            warnings.warn(
                f"{topics}: subscribers have not acknowledged every message in time", stacklevel=2
            )
        self._channels.clear()
        self._shared.clear()
        self._clock = None

    # ------------------------------------------------------------ receiving

    def follow_clock(self, on_time: Callable[[int], None]) -> None:
        """Subscribe to /clock."""

        def on_message(data: bytes, _: int) -> None:
            sec, nanosec = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
            on_time(int(sec) * _NS + int(nanosec))

        self._read(self._clock_topic, CLOCK_TYPE, CLOCK_QOS, on_message)

    def follow(self, topic: str, follower: Follower) -> None:
        """Subscribe as soon as the topic has a publisher."""
        if not is_topic(topic):
            raise OptionError(f"{topic!r} is not a valid ROS 2 topic name.")
        self._start(self._seek, topic, follower)

    def _seek(self, topic: str, follower: Follower) -> None:
        known: set[str] = set()
        while not self._ended.wait(_LOOK_S):
            for kind in {*self._kinds_of(topic)} - known:
                known.add(kind)
                channel, qos = self._channel(topic, kind, topic)
                qos = replace(qos, durability="volatile")  # no message of the past
                take = follower(channel)
                try:
                    self._read(topic, kind, qos, partial(_first_of, take))
                except (Refused, ConversionError) as error:  # perhaps because of another type
                    self._complain(f"{topic}: {error}")

    def subscribe(self, topic: str, kind: str, name: str, receive: Receive) -> Channel:
        """Subscribe with the QoS that the publishers offer, on a channel as rosbag2 records it."""
        channel, asked = self._channel(topic, kind, name)
        qos = self._overrides.get(topic) or asked
        try:
            self._received[topic] = self._read(topic, kind, qos, partial(receive, channel))
        except ConversionError as error:
            raise Refused(error.problem) from None
        return channel

    def _channel(self, topic: str, kind: str, name: str) -> tuple[Channel, Qos]:
        """The channel of a topic that others publish, and the QoS that hears all of them."""
        offered, type_hash, definition = self._announced(topic, kind)
        schema = Schema(kind, _ENCODING if definition else "", definition.encode())
        metadata = {QOS_KEY: qos_text(offered), **({HASH_KEY: type_hash} if type_hash else {})}
        return Channel(len(self._received), name, "cdr", schema, metadata), asked_qos(offered)


def _first_of(take: Callable[[bytes], object], data: bytes, _: int) -> None:
    take(data)


def is_topic(name: str) -> bool:
    """Whether ROS 2 can have a topic of this name."""
    return _TOPIC.fullmatch(name) is not None and "__" not in name


def is_hidden(topic: str) -> bool:
    """Whether ROS 2 hides a topic: a part of its name begins with an underscore.

    For recorders, service events are not hidden.
    """
    return not topic.endswith(SERVICE_EVENTS) and any(
        part.startswith("_") for part in topic.split("/")
    )


def finite(nanoseconds: int) -> int | None:
    """A duration of a QoS profile; None if it is infinite or unspecified."""
    return nanoseconds if 0 < nanoseconds < 2**63 - 1 else None


# ---------------------------------------------------------------- quality of service

_MAX_DEPTH = 2**31 - 1
_RECEIVED = 300  # depth of a subscription: 10 s of a camera, if what takes messages out hangs
_INFINITE_SECONDS = 2**31 - 1  # the smallest of the values that middlewares use for infinity
_INFINITE = {"sec": 2**63 // _NS, "nsec": 2**63 % _NS - 1}
_NAMES = {
    "history": ("keep_last", "keep_all"),
    "reliability": ("reliable", "best_effort"),
    "durability": ("volatile", "transient_local"),
    "liveliness": ("automatic", "manual_by_node", "manual_by_topic"),
}
DURATIONS = ("deadline", "lifespan", "liveliness_lease_duration")
"""The policies of `Qos` that are durations."""


@dataclass(frozen=True, slots=True)
class Qos:
    """The QoS profile that a publisher offers; the defaults are those of `ros2 bag play`.

    Its fields are the policies, with the names and in the order that rosbag2 and rclpy have.

    Attributes:
        history: ``keep_last`` or ``keep_all``.
        depth: How many messages ``keep_last`` keeps, at least 1.
        reliability: ``reliable`` or ``best_effort``.
        durability: ``volatile`` or ``transient_local``.
        deadline: Maximum nanoseconds between two messages; None for no limit.
        lifespan: Nanoseconds after which a message expires; None for never.
        liveliness: ``automatic``, ``manual_by_node`` or ``manual_by_topic``.
        liveliness_lease_duration: Nanoseconds after which a silent publisher is considered dead;
            None for never.
        avoid_ros_namespace_conventions: Whether the topic's DDS name has no ``rt/`` prefix.
    """

    history: str = "keep_last"
    depth: int = PLAYER_DEPTH
    reliability: str = "reliable"
    durability: str = "volatile"
    deadline: int | None = None
    lifespan: int | None = None
    liveliness: str = "automatic"
    liveliness_lease_duration: int | None = None
    avoid_ros_namespace_conventions: bool = False

    @property
    def is_reliable(self) -> bool:
        """Whether lost messages are resent."""
        return self.reliability == "reliable"

    @property
    def is_latched(self) -> bool:
        """Whether late subscribers get earlier messages."""
        return self.durability == "transient_local"


_POLICIES = tuple(policy.name for policy in fields(Qos))

CLOCK_QOS = Qos(depth=1, reliability="best_effort")
"""The profile of /clock, rclcpp's ClockQoS."""


def offered_qos(channel: Channel, overrides: Mapping[str, Qos]) -> Qos:
    """The profile that a player offers for a channel, chosen as by `ros2 bag play`.

    It is that of the overrides; else the recorded one, if those of all recorded publishers are the
    same to subscribers; else the default. For a latched topic, the depth is the number of messages
    that all publishers kept together, since that is what late subscribers get.

    Args:
        channel: The channel, with the recorded profiles in its metadata.
        overrides: Topic -> profile to offer instead.
    """
    if channel.topic in overrides:
        return overrides[channel.topic]
    profiles = recorded_qos(channel.metadata.get(QOS_KEY, ""))
    unseen: dict[str, Any] = {
        "lifespan": None,
        "avoid_ros_namespace_conventions": False,
    }  # by subscribers
    unseen |= {"history": "keep_last", "depth": PLAYER_DEPTH}
    if len({replace(profile, **unseen) for profile in profiles}) != 1:
        return Qos()
    depth = latched_depth(channel) if profiles[0].is_latched else PLAYER_DEPTH
    return replace(profiles[0], history="keep_last", depth=depth)


def asked_qos(profiles: Sequence[Qos]) -> Qos:
    """The QoS that matches all publishers, chosen as rosbag2 does; the default if there are none.

    Args:
        profiles: What the publishers offer.
    """
    return Qos(
        depth=_RECEIVED,
        reliability="reliable" if all(one.is_reliable for one in profiles) else "best_effort",
        durability="transient_local"
        if profiles and all(one.is_latched for one in profiles)
        else "volatile",
        avoid_ros_namespace_conventions=any(
            one.avoid_ros_namespace_conventions for one in profiles
        ),
    )


def qos_text(profiles: Sequence[Qos]) -> str:
    """QoS profiles as rosbag2 writes them from metadata version 9 on."""
    return dump_yaml([{key: _written(profile, key) for key in _POLICIES} for profile in profiles])


def _written(profile: Qos, key: str) -> Any:
    value = getattr(profile, key)
    if key not in DURATIONS:
        return value
    return dict(_INFINITE) if value is None else {"sec": value // _NS, "nsec": value % _NS}


def recorded_qos(text: str) -> tuple[Qos, ...]:
    """The profiles that the publishers of a topic offered when it was recorded.

    Policies that are unknown or system defaults become the defaults of `Qos`; a text that is not a
    list of profiles has none.

    Args:
        text: YAML as rosbag2 of metadata versions 2 to 9 writes it.
    """
    profiles = []
    for profile in native_qos(text):
        has_depth = profile.get("history") == "keep_last" and profile.get("depth") != 0
        found: dict[str, Any] = {}
        for key in _POLICIES:
            if key in profile and (key != "depth" or has_depth):
                with suppress(ValueError):
                    found[key] = _policy(key, profile[key])
        profiles.append(Qos(**found))
    return tuple(profiles)


def load_overrides(path: Path | None) -> dict[str, Qos]:
    """Read a file for `--qos-profile-overrides-path`, in the format of `ros2 bag play`.

    Args:
        path: The file; None for no overrides.

    Returns:
        Topic -> its profile; policies that the file leaves out have the default.

    Raises:
        OptionError: It cannot be read or is not valid; names the key.
    """
    if path is None:
        return {}
    overrides = {}
    for topic, profile in load_map(path, "topics to QoS profiles").items():
        if not isinstance(topic, str):
            raise OptionError(f"{path}: {topic!r} is not a topic name; put it in quotes.")
        if not isinstance(profile, dict):
            problem = "is not a QoS profile; list policies such as depth: 1."
            raise OptionError(f"{path}: {topic}: {problem}")
        found: dict[str, Any] = {}
        for key, value in profile.items():
            try:
                found[key] = _policy(key, value)
            except ValueError as reason:
                raise OptionError(f"{path}: {topic}: {key}: {reason}.") from None
        overrides[topic] = Qos(**found)
    return overrides


def _policy(key: str, value: Any) -> Any:
    """The value of a policy of `Qos`.

    Raises:
        ValueError: It is none; says why.
    """
    if key in _NAMES:
        names = _NAMES[key]
        name = value.lower() if isinstance(value, str) else value
        if name != "system_default" and name not in names:
            raise ValueError(f"{value!r} is not known. Use {', '.join(names)}")
        return names[0] if name == "system_default" else name
    if key in DURATIONS:
        return _duration(value)
    if key == "depth":
        if type(value) is not int or not 0 <= value <= _MAX_DEPTH:
            raise ValueError(f"{value!r} is not an integer from 0 to {_MAX_DEPTH}")
        return max(1, value)
    if key not in _POLICIES:
        raise ValueError(f"is not a QoS policy. Use {', '.join(_POLICIES)}")
    if not isinstance(value, bool):
        raise ValueError(f"{value!r} is neither true nor false")
    return value


def _duration(value: Any) -> int | None:
    """Nanoseconds; None if it is infinite or, as 0 is in ROS, unspecified."""
    if value is None or value == {}:
        return None
    if not isinstance(value, dict) or set(value) != {"sec", "nsec"}:
        raise ValueError("is not a duration; give sec and nsec")
    sec, nsec = value["sec"], value["nsec"]
    if type(sec) is not int or type(nsec) is not int or sec < 0 or nsec < 0:
        raise ValueError("sec and nsec have to be integers, 0 or more")
    return None if sec >= _INFINITE_SECONDS else (sec * _NS + nsec or None)


# ---------------------------------------------------------------- definitions of types

_ENCODING = "ros2msg"
_MAX_TEXT = 2**22
_FIELD = re.compile(r"^\s*([A-Za-z][\w/]*)(?:<=\d+)?(?:\[[^\]]*\])?\s+\w+")
_PRIMITIVE = re.compile(r"bool|byte|char|u?int(?:8|16|32|64)|float(?:32|64)|w?string")
_HASH = re.compile(r"RIHS01_[0-9a-f]{64}")


@cache
def standard_types() -> dict[str, Any]:
    """The types of a recent ROS 2, for publishers and recordings that do not define them."""
    return ros2_types("jazzy")


def full_name(name: str) -> str:
    """The full name of a type: ``std_msgs/String`` is short for ``std_msgs/msg/String``."""
    rooms = name.split("/")
    return f"{rooms[0]}/msg/{rooms[1]}" if len(rooms) == 2 else name


def types_in(schema: Schema | None) -> dict[str, Any]:
    """Definitions of a type and its parts; those without fields have the one that ROS 2 adds.

    Raises:
        Refused: There is no definition, or it cannot be parsed.
    """
    if schema is None:
        raise Refused("there is no definition")
    filler = standard_types()["std_msgs/msg/Empty"][1][0]
    return {
        name: (constants, fields or [filler])
        for name, (constants, fields) in types_of(schema, standard_types()).items()
    }


def hash_of(types: Mapping[str, Any], name: str) -> str:
    """The hash of a type, RIHS01_...

    Raises:
        Refused: ROS 2 cannot have this type.
    """
    hashed = make_store(dict(types), standard_types()).hash_rihs01
    return by_library(incomprehensible(name), hashed, name)


def recorded_hash(channel: Channel) -> str:
    """The hash of a channel's type, as recorded or of its definition; empty if it has none."""
    recorded = channel.metadata.get(HASH_KEY, "")
    if _HASH.fullmatch(recorded):
        return recorded
    try:
        return hash_of(types_in(channel.schema), full_name(channel.type_name))
    except (Refused, KeyError):
        return ""


def standard_definition(type_name: str, type_hash: str) -> str:
    """The definition of a standard type; empty if it is not one, or its hash differs.

    Args:
        type_name: Such as ``sensor_msgs/msg/Image``.
        type_hash: As announced by the publisher; empty if it announced none.
    """
    if type_name not in standard_types():
        return ""
    return _proven(Schema(type_name, _ENCODING, b""), type_hash)


def described_definition(texts: Mapping[str, str], type_name: str, type_hash: str) -> str:
    """The definition of a type as described by a node or a publisher.

    Args:
        texts: Definitions of the type and its parts, by type.
        type_name: The type.
        type_hash: As announced by the publisher, which the definition must have.

    Returns:
        The text, with the definitions of its parts; empty if it is not proven by the hash.
    """
    if not type_hash or type_name not in texts or sum(map(len, texts.values())) > _MAX_TEXT:
        return ""
    text = _with_parts({type_name: texts[type_name], **texts})
    return text if _proven(Schema(type_name, _ENCODING, text.encode()), type_hash) else ""


def _proven(schema: Schema, type_hash: str) -> str:
    """A definition with those of its parts; empty if its hash is not the one announced."""
    try:
        if type_hash and hash_of(types_in(schema), schema.name) != type_hash:
            return ""
        store: Any = make_store(types_of(schema, standard_types()), standard_types())
        text: str = by_library("", store.generate_msgdef, schema.name)[0]
        return text
    except Refused:
        return ""


def installed_definition(type_name: str, share: Sequence[Path]) -> str:
    """The installed definition of a type, with those of its parts, as rosbag2 stores it.

    Args:
        type_name: Such as ``sensor_msgs/msg/Image``.
        share: The ``share`` folders of all workspaces.

    Returns:
        The text; empty if a part is not installed as a ``.msg`` file.
    """
    found: dict[str, str] = {}
    todo = [type_name]
    while todo:
        name = todo.pop(0)
        if name in found:
            continue
        package, _, short = name.partition("/msg/")
        paths = [folder / package / "msg" / f"{short}.msg" for folder in share]
        text = next((path.read_text() for path in paths if path.is_file()), None)
        if text is None:
            return ""
        found[name] = text
        todo += _parts(text, package)
    return _with_parts(found)


def _with_parts(texts: Mapping[str, str]) -> str:
    """A definition followed by those of its parts; the first text is the type's own."""
    main, *parts = texts.items()
    line = "=" * 80
    rest = (f"\n{line}\nMSG: {name.replace('/msg/', '/')}\n{text}" for name, text in parts)
    return "".join((main[1], *rest))


def _parts(text: str, package: str) -> Iterator[str]:
    """Types of a definition's fields, except for built-in ones."""
    for line in text.splitlines():
        match = _FIELD.match(line.partition("#")[0])
        if match and not _PRIMITIVE.fullmatch(match[1]):
            rooms = match[1].split("/")
            yield f"{rooms[0] if len(rooms) > 1 else package}/msg/{rooms[-1]}"
