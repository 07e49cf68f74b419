"""Publishes in ROS 2 without an installed ROS: over DDS, with Eclipse Cyclone DDS."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Mapping
from typing import Any

from mp4ds.bags.typedefs import World, ros2_world
from mp4ds.errors import OptionError
from mp4ds.publishers.dds_domain import domain_id, open_participant
from mp4ds.publishers.dds_ears import Ears
from mp4ds.publishers.dds_services import serve
from mp4ds.publishers.dds_types import dds_topic, message_type
from mp4ds.publishers.dds_writer import Writer, dds_qos
from mp4ds.publishers.protocol import Controls
from mp4ds.publishers.qos import CLOCK_QOS, Qos
from mp4ds.publishers.ros2_writers import CLOCK, CLOCK_TYPE, PARTING_S, Writers, clock_message
from mp4ds.records import Channel, Schema

_DISTRIBUTION = "jazzy"  # its definitions stand in for those that a recording lacks
_SECOND = 10**9
_TIME = struct.Struct("<iI")
_CDR_HEADER = 4  # bytes


class DdsPublisher:
    """A publisher of ROS 2 topics (`Publisher`) that is a participant of DDS by itself.

    ROS 2 of any middleware can subscribe. Messages go out as they are, but that DDS fills up
    their end to a multiple of 4 bytes, and that messages of the other byte order are turned
    into this machine's.

    Channels share writers (`Writers`).

    Args:
        domain: The DDS domain, 0 to 232; None for that of ROS_DOMAIN_ID, else 0.
        overrides: Topic -> quality of service to offer instead of the recorded one.
        node: Name of the node that the services belong to.

    Raises:
        OptionError: There is no such domain.
        PublishError: Cyclone DDS is not installed, or finds no network.
    """

    world: str | None = "ros2"

    def __init__(
        self,
        *,
        domain: int | None = None,
        overrides: Mapping[str, Qos] = {},
        node: str = "rosbag2_player",
    ) -> None:
        self._domain = domain_id(domain)
        self._node = node
        self._types: World = ros2_world(_DISTRIBUTION)
        self._participant = open_participant(self._domain)
        self._ears = Ears(self._participant)
        self._writers: Writers[Writer] = Writers(overrides)
        self._services: list[Any] = []
        self._clock: Writer | None = None
        self._is_open = True

    @property
    def address(self) -> str:
        """Its domain, to be shown."""
        return f"ROS 2, domain {self._domain}, by Cyclone DDS"

    def advertise(self, channel: Channel) -> None:
        """Announce a channel before its first message; see `Publisher`."""

        def make(qos: Qos) -> Writer:
            kind = message_type(channel, self._types)
            return Writer(self._participant, channel.topic, kind, qos)

        self._writers.add(channel, channel.schema, make)

    def publish(self, channel: Channel, payload: bytes | memoryview, time_ns: int) -> None:
        """Publish one message of a channel that was advertised; see `Publisher`.

        Raises:
            ConversionError: The message is not of its type.
            PublishError: A subscriber takes nothing for 15 s, where all are kept.
        """
        self._writers[channel].write(payload)

    def clock(self, time_ns: int) -> None:
        """Publish the time of the recording as /clock."""
        if self._clock is None:
            kind = message_type(_clock_channel(), self._types)
            self._clock = Writer(self._participant, CLOCK, kind, CLOCK_QOS)
        self._clock.write(clock_message(time_ns))

    def subscribers(self, channel: Channel) -> int:
        """How many subscribers a channel's topic has now."""
        return self._writers[channel].subscribers()

    def follow_clock(self, on_time: Callable[[int], None]) -> None:
        """Call with each time, nanoseconds, that others publish as /clock."""
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic

        kind = message_type(_clock_channel(), self._types)
        topic = Topic(self._participant, dds_topic(CLOCK), kind.writes)
        qos = dds_qos(CLOCK_QOS, ignore_own=True)
        reader = DataReader(self._participant, topic, qos=qos)
        self._ears.hear(reader, lambda sample: on_time(_time_of(sample.payload)))

    def listen(self, topic: str, on_message: Callable[[], None]) -> None:
        """Call for each message of others on a topic, from when somebody publishes it."""
        name = dds_topic(topic)
        if name is None:
            raise OptionError(f"{topic!r} is no topic name of ROS 2.")
        self._ears.seek(name, on_message)

    def serve(self, controls: Controls) -> None:
        """Offer the services of `ros2 bag play`, for clients that use rmw_cyclonedds."""
        self._services += serve(self._participant, self._ears, self._node, controls, self._types)

    @property
    def wants_clock(self) -> bool:
        """False: in ROS 2 each node is told by itself to use a simulated time."""
        return False

    @property
    def is_alive(self) -> bool:
        """Whether it was not closed: nobody else can."""
        return self._is_open

    def close(self) -> None:
        """Wait until subscribers have what was sent, for 3 s at most, and leave."""
        if not self._is_open:
            return
        self._is_open = False
        end = time.monotonic() + PARTING_S
        for writer in self._writers:
            writer.wait(max(0.0, end - time.monotonic()))
        self._ears.close()
        self._services.clear()
        self._writers.clear()
        self._clock = None
        self._participant = None

    def __enter__(self) -> DdsPublisher:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _clock_channel() -> Channel:
    return Channel(0, CLOCK, "cdr", Schema(CLOCK_TYPE, "", b""))


def _time_of(payload: bytes) -> int:
    """Nanoseconds of a Clock message, which the library has turned into this machine's order."""
    sec, nanosec = _TIME.unpack_from(payload, _CDR_HEADER)
    return int(sec) * _SECOND + int(nanosec)
