"""Reads and writes rosbag2 recordings: a folder with metadata.yaml, or a single storage file."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

from mp4ds.bags.files import (
    SALVAGE,
    SALVAGE_REMEDY,
    ZSTD_MAGIC,
    DamageError,
    copy_file,
    decompress_file,
    most_held,
    open_source,
    unreadable,
    unzstd,
)
from mp4ds.bags.formats import CombinedReader
from mp4ds.bags.mcap import McapReader, McapWriter
from mp4ds.bags.mcap_records import MAGIC as MCAP_MAGIC
from mp4ds.bags.protocols import BagReader, BagWriter
from mp4ds.bags.rosbag2_metadata import (
    MCAP_RECORD,
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
    read_bag_info,
)
from mp4ds.bags.rosbag2_sqlite import SqliteReader, SqliteWriter
from mp4ds.errors import SourceError, SourceNotFoundError
from mp4ds.files.urls import remote
from mp4ds.records import (
    QOS_KEY,
    Attachment,
    Channel,
    ChannelStats,
    Excerpt,
    Message,
    MetadataRecord,
    Record,
    Schema,
)

_NEVER = 2**64  # past all log times


class Rosbag2Reader(CombinedReader):
    """Reads a rosbag2 recording of sqlite3 or MCAP storage: its files and one metadata record.

    This record, ``mp4ds:rosbag2``, comes first and holds the metadata.yaml and the small tables of
    the storage files, verbatim. Individually compressed payloads are decompressed. A file whose
    times are not known is taken to follow those listed before it.

    Args:
        path: A folder, or one ``.db3`` or ``.mcap`` file.

    Raises:
        SourceError: The recording is incomplete, damaged, or of an unknown kind.
    """

    format = "rosbag2"
    profile = "ros2"
    _mcap_reader: Callable[..., BagReader] = McapReader
    _sqlite_reader: Callable[..., BagReader] = SqliteReader

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self._first_copy = ExitStack()
        self._info, self._storage_files = self._find_storage()
        self._readers = self._open_storage()
        self._is_packed = [reader is None for reader in self._readers]
        has_yaml = path.is_dir() and (path / METADATA_FILE).is_file()
        self._head = [path / METADATA_FILE] if has_yaml else []
        self.files = [*self._head, *self._storage_files]
        if any(self._is_packed[:1]):
            self._unpack_first()
        mcaps = [reader for reader in self._readers if reader and reader.format == "mcap"]
        self.library = mcaps[0].library if mcaps else ""
        self._storage = "mcap" if mcaps else "sqlite3" if self._readers else ""
        for number, reader in enumerate(self._readers):
            if reader:
                self._declare(number, reader)
        self._tables = [reader.tables for reader in self._readers if reader]
        if self.is_indexed:
            self._declare_listed()

    def _find_storage(self) -> tuple[BagInfo | None, list[Path]]:
        """The metadata.yaml, and the storage files in reading order."""
        if self.path.is_dir():
            info = _folder_info(self.path)
            return info, [self.path / name for name in info.file_names]
        if not self.path.exists():
            raise SourceNotFoundError(self.path)
        sibling = self.path.parent / METADATA_FILE
        beside = read_bag_info(sibling) if sibling.exists() else None
        return beside if beside and self.path.name in beside.file_names else None, [self.path]

    def _open_storage(self) -> list[BagReader | None]:
        """The files' readers; None for one that must be decompressed or fetched first."""
        return [self._storage_reader(file) for file in self._storage_files]

    def _storage_reader(self, file: Path) -> BagReader | None:
        start = _start(file)
        if start.startswith(ZSTD_MAGIC) or (remote(file) and not self._is_mcap(file, start)):
            return None
        return self._file_reader(file)

    def _is_mcap(self, file: Path, start: bytes) -> bool:
        """Whether a storage file, which begins so, is or should be an MCAP file."""
        is_named = file.name.removesuffix(".zstd").endswith(".mcap")
        is_listed = self._info is not None and self._info.storage == "mcap"
        return start == MCAP_MAGIC or is_named or is_listed

    def _file_reader(self, file: Path, **limit: int) -> BagReader:
        """The reader of a file, or of its copy of the same name."""
        is_mcap = self._is_mcap(file, _start(file))
        return (self._mcap_reader if is_mcap else self._sqlite_reader)(file, **limit)

    def _holds_zstd(self, reader: BagReader) -> bool:
        """Whether the messages of a file without metadata.yaml are individually compressed."""
        texts = [text for key, text in reader.tables.items() if ":metadata:" in key]
        return bool(texts) and parse_bag_info(texts[-1], reader.path).compression == "message"

    @contextmanager
    def _opened(self, number: int) -> Iterator[BagReader]:
        reader, file = self._readers[number], self._storage_files[number]
        try:
            with nullcontext(reader) if reader else self._unpacked(file) as part:
                yield part
        except SourceError as error:
            if not self._is_packed[number] or error.path == file:
                raise
            raise SourceError(file, error.problem, error.remedy) from None  # not of its copy

    @contextmanager
    def _unpacked(self, file: Path) -> Iterator[BagReader]:
        """The reader of a copy, which has the name of the file: losses and tables tell it."""
        with tempfile.TemporaryDirectory(prefix="mp4ds-") as folder:
            copy = Path(folder) / file.name
            self._unpack(file, copy)
            # a small compressed file may hold what claims to be large
            with self._file_reader(copy, most=most_held()) as reader:
                reader.files = [file]
                yield reader

    def _unpack(self, file: Path, target: Path) -> None:
        (decompress_file if _start(file).startswith(ZSTD_MAGIC) else copy_file)(file, target)

    def _unpack_first(self) -> None:
        """Open the first file, whose channels are needed before anything is read, until then."""
        self._readers[0] = self._first_copy.enter_context(self._opened(0))

    def _drop_first(self) -> None:
        if any(self._is_packed[:1]):
            self._readers[0] = None
            self._first_copy.close()

    def _share(self, number: int, channel: Channel) -> Channel:
        """The recording's channel for one of a file, with the QoS of metadata.yaml if it has none.

        Databases of early versions have no column for it.
        """
        if self._info and self._storage == "sqlite3" and QOS_KEY not in channel.metadata:
            name = channel.topic, channel.type_name
            topics = (topic for topic in self._info.topics if (topic.name, topic.type_name) == name)
            if qos := next((topic.qos for topic in topics if topic.qos), None):
                channel = replace(channel, metadata={**channel.metadata, QOS_KEY: qos})
        return super()._share(number, channel)

    def _declare_listed(self) -> None:
        """Declare the topics that only metadata.yaml lists, since they have no messages."""
        if not self._info or not self.path.is_dir():
            return
        known = {(channel.topic, channel.type_name) for channel in self.channels}
        for topic in self._info.topics:
            if (topic.name, topic.type_name) not in known:
                channel = topic.to_channel(len(self._channels))
                self._channels[channel.identity, 0] = channel

    @property
    def is_indexed(self) -> bool:
        """Whether all files are; those that must be decompressed as a whole are not."""
        return not any(self._is_packed) and all(
            reader is not None and reader.is_indexed for reader in self._readers
        )

    @cached_property
    def spans(self) -> Sequence[tuple[int, int]]:
        """Of each file, bounds of its log times, nanoseconds."""
        starts: list[int] = []
        for number in reversed(range(len(self._readers))):
            span = None
            if self._readers[number]:
                with self._opened(number) as part:
                    span = part.span
            starts.append(span[0] if span else min(starts, default=_NEVER))
        return [(start, _NEVER) for start in reversed(starts)]

    @property
    def position(self) -> int:
        """Bytes read of the files; of one that was decompressed, the share read of its copy."""
        return self._done + sum(map(_position, self._active))

    def _records(self, excerpt: Excerpt) -> Iterator[Record]:
        """The metadata record, then the records of all files, merged."""
        if excerpt.others:
            yield self._metadata_record()
        yield from super()._records(excerpt)
        self._done += sum(file.stat().st_size for file in self._head)
        self._declare_listed()

    def _metadata_record(self) -> MetadataRecord:
        names = "\n".join(file.name for file in self._storage_files)
        content = {"storage": self._storage, "files": names}
        if self._info:
            content[METADATA_FILE] = self._info.text
        for tables in self._tables:
            content.update(tables)
        return MetadataRecord(RECORD, content)

    def _records_of(self, number: int, excerpt: Excerpt) -> Iterator[Record]:
        yield from super()._records_of(number, excerpt)
        if number == 0:
            self._drop_first()

    def _part_records(self, number: int, part: BagReader, excerpt: Excerpt) -> Iterator[Record]:
        if number > 0 and self._is_packed[number] and part.tables:
            yield MetadataRecord(TABLES_RECORD, part.tables)
        is_packed = self._info.compression == "message" if self._info else self._holds_zstd(part)
        records: Iterator[Record | None] = part.records(excerpt)
        if is_packed:
            records = (
                self._unzstd(number, one) if isinstance(one, Message) else one for one in records
            )
        yield from filter(None, records)

    def _unzstd(self, number: int, message: Message) -> Message | None:
        """A message of a file with its payload decompressed; None to leave it out."""
        try:
            return replace(message, data=unzstd(message.data))
        except DamageError as error:
            place = f": message of log time {message.log_time}, topic {message.channel.topic}"
            path = self._storage_files[number]
            raise unreadable(path, place, error, SALVAGE_REMEDY) from None

    def _stats(self) -> Mapping[int, ChannelStats]:
        """Those of all files; empty if one of them must be decompressed first."""
        return {} if None in self._readers else super()._stats()

    def close(self) -> None:
        """Close the files, and remove those that were decompressed."""
        super().close()
        self._drop_first()


def _position(part: BagReader) -> int:
    (file,) = part.files
    if part.path == file:
        return part.position
    return part.position * file.stat().st_size // part.path.stat().st_size


def _start(file: Path) -> bytes:
    with open_source(file) as stream:
        return stream.read(len(MCAP_MAGIC))


def _folder_info(path: Path) -> BagInfo:
    if not (path / METADATA_FILE).exists():
        remedy = f"If it is a rosbag2 recording, run `ros2 bag reindex` on it first, or {SALVAGE}"
        remedy += " If it is a folder of images, use `mp4ds import images`."
        raise SourceError(path, f"has no {METADATA_FILE}", remedy)
    info = read_bag_info(path / METADATA_FILE)
    if missing := [name for name in info.file_names if not (path / name).exists()]:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        problem = f"is incomplete: {missing[0]}{more}, listed in its {METADATA_FILE}, is missing"
        remedy = f"Add the missing file, run `ros2 bag reindex` to do without it, or {SALVAGE}"
        raise SourceError(path, problem, remedy)
    if unlisted := [] if remote(path) else unlisted_storage(path, info.file_names):
        problem = f"has {unlisted[0]}, which its {METADATA_FILE} does not list"
        remedy = f"Move it away, run `ros2 bag reindex` to add it, or {SALVAGE}"
        raise SourceError(path, problem, remedy)
    return info


STORAGE_NAME = re.compile(r"(?P<stem>.*?)(?:_(?P<number>\d+))?\.(?:db3|mcap)(?:\.zstd)?")
"""Names of storage files: the recording's name with a number."""


def unlisted_storage(folder: Path, listed: Collection[str]) -> list[str]:
    """Storage files of a recording that its metadata.yaml does not list.

    Args:
        folder: The recording.
        listed: Those that it lists.
    """

    def stem(name: str) -> str:
        match = STORAGE_NAME.fullmatch(name)
        return match["stem"] if match else name

    there = [file.name for file in folder.iterdir() if file.is_file()]
    stems = {stem(name) for name in listed if name in there}
    return [
        name
        for name in there
        if STORAGE_NAME.fullmatch(name)
        and name not in listed
        and f"{name}.zstd" not in listed  # ROS 2 leaves behind the files it decompressed to play
        and (not stems or stem(name) in stems)
    ]


# ---------------------------------------------------------------- the writer

_EMPTY_START = 2**63 - 1  # what rosbag2 writes without messages
_SUFFIXES = {"sqlite3": "db3", "mcap": "mcap"}
_SINCE = {
    "compression_format": 3,
    "compression_mode": 3,
    "offered_qos_profiles": 4,
    "files": 5,
    "custom_data": 6,
    "type_description_hash": 7,
    "ros_distro": 8,
}
"""Version of metadata.yaml in which a field appeared."""


class Rosbag2Writer(BagWriter):
    """Writes a rosbag2 folder.

    Given the metadata record ``mp4ds:rosbag2`` of a recording, its version, distribution and
    custom data are kept.

    Args:
        folder: Does not exist yet.
        storage: ``sqlite3`` or ``mcap``.
        name: The recording's name, used as the prefix of its storage file; by default the folder's.

    Raises:
        OSError: It cannot be written.
    """

    def __init__(self, folder: Path, *, storage: str, name: str = "") -> None:
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
            SqliteWriter(path) if storage == "sqlite3" else McapWriter(path, profile="ros2")
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
        content = record.metadata
        if record.name in (RECORD, TABLES_RECORD):
            distros = (text for key, text in content.items() if key.endswith(":ros_distro"))
            self._source_distro = next(filter(None, (self._source_distro, *distros)), "")
            if record.name == RECORD:
                texts = [text for key, text in content.items() if ":metadata:" in key]
                self._source = _parsed(content.get(METADATA_FILE, texts[-1] if texts else ""))
                self._source_is_whole = self._source is not None
            return
        if record.name == MCAP_RECORD:
            if not self._source_is_whole:
                self._source = _parsed(content.get("serialized_metadata", "")) or self._source
            self._source_has_record = True
        self._writer.add_metadata(record)

    @property
    def _ros_distro(self) -> str:
        return (self._source.ros_distro if self._source else "") or self._source_distro

    def _info(self) -> dict[str, Any]:
        """The content of metadata.yaml in the layout of its version."""
        old_style = any(has_numeric_qos(topic.qos or "") for topic in self._counts)
        version = NATIVE_QOS_VERSION - 1 if old_style else NEWEST_VERSION
        if self._source:
            version = self._source.version
        prefix = "" if version >= 4 else f"{self._name}/"
        duration = {"nanoseconds": max(0, self._end - self._start)}
        start = {"nanoseconds_since_epoch": self._start}
        count = sum(self._counts.values())
        part = {"starting_time": start, "duration": duration, "message_count": count}
        info = {
            "version": version,
            "storage_identifier": self._storage,
            "duration": duration,
            "starting_time": start,
            "message_count": count,
            "topics_with_message_count": [
                {"topic_metadata": self._listed(topic, version), "message_count": number}
                for topic, number in self._counts.items()
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [prefix + self._file_name],
            "files": [{"path": self._file_name, **part}],
            "custom_data": (dict(self._source.custom_data) if self._source else {}) or None,
            "ros_distro": self._ros_distro,
        }
        return _known_to(version, info)

    def _listed(self, topic: TopicMetadata, version: int) -> dict[str, Any]:
        """A topic as in the source's metadata.yaml, which may differ from its files."""
        qos, type_hash, encoding = topic.qos, topic.type_hash, topic.serialization_format
        listed, name = self._source.topics if self._source else (), (topic.name, topic.type_name)
        found = [one for one in listed if (one.name, one.type_name) == name]
        if len(found) == 1:
            (one,) = found
            encoding = one.serialization_format
            qos = qos if one.qos is None else one.qos
            type_hash = type_hash if one.type_hash is None else one.type_hash
        by_name = version >= NATIVE_QOS_VERSION
        metadata = {
            "name": topic.name,
            "type": topic.type_name,
            "serialization_format": encoding,
            "offered_qos_profiles": native_qos(qos or "") if by_name else qos,
            "type_description_hash": type_hash,
        }
        return _known_to(version, metadata)

    def finish(self) -> None:
        """Complete the storage, and write metadata.yaml."""
        info = self._info()
        inside = dump_yaml(info)
        if isinstance(self._writer, SqliteWriter):
            self._writer.add_bag_info(info["version"], inside, self._ros_distro)
        elif not self._source_has_record:
            self._writer.add_metadata(MetadataRecord(MCAP_RECORD, {"serialized_metadata": inside}))
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


def _known_to(version: int, fields: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in fields.items() if version >= _SINCE.get(key, 0)}
