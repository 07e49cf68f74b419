"""A time slice of a recording, read as a recording."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.protocols import BagReader, Format, first_of
from mp4ds.bags.salvage.losses import losses_of
from mp4ds.errors import SourceError
from mp4ds.options import Slice
from mp4ds.records import EVERYTHING, Channel, ChannelStats, Excerpt, Loss, Message, Record, Schema


class SliceReader:
    """The messages of a recording logged within a time slice. See `BagReader`.

    Attachments, metadata records, channels and definitions are those of the whole recording.

    Args:
        reader: The recording, closed together with this reader.
        asked: The requested slice.

    Attributes:
        span: The slice, as times of the recording.

    Raises:
        OptionError: It is empty, or a time is not valid.
        SourceError: The recording is damaged, or without messages.
    """

    def __init__(self, reader: BagReader, asked: Slice) -> None:
        self._reader = reader
        self.path, self.profile = reader.path, reader.profile
        self.library, self.files = reader.library, reader.files
        known = [item for item in reader.stats().values() if item.count]
        if not known or not reader.is_indexed:
            arrays = [times for times in reader.times().values() if len(times)]
            known = [ChannelStats(len(one), int(one[0]), int(one[-1])) for one in arrays]
        if not known:
            raise SourceError(reader.path, "has no messages to take a slice of")
        first, last = min(item.start for item in known), max(item.end for item in known)
        self.span = Excerpt(*asked.times(first, last, reader.path))

    @property
    def format(self) -> Format:
        """See `BagReader.format`."""
        return self._reader.format

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
        return losses_of(self._reader)

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
        return self._reader.records(excerpt.within(self.span))

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
        found = {key: in_span(times, self.span) for key, times in self._reader.times().items()}
        return {key: times for key, times in found.items() if len(times)}

    def first(self, channel: Channel) -> Message | None:
        """See `BagReader.first`."""
        if channel.id not in self._times:
            return None
        start = int(self._times[channel.id][0])
        excerpt = Excerpt(start, start + 1, frozenset([channel.topic]), others=False)
        return first_of(self.records(excerpt)).get(channel.id)

    def __enter__(self) -> SliceReader:
        return self

    def __exit__(self, *_: object) -> None:
        self._reader.__exit__()


def in_span(times: NDArray[np.int64], span: Excerpt) -> NDArray[np.int64]:
    """The part of sorted log times, nanoseconds, within the span of an excerpt; a view."""
    first = 0 if span.start is None else int(np.searchsorted(times, span.start))
    end = len(times) if span.end is None else int(np.searchsorted(times, span.end))
    return times[first:end]
