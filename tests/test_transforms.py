"""Static transforms out of messages of every kind, and which of them connect cameras."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import pytest
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from google.protobuf import descriptor_pb2
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap_protobuf.schema import build_file_descriptor_set

from foxglove_wire import fill
from mp4ds.errors import Refused
from mp4ds.messages.transforms import (
    Transform,
    TransformCollector,
    transform_parser,
)
from mp4ds.records import Channel, Schema
from scenes import build, typestore

TURN = (0.0, 0.0, math.sin(0.5), math.cos(0.5))
TREE = [
    Transform("base", "head", (0.5, -0.25, 1.75), TURN),
    Transform("head", "left", (0.0, 0.05, 0.0), (0.5, 0.5, 0.5, 0.5)),
    Transform("head", "right \u00e4", (0.0, -0.05, 0.0), (-0.5, 0.5, -0.5, 0.5)),
    Transform("base", "lidar", (0.0, 0.0, 2.0), (0.0, 0.0, 0.0, 1.0)),
]


def parse_transforms(channel: Channel, data: bytes | memoryview) -> list[Transform]:
    parse = transform_parser(channel)
    assert parse is not None
    return parse(memoryview(data))


# ---------------------------------------------------------------- writers of messages


def ros(encoding: str, name: str, items: Sequence[Transform], *, little: bool = True) -> bytes:
    nodes = [
        {**node(item), "header": {"stamp": 17, "frame_id": item.parent}, "transform": node(item)}
        for item in items
    ]
    store = typestore(encoding)
    is_one = name == "foxglove_msgs/msg/FrameTransform"
    message = build(encoding, name, nodes[0] if is_one else {"transforms": nodes})
    if encoding == "ros1":
        return bytes(store.serialize_ros1(message, name))
    return bytes(store.serialize_cdr(message, name, little_endian=little))


def protobuf(transforms: Sequence[Transform]) -> bytes:
    message = FrameTransforms()
    for item in transforms:
        fill(message.transforms.add(), in_nanoseconds(item))
    return bytes(message.SerializeToString())


def node(item: Transform) -> dict[str, Any]:
    return {
        "timestamp": {"sec": 17, "nsec": 18},
        "parent_frame_id": item.parent,
        "child_frame_id": item.child,
        "translation": dict(zip("xyz", item.translation, strict=True)),
        "rotation": dict(zip("xyzw", item.rotation, strict=True)),
    }


def in_nanoseconds(item: Transform) -> dict[str, Any]:
    return {**node(item), "timestamp": 17}


def channel(encoding: str, type_name: str, data: bytes = b"", topic: str = "/tf_static") -> Channel:
    return Channel(1, topic, encoding, Schema(type_name, encoding, data))


ONE, MANY = "foxglove.FrameTransform", "foxglove.FrameTransforms"
ONE_SCHEMA, MANY_SCHEMA = (
    build_file_descriptor_set(kind).SerializeToString()
    for kind in (FrameTransform, FrameTransforms)
)
PROTOBUF = channel("protobuf", MANY, MANY_SCHEMA)

Writer = Callable[[Sequence[Transform]], bytes]
Kinds = dict[str, tuple[Channel, Writer]]


def ros_kinds(name: str) -> Kinds:
    """A type in each serialization of ROS."""
    ros2 = channel("cdr", name)
    return {
        f"ros1 {name}": (
            channel("ros1", name.replace("/msg/", "/")),
            lambda items: ros("ros1", name, items),
        ),
        f"cdr {name}": (ros2, lambda items: ros("cdr", name, items)),
        f"cdr-be {name}": (ros2, lambda items: ros("cdr", name, items, little=False)),
    }


MANY_KINDS: Kinds = {
    "protobuf": (PROTOBUF, protobuf),
    "json": (
        channel("json", MANY),
        lambda items: json.dumps({"transforms": [node(item) for item in items]}).encode(),
    ),
    **ros_kinds("tf2_msgs/msg/TFMessage"),
    **ros_kinds("tf/msg/tfMessage"),
    **ros_kinds("foxglove_msgs/msg/FrameTransforms"),
}
ONE_KINDS: Kinds = {
    "protobuf": (
        channel("protobuf", ONE, ONE_SCHEMA),
        lambda items: bytes(fill(FrameTransform(), in_nanoseconds(items[0])).SerializeToString()),
    ),
    "json": (channel("json", ONE), lambda items: json.dumps(node(items[0])).encode()),
    **ros_kinds("foxglove_msgs/msg/FrameTransform"),
}

Numbers = st.floats(allow_nan=False, allow_infinity=False)
Names = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=12)
Transforms = st.builds(
    Transform,
    Names,
    Names,
    st.tuples(Numbers, Numbers, Numbers),
    st.tuples(Numbers, Numbers, Numbers, Numbers),
)


# ---------------------------------------------------------------- parsing


@pytest.mark.parametrize("kind", ONE_KINDS)
def test_messages_of_one_transform(kind: str) -> None:
    own, write = ONE_KINDS[kind]
    for item in TREE:
        assert parse_transforms(own, write([item])) == [item]


@settings(deadline=None, max_examples=30)
@given(st.lists(Transforms, max_size=4))
def test_any_transforms_return(items: list[Transform]) -> None:
    for own, write in MANY_KINDS.values():
        assert parse_transforms(own, write(items)) == items


@pytest.mark.parametrize(
    "own",
    [
        channel("ros1", "sensor_msgs/Image"),
        channel("ros1", "foxglove.FrameTransform"),
        channel("flatbuffer", ONE),
        Channel(1, "/tf_static", "protobuf", None),
        channel("protobuf", ONE),
        channel("protobuf", ONE, b"\xff\xff\xff"),
        channel("protobuf", MANY, ONE_SCHEMA),
        channel("protobuf", ONE, ONE_SCHEMA + bytes(1 << 20)),
    ],
)
def test_not_a_transform(own: Channel) -> None:
    assert transform_parser(own) is None


def test_descriptors_that_are_not_whole() -> None:
    files = descriptor_pb2.FileDescriptorSet.FromString(ONE_SCHEMA)
    without = descriptor_pb2.FileDescriptorSet(
        file=[file for file in files.file if "Vector3" not in file.name]
    )
    circle = descriptor_pb2.FileDescriptorSet()
    for name, other in (("a", "b"), ("b", "a")):
        circle.file.add(name=name, dependency=[other])
    chain = descriptor_pb2.FileDescriptorSet(file=files.file)
    chain.file.add(name="0")
    for number in range(1, 5000):
        chain.file.add(name=str(number), dependency=[str(number - 1)])
    for schema in (without, circle, chain):
        assert transform_parser(channel("protobuf", ONE, schema.SerializeToString())) is None


@pytest.mark.parametrize(
    "text",
    [
        "", "{", "[]", "7", "null", '"text"', '{"transforms": 7}', '{"transforms": [7]}',
        '{"transforms": ["a"]}', '{"transforms": [null]}', '{"transforms": {"a": 1}}',
        '{"transforms": [{"parent_frame_id": 7}]}', '{"transforms": [{"translation": 7}]}',
        '{"transforms": [{"translation": {"x": "1.0"}}]}',
        '{"transforms": [{"translation": {"x": null}}]}',
        '{"transforms": [{"rotation": [1, 2, 3, 4]}]}',
        '{"transforms": [{"translation": {"x": 1' + "0" * 400 + "}}]}",
        '{"transforms": [{"translation": {"x": 1' + "0" * 5000 + "}}]}",
        "[" * 100_000, '{"transforms": [' + "{}," * 10_000 + "{}]}",
        '{"transforms": []' + " " * (1 << 20) + "}", "\ud800",
    ],
)  # fmt: skip
def test_json_of_another_shape(text: str) -> None:
    with pytest.raises(Refused):
        parse_transforms(channel("json", MANY), text.encode("utf-8", "surrogatepass"))


def test_a_message_beyond_all_measure() -> None:
    for own, write in MANY_KINDS.values():
        with pytest.raises(Refused, match="bytes"):
            parse_transforms(own, write(TREE) + bytes(1 << 20))


@settings(deadline=None, max_examples=60)
@given(st.data())
def test_damaged_messages_end_in_a_wire_error(data: st.DataObject) -> None:
    own, write = MANY_KINDS[data.draw(st.sampled_from(sorted(MANY_KINDS)))]
    payload = bytearray(write(TREE))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(payload)))
    for damaged in (bytes(payload), bytes(payload[:cut])):
        try:
            found = parse_transforms(own, damaged)
        except Refused:
            continue
        assert all(isinstance(item, Transform) for item in found)


# ---------------------------------------------------------------- collecting


def collected(items: Iterable[Transform]) -> TransformCollector:
    collector = TransformCollector()
    for item in items:
        collector.add(PROTOBUF, protobuf([item]))
    return collector


@pytest.mark.parametrize(
    ("topic", "taken"),
    [
        ("/tf_static", True),
        ("tf_static", True),
        ("/robot1/tf_static", True),
        ("/tf_static/", True),
        ("/tf", False),
        ("/tf_static/other", False),
        ("/my_tf_static", False),
        ("", False),
    ],
)
def test_topics_of_static_transforms(topic: str, taken: bool) -> None:
    own = channel("protobuf", MANY, MANY_SCHEMA, topic)
    collector = TransformCollector()
    collector.add(own, protobuf(TREE))
    assert collector.takes(own) is taken
    assert bool(collector.transforms) is taken
    assert not collector.takes(channel("ros1", "std_msgs/String", b"", topic))


def test_the_latest_of_each_child_holds() -> None:
    moved = Transform("base", "head", (9.0, 9.0, 9.0), TURN)
    elsewhere = Transform("other", "/left", (0.0, 0.0, 0.0), TURN)  # a name as tf had it
    collector = collected([*TREE, moved, elsewhere])
    assert collector.transforms == [moved, elsewhere, *TREE[2:]]


@pytest.mark.parametrize(
    "item",
    [
        Transform("", "b", (0.0, 0.0, 0.0), TURN),
        Transform("a", "", (0.0, 0.0, 0.0), TURN),
        Transform("a", "a", (0.0, 0.0, 0.0), TURN),
        Transform("a", "b", (math.nan, 0.0, 0.0), TURN),
        Transform("a", "b", (0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 1.0)),
        Transform("a", "b", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)),
        Transform("a", "b", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.1)),
        Transform("a", "b", (0.0, 0.0, 0.0), (1e300, 0.0, 0.0, 0.0)),
    ],
)
def test_what_tf2_refuses_is_left_out(item: Transform) -> None:
    assert not item.is_usable
    assert collected([item, TREE[0]]).transforms == [TREE[0]]


# ---------------------------------------------------------------- between cameras


@settings(deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)), max_size=20),
    st.lists(st.integers(0, 9), max_size=4),
)
def test_any_graph_gives_the_ancestors(edges: list[tuple[int, int]], frames: list[int]) -> None:
    items = [Transform(f"f{a}", f"f{b}", (0.0, 0.0, 0.0), TURN) for a, b in edges if a != b]
    collector = collected(items)
    parents = {item.child: item.parent for item in collector.transforms}
    above: set[str] = set()
    todo = [f"f{n}" for n in frames]
    while todo:
        name = todo.pop()
        if name in parents and name not in above:
            above.add(name)
            todo.append(parents[name])
    found = collector.between(f"f{n}" for n in frames)
    assert {item.child for item in found} == above
    assert found == [item for item in collector.transforms if item.child in above]
