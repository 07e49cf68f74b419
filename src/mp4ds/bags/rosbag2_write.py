"""Writes rosbag2 recordings of sqlite3 or MCAP storage."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mp4ds.bags.mcap_write import McapWriter
from mp4ds.bags.rosbag2_metadata import (
    METADATA_FILE,
    NATIVE_QOS_VERSION,
    NEWEST_VERSION,
    RECORD,
    TABLES_RECORD,
    BagInfo,
    dump_bag_info,
    dump_yaml,
    has_numeric_qos,
    native_qos,
    parse_bag_info,
)
from mp4ds.bags.rosbag2_sqlite_write import SqliteWriter
from mp4ds.errors import OptionError, SourceError
from mp4ds.records import HASH_KEY, QOS_KEY, Attachment, Channel, Message, MetadataRecord, Schema

_EMPTY_START = 2**63 - 1  # what rosbag2 writes where there is no message
_SUFFIXES = {"sqlite3": "db3", "mcap": "mcap"}
_MCAP_RECORD = "rosbag2"


@dataclass
class _Topic:
    """A topic as metadata.yaml lists it, with its messages counted."""

    name: str
    type_name: str
    serialization_format: str
    qos: str
    type_hash: str
    count: int = 0


class Rosbag2Writer:
    """Writes a rosbag2 folder. See `BagWriter`.

    Given the metadata record ``mp4ds:rosbag2`` of a recording, its version, distribution and
    custom data are kept.

    Args:
        folder: Does not exist yet.
        storage: ``sqlite3`` or ``mcap``.
        name: The recording's name, which its storage file begins with; by default the
            folder's.
        library: Library string of an MCAP storage; this library's own where empty.
        compression: Of the chunks of an MCAP storage: ``zstd``, ``lz4`` or ``none``.

    Raises:
        OptionError: The storage or compression is unknown.
        OSError: The disk refused.
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
        self._folder = folder
        self._storage = storage
        self._name = name or folder.name
        self._file_name = f"{self._name}_0.{_SUFFIXES[storage]}"
        self._source: BagInfo | None = None
        self._source_distro = ""
        self._source_is_whole = False
        self._source_has_record = False
        self._topics: dict[tuple[str, str, str, str, str], _Topic] = {}
        self._topic_of: dict[int, _Topic] = {}
        self._left_out: Counter[str] = Counter()
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
        return dict(self._left_out + Counter(self._writer.omitted))

    def add_channel(self, channel: Channel) -> None:
        """Declare a channel. See `BagWriter.add_channel`."""
        if channel.id in self._topic_of:
            return
        self._writer.add_channel(channel)
        key = (
            channel.topic,
            channel.type_name,
            channel.message_encoding,
            channel.metadata.get(QOS_KEY, ""),
            channel.metadata.get(HASH_KEY, ""),
        )
        self._topic_of[channel.id] = self._topics.setdefault(key, _Topic(*key))

    def add_schema(self, schema: Schema) -> None:
        """Keep a definition that no channel refers to."""
        self._writer.add_schema(schema)

    def write(self, message: Message) -> None:
        """Append a message, payload verbatim."""
        self._writer.write(message)
        self._topic_of[message.channel.id].count += 1
        self._start = min(self._start, message.log_time)
        self._end = max(self._end, message.log_time)

    def add_attachment(self, attachment: Attachment) -> None:
        """Append an attachment; sqlite3 storage counts it in `omitted`."""
        if isinstance(self._writer, McapWriter):
            self._writer.add_attachment(attachment)
        else:
            self._left_out["attachments (sqlite3 storage holds none)"] += 1

    def add_metadata(self, record: MetadataRecord) -> None:
        """Take in what is known of the source, or append a metadata record."""
        if record.name == RECORD:
            self._take_source(record.metadata)
        elif record.name == TABLES_RECORD:
            self._take_distro(record.metadata)
        else:
            self._add_other_metadata(record)

    def _add_other_metadata(self, record: MetadataRecord) -> None:
        if record.name == _MCAP_RECORD and not self._source_is_whole:
            self._source = _parsed(record.metadata.get("serialized_metadata", "")) or self._source
        if isinstance(self._writer, McapWriter):
            self._source_has_record |= record.name == _MCAP_RECORD
            self._writer.add_metadata(record)
        elif record.name != _MCAP_RECORD:  # sqlite3 keeps its like in a table of its own
            self._left_out["metadata records (sqlite3 storage holds none)"] += 1

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
        old_style = any(has_numeric_qos(topic.qos) for topic in self._topics.values())
        return NATIVE_QOS_VERSION - 1 if old_style else NEWEST_VERSION

    def _info(self) -> dict[str, Any]:
        """The content of metadata.yaml as its version lays it out."""
        version = self._version()
        count = sum(topic.count for topic in self._topics.values())
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
                _topic_entry(self._as_listed(topic), version) for topic in self._topics.values()
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

    def _as_listed(self, topic: _Topic) -> _Topic:
        """The topic as the source's metadata.yaml listed it, which may differ from its files."""
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

    def _finish(self) -> None:
        info = self._info()
        inside = dump_yaml(info)
        if isinstance(self._writer, SqliteWriter):
            self._writer.add_bag_info(info["version"], inside, self._ros_distro)
        elif not self._source_has_record:
            self._writer.add_metadata(MetadataRecord(_MCAP_RECORD, {"serialized_metadata": inside}))
        self._writer.__exit__(None)
        (self._folder / METADATA_FILE).write_bytes(dump_bag_info(info).encode())

    def __enter__(self) -> Rosbag2Writer:
        return self

    def __exit__(self, exc_type: type[BaseException] | None, *_: object) -> None:
        if exc_type is not None:
            self._writer.__exit__(exc_type)
            return
        try:
            self._finish()
        except BaseException as error:
            self._writer.__exit__(type(error))
            raise


def _parsed(text: str) -> BagInfo | None:
    try:
        return parse_bag_info(text, Path(METADATA_FILE))
    except SourceError:
        return None  # none, or edited by hand: a plain one is written


def _topic_entry(topic: _Topic, version: int) -> dict[str, Any]:
    metadata: dict[str, Any] = {
        "name": topic.name,
        "type": topic.type_name,
        "serialization_format": topic.serialization_format,
    }
    if version >= NATIVE_QOS_VERSION:
        metadata["offered_qos_profiles"] = native_qos(topic.qos)
    elif version >= 4:
        metadata["offered_qos_profiles"] = topic.qos
    if version >= 7:
        metadata["type_description_hash"] = topic.type_hash
    return {"topic_metadata": metadata, "message_count": topic.count}
