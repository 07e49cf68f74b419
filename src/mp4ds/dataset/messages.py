"""The messages of a dataset: messages.mcap, channels that are also in videos, and for users."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.mcap import McapReader
from mp4ds.bags.protocols import Format, times_of
from mp4ds.bags.rosbag2_metadata import RECORD
from mp4ds.bags.salvage_mcap import McapSalvage
from mp4ds.dataset.rebuild import CalibrationMessages
from mp4ds.dataset.stream import Stream
from mp4ds.errors import FormatError, Refused, SourceError
from mp4ds.format.fields import Choice, everything
from mp4ds.records import (
    EVERYTHING,
    Channel,
    Excerpt,
    Loss,
    Message,
    MetadataRecord,
    Record,
    Schema,
)

_Item = TypeVar("_Item")
_RecordT = TypeVar("_RecordT", bound=Record)


class MessagesFile:
    """messages.mcap of a dataset; empty for a single video with its sidecar, which has none.

    Args:
        path: The file; None if there is none.
        salvage: Whether to read what can be read if it is damaged.
    """

    def __init__(self, path: Path | None, *, salvage: bool = False) -> None:
        self.path = path
        self.is_salvaged = salvage

    @cached_property
    def _reader(self) -> McapReader | McapSalvage | None:
        """The reader; keeps no file open between passes.

        Raises:
            FormatError: ``file-missing``, or ``messages-unreadable``: it is damaged, or does not
                list all its messages; if it is salvaged, nothing of it can be read.
        """
        if self.path is None:
            return None
        if not self.path.is_file():
            raise FormatError("file-missing", self.path, "does not exist")
        with _damage_told():
            if self.is_salvaged:
                return McapSalvage(self.path)
            reader = McapReader(self.path)
        if not reader.has_whole_index:
            raise FormatError(
                "messages-unreadable",
                self.path,
                "has no complete index; copy it again, or run `mcap recover`",
            )
        return reader

    @property
    def channels(self) -> Sequence[Channel]:
        """Its channels."""
        return self._reader.channels if self._reader else ()

    @property
    def profile(self) -> str:
        """MCAP profile of the recording."""
        return self._reader.profile if self._reader else ""

    @property
    def unused_schemas(self) -> Sequence[Schema]:
        """Definitions that no channel refers to."""
        return self._reader.unused_schemas if self._reader else ()

    @property
    def losses(self) -> Sequence[Loss]:
        """What is lost of it if it is salvaged, once its messages are counted."""
        return self._reader.losses if self._reader else ()

    @cached_property
    def counts(self) -> Mapping[int, int]:
        """Number of messages that can be read by channel id."""
        if self.is_salvaged:  # its index may list more
            return {key: len(times) for key, times in self.times.items()}
        stats = self._reader.stats() if self._reader else {}
        return {key: item.count for key, item in stats.items()}

    @cached_property
    def times(self) -> Mapping[int, NDArray[np.int64]]:
        """Sorted log times of the messages that can be read, nanoseconds, by channel id."""
        with _damage_told():
            if self.is_salvaged:
                return times_of(self._reader.records() if self._reader else ())
            return self._reader.times() if self._reader else {}

    def times_of(self, ids: Iterable[int]) -> NDArray[np.int64]:
        """Sorted log times, nanoseconds, of the messages of some channels together."""
        times = self.times
        found = [times[key] for key in ids if key in times]
        return np.sort(np.concatenate([np.empty(0, np.int64), *found]))

    def in_file_order(self) -> Iterator[Record]:
        """All its records, in file order."""
        if isinstance(self._reader, McapReader):
            return _intact(self._reader.as_it_stands())
        return self._records(EVERYTHING)

    def others(self) -> Iterator[Record]:
        """The attachments and metadata records in it."""
        return self._records(Excerpt(start=0, end=0))

    def in_time(self, excerpt: Excerpt) -> Iterator[Message]:
        """The messages of an excerpt, by log time."""
        records = self._records(replace(excerpt, others=False))
        return (record for record in records if isinstance(record, Message))

    def _records(self, excerpt: Excerpt) -> Iterator[Record]:
        reader = self._reader
        if isinstance(reader, McapSalvage):
            reader = McapSalvage(reader.path)  # one reads once at a time
        return _intact(reader.records(excerpt) if reader else ())


@contextmanager
def _damage_told() -> Iterator[None]:
    """Turn the error of a damaged recording into that of a damaged dataset."""
    try:
        yield
    except SourceError as error:
        raise FormatError("messages-unreadable", error.path, error.problem) from None


def _intact(items: Iterable[_Item]) -> Iterator[_Item]:
    with _damage_told():
        yield from items


def recorded_format(file: MessagesFile) -> Format:
    """The likely format of the recording that a messages.mcap is of."""
    if any(isinstance(item, MetadataRecord) and item.name == RECORD for item in file.others()):
        return "rosbag2"
    return "bag" if file.profile == "ros1" else "mcap"


def recorded_storage(records: Iterable[Record]) -> str:
    """The storage of a rosbag2 source; mcap, the default of ROS 2, if unknown.

    Args:
        records: All records of messages.mcap; the folder's own record precedes its messages.
    """
    for record in records:
        if isinstance(record, Message):
            break
        if isinstance(record, MetadataRecord) and record.name == RECORD:
            return "sqlite3" if record.metadata.get("storage") == "sqlite3" else "mcap"
    return "mcap"


@dataclass(frozen=True)
class RecordedMessage:
    """One message as recorded.

    Attributes:
        topic: Its topic.
        type_name: Its type as the recording spells it; empty if unknown.
        log_time_ns: When it was recorded, nanoseconds.
        publish_time_ns: When it was published, nanoseconds; the log time if unknown.
        raw: Its bytes, read-only.
        decode: Called by `decoded`.
    """

    topic: str
    type_name: str
    log_time_ns: int
    publish_time_ns: int
    raw: memoryview
    decode: Callable[[memoryview], Any] = field(repr=False, compare=False)

    @cached_property
    def decoded(self) -> Any:
        """The message as an object, decoded on first access.

        ROS 1 and ROS 2 messages become objects with the message's fields as attributes and numeric
        arrays as numpy arrays; protobuf gives a protobuf message; JSON gives dicts and lists.

        Raises:
            OptionError: No message of the topic can be decoded.
            SourceError: This one does not match its topic's type.
        """
        return self.decode(self.raw)


def as_recorded(messages: Iterable[Message], path: Path) -> Iterator[RecordedMessage]:
    """Messages for users.

    Args:
        messages: Of any channels.
        path: Where they are from, for errors.
    """
    decoders: dict[int, Callable[[memoryview], Any]] = {}
    for message in messages:
        channel = message.channel
        decode = decoders.setdefault(channel.id, _decoder(channel, path))
        yield RecordedMessage(
            topic=channel.topic,
            type_name=channel.type_name,
            log_time_ns=message.log_time,
            publish_time_ns=message.publish_time,
            raw=memoryview(message.data).toreadonly(),
            decode=decode,
        )


def _decoder(channel: Channel, path: Path) -> Callable[[memoryview], Any]:
    """Decodes the messages of a channel; the library's decoder is made for the first one."""

    @cache
    def made() -> Callable[[memoryview], Any]:
        # rosbags is slow to import, and not everyone decodes messages
        from mp4ds.bags.convert import decoder_of

        return decoder_of(channel)

    def decode(raw: memoryview) -> Any:
        try:
            return made()(raw)
        except Refused as error:
            problem = f"a message of {channel.topic} cannot be decoded: {error}"
            raise SourceError(path, problem) from None

    return decode


# ---------------------------------------------------------------- channels in several files

Part = Stream | CalibrationMessages
"""Messages of a channel that are not in messages.mcap."""

MessageSource = Callable[[Channel, Choice], Iterator[tuple[int, Message]]]
"""Yields the wanted messages of a part on a channel, each with its ordinal."""


def by_time(*records: Iterator[_RecordT]) -> Iterator[_RecordT]:
    """Merge messages that are in the order of their log times; other records come at once.

    An attachment has a log time, too, but stands anywhere: waiting for it would hold up messages.
    """
    return _in_order(records, lambda one: one.log_time if isinstance(one, Message) else 0)


def _in_order(parts: Sequence[Iterator[_Item]], key: Callable[[_Item], int]) -> Iterator[_Item]:
    with ExitStack() as stack:
        for part in parts:
            # the files of the others are open still when one fails
            stack.callback(getattr(part, "close", lambda: None))
        yield from heapq.merge(*parts, key=key)


@dataclass(frozen=True)
class ChannelGroup:
    """A channel with messages in videos, and its channels in messages.mcap if any.

    Attributes:
        channel: The channel as a whole, as in `Dataset.channels`.
        parts: Its messages in videos.
        file: The dataset's messages.mcap.
        recorded_ids: Its channels there, with the other messages.
    """

    channel: Channel
    parts: list[Part]
    file: MessagesFile
    recorded_ids: set[int]

    @property
    def streams(self) -> list[Stream]:
        """The streams with its images; none for calibrations."""
        return [part for part in self.parts if isinstance(part, Stream)]

    @property
    def recorded_count(self) -> int:
        """How many of its messages are in messages.mcap."""
        return sum(self.file.counts.get(key, 0) for key in self.recorded_ids)

    @property
    def recorded_times(self) -> NDArray[np.int64]:
        """Sorted log times, nanoseconds, of its messages in messages.mcap."""
        return self.file.times_of(self.recorded_ids)

    def sources(
        self, choice: Choice = everything, replaced: Mapping[Part, MessageSource] | None = None
    ) -> list[Iterator[tuple[int, Message]]]:
        """Its messages in videos, with their ordinals, by part.

        Args:
            choice: Which are wanted.
            replaced: Where those of some parts come from instead.
        """
        return [
            (replaced or {}).get(part, part.messages)(self.channel, choice) for part in self.parts
        ]

    def recorded(self, excerpt: Excerpt | None = None) -> Iterator[Message]:
        """Its messages in messages.mcap, which is read only if it has any.

        Args:
            excerpt: Those of it, by log time; None for all, in the order of the file.
        """
        if not self.recorded_ids:
            return
        own = replace(excerpt, topics=frozenset([self.channel.topic])) if excerpt else None
        for record in self.file.in_time(own) if own else self.file.in_file_order():
            if isinstance(record, Message) and record.channel.id in self.recorded_ids:
                yield replace(record, channel=self.channel)

    def merged(
        self,
        own: Sequence[Iterator[tuple[int, Message]]],
        recorded: Iterator[Message],
        place: str | None,
    ) -> Iterator[Message]:
        """All its messages, in the channel's order.

        Args:
            own: Those in videos, with their ordinals, by part.
            recorded: Those of messages.mcap, which fill the remaining ordinals.
            place: The dataset, for errors; None if some may be missing.

        Raises:
            FormatError: ``messages-missing``.
        """
        places = self.places
        given = 0
        for ordinal, message in _in_order(own, lambda pair: pair[0]):
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

    @property
    def is_in_time(self) -> bool:
        """Whether its messages are ordered by log time.

        They are not if an earlier time comes later, or if messages with equal times are in
        different files.
        """
        columns, recorded = [part.columns for part in self.parts], self.recorded_times
        count = sum(len(one.ordinal) for one in columns) + len(recorded)
        if max(int(one.ordinal[-1]) for one in columns) >= count:
            return False  # there is a gap, which reading everything reports
        times = np.empty(count, np.int64)
        owner = np.zeros(count, np.int64)  # 0: messages.mcap
        for number, one in enumerate(columns, start=1):
            times[one.ordinal], owner[one.ordinal] = one.log_time, number
        times[owner == 0] = recorded
        steps = np.diff(times)
        return bool((steps >= 0).all() and not ((steps == 0) & (np.diff(owner) != 0)).any())

    @property
    def gap(self) -> str:
        """What is missing according to the columns; empty if nothing.

        The ordinals that they leave free belong to the channel's messages in messages.mcap, so the
        counts must agree.
        """
        places = self.places
        total = len(places) + self.recorded_count
        if len(np.unique(places)) < len(places):
            return "two messages have the same number"
        if places[-1] >= total:
            return f"has {total} messages, and one with number {places[-1]}"
        return ""


def channel_groups(streams: Sequence[Stream], file: MessagesFile) -> list[ChannelGroup]:
    """The channels that have messages in videos.

    Args:
        streams: All streams.
        file: messages.mcap.
    """
    recorded = file.channels
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
                groups[identity] = ChannelGroup(channel, [], file, ids)
            groups[identity].parts.append(part)
    return list(groups.values())
