"""Reads rosbag2 recordings: a folder with metadata.yaml, or a single storage file."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.mcap import McapReader, is_mcap
from mp4ds.bags.mcap_records import SALVAGE, unzstd
from mp4ds.bags.protocols import Format, SourcePart, merged
from mp4ds.bags.rosbag2_files import (
    SharedChannels,
    ZstdFile,
    consecutive,
    copy_file,
    decompress_file,
    is_zstd,
    unlisted_storage,
)
from mp4ds.bags.rosbag2_metadata import (
    METADATA_FILE,
    RECORD,
    TABLES_RECORD,
    BagInfo,
    parse_bag_info,
    read_bag_info,
)
from mp4ds.bags.rosbag2_sqlite import SqliteReader
from mp4ds.errors import SourceError, SourceNotFoundError
from mp4ds.files.urls import remote
from mp4ds.records import (
    EVERYTHING,
    Channel,
    ChannelStats,
    Excerpt,
    Message,
    MetadataRecord,
    Record,
    Schema,
)

StorageReader = McapReader | SqliteReader
_NO_STATS = ChannelStats(0, 0, 0)


class Rosbag2Reader:
    """Reads a rosbag2 recording of sqlite3 or MCAP storage. See `BagReader`.

    The first record is a metadata record ``mp4ds:rosbag2`` that holds the metadata.yaml and
    the small tables of the storage files, verbatim. Individually compressed payloads are
    decompressed.

    Args:
        path: A folder, or one ``.db3`` or ``.mcap`` file.
        workdir: Where an sqlite3 file that is compressed as a whole is decompressed, or a remote
            one copied, while it is read; by default, the system's temporary folder.

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
        self._unpacked: ExitStack | None = None
        self._active: list[tuple[int, StorageReader]] = []
        self._done = 0
        self._readers = [self._storage_reader(file) for file in self._storage_files]
        mcaps = [reader for reader in self._readers if isinstance(reader, McapReader)]
        self.library = mcaps[0].library if mcaps else ""
        self._storage = "mcap" if mcaps else "sqlite3" if self._readers else ""
        self._channels = SharedChannels(self._info, self._storage, is_folder=path.is_dir())
        self._is_packed = [reader is None for reader in self._readers]
        for number, reader in enumerate(self._readers):
            if reader:
                self._channels.take_over(number, reader)
        if self._readers and self._readers[0] is None:
            self._unpack_first()
        self._tables = {
            number: reader.tables
            for number, reader in enumerate(self._readers)
            if isinstance(reader, SqliteReader)
        }
        if all(reader is not None and _is_complete(reader) for reader in self._readers):
            self._channels.add_listed()

    def _storage_reader(self, file: Path) -> StorageReader | None:
        """The reader of a storage file; None if it must be decompressed or fetched first."""
        decompress = unzstd if self._info and self._info.compression == "message" else None
        compressed = is_zstd(file)
        if (self._info and self._info.storage == "mcap") or is_mcap(file, compressed):
            opener = partial(ZstdFile, file) if compressed else None
            return McapReader(file, open_stream=opener, message_decompress=decompress)
        return None if compressed or remote(file) else self._sqlite_reader(file)

    def _sqlite_reader(self, file: Path, shown: Path | None = None) -> SqliteReader:
        decompress = unzstd if self._info and self._info.compression == "message" else None
        reader = SqliteReader(file, shown=shown, message_decompress=decompress)
        if not self._info and _tells_message_compression(reader):
            return SqliteReader(file, shown=shown, message_decompress=unzstd)
        return reader

    def _unpack_first(self) -> None:
        # Its channels are needed before anything is read: keep it until then.
        with ExitStack() as stack:
            reader = stack.enter_context(self._opened(0))
            self._readers[0] = reader
            self._channels.take_over(0, reader)
            self._unpacked = stack.pop_all()

    @contextmanager
    def _opened(self, number: int) -> Iterator[StorageReader]:
        """The reader of a storage file, which is decompressed while it is needed."""
        reader = self._readers[number]
        if reader:
            yield reader
            return
        file = self._storage_files[number]
        with tempfile.TemporaryDirectory(prefix="mp4ds-", dir=self._workdir) as folder:
            copy = Path(folder) / "storage.db3"
            (decompress_file if is_zstd(file) else copy_file)(file, copy)
            yield self._sqlite_reader(copy, file)

    def _drop_unpacked(self) -> None:
        if self._unpacked:
            self._readers[0] = None
            self._unpacked.close()
            self._unpacked = None

    @property
    def channels(self) -> Sequence[Channel]:
        """See `BagReader.channels`."""
        return self._channels.all

    @property
    def unused_schemas(self) -> Sequence[Schema]:
        """See `BagReader.unused_schemas`."""
        return self._channels.unused_schemas

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
        return self._done + sum(
            reader.position
            if isinstance(reader, McapReader)
            else int(reader.fraction * self._storage_files[number].stat().st_size)
            for number, reader in self._active
        )

    @property
    def is_indexed(self) -> bool:
        """See `BagReader.is_indexed`; files that must be decompressed as a whole are not."""
        return self._gives_excerpts and all(
            reader and reader.is_indexed for reader in self._readers
        )

    @property
    def _gives_excerpts(self) -> bool:
        """Whether each storage file gives excerpts in log-time order, though perhaps slowly."""
        return not any(self._is_packed) and all(
            isinstance(reader, SqliteReader) or (reader is not None and reader.is_indexed)
            for reader in self._readers
        )

    def records(self, excerpt: Excerpt = EVERYTHING) -> Iterator[Record]:
        """Read everything once, or a part of it. See `BagReader.records`."""
        self._done = 0
        if excerpt.others:
            yield self._info_record()
        if self.path.is_dir():
            self._done += self.files[0].stat().st_size
        if self._gives_excerpts:
            starts = [reader.start or 0 for reader in self._readers if reader]
            yield from merged(
                [
                    SourcePart(start, partial(self._file_records, number, excerpt))
                    for number, start in enumerate(starts)
                ]
            )
        else:
            yield from filter(excerpt.has, self._consecutive_records(excerpt))
        self._channels.add_listed()

    def _consecutive_records(self, excerpt: Excerpt) -> Iterator[Record]:
        """The minimum to read for an excerpt, file by file."""
        part = EVERYTHING if excerpt.has_messages else excerpt
        return consecutive(self._readers, lambda number: self._file_records(number, part))

    def _file_records(self, number: int, excerpt: Excerpt) -> Iterator[Record]:
        with self._opened(number) as reader:
            self._channels.take_over(number, reader)
            if isinstance(reader, SqliteReader) and number not in self._tables:
                yield MetadataRecord(TABLES_RECORD, reader.tables)
            self._active.append((number, reader))
            try:
                for record in reader.records(excerpt):
                    if isinstance(record, Message):
                        yield record.of_channel(self._channels.share(number, record.channel))
                    else:
                        yield record
            finally:
                self._active.remove((number, reader))
            self._channels.take_over(number, reader)
        self._done += self._storage_files[number].stat().st_size
        if number == 0:
            self._drop_unpacked()

    def _info_record(self) -> MetadataRecord:
        content = {
            "storage": self._storage,
            "files": "\n".join(file.name for file in self._storage_files),
        }
        if self._info:
            content[METADATA_FILE] = self._info.text
        for tables in self._tables.values():
            content.update(tables)
        return MetadataRecord(RECORD, content)

    def stats(self) -> Mapping[int, ChannelStats]:
        """See `BagReader.stats`; empty if it is unknown for one of the files."""
        total: dict[int, ChannelStats] = {}
        for number, reader in enumerate(self._readers):
            stats = reader.stats() if reader and _is_complete(reader) else {}
            if not reader or not _is_complete(reader) or (reader.channels and not stats):
                return {}
            for channel in reader.channels:
                shared = self._channels.share(number, channel).id
                total[shared] = total.get(shared, _NO_STATS).plus(stats.get(channel.id, _NO_STATS))
        for channel in self._channels.all:
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
                        shared = self._channels.share(number, channel)
                        found.setdefault(shared.id, []).append(times[channel.id])
        return {key: np.sort(np.concatenate(arrays)) for key, arrays in found.items()}

    def first(self, channel: Channel) -> Message | None:
        """See `BagReader.first`; files to be decompressed are assumed to be consecutive in time."""
        best: Message | None = None
        for number, known in enumerate(self._readers):
            if best and (not known or (known.start or 0) > best.log_time):
                continue
            with self._opened(number) as reader:
                for own in reader.channels:
                    if self._channels.share(number, own).id != channel.id:
                        continue
                    message = reader.first(own)
                    if message and (best is None or message.log_time < best.log_time):
                        best = message.of_channel(channel)
        return best

    def __enter__(self) -> Rosbag2Reader:
        return self

    def __exit__(self, *_: object) -> None:
        for reader in self._readers:
            if isinstance(reader, McapReader):
                reader.__exit__()
        self._drop_unpacked()


def _folder_info(path: Path) -> BagInfo:
    if not (path / METADATA_FILE).exists():
        raise SourceError(
            path,
            f"has no {METADATA_FILE}",
            "If it is a rosbag2 recording, run `ros2 bag reindex` on it first, or "
            f"{SALVAGE} If it is a folder of images, use `mp4ds import images`.",
        )
    info = read_bag_info(path / METADATA_FILE)
    missing = [name for name in info.file_names if not (path / name).exists()]
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise SourceError(
            path,
            f"is incomplete: {missing[0]}{more}, listed in its {METADATA_FILE}, is missing",
            f"Add the missing file, run `ros2 bag reindex` to do without it, or {SALVAGE}",
        )
    unlisted = [] if remote(path) else unlisted_storage(path, info.file_names)
    if unlisted:
        raise SourceError(
            path,
            f"has {unlisted[0]}, which its {METADATA_FILE} does not list",
            f"Move it away, run `ros2 bag reindex` to add it, or {SALVAGE}",
        )
    return info


def _sibling_info(path: Path) -> BagInfo | None:
    """The metadata.yaml beside a storage file, if it lists that file."""
    sibling = path.parent / METADATA_FILE
    if not sibling.exists():
        return None
    info = read_bag_info(sibling)
    return info if path.name in info.file_names else None


def _tells_message_compression(reader: SqliteReader) -> bool:
    texts = [text for key, text in reader.tables.items() if ":metadata:" in key]
    return bool(texts) and parse_bag_info(texts[-1], reader.path).compression == "message"


def _is_complete(reader: StorageReader) -> bool:
    """Whether all channels are known without reading."""
    return isinstance(reader, SqliteReader) or reader.has_statistics
