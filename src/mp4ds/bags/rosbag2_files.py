"""The storage files of a rosbag2 folder: reading them as one recording, and zstd."""

from __future__ import annotations

import io
import re
import shutil
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import zstandard

from mp4ds.bags.mcap_records import SALVAGE, open_source
from mp4ds.bags.protocols import ZSTD_PIECE, HoldBack, most_in_file
from mp4ds.bags.rosbag2_metadata import BagInfo
from mp4ds.errors import SourceError
from mp4ds.records import QOS_KEY, Channel, Message, Record, Schema

MAGIC = b"\x28\xb5\x2f\xfd"
_COPY_BYTES = 2**22


def is_zstd(path: Path) -> bool:
    """Whether a file is compressed, by its first bytes.

    Raises:
        SourceError: It cannot be read.
    """
    with closing(open_source(path)) as stream:
        return stream.read(len(MAGIC)) == MAGIC


class ZstdStream:
    """The content of a compressed file, read once from its start, up to any damage.

    Args:
        path: The compressed file.

    Attributes:
        consumed: Bytes of the file that were read.
        problem: Why it ended before the file did, a phrase; empty if it did not.

    Raises:
        SourceError: It cannot be opened, or is empty.
    """

    def __init__(self, path: Path) -> None:
        self._file = open_source(path)
        self._frame = zstandard.ZstdDecompressor().decompressobj()
        self._most = most_in_file(path.stat().st_size)
        self._given = 0
        self._is_within = False
        self._left = bytearray()
        self._ended = False
        self.consumed = 0
        self.problem = ""

    def read(self, length: int, /) -> bytes:
        """Read that many decompressed bytes; fewer at the end, or before damage."""
        while len(self._left) < length and not self._ended:
            piece = self._file.read(ZSTD_PIECE)
            if not piece:
                self._end("its zstd data is cut short" if self._is_within else "")
            self._take(piece)
            self.consumed += len(piece)
        data = bytes(self._left[:length])
        del self._left[:length]
        self._given += len(data)
        return data

    def _take(self, piece: bytes) -> None:
        while piece:
            try:
                self._left += self._frame.decompress(piece)
            except zstandard.ZstdError as error:
                self._end(f"its zstd data is damaged near byte {self.consumed}: {error}")
                return
            if self._given + len(self._left) > self._most:
                self._end(f"it unpacks to more than {self._most} bytes, too many for its size")
                return
            self._is_within = not self._frame.eof
            piece = b"" if self._is_within else self._frame.unused_data
            if not self._is_within:
                self._frame = zstandard.ZstdDecompressor().decompressobj()

    def _end(self, problem: str) -> None:
        self._ended, self.problem = True, problem

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class ZstdFile(ZstdStream):
    """The content of an undamaged compressed file.

    Args:
        path: The compressed file.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._path = path

    def read(self, length: int, /) -> bytes:
        """Read that many decompressed bytes; fewer at the end only.

        Raises:
            SourceError: It is damaged, cut short, or decompresses to too much.
        """
        data = super().read(length)
        if self.problem and len(data) < length:
            raise SourceError(self._path, self.problem, f"Copy it again, or {SALVAGE}")
        return data

    def tell(self) -> int:
        """Bytes of the compressed file consumed."""
        return self.consumed

    def seek(self, offset: int, /) -> int:
        """Not possible."""
        raise io.UnsupportedOperation("seek")


def copy_file(path: Path, target: Path) -> None:
    """Download a remote file, with the -wal or -journal beside a database that was not closed.

    Raises:
        SourceError: There is not enough space for it.
        RemoteError: It cannot be read.
        OSError: The target cannot be written.
    """
    sides = [path, *(path.with_name(path.name + ending) for ending in ("-wal", "-journal"))]
    found = [side for side in sides if side is path or side.exists()]
    size = sum(side.stat().st_size for side in found)
    if size > shutil.disk_usage(target.parent).free:
        raise SourceError(
            path,
            f"is an sqlite3 database of {size} bytes, which must be copied to {target.parent} to "
            "be read, and there is not enough space",
            "Set TMPDIR to another folder.",
        )
    for side in found:
        ending = side.name.removeprefix(path.name)
        with closing(side.open("rb")) as stream, Path(f"{target}{ending}").open("wb") as output:
            shutil.copyfileobj(stream, output, _COPY_BYTES)


def decompress_file(path: Path, target: Path) -> None:
    """Decompress a file into another one.

    Raises:
        SourceError: The file is damaged, cut short, or decompresses to too much.
        OSError: The target cannot be written.
    """
    with closing(ZstdFile(path)) as stream, target.open("wb") as output:
        while piece := stream.read(_COPY_BYTES):
            output.write(piece)


# ---------------------------------------------------------------- parts

STORAGE_NAME = re.compile(r"(?P<stem>.*?)(?:_(?P<number>\d+))?\.(?:db3|mcap)(?:\.zstd)?")
"""Names of storage files: the recording's name with a number."""


def unlisted_storage(folder: Path, listed: Collection[str]) -> list[str]:
    """Storage files of a recording that its metadata.yaml does not list.

    Args:
        folder: The recording.
        listed: Those that it lists.
    """

    def stem(name: str) -> str:
        match = STORAGE_NAME.fullmatch(name)
        return match["stem"] if match else name

    there = [file.name for file in folder.iterdir() if file.is_file()]
    stems = {stem(name) for name in listed if name in there}
    return [
        name
        for name in there
        if STORAGE_NAME.fullmatch(name)
        and name not in listed
        and f"{name}.zstd" not in listed  # ROS 2 leaves behind the files it decompressed to play
        and (not stems or stem(name) in stems)
    ]


class StorageReader(Protocol):
    """The reader of a storage file."""

    @property
    def channels(self) -> Sequence[Channel]:
        """See `BagReader.channels`."""

    @property
    def unused_schemas(self) -> Sequence[Schema]:
        """See `BagReader.unused_schemas`."""

    @property
    def start(self) -> int | None:
        """The earliest log time, nanoseconds; None if unknown."""


class SharedChannels:
    """Channels of the storage files, mapped to those of the recording.

    Args:
        info: The metadata.yaml, if there is one.
        storage: ``sqlite3`` or ``mcap``.
        is_folder: Whether everything listed in metadata.yaml belongs to the recording.
    """

    def __init__(self, info: BagInfo | None, storage: str, *, is_folder: bool) -> None:
        self._info = info
        self._storage = storage
        self._is_folder = is_folder
        self._channels: dict[tuple[tuple[object, ...], int], Channel] = {}
        self._shared: dict[tuple[int, int], Channel] = {}
        self._seen: Counter[tuple[int, tuple[object, ...]]] = Counter()
        self._schemas: dict[Schema, None] = {}

    def take_over(self, number: int, reader: StorageReader) -> None:
        """Add everything a storage file declares to the recording."""
        for channel in reader.channels:
            self.share(number, channel)
        self._schemas.update(dict.fromkeys(reader.unused_schemas))

    def share(self, number: int, channel: Channel) -> Channel:
        """The recording's channel for one of a storage file."""
        known = self._shared.get((number, channel.id))
        if known:
            return known
        channel = self._with_listed_qos(channel)
        # Equal channels of one file stay separate; those of several files are merged.
        place = number, channel.identity
        key = channel.identity, self._seen[place]
        self._seen[place] += 1
        shared = self._channels.setdefault(key, replace(channel, id=len(self._channels)))
        self._shared[number, channel.id] = shared
        return shared

    def _with_listed_qos(self, channel: Channel) -> Channel:
        """A topic of a database without a QoS column, with the QoS of metadata.yaml."""
        if self._storage == "mcap" or not self._info or QOS_KEY in channel.metadata:
            return channel
        for topic in self._info.topics:
            if topic.qos and (topic.name, topic.type_name) == (channel.topic, channel.type_name):
                return replace(channel, metadata={**channel.metadata, QOS_KEY: topic.qos})
        return channel

    def add_listed(self) -> None:
        """Topics without messages may be in metadata.yaml only."""
        if not self._info or not self._is_folder:
            return
        known = {(channel.topic, channel.type_name) for channel in self._channels.values()}
        for topic in self._info.topics:
            if (topic.name, topic.type_name) not in known:
                channel = topic.to_channel(len(self._channels))
                self._channels[channel.identity, 0] = channel

    @property
    def all(self) -> Sequence[Channel]:
        """Those known so far."""
        return list(self._channels.values())

    @property
    def unused_schemas(self) -> Sequence[Schema]:
        """Definitions that none of them refers to."""
        used = {channel.schema for channel in self._channels.values()}
        return [schema for schema in self._schemas if schema not in used]


def consecutive(
    readers: Sequence[StorageReader | None], records: Callable[[int], Iterator[Record]]
) -> Iterator[Record]:
    """Storage files one after another; overlapping ones are merged in log-time order.

    Args:
        readers: The files' readers; None for one that is not open yet.
        records: Reads the file with a number.
    """
    held = HoldBack()
    for number in range(len(readers)):
        starts = [reader.start for reader in readers[number + 1 :] if reader]
        until = min((start for start in starts if start is not None), default=None)
        for record in records(number):
            if isinstance(record, Message) and (
                held or (until is not None and record.log_time > until)
            ):
                held.add(record)
                now = record.log_time
                yield from held.release(now if until is None else min(now, until))
            else:
                yield record
    yield from held.release(None)
