"""Recordings from strangers: small files that claim much, read in bounded time and memory."""

from __future__ import annotations

import bz2
import io
import os
import re
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from mcap.writer import CompressionType, Writer

import jail
import mp4ds
from mp4ds.bags import files
from mp4ds.bags.mcap import McapReader, McapWriter
from mp4ds.bags.rosbag2_metadata import parse_qos
from mp4ds.errors import RemoteError
from mp4ds.records import Channel, Message, Schema
from remote_servers import web_server
from test_bags_mcap import channel_record, chunk, file_of, record
from test_bags_ros1 import make_bag, plain

TOPICS = (
    "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,"
    " serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL)"
)
MESSAGES = (
    "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,"
    " timestamp INTEGER NOT NULL, data BLOB NOT NULL)"
)
ENDLESS = "WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n)"
ENDLESS_TOPICS = (
    f"CREATE VIEW topics AS {ENDLESS} SELECT id, 'a' AS name, 'b' AS type,"
    " 'cdr' AS serialization_format FROM n"
)
PAGE = 512


# ---------------------------------------------------------------- sqlite3


def database(path: Path, *statements: str, page_size: int = PAGE) -> Path:
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute(f"PRAGMA page_size = {page_size}")
        for statement in statements:
            connection.execute(statement)
    return path


TOPIC = "INSERT INTO topics VALUES(1, '/a', 'b', 'cdr', '')"
NOT_PLAIN = {
    "endless-topics": ((ENDLESS_TOPICS, MESSAGES), "view or virtual table 'topics'"),
    "endless-messages": (
        (
            TOPICS,
            TOPIC,
            f"CREATE VIEW messages AS {ENDLESS} SELECT id, 1 AS topic_id, id AS timestamp,"
            " x'00' AS data FROM n",
        ),
        "view or virtual table 'messages'",
    ),
    "large-value": (
        (
            TOPICS,
            TOPIC,
            "CREATE VIEW messages AS SELECT 1 AS id, 1 AS topic_id, 1 AS timestamp,"
            " CAST(hex(zeroblob(999999999)) AS BLOB) AS data",
        ),
        "view or virtual table 'messages'",
    ),
    "virtual": (
        (TOPICS, "CREATE VIRTUAL TABLE messages USING fts4(id, topic_id, timestamp, data)"),
        "view or virtual table 'messages'",
    ),
    "generated": (
        (
            TOPICS,
            TOPIC,
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp,"
            " data BLOB AS (zeroblob(999999999)))",
            "INSERT INTO messages VALUES(1, 1, 1)",
        ),
        "has a computed column in its table messages",
    ),
    "listed-as-a-table": (
        (
            MESSAGES,
            ENDLESS_TOPICS,
            "PRAGMA writable_schema = ON",
            "UPDATE sqlite_master SET type = 'table' WHERE name = 'topics'",
        ),
        "a.db3: ",
    ),
    "query-as-a-name": (
        (
            TOPICS,
            MESSAGES,
            f'CREATE TABLE schema("a"" FROM ({ENDLESS} SELECT COUNT(1) AS a FROM n) --" INTEGER)',
            "INSERT INTO schema VALUES(1)",
        ),
        "",
    ),
}


@pytest.mark.parametrize("name", NOT_PLAIN)
def test_a_database_is_read_from_plain_tables(name: str, tmp_path: Path) -> None:
    statements, problem = NOT_PLAIN[name]
    path = database(tmp_path / "a.db3", *statements)
    outcome = jail.records(path)
    assert problem in outcome.text
    assert bool(problem) == bool(outcome.error)
    jail.records(path, salvage=True)


def pages_of(path: Path, table: str) -> tuple[bytearray, int]:
    """The file, and where the root page of a table begins."""
    with closing(sqlite3.connect(path)) as connection:
        query = "SELECT rootpage FROM sqlite_master WHERE name = ?"
        (root,) = connection.execute(query, (table,)).fetchone()
    return bytearray(path.read_bytes()), (root - 1) * PAGE


def with_pages(path: Path, data: bytearray) -> None:
    data[28:32] = struct.pack(">I", len(data) // PAGE)
    path.write_bytes(data)


@pytest.mark.parametrize("table", ["topics", "messages"])
def test_pages_that_are_found_by_many_ways(table: str, tmp_path: Path) -> None:
    fill = "INSERT INTO messages VALUES(1, 1, 1, x'00')"
    path = database(tmp_path / "a.db3", TOPICS, MESSAGES, TOPIC, fill)
    data, at = pages_of(path, table)
    leaf = data[at : at + PAGE]
    ways, levels = 80, 10
    first = len(data) // PAGE + 1
    for level in range(levels):
        below = struct.pack(">I", first + level)
        cell = PAGE - 5
        page = b"\5\0\0" + struct.pack(">HHB", ways, cell, 0) + below
        page += struct.pack(">H", cell) * ways
        page = page.ljust(cell, b"\0") + below + b"\1"
        if level == 0:
            data[at : at + PAGE] = page
        else:
            data += page
    with_pages(path, data + leaf)
    outcome = jail.records(path)
    assert "its tables list more data than a file of its size can hold" in outcome.text
    jail.records(path, salvage=True)


def test_rows_that_share_their_pages(tmp_path: Path) -> None:
    fill = "INSERT INTO messages VALUES(1, 1, 1, zeroblob(10000000))"
    path = database(tmp_path / "a.db3", TOPICS, MESSAGES, TOPIC, fill)
    data, at = pages_of(path, "messages")
    cell = data[at + 8 : at + 10]
    data[at + 3 : at + 5] = struct.pack(">H", 80)
    data[at + 8 : at + 168] = cell * 80
    with_pages(path, data)
    assert "does not list its messages" in jail.records(path).text
    # of different keys
    row = bytes(data[at + int.from_bytes(cell, "big") :][: PAGE - int.from_bytes(cell, "big")])
    size = row.index(b"\1", 1)
    starts = []
    page = bytearray(data[at : at + PAGE])
    for number in range(4):
        start = PAGE - (number + 1) * len(row)
        page[start : start + len(row)] = row[:size] + bytes([4 - number]) + row[size + 1 :]
        starts.append(start)
    page[3:5] = struct.pack(">H", 4)
    page[8:16] = struct.pack(">4H", *reversed(starts))
    data[at : at + PAGE] = page
    with_pages(path, data)
    outcome = jail.records(path)
    assert "its tables list more data than a file of its size can hold" in outcome.text
    outcome = jail.records(path, salvage=True)
    assert outcome.messages == 2
    assert "messages of /a with damaged or missing pages" in outcome.problems


# ---------------------------------------------------------------- YAML

BRACKETS = "[" * 50_000
ALIASES = "a0: &a0 [x, x]\n" + "".join(
    f"a{number}: &a{number} [*a{number - 1}, *a{number - 1}]\n" for number in range(1, 60)
)
LONG_ALIASES = f"a: &a {'x' * 10**6}\nb: [{'*a, ' * 10**5}]\n"


@pytest.mark.parametrize("text", [BRACKETS, ALIASES, LONG_ALIASES], ids=["deep", "wide", "long"])
def test_yaml_that_grows(text: str, tmp_path: Path) -> None:
    """As metadata.yaml, and as the QoS profiles of a channel, which stay a text."""
    folder = tmp_path / "a"
    folder.mkdir()
    (folder / "metadata.yaml").write_text(text)
    database(folder / "a_0.db3", TOPICS, MESSAGES, TOPIC)
    outcome = jail.records(folder)
    assert "metadata.yaml: is not valid YAML: " in outcome.text
    jail.records(folder, salvage=True)
    path = recording(tmp_path / "b.mcap", "cdr", "std_msgs/msg/Bool", "", b"", {"qos": text})
    outcome = jail.unpacked(path, "rosbag2")
    assert not outcome.error
    assert parse_qos(text) == []


# ---------------------------------------------------------------- definitions


def recording(
    path: Path,
    encoding: str,
    type_name: str,
    definition: str,
    payload: bytes,
    metadata: dict[str, str] | None = None,
) -> Path:
    """An MCAP file of one message."""
    kind = "ros2idl" if "module" in definition else f"{'ros1' if encoding == 'ros1' else 'ros2'}msg"
    schema = Schema(type_name, kind if definition else "", definition.encode())
    known = {f"offered_{key}_profiles": value for key, value in (metadata or {}).items()}
    channel = Channel(1, "/a", encoding, schema, known)
    with McapWriter(path, profile="ros1" if encoding == "ros1" else "ros2") as writer:
        writer.add_channel(channel)
        if payload:
            writer.write(Message(channel, 1, 1, 0, payload))
    return path


NEXT = "\n" + "=" * 80 + "\nMSG: "
MANY = struct.pack("<I", 2**32 - 1)
CDR = b"\0\1\0\0"
CONSTANT = "module a {{ module msg {{ const long X = {}; struct A {{ long x; }}; }}; }};"


def nested(levels: int, fields: str, last: str) -> str:
    """A type whose fields are of a type whose fields are of a type, and so on."""
    types = (f"{NEXT}a/B{n}\n" + fields.replace("{}", f"B{n + 1}") for n in range(levels))
    return f"B0 x\n{''.join(types)}{NEXT}a/B{levels}\n{last} x\n"


DEFINITIONS: dict[str, tuple[str, str, bytes]] = {
    "empty-messages": ("ros1", "std_msgs/Empty[] x\n", MANY),
    "empty-in-small-messages": (
        "ros1",
        f"B[] x{NEXT}a/B\nuint8 x\nstd_msgs/Empty[4000] y\n",
        struct.pack("<I", 10**5) + bytes(10**5),
    ),
    "empty-in-sequences": (
        "ros1",
        f"B[] x{NEXT}a/B\nstd_msgs/Empty[] y\n",
        struct.pack("<I", 10**4) + struct.pack("<I", 2**32 - 1) * 10**4,
    ),
    "small-messages": ("ros1", f"B[] x{NEXT}a/B\nuint8 x\n", MANY + bytes(100)),
    "large-messages": (
        "ros1",
        f"B[] x{NEXT}a/B\nC[400] x\n{NEXT}a/C\nuint8 x\nuint8 y\n",
        struct.pack("<I", 10**6) + bytes(10**6),
    ),
    "array": ("ros1", "uint8[4000000000] x\n", bytes(10)),
    "array-of-texts": ("ros1", "string[4000000000] x\n", bytes(10)),
    "array-of-messages": ("ros1", f"B[4000000000] x{NEXT}a/B\nuint8 x\n", bytes(10)),
    "doubling": ("ros1", nested(40, "{} x\n{} y\n", "uint8"), bytes(10)),
    "doubling-of-nothing": ("ros1", nested(40, "{} x\n{} y\n", "std_msgs/Empty"), bytes(10)),
    "doubling-of-sequences": ("ros1", nested(40, "{}[] x\n{}[] y\n", "time"), bytes(8)),
    "itself": ("ros1", "A[] x\n", bytes(10**6)),
    "deep": ("ros1", nested(500, "{} x\n", "uint8"), bytes(10)),
    "many-fields": ("ros1", "".join(f"uint8 x{n}\n" for n in range(5500)), bytes(10)),
    "cdr-messages": ("cdr", f"B[] x{NEXT}a/B\nuint8 x\n", CDR + MANY + bytes(100)),
    "cdr-array": ("cdr", "uint8[4000000000] x\n", CDR + bytes(10)),
    "idl-brackets": ("cdr", CONSTANT.format("((((((1))))))"), CDR + bytes(4)),
    "idl-many-brackets": ("cdr", CONSTANT.format("(1)+(1)" + "+(1)" * 50), CDR + bytes(4)),
    "idl-shift": ("cdr", CONSTANT.format("1 << 9000000000"), CDR + bytes(4)),
    "idl-product": ("cdr", CONSTANT.format("9" + "*9" * 50), CDR + bytes(4)),
}

REFUSALS = "contains itself|has more fields|has more than .* fields|takes too long|cannot be"


@pytest.mark.slow
def test_definitions_that_claim_much(tmp_path: Path) -> None:
    for name, (encoding, definition, payload) in DEFINITIONS.items():
        path = recording(tmp_path / f"{name}.mcap", encoding, "a/msg/A", definition, payload)
        outcome = jail.converted(path, "ros2" if encoding == "ros1" else "ros1")
        assert outcome.error == "ConversionError", (name, outcome.text)
        assert re.search(REFUSALS, outcome.text), (name, outcome.text)
        outcome = jail.decoded(path)
        assert outcome.error in ("OptionError", "SourceError"), (name, outcome.text)


# ---------------------------------------------------------------- compression


def zstd_bomb(size: int, *, told: bool) -> bytes:
    """A zstd frame of zeros: four bytes for each 128 KiB."""
    block = 2**17
    count = size // block
    head = b"\x28\xb5\x2f\xfd" + (b"\xc0\x38" + struct.pack("<Q", size) if told else b"\0\x38")
    zeros = struct.pack("<I", block << 3 | 2)  # the byte that is repeated, too
    return head + zeros * (count - 1) + struct.pack("<I", block << 3 | 3)


LARGE = 3 * 2**30


def lz4_bomb(size: int) -> bytes:
    piece = bytes(2**22)
    machine = lz4.frame.LZ4FrameCompressor(block_size=lz4.frame.BLOCKSIZE_MAX4MB)
    packed = [machine.begin(), *(machine.compress(piece) for _ in range(size // len(piece)))]
    return b"".join([*packed, machine.flush()])


CHUNKS: dict[str, tuple[Callable[[], bytes], str]] = {
    "zstd": (lambda: chunk(zstd_bomb(LARGE, told=True), "zstd", size=LARGE), "declares"),
    "zstd-untold": (lambda: chunk(zstd_bomb(LARGE, told=False), "zstd", size=LARGE), "declares"),
    "zstd-small": (lambda: chunk(zstd_bomb(LARGE, told=False), "zstd", size=1000), "damaged"),
    "lz4": (lambda: chunk(lz4_bomb(5 * 2**28), "lz4", size=1000), "does not unpack to 1000 bytes"),
}


@pytest.mark.parametrize("name", CHUNKS)
def test_chunks_that_unpack_to_much(name: str, tmp_path: Path) -> None:
    make, problem = CHUNKS[name]
    path = tmp_path / "a.mcap"
    path.write_bytes(file_of(make()))
    assert problem in jail.records(path).text
    assert jail.records(path, salvage=True).problems


def bag_of(path: Path, packed: bytes, size: int) -> None:
    chunks = [[(0, 1, b"x")]]
    make_bag(path, [plain()], chunks, compression="bz2", size=size, packed=packed)


@pytest.mark.slow
def test_a_bag_that_unpacks_to_much(tmp_path: Path) -> None:
    path = tmp_path / "a.bag"
    size = 150 * 2**20
    bag_of(path, bz2.compress(bytes(size)), size)
    assert "declares 157286400 bytes but has" in jail.records(path).text
    problems = jail.records(path, salvage=True).problems
    assert any("unpacks to more than 134217728 bytes" in problem for problem in problems)


def write_bag_info(folder: Path, name: str, mode: str) -> None:
    storage = "sqlite3" if "db3" in name else "mcap"
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  version: 5\n"
        f"  storage_identifier: {storage}\n  relative_file_paths: [{name}]\n"
        f"  compression_format: zstd\n  compression_mode: {mode}\n"
    )


@pytest.mark.parametrize("name", ["a.db3.zstd", "a.mcap.zstd"])
def test_a_file_that_unpacks_to_much(name: str, tmp_path: Path) -> None:
    suffix = name.partition(".")[2].removesuffix(".zstd")
    start = b"SQLite format 3\0"
    if suffix == "mcap":
        start = file_of()[:-50] + struct.pack("<BQ", 5, LARGE)
    packed = zstandard.compress(start) + zstd_bomb(LARGE, told=False)
    (tmp_path / name).write_bytes(packed)
    write_bag_info(tmp_path, name, "FILE")
    outcome = jail.records(tmp_path)
    problem = "it unpacks to more than 134217728 bytes, too many for its size"
    assert problem in outcome.text
    jail.records(tmp_path, salvage=True)


GIB = 2**30
MESSAGE = channel_record("/a") + struct.pack("<BQHIQQ", 5, 22 + GIB, 1, 0, 1, 1)


def lz4_message() -> bytes:
    machine = lz4.frame.LZ4FrameCompressor(block_size=lz4.frame.BLOCKSIZE_MAX4MB)
    zeros = (machine.compress(bytes(2**22)) for _ in range(GIB // 2**22))
    return b"".join([machine.begin(), machine.compress(MESSAGE), *zeros, machine.flush()])


def zstd_message(start: bytes = MESSAGE) -> bytes:
    """With blocks of 512 zeros, four bytes each."""
    count = GIB // 512
    head = b"\x28\xb5\x2f\xfd\0\x38" + struct.pack("<I", len(start) << 3)[:3] + start
    zeros = struct.pack("<I", 512 << 3 | 2)
    return head + zeros * (count - 1) + struct.pack("<I", 512 << 3 | 3)


@pytest.mark.parametrize(
    "compression",
    ["zstd", *(pytest.param(name, marks=pytest.mark.slow) for name in ("lz4", "bz2"))],
)
def test_a_chunk_is_bounded_whatever_its_ratio(compression: str, tmp_path: Path) -> None:
    """A GiB from less than 256 times as many bytes."""
    if compression == "bz2":
        path, size = tmp_path / "a.bag", GIB
        bag_of(path, bz2.compress(bytes(GIB // 2 + 2**20)) + bytes(GIB // 250), GIB)
    else:
        path, size = tmp_path / "a.mcap", len(MESSAGE) + GIB
        content = lz4_message() if compression == "lz4" else zstd_message()
        path.write_bytes(file_of(chunk(content, compression, crc=0, size=size)))
    refused = jail.records(path).text
    assert re.search(rf"declares {size} bytes but has \d+, over the limit of {GIB // 2}\.", refused)
    assert "set the environment variable MP4DS_MAX_DECOMPRESSED to a larger size" in refused
    problems = jail.records(path, salvage=True).problems
    assert any("the limit (MP4DS_MAX_DECOMPRESSED sets another)" in told for told in problems)


@pytest.mark.parametrize(
    "name",
    [
        "a.mcap",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("a.mcap.zstd", "a.db3.zstd")),
    ],
)
def test_a_message_is_bounded_whatever_its_ratio(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    if name == "a.mcap":
        sent = struct.pack("<HIQQ", 1, 0, 1, 1) + zstd_message(b"")
        path.write_bytes(file_of(channel_record("/a"), record(5, sent)))
    elif name == "a.mcap.zstd":
        start = zstandard.compress(file_of()[:-50])
        path.write_bytes(start + zstd_message() + zstandard.compress(file_of()[-50:]))
    else:
        whole = database(
            tmp_path / "a",
            TOPICS,
            MESSAGES,
            TOPIC,
            f"INSERT INTO messages VALUES(1, 1, 1, zeroblob({6 * 10**8}))",
            page_size=2**16,
        )
        packed = zstandard.compress(whole.read_bytes())
        path.write_bytes(packed + struct.pack("<II", 0x184D2A50, 2**20) + bytes(2**20))
        whole.unlink()
    mode = "MESSAGE" if name == "a.mcap" else "FILE"
    write_bag_info(tmp_path, name, mode)
    assert "over the limit of 536870912" in jail.records(tmp_path).text
    assert jail.records(tmp_path, salvage=True).problems


def test_the_limit_is_yours_to_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content = channel_record("/a") + record(5, struct.pack("<HIQQ", 1, 0, 1, 1) + bytes(2**28))
    path = tmp_path / "a.mcap"
    path.write_bytes(file_of(chunk(zstandard.compress(content), "zstd", crc=0, size=len(content))))

    def read() -> list[int]:
        with McapReader(path) as reader:
            return [len(item.data) for item in reader.records() if isinstance(item, Message)]

    with pytest.raises(mp4ds.SourceError, match="MP4DS_MAX_DECOMPRESSED"):
        read()  # as of a recording that claims more than it holds
    monkeypatch.setenv("MP4DS_MAX_DECOMPRESSED", "300M")
    assert read() == [2**28]
    monkeypatch.setenv("MP4DS_MAX_DECOMPRESSED", "200M")
    with pytest.raises(mp4ds.SourceError, match=f"over the limit of {200 * 2**20}"):
        read()
    monkeypatch.setenv("MP4DS_MAX_DECOMPRESSED", "much")
    with pytest.raises(mp4ds.OptionError, match="MP4DS_MAX_DECOMPRESSED: 'much' is not a size"):
        read()


def test_what_is_written_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also a large black picture, whose chunk would look like a bomb."""
    monkeypatch.setattr(files, "ALWAYS_ALLOWED", 2**20)
    channel = Channel(1, "/a", "cdr", None)
    payloads = [b"small", bytes(2**21), b"x" * 2**18, bytes(2**19 + 1), b"last"]
    path = tmp_path / "a.mcap"
    with McapWriter(path, profile="") as writer:
        writer.add_channel(channel)
        for number, payload in enumerate(payloads):
            writer.write(Message(channel, number, 0, 0, payload))
    with McapReader(path) as reader:
        found = [bytes(item.data) for item in reader.records() if isinstance(item, Message)]
    assert found == payloads
    assert path.stat().st_size < 2**22
    stream = io.BytesIO()
    other = Writer(stream, compression=CompressionType.ZSTD)
    other.start()
    other.add_message(other.register_channel("/a", "cdr", 0), 1, bytes(2**21), 1)
    other.finish()
    path.write_bytes(stream.getvalue())
    with pytest.raises(mp4ds.SourceError, match="declares"), McapReader(path) as reader:
        list(reader.records())


# ---------------------------------------------------------------- what is not what it seems


@pytest.mark.parametrize("name", ["metadata.yaml", "a_0.db3"])
def test_files_of_a_folder_that_are_no_files(name: str, tmp_path: Path) -> None:
    database(tmp_path / "a_0.db3", TOPICS, MESSAGES, TOPIC)
    write_bag_info(tmp_path, "a_0.db3", "")
    assert not (jail.records(tmp_path)).error
    for make in (os.mkfifo, lambda path: path.symlink_to("/dev/zero")):
        (tmp_path / name).unlink()
        make(tmp_path / name)
        assert f"{name}: is not a regular file" in jail.records(tmp_path).text
        jail.records(tmp_path, salvage=True)


# ---------------------------------------------------------------- servers


def test_a_web_server_that_never_ends(tmp_path: Path) -> None:
    with (tmp_path / "a.bag").open("wb") as stream:
        stream.truncate(2**24)
    with web_server(tmp_path) as web:
        web.endless = True
        with pytest.raises(RemoteError, match=r"got \d+ of \d+ bytes from byte"):
            mp4ds.pack(f"{web.url}/a.bag", tmp_path / "x")
        assert web.sent < 2**28
