"""The player: what is published when, and what its controls do."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest

import mp4ds
from coded_scenes import CODED
from mp4ds.errors import OptionError
from mp4ds.plugins.playing.options import PlayOptions
from mp4ds.plugins.playing.player import open_player
from mp4ds.plugins.ros.node import NodeNames
from player_scenes import (
    MS,
    START,
    Recorded,
    RecordingPublisher,
    make_drive,
    recorded,
    ros1_channel,
    run,
    running,
)
from sources import SOURCES
from waiting import until

FIRST = START
NOW = 1_900_000_000 * 10**9
CAMERA = "/camera/image_raw"


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Recorded]]:
    """A dataset, and the messages of its recording."""
    folder = tmp_path_factory.mktemp("drive")
    bag = make_drive(folder / "drive.bag")
    mp4ds.pack(bag, folder / "drive")
    return folder / "drive", recorded(bag)


def published(publisher: RecordingPublisher) -> list[Recorded]:
    return [(sent.topic, sent.payload, sent.time_ns) for sent in publisher.sent]


# ---------------------------------------------------------------- what is published


def test_everything_is_published_in_order(drive: tuple[Path, list[Recorded]]) -> None:
    publisher, summary = run(drive[0], rate=5.0)
    assert published(publisher) == drive[1]
    assert sum(summary.messages.values()) == len(drive[1])
    assert summary.messages[CAMERA] == 20
    assert not summary.stopped


def test_immediate_does_not_wait(drive: tuple[Path, list[Recorded]]) -> None:
    publisher, _ = run(drive[0], immediate=True, rate=0.001)
    assert published(publisher) == drive[1]


def test_a_part_of_it(drive: tuple[Path, list[Recorded]]) -> None:
    publisher, _ = run(drive[0], immediate=True, start_offset=0.3, duration=0.4)
    begin = FIRST + 300 * MS
    expected = [item for item in drive[1] if begin <= item[2] <= begin + 400 * MS]
    latched = [item for item in published(publisher) if item[0] == "/tf_static"]
    others = [item for item in published(publisher) if item[0] != "/tf_static"]
    assert others == expected
    assert {item[1] for item in latched} == {
        item[1] for item in drive[1] if item[0] == "/tf_static"
    }
    assert [item[0] for item in published(publisher)[:2]] == ["/tf_static"] * 2


@pytest.mark.parametrize(
    ("options", "topics"),
    [
        ({"topics": ["/tf*"]}, {"/tf", "/tf_static"}),
        ({"exclude": ["/tf*"]}, {CAMERA}),
        ({"regex": "^/tf$"}, {"/tf"}),
        ({"regex": ".*static", "topics": [CAMERA]}, {"/tf_static", CAMERA}),
        ({"regex": "/tf.*", "exclude": ["/tf"]}, {"/tf_static"}),
        ({"regex": "/tf"}, {"/tf"}),
        ({"exclude_regex": "/tf"}, {"/tf_static", CAMERA}),
        ({"topics": ["/tf*"], "exclude_regex": "/t.*c"}, {"/tf"}),
        ({"topics": ["/tf"], "remap": ["tf:=/robot/tf"],
          "names": NodeNames("player", "/robot", (("tf", "/last"), ("/none", "/other")))},
         {"/last"}),
        ({"topics": ["/tf"], "remap": ["/tf:=/moved"]}, {"/moved"}),
        ({"topics": ["/tf", CAMERA], "remap": ["tf:=/moved"], "prefix": "/robot"},
         {"/moved", "/robot/camera/image_raw"}),
    ],
)  # fmt: skip
def test_topics(
    drive: tuple[Path, list[Recorded]], options: dict[str, Any], topics: set[str]
) -> None:
    publisher, summary = run(drive[0], immediate=True, **options)
    assert {sent.topic for sent in publisher.sent} == topics
    assert {channel.topic for channel in publisher.advertised} == topics
    assert set(summary.messages) == topics


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"topics": ["/none"]}, "`topics` '/none' matches no topic"),
        ({"regex": "tf"}, "`regex` 'tf' fully matches no topic"),
        ({"exclude_regex": "tf"}, "`exclude_regex` 'tf' fully matches no topic"),
        ({"exclude_regex": "["}, "not a valid regular expression"),
        ({"clock_topics": ["/none"]}, "`clock_topics` '/none'"),
        ({"pause_topics": ["/none"]}, "`pause_topics` '/none'"),
        ({"clock_topics": ["/tf"], "clock": 5.0}, "`clock_topics` contradicts `clock`"),
        ({"skip_empty": -1.0}, "`skip_empty` -1"),
        ({"wait_for_all_acked": -1}, "`wait_for_all_acked` -1"),
        ({"until_sec": float("nan")}, "`until_sec` nan"),
        ({"remap": ["/tf"]}, "is not a remapping"),
        ({"remap": ["/none:=/other"]}, "there is no such topic"),
        ({"rate": 0.0}, "`rate` 0"),
        ({"start_offset": 100.0}, "past the end"),
        ({"clock": 0.0}, "`clock` 0"),
        ({"follow_clock": True, "clock": 10.0}, "`clock` contradicts `follow_clock`"),
    ],
)
def test_wrong_options(
    drive: tuple[Path, list[Recorded]], options: dict[str, Any], words: str
) -> None:
    with pytest.raises(OptionError, match=words.replace("(", r"\(")):
        run(drive[0], **options)


def test_several_datasets_on_one_clock(drive: tuple[Path, list[Recorded]], tmp_path: Path) -> None:
    bag = make_drive(tmp_path / "other.bag", topic="/rear", late=10 * MS, frames=10)
    mp4ds.pack(bag, tmp_path / "other")
    publisher, _ = run([drive[0], tmp_path / "other"], immediate=True)
    times = [sent.time_ns for sent in publisher.sent]
    assert times == sorted(times)
    assert sorted(published(publisher)) == sorted(drive[1] + recorded(bag))


def test_loop(drive: tuple[Path, list[Recorded]]) -> None:
    publisher = RecordingPublisher()
    with running(drive[0], publisher, immediate=True, loop=True):
        until(lambda: len(publisher.sent) > 3 * len(drive[1]))
    assert published(publisher)[: 3 * len(drive[1])] == 3 * drive[1]


def test_it_ends_when_the_receiving_side_is_shut_down(
    drive: tuple[Path, list[Recorded]],
) -> None:
    publisher = RecordingPublisher()
    publisher.on_sent = lambda sent: setattr(publisher, "is_alive", len(publisher.sent) < 5)
    with open_player(drive[0], PlayOptions(), node=publisher) as player:
        assert player.run().stopped
    assert len(publisher.sent) == 5


# ---------------------------------------------------------------- clock


def test_a_recorded_clock_is_not_published_beside_ours(tmp_path: Path) -> None:
    from mp4ds.bags.formats import open_writer
    from mp4ds.records import Message

    source = recorded(make_drive(tmp_path / "plain.bag", frames=8))
    clock = ros1_channel(0, "/clock", "rosgraph_msgs/Clock", "/player")
    image = ros1_channel(1, CAMERA, "sensor_msgs/Image", "/driver")
    with open_writer(
        tmp_path / "c.bag", "bag", name="c.bag", profile="ros1", library="", storage=""
    ) as writer:
        writer.add_channel(clock)
        writer.add_channel(image)
        for topic, payload, log_time in source:
            if topic == CAMERA:
                writer.write(Message(clock, log_time, log_time, 0, bytes(8)))
                writer.write(Message(image, log_time, log_time, 0, payload))
    mp4ds.pack(tmp_path / "c.bag", tmp_path / "c")
    publisher, _ = run(tmp_path / "c", immediate=True)
    assert sum(sent.topic == "/clock" for sent in publisher.sent) == 8
    publisher, _ = run(tmp_path / "c", immediate=True, clock=10.0)
    assert not any(sent.topic == "/clock" for sent in publisher.sent)
    assert len(publisher.clocks) >= 8  # one with each message, since no time passes


@pytest.mark.parametrize(
    "phases",
    [
        [(range(0, 501, 10), 0, 510)],  # a step after the last
        [(range(0, 2001, 10), 0, 2000), ([0], 0, 0), (range(0, 301, 10), 1, 310)],
        [([700], 700, 700), (range(700, 2001, 10), 701, 2000)],
    ],
    ids=["from the start", "a jump back", "in the middle"],
)
def test_follows_a_clock(
    phases: list[tuple[Any, int, int]], drive: tuple[Path, list[Recorded]]
) -> None:
    """Each phase: times that the other player tells, and which messages are due then, in ms."""
    expected: list[Recorded] = []
    if phases[0][1]:  # what is latched comes first
        expected += [item for item in drive[1] if item[0] == "/tf_static"]
    with running(drive[0], follow_clock=True) as (_, publisher):
        until(lambda: publisher.on_time)
        assert publisher.on_time is not None
        time.sleep(0.3)
        assert not publisher.sent
        for told, first, last in phases:
            for shift in told:
                publisher.on_time(FIRST + shift * MS)
            begin, end = FIRST + first * MS, FIRST + last * MS
            expected.extend(item for item in drive[1] if begin <= item[2] <= end)
            until(lambda: len(publisher.sent) == len(expected))
        time.sleep(0.2)
        found = published(publisher)
        assert sorted(item[:2] for item in found[:2]) == sorted(item[:2] for item in expected[:2])
        assert found[2:] == expected[2:]


# ---------------------------------------------------------------- controls


def test_pause_and_steps(drive: tuple[Path, list[Recorded]]) -> None:
    """Each is answered when the messages are out."""
    with running(drive[0], paused=True) as (player, publisher):
        assert player.is_paused
        for count in (1, 2, 3):
            assert player.play_next()
            assert len(publisher.sent) == count
        assert player.burst(5) == 5
        assert published(publisher) == drive[1][:8]
        assert player.burst(-1) == 0
        player.resume()
        assert not player.play_next()  # only while it stands still
        assert player.burst(3) == 0
        until(lambda: len(publisher.sent) == len(drive[1]))
    assert published(publisher) == drive[1]


@pytest.mark.parametrize("asked", [0, 100_000])
def test_a_burst_tells_how_many_there_were(drive: tuple[Path, list[Recorded]], asked: int) -> None:
    with running(drive[0], paused=True, loop=True) as (player, publisher):
        assert player.burst(4) == 4
        assert player.burst(asked) == len(drive[1]) - 4
        assert published(publisher) == drive[1]
        assert not player.play_next()
        assert player.burst(asked) == 0


def test_pause_holds_the_clock(drive: tuple[Path, list[Recorded]]) -> None:
    with running(drive[0], clock=100.0) as (player, publisher):
        until(lambda: len(publisher.sent) > 10)
        player.pause()
        # what was on its way is out when the clock is told the second time
        paused = len(publisher.clocks)
        until(lambda: len(publisher.clocks) > paused + 2)
        count, ticks = len(publisher.sent), len(publisher.clocks)
        until(lambda: len(publisher.clocks) > ticks + 5)
        assert len(publisher.sent) == count
        assert len({clock.time_ns for clock in publisher.clocks[ticks:]}) == 1
        player.toggle_paused()
        until(lambda: len(publisher.sent) == len(drive[1]))
    times = [clock.time_ns for clock in publisher.clocks]
    assert times == sorted(times)


def test_seek(drive: tuple[Path, list[Recorded]]) -> None:
    with running(drive[0], paused=True, topics=[CAMERA]) as (player, publisher):
        frames = [item for item in drive[1] if item[0] == CAMERA]
        for number in (12, 3, 19):
            assert player.seek(frames[number][2]) == frames[number][2]
            assert player.play_next()
            assert published(publisher)[-1] == frames[number]
        # as rosbag2: before the first message that is played is at the first
        assert player.seek(FIRST - 10**9) == frames[0][2]
        assert player.play_next()
        assert published(publisher)[-1] == frames[0]
        assert player.seek(2**62) == frames[-1][2]
        assert not player.play_next()


def test_it_is_played_again_where_it_was_kept_alive(drive: tuple[Path, list[Recorded]]) -> None:
    with running(drive[0], immediate=True, keep_alive=True) as (player, publisher):
        until(lambda: len(publisher.sent) == len(drive[1]))
        until(lambda: player.play(FIRST, FIRST + 100 * MS))
        again = [item for item in drive[1] if item[2] <= FIRST + 100 * MS]
        until(lambda: len(publisher.sent) == len(drive[1]) + len(again))
        assert published(publisher)[len(drive[1]) :] == again
    with running(drive[0], rate=0.01) as (player, publisher):
        until(lambda: publisher.sent)
        assert not player.play(FIRST, None)


def test_waits_for_subscribers(drive: tuple[Path, list[Recorded]]) -> None:
    publisher = RecordingPublisher(subscriber_count=0)
    with running(drive[0], publisher, immediate=True, wait_for_subscribers=True):
        time.sleep(0.5)
        assert not publisher.sent
        publisher.subscriber_count = 1
        until(lambda: len(publisher.sent) == len(drive[1]))


# ---------------------------------------------------------------- lock-step, late frames, stamps


def test_lock_step(drive: tuple[Path, list[Recorded]]) -> None:
    with running(drive[0], lock_step="/done", rate=100.0) as (_, publisher):

        def count() -> int:
            return sum(sent.topic == CAMERA for sent in publisher.sent)

        for number in range(1, 6):
            until(lambda number=number: count() == number)
            time.sleep(0.05)
            assert count() == number
            assert publisher.on_message is not None
            publisher.on_message(None)
    times = [sent.time_ns for sent in publisher.sent]
    assert times == sorted(times)


def test_late_frames_are_dropped_and_counted(drive: tuple[Path, list[Recorded]]) -> None:
    publisher = RecordingPublisher(busy_s=0.02)
    options = PlayOptions(rate=4.0, drop=True, read_ahead=1)
    with open_player(drive[0], options, node=publisher) as player:
        summary = player.run()
    others = [item for item in drive[1] if item[0] != CAMERA]
    assert [item for item in published(publisher) if item[0] != CAMERA] == others
    assert summary.slowed_s == 0
    assert summary.messages[CAMERA] + summary.dropped == 20


def test_publishing_as_ros2(drive: tuple[Path, list[Recorded]]) -> None:
    publisher = RecordingPublisher(world="ros2")
    with open_player(drive[0], PlayOptions(immediate=True), node=publisher) as player:
        player.run()
    assert {channel.message_encoding for channel in publisher.advertised} == {"cdr"}
    assert len(publisher.sent) == len(drive[1])
    assert all(sent.payload[:2] == b"\0\1" for sent in publisher.sent)


def test_publishing_as_jpeg(drive: tuple[Path, list[Recorded]]) -> None:
    publisher, _ = run(drive[0], immediate=True, publish_as="compressed")
    files = [sent for sent in publisher.sent if sent.topic == f"{CAMERA}/compressed"]
    assert len(files) == 20
    assert all(b"\xff\xd8" in sent.payload[:80] for sent in files)
    assert [sent.time_ns for sent in files] == [item[2] for item in drive[1] if item[0] == CAMERA]


def test_pictures_that_cannot_be_decoded_are_published_as_recorded(tmp_path: Path) -> None:
    """Though all of their channel was expected to become raw images."""
    made = CODED["video-h265-lost"]()
    mp4ds.pack(SOURCES["mcap-ros2-zstd"](tmp_path / "source", made), tmp_path / "video")
    publisher, summary = run(
        tmp_path / "video", RecordingPublisher("ros2"), immediate=True, publish_as="raw"
    )
    (reasons,) = summary.as_recorded.values()
    recorded = [sent for sent in publisher.sent if sent.topic in summary.as_recorded]
    assert len(recorded) == reasons["its picture cannot be decoded"] > 0
