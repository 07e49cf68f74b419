"""The messages of several datasets as they are to be published, from any time on."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from mp4ds.bags.convert import Converter, is_latched
from mp4ds.channels import Ahead
from mp4ds.dataset import Dataset
from mp4ds.errors import OptionError
from mp4ds.playing.names import Names, Wanted
from mp4ds.playing.read_ahead import ReadAhead
from mp4ds.records import Channel, Message
from mp4ds.republish import Reduction, Republisher
from mp4ds.streams.choices import everything
from mp4ds.streams.rebuild import DecodedColumns

T = TypeVar("T")

IsLate = Callable[[int], bool]
"""Asked with the log time of a frame before it is made; if it is late, it is left out."""

_MERGED_AHEAD = 64
"""Messages, all topics together, that wait to be published; frames wait where they are made."""


@dataclass(frozen=True, slots=True)
class Due:
    """A message to be published.

    Attributes:
        time_ns: When, in the recording's time.
        channel: The channel to publish it on; one of `Timeline.channels`.
        payload: The serialized message.
        is_frame: Whether it is an image.
    """

    time_ns: int
    channel: Channel
    payload: bytes | memoryview
    is_frame: bool


class Timeline:
    """What is played, merged by log time.

    Args:
        datasets: Opened; not closed here.
        world: What the messages have to be in: ``ros1``, ``ros2``; None for as recorded.
        wanted: Which topics.
        names: What they are called.
        kind: What images are given as: one of `mp4ds.republish.KINDS`; None for as recorded.
        reduction: How much smaller or fewer images are given.
        jpeg_quality: Of JPEG files that are made, 1 to 100.
        read_ahead: Frames of each stream that are made ahead.

    Attributes:
        channels: All that is published.
        start_ns: Log time of the first message, nanoseconds.
        end_ns: Log time of the last message, nanoseconds.

    Raises:
        OptionError: Nothing is to be played.
        ConversionError: A topic cannot be published there; names it.
    """

    def __init__(
        self,
        datasets: Sequence[Dataset],
        *,
        world: str | None,
        wanted: Wanted,
        names: Names,
        kind: str | None = None,
        reduction: Reduction = Reduction(),  # noqa: B008 - frozen
        jpeg_quality: int = 95,
        read_ahead: int = 8,
    ) -> None:
        topics = [channel.topic for dataset in datasets for channel in dataset.channels]
        wanted.check(topics)
        names.check(topic for topic in topics if wanted(topic))
        self._read_ahead = read_ahead
        self._parts = [
            _Part(dataset, world, wanted, names, kind, reduction, jpeg_quality)
            for dataset in datasets
        ]
        self.channels = [channel for part in self._parts for channel in part.published]
        spans = [part.span for part in self._parts if part.span]
        if not spans:
            raise OptionError("there is no message to be played.")
        self.start_ns = min(first for first, _ in spans)
        self.end_ns = max(last for _, last in spans)

    @property
    def as_recorded(self) -> dict[str, dict[str, int]]:
        """Camera topics of which messages stay as recorded where another form was asked for."""
        return {
            topic: dict(reasons)
            for part in self._parts
            if part.republisher
            for topic, reasons in part.republisher.as_recorded.items()
        }

    @property
    def thinned(self) -> dict[str, int]:
        """Frames left out on request so far, by topic."""
        return {
            topic: count
            for part in self._parts
            if part.republisher
            for topic, count in part.republisher.thinned.items()
        }

    def play(
        self,
        start_ns: int,
        *,
        is_late: IsLate,
        on_ready: Callable[[], None],
    ) -> Playback:
        """Begin to read, by threads, from a time on.

        Args:
            start_ns: Log time of the first message that may come.
            is_late: Asked before a frame is made.
            on_ready: Called, from another thread, when a message can be had.
        """
        return Playback(self._parts, start_ns, self._read_ahead, is_late, on_ready)

    def latched(self, time_ns: int) -> list[Due]:
        """The last message before a time of each latched channel."""
        return [due for part in self._parts for due in part.latched(time_ns)]


class Playback:
    """Messages from a time on, read ahead by threads. See `Timeline.play`."""

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
        self._merged = ReadAhead(merged, _MERGED_AHEAD, on_ready=on_ready)

    def head(self) -> Due | None:
        """The next message, which stays; None while it is not made yet.

        Raises:
            StopIteration: There are no more.
            Mp4dsError: A dataset is damaged.
        """
        return self._merged.head()

    def take(self) -> None:
        """Go on to the message after the `head`."""
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


class _Part:
    """One dataset, and what its channels are where they are published."""

    def __init__(
        self,
        dataset: Dataset,
        world: str | None,
        wanted: Wanted,
        names: Names,
        kind: str | None,
        reduction: Reduction,
        jpeg_quality: int,
    ) -> None:
        self._dataset = dataset
        self._converter = Converter(world)
        self._names = names
        self.republisher: Republisher | None = None
        if kind is not None or reduction != Reduction():
            encoding = "ros1" if (world or dataset.profile) == "ros1" else "cdr"
            self.republisher = Republisher(
                dataset,
                kind,
                encoding=encoding,
                selected=wanted,
                jpeg_quality=jpeg_quality,
                reduction=reduction,
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
        """Log times of the first and the last message of the topics that are wanted."""
        ids = {item.id for item in self._dataset.channels if item.topic in self._topics}
        times = [times for key, times in self._dataset.times().items() if key in ids and len(times)]
        if not times:
            return None
        return min(int(item[0]) for item in times), max(int(item[-1]) for item in times)

    @property
    def published(self) -> list[Channel]:
        """All that is published."""
        return list(self._channels.values())

    def _add(self, source: Channel, channel: Channel) -> Channel:
        self._channels[source.id] = replace(channel, topic=self._names(channel.topic))
        return self._channels[source.id]

    def messages(self, start_ns: int, is_late: IsLate, ahead: Ahead) -> Iterator[Due]:
        """Messages from a time on; see `Timeline.play`."""
        frames = [stream.rebuilder.columns for stream in self._dataset.streams]

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
        """The last message before a time, of each latched channel."""
        channels = [item for item in self._dataset.channels if item.topic in self._topics]
        for message in self._dataset.last_before(time_ns, [*filter(is_latched, channels)]):
            if due := self._due(message):
                yield due
