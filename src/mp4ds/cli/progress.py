"""What `mp4ds pack` tells of its progress, always on stderr.

On a terminal a live display; in a log file a line now and then, once a pack has taken 10 s; with
``--json`` one event per line, each a JSON object in ASCII:

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
                            or null, "hz": number or null}``: messages, and messages a second
    ``seconds_left``        number, of the whole job; null where too little is known
    ======================  ===============================================================

``{"event": "end", "time": ..., "outcome": ..., "seconds": ...}``
    The last one: ``"done"``, ``"failed"`` or ``"interrupted"``, and how long it took.

Lines that do not begin with ``{`` are warnings and errors for people. Readers ignore events and
keys that they do not know.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from mp4ds.cli.progress_log import Lines, Log
from mp4ds.cli.standing import DatasetStanding, JobStanding

if TYPE_CHECKING:
    from mp4ds.packing import PackProgress

_EVENT_SECONDS, _SILENCE_SECONDS = 1.0, 10.0
_TICK_SECONDS = 1.0


@contextmanager
def pack_progress(as_json: bool, *, whole: bool = True) -> Iterator[Callable[[PackProgress], None]]:
    """Tell of the progress of packs while the context lasts, on stderr.

    Args:
        as_json: By events for programs.
        whole: Whether this run is to do all of the job; no time left is told of a share of it.

    Yields:
        What takes the progress, several times a second.
    """
    stream = sys.stderr
    job = JobStanding(whole=whole)
    if not as_json and stream.isatty():
        from rich.console import Console

        from mp4ds.cli.progress_live import live_progress

        console = Console(stderr=True)
        if not console.is_dumb_terminal:
            with live_progress(job, console) as take:
                yield take
            return
    teller = (Events if as_json else Log)(job, Lines(stream))
    with told_by(teller, tick_seconds=_TICK_SECONDS) as take:
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
def told_by(teller: Teller, *, tick_seconds: float) -> Iterator[Callable[[PackProgress], None]]:
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


class Events:
    """Tells of a job by events in JSON.

    Args:
        job: Where it stands.
        lines: Take the events.
        clock: Seconds; does not go back.
        now: The time of day, with its zone.
    """

    def __init__(
        self,
        job: JobStanding,
        lines: Lines,
        *,
        clock: Callable[[], float] = time.monotonic,
        now: Callable[[], datetime] = lambda: datetime.now(timezone.utc),
    ) -> None:
        self._job = job
        self._lines = lines
        self._clock = clock
        self._now = now
        self._began: float | None = None
        self._told: dict[Path, float] = {}
        self._waiting: dict[Path, DatasetStanding] = {}
        self._last: DatasetStanding | None = None

    def take(self, state: PackProgress) -> None:
        """See `Teller.take`."""
        clock = self._clock()
        self._job.take(state, clock)
        if self._began is None:
            self._began = clock
            self._write("start", dataset=str(state.dataset))
        self._last = self._job.dataset(state.dataset)
        told = self._told.get(state.dataset)
        if told is None or clock - told >= _EVENT_SECONDS:
            self._tell(self._last, clock)
        else:
            self._waiting[state.dataset] = self._last

    def tick(self) -> None:
        """See `Teller.tick`."""
        clock = self._clock()
        for dataset, one in list(self._waiting.items()):
            if clock - self._told[dataset] >= _EVENT_SECONDS:
                self._tell(one, clock)
        if self._last is not None and clock - max(self._told.values()) >= _SILENCE_SECONDS:
            self._tell(self._last, clock)

    def end(self, outcome: str) -> None:
        """See `Teller.end`."""
        if self._began is None:
            return
        clock = self._clock()
        for one in list(self._waiting.values()):
            self._tell(one, clock)
        self._write("end", outcome=outcome, seconds=round(clock - self._began, 3))

    def _tell(self, one: DatasetStanding, clock: float) -> None:
        state, left = one.state, self._job.seconds_left(clock)
        self._told[state.dataset] = clock
        self._waiting.pop(state.dataset, None)
        rates = one.topic_rates(clock)
        self._write(
            "progress",
            dataset=str(state.dataset),
            phase=state.phase,
            note=state.note,
            done=_rounded(one.phase_share, 6),
            job_done=_rounded(self._job.share, 6),
            tasks_done=state.tasks_done,
            tasks_total=state.tasks_total,
            tasks_before=state.tasks_before,
            failed=state.failed,
            bytes_read=state.bytes_read,
            bytes_total=state.bytes_total,
            bytes_written=state.bytes_written,
            topics={
                topic: {"done": done, "total": total, "hz": _rounded(rates[topic], 2)}
                for topic, (done, total) in state.topics.items()
            },
            seconds_left=_rounded(left, 1),
        )

    def _write(self, event: str, **values: Any) -> None:
        now = self._now().isoformat(timespec="milliseconds")
        self._lines.write(json.dumps({"event": event, "time": now, **values}))


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)
