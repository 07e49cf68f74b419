"""Read recordings with public libraries alone, keeping digests and times: for ``compare.py``."""

from __future__ import annotations

import hashlib
import json
import re
import sqlite3
import struct
import tempfile
from array import array
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO, Any, cast

import mcap.records
import numpy as np
import yaml
import zstandard
from mcap.stream_reader import StreamReader
from numpy.typing import NDArray
from rosbags.rosbag1.reader import Header, RecordType, decompressors, read_bytes, read_uint32

from compare_digest import Channel, Digester

QOS_KEY, HASH_KEY = "offered_qos_profiles", "topic_type_hash"
ROS1_FORMAT = frozenset(("topic", "type", "message_definition", "conn", "op"))
MCAP_HOLDS = frozenset(
    ("publish time", "sequence", "definition", "QoS", "type hash", "connection header",
     "attachments", "metadata records", "profile")
)  # fmt: skip


class UnreadableError(Exception):
    """A recording cannot be read; ``str()`` says which and why."""


@dataclass
class Series:
    """Messages of one channel: times as unsigned 64-bit, 16 bytes of digest each."""

    position: array[int] = field(default_factory=lambda: array("Q"))
    log: array[int] = field(default_factory=lambda: array("Q"))
    publish: array[int] = field(default_factory=lambda: array("Q"))
    sequence: array[int] = field(default_factory=lambda: array("Q"))
    digests: bytearray = field(default_factory=bytearray)

    def columns(self) -> list[NDArray[np.uint64]]:
        """Position, log time, publish time, sequence, and both halves of the digest."""
        digests = np.frombuffer(bytes(self.digests), np.uint64).reshape(-1, 2)
        times = (self.position, self.log, self.publish, self.sequence)
        return [np.array(column, np.uint64) for column in times] + [digests[:, 0], digests[:, 1]]


@dataclass
class Recording:
    """What was read of one recording."""

    digester: Digester
    start: int = -(2**63)
    end: int = 2**64
    kind: str = ""
    folder: bool = False
    holds: frozenset[str] = MCAP_HOLDS
    series: dict[Channel, Series] = field(default_factory=dict)
    attachments: list[str] = field(default_factory=list)
    records: list[tuple[str, str]] = field(default_factory=list)
    profiles: list[str] = field(default_factory=list)
    information: dict[str, Any] | None = None
    notes: list[str] = field(default_factory=list)
    count: int = 0

    def opened(self, kind: str, holds: frozenset[str]) -> None:
        """Note the kind of one more file; all of them must hold a property for it to count."""
        if self.kind not in ("", kind):
            raise ValueError(f"mixes {self.kind} and {kind} files")
        self.kind = kind
        self.holds &= holds

    def add(self, channel: Channel, log: int, publish: int, sequence: int, payload: bytes) -> None:
        """Append one message, as digest and times."""
        series = self.series.setdefault(channel, Series())
        if not self.start <= log < self.end:
            return
        series.position.append(self.count)
        series.log.append(log & 0xFFFF_FFFF_FFFF_FFFF)  # sqlite's are signed
        series.publish.append(publish & 0xFFFF_FFFF_FFFF_FFFF)
        series.sequence.append(sequence)
        series.digests += self.digester.digest(channel, payload)
        self.count += 1

    def encodings(self) -> dict[str, set[str]]:
        """Message encodings by topic."""
        found: dict[str, set[str]] = defaultdict(set)
        for channel in self.series:
            found[channel.topic].add(channel.encoding)
        return found


def read(
    paths: Sequence[Path], digester: Digester, start: int = -(2**63), end: int = 2**64
) -> Recording:
    """Read a recording of one or more files; of its messages those from `start` to before `end`.

    Raises:
        UnreadableError: Names the file and says why.
    """
    recording = Recording(digester, start, end)
    for path in paths:
        if path.is_dir():
            with _blamed(path):
                _read_folder(path, recording)
        else:
            _read_file(path, recording)
    return recording


@contextmanager
def _blamed(path: Path) -> Iterator[None]:
    try:
        yield
    except UnreadableError:
        raise
    except Exception as error:  # each library has errors of its own for damaged files
        reason = str(error) or "ends too early"
        raise UnreadableError(f"{path}: {type(error).__name__}: {reason}") from error


def _read_file(path: Path, recording: Recording, *, unpack: bool = False) -> None:
    reader = {".bag": _read_bag, ".mcap": _read_mcap, ".db3": _read_sqlite}.get(path.suffix)
    if reader is None:
        raise UnreadableError(f"{path}: not a .bag, .mcap, .db3 or rosbag2 folder")
    with _blamed(path):
        reader(path, recording, unpack)


def _read_bag(path: Path, recording: Recording, _unpack: bool) -> None:
    """All records in file order; the index is not needed and not trusted."""
    recording.opened("bag", frozenset(("definition", "connection header")))
    connections: dict[int, Channel] = {}

    def scan(stream: IO[bytes]) -> int:
        chunks = 0
        while size := stream.read(4):
            stream.seek(-len(size), 1)
            header = Header.read(cast(Any, stream))
            data = read_bytes(cast(Any, stream), read_uint32(cast(Any, stream)))
            op = header.get_uint8("op")
            if op == RecordType.CHUNK:
                chunks += 1
                scan(BytesIO(decompressors[header.get_string("compression")](data)))
            elif op == RecordType.CONNECTION:
                channel = _bag_channel(header, data)
                known = connections.setdefault(header.get_uint32("conn"), channel)
                if known != channel:
                    recording.notes.append(f"{path}: connection of {known.topic} is told twice")
                recording.series.setdefault(known, Series())
            elif op == RecordType.MSGDATA:
                time = header.get_time("time")
                recording.add(connections[header.get_uint32("conn")], time, time, 0, data)
        return chunks

    with path.open("rb") as stream:
        if stream.readline(20) != b"#ROSBAG V2.0\n":
            raise UnreadableError(f"{path}: not a ROS bag of version 2.0")
        header = Header.read(cast(Any, stream))
        read_bytes(stream, read_uint32(cast(Any, stream)))
        found = scan(stream)
    if header.get_uint64("index_pos") == 0:
        recording.notes.append(f"{path}: the bag has no index; it was read to its end")
    elif found != (promised := header.get_uint32("chunk_count")):
        raise UnreadableError(f"{path}: holds {found} of {promised} chunks")


def _bag_channel(header: Header, data: bytes) -> Channel:
    fields = Header.read(BytesIO(struct.pack("<I", len(data)) + data))
    text = {key: value.decode("utf-8", "surrogateescape") for key, value in fields.items()}
    topic = header["topic"].decode("utf-8", "surrogateescape")
    metadata = {key: value for key, value in text.items() if key not in ROS1_FORMAT}
    # a filter may have renamed the topic: then the publisher's own header has the old name
    if text.get("topic", topic) != topic:
        metadata["topic"] = text["topic"]
    definition = ("ros1msg", fields["message_definition"])
    return Channel(topic, text["type"], "ros1", definition, tuple(sorted(metadata.items())))


def _read_mcap(path: Path, recording: Recording, unpack: bool) -> None:
    """All records in file order, so that attachments without an index are seen as well."""
    recording.opened("mcap", MCAP_HOLDS)
    schemas: dict[int, mcap.records.Schema] = {}
    channels: dict[int, Channel] = {}
    with path.open("rb") as stream:
        for record in StreamReader(stream, validate_crcs=True).records:
            if isinstance(record, mcap.records.Message):
                data = _unpacked(record.data) if unpack else record.data
                times = record.log_time, record.publish_time, record.sequence
                recording.add(channels[record.channel_id], *times, data)
            elif isinstance(record, mcap.records.Schema):
                schemas[record.id] = record
            elif isinstance(record, mcap.records.Channel):
                channel = _mcap_channel(record, schemas)
                channels[record.id] = channel
                recording.series.setdefault(channel, Series())
            elif isinstance(record, mcap.records.Attachment):
                digest = hashlib.sha256(record.data).hexdigest()[:16]
                recording.attachments.append(
                    f"{record.name!r} ({record.media_type}, created {record.create_time}, logged "
                    f"{record.log_time}, {len(record.data)} bytes, sha256 {digest})"
                )
            elif isinstance(record, mcap.records.Metadata):
                text = json.dumps(record.metadata, sort_keys=True)
                recording.records.append((record.name, text))
            elif isinstance(record, mcap.records.Header):
                recording.profiles.append(record.profile)


def _mcap_channel(
    record: mcap.records.Channel, schemas: Mapping[int, mcap.records.Schema]
) -> Channel:
    schema = schemas[record.schema_id] if record.schema_id else None
    definition = (schema.encoding, schema.data) if schema else None
    name = schema.name if schema else ""
    metadata = tuple(sorted(record.metadata.items()))
    return Channel(record.topic, name, record.message_encoding, definition, metadata)


def _read_sqlite(path: Path, recording: Recording, unpack: bool) -> None:
    if not path.is_file():
        raise FileNotFoundError(path)
    address = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
    with closing(sqlite3.connect(address, uri=True)) as database:
        database.text_factory = lambda raw: raw.decode("utf-8", "surrogateescape")
        topics = [row[1] for row in database.execute("PRAGMA table_info(topics)")]
        defined = bool(database.execute("PRAGMA table_info(message_definitions)").fetchall())
        holds = {"definition": defined, "QoS": QOS_KEY in topics}
        holds["type hash"] = "type_description_hash" in topics
        recording.opened("sqlite3", frozenset(name for name, held in holds.items() if held))
        channels = {row["id"]: _sqlite_channel(row, database, defined) for row in _topics(database)}
        for channel in channels.values():
            recording.series.setdefault(channel, Series())
        query = "SELECT topic_id, timestamp, data FROM messages ORDER BY timestamp, id"
        for topic_id, time, data in database.execute(query):
            payload = data if isinstance(data, bytes) else str(data).encode()
            recording.add(
                channels[topic_id], time, time, 0, _unpacked(payload) if unpack else payload
            )


def _topics(database: sqlite3.Connection) -> list[dict[str, Any]]:
    cursor = database.execute("SELECT * FROM topics ORDER BY id")
    names = [column[0] for column in cursor.description]
    return [dict(zip(names, row, strict=True)) for row in cursor]


def _sqlite_channel(row: Mapping[str, Any], database: sqlite3.Connection, defined: bool) -> Channel:
    definition = None
    if defined:
        # One type may be told in several versions; the hash says which belongs to the topic.
        found = database.execute(
            "SELECT encoding, encoded_message_definition FROM message_definitions "
            "WHERE topic_type = ? ORDER BY type_description_hash != ?, id",
            (row["type"], row.get("type_description_hash", "")),
        ).fetchone()
        definition = (found[0], found[1].encode("utf-8", "surrogateescape")) if found else None
    metadata = {QOS_KEY: row.get(QOS_KEY), HASH_KEY: row.get("type_description_hash")}
    held = tuple(sorted((key, value) for key, value in metadata.items() if value is not None))
    return Channel(row["name"], row["type"], row["serialization_format"], definition, held)


def _read_folder(path: Path, recording: Recording) -> None:
    recording.folder = True
    metadata = path / "metadata.yaml"  # a recorder that was killed leaves none
    if not metadata.is_file():
        files = [p for p in path.iterdir() if p.suffix in (".db3", ".mcap")]
        recording.notes.append(f"{path}: no metadata.yaml; files were read in the order of names")
        if not files:
            raise UnreadableError(f"{path}: neither metadata.yaml nor .db3 nor .mcap files")
        for file in sorted(files, key=lambda p: [int(n) for n in re.findall(r"\d+", p.stem)]):
            _read_file(file, recording)
        return
    # Every scalar stays the string that it is written as.
    document = yaml.load(metadata.read_text("utf-8"), yaml.BaseLoader)
    information = recording.information = document["rosbag2_bagfile_information"]
    mode = information.get("compression_mode", "").lower()
    for name in information["relative_file_paths"]:
        file = path / Path(name).name  # older versions list them relative to the parent folder
        if file.suffix == ".zstd":
            _read_compressed(file, recording)
        else:
            _read_file(file, recording, unpack=mode == "message")


def _read_compressed(file: Path, recording: Recording) -> None:
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / file.stem
        with _blamed(file), file.open("rb") as source, target.open("wb") as sink:
            sink.writelines(_unzstd(source))
        _read_file(target, recording)


def _unzstd(source: IO[bytes]) -> Iterator[bytes]:
    frame = None
    while block := source.read(1 << 20):
        while block:
            frame = frame or zstandard.ZstdDecompressor().decompressobj()
            yield frame.decompress(block)
            block = frame.unused_data if frame.eof else b""
            frame = None if frame.eof else frame
    if frame:
        raise ValueError("compressed data end too early")


def _unpacked(payload: bytes) -> bytes:
    return b"".join(_unzstd(BytesIO(payload)))
