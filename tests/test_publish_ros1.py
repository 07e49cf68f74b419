"""Publishing in ROS 1: a real master, rospy's subscribers, and ROS 1's own recorder and player."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import socket
import struct
import sys
from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pytest
from rosbags.rosbag1 import Reader as BagReader
from rosbags.rosbag1 import Writer as BagWriter

from commands import program
from roscore import HERE, PLAY, Core, Process, python
from roscore import _core as _core
from roscore import roscore as roscore
from sources import SOURCES, scene, typestore
from waiting import WATCHDOG_S, until

STRING = "std_msgs/msg/String"
CAMERA = ("/cam/image_raw", "/cam/camera_info")


def digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def string(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


def write_strings(path: Path, messages: Iterable[tuple[str, str, str, int]]) -> Path:
    """A bag of strings: topic, text, caller and latching of each."""
    writer, connections = BagWriter(path), {}
    with writer:
        for i, (topic, text, caller, latching) in enumerate(messages):
            key = topic, caller
            if key not in connections:
                connections[key] = writer.add_connection(
                    topic, STRING, typestore=typestore("ros1"), callerid=caller, latching=latching
                )
            writer.write(connections[key], 10**18 + i * 10**8, string(text))
    return path


def payloads(path: Path) -> Mapping[str, list[bytes]]:
    """The messages of a bag by topic, read by rosbags."""
    found = defaultdict(list)
    with BagReader(path) as reader:
        for connection, _, data in reader.messages():
            found[connection.topic].append(bytes(data))
    return found


def driver(core: Core, path: Path, **options: Any) -> Process:
    process = core.script("ros1_driver.py", str(path), json.dumps(options))
    assert process.next() == "ready"
    return process


def connected(
    core: Core, path: Path, *subscriptions: Iterable[str], **options: Any
) -> tuple[Process, ...]:
    """A driver that has advertised all, and a subscriber of each of some topics."""
    published = driver(core, path, **options)
    published.ask("advertise")
    receivers = [core.receiver(*topics) for topics in subscriptions]
    assert published.ask("await_subscribers", len(receivers))
    return published, *receivers


def texts(told: Iterable[Mapping[str, Any]]) -> list[str]:
    return [bytes.fromhex(message["start"])[4:].decode() for message in told]


# ---------------------------------------------------------------- content


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A camera amid other topics, of several publishers."""
    return SOURCES["bag-none"](tmp_path, scene("bayer_rggb8"))[0]


def test_every_message_arrives_in_order(roscore: Core, recording: Path) -> None:
    sent = payloads(recording)
    with BagReader(recording) as reader:
        kinds = {c.topic: c for c in reader.connections}
    published, receiver = connected(roscore, recording, sent)
    published.ask("publish")
    told = receiver.take(sum(map(len, sent.values())))
    published.ask("close")
    assert receiver.silence() == []
    got = defaultdict(list)
    for message in told:
        got[message["topic"]].append(message["digest"])
        kind = kinds[message["topic"]]
        assert message["type"] == kind.msgtype.replace("/msg/", "/")
        assert (message["md5sum"], message["definition"]) == (kind.digest, kind.msgdef.data)
    assert got == {topic: list(map(digest, all_)) for topic, all_ in sent.items()}


def test_an_mcap_without_md5sums(roscore: Core, tmp_path: Path) -> None:
    from mcap.writer import Writer

    store = typestore("ros1")
    definition, md5sum = store.generate_msgdef("sensor_msgs/msg/Imu", ros_version=1)
    with (tmp_path / "imu.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros1", "test")
        kind = writer.register_schema("sensor_msgs/msg/Imu", "ros1msg", definition.encode())
        writer.add_message(writer.register_channel("imu", "ros1", kind), 1, b"anything", 1)
        writer.finish()
    published, receiver = connected(roscore, tmp_path / "imu.mcap", ["/imu"])
    published.ask("publish")
    told = receiver.next()
    assert (told["type"], told["md5sum"]) == ("sensor_msgs/Imu", md5sum)
    assert told["definition"] == definition
    assert bytes.fromhex(told["start"]) == b"anything"


def test_what_ros1_cannot_have(roscore: Core, tmp_path: Path) -> None:
    from mcap.writer import Writer

    text = typestore("ros1").generate_msgdef(STRING, ros_version=1)[0].encode()
    with (tmp_path / "odd.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start("", "test")
        kind = writer.register_schema("std_msgs/String", "ros1msg", text)
        unknown = writer.register_schema("my_msgs/Thing", "ros1msg", b"other_msgs/Unknown part\n")
        channels = {
            "/cdr": ("cdr", kind),
            "/a topic": ("ros1", kind),
            "/": ("ros1", kind),
            "/nothing": ("ros1", 0),
            "/unknown": ("ros1", unknown),
        }
        for topic, (encoding, schema) in channels.items():
            number = writer.register_channel(topic, encoding, schema)
            writer.add_message(number, 1, string("x"), 1)
        writer.finish()
    published = driver(roscore, tmp_path / "odd.mcap")
    for index, topic in enumerate(channels):
        kind_, sentence = published.ask("advertise_one", index)
        assert (kind_, sentence.split(":")[0]) == ("ConversionError", f"topic {topic}")
        assert "Leave the topic out with `exclude`" in sentence


def test_two_types_on_one_topic(roscore: Core, tmp_path: Path) -> None:
    store = typestore("ros1")
    with BagWriter(tmp_path / "two.bag") as writer:
        for msgtype in (STRING, "std_msgs/msg/Bool"):
            connection = writer.add_connection("/topic", msgtype, typestore=store)
            writer.write(connection, 1, b"\0" * 4)
    published = driver(roscore, tmp_path / "two.bag")
    kind, sentence = published.ask("advertise")
    assert kind == "ConversionError"
    assert "std_msgs/String (992ce8a1687cec8c8bd883ec73ca41d1)" in sentence
    assert "std_msgs/Bool (8b94c1b53db61fb6aed406028ad6332a)" in sentence


# ---------------------------------------------------------------- latching

LATCHED = [
    ("/tf_static", "left 1", "/left", 1),
    ("/tf_static", "right 1", "/right", 1),
    ("/tf_static", "passing", "/else", 0),
    ("/tf_static", "left 2", "/left", 1),
    ("/plain", "gone", "/left", 0),
]


def test_latched_as_rosbag_play_does(roscore: Core, tmp_path: Path) -> None:
    bag = write_strings(tmp_path / "latched.bag", LATCHED)
    published, early = connected(roscore, bag, ["/tf_static", "/plain"])
    published.ask("publish")
    told = early.take(5)
    assert [t for t in texts(told) if t != "gone"] == [text for _, text, _, _ in LATCHED[:4]]
    late = roscore.receiver("/tf_static", "/plain")
    ours = late.take(2)
    assert late.silence() == early.silence() == []
    assert {(m["topic"], m["latching"]) for m in told} == {("/tf_static", "1"), ("/plain", "0")}
    assert texts(ours) == ["right 1", "left 2"]
    published.ask("close")

    player = roscore.start(PLAY, "--quiet", "--keep-alive", str(bag))
    try:
        first = roscore.receiver("/tf_static", "/plain")
        seen: list[Any] = []
        while {*texts(ours)} - {*texts(seen)}:  # until all is published
            seen.append(first.next())
        last = roscore.receiver("/tf_static", "/plain")
        theirs = last.take(2)
        assert last.silence() == []
        assert sorted(texts(theirs)) == sorted(texts(ours))
        assert {m["latching"] for m in theirs} == {m["latching"] for m in ours}
        first.end()
    finally:
        player.terminate()
        player.wait(WATCHDOG_S)


# ---------------------------------------------------------------- clock, listening, remote control


def test_clock(roscore: Core, recording: Path) -> None:
    times = [0, 1, 1_700_000_000_123_456_789, 4_294_967_295_999_999_999]
    published, follower = driver(roscore, recording), driver(roscore, recording)
    published.ask("clock", 5)
    follower.tell("follow_clock")
    assert follower.next() is None
    receiver = roscore.receiver("/clock")
    followed: list[int] = []
    received: list[int] = []

    def take(follower_told: list[Any], receiver_told: list[Any]) -> None:
        followed.extend(time_ns for _, time_ns in follower_told)
        for told in receiver_told:
            seconds, nanoseconds = struct.unpack("<II", bytes.fromhex(told["start"]))
            received.append(seconds * 10**9 + nanoseconds)

    def are_connected() -> bool:
        published.ask("clock", 5)
        take(follower.silence(0.1), receiver.silence(0.1))
        return bool(followed and received)

    until(are_connected)
    published.ask("clock", *times)
    while followed[-1] != times[-1]:
        take([follower.next()], [])
    while received[-1] != times[-1]:
        take([], [told := receiver.next()])
    for found in (followed, received):
        assert [time_ns for time_ns in found if time_ns != 5] == times
    assert told["type"] == "rosgraph_msgs/Clock"
    assert told["md5sum"] == "a9c97c1d230cfc112e270351a944ee47"
    for wrong in (-1, 2**32 * 10**9):
        assert published.ask("clock", wrong)[0] == "ConversionError"


def test_listen(roscore: Core, recording: Path) -> None:
    published, listener = driver(roscore, recording), driver(roscore, recording)
    published.ask("advertise")
    listener.ask("listen", CAMERA[0])
    assert listener.ask("listen", "no topic")[0] == "OptionError"
    index = published.ask("topics").index(CAMERA[0])
    until(lambda: published.ask("subscribers")[index] == 1)
    published.ask("publish")
    count = len(payloads(recording)[CAMERA[0]])
    heard = listener.take(count)
    assert [one[:2] for one in heard] == [["heard", CAMERA[0]]] * count
    expected = [
        int(seconds) * 10**9 + nanoseconds
        for _, seconds, nanoseconds in (
            struct.unpack_from("<III", payload) for payload in payloads(recording)[CAMERA[0]]
        )
    ]
    assert [stamp for _, _, stamp in heard] == expected
    assert listener.silence() == []


def test_pause_service(roscore: Core, recording: Path) -> None:
    published = driver(roscore, recording)
    published.ask("serve")
    service = f"{published.ask('node')}/pause_playback"
    assert roscore.run("rosservice", "type", service)[1].strip() == "std_srvs/SetBool"
    for wanted, success, told in (
        ("true", "True", "Playback is now paused"),
        ("true", "False", "Bag is already paused."),
        ("false", "True", "Playback is now resumed"),
        ("false", "False", "Bag is already running."),
    ):
        code, output, errors = roscore.run("rosservice", "call", service, wanted)
        assert (code, errors) == (0, "")
        assert re.findall(r"success: (\w+)\nmessage: \"(.*)\"", output) == [(success, told)]
        assert published.ask("is_paused") == (wanted == "true")


def test_use_sim_time(roscore: Core, recording: Path) -> None:
    published = driver(roscore, recording)
    assert published.ask("wants_clock") is False
    assert roscore.run("rosparam", "set", "/use_sim_time", "true")[0] == 0
    try:
        assert published.ask("wants_clock") is True
        # a node that begins now does not wait for a time that nobody tells
        later = driver(roscore, recording)
        later.ask("advertise")
        receiver = roscore.receiver(*CAMERA)
        until(lambda: sum(later.ask("subscribers")) >= 2)
        later.ask("publish")
        assert len(receiver.take(16)) == 16
        later.ask("close")
    finally:
        roscore.run("rosparam", "delete", "/use_sim_time")


# ---------------------------------------------------------------- slow and gone


def test_slow_subscriber_holds_up_nobody(roscore: Core, tmp_path: Path) -> None:
    bag = write_strings(tmp_path / "long.bag", [("/a", "x" * 10_000_000, "/n", 0)] * 3)
    published, slow, quick = connected(roscore, bag, ["/a"], ["/a"])
    slow.stop()
    for _ in range(10):
        published.ask("publish")
        quick.take(3)
    # what waits is bounded by bytes: 300 MB were sent, and 128 MiB and what the system holds wait
    assert 10 <= published.ask("dropped") <= 18
    published.ask("close")
    assert published.popen.wait(WATCHDOG_S) == 0
    slow.resume()


def test_short_queue_drops_the_oldest(roscore: Core, tmp_path: Path) -> None:
    messages = [("/a", f"{i:03}" + "x" * 1_000_000, "/n", 0) for i in range(30)]
    bag = write_strings(tmp_path / "many.bag", messages)
    published, receiver = connected(roscore, bag, ["/a"], queue=3)
    receiver.stop()
    published.ask("publish")
    dropped = published.ask("dropped")
    receiver.resume()
    got = [text[:3] for text in texts(receiver.take(30 - dropped))]
    assert dropped >= 15
    assert receiver.silence() == []
    assert got[-3:] == ["027", "028", "029"]
    assert got == sorted(got)


def test_player_that_waits_does_not_wait_for_ever(roscore: Core, tmp_path: Path) -> None:
    messages = [("/a", "x" * 1_000_000, "/n", 0)] * 40
    bag = write_strings(tmp_path / "many.bag", messages)
    published, receiver = connected(roscore, bag, ["/a"], queue=2, immediate=True)
    receiver.stop()
    assert published.ask("publish") == 1  # and no other one waited
    receiver.resume()
    receiver.take(40 - published.ask("dropped"))
    assert receiver.silence() == []
    published.ask("publish")  # it has caught up, and is waited for again
    receiver.take(40)


def test_subscriber_that_goes(roscore: Core, recording: Path) -> None:
    published = driver(roscore, recording)
    published.ask("advertise")
    stays, goes = roscore.receiver(*CAMERA), roscore.receiver(*CAMERA)
    index = published.ask("topics").index(CAMERA[0])
    until(lambda: published.ask("subscribers")[index] == 2)
    published.ask("publish")
    goes.end()
    stays.take(16)
    for _ in range(4):
        published.ask("publish")
        stays.take(16)
    until(lambda: published.ask("subscribers")[index] == 1)


@pytest.mark.skipif(not shutil.which("ss"), reason="needs iproute2")
def test_many_come_at_once(roscore: Core, tmp_path: Path) -> None:
    """With rospy's own backlog of 5, some of them would come after 1, 3 or 7 seconds."""
    topics = [f"/topic_{i}" for i in range(40)]
    bag = write_strings(tmp_path / "wide.bag", [(topic, topic, "/n", 0) for topic in topics])
    receivers = [roscore.receiver(*topics) for _ in range(2)]
    published = driver(roscore, bag)
    published.ask("advertise")
    published.ask("await_subscribers", 2)
    published.ask("publish")
    assert [sorted(texts(receiver.take(40))) for receiver in receivers] == [sorted(topics)] * 2
    code, listed, _ = roscore.run("ss", "-Hltnp")
    assert code == 0
    own = [line.split() for line in listed.splitlines() if f"pid={published.popen.pid}," in line]
    assert len(own) == 2  # XML-RPC and TCPROS
    assert min(int(columns[2]) for columns in own) >= 128


def test_recorded_rosout(roscore: Core, tmp_path: Path) -> None:
    """Topics that a node of rospy has, too, are those of the recording."""
    bag = write_strings(tmp_path / "out.bag", [(f"/{t}", t, "/n", 0) for t in ("rosout", "clock")])
    published, receiver = connected(roscore, bag, ["/rosout", "/clock"])
    published.ask("publish")
    told = receiver.take(2)
    assert {(m["type"], t) for m, t in zip(told, texts(told), strict=True)} == {
        ("std_msgs/String", "rosout"),
        ("std_msgs/String", "clock"),
    }
    assert published.ask("clock", 5)[0] == "ConversionError"


# ---------------------------------------------------------------- no ROS


def test_no_master(roscore: Core, recording: Path) -> None:
    script = python(str(HERE / "ros1_driver.py"), str(recording), "{}")
    with socket.socket() as silent:  # takes connections, and says nothing
        silent.bind(("127.0.0.1", 0))
        silent.listen(8)
        mute = f"http://127.0.0.1:{silent.getsockname()[1]}"
        for uri in ("http://127.0.0.1:9", mute, "nonsense"):
            env = {**roscore.environment, "ROS_MASTER_URI": uri, "PYTHONPATH": str(HERE)}
            done = program(*script, env=env)
            kind, sentence = json.loads(done.out)
            if uri == "nonsense":
                assert kind == "OptionError"
                continue
            assert kind == "RemoteError"
            assert sentence.startswith(f"{uri}: no ROS master answers")
            assert "ROS_MASTER_URI" in sentence


def test_no_rospy() -> None:
    code = (
        "import sys; sys.modules['rospy'] = None\n"
        "from mp4ds.plugins.ros.node import NodeOptions, open_node\n"
        "from mp4ds.errors import RemoteError\n"
        "try: open_node('ros1', NodeOptions(), 'player')\n"
        "except RemoteError as error: print(error)\n"
    )
    told = program("-c", code).out
    assert told.startswith("ros1: No module named '")
    assert "python3-rospy" in told
    assert "--system-site-packages" in told


def test_leaves_the_process_alone(roscore: Core) -> None:
    program = (
        "import logging, os, signal, sys, threading\n"
        "sys.path.append('/usr/lib/python3/dist-packages')\n"
        "logging.basicConfig(level=logging.WARNING)\n"
        "def state():\n"
        "    root = logging.getLogger()\n"
        "    return (root.handlers[:], root.level, root.disabled, logging.getLoggerClass(),\n"
        "            {k: v for k, v in os.environ.items() if k != 'ROS_LOG_FILENAME'},\n"
        "            signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM))\n"
        "before = state()\n"
        "from mp4ds.errors import RemoteError\n"
        "from mp4ds.plugins.ros.node import NodeOptions, open_node\n"
        "with open_node('ros1', NodeOptions(), 'player') as publisher:\n"
        "    during = state()\n"
        "    try: open_node('ros1', NodeOptions(), 'player')\n"
        "    except RemoteError as error: print(error)\n"
        "print(before == during == state())\n"
    )
    code, output, errors = roscore.run(sys.executable, "-c", program)
    assert (code, errors) == (0, "")
    told, is_same = output.splitlines()
    assert "a ROS node only once" in told
    assert is_same == "True"
