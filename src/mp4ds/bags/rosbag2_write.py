"""Writes rosbag2 recordings of sqlite3 or MCAP storage."""

from __future__ import annotations

import errno
import os
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import astuple, replace
from pathlib import Path
from typing import Any

from mp4ds.bags.mcap_write import McapWriter
from mp4ds.bags.protocols import BagWriter
from mp4ds.bags.rosbag2_metadata import (
    METADATA_FILE,
    NATIVE_QOS_VERSION,
    NEWEST_VERSION,
    RECORD,
    TABLES_RECORD,
    BagInfo,
    TopicMetadata,
    dump_bag_info,
    dump_yaml,
    has_numeric_qos,
    native_qos,
    parse_bag_info,
)
from mp4ds.errors import ConversionError, OptionError, SourceError
from mp4ds.records import HASH_KEY, QOS_KEY, Attachment, Channel, Message, MetadataRecord, Schema

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


def _schema_of(channel: Channel) -> Schema:
    if channel.schema is None:
        raise ConversionError(
            channel.topic,
            "has no schema, and rosbag2 needs the type of every topic",
            "Unpack to mcap instead.",
        )
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
            raise ConversionError(
                message.channel.topic,
                f"has the log time {message.log_time}, which rosbag2 cannot store",
                "Unpack to mcap instead.",
            )

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
                self._connection.execute(
                    "INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", row
                )
        except (OverflowError, sqlite3.DataError):
            raise ConversionError(
                message.channel.topic,
                f"has a message of {len(message.data)} bytes, more than sqlite3 can store",
                "Unpack to mcap instead.",
            ) from None

    def add_bag_info(self, version: int, text: str, ros_distro: str) -> None:
        """Write the topics, and the storage file's own description of the recording."""
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
            ((row, *astuple(topic)[:columns]) for topic, row in self._topics.items()),
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

    def add_attachment(self, attachment: Attachment) -> None:
        """Count an attachment."""
        self._omitted["attachments (sqlite3 storage cannot hold any)"] += 1

    def add_metadata(self, record: MetadataRecord) -> None:
        """Count a metadata record."""
        if record.name != _MCAP_RECORD:  # there is a table for that
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


# ---------------------------------------------------------------- the writer

_EMPTY_START = 2**63 - 1  # what rosbag2 writes without messages
_SUFFIXES = {"sqlite3": "db3", "mcap": "mcap"}
_MCAP_RECORD = "rosbag2"


class Rosbag2Writer(BagWriter):
    """Writes a rosbag2 folder.

    Given the metadata record ``mp4ds:rosbag2`` of a recording, its version, distribution and
    custom data are kept.

    Args:
        folder: Does not exist yet.
        storage: ``sqlite3`` or ``mcap``.
        name: The recording's name, used as the prefix of its storage file; by default the folder's.
        library: Library string of an MCAP storage; if empty, this library's own.
        compression: Of the chunks of an MCAP storage: ``zstd``, ``lz4`` or ``none``.

    Raises:
        OptionError: The storage or compression is unknown.
        OSError: It cannot be written.
    """

    format = "rosbag2"

    def __init__(
        self,
        folder: Path,
        *,
        storage: str,
        name: str = "",
        library: str = "",
        compression: str = "zstd",
    ) -> None:
        if storage not in _SUFFIXES:
            raise OptionError(f"storage {storage!r} is not known. Use {', '.join(_SUFFIXES)}.")
        super().__init__()
        self._folder = folder
        self._storage = storage
        self._name = name or folder.name
        self._file_name = f"{self._name}_0.{_SUFFIXES[storage]}"
        self._source: BagInfo | None = None
        self._source_distro = ""
        self._source_is_whole = False
        self._source_has_record = False
        self._topic_of: dict[int, TopicMetadata] = {}
        self._counts: dict[TopicMetadata, int] = {}
        self._start = _EMPTY_START
        self._end = 0
        folder.mkdir()
        path = folder / self._file_name
        self._writer: McapWriter | SqliteWriter = (
            SqliteWriter(path)
            if storage == "sqlite3"
            else McapWriter(path, profile="ros2", library=library, compression=compression)
        )

    @property
    def omitted(self) -> Mapping[str, int]:
        """What the storage cannot hold: a phrase -> how many."""
        return self._writer.omitted

    def add_channel(self, channel: Channel) -> None:
        """Declare a channel, which is a topic."""
        if channel.id in self._topic_of:
            return
        self._writer.add_channel(channel)
        topic = self._topic_of[channel.id] = TopicMetadata.of(channel)
        self._counts.setdefault(topic, 0)

    def add_schema(self, schema: Schema) -> None:
        """Keep a definition that no channel refers to."""
        self._writer.add_schema(schema)

    def write(self, message: Message) -> None:
        """Append a message, payload verbatim."""
        self._writer.write(message)
        self._counts[self._topic_of[message.channel.id]] += 1
        self._start = min(self._start, message.log_time)
        self._end = max(self._end, message.log_time)

    def add_attachment(self, attachment: Attachment) -> None:
        """Append an attachment, if the storage can hold it."""
        self._writer.add_attachment(attachment)

    def add_metadata(self, record: MetadataRecord) -> None:
        """Take over the metadata of the source recording, or append a metadata record."""
        if record.name == RECORD:
            self._take_source(record.metadata)
        elif record.name == TABLES_RECORD:
            self._take_distro(record.metadata)
        else:
            self._add_other_metadata(record)

    def _add_other_metadata(self, record: MetadataRecord) -> None:
        if record.name == _MCAP_RECORD and not self._source_is_whole:
            self._source = _parsed(record.metadata.get("serialized_metadata", "")) or self._source
        self._source_has_record |= record.name == _MCAP_RECORD
        self._writer.add_metadata(record)

    def _take_source(self, content: Mapping[str, str]) -> None:
        self._take_distro(content)
        texts = [text for key, text in content.items() if ":metadata:" in key]
        self._source = _parsed(content.get(METADATA_FILE, texts[-1] if texts else ""))
        self._source_is_whole = self._source is not None

    def _take_distro(self, content: Mapping[str, str]) -> None:
        distros = [text for key, text in content.items() if key.endswith(":ros_distro") and text]
        self._source_distro = self._source_distro or (distros[0] if distros else "")

    @property
    def _ros_distro(self) -> str:
        return (self._source.ros_distro if self._source else "") or self._source_distro

    def _version(self) -> int:
        if self._source:
            return self._source.version
        old_style = any(has_numeric_qos(topic.qos or "") for topic in self._counts)
        return NATIVE_QOS_VERSION - 1 if old_style else NEWEST_VERSION

    def _info(self) -> dict[str, Any]:
        """The content of metadata.yaml in the layout of its version."""
        version = self._version()
        count = sum(self._counts.values())
        span = {
            "duration": {"nanoseconds": max(0, self._end - self._start)},
            "starting_time": {"nanoseconds_since_epoch": self._start},
        }
        prefix = "" if version >= 4 else f"{self._name}/"
        info: dict[str, Any] = {
            "version": version,
            "storage_identifier": self._storage,
            **span,
            "message_count": count,
            "topics_with_message_count": [
                _topic_entry(self._as_listed(topic), count, version)
                for topic, count in self._counts.items()
            ],
        }
        if version >= 3:
            info |= {"compression_format": "", "compression_mode": ""}
        info["relative_file_paths"] = [prefix + self._file_name]
        if version >= 5:
            info["files"] = [
                {
                    "path": self._file_name,
                    "starting_time": span["starting_time"],
                    "duration": span["duration"],
                    "message_count": count,
                }
            ]
        if version >= 6:
            info["custom_data"] = (dict(self._source.custom_data) if self._source else {}) or None
        if version >= 8:
            info["ros_distro"] = self._ros_distro
        return info

    def _as_listed(self, topic: TopicMetadata) -> TopicMetadata:
        """The topic as listed in the source's metadata.yaml, which may differ from its files."""
        found = [
            listed
            for listed in (self._source.topics if self._source else ())
            if (listed.name, listed.type_name) == (topic.name, topic.type_name)
        ]
        if len(found) != 1:
            return topic
        return replace(
            topic,
            serialization_format=found[0].serialization_format,
            qos=topic.qos if found[0].qos is None else found[0].qos,
            type_hash=topic.type_hash if found[0].type_hash is None else found[0].type_hash,
        )

    def finish(self) -> None:
        """Complete the storage, and write metadata.yaml."""
        info = self._info()
        inside = dump_yaml(info)
        if isinstance(self._writer, SqliteWriter):
            self._writer.add_bag_info(info["version"], inside, self._ros_distro)
        elif not self._source_has_record:
            self._writer.add_metadata(MetadataRecord(_MCAP_RECORD, {"serialized_metadata": inside}))
        self._writer.finish()
        (self._folder / METADATA_FILE).write_bytes(dump_bag_info(info).encode())

    def abandon(self) -> None:
        """Close the storage as it is."""
        self._writer.abandon()


def _parsed(text: str) -> BagInfo | None:
    try:
        return parse_bag_info(text, Path(METADATA_FILE))
    except SourceError:
        return None  # none, or edited by hand: a plain one is written


def _topic_entry(topic: TopicMetadata, count: int, version: int) -> dict[str, Any]:
    metadata: dict[str, Any] = {
        "name": topic.name,
        "type": topic.type_name,
        "serialization_format": topic.serialization_format,
    }
    if version >= NATIVE_QOS_VERSION:
        metadata["offered_qos_profiles"] = native_qos(topic.qos or "")
    elif version >= 4:
        metadata["offered_qos_profiles"] = topic.qos
    if version >= 7:
        metadata["type_description_hash"] = topic.type_hash
    return {"topic_metadata": metadata, "message_count": count}
