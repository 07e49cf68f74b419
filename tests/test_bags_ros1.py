"""ROS 1 bags: what rosbags reads, we read, and what it normalises stays as recorded."""

from __future__ import annotations

import bz2
import os
import struct
import tracemalloc
from collections.abc import Iterable, Sequence
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
from rosbags.rosbag1 import Reader

from conftest import real
from damage import bag_fields, bag_records
from mp4ds.bags.formats import open_sources
from mp4ds.bags.ros1 import Ros1Reader
from mp4ds.bags.ros1_writer import Ros1Writer
from mp4ds.errors import (
    SourceError,
)
from mp4ds.records import Attachment, Channel, ChannelStats, Message, MetadataRecord, Schema
from sources import START

COMPRESSIONS = ("none", "bz2", "lz4")
REAL_BAGS = (
    "bags/bag_reader_java/Bool.bag",
    "bags/bag_reader_java/UInt8MultiArray.bag",
    "bags/ecto_ros_camera_info.bag",
    "bags/embag_array.bag",
    "bags/embag_test2_multiconn.bag",
    "bags/example_turtle_bz2.bag",
    "bags/example_turtle_lz4.bag",
    "bags/example_turtle_none.bag",
    "bags/example_unsorted_chunks.bag",
    "bags/fiducials_aruco_marker_raspicam.bag",
    "bags/joint_states_bz2.bag",
    "bags/librealsense_depth_color.bag",
    "bags/no_messages.bag",
    "bags/only_a_cube_melodic.bag",
    "bags/ouster_512x10_raw_packets.bag",
    "bags/roboto_tiny_dvs.bag",
    "bags/ros_comm_storage_test.bag",
    "bags/ros_numpy_test.bag",
    "bags/rosout_bz2.bag",
    "bags/spot_compressedDepth.bag",
    "bags/spot_cv_raw.bag",
    "bags/youliangtan_object_pose.bag",
    "corrupt/sample_ok.bag",
)
PLAIN = {"topic": b"/a", "type": b"std_msgs/String", "md5sum": b"992c", "message_definition": b""}

Header = Iterable[tuple[bytes, bytes]]


# ---------------------------------------------------------------- bags, byte by byte


def joined(fields: Header) -> bytes:
    pieces = [name + b"=" + value for name, value in fields]
    body = b"".join(struct.pack("<I", len(piece)) + piece for piece in pieces)
    return struct.pack("<I", len(body)) + body


def record(fields: Header, data: bytes) -> bytes:
    return joined(fields) + struct.pack("<I", len(data)) + data


def number(value: int, form: str = "<I") -> bytes:
    return struct.pack(form, value)


def stamp(time: int) -> bytes:
    return struct.pack("<II", *divmod(time, 10**9))


def connection(conn: int, topic: bytes, header: Header) -> bytes:
    return joined([(b"op", b"\7"), (b"topic", topic), (b"conn", number(conn))]) + joined(header)


def bag_header(index_pos: int, connections: int, chunks: int, *more: tuple[bytes, bytes]) -> bytes:
    counts = [(b"conn_count", number(connections)), (b"chunk_count", number(chunks))]
    head = joined([(b"op", b"\3"), (b"index_pos", number(index_pos, "<Q")), *counts, *more])
    padding = b" " * (4096 - len(head) - 4)
    return b"#ROSBAG V2.0\n" + head + number(len(padding)) + padding


def chunk_record(
    compression: str, content: bytes, size: int | None = None, packed: bytes | None = None
) -> bytes:
    pack = {"bz2": bz2.compress, "lz4": lz4.frame.compress}.get(compression, bytes)
    size = len(content) if size is None else size
    fields = [(b"op", b"\5"), (b"compression", compression.encode()), (b"size", number(size))]
    return record(fields, packed or pack(content))


def make_bag(
    path: Path,
    connections: Sequence[tuple[bytes, Header]],
    chunks: Sequence[Sequence[tuple[int, int, bytes]]] = (),
    *,
    compression: str = "none",
    shift: int = 0,
    counted: int = 0,
    size: int | None = None,
    packed: bytes | None = None,
) -> Path:
    """A bag of connections (topic, header) and chunks of messages (connection, time, payload).

    Damage: index offsets are shifted, counts in the chunk summaries are raised by `counted`,
    `size` is what chunks say that they unpack to, and `packed` stands in them instead.
    """
    body, infos = bytearray(), b""
    for chunk in chunks:
        position, content, entries = 4096 + 13 + len(body), b"", {}
        for conn, time, data in chunk:
            entries.setdefault(conn, []).append(stamp(time) + number(len(content) + shift))
            fields = [(b"op", b"\2"), (b"conn", number(conn)), (b"time", stamp(time))]
            content += record(fields, data)
        body += chunk_record(compression, content, size, packed)
        for conn, found in entries.items():
            counts = [(b"conn", number(conn)), (b"count", number(len(found)))]
            body += record([(b"op", b"\4"), (b"ver", number(1)), *counts], b"".join(found))
        times = [time for _, time, _ in chunk]
        span = [(b"start_time", stamp(min(times))), (b"end_time", stamp(max(times)))]
        place = [(b"ver", number(1)), (b"chunk_pos", number(position, "<Q"))]
        counts = [(b"count", number(len(entries)))]
        data = b"".join(number(c) + number(len(f) + counted) for c, f in entries.items())
        infos += record([(b"op", b"\6"), *place, *span, *counts], data)
    index = b"".join(connection(n, topic, header) for n, (topic, header) in enumerate(connections))
    head = bag_header(4096 + 13 + len(body), len(connections), len(chunks))
    path.write_bytes(head + body + index + infos)
    return path


def plain(topic: str = "/a", /, **more: bytes) -> tuple[bytes, Header]:
    fields = {**PLAIN, "topic": topic.encode(), **more}
    return topic.encode(), [(name.encode(), value) for name, value in fields.items()]


def connections_in(path: Path) -> list[bytes]:
    """Topic and header of all connections in a bag's index, sorted fields joined again."""
    data = path.read_bytes()
    (index,) = struct.unpack_from("<Q", data, data.index(b"index_pos=") + 10)
    return [
        fields[b"topic"] + b"\0" + joined(sorted(bag_fields(data[body:end]).items()))
        for _, body, end, fields in bag_records(data, index)
        if fields[b"op"] == b"\7"
    ]


# ---------------------------------------------------------------- reading and writing


Row = tuple[int, int, bytes]


def rows(reader: Ros1Reader) -> list[Row]:
    return [(m.channel.id, m.log_time, bytes(m.data)) for m in reader.records()]


def by_library(path: Path) -> list[Row]:
    with Reader(path) as reader:
        return [(c.id, time, bytes(data)) for c, time, data in reader.messages()]


def copy(source: Path, target: Path) -> None:
    with Ros1Reader(source) as reader, Ros1Writer(target) as writer:
        for channel in reader.channels:
            writer.add_channel(channel)
        for message in reader.records():
            writer.write(message)
    assert not writer.omitted


def identities(reader: Ros1Reader) -> list[tuple[object, ...]]:
    return [channel.identity for channel in reader.channels]


def refuse(path: Path, problem: str) -> None:
    def read_everything() -> None:
        with Ros1Reader(path) as reader:
            for _ in reader.records():
                pass

    with pytest.raises(SourceError) as caught:
        read_everything()
    assert str(caught.value).startswith(f"{path}: ")
    assert problem in str(caught.value)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", REAL_BAGS)
def test_real_bags(name: str) -> None:
    path = real(name)
    with Ros1Reader(path) as reader:
        found = rows(reader)
        assert found == by_library(path)
        assert reader.position == path.stat().st_size
        assert sum(item.count for item in reader.stats().values()) == len(found)


def test_messages_come_in_log_time_order_then_file_order(tmp_path: Path) -> None:
    chunks = [
        [(1, 5, b"b5"), (0, 5, b"a5"), (0, 9, b"a9"), (0, 5, b"a5 again")],
        [(0, 1, b"a1"), (1, 5, b"b5 later"), (1, 9, b"b9")],
    ]
    path = make_bag(tmp_path / "a.bag", [plain("/a"), plain("/b")], chunks, compression="lz4")
    with Ros1Reader(path) as reader:
        assert [data for _, _, data in rows(reader)] == [
            b"a1", b"b5", b"a5", b"a5 again", b"b5 later", b"a9", b"b9",
        ]  # fmt: skip
        assert reader.times()[0].tolist() == [1, 5, 5, 9]
        assert reader.times()[1].dtype == np.int64
        assert reader.stats() == {0: ChannelStats(4, 1, 9), 1: ChannelStats(3, 5, 9)}
        first = reader.first(reader.channels[1])
        assert first
        assert (bytes(first.data), first.publish_time, first.sequence) == (b"b5", 5, 0)


def test_connection_headers_stay_as_recorded(tmp_path: Path) -> None:
    headers = [
        plain("/odd", latching=b"true", callerid=b"/n", vendor=b"x=y", empty=b""),
        plain("//a/./b/", type=b"std_msgs/msg/String", latching=b"", topic=b"/inner"),
        (b"/none", [(b"type", b"pkg/Type"), (b"md5sum", b"*")]),
        (b"/nothing", [(b"callerid", b"/n")]),
        plain(
            "/raw", message_definition=b"# \xff\xfe\nstring data", callerid=b"/\xe9", type=b"\xff"
        ),
        (b"/raw\xff", [(b"topic", b"/raw\xff"), *plain()[1][1:]]),
        plain("/odd", latching=b"true", callerid=b"/n", vendor=b"x=y", empty=b""),
        plain("/name", **{"looks;base64": b"like it, is not"}),
    ]
    chunks = [[(n, n, b"%d" % n) for n in range(len(headers))]]
    path = make_bag(tmp_path / "a.bag", headers, chunks)
    with Ros1Reader(path) as reader:
        odd, verbatim, none, nothing, raw, *_ = reader.channels
        assert odd.metadata == {
            "md5sum": "992c", "latching": "true", "callerid": "/n", "vendor": "x=y", "empty": "",
        }  # fmt: skip
        assert verbatim.topic == "//a/./b/"
        assert verbatim.type_name == "std_msgs/msg/String"
        assert verbatim.metadata["topic"] == "/inner"
        assert none.schema == Schema("pkg/Type", "", b"")
        assert nothing.schema is None
        assert raw.schema
        assert raw.schema.data == b"# \xff\xfe\nstring data"
        assert raw.metadata["callerid;base64"] == "L+k="
        own = identities(reader)
    for channel in reader.channels:
        str(channel.identity).encode()  # everything can be written as UTF-8
    copied = tmp_path / "copy.bag"
    copy(path, copied)
    assert connections_in(copied) == connections_in(path)
    with Ros1Reader(copied) as reader:
        assert identities(reader) == own
        assert [data for _, _, data in rows(reader)] == [b"%d" % n for n in range(len(headers))]


# ---------------------------------------------------------------- what cannot be read


def test_not_a_bag(tmp_path: Path) -> None:
    refuse(tmp_path, "cannot be read: Is a directory")
    path = tmp_path / "a.bag"
    index = 4096 + 13
    for data, problem in (
        (b"#ROSBAG V2.0\r\n", "is a ROS 1 bag with converted line endings"),
        (
            b"#ROSBAG V1.2\n",
            "version 1.2; only version 2.0 is supported. Convert it first, with `rosbag filter",
        ),
        (b"#ROSRECORD V1.1\n", "version 1.1"),
        (b"#ROSBAG V2.0\n", "is damaged"),
        (b"#ROSBAG V2.0\n\x10\0\0\0", "is damaged"),
        (b"#ROSBAG V2.0\n" + joined([(b"op", b"\3")]), "is damaged"),
        (bag_header(0, 1, 1), "is not indexed: the recording was cut short. Run"),
        (bag_header(9999, 1, 1), "is cut short: its index should begin at byte 9999"),
        (bag_header(index, 1, 1), "is damaged"),
        (bag_header(index, 0, 0, (b"encryptor", b"rosbag/AesCbcEncryptor")), "is encrypted"),
    ):
        path.write_bytes(data)
        refuse(path, problem)


def test_messages_that_the_index_does_not_list_are_not_lost(tmp_path: Path) -> None:
    path = tmp_path / "a.bag"
    two = make_bag(path, [plain()], [[(0, 1, b"one"), (0, 2, b"two")]]).read_bytes()
    for index in (len(two), 50):
        path.write_bytes(bag_header(index, 0, 0) + two[4109:])
        refuse(path, "its index does not list what it holds at byte 4109")
    # the second message is in no index, and all of the index agrees on that
    entry = two.index(stamp(2), two.index(b"\4\0\0\0op=\4"))
    short = two[:entry] + two[entry + 12 :]
    short = short.replace(number(24) + stamp(1), number(12) + stamp(1))
    short = short.replace(b"count=\2", b"count=\1").replace(
        number(0) + number(2), number(0) + number(1)
    )
    (index,) = struct.unpack_from("<Q", two, two.index(b"index_pos=") + 10)
    path.write_bytes(bag_header(index - 12, 1, 1) + short[4109:])
    refuse(path, "its index lists 1 messages of 2")
    end_of_chunk = next(bag_records(two, 4109))[2]
    none = two[:end_of_chunk] + connection(0, *plain())
    none += two[two.index(b"\4\0\0\0op=\6") - 4 :].replace(b"count=\1", b"count=\0")
    path.write_bytes(bag_header(end_of_chunk, 1, 1) + none[4109:])
    refuse(path, "its index lists 0 messages of 2")
    twice = two[:entry] + two[entry - 12 : entry] + two[entry + 12 :]
    path.write_bytes(bag_header(index, 1, 1) + twice[4109:])
    refuse(path, "its index lists a message twice")
    with open_sources([path], salvage=True) as reader:
        assert len(list(reader.records())) == 2
    end = two[two.index(b"\4\0\0\0op=\6") - 4 :]
    path.write_bytes(bag_header(index, 1, 2) + two[4109:] + end)
    refuse(path, "its index lists a chunk twice")


def test_damage_has_a_sentence(tmp_path: Path) -> None:
    path = tmp_path / "a.bag"
    one = [[(0, 1, b"one")]]
    for options, problem in (
        ({"shift": 1}, "topic /a, chunk at byte 4109: "),
        ({"shift": 500}, "topic /a, chunk at byte 4109: a record is cut short. Copy it again"),
        ({"counted": 1}, "the index of the chunk at byte 4109 contradicts the bag's index"),
        ({"compression": "lzma"}, "it is compressed with 'lzma', which is not supported"),
        ({"size": 3}, "it holds 49 bytes instead of 3"),
        ({"size": 3, "compression": "bz2"}, "its bz2 data does not unpack to 3 bytes"),
        ({"size": 2**31, "compression": "bz2"}, "it declares 2147483648 bytes but has"),
    ):
        refuse(make_bag(path, [plain()], one, **options), problem)
    refuse(make_bag(path, [], one), "contradicts the bag's index")
    two = make_bag(path, [plain()], [[(0, 1, b"one")], [(0, 2, b"two")]]).read_bytes()
    path.write_bytes(two.replace(b"chunk_count=\2", b"chunk_count=\1"))
    refuse(path, "its header declares fewer chunks than its index lists")
    good = make_bag(path, [plain("/a"), plain("/b")], [[(0, 1, b"one"), (1, 2, b"two")]])
    data = good.read_bytes()
    path.write_bytes(data.replace(b"chunk_count=\1", b"chunk_count=\0"))
    refuse(path, "")
    path.write_bytes(data.replace(b"conn=\0\0\0\0", b"conn=\1\0\0\0", 1))
    refuse(path, "the index points to another message")
    path.write_bytes(data.replace(b"time=\0\0\0\0\1", b"time=\0\0\0\0\3", 1))
    refuse(path, "the index points to another message")


@pytest.mark.one_in(3)
@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_a_bag_cut_short_or_changed_anywhere(tmp_path: Path, compression: str) -> None:
    chunks = [[(0, 5 * n + c, os.urandom(20)) for n in range(5)] for c in range(2)]
    path = make_bag(tmp_path / "a.bag", [plain()], chunks, compression=compression)
    data = path.read_bytes()
    for length in [*range(100), *range(4090, len(data))]:
        path.write_bytes(data[:length])
        refuse(path, "")
    for place in [*range(110), *range(4109, len(data))]:
        path.write_bytes(data[:place] + bytes([data[place] ^ 0x55]) + data[place + 1 :])
        problem = damage_of(path)
        assert "codec" not in problem
        assert "b'" not in problem


def damage_of(path: Path) -> str:
    try:
        with Ros1Reader(path) as reader:
            assert len(rows(reader)) == 10
    except SourceError as error:
        return str(error)
    return ""


# ---------------------------------------------------------------- what a bag cannot hold

STRING = Channel(7, "/a", "ros1", Schema("std_msgs/String", "ros1msg", b"string data"), {})


def test_what_a_bag_cannot_hold_is_counted(tmp_path: Path) -> None:
    with Ros1Writer(tmp_path / "a.bag") as writer:
        writer.add_channel(STRING)
        writer.add_channel(STRING)
        writer.write(Message(STRING, START, START, 0, b"a"))
        writer.write(Message(STRING, START, START - 1, 0, b"b"))
        writer.write(Message(STRING, START, START, 4, memoryview(b"c")))
        writer.add_attachment(Attachment("a", "text/plain", 0, 0, b""))
        writer.add_metadata(MetadataRecord("a", {}))
        writer.add_schema(Schema("a", "", b""))
    assert writer.omitted == {
        "publish times that differ from the log time": 1,
        "sequence numbers of messages": 1,
        "attachments": 1,
        "metadata records": 1,
        "definitions that no topic uses": 1,
    }
    with Ros1Reader(tmp_path / "a.bag") as reader:
        assert len(reader.channels) == 1
        assert rows(reader) == [(0, START, b"a"), (0, START, b"b"), (0, START, b"c")]


@pytest.mark.slow
def test_memory_for_the_index_is_bounded(tmp_path: Path) -> None:
    """60,000 times and places are 10 MB of objects; of full chunks, counts alone are kept."""
    count, data = 60_000, bytes(1000)
    with Ros1Writer(tmp_path / "a.bag") as writer:
        writer.add_channel(STRING)
        tracemalloc.start()
        try:
            for n in range(count):
                writer.write(Message(STRING, n, n, 0, data))
            kept, _ = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
    assert kept < 4e6
    with Ros1Reader(tmp_path / "a.bag") as reader:
        assert reader.stats() == {0: ChannelStats(count, 0, count - 1)}
