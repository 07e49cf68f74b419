"""The pages of an sqlite3 file as they were last committed (sqlite.org/fileformat2.html).

A file beside the database may hold other contents of its pages: a ``-wal`` what was committed
since, a ``-journal`` what was there before a change that never ended. sqlite3 would write both
back into the database. Here they are looked up page by page, and nothing is written or copied.
"""

from __future__ import annotations

import struct
from collections import OrderedDict
from pathlib import Path
from typing import BinaryIO

from mp4ds.bags.mcap_records import open_source
from mp4ds.bags.salvage.sqlite_cells import leaf_cells
from mp4ds.errors import SourceError

MAGIC = b"SQLite format 3\0"
HEADER_BYTES = 100

_BLOCK_BYTES = 2**18
_BLOCKS = 8
_SIZES = [4096, 1024, 2048, 8192, 16384, 32768, 65536, 512]
_MAX_RESERVED = 32
_SAMPLE_BYTES = 4 * 2**20
_WAL_HEADER = struct.Struct(">8I")
_WAL_FRAME = struct.Struct(">6I")
_JOURNAL_HEADER = struct.Struct(">8s5I")
_JOURNAL_MAGIC = b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7"
_ALL_RECORDS = 0xFFFFFFFF


class Pages:
    """The pages of a database, by number from 1. A context manager.

    Args:
        path: The database.
        shown: Its name in errors, where it is a decompressed copy.

    Attributes:
        file_size: Bytes of the file.
        size: Bytes of a page.
        usable: Bytes of a page that hold data.
        count: Pages that there are; the last may be cut short.
        promised: Pages that there should be by the header; 0 where it does not tell.
        pending: What a file beside the database holds of it, a phrase; empty for nothing.

    Raises:
        SourceError: The file is missing, empty, or unreadable.
    """

    def __init__(self, path: Path, shown: Path | None = None) -> None:
        self._path = path
        self._shown = shown or path
        self._file = open_source(path, shown)
        self.file_size = path.stat().st_size
        self._blocks: OrderedDict[int, bytes] = OrderedDict()
        self._overlay: dict[int, int] = {}
        self._beside: BinaryIO | None = None
        self.pending = ""
        try:
            self._look_around()
        except BaseException:
            self.close()
            raise

    def _look_around(self) -> None:
        path = self._path
        header = self._at(0, HEADER_BYTES)
        self.size = self._page_size(header)
        reserved = header[20] if header.startswith(MAGIC) and len(header) > 20 else 0
        self.usable = self.size - (reserved if reserved <= _MAX_RESERVED else 0)
        self.count = -(-self.file_size // self.size)
        if not self._read_wal(Path(f"{path}-wal")):
            self._read_journal(Path(f"{path}-journal"))
        header = self.read(1)
        self.promised = 0
        if header.startswith(MAGIC) and header[24:28] == header[92:96]:
            self.promised = int.from_bytes(header[28:32], "big")

    def _page_size(self, header: bytes) -> int:
        if header.startswith(MAGIC) and len(header) == HEADER_BYTES:
            size = int.from_bytes(header[16:18], "big")
            size = 65536 if size == 1 else size
            if size in _SIZES:
                return size
        sample = self._at(0, _SAMPLE_BYTES)
        return max(_SIZES, key=lambda size: _number_of_rows(sample, size))

    def read(self, number: int) -> bytes:
        """A page; shorter, or empty, where the file ends before it does."""
        place = self._overlay.get(number)
        if place is not None and self._beside is not None:
            self._beside.seek(place)
            return self._beside.read(self.size)
        if not 1 <= number <= self.count:
            return b""
        return self._at((number - 1) * self.size, self.size)

    @property
    def all_bytes(self) -> int:
        """Bytes of all pages: rows that have more together claim the same ones."""
        return self.count * self.size

    def offset(self, number: int) -> int:
        """Byte of the database where a page begins."""
        return (number - 1) * self.size

    def there(self, number: int) -> int:
        """Bytes that the file has of a page."""
        return max(0, min(self.size, self.file_size - self.offset(number)))

    def _at(self, offset: int, length: int) -> bytes:
        if length > _BLOCK_BYTES:
            return self._load(offset, length)
        block, within = divmod(offset, _BLOCK_BYTES)
        if block not in self._blocks:
            while len(self._blocks) >= _BLOCKS:
                self._blocks.popitem(last=False)
            self._blocks[block] = self._load(block * _BLOCK_BYTES, _BLOCK_BYTES)
        return self._blocks[block][within : within + length]

    def _load(self, offset: int, length: int) -> bytes:
        try:
            self._file.seek(offset)
            return self._file.read(length)
        except OSError as error:
            raise SourceError(self._shown, f"cannot be read: {error.strerror}") from None

    def _open_beside(self, path: Path) -> BinaryIO | None:
        try:
            if path.is_file() and path.stat().st_size:
                return path.open("rb")
        except OSError as error:
            raise SourceError(path, f"cannot be read: {error.strerror}") from None
        return None

    def _read_wal(self, path: Path) -> bool:
        """Look up the pages that a write-ahead log committed."""
        stream = self._open_beside(path)
        if stream is None:
            return False
        head = stream.read(_WAL_HEADER.size)
        if len(head) < _WAL_HEADER.size:
            stream.close()
            return False
        magic, _, size, _, salt1, salt2, *told = _WAL_HEADER.unpack(head)
        order = ">" if magic & 1 else "<"
        sums = _wal_sums(order, head[:24], (0, 0))
        if magic & ~1 != 0x377F0682 or size != self.size or sums != tuple(told):
            stream.close()
            return False
        waiting: dict[int, int] = {}
        while True:
            place = stream.tell() + _WAL_FRAME.size
            frame = stream.read(_WAL_FRAME.size + size)
            if len(frame) < _WAL_FRAME.size + size:
                break
            number, committed, *salts_and_sums = _WAL_FRAME.unpack_from(frame)
            sums = _wal_sums(order, frame[:8], sums)
            sums = _wal_sums(order, frame[_WAL_FRAME.size :], sums)
            if salts_and_sums != [salt1, salt2, *sums]:
                break
            waiting[number] = place
            if committed:
                self._overlay.update(waiting)
                waiting.clear()
                self.count = committed
        self._beside = stream
        self.pending = f"changes that {path.name} holds"
        return True

    def _read_journal(self, path: Path) -> None:
        """Look up the pages as they were before a change that never ended."""
        stream = self._open_beside(path)
        if stream is None:
            return
        self._beside = stream
        end = path.stat().st_size
        start, found = 0, False
        while start + _JOURNAL_HEADER.size <= end:
            stream.seek(start)
            fields = _JOURNAL_HEADER.unpack(stream.read(_JOURNAL_HEADER.size))
            magic, records, nonce, pages, sector, size = fields
            if magic != _JOURNAL_MAGIC or size != self.size or not 32 <= sector <= 65536:
                break
            if not found:
                self.count, found = pages, True
            place = start + sector
            if records == _ALL_RECORDS:
                records = (end - place) // (size + 8)
            for _ in range(records):
                stream.seek(place)
                record = stream.read(size + 8)
                if len(record) < size + 8 or not _journal_matches(record, nonce, size):
                    break
                self._overlay.setdefault(int.from_bytes(record[:4], "big"), place + 4)
                place += size + 8
            start = -(-place // sector) * sector
        if found:
            self.pending = f"a change that was not finished, which {path.name} takes back"

    def close(self) -> None:
        """Close the files."""
        self._file.close()
        if self._beside:
            self._beside.close()

    def __enter__(self) -> Pages:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _number_of_rows(sample: bytes, size: int) -> int:
    """How many rows stand in pages that are sound, if these have a size."""
    pages = (sample[start : start + size] for start in range(size, len(sample), size))
    leaves = (leaf_cells(page, 0, size) for page in pages)
    return sum(len(leaf.rows) for leaf in leaves if not leaf.is_damaged)


def _wal_sums(order: str, data: bytes, sums: tuple[int, int]) -> tuple[int, int]:
    """Go on with the checksum of a write-ahead log."""
    first, second = sums
    for left, right in struct.iter_unpack(f"{order}II", data):
        first = (first + left + second) & 0xFFFFFFFF
        second = (second + right + first) & 0xFFFFFFFF
    return first, second


def _journal_matches(record: bytes, nonce: int, size: int) -> bool:
    """Whether a record of a journal matches its checksum: every 200th byte from the end."""
    page = record[4 : 4 + size]
    told = int.from_bytes(record[4 + size :], "big")
    total = nonce + sum(page[place] for place in range(size - 200, 0, -200))
    return total & 0xFFFFFFFF == told
