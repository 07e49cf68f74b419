"""rosbag2 recordings: read verbatim whatever their version and storage, written so that all can."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Iterable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import yaml
import zstandard
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader as RosbagsReader

from conftest import real
from mp4ds.bags.formats import open_sources
from mp4ds.bags.protocols import write_record
from mp4ds.bags.rosbag2 import Rosbag2Reader, Rosbag2Writer
from mp4ds.bags.rosbag2_metadata import RECORD, TABLES_RECORD, parse_bag_info
from mp4ds.bags.rosbag2_sqlite import SqliteWriter
from mp4ds.errors import SourceError
from mp4ds.records import Attachment, Channel, Message, MetadataRecord, Record, Schema
from scenes import scene as camera
from sources import write_rosbag2
from test_bags_mcap import check_index, messages

TESTS = "rosbag2/ros2_rosbag2"
PY = f"{TESTS}/rosbag2_py__test__resources__"
FOLDERS = (
    "rosbag2/geocamxyz_test_bag_sqlite3",
    "rosbag2/ros2bag_tools_images.bag",
    f"{TESTS}/ros2bag__test__resources/empty_bag",
    *(f"{PY}{s}/{name}" for s in ("sqlite3", "mcap") for name in ("convert_a", "convert_b")),
    *(f"{PY}{s}/{name}" for s in ("sqlite3", "mcap") for name in ("talker", "wbag")),
    *(
        f"{TESTS}/rosbag2_tests__resources/{s}/{name}"
        for s in ("sqlite3", "mcap")
        for name in ("bag_with_topics_and_service_events", "cdr_test", "wrong_rmw_test")
    ),
)
OLD_QOS = (
    "- history: 1\n  depth: 5\n  reliability: 2\n  durability: 1\n  deadline:\n"
    "    sec: 9223372036\n    nsec: 854775807\n  lifespan:\n    sec: 2147483647\n"
    "    nsec: 4294967295\n  liveliness: 1\n  liveliness_lease_duration:\n    sec: 0\n"
    "    nsec: 0\n  avoid_ros_namespace_conventions: false"
)
NEW_QOS = (
    OLD_QOS.replace("history: 1", "history: keep_last")
    .replace("reliability: 2", "reliability: best_effort")
    .replace("durability: 1", "durability: transient_local")
    .replace("liveliness: 1", "liveliness: automatic")
)
IMAGE = Schema("sensor_msgs/msg/Image", "ros2msg", b"uint32 height\n# \xc3\xbc\n")
OTHER = Schema("pkg/msg/Other", "ros2idl", b"module pkg {};\r\n")
UNUSED = Schema("pkg/msg/Unused", "ros2msg", b"int8 x")
HASH = "RIHS01_" + "0" * 64


def metadata(records: Iterable[Record], name: str) -> list[dict[str, str]]:
    return [dict(r.metadata) for r in records if isinstance(r, MetadataRecord) and r.name == name]


def fields(message: Message) -> tuple[Any, ...]:
    return (*message.channel.identity, message.log_time, bytes(message.data))


def read(path: Path, **options: Any) -> tuple[Rosbag2Reader, list[Record]]:
    with Rosbag2Reader(path, **options) as reader:
        records = list(reader.records())
        assert reader.position == sum(file.stat().st_size for file in reader.files)
        return reader, records


def payloads_of(path: Path) -> list[tuple[str, int, bytes]]:
    """Topic, time and payload of all messages, by the public libraries alone."""
    if path.suffix == ".db3":
        uri = f"{path.as_uri()}?mode=ro&immutable=1"
        with closing(sqlite3.connect(uri, uri=True)) as connection:
            query = (
                "SELECT name, timestamp, data FROM messages JOIN topics ON topic_id = topics.id"
                " ORDER BY timestamp, messages.id"
            )
            return [tuple(row) for row in connection.execute(query)]
    with path.open("rb") as stream:
        return [(c.topic, m.log_time, m.data) for _, c, m in make_reader(stream).iter_messages()]


@pytest.mark.parametrize("name", FOLDERS)
def test_real_recordings(name: str) -> None:
    path = real(name)
    reader, records = read(path)
    got = messages(records)
    text = (path / "metadata.yaml").read_text()
    info = yaml.safe_load(text)["rosbag2_bagfile_information"]
    files = [path / file for file in info["relative_file_paths"]]
    assert reader.files == [path / "metadata.yaml", *files]
    assert (reader.format, reader.profile) == ("rosbag2", "ros2")
    expected = [row for file in files for row in payloads_of(file)]
    assert [(m.channel.topic, m.log_time, bytes(m.data)) for m in got] == expected
    assert len(got) == info["message_count"] == sum(s.count for s in reader.stats().values())
    listed = {item["topic_metadata"]["name"] for item in info["topics_with_message_count"]}
    assert listed <= {channel.topic for channel in reader.channels}
    (own,) = metadata(records[:1], RECORD)
    assert own["metadata.yaml"] == text
    assert own["storage"] == info["storage_identifier"]
    assert own["files"].split("\n") == info["relative_file_paths"]
    check_index(reader, got)


def put(writer: Rosbag2Writer, records: Iterable[Record]) -> None:
    for record in records:
        write_record(writer, record)


def test_payloads_compressed_within_mcap(tmp_path: Path) -> None:
    source = real("rosbag2/amber_soccer_goal_msgzstd_v0/soccer_goal_12.mcap")
    shutil.copyfile(source, tmp_path / source.name)
    info = {
        "version": 5,
        "storage_identifier": "mcap",
        "compression_format": "zstd",
        "compression_mode": "MESSAGE",
        "relative_file_paths": [source.name],
        "message_count": 1,
        "topics_with_message_count": [],
    }
    (tmp_path / "metadata.yaml").write_text(yaml.dump({"rosbag2_bagfile_information": info}))
    reader, records = read(tmp_path)
    ((_, _, packed),) = payloads_of(source)
    (message,) = messages(records)
    assert bytes(message.data) == zstandard.decompress(packed)
    assert len(message.data) > 640 * 480 * 3
    check_index(reader, [message])
    # The same file alone: what stands beside it tells that its payloads are compressed.
    (alone,) = messages(read(tmp_path / source.name)[1])
    assert alone.data == message.data


def test_a_database_without_metadata() -> None:
    path = real("rosbag2/klintan_sample_2msg/sample.db3")
    reader, records = read(path)
    assert [(m.channel.topic, m.log_time, m.data) for m in messages(records)] == payloads_of(path)
    assert [(c.topic, c.schema, dict(c.metadata)) for c in reader.channels] == [
        ("/text", Schema("std_msgs/String", "", b""), {}),
        ("/image", Schema("sensor_msgs/Image", "", b""), {}),
    ]
    assert metadata(records, RECORD) == [{"storage": "sqlite3", "files": "sample.db3"}]
    check_index(reader, messages(records))


# Round trips ------------------------------------------------------------------------------


def channels(qos: str = OLD_QOS) -> tuple[Channel, ...]:
    told = {"offered_qos_profiles": qos, "topic_type_hash": HASH}
    return (
        Channel(0, "/image", "cdr", IMAGE, told),
        Channel(9, "/on", "cdr", OTHER, {"offered_qos_profiles": "", "topic_type_hash": ""}),
        Channel(5, "/image", "cdr", OTHER, told),
        Channel(6, "/empty", "cdr", IMAGE, told),
    )


def scene(qos: str = OLD_QOS) -> list[Message]:
    return [
        Message(channels(qos)[i % 3], 10**18 + i // 2, 10**18 + i // 2, 0, bytes([i]) * (i * 50))
        for i in range(60)
    ]


def write(
    folder: Path, storage: str, records: Iterable[Record], qos: str = OLD_QOS
) -> dict[str, int]:
    with Rosbag2Writer(folder, storage=storage, name="run") as writer:
        for channel in channels(qos):
            writer.add_channel(channel)
        writer.add_schema(UNUSED)
        put(writer, records)
    return dict(writer.omitted)


def source_record(version: int, **more: Any) -> MetadataRecord:
    info = {"version": version, "storage_identifier": "sqlite3", **more}
    text = yaml.dump({"rosbag2_bagfile_information": info})
    return MetadataRecord(RECORD, {"metadata.yaml": text, "storage": "sqlite3", "files": ""})


@pytest.mark.one_in(3)
@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
@pytest.mark.parametrize("version", [None, *range(2, 10)])
def test_round_trip(tmp_path: Path, storage: str, version: int | None) -> None:
    folder = tmp_path / "made"
    qos = NEW_QOS if version == 9 else "" if version and version < 4 else OLD_QOS
    custom = {"custom_data": {"operator": "kim", "run": "0042"}, "ros_distro": "jazzy"}
    given: list[Record] = [source_record(version, **custom)] if version else []
    assert write(folder, storage, [*given, *scene(qos)], qos) == {}
    assert sorted(file.name for file in folder.iterdir()) == [
        "metadata.yaml",
        f"run_0.{'db3' if storage == 'sqlite3' else 'mcap'}",
    ]
    reader, records = read(folder)
    assert list(map(fields, messages(records))) == list(map(fields, scene(qos)))
    assert {c.identity for c in reader.channels} == {c.identity for c in channels(qos)}
    assert reader.unused_schemas == [UNUSED]
    check_index(reader, messages(records))
    check_layout(folder, version or 8, given != [])
    with RosbagsReader(folder) as public:
        assert public.message_count == 60
        assert [c.topic for c in public.connections] == ["/image", "/on", "/image", "/empty"]
        assert [bytes(data) for _, _, data in public.messages()] == [m.data for m in scene(qos)]
        assert public.ros_distro == (
            "jazzy" if version and version >= 8 else "" if (version or 8) >= 8 else None
        )


def check_layout(folder: Path, version: int, told: bool) -> None:
    info = yaml.safe_load((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    topic = info["topics_with_message_count"][0]["topic_metadata"]
    assert info["version"] == version
    assert ("compression_mode" in info) == (version >= 3)
    assert ("offered_qos_profiles" in topic) == (version >= 4)
    assert ("files" in info) == (version >= 5)
    assert ("custom_data" in info) == (version >= 6)
    assert ("type_description_hash" in topic) == (version >= 7)
    assert ("ros_distro" in info) == (version >= 8)
    assert info["relative_file_paths"][0].startswith("run/") == (version < 4)
    assert (info["message_count"], info["duration"]["nanoseconds"]) == (60, 29)
    assert info["starting_time"]["nanoseconds_since_epoch"] == 10**18
    if version >= 6 and told:
        assert info["custom_data"] == {"operator": "kim", "run": "0042"}
    if version >= 9:
        assert topic["offered_qos_profiles"] == yaml.safe_load(NEW_QOS)
    elif version >= 4:
        assert topic["offered_qos_profiles"] == OLD_QOS


def test_mcap_storage_keeps_everything(tmp_path: Path) -> None:
    channel = channels()[0]
    records: list[Record] = [
        Message(channel, 5, 3, 7, b"a"),
        Attachment("a", "b", 1, 2, b"c"),
        MetadataRecord("mine", {"a": "b"}),
        Message(Channel(8, "/none", "json", None), 2**64 - 1, 1, 1, b""),
    ]
    with Rosbag2Writer(tmp_path / "a", storage="mcap") as writer:
        writer.add_channel(channel)
        writer.add_channel(Channel(8, "/none", "json", None))
        put(writer, records)
    assert writer.omitted == {}
    reader, found = read(tmp_path / "a")
    assert reader.library.startswith("mp4ds ")
    assert [(m.publish_time, m.sequence) for m in messages(found)] == [(3, 7), (1, 1)]
    assert records[1] in found
    assert records[2] in found
    (inside,) = metadata(found, "rosbag2")
    assert yaml.safe_load(inside["serialized_metadata"])["message_count"] == 2


def test_mcap_storage_keeps_the_record_of_the_source(tmp_path: Path) -> None:
    given = MetadataRecord("rosbag2", {"serialized_metadata": "version: 9\nros_distro: jazzy\n"})
    write(tmp_path / "a", "mcap", [given, *scene(NEW_QOS)], NEW_QOS)
    _, found = read(tmp_path / "a")
    assert metadata(found, "rosbag2") == [given.metadata]
    info = metadata(found, RECORD)[0]["metadata.yaml"]
    assert parse_bag_info(info, tmp_path).ros_distro == "jazzy"
    # To sqlite3 the record is no loss: what it tells stands in a table there.
    with Rosbag2Writer(tmp_path / "b", storage="sqlite3") as writer:
        put(writer, found)
    assert writer.omitted == {}


def test_what_sqlite3_cannot_hold_is_counted(tmp_path: Path) -> None:
    told = channels()[0]
    others = Channel(20, "/image", "cdr", Schema(IMAGE.name, "ros2msg", b"other"), told.metadata)
    ros1 = Channel(21, "/ros1", "ros1", IMAGE, {"callerid": "/a", "md5sum": ""})
    with Rosbag2Writer(tmp_path / "a", storage="sqlite3") as writer:
        for channel in (told, others, ros1):
            writer.add_channel(channel)
            writer.add_channel(channel)
        put(writer, [Message(told, 2, 1, 0, b""), Message(told, 3, 1, 9, b"")])
        put(writer, [Attachment("a", "b", 1, 2, b"c"), MetadataRecord("mine", {})])
    assert writer.omitted == {
        "attachments (sqlite3 storage cannot hold any)": 1,
        "channel metadata entries (sqlite3 storage keeps QoS and hash)": 2,
        "message definitions (sqlite3 storage keeps one per type)": 1,
        "metadata records (sqlite3 storage cannot hold any)": 1,
        "publish times (sqlite3 storage keeps only one time)": 2,
        "sequence numbers (sqlite3 storage keeps none)": 1,
    }
    assert [c.topic for c in Rosbag2Reader(tmp_path / "a").channels] == ["/image", "/ros1"]


# Split and compressed recordings ----------------------------------------------------------


def edit(folder: Path, change: Callable[[dict[str, Any]], None]) -> None:
    path = folder / "metadata.yaml"
    document = yaml.safe_load(path.read_text())
    change(document["rosbag2_bagfile_information"])
    path.write_text(yaml.safe_dump(document, sort_keys=False))


def split(tmp_path: Path, storage: str, parts: list[list[Message]]) -> Path:
    """A recording of several storage files."""
    names = []
    for number, part in enumerate(parts):
        folder = tmp_path / f"part{number}"
        write(folder, storage, part)
        (file,) = folder.glob("run_0.*")
        names.append(f"run_{number}{file.suffix}")
        if number:
            shutil.move(file, tmp_path / "part0" / names[-1])
    edit(tmp_path / "part0", lambda info: info.update(relative_file_paths=names))
    return tmp_path / "part0"


def test_a_file_that_is_not_named_is_not_left_out(tmp_path: Path) -> None:
    folder = split(tmp_path, "sqlite3", [scene()[:2], scene()[2:]])
    path = folder / "metadata.yaml"
    text = path.read_text()
    edit(folder, lambda info: info["relative_file_paths"].pop())
    with pytest.raises(SourceError, match=r"which its metadata.yaml does not list"):
        Rosbag2Reader(folder)
    path.write_text(text)
    compress_files(folder)
    with Rosbag2Reader(folder) as reader:
        whole = len(messages(reader.records()))
    for file in folder.glob("*.zstd"):  # as ROS 2 leaves them that has played it
        plain = zstandard.ZstdDecompressor().decompressobj().decompress(file.read_bytes())
        file.with_suffix("").write_bytes(plain)
    for salvage in (False, True):
        with open_sources([folder], salvage=salvage) as opened:
            assert len(messages(opened.records())) == whole


def compress_files(folder: Path, spelling: str = "FILE") -> None:
    for file in folder.glob("run_*"):
        packed = file.with_name(f"{file.name}.zstd")
        # Two frames, as when several compressed files were joined.
        data = file.read_bytes()
        packed.write_bytes(zstandard.compress(data[:999]) + zstandard.compress(data[999:]))
        file.unlink()

    def change(info: dict[str, Any]) -> None:
        info["relative_file_paths"] = [f"{name}.zstd" for name in info["relative_file_paths"]]
        info |= {"compression_mode": spelling, "compression_format": "zstd"}

    edit(folder, change)


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
@pytest.mark.parametrize("spelling", ["file", "FILE"])
def test_compressed_files(
    tmp_path: Path, storage: str, spelling: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = split(tmp_path, storage, [scene()[:25], scene()[25:]])
    compress_files(folder, spelling)
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(work))
    with Rosbag2Reader(folder) as reader:
        known = len(reader.channels)
        assert known == 4
        for _ in range(2):
            records = list(reader.records())
            assert list(map(fields, messages(records))) == list(map(fields, scene()))
            assert reader.position == sum(file.stat().st_size for file in reader.files)
        assert len(reader.channels) == 4
        assert len(metadata(records, TABLES_RECORD)) == (1 if storage == "sqlite3" else 0)
        check_index(reader, messages(records))
    assert list(work.iterdir()) == []


def test_a_database_alone_tells_that_its_payloads_are_compressed(tmp_path: Path) -> None:
    write_rosbag2(tmp_path / "a", camera("mono8"), compression="message")
    expected = list(map(fields, messages(read(tmp_path / "a")[1])))
    (tmp_path / "a" / "metadata.yaml").unlink()
    assert list(map(fields, messages(read(tmp_path / "a" / "a_0.db3")[1]))) == expected


# What a metadata.yaml may say ---------------------------------------------------------------


METADATA_FAULTS: dict[str, tuple[dict[str, Any], str]] = {
    "newer": ({"version": 10}, "metadata version 10"),
    "negative": ({"version": -3}, "metadata version -3"),
    "storage": ({"storage_identifier": "bolt"}, "storage 'bolt'"),
    "format": ({"compression_mode": "file", "compression_format": "lz4"}, "'lz4'"),
    "outside": ({"relative_file_paths": [".."]}, r"lists '\.\.' as a file"),
    "topics": ({"topics_with_message_count": [{"message_count": 1}]}, "not? as expected|expected"),
    "number": ({"version": "new"}, "expected"),
}


@pytest.mark.parametrize("name", METADATA_FAULTS)
def test_metadata_that_cannot_be_followed(tmp_path: Path, name: str) -> None:
    change, problem = METADATA_FAULTS[name]
    write(tmp_path / "a", "sqlite3", scene())
    edit(tmp_path / "a", lambda info: info.update(change))
    with pytest.raises(SourceError, match=problem):
        Rosbag2Reader(tmp_path / "a")


def test_paths_stay_inside_the_folder(tmp_path: Path) -> None:
    write(tmp_path / "a", "sqlite3", scene())
    for name in ("old name/run_0.db3", "../../elsewhere/run_0.db3", "C:\\bags\\run_0.db3"):
        edit(tmp_path / "a", lambda info, name=name: info.update(relative_file_paths=[name]))  # type: ignore[misc]
        assert len(messages(read(tmp_path / "a")[1])) == 60


# What a database may hold ---------------------------------------------------------------------


def database(path: Path, *statements: str) -> Path:
    """A database of five messages, changed afterwards."""
    with filled_database(path) as connection, connection:
        for statement in statements:
            connection.execute(statement)
    return path


def filled_database(path: Path) -> Any:
    writer = SqliteWriter(path)
    writer.add_channel(channels()[0])
    for time in range(5):
        writer.write(Message(channels()[0], time, time, 0, b"abc"))
    writer.add_bag_info(8, "version: 8", "humble")
    writer.__exit__(None, None, None)
    return closing(sqlite3.connect(path))


REBUILT = (
    "CREATE TABLE m(id INTEGER PRIMARY KEY, topic_id, timestamp, data)",
    "INSERT INTO m SELECT * FROM messages",
    "DROP TABLE messages",
    "ALTER TABLE m RENAME TO messages",
)
DATABASE_FAULTS = {
    "null": (
        [*REBUILT, "UPDATE messages SET data = NULL WHERE id = 3"],
        "message 3, topic /image: .* null",
    ),
    "negative": (
        ["UPDATE messages SET timestamp = -5 WHERE id = 3"],
        "message 1, topic /image: -5 is not a valid time",
    ),
    "orphan": (["UPDATE messages SET topic_id = 7 WHERE id = 3"], "message 3 has topic id 7"),
    "column": (["ALTER TABLE messages ADD COLUMN sent INTEGER"], "an unknown column 'sent'"),
    "no table": (["DROP TABLE topics"], "not of rosbag2"),
    "not UTF-8": (
        ["UPDATE topics SET name = CAST(x'ff' AS TEXT)"],
        "table topics that is not UTF-8",
    ),
}


@pytest.mark.parametrize("name", DATABASE_FAULTS)
def test_a_database_that_cannot_be_read(tmp_path: Path, name: str) -> None:
    statements, problem = DATABASE_FAULTS[name]
    path = database(tmp_path / "a.db3", *statements)
    with pytest.raises(SourceError, match=problem) as caught:
        read(path)
    assert str(path) in str(caught.value)


def test_tables_of_older_and_stranger_databases(tmp_path: Path) -> None:
    path = database(
        tmp_path / "a.db3",
        "DROP TABLE message_definitions",
        "DROP TABLE metadata",
        "DROP INDEX timestamp_idx",
        "ALTER TABLE topics ADD COLUMN extra TEXT DEFAULT 'kept'",
        "CREATE TABLE notes(id)",
    )
    reader, records = read(path)
    (channel,) = reader.channels
    assert channel.schema == Schema(IMAGE.name, "", b"")
    assert channel.metadata["extra"] == "kept"
    assert [m.log_time for m in messages(records)] == [0, 1, 2, 3, 4]
    assert metadata(records, RECORD) == [
        {
            "storage": "sqlite3",
            "files": "a.db3",
            "db3:a.db3:schema_version": "4",
            "db3:a.db3:ros_distro": "humble",
            "db3:a.db3:other_table:notes": "left out",
        }
    ]


def test_equal_topics_of_one_file_stay_apart(tmp_path: Path) -> None:
    path = database(
        tmp_path / "a.db3",
        "INSERT INTO topics SELECT 2, name, type, serialization_format, offered_qos_profiles,"
        " type_description_hash FROM topics",
        "UPDATE messages SET topic_id = 2 WHERE id = 2",
    )
    reader, records = read(path)
    assert [c.identity for c in reader.channels] == [channels()[0].identity] * 2
    assert [m.channel.id for m in messages(records)] == [0, 1, 0, 0, 0]


@pytest.mark.parametrize("times", [None, "timestamp + 1"], ids=["fewer", "others"])
def test_a_damaged_index_loses_no_message(times: str | None, tmp_path: Path) -> None:
    path = tmp_path / "a.db3"
    database(path, "PRAGMA writable_schema = ON")
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("PRAGMA writable_schema = ON")
        # An index that was made over fewer messages than there are, or over others.
        connection.execute("CREATE TABLE other(timestamp)")
        if times:
            connection.execute(
                f"INSERT INTO other(rowid, timestamp) SELECT id, {times} FROM messages"
            )
        connection.execute("CREATE INDEX other_idx ON other(timestamp)")
        connection.execute(
            "UPDATE sqlite_master SET rootpage = (SELECT rootpage FROM sqlite_master"
            " WHERE name = 'other_idx') WHERE name = 'timestamp_idx'"
        )
    with pytest.raises(SourceError, match="REINDEX"):
        read(path)
