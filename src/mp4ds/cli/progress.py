"""Progress of commands, always on stderr: live, as lines, or as events for packs."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime, timedelta, timezone
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TextIO

from mp4ds.cli.output import is_quiet, shown
from mp4ds.errors import size_text

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

    from mp4ds.packing.options import PackProgress

PACE_SECONDS = 60.0
"""Period over which the pace is measured."""

_LEFT_SECONDS = 3.0
_NAME_WIDTH = 60
_ROUNDING = 1e-6
_DIGITS = 9  # digits of a share: with a float's full precision, the time left may overflow


class PackState:
    """Progress of one or several packs.

    Args:
        whole: As for `pack_progress`.
        clock: Seconds; does not go back.

    Attributes:
        states: Last reported state of each dataset, in the order in which they began.
    """

    def __init__(self, *, whole: bool = True, clock: Callable[[], float] = time.monotonic) -> None:
        self.states: dict[Path, PackProgress] = {}
        self.clock = clock
        self._whole = whole
        self._began: float | None = None
        self._pace: Progress | None = None

    @property
    def seconds(self) -> float | None:
        """Seconds since it began; None before."""
        return None if self._began is None else self.clock() - self._began

    @property
    def share(self) -> float | None:
        """Share that is packed, by bytes of the sources; None if unknown."""
        total = packed = 0.0
        for state in self.states.values():
            share, weight = packed_share(state), max(1.0, state.bytes_total)
            if share is None:
                return None
            total, packed = total + weight, packed + weight * share
        return packed / total if total else None

    def take(self, state: PackProgress) -> None:
        """Take a reported state."""
        if self._began is None:
            self._began = self.clock()
        self.states[state.dataset] = state
        share = self.share
        # a short pack ends before this needs rich
        if share is None or not self._whole or self.clock() - self._began < _LEFT_SECONDS:
            return
        if self._pace is None:
            from rich.progress import Progress

            # never shown: used only to estimate time
            self._pace = Progress(get_time=self.clock, speed_estimate_period=PACE_SECONDS)
            self._pace.add_task("", total=1.0, completed=share)  # type: ignore[arg-type]
        self._pace.update(self._pace.task_ids[0], completed=share)

    @property
    def seconds_left(self) -> int | None:
        """Seconds until all is packed, at the pace of the last minute; None if unknown."""
        left = self._pace.tasks[0].time_remaining if self._pace else None
        return None if left is None else int(left)


def packed_share(state: PackProgress) -> float | None:
    """Share of a dataset that is packed, 0 to 1; None if unknown."""
    if state.phase == "planning":
        return 0.0
    if state.phase != "packing":
        return 1.0
    if state.done is not None:
        return round(min(1.0, max(0.0, state.done)), _DIGITS)
    return min(1.0, state.tasks_done / state.tasks_total) if state.tasks_total else None


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


def left_text(seconds: float | None) -> str:
    """The time left; empty if unknown or zero."""
    return f"{duration_text(seconds)} left" if seconds else ""


def count_text(done: int, total: int | None) -> str:
    """Render N of M, if M is known."""
    return str(done) if total is None else f"{done}/{total}"


def amounts(states: list[PackProgress]) -> list[str]:
    """Parts done and total, if there are any, and bytes read and written."""
    total, failed = sum(s.tasks_total for s in states), sum(s.failed for s in states)
    parts = f"parts {sum(s.tasks_done for s in states)}/{total}" if total else ""
    read, written = sum(s.bytes_read for s in states), sum(s.bytes_written for s in states)
    texts = [
        parts,
        f"{failed} failed" if failed else "",
        f"{size_text(read)} -> {size_text(written)}",
    ]
    return list(filter(None, texts))


def phase_text(state: PackProgress) -> str:
    """The phase of a dataset, unless it is just being packed."""
    return "" if state.phase == "packing" else f"{state.phase} {plain(state.note)}".strip()


# ---------------------------------------------------------------- lines

_EVENT_SECONDS, _SILENCE_SECONDS = 1.0, 10.0
_LONG_SECONDS = 10.0
_LINE_SECONDS, _LINE_SECONDS_MOST, _LINE_GROWTH = 60.0, 600.0, 0.05
_LISTED = 20


class Lines:
    """Writes lines as long as anyone reads them: a pack does not fail for lack of a log.

    Args:
        stream: Where to.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._is_broken = False

    def write(self, line: str) -> None:
        """Write a line and flush it."""
        if self._is_broken:
            return
        try:
            self._stream.write(line + "\n")
            self._stream.flush()
        except (OSError, ValueError):  # ValueError: it was closed
            self._is_broken = True


class Events:
    """Reports a job as JSON events.

    Args:
        job: Its progress.
        lines: Take the events.
        now: The time of day, with its zone.
    """

    def __init__(
        self,
        job: PackState,
        lines: Lines,
        *,
        now: Callable[[], datetime] = lambda: datetime.now(timezone.utc),
    ) -> None:
        self._job = job
        self._lines = lines
        self._now = now
        self._told: dict[Path, float] = {}
        self._waiting: dict[Path, PackProgress] = {}
        self._last: PackProgress | None = None

    def take(self, state: PackProgress) -> None:
        """See `ProgressWriter.take`."""
        self._job.take(state)
        if self._last is None:
            self._write("start", dataset=str(state.dataset))
        self._last = self._waiting[state.dataset] = state
        self._tell_waiting(_EVENT_SECONDS)

    def tick(self) -> None:
        """See `ProgressWriter.tick`."""
        self._tell_waiting(_EVENT_SECONDS)
        if self._last and self._job.clock() - max(self._told.values()) >= _SILENCE_SECONDS:
            self._tell(self._last)

    def end(self, outcome: str) -> None:
        """See `ProgressWriter.end`."""
        self._tell_waiting(0)
        if self._job.seconds is not None:
            self._write("end", outcome=outcome, seconds=round(self._job.seconds, 3))

    def _tell_waiting(self, pause: float) -> None:
        for dataset, state in list(self._waiting.items()):
            told = self._told.get(dataset)
            if told is None or self._job.clock() - told >= pause:
                self._tell(state)

    def _tell(self, state: PackProgress) -> None:
        self._told[state.dataset] = self._job.clock()
        self._waiting.pop(state.dataset, None)
        done = packed_share(state) if state.phase == "packing" else state.done
        self._write(
            "progress",
            dataset=str(state.dataset),
            phase=state.phase,
            note=state.note,
            # while joining does not report progress, the share stays that of packing
            done=None if done == 1 and state.phase != "packing" else _rounded(done),
            job_done=_rounded(self._job.share),
            tasks_done=state.tasks_done,
            tasks_total=state.tasks_total,
            tasks_before=state.tasks_before,
            failed=state.failed,
            bytes_read=state.bytes_read,
            bytes_total=state.bytes_total,
            bytes_written=state.bytes_written,
            topics={
                topic: {"done": done, "total": total}
                for topic, (done, total) in state.topics.items()
            },
            seconds_left=self._job.seconds_left,
        )

    def _write(self, event: str, **values: Any) -> None:
        now = self._now().isoformat(timespec="milliseconds")
        self._lines.write(json.dumps({"event": event, "time": now, **values}))


def _rounded(share: float | None) -> float | None:
    return None if share is None else round(share, 6)


class Log:
    """Reports a long job by plain lines: at its beginning, its end, and now and then.

    The first comes after 10 s. Others follow when a minute went by, later a twentieth of the
    time since the beginning, at most ten minutes.

    Args:
        job: Its progress.
        lines: Take the lines.
        now: The local time of day.
    """

    def __init__(
        self, job: PackState, lines: Lines, *, now: Callable[[], datetime] = datetime.now
    ) -> None:
        self._job = job
        self._lines = lines
        self._now = now
        self._told: float | None = None

    def take(self, state: PackProgress) -> None:
        """See `ProgressWriter.take`."""
        self._job.take(state)
        self.tick()

    def tick(self) -> None:
        """See `ProgressWriter.tick`."""
        seconds = self._job.seconds
        if seconds is None or seconds < _LONG_SECONDS:
            return
        states = list(self._job.states.values())
        if self._told is None:
            began = self._now() - timedelta(seconds=seconds)
            before = sum(state.tasks_before for state in states)
            self._line(
                f"started {began:%Y-%m-%d}",
                f"{size_text(sum(state.bytes_total for state in states))} to pack",
                f"{before} parts were already done" if before else "",
                at=began,
            )
        elif seconds - self._told < min(
            _LINE_SECONDS_MOST, max(_LINE_SECONDS, _LINE_GROWTH * self._told)
        ):
            return
        self._told = seconds
        if len(states) == 1:
            texts = [phase_text(states[0]) or percent_text(self._job.share), _topics(states[0])]
        else:
            texts = [percent_text(self._job.share), _datasets(states)]
        self._line(*texts, *amounts(states), left_text(self._job.seconds_left))

    def end(self, outcome: str) -> None:
        """See `ProgressWriter.end`."""
        if self._told is not None and self._job.seconds is not None:
            told = f"{outcome} after {duration_text(self._job.seconds)}"
            self._line(told, *amounts(list(self._job.states.values())))

    def _line(self, *texts: str, at: datetime | None = None) -> None:
        names = [dataset.name for dataset in self._job.states]
        what = plain(names[0]) if len(names) == 1 else f"{len(names)} datasets"
        told = " | ".join(filter(None, texts))
        self._lines.write(f"{at or self._now():%H:%M:%S} packing {what}: {told}")


def _topics(state: PackProgress) -> str:
    first = islice(state.topics.items(), _LISTED)
    texts = [f"{plain(topic)} {count_text(*counts)}" for topic, counts in first]
    return _listed(texts, len(state.topics))


def _datasets(states: list[PackProgress]) -> str:
    in_work = [state for state in states if packed_share(state) not in (0, 1) or phase_text(state)]
    texts = [
        f"{plain(one.dataset.name)} {phase_text(one) or percent_text(packed_share(one))}".rstrip()
        for one in in_work[:_LISTED]
    ]
    return _listed(texts, len(in_work))


def _listed(texts: list[str], count: int) -> str:
    more = count - len(texts)
    return ", ".join(texts) + (f" and {more} more" if more else "")


# ---------------------------------------------------------------- progress

_TICK_SECONDS = 1.0

Take = Callable[["PackProgress"], None]


@contextmanager
def pack_progress(as_json: bool, *, whole: bool = True) -> Iterator[Take]:
    """Tell of the progress of packs while the context lasts, on stderr.

    Args:
        as_json: By events for programs.
        whole: Whether this run is to do all of the job; of a share, the time left is not shown.

    Yields:
        What takes the progress, several times a second.
    """
    stream = sys.stderr
    if is_quiet() and not as_json:
        yield lambda _: None
        return
    if not as_json and stream.isatty():
        from rich.console import Console

        console = Console(stderr=True)
        if not console.is_dumb_terminal:
            with on_terminal(console, whole=whole) as take:
                yield take
            return
    job = PackState(whole=whole)
    teller = (Events if as_json else Log)(job, Lines(stream))
    with progress_to(teller, tick_seconds=_TICK_SECONDS) as take:
        yield take


@contextmanager
def on_terminal(console: Console, *, whole: bool = True) -> Iterator[Take]:
    """Show bars while the context lasts: of all, and of each camera or dataset."""
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = [
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=20),
        TaskProgressColumn(),
        TextColumn("{task.fields[told]}", markup=False),
    ]
    job = PackState(whole=False)
    with Progress(
        *columns,
        *([TimeRemainingColumn()] if whole else []),
        console=console,
        transient=True,
        speed_estimate_period=PACE_SECONDS,
        refresh_per_second=2,
    ) as bars:
        rows: dict[object, Any] = {}

        def show(key: object, name: str, share: float | None, told: str) -> None:
            if key not in rows:
                rows[key] = bars.add_task(name, total=None, completed=share or 0, told=told)  # type: ignore[arg-type]
            total = None if share is None else 1.0
            bars.update(rows[key], description=name, total=total, completed=share, told=told)

        def take(state: PackProgress) -> None:
            job.take(state)
            states = list(job.states.values())
            name = f"packing {len(states)} datasets"
            if len(states) == 1:
                name = phase_text(state) or f"packing {plain(state.dataset.name)}"
            show(None, name, job.share, "  ".join(amounts(states)))
            if len(states) > 1:
                for one in states:
                    told = "  ".join(filter(None, (phase_text(one), *amounts([one]))))
                    show(one.dataset, f"  {plain(one.dataset.name)}", packed_share(one), told)
                return
            for topic, (done, total) in state.topics.items():
                share = min(1.0, done / total) if total else None
                show(topic, f"  {plain(topic)}", share, count_text(done, total))

        yield take


class ProgressWriter(Protocol):
    """Tells of a job in lines."""

    def take(self, state: PackProgress) -> None:
        """Take a report, and show it if one is due."""

    def tick(self) -> None:
        """Tell what is due though nothing is heard."""

    def end(self, outcome: str) -> None:
        """Tell that it is over."""


@contextmanager
def progress_to(teller: ProgressWriter, *, tick_seconds: float) -> Iterator[Take]:
    """Let a job be told of while the context lasts, on from silence to its end."""
    lock, stop = threading.Lock(), threading.Event()

    def take(state: PackProgress) -> None:
        with lock:
            teller.take(state)

    def tick() -> None:
        while not stop.wait(tick_seconds):
            with lock:
                teller.tick()

    thread = threading.Thread(target=tick, name="progress", daemon=True)
    thread.start()
    outcome = "done"
    try:
        yield take
    except (KeyboardInterrupt, SystemExit):
        outcome = "interrupted"
        raise
    except BaseException:
        outcome = "failed"
        raise
    finally:
        stop.set()
        thread.join()
        teller.end(outcome)


# ---------------------------------------------------------------- other commands

_LINE_PAUSE = 10.0  # seconds
_SURE_SECONDS = 2.0  # from when on the time left is shown


class ProgressCallback(Protocol):
    """What takes the progress of a command."""

    def __call__(self, what: str, share: float | None = None) -> None:
        """Tell what is being done, and the share of all that is done, 0 to 1, where it is known."""


@contextmanager
def progress_of(doing: str, as_json: bool) -> Iterator[ProgressCallback | None]:
    """Tell of the progress of a command while the context lasts.

    On a terminal a bar with percent and time left, once a share is known; else a line every 10 s.

    Args:
        doing: Such as ``validating``.
        as_json: Tell nothing.
    """
    if as_json or is_quiet():
        yield None
        return
    if sys.stderr.isatty():
        from rich.console import Console

        console = Console(stderr=True)
        if not console.is_dumb_terminal:
            with _bar(console, doing) as tell:
                yield tell
            return
    yield LogOf(doing, Lines(sys.stderr))


@contextmanager
def _bar(console: Console, doing: str) -> Iterator[ProgressCallback]:
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = [
        TextColumn(doing, markup=False),
        BarColumn(bar_width=20),
        TextColumn("{task.fields[percent]}", markup=False),
        TimeRemainingColumn(),
        # of a plain string, what a topic is called would be taken for markup
        TextColumn("{task.fields[told]}", markup=False),
    ]
    with Progress(
        *columns, console=console, transient=True, speed_estimate_period=PACE_SECONDS
    ) as bar:
        task = bar.add_task("", total=None, told="", percent="")

        def tell(what: str, share: float | None = None) -> None:
            bar.update(task, told=shown(what))
            if share is not None:
                bar.update(task, total=1.0, completed=share, percent=percent_text(share))

        yield tell


class LogOf:
    """Writes a line every 10 s.

    Args:
        doing: What is done.
        lines: Take the lines.
        clock: Seconds; does not go back.
    """

    def __init__(
        self, doing: str, lines: Lines, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._doing = doing
        self._lines = lines
        self._clock = clock
        self._began = self._told = clock()
        self._share: float | None = None

    def __call__(self, what: str, share: float | None = None) -> None:
        """See `ProgressCallback`."""
        now = self._clock()
        self._share = self._share if share is None else share
        if now - self._told < _LINE_PAUSE:
            return
        self._told = now
        left = None
        if self._share and now - self._began >= _SURE_SECONDS:
            left = (now - self._began) * (1 - self._share) / self._share
        texts = [plain(what), percent_text(self._share), left_text(left)]
        told = " | ".join(filter(None, texts))
        self._lines.write(f"{datetime.now():%H:%M:%S} {self._doing}: {told}")
