"""What is asked of fsspec, and its errors as sentences."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from mp4ds.errors import Mp4dsError, OptionError, RemoteError, SourceError, TargetError

HTTP = ("http", "https")
INSTALL = "pip install 'mp4ds[remote]'"

_S3 = ("s3", "s3a")
_INSTALLED = (*_S3, *HTTP)

_HUB = "hf"  # of Hugging Face, whose files would read ahead, and fetch one range after another

_TAGS = ("ETag", "etag", "blob_id", "md5Hash", "Content-MD5")
_TIMES = ("LastModified", "Last-Modified", "mtime")
_REFUSED = (401, 403)
_MISSING = (404, 410)
_NO_CREDENTIALS = "Credentials"  # in the names of what the libraries of stores raise
_NETWORK = "Check the network, and try again."
_ACCESS = "Check the address and your credentials for it."
_MAX_TEXT, _MAX_CAUSES = 300, 8
# Many small ranges are asked for at once, on so many connections; botocore has 10 by itself.
_AT_ONCE, _HUB_AT_ONCE = 32, 8
# s3fs keeps ten parts of 50 MiB in memory unless told otherwise.
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
    """What a store tells of a file or folder.

    Attributes:
        is_folder: Whether it is one, or stands for one.
        size: Bytes; None where it is not told.
        tag: Changes with the content; empty where nothing does.
    """

    is_folder: bool
    size: int | None
    tag: str


class NoRangesError(Exception):
    """A web server sends the whole file where a part of it is asked for."""


class Store:
    """The file system of a URL.

    Args:
        path: Anything in it.

    Raises:
        OptionError: The scheme is not known, or what it needs is not installed.
    """

    def __init__(self, path: Place) -> None:
        self.scheme = path.scheme
        try:
            import fsspec
            from fsspec.config import conf
            from fsspec.core import url_to_fs
        except ImportError:
            raise OptionError(f"{path}: URLs need more than is installed. Run: {INSTALL}") from None
        if self.scheme not in fsspec.available_protocols():
            raise OptionError(
                f"{path}: {self.scheme}:// is not known. Use s3, gs, hf, https, http, file, or "
                "another scheme of fsspec."
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
            problem = f"{path}: URLs of {self.scheme}:// need more than is installed"
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
        """What is there now; None for nothing.

        Raises:
            SourceError: The store refuses to tell.
            RemoteError: It does not answer.
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
            RemoteError: The store does not give them, or the file is another one now.
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
            raise _remote_error(path, "could not be read: it is gone") from None
        for (start, end), data in zip(ranges, found, strict=True):
            if len(data) != end - start:
                problem = f"{len(data)} bytes came of {end - start} from byte {start} on"
                raise _remote_error(path, f"could not be read: {problem}", _NETWORK)
        return found

    def check_ranges(self, path: Place, size: int) -> None:
        """Refuse a web server that sends the whole file where a part of it is asked for.

        Raises:
            SourceError: It is one.
            RemoteError: It does not answer.
        """
        if self.scheme not in HTTP or size < 2:
            return
        try:
            with _sentences(path):
                self._fs.cat_file(self._key(path), start=size - 1, end=size)
        except FileNotFoundError:
            raise _remote_error(path, "could not be read: it is gone") from None

    def names(self, path: Place) -> list[str]:
        """Names of what is directly in a folder; none where the store does not list."""
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
        """All files in a folder and below it, relative to it; none where the store does not list.

        Raises:
            SourceError: The store refuses to tell.
            RemoteError: It does not answer.
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
            RemoteError: It does not answer.
        """
        key = self._key(path)
        with _sentences(path, "uploaded"):
            self._fs.put_file(str(local), key, **(_S3_UPLOAD if self.scheme in _S3 else {}))

    def remove(self, path: Place) -> None:
        """Remove a file, if it is there.

        Raises:
            TargetError: The store refuses.
            RemoteError: It does not answer.
        """
        with suppress(FileNotFoundError), _sentences(path, "removed"):
            self._fs.rm_file(self._key(path))


def _remote_error(path: Place, problem: str, remedy: str = "") -> RemoteError:
    return RemoteError(path, problem, remedy)


def _refusal(path: Place, problem: str, remedy: str = "") -> SourceError:
    return SourceError(path, problem, remedy)


@contextmanager
def _sentences(path: Place, done: str = "read") -> Iterator[None]:
    """Errors of fsspec as ours; of a missing file, a FileNotFoundError.

    Args:
        path: What is asked for.
        done: What is being done with it.
    """
    try:
        yield
    except Mp4dsError:
        raise
    except NoRangesError:
        problem = "its web server does not serve parts of files (byte ranges)"
        raise _refusal(
            path, f"cannot be read where it is: {problem}", "Download it first."
        ) from None
    except Exception as error:
        verdict, reason = explained(error)
        if verdict == "missing" and done != "uploaded":
            raise FileNotFoundError(str(path)) from None
        what = "access is refused: " if verdict == "refused" else ""
        if verdict == "failed" or done == "fetched":  # the latter was allowed before
            done = "read" if done == "fetched" else done
            raise _remote_error(path, f"could not be {done}: {what}{reason}", _NETWORK) from None
        kind = SourceError if done == "read" else TargetError
        raise kind(path, f"cannot be {done}: {what}{reason}", _ACCESS) from None


def explained(error: BaseException) -> tuple[str, str]:
    """What an error of fsspec, or of what it uses, comes down to.

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
    # For fsspec, what a web server did not answer to does not exist.
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
    """The HTTP status that an error tells of."""
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
    message = getattr(error, "message", None)
    if isinstance(message, str) and _status(error):
        return f"{_status(error)} {message}"  # without the address, which may hold a secret
    text = " ".join(str(error).split()).rstrip(".")
    return text if len(text) <= _MAX_TEXT else f"{text[:_MAX_TEXT]} ..."
