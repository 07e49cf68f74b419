"""Several recordings that belong together, read as one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.ordering import Part, merged
from mp4ds.bags.protocols import BagReader
from mp4ds.records import (
    EVERYTHING,
    Channel,
    ChannelStats,
    Excerpt,
    Message,
    Record,
    Schema,
)

_NO_STATS = ChannelStats(0, 0, 0)


class MultiReader:
    """A split recording, or recordings made side by side.

    Parts that follow each other in time are read one after the other, parts that overlap are
    merged by log time. Channels equal in all fields are one channel.

    Args:
        openers: Each opens one part; a part is open only while it is read.

    Attributes:
        is_indexed: Whether all parts are.
    """

    def __init__(self, openers: Sequence[Callable[[], BagReader]]) -> None:
        self._openers = openers
        self._channels: dict[tuple[object, ...], Channel] = {}
        self._schemas: dict[Schema, None] = {}
        self._skipped: Counter[str] = Counter()
        self._done = 0
        self._active: list[BagReader] = []
        self._stats: dict[int, ChannelStats] = {}
        self.is_indexed = True
        spans: list[tuple[int, int, int]] = []
        files: list[list[Path]] = []
        for number, opener in enumerate(openers):
            with opener() as part:
                if number == 0:
                    self.path, self.format = part.path, part.format
                    self.profile, self.library = part.profile, part.library
                elif part.profile != self.profile:
                    self.profile = ""
                self.is_indexed &= part.is_indexed
                files.append(list(part.files))
                for channel in part.channels:
                    self._shared(channel)
                self._schemas.update(dict.fromkeys(part.unused_schemas))
                stats = part.stats()
                self._add_stats(part, stats)
                known = [item for item in stats.values() if item.count]
                start = min((item.start for item in known), default=0)
                end = max((item.end for item in known), default=2**63)
                spans.append((start, end, number))
        self._spans = sorted(spans)
        self.files: Sequence[Path] = [file for *_, number in self._spans for file in files[number]]

    def _shared(self, channel: Channel) -> Channel:
        key = channel.identity
        if key not in self._channels:
            self._channels[key] = replace(channel, id=len(self._channels))
        return self._channels[key]

    def _add_stats(self, part: BagReader, stats: Mapping[int, ChannelStats]) -> None:
        for channel in part.channels:
            if channel.id in stats and stats[channel.id].count:
                shared = self._shared(channel).id
                self._stats[shared] = self._stats.get(shared, _NO_STATS).plus(stats[channel.id])

    @property
    def channels(self) -> Sequence[Channel]:
        """See `BagReader.channels`."""
        return list(self._channels.values())

    @property
    def unused_schemas(self) -> Sequence[Schema]:
        """See `BagReader.unused_schemas`."""
        return list(self._schemas)

    @property
    def skipped(self) -> Mapping[str, int]:
        """See `BagReader.skipped`."""
        return self._skipped

    @property
    def position(self) -> int:
        """See `BagReader.position`."""
        return self._done + sum(part.position for part in self._active)

    def records(self, excerpt: Excerpt = EVERYTHING) -> Iterator[Record]:
        """See `BagReader.records`."""
        self._done = 0
        self._skipped.clear()
        if self.is_indexed:
            return self._merged(excerpt)
        # What is out of order would be merged otherwise without what is not wanted.
        return filter(excerpt.has, self._merged(EVERYTHING if excerpt.has_messages else excerpt))

    def _merged(self, excerpt: Excerpt) -> Iterator[Record]:
        return merged(
            [
                Part(start, partial(self._part_records, number, excerpt))
                for start, end, number in self._spans
                if excerpt.others or excerpt.touches(start, end)
            ]
        )

    def _part_records(self, number: int, excerpt: Excerpt) -> Iterator[Record]:
        part = self._openers[number]()
        self._active.append(part)
        try:
            for record in part.records(excerpt):
                if isinstance(record, Message):
                    yield record.of_channel(self._shared(record.channel))
                else:
                    yield record
            for channel in part.channels:
                self._shared(channel)
            self._skipped.update(part.skipped)
            self._schemas.update(dict.fromkeys(part.unused_schemas))
            self._done += sum(file.stat().st_size for file in part.files)
        finally:
            self._active.remove(part)
            part.__exit__()

    def stats(self) -> Mapping[int, ChannelStats]:
        """See `BagReader.stats`."""
        return self._stats

    def times(self) -> Mapping[int, NDArray[np.int64]]:
        """See `BagReader.times`."""
        found: dict[int, list[NDArray[np.int64]]] = {}
        for opener in self._openers:
            with opener() as part:
                times = part.times()
                for channel in part.channels:
                    if channel.id in times:
                        found.setdefault(self._shared(channel).id, []).append(times[channel.id])
        return {key: np.sort(np.concatenate(arrays)) for key, arrays in found.items()}

    def first(self, channel: Channel) -> Message | None:
        """See `BagReader.first`."""
        best: Message | None = None
        for opener in self._openers:
            with opener() as part:
                for own in part.channels:
                    if self._shared(own).id != channel.id:
                        continue
                    message = part.first(own)
                    if message and (best is None or message.log_time < best.log_time):
                        best = message.of_channel(channel)
        return best

    def __enter__(self) -> MultiReader:
        return self

    def __exit__(self, *_: object) -> None:
        for part in self._active:
            part.__exit__()
