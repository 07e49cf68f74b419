"""The channels of a recording that have messages in videos, put together again."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import cast

from mp4ds.errors import FormatError
from mp4ds.records import Channel, Message
from mp4ds.streams import Stream
from mp4ds.streams.rebuild import DecodedColumns

MessageSource = Callable[[Channel], Iterator[tuple[int, Message]]]
"""Gives messages of a channel, each with its place among the channel's messages."""


@dataclass(frozen=True)
class ImageChannel:
    """A channel with images in videos.

    Attributes:
        channel: As in `Dataset.channels`.
        streams: Its streams; each holds some of its messages.
        recorded: Number of its messages that are in messages.mcap.
    """

    channel: Channel
    streams: list[Stream]
    recorded: int


@dataclass(frozen=True)
class Part:
    """Messages of a channel that belong to one video.

    Attributes:
        source: Makes them.
        decode_columns: Gives their columns.
        stream: Whose images they are; None for calibrations.
    """

    source: MessageSource
    decode_columns: Callable[[], DecodedColumns]
    stream: Stream | None = None

    @property
    def columns(self) -> DecodedColumns:
        """Their columns."""
        return self.decode_columns()


@dataclass(frozen=True)
class ChannelGroup:
    """A channel with messages in videos, and its channels in messages.mcap if any.

    Attributes:
        channel: The channel as a whole.
        parts: Its messages that belong to videos.
        recorded_ids: Channels of messages.mcap that have the others.
    """

    channel: Channel
    parts: list[Part]
    recorded_ids: set[int]

    @property
    def streams(self) -> list[Stream]:
        """The streams with its images; none for calibrations."""
        return [part.stream for part in self.parts if part.stream is not None]

    def messages(self, sources: Mapping[Path, MessageSource]) -> Iterator[Message]:
        """Its messages that belong to videos, in the channel's order.

        Args:
            sources: What gives the messages of a stream instead, by the path of its sidecar.
        """
        return (message for _, message in self._placed(sources))

    def merged(
        self, sources: Mapping[Path, MessageSource], recorded: Iterator[Message], place: str
    ) -> Iterator[Message]:
        """All its messages, in the channel's order.

        Args:
            sources: As for `messages`.
            recorded: Those of messages.mcap, which have the places that are left.
            place: The dataset, for errors.

        Raises:
            FormatError: ``messages-missing``.
        """
        due = 0
        for ordinal, message in self._placed(sources):
            while due < ordinal:
                verbatim = next(recorded, None)
                if verbatim is None:
                    raise FormatError(
                        "messages-missing",
                        place,
                        f"message {due} of topic {self.channel.topic} is in no file",
                    )
                yield verbatim
                due += 1
            yield message
            due += 1
        yield from recorded

    def _placed(self, sources: Mapping[Path, MessageSource]) -> Iterator[tuple[int, Message]]:
        parts = [
            sources.get(part.stream.path, part.source) if part.stream else part.source
            for part in self.parts
        ]
        return heapq.merge(*(part(self.channel) for part in parts), key=lambda pair: pair[0])


def channel_groups(streams: Sequence[Stream], recorded: Sequence[Channel]) -> list[ChannelGroup]:
    """The channels that have messages in videos.

    Args:
        streams: All streams.
        recorded: The channels of messages.mcap.
    """
    groups: dict[tuple[object, ...], ChannelGroup] = {}
    first_id = 1 + max((channel.id for channel in recorded), default=0)
    for stream in streams:
        images = Part(stream.messages, partial(_columns_of, stream), stream)
        sources = [(stream.sidecar.channel, images)]
        info = stream.sidecar.camera_info
        if info and info.messages:
            part = Part(stream.camera_info_messages, partial(_info_columns_of, stream))
            sources.append((info.channel, part))
        for model, part in sources:
            key = model.to_record(0).identity
            if key not in groups:
                channel = model.to_record(first_id + len(groups))
                ids = {item.id for item in recorded if item.identity == key}
                groups[key] = ChannelGroup(channel, [], ids)
            groups[key].parts.append(part)
    return list(groups.values())


def _columns_of(stream: Stream) -> DecodedColumns:
    return stream.rebuilder.columns


def _info_columns_of(stream: Stream) -> DecodedColumns:
    return cast(DecodedColumns, stream.camera_info_columns)  # it has messages
