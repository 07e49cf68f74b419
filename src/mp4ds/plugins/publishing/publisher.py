"""What ROS 1 and ROS 2 publishers have in common, and how to open one."""

from __future__ import annotations

import os
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Protocol

from mp4ds.errors import OptionError, PublishError
from mp4ds.plugins.publishing.names import PLAIN, NodeNames
from mp4ds.records import Channel


class Controls(Protocol):
    """Remote controls of a player, for services or keys; called from any thread."""

    @property
    def is_paused(self) -> bool:
        """Whether playback is paused."""

    @property
    def rate(self) -> float:
        """Seconds of the recording per second."""

    def pause(self) -> None:
        """Pause playback."""

    def resume(self) -> None:
        """Resume playback."""

    def toggle_paused(self) -> None:
        """Pause or resume playback."""

    def set_rate(self, rate: float) -> bool:
        """Change the playback rate; returns False if it is not greater than 0."""

    def play_next(self) -> bool:
        """While paused, publish the next message; returns, afterwards, whether there was one."""

    def burst(self, messages: int) -> int:
        """While paused, publish this many messages as fast as possible; 0: all that are left.

        Returns, afterwards, how many there were.
        """

    def step_back(self) -> bool:
        """While paused, go back by one message; returns whether it was published."""

    def seek(self, time_ns: int) -> int:
        """Continue at a recording time, or the nearest that is played; returns that time."""

    def play(self, start_ns: int, end_ns: int | None) -> bool:
        """Play an interval, if the player is waiting at the end; returns whether it does.

        Args:
            start_ns: First recording time.
            end_ns: Last recording time; None for the end.
        """

    def toggle_topic_pauses(self) -> None:
        """Turn pausing before messages on chosen topics off, or on again."""

    @property
    def start_ns(self) -> int:
        """Log time of the first message of the recording."""

    def stop(self) -> None:
        """Stop playback, and end."""


class Publisher(Protocol):
    """Publishes messages. A context manager; used by one thread.

    Attributes:
        world: What messages are to be converted to: ``ros1`` or ``ros2``; None: as recorded.
    """

    world: str | None

    @property
    def address(self) -> str:
        """Where it publishes, for display: a URL, or which ROS."""

    def advertise(self, channel: Channel) -> None:
        """Announce a channel before its first message. Several channels may have one topic.

        Latching (ROS 1) and QoS (ROS 2) are those of its metadata.

        Raises:
            Refused: Its message type is not installed.
            ConversionError: It cannot be published; names the topic.
            PublishError: The connection is lost.
        """

    def publish(self, channel: Channel, payload: bytes | memoryview, time_ns: int) -> None:
        """Publish a message of an advertised channel.

        Args:
            channel: The same object that was advertised.
            payload: The serialized message; not kept after the call.
            time_ns: Recording time, nanoseconds.

        Raises:
            PublishError: The connection is lost.
        """

    def clock(self, time_ns: int) -> None:
        """Publish a recording time as /clock, which the first call advertises."""

    def subscribers(self, channel: Channel) -> int:
        """How many subscribers a channel's topic has now."""

    def follow_clock(self, on_time: Callable[[int], None]) -> None:
        """Call back, from any thread, with each time that another node publishes as /clock.

        Raises:
            OptionError: There is no /clock here.
        """

    def listen(self, topic: str, on_message: Callable[[int | None], None]) -> None:
        """Call back, from any thread, for each message of any type on another node's topic.

        Args:
            topic: The topic.
            on_message: Called with the header stamp of the message, in nanoseconds; with None if
                it has no header, or that is not known.

        Raises:
            OptionError: There are no other nodes here.
        """

    def serve(self, controls: Controls) -> None:
        """Offer remote control of a player as is usual here, if at all."""

    @property
    def wants_clock(self) -> bool:
        """Whether all nodes are configured to use simulated time (ROS 1: /use_sim_time)."""

    @property
    def is_alive(self) -> bool:
        """Whether it can still publish; False once it was shut down from outside."""

    def close(self) -> None:
        """Send what is still waiting, for a limited time, and disconnect."""

    def __enter__(self) -> Publisher: ...

    def __exit__(self, *_: object) -> None: ...


# ---------------------------------------------------------------- opening

WORLDS = ("ros1", "ros2")
"""What can be published to."""

_PATIENCE_S = 2.0


def sourced(command: str = "play") -> str:
    """Which ROS is sourced: ``ros1`` or ``ros2``.

    Args:
        command: The command, for the error.

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
        command,
        "no ROS is sourced: source its setup file, or choose `ros1`, `ros2` (works without ROS "
        "after pip install 'mp4ds[dds]')",
    )


def open_publisher(
    kind: str,
    *,
    names: NodeNames = PLAIN,
    qos_overrides: Path | None = None,
    parting_s: float | None = None,
    queue_size: int = 0,
    is_paced: bool = True,
) -> Publisher:
    """Open a publisher.

    Args:
        kind: One of `WORLDS`.
        names: Name, namespace and remappings of the ROS node.
        qos_overrides: A YAML file of QoS profiles by topic (ROS 2).
        parting_s: How long to wait at the end for acknowledgements (ROS 2); None for 3 s.
        queue_size: Messages that may wait for each subscriber of a topic (ROS 1); 0 for any
            number, up to `MAX_BYTES`.
        is_paced: Whether messages are published at their times; if not, the ROS 1 publisher waits
            for slow subscribers.

    Raises:
        OptionError: There is no such kind, or the file of QoS profiles is not valid.
        PublishError: Something is missing: a library or a master.
    """
    if kind not in WORLDS:
        raise OptionError(f"cannot publish to {kind!r}. Use {', '.join(WORLDS)}.")
    if qos_overrides is not None and kind != "ros2":
        raise OptionError("`qos_overrides` needs `ros2`.")
    if kind == "ros1":
        from mp4ds.plugins.publishing.ros1 import RospyPublisher

        # limited by bytes, as a hundred small messages last for a moment only
        wait_s = 0.0 if is_paced else _PATIENCE_S
        return RospyPublisher(names=names, queue_size=queue_size, wait_s=wait_s)
    from mp4ds.plugins.publishing.ros2_writers import load_overrides

    overrides = load_overrides(qos_overrides) if qos_overrides is not None else {}
    if find_spec("rclpy") is not None:
        from mp4ds.plugins.publishing.ros2 import RclpyPublisher

        return RclpyPublisher(overrides=overrides, names=names, parting_s=parting_s)
    from mp4ds.plugins.publishing.dds import DdsPublisher

    return DdsPublisher(overrides=overrides, names=names, parting_s=parting_s)
