"""Topics and other small tables of a damaged rosbag2 database."""

from __future__ import annotations

import sqlite3
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path

from mp4ds.bags.rosbag2_sqlite import SqliteReader
from mp4ds.bags.salvage.sqlite_cells import LEAF, Value
from mp4ds.bags.salvage.sqlite_pages import Pages
from mp4ds.bags.salvage.sqlite_tables import Database, Tree
from mp4ds.errors import SourceError

# Columns of the tables as rosbag2 makes them; newer versions have more.
_COLUMNS: dict[str, Sequence[str]] = {
    "topics": (
        "id INTEGER PRIMARY KEY",
        "name TEXT NOT NULL",
        "type TEXT NOT NULL",
        "serialization_format TEXT NOT NULL",
        "offered_qos_profiles TEXT NOT NULL",
        "type_description_hash TEXT NOT NULL",
    ),
    "message_definitions": (
        "id INTEGER PRIMARY KEY",
        "topic_type TEXT NOT NULL",
        "encoding TEXT NOT NULL",
        "encoded_message_definition TEXT NOT NULL",
        "type_description_hash TEXT NOT NULL",
    ),
    "metadata": (
        "id INTEGER PRIMARY KEY",
        "metadata_version INTEGER NOT NULL",
        "metadata TEXT NOT NULL",
    ),
    "schema": ("schema_version INTEGER PRIMARY KEY", "ros_distro TEXT NOT NULL"),
}
_LEAST_COLUMNS = {"topics": 4, "message_definitions": 5, "metadata": 3, "schema": 2}
_MESSAGES = (
    "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,"
    " timestamp INTEGER NOT NULL, data BLOB NOT NULL)"
)
_MAX_SEARCHED = 10**4  # pages at the start of a file, where rosbag2 has its small tables


def open_small_tables(path: Path, shown: Path) -> tuple[SqliteReader, str]:
    """The small tables, by sqlite3 where it opens the file, else by what their pages hold.

    Args:
        path: The database.
        shown: Its name in errors and tables.

    Returns:
        A reader that knows topics, definitions and tables, and is not to be asked for
        messages; and why sqlite3 does not open the file, a phrase, empty where it does.

    Raises:
        SourceError: The file is missing, empty, or unreadable.
    """
    with Pages(path, shown) as pages:
        try:
            return SqliteReader(path, shown=shown), ""
        except SourceError as error:
            problem = str(error)
        found = _small_tables(Database(pages))
        pending = pages.pending
    with tempfile.TemporaryDirectory(prefix="mp4ds-") as folder:
        copy = Path(folder) / "tables.db3"
        _write(copy, found)
        reader = SqliteReader(copy, shown=shown)
    return reader, "" if pending else _short(problem, shown)


def _short(problem: str, shown: Path) -> str:
    return problem.removeprefix(f"{shown}: ").partition(". ")[0].rstrip(".")


def _small_tables(database: Database) -> dict[str, list[list[Value]]]:
    roots = database.roots()
    found: dict[str, list[list[Value]]] = {}
    visited: set[int] = set()
    for name in _COLUMNS:
        if name in roots:
            tree = database.tree(roots[name])
            visited |= tree.pages
            rows = [row for row in database.rows(tree) if _table_of(row) == name]
            if rows:
                found[name] = rows
    if "topics" not in found:
        for name, rows in _by_look(database, visited):
            if name not in found:
                found[name] = rows
            elif name not in roots:
                found[name] += rows
    return found


def _by_look(database: Database, visited: set[int]) -> Iterator[tuple[str, list[list[Value]]]]:
    """Rows that look like those of small tables, of pages that belong to no table."""
    free = database.free_pages()
    for number in range(2, min(database.pages.count, _MAX_SEARCHED) + 1):
        if number in visited or number in free or database.pages.read(number)[:1] != bytes([LEAF]):
            continue
        tree = Tree()
        tree.leaves.append(number)
        rows = list(database.rows(tree))
        for name in _COLUMNS:
            of_table = [row for row in rows if _table_of(row) == name]
            if of_table:
                yield name, of_table


def _table_of(row: list[Value]) -> str | None:
    """The table whose columns a row has; its values follow its key."""
    kinds = "".join("n" if v is None else "i" if isinstance(v, int) else "t" for v in row[1:])
    if kinds in ("nttt", "nttttt") or (kinds == "ntttt" and not _is_definition(row)):
        return "topics"
    return {"ntttt": "message_definitions", "nit": "metadata", "nt": "schema"}.get(kinds)


def _is_definition(row: list[Value]) -> bool:
    """Of rows with four texts: a topic's third is a serialization, a definition's second."""
    return row[3] in ("ros2msg", "ros2idl", "unknown", "")


def _write(path: Path, tables: dict[str, list[list[Value]]]) -> None:
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute(_MESSAGES)
        for name, columns in _COLUMNS.items():
            rows = tables.get(name, [])
            if not rows and name != "topics":
                continue
            count = max((len(row) - 1 for row in rows), default=_LEAST_COLUMNS[name])
            connection.execute(f"CREATE TABLE {name}({', '.join(columns[:count])})")
            marks = ", ".join("?" * count)
            for key, _, *rest in rows:
                rest += [""] * (count - 1 - len(rest))
                connection.execute(
                    f"INSERT OR IGNORE INTO {name} VALUES({marks})", (key, *map(_plain, rest))
                )


def _plain(value: Value) -> Value:
    r"""A value as sqlite3 takes it, damaged bytes of a text as ``\xNN``."""
    if isinstance(value, str):
        return value.encode(errors="surrogateescape").decode(errors="backslashreplace")
    return value
