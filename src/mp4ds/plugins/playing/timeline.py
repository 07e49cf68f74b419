"""The messages of several datasets, merged, as they are published, from any time on."""

from __future__ import annotations

import heapq
import threading
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from typing import Any, Generic, TypeVar

import numpy as np

from mp4ds.bags.latched import LatchedMessages, has_late, latched_depth
from mp4ds.dataset.dataset import Ahead, Dataset
from mp4ds.errors import OptionError
from mp4ds.format.fields import DecodedColumns, everything, last_of
from mp4ds.plugins.playing.options import KINDS, PlayOptions, rooted
from mp4ds.plugins.playing.pace import NS
from mp4ds.plugins.ros.node import World
from mp4ds.records import Message
from mp4ds.unpacking.republish import Republisher

# ---------------------------------------------------------------- read ahead

T = TypeVar("T")


class ReadAhead(Generic[T]):
    """An iterator whose items are produced by a thread of its own, a bounded amount ahead.

    Args:
        items: The source; used by the thread alone.
        room: Total size of the items that may wait; at least one always may.
        size_of: The size of an item.
        on_ready: Called by the thread when an item becomes available after there was none.
        sources: Others that it reads from, closed with it; the thread may add to them.
    """

    def __init__(
        self,
        items: Iterator[T],
        room: int,
        *,
        size_of: Callable[[T], int] = lambda _: 1,
        on_ready: Callable[[], None] = lambda: None,
        sources: Sequence[ReadAhead[Any]] = (),
    ) -> None:
        self._items = items
        self._room = room
        self._size_of = size_of
        self._on_ready = on_ready
        self._sources = sources
        self._changed = threading.Condition()
        self._waiting: deque[T] = deque()
        self._is_over = False  # nothing more comes
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def __iter__(self) -> Iterator[T]:
        return self

    def __next__(self) -> T:
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._is_over)
            self.head()
            item = self._waiting.popleft()
            self._room += self._size_of(item)
            self._changed.notify_all()
            return item

    def head(self) -> T | None:
        """The next item, without taking it; None while it is not ready.

        Raises:
            StopIteration: There are no more items.
            BaseException: What the source raised.
        """
        with self._changed:
            if self._waiting:
                return self._waiting[0]
            if self._error is not None:
                raise self._error
            if self._is_over:
                raise StopIteration
            return None

    def _work(self) -> None:
        try:
            for item in self._items:
                size = self._size_of(item)
                with self._changed:
                    self._changed.wait_for(
                        lambda: size <= self._room or not self._waiting or self._is_over  # noqa: B023
                    )
                    if self._is_over:
                        break
                    is_first = not self._waiting
                    self._room -= size
                    self._waiting.append(item)
                    self._changed.notify_all()
                if is_first:
                    self._on_ready()
        except BaseException as error:
            self._error = error
        finally:
            close = getattr(self._items, "close", None)
            if close is not None:  # a generator may have open files
                close()
            self._end()
            self._on_ready()

    def _end(self) -> None:
        with self._changed:
            self._is_over = True
            self._changed.notify_all()

    def close(self) -> None:
        """End the thread after the current item, and wait until it has closed its source."""
        with self._changed:
            self._waiting.clear()
        self._end()
        for source in [*self._sources]:  # for one of which the thread may be waiting
            source._end()
        self._thread.join()
        for source in self._sources:
            source.close()


# ---------------------------------------------------------------- timeline


IsLate = Callable[[int], bool]
"""Called with the log time of a frame before it is decoded; a late frame is dropped."""

_MERGED_AHEAD = 64 << 20
"""Bytes of all topics waiting to be published; decoded frames wait in queues of their own, too."""

_LEAST_SIZE = 64 << 10
"""Minimum size counted for a message: a thousand small ones wait, as with `ros2 bag play`."""


class Timeline:
    """The messages to play, of several datasets, merged by log time.

    Args:
        datasets: Open datasets; not closed here.
        options: How to play them.
        world: Convert messages to this.

    Attributes:
        channels: All channels that are published, as far as that is known beforehand.
        republishers: What converts the messages of each dataset.
        start_ns: Log time of the first message, nanoseconds.
        end_ns: Log time of the last message, nanoseconds.
        play_from: The first time to play.
        play_until: The last time to play: of several, the latest, as in `ros2 bag play`.

    Raises:
        OptionError: There is nothing to play.
        ConversionError: A topic cannot be published; names it.
    """

    def __init__(self, datasets: Sequence[Dataset], options: PlayOptions, world: World) -> None:
        topics = [topic for dataset in datasets for topic in dataset.all_topics]
        options.check_topics(topics)
        self._topics = {rooted(topic): topic for topic in topics if options.wants(topic)}
        for topic in options.rules:
            if topic not in self._topics:
                raise OptionError(f"`remap` {topic!r}: there is no such topic to play.")
        self._options = options
        self._parts = [_Part(dataset, options, world) for dataset in datasets]
        self.channels = [channel for part in self._parts for channel in part.channels]
        self.republishers = [part.republisher for part in self._parts]
        spans = [part.span for part in self._parts if part.span]
        if not spans:
            raise OptionError("There is no message to play.")
        self.start_ns = min(first for first, _ in spans)
        self.end_ns = max(last for _, last in spans)
        self.play_from = self.start_ns + round(options.start_offset * NS)
        if self.play_from > self.end_ns:
            raise OptionError(
                f"`start_offset` {options.start_offset:g} is past the end: the recording has "
                f"{(self.end_ns - self.start_ns) / NS:.3f} s."
            )
        ends = []
        if options.duration is not None:
            ends.append(self.play_from + round(options.duration * NS))
        if options.until_sec is not None and options.until_sec >= 0:
            ends.append(round(options.until_sec * NS))
        if options.until_nsec is not None and options.until_nsec >= 0:
            ends.append(options.until_nsec)
        self.play_until = min(max(ends, default=self.end_ns), self.end_ns)

    def play(
        self, start_ns: int, *, is_late: IsLate, on_ready: Callable[[], None]
    ) -> ReadAhead[Message]:
        """The messages from a time on, on channels that are published; read by threads.

        Args:
            start_ns: The earliest log time to read.
            is_late: Called before a frame is decoded.
            on_ready: Called, from another thread, when a message becomes available.
        """
        sources: list[ReadAhead[Any]] = []

        def ahead(items: Iterator[T]) -> Iterator[T]:
            sources.append(ReadAhead(items, self._options.read_ahead))
            return sources[-1]

        merged = heapq.merge(
            *(part.messages(start_ns, is_late, ahead) for part in self._parts),
            key=lambda message: message.log_time,
        )
        return ReadAhead(
            merged, _MERGED_AHEAD, size_of=_size_of, on_ready=on_ready, sources=sources
        )

    def is_frame(self, message: Message) -> bool:
        """Whether a message that is published is an image."""
        return any(part.republisher.is_frame(message) for part in self._parts)

    def named(self, option: str, topics: Sequence[str]) -> frozenset[str]:
        """The names that topics are published under.

        Args:
            option: The option that names the topics, for errors.
            topics: Their recorded names.

        Raises:
            OptionError: No such topic is played.
        """
        for topic in topics:
            if rooted(topic) not in self._topics:
                raise OptionError(f"`{option}` {topic!r}: there is no such topic to play.")
        return frozenset(self._options.renamed(self._topics[rooted(topic)]) for topic in topics)

    def latched(self, time_ns: int) -> list[Message]:
        """The latched messages that a late subscriber would have got by a time."""
        return [message for part in self._parts for message in part.latched(time_ns)]


def _size_of(message: Message) -> int:
    return max(len(message.data), _LEAST_SIZE)


class _Part:
    """A dataset that is played.

    Attributes:
        republisher: Converts its messages.
        channels: Those that are published.
    """

    def __init__(self, dataset: Dataset, options: PlayOptions, world: World) -> None:
        self._dataset = dataset
        if options.layer is None and (absence := dataset.absence(options.wants)):
            warnings.warn(f"{dataset.path}: {absence}; the views are played", stacklevel=2)
        self._topics = {item.topic for item in dataset.channels if options.wants(item.topic)}
        self.republisher = Republisher(
            dataset,
            world,
            selected=options.wants,
            converts_all=True,
            kind=KINDS[options.publish_as] if options.publish_as else None,
            jpeg_quality=options.jpeg_quality,
            renamed=options.renamed,
        )
        self.channels = [self.republisher.outgoing(item) for item in self.republisher.channels]

    @property
    def span(self) -> tuple[int, int] | None:
        """Log times of the first and the last message of the topics played."""
        times = [one for one in self._dataset.times(self._topics).values() if len(one)]
        if not times:
            return None
        first, last = min(int(item[0]) for item in times), max(int(item[-1]) for item in times)
        begin = self._dataset.slice_start  # latched messages from before it are sent at first
        return (first if begin is None else min(max(first, begin), last)), last

    def messages(self, start_ns: int, is_late: IsLate, ahead: Ahead) -> Iterator[Message]:
        """Messages from a time on."""
        streams = [item for item in self._dataset.streams if item.topic in self._topics]
        frames = [stream.columns for stream in streams]

        def in_time(columns: DecodedColumns) -> Iterator[int]:
            if not any(columns is item for item in frames):
                return everything(columns)
            times = columns.log_time
            due = np.flatnonzero(times >= start_ns).tolist()
            return (index for index in due if not is_late(int(times[index])))

        records = self._dataset.records(
            self.republisher.sources,
            start=start_ns,
            choose=in_time,
            topics=self._topics,
            ahead=ahead,
        )
        return (
            self.republisher.converted(record) for record in records if isinstance(record, Message)
        )

    def latched(self, time_ns: int) -> Iterator[Message]:
        """The latched messages of each channel at a time."""
        channels = [item for item in self._dataset.channels if item.topic in self._topics]
        kept = {item.id: LatchedMessages(item) for item in filter(has_late, channels)}
        topics = {item.topic for item in channels if item.id in kept}
        most = max((latched_depth(item) for item in channels if item.id in kept), default=1)
        earlier = self._dataset.records(end=time_ns, choose=last_of(time_ns, most), topics=topics)
        for message in earlier if topics else ():
            if isinstance(message, Message) and message.channel.id in kept:
                kept[message.channel.id].add(message)
        messages = sorted(chain.from_iterable(kept.values()), key=lambda item: item.log_time)
        return map(self.republisher.converted, messages)
