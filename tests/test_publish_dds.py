"""Publishing over DDS: what other participants are told, types, bytes, and what is refused."""

from __future__ import annotations

import struct
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("cyclonedds")

from mp4ds.bags.convert import Converter
from mp4ds.errors import ConversionError, OptionError, RemoteError
from mp4ds.plugins.ros.dds_types import dds_name, dds_topic, message_type
from mp4ds.plugins.ros.node import NodeOptions, open_node
from mp4ds.plugins.ros.ros2 import Qos
from mp4ds.records import Channel, Schema
from ros2_sides import KINDS, STORE, Side, channel, connect, dds_side, message, padded
from waiting import WATCHDOG_S, until

STRING = "std_msgs/msg/String"
STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"

OTHER_HASH = "RIHS01_" + "5" * 64


@pytest.fixture
def side(monkeypatch: pytest.MonkeyPatch) -> Iterator[Side]:
    with dds_side(monkeypatch) as found:
        yield found


def custom(definition: str, encoding: str = "ros2msg", name: str = "pkg/msg/Own") -> Channel:
    return Channel(1, "/own", "cdr", Schema(name, encoding, definition.encode()), {})


def test_others_are_told_type_hash_and_qos(side: Side) -> None:
    qos = Qos(reliability="best_effort", durability="transient_local", deadline=10**9)
    with side.open(overrides={"/b": qos}) as publisher:
        publisher.advertise(channel("/a", STRING))
        recorded = replace(channel("/b", STRING), metadata={"topic_type_hash": OTHER_HASH})
        publisher.advertise(recorded)
        (told,) = side.peer.ask("publications", "rt/a")
        (other,) = side.peer.ask("publications", "rt/b")
    assert told["type"] == "std_msgs::msg::dds_::String_"
    assert told["user_data"] == f"typehash={STRING_HASH};"
    assert other["user_data"] == f"typehash={OTHER_HASH};"
    assert (told["reliable"], told["latched"]) == (True, False)
    assert (other["reliable"], other["latched"], other["deadline"]) == (False, True, 10**9)


def test_subscribers_tell_the_type_hash(side: Side) -> None:
    """Nodes look for it, and complain where there is none."""
    clock = STORE.hash_rihs01("rosgraph_msgs/msg/Clock")
    with side.open() as listener, side.open() as publisher:
        listener.follow_clock(lambda _: None)
        listener.listen("/a", lambda _: None)
        publisher.advertise(channel("/a", STRING))
        for topic, expected in (("rt/clock", clock), ("rt/a", STRING_HASH)):
            (told,) = side.peer.ask("subscriptions", topic)
            assert told["user_data"] == f"typehash={expected};"


def test_topics_without_the_prefix_of_ros(side: Side) -> None:
    with side.open(overrides={"/a": Qos(avoid_ros_namespace_conventions=True)}) as publisher:
        publisher.advertise(channel("/a", STRING))
        assert side.peer.ask("publications", "a")


@pytest.mark.parametrize("kind", KINDS)
def test_the_definition_may_be_missing_for_standard_types(kind: str) -> None:
    made = message_type(channel("/a", kind, encoding=""))
    assert made.is_real
    assert made.type_hash == STORE.hash_rihs01(kind)


@pytest.mark.parametrize("kind", KINDS)
def test_big_endian_messages_become_those_of_this_machine(side: Side, kind: str) -> None:
    recorded = channel("/a", kind)
    with side.open() as publisher:
        connect(side, publisher, recorded)
        publisher.publish(recorded, message(kind, 7, little_endian=False), 0)
        got = side.peer.received("/a", 1)
    assert got == [padded(message(kind, 7))]


def test_what_follows_a_message_is_kept(side: Side) -> None:
    recorded = channel("/a", STRING)
    payload = b"\0\1\0\0" + struct.pack("<I", 4) + b"abc\0" + b"rest of it"
    with side.open() as publisher:
        connect(side, publisher, recorded)
        publisher.publish(recorded, payload, 0)
        assert side.peer.received("/a", 1) == [padded(payload)]


def test_a_large_image_arrives_whole(side: Side) -> None:
    recorded = channel("/image", "sensor_msgs/msg/Image")
    image = STORE.deserialize_cdr(message("sensor_msgs/msg/Image", 1), "sensor_msgs/msg/Image")
    image.data = np.random.default_rng(1).integers(0, 256, 2_000_000, np.uint8)
    payload = bytes(STORE.serialize_cdr(image, "sensor_msgs/msg/Image"))
    with side.open() as publisher:
        connect(side, publisher, recorded)
        publisher.publish(recorded, memoryview(payload), 0)
    assert side.peer.received("/image", 1) == [padded(payload)]


def test_many_messages_of_which_all_are_kept(side: Side) -> None:
    recorded = channel("/a", STRING)
    sent = [message(STRING, number) + bytes(20_000) for number in range(100)]
    with side.open(overrides={"/a": Qos(history="keep_all")}) as publisher:
        connect(side, publisher, recorded)
        for payload in sent:
            publisher.publish(recorded, payload, 0)
        got = side.peer.received("/a", len(sent))
    assert got == [padded(payload) for payload in sent]


IMAGE = "sensor_msgs/msg/Image"


def large(kind: str, number: int, size: int = 200_000) -> bytes:
    """More than a socket holds, a few of them.

    The larger, the fewer are under way when a subscriber stops.
    """
    if kind == STRING:
        return message(kind, number) + bytes(20_000)
    image = STORE.deserialize_cdr(message(kind, number), kind)
    image.data = np.zeros(size, np.uint8)
    return bytes(STORE.serialize_cdr(image, kind))


@pytest.mark.parametrize(("kind", "count"), [(STRING, 900), (IMAGE, 30)])
def test_a_subscriber_that_hangs_for_a_while_gets_all(side: Side, kind: str, count: int) -> None:
    recorded = channel("/a", kind)
    sent = [large(kind, number) for number in range(count)]
    with side.open() as publisher:
        with side.stopped(publisher, recorded):
            for payload in sent:
                publisher.publish(recorded, payload, 0)
        assert side.peer.received("/a", count) == [padded(payload) for payload in sent]


def test_a_subscriber_that_hangs_for_long_takes_no_more_memory(side: Side) -> None:
    """What is kept for it is what is newest."""
    recorded = channel("/a", IMAGE)
    sent = [padded(large(IMAGE, number, 500_000)) for number in range(100)]
    with side.open() as publisher:
        with side.stopped(publisher, recorded):
            for payload in sent:
                publisher.publish(recorded, payload, 0)
        until(lambda: sent[-1] in side.peer.received("/a", 1))
        got = side.peer.received("/a", 1)
    assert got[-32:] == sent[-32:]
    assert len(got) < 50


def test_its_own_clock_is_none_of_others(side: Side) -> None:
    heard: list[int] = []
    with side.open() as publisher, side.open() as other:
        publisher.follow_clock(heard.append)

        def arrives() -> bool:
            publisher.clock(5)
            other.clock(6)
            return bool(heard)

        until(arrives)
    assert set(heard) == {6}


def test_publishers_may_leave_while_they_are_heard(side: Side) -> None:
    times: list[int] = []
    messages: list[int | None] = []
    recorded = channel("/a", STRING)
    with side.open() as listener:
        listener.follow_clock(times.append)
        listener.listen("/a", messages.append)
        for number in (1, 2, 3):
            with side.open() as publisher:
                publisher.advertise(recorded)
                until(lambda: publisher.subscribers(recorded))
                publisher.publish(recorded, message(STRING, number), 0)
                until(lambda: (publisher.clock(number), number in times)[1])  # noqa: B023
        until(lambda: len(messages) == 3)
    assert len(messages) == 3
    assert set(times) == {1, 2, 3}


def test_no_thread_is_left(side: Side) -> None:
    before = threading.active_count()
    with side.open() as publisher:
        publisher.listen("/a", lambda _: None)
        assert threading.active_count() == before + 1
    assert threading.active_count() == before


@pytest.mark.parametrize(
    "definition",
    [
        "bool a\nbyte b\nchar c\nint8[] d\nuint8[3] e\nint16[<=4] f\nuint16 g\nint32 h\nuint32 i\n"
        "int64 j\nuint64 k\nfloat32 l\nfloat64 m\nstring n\nstring<=5 o\nstring[] p\n",
        "std_msgs/Empty[] a\n",
        "",
        "uint8 from\nuint8 lambda\n",
        "geometry_msgs/Pose[2] poses\n",
    ],
)
def test_types_of_every_kind_of_field_are_announced(definition: str) -> None:
    made = message_type(custom(definition))
    assert made.is_real
    assert made.type_hash.startswith("RIHS01_")
    assert made.is_empty == (not definition)


def test_definitions_in_idl_are_announced() -> None:
    text = (
        "=" * 80 + "\nIDL: pkg/msg/Own\nmodule pkg { module msg { struct Own "
        "{ uint32 number; sequence<double> values; }; }; };\n"
    )
    made = message_type(custom(text, "ros2idl"))
    assert made.is_real
    assert [*made.writes.__annotations__] == ["number", "values"]


OPAQUE = {
    "of wide strings": custom("wstring a\n"),
    "unknown": custom("", ""),
    "damaged": custom("uint8[ a"),
    "of an unknown part": custom("other/Thing a\n"),
    "of itself": custom("Own[] a\n"),
    "that is huge": custom("uint8[4294967295] a\n"),
    "that multiplies": custom(
        "A[9999] a\n"
        + "".join(
            "=" * 80 + f"\nMSG: pkg/{one}\n{two}[9999] a\n"
            for one, two in (("A", "B"), ("B", "C"), ("C", "float64"))
        )
    ),
}


@pytest.mark.parametrize("recorded", OPAQUE.values(), ids=OPAQUE)
def test_messages_of_a_type_that_dds_cannot_have_are_published(
    side: Side, recorded: Channel
) -> None:
    heard = threading.Semaphore(0)
    assert not message_type(recorded).is_real
    with side.open() as listener, side.open() as publisher:
        listener.listen("/own", lambda _: heard.release())
        publisher.advertise(recorded)
        (told,) = side.peer.ask("publications", "rt/own")
        assert told["type"] == "pkg::msg::dds_::Own_"
        until(lambda: publisher.subscribers(recorded))
        publisher.publish(recorded, b"\0\1\0\0anything", 0)
        assert heard.acquire(timeout=WATCHDOG_S)
        with pytest.raises(ConversionError, match="big-endian"):
            publisher.publish(recorded, b"\0\0\0\0anything", 0)


def test_empty_messages_of_ros1_are_published(side: Side) -> None:
    source = Channel(1, "/own", "ros1", Schema("std_msgs/Empty", "ros1msg", b""), {})
    converter = Converter("ros2")
    recorded = converter.channel(source)
    heard = threading.Semaphore(0)
    with side.open() as listener, side.open() as publisher:
        listener.listen("/own", lambda _: heard.release())
        publisher.advertise(recorded)
        until(lambda: publisher.subscribers(recorded))
        publisher.publish(recorded, converter.payload(source, b""), 0)
        publisher.publish(recorded, b"\0\1\0\0", 0)
        assert heard.acquire(timeout=WATCHDOG_S)
        assert heard.acquire(timeout=WATCHDOG_S)


@pytest.mark.parametrize("payload", [b"", b"\0\1\0", b"\0\1\0\0", b"\0\1\0\0\xff\xff\xff\xffab\0"])
def test_messages_that_are_not_of_their_type_are_told(side: Side, payload: bytes) -> None:
    recorded = channel("/a", STRING)
    with side.open() as publisher:
        publisher.advertise(recorded)
        with pytest.raises(ConversionError, match="/a: a message"):
            publisher.publish(recorded, payload, 0)
        publisher.publish(recorded, message(STRING, 1), 0)


def test_a_topic_may_have_two_types(side: Side) -> None:
    heard = threading.Semaphore(0)
    both = channel("/a", STRING), channel("/a", "std_msgs/msg/Header")
    with side.open() as listener, side.open() as publisher:
        listener.listen("/a", lambda _: heard.release())
        for recorded in both:
            publisher.advertise(recorded)
            until(lambda: publisher.subscribers(recorded))  # noqa: B023 (called at once)
            publisher.publish(recorded, message(recorded.type_name, 1), 0)
            assert heard.acquire(timeout=WATCHDOG_S)


def test_a_quality_of_service_that_makes_no_sense_is_told(side: Side) -> None:
    nonsense = Qos(deadline=-5)
    with (
        side.open(overrides={"/a": nonsense}) as publisher,
        pytest.raises(ConversionError, match="or its QoS"),
    ):
        publisher.advertise(channel("/a", STRING))


@pytest.mark.parametrize("told", ["x", "-1", "1.5", "²", "233", "1000000000"])
def test_a_bad_ros_domain_id_is_told(monkeypatch: pytest.MonkeyPatch, told: str) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", told)
    with pytest.raises(OptionError, match="ROS_DOMAIN_ID"):
        open_node("ros2", NodeOptions(), "player")


@pytest.mark.parametrize(
    ("name", "value"),
    [("ROS_LOCALHOST_ONLY", "1"), ("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")],
)
def test_discovery_may_be_kept_to_this_machine(
    side: Side, monkeypatch: pytest.MonkeyPatch, name: str, value: str
) -> None:
    monkeypatch.setenv(name, value)
    for _ in range(2):
        with side.open() as publisher:
            publisher.advertise(channel("/a", STRING))
            assert side.peer.ask("publications", "rt/a")


def test_a_configuration_that_makes_no_sense_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", "<Nonsense/>")
    with pytest.raises(RemoteError, match="CYCLONEDDS_URI"):
        open_node("ros2", NodeOptions(), "player")


def test_the_library_may_be_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "mp4ds.plugins.ros.dds_node", raising=False)
    monkeypatch.setitem(sys.modules, "cyclonedds.builtin", None)
    with pytest.raises(RemoteError, match=r"pip install 'mp4ds\[dds\]'"):
        open_node("ros2", NodeOptions(), "player")


@pytest.mark.parametrize("topic", ["", "/", "/a b", "/a//b", "/1a", "/ä", "/a__b", "/a/", "~/a"])
def test_topics_that_ros2_cannot_have(topic: str) -> None:
    assert dds_topic(topic) is None


def test_names_in_dds() -> None:
    assert dds_topic("/a/b_1") == "rt/a/b_1"
    assert dds_topic("a") == "rt/a"
    assert dds_topic("/a", bare=True) == "a"
    assert dds_name("sensor_msgs/msg/Image") == "sensor_msgs.msg.dds_.Image_"


def test_nothing_is_imported_before_it_is_needed() -> None:
    code = (
        "import sys, mp4ds.plugins.playing.player, mp4ds.plugins.recording.record; "
        "sys.exit(any(name.startswith(('cyclonedds', 'rclpy')) for name in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
