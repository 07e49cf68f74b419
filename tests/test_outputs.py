"""Outputs appear under their final name only when whole, and replace nothing unasked."""

from __future__ import annotations

import errno
import hashlib
import os
from pathlib import Path

import pytest

from each import each, fresh
from mp4ds.errors import Mp4dsError, TargetError, TargetExistsError, WriteError
from mp4ds.outputs import as_write_error, check_target, digest_file, staged


def anything(path: Path) -> bool:
    return True


def nothing(path: Path) -> bool:
    return False


def make(path: Path, kind: str, text: str = "new") -> None:
    if kind == "file":
        path.write_text(text)
    else:
        (path / "deep").mkdir(parents=True)
        (path / "deep" / "part").write_text(text)


def read(path: Path) -> str:
    return (path if path.is_file() else path / "deep" / "part").read_text()


@fresh
def target(tmp_path: Path) -> Path:
    return tmp_path / "out"


def only(folder: Path, *names: str) -> bool:
    return sorted(path.name for path in folder.iterdir()) == sorted(names)


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_an_output_appears_at_the_end(kind: str, target: Path) -> None:
    with staged(target, force=False, replaceable=nothing) as path:
        assert not path.exists()
        assert path.name == target.name
        make(path, kind)
        assert not target.exists()
    assert read(target) == "new"
    assert only(target.parent, "out")


@each("kind", ["file", "folder"])
@each("old", [None, "file", "folder"])
@each("error", [ValueError("x"), KeyboardInterrupt(), SystemExit(3)])
def test_what_goes_wrong_leaves_nothing(
    kind: str, old: str | None, error: BaseException, target: Path
) -> None:
    if old:
        make(target, old, "old")
    with (  # noqa: PT012 - the body is what is tested
        pytest.raises(type(error)) as caught,
        staged(target, force=bool(old), replaceable=anything) as path,
    ):
        make(path, kind)
        raise error
    assert caught.value is error
    assert not old or read(target) == "old"
    assert only(target.parent, *(["out"] if old else []))


@each("kind", ["file", "folder"])
@each("old", ["file", "folder"])
def test_force_replaces_what_may_be_replaced(kind: str, old: str, target: Path) -> None:
    make(target, old, "old")
    with staged(target, force=True, replaceable=anything) as path:
        make(path, kind)
        assert read(target) == "old"
    assert read(target) == "new"
    assert only(target.parent, "out")


def test_nothing_is_replaced_unasked(target: Path) -> None:
    make(target, "file", "old")
    with pytest.raises(TargetExistsError, match="--force") as caught:
        check_target(target, force=False, replaceable=anything)
    assert isinstance(caught.value, FileExistsError)
    assert caught.value.path == target
    with pytest.raises(TargetError, match="not something that mp4ds wrote") as refused:
        check_target(target, force=True, replaceable=nothing)
    assert not isinstance(refused.value, TargetExistsError)
    assert read(target) == "old"


def test_a_dangling_link_is_something(target: Path) -> None:
    target.symlink_to("nowhere")
    with pytest.raises(TargetExistsError):
        check_target(target, force=False, replaceable=anything)


def test_force_replaces_a_link_and_not_what_it_points_to(target: Path) -> None:
    make(target.parent / "precious", "folder", "old")
    target.symlink_to("precious")
    with staged(target, force=True, replaceable=Path.is_dir) as path:
        make(path, "folder")
    assert not target.is_symlink()
    assert read(target) == "new"
    assert read(target.parent / "precious") == "old"


def test_the_folder_must_exist(target: Path) -> None:
    with pytest.raises(TargetError, match="is no folder"):
        check_target(target / "deep", force=False, replaceable=anything)
    make(target, "file")
    with pytest.raises(TargetError, match="is no folder"):
        check_target(target / "deep", force=False, replaceable=anything)


@each("source", ["out", "out/deep", "out/deep/part", ".", "link", "link/deep"])
@each("force", [False, True])
def test_an_output_never_overlaps_with_its_source(
    source: str, force: bool, target: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make(target, "folder", "old")
    (target.parent / "link").symlink_to("out")
    monkeypatch.chdir(target.parent)
    with (
        pytest.raises(TargetError, match="overlaps with the source"),
        staged(target, force=force, replaceable=anything, sources=[Path(source)]),
    ):
        pytest.fail("nothing may be made there")
    assert read(target) == "old"
    assert only(target.parent, "out", "link")


def test_an_output_may_stand_beside_its_source(target: Path) -> None:
    make(target.parent / "out.bag", "file", "old")
    sources = [target.parent / "out.bag"]
    with staged(target, force=False, replaceable=nothing, sources=sources) as path:
        make(path, "folder")
    assert only(target.parent, "out", "out.bag")


def test_a_folder_that_may_not_be_written(target: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> str:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr("tempfile.mkdtemp", refuse)
    with (
        pytest.raises(TargetError, match="Permission denied"),
        staged(target, force=False, replaceable=nothing),
    ):
        pytest.fail("nothing can be made there")


@each("name", ["x" * 250, "\U0001f916" * 61 + ".bag", "a b", ".hidden", "-x"])
def test_any_name_that_the_disk_takes(name: str, tmp_path: Path) -> None:
    with staged(tmp_path / name, force=False, replaceable=nothing) as path:
        make(path, "folder")
    assert only(tmp_path, name)


@each("code", [errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EFBIG, errno.EROFS])
def test_a_disk_that_refuses(code: int, target: Path) -> None:
    with (  # noqa: PT012 - the body is what is tested
        pytest.raises(WriteError, match="the unfinished output was removed") as caught,
        staged(target, force=False, replaceable=nothing) as path,
    ):
        make(path, "folder")
        raise OSError(code, os.strerror(code))
    assert os.strerror(code) in str(caught.value)
    assert caught.value.path == target
    assert only(target.parent)


def test_other_errors_keep_their_class(target: Path) -> None:
    for error in (
        FileNotFoundError(errno.ENOENT, "x"),
        WriteError(target, OSError("x")),
        OSError(),
    ):
        assert as_write_error(error, target) is error
    assert isinstance(as_write_error(OSError(errno.ENOSPC, "full"), target), WriteError)


@pytest.mark.parametrize("old", [None, "file", "folder"])
def test_a_move_that_fails_brings_the_old_back(
    old: str | None, target: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if old:
        make(target, old, "old")
    rename = Path.rename

    def failing(self: Path, to: Path) -> Path:
        if to == target and self.name == target.name:
            raise OSError(errno.EIO, "Input/output error")
        return rename(self, to)

    monkeypatch.setattr(Path, "rename", failing)
    with (
        pytest.raises(Mp4dsError, match="Input/output error"),
        staged(target, force=True, replaceable=anything) as path,
    ):
        make(path, "folder")
    assert not old or read(target) == "old"
    assert only(target.parent, *(["out"] if old else []))


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_what_appeared_meanwhile_is_not_replaced(kind: str, target: Path) -> None:
    with (  # noqa: PT012 - the body is what is tested
        pytest.raises(TargetExistsError),
        staged(target, force=False, replaceable=nothing) as path,
    ):
        make(path, kind)
        make(target, kind, "of another run")
    assert read(target) == "of another run"
    assert only(target.parent, "out")


@each("size", [0, 1, 2**20, 2**20 + 17])
def test_digests(size: int, tmp_path: Path) -> None:
    data = os.urandom(size)
    (tmp_path / "x").write_bytes(data)
    assert digest_file(tmp_path / "x") == (size, hashlib.sha256(data).hexdigest())
