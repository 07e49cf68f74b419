"""Recordings and datasets at URLs, read by ranges through fsspec.

`location` turns a URL into an object that reads like a `pathlib.Path`, so that nothing else needs
to know where a file is. Local paths never get here, and fsspec is imported for URLs only.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache, cached_property, partial
from pathlib import Path, PurePosixPath
from reprlib import repr as shortened
from typing import TYPE_CHECKING, Any, BinaryIO, cast
from urllib.parse import quote, unquote, urlsplit

from mp4ds.errors import Mp4dsError, OptionError, Refused, RemoteError, SourceError
from mp4ds.files.ranges import Blocks, Range, RemoteFile

_HTTP = ("http", "https")
_S3 = ("s3", "s3a")
_HUB = "hf"  # of Hugging Face, whose files would read ahead, and fetch one range after another
_INSTALL = "Run: pip install 'mp4ds[remote]'"
# Many small ranges are requested at once, on that many connections; botocore's default is 10.
_AT_ONCE, _HUB_AT_ONCE = 32, 8
_TAGS = ("ETag", "etag", "blob_id", "md5Hash", "Content-MD5")
_TIMES = ("LastModified", "Last-Modified", "mtime")
_GONE = "could not be read: it no longer exists"
_NETWORK = "Check the network, and try again."
_ACCESS = "Check the address and your credentials for it."

_SIGNS = ("dataset.yaml", "metadata.yaml")
"""Files that identify a recording's or dataset's folder on a web server, which lists nothing."""

_FILE_SUFFIXES = (".bag", ".mcap", ".db3", ".zstd", ".mp4", ".yaml", ".yml")

if TYPE_CHECKING:
    # all that reads a path may be given one at a URL, which has what reading needs of it; it is no
    # path at run time, so that what only the local file system has is an error there
    _Path = Path
else:
    _Path = object


class RemotePath(_Path):
    """A URL with the parts of `pathlib.Path` that reading needs.

    A store's information is requested once and cached for the object's life; a new object sees
    changes. Its text has no secrets: neither password nor query.

    Args:
        url: With its scheme; a web address keeps its query, also for files in a folder.
        file_system: fsspec's, of another path in the same store; None to find it.
    """

    def __init__(self, url: str, file_system: Any = None) -> None:
        self.scheme, _, rest = url.partition("://")
        self.scheme = self.scheme.lower()
        self._on_web = self.scheme in _HTTP
        query = ""
        if self._on_web:
            rest, _, query = rest.partition("#")[0].partition("?")
        self._rest = rest.rstrip("/")
        self._query = f"?{query}" if query else ""
        if file_system is not None:
            self._files = file_system

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

    # ---------------------------------------------------------------- names

    @property
    def name(self) -> str:
        """The last part."""
        name = self._rest.rpartition("/")[2]
        return unquote(name) if self._on_web else name

    @property
    def suffix(self) -> str:
        """Its extension, with the dot."""
        return PurePosixPath(self.name).suffix

    @property
    def stem(self) -> str:
        """The name without its extension."""
        return PurePosixPath(self.name).stem

    @property
    def parent(self) -> RemotePath:
        """Its parent folder; for a bucket or host, itself."""
        return self._at(self._rest.rpartition("/")[0] or self._rest)

    def _at(self, rest: str) -> RemotePath:
        return RemotePath(f"{self.scheme}://{rest}{self._query}", self.__dict__.get("_files"))

    def __truediv__(self, name: str) -> RemotePath:  # type: ignore[override]
        tail = str(name).strip("/")
        return self._at(f"{self._rest}/{quote(tail) if self._on_web else tail}")

    def with_name(self, name: str) -> RemotePath:
        """A sibling with another name."""
        return self.parent / name

    def with_suffix(self, suffix: str) -> RemotePath:
        """The same with another extension."""
        return self.with_name(PurePosixPath(self.name).with_suffix(suffix).name)

    def resolve(self) -> RemotePath:  # type: ignore[override]
        """Itself."""
        return self

    # ---------------------------------------------------------------- what is there

    @cached_property
    def _files(self) -> Any:
        """The file system of its store.

        Raises:
            OptionError: The scheme is unknown, or its dependency is not installed.
        """
        try:
            import fsspec
            from fsspec.config import conf
            from fsspec.core import url_to_fs
        except ImportError:
            raise OptionError(f"{self}: URLs need an optional dependency. {_INSTALL}") from None
        if self.scheme not in fsspec.available_protocols():
            raise OptionError(
                f"{self}: {self.scheme}:// is not supported. Use s3, gs, hf, https, http, file, or "
                "another fsspec scheme."
            )
        options: dict[str, Any] = {}
        if self.scheme in _S3 and "config_kwargs" not in conf.get("s3", {}):
            options["config_kwargs"] = {"max_pool_connections": _AT_ONCE}
        try:
            found = url_to_fs(self.url, **options)[0]
            if self._on_web:
                found = _range_file_system()(**found.storage_options)
        except ImportError as error:
            is_of_extra = self.scheme in (*_S3, *_HTTP)
            remedy = _INSTALL if is_of_extra else _text(error)
            raise OptionError(
                f"{self}: {self.scheme}:// URLs need an optional dependency. {remedy}."
            ) from None
        except Exception as error:
            problem = f"could not be opened: {_explained(error)[1]}"
            raise RemoteError(self, problem, _ACCESS) from None
        return found

    def check(self) -> None:
        """Refuse a scheme that cannot be used.

        Raises:
            OptionError: Says what to do.
        """
        _ = self._files

    @property
    def _key(self) -> str:
        """What its store calls it."""
        return str(self._files._strip_protocol(self.url))

    @cached_property
    def _info(self) -> Mapping[str, Any] | None:
        """What its store says of it; None for nothing there."""
        may_be_folder = self._on_web and self.suffix not in _FILE_SUFFIXES
        if may_be_folder and any((self / sign).is_file() for sign in _SIGNS):
            return {"type": "directory"}
        try:
            with _sentences(self):
                self._files.invalidate_cache()
                info: Mapping[str, Any] = self._files.info(self._key)
        except FileNotFoundError:
            return None
        return info

    @property
    def tag(self) -> str:
        """The store's tag of the content, which changes with it; may be empty."""
        info = self._info or {}
        return next((f"{name} {info[name]}" for name in (*_TAGS, *_TIMES) if info.get(name)), "")

    def exists(self, *, follow_symlinks: bool = True) -> bool:
        """Whether anything exists.

        Raises:
            SourceError: The store refuses to tell.
            RemoteError: It does not answer.
        """
        return self._info is not None

    def is_dir(self, *, follow_symlinks: bool = True) -> bool:
        """Whether it is a folder; on a web server, one of a recording or dataset."""
        return self._info is not None and self._info.get("type") == "directory"

    def is_file(self, *, follow_symlinks: bool = True) -> bool:
        """Whether it is a file."""
        return self.exists() and not self.is_dir()

    def stat(self, *, follow_symlinks: bool = True) -> os.stat_result:
        """Its kind and size; no times.

        Raises:
            FileNotFoundError: It does not exist.
            SourceError: The size is unknown.
        """
        kind, size = (stat.S_IFDIR, 0) if self.is_dir() else (stat.S_IFREG, self._size())
        return os.stat_result((kind, 0, 0, 0, 0, 0, size, 0, 0, 0), {"st_mtime_ns": 0})

    def _size(self) -> int:
        if self._info is None:
            raise FileNotFoundError(2, "No such file", str(self))
        size: int | None = self._info.get("size")
        if size is None:
            problem = "cannot be read remotely: the server does not report its size"
            raise SourceError(self, problem, "Download it first.")
        return size

    def iterdir(self) -> Iterator[RemotePath]:  # type: ignore[override]
        """Its direct entries; none on a web server, which does not list."""
        if self._on_web:
            return iter(())
        try:
            with _sentences(self):
                self._files.invalidate_cache()
                found = self._files.ls(self._key, detail=False)
        except (FileNotFoundError, NotADirectoryError):
            return iter(())
        keys = sorted({str(key).rstrip("/") for key in found} - {self._key})
        return (self / key.rpartition("/")[2] for key in keys)

    def rglob(self, name: str) -> Iterator[RemotePath]:  # type: ignore[override]
        """The files with a name (not a pattern) in and below it; none on a web server."""
        if self._on_web:
            return iter(())
        with _sentences(self):
            self._files.invalidate_cache()
            keys = self._files.find(self._key)
        found = (self / key for key in sorted(str(key).removeprefix(self._key) for key in keys))
        return (path for path in found if path.name == name)

    # ---------------------------------------------------------------- content

    @cached_property
    def _blocks(self) -> Blocks:
        return Blocks()

    @cached_property
    def _open_size(self) -> int:
        """Its size; a web server that sends whole files when asked for a part is refused."""
        size = self._size()
        if self._on_web and size > 1:
            try:
                with _sentences(self):
                    self._files.cat_file(self._key, start=size - 1, end=size)
            except FileNotFoundError:
                raise RemoteError(self, _GONE) from None
        return size

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
        return cast(BinaryIO, RemoteFile(self._open_size, self._fetch, self._blocks))

    def _fetch(self, ranges: Sequence[Range]) -> list[bytes]:
        """Ranges of it, all at once.

        Raises:
            RemoteError: The store does not return them, or the file has changed.
        """
        starts, ends = [start for start, _ in ranges], [end for _, end in ranges]
        try:
            with _sentences(self, fetches=True):
                if self.scheme == _HUB:
                    ask = partial(self._files.cat_file, self._key, cache_type="none")
                    with ThreadPoolExecutor(_HUB_AT_ONCE) as pool:
                        found = list(pool.map(lambda span: ask(start=span[0], end=span[1]), ranges))
                else:
                    options = {"batch_size": _AT_ONCE} if self._files.async_impl else {}
                    found = self._files.cat_ranges(
                        [self._key] * len(ranges), starts, ends, **options
                    )
                for error in found:
                    if isinstance(error, BaseException):
                        raise error
        except FileNotFoundError:
            raise RemoteError(self, _GONE) from None
        for (start, end), data in zip(ranges, found, strict=True):
            if len(data) != end - start:
                problem = f"got {len(data)} of {end - start} bytes from byte {start} on"
                raise RemoteError(self, f"could not be read: {problem}", _NETWORK)
        return found

    def read_bytes(self) -> bytes:
        """All of it."""
        with self.open() as stream:
            return stream.read()


@cache
def _range_file_system() -> Any:
    """The class of fsspec for web servers, which reads whatever these send, limited to ranges."""
    from fsspec.implementations.http import HTTPFileSystem

    class RangeFileSystem(HTTPFileSystem):  # type: ignore[misc]
        """Reads no more than was asked for."""

        async def _cat_file(self, url: str, start: int = 0, end: int = 0, **kwargs: Any) -> bytes:
            """A range; one byte more if the server sends more.

            Raises:
                Refused: The server does not support ranges.
            """
            options = {**self.kwargs, **kwargs}
            headers = {
                **options.pop("headers", {}),
                "Range": f"bytes={start}-{end - 1}",
                "Accept-Encoding": "identity",
            }
            session = await self.set_session()
            async with session.get(self.encode_url(url), headers=headers, **options) as response:
                self._raise_not_found_for_status(response, url)
                if response.status != 206 and start > 0:
                    raise Refused("the web server does not support range requests")
                data = bytearray()
                while missing := end - start + 1 - len(data):
                    piece = await response.content.read(missing)
                    if not piece:
                        break
                    data += piece
                return bytes(data)

    return RangeFileSystem


# ---------------------------------------------------------------- locations

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


# ---------------------------------------------------------------- errors

_REFUSED = (401, 403)
_MISSING = (404, 410)
_PARSER = "aiohttp.http_exceptions"
_BROKEN_OFF = ("ContentLengthError", "TransferEncodingError", "IncompleteReadError")
_NO_CREDENTIALS = "Credentials"  # in the names of errors of store libraries
_MAX_TEXT, _MAX_CAUSES = 300, 8


@contextmanager
def _sentences(path: RemotePath, *, fetches: bool = False) -> Iterator[None]:
    """Translate fsspec's errors; a missing file becomes a FileNotFoundError.

    Args:
        path: What is being accessed.
        fetches: Whether the file was opened before, which was allowed.
    """
    try:
        yield
    except Mp4dsError:
        raise
    except Refused:
        problem = "cannot be read remotely: its web server does not support range requests"
        raise SourceError(path, problem, "Download it first.") from None
    except Exception as error:
        verdict, reason = _explained(error)
        if verdict == "missing":
            raise FileNotFoundError(str(path)) from None
        what = "access denied: " if verdict == "refused" else ""
        if verdict == "failed" or fetches:
            raise RemoteError(path, f"could not be read: {what}{reason}", _NETWORK) from None
        raise SourceError(path, f"cannot be read: {what}{reason}", _ACCESS) from None


def _explained(error: BaseException) -> tuple[str, str]:
    """Classify an error of fsspec or its dependencies.

    Returns:
        ``missing``, ``refused`` or ``failed``; and why, as the end of a sentence.
    """
    causes = list(_causes(error))
    statuses = [status for status in map(_status, causes) if status]
    reason = next(filter(None, map(_text, reversed(causes))), type(error).__name__)
    if any(status in _REFUSED for status in statuses):
        return "refused", reason
    if any(isinstance(e, PermissionError) or _NO_CREDENTIALS in type(e).__name__ for e in causes):
        return "refused", reason
    if any(status in _MISSING for status in statuses):
        return "missing", reason
    # For fsspec, a URL to which a web server does not respond does not exist.
    if isinstance(error, FileNotFoundError) and not any(map(_is_of_network, causes)):
        return "missing", reason
    return "failed", reason


def _causes(error: BaseException) -> Iterator[BaseException]:
    cause: BaseException | None = error
    for _ in range(_MAX_CAUSES):
        if cause is not None:
            yield cause
            cause = cause.__cause__


def _status(error: BaseException) -> int | None:
    """The HTTP status that a server answered with."""
    if type(error).__module__ == _PARSER:  # which numbers its own errors as if they were answers
        return None
    response = getattr(error, "response", None)
    if isinstance(response, Mapping):
        return _number(response.get("ResponseMetadata", {}).get("HTTPStatusCode"))
    return _number(getattr(error, "status", None)) or _number(getattr(error, "code", None))


def _number(value: object) -> int | None:
    return int(str(value)) if str(value).isdecimal() else None


def _is_of_network(error: BaseException) -> bool:
    is_aiohttp = type(error).__module__.startswith("aiohttp")
    return is_aiohttp or isinstance(error, ConnectionError) or _is_timeout(error)


def _is_timeout(error: BaseException) -> bool:
    return type(error).__name__.endswith("TimeoutError")  # there are many kinds


def _text(error: BaseException) -> str:
    if _is_timeout(error):
        return "it took too long to answer"
    if type(error).__name__ in _BROKEN_OFF:
        return "the server closed the connection before it had sent all"
    message = getattr(error, "message", None)
    if isinstance(message, str) and _status(error):
        return f"{_status(error)} {message.rstrip('.')}"  # the URL may hold a secret
    told = message if type(error).__module__ == _PARSER else error
    text = " ".join(str(told).split()).rstrip(".")
    return text if len(text) <= _MAX_TEXT else f"{text[:_MAX_TEXT]} ..."
