"""What a publisher can do, and what it may ask of the player."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

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
        """While it stands still, publish one message; returns whether it does."""

    def burst(self, messages: int) -> int:
        """While it stands still, publish messages as fast as can be; 0: all that are left.

        Returns how many it will publish, as far as there are any.
        """

    def step_back(self) -> bool:
        """While it stands still, go back by one message; returns whether it does."""

    def seek(self, time_ns: int) -> bool:
        """Go on at a time of the recording; returns whether it is within it."""

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

    def listen(self, topic: str, on_message: Callable[[], None]) -> None:
        """Call for each message on a topic of others, whatever its type, from any thread.

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
