"""The table of recording formats, several recordings read as one, and their digests."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Literal, overload

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.protocols import BagReader, BagWriter, SourcePart, merged
from mp4ds.errors import OptionError, SourceError, SourceNotFoundError
from mp4ds.files.outputs import begins_with
from mp4ds.files.sources import (
    HOW_TO_OPEN,
    is_folder,
    refuse_unfinished,
    source_digest,
    source_size,
    video_at,
)
from mp4ds.files.urls import remote
from mp4ds.records import EVERYTHING, Channel, ChannelStats, Excerpt, Message, Record, Schema

if TYPE_CHECKING:
    from mp4ds.bags.salvage.losses import Salvage, SalvageReader

_BLOCK = 2**20


class SourceHasher:
    """SHA-256 of the source files, computed just behind the reader.

    The bytes are still in the system's cache then, so the disk is read once. A folder is hashed
    when the reader is past its bytes. A context manager.

    Args:
        files: All files, in reading order.
    """

    def __init__(self, files: Sequence[Path]) -> None:
        self._files = list(files)
        self._sizes = {path: source_size(path) for path in files if is_folder(path)}
        self._position = 0
        self._number = 0
        self._offset = 0
        self._hash = hashlib.sha256()
        self._stream: BinaryIO | None = None  # kept open, since another file may get the name
        self._digests: list[tuple[int, str]] = []

    def advance(self, position: int | None) -> None:
        """Hash up to a position in all files, None for the end.

        Raises:
            SourceError: A file cannot be read.
        """
        while self._number < len(self._files) and (position is None or self._position < position):
            path = self._files[self._number]
            end = self._position + self._sizes.get(path, 0)
            if position is not None and position < end:
                return
            try:
                if path in self._sizes:
                    self._finish(*source_digest(path))
                    self._position = end
                    continue
                if self._stream is None:
                    self._stream = path.open("rb")
                at_end = self._hash_file(self._stream, position)
            except OSError as error:
                raise SourceError(path, f"cannot be read: {error.strerror}") from None
            if at_end:
                self._finish(self._offset, self._hash.hexdigest())

    def digest(self, number: int) -> tuple[int, str]:
        """Size in bytes and SHA-256 of a file by its number; reads all files to the end first.

        Raises:
            SourceError: It cannot be read.
        """
        if number >= len(self._digests):
            self.advance(None)
        return self._digests[number]

    def _hash_file(self, stream: BinaryIO, position: int | None) -> bool:
        while position is None or self._position < position:
            block = stream.read(_BLOCK)
            if not block:
                return True
            self._hash.update(block)
            self._offset += len(block)
            self._position += len(block)
        return False

    def _finish(self, size: int, sha256: str) -> None:
        self._digests.append((size, sha256))
        self._hash = hashlib.sha256()
        self._offset = 0
        self._number += 1
        self._close()

    def _close(self) -> None:
        if self._stream:
            self._stream.close()
        self._stream = None

    def __enter__(self) -> SourceHasher:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()


# ---------------------------------------------------------------- several recordings

_NO_STATS = ChannelStats(0, 0, 0)


class MultiReader:
    """A split recording, or recordings made side by side.

    Consecutive parts are read one after another; overlapping parts are merged by log time. Channels
    equal in all fields are one channel.

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
        # Otherwise, out-of-order messages would be merged differently in an excerpt.
        return filter(excerpt.has, self._merged(EVERYTHING if excerpt.has_messages else excerpt))

    def _merged(self, excerpt: Excerpt) -> Iterator[Record]:
        return merged(
            [
                SourcePart(start, partial(self._part_records, number, excerpt))
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


# ---------------------------------------------------------------- formats

# each imports its library when needed: a recording has one format


def _read_bag(path: Path) -> BagReader:
    from mp4ds.bags.ros1 import Ros1Reader

    return Ros1Reader(path)


def _read_mcap(path: Path) -> BagReader:
    from mp4ds.bags.mcap import McapReader

    return McapReader(path)


def _read_rosbag2(path: Path) -> BagReader:
    from mp4ds.bags.rosbag2 import Rosbag2Reader

    return Rosbag2Reader(path)


_READERS: dict[str, Callable[[Path], BagReader]] = {
    "bag": _read_bag,
    "mcap": _read_mcap,
    "rosbag2": _read_rosbag2,
}


def _salvage_bag(path: Path) -> Salvage:
    from mp4ds.bags.salvage.ros1 import Ros1Salvage

    return Ros1Salvage(path)


def _salvage_mcap(path: Path) -> Salvage:
    from mp4ds.bags.salvage.mcap import McapSalvage

    return McapSalvage(path)


def _salvage_rosbag2(path: Path) -> Salvage:
    from mp4ds.bags.salvage.rosbag2 import Rosbag2Salvage

    return Rosbag2Salvage(path)


_SALVAGERS: dict[str, Callable[[Path], Salvage]] = {
    "bag": _salvage_bag,
    "mcap": _salvage_mcap,
    "rosbag2": _salvage_rosbag2,
}

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
    if video := video_at(path):
        raise SourceError(path, f"is {video}, not a recording", f"{remedy} {HOW_TO_OPEN}")
    raise SourceError(path, "is not in a recording format that mp4ds supports", remedy)


def recording_names(path: Path) -> set[str] | None:
    """Names of a recording's files; see `mp4ds.files.outputs.Owned`."""
    from mp4ds.bags.rosbag2_metadata import METADATA_FILE, read_bag_info

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
    return _READERS[format_of(path)](path)


@overload
def open_sources(
    paths: Sequence[Path], *, salvage: Literal[True], opener: Opener = ...
) -> SalvageReader: ...


@overload
def open_sources(
    paths: Sequence[Path], *, salvage: bool = False, opener: Opener = ...
) -> BagReader: ...


def open_sources(
    paths: Sequence[Path], *, salvage: bool = False, opener: Opener = open_reader
) -> BagReader:
    """Open recordings that belong together, such as a split bag, as one recording.

    Args:
        paths: The recordings.
        salvage: Read what is readable of damaged ones, with a `SalvageReader`.
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
    if salvage:
        return _open_salvaged(paths)
    if len(paths) == 1:
        return opener(paths[0])
    return MultiReader([partial(opener, path) for path in paths])


def _open_salvaged(paths: Sequence[Path]) -> SalvageReader:
    for path in filter(remote, paths):
        raise SourceError(path, "cannot be salvaged from a remote location", "Download it first.")
    openers = [partial(_SALVAGERS[format_of(path)], path) for path in paths]
    if len(paths) == 1:
        return openers[0]()
    from mp4ds.bags.salvage.losses import MultiSalvage

    return MultiSalvage(openers)


def limits_of(
    target: str, storage: str
) -> tuple[Callable[[Channel], None], Callable[[Message], None]]:
    """The writer's checks that a format can hold a channel, and a message.

    Args:
        target: ``bag``, ``rosbag2`` or ``mcap``.
        storage: ``sqlite3`` or ``mcap``, for ``rosbag2``.
    """
    if target == "bag":
        from mp4ds.bags import ros1_write

        return ros1_write.check_channel, ros1_write.check_message
    if target == "rosbag2" and storage == "sqlite3":
        from mp4ds.bags import rosbag2_write

        return rosbag2_write.check_channel, rosbag2_write.check_message
    from mp4ds.bags.mcap_write import check_message

    return lambda _: None, check_message


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
        OptionError: The target is unknown.
        OSError: It cannot be written.
    """
    if target == "bag":
        from mp4ds.bags.ros1_write import Ros1Writer

        return Ros1Writer(path)
    if target == "rosbag2":
        from mp4ds.bags.rosbag2_write import Rosbag2Writer

        return Rosbag2Writer(path, storage=storage, name=name)
    if target == "mcap":
        from mp4ds.bags.mcap_write import McapWriter

        return McapWriter(path, profile=profile, library=library)
    raise OptionError(f"`to` {target!r} is not known. Use bag, rosbag2, mcap or images.")
