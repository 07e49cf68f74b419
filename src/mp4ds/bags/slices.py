"""A time slice of a recording, read as a recording."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.latched import begun_by, latched_before
from mp4ds.bags.protocols import BagReader, first_of
from mp4ds.errors import SourceError
from mp4ds.options import Slice
from mp4ds.records import EVERYTHING, Channel, ChannelStats, Excerpt, Loss, Message, Record, Schema

_NO_TIMES = np.empty(0, np.int64)


class SliceReader(BagReader):
    """The messages of a recording logged within a time slice. See `BagReader`.

    Attachments, metadata records, channels and definitions are those of the whole recording. If
    requested, the latched messages from before the slice are the first of its messages.

    Args:
        reader: The recording, closed together with this reader.
        asked: The requested slice.
        begin: The time from which it is counted, nanoseconds; None for the first message.

    Attributes:
        excerpt: The slice, as times of the recording.

    Raises:
        OptionError: It is empty, or a time is not valid.
        SourceError: The recording is damaged, or without messages.
    """

    def __init__(self, reader: BagReader, asked: Slice, begin: int | None = None) -> None:
        self._reader = reader
        self.format = reader.format
        self.path, self.profile = reader.path, reader.profile
        self.library, self.files = reader.library, reader.files
        known = [item for item in reader.stats().values() if item.count]
        if not known or not reader.is_indexed:
            arrays = [times for times in reader.times().values() if len(times)]
            known = [ChannelStats(len(one), int(one[0]), int(one[-1])) for one in arrays]
        if not known:
            raise SourceError(reader.path, "has no messages to take a slice of")
        first, last = min(item.start for item in known), max(item.end for item in known)
        first = max(first, begin or first)
        self.excerpt = Excerpt(*asked.times(first, last, reader.path))
        self._has_latched = asked.latched and self.excerpt.start is not None

    @property
    def channels(self) -> Sequence[Channel]:
        """See `BagReader.channels`."""
        return self._reader.channels

    @property
    def unused_schemas(self) -> Sequence[Schema]:
        """See `BagReader.unused_schemas`."""
        return self._reader.unused_schemas

    @property
    def skipped(self) -> Mapping[str, int]:
        """See `BagReader.skipped`."""
        return self._reader.skipped

    @property
    def losses(self) -> Sequence[Loss]:
        """The losses of the whole recording."""
        return self._reader.losses

    @property
    def position(self) -> int:
        """See `BagReader.position`."""
        return self._reader.position

    @property
    def is_indexed(self) -> bool:
        """See `BagReader.is_indexed`."""
        return self._reader.is_indexed

    def records(self, excerpt: Excerpt = EVERYTHING) -> Iterator[Record]:
        """See `BagReader.records`."""
        latched = [message for message in self._latched[0] if excerpt.has(message)]
        return begun_by(latched, self._reader.records(excerpt.within(self.excerpt)))

    @cached_property
    def _latched(self) -> tuple[Sequence[Message], Sequence[str]]:
        if not self._has_latched:
            return (), ()
        times, before = self._reader.times(), Excerpt(end=self.excerpt.start, others=False)
        sent = [c for c in self.channels if len(in_span(times.get(c.id, _NO_TIMES), before))]

        def read(topics: frozenset[str], _: int) -> Iterator[Record]:
            return self._reader.records(replace(before, topics=topics))

        return latched_before(sent, read)

    @property
    def latched(self) -> Mapping[str, int]:
        """Number of latched messages from before the slice, by topic."""
        return Counter(message.channel.topic for message in self._latched[0])

    @property
    def latched_left_out(self) -> Sequence[str]:
        """Latched topics whose messages from before the slice are too large to be included."""
        return self._latched[1]

    def stats(self) -> Mapping[int, ChannelStats]:
        """See `BagReader.stats`."""
        if not self.is_indexed:
            return {}
        return {
            key: ChannelStats(len(times), int(times[0]), int(times[-1]))
            for key, times in self.times().items()
        }

    def times(self) -> Mapping[int, NDArray[np.int64]]:
        """See `BagReader.times`."""
        return self._times

    @cached_property
    def _times(self) -> Mapping[int, NDArray[np.int64]]:
        early: dict[int, list[int]] = {}
        for message in self._latched[0]:
            early.setdefault(message.channel.id, []).append(message.log_time)
        found = {
            key: np.concatenate(
                [np.sort(np.array(early.get(key, ()), np.int64)), in_span(times, self.excerpt)]
            )
            for key, times in self._reader.times().items()
        }
        return {key: times for key, times in found.items() if len(times)}

    def first(self, channel: Channel) -> Message | None:
        """See `BagReader.first`."""
        if channel.id not in self._times:
            return None
        start = int(self._times[channel.id][0])
        excerpt = Excerpt(start, start + 1, frozenset([channel.topic]), others=False)
        return first_of(self.records(excerpt)).get(channel.id)

    def close(self) -> None:
        """Close the recording."""
        self._reader.close()


def in_span(times: NDArray[np.int64], span: Excerpt) -> NDArray[np.int64]:
    """The part of sorted log times, nanoseconds, within the span of an excerpt; a view."""
    first = 0 if span.start is None else int(np.searchsorted(times, span.start))
    end = len(times) if span.end is None else int(np.searchsorted(times, span.end))
    return times[first:end]
