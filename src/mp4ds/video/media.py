"""An mp4 opened by PyAV, on this machine or at a URL."""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

import av
from av.error import FFmpegError

from mp4ds.errors import RemoteError, VideoError
from mp4ds.remote import remote


class Media:
    """A container being read; `close` closes its file, too.

    Args:
        path: The video.

    Attributes:
        container: PyAV's.

    Raises:
        VideoError: ``file-missing`` or ``video-unreadable``.
        RemoteError: It is at a URL, and cannot be read there.
    """

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise VideoError("file-missing", path, "does not exist")
        try:
            self._open(path)
        except (FFmpegError, OSError) as error:
            raise VideoError("video-unreadable", path, f"cannot be opened: {error}") from None

    def _open(self, path: Path) -> None:
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


def pixel_format_of(context: Any) -> str:
    """Ffmpeg's name of the pixel format of a video's codec context; empty where none is told.

    PyAV 17, which Python 3.10 has, crashes where it is asked for `pix_fmt` then.
    """
    return str(context.format.name) if context.format else ""


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
