"""Reads and writes the sqlite3 storage files of rosbag2; what is read is not trusted."""

from __future__ import annotations

import errno
import os
import re
import sqlite3
import sys
from array import array
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from dataclasses import astuple
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.files import SALVAGE, SALVAGE_REMEDY, OversizeError, open_source, unreadable
from mp4ds.bags.protocols import BagReader, BagWriter
from mp4ds.bags.rosbag2_metadata import MCAP_RECORD, TopicMetadata
from mp4ds.errors import ConversionError, SourceError
from mp4ds.records import (
    EVERYTHING,
    HASH_KEY,
    QOS_KEY,
    Attachment,
    Channel,
    ChannelStats,
    Excerpt,
    Message,
    MetadataRecord,
    Schema,
)

_PLAIN = re.compile(rb"\s*CREATE\s+(TABLE|INDEX|UNIQUE\s+INDEX|TRIGGER)\b", re.IGNORECASE)
_LOOK_STEPS = 10**4  # steps of sqlite's virtual machine, well below a millisecond
_STEPS_A_BYTE, _LEAST_STEPS = 100, 10**6  # all queries of a pass need about 3 per byte
_LEAST_LENGTH = 10**6  # sqlite's default for the text of a query


class Tables:
    """The tables of an open file, for one pass: more would exceed its budget of steps.

    Args:
        connection: To the file.
        size: Its size in bytes, including the files beside it.
        path: The file, for errors.
    """

    def __init__(self, connection: sqlite3.Connection, size: int, path: Path) -> None:
        self._connection = connection
        self._size, self._left = size, 2 * size  # names are read twice, UTF-16 becomes longer
        self._path = path
        self.raised: BaseException | None = None
        looks = self._looks()
        next(looks)
        # A handler that raises counts as one that returns 1: this one keeps the signal's exception.
        connection.set_progress_handler(partial(next, looks, 1), _LOOK_STEPS)

    def _looks(self) -> Iterator[int]:
        try:
            for _ in range((_STEPS_A_BYTE * self._size + _LEAST_STEPS) // _LOOK_STEPS):
                yield 0
            self.raised = self.too_much()
        except BaseException as error:
            self.raised = error

    def check_plain(self) -> None:
        """Refuse anything that computes rows or values instead of storing them.

        Raises:
            SourceError: There is a view or a virtual table.
        """
        for name, sql in self.rows("SELECT name, sql FROM sqlite_master WHERE sql IS NOT NULL"):
            if not isinstance(sql, bytes) or not _PLAIN.match(sql):
                shown = bytes(name).decode(errors="replace") if isinstance(name, bytes) else name
                problem = f"has a view or virtual table {shown!r}, which recordings never have"
                remedy = f"Drop it with the sqlite3 tool, or {SALVAGE}"
                raise SourceError(self._path, problem, remedy)

    def select(self, query: str, values: Any = ()) -> sqlite3.Cursor:
        """Rows of numbers, or of the schema, which the file's size bounds."""
        return self._connection.execute(query, values)

    def rows(self, query: str, values: Any = ()) -> Iterator[tuple[Any, ...]]:
        """Rows with texts or blobs, whose total size must not exceed the file's.

        Raises:
            SourceError: It does: pages belong to several rows.
        """
        for row in self._connection.execute(query, values):
            self._left -= sum(len(value) for value in row if isinstance(value, bytes))
            if self._left < 0:
                raise self.too_much()
            yield row

    def too_much(self) -> SourceError:
        """The error for tables that hold more than the file."""
        problem = "is damaged: its tables list more data than a file of its size can hold"
        return SourceError(self._path, problem, SALVAGE_REMEDY)


@contextmanager
def open_tables(path: Path, *, damaged: bool = False) -> Iterator[Tables]:
    """Open a file for reading only.

    Args:
        path: The database.
        damaged: Read a file that was cut short, too, up to where it ends.

    Raises:
        SourceError: It cannot be read; also for errors within the block.
    """
    sides = [Path(f"{path}{suffix}") for suffix in ("-wal", "-journal")]
    beside = sum(side.stat().st_size for side in sides if side.exists())
    options = "mode=ro" if beside else "mode=ro&immutable=1"
    index = Path(f"{path}-shm")  # sqlite creates one to read a -wal, and leaves it behind
    had_index = index.exists()
    connection = tables = None
    try:
        uri = f"{path.absolute().as_uri()}?{options}"
        connection = sqlite3.connect(uri, uri=True, check_same_thread=False)
        connection.text_factory = bytes  # verbatim, whether it is UTF-8 or not
        size = path.stat().st_size + beside
        tables = Tables(connection, size, path)
        connection.execute("PRAGMA trusted_schema = OFF")
        if damaged:  # otherwise sqlite3 opens no file of fewer pages than its header says
            connection.execute("PRAGMA writable_schema = ON")
        if sys.version_info >= (3, 11):
            most = min(max(size, _LEAST_LENGTH), 2**31 - 1)
            connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, most)
        tables.check_plain()
        yield tables
    except (sqlite3.Error, UnicodeDecodeError) as error:
        if tables and tables.raised:
            raise tables.raised from None
        remedy = "If it was cut short, try `.recover` of the sqlite3 tool, or "
        if beside:
            remedy = "It was not closed properly: open and close it once with the sqlite3 tool, or "
        problem = f"cannot be read as sqlite3: {error}"
        raise SourceError(path, problem, remedy + SALVAGE) from None
    finally:
        if connection:
            connection.set_progress_handler(None, 0)
            connection.close()
        if not had_index:
            index.unlink(missing_ok=True)


# ---------------------------------------------------------------- the reader

_MAGIC = b"SQLite format 3\0"
_TOPIC_COLUMNS = ("id", "name", "type", "serialization_format")
_MESSAGE_COLUMNS = {"id", "topic_id", "timestamp", "data"}
_KNOWN_TABLES = {"messages", "topics", "schema", "metadata", "message_definitions"}
_METADATA_KEYS = {"type_description_hash": HASH_KEY}
_TIME_INDEXES = """
    SELECT COUNT(*) FROM pragma_index_list('messages') AS list, pragma_index_info(list.name) AS info
    WHERE NOT list.partial AND info.seqno = 0 AND info.name = 'timestamp'
"""
_INT64 = -(2**63), 2**63 - 1
_MOST = 2**31  # as sqlite3's own limit


class SqliteReader(BagReader):
    """Reads one ``.db3`` file. Channel ids are the ids of the topic rows.

    Every pass has its own connection, so that several can run.

    Args:
        path: The database.
        most: Bytes that a message may have.
        damaged: Read a file that was cut short, too.

    Attributes:
        tables: Content of the small tables by ``db3:<file>:<column>``, verbatim.
        is_indexed: Whether a span of log time can be found without scanning all messages.

    Raises:
        SourceError: The file is missing, damaged, or not a rosbag2 database.
    """

    format = "rosbag2"
    profile = "ros2"
    position = 0
    is_indexed = False

    def __init__(self, path: Path, *, most: int = _MOST, damaged: bool = False) -> None:
        self.path = path
        self.files = [path]
        self._most = most
        self._damaged = damaged
        self._definitions: list[tuple[Schema, str]] = []
        with closing(open_source(path)) as stream:
            if stream.read(len(_MAGIC)) != _MAGIC:
                raise SourceError(self.path, "is not an sqlite3 database")
        with self._opened() as tables:
            self._check_columns(tables)
            self._definitions = list(self._read_definitions(tables))
            self._schemas = [schema for schema, _ in self._definitions]
            self._channels = {channel.id: channel for channel in self._read_topics(tables)}
            self.tables: Mapping[str, str] = dict(self._read_tables(tables))
            self.is_indexed = tables.select(_TIME_INDEXES).fetchone() != (0,)

    def _opened(self) -> AbstractContextManager[Tables]:
        """Its tables, for one pass."""
        return open_tables(self.path, damaged=self._damaged)

    def _columns(self, tables: Tables, table: str) -> list[str]:
        """The columns of a table; none if it is not there."""
        columns = tables.select(f"PRAGMA table_xinfo({table})").fetchall()
        if any(hidden for *_, hidden in columns):
            problem = f"has a computed column in its table {table}, which recordings never have"
            raise SourceError(self.path, problem, SALVAGE_REMEDY)
        return [self._text(column[1], table) for column in columns]

    def _text(self, value: Any, table: str) -> str:
        if not isinstance(value, bytes):
            return "" if value is None else str(value)
        try:
            return value.decode()
        except UnicodeDecodeError:
            problem = f"has text in its table {table} that is not UTF-8"
            raise SourceError(self.path, problem) from None

    def _check_columns(self, tables: Tables) -> None:
        topics, messages = self._columns(tables, "topics"), self._columns(tables, "messages")
        if not {*topics}.issuperset(_TOPIC_COLUMNS) or not {*messages} >= _MESSAGE_COLUMNS:
            raise SourceError(self.path, "is an sqlite3 database, but not of rosbag2")
        if unknown := [name for name in messages if name not in _MESSAGE_COLUMNS]:
            problem = f"has an unknown column {unknown[0]!r} in its table of messages"
            raise SourceError(self.path, problem, "Install a newer mp4ds.")

    def _read_definitions(self, tables: Tables) -> Iterator[tuple[Schema, str]]:
        if not self._columns(tables, "message_definitions"):
            return
        for name, encoding, data, type_hash in tables.rows(
            "SELECT topic_type, encoding, encoded_message_definition, type_description_hash"
            " FROM message_definitions ORDER BY id"
        ):
            table = "message_definitions"
            definition = data if isinstance(data, bytes) else self._text(data, table).encode()
            schema = Schema(self._text(name, table), self._text(encoding, table), definition)
            yield schema, self._text(type_hash, table)

    def _read_topics(self, tables: Tables) -> Iterator[Channel]:
        columns = self._columns(tables, "topics")
        for row in tables.rows("SELECT * FROM topics ORDER BY id"):
            fields = dict(zip(columns, row, strict=True))
            number = fields.pop("id")
            texts = {column: self._text(value, "topics") for column, value in fields.items()}
            name, type_name, encoding = (texts.pop(column) for column in _TOPIC_COLUMNS[1:])
            metadata = {_METADATA_KEYS.get(column, column): text for column, text in texts.items()}
            schema = self._definition(type_name, metadata.get(HASH_KEY, ""))
            yield Channel(number, name, encoding, schema, metadata)

    def _definition(self, type_name: str, type_hash: str) -> Schema:
        found = [item for item in self._definitions if item[0].name == type_name]
        unknown = Schema(type_name, "", b""), type_hash
        return min(found, key=lambda item: item[1] != type_hash, default=unknown)[0]

    def _read_tables(self, tables: Tables) -> Iterator[tuple[str, str]]:
        prefix = f"db3:{self.path.name}"
        for column in self._columns(tables, "schema"):
            quoted = column.replace('"', '""')
            row = next(tables.rows(f'SELECT "{quoted}" FROM schema LIMIT 1'), None)
            if row:
                yield f"{prefix}:{column}", self._text(row[0], "schema")
        if self._columns(tables, "metadata"):
            for number, version, text in tables.rows(
                "SELECT id, metadata_version, metadata FROM metadata ORDER BY id"
            ):
                yield f"{prefix}:metadata:{number}", self._text(text, "metadata")
                yield f"{prefix}:metadata_version:{number}", self._text(version, "metadata")
        hashes = {(c.type_name, c.metadata.get(HASH_KEY, "")) for c in self._channels.values()}
        for number, (schema, type_hash) in enumerate(self._definitions, 1):
            if (schema.name, type_hash) not in hashes:
                yield f"{prefix}:definition_hash:{number}:{schema.name}", type_hash
        names = tables.rows("SELECT name FROM sqlite_master WHERE type = 'table'")
        for name in sorted(self._text(row[0], "sqlite_master") for row in names):
            if name not in _KNOWN_TABLES and not name.startswith("sqlite_"):
                yield f"{prefix}:other_table:{name}", "left out"

    @cached_property
    def span(self) -> tuple[int, int] | None:
        """Earliest and latest log time, nanoseconds; None without messages."""
        ends = (f"(SELECT {end}(timestamp) FROM messages)" for end in ("MIN", "MAX"))
        with self._opened() as tables:
            first, last = tables.select(f"SELECT {', '.join(ends)}").fetchone()
        return (first, last) if isinstance(first, int) and isinstance(last, int) else None

    def _records(self, excerpt: Excerpt) -> Iterator[Message]:
        """Read all messages or an excerpt by log time, ties by row id."""
        if excerpt == EVERYTHING:
            yield from self._all_records()
        elif excerpt.has_messages:
            yield from self._excerpt_records(excerpt)

    def _all_records(self) -> Iterator[Message]:
        size = self.path.stat().st_size
        with self._opened() as tables:
            # Counted without the index, which may lack messages where it is damaged.
            # COUNT(*) would continue without a look at signals.
            query = "SELECT COUNT(1) FROM messages NOT INDEXED"
            (rows,) = tables.select(query).fetchone()
            read = self.position = 0
            # Ids first: without an index, sorting whole rows would copy the recording.
            query = "SELECT id, timestamp FROM messages ORDER BY timestamp, id"
            before = None
            for read, row in enumerate(tables.select(query), 1):
                message = self._message(tables, row[0], f"message {read}")
                if row == before or row[1] != message.log_time:  # one twice, another not at all
                    raise self._bad_index()
                before = row
                self.position = min(size, size * read // max(1, rows))
                yield message
            if read != rows:
                raise self._bad_index()

    def _excerpt_records(self, excerpt: Excerpt) -> Iterator[Message]:
        channels = self._channels.values()
        unwanted = {channel.id for channel in channels if not excerpt.has_topic(channel.topic)}
        # A message with an unknown topic id belongs to no topic: all readers refuse it.
        column = "topic_id" if unwanted else "NULL"
        with self._opened() as tables:
            for where, times in _conditions(excerpt):
                query = f"SELECT id, {column} FROM messages {where} ORDER BY timestamp, id"
                for row_id, topic_id in tables.select(query, times):
                    if topic_id not in unwanted:
                        yield self._message(tables, row_id, f"message of id {row_id}")

    def _bad_index(self) -> SourceError:
        problem = "is damaged: its index of times does not list its messages"
        remedy = f"Rebuild it with `REINDEX` in the sqlite3 tool, or {SALVAGE}"
        return SourceError(self.path, problem, remedy)

    def _message(self, tables: Tables, row_id: int, place: str) -> Message:
        # a decompressed copy may hold a message that is large though its file is small
        query = (
            "SELECT topic_id, timestamp, CASE WHEN length(data) <= ? THEN data END, typeof(data),"
            " length(data) FROM messages WHERE id = ?"
        )
        row = next(tables.rows(query, (self._most, row_id)), None)
        if row is None:
            raise self._bad_index()
        topic_id, timestamp, data, kind, size = row
        channel = self._channels.get(topic_id)
        if channel is None:
            problem = f"{place} has topic id {topic_id}, which is not in its table of topics"
            remedy = f"`ros2 bag convert` leaves such messages out, or {SALVAGE}"
            raise SourceError(self.path, problem, remedy)
        place = f"{place}, topic {channel.topic}"
        problem = ""
        if not isinstance(timestamp, int) or timestamp < 0:
            problem = f"{timestamp!r} is not a valid time"
        elif kind != b"blob":
            problem = f"the payload is {kind.decode()}, not a blob"
        elif data is None:
            error = OversizeError(f"it has {size} bytes", self._most)
            raise unreadable(self.path, f": {place}", error, SALVAGE_REMEDY)
        if problem:
            raise SourceError(self.path, f"{place}: {problem}", SALVAGE_REMEDY)
        return Message(channel, timestamp, timestamp, 0, data)

    def _stats(self) -> Mapping[int, ChannelStats]:
        """Counts and spans by channel id."""
        stats = {channel_id: ChannelStats(0, 0, 0) for channel_id in self._channels}
        with self._opened() as tables:
            for topic_id, count, start, end in tables.select(
                "SELECT topic_id, COUNT(*), MIN(timestamp), MAX(timestamp)"
                " FROM messages NOT INDEXED GROUP BY topic_id"
            ):
                if topic_id in stats and isinstance(start, int) and isinstance(end, int):
                    stats[topic_id] = ChannelStats(count, start, end)
        return stats

    def _times(self) -> Mapping[int, NDArray[np.int64]]:
        """Log times by channel id, nanoseconds, sorted."""
        times: dict[int, array[int]] = {}
        with self._opened() as tables:
            for topic_id, timestamp in tables.select(
                "SELECT topic_id, timestamp FROM messages WHERE typeof(timestamp) = 'integer'"
            ):
                times.setdefault(topic_id, array("q")).append(timestamp)
        return {key: np.sort(np.array(values, np.int64)) for key, values in times.items()}


def _conditions(excerpt: Excerpt) -> Iterator[tuple[str, list[int]]]:
    """The condition of each query for an excerpt's span, and its parameters.

    sqlite sorts null before all numbers, and texts and blobs after them: none of these is a time,
    so spans open at the start or the end find and refuse them.
    """
    first, last = _INT64
    start = first if excerpt.start is None else excerpt.start
    end = last + 1 if excerpt.end is None else excerpt.end
    if start > last or end <= first:
        return
    known = {"timestamp >= ?": start} if start > first else {}
    if end <= last:
        known["timestamp < ?"] = end
        if start <= first:
            yield "WHERE timestamp IS NULL", []
    yield f"WHERE {' AND '.join(known)}" if known else "", list(known.values())


# ---------------------------------------------------------------- the writer

_WITHOUT_QOS, _WITHOUT_HASHES, _NEWEST = 1, 3, 4  # schemas; 2 differs from 3 by no topic

_REMEDY = "Unpack to mcap instead."
_MAX_TIME = 2**63 - 1
_DISK_ERRORS = {"full": errno.ENOSPC, "readonly": errno.EROFS, "read-only": errno.EROFS}
_MESSAGES = """
CREATE TABLE messages(
  id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,
  data BLOB NOT NULL);
CREATE INDEX timestamp_idx ON messages (timestamp ASC);
"""
_INSERT = "INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)"
_TOPICS = """
CREATE TABLE topics(
  id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
  serialization_format TEXT NOT NULL%s);
"""
_ABOUT = """
CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);
CREATE TABLE metadata(
  id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL, metadata TEXT NOT NULL);
"""
_DEFINITIONS = """
CREATE TABLE message_definitions(
  id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL, encoding TEXT NOT NULL,
  encoded_message_definition TEXT NOT NULL, type_description_hash TEXT NOT NULL);
"""


def _schema_of(channel: Channel) -> Schema:
    if channel.schema is None:
        problem = "has no schema, and rosbag2 needs the type of every topic"
        raise ConversionError(channel.topic, problem, _REMEDY)
    return channel.schema


class SqliteWriter(BagWriter):
    """Writes one ``.db3`` file.

    Args:
        path: The file, which must not exist.

    Raises:
        OSError: It cannot be written.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self._topics: dict[TopicMetadata, int] = {}
        self._row_of: dict[int, int] = {}
        self._definitions: dict[tuple[str, str], Schema] = {}
        self._keys: set[str] = set()
        with self._disk_errors():
            self._connection = sqlite3.connect(path, isolation_level=None)
        try:
            with self._disk_errors():
                # An unfinished file is deleted, so it needs no protection against a crash.
                for pragma in ("journal_mode = OFF", "synchronous = OFF"):
                    self._connection.execute(f"PRAGMA {pragma}")
                self._connection.executescript(f"BEGIN;{_MESSAGES}")
        except BaseException:
            self._connection.close()
            raise

    @contextmanager
    def _disk_errors(self) -> Iterator[None]:
        """Report disk errors as every other writer does."""
        try:
            yield
        except sqlite3.DataError:
            raise  # a value that sqlite3 cannot hold
        except sqlite3.DatabaseError as error:
            text = str(error)
            code = next((c for word, c in _DISK_ERRORS.items() if word in text), errno.EIO)
            raise OSError(code, f"{os.strerror(code)} (sqlite3: {text})", str(self.path)) from error

    @staticmethod
    def check_channel(channel: Channel) -> None:
        """Refuse a channel that the tables cannot hold.

        Raises:
            ConversionError: It has no schema.
        """
        _schema_of(channel)

    @staticmethod
    def check_message(message: Message) -> None:
        """Refuse a message that the tables cannot hold.

        Raises:
            ConversionError: Its log time is negative or beyond 63 bits.
        """
        if not 0 <= message.log_time <= _MAX_TIME:
            problem = f"has the log time {message.log_time}, which rosbag2 cannot store"
            raise ConversionError(message.channel.topic, problem, _REMEDY)

    def add_channel(self, channel: Channel) -> None:
        """Add a topic; channels with identical rows share one."""
        schema = _schema_of(channel)
        self._add_definition(schema, channel.metadata.get(HASH_KEY, ""))
        self._keys |= channel.metadata.keys()
        others = len(channel.metadata.keys() - {QOS_KEY, HASH_KEY})
        if others:
            self._omitted["channel metadata entries (sqlite3 storage keeps QoS and hash)"] += others
        topic = TopicMetadata.of(channel)
        self._row_of[channel.id] = self._topics.setdefault(topic, len(self._topics) + 1)

    def add_schema(self, schema: Schema) -> None:
        """Keep a definition that no topic refers to."""
        self._add_definition(schema, "")

    def _add_definition(self, schema: Schema, type_hash: str) -> None:
        if not schema.encoding and not schema.data:
            return
        if self._definitions.setdefault((schema.name, type_hash), schema) != schema:
            self._omitted["message definitions (sqlite3 storage keeps one per type)"] += 1

    def write(self, message: Message) -> None:
        """Append a message, payload verbatim."""
        self.check_message(message)
        if message.publish_time != message.log_time:
            self._omitted["publish times (sqlite3 storage keeps only one time)"] += 1
        if message.sequence:
            self._omitted["sequence numbers (sqlite3 storage keeps none)"] += 1
        row = self._row_of[message.channel.id], message.log_time, message.data
        try:
            with self._disk_errors():
                self._connection.execute(_INSERT, row)
        except (OverflowError, sqlite3.DataError):
            problem = f"has a message of {len(message.data)} bytes, more than sqlite3 can store"
            raise ConversionError(message.channel.topic, problem, _REMEDY) from None

    def add_bag_info(self, version: int, text: str, ros_distro: str) -> None:
        """Write the topics, and the storage file's own description of the recording."""
        schema = _WITHOUT_QOS
        if self._definitions or HASH_KEY in self._keys:
            schema = _NEWEST
        elif QOS_KEY in self._keys:
            schema = _WITHOUT_HASHES
        columns = {_WITHOUT_QOS: 3, _WITHOUT_HASHES: 4, _NEWEST: 5}[schema]
        names = ("offered_qos_profiles", "type_description_hash")[: columns - 3]
        rows = ((row, *astuple(topic)[:columns]) for topic, row in self._topics.items())
        execute, executemany = self._connection.execute, self._connection.executemany
        with self._disk_errors():
            execute(_TOPICS % "".join(f", {name} TEXT NOT NULL" for name in names))
            executemany(f"INSERT INTO topics VALUES (?{', ?' * columns})", rows)
            if schema >= _WITHOUT_HASHES:
                for statement in _ABOUT.split(";"):
                    execute(statement)
                execute("INSERT INTO schema VALUES (?, ?)", (schema, ros_distro))
                execute("INSERT INTO metadata VALUES (NULL, ?, ?)", (version, text))
            if schema >= _NEWEST:
                execute(_DEFINITIONS)
                definitions = (
                    (schema.name, schema.encoding, _text_or_blob(schema.data), type_hash)
                    for (_, type_hash), schema in self._definitions.items()
                )
                insert = "INSERT INTO message_definitions VALUES (NULL, ?, ?, ?, ?)"
                executemany(insert, definitions)

    def add_attachment(self, attachment: Attachment) -> None:
        """Count an attachment."""
        self._omitted["attachments (sqlite3 storage cannot hold any)"] += 1

    def add_metadata(self, record: MetadataRecord) -> None:
        """Count a metadata record."""
        if record.name != MCAP_RECORD:  # there is a table for that
            self._omitted["metadata records (sqlite3 storage cannot hold any)"] += 1

    def finish(self) -> None:
        """Commit, and close the file."""
        with self._disk_errors():
            self._connection.execute("COMMIT")
        self._connection.close()

    def abandon(self) -> None:
        """Close the file as it is."""
        with suppress(sqlite3.Error):
            self._connection.close()


def _text_or_blob(data: bytes) -> str | bytes:
    try:
        return data.decode()
    except UnicodeDecodeError:
        return data
