"""The player's pace: /clock at its rate, stalls that are made up for, reading that is too slow."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import mp4ds
from mp4ds.bags.formats import open_writer
from mp4ds.dataset.dataset import Dataset
from mp4ds.plugins.playing import pace
from mp4ds.plugins.playing.options import PlayOptions
from mp4ds.plugins.playing.pace import Pace
from mp4ds.plugins.playing.player import Player, PlaySummary
from mp4ds.plugins.playing.timeline import Timeline
from mp4ds.records import Message
from player_scenes import (
    MS,
    START,
    STEP,
    RecordingPublisher,
    make_ros2,
    ros2_channel,
    run,
    running,
    text,
)
from waiting import until

NS = 10**9
CHATTER = "/chatter"


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A second of strings at 20 Hz, without a camera."""
    folder = tmp_path_factory.mktemp("strings")
    mp4ds.pack(make_ros2(folder / "drive.mcap"), folder / "drive")
    return folder / "drive"


# ---------------------------------------------------------------- /clock


class Hand:
    """A clock of the machine that is put forward by hand."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        monkeypatch.setattr(pace, "time", self)

    def monotonic(self) -> float:
        return self.now


def test_no_clock_is_ahead_of_a_message_that_is_still_to_come(drive: Path) -> None:
    publisher = RecordingPublisher(world="ros2")
    told: list[int] = []
    publisher.on_sent = lambda sent: told.append(sent.time_ns - publisher.clocks[-1].time_ns)
    run(drive, publisher, clock=200.0, rate=0.5)
    assert len(publisher.clocks) > 5
    assert all(ahead >= 0 for ahead in told)


def test_the_clock_ticks_before_the_first_message(drive: Path) -> None:
    publisher = RecordingPublisher(world="ros2")
    before: list[int] = []
    publisher.on_sent = lambda _: before.append(len(publisher.clocks))
    run(drive, publisher, clock=100.0, delay=0.5, rate=10.0)
    assert before[0] > 2
    assert len({one.time_ns for one in publisher.clocks[: before[0]]}) == 1


@pytest.mark.parametrize(
    ("options", "topics"),
    [
        ({"clock_topics": ["/map"]}, ["/map"] * 2),
        ({"clock_topics_all": True, "topics": ["/map", "/tf_static"]},
         ["/tf_static"] * 4 + ["/map"] * 2),
        ({"clock_topics": ["/map"], "remap": ["/map:=/other"]}, ["/other"] * 2),
    ],
)  # fmt: skip
def test_the_clock_goes_with_messages_on_request(
    options: dict[str, Any], topics: list[str], drive: Path
) -> None:
    publisher = RecordingPublisher(world="ros2")
    heard: list[str] = []

    def note(sent: Any) -> None:
        if publisher.clocks and publisher.clocks[-1].time_ns == sent.time_ns:
            heard.append(sent.topic)

    publisher.on_sent = note
    run(drive, publisher, rate=10.0, **options)
    # one advertises it, before anything is sent
    assert len(publisher.clocks) == len(topics) + 1
    assert [topic for topic in heard if topic in topics] == topics


# ---------------------------------------------------------------- late, and why


def waits(steps: list[tuple[int, bool, int]]) -> Iterator[int]:
    clock = Pace(2.0, steady=lambda: 0)
    for by, was_awaited, _ in steps:
        due, before = clock.now() - 2 * by * MS, clock.now()
        waited = clock.hold_back(due, was_awaited=was_awaited)
        assert before - clock.now() == 2 * waited
        yield waited


class Machine:
    """A steady clock that goes on only while a player waits for a message to be due."""

    def __init__(self) -> None:
        self.now = 100 * NS

    def __call__(self) -> int:
        return self.now

    def drive(self, player: Player) -> None:
        wait = player._changed.wait

        def pass_time(seconds: float) -> None:
            if seconds < pace.CATCH_UP_NS / NS:
                self.now += math.ceil(seconds * NS)
            else:  # nothing is read yet
                wait(0.001)

        player._changed.wait = pass_time


def stalled(drive: Path, seconds: float, rate: float = 1.0) -> tuple[list[int], PlaySummary]:
    """How late each string comes, where the process stands at the fifth one."""
    machine, publisher = Machine(), RecordingPublisher(world="ros2")
    times: list[int] = []

    def on_sent(sent: Any) -> None:
        if sent.topic == CHATTER:
            times.append(machine())
            machine.now += round(seconds * NS) if len(times) == 5 else 0

    publisher.on_sent = on_sent
    with Dataset(drive) as dataset:
        options = PlayOptions(rate=rate)
        timeline = Timeline([dataset], options, "ros2")
        player = Player(timeline, publisher, options, steady=machine)
        machine.drive(player)
        summary = player.run()
    due = (round(times[0] + number * STEP / rate) for number in range(len(times)))
    return [time - at for time, at in zip(times, due, strict=True)], summary


@pytest.mark.parametrize("rate", [0.7, 1.0, 8.0])
def test_times_are_kept(drive: Path, rate: float) -> None:
    late, summary = stalled(drive, 0.0, rate)
    assert len(late) == 20
    assert all(0 <= by < MS for by in late)
    assert summary.slowed_s == 0


def test_a_stall_is_made_up_for(drive: Path) -> None:
    late, summary = stalled(drive, 0.6)
    # each is due 50 ms after the one before: they come at once until it has caught up
    for number, by in enumerate(late[5:], 1):
        assert abs(by - max(0, 600 * MS - number * STEP)) < MS
    assert summary.slowed_s == 0


@pytest.fixture
def slow_reading(monkeypatch: pytest.MonkeyPatch) -> None:
    """Strings that take 40 ms to read."""
    records = Dataset.records

    def slow(dataset: Dataset, *arguments: Any, **options: Any) -> Iterator[Any]:
        for record in records(dataset, *arguments, **options):
            time.sleep(0.04)
            yield record

    monkeypatch.setattr(Dataset, "records", slow)


def test_the_clock_waits_for_what_is_not_read_in_time(drive: Path, slow_reading: None) -> None:
    publisher, summary = run(drive, rate=10.0, clock=50.0)
    assert len(publisher.sent) == 26
    assert summary.slowed_s > 0.3
    times = [one.time_ns for one in publisher.clocks]
    assert times == sorted(times)


# ---------------------------------------------------------------- pausing, skipping, the end


@pytest.fixture
def gap(tmp_path: Path) -> Path:
    """Two strings, an hour apart."""
    channel = ros2_channel(0, CHATTER, "std_msgs/msg/String")
    with open_writer(
        tmp_path / "gap.mcap", "mcap", name="gap", profile="ros2", library="", storage="mcap"
    ) as writer:
        writer.add_channel(channel)
        for n in range(2):
            time_ns = START + n * 3600 * NS
            writer.write(Message(channel, time_ns, time_ns, 0, text(f"{n}")))
    mp4ds.pack(tmp_path / "gap.mcap", tmp_path / "gap")
    return tmp_path / "gap"


def test_empty_times_are_skipped(gap: Path) -> None:
    publisher, summary = run(gap, skip_empty=60.0, clock=20.0)
    assert len(publisher.sent) == 2
    assert summary.seconds < 3000
    assert summary.slowed_s == 0


@pytest.mark.parametrize(
    ("options", "last"),
    [
        ({"until_nsec": START + 100 * MS}, 100),
        ({"until_sec": (START + 125 * MS) / NS}, 100),
        ({"until_nsec": START + 200 * MS, "duration": 0.1}, 200),
        ({"until_nsec": START, "duration": 0.1}, 100),
        ({"until_nsec": -1, "until_sec": -1.0}, 950),
    ],
)
def test_the_last_time_that_is_played(drive: Path, options: dict[str, Any], last: int) -> None:
    publisher, _ = run(drive, immediate=True, topics=[CHATTER], **options)
    assert publisher.sent[-1].time_ns == START + last * MS


def test_it_pauses_before_messages_of_a_topic(drive: Path) -> None:
    publisher = RecordingPublisher(world="ros2")
    with running(drive, publisher, rate=10.0, pause_topics=["/map"]) as (player, _):
        until(lambda: player.is_paused)
        assert "/map" not in {sent.topic for sent in publisher.sent}
        assert player.play_next()
        assert publisher.sent[-1].payload == text("map 0")
        player.resume()  # as with rosbag play, also for the next one, which it stands before
        until(lambda: publisher.has_ended)
    assert len(publisher.sent) == 26
    publisher = RecordingPublisher(world="ros2")
    with running(drive, publisher, rate=10.0, pause_topics=["/map"], paused=True) as (player, _):
        player.toggle_topic_pauses()
        player.resume()
        until(lambda: publisher.has_ended)
    assert len(publisher.sent) == 26


def test_it_waits_for_the_stamps_that_control_its_rate(drive: Path) -> None:
    publisher = RecordingPublisher(world="ros2")
    options = {"rate_control_topic": "/odom", "rate_control_max_delay": 0.1}
    with running(drive, publisher, topics=[CHATTER], rate=5.0, **options) as (player, _):
        until(lambda: len(publisher.sent) == 3)  # of 0, 50 and 100 ms
        time.sleep(0.3)
        assert len(publisher.sent) <= 3
        assert publisher.on_message is not None
        publisher.on_message(None)  # without a stamp
        publisher.on_message(START + 500 * MS)
        until(lambda: len(publisher.sent) >= 12)
        time.sleep(0.3)
        assert len(publisher.sent) <= 13
        publisher.on_message(START + NS)
        until(lambda: publisher.has_ended)
        assert not player.is_paused
    assert len(publisher.sent) == 20


# ---------------------------------------------------------------- types that are not installed


def test_what_is_not_installed_is_left_out_and_counted(drive: Path) -> None:
    publisher = RecordingPublisher(
        world="ros2", not_installed=frozenset({"tf2_msgs/msg/TFMessage"})
    )
    with pytest.warns(UserWarning, match=r"are not installed: /tf_static \(tf2_msgs") as told:
        _, summary = run(drive, publisher, immediate=True)
    assert len(told) == 1
    assert summary.not_installed == {"/tf_static": 4}
    assert summary.messages == {CHATTER: 20, "/map": 2}
    assert not summary.stopped
    with pytest.warns(UserWarning, match="not installed"):
        _, summary = run(drive, publisher, immediate=True, start_offset=0.5)
    assert "/tf_static" not in {sent.topic for sent in publisher.sent}
