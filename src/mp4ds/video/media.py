"""An mp4 opened by PyAV, on this machine or at a URL."""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

import av

from mp4ds.errors import RemoteError
from mp4ds.remote import remote


class Media:
    """A container being read; `close` closes its file, too.

    Args:
        path: The video.

    Attributes:
        container: PyAV's.

    Raises:
        FFmpegError: It is no video.
        OSError: It cannot be read.
        RemoteError: It is at a URL, and cannot be read there.
    """

    def __init__(self, path: Path) -> None:
        self._file = _Source(path.open("rb")) if remote(path) else None
        try:
            # absolute: ffmpeg takes a relative name with a colon for an address
            source: Any = self._file or str(path.absolute())
            self.container: Any = av.open(source, "r", metadata_errors="ignore")
        except BaseException:
            if self._file:
                self._file.close()
            raise

    def close(self) -> None:
        """Close it."""
        self.container.close()
        if self._file:
            self._file.close()


class _Source:
    """A remote file for PyAV, which raises the first error of a file and prints the others."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._has_failed = False
        self.seek = stream.seek
        self.tell = stream.tell
        self.close = stream.close

    def read(self, size: int = -1) -> bytes:
        """Read so many bytes; after an error, none."""
        if self._has_failed:
            return b""
        try:
            return self._stream.read(size)
        except RemoteError:
            self._has_failed = True
            raise
