"""Which files mp4ds wrote: only these are replaced or removed.

What is asked for each kind of output is a list of its names, which the output itself tells: a
manifest, the metadata of a recording, a note. One file that is not in it keeps all from being
replaced, as does a symbolic link, which mp4ds never makes.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Collection, Iterable
from pathlib import Path, PurePosixPath

from mp4ds.errors import TargetError

Owned = Callable[[Path], Iterable[str] | None]
"""Tells the names of an output's files, from its folder on; None: it is none that mp4ds writes.

Of an output that is a file, the one name is empty.
"""

LISTING_NAME = "mp4ds_files.json"
"""File of a folder that lists the files in it, where nothing else does."""

PAGE_SIGN = b'<meta name="generator" content="mp4ds'
"""Within the first bytes of each page that mp4ds makes."""

_PAGE_NAME = "index.html"
_PAGE_BYTES = 1000
_MOST_BYTES = 2**26
_NAMED = 3


def check_replaceable(target: Path, owned: Owned) -> None:
    """Refuse to replace what mp4ds did not write.

    Args:
        target: What is there.
        owned: Tells its names.

    Raises:
        TargetError: It is something else, or there is something else in it.
    """
    if target.is_symlink():
        raise TargetError(
            target,
            "is a symbolic link, which --force does not replace",
            f"Name {os.path.realpath(target)} itself, or remove the link.",
        )
    is_folder = target.is_dir()
    if is_folder and not any(target.iterdir()):
        return
    names = refuse_not_ours(target, owned(target))
    if is_folder:
        refuse_strangers(target, strangers(target, names))


def refuse_not_ours(target: Path, names: Iterable[str] | None) -> set[str]:
    """The names of an output's files.

    Raises:
        TargetError: There are none: it is not of the kind.
    """
    if names is None:
        raise TargetError(
            target,
            "exists and is not something that mp4ds wrote, so --force does not replace it",
            "Choose another name, or remove it yourself.",
        )
    return set(names)


def refuse_strangers(target: Path, others: Collection[str]) -> None:
    """Refuse to replace a folder that holds something else, too.

    Raises:
        TargetError: Names some of it.
    """
    if not others:
        return
    listed = ", ".join(sorted(others)[:_NAMED]) + (", ..." if len(others) > _NAMED else "")
    what = "1 thing" if len(others) == 1 else f"{len(others)} things"
    raise TargetError(
        target,
        f"holds {what} that mp4ds did not write ({listed}), so --force does not replace it",
        "Move that elsewhere, or choose another name.",
    )


def strangers(folder: Path, names: Collection[str]) -> list[str]:
    """What is in a folder besides files of some names, those of a report in it, and their folders.

    Args:
        folder: The folder.
        names: From it on, with slashes.

    Returns:
        Names; that of a folder, in which nothing is known, ends with a slash.
    """
    known = set(names)
    folders = {str(above) for name in known for above in PurePosixPath(name).parents}
    found: list[str] = []
    waiting = [(folder, "")]
    while waiting:
        place, prefix = waiting.pop()
        with os.scandir(place) as entries:
            for entry in entries:
                name, path = prefix + entry.name, Path(entry.path)
                if entry.is_dir(follow_symlinks=False):
                    listed = listed_names(path) or ()
                    known.update(f"{name}/{inner}" for inner in listed)
                    if name in folders or listed:
                        folders.update(
                            f"{name}/{above}"
                            for inner in listed
                            for above in PurePosixPath(inner).parents
                        )
                        waiting.append((path, f"{name}/"))
                    else:
                        found.append(f"{name}/")
                elif not entry.is_file(follow_symlinks=False) or not (
                    name in known or (name == _PAGE_NAME and is_page(path))
                ):
                    found.append(name)
    return found


def write_listing(folder: Path) -> None:
    """List all files of a folder in it."""
    names = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())
    text = json.dumps({"files": names}, indent=1) + "\n"
    (folder / LISTING_NAME).write_text(text, encoding="utf-8")


def listed_names(folder: Path, listing: str = LISTING_NAME) -> set[str] | None:
    """The names that a listing in a folder tells, with its own; None where there is none.

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
