"""Reads what is left of a damaged rosbag2 recording."""

from __future__ import annotations

import sqlite3
from array import array
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.files import ZSTD_MAGIC, DamageError, OversizeError, decompress_file, unzstd
from mp4ds.bags.protocols import BagReader
from mp4ds.bags.rosbag2 import STORAGE_NAME, Rosbag2Reader, unlisted_storage
from mp4ds.bags.rosbag2_metadata import METADATA_FILE, BagInfo, read_bag_info
from mp4ds.bags.rosbag2_sqlite import SqliteReader, Tables
from mp4ds.bags.salvage_mcap import McapSalvage
from mp4ds.bags.salvage_scan import LossLog, lost_by
from mp4ds.errors import Refused, SourceError, SourceNotFoundError
from mp4ds.records import Excerpt, Loss, Message, Record, bounded

_RECOVER = (
    "Its tables may be found page by page: `sqlite3 FILE .recover | sqlite3 NEW.db3`, then give "
    "NEW.db3"
)
_UNFINISHED = "It was not closed properly: open and close it once with the sqlite3 tool"
_LEAST_ROW = 8  # bytes of a row in the table of messages
_MORE = "; `.recover` of the sqlite3 tool may find more"


class SqliteSalvage(SqliteReader):
    """Reads what sqlite3 can read of one ``.db3`` file.

    The files are neither changed nor copied. Messages come by log time; 24 bytes of each are held
    in memory.

    Args:
        path: The database.
        most: Bytes that a message may have.

    Attributes:
        expected: Expected number of messages, if known from elsewhere.

    Raises:
        SourceError: sqlite3 cannot open it, or its topics are damaged.
    """

    losses: Sequence[Loss] = ()
    # by reading everything, which no damage stops
    _times = BagReader._times
    _stats = BagReader._stats

    def __init__(self, path: Path, *, most: int = 2**31) -> None:
        self.expected: int | None = None
        try:
            super().__init__(path, most=most, damaged=True)
        except SourceError as error:
            remedy = _UNFINISHED if Path(f"{path}-journal").exists() else _RECOVER
            raise SourceError(path, error.problem, remedy) from None
        self.is_indexed = False

    @property
    def span(self) -> tuple[int, int] | None:
        """Earliest and latest log time, ns, if sqlite3 can find them; otherwise None."""
        try:
            return super().span
        except SourceError:
            return None

    def _records(self, excerpt: Excerpt) -> Iterator[Message]:
        """Everything readable, of which all but the excerpt is dropped."""
        self.losses = []
        log = LossLog(self.path.name)
        yield from filter(excerpt.has, self._found(log))
        self.losses = log.finish()

    def _found(self, log: LossLog) -> Iterator[Message]:
        given = lost = 0
        size = self.path.stat().st_size
        with self._opened() as tables:
            keys, times, problem = _index(tables, size // _LEAST_ROW, self.expected)
            for read, row in enumerate(np.lexsort((keys, times)).tolist(), 1):
                message = self._salvaged(tables, int(keys[row]), log)
                if message is None:
                    lost += 1
                else:
                    given += 1
                    log.gave(message.log_time)
                    yield message
                self.position = size * read // len(keys)
        # rosbag2 numbers its messages from 1 without gaps
        expected = self.expected or (int(keys.max(initial=0)) if problem else 0)
        missing = expected - given - lost
        if problem or missing > 0:
            problem = f"the table of messages: {problem}" if problem else "messages without a row"
            log.lost(None, None, problem + _MORE).add(max(0, missing), ())
        self.position = size

    def _salvaged(self, tables: Tables, key: int, log: LossLog) -> Message | None:
        """A message; None if it is lost, which is recorded."""
        channel = None
        try:
            topic_id, time = _first(tables, "topic_id, timestamp", key)
            channel = self._channels.get(topic_id) if isinstance(topic_id, int) else None
            if channel is None:
                raise Refused(f"messages of topic id {topic_id}, which has no row")
            if not isinstance(time, int) or time < 0:
                raise Refused(f"messages of {channel.topic} with a time before 1970")
            (size,) = _first(tables, "length(data)", key)
            if isinstance(size, int) and size > self._most:
                error = OversizeError("", self._most)
                raise Refused(f"messages of {channel.topic} {lost_by(error)}")
            (data,) = _first(tables, "data", key)
            if not isinstance(data, bytes):
                raise Refused(f"messages of {channel.topic} without a payload")
            return Message(channel, time, time, 0, data)
        except Refused as lost:
            problem = str(lost)
        except (sqlite3.Error, SourceError):
            _raise_if_interrupted(tables)
            of = f" of {channel.topic}" if channel else ""
            problem = f"messages{of} with damaged or missing pages"
        topics = [channel.topic] if channel else []
        log.lost_of_kind(problem, None, problem).add(1, topics)
        return None


def _first(tables: Tables, columns: str, key: int) -> tuple[object, ...]:
    row = next(tables.rows(f"SELECT {columns} FROM messages WHERE id = ?", (key,)), None)
    if row is None:
        raise Refused("messages whose rows cannot be found by their key")
    return row


def _index(
    tables: Tables, most: int, expected: int | None
) -> tuple[NDArray[np.int64], NDArray[np.int64], str]:
    """Keys and log times of the rows that can be read, and what damage ended reading in order.

    Each row that was not reached is then looked for by its key.

    Args:
        tables: Of the file.
        most: Rows that the file can hold.
        expected: Expected number of messages, if known from elsewhere.
    """
    keys, times = array("q"), array("q")

    def read(query: str, values: Sequence[int] = ()) -> str:
        try:
            for key, time in tables.select(query, values):
                keys.append(key)
                times.append(time if isinstance(time, int) else -1)
        except sqlite3.Error as error:
            _raise_if_interrupted(tables)
            return str(error)
        return ""

    query = "SELECT id, timestamp FROM messages NOT INDEXED"
    problem = read(f"{query} ORDER BY id")
    if problem:
        # Python steps ahead: instead of the last row before the damage, it gives the error
        read(f"{query} WHERE id > ? ORDER BY id LIMIT 1", (keys[-1] if keys else -(2**63),))
        try:
            (last,) = tables.select("SELECT MAX(id) FROM messages").fetchone()
        except sqlite3.Error:
            _raise_if_interrupted(tables)
            last = None
        reached = set(keys)
        for key in range(1, min(last or expected or 0, most) + 1):
            if key not in reached:
                read(f"{query} WHERE id = ?", (key,))
    # a page that is damaged may repeat keys: the first one counts, as for sqlite3
    found, first = np.unique(np.array(keys, np.int64), return_index=True)
    return found, np.array(times, np.int64)[first], problem


def _raise_if_interrupted(tables: Tables) -> None:
    """Raise what a signal's handler raised, which sqlite3 hides; not that a budget is used up."""
    if tables.raised and not isinstance(tables.raised, SourceError):
        raise tables.raised


# ---------------------------------------------------------------- the recording


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
    _mcap_reader = staticmethod(partial(McapSalvage, is_alone=False))
    _sqlite_reader = SqliteSalvage
    _times = BagReader._times  # by reading everything, which no damage stops

    def __init__(self, path: Path, *, is_alone: bool = True) -> None:
        self._is_alone = is_alone
        self._of_files: list[Loss] = []
        self._of_copies: dict[str, Loss] = {}
        self._logs: dict[int, LossLog] = {}  # of payloads in each file
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
            problem = f"has no {METADATA_FILE} and no storage file"
            remedy = "Give a rosbag2 folder, a ROS 1 .bag or an .mcap file."
            raise SourceError(path, problem, remedy)
        return info, [path / name for name in names]

    def _read_info(self, folder: Path) -> BagInfo | None:
        path, problem = folder / METADATA_FILE, "is missing"
        if path.exists():
            try:
                return read_bag_info(path)
            except SourceError as error:
                problem = error.problem
        self._lose(METADATA_FILE, problem, 0)
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

    def _file_reader(self, file: Path, **limit: int) -> BagReader:
        reader = super()._file_reader(file, **limit)
        if isinstance(reader, SqliteSalvage):
            reader.expected = self._expected(file)
        return reader

    def _holds_zstd(self, reader: BagReader) -> bool:
        for record in reader.records():
            if isinstance(record, Message):
                return bytes(record.data[: len(ZSTD_MAGIC)]) == ZSTD_MAGIC
        return False

    def _unpack(self, file: Path, target: Path) -> None:
        problem = decompress_file(file, target, to_damage=True)
        if problem:
            self._of_copies[file.name] = Loss(file.name, None, None, problem, 0)

    def _unpack_first(self) -> None:
        with suppress(SourceError):  # it is reported when it is read
            super()._unpack_first()

    @property
    def losses(self) -> Sequence[Loss]:
        """Files that cannot be read, and what was lost of the others by the last `records`."""
        return bounded([*self._of_files, *self._of_copies.values(), *super().losses])

    def _records(self, excerpt: Excerpt) -> Iterator[Record]:
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
        log = self._logs[number] = LossLog(file.name)
        try:
            for record in super()._records_of(number, excerpt):
                if isinstance(record, Message):
                    log.gave(record.log_time)
                yield record
            self._losses[number] = [*self._losses[number], *log.finish()]
        except SourceError as error:
            messages = self._expected(file)
            self._losses[number] = [Loss(file.name, None, None, error.problem, messages)]
            self._done += file.stat().st_size
            if number == 0:
                self._drop_first()

    def _unzstd(self, number: int, message: Message) -> Message | None:
        try:
            return replace(message, data=unzstd(message.data))
        except DamageError as error:
            topic = message.channel.topic
            problem = f"messages of {topic} {lost_by(error)}"
            self._logs[number].lost_of_kind(problem, None, problem).add(1, [topic])
            return None


def _number(name: str) -> tuple[str, int, str]:
    match = STORAGE_NAME.fullmatch(name)
    return (match["stem"], int(match["number"] or 0), name) if match else (name, 0, name)
