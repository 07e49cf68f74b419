"""Several recordings that belong together, read as one."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.protocols import BagReader
from mp4ds.records import (
    Attachment,
    Channel,
    ChannelStats,
    Message,
    Record,
    Schema,
)


class MultiReader:
    """A split recording, or recordings made side by side.

    Parts that follow each other in time are read one after the other, parts that overlap are
    merged by log time. Channels equal in all fields are one channel.

    Args:
        openers: Each opens one part; a part is open only while it is read.
    """

    def __init__(self, openers: Sequence[Callable[[], BagReader]]) -> None:
        self._openers = openers
        self._channels: dict[tuple[object, ...], Channel] = {}
        self._schemas: list[Schema] = []
        self._skipped: Counter[str] = Counter()
        self._done = 0
        self._active: list[BagReader] = []
        self._stats: dict[int, ChannelStats] = {}
        spans: list[tuple[int, int, int]] = []
        files: list[list[Path]] = []
        for number, opener in enumerate(openers):
            with opener() as part:
                if number == 0:
                    self.path, self.format = part.path, part.format
                    self.profile, self.library = part.profile, part.library
                elif part.profile != self.profile:
                    self.profile = ""
                files.append(list(part.files))
                for channel in part.channels:
                    self._shared(channel)
                stats = part.stats()
                self._add_stats(part, stats)
                known = [item for item in stats.values() if item.count]
                start = min((item.start for item in known), default=0)
                end = max((item.end for item in known), default=2**63)
                spans.append((start, end, number))
        self._groups = _overlapping(sorted(spans))
        order = [number for group in self._groups for number in group]
        self.files: Sequence[Path] = [file for number in order for file in files[number]]

    def _shared(self, channel: Channel) -> Channel:
        key = channel.identity
        if key not in self._channels:
            self._channels[key] = replace(channel, id=len(self._channels))
        return self._channels[key]

    def _add_stats(self, part: BagReader, stats: Mapping[int, ChannelStats]) -> None:
        for channel in part.channels:
            if channel.id not in stats or not stats[channel.id].count:
                continue
            shared, new = self._shared(channel).id, stats[channel.id]
            old = self._stats.get(shared, ChannelStats(0, new.start, new.end))
            self._stats[shared] = ChannelStats(
                old.count + new.count, min(old.start, new.start), max(old.end, new.end)
            )

    @property
    def channels(self) -> Sequence[Channel]:
        """See `BagReader.channels`."""
        return list(self._channels.values())

    @property
    def unused_schemas(self) -> Sequence[Schema]:
        """See `BagReader.unused_schemas`."""
        return self._schemas

    @property
    def skipped(self) -> Mapping[str, int]:
        """See `BagReader.skipped`."""
        return self._skipped

    @property
    def position(self) -> int:
        """See `BagReader.position`."""
        return self._done + sum(part.position for part in self._active)

    def records(self) -> Iterator[Record]:
        """See `BagReader.records`."""
        self._done = 0
        for group in self._groups:
            self._active = [self._openers[number]() for number in group]
            try:
                iterators = [self._part_records(part) for part in self._active]
                if len(iterators) == 1:
                    yield from iterators[0]
                else:
                    yield from heapq.merge(*iterators, key=_time_of)
                self._done += sum(
                    file.stat().st_size for part in self._active for file in part.files
                )
            finally:
                for part in self._active:
                    part.__exit__(None, None, None)
                self._active = []

    def _part_records(self, part: BagReader) -> Iterator[Record]:
        for record in part.records():
            if isinstance(record, Message):
                yield replace(record, channel=self._shared(record.channel))
            else:
                yield record
        for channel in part.channels:
            self._shared(channel)
        self._skipped.update(part.skipped)
        for schema in part.unused_schemas:
            if schema not in self._schemas:
                self._schemas.append(schema)

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
                        best = replace(message, channel=channel)
        return best

    def __enter__(self) -> MultiReader:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        tb: TracebackType | None,
    ) -> None:
        for part in self._active:
            part.__exit__(exc_type, exc, tb)
        self._active = []


def _overlapping(spans: Sequence[tuple[int, int, int]]) -> list[list[int]]:
    """Group parts, sorted by start, so that no two groups overlap in time."""
    groups: list[list[int]] = []
    group_end = -1
    for start, end, number in spans:
        if groups and start < group_end:
            groups[-1].append(number)
            group_end = max(group_end, end)
        else:
            groups.append([number])
            group_end = end
    return groups


def _time_of(record: Record) -> int:
    if isinstance(record, (Message, Attachment)):
        return record.log_time
    return 0  # metadata has no time: it comes as soon as its file does
