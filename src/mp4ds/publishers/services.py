"""The services that `ros2 bag play` offers, as rosbag2_interfaces of ROS 2 Jazzy defines them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from mp4ds.publishers.protocol import Controls

_NOTHING = "uint8 structure_needs_at_least_one_member"
_SUCCESS = "bool success"
_SECOND = 10**9


@dataclass(frozen=True, slots=True)
class Service:
    """A service of the player.

    Attributes:
        name: Its name below the node.
        kind: Its type in ``rosbag2_interfaces/srv``.
        request: Definition of a request.
        response: Definition of a response.
        answer: Does what a request asks; returns the fields of the response.
    """

    name: str
    kind: str
    request: str
    response: str
    answer: Callable[[Controls, Any], Mapping[str, Any]]


def _pause(controls: Controls, _: Any) -> Mapping[str, Any]:
    controls.pause()
    return {}


def _resume(controls: Controls, _: Any) -> Mapping[str, Any]:
    controls.resume()
    return {}


def _toggle_paused(controls: Controls, _: Any) -> Mapping[str, Any]:
    controls.toggle_paused()
    return {}


def _is_paused(controls: Controls, _: Any) -> Mapping[str, Any]:
    return {"paused": controls.is_paused}


def _get_rate(controls: Controls, _: Any) -> Mapping[str, Any]:
    return {"rate": controls.rate}


def _set_rate(controls: Controls, request: Any) -> Mapping[str, Any]:
    return {"success": controls.set_rate(request.rate)}


def _play_next(controls: Controls, _: Any) -> Mapping[str, Any]:
    return {"success": controls.play_next()}


def _burst(controls: Controls, request: Any) -> Mapping[str, Any]:
    return {"actually_burst": controls.burst(request.num_messages)}


def _seek(controls: Controls, request: Any) -> Mapping[str, Any]:
    time_ns = request.time.sec * _SECOND + request.time.nanosec
    return {"success": controls.seek(time_ns)}


def _stop(controls: Controls, _: Any) -> Mapping[str, Any]:
    controls.stop()
    return {}


PLAYER_SERVICES = (
    Service("pause", "Pause", _NOTHING, _NOTHING, _pause),
    Service("resume", "Resume", _NOTHING, _NOTHING, _resume),
    Service("toggle_paused", "TogglePaused", _NOTHING, _NOTHING, _toggle_paused),
    Service("is_paused", "IsPaused", _NOTHING, "bool paused", _is_paused),
    Service("get_rate", "GetRate", _NOTHING, "float64 rate", _get_rate),
    Service("set_rate", "SetRate", "float64 rate", _SUCCESS, _set_rate),
    Service("play_next", "PlayNext", _NOTHING, _SUCCESS, _play_next),
    Service("burst", "Burst", "uint64 num_messages", "uint64 actually_burst", _burst),
    Service("seek", "Seek", "builtin_interfaces/Time time", _SUCCESS, _seek),
    Service("stop", "Stop", _NOTHING, _NOTHING, _stop),
)
"""All but ``play``, which starts a playback where none is running."""
