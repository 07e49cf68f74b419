"""The progress of packs in lines: events for programs, and plain ones for log files."""

from __future__ import annotations

import json
from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from mp4ds.cli.output import size_text
from mp4ds.cli.standing import (
    Job,
    amounts,
    count_text,
    duration_text,
    left_text,
    packed_share,
    percent_text,
    phase_text,
    plain,
)

if TYPE_CHECKING:
    from mp4ds.packing import PackProgress

_EVENT_SECONDS, _SILENCE_SECONDS = 1.0, 10.0
_LONG_SECONDS = 10.0
_LINE_SECONDS, _LINE_SECONDS_MOST, _LINE_GROWTH = 60.0, 600.0, 0.05
_LISTED = 20


class Lines:
    """Writes lines, as long as anybody takes them: a pack does not fail for want of a log.

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
    """Tells of a job by events in JSON.

    Args:
        job: Where it stands.
        lines: Take the events.
        now: The time of day, with its zone.
    """

    def __init__(
        self,
        job: Job,
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
        """See `Teller.take`."""
        self._job.take(state)
        if self._last is None:
            self._write("start", dataset=str(state.dataset))
        self._last = self._waiting[state.dataset] = state
        self._tell_waiting(_EVENT_SECONDS)

    def tick(self) -> None:
        """See `Teller.tick`."""
        self._tell_waiting(_EVENT_SECONDS)
        if self._last and self._job.clock() - max(self._told.values()) >= _SILENCE_SECONDS:
            self._tell(self._last)

    def end(self, outcome: str) -> None:
        """See `Teller.end`."""
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
            # joining that does not tell how far it is keeps the whole share of packing
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
    """Tells of a long job by plain lines: of its beginning, its end, and now and then.

    The first comes after 10 s. Others follow when a minute went by, later a twentieth of the
    time since the beginning, at most ten minutes.

    Args:
        job: Where it stands.
        lines: Take the lines.
        now: The local time of day.
    """

    def __init__(
        self, job: Job, lines: Lines, *, now: Callable[[], datetime] = datetime.now
    ) -> None:
        self._job = job
        self._lines = lines
        self._now = now
        self._told: float | None = None

    def take(self, state: PackProgress) -> None:
        """See `Teller.take`."""
        self._job.take(state)
        self.tick()

    def tick(self) -> None:
        """See `Teller.tick`."""
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
                f"{before} parts were done before" if before else "",
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
        """See `Teller.end`."""
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
