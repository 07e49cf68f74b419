"""The tables of a damaged rosbag2 database, found by its trees and by the look of their rows."""

from __future__ import annotations

from array import array
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, field

from mp4ds.bags.salvage.sqlite_cells import (
    INTERIOR,
    LEAF,
    Row,
    Value,
    children,
    leaf_cells,
    serial_types,
    value,
    value_bytes,
    values,
)
from mp4ds.bags.salvage.sqlite_pages import HEADER_BYTES, Pages

_MAX_SMALL_ROW = 2**24
_MAX_ROWS = 10**5  # of a table that is no table of messages
_MAX_DEPTH = 32
_CACHED_LEAVES = 32


@dataclass
class Tree:
    """The pages of a table.

    Attributes:
        leaves: Pages with rows, in the order of their keys.
        pages: All pages that were visited.
        damaged: Pages of it that cannot be understood.
    """

    leaves: array[int] = field(default_factory=lambda: array("I"))
    pages: set[int] = field(default_factory=set)
    damaged: list[int] = field(default_factory=list)


class MessageRow:
    """Where the values of a message stand in its row: times are ns."""

    __slots__ = ("blob", "size", "time", "topic_id")

    def __init__(self, topic_id: int, time: int, blob: int, size: int) -> None:
        self.topic_id = topic_id
        self.time = time
        self.blob = blob
        self.size = size


class Database:
    """Reads tables of a database page by page.

    Args:
        pages: Its pages.
    """

    def __init__(self, pages: Pages) -> None:
        self.pages = pages
        self._leaves: OrderedDict[int, tuple[bytes, list[Row], bool]] = OrderedDict()

    def leaf(self, number: int) -> tuple[bytes, list[Row], bool]:
        """A page, its rows, and whether it is damaged."""
        if number not in self._leaves:
            page = self.pages.read(number)
            header = HEADER_BYTES if number == 1 else 0
            found = leaf_cells(page, header, self.pages.usable)
            if len(self._leaves) >= _CACHED_LEAVES:
                self._leaves.popitem(last=False)
            self._leaves[number] = page, found.rows, found.is_damaged
        return self._leaves[number]

    def tree(self, root: int) -> Tree:
        """The pages of the table whose root is a page."""
        tree = Tree()
        todo = [(root, 0)]
        while todo:
            number, depth = todo.pop()
            if number in tree.pages or depth > _MAX_DEPTH:
                tree.damaged.append(number)
                continue
            tree.pages.add(number)
            page = self.pages.read(number)
            header = HEADER_BYTES if number == 1 else 0
            kind = page[header] if len(page) > header else 0
            if kind == LEAF:
                tree.leaves.append(number)
            elif kind == INTERIOR:
                below, is_whole = children(page, header)
                if not is_whole:
                    tree.damaged.append(number)
                todo.extend((child, depth + 1) for child, _ in reversed(below))
            else:
                tree.damaged.append(number)
        return tree

    def roots(self) -> dict[str, int]:
        """Root page of each table by name, as far as the first page tells."""
        found: dict[str, int] = {}
        for row in self.rows(self.tree(1)):
            if len(row) == 6 and row[1] == "table":
                name, root = row[2], row[4]
                if isinstance(name, str) and isinstance(root, int) and root > 0:
                    found[name] = root
        return found

    def rows(self, tree: Tree) -> Iterator[list[Value]]:
        """Key and values of the rows of a small table that can be read."""
        count, left = 0, self.pages.all_bytes
        for number in tree.leaves:
            page, rows, _ = self.leaf(number)
            for row in rows:
                is_small = row.size <= min(_MAX_SMALL_ROW, left)
                payload = self.payload(page, row) if is_small else None
                left -= len(payload or b"")
                found = values(payload) if payload is not None else None
                count += 1
                if found is not None and count <= _MAX_ROWS:
                    yield [row.rowid, *found]

    def payload(self, page: bytes, row: Row) -> bytes | None:
        """All bytes of a row; None where they are not all there."""
        if row.size > self.pages.all_bytes:
            return None
        pieces = [page[row.start : row.start + row.local]]
        left, number = row.size - row.local, row.overflow
        room = self.pages.usable - 4
        while left > 0:
            more = self.pages.read(number)
            if len(more) < min(left + 4, self.pages.usable) or number <= 1:
                return None
            number = int.from_bytes(more[:4], "big")
            pieces.append(more[4 : 4 + min(left, room)])
            left -= room
            if (left > 0) != (number != 0):
                return None  # the chain ends early, or goes on after its end
        return b"".join(pieces)

    def free_pages(self) -> set[int]:
        """Pages that the database does not use, which may hold what was deleted."""
        header = self.pages.read(1)
        trunk = int.from_bytes(header[32:36], "big")
        found: set[int] = set()
        while trunk and trunk not in found and trunk <= self.pages.count:
            found.add(trunk)
            page = self.pages.read(trunk)
            count = min(int.from_bytes(page[4:8], "big"), max(0, len(page) - 8) // 4)
            for place in range(8, 8 + 4 * count, 4):
                found.add(int.from_bytes(page[place : place + 4], "big"))
            trunk = int.from_bytes(page[:4], "big")
        return found


def message_row(page: bytes, row: Row) -> MessageRow | None:
    """What a row tells if it is one of messages: no value, two integers, and a blob."""
    head = page[row.start : row.start + row.local]
    found = serial_types(head)
    if found is None or len(found[0]) != 4:
        return None
    (key, topic, time, blob), at = found
    if key != 0 or blob < 12 or blob % 2:
        return None
    numbers: list[int] = []
    for kind in (topic, time):
        size = value_bytes(kind)
        if size is None or kind in (0, 7) or kind >= 12 or at + size > len(head):
            return None
        number = value(kind, head[at : at + size])
        if not isinstance(number, int):
            return None
        numbers.append(number)
        at += size
    size = (blob - 12) // 2
    if at + size != row.size:
        return None
    return MessageRow(numbers[0], numbers[1], at, size)
