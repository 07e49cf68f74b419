"""Where messages are published: ROS 1, ROS 2, Foxglove."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Protocol

from mp4ds.errors import OptionError, PublishError
from mp4ds.plugins.publishing.names import PLAIN, NodeNames
from mp4ds.records import Channel


class Controls(Protocol):
    """What remote controls (services, a web page, keys) may do to a player; from any thread."""

    @property
    def is_paused(self) -> bool:
        """Whether it stands still."""

    @property
    def rate(self) -> float:
        """Seconds of the recording in a second."""

    def pause(self) -> None:
        """Stand still."""

    def resume(self) -> None:
        """Go on."""

    def toggle_paused(self) -> None:
        """Stand still or go on."""

    def set_rate(self, rate: float) -> bool:
        """Play at another rate; returns whether there is such a rate: above 0."""

    def play_next(self) -> bool:
        """While it stands still, publish one message; returns, when it is out, whether it did."""

    def burst(self, messages: int) -> int:
        """While it stands still, publish messages as fast as can be; 0: all that are left.

        Returns, when they are out, how many there were.
        """

    def step_back(self) -> bool:
        """While it stands still, go back by one message; returns whether that is out."""

    def seek(self, time_ns: int) -> int:
        """Go on at a time of the recording, or at the nearest that is played; returns which."""

    def play(self, start_ns: int, end_ns: int | None) -> bool:
        """Play again from a time to another; returns whether it does, being at its end.

        Args:
            start_ns: The first time, of the recording.
            end_ns: The last time; None for the end.
        """

    def toggle_topic_pauses(self) -> None:
        """Pause before the messages of some topics or not, as was asked for at first."""

    @property
    def start_ns(self) -> int:
        """Log time of the first message of the recording."""

    def stop(self) -> None:
        """End."""


class Publisher(Protocol):
    """Where messages are published. A context manager; used by one thread.

    Attributes:
        world: What messages have to be in: ``ros1``, ``ros2``; None for as they are recorded.
    """

    world: str | None

    @property
    def address(self) -> str:
        """Where it publishes, to be shown: a URL, or whose ROS it is."""

    def advertise(self, channel: Channel) -> None:
        """Announce a channel before its first message. Several channels may have one topic.

        Latching (ROS 1) and QoS (ROS 2) are those of its metadata.

        Raises:
            Refused: Its type is not installed there.
            ConversionError: It cannot be published there; names the topic.
            PublishError: The other side refuses.
        """

    def publish(self, channel: Channel, payload: bytes | memoryview, time_ns: int) -> None:
        """Publish one message of a channel that was advertised.

        Args:
            channel: The very object that was advertised.
            payload: The serialized message; not kept after the call.
            time_ns: The recording's time, nanoseconds.

        Raises:
            PublishError: The connection is lost.
        """

    def clock(self, time_ns: int) -> None:
        """Publish the time of the recording as /clock; advertised by the first call."""

    def subscribers(self, channel: Channel) -> int:
        """How many subscribers a channel's topic has now."""

    def follow_clock(self, on_time: Callable[[int], None]) -> None:
        """Call with each time, nanoseconds, that others publish as /clock, from any thread.

        Raises:
            OptionError: There is no such clock here.
        """

    def listen(self, topic: str, on_message: Callable[[int | None], None]) -> None:
        """Call for each message on a topic of others, whatever its type, from any thread.

        Args:
            topic: The topic.
            on_message: Called with the stamp, nanoseconds, of a message that begins with a header;
                with None for others, and where it cannot be told.

        Raises:
            OptionError: That cannot be done here.
        """

    def serve(self, controls: Controls) -> None:
        """Offer a player's remote controls as this side's players do; nothing where it has none."""

    @property
    def wants_clock(self) -> bool:
        """Whether everybody here is told to use a simulated time (ROS 1: /use_sim_time)."""

    @property
    def is_alive(self) -> bool:
        """Whether it still publishes; False once it was shut down from outside."""

    def close(self) -> None:
        """Send what is waiting to be sent, as far as that ends soon, and leave."""

    def __enter__(self) -> Publisher: ...

    def __exit__(self, *_: object) -> None: ...


# ---------------------------------------------------------------- opening

WORLDS: Mapping[str, str | None] = {"ros1": "ros1", "ros2": "ros2", "foxglove": None}
"""What can be published to, and what messages have to be in there; None: as recorded."""

_PATIENCE_S = 2.0


def sourced(command: str = "play", others: str = " or `foxglove`") -> str:
    """What is sourced here: ``ros1`` or ``ros2``.

    Args:
        command: What is to be done, for the error.
        others: What else can be named, for the error.

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
        "no ROS is sourced here: source its setup file, or give `ros1`, `ros2` (without ROS by "
        f"pip install 'mp4ds[dds]'){others}",
    )


def open_publisher(
    kind: str,
    *,
    names: NodeNames = PLAIN,
    qos_overrides: Path | None = None,
    parting_s: float | None = None,
    queue_size: int = 0,
    host: str = "127.0.0.1",
    port: int = 8765,
    origins: Sequence[str] = (),
    span: tuple[int, int] | None = None,
    is_paced: bool = True,
) -> Publisher:
    """Join what is to be published to.

    Args:
        kind: One of `WORLDS`.
        names: What the node and its topics are called, in ROS.
        qos_overrides: A YAML file of QoS profiles by topic, for ROS 2.
        parting_s: How long subscribers have to acknowledge at the end, in ROS 2; None for 3 s.
        queue_size: Messages that may wait for each subscriber of a topic, in ROS 1; 0 for any
            number, as far as `MAX_BYTES` allows.
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
        raise OptionError("`qos_overrides` goes with `ros2`.")
    if kind == "ros1":
        from mp4ds.plugins.publishing.ros1 import RospyPublisher

        # what waits is bounded by its bytes: a hundred small messages are a moment
        wait_s = 0.0 if is_paced else _PATIENCE_S
        return RospyPublisher(names=names, queue_size=queue_size, wait_s=wait_s)
    if kind == "foxglove":
        from mp4ds.plugins.publishing.foxglove import FoxglovePublisher

        return FoxglovePublisher(host=host, port=port, origins=origins, span=span)
    from mp4ds.plugins.publishing.ros2_writers import PARTING_S, load_overrides

    overrides = load_overrides(qos_overrides) if qos_overrides is not None else {}
    parting_s = PARTING_S if parting_s is None else parting_s
    if find_spec("rclpy") is not None:
        from mp4ds.plugins.publishing.ros2 import RclpyPublisher

        return RclpyPublisher(overrides=overrides, names=names, parting_s=parting_s)
    from mp4ds.plugins.publishing.dds import DdsPublisher

    return DdsPublisher(overrides=overrides, names=names, parting_s=parting_s)
