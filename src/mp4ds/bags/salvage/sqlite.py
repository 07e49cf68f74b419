"""Reads what is left of a damaged sqlite3 storage file of rosbag2."""

from __future__ import annotations

import sqlite3
import tempfile
from array import array
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.mcap_records import DamageError, OversizeError
from mp4ds.bags.protocols import Format, most_held
from mp4ds.bags.rosbag2_sqlite import SqliteReader
from mp4ds.bags.salvage.losses import FileSalvage, LossLog
from mp4ds.bags.salvage.scan import lost_by
from mp4ds.bags.salvage.sqlite_pages import (
    HEADER_BYTES,
    INTERIOR,
    LEAF,
    Pages,
    Row,
    Value,
    children,
    leaf_cells,
    serial_types,
    value,
    value_bytes,
    values,
)
from mp4ds.errors import Refused, SourceError
from mp4ds.records import Channel, Message, Record, Schema

_MAX_SMALL_ROW = 2**24
_MAX_ROWS = 10**5  # of any table but that of messages
_MAX_DEPTH = 32
_CACHED_LEAVES = 32


@dataclass
class Tree:
    """The pages of a table.

    Attributes:
        leaves: Pages with rows, in the order of their keys.
        pages: All pages that were visited.
        damaged: Its damaged pages.
    """

    leaves: array[int] = field(default_factory=lambda: array("I"))
    pages: set[int] = field(default_factory=set)
    damaged: list[int] = field(default_factory=list)


class MessageRow:
    """The places of a message's values in its row; times in ns."""

    __slots__ = ("blob", "size", "time", "topic_id")

    def __init__(self, topic_id: int, time: int, blob: int, size: int) -> None:
        self.topic_id = topic_id
        self.time = time
        self.blob = blob
        self.size = size


class Database:
    """Reads tables of a database page by page.

    Args:
        pages: Its pages.
    """

    def __init__(self, pages: Pages) -> None:
        self.pages = pages
        self._leaves: OrderedDict[int, tuple[bytes, list[Row], bool]] = OrderedDict()

    def leaf(self, number: int) -> tuple[bytes, list[Row], bool]:
        """A page, its rows, and whether it is damaged."""
        if number not in self._leaves:
            page = self.pages.read(number)
            header = HEADER_BYTES if number == 1 else 0
            found = leaf_cells(page, header, self.pages.usable)
            if len(self._leaves) >= _CACHED_LEAVES:
                self._leaves.popitem(last=False)
            self._leaves[number] = page, found.rows, found.is_damaged
        return self._leaves[number]

    def tree(self, root: int) -> Tree:
        """The pages of the table with a root page."""
        tree = Tree()
        todo = [(root, 0)]
        while todo:
            number, depth = todo.pop()
            if number in tree.pages or depth > _MAX_DEPTH:
                tree.damaged.append(number)
                continue
            tree.pages.add(number)
            page = self.pages.read(number)
            header = HEADER_BYTES if number == 1 else 0
            kind = page[header] if len(page) > header else 0
            if kind == LEAF:
                tree.leaves.append(number)
            elif kind == INTERIOR:
                below, is_whole = children(page, header)
                if not is_whole:
                    tree.damaged.append(number)
                todo.extend((child, depth + 1) for child, _ in reversed(below))
            else:
                tree.damaged.append(number)
        return tree

    def roots(self) -> dict[str, int]:
        """Root page of each table by name, as far as readable in the first page."""
        found: dict[str, int] = {}
        for row in self.rows(self.tree(1)):
            if len(row) == 6 and row[1] == "table":
                name, root = row[2], row[4]
                if isinstance(name, str) and isinstance(root, int) and root > 0:
                    found[name] = root
        return found

    def rows(self, tree: Tree) -> Iterator[list[Value]]:
        """Key and values of the readable rows of a small table."""
        count, left = 0, self.pages.all_bytes
        for number in tree.leaves:
            page, rows, _ = self.leaf(number)
            for row in rows:
                is_small = row.size <= min(_MAX_SMALL_ROW, left)
                payload = self.payload(page, row) if is_small else None
                left -= len(payload or b"")
                found = values(payload) if payload is not None else None
                count += 1
                if found is not None and count <= _MAX_ROWS:
                    yield [row.rowid, *found]

    def payload(self, page: bytes, row: Row) -> bytes | None:
        """All bytes of a row; None if some are missing."""
        if row.size > self.pages.all_bytes:
            return None
        pieces = [page[row.start : row.start + row.local]]
        left, number = row.size - row.local, row.overflow
        room = self.pages.usable - 4
        while left > 0:
            more = self.pages.read(number)
            if len(more) < min(left + 4, self.pages.usable) or number <= 1:
                return None
            number = int.from_bytes(more[:4], "big")
            pieces.append(more[4 : 4 + min(left, room)])
            left -= room
            if (left > 0) != (number != 0):
                return None  # the chain ends too early or too late
        return b"".join(pieces)

    def free_pages(self) -> set[int]:
        """Unused pages, which may hold deleted rows."""
        header = self.pages.read(1)
        trunk = int.from_bytes(header[32:36], "big")
        found: set[int] = set()
        while trunk and trunk not in found and trunk <= self.pages.count:
            found.add(trunk)
            page = self.pages.read(trunk)
            count = min(int.from_bytes(page[4:8], "big"), max(0, len(page) - 8) // 4)
            for place in range(8, 8 + 4 * count, 4):
                found.add(int.from_bytes(page[place : place + 4], "big"))
            trunk = int.from_bytes(page[:4], "big")
        return found


def message_row(page: bytes, row: Row) -> MessageRow | None:
    """The row as a message, if it has the columns of one: null, two integers and a blob."""
    head = page[row.start : row.start + row.local]
    found = serial_types(head)
    if found is None or len(found[0]) != 4:
        return None
    (key, topic, time, blob), at = found
    if key != 0 or blob < 12 or blob % 2:
        return None
    numbers: list[int] = []
    for kind in (topic, time):
        size = value_bytes(kind)
        if size is None or kind in (0, 7) or kind >= 12 or at + size > len(head):
            return None
        number = value(kind, head[at : at + size])
        if not isinstance(number, int):
            return None
        numbers.append(number)
        at += size
    size = (blob - 12) // 2
    if at + size != row.size:
        return None
    return MessageRow(numbers[0], numbers[1], at, size)


# ---------------------------------------------------------------- places of messages

_CHUNK = 4096


@dataclass
class MessageIndex:
    """For each message: log time in ns, key, page, and number within the page."""

    times: array[int] = field(default_factory=lambda: array("q"))
    keys: array[int] = field(default_factory=lambda: array("q"))
    pages: array[int] = field(default_factory=lambda: array("I"))
    places: array[int] = field(default_factory=lambda: array("H"))

    def order(self) -> Iterator[int]:
        """Positions by log time, then by key; for each key, the first one found."""
        if not self.keys:
            return
        times, keys = np.frombuffer(self.times, np.int64), np.frombuffer(self.keys, np.int64)
        _, first = np.unique(keys, return_index=True)
        order = first[np.lexsort((keys[first], times[first]))]
        for start in range(0, len(order), _CHUNK):
            yield from order[start : start + _CHUNK].tolist()

    def missing_keys(self) -> int:
        """Number of missing keys from 1 to the greatest: rosbag2 leaves no gaps."""
        keys = self.distinct_keys()
        return max(0, int(keys[-1]) - int((keys > 0).sum())) if len(keys) else 0

    def distinct_keys(self) -> NDArray[np.int64]:
        """All keys, sorted, each once."""
        return np.unique(np.array(self.keys, np.int64))


def index_messages(database: Database, log: LossLog, expected: int | None) -> MessageIndex:
    """Find all messages: by the tree of their table or, if it is damaged, in all pages.

    Args:
        database: The database.
        log: Records the damaged pages.
        expected: Expected number of messages, if known from elsewhere.
    """
    pages = database.pages
    index = MessageIndex()
    roots = database.roots()
    root = roots.get("messages")
    tree = database.tree(root) if root else Tree()
    damaged = set(tree.damaged)
    for number in tree.leaves:
        if not _add(database, number, index):
            damaged.add(number)
    is_short = pages.promised > pages.count
    if root is None or tree.damaged or is_short:
        for number in _other_pages(database, roots, tree):
            _add(database, number, index)
    drafts = []
    if root is None:
        drafts.append(log.lost(0, pages.there(1), "the page with the list of tables is damaged"))
    for number in sorted(number for number in damaged if 1 <= number <= pages.count):
        problem = "a page of the table of messages is damaged"
        drafts.append(log.lost(pages.offset(number), pages.there(number), problem))
    if is_short or (damaged and max(damaged) > pages.count):
        problem = f"the file ends before its {pages.promised or 'last'} pages do"
        drafts.append(log.lost(pages.file_size, None, problem, join=False))
    # The keys cannot reveal what is missing after the last one.
    is_open_ended = is_short or (damaged and tree.leaves and tree.leaves[-1] in damaged)
    if expected is None and not (root is None or is_open_ended):
        expected = len(index.keys) + index.missing_keys()
    if expected is not None:
        missing = max(0, expected - len(index.distinct_keys()))
        if missing and not drafts and (tree.damaged or root is None):
            drafts.append(log.lost(None, None, "pages of the table of messages cannot be found"))
        for draft in dict.fromkeys(drafts):
            draft.add(missing, ())
            missing = 0
    return index


def _add(database: Database, number: int, index: MessageIndex) -> bool:
    """Index the messages of a page. Returns whether it is undamaged."""
    page, rows, is_damaged = database.leaf(number)
    for place, row in enumerate(rows):
        found = message_row(page, row)
        if found is None:
            is_damaged = True
            continue
        index.times.append(found.time)
        index.keys.append(row.rowid)
        index.pages.append(number)
        index.places.append(place)
    return not is_damaged


def _other_pages(database: Database, roots: dict[str, int], tree: Tree) -> Iterator[int]:
    """Pages of rows that belong to no known table."""
    known = set(tree.pages) | database.free_pages()
    for name, root in roots.items():
        if name != "messages":
            known |= database.tree(root).pages
    for number in range(2, database.pages.count + 1):
        if number not in known and database.pages.read(number)[:1] == bytes([LEAF]):
            yield number


# ---------------------------------------------------------------- topics

# Columns of rosbag2's tables; newer versions have more.
_COLUMNS: dict[str, Sequence[str]] = {
    "topics": (
        "id INTEGER PRIMARY KEY",
        "name TEXT NOT NULL",
        "type TEXT NOT NULL",
        "serialization_format TEXT NOT NULL",
        "offered_qos_profiles TEXT NOT NULL",
        "type_description_hash TEXT NOT NULL",
    ),
    "message_definitions": (
        "id INTEGER PRIMARY KEY",
        "topic_type TEXT NOT NULL",
        "encoding TEXT NOT NULL",
        "encoded_message_definition TEXT NOT NULL",
        "type_description_hash TEXT NOT NULL",
    ),
    "metadata": (
        "id INTEGER PRIMARY KEY",
        "metadata_version INTEGER NOT NULL",
        "metadata TEXT NOT NULL",
    ),
    "schema": ("schema_version INTEGER PRIMARY KEY", "ros_distro TEXT NOT NULL"),
}
_LEAST_COLUMNS = {"topics": 4, "message_definitions": 5, "metadata": 3, "schema": 2}
_MESSAGES = (
    "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,"
    " timestamp INTEGER NOT NULL, data BLOB NOT NULL)"
)
_MAX_SEARCHED = 10**4  # pages at the start of a file, where rosbag2's small tables are


def open_small_tables(path: Path, shown: Path) -> tuple[SqliteReader, str]:
    """The small tables, by sqlite3 if it can open the file, otherwise from their pages.

    Args:
        path: The database.
        shown: Its name in errors and tables.

    Returns:
        A reader for topics, definitions and tables, not for messages; and why sqlite3 cannot open
        the file, a phrase, empty if it can.

    Raises:
        SourceError: The file is missing, empty, or unreadable.
    """
    with Pages(path, shown) as pages:
        try:
            return SqliteReader(path, shown=shown), ""
        except SourceError as error:
            problem = str(error)
        found = _small_tables(Database(pages))
        pending = pages.pending
    with tempfile.TemporaryDirectory(prefix="mp4ds-") as folder:
        copy = Path(folder) / "tables.db3"
        _write(copy, found)
        reader = SqliteReader(copy, shown=shown)
    return reader, "" if pending else _short(problem, shown)


def _short(problem: str, shown: Path) -> str:
    return problem.removeprefix(f"{shown}: ").partition(". ")[0].rstrip(".")


def _small_tables(database: Database) -> dict[str, list[list[Value]]]:
    roots = database.roots()
    found: dict[str, list[list[Value]]] = {}
    visited: set[int] = set()
    for name in _COLUMNS:
        if name in roots:
            tree = database.tree(roots[name])
            visited |= tree.pages
            rows = [row for row in database.rows(tree) if _table_of(row) == name]
            if rows:
                found[name] = rows
    if "topics" not in found:
        for name, rows in _by_look(database, visited):
            if name not in found:
                found[name] = rows
            elif name not in roots:
                found[name] += rows
    return found


def _by_look(database: Database, visited: set[int]) -> Iterator[tuple[str, list[list[Value]]]]:
    """Rows that look like those of small tables, in pages that belong to no table."""
    free = database.free_pages()
    for number in range(2, min(database.pages.count, _MAX_SEARCHED) + 1):
        if number in visited or number in free or database.pages.read(number)[:1] != bytes([LEAF]):
            continue
        tree = Tree()
        tree.leaves.append(number)
        rows = list(database.rows(tree))
        for name in _COLUMNS:
            of_table = [row for row in rows if _table_of(row) == name]
            if of_table:
                yield name, of_table


def _table_of(row: list[Value]) -> str | None:
    """The table that a row seems to belong to; its values follow its key."""
    kinds = "".join("n" if v is None else "i" if isinstance(v, int) else "t" for v in row[1:])
    if kinds in ("nttt", "nttttt") or (kinds == "ntttt" and not _is_definition(row)):
        return "topics"
    return {"ntttt": "message_definitions", "nit": "metadata", "nt": "schema"}.get(kinds)


def _is_definition(row: list[Value]) -> bool:
    """For rows of four texts: a topic's third is a serialization, a definition's second is."""
    return row[3] in ("ros2msg", "ros2idl", "unknown", "")


def _write(path: Path, tables: dict[str, list[list[Value]]]) -> None:
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute(_MESSAGES)
        for name, columns in _COLUMNS.items():
            rows = tables.get(name, [])
            if not rows and name != "topics":
                continue
            count = max((len(row) - 1 for row in rows), default=_LEAST_COLUMNS[name])
            connection.execute(f"CREATE TABLE {name}({', '.join(columns[:count])})")
            marks = ", ".join("?" * count)
            for key, _, *rest in rows:
                rest += [""] * (count - 1 - len(rest))
                connection.execute(
                    f"INSERT OR IGNORE INTO {name} VALUES({marks})", (key, *map(_plain, rest))
                )


def _plain(value: Value) -> Value:
    r"""A value for sqlite3, with damaged bytes of a text as ``\xNN``."""
    if isinstance(value, str):
        return value.encode(errors="surrogateescape").decode(errors="backslashreplace")
    return value


# ---------------------------------------------------------------- the reader


class SqliteSalvage(FileSalvage):
    """Reads what is left of one ``.db3`` file, page by page. See `SalvageReader`.

    An unfinished transaction is ignored; one in a write-ahead log is read from there. The files are
    neither changed nor copied. Messages come by log time. Their places, 22 bytes each, are held in
    memory.

    Args:
        path: The database.
        shown: Its name in errors and tables, where it is a decompressed copy.
        message_decompress: Decompresses the payload of a message; raises `DamageError` if it
            cannot.
        expected: Expected number of messages, if known from elsewhere.

    Attributes:
        tables: Content of the small tables by ``db3:<file>:<column>``, verbatim.

    Raises:
        SourceError: The file is missing, empty, or unreadable.
    """

    format: Format = "rosbag2"
    profile = "ros2"
    is_ordered = True

    def __init__(
        self,
        path: Path,
        *,
        shown: Path | None = None,
        message_decompress: Callable[[bytes], bytes] | None = None,
        expected: int | None = None,
    ) -> None:
        super().__init__(path, shown)
        self._decompress = message_decompress
        self._expected = expected
        self._rows, self._rows_read, self._given, self._left = 0, 0, 0, 0
        self._small, self._problem = open_small_tables(path, self._shown)
        self._channels = {channel.id: channel for channel in self._small.channels}
        self.tables: Mapping[str, str] = self._small.tables

    @property
    def channels(self) -> Sequence[Channel]:
        """All topics, in the order of their ids."""
        return list(self._channels.values())

    @property
    def unused_schemas(self) -> Sequence[Schema]:
        """Message definitions that no topic refers to."""
        return self._small.unused_schemas

    @property
    def start(self) -> int | None:
        """The earliest log time, ns, if sqlite3 can find it; otherwise None."""
        if self._small.path != self.path:
            return None  # its tables were rebuilt, without messages
        try:
            return self._small.start
        except SourceError:
            return None

    @property
    def fraction(self) -> float:
        """Part of the messages that `records` has read."""
        return min(1.0, self._rows_read / self._rows) if self._rows else 0.0

    def _lost_in_all(self) -> int | None:
        return None if self._expected is None else max(0, self._expected - self._given)

    def _pass(self, log: LossLog) -> Iterator[Record]:
        self._given = self._rows_read = 0
        size = self.path.stat().st_size
        with Pages(self.path, self._shown) as pages:
            database = Database(pages)
            if self._problem:
                log.lost(None, None, self._problem).add(0, ())
            index = index_messages(database, log, self._expected)
            self._rows = len(index.times)
            self._left = database.pages.all_bytes
            for message in self._messages(database, index, log):
                self._given += 1
                log.gave(message.log_time)
                yield message
                self._position = int(self.fraction * size)
            self._position = size

    def _messages(self, database: Database, index: MessageIndex, log: LossLog) -> Iterator[Message]:
        for position in index.order():
            self._rows_read += 1
            message = self._message(database, index, position, log)
            if message is not None:
                yield message

    def _message(
        self, database: Database, index: MessageIndex, position: int, log: LossLog
    ) -> Message | None:
        number, place = index.pages[position], index.places[position]
        page, rows, _ = database.leaf(number)
        row = rows[place] if place < len(rows) else None
        found = message_row(page, row) if row else None
        if row is None or found is None:
            return None
        channel = self._channels.get(found.topic_id)
        try:
            if channel is None:
                raise Refused(f"messages of topic id {found.topic_id}, which has no row")
            data = self._payload(database, page, row, found, channel.topic)
        except Refused as lost:
            loss = log.lost_of_kind(str(lost), database.pages.offset(number), str(lost))
            loss.add(1, [channel.topic] if channel else [])
            return None
        return Message(channel, found.time, found.time, 0, data)

    def _payload(
        self, database: Database, page: bytes, row: Row, found: MessageRow, topic: str
    ) -> bytes:
        """The payload of a message of a topic.

        Raises:
            Refused: It cannot be read.
        """
        if found.time < 0:
            raise Refused(f"messages of {topic} with a time before 1970")
        if self.path != self._shown and row.size > (most := most_held()):
            raise Refused(f"messages of {topic} {lost_by(OversizeError('', most))}")
        payload = database.payload(page, row) if row.size <= self._left else None
        if payload is None:
            raise Refused(f"messages of {topic} with damaged or missing pages")
        self._left -= len(payload)
        data = payload[found.blob :]
        try:
            return self._decompress(data) if self._decompress else data
        except DamageError as error:
            raise Refused(f"messages of {topic} {lost_by(error)}") from None
