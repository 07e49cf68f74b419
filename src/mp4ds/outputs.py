"""Outputs appear under their final name only when whole.

An output is made in a folder beside its target, on the same file system, and moved into
place by one rename; whatever goes wrong before leaves nothing but the target as it was.
"""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import socket
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from mp4ds.errors import TargetError, TargetExistsError, WriteError


@contextmanager
def staged(
    target: Path, *, force: bool, replaceable: Callable[[Path], bool], sources: Sequence[Path] = ()
) -> Iterator[Path]:
    """Make an output under a temporary name and move it into place at the end.

    Args:
        target: The final name; its parent folder must exist.
        force: Replace an existing target.
        replaceable: Whether an existing target is of the kind that may be replaced.
        sources: What the output is made from: neither may stand in the other.

    Yields:
        A path that does not exist yet, for the caller to make a file or folder at.

    Raises:
        TargetExistsError: The target exists and ``force`` is not set.
        TargetError: It may not be written or replaced.
        WriteError: The disk refused.
    """
    check_target(target, force=force, replaceable=replaceable, sources=sources)
    try:
        folder = Path(
            tempfile.mkdtemp(prefix=f".{target.name[:60]}.", suffix=".part", dir=target.parent)
        )
    except OSError as error:
        raise TargetError(
            target, f"cannot be written there: {error.strerror}", "Choose another folder."
        ) from None
    try:
        path = folder / target.name
        try:
            yield path
            sync(path)
            move_into_place(path, target, folder, force=force)
        except OSError as error:
            raise as_write_error(error, target) from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def check_target(
    target: Path,
    *,
    force: bool,
    replaceable: Callable[[Path], bool],
    sources: Sequence[Path] = (),
) -> None:
    """Refuse a target early, before any work is done. See `staged`."""
    _refuse_overlap(target, sources)
    if not target.parent.is_dir():
        raise TargetError(target, f"{target.parent} is no folder", "Make the folder first.")
    if not os.path.lexists(target):
        return
    if not force:
        raise TargetExistsError(target)
    if not replaceable(target):
        raise TargetError(
            target,
            "exists and is not something that mp4ds wrote, so --force does not replace it",
            "Choose another name, or remove it yourself.",
        )


def _refuse_overlap(target: Path, sources: Sequence[Path]) -> None:
    """Keep a source from being written into, or replaced together with what is around it."""
    place = target.resolve()
    for source in (path.resolve() for path in sources):
        if place == source or source in place.parents or place in source.parents:
            raise TargetError(
                target, f"overlaps with the source {source}", "Choose a place beside the source."
            )


def as_write_error(error: OSError, target: Path) -> OSError:
    """The error to report for an operating system's error while writing."""
    if isinstance(error, (WriteError, TargetError)) or error.errno is None:
        return error
    if error.errno in _WRITE_ERRNOS:
        return WriteError(target, error)
    return error


_BLOCK = 2**20
_SEEN_SECONDS, _LOOK_SECONDS = 90.0, 1.0  # NFS keeps names and sizes for up to a minute
_WRITE_ERRNOS = {
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EFBIG,
    errno.EIO,
    errno.EROFS,
    errno.EACCES,
    errno.EPERM,
    errno.ENAMETOOLONG,
}


def sync(path: Path) -> None:
    """Bring an output's bytes to the disk before its name is."""
    files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
    for file in files:
        with file.open("rb") as stream:
            os.fsync(stream.fileno())


def write_synced(path: Path, data: bytes, *, replace: bool = True) -> None:
    """Write a small file whole or not at all, whatever happens meanwhile.

    Args:
        path: The file.
        data: Its content.
        replace: Replace the file if it is there.

    Raises:
        FileExistsError: It is there, and is not to be replaced.
        OSError: The disk refused.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.{socket.gethostname()}.part")
    try:
        with part.open("wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        if replace:
            part.replace(path)
        else:
            path.hardlink_to(part)
    finally:
        part.unlink(missing_ok=True)
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Bring the names in a folder to the disk, where the system can."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def is_seen(is_there: Callable[[], bool], *folders: Path) -> bool:
    """Whether what another machine has made is there; a file system may show it after a while only.

    Args:
        is_there: Looks for it.
        folders: In which it is.
    """
    end = time.monotonic() + _SEEN_SECONDS
    while not (seen := is_there()) and time.monotonic() < end:
        for folder in folders:
            list(folder.iterdir())  # which asks the server for its names anew
        time.sleep(_LOOK_SECONDS)
    return seen


def move_into_place(path: Path, target: Path, folder: Path, *, force: bool) -> None:
    """Give an output its final name.

    Args:
        path: The output, whole.
        target: Its final name.
        folder: Where what stands there is put meanwhile; on the same file system.
        force: Replace what stands there.

    Raises:
        TargetExistsError: Something stands there and ``force`` is not set.
    """
    old = folder / "replaced"
    replaced = os.path.lexists(target)
    if replaced and not force:
        raise TargetExistsError(target)  # it appeared meanwhile
    if replaced:
        target.rename(old)
    try:
        path.rename(target)
    except OSError:
        if replaced:
            with suppress(OSError):
                old.rename(target)
        raise


def digest_file(path: Path) -> tuple[int, str]:
    """Size in bytes and SHA-256 of a file."""
    digest = hashlib.sha256()
    size = 0
    with path.open("rb") as stream:
        while block := stream.read(_BLOCK):
            digest.update(block)
            size += len(block)
    return size, digest.hexdigest()
