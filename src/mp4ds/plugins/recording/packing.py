"""A process of low priority that packs what is recorded while the recording goes on."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

from mp4ds.errors import Mp4dsError
from mp4ds.format.sidecars import load_about
from mp4ds.packing.pack import pack
from mp4ds.packing.processes import CallError, ProcessExecutor
from mp4ds.packing.spool import SpoolFolder

_NICE = 10


class PackingError(Mp4dsError):
    """A piece could not be packed, or parts could not be joined; all are still there."""


class PackingProcess:
    """Packs one piece at a time, in a process of low priority. A context manager."""

    def __init__(self) -> None:
        self._executor = ProcessExecutor(1, nice=_NICE)
        self._thread = ThreadPoolExecutor(1, "packing")
        self._jobs: list[Future[None]] = []

    def submit(self, job: Callable[[], None]) -> None:
        """Run a job that packs or joins, after all earlier ones, in another thread."""
        self._jobs.append(self._thread.submit(job))

    def wait(self, seconds: float) -> bool:
        """Wait until all jobs have run; returns whether they have."""
        return not wait(self._jobs, seconds).not_done

    def __enter__(self) -> PackingProcess:
        return self

    def __exit__(self, exc_type: type[BaseException] | None, *_: object) -> None:
        if exc_type is not None:
            self._thread.shutdown(wait=False, cancel_futures=True)
            self._executor.shutdown(cancel_futures=True)  # in the middle of a piece
        self._thread.shutdown()
        self._executor.shutdown()

    def pack(self, folder: Path, number: int) -> None:
        """Make the part of a piece, which is then removed.

        Raises:
            PackingError: It failed.
        """
        self._call(_pack, folder, number)

    def join(
        self, folder: Path, count: int, target: Path, *, force: bool, about: str | None
    ) -> None:
        """Make the dataset of all parts.

        Args:
            folder: The folder.
            count: How many parts there are.
            target: The dataset.
            force: Replace an existing one.
            about: A file that describes the recording.

        Raises:
            PackingError: It failed.
        """
        self._call(_join, folder, count, target, force, about)

    def _call(self, function: Callable[..., None], *args: Any) -> None:
        try:
            self._executor.submit(function, *args).result()
        except (CallError, CancelledError, OSError) as error:
            raise PackingError(str(error)) from None


# ---------------------------------------------------------------- in the process


def _pack(folder: Path, number: int) -> None:
    spool = SpoolFolder(folder)
    with spool.locked(shared=True):
        spool.pack(number, pack)


def _join(folder: Path, count: int, target: Path, force: bool, about: str | None) -> None:
    spool = SpoolFolder(folder)
    told = load_about(about) if about is not None else None
    with spool.locked(shared=True):
        spool.join(count, target, force=force, about=told)
