"""The files that a recording consists of; one of them may be a folder of images.

Such a folder counts as one file, since a manifest cannot list a hundred thousand: its files,
without subfolders, sorted by name. Its digest is that of a listing in the format of sha256sum.
"""

from __future__ import annotations

import hashlib
import os
import shlex
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import xxhash

from mp4ds.errors import SourceError
from mp4ds.files.outputs import digest_file
from mp4ds.files.urls import location, remote, spelled

_SAMPLE = 2**16
_BLOCK = 2**20
_SIDES = ("-wal", "-journal")
"""Files that sqlite keeps next to a database in use: its latest changes."""


_VIDEOS = (".mp4", ".m4v", ".mov", ".mkv", ".webm", ".avi")
HOW_TO_OPEN = (
    "`mp4ds.open` reads frames of an .mp4 or .mov without packing; to convert other videos, run "
    "`ffmpeg -i VIDEO -c copy VIDEO.mp4`."
)
"""Advice for a video given instead of a recording or dataset."""


RECORDING_NAME = "recording.json"
"""File of a folder in which a recording is being made, or was when it was cut off."""


UNFINISHED = ".recording"
"""What the name of such a folder ends with."""


def is_unfinished(folder: Path) -> bool:
    """Whether a folder holds a recording that is being made, or was cut off."""
    return not remote(folder) and (folder / RECORDING_NAME).is_file()


def salvage_command(folder: Path) -> str:
    """The command that makes a dataset of an unfinished recording."""
    target = folder.with_suffix("") if folder.suffix == UNFINISHED else "DATASET"
    return f"mp4ds pack --salvage {shlex.quote(str(folder))} -o {shlex.quote(str(target))}"


def refuse_unfinished(folder: Path) -> None:
    """Refuse a recording that is not a dataset yet.

    Raises:
        SourceError: It is one.
    """
    if is_unfinished(folder):
        remedy = f"Make a dataset of it first: {salvage_command(folder)}"
        raise SourceError(folder, "is being recorded, or was cut off", remedy)


def is_video(path: Path) -> bool:
    """Whether a file is a video, by its name."""
    return path.suffix.lower() in _VIDEOS and path.is_file()


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

    For a folder it is the SHA-256 of a line for each member: its own SHA-256, two spaces and its
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
    """Name of a recording's file in a manifest: with its folder's, if that was given."""
    if folder is None or path == folder:
        return path.name
    if path.parent == folder:
        return f"{folder.name}/{path.name}"
    if remote(path) or folder not in path.parents:
        return path.name
    return f"{folder.name}/{path.relative_to(folder).as_posix()}"


@dataclass(frozen=True, slots=True)
class SourceState:
    """The state of a recording's file, by which changes are detected on any machine.

    Attributes:
        path: Absolute, or a URL.
        size: Bytes.
        modified_ns: Modification time; 0 at a URL.
        sample: XXH64 of its first and last bytes and of what sqlite keeps next to it, or of the
            names, sizes and times in a folder; at a URL, the store's tag for its content, such as
            an ETag, if any.
    """

    path: str
    size: int
    modified_ns: int
    sample: str

    @classmethod
    def of(cls, path: Path) -> SourceState:
        """The state of a file now.

        Raises:
            SourceError: It cannot be read.
        """
        try:
            if is_folder(path):
                digest = xxhash.xxh64()
                size, latest = _add_listing(digest, members(path))
                return cls(spelled(path), size, latest, digest.hexdigest())
            stat = path.stat()
            found = remote(path)
            if found and found.tag:
                return cls(found.url, stat.st_size, 0, found.tag)
            with path.open("rb") as stream:
                digest = xxhash.xxh64(stream.read(_SAMPLE))
                if stat.st_size > _SAMPLE:
                    stream.seek(max(_SAMPLE, stat.st_size - _SAMPLE))
                    digest.update(stream.read(_SAMPLE))
            if not found:
                sides = [path.with_name(path.name + suffix) for suffix in _SIDES]
                _add_listing(digest, list(filter(os.path.isfile, sides)))  # also of long names
        except OSError as error:
            raise SourceError(path, f"cannot be read: {error.strerror}") from None
        return cls(spelled(path), stat.st_size, stat.st_mtime_ns, digest.hexdigest())

    def check(self) -> None:
        """Refuse the file if it has changed.

        Raises:
            SourceError: It has changed, or cannot be read.
        """
        path = location(self.path)
        if SourceState.of(path) != self:
            remedy = "Start over with `restart`, or restore the file as it was."
            raise SourceError(path, "has changed since packing began", remedy)


def _add_listing(digest: xxhash.xxh64, files: Sequence[Path]) -> tuple[int, int]:
    """Add names, sizes and times of files to a digest; bytes of all, and the latest time."""
    size = latest = 0
    for path in files:
        stat = path.stat()
        digest.update(f"{path.name}\0{stat.st_size}\0{stat.st_mtime_ns}\n".encode(errors="replace"))
        size += stat.st_size
        latest = max(latest, stat.st_mtime_ns)
    return size, latest


@contextmanager
def unchanged(states: Sequence[SourceState]) -> Iterator[None]:
    """Refuse a recording that changes while it is read within the context.

    Args:
        states: The states its files must keep throughout.

    Raises:
        SourceError: Names a file that has changed or been replaced.
    """
    for state in states:
        state.check()
    before = [_identities(location(state.path)) for state in states]

    def check() -> None:
        for state, identities in zip(states, before, strict=True):
            path = location(state.path)
            if SourceState.of(path) != state or any(map(_differ, identities, _identities(path))):
                remedy = "Pack it again when nothing is writing to it."
                raise SourceError(path, "changed while it was being read", remedy)

    try:
        yield
    except SourceError:
        check()  # it may look damaged because it changed
        raise
    check()


def _identities(path: Path) -> list[tuple[int, int, int]]:
    """Device, inode and time of the last change of a file, or of all in a folder."""
    if remote(path):
        return []
    stats = (one.stat() for one in (members(path) if is_folder(path) else [path]))
    return [(stat.st_dev, stat.st_ino, stat.st_ctime_ns) for stat in stats]


def _differ(before: tuple[int, int, int], now: tuple[int, int, int]) -> bool:
    """Whether a name now belongs to a different file."""
    # a network file system may renumber the same file, and a new link changes its time
    return before[:2] != now[:2] and before[2] != now[2]


class SourceHasher:
    """SHA-256 of the source files, computed just behind the reader.

    The bytes are still in the system's cache then, so the disk is read once. A folder is hashed
    when the reader is past its bytes. A context manager.

    Args:
        files: All files, in reading order.
    """

    def __init__(self, files: Sequence[Path]) -> None:
        self._digests: list[tuple[int, str]] = []
        self._position = 0
        self._steps = self._hashed(files)

    def _hashed(self, files: Sequence[Path]) -> Generator[int]:
        """Hash the files step by step, and give the bytes of each step."""
        for path in files:
            try:
                if is_folder(path):
                    yield source_size(path)
                    self._digests.append(source_digest(path))
                    continue
                size, digest = 0, hashlib.sha256()
                # it stays open until all is read, since another file may get the name
                with path.open("rb") as stream:
                    while block := stream.read(_BLOCK):
                        size += len(block)
                        digest.update(block)
                        yield len(block)
                self._digests.append((size, digest.hexdigest()))
            except OSError as error:
                raise SourceError(path, f"cannot be read: {error.strerror}") from None

    def advance(self, position: int | None) -> None:
        """Hash up to a position in all files, None for the end.

        Raises:
            SourceError: A file cannot be read.
        """
        while position is None or self._position < position:
            step = next(self._steps, None)
            if step is None:
                return
            self._position += step

    def digest(self, number: int) -> tuple[int, str]:
        """Size in bytes and SHA-256 of a file by its number; reads all files to the end first.

        Raises:
            SourceError: It cannot be read.
        """
        if number >= len(self._digests):
            self.advance(None)
        return self._digests[number]

    def __enter__(self) -> SourceHasher:
        return self

    def __exit__(self, *_: object) -> None:
        self._steps.close()
