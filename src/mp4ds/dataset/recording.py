"""A dataset as a recording, so that it can be repacked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.protocols import BagReader, stats_of
from mp4ds.dataset.dataset import Dataset
from mp4ds.errors import advising
from mp4ds.format.manifest import Manifest
from mp4ds.format.sidecars import COPY_AGAIN, MANIFEST_NAME, load_manifest
from mp4ds.records import Channel, ChannelStats, Excerpt, Message, Record, Schema

_BEST_JPEG = 100


class DatasetReader(BagReader):
    """The recording held by a dataset.

    Messages of lossy streams have the pixels of the videos; re-encoded JPEG files are made with the
    best quality.

    Args:
        path: The folder, or its manifest; or its URL.

    Attributes:
        manifest: Of the dataset.
        begin: Where the slice that it holds was cut, after which its own slices are counted.

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
        self.format = self.manifest.format
        self.profile = self.manifest.recording_profile
        self.library = self.manifest.library
        self.begin = self._dataset.slice_start
        names = [MANIFEST_NAME, *(entry.name for entry in self.manifest.files)]
        self.files = [self.path / name for name in names]
        self._read = 0

    @property
    def channels(self) -> Sequence[Channel]:
        """All channels."""
        return self._dataset.channels

    @property
    def unused_schemas(self) -> Sequence[Schema]:
        """Definitions that no channel refers to."""
        return self._dataset.unused_schemas

    @property
    def position(self) -> int:
        """Bytes of its files in proportion to the messages read."""
        total = sum(entry.size for entry in self.manifest.files)
        return total * self._read // max(1, self.manifest.messages)

    @cached_property
    def is_indexed(self) -> bool:
        """Whether the messages of each channel are in the order of their log times."""
        return self._dataset.is_in_time

    def _records(self, excerpt: Excerpt) -> Iterator[Record]:
        """Its records, decoded; without those that an excerpt lacks."""
        self._read = 0
        with advising(COPY_AGAIN):
            for record in self._decoded(excerpt):
                yield record
                self._read += isinstance(record, Message)

    def _decoded(self, excerpt: Excerpt) -> Iterator[Record]:
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

    def _times(self) -> Mapping[int, NDArray[np.int64]]:
        """Log times by channel id, nanoseconds, from the sidecars."""
        return self._recorded_times

    @cached_property
    def _recorded_times(self) -> Mapping[int, NDArray[np.int64]]:
        return self._dataset.times()

    def _stats(self) -> Mapping[int, ChannelStats]:
        """Counts and spans of the log times, whether they are in order or not."""
        return stats_of(self._recorded_times)

    def close(self) -> None:
        """Close the dataset."""
        self._dataset.close()
