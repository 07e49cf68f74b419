"""The last committed pages of an sqlite3 file, and their rows.

Source: sqlite.org/fileformat2.html.
"""

from __future__ import annotations

import struct
from collections import OrderedDict
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mp4ds.bags.mcap_records import open_source
from mp4ds.errors import SourceError

LEAF = 0x0D
INTERIOR = 0x05

_INTEGER_BYTES = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8, 8: 0, 9: 0}
Value = int | float | str | bytes | None


class Row(NamedTuple):
    """A row of a table; its page may hold only its beginning.

    Attributes:
        rowid: Its key.
        start: Byte of the page where its payload begins.
        size: Bytes of the payload.
        local: How many of these are in the page.
        overflow: Number of the page where it continues, or 0.
    """

    rowid: int
    start: int
    size: int
    local: int
    overflow: int


class Leaf(NamedTuple):
    """The rows of a page.

    Attributes:
        rows: The readable ones, in order.
        is_damaged: Whether some are unreadable, or it is not a page of rows at all.
    """

    rows: list[Row]
    is_damaged: bool


def varint(data: bytes, at: int) -> tuple[int, int]:
    """A variable-length number, and where it ends.

    Raises:
        IndexError: The data ends too early.
    """
    value = 0
    for count in range(8):
        byte = data[at + count]
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, at + count + 1
    return value << 8 | data[at + 8], at + 9


def leaf_cells(page: bytes, header: int, usable: int) -> Leaf:
    """The rows of a page.

    Args:
        page: The page.
        header: Byte where its header begins: 100 in the first page, else 0.
        usable: Bytes of a page that hold data.
    """
    if len(page) < header + 8 or page[header] != LEAF:
        return Leaf([], True)
    count = int.from_bytes(page[header + 3 : header + 5], "big")
    first = header + 8
    if first + 2 * count > len(page):
        return Leaf([], True)
    rows: list[Row] = []
    last: int | None = None
    for place in struct.unpack_from(f">{count}H", page, first):
        row = _row(page, place, usable) if place >= first + 2 * count else None
        if row is None or (last is not None and row.rowid <= last):
            continue
        last = row.rowid
        rows.append(row)
    return Leaf(rows, len(rows) != count or len(page) < usable)


def _row(page: bytes, place: int, usable: int) -> Row | None:
    try:
        size, place = varint(page, place)
        rowid, place = varint(page, place)
    except IndexError:
        return None
    if rowid >= 2**63:
        rowid -= 2**64
    local = local_bytes(size, usable)
    overflow = 0
    if local < size:
        overflow = int.from_bytes(page[place + local : place + local + 4], "big")
        if not overflow:
            return None
    if size < 2 or place + local + (4 if overflow else 0) > len(page):
        return None
    return Row(rowid, place, size, local, overflow)


def local_bytes(size: int, usable: int) -> int:
    """Bytes of a payload that are in the page of its row."""
    if size <= usable - 35:
        return size
    least = (usable - 12) * 32 // 255 - 23
    local = least + (size - least) % (usable - 4)
    return local if local <= usable - 35 else least


def children(page: bytes, header: int) -> tuple[list[tuple[int, int | None]], bool]:
    """The children of an inner page, with the greatest key below each but the last.

    Returns:
        The children, and whether all of them could be read.
    """
    if len(page) < header + 12 or page[header] != INTERIOR:
        return [], False
    count = int.from_bytes(page[header + 3 : header + 5], "big")
    first = header + 12
    if first + 2 * count > len(page):
        return [], False
    found: list[tuple[int, int | None]] = []
    for place in struct.unpack_from(f">{count}H", page, first):
        try:
            key, _ = varint(page, place + 4)
        except IndexError:
            return found, False
        found.append((int.from_bytes(page[place : place + 4], "big"), key))
    found.append((int.from_bytes(page[header + 8 : header + 12], "big"), None))
    return found, True


def serial_types(payload: bytes) -> tuple[list[int], int] | None:
    """The types of a row's values, and where the values begin; None if it is not a row."""
    try:
        size, at = varint(payload, 0)
        types: list[int] = []
        while at < size:
            kind, at = varint(payload, at)
            types.append(kind)
    except IndexError:
        return None
    return (types, size) if at == size else None


def values(payload: bytes) -> list[Value] | None:
    """All values of a complete row; None if it is not a row."""
    found = serial_types(payload)
    if found is None:
        return None
    types, at = found
    result: list[Value] = []
    for kind in types:
        size = value_bytes(kind)
        if size is None or at + size > len(payload):
            return None
        result.append(value(kind, payload[at : at + size]))
        at += size
    return result if at == len(payload) else None


def value_bytes(kind: int) -> int | None:
    """Size of a value of a type; None for an invalid type."""
    if kind >= 12:
        return (kind - 12) // 2
    if kind == 0:
        return 0
    return 8 if kind == 7 else _INTEGER_BYTES.get(kind)


def value(kind: int, raw: bytes) -> Value:
    """A value of a type."""
    if kind >= 12:
        return raw if kind % 2 == 0 else raw.decode(errors="surrogateescape")
    if kind == 0:
        return None
    if kind == 7:
        number: float = struct.unpack(">d", raw)[0]
        return number
    if kind in (8, 9):
        return kind - 8
    return int.from_bytes(raw, "big", signed=True)


# ---------------------------------------------------------------- pages

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
        count: Number of pages present; the last may be cut short.
        promised: Number of pages according to the header; 0 if not stated.
        pending: What a file beside the database holds for it, a phrase; empty for nothing.

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
        """A page; shorter or empty if the file ends too early."""
        place = self._overlay.get(number)
        if place is not None and self._beside is not None:
            self._beside.seek(place)
            return self._beside.read(self.size)
        if not 1 <= number <= self.count:
            return b""
        return self._at((number - 1) * self.size, self.size)

    @property
    def all_bytes(self) -> int:
        """Bytes of all pages: rows with more in total must share pages."""
        return self.count * self.size

    def offset(self, number: int) -> int:
        """Byte of the database where a page begins."""
        return (number - 1) * self.size

    def there(self, number: int) -> int:
        """Number of bytes of a page that are in the file."""
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
        """Find the pages committed in a write-ahead log."""
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
        """Find the pages as they were before an unfinished transaction."""
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
            self.pending = f"an unfinished change, which {path.name} rolls back"

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
    """Number of rows in undamaged pages, assuming a page size."""
    pages = (sample[start : start + size] for start in range(size, len(sample), size))
    leaves = (leaf_cells(page, 0, size) for page in pages)
    return sum(len(leaf.rows) for leaf in leaves if not leaf.is_damaged)


def _wal_sums(order: str, data: bytes, sums: tuple[int, int]) -> tuple[int, int]:
    """Continue with the checksum of a write-ahead log."""
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
