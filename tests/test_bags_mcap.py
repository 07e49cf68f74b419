"""MCAP files: what the library reads, we read; what we write, the library reads."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap import records as mcap_records
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader

from conftest import real
from mp4ds.bags.mcap import McapReader, McapWriter
from mp4ds.bags.protocols import write_record
from mp4ds.errors import SourceError
from mp4ds.records import Attachment, Channel, Message, MetadataRecord, Record, Schema

REAL_FILES = (
    "corrupt/sample_ok.mcap",
    "mcap/depthai_recording_json_lz4.mcap",
    "mcap/lichtblick_example2_json.mcap",
    "mcap/mcap_explorer_demo_protobuf_image.mcap",
    "mcap/pj_bad_schema.mcap",
    "mcap/pj_empty_channel.mcap",
    "mcap/pj_publish_vs_log_time.mcap",
    "mcap/reductstore_demo.mcap",
    "mcap/rerun_protobuf_vec3.mcap",
    "mcap/rerun_simple_protobuf.mcap",
    "mcap/roboto_tiny_dvs_ros1profile.mcap",
    "rosbag2/amber_soccer_goal_msgzstd_v0/soccer_goal_12.mcap",
)
IMAGE = Schema("sensor_msgs/msg/Image", "ros2msg", b"uint32 height\n\xff")
OTHER = Schema("pkg/msg/Other", "ros2idl", b"")
UNUSED = Schema("pkg/msg/Unused", "ros2msg", b"int8 x")


def messages(records: Iterable[Record]) -> list[Message]:
    return [record for record in records if isinstance(record, Message)]


def fields(message: Message) -> tuple[Any, ...]:
    return (
        *message.channel.identity,
        message.log_time,
        message.publish_time,
        message.sequence,
        bytes(message.data),
    )


def read(path: Path) -> tuple[McapReader, list[Record]]:
    with McapReader(path) as reader:
        return reader, list(reader.records())


def by_library(path: Path) -> list[Any]:
    with path.open("rb") as stream:
        return list(StreamReader(stream, validate_crcs=True).records)


def check_against_library(path: Path) -> None:
    """Everything that the library's streaming reader finds, and the index against it."""
    found = by_library(path)
    reader, records = read(path)
    expected = [
        (r.channel_id, r.sequence, r.log_time, r.publish_time, r.data)
        for r in found
        if isinstance(r, mcap_records.Message)
    ]
    if any(isinstance(r, mcap_records.ChunkIndex) for r in found):
        expected.sort(key=lambda item: item[2])
    got = messages(records)
    assert [
        (m.channel.id, m.sequence, m.log_time, m.publish_time, bytes(m.data)) for m in got
    ] == expected
    check_declarations(reader, found)
    check_others(records, found)
    check_index(reader, got)
    assert reader.position == path.stat().st_size


def check_declarations(reader: McapReader, found: list[Any]) -> None:
    schemas = {r.id: r for r in found if isinstance(r, mcap_records.Schema)}
    channels = {r.id: r for r in found if isinstance(r, mcap_records.Channel)}
    assert {channel.id for channel in reader.channels} == set(channels)
    for channel in reader.channels:
        record = channels[channel.id]
        assert (channel.topic, channel.message_encoding) == (record.topic, record.message_encoding)
        assert channel.metadata == record.metadata
        schema = schemas.get(record.schema_id)
        assert channel.schema == (
            Schema(schema.name, schema.encoding, schema.data) if schema else None
        )
    header = next(r for r in found if isinstance(r, mcap_records.Header))
    assert (reader.profile, reader.library) == (header.profile, header.library)


def check_others(records: list[Record], found: list[Any]) -> None:
    assert [
        (r.name, r.media_type, r.create_time, r.log_time, r.data)
        for r in records
        if isinstance(r, Attachment)
    ] == [
        (r.name, r.media_type, r.create_time, r.log_time, r.data)
        for r in found
        if isinstance(r, mcap_records.Attachment)
    ]
    assert [(r.name, r.metadata) for r in records if isinstance(r, MetadataRecord)] == [
        (r.name, r.metadata) for r in found if isinstance(r, mcap_records.Metadata)
    ]


def check_index(reader: McapReader, got: list[Message]) -> None:
    times, stats = reader.times(), reader.stats()
    for channel in reader.channels:
        own = [m for m in got if m.channel is channel]
        assert times.get(channel.id, np.empty(0)).tolist() == sorted(m.log_time for m in own)
        if stats:
            span = stats[channel.id]
            assert span.count == len(own)
            assert all(span.start <= m.log_time <= span.end for m in own)
        first = reader.first(channel)
        expected = min(own, key=lambda m: m.log_time, default=None)
        assert (first and fields(first)) == (expected and fields(expected))


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", REAL_FILES)
def test_real_recordings(name: str) -> None:
    check_against_library(real(name))


def test_conformance_files() -> None:
    folder = real("mcap/conformance")
    files = sorted(folder.rglob("*.mcap"))
    assert len(files) > 100
    for file in files:
        check_against_library(file)


def write_all(path: Path, records: Iterable[Record], **options: Any) -> list[Record]:
    records = list(records)
    with McapWriter(path, profile="ros2", **options) as writer:
        writer.add_schema(UNUSED)
        for record in records:
            write_record(writer, record)
        assert writer.omitted == {}
    return records


def scene() -> list[Record]:
    qos = {"offered_qos_profiles": "- history: 3\n", "topic_type_hash": ""}
    channels = (
        Channel(0, "/image", "cdr", IMAGE, qos),
        Channel(7, "/image", "cdr", IMAGE, qos),  # a second publisher, equal in all
        Channel(3, "/other", "cdr", OTHER),
        Channel(65_000, "/none", "json", None, {"": "ü"}),
    )
    records: list[Record] = [MetadataRecord("first", {"a": "1", "ü": ""})]
    for number in range(200):
        channel = channels[number % 4]
        data = memoryview(bytes([number]) * (number * 37 % 5000))
        records.append(Message(channel, 10**18 + number, number, 2**32 - 1 - number, data))
        if number == 100:
            records.append(Attachment("a.txt", "text/plain", 1, 2**64 - 1, b"\x00" * 10))
    return [
        *records,
        Message(channels[0], 2**63 - 1, 2**64 - 1, 0, b""),
        MetadataRecord("first", {}),
    ]


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
@pytest.mark.parametrize("chunk_size", [1, 4096, 10**7])
def test_round_trip(
    tmp_path: Path, compression: str, chunk_size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.mcap"
    monkeypatch.setattr("mp4ds.bags.mcap.CHUNK_BYTES", chunk_size)
    written = write_all(path, scene(), compression=compression)
    reader, records = read(path)
    assert list(map(fields, messages(records))) == list(map(fields, messages(written)))
    assert len({channel.id for channel in reader.channels}) == 4
    assert reader.unused_schemas == [UNUSED]
    others = [r for r in records if not isinstance(r, Message)]
    assert others == [r for r in written if not isinstance(r, Message)]
    assert (reader.profile, reader.library) == ("ros2", "mp4ds 0.1.0")
    assert reader.skipped == {}
    check_against_library(path)
    with path.open("rb") as stream:
        assert sum(1 for _ in make_reader(stream).iter_messages()) == 201


# Damage -----------------------------------------------------------------------------------


def refuse(path: Path, problem: str) -> None:
    def read_everything() -> None:
        with McapReader(path) as reader:
            list(reader.records())

    with pytest.raises(SourceError, match=problem) as caught:
        read_everything()
    assert str(path) in str(caught.value)


def test_not_a_recording(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"#ROSBAG V2.0\n" + bytes(5000))
    refuse(path, "is not an MCAP file")
    for magic in (b"\x89MCAP0\n", b"\x89MCAP0\r\r\n"):
        path.write_bytes(magic + bytes(5000))
        refuse(path, "with converted line endings.* --salvage")
    refuse(tmp_path, "cannot be read")


def test_a_file_cut_short_anywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = tmp_path / "a.mcap"
    monkeypatch.setattr("mp4ds.bags.mcap.CHUNK_BYTES", 2000)
    write_all(whole, scene(), compression="none")
    data = whole.read_bytes()
    path = tmp_path / "cut.mcap"
    for length in [*range(9, 200), *range(200, len(data), 9973), *range(len(data) - 60, len(data))]:
        path.write_bytes(data[:length])
        refuse(path, "mcap recover")


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def text(value: str) -> bytes:
    return struct.pack("<I", len(value.encode())) + value.encode()


def channel_record(topic: str) -> bytes:
    return record(4, struct.pack("<HH", 1, 0) + text(topic) + text("cdr") + text(""))


def message_record(number: int) -> bytes:
    return record(5, struct.pack("<HIQQ", number, 0, 1, 1) + b"payload")


def chunk(
    records: bytes, compression: str = "", crc: int | None = None, size: int | None = None
) -> bytes:
    head = struct.pack(
        "<QQQI",
        1,
        1,
        len(records) if size is None else size,
        zlib.crc32(records) if crc is None else crc,
    )
    return record(6, head + text(compression) + struct.pack("<Q", len(records)) + records)


def file_of(*records: bytes) -> bytes:
    magic = b"\x89MCAP0\r\n"
    end = record(15, bytes(4)) + record(2, bytes(20))
    return magic + record(1, text("") + text("")) + b"".join(records) + end + magic


DAMAGED: dict[str, tuple[bytes, str]] = {
    "unknown compression": (file_of(chunk(b"", "brotli")), "'brotli'"),
    "no channel": (
        file_of(message_record(3)),
        "message 1 belongs to channel 3, which is not defined",
    ),
    "two channels": (
        file_of(channel_record("/a"), channel_record("/b")),
        "defined twice and differently",
    ),
    "two schemas": (
        file_of(*(record(3, b"\1\0" + text(name) + text("") + text("")) for name in "ab")),
        "schema 1 is defined twice",
    ),
    "size": (file_of(chunk(b"", size=3)), "holds 0 bytes instead of 3"),
    "checksum": (file_of(chunk(message_record(1), crc=3)), "checksum"),
    "message": (file_of(record(5, b"abc")), "shorter than its fields"),
    "channel": (file_of(record(4, b"abc")), "Channel is shorter"),
    "not UTF-8": (file_of(record(12, b"\1\0\0\0\xff" + text(""))), "not UTF-8"),
    "chunk": (file_of(record(6, b"abc")), "a chunk is shorter"),
    "record in a chunk": (file_of(chunk(b"\5abc")), "ends within a record"),
    "length in a chunk": (file_of(chunk(message_record(1)[:-1])), "ends within a record"),
    "lz4": (file_of(chunk(b"abc", "lz4", crc=0)), "lz4"),
    "zstd": (file_of(chunk(b"abc", "zstd", crc=0)), "zstd"),
    "bomb": (file_of(chunk(b"abc", "zstd", size=2**60)), "declares"),
    "header": (b"\x89MCAP0\r\n" + file_of()[8:].replace(b"\1", b"\3", 1), "header"),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damage_has_a_sentence(tmp_path: Path, name: str) -> None:
    data, problem = DAMAGED[name]
    path = tmp_path / "a.mcap"
    path.write_bytes(data)
    refuse(path, problem)


def test_an_attachment_is_verified(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_all(path, [Attachment("name", "", 0, 0, b"content")])
    path.write_bytes(path.read_bytes().replace(b"content", b"Content"))
    refuse(path, "attachment 'name' does not match its checksum")
