"""Opening recordings: the table of their formats, and several read as one."""

from __future__ import annotations

from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.protocols import BagReader, BagWriter, merged
from mp4ds.bags.rosbag2_metadata import METADATA_FILE, read_bag_info
from mp4ds.errors import OptionError, SourceError, SourceNotFoundError
from mp4ds.files.outputs import begins_with
from mp4ds.files.sources import HOW_TO_OPEN, is_video, refuse_unfinished
from mp4ds.files.urls import remote
from mp4ds.records import (
    EVERYTHING,
    Channel,
    ChannelStats,
    Excerpt,
    Loss,
    Message,
    Record,
    Schema,
    bounded,
)

# by name: each imports its library, and a recording has one format
_CLASSES = {
    "bag": ("ros1:Ros1Reader", "salvage_ros1:Ros1Salvage", "ros1_writer:Ros1Writer"),
    "mcap": ("mcap:McapReader", "salvage_mcap:McapSalvage", "mcap:McapWriter"),
    "rosbag2": ("rosbag2:Rosbag2Reader", "salvage_rosbag2:Rosbag2Salvage", "rosbag2:Rosbag2Writer"),
}
_READER, _SALVAGE, _WRITER = range(3)


def _class(name: str) -> Any:
    module, _, found = name.partition(":")
    return getattr(import_module(f"mp4ds.bags.{module}"), found)


_MAGIC = {b"#ROSBAG V": "bag", b"\x89MCAP0\r\n": "mcap", b"SQLite format 3\0": "rosbag2"}
_FILE_MAGIC = [magic for magic, name in _MAGIC.items() if name != "rosbag2"]
RECORDING_SUFFIXES = {".bag": "bag", ".mcap": "mcap", ".db3": "rosbag2"}
"""File suffix -> format."""


def format_of(path: Path) -> str:
    """The format of a recording, by its first bytes, or by its name if these are damaged.

    Raises:
        SourceNotFoundError: It does not exist.
        SourceError: It is not a recording, or cannot be read.
    """
    try:
        if not path.exists():
            raise SourceNotFoundError(path)
        if path.is_dir():
            refuse_unfinished(path)
            return "rosbag2"
        if not path.is_file():
            raise SourceError(path, "is neither a file nor a folder")
        with path.open("rb") as stream:
            start = stream.read(16)
    except SourceError:
        raise
    except OSError as error:
        raise SourceError(path, f"cannot be read: {error.strerror}") from None
    for magic, name in _MAGIC.items():
        if start.startswith(magic):
            return name
    if path.suffix in RECORDING_SUFFIXES:
        return RECORDING_SUFFIXES[path.suffix]
    remedy = "Give a ROS 1 .bag, a rosbag2 folder or an .mcap file."
    if is_video(path):
        raise SourceError(path, "is a video, not a recording", f"{remedy} {HOW_TO_OPEN}")
    raise SourceError(path, "is not in a recording format that mp4ds supports", remedy)


def recording_names(path: Path) -> set[str] | None:
    """Names of a recording's files; see `mp4ds.files.outputs.Owned`."""
    if path.is_file():
        return {""} if begins_with(path, *_FILE_MAGIC) else None
    try:
        info = read_bag_info(path / METADATA_FILE)
    except SourceError:
        return None
    return {METADATA_FILE, *info.file_names} if info.file_names else None


Opener = Callable[[Path], BagReader]
"""Opens one recording."""


def open_reader(path: Path) -> BagReader:
    """Open one recording of any format.

    Raises:
        SourceError: It cannot be read; says why, and what to do.
    """
    reader: BagReader = _class(_CLASSES[format_of(path)][_READER])(path)
    return reader


def open_sources(
    paths: Sequence[Path], *, salvage: bool = False, opener: Opener = open_reader
) -> BagReader:
    """Open recordings that belong together, such as a split bag, as one recording.

    Args:
        paths: The recordings.
        salvage: Read what is readable of damaged ones, instead of failing: the reader's `losses`
            then say what is not.
        opener: Opens one of them, unless they are salvaged.

    Raises:
        SourceError: One of them cannot be read, or is given twice.
    """
    if not paths:
        raise OptionError("No recording was given.")
    seen: set[Path] = set()
    for path in paths:
        resolved = path.resolve()
        if resolved in seen:
            raise SourceError(path, "is given twice")
        seen.add(resolved)
    is_alone = len(paths) == 1
    if salvage:
        for path in filter(remote, paths):
            problem = "cannot be salvaged from a remote location"
            raise SourceError(path, problem, "Download it first.")
        formats = {path: format_of(path) for path in paths}

        def opener(path: Path) -> BagReader:
            reader: BagReader = _class(_CLASSES[formats[path]][_SALVAGE])(path, is_alone=is_alone)
            return reader

    return opener(paths[0]) if is_alone else MultiReader([partial(opener, path) for path in paths])


def writer_of(target: str, storage: str) -> type[BagWriter]:
    """The class that knows whether a format can hold a channel, and a message.

    Args:
        target: ``bag``, ``rosbag2`` or ``mcap``.
        storage: ``sqlite3`` or ``mcap``, for ``rosbag2``.
    """
    name = _CLASSES["bag" if target == "bag" else "mcap"][_WRITER]
    if target == "rosbag2" and storage == "sqlite3":
        name = "rosbag2_sqlite:SqliteWriter"
    writer: type[BagWriter] = _class(name)
    return writer


def open_writer(
    path: Path, target: str, *, name: str, profile: str, library: str, storage: str
) -> BagWriter:
    """Open a recording for writing.

    Args:
        path: Where to write; does not exist yet.
        target: ``bag``, ``rosbag2`` or ``mcap``.
        name: Final name, used for the files in a rosbag2 folder.
        profile: MCAP profile, for ``mcap``.
        library: MCAP library string, for ``mcap``.
        storage: ``sqlite3`` or ``mcap``, for ``rosbag2``.

    Raises:
        OSError: It cannot be written.
    """
    options: Mapping[str, Mapping[str, str]] = {
        "bag": {},
        "rosbag2": {"storage": storage, "name": name},
        "mcap": {"profile": profile, "library": library},
    }
    writer: BagWriter = _class(_CLASSES[target][_WRITER])(path, **options[target])
    return writer


# ---------------------------------------------------------------- several as one

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
        spans = enumerate(self.spans)
        needed = [place for place, span in spans if excerpt.others or excerpt.touches(*span)]
        starts = [self.spans[number][0] for number in needed]
        return merged(starts, lambda place: self._records_of(needed[place], excerpt))

    def _records_of(self, number: int, excerpt: Excerpt) -> Iterator[Record]:
        with self._opened(number) as part:
            self._declare(number, part)
            self._active.append(part)
            try:
                for record in self._part_records(number, part, excerpt):
                    if isinstance(record, Message):
                        record = record.of_channel(self._share(number, record.channel))
                    yield record
            finally:
                self._active.remove(part)
            self._declare(number, part)
            self._skipped.update(part.skipped)
            self._losses[number] = part.losses
            self._done += sum(file.stat().st_size for file in part.files)

    def _part_records(self, number: int, part: BagReader, excerpt: Excerpt) -> Iterator[Record]:
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
                    own = stats.get(channel.id, _NO_STATS)
                    # a damaged part may have channels that its index does not list
                    total[shared] = total.get(shared, _NO_STATS).plus(own)
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
