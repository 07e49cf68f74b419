"""Where messages are published: ROS 1, ROS 2, Foxglove. The only package that imports these."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path

from mp4ds.errors import OptionError, PublishError
from mp4ds.publishers.protocol import Controls, Publisher

__all__ = ["WORLDS", "Controls", "Publisher", "open_publisher", "sourced"]

WORLDS: Mapping[str, str | None] = {"ros1": "ros1", "ros2": "ros2", "foxglove": None}
"""What can be published to, and what messages have to be in there; None: as recorded."""

_PATIENCE_S = 2.0


def sourced() -> str:
    """What is sourced here: ``ros1`` or ``ros2``.

    Raises:
        PublishError: Neither is.
    """
    version = os.environ.get("ROS_VERSION")
    if version in ("1", "2"):
        return f"ros{version}"
    for module, kind in (("rclpy", "ros2"), ("rospy", "ros1"), ("cyclonedds", "ros2")):
        if find_spec(module) is not None:
            return kind
    raise PublishError(
        "play",
        "no ROS is sourced here: source its setup file, or name what to play into: --ros1, "
        "--ros2 (without ROS by pip install 'mp4ds[dds]') or --foxglove",
    )


def open_publisher(
    kind: str,
    *,
    qos_overrides: Path | None = None,
    host: str = "127.0.0.1",
    port: int = 8765,
    origins: Sequence[str] = (),
    span: tuple[int, int] | None = None,
    is_paced: bool = True,
) -> Publisher:
    """Join what is to be published to.

    Args:
        kind: One of `WORLDS`.
        qos_overrides: A YAML file of QoS profiles by topic, for ROS 2.
        host: Address to listen on, for Foxglove.
        port: Port to listen on, for Foxglove.
        origins: Web sites that may connect, for Foxglove.
        span: Log times of the first and the last message, nanoseconds.
        is_paced: Whether messages come at their times; else slow subscribers are waited for where
            that is possible, which is in ROS 1.

    Raises:
        OptionError: There is no such kind, or the file of QoS profiles makes no sense.
        PublishError: It is not there: a library, a master, a free port.
    """
    if kind not in WORLDS:
        raise OptionError(f"cannot play into {kind!r}. Use {', '.join(WORLDS)}.")
    if qos_overrides is not None and kind != "ros2":
        raise OptionError("--qos-profile-overrides-path goes with --ros2.")
    if kind == "ros1":
        from mp4ds.publishers.ros1 import RospyPublisher

        # what waits is bounded by its bytes: a hundred small messages are a moment
        return RospyPublisher(queue_size=0, wait_s=0.0 if is_paced else _PATIENCE_S)
    if kind == "foxglove":
        from mp4ds.publishers.foxglove import FoxglovePublisher

        return FoxglovePublisher(host=host, port=port, origins=origins, span=span)
    from mp4ds.publishers.qos import load_overrides

    overrides = load_overrides(qos_overrides) if qos_overrides is not None else {}
    if find_spec("rclpy") is not None:
        from mp4ds.publishers.ros2 import RclpyPublisher

        return RclpyPublisher(overrides=overrides)
    from mp4ds.publishers.dds import DdsPublisher

    return DdsPublisher(overrides=overrides)
