"""Hard times of a pack in parts: each is told in a sentence, and the same command ends it well.

The disk is full at every page and every file, the recording fails or changes while it is read,
processes die, folders vanish. The recording is never touched, nothing stands under the dataset's
name before it is whole, and what comes out at last is what an undisturbed pack makes.
"""

from __future__ import annotations

import errno
import hashlib
import io
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import mp4ds
from commands import NEEDS_ROOT, call, run, start, tree
from compare import compare
from in_parts import WORK, InlineExecutor, Pack, facts, leftovers
from mp4ds.errors import Mp4dsError, PartsFailedError, SourceError, TargetError, WriteError
from mp4ds.packing.options import PackOptions
from mp4ds.packing.parts import PartPacker
from mp4ds.packing.planning import Piece
from mp4ds.plugins.demo import demo
from mp4ds.processes import ProcessExecutor
from round_trips import unpacked
from waiting import WATCHDOG_S, is_alive, until

PARTS = ["00000", "00001"]
PAGE = 4096
KINDS = ["bag-none", "mcap-ros2-zstd", "rosbag2-sqlite3-v9", "rosbag2-mcap-v9"]
AGAIN = "run the same command again to resume"


def instead_of_open(patch: pytest.MonkeyPatch, opened: Callable[..., Any]) -> None:
    """Have files opened by another function, those of `pathlib`, too."""
    patch.setattr("io.open", opened)
    if sys.version_info < (3, 11):  # which keeps io.open as a method of its own
        patch.setattr("pathlib._NormalAccessor.open", staticmethod(opened))


@pytest.fixture
def pack(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Pack:
    """Of a bag, or of the kind that a test names."""
    made = Pack(tmp_path, getattr(request, "param", "bag-none"), monkeypatch)
    assert made.expected
    return made


def before_task(name: str, action: Callable[[], object]) -> InlineExecutor:
    """An executor that does something before it runs a task."""

    def meanwhile(task: str) -> bool:
        if task == name:
            action()
        return False

    return InlineExecutor(meanwhile)


@contextmanager
def disk_of(folder: Path, *options: str) -> Iterator[Path]:
    """A small file system of its own in memory."""
    folder.mkdir(exist_ok=True)
    _mount("-t", "tmpfs", "-o", ",".join(options), "tmpfs", str(folder))
    try:
        yield folder
    finally:
        # lazily: an encoder that was refused its first byte keeps its file open until it is freed
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def _mount(*arguments: str) -> None:
    try:
        done = subprocess.run(["mount", *arguments], capture_output=True, check=False)
    except OSError:
        pytest.skip(NEEDS_ROOT)
    if done.returncode:
        pytest.skip(NEEDS_ROOT)


def with_room(disk: Path) -> None:
    """Somebody makes space."""
    _mount("-o", "remount,size=64m,nr_inodes=10000", str(disk))


# ---------------------------------------------------------------- a disk that is full


REACHED = {
    "pages": {"00000 nothing", "00001 nothing", "00001 yaml", "joined mp4", "joined yaml"},
    "files": {"00000 nothing", "00001 yaml", "joined nothing", "joined yaml"},
}
"""Where packs must have been interrupted for this to be a test: folder, and last file in it."""


def _state(work: Path) -> str:
    """The last file, in the order of their making, of which something was written."""
    order = ["plan.json", "part.json", "mp4", "messages.mcap", "yaml", "dataset.yaml"]
    found = {path.name for path in work.rglob("*") if path.is_file() and path.stat().st_size}
    kinds = {name if name in order else name.rpartition(".")[2] for name in found}
    return max((kind for kind in kinds if kind in order), key=order.index, default="nothing")


@pytest.fixture
def reached(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Which folders that were to be filled were given up, and how far they had come."""
    states: set[str] = set()
    remove = shutil.rmtree

    def spy(folder: Path, *args: Any, **options: Any) -> None:
        name = folder.parent.name if folder.name == "new" else folder.name
        if name.startswith(".") and folder.is_dir():
            kind = "joined" if name.startswith(".dataset.") else name[1:6]
            states.add(f"{kind} {_state(folder)}")
        remove(folder, *args, **options)

    monkeypatch.setattr("shutil.rmtree", spy)
    return states


@pytest.mark.slow
@pytest.mark.parametrize("limit", ["pages", "files"])
def test_a_disk_that_is_full_at_any_moment(
    limit: str, pack: Pack, tmp_path: Path, reached: set[str]
) -> None:
    before = tree(pack.source.parent)
    refusals = 0
    for number in range(1, 100):
        options = (
            [f"size={number * PAGE}"] if limit == "pages" else ["size=64m", f"nr_inodes={number}"]
        )
        with disk_of(tmp_path / "disk", *options) as disk:
            pack.target = disk / "dataset"
            try:
                pack.run()
                break
            except Mp4dsError as error:
                told, code = str(error), error.exit_code
            refusals += 1
            assert "No space left" in told
            assert str(disk) in told
            assert code == 1
            assert not pack.target.exists()
            assert tree(pack.source.parent) == before
            with_room(disk)
            pack.goes_on()
            if number % 6 == 0:
                shutil.copytree(pack.target, tmp_path / str(number) / "dataset")
                assert compare([pack.source], unpacked(tmp_path / str(number), "bag")) == []
    assert refusals >= 12
    assert REACHED[limit] <= reached


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    "name", ["plan.json", "part.json", "messages.mcap", "cam_image_raw.yaml", "dataset.yaml"]
)
@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO, errno.EROFS], ids=errno.errorcode.get)
def test_a_file_that_the_disk_refuses(
    code: int, name: str, pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every file that is written by Python, in a part or in the joining."""
    with failing_open(monkeypatch, lambda path, mode: "w" in mode and name in path, code):
        error = pack.refused(os.strerror(code))
    assert isinstance(error, (PartsFailedError, WriteError))
    assert error.exit_code == 1
    assert str(tmp_path) in str(error)
    pack.goes_on()


@contextmanager
def failing_open(
    monkeypatch: pytest.MonkeyPatch, fails: Callable[[str, str], bool], code: int
) -> Iterator[None]:
    """Opening some files fails."""
    real = io.open

    def refuse(file: Any, mode: str = "r", *args: Any, **options: Any) -> Any:
        if isinstance(file, (str, Path)) and fails(str(file), mode):
            raise OSError(code, os.strerror(code), str(file))
        return real(file, mode, *args, **options)

    with monkeypatch.context() as patch:
        instead_of_open(patch, refuse)
        yield


@pytest.mark.parametrize("size", ["300k", "700k"])
@pytest.mark.slow
def test_the_real_command_on_a_full_disk(size: str, tmp_path: Path) -> None:
    (tmp_path / "source").mkdir()
    bag = tmp_path / "source" / "drive.bag"
    demo(bag, seconds=0.4)
    before = tree(bag.parent)
    with disk_of(tmp_path / "disk", f"size={size}") as disk:
        arguments = ("pack", bag, "-o", disk / "dataset", "--codec", "ffv1", "--window", 3)
        failed = run(*arguments, "--jobs", 2)
        lines = failed.err.strip().splitlines()
        assert "Traceback" not in failed.err
        assert failed.code == 1, failed.err
        assert "No space left" in lines[-1]
        assert str(disk) in lines[-1]
        assert not (disk / "dataset").exists()
        assert tree(bag.parent) == before
        with_room(disk)
        again = call(*arguments, "--jobs", 1)
        assert again.code == 0, again.err
        assert leftovers(disk) == []
        mp4ds.pack(bag, tmp_path / "whole", PackOptions(codec="ffv1"))
        assert facts(disk / "dataset") == facts(tmp_path / "whole")
        shutil.copytree(disk / "dataset", tmp_path / "dataset")
    assert compare([bag], unpacked(tmp_path, "bag")) == []


# ---------------------------------------------------------------- a source that fails


class _BadSector(io.FileIO):
    """A file of which some bytes cannot be read, while `broken` is set."""

    broken = False

    def __init__(self, path: str, bad: range) -> None:
        super().__init__(path)
        self._bad = bad

    def _check(self, size: int) -> None:
        start = self.tell()
        if type(self).broken and start < self._bad.stop and start + size > self._bad.start:
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    def readinto(self, buffer: Any) -> int | None:
        self._check(len(memoryview(buffer)))
        return super().readinto(buffer)

    def readall(self) -> bytes:
        self._check(2**40)
        return super().readall()


@pytest.mark.parametrize(
    "pack", ["bag-none", "bag-bz2", "mcap-ros2-zstd", "mcap-ros2-none"], indirect=True
)
def test_a_bad_sector(pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    middle = pack.source.stat().st_size // 2
    real = io.open

    class Drive(_BadSector):
        pass

    def opened(file: Any, mode: str = "r", buffering: int = -1, *args: Any, **options: Any) -> Any:
        if str(file) == str(pack.source) and mode == "rb":
            return io.BufferedReader(Drive(str(file), range(middle, middle + 512)), 512)
        return real(file, mode, buffering, *args, **options)

    executor = before_task(PARTS[0], lambda: setattr(Drive, "broken", True))
    with monkeypatch.context() as patch:
        instead_of_open(patch, opened)
        error = pack.refused("Input/output error", executor, keep_going=True)
    assert isinstance(error, PartsFailedError)
    assert executor.ran == PARTS
    assert "could not be written" not in str(error)
    assert str(pack.source) in str(error)
    pack.goes_on()
    assert compare([pack.source], unpacked(tmp_path, pack.source.suffix[1:])) == []


CHANGES: dict[str, Callable[[Path], object]] = {
    "cut short": lambda path: os.truncate(path, path.stat().st_size // 2),
    "longer": lambda path: path.write_bytes(path.read_bytes() + b"more"),
    "another": lambda path: path.write_bytes(hashlib.sha512(b"").digest() * 100),
    "gone": Path.unlink,
    "a folder": lambda path: [change() for change in (path.unlink, path.mkdir)],
}


@pytest.mark.one_in(3)
@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("pack", KINDS, indirect=True)
def test_a_source_that_changes_while_it_is_packed(change: str, pack: Pack) -> None:
    files = [pack.source] if pack.source.is_file() else [*pack.source.iterdir()]
    file = max(files, key=lambda path: path.stat().st_size)
    times = file.stat().st_atime_ns, file.stat().st_mtime_ns
    data = file.read_bytes()
    executor = before_task(PARTS[1], lambda: CHANGES[change](file))
    assert pack.refused(f"Part {PARTS[1]}: .*{file.name}", executor).exit_code == 2
    assert isinstance(pack.refused(None), SourceError)  # it is still not what it was
    if file.is_dir():
        file.rmdir()
    file.write_bytes(data)
    os.utime(file, ns=times)
    assert pack.goes_on() == [PARTS[1]]


def test_a_source_that_goes_before_the_joining(pack: Pack) -> None:
    away = pack.source.with_suffix(".away")

    def vanish(told: mp4ds.PackProgress) -> None:
        if told.phase == "joining" and pack.source.exists():
            pack.source.rename(away)

    assert isinstance(pack.refused("no such file", progress=vanish), SourceError)
    away.rename(pack.source)
    assert pack.goes_on() == []


# ---------------------------------------------------------------- processes that die


def harmed(packer: PartPacker, piece: Piece, name: str, harm: str) -> None:
    """Do something before a piece is packed; in another process."""
    if piece.name == name:
        exec(harm)
    packer(piece)


class Harmed(ProcessExecutor):
    """Whose processes do something before they pack a piece."""

    def __init__(self, jobs: int, name: str, harm: str) -> None:
        super().__init__(jobs)
        self._harm = name, f"import os, signal, sys; {harm}"

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Any:
        if isinstance(fn, PartPacker):
            return super().submit(harmed, fn, *args, *self._harm)
        return super().submit(fn, *args, **kwargs)


@pytest.fixture
def harm(monkeypatch: pytest.MonkeyPatch) -> type[Harmed]:
    """Processes that do something before they pack a piece."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))  # where they find `harmed`
    return Harmed


@pytest.mark.parametrize("jobs", [pytest.param(1, marks=pytest.mark.slow), 3])
def test_a_process_that_is_killed_again_and_again(
    jobs: int, pack: Pack, harm: type[Harmed], tmp_path: Path
) -> None:
    log = tmp_path / "tries"
    kill = f"open({str(log)!r}, 'a').write('x'); os.kill(os.getpid(), signal.SIGKILL)"
    words = "SIGKILL, perhaps for lack of memory"
    error = pack.refused(words, harm(jobs, PARTS[0], kill), keep_going=True, jobs=jobs)
    assert isinstance(error, PartsFailedError)
    assert [name for name, _ in error.failures] == [PARTS[0]]
    assert error.exit_code == 1
    assert AGAIN in str(error)
    assert log.read_text() == "xx"  # it is tried once more, and no oftener
    assert pack.goes_on() == [PARTS[0]]


@pytest.mark.skipif(shutil.which("prlimit") is None, reason="prlimit is not installed")
@pytest.mark.parametrize("megabytes", [20, 150])
def test_processes_that_cannot_start_for_lack_of_memory(
    megabytes: int, pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    python = tmp_path / "python"
    limit = f"prlimit --as={megabytes * 2**20}"
    python.write_text(f'#!/bin/sh\nexec {limit} {sys.executable} "$@"\n')
    python.chmod(0o755)
    with monkeypatch.context() as patch:
        patch.setattr("sys.executable", str(python))
        error = pack.refused("Part source-0: its process exited", ProcessExecutor(1), jobs=1)
    assert "\n" not in str(error)
    assert leftovers(tmp_path) == []
    assert pack.goes_on() == PARTS


# ---------------------------------------------------------------- folders that are not as they were


def test_a_work_folder_that_is_removed_meanwhile(pack: Pack, tmp_path: Path) -> None:
    executor = before_task(PARTS[1], lambda: shutil.rmtree(tmp_path / WORK))
    pack.refused("all machines must share", executor)
    assert pack.goes_on() == PARTS


@pytest.mark.parametrize(
    ("gone", "again"),
    [
        (".", PARTS),
        (PARTS[0], PARTS[:1]),
        (f"{PARTS[0]}/part.json", PARTS[:1]),
        (f"{PARTS[1]}/dataset.yaml", PARTS[1:]),
        (f"{PARTS[1]}/messages.mcap", PARTS[1:]),
        (f"{PARTS[1]}/cam_image_raw.mp4", PARTS[1:]),
        (f"{PARTS[1]}/cam_image_raw.exact.mp4", PARTS[1:]),
    ],
)
def test_what_is_removed_before_the_joining(
    gone: str, again: list[str], pack: Pack, tmp_path: Path
) -> None:
    place = tmp_path / WORK / gone

    def vanish(told: mp4ds.PackProgress) -> None:
        if told.phase == "joining" and not told.note and place.exists():
            shutil.rmtree(place) if place.is_dir() else place.unlink()

    pack.refused(r"mp4ds-part|No such file", progress=vanish)
    assert pack.goes_on() == again


@pytest.mark.parametrize(
    "name",
    ["messages.mcap", "cam_image_raw.yaml", "cam_image_raw.mp4", "cam_image_raw.exact.mp4"],
)
def test_what_rots_before_the_joining_is_made_again(name: str, pack: Pack, tmp_path: Path) -> None:
    def rot(told: mp4ds.PackProgress) -> None:
        path = tmp_path / WORK / PARTS[0] / name
        if told.phase == "joining" and not told.note:
            data = bytearray(path.read_bytes())
            data[len(data) // 2] ^= 0x10
            path.write_bytes(data)

    pack.refused(rf"{PARTS[0]}/{name}", progress=rot)
    assert pack.goes_on() == PARTS[:1]


@contextmanager
def unmounted_at_the_end(folder: Path) -> Iterator[Callable[[], None]]:
    """Gives a function that makes a folder one that nobody can write into, not even root."""

    def protect() -> None:
        if not os.path.ismount(folder):
            _mount("--bind", str(folder), str(folder))
            _mount("-o", "remount,bind,ro", str(folder))

    try:
        yield protect
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def test_folders_that_are_or_become_read_only(pack: Pack, tmp_path: Path) -> None:
    words = "Read-only file system"
    (tmp_path / "out").mkdir()
    pack.target = tmp_path / "out" / "dataset"
    with unmounted_at_the_end(tmp_path / "out") as protect:
        protect()
        assert isinstance(pack.refused(f"cannot be created: {words}"), TargetError)
    pack.target = tmp_path / "dataset"
    with unmounted_at_the_end(tmp_path / WORK) as protect:
        pack.refused(words, before_task(PARTS[1], protect))
        for restart in (False, True):  # neither can do anything now
            pack.refused(words, restart=restart)
    with unmounted_at_the_end(tmp_path) as protect:
        pack.refused(words, progress=lambda told: told.phase == "joining" and protect())
    pack.goes_on()


@pytest.mark.parametrize("year", [1970, 2100])
def test_a_clock_that_goes_wrong(
    year: int, pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = (year - 1970) * 31_556_952

    def wrong() -> None:
        for path in (tmp_path / WORK).rglob("*"):
            os.utime(path, (now, now))
        clock = iter(range(now + 10**6, 0, -1))
        monkeypatch.setattr("time.time", lambda: float(next(clock)))

    pack.run(before_task(PARTS[1], wrong))
    assert facts(pack.target) == pack.expected


# ---------------------------------------------------------------- signals


@pytest.fixture(scope="module")
def long_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("long") / "drive.bag"
    demo(path, seconds=2)
    return path


def _children(pid: int) -> list[int]:
    threads = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(word) for path in threads for word in path.read_text().split()]


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="there is no /proc here")
@pytest.mark.parametrize(
    ("signals", "code"),
    [
        pytest.param([signal.SIGINT], 130, id="ctrl-c", marks=pytest.mark.slow),
        pytest.param([signal.SIGTERM], 143, id="sigterm", marks=pytest.mark.slow),
        pytest.param([signal.SIGINT] * 4, 130, id="ctrl-c again and again", marks=pytest.mark.slow),
    ],
)
def test_a_parallel_pack_that_is_interrupted(
    signals: list[signal.Signals], code: int, long_bag: Path, tmp_path: Path
) -> None:
    before = tree(long_bag.parent)
    arguments = ("pack", long_bag, "-o", tmp_path / "dataset", "--window", 5, "--codec", "h264")
    process = start(*arguments, "--jobs", 2)
    until(lambda: list((tmp_path / WORK).glob("0*/part.json")), process)
    children: list[int] = []
    while not children and process.poll() is None:
        children = _children(process.pid)
    for number in signals:
        process.send_signal(number)
        time.sleep(0.02)
    _, err = process.communicate(timeout=WATCHDOG_S)
    # one that comes while Python ends is the death of it; a shell calls that 130, too
    assert process.returncode in (code, -signal.SIGINT if len(signals) > 1 else code), err
    assert "Traceback" not in err
    assert AGAIN in err
    until(lambda: not any(map(is_alive, children)))
    assert leftovers(tmp_path) == [WORK]
    assert not (tmp_path / "dataset").exists()
    assert tree(long_bag.parent) == before
    again = call(*arguments, "--jobs", 1)
    assert again.code == 0, again.err
    mp4ds.pack(long_bag, tmp_path / "whole", PackOptions(codec="h264"))
    assert facts(tmp_path / "dataset") == facts(tmp_path / "whole")
    assert leftovers(tmp_path) == []


@pytest.mark.slow
def test_an_interruption_before_anything_is_finished(long_bag: Path, tmp_path: Path) -> None:
    process = start("pack", long_bag, "-o", tmp_path / "dataset", "--window", 10, "--jobs", 1)
    until(lambda: list((tmp_path / WORK).glob(".0*")), process)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=WATCHDOG_S)
    assert (process.returncode, out) == (130, "")
    assert "Traceback" not in err
    # unless the part was just then finished
    assert list((tmp_path / WORK).glob("0*/part.json")) or tree(tmp_path) == {}
