"""Latched topics of ROS 2, of which rosbag2 makes one channel for all publishers."""

from __future__ import annotations

from pathlib import Path

import pytest

import mp4ds
from mp4ds.bags.latched import LATCHED_QOS, LatchedMessages, latched_depth
from mp4ds.plugins.ros.ros2 import offered_qos
from mp4ds.records import Channel, Message
from player_scenes import (
    STATIC,
    RecordingPublisher,
    make_ros2,
    profiles,
    ros2_channel,
    run,
    static_channel,
    static_transform,
    text,
)

STRING = "std_msgs/msg/String"


def late(channel: Channel, *payloads: bytes) -> list[bytes]:
    """What is kept of messages for those that come after them."""
    kept = LatchedMessages(channel)
    for payload in payloads:
        kept.add(Message(channel, 0, 0, 0, payload))
    return [bytes(message.data) for message in kept]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("ros2")
    mp4ds.pack(make_ros2(folder / "drive.mcap"), folder / "drive")
    return folder / "drive"


def test_what_came_before_the_start_is_sent_at_first(drive: Path) -> None:
    publisher, _ = run(drive, RecordingPublisher("ros2"), start_offset=0.5, immediate=True)
    first = [(sent.topic, sent.payload) for sent in publisher.sent[:6]]
    assert first == [
        *(("/tf_static", static_transform(child)) for child in STATIC),
        *(("/map", text(f"map {n}")) for n in range(2)),
    ]
    assert {sent.topic for sent in publisher.sent[6:]} == {"/chatter"}


def test_of_tf_static_the_newest_of_each_child_frame_is_kept() -> None:
    first = [static_transform(child) for child in STATIC]
    again = static_transform("lidar", 7)
    expected = [first[0], first[2], first[3], again]
    assert late(static_channel(1), *first, again) == expected
    assert late(static_channel(1), *first, again, *expected) == expected  # the player went back
    many = [static_transform(f"{n}") for n in range(200)]
    assert late(static_channel(1), *many) == many


@pytest.mark.parametrize(
    ("channel", "depth"),
    [
        (ros2_channel(1, "/map", STRING, profiles(1, 1, 1, 1)), 10),
        (ros2_channel(1, "/map", STRING, profiles(12, 5)), 17),
        (ros2_channel(1, "/map", STRING, profiles(0, 0, 0)), 30),
        (ros2_channel(1, "/map", STRING, profiles(10**30)), 1000),
        (ros2_channel(1, "/map", STRING, profiles(1).replace("last", "all")), 1000),
        (ros2_channel(1, "/map", STRING, LATCHED_QOS), 1),
        (ros2_channel(1, "/tf_static", STRING, profiles(1)), 10),
        (ros2_channel(1, "/robot/tf_static", "tf2_msgs/msg/TFMessage", profiles(1)), 100),
    ],
    ids=lambda value: str(value) if isinstance(value, int) else value.topic,
)
def test_as_many_are_offered_as_all_publishers_kept(channel: Channel, depth: int) -> None:
    assert latched_depth(channel) == depth
    offered = offered_qos(channel, {})
    assert (offered.durability, offered.depth) == ("transient_local", depth)
    if depth < 100:
        messages = [text(f"{n}") for n in range(depth + 5)]
        assert late(channel, *messages) == messages[5:]
