"""Progress of commands, always on stderr: live, or as lines."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import TextIO

from mp4ds.cli.output import is_json, is_quiet, shown
from mp4ds.errors import size_text
from mp4ds.packing.options import PackProgress

_NAME_WIDTH = 60
_ROUNDING = 1e-6
_DIGITS = 9  # digits of a share: with a float's full precision, the time left may overflow


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


# ---------------------------------------------------------------- ways to show it

_SURE_SECONDS = 3.0
_LEAST_PAUSE, _MOST_PAUSE, _GROWTH = 10.0, 600.0, 0.05
_LISTED = 20


@contextmanager
def display(*, timed: bool = True) -> Iterator[Show]:
    """Show progress while the context lasts: bars on a terminal, else lines; or nothing.

    Args:
        timed: Say how long it still takes.
    """
    if is_quiet() or is_json():
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


# ---------------------------------------------------------------- packs

States = dict[Path, PackProgress]
"""Last reported state of each dataset, in the order in which they began."""


def share_of(states: States) -> float | None:
    """Share of packs that is done, by bytes of the sources; None if unknown."""
    total = packed = 0.0
    for state in states.values():
        share, weight = packed_share(state), max(1.0, state.bytes_total)
        if share is None:
            return None
        total, packed = total + weight, packed + weight * share
    return round(packed / total, _DIGITS) if total else None


def rows_of(states: States) -> list[Row]:
    """All packs, and each dataset or, of one, each camera."""
    if len(states) > 1:
        all_of_it = Row(
            f"packing {len(states)} datasets", _amounts(*states.values()), share_of(states)
        )
        rows = [Row(one.dataset.name, _text(one), packed_share(one)) for one in states.values()]
        return [all_of_it, *rows]
    (state,) = states.values()
    cameras = [
        Row(
            topic,
            str(done) if total is None else f"{done}/{total}",
            min(1.0, done / total) if total else None,
        )
        for topic, (done, total) in state.topics.items()
    ]
    return [Row(f"packing {state.dataset.name}", _text(state), share_of(states)), *cameras]


def packed_share(state: PackProgress) -> float | None:
    """Share of a dataset that is packed, 0 to 1; None if unknown."""
    if state.phase == "planning":
        return 0.0
    if state.phase != "packing":
        return 1.0
    if state.done is not None:
        return round(min(1.0, max(0.0, state.done)), _DIGITS)
    return min(1.0, state.tasks_done / state.tasks_total) if state.tasks_total else None


def _text(state: PackProgress) -> str:
    phase = "" if state.phase == "packing" else f"{state.phase} {plain(state.note)}".strip()
    return "  ".join(filter(None, (phase, _amounts(state))))


def _amounts(*states: PackProgress) -> str:
    """Parts done and total, if there are any, and bytes read and written."""
    total, failed = sum(s.tasks_total for s in states), sum(s.failed for s in states)
    read, written = sum(s.bytes_read for s in states), sum(s.bytes_written for s in states)
    texts = [
        f"parts {sum(s.tasks_done for s in states)}/{total}" if total else "",
        f"{failed} failed" if failed else "",
        f"{size_text(read)} -> {size_text(written)}",
    ]
    return "  ".join(filter(None, texts))


@contextmanager
def pack_progress(*, whole: bool = True) -> Iterator[Callable[[PackProgress], None]]:
    """Show the progress of packs while the context lasts.

    Args:
        whole: Whether this run is to do all of the job; of a share, the time left is not shown.

    Yields:
        What takes the progress, several times a second.
    """
    states: States = {}
    with display(timed=whole) as show:

        def take(state: PackProgress) -> None:
            states[state.dataset] = state
            show(rows_of(states))

        yield take
