"""Files that are compressed as a whole by zstd."""

from __future__ import annotations

import io
from contextlib import closing
from pathlib import Path
from typing import Any

import zstandard

from mp4ds.bags.mcap_records import open_source
from mp4ds.errors import SourceError

MAGIC = b"\x28\xb5\x2f\xfd"
_PIECE_BYTES = 2**16


def is_zstd(path: Path) -> bool:
    """Whether a file is compressed, by its first bytes.

    Raises:
        SourceError: It cannot be read.
    """
    with closing(open_source(path)) as stream:
        return stream.read(len(MAGIC)) == MAGIC


class ZstdFile:
    """The content of a compressed file, read once from its start.

    Args:
        path: The compressed file.
    """

    def __init__(self, path: Path) -> None:
        self._file = open_source(path)
        self._content: Any = zstandard.ZstdDecompressor().stream_reader(
            self._file, read_across_frames=True, closefd=False
        )

    def read(self, length: int, /) -> bytes:
        """Read so many decompressed bytes; fewer at the end only."""
        data: bytes = self._content.read(length)
        while len(data) < length:
            more = self._content.read(length - len(data))
            if not more:
                break
            data += more
        return data

    def tell(self) -> int:
        """Bytes of the compressed file consumed."""
        return self._file.tell()

    def seek(self, offset: int, /) -> int:
        """Not possible."""
        raise io.UnsupportedOperation("seek")

    def close(self) -> None:
        """Close the file."""
        self._content.close()
        self._file.close()


def decompress_file(path: Path, target: Path) -> None:
    """Decompress a file into another one.

    Raises:
        SourceError: The file is damaged or cut short.
        OSError: The target cannot be written.
    """
    with closing(open_source(path)) as stream, target.open("wb") as output:
        decompressor = zstandard.ZstdDecompressor()
        frame = decompressor.decompressobj()
        at_end = False
        while piece := stream.read(_PIECE_BYTES):
            while piece:
                try:
                    output.write(frame.decompress(piece))
                except zstandard.ZstdError as error:
                    raise SourceError(path, f"its zstd compression is damaged: {error}") from None
                at_end = frame.eof
                piece = frame.unused_data if at_end else b""
                if at_end:
                    frame = decompressor.decompressobj()
    if not at_end:
        raise SourceError(path, "its zstd compression is cut short", "Copy the file anew.")
