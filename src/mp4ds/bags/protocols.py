"""The interfaces of readers and writers of recordings, and what readers share."""

from __future__ import annotations

import bisect
import heapq
from abc import ABC, abstractmethod
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from mp4ds.records import (
    EVERYTHING,
    Attachment,
    Channel,
    ChannelStats,
    Excerpt,
    Loss,
    Message,
    MetadataRecord,
    Record,
    Schema,
)

Format = Literal["bag", "rosbag2", "mcap"]
_Reader = TypeVar("_Reader", bound="BagReader")
_Writer = TypeVar("_Writer", bound="BagWriter")


@dataclass(frozen=True, slots=True)
class RecordingSlice:
    """What a reader gives of its recording.

    Attributes:
        span: Its log times.
        latched: Messages of latched topics from before it, which come first.
        left_out: Latched topics whose messages from before it are too large to be included.
    """

    span: Excerpt = EVERYTHING
    latched: Sequence[Message] = ()
    left_out: Sequence[str] = ()


WHOLE = RecordingSlice()
"""Everything that the recording has."""


class BagReader(ABC):
    """One recording, opened for reading. A context manager; the file is never changed.

    A reader has at least `_channels` and `_records`, from which everything else follows; it
    overrides what its index makes faster. Where it has a slice, `records`, `times`, `stats` and
    `first` are those of the slice; everything else is that of the whole recording.

    Attributes:
        format: ``bag``, ``rosbag2`` or ``mcap``.
        path: The file or folder that was opened.
        profile: ``ros1``, ``ros2`` or any other MCAP profile; empty for none.
        library: The MCAP header's library string; empty for other formats.
        files: All files of the recording, in reading order.
        tables: Small tables of a database, verbatim: a name -> content; empty for other formats.
        begin: Log time from which slices are counted, ns; None for that of the first message.
        slice: What is given of it; all, unless it was set.
        pairs: Calibration channels and those of their images, by id; None: yet to be found.
        reduction: What is done to its images, as manifests have it; empty for nothing.
        redaction: What the last `records` redacted, as manifests have it.
    """

    format: Format
    path: Path
    files: Sequence[Path]
    profile: str = ""
    library: str = ""
    tables: Mapping[str, str] = MappingProxyType({})
    begin: int | None = None
    slice: RecordingSlice = WHOLE
    pairs: Mapping[int, int] | None = None
    reduction: Mapping[str, Any] = MappingProxyType({})
    redaction: Mapping[str, Any] = MappingProxyType({})

    # what was found so far, which may grow while reading
    _channels: Mapping[Any, Channel] = MappingProxyType({})
    _schemas: Iterable[Schema] = ()
    _skipped: Mapping[str, int] = MappingProxyType({})

    @property
    def channels(self) -> Sequence[Channel]:
        """All channels known so far.

        Complete once `records` of everything is exhausted, or if the recording `is_indexed`.
        """
        return list(self._channels.values())

    @property
    def unused_schemas(self) -> Sequence[Schema]:
        """Definitions that no channel refers to.

        Complete once `records` of everything is exhausted, or if the recording `is_indexed`.
        """
        used = {channel.schema for channel in self.channels}
        return [schema for schema in dict.fromkeys(self._schemas) if schema not in used]

    @property
    def skipped(self) -> Mapping[str, int]:
        """What the source holds but no dataset can: a phrase -> how many; to be reported.

        As found by the last `records`.
        """
        return dict(self._skipped)

    @property
    def losses(self) -> Sequence[Loss]:
        """What the last `records` could not read, if damaged recordings are salvaged."""
        return ()

    @property
    def position(self) -> int:
        """Bytes of `files` that `records` of everything has consumed, for progress and hashing."""
        return 0

    @property
    def is_indexed(self) -> bool:
        """Whether an excerpt can be read, in log-time order, without reading the rest."""
        return False

    def records(self, excerpt: Excerpt = EVERYTHING) -> Iterator[Record]:
        """Read everything once, or a part of it.

        Messages of one channel come in log-time order, ties in source order; without an index (some
        MCAP files), they come in file order. Attachments and metadata records come where they are
        in the file.

        An excerpt comes in the order of the whole. Where the recording
        `is_indexed`, the messages of consecutive spans are, for each channel, those of the whole
        one after another. Only the counts of `stats` reveal what a damaged index hides:
        use spans that are open at both ends, and count their messages.

        Args:
            excerpt: What to read. If the recording `is_indexed`, little else is read; otherwise
                everything is read, and the rest dropped.

        Raises:
            SourceError: The file is damaged; names the file and, if known, the topic.
        """
        records = self._records(excerpt.within(self.slice.span))
        latched = [message for message in self.slice.latched if excerpt.has(message)]
        return self._begun_by(latched, records) if latched else records

    def records_before(self, topics: Iterable[str]) -> Iterator[Record]:
        """Records of topics from before the slice, to decode what is in it."""
        start = self.slice.span.start
        if start is None:
            return iter(())
        return self._records(Excerpt(end=start, topics=frozenset(topics), others=False))

    @staticmethod
    def _begun_by(latched: Sequence[Message], records: Iterator[Record]) -> Iterator[Record]:
        # What is not a message comes first: it may tell about those that follow.
        for record in records:
            if latched and isinstance(record, Message):
                yield from latched
                latched = ()
            yield record
        yield from latched

    def times(self) -> Mapping[int, NDArray[np.int64]]:
        """Log times of every message, nanoseconds, sorted, by channel id."""
        return self._times() if self.slice is WHOLE else self._sliced_times

    def stats(self) -> Mapping[int, ChannelStats]:
        """Counts and time spans by channel id, as far as known without reading messages."""
        return self._stats() if self.slice is WHOLE else BagReader._stats(self)

    def first(self, channel: Channel) -> Message | None:
        """The channel's first message by log time, or None."""
        if not self.is_indexed:
            return self._first_messages.get(channel.id)
        for record in self.records(Excerpt(topics=frozenset([channel.topic]), others=False)):
            if isinstance(record, Message) and record.channel.id == channel.id:
                return with_own_payload(record)
        return None

    @property
    def span(self) -> tuple[int, int] | None:
        """Earliest and latest log time, nanoseconds; None if not known without reading messages."""
        known = [one for one in self.stats().values() if one.count]
        return (min(one.start for one in known), max(one.end for one in known)) if known else None

    @abstractmethod
    def _records(self, excerpt: Excerpt) -> Iterator[Record]:
        """`records` of the whole recording."""

    def _times(self) -> Mapping[int, NDArray[np.int64]]:
        """`times` of the whole recording."""
        return times_of(self._records(EVERYTHING))

    def _stats(self) -> Mapping[int, ChannelStats]:
        """`stats` of the whole recording."""
        return stats_of(self.times()) if self.is_indexed else {}

    @cached_property
    def _first_messages(self) -> Mapping[int, Message]:
        first: dict[int, Message] = {}
        for record in self.records():
            if isinstance(record, Message):
                known = first.get(record.channel.id)
                if known is None or record.log_time < known.log_time:
                    first[record.channel.id] = with_own_payload(record)
        return first

    @cached_property
    def _sliced_times(self) -> Mapping[int, NDArray[np.int64]]:
        early = times_of(self.slice.latched)
        found = {
            key: np.concatenate([early.get(key, times[:0]), in_span(times, self.slice.span)])
            for key, times in self._times().items()
        }
        return {key: times for key, times in found.items() if len(times)}

    def close(self) -> None:  # noqa: B027 - most readers have nothing open between two records
        """Close what is open."""

    def __enter__(self: _Reader) -> _Reader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class BagWriter(ABC):
    """One recording, opened for writing under a temporary name by the caller.

    A context manager: leaving it normally completes the file; an exception abandons it, and the
    caller removes what is left. What the format cannot hold is counted.
    """

    def __init__(self) -> None:
        self._omitted: Counter[str] = Counter()

    @property
    def omitted(self) -> Mapping[str, int]:
        """What was left out because the format cannot hold it: a phrase -> how many."""
        return dict(self._omitted)

    @staticmethod  # noqa: B027 - most formats hold any
    def check_channel(channel: Channel) -> None:
        """Refuse a channel that the format cannot hold.

        Raises:
            ConversionError: Says why, and what to do.
        """

    @staticmethod  # noqa: B027 - likewise
    def check_message(message: Message) -> None:
        """Refuse a message that the format cannot hold.

        Raises:
            ConversionError: Says why, and what to do.
        """

    @abstractmethod
    def add_channel(self, channel: Channel) -> None:
        """Declare a channel; required before its messages.

        Raises:
            ConversionError: The format cannot hold the channel.
        """

    @abstractmethod
    def write(self, message: Message) -> None:
        """Append a message, payload verbatim.

        Raises:
            ConversionError: The format cannot hold the message.
        """

    def add_schema(self, schema: Schema) -> None:
        """Keep a definition that no channel refers to."""
        self._omitted["definitions that no topic uses"] += 1

    def add_attachment(self, attachment: Attachment) -> None:
        """Append an attachment."""
        self._omitted["attachments"] += 1

    def add_metadata(self, record: MetadataRecord) -> None:
        """Append a metadata record."""
        self._omitted["metadata records"] += 1

    @abstractmethod
    def finish(self) -> None:
        """Complete and close the file."""

    @abstractmethod
    def abandon(self) -> None:
        """Close the file as it is."""

    def __enter__(self: _Writer) -> _Writer:
        return self

    def __exit__(self, exc_type: type[BaseException] | None, *_: object) -> None:
        try:
            if exc_type is None:
                self.finish()
        finally:
            self.abandon()


def write_record(writer: BagWriter, record: Record) -> None:
    """Append a record, declaring its channel first if necessary."""
    if isinstance(record, Message):
        writer.add_channel(record.channel)
        writer.write(record)
    elif isinstance(record, Attachment):
        writer.add_attachment(record)
    else:
        writer.add_metadata(record)


# ---------------------------------------------------------------- ordering

HOLD_BYTES = 256 * 2**20
"""Maximum payload bytes held back; messages further out of order come as early as possible."""


class HoldBack:
    """Sorts messages by log time, ties in source order, holding back no more than necessary."""

    def __init__(self) -> None:
        self._heap: list[tuple[int, int, int, Message]] = []
        self._added = 0
        self._bytes = 0

    def add(self, message: Message, place: int = 0) -> None:
        """Add a message.

        Args:
            message: The message.
            place: Its place in the source, if messages are not added in source order; ties of one
                place come in the order of adding.
        """
        self._added += 1
        self._bytes += len(message.data)
        heapq.heappush(self._heap, (message.log_time, place, self._added, message))

    def release(self, until: int | None) -> Iterator[Message]:
        """Yield, in order, the messages that no later one can precede.

        Args:
            until: No message added later is earlier than this log time, in nanoseconds; None if no
                message follows.
        """
        while self._heap and (
            until is None or self._heap[0][0] <= until or self._bytes > HOLD_BYTES
        ):
            message = heapq.heappop(self._heap)[-1]
            self._bytes -= len(message.data)
            yield message


def later_starts(
    places: NDArray[np.uint64], starts: NDArray[np.uint64]
) -> Callable[[int], int | None]:
    """When the chunks of a file begin, for knowing which messages no later one can precede.

    Args:
        places: Byte offsets of chunks with messages, increasing.
        starts: Their earliest log times, nanoseconds.

    Returns:
        A function that returns the earliest log time in the chunks after a byte offset; None after
        the last.
    """
    # arrays of Python: a query is as fast as of a list, at a fifth of its memory
    offsets = array("Q", places.tobytes())
    earliest = array("Q", np.minimum.accumulate(starts[::-1])[::-1].tobytes())

    def after(offset: int) -> int | None:
        place = bisect.bisect_right(offsets, offset)
        return earliest[place] if place < len(earliest) else None

    return after


def merged(
    starts: Sequence[int], records_of: Callable[[int], Iterator[Record]]
) -> Iterator[Record]:
    """Several sources merged in log-time order, each opened when it is needed.

    Ties come in the order of the sources. Attachments and metadata records do not wait.

    Args:
        starts: Of each source, a lower bound of its log times, nanoseconds.
        records_of: Reads the source of a number, in log-time order; one that is not is passed on
            in its own order.
    """
    waiting = sorted(range(len(starts)), key=lambda number: (starts[number], number), reverse=True)
    heads: list[tuple[int, int, Message, Iterator[Record]]] = []

    while waiting or heads:
        if waiting and (not heads or starts[waiting[-1]] <= heads[0][0]):
            number = waiting.pop()
            records = records_of(number)
        else:
            _, number, message, records = heapq.heappop(heads)
            yield message
        for record in records:
            if isinstance(record, Message):
                key = record.log_time, number
                is_first = not heads or key < heads[0][:2]
                if not is_first or (waiting and starts[waiting[-1]] <= record.log_time):
                    heapq.heappush(heads, (*key, record, records))
                    break
            yield record


# ---------------------------------------------------------------- without an index

_INT64_MAX = np.uint64(2**63 - 1)


def times_of(records: Iterable[Record]) -> dict[int, NDArray[np.int64]]:
    """Log times by channel id, sorted; see `sorted_times`."""
    found: dict[int, list[int]] = {}
    for record in records:
        if isinstance(record, Message):
            found.setdefault(record.channel.id, []).append(record.log_time)
    return {key: sorted_times(np.array(times, np.uint64)) for key, times in found.items()}


def sorted_times(times: NDArray[np.uint64]) -> NDArray[np.int64]:
    """Log times, sorted; those past the year 2262 are clamped."""
    return np.sort(np.minimum(times, _INT64_MAX)).astype(np.int64)


def stats_of(times: Mapping[int, NDArray[np.int64]]) -> dict[int, ChannelStats]:
    """Counts and spans of sorted log times; a channel without messages has times of 0."""
    return {
        key: ChannelStats(len(found), *(map(int, found[[0, -1]]) if len(found) else (0, 0)))
        for key, found in times.items()
    }


def with_own_payload(message: Message) -> Message:
    """A message with a copied payload, to keep: a view would keep the whole chunk in memory."""
    return replace(message, data=bytes(message.data))


def in_span(times: NDArray[np.int64], span: Excerpt) -> NDArray[np.int64]:
    """The part of sorted log times, nanoseconds, within the span of an excerpt; a view."""
    first = 0 if span.start is None else int(np.searchsorted(times, span.start))
    end = len(times) if span.end is None else int(np.searchsorted(times, span.end))
    return times[first:end]
