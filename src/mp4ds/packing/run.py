"""One recording being packed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mp4ds import errors
from mp4ds.errors import PartsFailedError
from mp4ds.packing.job import Job, Task, absolute
from mp4ds.packing.workplace import Workplace


@dataclass
class Run:
    """One recording being packed by tasks.

    Attributes:
        job: What is to be done.
        place: Where its parts are made.
        paths: What is to be packed, as it was given.
        target: The dataset.
        force: Replace an existing dataset.
        is_new: Whether the job was planned just now.
        failures: Name and sentence of each task that failed.
        exit_code: What the first of them asks for.
    """

    job: Job
    place: Workplace
    paths: Sequence[Path]
    target: Path
    force: bool
    is_new: bool
    failures: list[tuple[str, str]] = field(default_factory=list)
    exit_code: int = 1

    def begin(self, options: dict[str, object], *, anew: bool, alone: bool) -> None:
        """Take the place over; it is held.

        Args:
            options: Those that decide what comes out.
            anew: Forget what is there.
            alone: Nobody else is at work there.

        Raises:
            OptionError: An unfinished pack with other options is there.
            SourceError: The recording has changed since.
        """
        if anew and alone:
            self.place.clear()
        if self.is_new:
            self.job = self.place.begin(self.job)
        self.place.check(self.job, options, absolute(self.paths))
        if alone:
            self.place.sweep()

    @property
    def missing(self) -> list[Task]:
        """The tasks whose results are not there."""
        return [task for task in self.job.tasks if not self.place.is_done(task)]

    def fail(self, name: str, kind: str, sentence: str) -> None:
        """Take notice of a task that failed."""
        if not self.failures:
            self.exit_code = getattr(getattr(errors, kind, None), "exit_code", 1)
        self.failures.append((name, sentence))

    def raise_failures(self) -> None:
        """Report the tasks that failed.

        Raises:
            PartsFailedError: There are some.
        """
        if self.failures:
            raise PartsFailedError(self.target, self.failures, len(self.job.tasks), self.exit_code)
