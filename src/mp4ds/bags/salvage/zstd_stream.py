"""The content of a file that is compressed as a whole, up to where it is damaged."""

from __future__ import annotations

from pathlib import Path

import zstandard

from mp4ds.bags.mcap_records import open_source

_PIECE = 2**16


class ZstdStream:
    """The content of a zstd file, read once from its start.

    Args:
        path: The compressed file.

    Attributes:
        consumed: Bytes of the file that were read.
        problem: Why it ended before the file did, a phrase; empty where it did not.

    Raises:
        SourceError: It cannot be opened, or is empty.
    """

    def __init__(self, path: Path) -> None:
        self._file = open_source(path)
        self._frame = zstandard.ZstdDecompressor().decompressobj()
        self._is_within = False
        self._left = bytearray()
        self._ended = False
        self.consumed = 0
        self.problem = ""

    def read(self, length: int, /) -> bytes:
        """Read so many decompressed bytes; fewer at the end, or before damage."""
        while len(self._left) < length and not self._ended:
            piece = self._file.read(_PIECE)
            if not piece:
                self._ended = True
                if self._is_within:
                    self.problem = "its zstd compression is cut short"
            self._take(piece)
            self.consumed += len(piece)
        data = bytes(self._left[:length])
        del self._left[:length]
        return data

    def _take(self, piece: bytes) -> None:
        while piece:
            try:
                self._left += self._frame.decompress(piece)
            except zstandard.ZstdError as error:
                self.problem = f"its zstd compression is damaged near byte {self.consumed}: {error}"
                self._ended = True
                return
            self._is_within = not self._frame.eof
            piece = b"" if self._is_within else self._frame.unused_data
            if not self._is_within:
                self._frame = zstandard.ZstdDecompressor().decompressobj()

    def close(self) -> None:
        """Close the file."""
        self._file.close()
