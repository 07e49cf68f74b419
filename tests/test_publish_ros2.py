"""What holds for publishing in ROS 2 both over DDS and by rclpy; and quality of service."""

from __future__ import annotations

import json
import sys
import threading
import warnings
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import fake_rclpy
from mp4ds.bags.latched import LATCHED_QOS
from mp4ds.errors import ConversionError, OptionError, Refused, RemoteError
from mp4ds.plugins.playing.player import player_services
from mp4ds.plugins.ros.node import NodeNames
from mp4ds.plugins.ros.ros2 import Qos, load_overrides, offered_qos, qos_text, recorded_qos
from mp4ds.records import Channel, Schema
from player_scenes import STATIC, static_channel, static_transform
from ros2_sides import KINDS, STORE, Controls, Side, channel, connect, message, padded
from ros2_sides import side as side
from waiting import WATCHDOG_S, until

STRING = "std_msgs/msg/String"


def test_late_subscribers_get_all_static_transforms(side: Side) -> None:
    recorded = static_channel(1, 1, 1, 1)
    sent = [static_transform(child) for child in STATIC]
    with side.open() as publisher:
        publisher.advertise(recorded)
        for payload in sent:
            publisher.publish(recorded, payload, 0)
        side.peer.subscribe("/tf_static", recorded.type_name, latched=True)
        got = side.peer.received("/tf_static", len(sent))
    assert [padded(payload) for payload in got] == [padded(payload) for payload in sent]


@pytest.mark.parametrize("kind", KINDS)
def test_every_message_arrives_in_order(side: Side, kind: str) -> None:
    recorded = channel("/robot/topic", kind)
    sent = [message(kind, number) for number in range(20)]
    with side.open() as publisher:
        publisher.advertise(recorded)
        assert publisher.subscribers(recorded) == 0
        connect(side, publisher, recorded)
        until(lambda: publisher.subscribers(recorded) == 1)
        for number, payload in enumerate(sent):
            publisher.publish(recorded, memoryview(payload) if number % 2 else payload, number)
        got = side.peer.received("/robot/topic", 20)
    assert [padded(payload) for payload in got] == [padded(payload) for payload in sent]


def test_latched_messages_reach_late_subscribers_from_each_publisher(side: Side) -> None:
    left, right = (channel("/tf_static", STRING, qos=LATCHED_QOS) for _ in range(2))
    with side.open() as publisher:
        for recorded, number in ((left, 1), (left, 2), (right, 3)):
            publisher.advertise(recorded)
            publisher.publish(recorded, message(STRING, number), number)
        side.peer.subscribe("/tf_static", STRING, latched=True)
        got = side.peer.received("/tf_static", 2)
        expected = [padded(message(STRING, number)) for number in (2, 3)]
        assert sorted(padded(payload) for payload in got) == expected


def test_channels_of_a_topic_share_a_publisher(side: Side) -> None:
    first, second = channel("/tf", STRING), channel("/tf", STRING)
    with side.open() as publisher:
        publisher.advertise(second)
        connect(side, publisher, first)
        assert side.peer.connected("/tf", 1) == 1
        publisher.publish(first, message(STRING, 1), 0)
        publisher.publish(second, message(STRING, 2), 0)
        assert len(side.peer.received("/tf", 2)) == 2


@pytest.mark.parametrize("reliable", [True, False])
def test_best_effort_is_only_for_best_effort(side: Side, reliable: bool) -> None:
    recorded = channel("/camera", STRING)
    best_effort = {"/camera": Qos(reliability="best_effort")}
    with side.open(overrides=best_effort) as publisher:
        publisher.advertise(recorded)
        side.peer.subscribe("/camera", STRING, reliable=reliable)
        other = channel("/other", STRING)
        publisher.advertise(other)
        side.peer.subscribe("/other", STRING, reliable=reliable)
        until(lambda: publisher.subscribers(other) == 1)
        until(lambda: publisher.subscribers(recorded) == (0 if reliable else 1))
        if not reliable:

            def arrives() -> bool:
                publisher.publish(recorded, message(STRING, 1), 0)
                return bool(side.peer.received("/camera", 1, 0.1))

            until(arrives)


def test_the_clock_is_that_of_ros(side: Side) -> None:
    times = [1_700_000_000_000_000_000 + 25_000_000 * number for number in range(40)]
    with side.open() as publisher:
        publisher.clock(0)
        side.peer.subscribe("/clock", "rosgraph_msgs/msg/Clock", reliable=False)
        assert side.peer.connected("/clock", 1) == 1
        got: list[bytes] = []

        def heard() -> bool:
            publisher.clock(0)
            got[:] = side.peer.received("/clock", 1, 0.02)
            return bool(got)

        until(heard)  # best effort: whoever is connected on one side may not be on both
        told: list[int] = []

        def is_told(time_ns: int) -> bool:
            told[:] = [
                int.from_bytes(raw[4:8], "little") * 10**9 + int.from_bytes(raw[8:12], "little")
                for raw in side.peer.received("/clock", 1)
            ]
            return time_ns in told

        for time_ns in times:
            publisher.clock(time_ns)
            until(lambda time_ns=time_ns: is_told(time_ns))
    assert told == sorted(told)
    assert [one for one in told if one] == times


def test_the_clock_of_others_is_followed(side: Side) -> None:
    heard: list[int] = []
    with side.open() as publisher:
        publisher.follow_clock(heard.append)
        for sec in (1, 2):
            payload = b"\0\1\0\0" + sec.to_bytes(4, "little") + (7).to_bytes(4, "little")
            told = sec * 10**9 + 7

            def arrives(payload: bytes = payload, told: int = told) -> bool:
                kind = "rosgraph_msgs/msg/Clock"
                side.peer.publish("/clock", kind, payload, reliable=False)
                return told in heard

            until(arrives)
    assert heard == sorted(heard)


@pytest.mark.parametrize("reliable", [True, False])
@pytest.mark.parametrize("kind", [STRING, "sensor_msgs/msg/Imu"])
def test_topics_of_others_are_heard_whatever_their_type(
    side: Side, kind: str, reliable: bool
) -> None:
    count, sent, heard = threading.Semaphore(0), 0, 0
    with side.open() as publisher:
        publisher.listen("/trigger", lambda _: count.release())

        def arrives(seconds: float) -> bool:
            nonlocal sent, heard
            side.peer.publish("/trigger", kind, message(kind, sent), reliable=reliable)
            sent, is_heard = sent + 1, count.acquire(timeout=seconds)
            heard += is_heard
            return is_heard

        # whoever is connected on one side may not be on both; from the first on, each one arrives
        until(lambda: arrives(0.5))
        assert arrives(WATCHDOG_S)
        assert arrives(WATCHDOG_S)
        while count.acquire(blocking=False):
            heard += 1
        assert heard <= sent


def test_a_topic_to_listen_to_has_to_have_a_name(side: Side) -> None:
    with side.open() as publisher, pytest.raises(OptionError, match="not a valid ROS 2 topic name"):
        publisher.listen("/no topic", lambda _: None)


CALLS: dict[str, tuple[str, dict[str, Any], tuple[Any, ...] | None, dict[str, Any]]] = {
    "pause": ("Pause", {}, ("pause",), {}),
    "resume": ("Resume", {}, ("resume",), {}),
    "toggle_paused": ("TogglePaused", {}, ("toggle_paused",), {}),
    "is_paused": ("IsPaused", {}, None, {"paused": True}),
    "get_rate": ("GetRate", {}, None, {"rate": 2.5}),
    "set_rate": ("SetRate", {"rate": 0.5}, ("set_rate", 0.5), {"success": True}),
    "play_next": ("PlayNext", {}, ("play_next",), {"success": True}),
    "burst": ("Burst", {"num_messages": 9}, ("burst", 9), {"actually_burst": 3}),
    "play": (
        "Play",
        {
            "start_offset": SimpleNamespace(sec=2, nanosec=3),
            "playback_duration": SimpleNamespace(sec=4, nanosec=0),
            "playback_until_timestamp": SimpleNamespace(sec=5, nanosec=0),
        },
        ("play", 102_000_000_003, 106_000_000_003),
        {"success": True},
    ),
    "seek": (
        "Seek",
        {"time": SimpleNamespace(sec=5, nanosec=6)},
        ("seek", 5_000_000_006),
        {"success": True},
    ),
    "stop": ("Stop", {}, ("stop",), {}),
}


def test_the_services_are_those_of_rosbag2(side: Side) -> None:
    player = Controls()
    with side.open() as publisher:
        publisher.serve(player_services(player))
        for name, (kind, request, _, reply) in CALLS.items():
            assert side.peer.call(f"/rosbag2_player/{name}", kind, request) == reply
    assert player.asked == [asked for _, _, asked, _ in CALLS.values() if asked]


def test_ros_names_the_node_and_its_clock(side: Side) -> None:
    names = NodeNames("player", "/robot", (("/clock", "/sim"),))
    with side.open(names=names) as publisher:
        publisher.serve(player_services(Controls()))
        publisher.clock(0)
        assert side.peer.call("/robot/player/get_rate", "GetRate", {}) == {"rate": 2.5}
        side.peer.subscribe("/sim", "rosgraph_msgs/msg/Clock", reliable=False)
        assert side.peer.connected("/sim", 1) == 1


@pytest.mark.parametrize("milliseconds", [int(WATCHDOG_S * 1000), 0])
def test_subscribers_have_as_long_as_they_are_given(side: Side, milliseconds: int) -> None:
    recorded = channel("/robot/topic", STRING)
    with side.open(wait_for_all_acked=milliseconds) as publisher:
        connect(side, publisher, recorded)
        publisher.publish(recorded, message(STRING, 1), 0)
    assert len(side.peer.received("/robot/topic", 1)) == 1


@pytest.mark.parametrize("milliseconds", [500, None])
def test_subscribers_that_do_not_acknowledge(side: Side, milliseconds: int | None) -> None:
    """The topics are named, others are not."""
    heard, plain = channel("/robot/topic", STRING), channel("/robot/other", STRING)
    publisher = side.open(wait_for_all_acked=milliseconds)
    with side.stopped(publisher, heard):
        publisher.advertise(plain)
        publisher.publish(heard, message(STRING, 1), 0)
        publisher.publish(plain, message(STRING, 1), 0)
        with pytest.warns(UserWarning, match=r"^/robot/topic: subscribers have not acknowledged"):
            publisher.close()


def test_who_is_closed_is_gone(side: Side) -> None:
    recorded = channel("/topic", STRING)
    with side.open() as publisher:
        publisher.advertise(recorded)
        publisher.listen("/silent", lambda _: None)
        side.peer.subscribe("/topic", STRING)
        assert side.peer.connected("/topic", 1) == 1
        assert publisher.is_alive
        assert not publisher.wants_clock
    assert not publisher.is_alive
    assert side.peer.connected("/topic", 0) == 0
    publisher.close()


@pytest.mark.parametrize(
    ("recorded", "says"),
    [
        (Channel(1, "/x", "ros1", Schema("std_msgs/String", "ros1msg", b""), {}), "ros1"),
        (Channel(1, "/x", "", None, {}), "message encoding is unknown"),
        (Channel(1, "/x y", "cdr", Schema(STRING, "", b""), {}), "not valid in ROS 2"),
        (Channel(1, "/x", "cdr", Schema("nonsense", "", b""), {}), "nonsense"),
        (Channel(1, "/x", "cdr", None, {}), "''"),
    ],
)
def test_what_ros2_cannot_have_is_told(side: Side, recorded: Channel, says: str) -> None:
    with side.open() as publisher, pytest.raises(ConversionError, match=says) as told:
        publisher.advertise(recorded)
    assert recorded.topic in str(told.value)


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> fake_rclpy.Bus:
    return fake_rclpy.install(monkeypatch)


def test_rclpy_has_to_have_the_whole_type(bus: fake_rclpy.Bus) -> None:
    bus.halves.add("sensor_msgs/msg/Imu")
    with Side(None).open() as publisher:
        for kind, says in (("JointState", "not installed"), ("Imu", "typesupport_c")):
            with pytest.raises(Refused, match=says):
                publisher.advertise(channel("/x", f"sensor_msgs/msg/{kind}"))


def test_an_installed_type_that_is_not_the_recorded_one_is_told(
    bus: fake_rclpy.Bus, tmp_path: Path
) -> None:
    bus.share = tmp_path
    (tmp_path / "std_msgs" / "msg").mkdir(parents=True)
    described = tmp_path / "std_msgs" / "msg" / "String.json"
    recorded, other = STORE.hash_rihs01(STRING), "RIHS01_" + "5" * 64
    told = replace(channel("/x", STRING), metadata={"topic_type_hash": other})
    for one, installed, is_same in (
        (channel("/x", STRING), recorded, True),
        (channel("/x", STRING), other, False),
        (told, other, True),
        (told, recorded, False),
    ):
        hashes = [{"type_name": STRING, "hash_string": installed}]
        described.write_text(json.dumps({"type_hashes": hashes}))
        with Side(None).open() as publisher, warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            publisher.advertise(one)
            publisher.advertise(channel("/y", STRING))  # it is told once
        assert [str(warning.message).split(",")[0] for warning in said] == (
            [] if is_same else [f"/x: the installed type {STRING} differs from the recorded one"]
        )


def test_rclpy_tells_of_a_topic_whose_type_it_has_not(bus: fake_rclpy.Bus) -> None:
    peer = fake_rclpy.FakePeer(bus)
    bus.kinds["own/msg/Own"] = SimpleNamespace(type_name="own/msg/Own")
    peer.advertise("/own", "own/msg/Own")
    del bus.kinds["own/msg/Own"]
    with Side(None).open() as publisher:
        publisher.listen("/own", lambda _: None)
        until(lambda: bus.errors)
    assert "'own/msg/Own' is not installed" in bus.errors[0]


def test_rclpy_reads_a_big_endian_clock(bus: fake_rclpy.Bus) -> None:
    heard: list[int] = []
    payload = b"\0\0\0\0" + (5).to_bytes(4, "big") + (6).to_bytes(4, "big")
    with Side(None).open() as publisher:
        publisher.follow_clock(heard.append)
        fake_rclpy.FakePeer(bus).publish("/clock", "rosgraph_msgs/msg/Clock", payload)
        until(lambda: heard)
    assert heard == [5_000_000_006]


def test_rclpy_gets_the_whole_quality_of_service(bus: fake_rclpy.Bus) -> None:
    with Side(None).open(overrides={"/x": WHOLE}) as publisher:
        publisher.advertise(channel("/x", STRING))
        got = bus.publishers[0].qos
    for policy, value in asdict(WHOLE).items():
        found = getattr(got, policy)
        found = getattr(found, "nanoseconds", getattr(found, "name", found))
        assert found == (value.upper() if isinstance(value, str) else value), policy


def test_rclpy_passes_messages_on_as_they_are(bus: fake_rclpy.Bus) -> None:
    recorded = channel("/x", STRING)
    payload = message(STRING, 1, little_endian=False)[:-1]
    peer = fake_rclpy.FakePeer(bus)
    with Side(None).open() as publisher:
        publisher.advertise(recorded)
        peer.subscribe("/x", STRING)
        publisher.publish(recorded, payload, 0)
    assert peer.received("/x", 1) == [padded(payload)]


def test_rclpy_may_be_shut_down_from_outside(bus: fake_rclpy.Bus) -> None:
    with Side(None).open() as publisher:
        publisher.advertise(channel("/x", STRING))
        bus.publishers[0].node.context.try_shutdown()
        assert not publisher.is_alive


def test_services_may_be_missing_in_a_ros(
    bus: fake_rclpy.Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rosbag2_interfaces.srv", None)
    with Side(None).open() as publisher:
        publisher.serve(player_services(Controls()))
    assert not bus.services


def test_without_a_ros_that_is_told(bus: fake_rclpy.Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rclpy.context", None)
    with pytest.raises(RemoteError, match="source ROS 2"):
        Side(None).open()


INFINITE = (
    {"sec": 9223372036, "nsec": 854775807},
    {"sec": 2147483647, "nsec": 4294967295},
    {"sec": 2147483647, "nsec": 2147483647},
)


def profile(style: str, infinity: dict[str, int], **other: Any) -> str:
    """A recorded profile, as numbers before version 9 of the metadata, then as names."""
    policies: dict[str, Any] = {
        "history": 3 if style == "numbers" else "unknown",
        "depth": 0,
        "reliability": 2 if style == "numbers" else "best_effort",
        "durability": 2 if style == "numbers" else "volatile",
        "deadline": infinity,
        "lifespan": infinity,
        "liveliness": 1 if style == "numbers" else "automatic",
        "liveliness_lease_duration": infinity,
        "avoid_ros_namespace_conventions": "false",
        **other,
    }
    lines = []
    for key, value in policies.items():
        if isinstance(value, dict):
            lines += [f"  {key}:", *(f"    {part}: {number}" for part, number in value.items())]
        else:
            lines.append(f"  {key}: {value}")
    return "-" + "\n".join(lines)[1:]


WHOLE = Qos(
    history="keep_all",
    depth=4,
    reliability="best_effort",
    durability="transient_local",
    deadline=1_000_000_005,
    lifespan=7,
    liveliness="manual_by_topic",
    liveliness_lease_duration=3_000_000_000,
    avoid_ros_namespace_conventions=True,
)
"""Every policy differs from the default."""


def test_profiles_are_written_as_rosbag2_does() -> None:
    profiles = [replace(WHOLE, history="keep_last"), replace(WHOLE, depth=10), Qos()]
    text = qos_text(profiles)
    assert [*recorded_qos(text)] == profiles
    assert "sec: 9223372036\n    nsec: 854775807" in text
    assert "history: keep_last\n  depth: 4\n  reliability: best_effort" in text


@pytest.mark.parametrize("style", ["numbers", "names"])
@pytest.mark.parametrize("infinity", [*INFINITE, {"sec": 0, "nsec": 0}])
def test_recorded_profiles_are_read(style: str, infinity: dict[str, int]) -> None:
    assert recorded_qos(profile(style, infinity)) == (Qos(reliability="best_effort"),)


@pytest.mark.parametrize(
    "text",
    ["", "[]", "nonsense", "- 1", "{", "- reliability: [1]\n  depth: many\n  deadline: 3", "- {}"],
)
def test_profiles_that_say_nothing_are_the_default(text: str) -> None:
    assert offered_qos(channel("/x", STRING, qos=text), {}) == Qos()


@pytest.mark.parametrize(
    ("profiles", "expected"),
    [
        ([{}], Qos(reliability="best_effort")),
        ([{}, {"lifespan": {"sec": 1, "nsec": 0}}], Qos(reliability="best_effort")),
        ([{}, {"reliability": "reliable"}], Qos()),
        ([{}, {"durability": "transient_local"}], Qos()),
        ([{}, {"deadline": {"sec": 1, "nsec": 0}}], Qos()),
        ([{"history": "keep_last", "depth": 1}], Qos(reliability="best_effort")),
        ([{"history": "keep_all"}], Qos(reliability="best_effort")),
        (
            [{"history": "keep_last", "depth": 2, "durability": "transient_local"}],
            Qos(reliability="best_effort", durability="transient_local"),
        ),
        (
            [{"history": "keep_last", "depth": 12, "durability": "transient_local"}] * 2,
            Qos(reliability="best_effort", durability="transient_local", depth=24),
        ),
    ],
)
def test_the_player_offers_what_all_recorded_publishers_did(
    profiles: list[dict[str, Any]], expected: Qos
) -> None:
    text = "\n".join(profile("names", INFINITE[0], **other) for other in profiles)
    recorded = channel("/x", STRING, qos=text)
    assert offered_qos(recorded, {}) == expected
    assert offered_qos(recorded, {"/other": Qos(depth=7)}) == expected
    assert offered_qos(recorded, {"/x": Qos(depth=7)}) == Qos(depth=7)


def test_overrides_are_read(tmp_path: Path) -> None:
    path = tmp_path / "qos.yaml"
    path.write_text(
        "/test_topic:\n"
        "  history: keep_all\n  depth: 0\n  reliability: reliable\n"
        "  durability: transient_local\n  deadline:\n    # unspecified\n    sec: 0\n    nsec: 0\n"
        "  lifespan:\n    sec: 1\n    nsec: 5\n  liveliness: manual_by_topic\n"
        "  liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n"
        "  avoid_ros_namespace_conventions: true\n"
        "/other:\n  reliability: best_effort\n"
    )
    (tmp_path / "empty.yaml").write_text("# nothing yet\n")
    assert load_overrides(tmp_path / "empty.yaml") == {}
    assert load_overrides(path) == {
        "/test_topic": Qos(
            history="keep_all",
            depth=1,
            durability="transient_local",
            lifespan=1_000_000_005,
            liveliness="manual_by_topic",
            avoid_ros_namespace_conventions=True,
        ),
        "/other": Qos(reliability="best_effort"),
    }


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("- 1", "does not map topics"),
        ("{", "not valid YAML"),
        ("a: &a [*a]", "a: is not a QoS profile"),
        ("1: {depth: 1}", "1 is not a topic name"),
        ("/x: 1", "/x: is not a QoS profile"),
        ("/x: {depth: -1}", "depth: -1 is not an integer"),
        ("/x: {depth: true}", "depth: True is not an integer"),
        ("/x: {dept: 1}", "dept: is not a QoS policy. Use history"),
        ("/x: {reliability: mostly}", "'mostly' is not known. Use reliable, best_effort"),
        ("/x: {reliability: [1]}", "is not known"),
        ("/x: {deadline: {sec: 1}}", "deadline: is not a duration"),
        ("/x: {deadline: {sec: -1, nsec: 0}}", "integers, 0 or more"),
        ("/x: {deadline: {sec: 1.5, nsec: 0}}", "integers, 0 or more"),
        ("/x: {avoid_ros_namespace_conventions: 1}", "neither true nor false"),
        ("[" * 5000, "not valid YAML"),
        ("#" * (2**20 + 1), "too large"),
        (b"\x89PNG\r\n\x1a\n\0\0", "not valid YAML"),
        (None, "cannot be read"),
    ],
    ids=lambda value: str(value)[:20],
)
def test_bad_overrides_are_told(tmp_path: Path, text: str | bytes | None, says: str) -> None:
    path = tmp_path / "qos.yaml"
    if text is not None:
        path.write_bytes(text.encode() if isinstance(text, str) else text)
    with pytest.raises(OptionError) as told:
        load_overrides(path)
    assert says in str(told.value)
    assert str(path) in str(told.value)
