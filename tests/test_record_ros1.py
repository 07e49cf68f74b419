"""`mp4ds record --ros1` from a real master, beside ROS 1's own recorder."""

from __future__ import annotations

import re
import signal
import subprocess
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import pytest

import mp4ds
from conftest import real
from mp4ds.bags.formats import open_reader
from mp4ds.records import Message
from player_scenes import make_drive
from roscore import PLAY, RECORD, Core, missing, python
from roscore import _core as _core
from roscore import roscore as roscore
from waiting import WATCHDOG_S, until

NOT_OF_PLAYERS = "/rosout.*|/clock"


def ours(target: Path, *options: str) -> list[str]:
    return python("mp4ds", "record", "--ros1", "-o", str(target), *options)


def contents(recording: Path) -> dict[Any, list[bytes]]:
    """Payloads of each connection, by what its header says."""
    found: dict[Any, list[bytes]] = defaultdict(list)
    with open_reader(recording) as reader:
        for record in reader.records():
            if isinstance(record, Message):
                channel = record.channel
                key = (channel.topic, channel.schema, tuple(sorted(channel.metadata.items())))
                found[key].append(bytes(record.data))
    return dict(found)


def recorded(core: Core, recorders: Sequence[list[str]], bag: Path, topics: Iterable[str]) -> None:
    """Record a player with several recorders, until all that it plays was received."""
    processes = [core.start(*command) for command in recorders]
    try:
        until(lambda: sum("record" in node for node in core.nodes()) == len(recorders))
        play = [PLAY, "--quiet", "--queue", "100000", str(bag)]
        core.play(play, topics, len(recorders))
    finally:
        for process in processes:
            process.send_signal(signal.SIGINT)
        codes = [process.wait(WATCHDOG_S) for process in processes]
    assert codes == [0] * len(recorders), (core.folder / "python.log").read_text()[-2000:]


@pytest.mark.parametrize(
    "name",
    ["drive", "roboto_tiny_dvs", pytest.param("ecto_ros_camera_info", marks=pytest.mark.slow)],
)
def test_as_rosbag_record(roscore: Core, tmp_path: Path, name: str) -> None:
    """The same messages, with the same connection headers; of several publishers, some latched."""
    bag = make_drive(tmp_path / "drive.bag") if name == "drive" else real(f"bags/{name}.bag")
    topics = {topic for topic, *_ in contents(bag) if not re.fullmatch(NOT_OF_PLAYERS, topic)}
    both = [
        ours(tmp_path / "live", "-a", "--exclude-regex", NOT_OF_PLAYERS),
        [RECORD, "-a", "-O", str(tmp_path / "theirs.bag"), "-x", NOT_OF_PLAYERS],
    ]
    recorded(roscore, both, bag, topics)
    mp4ds.unpack(tmp_path / "live", None, tmp_path / "again.bag")
    found, due = contents(tmp_path / "again.bag"), contents(tmp_path / "theirs.bag")
    assert found.keys() == due.keys()
    assert found == due
    assert any(dict(metadata).get("latching") == "1" for _, _, metadata in found) == (
        name == "drive"
    )
    assert mp4ds.validate(tmp_path / "live", deep=True) == []


def test_topics_that_are_named(roscore: Core, tmp_path: Path) -> None:
    bag = make_drive(tmp_path / "drive.bag")
    commands = {  # with -e all are regular expressions, as for rosbag record
        "globs": ours(tmp_path / "globs", "/camera/*", "/tf"),
        "patterns": ours(tmp_path / "patterns", "/camera/.*", "-e", "/tf"),
    }
    topics = {"/camera/image_raw", "/tf"}
    recorded(roscore, [*commands.values()], bag, topics)
    for name in commands:
        with mp4ds.open(tmp_path / name) as dataset:
            found = {channel.topic for channel in dataset.channels}
            assert found == topics, name


def test_some_messages_of_what_a_node_hears(roscore: Core, tmp_path: Path) -> None:
    """The first ones of what `rosbag record --node` gets, which takes no --limit with it."""
    bag = make_drive(tmp_path / "drive.bag")
    topics = ["/camera/image_raw", "/tf"]
    prefix = ["--limit=5", "--output-prefix", str(tmp_path / "live"), "__name:=record"]
    theirs = ["-O", str(tmp_path / "theirs.bag"), "__name:=record_theirs"]
    listener = roscore.start(RECORD, "-O", str(tmp_path / "heard"), *topics, "__name:=listener")
    until(lambda: "/listener" in roscore.nodes(), listener)
    other = roscore.start(RECORD, "--node=/listener", *theirs)
    ours = roscore.start(*python("mp4ds", "record", "--ros1", "--node=listener", *prefix))
    try:
        until(lambda: {"/record", "/record_theirs"} <= {*roscore.nodes()}, other)
        roscore.play([PLAY, "--quiet", "--queue", "100000", str(bag)], topics, 3)
        assert ours.wait(WATCHDOG_S) == 0  # by itself
    finally:
        for process in (other, listener, ours):
            process.send_signal(signal.SIGINT)
            process.wait(WATCHDOG_S)
    (made,) = tmp_path.glob("live_*")
    assert re.fullmatch(r"live(_\d+){3}-\d\d_\d\d_\d\d", made.name)
    mp4ds.unpack(made, None, tmp_path / "again.bag")
    found, due = contents(tmp_path / "again.bag"), contents(tmp_path / "theirs.bag")
    assert found == {key: messages[:5] for key, messages in due.items()}
    assert {topic for topic, *_ in found} == {*topics}


def spooled(folder: Path) -> int:
    """Bytes of a recording that are not packed yet."""
    return sum(path.stat().st_size for path in folder.glob("*.mcap"))


def test_a_clock_that_starts_late(roscore: Core, tmp_path: Path) -> None:
    """Nothing is recorded before its first time: no message has the time 0."""
    bag = make_drive(tmp_path / "drive.bag")
    roscore.run("rosparam", "set", "/use_sim_time", "true")
    recorder = roscore.start(*ours(tmp_path / "live", "-a", "--exclude", "/rosout*"))
    player = None
    try:
        log = roscore.folder / "python.log"
        until(lambda: log.exists() and "waiting for /clock" in log.read_text())
        player = roscore.start(PLAY, "-q", "--clock", "--loop", str(bag))
        until(lambda: spooled(tmp_path / "live.recording") > 10_000)
        recorder.send_signal(signal.SIGINT)
        assert recorder.wait(WATCHDOG_S) == 0
    finally:
        for process in filter(None, (player, recorder)):
            process.kill()
            process.wait(WATCHDOG_S)
        roscore.run("rosparam", "delete", "/use_sim_time")
    with open_reader(bag) as reader:
        due = [one.log_time for one in reader.records() if isinstance(one, Message)]
    with mp4ds.open(tmp_path / "live") as dataset:
        times = [one.log_time_ns for one in dataset.messages()]
    assert times
    assert min(due) <= min(times)
    assert max(times) <= max(due) + 10**9


def test_looking_back(roscore: Core, tmp_path: Path) -> None:
    """Saved by a service, a signal and a message, while nothing comes; with what is latched."""
    bag = make_drive(tmp_path / "drive.bag")
    options = ("-a", "--exclude", "/rosout*", "--exclude", "/go", "--trigger", "/go:data==true")
    command = ours(tmp_path / "live", *options, "--keep-last", "10m", "__name:=bag")
    log = roscore.folder / "python.log"
    begin = log.stat().st_size if log.exists() else 0

    def is_saved(count: int) -> bool:
        return log.read_text()[begin:].count("mp4ds: saved ") == count

    recorder = roscore.start(*command)
    try:
        until(lambda: "/bag" in roscore.nodes(), recorder)
        roscore.play([PLAY, "--quiet", str(bag)], {topic for topic, *_ in contents(bag)}, 1)
        done = roscore.run("rosservice", "call", "/bag/snapshot")
        assert "success: True" in done[1], done
        until(lambda: is_saved(1), recorder)
        recorder.send_signal(signal.SIGUSR1)
        until(lambda: is_saved(2), recorder)
        done = roscore.run("rostopic", "pub", "-1", "/go", "std_msgs/Bool", "true")
        until(lambda: is_saved(3), recorder)
        recorder.send_signal(signal.SIGINT)
        assert recorder.wait(WATCHDOG_S) == 0
    finally:
        recorder.kill()
        recorder.wait(WATCHDOG_S)
    made = sorted(tmp_path.glob("live_*"))
    assert len(made) == 3

    def payloads(recording: Path) -> list[tuple[str, bytes]]:
        found = contents(recording)
        return sorted((key[0], payload) for key, own in found.items() for payload in own)

    for dataset in made:
        mp4ds.unpack(dataset, None, again := dataset.with_suffix(".bag"))
        assert payloads(again) == payloads(bag)
        assert mp4ds.validate(dataset, deep=True) == []


def test_without_a_master(tmp_path: Path) -> None:
    if why := missing():
        pytest.skip(why)
    env = {"PATH": "/usr/bin:/bin", "ROS_MASTER_URI": "http://127.0.0.1:1/"}
    command = ours(tmp_path / "live", "-a", "--keep-last", "60s")
    process = subprocess.Popen(command, env=env, stderr=subprocess.PIPE, text=True)
    status = Path("/proc", str(process.pid), "status")

    def is_ignored() -> bool:
        mask = status.read_text().partition("SigIgn:")[2].split()[0]
        return bool(int(mask, 16) >> (signal.SIGUSR1 - 1) & 1)

    until(is_ignored, process)
    process.send_signal(signal.SIGUSR1)  # a trigger that comes too early
    _, said = process.communicate(timeout=WATCHDOG_S)
    assert process.returncode == 1
    assert "no ROS master answers" in said
    assert not list(tmp_path.iterdir())
