"""Quality of service in ROS 2: as recorded, as offered by a player, as asked for by a recorder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import yaml

from mp4ds.bags.latched import PLAYER_DEPTH, latched_depth
from mp4ds.bags.rosbag2_metadata import dump_yaml, native_qos
from mp4ds.errors import OptionError
from mp4ds.records import QOS_KEY, Channel

_NS = 10**9
_MAX_DEPTH = 2**31 - 1
_RECEIVED = 300  # depth of a subscription: 10 s of a camera, if what takes messages out hangs
_MAX_BYTES = 2**20
_Loader: type[Any] = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
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


# ---------------------------------------------------------------- as text


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
