"""A pack in parts that was interrupted goes on; one that is another is refused."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import mp4ds
from commands import run
from compare import compare
from in_parts import IN_PARTS, WORK, InlineExecutor, Pack, facts, leftovers, use
from mp4ds.bags.ros1 import Ros1Reader
from mp4ds.errors import (
    OptionError,
    PartsFailedError,
    SourceError,
    TargetError,
    TargetExistsError,
)
from mp4ds.packing.options import PackOptions
from mp4ds.packing.pack import pack_each, pack_share
from mp4ds.plugins.demo import demo
from mp4ds.records import ChannelStats
from round_trips import unpacked
from sources import SOURCES, scene
from waiting import until

PARTS = [f"0000{number}" for number in range(4)]


@pytest.fixture
def pack(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Pack:
    return Pack(tmp_path, "bag-none", monkeypatch, frames=12)


@pytest.fixture
def stopped(pack: Pack) -> Callable[[int], Path]:
    """Have a part fail; returns the folder of those before it."""

    def stop(number: int) -> Path:
        fails = InlineExecutor(lambda name: name == PARTS[number])
        pack.refused("run the same command again to resume", fails)
        assert leftovers(pack.target.parent) == ([WORK] if number else [])
        return pack.target.with_name(WORK)

    return stop


def test_it_goes_on_from_the_last_finished_part(
    pack: Pack, stopped: Callable[[int], Path], tmp_path: Path
) -> None:
    stopped(0)  # where nothing was finished, nothing is left
    stopped(2)
    assert pack.goes_on() == PARTS[2:]
    assert compare([pack.source], unpacked(tmp_path, "bag")) == []


def test_keep_going_runs_all_others_and_names_what_failed(pack: Pack) -> None:
    executor = InlineExecutor(lambda name: name in (PARTS[0], PARTS[2]))
    error = pack.refused(f"{pack.target}: 2 of 4 parts could not be", executor, keep_going=True)
    assert isinstance(error, PartsFailedError)
    assert error.failures == [(PARTS[0], "the disk is full"), (PARTS[2], "the disk is full")]
    assert error.exit_code == 1
    assert executor.ran == [PARTS[1], PARTS[3]]
    assert pack.goes_on() == [PARTS[0], PARTS[2]]


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"codec": "ffv1"}, r"different `codec`: 'h264', and now it is 'ffv1'.*`restart`"),
        ({"codec": None}, r"different `codec`: 'h264', and now it is None.*`restart`"),
        ({"window": 4}, r"different `window`: 3, and now it is 4"),
        ({"quality": "crf=20"}, r"different `quality`: 'lossless', and now it is 'crf=20'"),
        ({"exclude": ["/imu"]}, r"different `exclude`: \[\], and now it is \['/imu'\]"),
    ],
)
def test_other_options_are_refused(
    options: dict[str, Any], sentence: str, pack: Pack, stopped: Callable[[int], Path]
) -> None:
    stopped(1)
    assert isinstance(pack.refused(sentence, **options), OptionError)
    assert pack.goes_on() == PARTS[1:]


@pytest.mark.parametrize("change", ["longer", "touched", "byte", "missing"])
def test_a_changed_source_is_refused(
    change: str, pack: Pack, stopped: Callable[[int], Path]
) -> None:
    stopped(1)
    state = pack.source.stat()
    if change == "missing":
        pack.source.unlink()
    else:
        data = bytearray(pack.source.read_bytes())
        if change == "byte":
            data[100] ^= 1
        pack.source.write_bytes(data + b"x" * (change == "longer"))
        if change == "byte":
            os.utime(pack.source, ns=(state.st_atime_ns, state.st_mtime_ns))
    error = pack.refused(r"has changed|no such file|cannot be read")
    assert isinstance(error, SourceError)


def test_restart_begins_anew(pack: Pack, stopped: Callable[[int], Path]) -> None:
    stopped(3)
    assert pack.run(restart=True) == PARTS
    assert facts(pack.target) == pack.expected


@pytest.mark.one_in(2)
@pytest.mark.parametrize(
    "name", ["part.json", "cam_image_raw.mp4", "cam_image_raw.yaml", "-cam_image_raw.yaml"]
)
def test_a_part_that_is_not_whole_is_made_again(
    name: str, pack: Pack, stopped: Callable[[int], Path]
) -> None:
    path = stopped(3) / PARTS[1] / name.lstrip("-")
    if name.startswith("-"):
        path.unlink()
    else:
        os.truncate(path, 100)
    assert pack.goes_on() == [PARTS[1], PARTS[3]]


def test_two_at_a_time_are_refused(pack: Pack) -> None:
    refusals = []

    def meanwhile(_: str) -> bool:
        with pytest.raises(TargetError, match=r"another mp4ds is working there"):
            mp4ds.pack(pack.source, pack.target, IN_PARTS)
        refusals.append(1)
        return False

    pack.run(InlineExecutor(meanwhile))
    assert refusals


@pytest.mark.parametrize(
    "interruption", [KeyboardInterrupt(), SystemExit(143)], ids=["ctrl-c", "sigterm"]
)
def test_an_interrupt_keeps_what_is_finished(interruption: BaseException, pack: Pack) -> None:
    def interrupt(name: str) -> bool:
        if name == PARTS[2]:
            raise interruption
        return False

    with pytest.raises(type(interruption)) as caught:
        pack.run(InlineExecutor(interrupt))
    assert "run the same command again to resume" in caught.value.args[0]
    assert getattr(caught.value, "code", 143) == 143
    assert pack.goes_on() == PARTS[2:]


@pytest.mark.parametrize("broken", ["not json", "{}", '{"paths": 3}'])
def test_a_damaged_note_of_the_plan_is_refused(
    broken: str, pack: Pack, stopped: Callable[[int], Path]
) -> None:
    (stopped(1) / "plan.json").write_text(broken)
    assert isinstance(pack.refused(r"`restart`"), TargetError)


# ---------------------------------------------------------------- shares


def test_shares_of_several_machines_are_joined(pack: Pack, monkeypatch: pytest.MonkeyPatch) -> None:
    pack.refused("nothing to join", join=True)
    executor = use(monkeypatch, InlineExecutor())
    for number in (3, 1):
        pack_share(pack.source, pack.target, (number, 3), IN_PARTS)
    assert sorted(executor.ran) == [PARTS[0], PARTS[2], PARTS[3]]
    pack.refused(rf"1 of 4 parts are missing: {PARTS[1]}", join=True)
    use(monkeypatch, executor)
    pack_share(pack.source, pack.target, (2, 3), IN_PARTS)
    assert len(executor.ran) == 4
    assert not pack.target.exists()
    assert pack.run(join=True) == []
    assert facts(pack.target) == pack.expected
    assert leftovers(pack.target.parent) == []


# ---------------------------------------------------------------- many recordings


def test_many_recordings_are_one_job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Long ones, short ones, and one that is there already."""
    (tmp_path / "source").mkdir()
    paths = []
    for number, frames in enumerate((12, 2, 9)):
        folder = tmp_path / "source" / str(number)
        folder.mkdir()
        (path,) = SOURCES["bag-none"](folder, scene("mono8", frames=frames))
        paths.append(path.rename(tmp_path / "source" / f"drive{number}.bag"))
    executor = use(monkeypatch, InlineExecutor())
    done = pack_each(paths[:2], tmp_path / "datasets", IN_PARTS)
    assert [summary.dataset.name for summary in done] == ["drive0", "drive1"]
    ran = len(executor.ran)
    (summary,) = pack_each(paths, tmp_path / "datasets", IN_PARTS)
    assert summary.dataset.name == "drive2"
    assert len(executor.ran) == ran + 3
    assert leftovers(tmp_path / "datasets") == []
    for path in paths:
        assert mp4ds.validate(tmp_path / "datasets" / path.stem, deep=True) == []
        again = tmp_path / f"{path.stem}-again.bag"
        mp4ds.unpack(tmp_path / "datasets" / path.stem, "bag", again)
        assert compare([path], again) == []
    result = run("pack", *paths, "-o", f"{tmp_path}/datasets/")
    assert (result.code, result.out) == (
        0,
        f"3 recordings already packed in {tmp_path}/datasets/\n",
    )
    with pytest.raises(OptionError, match="would both become"):
        pack_each([paths[0], paths[0]], tmp_path / "datasets", IN_PARTS)
    paths[1].replace(paths[0])
    with pytest.raises(TargetExistsError):
        pack_each(paths[:1], tmp_path / "datasets", IN_PARTS)


# ---------------------------------------------------------------- killed, in earnest


@pytest.fixture(scope="module")
def long_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("long") / "drive.bag"
    demo(path, seconds=6)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("kills", [1, 20], ids=["once", "storm"])
def test_killed_at_random_moments_it_ends_as_if_it_had_not_been(
    kills: int, tmp_path: Path, long_bag: Path
) -> None:
    mp4ds.pack(long_bag, tmp_path / "whole", PackOptions(codec="h264"))
    command = [
        *(sys.executable, "-m", "mp4ds", "pack", str(long_bag), "-o", str(tmp_path / "dataset")),
        *("--window", "15", "--codec", "h264", "--jobs", "2"),
    ]
    rng = random.Random(kills)
    done = 0
    for _ in range(kills):
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        try:
            process.wait(rng.uniform(0.3, 4))  # any moment will do
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            done += 1
        process.communicate()
        if (tmp_path / "dataset").exists():
            break
    assert done
    if not (tmp_path / "dataset").exists():
        ended: list[subprocess.CompletedProcess[str]] = []

        def is_free() -> bool:  # workers end by themselves
            ended.append(subprocess.run(command, capture_output=True, check=False, text=True))
            return "working there" not in ended[-1].stderr

        until(is_free)
        last = ended[-1]
        assert last.returncode == 0, last.stderr
    assert facts(tmp_path / "dataset") == facts(tmp_path / "whole")
    assert leftovers(tmp_path) == []
    assert mp4ds.validate(tmp_path / "dataset", deep=True) == []
    assert compare([long_bag], unpacked(tmp_path, "bag")) == []


def test_messages_are_counted_by_channel(pack: Pack, monkeypatch: pytest.MonkeyPatch) -> None:
    """An index that gives one publisher's message to another of the same topic is wrong, too."""
    true = Ros1Reader.stats

    def stats(reader: Ros1Reader) -> dict[int, ChannelStats]:
        found = dict(true(reader))
        more, less = [item.id for item in reader.channels if item.topic == "/chatter"][:2]
        found[more] = replace(found[more], count=found[more].count + 1)
        found[less] = replace(found[less], count=found[less].count - 1)
        return found

    monkeypatch.setattr(Ros1Reader, "stats", stats)
    pack.refused(r"its index lists \d messages on /chatter, but \d were")
