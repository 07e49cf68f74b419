"""Where the messages of a damaged rosbag2 database stand."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.salvage.losses import LossLog
from mp4ds.bags.salvage.sqlite_cells import LEAF
from mp4ds.bags.salvage.sqlite_tables import Database, Tree, message_row

_CHUNK = 4096


@dataclass
class MessageIndex:
    """Log times, ns, keys, pages and numbers within their pages of all messages."""

    times: array[int] = field(default_factory=lambda: array("q"))
    keys: array[int] = field(default_factory=lambda: array("q"))
    pages: array[int] = field(default_factory=lambda: array("I"))
    places: array[int] = field(default_factory=lambda: array("H"))

    def order(self) -> Iterator[int]:
        """Positions by log time, then by key; of one key the first that was found."""
        if not self.keys:
            return
        times, keys = np.frombuffer(self.times, np.int64), np.frombuffer(self.keys, np.int64)
        _, first = np.unique(keys, return_index=True)
        order = first[np.lexsort((keys[first], times[first]))]
        for start in range(0, len(order), _CHUNK):
            yield from order[start : start + _CHUNK].tolist()

    def missing_keys(self) -> int:
        """How many keys from 1 to the greatest, as rosbag2 gives them, no message has."""
        keys = self.distinct_keys()
        return max(0, int(keys[-1]) - int((keys > 0).sum())) if len(keys) else 0

    def distinct_keys(self) -> NDArray[np.int64]:
        """All keys, sorted, each once."""
        return np.unique(np.array(self.keys, np.int64))


def index_messages(database: Database, log: LossLog, expected: int | None) -> MessageIndex:
    """Find all messages: by the tree of their table, and where it is damaged in all pages.

    Args:
        database: The database.
        log: Where pages that cannot be understood are put down.
        expected: How many messages there should be, where something else tells.
    """
    pages = database.pages
    index = MessageIndex()
    roots = database.roots()
    root = roots.get("messages")
    tree = database.tree(root) if root else Tree()
    damaged = set(tree.damaged)
    for number in tree.leaves:
        if not _add(database, number, index):
            damaged.add(number)
    is_short = pages.promised > pages.count
    if root is None or tree.damaged or is_short:
        for number in _other_pages(database, roots, tree):
            _add(database, number, index)
    drafts = []
    if root is None:
        drafts.append(log.lost(0, pages.there(1), "the page with the list of tables is damaged"))
    for number in sorted(number for number in damaged if 1 <= number <= pages.count):
        problem = "a page of the table of messages is damaged"
        drafts.append(log.lost(pages.offset(number), pages.there(number), problem))
    if is_short or (damaged and max(damaged) > pages.count):
        problem = f"the file ends before its {pages.promised or 'last'} pages do"
        drafts.append(log.lost(pages.file_size, None, problem, join=False))
    # The keys do not tell what is missing after the last one.
    is_open_ended = is_short or (damaged and tree.leaves and tree.leaves[-1] in damaged)
    if expected is None and not (root is None or is_open_ended):
        expected = len(index.keys) + index.missing_keys()
    if expected is not None:
        missing = max(0, expected - len(index.distinct_keys()))
        if missing and not drafts and (tree.damaged or root is None):
            drafts.append(log.lost(None, None, "pages of the table of messages cannot be found"))
        for draft in dict.fromkeys(drafts):
            draft.add(missing, ())
            missing = 0
    return index


def _add(database: Database, number: int, index: MessageIndex) -> bool:
    """Index the messages of a page. Returns whether it is sound."""
    page, rows, is_damaged = database.leaf(number)
    for place, row in enumerate(rows):
        found = message_row(page, row)
        if found is None:
            is_damaged = True
            continue
        index.times.append(found.time)
        index.keys.append(row.rowid)
        index.pages.append(number)
        index.places.append(place)
    return not is_damaged


def _other_pages(database: Database, roots: dict[str, int], tree: Tree) -> Iterator[int]:
    """Pages with rows that belong to no table that is known."""
    known = set(tree.pages) | database.free_pages()
    for name, root in roots.items():
        if name != "messages":
            known |= database.tree(root).pages
    for number in range(2, database.pages.count + 1):
        if number not in known and database.pages.read(number)[:1] == bytes([LEAF]):
            yield number
