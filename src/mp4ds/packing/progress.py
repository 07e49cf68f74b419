"""How far a divided pack has come."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from mp4ds.packing.job import Job
from mp4ds.packing.report import PackProgress

_REPORT_SECONDS = 0.1

Report = Callable[[PackProgress], None]


class JobProgress:
    """Adds up what tasks tell.

    Args:
        job: The job.
        target: The dataset.
        report: Told several times a second; None for nobody.
    """

    def __init__(self, job: Job, target: Path, report: Report | None) -> None:
        self._job = job
        self._target = target
        self._report = report
        self._told: dict[str, Mapping[str, tuple[int, int]]] = {}
        self._next = 0.0
        self._bytes_total = sum(source.size for source in job.sources)
        self._parts = sum(task.source is None for task in job.tasks)
        self._done: set[str] = set()
        self._before = 0
        self.failed = 0
        self.bytes_written = 0

    def heard(self, name: str, told: Mapping[str, Any]) -> None:
        """Take what a task tells of itself."""
        if "topics" in told:
            self._told[name] = told["topics"]
            self.report()

    def finished(self, name: str, topics: Mapping[str, tuple[int, int]], *, before: bool) -> None:
        """Take notice of a task that is done.

        Args:
            name: Of the task.
            topics: Messages and bytes of each of its topics.
            before: Whether an earlier run did it.
        """
        self._told[name] = topics
        self._done.add(name)
        self._before += before
        self.report()

    def report(self, phase: str = "packing", note: str = "", *, now: bool = False) -> None:
        """Tell where the pack stands, unless it was told just now."""
        clock = time.monotonic()
        if self._report is None or (clock < self._next and not now):
            return
        self._next = clock + _REPORT_SECONDS
        messages: dict[str, int] = {}
        size = 0
        for topics in self._told.values():
            for topic, (count, length) in topics.items():
                messages[topic] = messages.get(topic, 0) + count
                size += length
        self._report(
            PackProgress(
                dataset=self._target,
                phase=phase,
                done=self._share(messages),
                bytes_read=size,
                bytes_total=self._bytes_total,
                bytes_written=self.bytes_written,
                topics={
                    topic: (messages.get(topic, 0), self._job.work[topic][0])
                    for topic in self._job.cameras
                },
                tasks_done=len(self._done),
                tasks_total=self._parts,
                tasks_before=self._before,
                failed=self.failed,
                note=note,
            )
        )

    def _share(self, messages: Mapping[str, int]) -> float | None:
        work = self._job.work
        total = sum(count * cost for count, cost in work.values())
        if not total:
            return None
        return (
            sum(min(messages.get(t, 0), count) * cost for t, (count, cost) in work.items()) / total
        )
