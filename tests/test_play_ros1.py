"""`mp4ds play --ros1` into a real master, beside ROS 1's own player of the same recording."""

from __future__ import annotations

import hashlib
import re
import signal
import struct
import subprocess
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from rosbags.rosbag1 import Reader as BagReader

import mp4ds
from conftest import real
from player_scenes import make_drive
from roscore import PLAY, RECORD, Core, Process, python
from roscore import _core as _core
from roscore import roscore as roscore
from waiting import WATCHDOG_S, until

NS = 10**9
Digests = Mapping[str, Sequence[str]]


def mp4ds_play(dataset: Path, *options: str) -> list[str]:
    return python("mp4ds", "play", str(dataset), "--ros1", *options)


def packed(bag: Path, folder: Path) -> Path:
    mp4ds.pack([bag], folder / bag.stem)
    return folder / bag.stem


def digests(bag: Path) -> Digests:
    """Digests of the messages of a bag by topic, read by rosbags."""
    found = defaultdict(list)
    with BagReader(bag) as reader:
        for connection, _, data in reader.messages():
            found["/" + connection.topic.lstrip("/")].append(hashlib.sha256(data).hexdigest())
    return dict(found)


def by_topic(told: Iterable[Mapping[str, Any]]) -> Digests:
    found = defaultdict(list)
    for message in told:
        found[message["topic"]].append(message["digest"])
    return dict(found)


def published(core: Core, command: list[str], topics: Iterable[str], count: int) -> list[Digests]:
    """What rospy and ROS 1's recorder get from a player."""
    receiver = core.receiver(*topics)
    bag = core.folder / f"{time.monotonic_ns()}.bag"
    recorder = core.start(RECORD, "-O", str(bag), *topics)
    try:
        until(lambda: any("record" in node for node in core.nodes()))
        _, errors = core.play(command, topics, 2)
        assert all(line.startswith("mp4ds: ") for line in errors.splitlines())
        told = receiver.take(count)
        assert receiver.silence() == []
    finally:
        recorder.send_signal(signal.SIGINT)
        recorder.wait(WATCHDOG_S)
        receiver.end()
    return [by_topic(told), digests(bag)]


@pytest.mark.parametrize(
    ("name", "pace"),
    [
        ("roboto_tiny_dvs", "--immediate"),
        pytest.param("librealsense_depth_color", "--immediate", marks=pytest.mark.slow),
        pytest.param("ecto_ros_camera_info", "--immediate", marks=pytest.mark.slow),
        pytest.param("youliangtan_object_pose", "--rate=6", marks=pytest.mark.slow),
    ],
)
def test_as_rosbag_play(roscore: Core, tmp_path: Path, name: str, pace: str) -> None:
    bag = real(f"bags/{name}.bag")
    dataset = packed(bag, tmp_path)
    # names that ROS 1 cannot have end rosbag play, and every node has a /rosout of its own
    is_played = re.compile(r"/(?!rosout$)[\w/]+").fullmatch
    recorded = {topic: sent for topic, sent in digests(bag).items() if is_played(topic)}
    count = sum(map(len, recorded.values()))
    ours = mp4ds_play(dataset, pace)
    ours += [word for topic in recorded for word in ("--topics", topic)]
    # with its queue of 100, rosbag play loses messages where a subscriber is slow
    theirs = [PLAY, "--quiet", "--queue", "100000"]
    theirs += [pace if pace != "--immediate" else "--rate=1000"]  # it does not pause otherwise
    theirs += ["--bags", str(bag), "--topics", *recorded]
    for command in (ours, theirs):
        by_rospy, by_recorder = published(roscore, command, recorded, count)
        assert by_rospy == recorded
        assert by_recorder == recorded


# ---------------------------------------------------------------- clocks


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """A second of a camera at 20 Hz, packed; the bag lies beside it."""
    return packed(make_drive(tmp_path / "drive.bag"), tmp_path)


CAMERA = "/camera/image_raw"


def stamps(told: Iterable[Mapping[str, Any]]) -> list[int]:
    """Stamps of messages that begin with a header, nanoseconds."""
    found = (struct.unpack_from("<III", bytes.fromhex(m["start"])) for m in told)
    return [seconds * NS + nanoseconds for _, seconds, nanoseconds in found]


@pytest.mark.parametrize("leader", ["rosbag", pytest.param("mp4ds", marks=pytest.mark.slow)])
def test_two_players_in_step(roscore: Core, tmp_path: Path, leader: str) -> None:
    """The leader goes on for longer: rosbag play's last /clock is before its last message."""
    bag = make_drive(tmp_path / "first.bag", frames=25)
    first = packed(bag, tmp_path)
    second = packed(make_drive(tmp_path / "second.bag", topic="/second", frames=20), tmp_path)
    receiver = roscore.receiver(CAMERA, "/second/image_raw")
    assert roscore.run("rosparam", "set", "/use_sim_time", "true")[0] == 0
    follower = roscore.start(*mp4ds_play(second, "--topics", "/second/*"))
    try:
        until(lambda: any("play" in node for node in roscore.nodes()))
        assert receiver.silence() == []  # nobody has begun
        options = ("--clock", "--topics", CAMERA)
        if leader == "mp4ds":
            command = mp4ds_play(first, *options)
        else:
            command = [PLAY, "--quiet", "--bags", str(bag), *options]
        roscore.play(command, [CAMERA], 1)
        told = receiver.take(45)
        assert follower.wait(WATCHDOG_S) == 0  # it ends soon after the leader
    finally:
        if follower.poll() is None:
            follower.terminate()
        follower.wait(WATCHDOG_S)
        roscore.run("rosparam", "delete", "/use_sim_time")
    arrivals: dict[int, list[float]] = defaultdict(list)
    for message, stamp in zip(told, stamps(told), strict=True):
        arrivals[stamp].append(message["arrival"])
    assert [len(times) for times in arrivals.values()] == [2] * 20 + [1] * 5
    # the follower played while the leader did, not after it
    first = next(number for number, message in enumerate(told) if message["topic"] != CAMERA)
    assert sum(message["topic"] == CAMERA for message in told[first:]) > 1


# ---------------------------------------------------------------- latching, and remote control


def test_latched_before_the_start(roscore: Core, drive: Path) -> None:
    """The last of each caller comes first, as from ``rosbag play -s``."""
    bag = drive.parent / "drive.bag"
    theirs = [PLAY, "--quiet", "--start", "0.5", str(bag)]
    found = []
    for command in (mp4ds_play(drive, "--start", "0.5"), theirs):
        receiver = roscore.receiver("/tf_static")
        roscore.play(command, ["/tf_static"], 1)
        told = receiver.take(2)
        assert receiver.silence() == []
        assert {message["latching"] for message in told} == {"1"}
        found.append({message["digest"] for message in told})
        receiver.end()
    assert found[0] == found[1]
    assert len(found[0]) == 2


@contextmanager
def playing(core: Core, dataset: Path) -> Iterator[tuple[subprocess.Popen[str], Process, str]]:
    """A player that begins again and again, who receives it, and its node's name."""
    before = set(core.nodes())
    receiver = core.receiver(CAMERA)
    player = core.start(*mp4ds_play(dataset, "--loop"))
    try:
        receiver.next()
        (node,) = (name for name in core.nodes() if name not in before and "mp4ds_play" in name)
        yield player, receiver, node
    finally:
        if player.poll() is None:
            player.terminate()
        player.wait(WATCHDOG_S)


def test_ends_with_its_node(roscore: Core, drive: Path) -> None:
    with playing(roscore, drive) as (player, _, node):
        assert roscore.run("rosnode", "kill", node)[0] == 0
        assert player.wait(WATCHDOG_S) == 0
    assert node not in roscore.nodes()


@pytest.mark.parametrize(
    ("number", "code"),
    [(signal.SIGINT, 0), pytest.param(signal.SIGTERM, 143, marks=pytest.mark.slow)],
)
def test_signals(roscore: Core, drive: Path, number: signal.Signals, code: int) -> None:
    with playing(roscore, drive) as (player, _, node):
        player.send_signal(number)
        assert player.wait(WATCHDOG_S) == code
    assert node not in roscore.nodes()  # it has signed off


def test_ros_names_the_node_and_its_topics(roscore: Core, drive: Path) -> None:
    """As roslaunch gives them; rosbag play takes the same."""
    told = ("__name:=player", "__ns:=/robot", "/tf:=/moved", "_rate:=3", "__log:=/none")
    receiver = roscore.receiver("/moved")
    player = roscore.start(*mp4ds_play(drive, "--loop", *told))
    try:
        receiver.next()
        assert "/robot/player" in roscore.nodes()
        assert "/robot/player/pause_playback" in roscore.run("rosservice", "list")[1].split()
    finally:
        player.send_signal(signal.SIGINT)
        assert player.wait(WATCHDOG_S) == 0
        receiver.end()
