"""The progress of packs in plain lines, for log files."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from itertools import islice
from typing import TYPE_CHECKING, TextIO

from mp4ds.cli.output import shown, size_text
from mp4ds.cli.standing import DatasetStanding, JobStanding

if TYPE_CHECKING:
    from mp4ds.packing import PackProgress

_LONG_SECONDS = 10.0
_LINE_SECONDS, _LINE_SECONDS_MOST, _LINE_GROWTH = 60.0, 600.0, 0.05
_LINE_SHARE = 0.05
_LISTED = 20
_NAME_WIDTH = 60
_ROUNDING = 1e-6


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


@dataclass
class Log:
    """Tells of a long job by plain lines: of its beginning, its end, and now and then.

    The first comes after 10 s. Others follow when a minute went by, later a twentieth of the
    time since the beginning, at most ten minutes; and at each 5 % of the job.

    Args:
        job: Where it stands.
        lines: Take the lines.
        clock: Seconds; does not go back.
        now: The local time of day.
    """

    job: JobStanding
    lines: Lines
    clock: Callable[[], float] = field(default=time.monotonic, kw_only=True)
    now: Callable[[], datetime] = field(default=datetime.now, kw_only=True)
    _began: float | None = None
    _told: float | None = None
    _share: float = 0.0

    def take(self, state: PackProgress) -> None:
        """See `Teller.take`."""
        clock = self.clock()
        if self._began is None:
            self._began = clock
        self.job.take(state, clock)
        self._tell_if_due(clock)

    def tick(self) -> None:
        """See `Teller.tick`."""
        self._tell_if_due(self.clock())

    def end(self, outcome: str) -> None:
        """See `Teller.end`."""
        if self._told is None or self._began is None:
            return
        seconds = self.clock() - self._began
        datasets = list(self.job.datasets)
        told = f"{outcome} after {duration_text(seconds)}"
        self._line(told, parts_text(datasets), bytes_text(datasets))

    def _tell_if_due(self, clock: float) -> None:
        if self._began is None or clock - self._began < _LONG_SECONDS:
            return
        share = self.job.share or 0.0
        if self._told is None:
            self._tell_start(clock - self._began)
        elif not self._is_due(clock, self._told, share):
            return
        self._told, self._share = clock, share
        self._line(*_standing(self.job, clock))

    def _is_due(self, clock: float, told: float, share: float) -> bool:
        long = clock - told >= _LONG_SECONDS and share - self._share >= _LINE_SHARE
        growing = max(_LINE_SECONDS, _LINE_GROWTH * (told - (self._began or 0.0)))
        return long or clock - told >= min(_LINE_SECONDS_MOST, growing)

    def _tell_start(self, seconds: float) -> None:
        began = self.now() - timedelta(seconds=seconds)
        total = sum(one.state.bytes_total for one in self.job.datasets)
        before = sum(one.state.tasks_before for one in self.job.datasets)
        again = f"{before} parts were done before" if before else ""
        self._line(f"started {began:%Y-%m-%d}", f"{size_text(total)} to pack", again, at=began)

    def _line(self, *texts: str, at: datetime | None = None) -> None:
        names = [one.state.dataset.name for one in self.job.datasets]
        what = plain(names[0]) if len(names) == 1 else f"{len(names)} datasets"
        told = " | ".join(filter(None, texts))
        self.lines.write(f"{at or self.now():%H:%M:%S} packing {what}: {told}")


def plain(value: object) -> str:
    """A name in ASCII that fits into a line and steers no terminal."""
    text = shown(value).encode("ascii", "backslashreplace").decode()
    return text if len(text) <= _NAME_WIDTH else "..." + text[3 - _NAME_WIDTH :]


def percent_text(share: float | None) -> str:
    """A share in percent, never 100 before all is done; empty where it is not known."""
    return "" if share is None else f"{int(100 * share + _ROUNDING)} %"


def rate_text(rate: float | None) -> str:
    """A rate in Hz; empty where it is not known."""
    return "" if rate is None else f"{rate:.0f} Hz" if rate >= 10 else f"{rate:.1f} Hz"


def duration_text(seconds: float) -> str:
    """A duration in the largest two units that say something."""
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
    """The time left; empty where it is not known, or no time."""
    return "" if seconds is None or seconds < 0.5 else f"{duration_text(seconds)} left"


def count_text(done: int, total: int | None) -> str:
    """So many of so many, if that is known."""
    return str(done) if total is None else f"{done}/{total}"


def parts_text(datasets: Iterable[DatasetStanding]) -> str:
    """Parts done and in all, and those that failed; empty where there are none."""
    states = [one.state for one in datasets]
    total, failed = sum(s.tasks_total for s in states), sum(s.failed for s in states)
    if not total:
        return ""
    done = sum(state.tasks_done for state in states)
    return f"parts {done}/{total}" + (f", {failed} failed" if failed else "")


def bytes_text(datasets: Iterable[DatasetStanding]) -> str:
    """Bytes read and written."""
    states = [one.state for one in datasets]
    read, written = sum(s.bytes_read for s in states), sum(s.bytes_written for s in states)
    return f"{size_text(read)} -> {size_text(written)}"


def phase_text(one: DatasetStanding) -> str:
    """What is being done with a dataset, where it is not just packed."""
    if one.state.phase == "packing":
        return ""
    return f"{one.state.phase} {plain(one.state.note)}".strip()


def _topics(one: DatasetStanding, clock: float) -> str:
    rates = one.topic_rates(clock)
    texts = [
        f"{plain(topic)} {count_text(*counts)} {rate_text(rates[topic])}".rstrip()
        for topic, counts in islice(one.state.topics.items(), _LISTED)
    ]
    return _listed(texts, len(one.state.topics))


def _datasets(in_work: list[DatasetStanding]) -> str:
    texts = [
        f"{plain(one.state.dataset.name)} {phase_text(one) or percent_text(one.packed)}".rstrip()
        for one in in_work[:_LISTED]
    ]
    return _listed(texts, len(in_work))


def _listed(texts: list[str], count: int) -> str:
    more = count - len(texts)
    return ", ".join(texts) + (f" and {more} more" if more else "")


def _standing(job: JobStanding, clock: float) -> list[str]:
    """Where a job stands, in parts of a line."""
    datasets = list(job.datasets)
    if len(datasets) == 1:
        (one,) = datasets
        texts = [phase_text(one) or percent_text(job.share), parts_text(datasets)]
        texts.append(_topics(one, clock))
    else:
        texts = [percent_text(job.share), parts_text(datasets), _datasets(job.in_work)]
    return [*texts, bytes_text(datasets), left_text(job.seconds_left(clock))]
