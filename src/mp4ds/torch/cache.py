"""Frames that were decoded before, in files of a folder that all processes of a machine share."""

from __future__ import annotations

import os
import shutil
import warnings
import weakref
from contextlib import ExitStack, suppress
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import xxhash

from mp4ds._version import __version__
from mp4ds.dataset.stream import Stream
from mp4ds.dataset.topic import Topic
from mp4ds.errors import OptionError, VideoError
from mp4ds.files.outputs import lock
from mp4ds.messages.encodings import Pixels

RAM = "ram"
"""Names the folder of this user in shared memory."""

CACHE_BYTES = 8 << 30
"""What a cache may take unless told otherwise."""

_SHARED_MEMORY = Path("/dev/shm")
_SUM_BYTES = 8


class FrameCache:
    """A folder with a file for each camera and way to return its frames.

    A file has a place for each frame, with a checksum of its pixels. So processes need no lock, and
    what a killed one wrote half counts as missing, as does what a crash of the machine took.

    The folder in shared memory is removed by the last process that made a cache there, unless it is
    killed: then by the last one of a later training.

    Args:
        where: A folder, which is made, or `RAM`.
        most: Maximum of bytes, over all cameras.
        frames: Of all cameras: a camera gets a share for each of its frames.

    Raises:
        OptionError: The folder cannot be used, or `most` is not positive.
    """

    def __init__(self, where: str | Path, most: int, frames: int) -> None:
        if most < 1:
            raise OptionError(f"cache_bytes is {most}, but must be at least 1.")
        if not hasattr(os, "preadv"):
            raise OptionError("cache needs Linux, a BSD or macOS 11.")
        self._most, self._frames = most, frames
        self._folder = Path(where).absolute()
        self._users: BinaryIO | None = None
        try:
            if where == RAM:
                self._use_shared_memory()
            else:
                self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OptionError(f"cache {self._folder} cannot be used: {error.strerror}.") from None

    def _use_shared_memory(self) -> None:
        if not _SHARED_MEMORY.is_dir():
            raise OptionError("cache='ram' needs /dev/shm; give a folder instead.")
        self._folder = _SHARED_MEMORY / f"mp4ds-{os.getuid()}"
        while self._users is None:
            self._folder.mkdir(mode=0o700, exist_ok=True)
            found = self._folder.lstat()
            if found.st_uid != os.getuid() or found.st_mode & 0o77:
                raise OptionError(f"cache {self._folder} belongs to somebody else; give a folder.")
            with suppress(FileNotFoundError, BlockingIOError):  # its last user removes it just now
                self._users = _used(self._folder / "users")
        weakref.finalize(self, _leave, self._folder, self._users, os.getpid())

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_users": None}

    def camera(self, topic: Topic, view: dict[str, Any], like: Pixels) -> CachedFrames:
        """The frames of a camera, as they are returned.

        Args:
            topic: The camera.
            view: Format, size and crop.
            like: An array of no frames, but of their shape and type.

        Raises:
            OptionError: The file cannot be opened.
            VideoError: A video is missing.
        """
        # decoders of other versions may round differently where they resize
        told = [__version__, version("av"), view, like.shape, like.dtype.str, len(topic)]
        try:
            told += [fact for part in topic.parts for fact in _facts(part)]
        except OSError as error:
            place = topic.parts[0].video_path
            raise VideoError("file-missing", place, f"cannot be read: {error.strerror}") from None
        path = self._folder / f"{sha256(repr(told).encode()).hexdigest()[:32]}.frames"
        size = int(np.prod(like.shape[1:])) * like.itemsize
        places = self._most * len(topic) // self._frames // (size + _SUM_BYTES)
        try:
            return CachedFrames(path, size, min(places, len(topic)))
        except OSError as error:
            raise OptionError(f"cache {path} cannot be opened: {error.strerror}.") from None


def _facts(part: Any) -> list[object]:
    """What tells the images of a part from all others: digests, else what a change alters."""
    if not isinstance(part, Stream):
        return _state(part.path)
    found: list[object] = [part.layer, sha256(part.path.read_bytes()).hexdigest()]
    for path, video in part.videos:  # the sidecar has the digests
        found += [path.stat().st_size] if video.sha256 else _state(path)
    return found


def _state(path: Path) -> list[object]:
    found = path.stat()
    return [str(path), found.st_size, found.st_mtime_ns]


def _used(path: Path) -> BinaryIO:
    """A file that is locked as one of several users.

    Raises:
        FileNotFoundError: It was removed meanwhile.
        BlockingIOError: It is being removed.
    """
    with ExitStack() as stack:
        file = stack.enter_context(path.open("ab"))
        lock(file, shared=True)
        if os.fstat(file.fileno()).st_ino != path.stat().st_ino:
            raise FileNotFoundError
        stack.pop_all()
        return file


def _leave(folder: Path, users: BinaryIO, process: int) -> None:
    """Remove the folder if nobody else uses it; a fork is no user."""
    with users:
        if os.getpid() == process:
            with suppress(BlockingIOError):
                lock(users)
                shutil.rmtree(folder, ignore_errors=True)


class CachedFrames:
    """The frames of one camera that are in the cache. One thread at a time may use it.

    Args:
        path: The file; made if it is missing.
        size: Bytes of a frame.
        places: How many frames may be in it: the first ones.

    Raises:
        OSError: The file cannot be opened.
    """

    def __init__(self, path: Path, size: int, places: int) -> None:
        self._path, self._size, self._places = path, size, places
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        self._sum = np.zeros(1, np.uint64)

    def load(self, number: int, out: Pixels) -> bool:
        """Whether a frame is there; it is written to `out`, contiguous, which else has anything."""
        if number >= self._places:
            return False
        place = number * (self._size + _SUM_BYTES)
        if os.preadv(self._file, [out.data, self._sum.data], place) < self._size + _SUM_BYTES:
            return False
        return bool(self._sum[0]) and xxhash.xxh3_64_intdigest(out.data) == self._sum[0]

    def store(self, number: int, pixels: Pixels) -> None:
        """Keep a frame, contiguous, if it has a place."""
        if number >= self._places:
            return
        self._sum[0] = xxhash.xxh3_64_intdigest(pixels.data)
        try:
            place = number * (self._size + _SUM_BYTES)
            os.pwritev(self._file, [pixels.data, self._sum.data], place)
        except OSError as error:  # what was written in part counts as missing
            self._places = 0
            reason = f"the cache {self._path} cannot be written: {error.strerror}"
            warnings.warn(f"{reason}; frames are decoded instead", stacklevel=2)

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)
