"""What all salvage readers have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.by_reading import first_of, times_of
from mp4ds.bags.protocols import BagReader, Format
from mp4ds.bags.salvage.losses import LossLog
from mp4ds.records import (
    EVERYTHING,
    Channel,
    ChannelStats,
    Excerpt,
    Loss,
    Message,
    Record,
    Schema,
)


class SalvageReader(BagReader, Protocol):
    """Reads what can be read of a recording, in one pass, and knows what cannot.

    It never fails because of damage. Of an intact recording it gives what the usual reader
    gives. Messages come in log-time order where the index at the end of the file can be read,
    else in the order of the file. Some that are doubtful are given too: where a checksum shows
    that something of a chunk is wrong and nothing tells what, the loss says so.
    """

    @property
    def losses(self) -> Sequence[Loss]:
        """What could not be read; complete once `records` of everything is exhausted."""
        ...


class Salvage(ABC):
    """What all salvage readers do alike. See `SalvageReader`.

    Args:
        path: What to read.

    Attributes:
        when_read: Is given the losses when `records` is exhausted.
        is_alone: Whether it is an error, and not only a loss, that nothing can be read.
    """

    format: Format
    profile: str = ""
    library: str = ""
    is_indexed = False

    def __init__(self, path: Path) -> None:
        self.path = path
        self.files: Sequence[Path] = [path]
        self.when_read: Callable[[Sequence[Loss]], None] | None = None
        self.is_alone = True
        self._losses: list[Loss] = []
        self._first: dict[int, Message] | None = None

    @abstractmethod
    def _read(self, losses: list[Loss]) -> Iterator[Record]:
        """Read everything once, and at the end tell what is lost."""

    @property
    @abstractmethod
    def channels(self) -> Sequence[Channel]:
        """All channels known so far."""

    @property
    @abstractmethod
    def position(self) -> int:
        """Bytes of the files that `records` has come to."""

    @property
    def unused_schemas(self) -> Sequence[Schema]:
        """See `BagReader.unused_schemas`."""
        return ()

    @property
    def skipped(self) -> Mapping[str, int]:
        """See `BagReader.skipped`."""
        return {}

    @property
    def losses(self) -> Sequence[Loss]:
        """See `SalvageReader.losses`."""
        return self._losses

    def records(self, excerpt: Excerpt = EVERYTHING) -> Iterator[Record]:
        """What can be read. See `BagReader.records`."""
        self._losses = []
        losses: list[Loss] = []
        for record in self._read(losses):
            if excerpt is EVERYTHING or excerpt.has(record):
                yield record
        self._losses = losses
        if self.when_read:
            self.when_read(losses)

    def stats(self) -> Mapping[int, ChannelStats]:
        """Counts and spans as an index at the end tells, with what is lost; else empty."""
        return {}

    def times(self) -> Mapping[int, NDArray[np.int64]]:
        """Log times of what can be read, by reading it."""
        return times_of(self._read([]))

    def first(self, channel: Channel) -> Message | None:
        """The channel's first message by log time, by reading once for all channels."""
        if self._first is None:
            self._first = first_of(self._read([]))
        return self._first.get(channel.id)

    def __enter__(self) -> Salvage:
        return self

    def __exit__(self, *_: object) -> None:
        return None


class FileSalvage(Salvage):
    """A salvage reader of one file.

    Args:
        path: The file.
        shown: Its name in losses, where it is a decompressed copy.
    """

    def __init__(self, path: Path, shown: Path | None = None) -> None:
        super().__init__(path)
        self._shown = shown or path
        self._position = 0

    @abstractmethod
    def _pass(self, log: LossLog) -> Iterator[Record]:
        """Read everything once, putting down what is lost."""

    @property
    def _orderly(self) -> Callable[[], BagReader] | None:
        """Opens the usual reader, where more of the file is out of order than is held back.

        If the file is intact, that one can put it in order all the same.
        """
        return None

    def _lost_in_all(self) -> int | None:
        """Messages lost by the last pass, where the file tells how many there were."""
        return None

    @property
    def position(self) -> int:
        """Bytes of the file that `records` has come to."""
        return self._position

    def _read(self, losses: list[Loss]) -> Iterator[Record]:
        opener = self._orderly
        if opener is not None and self._is_intact():
            with opener() as usual:
                for record in usual.records():
                    self._position = usual.position
                    yield record
                self._position = usual.position
            return
        log = LossLog(self._shown.name)
        yield from self._pass(log)
        losses += log.finish(self._lost_in_all())

    def _is_intact(self) -> bool:
        log = LossLog(self._shown.name)
        for _ in self._pass(log):
            pass
        return not log.finish()
