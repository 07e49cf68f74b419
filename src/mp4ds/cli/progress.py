"""What `mp4ds pack` tells of its progress, always on stderr.

On a terminal bars; in a log file a line now and then, once a pack has taken 10 s; with ``--json``
one event per line, each a JSON object in ASCII:

``{"event": "start", "time": ..., "dataset": ...}``
    Before the first ``progress``. Nothing is told of a pack that fails before it begins.

``{"event": "progress", "time": ..., "dataset": ..., ...}``
    At most one a second of each dataset, every 10 s of the last one where nothing happens, and
    at the end whatever is newer than the last one told.

    ======================  ===============================================================
    ``time``                string, UTC, ISO 8601 with milliseconds
    ``dataset``             string, the folder being made
    ``phase``               ``"planning"``, ``"packing"``, ``"joining"`` or ``"uploading"``
    ``note``                string, what is being done now, or empty
    ``done``                number 0 to 1, share of this phase; null where nothing tells
    ``job_done``            number 0 to 1, share of the packing of all datasets; or null
    ``tasks_done``          integer, parts that are done
    ``tasks_total``         integer, parts that there are; 0 for a pack in one go
    ``tasks_before``        integer, parts of ``tasks_done`` that an earlier run did
    ``failed``              integer, parts that failed
    ``bytes_read``          integer, payload bytes packed so far
    ``bytes_total``         integer, bytes of the source files
    ``bytes_written``       integer, bytes of the dataset so far
    ``topics``              object: topic of a camera -> ``{"done": integer, "total": integer
                            or null}``, messages
    ``seconds_left``        integer, until all is packed; null where too little is known
    ======================  ===============================================================

``{"event": "end", "time": ..., "outcome": ..., "seconds": ...}``
    The last one: ``"done"``, ``"failed"`` or ``"interrupted"``, and how long it took.

Lines that do not begin with ``{`` are warnings and errors for people. Readers ignore events and
keys that they do not know.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Protocol

from mp4ds.cli.progress_lines import Events, Lines, Log
from mp4ds.cli.standing import (
    PACE_SECONDS,
    Job,
    amounts,
    count_text,
    packed_share,
    phase_text,
    plain,
)

if TYPE_CHECKING:
    from rich.console import Console

    from mp4ds.packing import PackProgress

_TICK_SECONDS = 1.0

Take = Callable[["PackProgress"], None]


@contextmanager
def pack_progress(as_json: bool, *, whole: bool = True) -> Iterator[Take]:
    """Tell of the progress of packs while the context lasts, on stderr.

    Args:
        as_json: By events for programs.
        whole: Whether this run is to do all of the job; no time left is told of a share of it.

    Yields:
        What takes the progress, several times a second.
    """
    stream = sys.stderr
    if not as_json and stream.isatty():
        from rich.console import Console

        console = Console(stderr=True)
        if not console.is_dumb_terminal:
            with on_terminal(console, whole=whole) as take:
                yield take
            return
    job = Job(whole=whole)
    teller = (Events if as_json else Log)(job, Lines(stream))
    with told_by(teller, tick_seconds=_TICK_SECONDS) as take:
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
    job = Job(whole=False)
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


class Teller(Protocol):
    """Tells of a job in lines."""

    def take(self, state: PackProgress) -> None:
        """Take what is told, and tell it if it is time to."""

    def tick(self) -> None:
        """Tell what is due though nothing is heard."""

    def end(self, outcome: str) -> None:
        """Tell that it is over."""


@contextmanager
def told_by(teller: Teller, *, tick_seconds: float) -> Iterator[Take]:
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
