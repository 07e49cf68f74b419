"""Outputs for URLs: completed on this machine, then copied there.

The file that identifies an output comes last, so that an output without it is visibly incomplete.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeVar

from mp4ds.errors import Mp4dsError, RemoteError, TargetError, TargetExistsError, interrupted
from mp4ds.files.outputs import Owned, lock, refuse_not_ours, refuse_unknown_files
from mp4ds.files.urls import RemotePath

Made = TypeVar("Made")
Report = Callable[[str, int, int], None]
"""Called with the file being uploaded, bytes uploaded, and total bytes."""

_LOCK = "lock"
_PROBE = ".mp4ds-upload"


def uploaded(
    target: RemotePath,
    make: Callable[[Path], Made],
    *,
    is_folder: bool = True,
    last: str = "",
    force: bool,
    owned: Owned,
    report: Report | None = None,
) -> Made:
    """Make an output on this machine, and copy it to a URL.

    Args:
        target: Where it goes.
        make: Makes it at a local path, replacing what is there.
        is_folder: Whether it is a folder.
        last: For a folder, the file to copy last, without which it is incomplete.
        force: Replace what is at the URL.
        owned: Tells which files of that mp4ds wrote.
        report: Called with the upload's progress.

    Returns:
        What `make` returns.

    Raises:
        TargetError: The target cannot be written or replaced, or another run is working on it.
        RemoteError: It could not be uploaded; the output is kept here.
    """
    local = local_path(target)
    with _claimed(local.parent, target):
        old = _replaced(target, is_folder=is_folder, force=force, owned=owned)
        _probe(target / _PROBE if is_folder else target.with_name(f"{target.name}{_PROBE}"))
        made = make(local)
        kept = f"The output is kept in {local}: copy it with a tool of your choice"
        kept += f"({last} last), or run the command again." if last else ", or run again."
        try:
            _send(local, target, old, last, report)
        except (TargetError, RemoteError) as error:
            raise type(error)(target, str(error).rstrip("."), kept) from None
        except (KeyboardInterrupt, SystemExit) as error:
            raise interrupted(error, f"the upload is incomplete. {kept}") from None
        if is_folder:
            shutil.rmtree(local, ignore_errors=True)
        else:
            local.unlink(missing_ok=True)
    return made


def local_path(target: RemotePath) -> Path:
    """Where the output for a URL is made: the same on all machines that share ``TMPDIR``.

    Raises:
        TargetError: Nothing can be uploaded there, or no folder can be created here.
    """
    if not target.is_writable:
        problem = "is on a web server, which does not accept uploads"
        raise TargetError(target, problem, "Give a location in a store, such as s3://.")
    if target.parent == target:
        raise TargetError(target, "is an entire bucket", "Give a folder in it.")
    digest = hashlib.sha256(str(target).encode()).hexdigest()
    folder = _own_folder() / f"{target.name[:60]}-{digest[:16]}"
    folder.mkdir(exist_ok=True)
    return folder / target.name


def _own_folder() -> Path:
    """The user's own folder in the system's temporary one, which nobody else can touch."""
    folder = Path(tempfile.gettempdir()) / f"mp4ds-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        stat = folder.lstat()
    except OSError as error:
        raise TargetError(
            folder, f"cannot be created: {error.strerror}", "Set TMPDIR to another folder."
        ) from None
    if not folder.is_dir() or folder.is_symlink() or stat.st_uid != os.getuid():
        raise TargetError(folder, "belongs to another user", "Set TMPDIR to another folder.")
    return folder


@contextmanager
def _claimed(folder: Path, target: RemotePath) -> Iterator[None]:
    """Lock the folder while working in it; it is removed once empty."""
    with (folder / _LOCK).open("w") as file:
        try:
            lock(file)
        except BlockingIOError:
            raise TargetError(
                target, "another mp4ds is already making it here", "Wait for it, or stop it."
            ) from None
        try:
            yield
        finally:
            if {path.name for path in folder.iterdir()} <= {_LOCK}:
                shutil.rmtree(folder, ignore_errors=True)


def _replaced(target: RemotePath, *, is_folder: bool, force: bool, owned: Owned) -> set[str]:
    """Names of the files to replace, empty that of a file; see `outputs.check_target`."""
    now = RemotePath(target.url)
    if not now.exists():
        return set()
    if not force:
        raise TargetExistsError(target)
    old = refuse_not_ours(target, owned(now))
    if not is_folder:
        return {""}
    begin = len(target.url) + 1
    there = {path.url[begin:] for path in now.files()}
    refuse_unknown_files(target, there - old)
    return there


def _probe(path: RemotePath) -> None:
    """Check before the work whether the place can be written to."""
    with tempfile.NamedTemporaryFile() as file:
        path.upload(Path(file.name))
    path.remove()


def _send(local: Path, target: RemotePath, old: set[str], last: str, report: Report | None) -> None:
    """Copy a file, whose name in the output is empty, or all files of a folder."""
    for name in sorted(old - {""}, key=lambda name: name != last):
        (target / name).remove()
    if local.is_file():
        files = {"": local.stat().st_size}
    else:
        paths = filter(Path.is_file, sorted(local.rglob("*")))
        files = {path.relative_to(local).as_posix(): path.stat().st_size for path in paths}
    done, total = 0, sum(files.values())
    sent: list[RemotePath] = []
    try:
        for name in sorted(files, key=lambda name: name == last):
            if report:
                report(name or target.name, done, total)
            sent.append(target / name)
            sent[-1].upload(local / name)
            done += files[name]
    except BaseException:
        for place in sent if "" not in old else ():  # a file that is not replaced stays
            with suppress(Mp4dsError):
                place.remove()
        raise
