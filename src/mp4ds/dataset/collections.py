"""Many datasets: found below a folder or by a pattern, and processed in parallel."""

from __future__ import annotations

import glob
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from typing import TypeVar

from mp4ds.errors import Mp4dsError, SourceError, SourceNotFoundError
from mp4ds.files.sources import refuse_unfinished
from mp4ds.files.urls import RemotePath, location
from mp4ds.format.sidecars import MANIFEST_NAME

_Item = TypeVar("_Item")
_Made = TypeVar("_Made")

TIDY_S = 20.0
"""Seconds that a process has to end, on its parent's word."""

Paths = str | Path | Sequence[str | Path]
"""A path or several."""


def datasets_in(paths: Paths) -> list[Path]:
    """The datasets given by paths, in the same order.

    Args:
        paths: Datasets, sidecars, videos; folders of datasets, at any depth; patterns such as
            ``drives/*``; or URLs, but not URL patterns.

    Raises:
        SourceNotFoundError: A path does not exist, or a pattern matches nothing.
        SourceError: A folder has no dataset in it or below it.
    """
    several = [paths] if isinstance(paths, (str, Path, RemotePath)) else paths
    return [dataset for path in several for dataset in _datasets_at(location(path))]


def _datasets_at(path: Path) -> list[Path]:
    if path.exists():
        return _below(path)
    # Path.glob takes no absolute patterns
    matches = sorted(glob.glob(str(path))) if glob.has_magic(str(path)) else []  # noqa: PTH207
    folders = [Path(match) for match in matches if Path(match).is_dir()]
    if not folders:
        raise SourceNotFoundError(path)
    found: list[Path] = []
    for folder in folders:
        try:
            found += _below(folder)
        except SourceError:
            continue  # a pattern matches other folders, too
    if not found:
        raise SourceError(path, "matches no dataset", "Give folders made by `mp4ds pack`.")
    return found


def _below(path: Path) -> list[Path]:
    if path.name == MANIFEST_NAME:
        return [path.parent]
    if not path.is_dir() or (path / MANIFEST_NAME).is_file():
        return [path]
    refuse_unfinished(path)
    found = sorted(manifest.parent for manifest in path.rglob(MANIFEST_NAME))
    # names that begin with a dot are being made
    found = [one for one in found if not _is_hidden(one, path)]
    if not found:
        raise SourceError(
            path,
            f"holds no dataset: there is no {MANIFEST_NAME} in it or below it",
            "Give a folder made by `mp4ds pack`.",
        )
    return found


def _is_hidden(dataset: Path, folder: Path) -> bool:
    if isinstance(dataset, RemotePath):
        return False
    return any(part.startswith(".") for part in dataset.relative_to(folder).parts)


def each(
    work: Callable[[_Item], _Made], items: Sequence[_Item], jobs: int | None = 1
) -> Iterator[tuple[_Item, _Made]]:
    """Process items in parallel.

    Args:
        work: A function that other processes can import, with picklable arguments.
        items: Its arguments.
        jobs: Number of processes; if 1, this one; None for one per core.

    Yields:
        Each item with its result, in order.

    Raises:
        Mp4dsError: A process died, perhaps out of memory; otherwise whatever the work raises.
    """
    workers = min(jobs or available_cores(), len(items))
    if workers < 2:
        for item in items:
            yield item, work(item)
        return
    before = set(multiprocessing.active_children())
    with ProcessPoolExecutor(
        workers, multiprocessing.get_context("spawn"), initializer=_leave_to_parent
    ) as pool:
        try:
            yield from zip(items, pool.map(partial(_worked, work), items), strict=True)
        except BrokenProcessPool:
            raise Mp4dsError(
                "A worker process died, perhaps out of memory. Try fewer `jobs`."
            ) from None
        except BaseException:  # nobody waits for work in progress
            processes = set(multiprocessing.active_children()) - before
            for process in processes:
                process.terminate()
            for process in processes:
                process.join(TIDY_S)
                process.kill()  # one that has not ended would be waited for without end
            pool.shutdown(cancel_futures=True)
            raise


def available_cores() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _leave_to_parent() -> None:
    """Let the parent handle Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _worked(work: Callable[[_Item], _Made], item: _Item) -> _Made:
    """Work, and tidy up if the parent's word to end comes meanwhile.

    Where the pool itself is at work, ending is left to the system: the pool would take what a
    handler raises for a result that cannot be sent, and go on.
    """
    try:
        signal.signal(signal.SIGTERM, _end)
        try:
            return work(item)
        finally:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
    except SystemExit as ended:
        os._exit(int(ended.code or 0))


def _end(number: int, _: object) -> None:
    signal.signal(number, signal.SIG_IGN)  # the pool sends it, too, when another process has died
    sys.exit(128 + number)
