"""What the command line prints: results on stdout, complaints and progress on stderr."""

from __future__ import annotations

import json
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, is_dataclass
from datetime import datetime, timezone
from typing import Any, TextIO
from unicodedata import east_asian_width

import click

from mp4ds.errors import Mp4dsError, counted

QUIET, JSON = "mp4ds.quiet", "mp4ds.json"
"""Keys in click's context: print nothing but errors and JSON; print results for programs."""


def is_set(key: str) -> bool:
    """Whether that holds for the command that runs."""
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
    if is_set(JSON):
        print_json(result)
    elif not is_set(QUIET):
        say_it(result)


def print_json(value: Any) -> None:
    """Print a result for scripts."""

    def jsonable(part: Any) -> Any:
        return asdict(part) if is_dataclass(part) and not isinstance(part, type) else str(part)

    text = json.dumps(value, default=jsonable, indent=2)
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
    if is_set(QUIET):
        return
    with printed():
        print(shown(value))


def say_counts(counts: Mapping[str, int | Mapping[str, int]], what: str) -> None:
    """Print what became of so many messages, by topic or by topic and reason."""
    for topic, found in counts.items():
        for reason, count in found.items() if isinstance(found, Mapping) else [("", found)]:
            why = f": {reason}" if reason else ""
            say(f"{topic}: {counted(count, 'message')} {what}{why}")


def complain(value: object) -> None:
    """Print a line to stderr; failing to print it is not an error."""
    with suppress(OSError, ValueError):
        print(f"mp4ds: {shown(value)}", file=sys.stderr, flush=True)


_TEXT = 20  # columns of a text that a terminal shows at least


def print_table(
    rows: Sequence[Mapping[str, str]],
    texts: Mapping[str, str],
    *,
    spare: Sequence[str] = (),
) -> bool:
    """Print a table with a line for each row, without the columns that are empty.

    A terminal shows what fits: short names of types, fewer columns. Other programs get all.

    Args:
        rows: A text for each column, by its heading. All have the same columns; the first one
            names a row.
        texts: Columns that do not hold numbers -> ``topic``, ``type`` or ``text``: a terminal that
            is too narrow gets short names of types, and texts without their ends.
        spare: Columns that such a terminal leaves out, as many as it has to, in this order.

    Returns:
        Whether anything was shortened or left out.
    """
    if is_set(QUIET) or not rows:
        return False
    is_terminal = sys.stdout.isatty()
    columns = {
        name: [name, *(shown(row[name]) for row in rows)]
        for name in rows[0]
        if any(row[name] for row in rows)
    }
    width = shutil.get_terminal_size().columns if is_terminal else sys.maxsize
    is_cut = False
    for name in ("", *spare):
        widths = {name: max(map(_width, cells)) for name, cells in columns.items()}
        least = (min(widths[own], _TEXT if texts.get(own) == "text" else width) for own in widths)
        if sum(least) + 2 * len(widths) - 2 <= width:
            break
        is_cut = True
        columns.pop(name, None)
        for cells in (columns[own] for own in columns if texts.get(own) == "type"):
            cells[:] = [re.sub(r"[\w.]+/(?:msg/)?", "", cell) for cell in cells]
    with printed():
        for number in range(len(rows) + 1):
            line = ""
            for name, cells in columns.items():
                space = " " * (widths[name] - _width(cells[number]))
                line += cells[number] + space if name in texts else space + cells[number]
                line += "  "
            line = line.rstrip()
            if _width(line) > width:
                is_cut = True
                line = f"{line[: width - 3]}..."
            print(click.style(line, bold=True) if is_terminal and not number else line)
    return is_cut


def _width(text: str) -> int:
    """Columns of a terminal that a text takes."""
    return len(text) + sum(east_asian_width(letter) in "WF" for letter in text)


def number(value: float | None, digits: int) -> str:
    """A number in a table; empty if there is none."""
    return "" if value is None else f"{value:.{digits}f}"


# ---------------------------------------------------------------- progress

_NAME_WIDTH = 60
_ROUNDING = 1e-6


@dataclass(frozen=True)
class Row:
    """What is done.

    Attributes:
        name: What is in work.
        text: More about it.
        share: Share that is done, 0 to 1; None if unknown.
    """

    name: str
    text: str = ""
    share: float | None = None


Show = Callable[[Sequence[Row]], None]
"""Shows how far a command is: a row for all of it, and rows for its parts."""


def plain(value: object) -> str:
    """A name in ASCII that fits into a line and cannot control a terminal."""
    text = shown(value).encode("ascii", "backslashreplace").decode()
    return text if len(text) <= _NAME_WIDTH else "..." + text[3 - _NAME_WIDTH :]


def percent_text(share: float | None) -> str:
    """A share in percent, never 100 before all is done; empty if unknown."""
    return "" if share is None else f"{int(100 * share + _ROUNDING)} %"


def duration_text(seconds: float) -> str:
    """A duration in its two largest units."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    if minutes < 60:
        return f"{minutes} min"
    if minutes < 48 * 60:
        return f"{minutes // 60} h {minutes % 60} min"
    hours = round(seconds / 3600)
    return f"{hours // 24} d {hours % 24} h"


_SURE_SECONDS = 3.0
_LEAST_PAUSE, _MOST_PAUSE, _GROWTH = 10.0, 600.0, 0.05
_LISTED = 20


@contextmanager
def display(*, timed: bool = True) -> Iterator[Show]:
    """Show progress while the context lasts: bars on a terminal, else lines; or nothing.

    Args:
        timed: Say how long it still takes.
    """
    if is_set(QUIET) or is_set(JSON):
        yield lambda _: None
    elif sys.stderr.isatty():
        with _bars(timed=timed) as show:
            yield show
    else:
        log, outcome = Log(sys.stderr, timed=timed), "done"
        try:
            yield log.show
        except BaseException as error:
            stopped = isinstance(error, (KeyboardInterrupt, SystemExit))
            outcome = "interrupted" if stopped else "failed"
            raise
        finally:
            log.end(outcome)


@contextmanager
def _bars(*, timed: bool) -> Iterator[Show]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = [
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=20),
        TextColumn("{task.fields[percent]}", markup=False),
        TextColumn("{task.fields[text]}", markup=False),
        *([TimeRemainingColumn()] if timed else []),
    ]
    console = Console(stderr=True)
    with Progress(
        *columns, console=console, transient=True, disable=console.is_dumb_terminal
    ) as bars:

        def show(rows: Sequence[Row]) -> None:
            for number, row in enumerate(rows):
                if number == len(bars.task_ids):
                    bars.add_task("", total=None, text="", percent="")
                bars.update(
                    bars.task_ids[number],
                    description="  " * (number > 0) + plain(row.name),
                    text=shown(row.text),
                    percent=percent_text(row.share),
                    total=None if row.share is None else 1.0,
                    completed=row.share,
                    visible=True,
                )
            for stale in bars.task_ids[len(rows) :]:
                bars.update(stale, visible=False)

        yield show


class Log:
    """Reports by lines: after 10 s, and whenever a twentieth of the time has passed again.

    Args:
        stream: Where to.
        timed: Say how long it still takes.
        clock: Seconds; does not go back.
        now: The time of day.
    """

    def __init__(
        self,
        stream: TextIO,
        *,
        timed: bool = True,
        clock: Callable[[], float] = time.monotonic,
        now: Callable[[], datetime] = lambda: datetime.now(timezone.utc),
    ) -> None:
        self._stream, self._timed, self._clock, self._now = stream, timed, clock, now
        self._began = clock()
        self._known: tuple[float, float] | None = None  # when a share was known first, and which
        self._last: Sequence[Row] = ()
        self._next = _LEAST_PAUSE

    def show(self, rows: Sequence[Row]) -> None:
        """Take what is done, and write a line if one is due."""
        self._last = rows
        whole, *parts = rows
        left, seconds = self._left(whole.share), self._clock() - self._began
        if seconds < self._next:
            return
        self._next = seconds + min(max(_LEAST_PAUSE, _GROWTH * seconds), _MOST_PAUSE)
        listed = ", ".join(f"{plain(one.name)} {one.text}" for one in parts[:_LISTED])
        more = f" and {len(parts) - _LISTED} more" if len(parts) > _LISTED else ""
        time_left = f"{duration_text(left)} left" if left else ""
        self._tell(percent_text(whole.share), plain(whole.text), listed + more, time_left)

    def end(self, outcome: str) -> None:
        """Write how it ended, if there were lines before."""
        seconds = self._clock() - self._began
        if self._last and seconds >= _LEAST_PAUSE:
            self._tell(f"{outcome} after {duration_text(seconds)}", plain(self._last[0].text))

    def _left(self, share: float | None) -> float | None:
        """Seconds until all is done, by what was done since a share was known; None if unknown."""
        if not share or not self._timed:
            return None
        now = self._clock()
        self._known = self._known or (now, share)
        began, before = self._known
        if share <= before or now - began < _SURE_SECONDS:
            return None
        return (now - began) * (1 - share) / (share - before)

    def _tell(self, *texts: str) -> None:
        name = plain(self._last[0].name)
        line = " | ".join(filter(None, texts))
        with suppress(OSError, ValueError):  # nobody reads it; ValueError: it was closed
            self._stream.write(f"{self._now().astimezone():%H:%M:%S} {name}: {line}\n")
            self._stream.flush()


@contextmanager
def progress_of(doing: str) -> Iterator[Callable[..., None]]:
    """Show the progress of a command while the context lasts.

    Args:
        doing: Such as ``validating``.

    Yields:
        What takes what is being done, and the share of all that is done, 0 to 1, where known.
    """
    known = [0.0]
    with display() as show:

        def tell(what: str, share: float | None = None) -> None:
            known[0] = known[0] if share is None else share
            show([Row(doing, what, known[0] or None)])

        yield tell
