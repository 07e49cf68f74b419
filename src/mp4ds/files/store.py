"""Access to fsspec, with its errors as sentences."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from mp4ds.errors import Mp4dsError, OptionError, Refused, RemoteError, SourceError, TargetError

HTTP = ("http", "https")
INSTALL = "pip install 'mp4ds[remote]'"

_S3 = ("s3", "s3a")
_INSTALLED = (*_S3, *HTTP)

_HUB = "hf"  # of Hugging Face, whose files would read ahead, and fetch one range after another

_TAGS = ("ETag", "etag", "blob_id", "md5Hash", "Content-MD5")
_TIMES = ("LastModified", "Last-Modified", "mtime")
_REFUSED = (401, 403)
_MISSING = (404, 410)
_PARSER = "aiohttp.http_exceptions"
_BROKEN_OFF = ("ContentLengthError", "TransferEncodingError", "IncompleteReadError")
_NO_CREDENTIALS = "Credentials"  # in the names of errors of store libraries
_NETWORK = "Check the network, and try again."
_ACCESS = "Check the address and your credentials for it."
_MAX_TEXT, _MAX_CAUSES = 300, 8
# Many small ranges are requested at once, on that many connections; botocore's default is 10.
_AT_ONCE, _HUB_AT_ONCE = 32, 8
# By default s3fs keeps ten parts of 50 MiB in memory.
_S3_UPLOAD = {"chunksize": 2**24, "max_concurrency": 4}

Range = tuple[int, int]
"""First byte, and the one after the last."""


if TYPE_CHECKING:
    # all that reads a path may be given one at a URL, which has what reading needs of it; it is no
    # path at run time, so that what only the local file system has is an error there
    _Path = Path
else:
    _Path = object


class Place(_Path):
    """A path at a URL.

    Attributes:
        scheme: Such as ``s3``, in small letters.
    """

    scheme: str

    @property
    def url(self) -> str:
        """The whole URL; it may hold secrets."""
        raise NotImplementedError


class Facts(NamedTuple):
    """A store's information about a file or folder.

    Attributes:
        is_folder: Whether it is a folder, or represents one.
        size: Bytes; None if unknown.
        tag: Changes with the content; empty if there is none.
    """

    is_folder: bool
    size: int | None
    tag: str


class Store:
    """The file system of a URL.

    Args:
        path: Anything in it.

    Raises:
        OptionError: The scheme is unknown, or its dependency is not installed.
    """

    def __init__(self, path: Place) -> None:
        self.scheme = path.scheme
        try:
            import fsspec
            from fsspec.config import conf
            from fsspec.core import url_to_fs
        except ImportError:
            raise OptionError(f"{path}: URLs need an optional dependency. Run: {INSTALL}") from None
        if self.scheme not in fsspec.available_protocols():
            raise OptionError(
                f"{path}: {self.scheme}:// is not supported. Use s3, gs, hf, https, http, file, or "
                "another fsspec scheme."
            )
        options: dict[str, Any] = {}
        if self.scheme in _S3 and "config_kwargs" not in conf.get("s3", {}):
            options["config_kwargs"] = {"max_pool_connections": _AT_ONCE}
        try:
            self._fs: Any = url_to_fs(path.url, **options)[0]
            if self.scheme in HTTP:
                from mp4ds.files.web import RangeFileSystem

                self._fs = RangeFileSystem(**self._fs.storage_options)
        except ImportError as error:
            problem = f"{path}: {self.scheme}:// URLs need an optional dependency"
            remedy = f"Run: {INSTALL}." if self.scheme in _INSTALLED else f"{_text(error)}."
            raise OptionError(f"{problem}. {remedy}") from None
        except Exception as error:
            raise _remote_error(
                path, f"could not be opened: {explained(error)[1]}", _ACCESS
            ) from None

    def _key(self, path: Place) -> str:
        key: str = self._fs._strip_protocol(path.url)
        return key

    def look(self, path: Place) -> Facts | None:
        """What exists there now; None for nothing.

        Raises:
            SourceError: The store denies access.
            RemoteError: It does not respond.
        """
        try:
            with _sentences(path):
                self._fs.invalidate_cache()
                info: Mapping[str, Any] = self._fs.info(self._key(path))
        except FileNotFoundError:
            return None
        tag = next((f"{name} {info[name]}" for name in (*_TAGS, *_TIMES) if info.get(name)), "")
        return Facts(info.get("type") == "directory", info.get("size"), tag)

    def fetch(self, path: Place, ranges: Sequence[Range]) -> list[bytes]:
        """Ranges of a file, all at once.

        Raises:
            RemoteError: The store does not return them, or the file has changed.
        """
        key = self._key(path)
        starts, ends = [start for start, _ in ranges], [end for _, end in ranges]
        try:
            with _sentences(path, "fetched"):
                if self.scheme == _HUB:
                    with ThreadPoolExecutor(_HUB_AT_ONCE) as pool:
                        ask = partial(self._fs.cat_file, key, cache_type="none")
                        found = list(pool.map(lambda span: ask(start=span[0], end=span[1]), ranges))
                elif len(ranges) == 1:
                    found = [self._fs.cat_file(key, start=starts[0], end=ends[0])]
                else:
                    options = {"batch_size": _AT_ONCE} if self._fs.async_impl else {}
                    found = self._fs.cat_ranges([key] * len(ranges), starts, ends, **options)
                for error in found:
                    if isinstance(error, BaseException):
                        raise error
        except FileNotFoundError:
            raise _remote_error(path, "could not be read: it no longer exists") from None
        for (start, end), data in zip(ranges, found, strict=True):
            if len(data) != end - start:
                problem = f"got {len(data)} of {end - start} bytes from byte {start} on"
                raise _remote_error(path, f"could not be read: {problem}", _NETWORK)
        return found

    def check_ranges(self, path: Place, size: int) -> None:
        """Refuse a web server that sends the whole file when asked for a part.

        Raises:
            SourceError: It is one.
            RemoteError: It does not respond.
        """
        if self.scheme not in HTTP or size < 2:
            return
        try:
            with _sentences(path):
                self._fs.cat_file(self._key(path), start=size - 1, end=size)
        except FileNotFoundError:
            raise _remote_error(path, "could not be read: it no longer exists") from None

    def names(self, path: Place) -> list[str]:
        """Names of a folder's direct entries; none if the store does not list."""
        if self.scheme in HTTP:
            return []
        key = self._key(path).rstrip("/")
        try:
            with _sentences(path):
                self._fs.invalidate_cache()
                found = self._fs.ls(key, detail=False)
        except (FileNotFoundError, NotADirectoryError):
            return []
        paths = [str(path).rstrip("/") for path in found]
        return sorted(path.rpartition("/")[2] for path in paths if path != key)

    def files(self, path: Place) -> list[str]:
        """All files in and below a folder, relative to it; none if the store does not list.

        Raises:
            SourceError: The store denies access.
            RemoteError: It does not respond.
        """
        if self.scheme in HTTP:
            return []
        key = self._key(path).rstrip("/")
        with _sentences(path):
            self._fs.invalidate_cache()
            return sorted(str(file).removeprefix(key).strip("/") for file in self._fs.find(key))

    def put(self, local: Path, path: Place) -> None:
        """Upload a file.

        Raises:
            TargetError: The store refuses.
            RemoteError: It does not respond.
        """
        key = self._key(path)
        with _sentences(path, "uploaded"):
            self._fs.put_file(str(local), key, **(_S3_UPLOAD if self.scheme in _S3 else {}))

    def remove(self, path: Place) -> None:
        """Remove a file, if it is there.

        Raises:
            TargetError: The store refuses.
            RemoteError: It does not respond.
        """
        with suppress(FileNotFoundError), _sentences(path, "removed"):
            self._fs.rm_file(self._key(path))


def _remote_error(path: Place, problem: str, remedy: str = "") -> RemoteError:
    return RemoteError(path, problem, remedy)


def _refusal(path: Place, problem: str, remedy: str = "") -> SourceError:
    return SourceError(path, problem, remedy)


@contextmanager
def _sentences(path: Place, done: str = "read") -> Iterator[None]:
    """Translate fsspec's errors; a missing file becomes a FileNotFoundError.

    Args:
        path: What is being accessed.
        done: The operation, as a participle.
    """
    try:
        yield
    except Mp4dsError:
        raise
    except Refused:
        problem = "its web server does not support range requests"
        raise _refusal(path, f"cannot be read remotely: {problem}", "Download it first.") from None
    except Exception as error:
        verdict, reason = explained(error)
        if verdict == "missing" and done != "uploaded":
            raise FileNotFoundError(str(path)) from None
        what = "access denied: " if verdict == "refused" else ""
        if verdict == "failed" or done == "fetched":  # the latter was allowed before
            done = "read" if done == "fetched" else done
            raise _remote_error(path, f"could not be {done}: {what}{reason}", _NETWORK) from None
        kind = SourceError if done == "read" else TargetError
        raise kind(path, f"cannot be {done}: {what}{reason}", _ACCESS) from None


def explained(error: BaseException) -> tuple[str, str]:
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
        if cause is None:
            return
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
