"""What publishes the channels of a recording in ROS 2, be it by rclpy or by DDS."""

from __future__ import annotations

import struct
from collections.abc import Callable, Hashable, Iterator, Mapping
from typing import Generic, TypeVar

from mp4ds.errors import ConversionError
from mp4ds.publishers.qos import Qos, offered_qos
from mp4ds.records import Channel

CLOCK = "/clock"
CLOCK_TYPE = "rosgraph_msgs/msg/Clock"
PARTING_S = 3.0
"""Seconds that subscribers have at the end."""

_LITTLE = b"\0\1\0\0"
_TIME = struct.Struct("<iI")
_Writer = TypeVar("_Writer")


def clock_message(time_ns: int) -> bytes:
    """A message of /clock, in CDR."""
    return _LITTLE + _TIME.pack(*divmod(time_ns, 10**9))


class Writers(Generic[_Writer]):
    """The writers of the channels that were advertised.

    Channels of one topic, type and quality of service have one writer; latched ones have one
    each, so that late subscribers get the last message of each, as from the recorded publishers.

    Args:
        overrides: Topic -> quality of service to offer instead of the recorded one.
    """

    def __init__(self, overrides: Mapping[str, Qos]) -> None:
        self._overrides = dict(overrides)
        self._channels: dict[int, tuple[Channel, _Writer]] = {}
        self._shared: dict[tuple[str, Hashable, Qos], _Writer] = {}

    def add(self, channel: Channel, kind: Hashable, make: Callable[[Qos], _Writer]) -> None:
        """See that a channel has a writer.

        Args:
            channel: The channel.
            kind: What stands for its type.
            make: Makes a writer of it.

        Raises:
            ConversionError: Its messages are not those of ROS 2.
        """
        if id(channel) in self._channels:
            return
        if channel.message_encoding != "cdr":
            encoding = channel.message_encoding or "of no known encoding"
            raise ConversionError(channel.topic, f"its messages are {encoding}, not those of ROS 2")
        qos = offered_qos(channel, self._overrides)
        key = (channel.topic, kind, qos)
        writer = None if qos.is_latched else self._shared.get(key)
        if writer is None:
            writer = self._shared[key] = make(qos)
        self._channels[id(channel)] = channel, writer

    def __getitem__(self, channel: Channel) -> _Writer:
        return self._channels[id(channel)][1]

    def __iter__(self) -> Iterator[_Writer]:
        return (writer for _, writer in self._channels.values())

    def clear(self) -> None:
        """Let go of them."""
        self._channels.clear()
        self._shared.clear()
