"""Reassembles the channels that have messages in videos."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from mp4ds.dataset.columns import Choice
from mp4ds.dataset.rebuild import CalibrationMessages
from mp4ds.dataset.stream import Stream
from mp4ds.errors import FormatError
from mp4ds.records import Channel, Message, Record

Part = Stream | CalibrationMessages
"""Messages of a channel that are not in messages.mcap."""

MessageSource = Callable[[Channel, Choice], Iterator[tuple[int, Message]]]
"""Yields the wanted messages of a part on a channel, each with its ordinal."""

Read = Callable[[Part, Channel], Iterator[tuple[int, Message]]]
"""Yields the messages of a part that are wanted, each with its ordinal."""

T = TypeVar("T")
_RecordT = TypeVar("_RecordT", bound=Record)


def by_time(*records: Iterator[_RecordT]) -> Iterator[_RecordT]:
    """Merge records that are in the order of their log times; what has none comes first."""
    return _in_order(records, lambda record: getattr(record, "log_time", 0))


def _in_order(parts: Sequence[Iterator[T]], key: Callable[[T], int]) -> Iterator[T]:
    with ExitStack() as stack:
        for part in parts:
            # the files of the others are open still when one fails
            stack.callback(getattr(part, "close", lambda: None))
        yield from heapq.merge(*parts, key=key)


def _ordinal(pair: tuple[int, Message]) -> int:
    return pair[0]


@dataclass(frozen=True)
class ChannelGroup:
    """A channel with messages in videos, and its channels in messages.mcap if any.

    Attributes:
        channel: The channel as a whole, as in `Dataset.channels`.
        parts: Its messages in videos.
        recorded_ids: Channels of messages.mcap with the other messages.
    """

    channel: Channel
    parts: list[Part]
    recorded_ids: set[int]

    @property
    def streams(self) -> list[Stream]:
        """The streams with its images; none for calibrations."""
        return [part for part in self.parts if isinstance(part, Stream)]

    def recorded(self, counts: Mapping[int, int]) -> int:
        """How many of its messages are in messages.mcap, from the counts of its channels there."""
        return sum(counts.get(key, 0) for key in self.recorded_ids)

    def found_in(self, records: Iterable[Record]) -> Iterator[Message]:
        """Its messages among the records of messages.mcap, read only if there are any."""
        for record in records if self.recorded_ids else ():
            if isinstance(record, Message) and record.channel.id in self.recorded_ids:
                yield replace(record, channel=self.channel)

    def messages(self, read: Read) -> Iterator[Message]:
        """Its messages in videos, in the channel's order."""
        return (message for _, message in _in_order(self._read(read), _ordinal))

    def parts_of(self, read: Read) -> list[Iterator[Message]]:
        """Its messages in videos, separately for each part."""
        return [(message for _, message in part) for part in self._read(read)]

    def _read(self, read: Read) -> list[Iterator[tuple[int, Message]]]:
        return [read(part, self.channel) for part in self.parts]

    def merged(
        self, read: Read, recorded: Iterator[Message], place: str | None
    ) -> Iterator[Message]:
        """All its messages, in the channel's order.

        Args:
            read: Reads those in videos.
            recorded: Those of messages.mcap, which fill the remaining ordinals.
            place: The dataset, for errors; None if some may be missing.

        Raises:
            FormatError: ``messages-missing``.
        """
        places = self.places
        given = 0
        for ordinal, message in _in_order(self._read(read), _ordinal):
            before = ordinal - int(np.searchsorted(places, ordinal))
            while given < before:
                verbatim = next(recorded, None)
                if verbatim is None:
                    if place is None:
                        break
                    raise FormatError(
                        "messages-missing",
                        place,
                        f"message {self._free(given)} of topic {self.channel.topic} is not in "
                        "any file",
                    )
                yield verbatim
                given += 1
            yield message
        yield from recorded

    @property
    def places(self) -> NDArray[np.int64]:
        """Ordinals of the messages in videos; sorted."""
        return np.sort(np.concatenate([part.columns.ordinal for part in self.parts]))

    def _free(self, number: int) -> int:
        """The ordinal of a message of messages.mcap, by its index there."""
        for place in self.places.tolist():
            number += place <= number
        return number

    def is_in_time(self, recorded: Sequence[NDArray[np.int64]]) -> bool:
        """Whether its messages are ordered by log time.

        They are not if an earlier time comes later, or if messages with equal times are in
        different files.

        Args:
            recorded: Sorted log times of its messages in messages.mcap, nanoseconds.
        """
        columns = [part.columns for part in self.parts]
        count = sum(len(one.ordinal) for one in columns) + sum(map(len, recorded))
        if max(int(one.ordinal[-1]) for one in columns) >= count:
            return False  # there is a gap, which reading everything reports
        times = np.empty(count, np.int64)
        owner = np.zeros(count, np.int64)  # 0: messages.mcap
        for number, one in enumerate(columns, start=1):
            times[one.ordinal], owner[one.ordinal] = one.log_time, number
        times[owner == 0] = np.sort(np.concatenate([times[:0], *recorded]))
        steps = np.diff(times)
        return bool((steps >= 0).all() and not ((steps == 0) & (np.diff(owner) != 0)).any())

    def gap(self, recorded: int) -> str:
        """What is missing according to the columns; empty if nothing.

        The ordinals that they leave free belong to the channel's messages in messages.mcap, so the
        counts must agree.

        Args:
            recorded: Messages in messages.mcap.
        """
        places = self.places
        total = len(places) + recorded
        if len(np.unique(places)) < len(places):
            return "two messages have the same number"
        if places[-1] >= total:
            return f"has {total} messages, and one with number {places[-1]}"
        return ""


def channel_groups(streams: Sequence[Stream], recorded: Sequence[Channel]) -> list[ChannelGroup]:
    """The channels that have messages in videos.

    Args:
        streams: All streams.
        recorded: The channels of messages.mcap.
    """
    groups: dict[tuple[object, ...], ChannelGroup] = {}
    first_id = 1 + max((channel.id for channel in recorded), default=0)
    for stream in streams:
        parts: list[Part] = [] if stream.is_lost else [stream]
        parts += [stream.infos] if stream.infos else []
        for part in parts:
            identity = part.channel.identity
            if identity not in groups:
                channel = replace(part.channel, id=first_id + len(groups))
                ids = {item.id for item in recorded if item.identity == identity}
                groups[identity] = ChannelGroup(channel, [], ids)
            groups[identity].parts.append(part)
    return list(groups.values())
