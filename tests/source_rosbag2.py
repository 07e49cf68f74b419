"""rosbag2 folders of metadata versions 4 to 9, written with the public libraries alone."""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import yaml
import zstandard
from mcap.writer import CompressionType, Writer

from scenes import Record, Scene, typestore

CUSTOM_DATA = {"operator": "kim", "site": "yard 7: north", "run": "0042"}
POLICIES = {
    "history": ["system_default", "keep_last", "keep_all"],
    "reliability": ["system_default", "reliable", "best_effort"],
    "durability": ["system_default", "transient_local", "volatile"],
    "liveliness": ["system_default", "automatic"],
}


class PlainDumper(yaml.SafeDumper):
    """Writes no anchors, as rosbag2 does not either."""

    def ignore_aliases(self, data: object) -> bool:
        return True


def dump(value: object) -> str:
    return yaml.dump(value, Dumper=PlainDumper, sort_keys=False)


def qos_profiles(topic: str) -> list[dict[str, Any]]:
    """Offered QoS of a topic's publishers, policies by name."""
    infinite = {"sec": 9223372036, "nsec": 854775807}
    foxy = {"sec": 2147483647, "nsec": 4294967295}
    unset = {"sec": 0, "nsec": 0}
    profile = {
        "history": "keep_last",
        "depth": 10,
        "reliability": "reliable",
        "durability": "volatile",
        "deadline": foxy if topic == "/imu" else infinite,
        "lifespan": infinite,
        "liveliness": "automatic",
        "liveliness_lease_duration": unset,
        "avoid_ros_namespace_conventions": False,
    }
    if topic == "/chatter":
        return []
    if topic == "/tf":
        return [profile, profile | {"depth": 100, "durability": "transient_local"}]
    return [profile | {"reliability": "best_effort"}]


def qos_text(topic: str, version: int) -> str:
    """QoS as the YAML text that storage holds: policies as numbers before version 9."""
    profiles = qos_profiles(topic)
    if version < 9:
        numbers = {key: names.index for key, names in POLICIES.items()}
        profiles = [
            {k: numbers[k](v) if k in numbers else v for k, v in profile.items()}
            for profile in profiles
        ]
    return dump(profiles).strip() if profiles else ""


def rosbag2_information(
    topics: Mapping[str, str],
    files: Mapping[str, Sequence[Record]],
    *,
    storage: str,
    version: int,
    compression: str | None = None,
) -> dict[str, Any]:
    """``rosbag2_bagfile_information`` of a metadata.yaml as its version has it (4 to 9)."""
    messages = [message for part in files.values() for message in part]
    counts = Counter(message.topic for message in messages)

    def span(part: Sequence[Record]) -> dict[str, Any]:
        times = [message.log_time for message in part] or [0]
        duration = {"nanoseconds": max(times) - min(times)}
        return {
            "duration": duration,
            "starting_time": {"nanoseconds_since_epoch": min(times)},
            "message_count": len(part),
        }

    listed = []
    for topic, msgtype in topics.items():
        qos = qos_profiles(topic) if version >= 9 else qos_text(topic, version)
        entry: dict[str, Any] = {"name": topic, "type": msgtype, "serialization_format": "cdr"}
        entry["offered_qos_profiles"] = qos
        if version >= 7:
            entry["type_description_hash"] = typestore("cdr").hash_rihs01(msgtype)
        listed.append({"topic_metadata": entry, "message_count": counts[topic]})
    information = {"version": version, "storage_identifier": storage, **span(messages)}
    information |= {
        "topics_with_message_count": listed,
        "compression_format": "zstd" if compression else "",
        "compression_mode": compression.upper() if compression else "",
        "relative_file_paths": list(files),
    }
    if version >= 5:
        information["files"] = [{"path": name, **span(part)} for name, part in files.items()]
    if version >= 6:
        information["custom_data"] = CUSTOM_DATA
    if version >= 8:
        information["ros_distro"] = "jazzy" if version >= 9 else "iron"
    return information


def write_rosbag2(
    path: Path,
    scene: Scene,
    storage: str = "sqlite3",
    version: int = 9,
    compression: str | None = None,
    *,
    files: int = 1,
) -> None:
    """A rosbag2 folder with a metadata.yaml of the version, and storage of its time.

    Args:
        path: The folder to make.
        scene: What to write; publishers of one topic become one.
        storage: ``sqlite3`` or ``mcap``.
        version: Of the metadata, 4 to 9.
        compression: None, ``file`` or ``message``; both by zstd.
        files: How many storage files the recording is split into.
    """
    path.mkdir(parents=True)
    suffix = ".db3" if storage == "sqlite3" else ".mcap"
    ending = suffix + (".zstd" if compression == "file" else "")
    size = -(-len(scene.messages) // files)
    parts = [scene.messages[i * size : (i + 1) * size] for i in range(files)]
    names = {f"{path.name}_{i}{ending}": part for i, part in enumerate(parts)}
    topics = {message.topic: message.msgtype for message in scene.messages} | scene.silent
    information = rosbag2_information(
        topics, names, storage=storage, version=version, compression=compression
    )
    write = _write_sqlite if storage == "sqlite3" else _write_rosbag2_mcap
    for i, part in enumerate(parts):
        file = path / f"{path.name}_{i}{suffix}"
        payloads = [(message, message.payload("cdr")) for message in part]
        if compression == "message":
            payloads = [(message, zstandard.compress(raw)) for message, raw in payloads]
        write(file, topics, payloads, information)
        if compression == "file":
            Path(f"{file}.zstd").write_bytes(zstandard.compress(file.read_bytes()))
            file.unlink()
    document = dump({"rosbag2_bagfile_information": information})
    (path / "metadata.yaml").write_text(document, "utf-8")


def _write_sqlite(
    path: Path,
    topics: Mapping[str, str],
    messages: Sequence[tuple[Record, bytes]],
    information: Mapping[str, Any],
) -> None:
    """Tables as Foxy (4), Humble (5, 6) and Iron or later (7 to 9) make them."""
    version, store = information["version"], typestore("cdr")
    ids = {topic: i for i, topic in enumerate(topics, 1)}
    with closing(sqlite3.connect(path)) as database, database:
        create, insert = database.execute, database.executemany
        create("PRAGMA synchronous = OFF")  # no test needs it after a power cut
        hashed = ", type_description_hash TEXT NOT NULL" if version >= 7 else ""
        create(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, "
            f"serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL{hashed})"
        )
        create(
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, "
            "timestamp INTEGER NOT NULL, data BLOB NOT NULL)"
        )
        create("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
        if version >= 5:
            create("CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT)")
            create("INSERT INTO schema VALUES(?, 'any')", (4 if version >= 7 else 3,))
            create("CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version, metadata)")
        if version >= 7:
            create(
                "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT, "
                "encoding TEXT, encoded_message_definition TEXT, type_description_hash TEXT)"
            )
            for msgtype in sorted(set(topics.values())):
                definition = store.generate_msgdef(msgtype, ros_version=2)[0]
                told = (msgtype, "ros2msg", definition, store.hash_rihs01(msgtype))
                create("INSERT INTO message_definitions VALUES(NULL, ?, ?, ?, ?)", told)
            create("INSERT INTO metadata VALUES(1, ?, ?)", (version, dump(information)))
        for topic, msgtype in topics.items():
            row = [ids[topic], topic, msgtype, "cdr", qos_text(topic, version)]
            row += [store.hash_rihs01(msgtype)] if version >= 7 else []
            create(f"INSERT INTO topics VALUES({', '.join('?' * len(row))})", row)
        rows = [(ids[message.topic], message.log_time, raw) for message, raw in messages]
        insert("INSERT INTO messages VALUES(NULL, ?, ?, ?)", rows)


def _write_rosbag2_mcap(
    path: Path,
    topics: Mapping[str, str],
    messages: Sequence[tuple[Record, bytes]],
    information: Mapping[str, Any],
) -> None:
    """As the MCAP plugin does: topics without messages stand in metadata.yaml alone."""
    version, store = information["version"], typestore("cdr")
    ids: dict[str, int] = {}
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=1 << 15, compression=CompressionType.ZSTD)
        writer.start("ros2", "libmcap 1.4.0")
        for message, raw in messages:
            topic, msgtype = message.topic, message.msgtype
            if topic not in ids:
                definition = store.generate_msgdef(msgtype, ros_version=2)[0].encode()
                schema = writer.register_schema(msgtype, "ros2msg", definition)
                metadata = {"offered_qos_profiles": qos_text(topic, version)}
                if version >= 7:
                    metadata["topic_type_hash"] = store.hash_rihs01(msgtype)
                ids[topic] = writer.register_channel(topic, "cdr", schema, metadata)
            writer.add_message(ids[topic], message.log_time, raw, message.log_time)
        writer.add_metadata("rosbag2", {"serialized_metadata": dump(information)})
        writer.finish()  # type: ignore[no-untyped-call]
