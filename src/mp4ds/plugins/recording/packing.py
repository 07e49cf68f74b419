"""A process of low priority that packs what is recorded while the recording goes on.

``python -m mp4ds.plugins.recording.packing`` takes an order from each line of its standard input,
and answers with a line. If the input ends in the middle of an order, its recorder was killed.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from mp4ds.errors import Mp4dsError, sentence_of
from mp4ds.format.sidecars import load_about
from mp4ds.packing.engine import Orders, release_memory, tell
from mp4ds.packing.pack import pack
from mp4ds.packing.spool import SpoolFolder

_NICE = 10


class PackingError(Mp4dsError):
    """A piece could not be packed, or parts could not be joined; all are still there."""


class PackingProcess:
    """Carries out orders, one at a time, in a process of low priority. A context manager."""

    _ARGUMENTS = ("-m", "mp4ds.plugins.recording.packing")

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None
        self._thread = ThreadPoolExecutor(1, "packing")
        self._jobs: list[Future[None]] = []

    def submit(self, job: Callable[[], None]) -> None:
        """Run a job that gives orders after all earlier ones, in another thread."""
        self._jobs.append(self._thread.submit(job))

    def wait(self, seconds: float) -> bool:
        """Wait until all jobs have run; returns whether they have."""
        return not wait(self._jobs, seconds).not_done

    def __enter__(self) -> PackingProcess:
        return self

    def __exit__(self, exc_type: type[BaseException] | None, *_: object) -> None:
        if exc_type is not None:
            self._thread.shutdown(wait=False, cancel_futures=True)
            if self._process is not None:
                self._process.kill()  # in the middle of an order
        self._thread.shutdown()
        self._close()

    def pack(self, folder: Path, number: int) -> None:
        """Make the part of a piece, which is then removed.

        Raises:
            PackingError: It failed.
        """
        self._order("pack", str(folder), number)

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
        self._order("join", str(folder), count, str(target), force, about)

    def _order(self, *order: Any) -> None:
        if self._process is None:
            self._process = subprocess.Popen(
                [sys.executable, *self._ARGUMENTS],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                start_new_session=True,  # Ctrl-C is for the recorder
            )
        answer = ""
        with suppress(OSError):  # it has died, as its answer shows
            _pipe(self._process.stdin).write(json.dumps(order) + "\n")
            _pipe(self._process.stdin).flush()
            answer = _pipe(self._process.stdout).readline()
        if not answer:
            raise PackingError(f"the process that packs ended with code {self._close()}")
        if problem := json.loads(answer):
            raise PackingError(problem)

    def _close(self) -> int:
        """End it; returns its exit code."""
        process, self._process = self._process, None
        if process is None:
            return 0
        with suppress(OSError):  # where it has died before it read all
            _pipe(process.stdin).close()
        _pipe(process.stdout).close()
        return process.wait()


def _pipe(pipe: IO[str] | None) -> IO[str]:
    if pipe is None:
        raise OSError("no pipe")
    return pipe


# ---------------------------------------------------------------- the process


def _carry_out(kind: str, folder: str, number: int, *rest: Any) -> str:
    """Carry out an order; returns the sentence of its error, empty if there is none."""
    spool = SpoolFolder(Path(folder))
    try:
        with spool.locked(shared=True):
            if kind == "pack":
                spool.pack(number, pack)
            else:
                target, force, about = rest
                told = load_about(about) if about is not None else None
                spool.join(number, Path(target), force=force, about=told)
    except Mp4dsError as error:
        return str(error)
    except OSError as error:
        return sentence_of(error)
    return ""


def _main() -> None:
    if hasattr(os, "nice"):
        os.nice(_NICE)
    for order in Orders():
        problem = _carry_out(*order)
        release_memory()
        tell(problem)


if __name__ == "__main__":
    with suppress(BrokenPipeError):
        _main()
