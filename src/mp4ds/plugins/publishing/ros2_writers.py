"""What both ROS 2 publishers share: writers of channels, QoS profiles, the player's services."""

from __future__ import annotations

import struct
import warnings
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import yaml

from mp4ds.bags.latched import PLAYER_DEPTH, latched_depth
from mp4ds.bags.rosbag2_metadata import native_qos
from mp4ds.errors import ConversionError, OptionError
from mp4ds.plugins.publishing.publisher import Controls
from mp4ds.records import QOS_KEY, Channel

NOTHING = "uint8 structure_needs_at_least_one_member"
_SUCCESS = "bool success"
_PLAY = (
    "builtin_interfaces/Time start_offset\nbuiltin_interfaces/Duration playback_duration\n"
    "builtin_interfaces/Time playback_until_timestamp"
)
_SECOND = 10**9


@dataclass(frozen=True, slots=True)
class Service:
    """A service of a player or recorder.

    Attributes:
        name: Its name below the node.
        kind: Its type in ``rosbag2_interfaces/srv``.
        request: Definition of a request.
        response: Definition of a response.
        answer: Called with the controls and a request; carries it out, and returns the fields of
            the response.
    """

    name: str
    kind: str
    request: str
    response: str
    answer: Callable[[Any, Any], Mapping[str, Any]]


class Pausable(Protocol):
    """A player or recorder, which can be paused."""

    @property
    def is_paused(self) -> bool:
        """Whether it is paused."""
        ...

    def pause(self) -> object:
        """Pause it."""
        ...

    def resume(self) -> object:
        """Resume it."""
        ...


def pause(controls: Pausable, _: Any) -> Mapping[str, Any]:
    """Pause as requested."""
    controls.pause()
    return {}


def resume(controls: Pausable, _: Any) -> Mapping[str, Any]:
    """Resume as requested."""
    controls.resume()
    return {}


def _toggle_paused(controls: Controls, _: Any) -> Mapping[str, Any]:
    controls.toggle_paused()
    return {}


def is_paused(controls: Pausable, _: Any) -> Mapping[str, Any]:
    """Report whether it is paused."""
    return {"paused": controls.is_paused}


def _get_rate(controls: Controls, _: Any) -> Mapping[str, Any]:
    return {"rate": controls.rate}


def _set_rate(controls: Controls, request: Any) -> Mapping[str, Any]:
    return {"success": controls.set_rate(request.rate)}


def _play_next(controls: Controls, _: Any) -> Mapping[str, Any]:
    return {"success": controls.play_next()}


def _burst(controls: Controls, request: Any) -> Mapping[str, Any]:
    return {"actually_burst": controls.burst(request.num_messages)}


def _play(controls: Controls, request: Any) -> Mapping[str, Any]:
    start = controls.start_ns + _nanoseconds(request.start_offset)
    length, until = map(_nanoseconds, (request.playback_duration, request.playback_until_timestamp))
    # clients that leave out an end send 0
    ends = [
        time for time, is_given in ((start + length, length > 0), (until, until > 0)) if is_given
    ]
    return {"success": controls.play(start, max(ends, default=None))}


def _seek(controls: Controls, request: Any) -> Mapping[str, Any]:
    controls.seek(_nanoseconds(request.time))
    return {"success": True}


def _nanoseconds(time: Any) -> int:
    return int(time.sec * _SECOND + time.nanosec)


def _stop(controls: Controls, _: Any) -> Mapping[str, Any]:
    controls.stop()
    return {}


PLAYER_SERVICES = (
    Service("pause", "Pause", NOTHING, NOTHING, pause),
    Service("resume", "Resume", NOTHING, NOTHING, resume),
    Service("toggle_paused", "TogglePaused", NOTHING, NOTHING, _toggle_paused),
    Service("is_paused", "IsPaused", NOTHING, "bool paused", is_paused),
    Service("get_rate", "GetRate", NOTHING, "float64 rate", _get_rate),
    Service("set_rate", "SetRate", "float64 rate", _SUCCESS, _set_rate),
    Service("play_next", "PlayNext", NOTHING, _SUCCESS, _play_next),
    Service("burst", "Burst", "uint64 num_messages", "uint64 actually_burst", _burst),
    Service("play", "Play", _PLAY, _SUCCESS, _play),
    Service("seek", "Seek", "builtin_interfaces/Time time", _SUCCESS, _seek),
    Service("stop", "Stop", NOTHING, NOTHING, _stop),
)
"""The services of `ros2 bag play`. They respond when the request has been carried out."""


# ---------------------------------------------------------------- QoS

_MAX_BYTES = 2**20
_MAX_DEPTH = 2**31 - 1
_INFINITE_SECONDS = 2**31 - 1  # the smallest of the values that middlewares use for infinity
_NAMES = {
    "history": ("keep_last", "keep_all"),
    "reliability": ("reliable", "best_effort"),
    "durability": ("volatile", "transient_local"),
    "liveliness": ("automatic", "manual_by_node", "manual_by_topic"),
}
_DURATIONS = {
    "deadline": "deadline_ns",
    "lifespan": "lifespan_ns",
    "liveliness_lease_duration": "lease_ns",
}
_BARE = "avoid_ros_namespace_conventions"
_Loader: type[Any] = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@dataclass(frozen=True, slots=True)
class Qos:
    """The QoS profile that a publisher offers; the defaults are those of `ros2 bag play`.

    Attributes:
        history: ``keep_last`` or ``keep_all``.
        depth: How many messages ``keep_last`` keeps, at least 1.
        reliability: ``reliable`` or ``best_effort``.
        durability: ``volatile`` or ``transient_local``.
        deadline_ns: Maximum nanoseconds between two messages; None for no limit.
        lifespan_ns: Nanoseconds after which a message expires; None for never.
        liveliness: ``automatic``, ``manual_by_node`` or ``manual_by_topic``.
        lease_ns: Nanoseconds after which a silent publisher is considered dead; None for never.
        avoid_ros_namespace_conventions: Whether the topic's DDS name has no ``rt/`` prefix.
    """

    history: str = "keep_last"
    depth: int = PLAYER_DEPTH
    reliability: str = "reliable"
    durability: str = "volatile"
    deadline_ns: int | None = None
    lifespan_ns: int | None = None
    liveliness: str = "automatic"
    lease_ns: int | None = None
    avoid_ros_namespace_conventions: bool = False

    @property
    def is_reliable(self) -> bool:
        """Whether lost messages are resent."""
        return self.reliability == "reliable"

    @property
    def is_latched(self) -> bool:
        """Whether late subscribers get earlier messages."""
        return self.durability == "transient_local"


CLOCK_QOS = Qos(depth=1, reliability="best_effort")
"""The profile of /clock, rclcpp's ClockQoS."""


def recorded_qos(text: str) -> tuple[Qos, ...]:
    """The profiles that the publishers of a topic offered when it was recorded.

    Policies that are unknown or system defaults become the defaults of `Qos`; a text that is not a
    list of profiles has none.

    Args:
        text: YAML as rosbag2 of metadata versions 2 to 9 writes it.
    """
    return tuple(_recorded(profile) for profile in native_qos(text))


def _recorded(profile: Mapping[str, Any]) -> Qos:
    found: dict[str, Any] = {}
    for key, names in _NAMES.items():
        name = profile.get(key)
        found[key] = name if isinstance(name, str) and name in names else names[0]
    for key, attribute in _DURATIONS.items():
        found[attribute] = _recorded_duration(profile.get(key))
    depth = profile.get("depth")
    if type(depth) is int and depth > 0 and profile.get("history") == "keep_last":
        found["depth"] = min(depth, _MAX_DEPTH)
    return Qos(**found, avoid_ros_namespace_conventions=profile.get(_BARE) is True)


def _recorded_duration(value: Any) -> int | None:
    parts = value if isinstance(value, dict) else {}
    sec, nsec = parts.get("sec"), parts.get("nsec")
    if type(sec) is not int or type(nsec) is not int or sec < 0 or nsec < 0:
        return None
    return _duration(sec, nsec)


def _duration(sec: int, nsec: int) -> int | None:
    """Nanoseconds; None if it is infinite or, as 0 is in ROS, unspecified."""
    return None if sec >= _INFINITE_SECONDS else (sec * _SECOND + nsec or None)


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
    if len({_as_subscribers_see(profile) for profile in profiles}) != 1:
        return Qos()
    depth = latched_depth(channel) if profiles[0].is_latched else PLAYER_DEPTH
    return replace(profiles[0], history="keep_last", depth=depth)


def _as_subscribers_see(qos: Qos) -> Qos:
    return replace(
        qos,
        history="keep_last",
        depth=PLAYER_DEPTH,
        lifespan_ns=None,
        avoid_ros_namespace_conventions=False,
    )


def load_overrides(path: Path) -> dict[str, Qos]:
    """Read a file for `--qos-profile-overrides-path`, in the format of `ros2 bag play`.

    Returns:
        Topic -> its profile; policies that the file leaves out have the default.

    Raises:
        OptionError: It cannot be read or is not valid; names the key.
    """
    document = load_map(path, "topics to QoS profiles")
    return {_topic(path, topic): _override(path, topic, value) for topic, value in document.items()}


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
    if len(data) > _MAX_BYTES:
        raise OptionError(f"{path}: is larger than {_MAX_BYTES} bytes, too large to map {of}.")
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


def _topic(path: Path, topic: Any) -> str:
    if not isinstance(topic, str):
        raise OptionError(f"{path}: {topic!r} is not a topic name; put it in quotes.")
    return topic


def _override(path: Path, topic: Any, profile: Any) -> Qos:
    if not isinstance(profile, dict):
        raise OptionError(f"{path}: {topic}: is not a QoS profile; list policies such as depth: 1.")
    found: dict[str, Any] = {}
    for key, value in profile.items():
        place = f"{path}: {topic}: {key}"
        if key in _NAMES:
            found[key] = _name(place, value, _NAMES[key])
        elif key in _DURATIONS:
            found[_DURATIONS[key]] = _override_duration(place, value)
        elif key == "depth":
            found[key] = max(1, _whole(place, value))
        elif key == _BARE:
            found[key] = _flag(place, value)
        else:
            known = ", ".join((*_NAMES, "depth", *_DURATIONS, _BARE))
            raise OptionError(f"{place}: is not a QoS policy. Use {known}.")
    return Qos(**found)


def _name(place: str, value: Any, names: tuple[str, ...]) -> str:
    name = value.lower() if isinstance(value, str) else value
    if name == "system_default":
        return names[0]
    if name not in names:
        raise OptionError(f"{place}: {value!r} is not known. Use {', '.join(names)}.")
    return str(name)


def _whole(place: str, value: Any) -> int:
    if type(value) is not int or not 0 <= value <= _MAX_DEPTH:
        raise OptionError(f"{place}: {value!r} is not an integer from 0 to {_MAX_DEPTH}.")
    return value


def _flag(place: str, value: Any) -> bool:
    if not isinstance(value, bool):
        raise OptionError(f"{place}: {value!r} is neither true nor false.")
    return value


def _override_duration(place: str, value: Any) -> int | None:
    if value is None or value == {}:
        return None
    if not isinstance(value, dict) or set(value) != {"sec", "nsec"}:
        raise OptionError(f"{place}: is not a duration; give sec and nsec.")
    sec, nsec = value["sec"], value["nsec"]
    if type(sec) is not int or type(nsec) is not int or sec < 0 or nsec < 0:
        raise OptionError(f"{place}: sec and nsec have to be integers, 0 or more.")
    return _duration(sec, nsec)


# ---------------------------------------------------------------- writers

CLOCK = "/clock"
CLOCK_TYPE = "rosgraph_msgs/msg/Clock"
PARTING_S = 3.0
"""Seconds to wait at the end for acknowledgements."""

_LITTLE = b"\0\1\0\0"
_TIME = struct.Struct("<iI")
_Writer = TypeVar("_Writer")


def clock_message(time_ns: int) -> bytes:
    """A message of /clock, in CDR."""
    return _LITTLE + _TIME.pack(*divmod(time_ns, 10**9))


class Writers(Generic[_Writer]):
    """The writers of advertised channels.

    Channels with the same topic, type and QoS share a writer; latched ones have one each, so that
    late subscribers get the last message of each, as from the recorded publishers.

    Args:
        overrides: Topic -> QoS profile to offer instead of the recorded one.
    """

    def __init__(self, overrides: Mapping[str, Qos]) -> None:
        self._overrides = dict(overrides)
        self._channels: dict[int, tuple[Channel, _Writer]] = {}
        self._shared: dict[tuple[str, Hashable, Qos], _Writer] = {}

    def add(self, channel: Channel, kind: Hashable, make: Callable[[Qos], _Writer]) -> None:
        """Add a channel, with a writer of its own or a shared one.

        Args:
            channel: The channel.
            kind: Identifies its type.
            make: Creates a writer for it.

        Raises:
            ConversionError: Its messages are not in CDR.
        """
        if id(channel) in self._channels:
            return
        if channel.message_encoding != "cdr":
            encoding = channel.message_encoding or "unknown"
            raise ConversionError(channel.topic, f"its message encoding is {encoding}, not cdr")
        qos = offered_qos(channel, self._overrides)
        key = (channel.topic, kind, qos)
        writer = None if qos.is_latched else self._shared.get(key)
        if writer is None:
            writer = self._shared[key] = make(qos)
        self._channels[id(channel)] = channel, writer

    def __getitem__(self, channel: Channel) -> _Writer:
        return self._channels[id(channel)][1]

    def wait(self, is_acknowledged: Callable[[_Writer], bool], *, warns: bool) -> None:
        """Wait for subscribers to acknowledge what was sent.

        Args:
            is_acknowledged: Waits for those of a writer; returns whether they did so in time.
            warns: Whether to name the topics of which they did not.
        """
        found = {id(writer): (channel.topic, writer) for channel, writer in self._channels.values()}
        late = sorted({topic for topic, writer in found.values() if not is_acknowledged(writer)})
        if late and warns:
            warnings.warn(
                f"{', '.join(late)}: subscribers have not acknowledged every message in time",
                stacklevel=2,
            )

    def clear(self) -> None:
        """Release all writers."""
        self._channels.clear()
        self._shared.clear()
