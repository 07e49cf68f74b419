"""Writes the sqlite3 storage files of rosbag2.

Their tables are of schema 4, or of the older one that has columns for just what is there: an
old recording comes out with the columns that it had.
"""

from __future__ import annotations

import errno
import os
import sqlite3
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from mp4ds.errors import ConversionError
from mp4ds.records import HASH_KEY, QOS_KEY, Channel, Message, Schema

_WITHOUT_QOS, _WITHOUT_HASHES, _NEWEST = 1, 3, 4  # schemas; 2 differs from 3 by no topic

_MAX_TIME = 2**63 - 1
_DISK_ERRORS = {"full": errno.ENOSPC, "readonly": errno.EROFS, "read-only": errno.EROFS}
_MESSAGES = """
CREATE TABLE messages(
  id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,
  data BLOB NOT NULL);
CREATE INDEX timestamp_idx ON messages (timestamp ASC);
"""
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


def check_channel(channel: Channel) -> None:
    """Refuse a channel that the tables cannot hold.

    Raises:
        ConversionError: It has no schema.
    """
    _schema_of(channel)


def _schema_of(channel: Channel) -> Schema:
    if channel.schema is None:
        raise ConversionError(
            channel.topic,
            "has no schema, and rosbag2 wants the type of every topic",
            "Unpack to mcap instead.",
        )
    return channel.schema


def check_message(message: Message) -> None:
    """Refuse a message that the tables cannot hold.

    Raises:
        ConversionError: Its log time is negative or beyond 63 bits.
    """
    if not 0 <= message.log_time <= _MAX_TIME:
        raise ConversionError(
            message.channel.topic,
            f"has the log time {message.log_time}, which rosbag2 cannot hold",
            "Unpack to mcap instead.",
        )


class SqliteWriter:
    """Writes one ``.db3`` file.

    Args:
        path: The file, which must not exist.

    Raises:
        OSError: The disk refused.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._topics: dict[tuple[str, str, str, str, str], int] = {}
        self._row_of: dict[int, int] = {}
        self._definitions: dict[tuple[str, str], Schema] = {}
        self._keys: set[str] = set()
        self._left_out: Counter[str] = Counter()
        with self._disk_errors():
            self._connection = sqlite3.connect(path, isolation_level=None)
        try:
            with self._disk_errors():
                # An unfinished file is thrown away, so nothing guards it against a crash.
                for pragma in ("journal_mode = OFF", "synchronous = OFF"):
                    self._connection.execute(f"PRAGMA {pragma}")
                self._connection.executescript(f"BEGIN;{_MESSAGES}")
        except BaseException:
            self._connection.close()
            raise

    @contextmanager
    def _disk_errors(self) -> Iterator[None]:
        """Report what the disk refused as every other writer does."""
        try:
            yield
        except sqlite3.DataError:
            raise  # a value that sqlite3 cannot hold
        except sqlite3.DatabaseError as error:
            text = str(error)
            code = next((c for word, c in _DISK_ERRORS.items() if word in text), errno.EIO)
            raise OSError(code, f"{os.strerror(code)} (sqlite3: {text})", str(self.path)) from error

    @property
    def omitted(self) -> Mapping[str, int]:
        """What the tables cannot hold: a phrase -> how many."""
        return self._left_out

    def add_channel(self, channel: Channel) -> None:
        """Add a topic; channels that its row cannot tell apart share one."""
        schema = _schema_of(channel)
        qos, type_hash = channel.metadata.get(QOS_KEY, ""), channel.metadata.get(HASH_KEY, "")
        self._add_definition(schema, type_hash)
        self._keys |= channel.metadata.keys()
        others = len(channel.metadata.keys() - {QOS_KEY, HASH_KEY})
        if others:
            self._left_out["channel metadata entries (sqlite3 storage keeps QoS and hash)"] += (
                others
            )
        key = (channel.topic, channel.type_name, channel.message_encoding, qos, type_hash)
        self._row_of[channel.id] = self._topics.setdefault(key, len(self._topics) + 1)

    def add_schema(self, schema: Schema) -> None:
        """Keep a definition that no topic refers to."""
        self._add_definition(schema, "")

    def _add_definition(self, schema: Schema, type_hash: str) -> None:
        if not schema.encoding and not schema.data:
            return
        if self._definitions.setdefault((schema.name, type_hash), schema) != schema:
            self._left_out["message definitions (sqlite3 storage keeps one for a type)"] += 1

    def write(self, message: Message) -> None:
        """Append a message, payload verbatim."""
        check_message(message)
        if message.publish_time != message.log_time:
            self._left_out["publish times (sqlite3 storage keeps one time)"] += 1
        if message.sequence:
            self._left_out["sequence numbers (sqlite3 storage keeps none)"] += 1
        row = self._row_of[message.channel.id], message.log_time, message.data
        try:
            with self._disk_errors():
                self._connection.execute(
                    "INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", row
                )
        except (OverflowError, sqlite3.DataError):
            raise ConversionError(
                message.channel.topic,
                f"has a message of {len(message.data)} bytes, more than sqlite3 can hold",
                "Unpack to mcap instead.",
            ) from None

    def add_bag_info(self, version: int, text: str, ros_distro: str) -> None:
        """Write the topics, and what the storage file itself tells of the recording."""
        schema = _WITHOUT_QOS
        if self._definitions or HASH_KEY in self._keys:
            schema = _NEWEST
        elif QOS_KEY in self._keys:
            schema = _WITHOUT_HASHES
        with self._disk_errors():
            self._write_topics({_WITHOUT_QOS: 3, _WITHOUT_HASHES: 4, _NEWEST: 5}[schema])
            if schema >= _WITHOUT_HASHES:
                self._write_about(schema, version, text, ros_distro)
            if schema >= _NEWEST:
                self._write_definitions()

    def _write_topics(self, columns: int) -> None:
        names = ("offered_qos_profiles", "type_description_hash")[: columns - 3]
        self._connection.execute(_TOPICS % "".join(f", {name} TEXT NOT NULL" for name in names))
        self._connection.executemany(
            f"INSERT INTO topics VALUES (?{', ?' * columns})",
            ((row, *key[:columns]) for key, row in self._topics.items()),
        )

    def _write_about(self, schema: int, version: int, text: str, ros_distro: str) -> None:
        for statement in _ABOUT.split(";"):
            self._connection.execute(statement)
        self._connection.execute("INSERT INTO schema VALUES (?, ?)", (schema, ros_distro))
        self._connection.execute(
            "INSERT INTO metadata (metadata_version, metadata) VALUES (?, ?)", (version, text)
        )

    def _write_definitions(self) -> None:
        self._connection.execute(_DEFINITIONS)
        self._connection.executemany(
            "INSERT INTO message_definitions (topic_type, encoding, encoded_message_definition,"
            " type_description_hash) VALUES (?, ?, ?, ?)",
            (
                (schema.name, schema.encoding, _text_or_blob(schema.data), type_hash)
                for (_, type_hash), schema in self._definitions.items()
            ),
        )

    def __exit__(self, exc_type: type[BaseException] | None, *_: object) -> None:
        try:
            if exc_type is None:
                with self._disk_errors():
                    self._connection.execute("COMMIT")
        finally:
            with suppress(sqlite3.Error):
                self._connection.close()


def _text_or_blob(data: bytes) -> str | bytes:
    try:
        return data.decode()
    except UnicodeDecodeError:
        return data
