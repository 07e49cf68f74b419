"""The files that a recording consists of; one of them may be a folder of images.

Such a folder counts as one file, since a manifest cannot list a hundred thousand: what is in it,
without the folders, in the order of the names. Its digest is that of a listing as sha256sum
writes it.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

from mp4ds.outputs import digest_file
from mp4ds.remote import remote


def is_folder(path: Path) -> bool:
    """Whether a file of a recording is a folder."""
    return not remote(path) and path.is_dir()


def members(folder: Path) -> list[Path]:
    """The regular files directly in a folder, by name.

    Raises:
        OSError: It cannot be read.
    """
    return sorted((path for path in folder.iterdir() if path.is_file()), key=_name)


def _name(path: Path) -> bytes:
    return path.name.encode(errors="surrogateescape")


def source_size(path: Path) -> int:
    """Bytes of a file of a recording.

    Raises:
        OSError: It cannot be read.
    """
    if is_folder(path):
        return sum(member.stat().st_size for member in members(path))
    return path.stat().st_size


def source_digest(path: Path) -> tuple[int, str]:
    """Size in bytes and SHA-256 of a file of a recording.

    Of a folder it is the SHA-256 of a line for each member: its own SHA-256, two spaces and its
    name.

    Raises:
        OSError: It cannot be read.
    """
    if not is_folder(path):
        return digest_file(path)
    total, listing = 0, hashlib.sha256()
    for member in members(path):
        size, digest = digest_file(member)
        total += size
        listing.update(b"%b  %b\n" % (digest.encode(), _name(member)))
    return total, listing.hexdigest()


def source_name(path: Path, folder: Path | None) -> str:
    """Name of a recording's file in a manifest: with its folder's, where that was given."""
    if folder is None or path == folder:
        return path.name
    if path.parent == folder:
        return f"{folder.name}/{path.name}"
    if remote(path) or folder not in path.parents:
        return path.name
    return f"{folder.name}/{path.relative_to(folder).as_posix()}"
