"""Files that are compressed as a whole by zstd."""

from __future__ import annotations

import io
import shutil
from contextlib import closing
from pathlib import Path
from typing import Any

import zstandard

from mp4ds.bags.mcap_records import SALVAGE_REMEDY, open_source
from mp4ds.errors import SourceError

MAGIC = b"\x28\xb5\x2f\xfd"
_PIECE_BYTES, _COPY_BYTES = 2**16, 2**22


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


def copy_file(path: Path, target: Path) -> None:
    """Bring a remote file here, with what stands beside it of a database that was not closed.

    Raises:
        SourceError: There is no room for it.
        RemoteError: It cannot be read.
        OSError: The target cannot be written.
    """
    sides = [path, *(path.with_name(path.name + ending) for ending in ("-wal", "-journal"))]
    found = [side for side in sides if side is path or side.exists()]
    size = sum(side.stat().st_size for side in found)
    if size > shutil.disk_usage(target.parent).free:
        raise SourceError(
            path,
            f"is an sqlite3 database of {size} bytes, which is copied to {target.parent} to be "
            "read, and there is no room for it",
            "Name another folder by TMPDIR.",
        )
    for side in found:
        ending = side.name.removeprefix(path.name)
        with closing(side.open("rb")) as stream, Path(f"{target}{ending}").open("wb") as output:
            shutil.copyfileobj(stream, output, _COPY_BYTES)


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
                    problem = f"its zstd compression is damaged: {error}"
                    raise SourceError(path, problem, SALVAGE_REMEDY) from None
                at_end = frame.eof
                piece = frame.unused_data if at_end else b""
                if at_end:
                    frame = decompressor.decompressobj()
    if not at_end:
        raise SourceError(
            path, "its zstd compression is cut short", f"Copy the file anew; {SALVAGE_REMEDY}"
        )
