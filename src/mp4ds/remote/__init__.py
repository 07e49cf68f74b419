"""Recordings and datasets at URLs, read by ranges through fsspec.

`location` makes of a URL what reads like a `pathlib.Path`, so that nothing else has to know
where a file is. What is local never gets here, and fsspec is imported for URLs alone.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import cast
from urllib.parse import unquote, urlsplit

from mp4ds.remote.file import RemoteFile
from mp4ds.remote.path import RemotePath

__all__ = ["RemotePath", "expect", "location", "remote", "spelled"]

_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+)://")
_LOCAL = ("file", "local")


def location(path: Path | str) -> Path:
    """Where a user's path or URL points to.

    Args:
        path: A local path, or a URL of a scheme that fsspec knows, such as ``s3``, ``gs``,
            ``https`` or ``file``.

    Returns:
        The local path; of a URL a `RemotePath`, which has of a path what reading needs.

    Raises:
        OptionError: The scheme is not known, or what it needs is not installed.
    """
    if not isinstance(path, str):
        return path
    match = _URL.match(path)
    if match is None:
        return Path(path)
    if match[1].lower() in _LOCAL:
        return Path(unquote(urlsplit(path).path))
    found = RemotePath(path)
    found.check()
    return cast(Path, found)


def remote(path: object) -> RemotePath | None:
    """What `location` made of a URL; None for a local path."""
    return path if isinstance(path, RemotePath) else None


def spelled(path: Path) -> str:
    """A path or URL in full, from which `location` makes it again anywhere on this machine."""
    found = remote(path)
    return found.url if found else str(path.absolute())


def expect(stream: object, ranges: Iterable[tuple[int, int]]) -> None:
    """Tell a file which of its bytes will be read, so that a remote one fetches them in time.

    Args:
        stream: What ``open("rb")`` gave, of a local path or a `RemotePath`.
        ranges: First byte and end of each, in the order of reading; other bytes may be read
            between.
    """
    if isinstance(stream, RemoteFile):
        stream.expect(ranges)
