"""Reads what is there of a damaged rosbag2 recording."""

from __future__ import annotations

import contextlib
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import TracebackType

from mp4ds.bags.mcap import is_mcap
from mp4ds.bags.mcap_records import unzstd
from mp4ds.bags.ordering import HoldBack, Part, merged
from mp4ds.bags.protocols import Format
from mp4ds.bags.rosbag2_metadata import METADATA_FILE, RECORD, TABLES_RECORD
from mp4ds.bags.salvage.losses import bounded
from mp4ds.bags.salvage.mcap import McapSalvage
from mp4ds.bags.salvage.reader import Salvage
from mp4ds.bags.salvage.rosbag2_files import StorageFile, find_storage, unreadable
from mp4ds.bags.salvage.sqlite import SqliteSalvage
from mp4ds.bags.salvage.zstd_stream import ZstdStream
from mp4ds.bags.zstd_files import MAGIC as ZSTD_MAGIC
from mp4ds.errors import SourceError
from mp4ds.records import QOS_KEY, Channel, Loss, Message, MetadataRecord, Record, Schema

Storage = McapSalvage | SqliteSalvage


class Rosbag2Salvage(Salvage):
    """Reads what is there of a rosbag2 recording. See `SalvageReader`.

    A folder need not have a metadata.yaml: its storage files are taken by their numbers, and
    so are those that a metadata.yaml does not name.

    Args:
        path: A folder, or one ``.db3`` file.
        workdir: Where an sqlite3 file that is compressed as a whole is decompressed for as
            long as it is read; the system's temporary folder by default.

    Raises:
        SourceError: There is no storage file, or the disk does not give it.
    """

    format: Format = "rosbag2"
    profile = "ros2"

    def __init__(self, path: Path, *, workdir: Path | None = None) -> None:
        super().__init__(path)
        self._workdir = workdir
        self._info, self._storage_files, self._missing = find_storage(path)
        has_yaml = path.is_dir() and (path / METADATA_FILE).is_file()
        self._head = [path / METADATA_FILE] if has_yaml else []
        self._channels: dict[tuple[tuple[object, ...], int], Channel] = {}
        self._shared: dict[tuple[int, int], Channel] = {}
        self._seen: Counter[tuple[int, tuple[object, ...]]] = Counter()
        self._schemas: dict[Schema, None] = {}
        self._active: list[tuple[int, Storage]] = []
        self._done = 0
        self._unpacked = ExitStack()
        self._first_copy: SqliteSalvage | None = None
        self._first_tables: Mapping[str, str] = {}
        self._given = 0
        self._readers = self._open_storage()
        self.files: Sequence[Path] = [*self._head, *(file.path for file in self._storage_files)]
        mcaps = [reader for reader in self._readers if isinstance(reader, McapSalvage)]
        self.library = mcaps[0].library if mcaps else ""
        self._storage = "mcap" if mcaps else "sqlite3" if self._readers else ""
        for number, reader in enumerate(self._readers):
            if reader:
                self._take_over(number, reader)
        if self._readers and self._readers[0] is None:
            # Its channels are wanted before anything is read: keep it until it was.
            with contextlib.suppress(SourceError):  # it is told when it is read
                self._first_copy = self._unpacked.enter_context(self._decompressed(0))
                self._first_tables = self._first_copy.tables
                self._take_over(0, self._first_copy)
        if all(reader is not None and _is_complete(reader) for reader in self._readers):
            self._add_listed_topics()

    def _open_storage(self) -> list[Storage | None]:
        """The readers of the storage files, of which those that cannot be opened are lost."""
        readers: list[Storage | None] = []
        files: list[StorageFile] = []
        for file in self._storage_files:
            try:
                reader = self._storage_reader(file)
            except SourceError as error:
                if not self.path.is_dir():
                    raise
                self._missing.append(unreadable(file.path.name, error, file.messages))
                continue
            if reader:
                reader.is_alone = False
            readers.append(reader)
            files.append(file)
        self._storage_files = files
        return readers

    def _storage_reader(self, file: StorageFile) -> Storage | None:
        """The reader of a storage file; None where it must be decompressed first."""
        is_whole = self._info is not None and self._info.compression == "message"
        is_listed_so = self._info is not None and self._info.storage == "mcap"
        if is_listed_so or ".mcap" in file.path.suffixes or is_mcap(file.path, is_compressed=False):
            opened = partial(McapSalvage, file.path, is_compressed=file.is_compressed)
            reader: Storage = opened(message_decompress=unzstd if is_whole else None)
            if self._info is None and _holds_zstd(reader):
                reader = opened(message_decompress=unzstd)
            return reader
        if file.is_compressed:
            return None
        of_file = partial(SqliteSalvage, file.path, expected=file.messages)
        reader = of_file(message_decompress=unzstd if is_whole else None)
        if self._info is None and _holds_zstd(reader):
            reader = of_file(message_decompress=unzstd)
        return reader

    @contextmanager
    def _opened(self, number: int) -> Iterator[Storage]:
        """The reader of a storage file, decompressed for as long as it is needed."""
        reader = self._readers[number]
        if reader:
            yield reader
        elif number == 0 and self._first_copy:
            yield self._first_copy
        else:
            with self._decompressed(number) as copy:
                yield copy

    @contextmanager
    def _decompressed(self, number: int) -> Iterator[SqliteSalvage]:
        file = self._storage_files[number]
        with tempfile.TemporaryDirectory(prefix="mp4ds-", dir=self._workdir) as folder:
            copy = Path(folder) / "storage.db3"
            _decompress(file.path, copy)
            is_whole = self._info is not None and self._info.compression == "message"
            yield SqliteSalvage(
                copy,
                shown=file.path,
                message_decompress=unzstd if is_whole else None,
                expected=file.messages,
            )

    def _take_over(self, number: int, reader: Storage) -> None:
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
                channel = topic.to_channel(len(self._channels))
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
            if reader:
                skipped.update(reader.skipped)
        return dict(skipped)

    @property
    def position(self) -> int:
        """Bytes consumed; within an sqlite3 file by the part of its messages read."""
        return self._done + sum(
            reader.position
            if isinstance(reader, McapSalvage)
            else int(reader.fraction * self._storage_files[number].path.stat().st_size)
            for number, reader in self._active
        )

    def _read(self, losses: list[Loss]) -> Iterator[Record]:
        self._done = self._given = 0
        found: dict[int, Sequence[Loss]] = {}
        yield self._info_record()
        self._done += sum(file.stat().st_size for file in self._head)
        if all(reader is not None and reader.is_ordered for reader in self._readers):
            starts = [reader.start or 0 for reader in self._readers if reader]
            yield from merged(
                [
                    Part(start, partial(self._file_records, number, found))
                    for number, start in enumerate(starts)
                ]
            )
        else:
            yield from self._consecutive_records(found)
        self._add_listed_topics()
        lost = [loss for number in sorted(found) for loss in found[number]]
        losses += bounded([*self._missing, *lost])
        if losses and not self._given and not self._channels:
            raise SourceError(self.path, f"holds no message that can be read: {losses[-1].problem}")

    def _consecutive_records(self, found: dict[int, Sequence[Loss]]) -> Iterator[Record]:
        held = HoldBack()
        for number in range(len(self._storage_files)):
            until = self._later_start(number)
            for record in self._file_records(number, found):
                if isinstance(record, Message) and (
                    held or (until is not None and record.log_time > until)
                ):
                    held.add(record)
                    now = record.log_time
                    yield from held.release(now if until is None else min(now, until))
                else:
                    yield record
        yield from held.release(None)

    def _file_records(self, number: int, found: dict[int, Sequence[Loss]]) -> Iterator[Record]:
        try:
            yield from self._salvaged_records(number, found)
        except SourceError as error:
            file = self._storage_files[number]
            found[number] = [unreadable(file.path.name, error, file.messages)]
        self._done += self._storage_files[number].path.stat().st_size
        if number == 0:
            self._drop_unpacked()

    def _salvaged_records(self, number: int, found: dict[int, Sequence[Loss]]) -> Iterator[Record]:
        is_packed = self._readers[number] is None
        with self._opened(number) as reader:
            self._take_over(number, reader)
            if is_packed and number > 0 and isinstance(reader, SqliteSalvage):
                yield MetadataRecord(TABLES_RECORD, reader.tables)
            self._active.append((number, reader))
            try:
                for record in reader.records():
                    if isinstance(record, Message):
                        self._given += 1
                        yield record.of_channel(self._share(number, record.channel))
                    else:
                        yield record
            finally:
                self._active.remove((number, reader))
            found[number] = reader.losses
            self._take_over(number, reader)

    def _drop_unpacked(self) -> None:
        self._first_copy = None
        self._unpacked.close()

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        tb: TracebackType | None,
    ) -> None:
        self._drop_unpacked()

    def _later_start(self, number: int) -> int | None:
        starts = [reader.start for reader in self._readers[number + 1 :] if reader]
        return min((start for start in starts if start is not None), default=None)

    def _info_record(self) -> MetadataRecord:
        content = {
            "storage": self._storage,
            "files": "\n".join(file.path.name for file in self._storage_files),
        }
        if self._info:
            content[METADATA_FILE] = self._info.text
        for number, reader in enumerate(self._readers):
            if isinstance(reader, SqliteSalvage):
                content.update(reader.tables)
            elif reader is None and number == 0:
                content.update(self._first_tables)
        return MetadataRecord(RECORD, content)


def _is_complete(reader: Storage) -> bool:
    """Whether all channels are known without reading."""
    return isinstance(reader, SqliteSalvage) or reader.has_statistics


def _holds_zstd(reader: Storage) -> bool:
    """Whether its messages are compressed one by one, by the look of the first one."""
    for record in reader.records():
        if isinstance(record, Message):
            return bytes(record.data[: len(ZSTD_MAGIC)]) == ZSTD_MAGIC
    return False


def _decompress(path: Path, target: Path) -> None:
    """Decompress a file into another one, as far as it goes."""
    stream = ZstdStream(path)
    try:
        with target.open("wb") as output:
            while piece := stream.read(2**20):
                output.write(piece)
    finally:
        stream.close()
    if not target.stat().st_size:
        raise SourceError(path, stream.problem or "holds nothing")
