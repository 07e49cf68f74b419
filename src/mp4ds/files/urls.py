"""Recordings and datasets at URLs, read by ranges through fsspec.

`location` turns a URL into an object that reads like a `pathlib.Path`, so that nothing else needs
to know where a file is. Local paths never get here, and fsspec is imported for URLs only.
"""

from __future__ import annotations

import io
import re
from bisect import bisect_left, bisect_right
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property
from pathlib import Path, PurePosixPath
from reprlib import repr as shortened
from threading import Lock
from typing import Any, BinaryIO, NamedTuple, cast
from urllib.parse import quote, unquote, urlsplit

from mp4ds.errors import RemoteError, SourceError
from mp4ds.files.store import HTTP, Facts, Place, Range, Store

Fetch = Callable[[Sequence[Range]], list[bytes]]
"""Fetches ranges, all at once."""

KEPT_BYTES = 32 * 2**20
"""Kept per open file, for other readers of the same bytes."""

_IDLE_BYTES = 2**20
_LEAST, _MOST = 2**17, 2**22  # read-ahead: at first, and after a while of reading in order
_FILL_BYTES = 2 * _MOST
_FIRST_BATCH_BYTES, _BATCH_BYTES, _BATCH_RANGES = 2**19, 2**23, 256
_GAP = 2**16  # smaller gaps cost less to fetch than a second request


class Segments:
    """The most recently fetched bytes of a file, shared by all its current readers.

    Threads may share it.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._data: OrderedDict[int, bytes] = OrderedDict()  # by first byte, the latest last
        self._starts: list[int] = []
        self._size = 0
        self._users = 0

    def claim(self) -> None:
        """Keep bytes until `release`."""
        with self._lock:
            self._users += 1

    def release(self) -> None:
        """Drop what is no longer needed."""
        with self._lock:
            self._users -= 1
            if not self._users:
                self._shrink(_IDLE_BYTES)

    def add(self, start: int, data: bytes) -> None:
        """Keep fetched bytes; segments are never nested."""
        end = start + len(data)
        with self._lock:
            number = bisect_right(self._starts, start) - 1
            if number >= 0 and self._end(number) >= end:
                self._data.move_to_end(self._starts[number])
                return
            number = bisect_left(self._starts, start)
            while number < len(self._starts) and self._end(number) <= end:
                self._size -= len(self._data.pop(self._starts.pop(number)))
            self._starts.insert(number, start)
            self._data[start] = data
            self._size += len(data)
            self._shrink(KEPT_BYTES)

    def _end(self, number: int) -> int:
        start = self._starts[number]
        return start + len(self._data[start])

    def _shrink(self, size: int) -> None:
        while self._size > size and self._data:
            start, data = self._data.popitem(last=False)
            del self._starts[bisect_left(self._starts, start)]
            self._size -= len(data)

    def at(self, place: int) -> tuple[int, bytes] | None:
        """The kept bytes that hold a place, and where they begin."""
        with self._lock:
            number = bisect_right(self._starts, place) - 1
            if number < 0:
                return None
            start = self._starts[number]
            data = self._data[start]
            if place >= start + len(data):
                return None
            self._data.move_to_end(start)
            return start, data

    def hold(self, start: int, end: int) -> bool:
        """Whether all bytes of a range are kept."""
        while start < end:
            found = self.at(start)
            if found is None:
                return False
            start = found[0] + len(found[1])
        return True

    def next_start(self, place: int, default: int) -> int:
        """Where the next kept bytes begin after a place."""
        with self._lock:
            number = bisect_right(self._starts, place)
            return self._starts[number] if number < len(self._starts) else default


class RemoteFile(io.RawIOBase):
    """A remote file, open for reading; `read` returns less than requested only at the end.

    Sequential reading fetches more and more ahead, random reading little more than requested.
    Ranges announced by `expect` are fetched while earlier ones are being used.

    Args:
        size: Bytes of the file.
        fetch: Fetches ranges; reading raises its errors.
        segments: The kept bytes of the file.
    """

    def __init__(self, size: int, fetch: Fetch, segments: Segments) -> None:
        super().__init__()
        self._size = size
        self._fetch = fetch
        self._segments = segments
        self._place = 0
        self._read_to = 0
        self._ahead = 0
        self._plan: _Plan | None = None
        segments.claim()

    def expect(self, ranges: Iterable[Range]) -> None:
        """See `mp4ds.files.urls.expect`; replaces earlier announcements."""
        self._drop_plan()
        missing = (span for span in ranges if not self._segments.hold(*span))
        self._plan = _Plan(missing, self._load)

    def read(self, size: int | None = -1, /) -> bytes:
        """Read that many bytes, or all that are left."""
        place = self._place
        wanted = self._size if size is None or size < 0 else place + size
        end = max(place, min(wanted, self._size))
        pieces: list[bytes | memoryview] = []
        while place < end:
            if self._plan:
                self._plan.reach(place)
            found = self._segments.at(place)
            if found is None:
                self._fill(place, end)
                continue
            start, data = found
            piece = memoryview(data)[place - start : end - start]
            pieces.append(piece)
            place += len(piece)
            self._read_to = place
        self._place = place
        return b"".join(pieces)

    def _fill(self, place: int, end: int) -> None:
        """Fetch what is missing from a position on, and something after it."""
        if 0 <= place - self._read_to <= _GAP:
            self._ahead = min(max(2 * self._ahead, _LEAST), _MOST)
        else:
            self._ahead = _LEAST
        wanted = min(max(end, place + self._ahead), place + _FILL_BYTES, self._size)
        stop = self._segments.next_start(place, wanted)
        # After a file's last bytes, readers usually want those before them.
        start = max(0, min(place, self._size - _LEAST)) if stop == self._size else place
        self._load([(start, min(stop, wanted))])

    def _load(self, ranges: Iterable[Range]) -> None:
        pieces = list(_split(ranges, _MOST))
        for (start, _), data in zip(pieces, self._fetch(pieces), strict=True):
            self._segments.add(start, data)

    def readinto(self, buffer: Any, /) -> int:
        """Read into a buffer."""
        view = memoryview(buffer).cast("B")
        data = self.read(len(view))
        view[: len(data)] = data
        return len(data)

    def readable(self) -> bool:
        """Always."""
        return True

    def seekable(self) -> bool:
        """Always."""
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        """Change the position; costs nothing."""
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._place, io.SEEK_END: self._size}[whence]
        if base + offset < 0:
            raise ValueError(f"seek to {base + offset}, before the file")
        self._place = base + offset
        return self._place

    def tell(self) -> int:
        """The position."""
        return self._place

    def close(self) -> None:
        """Stop fetching, and drop what was fetched."""
        if not self.closed:
            self._drop_plan()
            self._segments.release()
        super().close()

    def _drop_plan(self) -> None:
        if self._plan:
            self._plan.close()
            self._plan = None


def _split(ranges: Iterable[Range], most: int) -> Iterator[Range]:
    """Ranges in pieces of that many bytes at most."""
    for start, end in ranges:
        for first in range(start, end, most):
            yield first, min(first + most, end)


class _Plan:
    """Fetches announced ranges in batches, each while the previous one is being used.

    Args:
        ranges: In the order of reading.
        load: Fetches ranges and keeps them.
    """

    def __init__(self, ranges: Iterable[Range], load: Callable[[Iterable[Range]], None]) -> None:
        self._batches = _batches(ranges)
        self._load = load
        self._worker = ThreadPoolExecutor(1, "mp4ds-fetch")
        self._current: list[Range] = []
        self._next: list[Range] = []
        self._coming: Future[None] | None = None
        self._begin_next()

    def reach(self, place: int) -> None:
        """Wait for the bytes at a position, if they are the next announced ones."""
        while _holds(self._next, place) and not _holds(self._current, place):
            if self._coming is None:
                self._coming = self._worker.submit(self._load, self._next)
            coming, self._coming = self._coming, None
            coming.result()
            self._current = self._next
            self._begin_next()
            if self._next:
                self._coming = self._worker.submit(self._load, self._next)

    def _begin_next(self) -> None:
        self._next = next(self._batches, [])

    def close(self) -> None:
        """Stop fetching."""
        self._worker.shutdown(wait=False, cancel_futures=True)


def _holds(ranges: Sequence[Range], place: int) -> bool:
    return any(start <= place < end for start, end in ranges)


def _batches(ranges: Iterable[Range]) -> Iterator[list[Range]]:
    """Ranges to fetch at once, merging those close to each other.

    The batches grow, since readers may stop early.
    """
    batch: list[Range] = []
    size, most = 0, _FIRST_BATCH_BYTES
    for start, end in _split(ranges, _MOST):
        length = end - start
        if batch and (size + length > most or len(batch) == _BATCH_RANGES):
            yield batch
            batch, size, most = [], 0, min(2 * most, _BATCH_BYTES)
        if batch and 0 <= start - batch[-1][1] <= _GAP:
            size += start - batch[-1][1]
            batch[-1] = batch[-1][0], end
        else:
            batch.append((start, end))
        size += length
    if batch:
        yield batch


# ---------------------------------------------------------------- path

_SIGNS = ("dataset.yaml", "metadata.yaml")
"""Files that identify a recording's or dataset's folder on a web server, which lists nothing."""

_FILE_SUFFIXES = (".bag", ".mcap", ".db3", ".zstd", ".mp4", ".yaml", ".yml")


class RemoteStat(NamedTuple):
    """The part of a stat result that stores provide; sizes in bytes, times in nanoseconds."""

    st_size: int
    st_mtime_ns: int = 0


class RemotePath(Place):
    """A URL with the parts of `pathlib.Path` that reading needs.

    A store's information is requested once and cached for the object's life; a new object sees
    changes. Its text has no secrets: neither password nor query.

    Args:
        url: With its scheme; a web address keeps its query, also for files in a folder.
        store: Its file system's store; None to find it.
    """

    def __init__(self, url: str, store: Store | None = None) -> None:
        self.scheme, _, rest = url.partition("://")
        self.scheme = self.scheme.lower()
        query = ""
        if self.scheme in HTTP:
            rest, _, query = rest.partition("#")[0].partition("?")
        self._rest = rest.rstrip("/")
        self._query = f"?{query}" if query else ""
        self._given_store = store

    @property
    def url(self) -> str:
        """The whole URL; it may hold secrets."""
        return f"{self.scheme}://{self._rest}{self._query}"

    def __str__(self) -> str:
        place, slash, path = self._rest.partition("/")
        return f"{self.scheme}://{place.rpartition('@')[2]}{slash}{path}"

    def __repr__(self) -> str:
        return f"RemotePath({str(self)!r})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, RemotePath) and self.url == other.url

    def __hash__(self) -> int:
        return hash(self.url)

    def __lt__(self, other: RemotePath) -> bool:  # type: ignore[override]
        return self.url < other.url

    def __reduce__(self) -> tuple[object, ...]:
        return RemotePath, (self.url,)

    @cached_property
    def _store(self) -> Store:
        return self._given_store or Store(self)

    def check(self) -> None:
        """Refuse a scheme that cannot be used.

        Raises:
            OptionError: Says what to do.
        """
        _ = self._store

    # ---------------------------------------------------------------- names

    @property
    def name(self) -> str:
        """The last part."""
        name = self._rest.rpartition("/")[2]
        return unquote(name) if self.scheme in HTTP else name

    @property
    def suffix(self) -> str:
        """Its extension, with the dot."""
        return PurePosixPath(self.name).suffix

    @property
    def suffixes(self) -> list[str]:
        """All its extensions."""
        return PurePosixPath(self.name).suffixes

    @property
    def stem(self) -> str:
        """The name without its extension."""
        return PurePosixPath(self.name).stem

    @property
    def parent(self) -> RemotePath:
        """Its parent folder; for a bucket or host, itself."""
        return self._at(self._rest.rpartition("/")[0] or self._rest)

    @property
    def parents(self) -> Sequence[RemotePath]:
        """All its parent folders, the nearest first."""
        found = []
        path = self
        while path.parent != path:
            path = path.parent
            found.append(path)
        return found

    def _at(self, rest: str) -> RemotePath:
        return RemotePath(f"{self.scheme}://{rest}{self._query}", self._store)

    def __truediv__(self, name: str) -> RemotePath:  # type: ignore[override]
        tail = str(name).strip("/")
        return self._at(f"{self._rest}/{quote(tail) if self.scheme in HTTP else tail}")

    def with_name(self, name: str) -> RemotePath:
        """A sibling with another name."""
        return self.parent / name

    def with_suffix(self, suffix: str) -> RemotePath:
        """The same with another extension."""
        return self.with_name(PurePosixPath(self.name).with_suffix(suffix).name)

    def absolute(self) -> RemotePath:
        """Itself."""
        return self

    def resolve(self) -> RemotePath:  # type: ignore[override]
        """Itself."""
        return self

    # ---------------------------------------------------------------- what is there

    @cached_property
    def _facts(self) -> Facts | None:
        may_be_folder = self.scheme in HTTP and self.suffix not in _FILE_SUFFIXES
        if may_be_folder and any((self / sign).is_file() for sign in _SIGNS):
            return Facts(True, None, "")
        return self._store.look(self)

    @property
    def tag(self) -> str:
        """The store's tag of the content, which changes with it; may be empty."""
        return self._facts.tag if self._facts else ""

    def exists(self, *, follow_symlinks: bool = True) -> bool:
        """Whether anything exists.

        Raises:
            SourceError: The store refuses to tell.
            RemoteError: It does not answer.
        """
        return self._facts is not None

    def is_dir(self, *, follow_symlinks: bool = True) -> bool:
        """Whether it is a folder; on a web server, one of a recording or dataset."""
        return self._facts is not None and self._facts.is_folder

    def is_file(self, *, follow_symlinks: bool = True) -> bool:
        """Whether it is a file."""
        return self._facts is not None and not self._facts.is_folder

    def stat(self, *, follow_symlinks: bool = True) -> RemoteStat:  # type: ignore[override]
        """Its size.

        Raises:
            FileNotFoundError: It does not exist.
            SourceError: The size is unknown.
        """
        return RemoteStat(0 if self.is_dir() else self._size())

    def _size(self) -> int:
        facts = self._facts
        if facts is None:
            raise FileNotFoundError(2, "No such file", str(self))
        if facts.size is None:
            raise SourceError(
                self,
                "cannot be read remotely: the server does not report its size",
                "Download it first.",
            )
        return facts.size

    def iterdir(self) -> Iterator[RemotePath]:  # type: ignore[override]
        """Its direct entries; none on a web server, which does not list."""
        return (self / name for name in self._store.names(self))

    def rglob(self, name: str) -> Iterator[RemotePath]:  # type: ignore[override]
        """The files with a name (not a pattern) in and below it; none on a web server."""
        return (path for path in self.files() if path.name == name)

    def files(self) -> list[RemotePath]:
        """All files in and below it; none on a web server, which does not list."""
        return [self / path for path in self._store.files(self)]

    # ---------------------------------------------------------------- content

    @cached_property
    def _segments(self) -> Segments:
        return Segments()

    @cached_property
    def _open_size(self) -> int:
        size = self._size()
        self._store.check_ranges(self, size)
        return size

    def _fetch(self, ranges: Sequence[Range]) -> list[bytes]:
        return self._store.fetch(self, ranges)

    def open(self, mode: str = "rb") -> BinaryIO:  # type: ignore[override]
        """Open it for reading by ranges.

        Raises:
            FileNotFoundError: It does not exist.
            SourceError: The store denies access, or does not support ranges.
            RemoteError: It does not answer.
        """
        if mode != "rb":
            raise ValueError(f"mode {mode!r}: a remote file is opened with 'rb' only")
        if self.is_dir():
            raise IsADirectoryError(21, "Is a folder", str(self))
        return cast(BinaryIO, RemoteFile(self._open_size, self._fetch, self._segments))

    def read_bytes(self) -> bytes:
        """All of it."""
        with self.open() as stream:
            return stream.read()

    # ---------------------------------------------------------------- writing

    @property
    def is_writable(self) -> bool:
        """Whether its kind of store accepts uploads."""
        return self.scheme not in HTTP

    def upload(self, local: Path) -> RemotePath:
        """Upload a file here, replacing what is there.

        Returns:
            A path with the new state.

        Raises:
            TargetError: The store denies access.
            RemoteError: It does not respond, or has stored less.
        """
        self._store.put(local, self)
        now = RemotePath(self.url, self._store)
        sizes = now.stat().st_size if now.exists() else 0, local.stat().st_size
        if sizes[0] != sizes[1]:
            problem = f"could not be uploaded: only {sizes[0]} of {sizes[1]} bytes arrived"
            raise RemoteError(self, problem)
        return now

    def remove(self) -> None:
        """Remove the file here, if there is one.

        Raises:
            TargetError: The store denies access.
            RemoteError: It does not answer.
        """
        self._store.remove(self)


# ---------------------------------------------------------------- remote

_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+)://")
_LOCAL = ("file", "local")


def location(path: Path | str) -> Path:
    """Where a user's path or URL points to.

    Args:
        path: A local path, or a URL of a scheme that fsspec knows, such as ``s3``, ``gs``,
            ``https`` or ``file``.

    Returns:
        The local path; for a URL a `RemotePath`, which has what reading needs of a path.

    Raises:
        OptionError: The scheme is not known, or what it needs is not installed.
        TypeError: It is neither a path nor a text, such as a list or an open dataset.
    """
    if not isinstance(path, str):
        if not isinstance(path, (Path, RemotePath)):
            raise TypeError(f"{shortened(path)} is no path: give a str, a pathlib.Path, or a URL")
        return path
    match = _URL.match(path)
    if match is None:
        return Path(path)
    if match[1].lower() in _LOCAL:
        return Path(unquote(urlsplit(path).path))
    found = RemotePath(path)
    found.check()
    return found


def remote(path: object) -> RemotePath | None:
    """The result of `location` for a URL; None for a local path."""
    return path if isinstance(path, RemotePath) else None


def spelled(path: Path) -> str:
    """A full path or URL, from which `location` rebuilds it anywhere on this machine."""
    found = remote(path)
    return found.url if found else str(path.absolute())


def expect(stream: object, ranges: Iterable[tuple[int, int]]) -> None:
    """Announce which bytes of a file will be read, so that a remote one fetches them in time.

    Args:
        stream: From ``open("rb")`` of a local path or a `RemotePath`.
        ranges: First byte and end of each, in the order of reading; other bytes may be read
            between.
    """
    if isinstance(stream, RemoteFile):
        stream.expect(ranges)
