"""Stamps of headers, moved to the time at which their messages are published."""

from __future__ import annotations

from collections.abc import Callable

from mp4ds.bags.stamps import HeaderStamps
from mp4ds.errors import ConversionError
from mp4ds.records import Channel


class Restamper:
    """Moves the stamps of messages. What had the same stamp has the same one again."""

    def __init__(self) -> None:
        self._stamps: dict[int, tuple[Channel, HeaderStamps]] = {}

    def restamped(
        self, channel: Channel, payload: bytes | memoryview, wall_of: Callable[[int], int]
    ) -> bytes | memoryview:
        """A message as if it was made now; itself where it has no stamp.

        Args:
            channel: Of the message.
            payload: The serialized message.
            wall_of: The time of this machine, nanoseconds, at which the recording's time is
                what it is given.

        Raises:
            ConversionError: It is not of the channel's type.
        """
        if id(channel) not in self._stamps:
            self._stamps[id(channel)] = (channel, HeaderStamps(channel))
        stamps = self._stamps[id(channel)][1]
        if not stamps.has_any:
            return payload
        try:
            return memoryview(stamps.moved(payload, wall_of))
        except ValueError as error:
            problem = f"the stamp of a message cannot be changed: {error}"
            raise ConversionError(channel.topic, problem) from None
