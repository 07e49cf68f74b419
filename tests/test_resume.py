"""A pack in parts that was interrupted goes on; one that is another is refused."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import threading
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import mp4ds
from in_parts import WORK, InlineExecutor, facts, leftovers, use
from mp4ds.bags.ros1 import Ros1Reader
from mp4ds.errors import (
    FormatError,
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
from round_trips import Compare, unpacked
from sources import SOURCES, scene
from waiting import until

IN_PARTS = PackOptions(window=3, codec="h264")
PARTS = [f"0000{number}" for number in range(4)]


@pytest.fixture
def source(tmp_path: Path) -> Path:
    (path,) = SOURCES["bag-none"](tmp_path / "source", scene("bayer_rggb8", frames=12))
    return path


@pytest.fixture
def expected(source: Path, tmp_path: Path) -> dict[str, Any]:
    mp4ds.pack(source, tmp_path / "whole", PackOptions(codec="h264"))
    return facts(tmp_path / "whole")


def fail_at(tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    use(monkeypatch, InlineExecutor(lambda task: task == name))
    with pytest.raises(PartsFailedError, match=r"run the same command again to resume"):
        mp4ds.pack(source, tmp_path / "dataset", IN_PARTS)


def test_it_goes_on_from_the_last_finished_part(
    tmp_path: Path,
    source: Path,
    expected: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
    compare: Compare,
) -> None:
    fail_at(tmp_path, source, monkeypatch, PARTS[2])
    assert not (tmp_path / "dataset").exists()
    assert leftovers(tmp_path) == [WORK]
    executor = use(monkeypatch, InlineExecutor())
    mp4ds.pack(source, tmp_path / "dataset", IN_PARTS)
    assert executor.ran == PARTS[2:]
    assert leftovers(tmp_path) == []
    assert facts(tmp_path / "dataset") == expected
    assert compare([source], unpacked(tmp_path, "bag")) == []


class SlowToShow(InlineExecutor):
    """Whose last result is seen a while after its call is done, as on a shared file system."""

    def __init__(self, part: Path) -> None:
        super().__init__()
        self._part = part

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Any:
        future = super().submit(fn, *args, **kwargs)
        if self._part.exists():
            hidden = self._part.rename(self._part.with_name(f".{self._part.name}"))
            threading.Timer(1.0, hidden.rename, (self._part,)).start()
        return future


def test_a_result_that_is_seen_late_is_waited_for(
    tmp_path: Path, source: Path, expected: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    use(monkeypatch, SlowToShow(tmp_path / WORK / PARTS[3]))
    mp4ds.pack(source, tmp_path / "dataset", IN_PARTS)
    assert facts(tmp_path / "dataset") == expected


def test_keep_going_runs_all_others_and_names_what_failed(
    tmp_path: Path, source: Path, expected: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    executor = use(monkeypatch, InlineExecutor(lambda name: name in (PARTS[0], PARTS[2])))
    with pytest.raises(PartsFailedError) as caught:
        mp4ds.pack(source, tmp_path / "dataset", replace(IN_PARTS, keep_going=True))
    assert caught.value.failures == [(PARTS[0], "the disk is full"), (PARTS[2], "the disk is full")]
    assert caught.value.exit_code == 1
    assert str(caught.value).startswith(f"{tmp_path / 'dataset'}: 2 of 4 parts could not be packed")
    assert executor.ran == [PARTS[1], PARTS[3]]
    executor = use(monkeypatch, InlineExecutor())
    mp4ds.pack(source, tmp_path / "dataset", IN_PARTS)
    assert executor.ran == [PARTS[0], PARTS[2]]
    assert facts(tmp_path / "dataset") == expected


def test_where_nothing_was_finished_nothing_is_left(
    tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fail_at(tmp_path, source, monkeypatch, PARTS[0])
    assert leftovers(tmp_path) == []


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
    options: dict[str, Any],
    sentence: str,
    tmp_path: Path,
    source: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fail_at(tmp_path, source, monkeypatch, PARTS[1])
    with pytest.raises(OptionError, match=sentence):
        mp4ds.pack(source, tmp_path / "dataset", replace(IN_PARTS, **options))
    assert leftovers(tmp_path) == [WORK]


@pytest.mark.parametrize("change", ["longer", "touched", "byte", "missing"])
def test_a_changed_source_is_refused(
    change: str, tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fail_at(tmp_path, source, monkeypatch, PARTS[1])
    state = source.stat()
    if change == "missing":
        source.unlink()
    else:
        data = bytearray(source.read_bytes())
        if change == "byte":
            data[100] ^= 1
        source.write_bytes(data + b"x" * (change == "longer"))
        if change == "byte":
            os.utime(source, ns=(state.st_atime_ns, state.st_mtime_ns))
    with pytest.raises(SourceError, match=r"has changed|no such file|cannot be read"):
        mp4ds.pack(source, tmp_path / "dataset", IN_PARTS)


def test_another_recording_under_the_same_name_is_refused(
    tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fail_at(tmp_path, source, monkeypatch, PARTS[1])
    other = shutil.copy(source, tmp_path / "other.bag")
    with pytest.raises(OptionError, match=r"holds an unfinished pack of .*`restart`"):
        mp4ds.pack(other, tmp_path / "dataset", IN_PARTS)


def test_restart_begins_anew(
    tmp_path: Path, source: Path, expected: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    fail_at(tmp_path, source, monkeypatch, PARTS[3])
    executor = use(monkeypatch, InlineExecutor())
    mp4ds.pack(source, tmp_path / "dataset", replace(IN_PARTS, restart=True))
    assert executor.ran == PARTS
    assert facts(tmp_path / "dataset") == expected


def test_parts_without_a_plan_are_made_again(
    tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fail_at(tmp_path, source, monkeypatch, PARTS[2])
    (tmp_path / WORK / "plan.json").unlink()
    executor = use(monkeypatch, InlineExecutor())
    mp4ds.pack(source, tmp_path / "dataset", replace(IN_PARTS, codec="ffv1"))
    assert executor.ran == PARTS
    assert len(mp4ds.Dataset(tmp_path / "dataset").streams) == 1


def test_parts_that_are_being_discarded_keep_their_plan(
    tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fail_at(tmp_path, source, monkeypatch, PARTS[2])
    other = replace(IN_PARTS, codec="ffv1")

    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", interrupt)
        with pytest.raises(KeyboardInterrupt):
            mp4ds.pack(source, tmp_path / "dataset", replace(other, restart=True))
    with pytest.raises(OptionError, match="different `codec`"):
        mp4ds.pack(source, tmp_path / "dataset", other)


@pytest.mark.parametrize("damage", ["record", "video", "sidecar", "missing"])
def test_a_part_that_is_not_whole_is_made_again(
    damage: str,
    tmp_path: Path,
    source: Path,
    expected: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fail_at(tmp_path, source, monkeypatch, PARTS[3])
    part = tmp_path / WORK / PARTS[1]
    name = {"record": "part.json", "video": "cam_image_raw.mp4"}.get(damage, "cam_image_raw.yaml")
    if damage == "missing":
        (part / name).unlink()
    else:
        os.truncate(part / name, 100)
    executor = use(monkeypatch, InlineExecutor())
    mp4ds.pack(source, tmp_path / "dataset", IN_PARTS)
    assert executor.ran == [PARTS[1], PARTS[3]]
    assert facts(tmp_path / "dataset") == expected


def test_a_video_that_rotted_is_not_joined(
    tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fail_at(tmp_path, source, monkeypatch, PARTS[3])
    video = tmp_path / WORK / PARTS[1] / "cam_image_raw.mp4"
    data = bytearray(video.read_bytes())
    data[len(data) // 2] ^= 1
    video.write_bytes(data)
    use(monkeypatch, InlineExecutor())
    with pytest.raises(FormatError, match=r"cam_image_raw.mp4.*was damaged after"):
        mp4ds.pack(source, tmp_path / "dataset", IN_PARTS)
    assert not (tmp_path / "dataset").exists()


def test_two_at_a_time_are_refused(
    tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refusals = []

    def meanwhile(_: str) -> bool:
        with pytest.raises(TargetError, match=r"another mp4ds is working there"):
            mp4ds.pack(source, tmp_path / "dataset", IN_PARTS)
        refusals.append(1)
        return False

    use(monkeypatch, InlineExecutor(meanwhile))
    mp4ds.pack(source, tmp_path / "dataset", IN_PARTS)
    assert refusals


@pytest.mark.parametrize(
    "interruption", [KeyboardInterrupt(), SystemExit(143)], ids=["ctrl-c", "sigterm"]
)
def test_an_interrupt_keeps_what_is_finished(
    interruption: BaseException, tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(name: str) -> bool:
        if name == PARTS[2]:
            raise interruption
        return False

    use(monkeypatch, InlineExecutor(interrupt))
    with pytest.raises(type(interruption)) as caught:
        mp4ds.pack(source, tmp_path / "dataset", IN_PARTS)
    assert "run the same command again to resume" in caught.value.args[0]
    assert getattr(caught.value, "code", 143) == 143
    executor = use(monkeypatch, InlineExecutor())
    mp4ds.pack(source, tmp_path / "dataset", IN_PARTS)
    assert executor.ran == PARTS[2:]


@pytest.mark.parametrize("broken", ["not json", "{}", '{"paths": 3}'])
def test_a_damaged_note_of_the_plan_is_refused(
    broken: str, tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fail_at(tmp_path, source, monkeypatch, PARTS[1])
    (tmp_path / WORK / "plan.json").write_text(broken)
    with pytest.raises(TargetError, match=r"`restart`"):
        mp4ds.pack(source, tmp_path / "dataset", IN_PARTS)


# ---------------------------------------------------------------- shares


def test_shares_of_several_machines_are_joined(
    tmp_path: Path, source: Path, expected: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    executor = use(monkeypatch, InlineExecutor())
    with pytest.raises(OptionError, match=r"nothing to join"):
        mp4ds.pack(source, tmp_path / "dataset", replace(IN_PARTS, join=True))
    for number in (3, 1):
        pack_share(source, tmp_path / "dataset", (number, 3), IN_PARTS)
    assert sorted(executor.ran) == [PARTS[0], PARTS[2], PARTS[3]]
    with pytest.raises(OptionError, match=rf"1 of 4 parts are missing: {PARTS[1]}"):
        mp4ds.pack(source, tmp_path / "dataset", replace(IN_PARTS, join=True))
    pack_share(source, tmp_path / "dataset", (2, 3), IN_PARTS)
    assert not (tmp_path / "dataset").exists()
    mp4ds.pack(source, tmp_path / "dataset", replace(IN_PARTS, join=True))
    assert len(executor.ran) == 4
    assert facts(tmp_path / "dataset") == expected
    assert leftovers(tmp_path) == []


# ---------------------------------------------------------------- many recordings


def test_many_recordings_are_one_job(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compare: Compare
) -> None:
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
    with pytest.raises(OptionError, match="would both become"):
        pack_each([paths[0], paths[0]], tmp_path / "datasets", IN_PARTS)
    paths[1].replace(paths[0])
    with pytest.raises(TargetExistsError):
        pack_each(paths[:1], tmp_path / "datasets", IN_PARTS)


class LastFirst(InlineExecutor):
    """Makes the last of so many calls first."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self._waiting: list[tuple[Future[Any], Any, Any]] = []
        self._count = count

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Any:
        future: Future[Any] = Future()
        self._waiting.append((future, fn, args))
        if len(self._waiting) == self._count:
            threading.Thread(target=self._run).start()
        return future

    def _run(self) -> None:
        for future, fn, args in reversed(self._waiting):
            future.set_result(super().submit(fn, *args).result())


def test_summaries_are_in_the_order_of_the_sources(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whichever was done first."""
    paths = []
    for name in ("b", "a", "c"):
        (path,) = SOURCES["bag-none"](tmp_path, scene("mono8", frames=9))
        paths.append(path.rename(tmp_path / f"{name}.bag"))
    use(monkeypatch, LastFirst(3 * (3 + 1)))
    done = pack_each(paths, tmp_path / "datasets", IN_PARTS)
    assert [summary.dataset.name for summary in done] == ["b", "a", "c"]


# ---------------------------------------------------------------- killed, in earnest


@pytest.fixture(scope="module")
def long_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("long") / "drive.bag"
    demo(path, seconds=6)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("kills", [1, 20], ids=["once", "storm"])
def test_killed_at_random_moments_it_ends_as_if_it_had_not_been(
    kills: int, tmp_path: Path, long_bag: Path, compare: Compare
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


def test_messages_are_counted_by_channel(
    tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An index that gives one publisher's message to another of the same topic is wrong, too."""
    use(monkeypatch, InlineExecutor())
    true = Ros1Reader.stats

    def stats(reader: Ros1Reader) -> dict[int, ChannelStats]:
        found = dict(true(reader))
        more, less = [item.id for item in reader.channels if item.topic == "/chatter"][:2]
        found[more] = replace(found[more], count=found[more].count + 1)
        found[less] = replace(found[less], count=found[less].count - 1)
        return found

    monkeypatch.setattr(Ros1Reader, "stats", stats)
    with pytest.raises(SourceError, match=r"its index lists \d messages on /chatter, but \d were"):
        mp4ds.pack(source, tmp_path / "dataset", IN_PARTS)
    assert not (tmp_path / "dataset").exists()
