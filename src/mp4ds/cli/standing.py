"""Where a job of one or several packs stands, and how that is said."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from mp4ds.cli.output import shown, size_text

if TYPE_CHECKING:
    from rich.progress import Progress

    from mp4ds.packing import PackProgress

PACE_SECONDS = 60.0
"""Over which a pace is taken."""

_LEFT_SECONDS = 3.0
_NAME_WIDTH = 60
_ROUNDING = 1e-6


class Job:
    """Where one or several packs stand.

    Args:
        whole: As for `pack_progress`.
        clock: Seconds; does not go back.

    Attributes:
        states: What was told last of each dataset, in the order in which they began.
    """

    def __init__(self, *, whole: bool = True, clock: Callable[[], float] = time.monotonic) -> None:
        self.states: dict[Path, PackProgress] = {}
        self.clock = clock
        self._whole = whole
        self._began: float | None = None
        self._pace: Progress | None = None

    @property
    def seconds(self) -> float | None:
        """Since it began; None before."""
        return None if self._began is None else self.clock() - self._began

    @property
    def share(self) -> float | None:
        """Share of it that is packed, by bytes of the sources; None where nothing tells."""
        total = packed = 0.0
        for state in self.states.values():
            share, weight = packed_share(state), max(1.0, state.bytes_total)
            if share is None:
                return None
            total, packed = total + weight, packed + weight * share
        return packed / total if total else None

    def take(self, state: PackProgress) -> None:
        """Take what is told."""
        if self._began is None:
            self._began = self.clock()
        self.states[state.dataset] = state
        share = self.share
        # a short pack ends before this needs rich
        if share is None or not self._whole or self.clock() - self._began < _LEFT_SECONDS:
            return
        if self._pace is None:
            from rich.progress import Progress

            # never shown: it is here for what it knows of time
            self._pace = Progress(get_time=self.clock, speed_estimate_period=PACE_SECONDS)
            self._pace.add_task("", total=1.0, completed=share)  # type: ignore[arg-type]
        self._pace.update(self._pace.task_ids[0], completed=share)

    @property
    def seconds_left(self) -> int | None:
        """Until all is packed, by the pace of the last minute; None while too little is known."""
        left = self._pace.tasks[0].time_remaining if self._pace else None
        return None if left is None else int(left)


def packed_share(state: PackProgress) -> float | None:
    """Share of a dataset that is packed, 0 to 1; None where nothing tells."""
    if state.phase == "planning":
        return 0.0
    if state.phase != "packing":
        return 1.0
    if state.done is not None:
        return min(1.0, max(0.0, state.done))
    return min(1.0, state.tasks_done / state.tasks_total) if state.tasks_total else None


def plain(value: object) -> str:
    """A name in ASCII that fits into a line and steers no terminal."""
    text = shown(value).encode("ascii", "backslashreplace").decode()
    return text if len(text) <= _NAME_WIDTH else "..." + text[3 - _NAME_WIDTH :]


def percent_text(share: float | None) -> str:
    """A share in percent, never 100 before all is done; empty where it is not known."""
    return "" if share is None else f"{int(100 * share + _ROUNDING)} %"


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
    return f"{duration_text(seconds)} left" if seconds else ""


def count_text(done: int, total: int | None) -> str:
    """So many of so many, if that is known."""
    return str(done) if total is None else f"{done}/{total}"


def amounts(states: list[PackProgress]) -> list[str]:
    """Parts done and in all, if there are any, and bytes read and written."""
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
    """What is being done with a dataset, where it is not just packed."""
    return "" if state.phase == "packing" else f"{state.phase} {plain(state.note)}".strip()
