"""`mp4ds record` of recordings that are played: what comes, how it is cut, what a kill leaves."""

from __future__ import annotations

import re
import shutil
import signal
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import mp4ds
from coded_scenes import CODED
from commands import call, tree
from compare import compare
from mp4ds.bags.formats import open_sources
from mp4ds.bags.mcap import McapWriter
from mp4ds.bags.salvage_mcap import McapSalvage
from mp4ds.dataset.dataset import datasets_in
from mp4ds.errors import OptionError, SourceError, TargetExistsError, WriteError
from mp4ds.files.sources import RECORDING_NAME
from mp4ds.packing.options import PackOptions
from mp4ds.packing.spool import SpoolFolder
from mp4ds.plugins.recording import spool
from mp4ds.plugins.recording.options import RecordOptions, Wanted
from mp4ds.plugins.recording.receiving import MessageBuffer
from mp4ds.plugins.recording.record import RecordProgress
from mp4ds.plugins.ros.node import NodeNames
from mp4ds.processes import ProcessExecutor
from mp4ds.records import Channel, Message, Schema
from player_scenes import make_drive
from record_scenes import PlayedNode, fail_to_pack, played, recorded
from scenes import Scene, scene
from sources import SOURCES
from waiting import WATCHDOG_S, until

SALVAGE = PackOptions(salvage=True)
HERE = Path(__file__).parent


@pytest.fixture(autouse=True)
def pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """Even a short recording is cut into several pieces."""
    monkeypatch.setattr(spool, "WINDOW_NS", 300_000_000)


def write(folder: Path, source: str = "bag-none", of: Scene | None = None) -> list[Path]:
    made = of or scene("bayer_rggb8", frames=40)
    return SOURCES[source](folder / "source", replace(made, silent={}))  # nobody hears of those


def again(dataset: Path, folder: Path, to: str | None = None) -> Path:
    output = folder / f"{dataset.name}_again"
    if (to or "bag") == "bag":
        output = output.with_suffix(".bag")
    mp4ds.unpack(dataset, to, output)
    return output


# ---------------------------------------------------------------- what comes


@pytest.mark.one_in(2)
@pytest.mark.parametrize(
    ("source", "encoding"),
    [
        ("bag-none", "bayer_rggb8"),
        ("bag-none", "16UC1"),
        ("rosbag2-sqlite3-v5", "32FC1"),
        ("rosbag2-mcap-v5", "yuv422_yuy2"),
    ],
)
def test_what_comes_is_there(source: str, encoding: str, tmp_path: Path) -> None:
    paths = write(tmp_path, source, scene(encoding, frames=20))
    summary = recorded(PlayedNode(paths), tmp_path / "live")
    assert mp4ds.validate(tmp_path / "live", deep=True) == []
    (made,) = summary.datasets
    assert {item.frames for item in made.topics if "image" in item.topic} == {20}
    assert not summary.dropped
    assert not (tmp_path / "live.recording").exists()
    to = "rosbag2" if source.startswith("rosbag2") else "bag"
    assert compare(paths, again(tmp_path / "live", tmp_path, to)) == []
    with mp4ds.open(tmp_path / "live") as dataset:
        stream = dataset["/cam/image_raw"]
        assert stream[7].intrinsics.k[0] > 0  # calibrations have found their images
        assert stream[13].data.shape[0] == 48


@pytest.mark.parametrize("kind", ["video-h265", "video-h264-headers-once"])
def test_packets_on_both_sides_of_a_cut(kind: str, tmp_path: Path) -> None:
    """Pieces are cut at key frames of the video, whatever else is cut in between."""
    paths = write(tmp_path, "rosbag2-mcap-v5", CODED[kind](frames=40))
    (made,) = recorded(PlayedNode(paths), tmp_path / "live").datasets
    assert {item.topic: item.frames for item in made.topics}["/cam/video"] == 40
    assert mp4ds.validate(tmp_path / "live", deep=True) == []
    assert compare(paths, again(tmp_path / "live", tmp_path, "rosbag2")) == []
    with mp4ds.open(tmp_path / "live") as dataset:
        assert len(dataset.streams) == 1


@pytest.mark.one_in(2)
@pytest.mark.parametrize("case", ["late at a cut", "a clock that jumps back"])
def test_times_that_are_not_in_order(case: str, tmp_path: Path) -> None:
    """As threads take turns, or a simulation starts over: all is there, by log time."""
    paths = write(tmp_path)
    first = next(iter(messages(paths))).log_time
    sent: list[tuple[str, int, bytes]] = []

    def altered(message: Message, number: int) -> Message:
        time = message.log_time
        if case == "late at a cut":
            time -= 120_000_000 * (number % 7 == 3)
        elif time - first > 1_200_000_000:
            time -= 1_000_000_000
        sent.append((message.channel.topic, time, bytes(message.data)))
        return replace(message, log_time=time)

    topics = {message.channel.topic for message in messages(paths)}
    recorded(PlayedNode(paths, altered=dict.fromkeys(topics, altered)), tmp_path / "live")
    assert mp4ds.validate(tmp_path / "live", deep=True) == []
    found = [
        (message.channel.topic, message.log_time, bytes(message.data))
        for message in messages([again(tmp_path / "live", tmp_path)])
    ]
    assert sorted(found) == sorted(sent)
    times = [time for _, time, _ in found]
    assert times == sorted(times)


def test_quality(tmp_path: Path) -> None:
    paths = write(tmp_path)
    recorded(PlayedNode(paths), tmp_path / "live", quality="visual")
    assert mp4ds.validate(tmp_path / "live", deep=True) == []
    found = compare(paths, again(tmp_path / "live", tmp_path), ignore_pixels=["/cam/image_raw"])
    assert found == []
    with mp4ds.open(tmp_path / "live") as dataset:
        assert dataset.streams[0].sidecar.video.codec == "av1"


def wanted(*topics: str, **options: Any) -> Wanted:
    return Wanted(topics, RecordOptions(**options))


def test_named_topics_are_waited_for() -> None:
    """A limit is reached when they have come, too."""
    assert Wanted(["/a", "/cam/*"], RecordOptions(limit=3)).due == {"/a"}
    assert not Wanted([], RecordOptions(all=True, limit=3)).due


def test_topics_that_are_wanted() -> None:
    chosen = wanted("cam/*", regex="imu$", exclude=["/cam/info"], exclude_regex="depth")
    topics = ("/cam/image", "/cam/info", "/cam/depth", "/front/imu", "/imu/raw")
    assert [*filter(chosen, topics)] == ["/cam/image", "/front/imu"]
    assert all(map(wanted(all=True), topics))
    with pytest.raises(OptionError, match="not a valid regular expression"):
        wanted(regex="(")


@pytest.mark.parametrize(
    ("topics", "options", "found"),
    [
        ([], {"all": True}, "image imu event"),
        ([], {"all_topics": True}, "image imu"),
        ([], {"all_services": True}, "event"),
        ([], {"topic_types": ["sensor_msgs/msg/Imu"]}, "imu"),
        (["/cam/*"], {"topic_types": ["sensor_msgs/msg/Imu"]}, "image imu"),
        ([], {"all": True, "exclude_topic_types": ["sensor_msgs/msg/Imu"]}, "image event"),
        (["/arm/_service_event"], {}, "event"),
        ([], {"regex": "^/arm/"}, "event"),
        ([], {"exclude": ["/arm/*"], "all_services": True}, ""),
    ],
)
def test_topics_by_type_and_services(
    topics: list[str], options: dict[str, Any], found: str
) -> None:
    """As Jazzy's recorder chooses: events of services are not among `all_topics`."""
    there = {
        "image": ("/cam/image", "sensor_msgs/msg/Image"),
        "imu": ("/imu", "sensor_msgs/msg/Imu"),
        "event": ("/arm/_service_event", "std_srvs/srv/Trigger_Event"),
    }
    chosen = wanted(*topics, **options)
    assert [name for name, topic in there.items() if chosen(*topic)] == found.split()


def test_topics_that_ros_renames() -> None:
    """As for `rosbag record`: subscribed to by the new name, recorded by the one that was typed."""
    names = NodeNames("bag", "/robot", (("front", "/camera/image"), ("/tf", "tf"), ("imu", "/x")))
    chosen = wanted("front", "/tf", "odom", "/gps/*", exclude=("left",), names=names)
    topics = ("/camera/image", "/robot/tf", "/robot/odom", "/gps/fix", "/tf", "/robot/front", "/x")
    found = [topic for topic in topics if chosen(topic)]
    assert found == [*topics[:4]]
    assert [*map(chosen.recorded_as, found)] == ["/robot/front", "/tf", "/robot/odom", "/gps/fix"]
    everything = wanted(all=True, exclude=("left",), names=names)
    assert everything("/camera/image")
    assert not everything("/robot/left")
    assert everything.recorded_as("/camera/image") == "/camera/image"
    with pytest.raises(
        OptionError, match="/robot/front and /camera/image are the same topic after remapping"
    ):
        wanted("front", "/camera/image", names=names)


class Opened:
    """Lets the command record from a node that plays a recording, and keeps its options."""

    def __init__(self, node: PlayedNode, monkeypatch: pytest.MonkeyPatch) -> None:
        self.options = RecordOptions()
        self._node = node
        monkeypatch.setattr("mp4ds.cli.record.open_recorder", self)

    def __call__(self, topics: Any, dataset: Any, options: RecordOptions, **rest: Any) -> Any:
        self.options = options
        return played(self._node, topics, dataset, options, **rest)


def test_what_launch_files_append(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    node = PlayedNode(write(tmp_path, of=scene("mono8", frames=2)))
    opened = Opened(node, monkeypatch)
    told = call(
        *("record", "--ros2", "-o", tmp_path / "live", "camera", "--no-progress"),
        *("--ros-args", "-r", "__node:=bag", "-r", "__ns:=/robot"),
        *("-r", "camera:=/cam/image_raw", "-p", "use_sim_time:=true", "--log-level", "warn"),
    )
    assert (told.code, told.err) == (0, "")
    names = opened.options.names
    assert (opened.options.to, names.node, names.namespace) == ("ros2", "bag", "/robot")
    assert names.use_sim_time
    with mp4ds.open(tmp_path / "live") as dataset:
        assert len(dataset["/cam/image_raw"]) == 2  # as the source calls it
    assert call("record", "--ros-args", "--nonsense").code == 2


def test_one_that_may_not_finish(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second signal says where the rest is."""
    opened = Opened(PlayedNode(write(tmp_path)), monkeypatch)

    def wait(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("mp4ds.plugins.recording.record.wait", wait)
    monkeypatch.chdir(tmp_path)
    told = call("record", "--ros1", "-o", "", "-a", "--no-progress")
    assert opened.options.to == "ros1"
    assert told.code == 130
    found = re.search(r"pack --salvage \S+/mp4ds_[\d_-]+\.recording -o ", told.err)
    assert found, told.err


def test_no_trigger(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Looking back, nothing is saved then, and that is no failure."""
    Opened(PlayedNode(write(tmp_path, of=scene("mono8", frames=2))), monkeypatch)
    before = tree(tmp_path)
    options = ("--ros1", "-a", "-o", tmp_path / "live", "--keep-last", "60s", "--no-progress")
    told = call("record", *options)
    assert (told.code, told.out) == (0, "nothing was saved: there was no trigger\n")
    assert tree(tmp_path) == before


def test_nothing_to_record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As ROS's own recorders do: a recording without messages, and that is no failure."""
    Opened(PlayedNode(write(tmp_path, of=scene("mono8", frames=2))), monkeypatch)
    told = call("record", "--ros1", "-o", tmp_path / "live", "/nothing", "--no-progress")
    assert told.code == 0, told
    assert told.out == f"{tmp_path / 'live'}: empty: no matching topic was published\n"
    assert mp4ds.validate(tmp_path / "live", deep=True) == []
    assert again(tmp_path / "live", tmp_path).stat().st_size > 0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"all": False}, "Name topics"),
        ({"quality": "vmaf=95"}, "several tries"),
        ({"duration": -1.0}, "duration"),
        ({"max_duration": float("nan")}, "max_duration"),
        ({"codec": "av1"}, "lossless"),
        ({"custom_data": ["operator"]}, "'operator' is not of the form KEY=VALUE"),
        ({"prefix": "run"}, "`prefix` is for a dataset that is not named"),
    ],
)
def test_options_that_make_no_sense(options: dict[str, Any], said: str, tmp_path: Path) -> None:
    node = PlayedNode(write(tmp_path, "rosbag2-mcap-v5"))
    with pytest.raises(OptionError, match=said):
        recorded(node, tmp_path / "live", **options)
    assert not list(tmp_path.glob("live*"))


def test_what_is_there_is_kept(tmp_path: Path) -> None:
    paths = write(tmp_path, of=scene("mono8", frames=2))
    (tmp_path / "live").mkdir()
    with pytest.raises(TargetExistsError):
        recorded(PlayedNode(paths), tmp_path / "live")
    (tmp_path / "live").rmdir()
    recorded(PlayedNode(paths), tmp_path / "live")
    recorded(PlayedNode(paths), tmp_path / "live", force=True)
    assert mp4ds.validate(tmp_path / "live") == []


# ---------------------------------------------------------------- splits, pauses


@pytest.mark.one_in(2)
@pytest.mark.parametrize("most", [{"max_duration": 0.5}, {"max_size": 200_000}])
def test_datasets_of_a_length_or_size(most: dict[str, Any], tmp_path: Path) -> None:
    paths = write(tmp_path, of=scene("mono8", frames=40, width=160, height=120))
    summary = recorded(PlayedNode(paths), tmp_path / "live", **most)
    made = [item.dataset for item in summary.datasets]
    assert len(made) > 1
    assert [path.name for path in made] == [f"live_{number}" for number in range(len(made))]
    mp4ds.pack(made, tmp_path / "whole")
    assert compare(paths, again(tmp_path / "whole", tmp_path)) == []


def test_the_newest_datasets(tmp_path: Path) -> None:
    """So many are kept of those that this recorder made; each has the latched messages."""
    bag = make_drive(tmp_path / "drive.bag", frames=60)
    (tmp_path / "live_00").mkdir()
    options = {"max_duration": 0.5, "max_splits": 2, "repeat_latched": True}
    made = recorded(PlayedNode([bag]), tmp_path / "live", **options).datasets
    assert [one.dataset.name for one in made] == ["live_4", "live_5"]
    assert {path.name for path in tmp_path.glob("live*")} == {"live_00", "live_4", "live_5"}
    static = [one.data for one in messages([bag]) if one.channel.topic == "/tf_static"]
    for one in made:
        assert mp4ds.validate(one.dataset, deep=True) == []
        there = [*messages([again(one.dataset, tmp_path)])]
        assert [item.data for item in there if item.channel.topic == "/tf_static"] == static
        assert there[-1].log_time - there[0].log_time <= 500_000_000


def test_little_space(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It stops in time, with a dataset of all that came before, or does not begin."""
    paths, free = write(tmp_path), [10**9]
    usage, close, closed = shutil.disk_usage(tmp_path), MessageBuffer.close, threading.Event()

    def closing(buffer: MessageBuffer) -> None:
        close(buffer)
        closed.set()

    def after(number: int) -> None:
        if number == 20:
            free[0] = 10**6
            until(closed.is_set)  # nothing is taken any more

    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=free[0]))
    monkeypatch.setattr(MessageBuffer, "close", closing)
    Opened(PlayedNode(paths, before=after), monkeypatch)
    command = ("record", "--ros1", "-a", "-o", tmp_path / "live", "--no-progress", "--min-space")
    told = call(*command, "100M")
    assert told.code == 1
    assert "stopped: the file system has less free space than asked for" in told.err
    assert mp4ds.validate(tmp_path / "live", deep=True) == []
    recordings = [again(tmp_path / "live", tmp_path)], paths
    found, sent = ([bytes(one.data) for one in messages(made)] for made in recordings)
    assert {*sent[:19]} <= {*found} < {*sent}
    Opened(PlayedNode(paths), monkeypatch)
    told = call(*command[:4], tmp_path / "other", "--min-space", "100M")
    assert told.code == 2
    assert "less than 104857600 bytes free" in told.err
    assert not [*tmp_path.glob("other*")]


def test_pauses_and_splits_on_demand(tmp_path: Path) -> None:
    paths = write(tmp_path)
    with open_sources(paths) as reader:
        total = sum(isinstance(record, Message) for record in reader.records())
    node = PlayedNode(paths, before=lambda number: controls(number))
    with played(node, (), tmp_path / "live", RecordOptions(all=True)) as recorder:

        def controls(number: int) -> None:
            if number == total // 4:
                recorder.toggle_paused()
                assert recorder.is_paused
            elif number == total // 2:
                recorder.resume()
            elif number == 3 * total // 4:
                recorder.split()

        summary = recorder.run()
    assert [item.dataset.name for item in summary.datasets] == ["live", "live_1"]
    there = sum(topic.messages for item in summary.datasets for topic in item.topics)
    assert there == total - (total // 2 - total // 4)


# ---------------------------------------------------------------- too much


def test_packing_that_is_too_slow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The spool keeps what is not packed yet, beyond what the buffer holds; nothing is dropped."""
    monkeypatch.setattr(spool, "WINDOW_NS", 2_000_000_000)
    paths = write(tmp_path, of=scene("bayer_rggb8", frames=60, width=320, height=240))
    is_received = threading.Event()
    submit = ProcessExecutor.submit

    def slow(self: ProcessExecutor, *call: Any) -> Any:
        assert is_received.wait(WATCHDOG_S)
        return submit(self, *call)

    def watch(progress: RecordProgress) -> None:
        seen.append(progress)
        if progress.state == "finishing" and not progress.waiting_bytes:
            is_received.set()

    seen: list[RecordProgress] = []
    monkeypatch.setattr(ProcessExecutor, "submit", slow)
    node = PlayedNode(paths, rate=4.0)
    options = RecordOptions(all=True, buffer=1)
    with played(node, (), tmp_path / "live", options, progress=watch) as recorder:
        summary = recorder.run()
    assert max(progress.spool_bytes for progress in seen) > 3_000_000
    assert not summary.dropped
    assert mp4ds.validate(tmp_path / "live", deep=True) == []
    assert compare(paths, again(tmp_path / "live", tmp_path)) == []


def test_pieces_that_come_too_fast_wait_for_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An encoder that cannot keep up only takes from receiving."""
    # of three seconds, the first piece is complete after one and a half
    monkeypatch.setattr(spool, "WINDOW_NS", 500_000_000)
    monkeypatch.setattr(spool, "_PACKED_BYTES", 1000)
    paths = write(tmp_path, of=scene("bayer_rggb8", frames=90, width=64, height=48))
    is_received, submit = threading.Event(), ProcessExecutor.submit
    found: list[bool] = []

    def note(self: ProcessExecutor, *call: Any) -> Any:
        found.append(is_received.is_set())
        return submit(self, *call)

    monkeypatch.setattr(ProcessExecutor, "submit", note)
    options = RecordOptions(all=True)
    with played(node := PlayedNode(paths, rate=1.0), (), tmp_path / "live", options) as recorder:
        node.stop = lambda: (is_received.set(), recorder.stop())
        recorder.run()
    assert found == [True] * len(found)
    assert len(found) > 3  # pieces, and what joins them
    assert mp4ds.validate(tmp_path / "live", deep=True) == []
    assert compare(paths, again(tmp_path / "live", tmp_path)) == []


@pytest.mark.parametrize("why", ["out of order", "exited with code 7"])
def test_packing_that_fails(why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The recording goes on, what was recorded stays, and the command that packs it is named."""
    paths = write(tmp_path)
    if why == "out of order":
        fail_to_pack(1, "the encoder is out of order", monkeypatch)
        left = {"000000", "000001.mcap", "000002.mcap"}
    else:  # the process dies
        (tmp_path / "python").write_text("#!/bin/sh\nexit 7\n")
        (tmp_path / "python").chmod(0o755)
        monkeypatch.setattr("sys.executable", str(tmp_path / "python"))
        left = {"000000.mcap", "000001.mcap", "000002.mcap"}
    with pytest.raises(WriteError, match=rf"{why}.*--salvage .*live\.recording"):
        recorded(PlayedNode(paths), tmp_path / "live")
    assert not (tmp_path / "live").exists()
    assert left < {path.name for path in (tmp_path / "live.recording").iterdir()}
    summary = mp4ds.pack(tmp_path / "live.recording", tmp_path / "live", SALVAGE)
    assert not summary.losses
    assert compare(paths, again(tmp_path / "live", tmp_path)) == []


def test_a_buffer_that_is_full(tmp_path: Path) -> None:
    message = next(iter(messages(write(tmp_path))))
    buffer = MessageBuffer(3 * len(message.data))
    for number in range(5):
        buffer.put(replace(message, sequence=number))
    assert buffer.topics[message.channel.topic].dropped == 2
    buffer.close()
    buffer.put(message)
    found = [buffer.take(0.0) for _ in range(3)]
    assert [item.sequence for item in found if item] == [2, 3, 4]
    with pytest.raises(EOFError):
        buffer.take(0.0)
    assert buffer.topics[message.channel.topic].messages == 5


def test_a_disk_that_is_too_slow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What was sent is there, or was dropped and counted: by topic, here and in the dataset."""
    paths = write(tmp_path, of=scene("mono8", frames=40, width=256, height=256))
    sent = Counter(message.channel.topic for message in messages(paths))
    all_sent, write_message = threading.Event(), McapWriter.write

    def wait_and_write(self: McapWriter, message: Message) -> None:
        assert all_sent.wait(WATCHDOG_S)
        write_message(self, message)

    monkeypatch.setattr(McapWriter, "write", wait_and_write)
    options = RecordOptions(all=True, buffer=1)
    with played(node := PlayedNode(paths), (), tmp_path / "live", options) as recorder:
        node.stop = lambda: (all_sent.set(), recorder.stop())
        summary = recorder.run()
    (made,) = summary.datasets
    kept = Counter({one.topic: one.messages for one in made.topics})
    assert summary.dropped["/cam/image_raw"] > 20
    assert kept + Counter(summary.dropped) == sent
    with mp4ds.open(tmp_path / "live") as dataset:
        assert {tuple(one.topics): one.messages for one in dataset.manifest.losses} == {
            (topic,): count for topic, count in summary.dropped.items()
        }
    assert mp4ds.validate(tmp_path / "live", deep=True) == []


def test_times_that_no_recording_can_hold(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Such messages are left out and counted; the others are recorded."""
    paths = write(tmp_path, of=scene("mono8", frames=20))
    times = {
        3: -1,
        5: 2**63,
        7: 2**64,
        9: -(2**70),
        11: 0,
        13: 2**32 * 10**9,
        15: 2**32 * 10**9 - 1,
    }

    def altered(field: str, message: Message, number: int) -> Message:
        return replace(message, **{field: times[number]}) if number in times else message

    fields = {"/cam/image_raw": "log_time", "/imu": "publish_time"}
    each = {topic: partial(altered, field) for topic, field in fields.items()}
    Opened(PlayedNode(paths, altered=each), monkeypatch)
    told = call("record", "--ros1", "-a", "-o", tmp_path / "live", "--no-progress")
    assert told.code == 1
    why = "their log time is negative or too large"
    # a negative time of publishing is none: middlewares that do not know it say 0
    for topic, count in (("/cam/image_raw", 5), ("/imu", 3)):
        assert f"{topic}: {count} messages left out: {why}" in told.out
    assert mp4ds.validate(tmp_path / "live", deep=True) == []
    with mp4ds.open(tmp_path / "live") as dataset:
        assert len(dataset["/cam/image_raw"]) == 15


def messages(paths: list[Path]) -> Iterator[Message]:
    with open_sources(paths) as reader:
        for record in reader.records():
            if isinstance(record, Message):
                yield record


def test_a_disk_that_is_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What was written before is kept."""
    paths = write(tmp_path)
    due = next(iter(messages(paths)))

    def refuse(self: McapWriter, message: Message) -> None:
        if message.log_time - due.log_time > 700_000_000:
            raise OSError(28, "No space left on device")
        write_message(self, message)

    write_message = McapWriter.write
    monkeypatch.setattr(McapWriter, "write", refuse)
    with pytest.raises(WriteError, match=r"No space left.*--salvage .*live\.recording"):
        recorded(PlayedNode(paths), tmp_path / "live")
    monkeypatch.undo()
    assert not (tmp_path / "live").exists()
    mp4ds.pack(tmp_path / "live.recording", tmp_path / "live", SALVAGE)
    found = assert_prefix(paths, tmp_path / "live", tmp_path)
    assert 10 < found["/cam/image_raw"] < 40


# ---------------------------------------------------------------- power cuts


@pytest.fixture(scope="module")
def left(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Path], Path]:
    """A recording, and a folder in which it was being recorded when the recorder was killed."""
    place = tmp_path_factory.mktemp("killed")
    paths = write(place, of=scene("bayer_rggb8", frames=400, width=64, height=48))
    folder = place / "live.recording"
    command = [sys.executable, str(HERE / "record_scenes.py"), str(paths[0]), folder.stem, "4"]
    process = subprocess.Popen(command, cwd=place, stdin=subprocess.DEVNULL)

    def is_half_packed() -> bool:
        last = max(folder.glob("*.mcap"), default=None)
        return (folder / "000001").is_dir() and last is not None and last.stat().st_size > 40_000

    until(is_half_packed, process)
    process.send_signal(signal.SIGKILL)
    process.wait()

    def is_left() -> bool:  # by the process that packs, too
        try:
            SpoolFolder(folder).locked().close()
        except SourceError:
            return False
        return True

    until(is_left)
    return paths, folder


@pytest.fixture
def killed(left: tuple[list[Path], Path], tmp_path: Path) -> tuple[list[Path], Path]:
    """The same, to be changed."""
    shutil.copytree(left[1], tmp_path / "live.recording")
    return left[0], tmp_path / "live.recording"


@pytest.mark.slow
def test_no_recovery_while_it_is_packed(killed: tuple[list[Path], Path], tmp_path: Path) -> None:
    """The process that packs may live a little longer than its recorder."""
    _, folder = killed
    spool = SpoolFolder(folder)
    recorded = pytest.raises(SourceError, match="is being recorded")
    with spool.locked(shared=True), spool.locked(shared=True), recorded:
        mp4ds.pack(folder, tmp_path / "salvaged", SALVAGE)
    with spool.locked(), pytest.raises(SourceError, match="is being recovered"):
        spool.locked(shared=True)


def assert_prefix(paths: list[Path], dataset: Path, folder: Path) -> dict[str, int]:
    """What is in a dataset are the first messages of each topic; returns how many."""
    assert mp4ds.validate(dataset, deep=True) == []
    due: dict[str, list[Message]] = {}
    for message in messages(paths):
        due.setdefault(message.channel.topic, []).append(message)
    found: dict[str, list[Message]] = {}
    for message in messages([again(dataset, folder)]):
        found.setdefault(message.channel.topic, []).append(message)
    for topic, there in found.items():
        for one, other in zip(due[topic], there, strict=False):
            assert (one.log_time, bytes(one.data)) == (other.log_time, bytes(other.data))
            assert one.channel.identity == other.channel.identity
    return {topic: len(there) for topic, there in found.items()}


def test_a_recorder_that_is_killed(killed: tuple[list[Path], Path], tmp_path: Path) -> None:
    paths, folder = killed
    with pytest.raises(OptionError, match="--salvage"):
        mp4ds.pack(folder, tmp_path / "salvaged", PackOptions(quality="visual"))
    for wrong in (mp4ds.validate, mp4ds.open, partial(mp4ds.pack, dataset=tmp_path / "no")):
        with pytest.raises(mp4ds.Mp4dsError):
            wrong(folder)
    with pytest.raises(SourceError, match="pack --salvage"):
        open_sources([folder])
    with pytest.raises(SourceError, match="pack --salvage"):
        datasets_in(folder)
    before = tree(folder)
    summary = mp4ds.pack(folder, tmp_path / "salvaged", SALVAGE)
    assert [loss.problem for loss in summary.losses] == ["the file ends before its footer"]
    found = assert_prefix(paths, tmp_path / "salvaged", tmp_path)
    assert found["/cam/image_raw"] > 20
    assert tree(folder) == before
    with mp4ds.open(tmp_path / "salvaged") as dataset:
        assert len(dataset.streams) == 1


def test_a_spool_that_is_torn(killed: tuple[list[Path], Path], tmp_path: Path) -> None:
    """However much of its last piece reached the disk, what comes back is what was recorded."""
    paths, folder = killed
    last = max(folder.glob("*.mcap"))
    data = last.read_bytes()
    for number, cut in enumerate((0, 30, len(data) // 2, len(data) - 1)):
        for kind, rest in (("cut", b""), ("zeros", bytes(len(data) - cut))):
            last.write_bytes(data[:cut] + rest)
            made = tmp_path / f"made{number}{kind}"
            summary = mp4ds.pack(folder, made, SALVAGE)
            assert last.name in {loss.file for loss in summary.losses}
            found = assert_prefix(paths, made, tmp_path)
            assert found["/cam/image_raw"] > 10
            assert set(found) <= {message.channel.topic for message in messages(paths)}


def test_a_recording_that_is_being_made_is_left_alone(tmp_path: Path) -> None:
    seen = []

    def look(number: int) -> None:
        if number == 30:
            folder = tmp_path / "live.recording"
            until(lambda: (folder / RECORDING_NAME).exists())
            with pytest.raises(SourceError, match="is being recorded"):
                mp4ds.pack(folder, tmp_path / "early", SALVAGE)
            seen.append(number)

    recorded(PlayedNode(write(tmp_path), before=look), tmp_path / "live")
    assert seen == [30]
    assert not (tmp_path / "early").exists()


def test_a_piece_is_written_before_the_next_one_begins(tmp_path: Path) -> None:
    """Or a recorder that is killed would leave a gap."""
    jobs, process = ThreadPoolExecutor(1), ProcessExecutor(1)
    split = spool.Split(tmp_path / "drive", RecordOptions(), "ros1", [], process, jobs, print)
    channel = Channel(1, "/a", "ros1", Schema("std_msgs/String", "ros1msg", b"string data"), {})
    for time in (0, 1, 2, spool.WINDOW_NS):
        split.write(Message(channel, time, time, 0, bytes(5)))
    salvaged = McapSalvage(split.folder.piece(0))
    assert [m.log_time for m in salvaged.records() if isinstance(m, Message)] == [0, 1, 2]
    split.abandon()
    split.lock.close()
