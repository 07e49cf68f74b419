"""Outputs appear under their final name only when whole, and replace nothing unasked."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from mp4ds.errors import Mp4dsError, TargetError, TargetExistsError
from mp4ds.files.outputs import (
    PAGE_SIGN,
    check_target,
    csv_cell,
    staged,
    write_listing,
)


def anything(path: Path) -> set[str]:
    """Everything is ours."""
    return {p.relative_to(path).as_posix() for p in path.rglob("*")} if path.is_dir() else {""}


def nothing(path: Path) -> None:
    return None


def make(path: Path, kind: str, text: str = "new") -> None:
    if kind == "file":
        path.write_text(text)
    else:
        (path / "deep").mkdir(parents=True)
        (path / "deep" / "part").write_text(text)


def read(path: Path) -> str:
    return (path if path.is_file() else path / "deep" / "part").read_text()


@pytest.fixture
def target(tmp_path: Path) -> Path:
    return tmp_path / "out"


def refused(target: Path, words: str, **options: Any) -> TargetError:
    """The error of an output that is refused before anything is made."""
    options = {"force": False, "owned": nothing, **options}
    with pytest.raises(TargetError, match=words) as caught, staged(target, **options):
        pytest.fail("nothing may be made there")
    return caught.value


def only(folder: Path, *names: str) -> bool:
    return sorted(path.name for path in folder.iterdir()) == sorted(names)


FORMULAS = ["=1+1", "+1+1", "-A1", "@SUM(A1)", "\t=1", "\r=1", "\uff1d1", "=", "-1-1"]
NO_FORMULAS = ["", "/cam=1", "cam", "-1", "+2.5", "'=1"]


@pytest.mark.parametrize("text", [*FORMULAS, *NO_FORMULAS])
def test_a_formula_in_a_csv_file_is_text(text: str) -> None:
    assert csv_cell(text) == (f"'{text}" if text in FORMULAS else text)


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_an_output_appears_at_the_end(kind: str, target: Path) -> None:
    with staged(target, force=False, owned=nothing) as path:
        assert not path.exists()
        assert path.name == target.name
        make(path, kind)
        assert not target.exists()
    assert read(target) == "new"
    assert only(target.parent, "out")


@pytest.mark.parametrize("kind", ["file", "folder"])
@pytest.mark.parametrize("old", [None, "file", "folder"])
@pytest.mark.parametrize("error", [ValueError("x"), KeyboardInterrupt(), SystemExit(3)])
def test_what_goes_wrong_leaves_nothing(
    kind: str, old: str | None, error: BaseException, target: Path
) -> None:
    if old:
        make(target, old, "old")
    with (  # noqa: PT012 - the body is what is tested
        pytest.raises(type(error)) as caught,
        staged(target, force=bool(old), owned=anything) as path,
    ):
        make(path, kind)
        raise error
    assert caught.value is error
    assert not old or read(target) == "old"
    assert only(target.parent, *(["out"] if old else []))


@pytest.mark.parametrize(
    ("stranger", "told"),
    [
        ("notes.txt", "1 item .*(notes.txt)"),
        ("deep/notes.txt", "1 item .*(deep/notes.txt)"),
        ("labels/1.txt", r"1 item .*\(labels/\)"),
        ("empty/", r"1 item .*\(empty/\)"),
        ("link ->", r"1 item .*\(link\)"),
        ("deep/part ->", r"1 item .*\(deep/part\)"),
        ("a b c d e", r"5 items .*\(a, b, c, \.\.\.\)"),
    ],
)
def test_what_mp4ds_did_not_write_keeps_the_rest_from_being_replaced(
    stranger: str, told: str, target: Path
) -> None:
    make(target, "folder", "old")
    if stranger.endswith(" ->"):
        path = target / stranger[:-3]
        path.unlink(missing_ok=True)
        path.symlink_to(__file__)
    elif stranger.endswith("/"):
        (target / stranger).mkdir()
    else:
        for name in stranger.split():
            (target / name).parent.mkdir(exist_ok=True)
            (target / name).write_text("mine")
    before = sorted(target.rglob("*"))
    refused(target, told, force=True, owned=lambda _: {"deep/part"})
    assert sorted(target.rglob("*")) == before
    assert only(target.parent, "out")


def test_what_appears_in_it_meanwhile_is_kept(target: Path) -> None:
    make(target, "folder", "old")
    with (  # noqa: PT012 - the body is what is tested
        pytest.raises(TargetError, match=r"1 item .*notes\.txt"),
        staged(target, force=True, owned=lambda _: {"deep/part"}) as path,
    ):
        make(path, "folder")
        (target / "notes.txt").write_text("mine")
    assert read(target) == "old"
    assert only(target, "deep", "notes.txt")


def test_a_report_within_is_replaced_with_it(target: Path) -> None:
    make(target, "folder", "old")
    (target / "index.html").write_bytes(b"<!doctype html>" + PAGE_SIGN)
    (target / "report" / "stills").mkdir(parents=True)
    (target / "report" / "stills" / "left.jpg").touch()
    write_listing(target / "report")
    check_target(target, force=True, owned=lambda _: {"deep/part"})
    (target / "report" / "stills" / "mine.jpg").touch()
    told = r"\(report/stills/mine\.jpg\)"
    refused(target, told, force=True, owned=lambda _: {"deep/part"})


@pytest.mark.parametrize("source", ["out", "out/deep", "out/deep/part", ".", "link", "link/deep"])
@pytest.mark.parametrize("force", [False, True])
def test_an_output_never_overlaps_with_its_source(
    source: str, force: bool, target: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make(target, "folder", "old")
    (target.parent / "link").symlink_to("out")
    monkeypatch.chdir(target.parent)
    sources = [Path(source)]
    refused(target, "overlaps with the source", force=force, owned=anything, sources=sources)
    assert read(target) == "old"
    assert only(target.parent, "out", "link")


@pytest.mark.parametrize("old", [None, "file", "folder"])
def test_a_move_that_fails_brings_the_old_back(
    old: str | None, target: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if old:
        make(target, old, "old")
    rename = Path.rename

    def failing(self: Path, to: Path) -> Path:
        if to == target and self.parent.name == "new":
            raise OSError(errno.EIO, "Input/output error")
        return rename(self, to)

    monkeypatch.setattr(Path, "rename", failing)
    monkeypatch.setattr("mp4ds.files.outputs.swap_names", lambda *_: False)
    with (
        pytest.raises(Mp4dsError, match="Input/output error"),
        staged(target, force=True, owned=anything) as path,
    ):
        make(path, "folder")
    assert not old or read(target) == "old"
    assert only(target.parent, *(["out"] if old else []))


@pytest.mark.parametrize("kind", ["file", "folder"])
@pytest.mark.parametrize("old", ["file", "folder"])
@pytest.mark.parametrize("can", [False, True])
def test_force_replaces_what_may_be_replaced(
    can: bool, old: str, kind: str, target: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if can and sys.platform in ("linux", "darwin"):  # there is no moment without either
        monkeypatch.setattr(Path, "rename", None)
    elif not can:
        monkeypatch.setattr("mp4ds.files.outputs.swap_names", lambda *_: False)
    make(target, old, "old")
    with staged(target, force=True, owned=anything) as path:
        make(path, kind)
        assert read(target) == "old"
    assert read(target) == "new"
    assert only(target.parent, "out")


KILLED = """
import os, sys
from pathlib import Path
from typing import Any
from mp4ds.files import outputs
from mp4ds.files.outputs import staged

target, moment = Path(sys.argv[1]), sys.argv[2]
if moment == "between":
    outputs.swap_names = lambda *_: False
    rename = Path.rename
    def kill(self, to):
        rename(self, to)
        os.kill(os.getpid(), 9)
    Path.rename = kill
with staged(target, force=True, owned=lambda _: {""}) as path:
    path.write_text("of the killed run")
    if moment == "wait":
        print("made", flush=True)
        sys.stdin.read()
    if moment == "within":
        os.kill(os.getpid(), 9)
"""


def killed(target: Path, moment: str) -> None:
    done = subprocess.run([sys.executable, "-c", KILLED, str(target), moment], check=False)
    assert done.returncode == -signal.SIGKILL


@pytest.mark.parametrize("name", ["out", "lock", "old", "x" * 250])
@pytest.mark.parametrize("moment", ["within", "between", "without its lock"])
def test_the_next_run_removes_what_a_killed_one_left(
    moment: str, name: str, tmp_path: Path
) -> None:
    target = tmp_path / name
    target.write_text("old")
    killed(target, "between" if moment == "between" else "within")
    (left,) = tmp_path.glob(".*.part")
    if moment == "without its lock":  # killed while it removed that, or never on the disk
        (left / "lock").unlink()
    assert target.exists() == (moment != "between")
    refused(target, "already exists")
    assert target.read_text() == "old"  # also where it had no name when the run was killed
    assert only(tmp_path, name)


def test_only_abandoned_files_of_this_user_are_leftovers(tmp_path: Path) -> None:
    target = tmp_path / "out"
    command = [sys.executable, "-c", KILLED, str(target), "wait"]
    precious = tmp_path / "precious" / "out"
    make(precious, "folder", "mine")
    for number, files in enumerate((["notes"], ["lock", "new/notes"], ["lock", "new/out", "mine"])):
        for name in files:
            path = tmp_path / f".out.abcdefg{number}.part" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
    planted = tmp_path / ".out.abcdefg9.part"
    planted.mkdir()
    (planted / "lock").touch()
    (planted / "old").symlink_to(precious.parent)
    (tmp_path / ".out.abcdefg8.part").symlink_to(precious.parent)
    before = sorted(tmp_path.rglob("*"))
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "made\n"
        (at_work,) = set(tmp_path.glob(".*.part/new/out")) - set(before)
        with staged(target, force=False, owned=nothing) as path:
            path.write_text("of this run")
        assert at_work.exists()
        target.unlink()
        process.communicate()
    assert target.read_text() == "of the killed run"
    target.unlink()
    assert sorted(tmp_path.rglob("*")) == before


def test_folders_are_synced(target: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The bytes and names of an output before its own name, and then that."""
    synced: list[str] = []
    fsync = os.fsync

    def watched(handle: int) -> None:
        synced.append(str(Path(f"/proc/self/fd/{handle}").readlink()))
        fsync(handle)

    if not Path("/proc/self/fd").is_dir():
        pytest.skip("nothing tells what a descriptor is of")
    monkeypatch.setattr("os.fsync", watched)
    with staged(target, force=False, owned=nothing) as path:
        make(path, "folder")
    made = str(path)
    assert synced == [f"{made}/deep/part", f"{made}/deep", made, str(target.parent)]


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_what_appeared_meanwhile_is_not_replaced(kind: str, target: Path) -> None:
    with (  # noqa: PT012 - the body is what is tested
        pytest.raises(TargetExistsError),
        staged(target, force=False, owned=nothing) as path,
    ):
        make(path, kind)
        make(target, kind, "of another run")
    assert read(target) == "of another run"
    assert only(target.parent, "out")
