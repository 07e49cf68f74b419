"""The messages of several datasets, merged, as they are published, from any time on."""

from __future__ import annotations

import heapq
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Generic, TypeVar

import numpy as np

from mp4ds.bags.convert import Converter
from mp4ds.bags.latched import LatchedMessages, has_late, latched_depth
from mp4ds.dataset.columns import DecodedColumns, everything
from mp4ds.dataset.dataset import Ahead, Dataset
from mp4ds.errors import OptionError
from mp4ds.plugins.playing.options import KINDS, Names, PlayOptions, Wanted, rooted
from mp4ds.records import Channel, Message
from mp4ds.unpacking.pictures import Reduction
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
    """

    def __init__(
        self,
        items: Iterator[T],
        room: int,
        *,
        size_of: Callable[[T], int] = lambda _: 1,
        on_ready: Callable[[], None] | None = None,
    ) -> None:
        self._items = items
        self._room = room
        self._size_of = size_of
        self._on_ready = on_ready
        self._changed = threading.Condition()
        self._waiting: deque[T] = deque()
        self._is_closed = False
        self._is_done = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def __len__(self) -> int:
        """Number of items waiting."""
        return len(self._waiting)

    def __iter__(self) -> Iterator[T]:
        return self

    def __next__(self) -> T:
        with self._changed:
            while not self._waiting and not self._is_done and not self._is_closed:
                self._changed.wait()
            return self._take()

    def head(self) -> T | None:
        """The next item, without taking it; None while it is not ready.

        Raises:
            StopIteration: There are no more items.
            BaseException: What the source raised.
        """
        with self._changed:
            if self._waiting:
                return self._waiting[0]
            if self._is_done or self._is_closed:
                return self._take()
            return None

    def _take(self) -> T:
        if self._waiting:
            item = self._waiting.popleft()
            self._room += self._size_of(item)
            self._changed.notify_all()
            return item
        if self._error is not None:
            raise self._error
        raise StopIteration

    def _work(self) -> None:
        try:
            for item in self._items:
                if not self._put(item):
                    break
        except BaseException as error:
            self._error = error
        finally:
            close = getattr(self._items, "close", None)
            if close is not None:  # a generator may have open files
                close()
            with self._changed:
                self._is_done = True
                self._changed.notify_all()
            self._notify()

    def _put(self, item: T) -> bool:
        with self._changed:
            size = self._size_of(item)
            while self._waiting and size > self._room and not self._is_closed:
                self._changed.wait()
            if self._is_closed:
                return False
            is_first = not self._waiting
            self._room -= size
            self._waiting.append(item)
            self._changed.notify_all()
        if is_first:
            self._notify()
        return True

    def _notify(self) -> None:
        if self._on_ready is not None:
            self._on_ready()

    def stop(self) -> None:
        """Tell the thread to end after the current item."""
        with self._changed:
            self._is_closed = True
            self._waiting.clear()
            self._changed.notify_all()

    def join(self) -> None:
        """Wait until the thread has ended and closed its source."""
        self._thread.join()


# ---------------------------------------------------------------- timeline


IsLate = Callable[[int], bool]
"""Called with the log time of a frame before it is decoded; a late frame is dropped."""

_MERGED_AHEAD = 64 << 20
"""Bytes of all topics waiting to be published; decoded frames wait in queues of their own, too."""

_LEAST_SIZE = 64 << 10
"""Minimum size counted for a message: a thousand small ones wait, as with `ros2 bag play`."""


@dataclass(frozen=True, slots=True)
class Due:
    """A message to be published.

    Attributes:
        time_ns: When, in recording time.
        channel: The channel to publish it on, one of `Timeline.channels`.
        payload: The serialized message.
        is_frame: Whether it is an image.
    """

    time_ns: int
    channel: Channel
    payload: bytes | memoryview
    is_frame: bool


class Timeline:
    """The messages to play, merged by log time.

    Args:
        datasets: Open datasets; not closed here.
        options: How to play them.
        world: Convert messages to this: ``ros1`` or ``ros2``; None: as recorded.

    Attributes:
        channels: All channels that are published.
        start_ns: Log time of the first message, nanoseconds.
        end_ns: Log time of the last message, nanoseconds.

    Raises:
        OptionError: There is nothing to play.
        ConversionError: A topic cannot be published; names it.
    """

    def __init__(
        self, datasets: Sequence[Dataset], options: PlayOptions, world: str | None
    ) -> None:
        wanted, names = Wanted(options), Names(options)
        topics = [topic for dataset in datasets for topic in dataset.all_topics]
        wanted.check(topics)
        names.check(topic for topic in topics if wanted(topic))
        self._read_ahead = options.read_ahead
        self._names = {rooted(topic): names(topic) for topic in topics if wanted(topic)}
        self._parts = [_Part(dataset, options, wanted, names, world) for dataset in datasets]
        self.channels = [channel for part in self._parts for channel in part.published]
        spans = [part.span for part in self._parts if part.span]
        if not spans:
            raise OptionError("There is no message to play.")
        self.start_ns = min(first for first, _ in spans)
        self.end_ns = max(last for _, last in spans)

    @property
    def republishers(self) -> list[Republisher]:
        """What converts or reduces images, of each dataset, if anything does."""
        return [part.republisher for part in self._parts if part.republisher]

    def play(
        self,
        start_ns: int,
        *,
        is_late: IsLate,
        on_ready: Callable[[], None],
    ) -> Playback:
        """Start reading from a time on, in threads.

        Args:
            start_ns: The earliest log time to read.
            is_late: Called before a frame is decoded.
            on_ready: Called, from another thread, when a message becomes available.
        """
        return Playback(self._parts, start_ns, self._read_ahead, is_late, on_ready)

    def named(self, option: str, topics: Sequence[str]) -> frozenset[str]:
        """The names that topics are published under.

        Args:
            option: The option that names the topics, for errors.
            topics: Their recorded names.

        Raises:
            OptionError: No such topic is played.
        """
        for topic in topics:
            if rooted(topic) not in self._names:
                raise OptionError(f"`{option}` {topic!r}: there is no such topic to play.")
        return frozenset(self._names[rooted(topic)] for topic in topics)

    def latched(self, time_ns: int) -> list[Due]:
        """The latched messages that a late subscriber would have got by a time."""
        return [due for part in self._parts for due in part.latched(time_ns)]


class Playback:
    """Messages from a time on, read ahead by threads."""

    def __init__(
        self,
        parts: Sequence[_Part],
        start_ns: int,
        depth: int,
        is_late: IsLate,
        on_ready: Callable[[], None],
    ) -> None:
        self._sources: list[ReadAhead[object]] = []
        self._is_closing = False

        def ahead(items: Iterator[T]) -> Iterator[T]:
            made = ReadAhead(items, depth)
            self._sources.append(made)  # type: ignore[arg-type]
            if self._is_closing:
                made.stop()
            return made

        merged = heapq.merge(
            *(part.messages(start_ns, is_late, ahead) for part in parts),
            key=lambda due: due.time_ns,
        )
        self._merged = ReadAhead(merged, _MERGED_AHEAD, size_of=_size_of, on_ready=on_ready)

    def head(self) -> Due | None:
        """The next message, without taking it; None while it is not ready.

        Raises:
            StopIteration: There are no more messages.
            Mp4dsError: A dataset is damaged.
        """
        return self._merged.head()

    def take(self) -> None:
        """Take the next message."""
        next(self._merged)

    def close(self) -> None:
        """End the threads."""
        self._is_closing = True
        self._merged.stop()
        for source in [*self._sources]:
            source.stop()
        self._merged.join()
        for source in self._sources:
            source.join()


def _size_of(due: Due) -> int:
    return max(len(due.payload), _LEAST_SIZE)


class _Part:
    """A dataset, and its channels as they are published."""

    def __init__(
        self,
        dataset: Dataset,
        options: PlayOptions,
        wanted: Wanted,
        names: Names,
        world: str | None,
    ) -> None:
        self._dataset = dataset
        self._converter = Converter(world)
        self._names = names
        self.republisher: Republisher | None = None
        if options.publish_as is not None or options.reduction != Reduction():
            self.republisher = Republisher(
                dataset,
                KINDS[options.publish_as] if options.publish_as else None,
                encoding="ros1" if (world or dataset.profile) == "ros1" else "cdr",
                selected=wanted,
                jpeg_quality=options.jpeg_quality,
                reduction=options.reduction,
            )
        self._wanted = wanted
        self._topics = {item.topic for item in dataset.channels if wanted(item.topic)}
        self.span = self._span()
        self._channels: dict[int, Channel] = {}
        self._frames = {item.channel.id for item in dataset.image_channels()}
        for channel in dataset.channels:
            is_emptied = self.republisher is not None and self.republisher.empties(channel)
            if wanted(channel.topic) and not is_emptied:
                self._add(channel, self._converter.channel(channel))
        for channel in self.republisher.channels if self.republisher else ():
            self._frames.add(channel.id)
            self._add(channel, channel)

    def _span(self) -> tuple[int, int] | None:
        """Log times of the first and the last message of the topics played."""
        times = [one for one in self._dataset.times(self._topics).values() if len(one)]
        if not times:
            return None
        first, last = min(int(item[0]) for item in times), max(int(item[-1]) for item in times)
        begin = self._dataset.slice_start  # latched messages from before it are sent at first
        return (first if begin is None else min(max(first, begin), last)), last

    @property
    def published(self) -> list[Channel]:
        """The channels that are published."""
        return list(self._channels.values())

    def _add(self, source: Channel, channel: Channel) -> Channel:
        self._channels[source.id] = replace(channel, topic=self._names(channel.topic))
        return self._channels[source.id]

    def messages(self, start_ns: int, is_late: IsLate, ahead: Ahead) -> Iterator[Due]:
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
            self.republisher.sources if self.republisher else None,
            start=start_ns,
            choose=in_time,
            topics=self._topics,
            ahead=ahead,
        )
        for record in records:
            if isinstance(record, Message) and (due := self._due(record)):
                yield due

    def _due(self, message: Message) -> Due | None:
        source = message.channel
        channel = self._channels.get(source.id)
        if channel is None:
            if not self._wanted(source.topic):
                return None
            channel = self._add(source, self._converter.channel(source))
        payload = message.data
        if self.republisher is None or not self.republisher.makes(source):
            payload = self._converter.payload(source, payload)
        return Due(message.log_time, channel, payload, source.id in self._frames)

    def latched(self, time_ns: int) -> Iterator[Due]:
        """The latched messages of each channel at a time."""
        channels = [item for item in self._dataset.channels if item.topic in self._topics]
        kept = {item.id: LatchedMessages[Message](item) for item in filter(has_late, channels)}
        topics = {item.topic for item in channels if item.id in kept}
        most = max((latched_depth(item) for item in channels if item.id in kept), default=1)
        for message in self._dataset.before(time_ns, topics, most) if topics else ():
            if message.channel.id in kept:
                kept[message.channel.id].add(message.data, message)
        messages = sorted(chain.from_iterable(kept.values()), key=lambda item: item.log_time)
        for message in messages:
            if due := self._due(message):
                yield due
