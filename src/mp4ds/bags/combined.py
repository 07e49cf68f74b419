"""Several files or recordings, read as one."""

from __future__ import annotations

from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.protocols import BagReader, SourcePart, merged
from mp4ds.records import (
    EVERYTHING,
    MAX_LOSSES,
    Channel,
    ChannelStats,
    Excerpt,
    Loss,
    Message,
    Record,
    Schema,
)

MORE_LOSSES = " more places that could not be read"

_NO_STATS = ChannelStats(0, 0, 0)
_NO_TIMES = np.empty(0, np.int64)


class CombinedReader(BagReader):
    """Parts read as one recording.

    Parts that follow one another are read one after another, and those that overlap are merged by
    log time. Equal channels of several parts are one channel; those of one part stay separate.

    """

    def __init__(self) -> None:
        self._channels: dict[tuple[tuple[object, ...], int], Channel] = {}
        self._shared: dict[tuple[int, int], Channel] = {}
        self._seen: Counter[tuple[int, tuple[object, ...]]] = Counter()
        self._schemas: dict[Schema, None] = {}
        self._skipped: Counter[str] = Counter()
        self._losses: dict[int, Sequence[Loss]] = {}
        self._done = 0
        self._active: list[BagReader] = []

    @property
    @abstractmethod
    def spans(self) -> Sequence[tuple[int, int]]:
        """Of each part, bounds of its log times, nanoseconds."""

    @abstractmethod
    def _opened(self, number: int) -> AbstractContextManager[BagReader]:
        """The reader of a part, for one use."""

    def _declare(self, number: int, part: BagReader) -> None:
        """Add everything a part declares."""
        for channel in part.channels:
            self._share(number, channel)
        self._schemas.update(dict.fromkeys(part.unused_schemas))

    def _share(self, number: int, channel: Channel) -> Channel:
        """The recording's channel for one of a part."""
        known = self._shared.get((number, channel.id))
        if known:
            return known
        place = number, channel.identity
        key = channel.identity, self._seen[place]
        self._seen[place] += 1
        shared = self._channels.setdefault(key, replace(channel, id=len(self._channels)))
        self._shared[number, channel.id] = shared
        return shared

    @property
    def channels(self) -> Sequence[Channel]:
        """Those of all parts."""
        return list(self._channels.values())

    @property
    def unused_schemas(self) -> Sequence[Schema]:
        """Definitions that no channel of any part refers to."""
        used = {channel.schema for channel in self._channels.values()}
        return [schema for schema in self._schemas if schema not in used]

    @property
    def skipped(self) -> Mapping[str, int]:
        """Those of all parts."""
        return self._skipped

    @property
    def losses(self) -> Sequence[Loss]:
        """Those of all parts, in their order."""
        return bounded([loss for number in sorted(self._losses) for loss in self._losses[number]])

    @property
    def position(self) -> int:
        """Bytes of the parts that were read, and of those being read."""
        return self._done + sum(part.position for part in self._active)

    def _records(self, excerpt: Excerpt) -> Iterator[Record]:
        """Those of all parts, merged; only the parts that an excerpt needs are opened."""
        self._done = 0
        self._skipped.clear()
        self._losses.clear()
        if self.is_indexed:
            return self._merged(excerpt)
        # Otherwise, out-of-order messages would be merged differently in an excerpt.
        return filter(excerpt.has, self._merged(EVERYTHING if excerpt.has_messages else excerpt))

    def _merged(self, excerpt: Excerpt) -> Iterator[Record]:
        return merged(
            [
                SourcePart(start, partial(self._records_of, number, excerpt))
                for number, (start, end) in enumerate(self.spans)
                if excerpt.others or excerpt.touches(start, end)
            ]
        )

    def _records_of(self, number: int, excerpt: Excerpt) -> Iterator[Record]:
        with self._opened(number) as part:
            self._declare(number, part)
            self._active.append(part)
            try:
                for record in self._part_records(number, part, excerpt):
                    if isinstance(record, Message):
                        yield record.of_channel(self._share(number, record.channel))
                    else:
                        yield record
            finally:
                self._active.remove(part)
            self._declare(number, part)
            self._skipped.update(part.skipped)
            self._losses[number] = part.losses
            self._done += sum(file.stat().st_size for file in part.files)

    def _part_records(self, number: int, part: BagReader, excerpt: Excerpt) -> Iterator[Record]:
        del number
        return part.records(excerpt)

    def _stats(self) -> Mapping[int, ChannelStats]:
        """Those of all parts; empty if they are unknown for one of them."""
        total = {channel.id: _NO_STATS for channel in self.channels}
        for number in range(len(self.spans)):
            with self._opened(number) as part:
                stats = part.stats()
                if not stats and (part.channels or not part.is_indexed):
                    return {}
                for channel in part.channels:
                    shared = self._share(number, channel).id
                    total[shared] = total[shared].plus(stats.get(channel.id, _NO_STATS))
        return total

    def _times(self) -> Mapping[int, NDArray[np.int64]]:
        """Those of all parts."""
        found: dict[int, list[NDArray[np.int64]]] = {}
        for number in range(len(self.spans)):
            with self._opened(number) as part:
                times = part.times()
                for channel in part.channels:
                    shared = self._share(number, channel).id
                    found.setdefault(shared, []).append(times.get(channel.id, _NO_TIMES))
        return {key: np.sort(np.concatenate(arrays)) for key, arrays in found.items()}

    def _first(self, channel: Channel) -> Message | None:
        """The channel's first message by log time, or None."""
        best: Message | None = None
        for number, (start, _) in enumerate(self.spans):
            if best is not None and start > best.log_time:
                continue
            with self._opened(number) as part:
                for own in part.channels:
                    if self._share(number, own).id != channel.id:
                        continue
                    message = part.first(own)
                    if message and (best is None or message.log_time < best.log_time):
                        best = message.of_channel(channel)
        return best

    def close(self) -> None:
        """Close the parts that are being read."""
        for part in self._active:
            part.close()


class MultiReader(CombinedReader):
    """A split recording, or recordings made side by side.

    Args:
        openers: Each opens one part; a part is open only while it is read.

    """

    is_indexed: bool = True
    spans: Sequence[tuple[int, int]] = ()

    def __init__(self, openers: Sequence[Callable[[], BagReader]]) -> None:
        super().__init__()
        self._openers = openers
        spans, files = [], []
        for number in range(len(openers)):
            with self._opened(number) as part:
                if number == 0:
                    self.path, self.format = part.path, part.format
                    self.profile, self.library = part.profile, part.library
                elif part.profile != self.profile:
                    self.profile = ""
                self.is_indexed &= part.is_indexed
                files.append(part.files)
                self._declare(number, part)
                spans.append(part.span or (0, 2**63))
        self.spans = spans
        in_time = sorted(range(len(spans)), key=lambda number: spans[number][0])
        self.files = [file for number in in_time for file in files[number]]

    def _opened(self, number: int) -> BagReader:
        return self._openers[number]()


def bounded(losses: Sequence[Loss]) -> list[Loss]:
    """Losses of several files; the last one sums up those beyond the limit."""
    if len(losses) <= MAX_LOSSES:
        return list(losses)
    rest = losses[MAX_LOSSES - 1 :]
    number = sum(_places(loss) for loss in rest)
    counts = [loss.messages for loss in rest if loss.messages is not None]
    more = Loss(
        rest[0].file,
        None,
        sum(loss.size or 0 for loss in rest),
        f"{number}{MORE_LOSSES}",
        sum(counts) if len(counts) == len(rest) else None,
    )
    return [*losses[: MAX_LOSSES - 1], more]


def _places(loss: Loss) -> int:
    number = loss.problem.removesuffix(MORE_LOSSES)
    return int(number) if loss.problem.endswith(MORE_LOSSES) and number.isdecimal() else 1
