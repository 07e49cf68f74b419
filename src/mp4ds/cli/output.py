"""What the command line prints: results on stdout, complaints on stderr."""

from __future__ import annotations

import json
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, is_dataclass
from typing import Any
from unicodedata import east_asian_width

import click

from mp4ds.errors import Mp4dsError, counted

_QUIET, _JSON = "mp4ds.quiet", "mp4ds.json"  # keys in click's context


def be_quiet() -> None:
    """From now on, print neither results for people nor progress."""
    click.get_current_context().meta[_QUIET] = True


def be_json() -> None:
    """From now on, print results and errors for programs."""
    click.get_current_context().meta[_JSON] = True


def is_quiet() -> bool:
    """Whether nothing but errors and JSON is printed."""
    return _is_set(_QUIET)


def is_json() -> bool:
    """Whether results are printed for programs."""
    return _is_set(_JSON)


def _is_set(key: str) -> bool:
    context = click.get_current_context(silent=True)
    return context is not None and key in context.meta


@contextmanager
def printed() -> Iterator[None]:
    """Report system errors as errors of standard output: no other file is involved.

    Raises:
        Mp4dsError: It cannot be written to.
        Exit: The reader has closed it.
    """
    try:
        yield
    except BrokenPipeError:
        raise click.exceptions.Exit(1) from None
    except OSError as error:
        raise Mp4dsError(
            f"standard output: {error.strerror or error}. The command's output text is lost; the "
            "files it wrote are complete."
        ) from None


def show(result: Any, say_it: Callable[[Any], object]) -> None:
    """Print a result: as JSON for programs, or by a function for people."""
    if is_json():
        print_json(result)
    elif not is_quiet():
        say_it(result)


def _jsonable(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    return str(value)


def print_json(value: Any) -> None:
    """Print a result for scripts."""
    text = json.dumps(value, default=_jsonable, indent=2)
    with printed():
        print(text)


def shown(value: object) -> str:
    """A text without terminal control characters, which topic and file names may contain."""
    text = str(value)
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def say(value: object) -> None:
    """Print one line."""
    if is_quiet():
        return
    with printed():
        print(shown(value))


def complain(value: object) -> None:
    """Print a line to stderr; failing to print it is not an error."""
    with suppress(OSError, ValueError):
        print(f"mp4ds: {shown(value)}", file=sys.stderr, flush=True)


_MOST_ROWS = 20  # of a table on a terminal
_MOST_LINES = 3  # of the names of other rows
_SHORTEST = {"topic": 24, "type": 12, "text": 20}


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        name: Its heading.
        kind: ``number``, right-aligned; ``topic``, ``type`` or ``text``, which a terminal that is
            too narrow shortens.
        spare: A terminal that is too narrow leaves out the column with the largest number first;
            0: none does.
    """

    name: str
    kind: str = "number"
    spare: int = 0


def print_table(
    columns: Sequence[Column], rows: Sequence[Sequence[str]], *, first: int = 0
) -> bool:
    """Print a table with a line for each row, without the columns that are empty.

    A terminal shows what fits: few rows, short names of types, fewer columns. Other programs get
    all.

    Args:
        columns: Its columns.
        rows: A text for each of them.
        first: How many rows a terminal shows if there are too many for it, the others by name.

    Returns:
        Whether anything was shortened or left out.
    """
    if is_quiet():
        return False
    cells = [[shown(cell) for cell in row] for row in rows]
    is_terminal = sys.stdout.isatty()
    most = (first or _MOST_ROWS) if is_terminal and len(cells) > _MOST_ROWS else len(cells)
    cells, folded = cells[:most], [row[0] for row in cells[most:]]
    used = [n for n in range(len(columns)) if any(row[n] for row in cells)]
    table = [[column.name for column in columns], *cells]
    widths = {n: max(_width(row[n]) for row in table) for n in used}
    width = shutil.get_terminal_size().columns if is_terminal else sys.maxsize
    is_cut = _total(widths) > width
    if is_cut:
        widths = _fitted(columns, used, table, width)
    with printed():
        for number, row in enumerate(table):
            line = "  ".join(_cell(row[n], size, columns[n].kind) for n, size in widths.items())
            is_heading = is_terminal and not number
            print(click.style(line.rstrip(), bold=True) if is_heading else line.rstrip())
    if folded:
        say(f"{counted(len(folded), f'other {columns[0].name}')}:")
        names = ", ".join(folded)
        for line in textwrap.wrap(names, width - 2, max_lines=_MOST_LINES, placeholder=" ..."):
            say(f"  {line}")
    return is_cut or bool(folded)


def _fitted(
    columns: Sequence[Column], used: Sequence[int], table: list[list[str]], width: int
) -> dict[int, int]:
    """The columns that a terminal shows, and how wide; type names in the table are shortened."""
    for row in table:
        for n in used:
            if columns[n].kind == "type":
                row[n] = re.sub(r"[\w.]+/(?:msg/)?", "", row[n])
    widths = {n: max(_width(row[n]) for row in table) for n in used}
    least = {n: min(size, _SHORTEST.get(columns[n].kind, size)) for n, size in widths.items()}
    while _total(least) > width and any(columns[n].spare for n in least):
        del least[max(least, key=lambda n: columns[n].spare)]
    found = {n: widths[n] for n in least}
    while _total(found) > max(width, _total(least)):
        longer = [n for n in found if found[n] > least[n]]
        found[max(longer, key=lambda n: (columns[n].kind == "text", found[n]))] -= 1
    return found


def _total(widths: dict[int, int]) -> int:
    """Columns of a terminal that a table takes."""
    return sum(widths.values()) + 2 * len(widths) - 2


def _width(text: str) -> int:
    """Columns of a terminal that a text takes."""
    return len(text) + sum(east_asian_width(letter) in "WF" for letter in text)


def _cell(text: str, width: int, kind: str) -> str:
    """A text of a table in a given width; if too long, without its end, or a topic's middle."""
    if _width(text) > width:
        begin = text[: (width - 3) // 3 if kind == "topic" else width - 3]
        end = text[len(text) - (width - 3 - len(begin)) :]
        while _width(begin) + _width(end) > width - 3:  # of wide letters
            begin, end = begin[:-1], end if begin else end[1:]
        text = f"{begin}...{end}"
    space = " " * (width - _width(text))
    return space + text if kind == "number" else text + space


def number(value: float | None, digits: int) -> str:
    """A number in a table; empty if there is none."""
    return "" if value is None else f"{value:.{digits}f}"
