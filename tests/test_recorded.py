"""Messages of a dataset that are no frames: which there are, their order, and their fields."""

from __future__ import annotations

import dataclasses
import struct
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet

import mp4ds
from foxglove_scenes import FOXGLOVE_SOURCES, foxglove_scene
from foxglove_wire import SERIALIZATIONS
from mp4ds.bags.convert import decoder_of
from mp4ds.errors import Refused
from mp4ds.records import Channel, Schema
from round_trips import packed
from scenes import image_ros1, raw_scene
from sources import SOURCES, START, Scene, odd_scene, scene, write_bag

TOPIC = "/cam/image_raw"
INFO_TOPIC = "/cam/camera_info"
RULER = b"=" * 80


def check_fields(message: Any, values: Mapping[str, Any]) -> None:
    """An object has the values that were sent; names are lower case there, times nanoseconds."""
    found = message if isinstance(message, dict) else None
    if descriptor := getattr(message, "DESCRIPTOR", None):
        names = [field.name for field in descriptor.fields]
    else:
        names = [name for name in found or dir(message) if not name.startswith("_")]
    lower = {name.lower(): name for name in names}
    for name, value in values.items():
        if name == "seq" and "seq" not in lower:
            continue  # headers of ROS 2 have none
        own = found[name] if found else getattr(message, lower[name])
        check_value(own, value)


def check_value(own: Any, value: Any) -> None:
    if isinstance(value, Mapping):
        check_fields(own, value)
    elif hasattr(own, "sec"):
        assert own.sec * 10**9 + own.nanosec == value
    elif hasattr(own, "ToNanoseconds"):
        assert own.ToNanoseconds() == value
    elif isinstance(value, (Sequence, np.ndarray)) and not isinstance(value, str):
        assert len(own) == len(value)
        for one, other in zip(own, value, strict=True):
            check_value(one, other)
    else:
        assert own == pytest.approx(value) if isinstance(value, float) else own == value


# ---------------------------------------------------------------- all sources


@pytest.mark.one_in(4)
@pytest.mark.parametrize("variant", SOURCES)
def test_messages_of_every_source(variant: str, tmp_path: Path) -> None:
    source = scene("mono8", frames=6)
    dataset = packed(tmp_path, source, variant)
    sent = [record for record in source.messages if record.topic != TOPIC]
    with mp4ds.open(dataset) as opened:
        found = list(opened.messages())
        times = [message.log_time_ns for message in found]
        if variant != "mcap-unindexed":  # as the file has them
            assert times == sorted(times)
        assert sorted((message.topic, message.log_time_ns) for message in found) == sorted(
            (record.topic, record.log_time) for record in sent
        )
        for topic in {record.topic for record in sent}:
            own = sorted(
                (message for message in found if message.topic == topic),
                key=lambda message: message.log_time_ns,
            )
            due = sorted((r for r in sent if r.topic == topic), key=lambda r: r.log_time)
            for message, record in zip(own, due, strict=True):
                check_fields(message.decoded, record.values)
                is_typed = variant != "mcap-none-profile" or topic != "/chatter"
                name = message.type_name.replace("/msg/", "/")
                assert not is_typed or name == record.msgtype.replace("/msg/", "/")


@pytest.mark.parametrize("variant", FOXGLOVE_SOURCES)
def test_messages_of_foxglove(variant: str, tmp_path: Path) -> None:
    source = foxglove_scene(partial(scene, "rgb8"), frames=6, width=64, height=48)
    mp4ds.pack(FOXGLOVE_SOURCES[variant](tmp_path, source), tmp_path / "dataset")
    sent = [record for record in source.messages if record.topic != "/camera/image"]
    with mp4ds.open(tmp_path / "dataset") as opened:
        for topic in ("/tf", "/pose", "/log", "/camera/calibration"):
            due = [record for record in sent if record.topic == topic]
            found = list(opened.messages([topic]))
            assert len(found) == len(due) > 0
            for message, record in zip(found, due, strict=True):
                assert (message.topic, message.log_time_ns) == (topic, record.log_time)
                check_fields(message.decoded, record.values)


# ---------------------------------------------------------------- which, and in which order


def test_some_topics(tmp_path: Path) -> None:
    with mp4ds.open(packed(tmp_path, scene("mono8"), "mcap-ros2-zstd")) as dataset:
        everything = list(dataset.messages())
        for topics in (["/imu"], ["/tf", "/imu"], [INFO_TOPIC, "/chatter"], [TOPIC], []):
            found = list(dataset.messages(topics))
            assert found == [message for message in everything if message.topic in topics]
        assert len(list(dataset.messages([INFO_TOPIC]))) == 8
        imu = next(dataset.messages(["/imu"]))
        assert imu.publish_time_ns == imu.log_time_ns - 1_500_000
        assert imu.raw.readonly
        assert imu.decoded is imu.decoded
        with pytest.raises(dataclasses.FrozenInstanceError):
            imu.topic = "/other"  # type: ignore[misc]
        with pytest.raises(mp4ds.OptionError, match=r"no topic '/gps'; there are: .*/imu"):
            dataset.messages(["/imu", "/gps"])
        with pytest.raises(mp4ds.OptionError, match=r"such as \['/imu'\]"):
            dataset.messages("/imu")


def test_nothing_is_read_ahead(tmp_path: Path) -> None:
    with mp4ds.open(packed(tmp_path, scene("mono8"), "mcap-ros2-zstd")) as dataset:
        one, other = dataset.messages(["/imu"]), dataset.messages(["/imu"])
        assert [next(one) for _ in range(3)] == [next(other) for _ in range(3)]
        assert dataset[TOPIC][3].index == 3
        assert next(one) == next(other)


@pytest.mark.parametrize("trait", ["data-short", "encoding-unknown", "data-empty"])
def test_images_stored_verbatim(trait: str, tmp_path: Path) -> None:
    write_bag(tmp_path / "drive.bag", odd_scene(trait))
    summary = mp4ds.pack(tmp_path / "drive.bag", tmp_path / "dataset")
    (entry,) = (item for item in summary.topics if item.topic == "/odd/image")
    left = entry.messages - entry.frames
    assert left
    with mp4ds.open(tmp_path / "dataset") as dataset:
        found = list(dataset.messages(["/odd/image"]))
        assert len(found) == left
        sent = {bytes(r.payload("ros1")) for r in odd_scene(trait).messages}
        for message in found:
            assert bytes(message.raw) in sent
            assert message.decoded.width == 32
        topics = {message.topic for message in dataset.messages()}
        assert topics == ({"/chatter", "/odd/image"} if entry.frames == 0 else {"/chatter"})


def test_a_pair_alone_has_its_calibrations(tmp_path: Path) -> None:
    with mp4ds.open(packed(tmp_path, scene("mono8")) / "cam_image_raw.mp4") as pair:
        found = list(pair.messages())
        assert [message.topic for message in found] == [INFO_TOPIC] * 8
        assert found[0].decoded.distortion_model == "plumb_bob"


# ---------------------------------------------------------------- what cannot be decoded


def channel(encoding: str, name: str = "", schema: bytes = b"", kind: str = "") -> Channel:
    return Channel(0, "/odd", encoding, Schema(name, kind, schema) if name else None)


@pytest.mark.parametrize(
    ("odd", "problem"),
    [
        (channel("flatbuffer", "foxglove.Log", b"", "flatbuffer"), "their encoding is flatbuffer"),
        (channel(""), "their encoding is unknown"),
        (channel("ros1"), "its message type is not known"),
        (channel("cdr", "my_msgs/msg/Odd"), "no definition of type my_msgs/msg/Odd"),
        (channel("ros1", "my_msgs/Odd", b"int32[ x", "ros1msg"), "cannot be parsed"),
        (channel("ros1", "my_msgs/Odd", b"other_msgs/X x", "ros1msg"), "no definition of type"),
        (channel("ros1", "my_msgs/Odd", b"std_msgs/Empty[] x", "ros1msg"), "without fields"),
        (
            channel(
                "ros1", "a/A", b"B[3] b\n" + RULER + b"\nMSG: a/B\nstd_msgs/Empty e", "ros1msg"
            ),
            "without fields",
        ),
        (channel("protobuf", "foxglove.Log"), "definition is unknown"),
        (channel("protobuf", "foxglove.Log", b"\xff", "protobuf"), "does not declare foxglove.Log"),
        (channel("protobuf", "foxglove.Log", b"", "protobuf"), "does not declare foxglove.Log"),
    ],
)
def test_topics_that_cannot_be_decoded(odd: Channel, problem: str) -> None:
    with pytest.raises(mp4ds.OptionError, match=rf"/odd cannot be decoded: .*{problem}.*\.raw"):
        decoder_of(odd)


def test_a_type_declared_inside_another_in_a_file_that_comes_before_its_imports() -> None:
    files = FileDescriptorSet()
    outer = files.file.add(name="a.proto", package="p", dependency=["b.proto"])
    inner = outer.message_type.add(name="Outer").nested_type.add(name="Inner")
    inner.field.add(name="part", number=7, label=1, type=11, type_name=".p.Part")
    part = files.file.add(name="b.proto", package="p").message_type.add(name="Part")
    part.field.add(name="text", number=1, label=1, type=9)
    decode = decoder_of(channel("protobuf", "p.Outer.Inner", files.SerializeToString(), "protobuf"))
    assert decode(memoryview(b"\x3a\x04\x0a\x02hi")).part.text == "hi"


@pytest.mark.parametrize("encoding", ["ros1", "cdr", "json", "protobuf"])
def test_any_bytes(encoding: str) -> None:
    """An object or a Refused, whatever the bytes are."""
    if encoding == "protobuf":
        name, schema = SERIALIZATIONS["protobuf"].schema("foxglove_msgs/msg/Log")
        odd = channel("protobuf", name, schema, "protobuf")
    elif encoding == "json":
        odd = channel("json", "x", b"{}", "jsonschema")
    else:
        odd = channel(encoding, "sensor_msgs/msg/PointCloud2")
    decode = decoder_of(odd)
    rng = np.random.default_rng(0)
    refused = 0
    for size in [*range(40), *rng.integers(0, 400, 300).tolist()]:
        data = rng.integers(0, 256, size, np.uint8).tobytes()
        if encoding == "cdr" and size % 2:
            data = b"\0\1\0\0" + data
        try:
            decode(memoryview(data))
        except Refused:
            refused += 1
    assert refused > 100


def test_deep_json() -> None:
    decode = decoder_of(channel("json"))
    assert decode(memoryview(b'{"a": [1, 2.5]}')) == {"a": [1, 2.5]}
    with pytest.raises(Refused):
        decode(memoryview(b"[" * (10 * sys.getrecursionlimit())))


def test_bytes_after_a_message() -> None:
    """As ROS itself, which overlooks them, but not when the type must be another."""
    image = image_ros1(width=2, height=1, encoding="mono8", data=b"ab", tail=b"four")
    decode = decoder_of(channel("ros1", "sensor_msgs/Image"))
    assert decode(memoryview(image)).data.tolist() == [97, 98]
    with pytest.raises(Refused, match="it is not a sensor_msgs/Image"):
        decode(memoryview(image + bytes(9)))


def test_a_message_of_another_type_is_reported(tmp_path: Path) -> None:
    text = struct.pack("<I", 2) + b"hi"
    good = (START, text, b"\0\1\0\0" + struct.pack("<I", 3) + b"hi\0")
    bad = (START + 1, text[:-1], good[2][:-2])
    made = raw_scene("/said", "std_msgs/msg/String", [good, bad])
    images = scene("mono8", with_info=False).messages
    for variant in ("bag-none", "mcap-ros2-zstd"):
        folder = tmp_path / variant
        source = Scene([*made.messages, *images])
        dataset = packed(folder, source, variant)
        with mp4ds.open(dataset) as opened:
            first, second = opened.messages(["/said"])
            assert first.decoded.data == "hi"
            with pytest.raises(mp4ds.SourceError, match=r"messages\.mcap.* /said cannot be dec"):
                _ = second.decoded
            assert bytes(second.raw) in (bad[1], bad[2])


def test_big_endian_cdr() -> None:
    decode = decoder_of(channel("cdr", "std_msgs/msg/Int32", b"int32 data", "ros2msg"))
    assert decode(memoryview(b"\0\0\0\0\0\0\0\7")).data == 7
    assert decode(memoryview(b"\0\1\0\0\7\0\0\0")).data == 7
    with pytest.raises(Refused):
        decode(memoryview(b"\0\2\0\0\7\0\0\0"))
