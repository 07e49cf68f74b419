"""Opens sqlite3 files that a stranger may have made: plain tables, and no more work than bytes.

A view can be asked for rows without end, and so can a table whose pages refer to each other.
"""

from __future__ import annotations

import re
import sqlite3
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from mp4ds.bags.mcap_records import SALVAGE_REMEDY
from mp4ds.errors import SourceError

_PLAIN = re.compile(rb"\s*CREATE\s+(TABLE|INDEX|UNIQUE\s+INDEX|TRIGGER)\b", re.IGNORECASE)
_LOOK_STEPS = 10**4  # of sqlite's machine, well below a millisecond
_STEPS_A_BYTE, _LEAST_STEPS = 100, 10**6  # all queries of a pass need about 3 for each byte
_LEAST_LENGTH = 10**6  # sqlite's default for the text of a query


class Tables:
    """The tables of an open file, for one pass: more would use up what it may cost.

    Args:
        connection: To the file.
        size: Its bytes, with what stands beside it.
        shown: Its name in errors.
    """

    def __init__(self, connection: sqlite3.Connection, size: int, shown: Path) -> None:
        self._connection = connection
        self._size, self._left = size, 2 * size  # names are read twice, UTF-16 becomes longer
        self._shown = shown
        self.raised: BaseException | None = None
        looks = self._looks()
        next(looks)
        # A handler that raises is taken for one that says 1: this one keeps what a signal raises.
        connection.set_progress_handler(partial(next, looks, 1), _LOOK_STEPS)

    def _looks(self) -> Iterator[int]:
        try:
            for _ in range((_STEPS_A_BYTE * self._size + _LEAST_STEPS) // _LOOK_STEPS):
                yield 0
            self.raised = self.too_much()
        except BaseException as error:
            self.raised = error

    def check_plain(self) -> None:
        """Refuse what computes rows or values instead of holding them.

        Raises:
            SourceError: There is a view or a virtual table.
        """
        for name, sql in self.rows("SELECT name, sql FROM sqlite_master WHERE sql IS NOT NULL"):
            if not isinstance(sql, bytes) or not _PLAIN.match(sql):
                shown = bytes(name).decode(errors="replace") if isinstance(name, bytes) else name
                raise SourceError(
                    self._shown,
                    f"has a view or virtual table {shown!r}, which no recording has",
                    f"Drop it with the sqlite3 tool, or go without: {SALVAGE_REMEDY}",
                )

    def columns(self, table: str) -> list[tuple[Any, bool]]:
        """Name of each column of a table, and whether its values are computed."""
        found = self._connection.execute(f"PRAGMA table_xinfo({table})")
        return [(row[1], row[6] != 0) for row in found]

    def select(self, query: str, values: Any = ()) -> sqlite3.Cursor:
        """Rows of numbers."""
        return self._connection.execute(query, values)

    def rows(self, query: str, values: Any = ()) -> Iterator[tuple[Any, ...]]:
        """Rows with texts or blobs, which all together are no longer than the file.

        Raises:
            SourceError: They are: pages belong to several rows.
        """
        for row in self._connection.execute(query, values):
            self._left -= sum(len(value) for value in row if isinstance(value, bytes))
            if self._left < 0:
                raise self.too_much()
            yield row

    def too_much(self) -> SourceError:
        """The error for tables that hold more than the file."""
        problem = "is damaged: its tables list more than a file of its size can hold"
        return SourceError(self._shown, problem, SALVAGE_REMEDY)


@contextmanager
def open_tables(path: Path, shown: Path) -> Iterator[Tables]:
    """Open a file for reading only.

    Args:
        path: The database.
        shown: Its name in errors, where it is a decompressed copy.

    Raises:
        SourceError: It cannot be read, also for whatever is done within.
    """
    sides = [Path(f"{path}{suffix}") for suffix in ("-wal", "-journal")]
    beside = sum(side.stat().st_size for side in sides if side.exists())
    options = "mode=ro" if beside else "mode=ro&immutable=1"
    index = Path(f"{path}-shm")  # sqlite makes one to read a -wal, and leaves it
    had_index = index.exists()
    connection = tables = None
    try:
        uri = f"{path.absolute().as_uri()}?{options}"
        connection = sqlite3.connect(uri, uri=True, check_same_thread=False)
        connection.text_factory = bytes  # verbatim, whether it is UTF-8 or not
        size = path.stat().st_size + beside
        tables = Tables(connection, size, shown)
        connection.execute("PRAGMA trusted_schema = OFF")
        if sys.version_info >= (3, 11):
            most = min(max(size, _LEAST_LENGTH), 2**31 - 1)
            connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, most)
        tables.check_plain()
        yield tables
    except (sqlite3.Error, UnicodeDecodeError) as error:
        if tables and tables.raised:
            raise tables.raised from None
        remedy = (
            "It was not closed properly: open and close it once with the sqlite3 tool; "
            if beside
            else "If it was cut short, try `.recover` of the sqlite3 tool; without that, "
        )
        problem = f"cannot be read as sqlite3: {error}"
        raise SourceError(shown, problem, remedy + SALVAGE_REMEDY) from None
    finally:
        if connection:
            connection.set_progress_handler(None, 0)
            connection.close()
        if not had_index:
            index.unlink(missing_ok=True)
