"""Files that are compressed as a whole by zstd."""

from __future__ import annotations

import io
import shutil
from contextlib import closing
from pathlib import Path

import zstandard

from mp4ds.bags.inflate import FILE_RATIO, ZSTD_PIECE, most_unpacked
from mp4ds.bags.mcap_records import SALVAGE_REMEDY, open_source
from mp4ds.errors import SourceError

MAGIC = b"\x28\xb5\x2f\xfd"
_COPY_BYTES = 2**22


def is_zstd(path: Path) -> bool:
    """Whether a file is compressed, by its first bytes.

    Raises:
        SourceError: It cannot be read.
    """
    with closing(open_source(path)) as stream:
        return stream.read(len(MAGIC)) == MAGIC


class ZstdStream:
    """The content of a compressed file, read once from its start, up to where it is damaged.

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
        self._most = most_unpacked(path.stat().st_size, FILE_RATIO)
        self._given = 0
        self._is_within = False
        self._left = bytearray()
        self._ended = False
        self.consumed = 0
        self.problem = ""

    def read(self, length: int, /) -> bytes:
        """Read so many decompressed bytes; fewer at the end, or before damage."""
        while len(self._left) < length and not self._ended:
            piece = self._file.read(ZSTD_PIECE)
            if not piece:
                self._end("its zstd compression is cut short" if self._is_within else "")
            self._take(piece)
            self.consumed += len(piece)
        data = bytes(self._left[:length])
        del self._left[:length]
        self._given += len(data)
        return data

    def _take(self, piece: bytes) -> None:
        while piece:
            try:
                self._left += self._frame.decompress(piece)
            except zstandard.ZstdError as error:
                self._end(f"its zstd compression is damaged near byte {self.consumed}: {error}")
                return
            if self._given + len(self._left) > self._most:
                self._end(f"it unpacks to more than {self._most} bytes, too many for its size")
                return
            self._is_within = not self._frame.eof
            piece = b"" if self._is_within else self._frame.unused_data
            if not self._is_within:
                self._frame = zstandard.ZstdDecompressor().decompressobj()

    def _end(self, problem: str) -> None:
        self._ended, self.problem = True, problem

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class ZstdFile(ZstdStream):
    """The content of a compressed file that is sound.

    Args:
        path: The compressed file.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._path = path

    def read(self, length: int, /) -> bytes:
        """Read so many decompressed bytes; fewer at the end only.

        Raises:
            SourceError: It is damaged, cut short, or unpacks to too much.
        """
        data = super().read(length)
        if self.problem and len(data) < length:
            raise SourceError(self._path, self.problem, f"Copy it again; {SALVAGE_REMEDY}")
        return data

    def tell(self) -> int:
        """Bytes of the compressed file consumed."""
        return self.consumed

    def seek(self, offset: int, /) -> int:
        """Not possible."""
        raise io.UnsupportedOperation("seek")


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
        SourceError: The file is damaged, cut short, or unpacks to too much.
        OSError: The target cannot be written.
    """
    with closing(ZstdFile(path)) as stream, target.open("wb") as output:
        while piece := stream.read(_COPY_BYTES):
            output.write(piece)
