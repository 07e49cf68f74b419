"""What the command line prints: results on stdout, complaints on stderr."""

from __future__ import annotations

import json
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, is_dataclass
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


def print_table(
    rows: Sequence[Mapping[str, str]],
    texts: Mapping[str, str],
    *,
    spare: Sequence[str] = (),
    first: int = 0,
) -> bool:
    """Print a table with a line for each row, without the columns that are empty.

    A terminal shows what fits: few rows, short names of types, fewer columns. Other programs get
    all.

    Args:
        rows: A text for each column, by its heading. All have the same columns; the first one
            names a row.
        texts: Columns that do not hold numbers -> ``topic``, ``type`` or ``text``, which a
            terminal that is too narrow shortens.
        spare: Columns that such a terminal leaves out, as many as it has to, in this order.
        first: How many rows a terminal shows if there are too many for it, the others by name.

    Returns:
        Whether anything was shortened or left out.
    """
    if is_quiet() or not rows:
        return False
    is_terminal = sys.stdout.isatty()
    most = (first or _MOST_ROWS) if is_terminal and len(rows) > _MOST_ROWS else len(rows)
    columns = {
        name: [name, *(shown(row[name]) for row in rows[:most])]
        for name in rows[0]
        if any(row[name] for row in rows[:most])
    }
    kinds = {name: texts.get(name, "number") for name in columns}
    widths = {name: max(map(_width, cells)) for name, cells in columns.items()}
    width = shutil.get_terminal_size().columns if is_terminal else sys.maxsize
    is_cut = _total(widths) > width
    if is_cut:
        widths = _fitted(columns, kinds, spare, width)
    with printed():
        for number in range(most + 1):
            cells = (_cell(columns[name][number], widths[name], kinds[name]) for name in widths)
            line = "  ".join(cells).rstrip()
            print(click.style(line, bold=True) if is_terminal and not number else line)
    if folded := rows[most:]:
        heading = next(iter(rows[0]))
        say(f"{counted(len(folded), f'other {heading}')}:")
        names = ", ".join(shown(row[heading]) for row in folded)
        for line in textwrap.wrap(names, width - 2, max_lines=_MOST_LINES, placeholder=" ..."):
            say(f"  {line}")
    return is_cut or bool(folded)


def _fitted(
    columns: dict[str, list[str]], kinds: Mapping[str, str], spare: Sequence[str], width: int
) -> dict[str, int]:
    """The columns that a terminal shows, and how wide; type names in them are shortened."""
    for name, cells in columns.items():
        if kinds[name] == "type":
            cells[:] = [re.sub(r"[\w.]+/(?:msg/)?", "", cell) for cell in cells]
    widths = {name: max(map(_width, cells)) for name, cells in columns.items()}
    least = {name: min(size, _SHORTEST.get(kinds[name], size)) for name, size in widths.items()}
    for name in spare:
        if _total(least) > width:
            least.pop(name, None)
    found = {name: widths[name] for name in least}
    while _total(found) > max(width, _total(least)):
        longer = [name for name in found if found[name] > least[name]]
        found[max(longer, key=lambda name: (kinds[name] == "text", found[name]))] -= 1
    return found


def _total(widths: Mapping[str, int]) -> int:
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
