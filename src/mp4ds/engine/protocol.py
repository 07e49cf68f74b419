"""What runs tasks, whatever machines it runs them on."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a task ended.

    Attributes:
        task: Its arguments.
        error: Class name and sentence of what it failed with; None where it was done.
        facts: What it told at its end.
    """

    task: tuple[str, ...]
    error: tuple[str, str] | None = None
    facts: dict[str, Any] = field(default_factory=dict)


class Engine(Protocol):
    """Runs tasks. Each is a call of one function of which engines know nothing.

    The function takes the task's arguments, is idempotent, and leaves its result on the disk;
    so a task may be run again, or twice at once, and no result passes through the engine.
    """

    def run(
        self,
        tasks: Sequence[tuple[str, ...]],
        on_progress: Callable[[tuple[str, ...], dict[str, Any]], None],
    ) -> Generator[Outcome, None, None]:
        """Run tasks, in any order, several at a time.

        Args:
            tasks: Arguments of each, distinct.
            on_progress: Called with what a running task tells, where the engine hears it.

        Yields:
            The outcome of each task, as they end. Closing the generator ends what still runs.
        """
        ...
