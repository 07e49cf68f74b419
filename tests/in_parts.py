"""Recordings packed in parts, within the tests' own process, and what to compare of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from mp4ds.errors import Mp4dsError
from mp4ds.format.sidecars import MANIFEST_NAME, load_manifest, load_stream
from mp4ds.packing.engine import Outcome
from mp4ds.packing.work import run_task


class InlineEngine:
    """Runs tasks one after the other; see `mp4ds.packing.engine.Engine`.

    Args:
        fails: Whether a task is to fail, by its name.
    """

    def __init__(self, fails: Callable[[str], bool] = lambda _: False) -> None:
        self.ran: list[str] = []
        self._fails = fails

    def run(
        self,
        tasks: Sequence[tuple[str, ...]],
        on_progress: Callable[[tuple[str, ...], dict[str, Any]], None],
    ) -> Iterator[Outcome]:
        for task in tasks:
            folder, name = task
            if self._fails(name):
                yield Outcome(task, ("WriteError", "the disk is full"))
                continue
            self.ran.append(name)
            try:
                run_task(folder, name, lambda told, task=task: on_progress(task, told))
            except (Mp4dsError, OSError) as error:
                yield Outcome(task, (type(error).__name__, str(error)))
            else:
                yield Outcome(task)


def facts(dataset: Path) -> dict[str, Any]:
    """All that two packs of the same images have in common, however they were divided."""
    manifest = load_manifest(dataset / MANIFEST_NAME)
    found: dict[str, Any] = manifest.model_dump(exclude={"files", "streams", "tools"})
    found["streams"] = {}
    for entry in manifest.streams:
        sidecar = load_stream(dataset / entry.sidecar)
        values = sidecar.model_dump()
        for fact in ("size", "sha256"):
            del values["video"][fact]
        found["streams"][entry.sidecar] = values
    return found


def leftovers(folder: Path) -> list[str]:
    """Names of what no finished pack leaves beside its dataset."""
    return sorted(path.name for path in folder.iterdir() if path.name.startswith("."))
