"""Reads what is left of a damaged rosbag2 recording."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from mp4ds.bags.combined import bounded
from mp4ds.bags.files import ZSTD_MAGIC, decompress_file
from mp4ds.bags.protocols import BagReader
from mp4ds.bags.rosbag2 import STORAGE_NAME, Decompress, Rosbag2Reader, unlisted_storage
from mp4ds.bags.rosbag2_metadata import METADATA_FILE, BagInfo, read_bag_info
from mp4ds.bags.salvage.mcap import McapSalvage
from mp4ds.bags.salvage.sqlite import SqliteSalvage
from mp4ds.errors import SourceError, SourceNotFoundError
from mp4ds.records import EVERYTHING, Excerpt, Loss, Message, Record


class Rosbag2Salvage(Rosbag2Reader):
    """Reads what is left of a rosbag2 recording.

    A folder needs no metadata.yaml: storage files it does not list are read in the order of their
    numbers.

    Args:
        path: A folder, or one storage file.
        is_alone: Whether it is an error, not just a loss, if nothing can be read.

    Raises:
        SourceError: There is no storage file, or the folder cannot be read.
    """

    is_indexed = False
    # by reading everything, which no damage stops
    _times = BagReader._times
    _first = BagReader._first

    def __init__(self, path: Path, *, is_alone: bool = True) -> None:
        self._is_alone = is_alone
        self._of_files: list[Loss] = []
        super().__init__(path)

    def _find_storage(self) -> tuple[BagInfo | None, list[Path]]:
        path = self.path
        if not path.exists():
            raise SourceNotFoundError(path)
        if not path.is_dir():
            info = self._read_info(path.parent)
            self._of_files.clear()
            return info if info and path.name in info.file_names else None, [path]
        info = self._read_info(path)
        names = self._names(info)
        if not names and not info:
            raise SourceError(
                path,
                f"has no {METADATA_FILE} and no storage file",
                "Give a rosbag2 folder, a ROS 1 .bag or an .mcap file.",
            )
        return info, [path / name for name in names]

    def _read_info(self, folder: Path) -> BagInfo | None:
        path = folder / METADATA_FILE
        if not path.exists():
            self._lose(METADATA_FILE, "is missing", 0)
            return None
        try:
            return read_bag_info(path)
        except SourceError as error:
            self._lose(METADATA_FILE, error.problem, 0)
            return None

    def _names(self, info: BagInfo | None) -> Sequence[str]:
        """Storage files in reading order: those listed, and those that should be."""
        listed = list(info.file_names) if info else []
        there = [name for name in listed if (self.path / name).is_file()]
        for name in listed:
            if name not in there:
                self._lose(name, "is missing", info.counts.get(name) if info else None)
        others = sorted(unlisted_storage(self.path, listed), key=_number)
        if info:
            for name in others:
                self._lose(name, f"is not listed in {METADATA_FILE}, but was read", 0)
        return sorted([*there, *others], key=_number) if others else there

    def _lose(self, name: str, problem: str, messages: int | None) -> None:
        self._of_files.append(Loss(name, None, None, problem, messages))

    def _expected(self, file: Path) -> int | None:
        """Number of messages of a file according to metadata.yaml; None if unknown."""
        return self._info.counts.get(file.name) if self._info else None

    def _open_storage(self) -> list[BagReader | None]:
        readers: list[BagReader | None] = []
        for file in list(self._storage_files):
            try:
                readers.append(self._storage_reader(file))
            except SourceError as error:
                if not self.path.is_dir():
                    raise
                self._lose(file.name, error.problem, self._expected(file))
                self._storage_files.remove(file)
        return readers

    def _mcap_reader(
        self, file: Path, is_compressed: bool, decompress: Decompress | None
    ) -> BagReader:
        return McapSalvage(
            file, is_alone=False, is_compressed=is_compressed, message_decompress=decompress
        )

    def _sqlite_reader(self, file: Path, shown: Path, decompress: Decompress | None) -> BagReader:
        expected = self._expected(shown)
        return SqliteSalvage(file, shown=shown, message_decompress=decompress, expected=expected)

    def _holds_zstd(self, reader: BagReader) -> bool:
        for record in reader.records():
            if isinstance(record, Message):
                return bytes(record.data[: len(ZSTD_MAGIC)]) == ZSTD_MAGIC
        return False

    def _unpack(self, file: Path, target: Path) -> None:
        decompress_file(file, target, to_damage=True)

    def _unpack_first(self) -> None:
        with suppress(SourceError):  # it is reported when it is read
            super()._unpack_first()

    @property
    def losses(self) -> Sequence[Loss]:
        """Files that cannot be read, and what was lost of the others by the last `records`."""
        return bounded([*self._of_files, *super().losses])

    def _records(self, excerpt: Excerpt = EVERYTHING) -> Iterator[Record]:
        """The metadata record, then everything readable, of which all but the excerpt is dropped.

        Raises:
            SourceError: Nothing can be read.
        """
        yield from super()._records(excerpt)
        if self._is_alone and self.losses and not self.channels:
            problem = f"holds no readable message: {self.losses[-1].problem}"
            raise SourceError(self.path, problem)

    def _records_of(self, number: int, excerpt: Excerpt) -> Iterator[Record]:
        file = self._storage_files[number]
        try:
            yield from super()._records_of(number, excerpt)
        except SourceError as error:
            self._losses[number] = [
                Loss(file.name, None, None, error.problem, self._expected(file))
            ]
            self._done += file.stat().st_size
            if number == 0:
                self._drop_first()


def _number(name: str) -> tuple[str, int, str]:
    match = STORAGE_NAME.fullmatch(name)
    return (match["stem"], int(match["number"] or 0), name) if match else (name, 0, name)
