"""A file or folder at a URL, as a path that can be read."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import BinaryIO, NamedTuple, cast
from urllib.parse import quote, unquote

from mp4ds.errors import RemoteError, SourceError
from mp4ds.remote.file import Range, RemoteFile, Segments
from mp4ds.remote.store import HTTP, Facts, Store

_SIGNS = ("dataset.yaml", "metadata.yaml")
"""What a web server has of a folder that holds a recording or a dataset; it lists nothing."""

_FILE_SUFFIXES = (".bag", ".mcap", ".db3", ".zstd", ".mp4", ".yaml", ".yml")


class RemoteStat(NamedTuple):
    """As much of a stat result as a store tells; sizes in bytes, times in nanoseconds."""

    st_size: int
    st_mtime_ns: int = 0


class RemotePath:
    """A URL with what reading needs of `pathlib.Path`.

    What a store tells of it is asked for once and holds as long as the object does; an object
    made anew sees changes. Its text has no secrets: neither password nor query.

    Args:
        url: With its scheme; of a web address the query is kept, also for files in a folder.
        store: Of its file system; None to find it.
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

    def __lt__(self, other: RemotePath) -> bool:
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
        """Its ending, with the dot."""
        return PurePosixPath(self.name).suffix

    @property
    def suffixes(self) -> list[str]:
        """All its endings."""
        return PurePosixPath(self.name).suffixes

    @property
    def stem(self) -> str:
        """The name without its ending."""
        return PurePosixPath(self.name).stem

    @property
    def parent(self) -> RemotePath:
        """The folder that it is in; of a bucket or host, itself."""
        return self._at(self._rest.rpartition("/")[0] or self._rest)

    @property
    def parents(self) -> Sequence[RemotePath]:
        """All folders that it is in, the nearest first."""
        found = []
        path = self
        while path.parent != path:
            path = path.parent
            found.append(path)
        return found

    def _at(self, rest: str) -> RemotePath:
        return RemotePath(f"{self.scheme}://{rest}{self._query}", self._store)

    def __truediv__(self, name: str) -> RemotePath:
        tail = str(name).strip("/")
        return self._at(f"{self._rest}/{quote(tail) if self.scheme in HTTP else tail}")

    def with_name(self, name: str) -> RemotePath:
        """Another one in the same folder."""
        return self.parent / name

    def with_suffix(self, suffix: str) -> RemotePath:
        """The same with another ending."""
        return self.with_name(PurePosixPath(self.name).with_suffix(suffix).name)

    def absolute(self) -> RemotePath:
        """Itself."""
        return self

    def resolve(self) -> RemotePath:
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
        """What the store says of the content, and would say otherwise of another; may be empty."""
        return self._facts.tag if self._facts else ""

    def exists(self) -> bool:
        """Whether there is anything.

        Raises:
            SourceError: The store refuses to tell.
            RemoteError: It does not answer.
        """
        return self._facts is not None

    def is_dir(self) -> bool:
        """Whether it is a folder; of a web server, one of a recording or dataset."""
        return self._facts is not None and self._facts.is_folder

    def is_file(self) -> bool:
        """Whether it is a file."""
        return self._facts is not None and not self._facts.is_folder

    def stat(self, *, follow_symlinks: bool = True) -> RemoteStat:
        """Its size.

        Raises:
            FileNotFoundError: There is nothing.
            SourceError: The size is not told.
        """
        return RemoteStat(0 if self.is_dir() else self._size())

    def _size(self) -> int:
        facts = self._facts
        if facts is None:
            raise FileNotFoundError(2, "No such file", str(self))
        if facts.size is None:
            raise SourceError(
                cast(Path, self),
                "cannot be read where it is: its size is not told",
                "Download it first.",
            )
        return facts.size

    def iterdir(self) -> Iterator[RemotePath]:
        """What is directly in it; nothing of a web server, which does not list."""
        return (self / name for name in self._store.names(self))

    def rglob(self, name: str) -> Iterator[RemotePath]:
        """The files of a name (no pattern) in it and below; nothing of a web server."""
        return (path for path in self.files() if path.name == name)

    def files(self) -> list[RemotePath]:
        """All files in it and below; none of a web server, which does not list."""
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

    def open(self, mode: str = "rb") -> BinaryIO:
        """Open it for reading by ranges.

        Raises:
            FileNotFoundError: There is nothing.
            SourceError: The store refuses, or serves no ranges.
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
        """Whether its kind of store takes uploads."""
        return self.scheme not in HTTP

    def upload(self, local: Path) -> RemotePath:
        """Put a file here, in the place of what is there.

        Returns:
            The path, which tells what is there now.

        Raises:
            TargetError: The store refuses.
            RemoteError: It does not answer, or has kept less.
        """
        self._store.put(local, self)
        now = RemotePath(self.url, self._store)
        sizes = now.stat().st_size if now.exists() else 0, local.stat().st_size
        if sizes[0] != sizes[1]:
            problem = f"could not be uploaded: {sizes[0]} of {sizes[1]} bytes are there"
            raise RemoteError(cast(Path, self), problem)
        return now

    def remove(self) -> None:
        """Remove the file here, if there is one.

        Raises:
            TargetError: The store refuses.
            RemoteError: It does not answer.
        """
        self._store.remove(self)
