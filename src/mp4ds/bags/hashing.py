"""SHA-256 of the files of a recording, while it is read."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

from mp4ds.errors import SourceError
from mp4ds.source_files import is_folder, source_digest, source_name, source_size

_BLOCK = 2**20


class SourceHasher:
    """SHA-256 of the source files, taken while they are read, behind the reader.

    The bytes are then still in the system's cache: the disk is read once. A folder is hashed when
    the reader is past its bytes. A context manager.

    Args:
        path: The recording; a folder's name is put before those of its files.
        files: All files, in reading order.
    """

    def __init__(self, path: Path, files: Sequence[Path]) -> None:
        self._folder = path if path.is_dir() else None
        self._files = list(files)
        self._sizes = {path: source_size(path) for path in files if is_folder(path)}
        self._position = 0
        self._number = 0
        self._offset = 0
        self._hash = hashlib.sha256()
        self._stream: BinaryIO | None = None  # held, as another file may take the name
        self.digests: list[tuple[str, int, str]] = []

    def advance(self, position: int | None) -> None:
        """Hash up to a position in all files, None for the end.

        Raises:
            SourceError: A file cannot be read.
        """
        while self._number < len(self._files) and (position is None or self._position < position):
            path = self._files[self._number]
            end = self._position + self._sizes.get(path, 0)
            if position is not None and position < end:
                return
            try:
                if path in self._sizes:
                    self._finish(path, *source_digest(path))
                    self._position = end
                    continue
                if self._stream is None:
                    self._stream = path.open("rb")
                at_end = self._hash_file(self._stream, position)
            except OSError as error:
                raise SourceError(path, f"cannot be read: {error.strerror}") from None
            if at_end:
                self._finish(path, self._offset, self._hash.hexdigest())

    def _hash_file(self, stream: BinaryIO, position: int | None) -> bool:
        while position is None or self._position < position:
            block = stream.read(_BLOCK)
            if not block:
                return True
            self._hash.update(block)
            self._offset += len(block)
            self._position += len(block)
        return False

    def _finish(self, path: Path, size: int, sha256: str) -> None:
        self.digests.append((source_name(path, self._folder), size, sha256))
        self._hash = hashlib.sha256()
        self._offset = 0
        self._number += 1
        self._close()

    def _close(self) -> None:
        if self._stream:
            self._stream.close()
        self._stream = None

    def __enter__(self) -> SourceHasher:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()
