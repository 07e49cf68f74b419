"""Reads what is left of a damaged rosbag2 recording."""

from __future__ import annotations

import contextlib
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from mp4ds.bags.mcap import is_mcap
from mp4ds.bags.mcap_records import unzstd
from mp4ds.bags.protocols import Format, SourcePart, merged
from mp4ds.bags.rosbag2_files import MAGIC as ZSTD_MAGIC
from mp4ds.bags.rosbag2_files import (
    STORAGE_NAME,
    SharedChannels,
    ZstdStream,
    consecutive,
    is_zstd,
    unlisted_storage,
)
from mp4ds.bags.rosbag2_metadata import METADATA_FILE, RECORD, TABLES_RECORD, BagInfo, read_bag_info
from mp4ds.bags.salvage.losses import Salvage, bounded
from mp4ds.bags.salvage.mcap import McapSalvage
from mp4ds.bags.salvage.sqlite import SqliteSalvage
from mp4ds.errors import SourceError, SourceNotFoundError
from mp4ds.records import Channel, Loss, Message, MetadataRecord, Record, Schema


@dataclass(frozen=True, slots=True)
class StorageFile:
    """A storage file.

    Attributes:
        path: The file.
        is_compressed: Whether it is compressed as a whole.
        messages: Number of messages according to metadata.yaml; None if unknown.
    """

    path: Path
    is_compressed: bool
    messages: int | None


def find_storage(path: Path) -> tuple[BagInfo | None, list[StorageFile], list[Loss]]:
    """Find the parts of a recording.

    Args:
        path: A folder, or a storage file.

    Returns:
        The metadata.yaml if readable, the storage files in reading order, and the losses: files
        that are missing or unreadable.

    Raises:
        SourceError: There is no storage file, or the folder cannot be read.
    """
    if not path.exists():
        raise SourceNotFoundError(path)
    losses: list[Loss] = []
    folder = path if path.is_dir() else path.parent
    info = _info(folder, losses)
    if not path.is_dir():
        if info and path.name not in info.file_names:
            info = None
        return info, [_storage_file(path, _counts(info))], []
    names = _names(folder, info, losses)
    if not names and not info:
        raise SourceError(
            path,
            f"has no {METADATA_FILE} and no storage file",
            "Give a rosbag2 folder, a ROS 1 .bag or an .mcap file.",
        )
    counts = _counts(info)
    files = []
    for name in names:
        try:
            files.append(_storage_file(folder / name, counts))
        except SourceError as error:
            losses.append(unreadable(name, error, counts.get(name)))
    return info, files, losses


def _info(folder: Path, losses: list[Loss]) -> BagInfo | None:
    path = folder / METADATA_FILE
    if not path.exists():
        losses.append(Loss(METADATA_FILE, None, None, "is missing", 0))
        return None
    try:
        return read_bag_info(path)
    except SourceError as error:
        losses.append(unreadable(METADATA_FILE, error, 0))
        return None


def unreadable(name: str, error: SourceError, messages: int | None) -> Loss:
    """The loss of a completely unreadable file."""
    return Loss(name, None, None, error.problem, messages)


def _names(folder: Path, info: BagInfo | None, losses: list[Loss]) -> Sequence[str]:
    """Storage files in reading order: those listed, and those that should be."""
    listed = list(info.file_names) if info else []
    counts = _counts(info)
    for name in listed:
        if not (folder / name).is_file():
            losses.append(Loss(name, None, None, "is missing", counts.get(name)))
    others = unlisted_storage(folder, listed)
    if info:
        for name in sorted(others, key=_number):
            losses.append(
                Loss(name, None, None, f"is not listed in {METADATA_FILE}, but was read", 0)
            )
    found = [name for name in listed if (folder / name).is_file()]
    return sorted([*found, *others], key=_number) if others else found


def _number(name: str) -> tuple[str, int, str]:
    match = STORAGE_NAME.fullmatch(name)
    return (match["stem"], int(match["number"] or 0), name) if match else (name, 0, name)


def _storage_file(path: Path, counts: Mapping[str, int]) -> StorageFile:
    return StorageFile(path, is_zstd(path), counts.get(path.name))


def _counts(info: BagInfo | None) -> Mapping[str, int]:
    """Number of messages of each storage file, as far as metadata.yaml states it."""
    return info.counts if info else {}


# ---------------------------------------------------------------- the reader

Storage = McapSalvage | SqliteSalvage


class Rosbag2Salvage(Salvage):
    """Reads what is left of a rosbag2 recording. See `SalvageReader`.

    A folder needs no metadata.yaml: storage files it does not list are read in the order of their
    numbers.

    Args:
        path: A folder, or one ``.db3`` file.
        workdir: Where an sqlite3 file that is compressed as a whole is decompressed while it is
            read; by default, the system's temporary folder.

    Raises:
        SourceError: There is no storage file, or the folder cannot be read.
    """

    format: Format = "rosbag2"
    profile = "ros2"

    def __init__(self, path: Path, *, workdir: Path | None = None) -> None:
        super().__init__(path)
        self._workdir = workdir
        self._info, self._storage_files, self._missing = find_storage(path)
        has_yaml = path.is_dir() and (path / METADATA_FILE).is_file()
        self._head = [path / METADATA_FILE] if has_yaml else []
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
        self._channels = SharedChannels(self._info, self._storage, is_folder=path.is_dir())
        for number, reader in enumerate(self._readers):
            if reader:
                self._channels.take_over(number, reader)
        if self._readers and self._readers[0] is None:
            # Its channels are needed before anything is read: keep it until then.
            with contextlib.suppress(SourceError):  # it is reported when it is read
                self._first_copy = self._unpacked.enter_context(self._decompressed(0))
                self._first_tables = self._first_copy.tables
                self._channels.take_over(0, self._first_copy)
        if all(reader is not None and _is_complete(reader) for reader in self._readers):
            self._channels.add_listed()

    def _open_storage(self) -> list[Storage | None]:
        """The readers of the storage files; files that cannot be opened are recorded as lost."""
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
        """The reader of a storage file; None if it must be decompressed first."""
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
        """The reader of a storage file, which is decompressed while it is needed."""
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
                    SourcePart(start, partial(self._file_records, number, found))
                    for number, start in enumerate(starts)
                ]
            )
        else:
            yield from consecutive(self._readers, lambda number: self._file_records(number, found))
        self._channels.add_listed()
        lost = [loss for number in sorted(found) for loss in found[number]]
        losses += bounded([*self._missing, *lost])
        if losses and not self._given and not self.channels:
            raise SourceError(self.path, f"holds no readable message: {losses[-1].problem}")

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
            self._channels.take_over(number, reader)
            if is_packed and number > 0 and isinstance(reader, SqliteSalvage):
                yield MetadataRecord(TABLES_RECORD, reader.tables)
            self._active.append((number, reader))
            try:
                for record in reader.records():
                    if isinstance(record, Message):
                        self._given += 1
                        yield record.of_channel(self._channels.share(number, record.channel))
                    else:
                        yield record
            finally:
                self._active.remove((number, reader))
            found[number] = reader.losses
            self._channels.take_over(number, reader)

    def _drop_unpacked(self) -> None:
        self._first_copy = None
        self._unpacked.close()

    def __exit__(self, *_: object) -> None:
        self._drop_unpacked()

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
    """Whether its messages are individually compressed, judging by the first one."""
    for record in reader.records():
        if isinstance(record, Message):
            return bytes(record.data[: len(ZSTD_MAGIC)]) == ZSTD_MAGIC
    return False


def _decompress(path: Path, target: Path) -> None:
    """Decompress a file into another one, as far as possible."""
    stream = ZstdStream(path)
    try:
        with target.open("wb") as output:
            while piece := stream.read(2**20):
                output.write(piece)
    finally:
        stream.close()
    if not target.stat().st_size:
        raise SourceError(path, stream.problem or "holds nothing")
