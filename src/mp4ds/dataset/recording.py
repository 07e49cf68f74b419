"""A dataset as a recording, so that it can be repacked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.protocols import Format, first_of
from mp4ds.dataset.dataset import Dataset
from mp4ds.errors import advising
from mp4ds.format.manifest import Manifest
from mp4ds.format.sidecars import COPY_AGAIN, MANIFEST_NAME, load_manifest
from mp4ds.records import EVERYTHING, Channel, ChannelStats, Excerpt, Message, Record, Schema

_BEST_JPEG = 100


class DatasetReader:
    """The recording held by a dataset. See `BagReader`.

    Messages of lossy streams have the pixels of the videos; re-encoded JPEG files are made with the
    best quality.

    Args:
        path: The folder, or its manifest; or its URL.

    Attributes:
        manifest: Of the dataset.
        slice_start: See `Dataset.slice_start`.

    Raises:
        FormatError: A file breaks a rule of the format.
        SourceError: It is not a dataset.
    """

    def __init__(self, path: Path) -> None:
        with advising(COPY_AGAIN):
            self._dataset = Dataset(path, jpeg_quality=_BEST_JPEG)
            self._dataset.verify_sidecars()
        self.path = self._dataset.path
        self.manifest: Manifest = load_manifest(self.path / MANIFEST_NAME)
        self.profile = self.manifest.recording_profile
        self.library = self.manifest.library
        self.slice_start = self._dataset.slice_start
        names = [MANIFEST_NAME, *(entry.name for entry in self.manifest.files)]
        self.files: Sequence[Path] = [self.path / name for name in names]
        self.skipped: Mapping[str, int] = {}
        self._read = 0

    @property
    def format(self) -> Format:
        """See `BagReader.format`."""
        return self.manifest.format

    @property
    def channels(self) -> Sequence[Channel]:
        """See `BagReader.channels`."""
        return self._dataset.channels

    @property
    def unused_schemas(self) -> Sequence[Schema]:
        """See `BagReader.unused_schemas`."""
        return self._dataset.unused_schemas

    @property
    def position(self) -> int:
        """See `BagReader.position`; by the number of messages."""
        total = sum(entry.size for entry in self.manifest.files)
        return total * self._read // max(1, self.manifest.messages)

    @cached_property
    def is_indexed(self) -> bool:
        """See `BagReader.is_indexed`."""
        return self._dataset.is_in_time

    def records(self, excerpt: Excerpt = EVERYTHING) -> Iterator[Record]:
        """See `BagReader.records`."""
        self._read = 0
        with advising(COPY_AGAIN):
            for record in self._records(excerpt):
                yield record
                self._read += isinstance(record, Message)

    def _records(self, excerpt: Excerpt) -> Iterator[Record]:
        start, end = excerpt.start, excerpt.end
        if (start is None and end is None) or not self.is_indexed:
            records = self._dataset.records(topics=self._topics(excerpt))
            return filter(excerpt.has, records)
        return self._span(excerpt, start, end)

    def _span(self, excerpt: Excerpt, start: int | None, end: int | None) -> Iterator[Record]:
        if excerpt.others:
            yield from self._dataset.other_records()
        if excerpt.has_messages:
            topics = self._topics(excerpt)
            yield from self._dataset.records(start=start, end=end, topics=topics)

    def _topics(self, excerpt: Excerpt) -> frozenset[str] | None:
        if excerpt.topics is None and not excerpt.without:
            return None
        return frozenset(
            channel.topic for channel in self.channels if excerpt.has_topic(channel.topic)
        )

    def stats(self) -> Mapping[int, ChannelStats]:
        """See `BagReader.stats`."""
        return {
            key: ChannelStats(len(times), int(times[0]), int(times[-1]))
            for key, times in self.times().items()
            if len(times)
        }

    def times(self) -> Mapping[int, NDArray[np.int64]]:
        """See `BagReader.times`."""
        return self._times

    @cached_property
    def _times(self) -> Mapping[int, NDArray[np.int64]]:
        return self._dataset.times()

    def first(self, channel: Channel) -> Message | None:
        """See `BagReader.first`."""
        times = self._times.get(channel.id)
        if times is None or not len(times):
            return None
        start = int(times[0])
        span = Excerpt(start, start + 1, frozenset([channel.topic]), others=False)
        return first_of(self.records(span)).get(channel.id)

    def __enter__(self) -> DatasetReader:
        return self

    def __exit__(self, *_: object) -> None:
        self._dataset.close()
