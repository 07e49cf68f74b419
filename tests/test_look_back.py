"""`mp4ds record --keep-last`: what triggers save, what is removed, what a kill leaves."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.convert.converter import default_message

import mp4ds
from coded_scenes import CODED
from mp4ds.bags.formats import open_sources
from mp4ds.bags.mcap import McapWriter
from mp4ds.errors import Mp4dsError, Refused, WriteError
from mp4ds.packing.options import PackOptions
from mp4ds.packing.spool import SpoolFolder
from mp4ds.plugins.recording import record
from mp4ds.plugins.recording.lookback import LookBack, Saved
from mp4ds.plugins.recording.options import RecordOptions, Trigger
from mp4ds.plugins.recording.record import Recorder, RecordSummary
from mp4ds.plugins.recording.spool import Piece
from mp4ds.processes import ProcessExecutor
from mp4ds.records import Channel, Message
from player_scenes import START, make_drive, ros1_channel, ros2_channel
from record_scenes import PlayedNode, played
from scenes import typestore
from sources import SOURCES

S = 10**9
KEEP, MORE = 2.0, 0.5
STATIC = "/tf_static"
Row = tuple[str, int, bytes]


def messages(path: Path) -> list[Row]:
    with open_sources([path]) as reader:
        found = [one for one in reader.records() if isinstance(one, Message)]
        return [(one.channel.topic, one.log_time, bytes(one.data)) for one in found]


def again(dataset: Path, to: str = "bag") -> list[Row]:
    """The messages of a dataset."""
    path = dataset.with_name(f"{dataset.name}_again.{to}")
    mp4ds.unpack(dataset, to, path)
    return messages(path)


def looked_back(
    paths: list[Path],
    target: Path,
    acts: Mapping[int, Callable[[Recorder], object]],
    **more: Any,
) -> tuple[RecordSummary, list[int]]:
    """Play a recording to a recorder that looks back, and do something before messages of a number.

    Returns its summary, and the times at which that was done.
    """
    times: list[int] = []

    def act(number: int) -> None:
        if number in acts:
            times.append(node.time)
            acts[number](recorder)

    node = PlayedNode(paths, before=act, **more.pop("node", {}))
    options = RecordOptions(**{"all": True, "keep_last": KEEP, **more})
    with played(node, (), target, options) as recorder:
        return recorder.run(), times


def due(sent: list[Row], time: int, more: float = MORE) -> list[Row]:
    """What a trigger at a time is to save."""
    begin, end = time - round(KEEP * S), time + round(more * S)
    return [one for one in sent if begin <= one[1] < end or (one[0] == STATIC and one[1] < end)]


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """Eight seconds: a camera, transforms, and static ones, latched, at the very beginning."""
    return make_drive(tmp_path / "drive.bag", frames=160)


def test_what_triggers_save(drive: Path, tmp_path: Path) -> None:
    """Each the last seconds and what follows, whole, with latched messages from long before."""
    sent = messages(drive)
    # the second one in the time of the first; the last one is cut off by the end
    numbers = [len(sent) // 2, len(sent) // 2 + 20, len(sent) - 5]
    acts = dict.fromkeys(numbers, Recorder.snapshot)
    summary, times = looked_back([drive], tmp_path / "live", acts, and_then=MORE)
    made = [one.dataset for one in summary.datasets]
    assert {path.name for path in tmp_path.iterdir()} == {"drive.bag", *(one.name for one in made)}
    for time, dataset in zip(times, made, strict=True):
        assert dataset.name.startswith("live_20")
        assert mp4ds.validate(dataset, deep=True) == []
        assert again(dataset) == due(sent, time)
        with mp4ds.open(dataset) as opened:
            assert len(opened.streams) == 1
            assert opened.slice_start == time - round(KEEP * S)  # where `play` begins
            assert opened.latched_before == {STATIC: 2}


def test_video_that_arrives_coded(tmp_path: Path) -> None:
    """It begins at a key frame, which may be earlier; frames are complete from there on."""
    paths = SOURCES["rosbag2-mcap-v5"](tmp_path / "source", CODED["video-h264"](frames=120))
    everything = messages(*paths)
    sent = [one for one in everything if one[0] == "/cam/video"]
    acts = {3 * len(everything) // 4: Recorder.snapshot}
    summary, (time,) = looked_back(paths, tmp_path / "live", acts)
    (made,) = summary.datasets
    there = again(made.dataset, "rosbag2")
    found = [one for one in there if one[0] == "/cam/video"]
    inside = [one for one in sent if time - KEEP * S <= one[1] < time]
    assert len(inside) <= len(found) < len(sent)
    assert set(inside) <= set(found) <= set(sent)
    assert mp4ds.validate(made.dataset, deep=True) == []
    with mp4ds.open(made.dataset) as dataset:
        assert len(dataset.streams) == 1
        assert dataset.slice_start == min(one[1] for one in there)
        assert dataset.latched_before == {}


def test_nothing_is_left_without_a_trigger(drive: Path, tmp_path: Path) -> None:
    """And while it looks back, no more than the last seconds are on disk."""
    seen: list[int] = []

    def look(_: Recorder) -> None:
        sizes = [0]
        for path in tmp_path.glob("live*.recording/*.mcap"):
            with suppress(FileNotFoundError):  # it was just removed
                sizes.append(path.stat().st_size)
        seen.append(sum(sizes))

    acts = dict.fromkeys(range(100, 480, 20), look)
    summary, _ = looked_back([drive], tmp_path / "live", acts)
    assert summary.datasets == []
    assert [*tmp_path.iterdir()] == [drive]
    assert 0 < max(seen) < drive.stat().st_size


@pytest.mark.parametrize("is_removed", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_disk_that_is_full(
    is_removed: bool, drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was on disk by then is recovered: what was looked back at, and what was being saved.

    Also if a power cut brings back the piece whose latched messages piece 0 has.
    """
    sent, write, forget = messages(drive), McapWriter.write, LookBack._forget
    removed: list[tuple[Path, bytes]] = []

    def note(self: LookBack, piece: Piece) -> None:
        removed.append((piece.writer.path, piece.writer.path.read_bytes()))
        forget(self, piece)

    monkeypatch.setattr(LookBack, "_forget", note)
    _, full, _ = sent[3 * len(sent) // 4]

    def refuse(self: McapWriter, message: Message) -> None:
        if message.log_time >= full:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(self, message)

    monkeypatch.setattr(McapWriter, "write", refuse)
    acts = {len(sent) // 2: Recorder.snapshot}
    with pytest.raises(WriteError, match=r"No space left.*--salvage .*live_20"):
        looked_back([drive], tmp_path / "live", acts, and_then=60)
    folders = [*tmp_path.glob("live*.recording")]
    assert len(folders) == 2
    if not is_removed:
        removed[0][0].write_bytes(removed[0][1])
    for folder in folders:
        summary = mp4ds.pack(folder, folder.with_suffix(""), PackOptions(salvage=True))
        found = again(folder.with_suffix(""))
        assert {topic for topic, *_ in found} == {topic for topic, *_ in sent}
        assert len(found) == len({*found})
        if not is_removed and folder == removed[0][0].parent:
            continue  # it has the very first piece, too
        assert {one.problem for one in summary.losses} == {"the file ends before its footer"}
        begun = next(number for number, one in enumerate(found) if one[0] != STATIC)
        place = sent.index(found[begun])
        assert found[begun:] == sent[place : 3 * len(sent) // 4]
        assert sent[place][1] <= full - round(KEEP * S)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("what", ["its folder", "a link", "packing", "joining"])
def test_what_cannot_be_saved(
    what: str, drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It stays, and is recovered; the recorder goes on, and saves the next one."""
    sent = messages(drive)
    failed: list[Path] = []

    def failing(real: Callable[..., Any], is_due: Callable[..., bool]) -> Callable[..., Any]:
        def call(self: Any, *rest: Any, **more: Any) -> Any:
            if not failed and is_due(self, *rest):
                failed.append(tmp_path)
                raise OSError(errno.EDQUOT, "Disk quota exceeded")
            return real(self, *rest, **more)

        return call

    owner, name, is_due = {
        "its folder": (SpoolFolder, "begin", lambda self, _: any(tmp_path.glob("live*"))),
        "a link": (Saved, "link", lambda self, _: self.folder.piece(2).exists()),
        "packing": (ProcessExecutor, "submit", lambda self, *call: call[-1] == 2),
        "joining": (ProcessExecutor, "submit", lambda self, call, *_: "_join" in repr(call)),
    }[what]
    monkeypatch.setattr(owner, name, failing(getattr(owner, name), is_due))
    numbers = [len(sent) // 2, len(sent) - 5]
    acts = dict.fromkeys(numbers, Recorder.snapshot)
    summary, times = looked_back([drive], tmp_path / "live", acts, and_then=MORE)
    (made,) = summary.datasets
    assert again(made.dataset) == due(sent, times[1])
    folders = sorted(tmp_path.glob("live*.recording"))
    assert len(folders) == len(summary.failed) == (2 if what == "a link" else 1)
    found: set[Row] = set()
    assert any(f"{one}: " in summary.warnings[0] for one in folders)
    for folder in folders:
        assert any(f"Then run: mp4ds pack --salvage {folder} -o " in one for one in summary.failed)
        mp4ds.pack(folder, folder.with_suffix(""), PackOptions(salvage=True))
        rows = again(folder.with_suffix(""))
        assert len(rows) == len({*rows})
        found |= {*rows}
    assert {*due(sent, times[0])} <= found <= {*sent}


def test_names_that_others_take_meanwhile(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of a second recorder with the same name and trigger: the next number is taken."""
    monkeypatch.setattr(record, "_TIME", "now")
    monkeypatch.setattr(os.path, "lexists", lambda path: False)  # not yet
    (tmp_path / "live_now.recording").mkdir()
    (tmp_path / "live_now_2.recording").mkdir()
    sent = messages(drive)
    numbers = [len(sent) // 2, len(sent) - 5]
    summary, _ = looked_back([drive], tmp_path / "live", dict.fromkeys(numbers, Recorder.snapshot))
    assert [one.dataset.name for one in summary.datasets] == ["live_now_3", "live_now_4"]


def test_a_clock_that_jumps_back(drive: Path, tmp_path: Path) -> None:
    """As of a simulation that starts over: what is saved ends there, and old pieces go."""
    sent = messages(drive)
    first = sent[0][1]

    def altered(message: Message, number: int) -> Message:
        is_before = message.log_time - first < 4 * S
        return replace(message, log_time=message.log_time + 3600 * S * is_before)

    topics = {topic for topic, *_ in sent}
    numbers = [len(sent) // 2 - 20, len(sent) - 1]
    acts = dict.fromkeys(numbers, Recorder.snapshot)
    altering = {"altered": dict.fromkeys(topics, altered)}
    summary, times = looked_back([drive], tmp_path / "live", acts, and_then=60, node=altering)
    before, after = (again(one.dataset) for one in summary.datasets)
    begin = times[0] - round(KEEP * S)
    assert "the clock has jumped" in summary.warnings[0]
    assert before == [
        (topic, time + 3600 * S, data)
        for topic, time, data in sent
        if time - first < 4 * S and (topic == STATIC or begin <= time + 3600 * S)
    ]
    moving = [one for one in after if one[0] != STATIC]
    assert moving == [one for one in sent if one[1] >= times[1] - round(KEEP * S)]
    assert len(after) == len(moving) + 2


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"keep_last": None, "and_then": 10}, "need `keep_last`"),
        ({"keep_last": None, "trigger": ["/go"]}, "need `keep_last`"),
        ({"max_duration": 60}, "contradicts"),
        ({"max_splits": 2}, "contradicts"),  # it would delete what was saved
        ({"limit": 20}, "contradicts"),  # it would stop before anybody could trigger
        ({"keep_last": 0}, "more than 0"),
        ({"repeat_latched": True}, "saves latched messages with each dataset"),
        ({"trigger": ["/battery:percentage=0.2"]}, "neither TOPIC nor TOPIC:FIELD>VALUE"),
        ({"trigger": ["/battery:a..b>0"]}, "neither TOPIC nor TOPIC:FIELD>VALUE"),
        ({}, "cannot link files"),
    ],
)
def test_what_makes_no_sense(
    options: dict[str, Any],
    said: str,
    drive: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(Path, "hardlink_to", refuse)
    with pytest.raises(Mp4dsError, match=said):
        looked_back([drive], tmp_path / "live", {}, **options)
    assert [*tmp_path.iterdir()] == [drive]


@pytest.mark.parametrize("and_then", [None, 1.0])
def test_messages_that_trigger(and_then: float | None, drive: Path, tmp_path: Path) -> None:
    """Those that come soon after one of them belong to it."""
    summary, _ = looked_back(
        [drive], tmp_path / "live", {}, exclude=[STATIC], trigger=[STATIC], and_then=and_then
    )
    (made,) = summary.datasets  # one message follows the other in no time
    assert STATIC not in {topic.topic for topic in made.topics}


def test_conditions_that_trigger(drive: Path, tmp_path: Path) -> None:
    """Once, when they become true; those that cannot are told, and the others go on."""
    second = START // S + 4
    good = f"/tf:transforms[0].header.stamp.sec>={second}"
    summary, _ = looked_back([drive], tmp_path / "live", {}, trigger=["/tf:speed > 1", good])
    (made,) = summary.datasets
    sent = messages(drive)
    at = next(one[1] for one in sent if one[0] == "/tf" and one[1] >= second * S)
    assert again(made.dataset) == due(sent, at, more=0)
    (warning,) = summary.warnings
    assert "--trigger '/tf:speed > 1' cannot trigger: there is no field 'speed'" in warning
    assert "tf2_msgs/msg/TFMessage has transforms" in warning


BATTERY, DIAGNOSTICS = "sensor_msgs/{}BatteryState", "diagnostic_msgs/{}DiagnosticArray"


def typed(world: str, kind: str) -> Channel:
    make = ros1_channel if world == "ros1" else ros2_channel
    return make(0, "/x", kind.format("" if world == "ros1" else "msg/"), "")


def sent_as(channel: Channel, **fields: Any) -> bytes:
    """A message; a field of a part is named with two underscores."""
    store, kind = typestore(channel.message_encoding), channel.type_name
    kind = kind if "/msg/" in kind else kind.replace("/", "/msg/")
    value = default_message(store, kind)
    for name, field in fields.items():
        *parts, last = name.split("__")
        target = value
        for part in parts:
            target = getattr(target, part)
        setattr(target, last, field)
    is_ros1 = channel.message_encoding == "ros1"
    write = store.serialize_ros1 if is_ros1 else store.serialize_cdr
    return bytes(write(value, kind))


@pytest.mark.parametrize("world", ["ros1", "ros2"])
@pytest.mark.parametrize(
    ("condition", "field", "values", "expected"),
    [
        ("percentage<0.2", "percentage", [0.5, 0.1, 0.1, 0.5, 0.1], [1, 4]),
        ("percentage<=0.2", "percentage", [0.2, 0.1, float("nan"), 0.2], [0, 3]),  # float32
        ("header.stamp.sec != 7", "header__stamp__sec", [7, 8, 9, 7, 8], [1, 4]),
        ("present == true", "present", [False, True, True, False, True], [1, 4]),
        ("location=='dock 1'", "location", ["", "dock 1", "dock 2", "dock 1"], [1, 3]),
        ("location==dock 1", "location", ["", "dock 1", "dock 2", "dock 1"], [1, 3]),
        ("power_supply_status>=2", "power_supply_status", [1, 3, 2, 1, 2], [1, 4]),
        ("cell_voltage[1]>4", "cell_voltage", [[], [5, 4], [4, 5], [5], [5, 5]], [2, 4]),
    ],
)
def test_values_that_trigger(
    world: str, condition: str, field: str, values: list[Any], expected: list[int]
) -> None:
    channel = typed(world, BATTERY)
    is_triggered = Trigger(f"/x:{condition}").watch(channel)
    if isinstance(values[0], list):
        values = [np.array(one, np.float32) for one in values]
    payloads = [sent_as(channel, **{field: one}) for one in values]
    assert [number for number, one in enumerate(payloads) if is_triggered(one)] == expected
    assert not is_triggered(b"damaged")
    assert is_triggered(payloads[expected[0]])  # it has ended with what cannot be read


@pytest.mark.parametrize("world", ["ros1", "ros2"])
def test_levels_that_trigger(world: str) -> None:
    """Which are bytes."""
    channel = typed(world, DIAGNOSTICS)
    is_triggered = Trigger("/x: status[0].level >= 2").watch(channel)
    store = typestore(channel.message_encoding)
    status = default_message(store, "diagnostic_msgs/msg/DiagnosticStatus")
    found = []
    for level in (0, 2, 1, 2):
        status = replace(status, level=level)
        found.append(is_triggered(sent_as(channel, status=[status])))
    assert found == [False, True, False, True]


@pytest.mark.parametrize(
    ("condition", "said"),
    [
        ("voltag>1", "there is no field 'voltag': a sensor_msgs/msg/BatteryState has header, "),
        ("header.stamp.secs>1", "there is no field 'secs': .*Time has sec, nanosec"),
        ("voltage.x>1", "there is no field 'x'"),
        ("header>1", "header is a std_msgs/msg/Header: choose .*, header.stamp, header.frame_id"),
        ("cell_voltage>1", r"cell_voltage is an array: choose an element, such as .*\[0\]"),
        ("voltage[0]>1", "voltage is no array"),
        ("voltage>low", "voltage is a float32, which 'low' is not"),
        ("present>1", "present is a bool: compare it with == or !="),
        ("present==1", "present is a bool, which '1' is not"),
        ("location<x", "location is a string: compare it with == or !="),
    ],
)
def test_conditions_that_cannot_be(condition: str, said: str) -> None:
    with pytest.raises(Refused, match=said):
        Trigger(f"/x:{condition}").watch(typed("ros2", BATTERY))
