"""Outputs get their final name only when complete, and replace only what mp4ds wrote."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import shutil
import socket
import tempfile
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from mp4ds.errors import (
    TargetError,
    TargetExistsError,
    WriteError,
    counted,
)
from mp4ds.files.urls import location, remote
from mp4ds.processes import swap_names

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]


def lock(file: IO[Any], *, shared: bool = False) -> bool:
    """Lock a file while it is open and its process lives.

    Args:
        file: Open for writing, as NFS requires.
        shared: Whether other shared locks are allowed.

    Returns:
        Whether it is locked; False if the system or file system has no locks.

    Raises:
        BlockingIOError: Another process holds it.
    """
    if fcntl is None:
        return False
    try:
        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError:
        return False
    return True


def is_mine(stat: os.stat_result, folder: Path) -> bool:
    """Whether something belongs to the user of this process.

    Args:
        stat: Its status.
        folder: A folder next to it: a server may map the user differently.
    """
    if not hasattr(os, "geteuid") or stat.st_uid == os.geteuid():
        return True
    with suppress(OSError), tempfile.TemporaryFile(dir=folder) as file:
        return os.fstat(file.fileno()).st_uid == stat.st_uid
    return False


# ---------------------------------------------------------------- owned

Owned = Callable[[Path], Iterable[str] | None]
"""Returns the names of an output's files, relative to its folder; None if it is not of mp4ds.

For an output that is a file, the only name is empty.
"""

LISTING_NAME = "mp4ds_files.json"
"""File that lists the files of a folder, if nothing else does."""

PAGE_SIGN = b'<meta name="generator" content="mp4ds'
"""Within the first bytes of each page that mp4ds makes."""

_PAGE_NAME = "index.html"
_PAGE_BYTES = 1000
_MOST_BYTES = 2**26
_NAMED = 3


def check_replaceable(target: Path, owned: Owned) -> None:
    """Refuse to replace what mp4ds did not write.

    Args:
        target: The existing output.
        owned: Returns its names.

    Raises:
        TargetError: It is something else, or holds something else.
    """
    if target.is_symlink():
        remedy = f"Give {os.path.realpath(target)} itself, or remove the link."
        raise TargetError(target, "is a symbolic link, which `force` does not replace", remedy)
    is_folder = target.is_dir()
    if is_folder and not any(target.iterdir()):
        return
    names = owned(target)
    if names is None:
        problem = "exists and was not written by mp4ds, so `force` does not replace it"
        raise TargetError(target, problem, "Choose another name, or remove it yourself.")
    if is_folder and (others := unknown_files(target, set(names))):
        listed = ", ".join(sorted(others)[:_NAMED]) + (", ..." if len(others) > _NAMED else "")
        problem = f"holds {counted(len(others), 'item')} that mp4ds did not write ({listed})"
        problem += ", so `force` does not replace it"
        raise TargetError(target, problem, "Move them elsewhere, or choose another name.")


def unknown_files(folder: Path, names: Collection[str]) -> list[str]:
    """What a folder holds besides the named files, those of a report in it, and their folders.

    Args:
        folder: The folder.
        names: Relative to it, with slashes.

    Returns:
        Names; that of a folder without known files ends with a slash.
    """
    known = set(names)
    found: list[str] = []
    waiting = [(folder, "")]
    while waiting:
        place, prefix = waiting.pop()
        with os.scandir(place) as entries:
            for entry in entries:
                name, path = prefix + entry.name, Path(entry.path)
                if entry.is_dir(follow_symlinks=False):
                    known.update(f"{name}/{inner}" for inner in listed_names(path) or ())
                    if any(one.startswith(f"{name}/") for one in known):
                        waiting.append((path, f"{name}/"))
                    else:
                        found.append(f"{name}/")
                elif not entry.is_file(follow_symlinks=False) or not (
                    name in known or (name == _PAGE_NAME and is_page(path))
                ):
                    found.append(name)
    return found


def write_listing(folder: Path) -> None:
    """Write a listing of all files of a folder into it."""
    names = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())
    text = json.dumps({"files": names}, indent=1) + "\n"
    (folder / LISTING_NAME).write_text(text, encoding="utf-8")


def listed_names(folder: Path, listing: str = LISTING_NAME) -> set[str] | None:
    """The names in a folder's listing, including its own; None if there is none.

    Args:
        folder: The folder.
        listing: Name of a file of JSON that has them under ``files``.
    """
    path = folder / listing
    try:
        if path.is_symlink() or path.stat().st_size > _MOST_BYTES:
            return None
        names = json.loads(path.read_bytes())["files"]
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return None
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        return None
    return {listing, *names}


_FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n", "\uff1d", "\uff0b", "\uff0d", "\uff20")
_NUMBER = re.compile(r"[+-]?[0-9]+(\.[0-9]+)?")


def csv_cell(text: str) -> str:
    """Text of a recording for a CSV file: what a spreadsheet takes for a formula follows a '."""
    is_formula = text.startswith(_FORMULA) and not _NUMBER.fullmatch(text)
    return f"'{text}" if is_formula else text


def begins_with(path: Path, *starts: bytes) -> bool:
    """Whether a file is of a kind, by its first bytes; or is empty, so that nothing is lost."""
    try:
        if not path.is_file():
            return False
        with path.open("rb") as stream:
            head = stream.read(max(map(len, starts)))
    except OSError:
        return False
    return not head or head.startswith(starts)


def is_page(path: Path) -> bool:
    """Whether a file is a page that mp4ds made."""
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        return PAGE_SIGN in stream.read(_PAGE_BYTES)


# ---------------------------------------------------------------- outputs

_LOCK, _NEW, _OLD = "lock", "new", "old"  # the contents of a folder where an output is made
_SUFFIX = ".part"


@contextmanager
def staged(
    target: Path, *, force: bool, owned: Owned, sources: Sequence[Path] = ()
) -> Iterator[Path]:
    """Make an output under a temporary name and move it into place at the end.

    Args:
        target: The final name; its parent folder must exist.
        force: Replace an existing target.
        owned: Returns which files of an existing target mp4ds wrote.
        sources: What the output is made from: neither may be in the other.

    Yields:
        A path that does not exist yet, for the caller to make a file or folder at.

    Raises:
        TargetExistsError: The target exists and ``force`` is not set.
        TargetError: It cannot be written or replaced.
        WriteError: It could not be written.
    """
    _clear_leftovers(target)
    check_target(target, force=force, owned=owned, sources=sources)
    try:
        folder, held = _begun(target.parent, _prefix(target), _SUFFIX)
    except OSError as error:
        if error.errno in _FULL:
            raise WriteError(target, error) from None
        raise TargetError(
            target, f"cannot be written there: {error.strerror}", "Choose another folder."
        ) from None
    try:
        path = folder / _NEW / target.name
        path.parent.mkdir()
        yield path
        sync(path)
        old = folder / _OLD / target.name
        _move_into_place(path, target, old, force=force, owned=owned)
    except OSError as error:
        raise as_write_error(error, target) from error
    finally:
        _discard(folder)
        held.close()


@contextmanager
def work_folder(parent: Path, prefix: str) -> Iterator[Path]:
    """A private folder for this run, removed at its end; those of killed runs are removed first.

    Args:
        parent: Where it is made.
        prefix: Prefix of its name.

    Raises:
        OSError: It cannot be written.
    """
    for path in _matching(parent, prefix):
        _remove_abandoned(path)
    folder, held = _begun(parent, prefix)
    try:
        yield folder
    finally:
        _discard(folder)
        held.close()


def _begun(parent: Path, prefix: str, suffix: str = "") -> tuple[Path, IO[bytes]]:
    """A new folder and its lock, so that no other run considers it abandoned."""
    while True:
        folder = Path(tempfile.mkdtemp(prefix=prefix, suffix=suffix, dir=parent))
        try:
            file = (folder / _LOCK).open("xb")
            with suppress(BlockingIOError):
                lock(file)
                if (folder / _LOCK).exists():
                    return folder, file
            file.close()
        except FileNotFoundError:
            continue  # another run removed it before it was locked, as may happen above
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise


def _matching(parent: Path, prefix: str, suffix: str = "") -> Iterator[Path]:
    """The folders in which runs work, or have worked."""
    name = re.compile(re.escape(prefix) + "[a-z0-9_]{8}" + re.escape(suffix))
    with suppress(OSError):
        for path in list(parent.iterdir()):
            if name.fullmatch(path.name) and not path.is_symlink() and path.is_dir():
                yield path


def _remove_abandoned(folder: Path, before: Callable[[], None] = lambda: None) -> None:
    """Remove what a killed run left behind; not if another run is active, or that is unknown.

    Args:
        folder: Its folder.
        before: Called before it is removed, if it is.
    """
    with suppress(OSError):
        folder.rmdir()
    with suppress(OSError), (folder / _LOCK).open("r+") as file:
        if is_mine(folder.lstat(), folder.parent) and lock(file):
            before()
            _discard(folder)


def _discard(folder: Path) -> None:
    """Remove a run's folder, the lock last: what is left without it is nobody's."""
    with suppress(OSError):
        for path in folder.iterdir():
            shutil.rmtree(path, ignore_errors=True)  # no file
    shutil.rmtree(folder, ignore_errors=True)


def _prefix(target: Path) -> str:
    return f".{target.name[:60]}."


def _clear_leftovers(target: Path) -> None:
    """Remove what killed runs for a target left behind, if it is recognisable."""

    def restore() -> None:
        if os.path.lexists(old) and not os.path.lexists(target):
            old.rename(target)

    for folder in _matching(target.parent, _prefix(target), _SUFFIX):
        old = folder / _OLD / target.name
        with suppress(OSError):
            parts = list(folder.iterdir())
            inner = [path.name for part in parts if part.name != _LOCK for path in part.iterdir()]
            # another target's long name may start the same
            if {part.name for part in parts} <= {_LOCK, _NEW, _OLD} and (
                {*inner} <= {target.name} and not any(part.is_symlink() for part in parts)
            ):
                # the lock was there before the others, and may be gone or not yet on the disk
                if parts and is_mine(folder.lstat(), folder.parent):
                    (folder / _LOCK).touch()
                _remove_abandoned(folder, restore)


def local_target(path: Path | str) -> Path:
    """The absolute path of an output; links stay as they are.

    Raises:
        TargetError: It is a URL.
    """
    target = location(path)
    if remote(target):
        problem = "is a URL, and outputs are written to local folders"
        raise TargetError(target, problem, "Write it here, then upload it with the store's tool.")
    return Path(os.path.abspath(target))  # noqa: PTH100 - keeps links, unlike resolve()


def check_target(
    target: Path,
    *,
    force: bool,
    owned: Owned,
    sources: Sequence[Path] = (),
) -> None:
    """Refuse a target early, before any work is done, as `staged` refuses it."""
    place = target.resolve()
    for source in (path.resolve() for path in sources if not remote(path)):
        # which would be written into, or replaced with its surroundings
        if place == source or source in place.parents or place in source.parents:
            problem = f"overlaps with the source {source}"
            raise TargetError(target, problem, "Choose a location outside the source.")
    if not target.parent.is_dir():
        raise TargetError(target, f"{target.parent} is not a folder", "Create the folder first.")
    if not os.path.lexists(target):
        return
    if not force:
        raise TargetExistsError(target)
    check_replaceable(target, owned)


def as_write_error(error: OSError, target: Path) -> OSError:
    """The error to report for an operating system's error while writing."""
    is_told = isinstance(error, (WriteError, TargetError)) or error.errno not in _WRITE_ERRNOS
    return error if is_told else WriteError(target, error)


_BLOCK = 2**20
_SEEN_SECONDS, _LOOK_SECONDS = 90.0, 1.0  # NFS keeps names and sizes for up to a minute
_FULL = (errno.ENOSPC, errno.EDQUOT)
_WRITE_ERRNOS = {
    *_FULL,
    errno.EFBIG,
    errno.EIO,
    errno.EROFS,
    errno.EACCES,
    errno.EPERM,
    errno.ENAMETOOLONG,
}


def sync(path: Path) -> None:
    """Sync an output's bytes, and the names in its folders, to disk before its own name."""
    for place in [*sorted(path.rglob("*"), reverse=True), path]:
        if place.is_dir():
            sync_folder(place)
        elif place.is_file():
            with place.open("rb") as stream:
                os.fsync(stream.fileno())


def write_synced(path: Path, data: bytes, *, replace: bool = True) -> None:
    """Write a small file completely or not at all, whatever happens meanwhile.

    Args:
        path: The file.
        data: Its content.
        replace: Replace the file if it exists.

    Raises:
        FileExistsError: It exists and `replace` is false.
        OSError: It cannot be written.
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
    """Sync the names in a folder to disk, if the system can."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def is_seen(is_there: Callable[[], bool], *folders: Path) -> bool:
    """Whether another machine's result exists; a file system may only show it after a while.

    Args:
        is_there: Checks for it.
        folders: The folders it is in.
    """
    end = time.monotonic() + _SEEN_SECONDS
    while not (seen := is_there()) and time.monotonic() < end:
        for folder in folders:
            try:
                list(folder.iterdir())  # which asks the server for its names again
            except FileNotFoundError:
                return False
        time.sleep(_LOOK_SECONDS)
    return seen


def _move_into_place(path: Path, target: Path, old: Path, *, force: bool, owned: Owned) -> None:
    """Give an output its final name, replacing what is there.

    Args:
        path: The complete output; afterwards what it replaced, if names can be swapped.
        target: Its final name.
        old: Where else to move what it replaces, on the same file system.
        force: Replace what is there.
        owned: Returns which files of that mp4ds wrote.

    Raises:
        TargetExistsError: Something is there and ``force`` is not set.
        TargetError: Something else has been put there meanwhile.
    """
    if not os.path.lexists(target):
        try:
            path.rename(target) if path.is_dir() else target.hardlink_to(path)
        except OSError:
            if os.path.lexists(target):
                raise TargetExistsError(target) from None
            path.rename(target)  # of a file where there are no links, which would replace another
    elif not force:
        raise TargetExistsError(target)  # it appeared meanwhile
    else:
        check_replaceable(target, owned)
        if not swap_names(path, target):  # which leaves no moment without either
            old.parent.mkdir(exist_ok=True)
            target.rename(old)
            try:
                path.rename(target)
            except OSError:
                with suppress(OSError):
                    old.rename(target)
                raise
    sync_folder(target.parent)


def digest_file(path: Path) -> tuple[int, str]:
    """Size in bytes and SHA-256 of a file."""
    digest = hashlib.sha256()
    size = 0
    with path.open("rb") as stream:
        while block := stream.read(_BLOCK):
            digest.update(block)
            size += len(block)
    return size, digest.hexdigest()
