"""The rows in the pages of an sqlite3 file (sqlite.org/fileformat2.html, "B-tree Pages")."""

from __future__ import annotations

import struct
from typing import NamedTuple

LEAF = 0x0D
INTERIOR = 0x05

_INTEGER_BYTES = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8, 8: 0, 9: 0}
Value = int | float | str | bytes | None


class Row(NamedTuple):
    """A row of a table, of which only the beginning stands in its page.

    Attributes:
        rowid: Its key.
        start: Byte of the page where its payload begins.
        size: Bytes of the payload.
        local: How many of these stand in the page.
        overflow: Number of the page where it goes on, 0 where it does not.
    """

    rowid: int
    start: int
    size: int
    local: int
    overflow: int


class Leaf(NamedTuple):
    """What a page of rows holds.

    Attributes:
        rows: Those that can be understood, in their order.
        is_damaged: Whether there are others, or it is no page of rows at all.
    """

    rows: list[Row]
    is_damaged: bool


def varint(data: bytes, at: int) -> tuple[int, int]:
    """A number of variable length, and where it ends.

    Raises:
        IndexError: The data ends before it does.
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
    """Bytes of a payload that stand in the page of its row."""
    if size <= usable - 35:
        return size
    least = (usable - 12) * 32 // 255 - 23
    local = least + (size - least) % (usable - 4)
    return local if local <= usable - 35 else least


def children(page: bytes, header: int) -> tuple[list[tuple[int, int | None]], bool]:
    """The pages below one that holds no rows, with the greatest key below each but the last.

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
    """The types of a row's values, and where the values begin; None where it is no row."""
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
    """All values of a row that is whole; None where it is no row."""
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
    """Bytes of a value of a type, None for a type that there is not."""
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
