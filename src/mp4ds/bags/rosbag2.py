"""Reads rosbag2 recordings: a folder with metadata.yaml, or a single storage file."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.mcap import McapReader
from mp4ds.bags.mcap_records import MAGIC, open_source, unzstd
from mp4ds.bags.ordering import HoldBack
from mp4ds.bags.protocols import Format
from mp4ds.bags.rosbag2_metadata import (
    METADATA_FILE,
    RECORD,
    TABLES_RECORD,
    BagInfo,
    Topic,
    parse_bag_info,
    read_bag_info,
)
from mp4ds.bags.rosbag2_sqlite import HASH_KEY, QOS_KEY, SqliteReader
from mp4ds.bags.rosbag2_write import Rosbag2Writer
from mp4ds.bags.zstd_files import ZstdFile, decompress_file, is_zstd
from mp4ds.errors import SourceError, SourceNotFoundError
from mp4ds.records import Channel, ChannelStats, Message, MetadataRecord, Record, Schema

__all__ = ["Rosbag2Reader", "Rosbag2Writer"]

StorageReader = McapReader | SqliteReader
_NO_STATS = ChannelStats(0, 0, 0)


class Rosbag2Reader:
    """Reads a rosbag2 recording of sqlite3 or MCAP storage. See `BagReader`.

    The first record is a metadata record ``mp4ds:rosbag2`` that holds the metadata.yaml and
    the small tables of the storage files, verbatim. Payloads that were compressed one by one
    are given out decompressed.

    Args:
        path: A folder, or one ``.db3`` or ``.mcap`` file.
        workdir: Where an sqlite3 file that is compressed as a whole is decompressed for as
            long as it is read; the system's temporary folder by default.

    Raises:
        SourceError: The recording is incomplete, damaged, or of an unknown kind.
    """

    format: Format = "rosbag2"
    profile = "ros2"

    def __init__(self, path: Path, *, workdir: Path | None = None) -> None:
        self.path = path
        self._workdir = workdir
        self._info: BagInfo | None = None
        self._storage_files: list[Path] = [path]
        if path.is_dir():
            self._info = _folder_info(path)
            self._storage_files = [path / name for name in self._info.file_names]
        elif not path.exists():
            raise SourceNotFoundError(path)
        else:
            self._info = _sibling_info(path)
        head = [path / METADATA_FILE] if path.is_dir() else []
        self.files: Sequence[Path] = [*head, *self._storage_files]
        self._channels: dict[tuple[tuple[object, ...], int], Channel] = {}
        self._shared: dict[tuple[int, int], Channel] = {}
        self._seen: Counter[tuple[int, tuple[object, ...]]] = Counter()
        self._schemas: dict[Schema, None] = {}
        self._unpacked: ExitStack | None = None
        self._active: tuple[int, StorageReader] | None = None
        self._done = 0
        self._readers = [self._storage_reader(file) for file in self._storage_files]
        mcaps = [reader for reader in self._readers if isinstance(reader, McapReader)]
        self.library = mcaps[0].library if mcaps else ""
        self._storage = "mcap" if mcaps else "sqlite3" if self._readers else ""
        for number, reader in enumerate(self._readers):
            if reader:
                self._take_over(number, reader)
        if self._readers and self._readers[0] is None:
            self._unpack_first()
        if all(reader is not None and _is_complete(reader) for reader in self._readers):
            self._add_listed_topics()

    def _storage_reader(self, file: Path) -> StorageReader | None:
        """The reader of a storage file; None where it must be decompressed first."""
        decompress = unzstd if self._info and self._info.compression == "message" else None
        compressed = is_zstd(file)
        if (self._info and self._info.storage == "mcap") or _is_mcap(file, compressed):
            opener = partial(ZstdFile, file) if compressed else None
            return McapReader(file, open_stream=opener, message_decompress=decompress)
        if compressed:
            return None
        reader = SqliteReader(file, message_decompress=decompress)
        if not self._info and _tells_message_compression(reader):
            return SqliteReader(file, message_decompress=unzstd)
        return reader

    def _unpack_first(self) -> None:
        # Its channels are wanted before anything is read: keep it until it was.
        with ExitStack() as stack:
            reader = stack.enter_context(self._opened(0))
            self._readers[0] = reader
            self._take_over(0, reader)
            self._unpacked = stack.pop_all()

    @contextmanager
    def _opened(self, number: int) -> Iterator[StorageReader]:
        """The reader of a storage file, decompressed for as long as it is needed."""
        reader = self._readers[number]
        if reader:
            yield reader
            return
        file = self._storage_files[number]
        with tempfile.TemporaryDirectory(prefix="mp4ds-", dir=self._workdir) as folder:
            copy = Path(folder) / "storage.db3"
            decompress_file(file, copy)
            decompress = unzstd if self._info and self._info.compression == "message" else None
            yield SqliteReader(copy, shown=file, message_decompress=decompress)

    def _drop_unpacked(self) -> None:
        if self._unpacked:
            self._readers[0] = None
            self._unpacked.close()
            self._unpacked = None

    def _take_over(self, number: int, reader: StorageReader) -> None:
        """Make all that a storage file declares part of the recording."""
        for channel in reader.channels:
            self._share(number, channel)
        self._schemas.update(dict.fromkeys(reader.unused_schemas))

    def _share(self, number: int, channel: Channel) -> Channel:
        """The recording's channel for one of a storage file."""
        known = self._shared.get((number, channel.id))
        if known:
            return known
        channel = self._with_listed_qos(channel)
        # Equal channels of one file stay apart; those of several files are one.
        place = number, channel.identity
        key = channel.identity, self._seen[place]
        self._seen[place] += 1
        shared = self._channels.setdefault(key, replace(channel, id=len(self._channels)))
        self._shared[number, channel.id] = shared
        return shared

    def _with_listed_qos(self, channel: Channel) -> Channel:
        """A topic of a database without a column for QoS, with what metadata.yaml tells."""
        if self._storage == "mcap" or not self._info or QOS_KEY in channel.metadata:
            return channel
        for topic in self._info.topics:
            if topic.qos and (topic.name, topic.type_name) == (channel.topic, channel.type_name):
                return replace(channel, metadata={**channel.metadata, QOS_KEY: topic.qos})
        return channel

    def _add_listed_topics(self) -> None:
        """Topics without messages may stand in metadata.yaml alone."""
        if not self._info or not self.path.is_dir():
            return
        known = {(channel.topic, channel.type_name) for channel in self._channels.values()}
        for topic in self._info.topics:
            if (topic.name, topic.type_name) not in known:
                channel = _listed_channel(topic, len(self._channels))
                self._channels[channel.identity, 0] = channel

    @property
    def channels(self) -> Sequence[Channel]:
        """See `BagReader.channels`."""
        return list(self._channels.values())

    @property
    def unused_schemas(self) -> Sequence[Schema]:
        """See `BagReader.unused_schemas`."""
        used = {channel.schema for channel in self._channels.values()}
        return [schema for schema in self._schemas if schema not in used]

    @property
    def skipped(self) -> Mapping[str, int]:
        """Records that only the application that wrote them understands: name -> count."""
        skipped: Counter[str] = Counter()
        for reader in self._readers:
            if isinstance(reader, McapReader):
                skipped.update(reader.skipped)
        return dict(skipped)

    @property
    def position(self) -> int:
        """Bytes consumed; within an sqlite3 file by the part of its messages read."""
        if not self._active:
            return self._done
        number, reader = self._active
        if isinstance(reader, McapReader):
            return self._done + reader.position
        return self._done + int(reader.fraction * self._storage_files[number].stat().st_size)

    def records(self) -> Iterator[Record]:
        """Read everything once. See `BagReader.records`."""
        self._done = 0
        yield self._info_record()
        if self.path.is_dir():
            self._done += self.files[0].stat().st_size
        held = HoldBack()
        for number in range(len(self._storage_files)):
            until = self._later_start(number)
            for record in self._file_records(number):
                if isinstance(record, Message) and (
                    held or (until is not None and record.log_time > until)
                ):
                    held.add(record)
                    now = record.log_time
                    yield from held.release(now if until is None else min(now, until))
                else:
                    yield record
        yield from held.release(None)
        self._add_listed_topics()

    def _file_records(self, number: int) -> Iterator[Record]:
        packed = self._readers[number] is None
        with self._opened(number) as reader:
            self._take_over(number, reader)
            if packed and isinstance(reader, SqliteReader):
                yield MetadataRecord(TABLES_RECORD, reader.tables)
            self._active = number, reader
            try:
                for record in reader.records():
                    if isinstance(record, Message):
                        yield replace(record, channel=self._share(number, record.channel))
                    else:
                        yield record
            finally:
                self._active = None
            self._take_over(number, reader)
        self._done += self._storage_files[number].stat().st_size
        if number == 0:
            self._drop_unpacked()

    def _later_start(self, number: int) -> int | None:
        starts = [reader.start for reader in self._readers[number + 1 :] if reader]
        return min((start for start in starts if start is not None), default=None)

    def _info_record(self) -> MetadataRecord:
        content = {
            "storage": self._storage,
            "files": "\n".join(file.name for file in self._storage_files),
        }
        if self._info:
            content[METADATA_FILE] = self._info.text
        for reader in self._readers:
            if isinstance(reader, SqliteReader):
                content.update(reader.tables)
        return MetadataRecord(RECORD, content)

    def stats(self) -> Mapping[int, ChannelStats]:
        """See `BagReader.stats`; empty where one of the files does not tell."""
        total: dict[int, ChannelStats] = {}
        for number, reader in enumerate(self._readers):
            stats = reader.stats() if reader and _is_complete(reader) else {}
            if not reader or not _is_complete(reader) or (reader.channels and not stats):
                return {}
            for channel in reader.channels:
                shared = self._share(number, channel).id
                total[shared] = _add_stats(total.get(shared), stats.get(channel.id, _NO_STATS))
        for channel in self._channels.values():
            total.setdefault(channel.id, _NO_STATS)
        return total

    def times(self) -> Mapping[int, NDArray[np.int64]]:
        """See `BagReader.times`."""
        found: dict[int, list[NDArray[np.int64]]] = {}
        for number in range(len(self._storage_files)):
            with self._opened(number) as reader:
                times = reader.times()
                for channel in reader.channels:
                    if channel.id in times:
                        shared = self._share(number, channel)
                        found.setdefault(shared.id, []).append(times[channel.id])
        return {key: np.sort(np.concatenate(arrays)) for key, arrays in found.items()}

    def first(self, channel: Channel) -> Message | None:
        """See `BagReader.first`; files that must be decompressed are taken to follow in time."""
        best: Message | None = None
        for number, known in enumerate(self._readers):
            if best and (not known or (known.start or 0) > best.log_time):
                continue
            with self._opened(number) as reader:
                for own in reader.channels:
                    if self._share(number, own).id != channel.id:
                        continue
                    message = reader.first(own)
                    if message and (best is None or message.log_time < best.log_time):
                        best = replace(message, channel=channel)
        return best

    def __enter__(self) -> Rosbag2Reader:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        tb: TracebackType | None,
    ) -> None:
        for reader in self._readers:
            if isinstance(reader, McapReader):
                reader.__exit__(exc_type, exc, tb)
        self._drop_unpacked()


def _folder_info(path: Path) -> BagInfo:
    if not (path / METADATA_FILE).exists():
        raise SourceError(
            path,
            f"has no {METADATA_FILE}",
            "If it is a rosbag2 recording, run `ros2 bag reindex` on it first.",
        )
    info = read_bag_info(path / METADATA_FILE)
    missing = [name for name in info.file_names if not (path / name).exists()]
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise SourceError(
            path,
            f"is incomplete: {missing[0]}{more}, which its {METADATA_FILE} names, is missing",
            "Add what is missing, or run `ros2 bag reindex` to go without it.",
        )
    return info


def _sibling_info(path: Path) -> BagInfo | None:
    """What a metadata.yaml beside a storage file says of it, if it says anything."""
    sibling = path.parent / METADATA_FILE
    if not sibling.exists():
        return None
    info = read_bag_info(sibling)
    return info if path.name in info.file_names else None


def _is_mcap(file: Path, compressed: bool) -> bool:
    if compressed:
        return ".mcap" in file.suffixes
    with open_source(file) as stream:
        return stream.read(len(MAGIC)) == MAGIC


def _tells_message_compression(reader: SqliteReader) -> bool:
    texts = [text for key, text in reader.tables.items() if ":metadata:" in key]
    return bool(texts) and parse_bag_info(texts[-1], reader.path).compression == "message"


def _is_complete(reader: StorageReader) -> bool:
    """Whether all channels are known without reading."""
    return isinstance(reader, SqliteReader) or reader.has_statistics


def _listed_channel(topic: Topic, channel_id: int) -> Channel:
    metadata = {QOS_KEY: topic.qos, HASH_KEY: topic.type_hash}
    return Channel(
        channel_id,
        topic.name,
        topic.serialization_format,
        Schema(topic.type_name, "", b""),
        {key: value for key, value in metadata.items() if value is not None},
    )


def _add_stats(old: ChannelStats | None, new: ChannelStats) -> ChannelStats:
    if old is None or not old.count:
        return new
    if not new.count:
        return old
    return ChannelStats(old.count + new.count, min(old.start, new.start), max(old.end, new.end))
