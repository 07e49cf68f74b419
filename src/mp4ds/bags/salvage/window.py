"""A file that is read once from its start, with a look ahead of what is taken."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Protocol

from mp4ds.bags.mcap_records import open_source
from mp4ds.errors import SourceError

BLOCK = 2**20
_PIECE = 16 * 2**20
_MAX_AHEAD = 64 * 2**20


class Source(Protocol):
    """What a window is over: a file, or the content of a compressed one."""

    def read(self, length: int, /) -> bytes:
        """Read so many bytes; fewer at the end only."""
        ...

    def close(self) -> None:
        """Close it."""
        ...


class Window:
    """What of a file lies before the reader. A context manager.

    Args:
        source: A stream at byte `offset`.
        path: Its name, for errors.
        size: Bytes of the whole file where that is known.
        offset: Where the stream stands.

    Attributes:
        offset: Byte at which the window begins.
        size: Bytes of the whole file, None where it is not known.
    """

    def __init__(
        self, source: Source, path: Path, *, size: int | None = None, offset: int = 0
    ) -> None:
        self._source = source
        self._path = path
        self._data = b""
        self._at = 0
        self._ended = False
        self._probe: io.FileIO | None = None
        self.offset = offset
        self.size = size

    @classmethod
    def of_file(cls, path: Path, offset: int = 0) -> Window:
        """A window over a file.

        Raises:
            SourceError: It cannot be opened, is empty, or a git-lfs pointer.
        """
        stream = open_source(path)
        stream.seek(offset)
        return cls(stream, path, size=path.stat().st_size, offset=offset)

    @classmethod
    def of_content(cls, content: bytes, path: Path) -> Window:
        """A window over what a chunk unpacked to."""
        window = cls(io.BytesIO(), path, size=len(content))
        window._data, window._ended = content, True
        return window

    @property
    def position(self) -> int:
        """Bytes of the file that the reader has come to."""
        consumed = getattr(self._source, "consumed", None)
        return self.offset if consumed is None else int(consumed)

    @property
    def problem(self) -> str:
        """Why the content ended before the file did, a phrase; empty where it did not."""
        return str(getattr(self._source, "problem", ""))

    @property
    def left(self) -> int | None:
        """Bytes before the reader, None where that is not known."""
        if self.size is not None:
            return max(0, self.size - self.offset)
        return len(self._data) - self._at if self._ended else None

    def peek(self, length: int) -> memoryview:
        """The next bytes, fewer at the end only. Reads what is there, whatever is asked for.

        Raises:
            SourceError: The disk does not give them.
        """
        if len(self._data) - self._at < length and not self._ended:
            self._fill(length)
        return memoryview(self._data)[self._at : self._at + length]

    def _fill(self, length: int) -> None:
        pieces = [self._data[self._at :]]
        have = len(pieces[0])
        while have < length and not self._ended:
            wanted = min(max(length - have, BLOCK), _PIECE)
            try:
                piece = self._source.read(wanted)
            except OSError as error:
                raise SourceError(
                    self._path, f"cannot be read: {error.strerror or error}"
                ) from None
            self._ended = len(piece) < wanted
            pieces.append(piece)
            have += len(piece)
        self._data, self._at = b"".join(pieces), 0

    def skip(self, length: int) -> None:
        """Go on by so many bytes, which may be more than were looked at."""
        while length > 0:
            step = min(length, len(self._data) - self._at) or len(self.peek(min(length, BLOCK)))
            if not step:
                return
            self._at += step
            self.offset += step
            length -= step

    def look(self, distance: int, length: int) -> bytes | None:
        """Bytes far ahead, without reading up to them; None where that cannot be done."""
        if self._ended or distance + length <= len(self._data) - self._at:
            return bytes(self.peek(distance + length)[distance:])
        if self.size is None:
            if distance > _MAX_AHEAD:
                return None
            return bytes(self.peek(distance + length)[distance:])
        try:
            if self._probe is None:
                self._probe = io.FileIO(self._path)
            self._probe.seek(self.offset + distance)
            return self._probe.read(length) or b""
        except OSError as error:
            raise SourceError(self._path, f"cannot be read: {error.strerror}") from None

    def close(self) -> None:
        """Close the file."""
        self._source.close()
        if self._probe:
            self._probe.close()

    def __enter__(self) -> Window:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
