"""`mp4ds record` in ROS 2: over DDS from a real participant, and by rclpy as the fake has it."""

from __future__ import annotations

import base64
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from rosbags.convert.converter import default_message
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import mp4ds
from mp4ds.bags.formats import open_reader
from mp4ds.bags.rosbag2_metadata import read_bag_info
from mp4ds.errors import OptionError
from mp4ds.plugins.recording.options import RecordOptions, Wanted
from mp4ds.plugins.recording.receiving import Source
from mp4ds.plugins.recording.record import RecordProgress, open_recorder, recorder_services
from mp4ds.plugins.ros.node import Node, NodeNames, open_node
from mp4ds.plugins.ros.ros2 import (
    Qos,
    asked_qos,
    installed_definition,
    is_hidden,
    recorded_qos,
    standard_definition,
)
from mp4ds.records import HASH_KEY, QOS_KEY, Channel, Message, Schema
from ros2_sides import SIDES, STORE, Controls, Side, channel, message, padded
from ros2_sides import side as side
from scenes import scene
from waiting import WATCHDOG_S, until

pytest.importorskip("cyclonedds")

from mp4ds.plugins.ros.dds_node import DdsNode
from mp4ds.plugins.ros.dds_types import ros_type

STRING, IMAGE, TF = "std_msgs/msg/String", "sensor_msgs/msg/Image", "tf2_msgs/msg/TFMessage"
LATCHED = "- {history: 1, depth: 5, reliability: 1, durability: 1}"
BEST_EFFORT = "- {history: 1, depth: 5, reliability: 2, durability: 2}"


def receiving(
    take: Callable[[Message], None], *topics: str, node: Node | None = None, **options: Any
) -> Source:
    """A recorder's source, which is not started; without topics, of all there are."""
    chosen = RecordOptions(all=not topics, **options)
    node = node or open_node("ros2", chosen, "rosbag2_recorder")
    return Source(node, chosen, Wanted(topics, chosen), take)


class Heard:
    """What a source receives, by topic."""

    def __init__(self) -> None:
        self.payloads: dict[str, list[bytes]] = defaultdict(list)
        self.channels: dict[str, Channel] = {}
        self.times: list[tuple[int, int]] = []

    def take(self, message: Message) -> None:
        self.channels[message.channel.topic] = message.channel
        self.times.append((message.publish_time, message.log_time))
        self.payloads[message.channel.topic].append(bytes(message.data))


@contextmanager
def recording(
    side: Side, *channels: Channel, topics: Sequence[str] = (), **options: Any
) -> Iterator[tuple[Node, Source, Heard]]:
    """A node that has advertised channels, a source that hears of it, and what it receives."""
    heard = Heard()
    with side.open() as publisher:
        for one in channels:
            publisher.advertise(one)
        source = receiving(heard.take, *topics, **options)
        source.start()
        yield publisher, source, heard
        source.close()


def test_every_message_is_received(side: Side) -> None:
    """Topics that appear later too, each by the quality of service of its publishers."""
    strings = channel("/robot/name", STRING)
    lossy = channel("/robot/tf", TF, qos=BEST_EFFORT)
    latched = channel("/robot/map", STRING, qos=LATCHED)
    sent = {one.topic: [message(one.type_name, n) for n in range(9)] for one in (strings, lossy)}
    heard = Heard()
    source = receiving(heard.take)
    with side.open() as publisher:
        publisher.advertise(latched)
        publisher.publish(latched, message(STRING, 77), 0)
        source.start()
        for one in (strings, lossy):
            publisher.advertise(one)
            until(lambda one=one: publisher.subscribers(one) == 1)
            for payload in sent[one.topic]:
                publisher.publish(one, payload, 0)
                until(lambda one=one, payload=payload: ends_with(heard, one.topic, payload))
        until(lambda: heard.payloads["/robot/map"])
        source.close()
    assert [*map(padded, heard.payloads["/robot/map"])] == [padded(message(STRING, 77))]
    for topic, payloads in sent.items():
        assert [*map(padded, heard.payloads[topic])] == [*map(padded, payloads)]
    assert all(0 < publish <= log <= time.time_ns() for publish, log in heard.times)
    found = heard.channels["/robot/map"]
    assert found.schema == Schema(STRING, "ros2msg", b"string data\n")
    assert found.metadata[HASH_KEY] == STORE.hash_rihs01(STRING)
    (told,) = recorded_qos(found.metadata[QOS_KEY])
    assert (told.is_reliable, told.is_latched) == (True, True)
    (told,) = recorded_qos(heard.channels["/robot/tf"].metadata[QOS_KEY])
    assert (told.is_reliable, told.is_latched) == (False, False)
    assert not source.lost
    assert not source.warnings


def ends_with(heard: Heard, topic: str, payload: bytes) -> bool:
    return bool(heard.payloads[topic]) and padded(heard.payloads[topic][-1]) == padded(payload)


def test_a_recording_is_a_rosbag2(
    side: Side, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its metadata.yaml has distribution, custom data and silent topics, as of `ros2 bag`."""
    monkeypatch.setenv("ROS_DISTRO", "jazzy")
    camera = channel("/cam/image_raw", IMAGE)
    silent = channel("/robot/silent", IMAGE, qos=BEST_EFFORT)
    drive = scene("mono8", frames=30, with_info=False).messages
    images = [one.payload("cdr") for one in drive if one.topic == "/cam/image_raw"]
    options = RecordOptions(to="ros2", all=True, custom_data=["operator=kim", "note=a=b"])
    with side.open() as publisher:
        for one in (camera, silent):
            publisher.advertise(one)
        with open_recorder((), tmp_path / "live", options) as recorder:

            def publish() -> None:
                until(lambda: publisher.subscribers(camera) == publisher.subscribers(silent) == 1)
                for payload in images:
                    publisher.publish(camera, payload, 0)
                until(lambda: recorder.received == len(images))
                recorder.stop()

            threading.Thread(target=publish).start()
            (made,) = recorder.run().datasets
    counts = {"/cam/image_raw": 30, "/robot/silent": 0}
    assert {item.topic: item.messages for item in made.topics} == counts
    assert {item.topic: item.frames for item in made.topics} == counts
    assert mp4ds.validate(tmp_path / "live", deep=True) == []
    mp4ds.unpack(tmp_path / "live", None, tmp_path / "again")
    with open_reader(tmp_path / "again") as reader:
        assert reader.format == "rosbag2"
        found = [bytes(one.data) for one in reader.records() if isinstance(one, Message)]
    assert [*map(padded, found)] == [*map(padded, images)]
    info = read_bag_info(tmp_path / "again" / "metadata.yaml")
    assert (info.ros_distro, info.custom_data) == ("jazzy", {"operator": "kim", "note": "a=b"})
    assert {one.name: one.count for one in info.topics} == counts
    assert {(one.type_name, one.type_hash) for one in info.topics} == {
        (IMAGE, STORE.hash_rihs01(IMAGE))
    }


def test_ros_renames_topics(side: Side) -> None:
    """And /clock, and its own services; the recording has the names that were asked for."""
    names = NodeNames("bag", "/robot", (("name", "/front/name"), ("/clock", "/sim")))
    found, clock = channel("/front/name", STRING), 1_700_000_000 * 10**9
    heard, controls = Heard(), Controls()
    with side.open(names=names) as publisher:
        publisher.advertise(found)
        publisher.clock(clock)
        node = side.open("rosbag2_recorder", names=names)
        node.serve(recorder_services(controls))
        source = receiving(heard.take, "name", node=node, use_sim_time=True, names=names)
        source.start()

        def arrives() -> bool:
            publisher.clock(clock)
            publisher.publish(found, message(STRING, 1), 0)
            return any(log == clock for _, log in heard.times)

        until(arrives)

        def call(name: str) -> dict[str, Any]:
            kind = "".join(map(str.capitalize, name.split("_")))
            return side.peer.call(f"/robot/bag/{name}", kind, {})

        assert call("is_paused") == {"paused": True}
        assert [*map(call, ("pause", "resume", "split_bagfile", "stop"))] == [{}] * 4
        assert call("snapshot") == {"success": True}
        source.close()
    assert controls.asked == [("pause",), ("resume",), ("split",), ("stop",), ("snapshot",)]
    assert {*heard.payloads} == {*source.topics} == {"/robot/name"}
    assert ("bag" in node.address) != node.address.endswith("(Cyclone DDS)")


def test_looking_back(side: Side, tmp_path: Path) -> None:
    """Saved by a service while nothing comes, and by a message; each with what is latched."""
    strings, trigger = channel("/robot/name", STRING), channel("/robot/go", STRING)
    latched = channel("/robot/map", STRING, qos=LATCHED)
    options = RecordOptions(
        to="ros2", keep_last=600, all=True, trigger=["/robot/go:data==message 2"]
    )
    saved: list[Path] = []
    replies: list[Any] = []
    with side.open() as publisher:
        for one in (strings, trigger, latched):
            publisher.advertise(one)
        publisher.publish(latched, message(STRING, 77), 0)

        def watch(state: RecordProgress) -> None:
            saved[:] = [path for path, is_complete in state.saved.items() if is_complete]

        with open_recorder((), tmp_path / "live", options, progress=watch) as recorder:

            def publish() -> None:
                until(lambda: publisher.subscribers(strings) == publisher.subscribers(latched) == 1)
                until(lambda: publisher.subscribers(trigger) == 2)
                publisher.publish(strings, message(STRING, 1), 0)
                until(lambda: recorder.received == 2)
                name = "/rosbag2_recorder/snapshot"
                replies.append(side.peer.call(name, "Snapshot", {}))
                until(lambda: len(saved) == 1)
                publisher.publish(trigger, message(STRING, 2), 0)
                until(lambda: len(saved) == 2)
                recorder.stop()

            threading.Thread(target=publish).start()
            made = recorder.run().datasets
    assert replies == [{"success": True}]
    assert {path.name for path in tmp_path.iterdir()} == {one.dataset.name for one in made}
    counts = [{item.topic: item.messages for item in one.topics} for one in made]
    assert counts[0] == {"/robot/name": 1, "/robot/map": 1, "/robot/go": 0}
    assert {**counts[1], "/robot/go": 0} == counts[0]  # whether the trigger is in it is chance


def test_nothing_is_recorded_before_the_clock(side: Side) -> None:
    """As by `ros2 bag record`; what is latched still comes, with the clock's time."""
    plain, latched = channel("/robot/name", STRING), channel("/robot/map", STRING, qos=LATCHED)
    heard, clock = Heard(), 1_700_000_000 * 10**9
    with side.open() as publisher:
        for one in (plain, latched):
            publisher.advertise(one)
        publisher.publish(latched, message(STRING, 77), 0)
        source = receiving(heard.take, "/robot/*", use_sim_time=True, polling_interval=10.0)
        source.start()
        assert source.waiting_for == "/clock"
        publisher.publish(plain, message(STRING, 1), 0)
        publisher.clock(0)  # as simulators do at first: no time yet
        publisher.publish(plain, message(STRING, 2), 0)
        assert publisher.subscribers(plain) == 0

        def arrives() -> bool:
            publisher.clock(clock)
            return bool(heard.payloads["/robot/map"]) and publisher.subscribers(plain) == 1

        until(arrives)
        assert source.waiting_for == ""
        publisher.publish(plain, message(STRING, 3), 0)
        until(lambda: heard.payloads["/robot/name"])
        source.close()
    assert [*map(padded, heard.payloads["/robot/map"])] == [padded(message(STRING, 77))]
    assert [*map(padded, heard.payloads["/robot/name"])] == [padded(message(STRING, 3))]
    assert {log for _, log in heard.times} == {clock}


def test_the_clock_is_recorded_by_itself(side: Side) -> None:
    clock = 1_700_000_000 * 10**9
    options = {"use_sim_time": True, "polling_interval": 10.0}
    with recording(side, **options) as (publisher, _, heard):

        def arrives() -> bool:
            publisher.clock(clock + len(heard.times))
            return len(heard.payloads["/clock"]) > 3

        until(arrives)
    assert {log for _, log in heard.times} <= {*range(clock, clock + 5)}


def test_a_message_that_cannot_be_taken(side: Side) -> None:
    """It is counted as lost, and told; the next ones are taken."""
    recorded, taken = channel("/robot/name", STRING), []

    def take(message: Message) -> None:
        if not taken:
            taken.append(None)
            raise ValueError("no")
        taken.append(message)

    source = receiving(take)
    with side.open() as publisher:
        publisher.advertise(recorded)
        source.start()
        until(lambda: publisher.subscribers(recorded) == 1)
        for number in range(3):
            publisher.publish(recorded, message(STRING, number), 0)
        until(lambda: len(taken) == 3)
        source.close()
    assert source.lost == {"/robot/name": 1}
    assert [*source.warnings] == ["/robot/name: a message could not be recorded: ValueError('no')"]


def test_a_recorder_that_hangs_for_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    """What comes over DDS meanwhile waits, and is not overwritten."""
    recorded, taken, goes_on = channel("/robot/name", STRING), [], threading.Event()
    sent = [padded(message(STRING, number)) for number in range(1000)]

    def take(message: Message) -> None:
        goes_on.wait(WATCHDOG_S)
        taken.append(bytes(message.data))

    with SIDES["dds"](monkeypatch) as side, side.open() as publisher:
        publisher.advertise(recorded)
        source = receiving(take)
        source.start()
        until(lambda: publisher.subscribers(recorded) == 1)
        for payload in sent:
            publisher.publish(recorded, payload, 0)
        assert publisher._channels[id(recorded)][1].wait(WATCHDOG_S)  # it is in its queue
        goes_on.set()
        until(lambda: len(taken) == len(sent))
        source.close()
    assert taken == sent
    assert not source.lost


EVENT = "std_srvs/srv/Trigger_Event"
NAME, HEARD = "/robot/name", {"topics": ["/robot/*"], "ignore_leaf": True}
CHOSEN: dict[str, tuple[list[Channel], dict[str, Any]]] = {
    "one of several types": ([channel(NAME, STRING), channel(NAME, "std_msgs/msg/Header")], {}),
    "not hidden": ([channel(NAME, STRING), channel("/robot/_internal", STRING)], {}),
    "heard by others": ([channel(NAME, STRING), channel("/robot/leaf", STRING)], HEARD),
    "events": ([Channel(1, "/arm/_service_event", "cdr", Schema(EVENT, "", b""), {})], {}),
}
"""Topics there are, and options; of all only the first is recorded."""


@pytest.mark.parametrize("case", CHOSEN)
def test_topics_that_are_recorded(side: Side, case: str) -> None:
    channels, options = CHOSEN[case]
    (topic, *_) = (one.topic for one in channels)
    others = 0
    if "ignore_leaf" in options:
        side.peer.subscribe(topic, STRING)
        others = 1
    with recording(side, *channels, **options) as (publisher, source, _):
        there = [one for one in channels if one.topic == topic]
        until(lambda: sum(map(publisher.subscribers, there)) == 1 + others)
    assert [*source.topics] == [topic]
    said = [*source.warnings]
    if case == "one of several types":
        assert said.pop().startswith("/robot/name: has several types: only std_msgs/msg/")
    if case == "events":  # nobody defines them here, and they are recorded nevertheless
        said = []
    assert said == []


def test_topics_that_nobody_publishes_yet(monkeypatch: pytest.MonkeyPatch) -> None:
    plain, heard = channel("/robot/name", STRING), Heard()
    with SIDES["rclpy"](monkeypatch) as side:
        side.peer.subscribe("/robot/name", STRING)
        source = receiving(heard.take, unpublished=True, discover=False)
        source.start()
        with side.open() as publisher:
            publisher.advertise(plain)
            assert publisher.subscribers(plain) == 2
            publisher.publish(plain, message(STRING, 1), 0)
            until(lambda: heard.payloads["/robot/name"])
        source.close()
    assert [*map(padded, heard.payloads["/robot/name"])] == [padded(message(STRING, 1))]
    with pytest.raises(OptionError, match="source a ROS 2"):
        DdsNode(RecordOptions(unpublished=True), "recorder")


def test_a_type_that_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """By rclpy it is left out, with a warning."""
    with SIDES["rclpy"](monkeypatch) as side, side.open() as publisher:
        publisher.advertise(channel("/robot/name", STRING))
        del side.peer._bus.kinds[STRING]
        source = receiving(Heard().take)
        source.start()
        source.close()
    (warning,) = source.warnings
    assert "'std_msgs/msg/String' is not installed" in warning


def test_a_definition_that_is_announced(monkeypatch: pytest.MonkeyPatch) -> None:
    """Over DDS types tell their fields, which their hash proves."""
    text = (
        "std_msgs/Header header\nmy_msgs/Part[<=3] parts\nfloat64[3] point\nstring<=5 name\n"
        "uint8[] data\nbool is_on\n\n"
        + "=" * 80
        + "\nMSG: my_msgs/Part\nint16 number\nbyte flags\n"
    )
    schema = Schema("my_msgs/msg/Whole", "ros2msg", text.encode())
    recorded = Channel(1, "/robot/whole", "cdr", schema, {})
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(text, "my_msgs/msg/Whole"))
    with SIDES["dds"](monkeypatch) as side, recording(side, recorded) as (publisher, _, heard):
        until(lambda: publisher.subscribers(recorded) == 1)
        value = default_message(store, "my_msgs/msg/Whole")
        payload = bytes(store.serialize_cdr(value, "my_msgs/msg/Whole"))
        publisher.publish(recorded, payload, 0)
        until(lambda: heard.payloads["/robot/whole"])
    found = heard.channels["/robot/whole"]
    assert found.metadata[HASH_KEY] == store.hash_rihs01("my_msgs/msg/Whole")
    assert found.schema
    again = get_typestore(Stores.ROS2_JAZZY)
    again.register(get_types_from_msg(found.schema.data.decode(), "my_msgs/msg/Whole"))
    assert again.hash_rihs01("my_msgs/msg/Whole") == store.hash_rihs01("my_msgs/msg/Whole")


CUSTOM = "my_msgs/msg/Part"


@pytest.mark.parametrize("described", ["proven", "wrong", "unknown", "nobody"])
def test_a_definition_that_a_node_describes(
    described: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Over DDS, the node that publishes is asked; its answer is proven by the type's hash."""
    texts = {
        CUSTOM: "# of a robot\nstd_msgs/Header header\nint16 number\n",
        "std_msgs/msg/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
        "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec\n",
    }
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(texts[CUSTOM], CUSTOM))
    type_hash = store.hash_rihs01(CUSTOM)
    payload = bytes(store.serialize_cdr(default_message(store, CUSTOM), CUSTOM))
    typename, heard = "my_msgs.msg.dds_.Part_", Heard()
    with SIDES["dds"](monkeypatch) as side:
        if described == "wrong":
            texts[CUSTOM] = texts[CUSTOM].replace("int16", "int32")
        if described != "nobody":
            side.peer.ask("describe", "robot/other", {})
            side.peer.ask("describe", "robot/part", {} if described == "unknown" else texts)
        source = receiving(heard.take, "/robot/part")
        source.start()

        def arrives() -> bool:
            message = base64.b64encode(payload).decode()
            side.peer.ask("publish_opaque", "rt/robot/part", typename, type_hash, message)
            return bool(heard.payloads["/robot/part"])

        until(arrives)
        source.close()
    assert padded(heard.payloads["/robot/part"][0]) == padded(payload)
    found = heard.channels["/robot/part"]
    assert found.metadata[HASH_KEY] == type_hash
    assert found.schema
    if described != "proven":
        assert (found.schema.encoding, found.schema.data) == ("", b"")
        assert [*source.warnings] == [
            f"/robot/part: recorded without the definition of {CUSTOM}, which was not found"
        ]
        return
    main, *parts = found.schema.data.decode().split("=" * 80)
    assert main.startswith("# of a robot\n")
    assert len(parts) == 2
    again = get_typestore(Stores.ROS2_JAZZY)
    again.register(get_types_from_msg(found.schema.data.decode(), CUSTOM))
    assert again.hash_rihs01(CUSTOM) == type_hash


# ---------------------------------------------------------------- without a network


def test_qos_that_hears_all_publishers() -> None:
    reliable, lossy = Qos(), Qos(reliability="best_effort")
    latched = Qos(durability="transient_local")
    for offered, is_reliable, is_latched in (
        ([reliable, reliable], True, False),
        ([reliable, lossy], False, False),
        ([latched, latched], True, True),
        ([latched, reliable], True, False),
    ):
        asked = asked_qos(offered)
        assert (asked.is_reliable, asked.is_latched, asked.depth) == (is_reliable, is_latched, 300)


def test_names() -> None:
    assert is_hidden("/a/_b/c")
    assert not is_hidden("/a/b_c")
    assert ros_type("std_msgs::msg::dds_::String_") == STRING
    assert ros_type("std_msgs.msg.dds_.String_") == STRING
    assert ros_type("Shape::Type") == ""


def test_definitions_that_are_installed(tmp_path: Path) -> None:
    for name, text in {
        "a_msgs/msg/A": "# a comment b_msgs/Z z\nint32 X=3\nB b\nb_msgs/C[] c # d_msgs/D d\n",
        "a_msgs/msg/B": "string<=4 name 'x'\nfloat32[2] y\n",
        "b_msgs/msg/C": "a_msgs/B b\nwstring text\n",
    }.items():
        path = tmp_path / f"{name}.msg"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    found = installed_definition("a_msgs/msg/A", [tmp_path / "none", tmp_path])
    separator = "\n" + "=" * 80 + "\n"
    main, *parts = found.split(separator)
    assert main.startswith("# a comment")
    assert [part.partition("\n")[0] for part in parts] == ["MSG: a_msgs/B", "MSG: b_msgs/C"]
    assert installed_definition("a_msgs/msg/Gone", [tmp_path]) == ""
    assert standard_definition(STRING, "RIHS01_" + 64 * "0") == ""
    assert standard_definition(STRING, STORE.hash_rihs01(STRING)) == "string data\n"
