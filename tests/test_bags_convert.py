"""ROS 1 <-> ROS 2: the same values on both sides, and back to the same channel."""

from __future__ import annotations

import dataclasses
import struct
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from rosbags.convert.converter import default_message
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.msg import normalize_msgtype

from conftest import real
from mp4ds.bags.convert import Converter
from mp4ds.bags.latched import LATCHED_QOS
from mp4ds.bags.ros1 import Ros1Reader
from mp4ds.errors import ConversionError
from mp4ds.records import Channel, Schema
from player_scenes import ros1_channel
from sources import image_cdr, image_ros1, scene, typestore

HEADER = "std_msgs/msg/Header"
NO_SEQ = "messages with a header sequence number, which ROS 2 does not have"
PLAIN: dict[str, Any] = {"width": 3, "height": 2, "encoding": "mono8", "data": b"abcdef"}
TAILS = "messages with trailing bytes, which were dropped"
REAL_BAGS = (
    "bag_reader_java/Int64MultiArray",
    "ecto_ros_camera_info",
    "embag_array",
    "example_turtle_none",
    "fiducials_aruco_marker_raspicam",
    "joint_states_bz2",
    "librealsense_depth_color",
    "only_a_cube_melodic",
    "ouster_512x10_raw_packets",
    "roboto_tiny_dvs",
    "ros_numpy_test",
    "rosout_bz2",
    "spot_cv_raw",
    "youliangtan_object_pose",
)


def store_of(channel: Channel) -> Any:
    """A store of a channel's own definition, with the header of its world."""
    assert channel.schema
    world = Stores.ROS1_NOETIC if channel.message_encoding == "ros1" else Stores.ROS2_HUMBLE
    text = channel.schema.data.decode().replace("roslib/Header", "std_msgs/Header")
    types = get_types_from_msg(text, normalize_msgtype(channel.schema.name))
    store = get_typestore(Stores.EMPTY)
    store.register({**types, HEADER: get_typestore(world).fielddefs[HEADER]})
    return store


def read(channel: Channel, store: Any, data: bytes | memoryview) -> Any:
    decode = store.deserialize_ros1 if channel.message_encoding == "ros1" else store.deserialize_cdr
    return values(decode(data, normalize_msgtype(channel.type_name)))


def values(item: Any) -> Any:
    """The values of a message in order, without names and without header.seq."""
    if dataclasses.is_dataclass(item):
        skip = {"__msgtype__", "structure_needs_at_least_one_member"}
        skip |= {"seq"} if item.__msgtype__ == HEADER else set()
        names = [field.name for field in dataclasses.fields(item) if field.name not in skip]
        return [values(getattr(item, name)) for name in names]
    if isinstance(item, np.ndarray):
        return item.tobytes()
    if isinstance(item, list):
        return [values(part) for part in item]
    return struct.pack("<d", item) if isinstance(item, float) else item


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", REAL_BAGS)
def test_real_bags_to_ros2_and_back(name: str) -> None:
    to_ros2, to_ros1 = Converter("ros2"), Converter("ros1")
    known: dict[int, tuple[Channel, Any, Any]] = {}
    with Ros1Reader(real(f"bags/{name}.bag")) as reader:
        for channel in reader.channels:
            made = to_ros2.channel(channel)
            known[channel.id] = made, store_of(channel), store_of(made)
            assert to_ros1.channel(made) == channel
            unremembered = to_ros1.channel(replace(made, metadata={}))
            assert unremembered.metadata == {"md5sum": channel.metadata["md5sum"]}
        for record in reader.records():
            channel = record.channel
            made, store1, store2 = known[channel.id]
            there = to_ros2.payload(channel, record.data)
            back = to_ros1.payload(made, there)
            before = read(channel, store1, record.data)
            assert read(made, store2, there) == before
            assert read(channel, store1, back) == before
            assert len(back) == len(record.data)


def test_a_scene_becomes_what_ros2_writes() -> None:
    """Payloads are those that rosbags writes for ROS 2, byte for byte."""
    converter = Converter("ros2")
    checked = set()
    for n, message in enumerate(scene("rgb8").messages):
        package, _, name = message.msgtype.split("/")
        channel = ros1_channel(n, message.topic, f"{package}/{name}", "/node")
        made = converter.channel(channel)
        assert made.type_name == message.msgtype
        assert made.topic == message.topic
        assert made.metadata["topic_type_hash"] == typestore("cdr").hash_rihs01(message.msgtype)
        assert converter.payload(channel, message.payload("ros1")) == message.payload("cdr")
        checked.add(message.msgtype)
    assert len(checked) > 4
    assert converter.omitted[NO_SEQ] > 10


def test_the_ros1_identity_is_kept() -> None:
    metadata = {"callerid": "/n", "latching": "1", "md5sum": "0" * 32, "vendor": "x", "topic": "t"}
    for data in (b"string data # what\n", b"string data # \xff\n"):
        channel = Channel(
            3, "chatter", "ros1", Schema("std_msgs/String", "ros1msg", data), metadata
        )
        made = Converter("ros2").channel(channel)
        assert (made.id, made.topic, made.message_encoding) == (3, "chatter", "cdr")
        assert made.schema == Schema("std_msgs/msg/String", "ros2msg", b"string data\n")
        assert made.metadata["ros1:callerid"] == "/n"
        assert made.metadata["ros1:type"] == "std_msgs/String"
        assert made.metadata["offered_qos_profiles"] == LATCHED_QOS
        assert Converter("ros1").channel(made) == channel
    bare = Channel(3, "/a", "ros1", Schema("std_msgs/String", "", b""), {"latching": "0"})
    made = Converter("ros2").channel(bare)
    assert made.metadata["offered_qos_profiles"] == ""
    assert Converter("ros1").channel(made) == bare


def test_an_identity_that_does_not_fit_is_not_believed() -> None:
    identity = {"ros1:type": "std_msgs/Int8", "ros1:message_definition": "int8 data", "ros1:a": "b"}
    for more in ({}, {"ros1:message_definition;base64": "%"}, {"ros1:type": "1/2/3"}):
        schema = Schema("std_msgs/msg/String", "ros2msg", b"string data")
        made = Converter("ros1").channel(Channel(0, "/a", "cdr", schema, {**identity, **more}))
        assert made.type_name == "std_msgs/String"
        assert made.metadata == {"md5sum": "992ce8a1687cec8c8bd883ec73ca41d1"}


@pytest.mark.parametrize(
    ("qos", "latching"),
    [
        (LATCHED_QOS, "1"),
        ("- durability: transient_local\n- {durability: 'transient_local'}", "1"),
        ("- durability: 1\n- durability: 2", None),
        ("- durability: volatile", None),
        ("", None),
        ("- history: 1", None),
    ],
)
def test_latching_is_transient_local(qos: str, latching: str | None) -> None:
    schema = Schema("std_msgs/msg/String", "ros2msg", b"string data")
    converter = Converter("ros1")
    made = converter.channel(Channel(0, "/a", "cdr", schema, {"offered_qos_profiles": qos}))
    assert made.metadata.get("latching") == latching
    assert bool(converter.omitted) == bool(qos and not latching)
    for word in ("1", "true", "True") if latching else ():
        ros1 = replace(
            ros1_channel(0, "/a", "std_msgs/String", "/node"), metadata={"latching": word}
        )
        assert Converter("ros2").channel(ros1).metadata["offered_qos_profiles"] == LATCHED_QOS


def test_definitions_as_they_are_found() -> None:
    """Line ends, rulers, bounds, defaults, old headers, and types defined elsewhere."""
    old_header = (
        b"Header h\r\n=====================\r\nMSG: roslib/Header\r\n"
        b"uint32 seq\r\ntime stamp\r\nstring frame_id\r\n"
    )
    idl = (
        b"%b\nIDL: my/msg/A\n"
        b'#include "my/msg/B.idl"\nmodule my { module msg { struct A { my::msg::B b; '
        b"sequence<double, 4> d; uint8 o; string<7> s; }; }; };\n"
        b"%b\nIDL: my/msg/B\nmodule my { module msg { struct B { long x; }; }; };\n"
    ) % (b"=" * 80, b"=" * 80)
    bounds = b"string<=5 name 'x'\nint32[<=3] a\nint8 b 4\nint8 C=3"
    times = b"std_msgs/Header header\nbuiltin_interfaces/Time t"
    cases = (
        (Schema("my/A", "ros1msg", old_header), "ros2"),
        (Schema("my/A", "ros1msg", b"roslib/Header h\nduration d\nchar c\nbyte b"), "ros2"),
        (Schema("my/A", "ros1msg", b"sensor_msgs/Image image"), "ros2"),
        (Schema("std_msgs/Empty", "ros1msg", b""), "ros2"),
        (Schema("my/Empty", "ros1msg", b"# nothing\n"), "ros2"),
        (Schema("sensor_msgs/Image", "ros1msg", b"\n"), "ros2"),
        (Schema("my/msg/A", "ros2msg", bounds), "ros1"),
        (Schema("my/msg/A", "ros2msg", times), "ros1"),
        (Schema("my/msg/A", "ros2idl", idl), "ros1"),
    )
    for schema, target in cases:
        encoding = "ros1" if target == "ros2" else "cdr"
        made = Converter(target).channel(Channel(0, "/a", encoding, schema, {}))
        assert made.schema
        assert b"<=" not in made.schema.data
        assert b"roslib" not in made.schema.data
        store_of(made).get_msgdef(normalize_msgtype(made.type_name))
        back = Converter("ros1" if target == "ros2" else "ros2").channel(made)
        assert back.schema
        assert normalize_msgtype(back.type_name) == normalize_msgtype(schema.name)


@pytest.mark.parametrize(
    "options",
    [{"little_endian": False}, {"padding": b"\x61"}, {"options": b"\0\3"}, {"tail": b"\0\0"}],
    ids=lambda options: next(iter(options)),
)
def test_forms_of_cdr(options: dict[str, Any]) -> None:
    channel = Channel(0, "/a", "cdr", Schema("sensor_msgs/msg/Image", "", b""), {})
    converter = Converter("ros1")
    assert converter.payload(channel, image_cdr(**PLAIN, **options)) == image_ros1(**PLAIN)
    assert not converter.omitted  # padding up to a multiple of four is no content


def test_bytes_after_a_message_are_counted() -> None:
    ros1 = ros1_channel(0, "/a", "sensor_msgs/Image", "/node")
    to_ros2, to_ros1 = Converter("ros2"), Converter("ros1")
    assert to_ros2.payload(ros1, image_ros1(**PLAIN, tail=b"four")) == image_cdr(**PLAIN)
    assert to_ros2.omitted == {TAILS: 1, NO_SEQ: 1}
    made = to_ros2.channel(ros1)
    assert to_ros1.payload(made, image_cdr(**PLAIN, tail=b"four")) == image_ros1(**PLAIN)
    assert to_ros1.omitted == {TAILS: 1}
    with pytest.raises(ConversionError):
        to_ros2.payload(ros1, image_ros1(**PLAIN, tail=b"more than eight"))


@pytest.mark.parametrize(
    ("encoding", "schema", "target", "problem"),
    [
        ("protobuf", Schema("foxglove.RawImage", "protobuf", b""), "ros1", "messages are protobuf"),
        ("ros1", None, "ros2", "its message type is not known"),
        ("ros1", Schema("my/Type", "", b""), "ros2", "no definition of type my/Type is known"),
        ("ros1", Schema("my/Type", "ros1msg", b"Other x"), "ros2", "type my/msg/Other is known"),
        ("ros1", Schema("my/Type", "ros1msg", b"int8 x\n?!"), "ros2", "cannot be parsed"),
        ("ros1", Schema("my/Type", "ros1msg", b"Type x"), "ros2", "contains itself"),
        ("cdr", Schema("my/msg/Type", "ros2idl", b"module {"), "ros1", "cannot be parsed"),
        ("cdr", Schema("x", "ros2msg", b"bool data\n"), "ros1", "cannot be parsed"),
    ],
)  # fmt: skip
def test_what_cannot_be_converted(
    encoding: str, schema: Schema | None, target: str, problem: str
) -> None:
    with pytest.raises(ConversionError) as caught:
        Converter(target).channel(Channel(0, "/a", encoding, schema, {}))
    assert str(caught.value).startswith("topic /a: ")
    assert problem in str(caught.value)
    assert "Exclude the topic with `exclude`, or unpack to mcap" in str(caught.value)


@pytest.mark.parametrize("target", ["ros1", "ros2"])
def test_payloads_that_do_not_parse(target: str) -> None:
    ros1 = ros1_channel(0, "/a", "sensor_msgs/Image", "/node")
    if target == "ros2":
        channel, data = ros1, image_ros1(**PLAIN)
    else:
        channel, data = Converter("ros2").channel(ros1), image_cdr(**PLAIN)
    converter = Converter(target)
    huge = data.replace(b"\6\0\0\0abcdef", b"\xff\xff\xff\xffabcdef")
    for damaged in [huge, b"\xff" * 80, *(data[:length] for length in range(len(data)))]:
        with pytest.raises(ConversionError, match="a message cannot be parsed as sensor_msgs/"):
            converter.payload(channel, damaged)
    assert not converter.omitted


@pytest.mark.slow
def test_every_standard_type_converts() -> None:
    """All of Noetic's types, with default values, against rosbags' own serialisation."""
    store = get_typestore(Stores.ROS1_NOETIC)
    converter = Converter("ros2")
    for number, name in enumerate(store.types):
        package, _, short = name.split("/")
        if package == "builtin_interfaces" or name == HEADER:
            continue
        message = store.serialize_ros1(default_message(store, name), name)
        channel = ros1_channel(number, "/a", f"{package}/{short}", "/node")
        made = converter.channel(channel)
        there = converter.payload(channel, message)
        assert read(made, store_of(made), there) == read(channel, store, message)


# ---------------------------------------------------------------- times


def stamped(kind: str, seconds: int, encoding: str) -> tuple[Channel, bytes]:
    """A message with a time, in its header, in an array of messages, or by itself."""
    store = typestore("ros1" if encoding == "ros1" else "ros2")
    names = {"header": "sensor_msgs/msg/Imu", "nested": "nav_msgs/msg/Path"}
    name = names.get(kind, "rosgraph_msgs/msg/Clock")
    message = default_message(store, name)
    seconds -= 2**32 if seconds >= 2**31 else 0  # the same bits
    time = store.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=5)
    if kind == "alone":
        message.clock = time
    elif kind == "header":
        message.header.stamp = time
    else:
        poses = [default_message(store, "geometry_msgs/msg/PoseStamped") for _ in range(2)]
        message.poses = poses
        poses[1].header.stamp = time
        poses[0].pose.position.x = -1.0
    made = (
        store.serialize_ros1(message, name)
        if encoding == "ros1"
        else store.serialize_cdr(message, name)
    )
    schema = Schema(name.replace("/msg/", "/") if encoding == "ros1" else name, "", b"")
    return Channel(0, "/a", encoding, schema, {}), bytes(made)


@pytest.mark.parametrize("kind", ["header", "nested", "alone"])
@pytest.mark.parametrize(
    ("encoding", "target", "good", "bad"),
    [("cdr", "ros1", 2**31 - 1, -1), ("ros1", "ros2", 2**31 - 1, 2**31)],
)
def test_times_that_the_target_cannot_hold(
    kind: str, encoding: str, target: str, good: int, bad: int
) -> None:
    converter = Converter(target)
    converter.payload(*stamped(kind, good, encoding))
    with pytest.raises(ConversionError, match=f"topic /a: a message has a time of {bad} s, and"):
        converter.payload(*stamped(kind, bad, encoding))
