"""The progress of packs on a terminal."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import islice
from typing import TYPE_CHECKING

from rich.cells import cell_len, set_cell_size
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from mp4ds.cli.output import shown, size_text
from mp4ds.cli.progress_log import (
    bytes_text,
    count_text,
    left_text,
    parts_text,
    percent_text,
    phase_text,
    rate_text,
)
from mp4ds.cli.standing import DatasetStanding, JobStanding

if TYPE_CHECKING:
    from mp4ds.packing import PackProgress

_DRAWN_A_SECOND = 2.0
_LEAST_BAR = 12
_LEAST_NAME = 12
_MARGINS = 4  # cells beside a name


@contextmanager
def live_progress(
    job: JobStanding, console: Console, *, clock: Callable[[], float] = time.monotonic
) -> Iterator[Callable[[PackProgress], None]]:
    """Show a job while the context lasts.

    Args:
        job: Where it stands.
        console: Where to show it.
        clock: Seconds; does not go back.

    Yields:
        What takes the progress.
    """
    lock = threading.Lock()

    def take(state: PackProgress) -> None:
        with lock:
            job.take(state, clock())

    def draw() -> RenderableType:
        with lock:
            return drawn(job, console.width, console.height, clock())

    with Live(
        get_renderable=draw,
        console=console,
        refresh_per_second=_DRAWN_A_SECOND,
        transient=True,
    ):
        yield take


def drawn(job: JobStanding, width: int, height: int, now: float) -> RenderableType:
    """A picture of where a job stands: a line of all, and one for each topic or dataset.

    Args:
        job: Where it stands.
        width: Of the terminal, cells.
        height: Of the terminal, lines; the picture is lower than that.
        now: Seconds of the clock by which `job` was told.
    """
    datasets = list(job.datasets)
    if not datasets:
        return Text("reading", no_wrap=True)
    details = _details(job, now)
    left = left_text(job.seconds_left(now))
    heading = _heading(job)
    used = sum(cell_len(text) + 1 for text in (heading, "100 %", details, left))
    is_wide = width - used > _LEAST_BAR
    line = Table.grid(padding=(0, 1), expand=True)
    line.add_column(no_wrap=True, overflow="ellipsis", max_width=width // 3)
    line.add_column(ratio=1)
    texts = [percent_text(_share(job)), *([details] if is_wide else []), left]
    for _ in texts:
        line.add_column(no_wrap=True)
    line.add_row(Text(heading), _bar(job), *map(Text, texts))
    rows = [] if is_wide else [f"  {details}"]
    room = max(0, height - 2 - len(rows))
    if len(datasets) == 1:
        rows += _topic_rows(datasets[0], width, room, now)
    else:
        rows += _dataset_rows(job.in_work, width, room, now)
    below = Text("\n".join(rows), no_wrap=True, overflow="ellipsis")
    return Group(line, below) if rows else line


def _heading(job: JobStanding) -> str:
    datasets = list(job.datasets)
    if len(datasets) == 1:
        return phase_text(datasets[0]) or "packing"
    finished = sum(one.is_finished for one in datasets)
    joining = f", {phase_text(job.joining)}" if job.joining else ""
    return f"packing {finished}/{len(datasets)} datasets{joining}"


def _share(job: JobStanding) -> float | None:
    """What the bar shows: the phase of a dataset, or the packing of several."""
    datasets = list(job.datasets)
    if len(datasets) == 1 and datasets[0].state.phase != "packing":
        return datasets[0].phase_share
    return job.share


def _bar(job: JobStanding) -> ProgressBar:
    share = _share(job)
    return ProgressBar(total=1.0, completed=share or 0.0, pulse=share is None)


def _details(job: JobStanding, now: float) -> str:
    datasets = list(job.datasets)
    rates = [one.byte_rate(now) for one in job.in_work]
    known = [rate for rate in rates if rate is not None]
    rate = f"{size_text(sum(known))}/s" if known else ""
    return "  ".join(filter(None, (parts_text(datasets), bytes_text(datasets), rate)))


def _topic_rows(one: DatasetStanding, width: int, room: int, now: float) -> list[str]:
    rates = one.topic_rates(now)
    fitting = _fitting(len(one.state.topics), room)
    counts = list(one.state.topics.values())
    texts = [
        (shown(topic), count_text(*count), rate_text(rates[topic]))
        for topic, count in islice(one.state.topics.items(), fitting)
    ]
    if fitting < len(counts) and room:
        hidden = counts[fitting:]
        totals = [total for _, total in hidden if total is not None]
        total = sum(totals) if len(totals) == len(hidden) else None
        rest = count_text(sum(done for done, _ in hidden), total)
        texts.append((f"and {len(hidden)} more topics", rest, ""))
    widest = max((len(count) for _, count, _ in texts), default=0)
    return _aligned([(name, f"{count:>{widest}}  {rate:>7}") for name, count, rate in texts], width)


def _dataset_rows(in_work: list[DatasetStanding], width: int, room: int, now: float) -> list[str]:
    fitting = _fitting(len(in_work), room)
    rows = []
    for one in in_work[:fitting]:
        rate = one.byte_rate(now)
        speed = f"{size_text(rate)}/s" if rate is not None else ""
        told = phase_text(one) or percent_text(one.packed)
        texts = (f"{told:>5}", parts_text([one]), bytes_text([one]), speed)
        rows.append((shown(one.state.dataset.name), "  ".join(filter(None, texts))))
    if fitting < len(in_work) and room:
        rows.append((f"and {len(in_work) - fitting} more in work", ""))
    return _aligned(rows, width)


def _fitting(count: int, room: int) -> int:
    """How many of some rows are shown: all, or as many as leave room for one about the rest."""
    return count if count <= room else max(0, room - 1)


def _aligned(rows: list[tuple[str, str]], width: int) -> list[str]:
    """Rows of a name and numbers; names are cut where the terminal is too narrow."""
    widest = max((cell_len(name) for name, _ in rows), default=0)
    numbers = max((len(text) for _, text in rows), default=0)
    cells = max(_LEAST_NAME, min(widest, width - numbers - _MARGINS))
    return [f"  {set_cell_size(name, cells)}  {text}" for name, text in rows]
