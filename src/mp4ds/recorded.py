"""Messages of a recording that are no frames, to be looked at."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from mp4ds.errors import SourceError
from mp4ds.records import Channel, Message
from mp4ds.wire import WireError


@dataclass(frozen=True)
class RecordedMessage:
    """One message as recorded.

    Attributes:
        topic: Its topic.
        type_name: Its type as the recording spells it; empty where that is not known.
        log_time_ns: When it was recorded, nanoseconds.
        publish_time_ns: When it was published, nanoseconds; the log time where not known.
        raw: Its bytes, which cannot be written to.
        decode: What `decoded` calls.
    """

    topic: str
    type_name: str
    log_time_ns: int
    publish_time_ns: int
    raw: memoryview
    decode: Callable[[memoryview], Any] = field(repr=False, compare=False)

    @cached_property
    def decoded(self) -> Any:
        """The message as an object, decoded when first asked for.

        ROS 1 and ROS 2 give an object whose attributes are the message's fields, arrays of
        numbers as numpy's; protobuf a message of its own; JSON dicts and lists.

        Raises:
            OptionError: No message of the topic can be decoded.
            SourceError: This one is not of the type that its topic tells.
        """
        return self.decode(self.raw)


def as_recorded(messages: Iterable[Message], path: Path) -> Iterator[RecordedMessage]:
    """Messages to be looked at.

    Args:
        messages: Of any channels.
        path: Where they are from, for errors.
    """
    topics: dict[int, _Topic] = {}
    for message in messages:
        channel = message.channel
        topic = topics.setdefault(channel.id, _Topic(channel, path))
        yield RecordedMessage(
            topic=channel.topic,
            type_name=channel.type_name,
            log_time_ns=message.log_time,
            publish_time_ns=message.publish_time,
            raw=memoryview(message.data).toreadonly(),
            decode=topic.decode,
        )


class _Topic:
    """Decodes the messages of a channel; the first one makes the decoder."""

    def __init__(self, channel: Channel, path: Path) -> None:
        self._channel = channel
        self._path = path

    @cached_property
    def _decoder(self) -> Callable[[memoryview], Any]:
        # rosbags takes long to import, and not everybody decodes messages
        from mp4ds.bags.decoding import decoder_of

        return decoder_of(self._channel)

    def decode(self, raw: memoryview) -> Any:
        try:
            return self._decoder(raw)
        except WireError as error:
            raise SourceError(
                self._path, f"a message of {self._channel.topic} cannot be decoded: {error}"
            ) from None
