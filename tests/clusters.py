"""Clusters on this machine's loopback, and the tasks that tests give to their workers.

Schedulers and workers are processes of Dask, started and ended by their number; workers import the
tasks from here. A task takes a folder and the name of its result, which is there whole or not at
all, as those of a pack are.
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import TracebackType

from distributed import Client

from waiting import WATCHDOG_S, until

HERE = Path(__file__).parent

WITH_NANNY = ("--nthreads", "1")
"""Arguments of a worker as Dask has it: another process that imports all starts it anew."""

_LOOPBACK = ("--host", "127.0.0.1", "--no-dashboard")

OTHER_VERSION = "import mp4ds._version\nmp4ds._version.__version__ = '0.0.1'\n"
"""A sitecustomize.py that makes a worker one of another mp4ds."""


class RealCluster:
    """A scheduler and its workers; a context manager that ends them.

    Args:
        folder: For what they write.
        workers: How many to start.
        arguments: More arguments of the workers.
        config: Values of Dask's configuration, as its environment has them.
        path: Where processes find modules, besides what is installed.
    """

    def __init__(
        self,
        folder: Path,
        *,
        workers: int = 2,
        arguments: tuple[str, ...] = ("--nthreads", "1", "--no-nanny"),
        config: dict[str, str] | None = None,
        path: Path = HERE,
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._environment = {**os.environ, "PYTHONPATH": str(path), **(config or {})}
        self._arguments = arguments
        self.workers: list[subprocess.Popen[bytes]] = []
        file = folder / "scheduler.json"
        self.scheduler = self._start("dask_scheduler", "--port", "0", "--scheduler-file", str(file))
        try:
            until(lambda: file.exists() and bool(file.read_text()))
            self.address: str = json.loads(file.read_text())["address"]
            for _ in range(workers):
                self.add_worker()
        except BaseException:
            self.end()
            raise

    def _start(self, command: str, *arguments: str) -> subprocess.Popen[bytes]:
        with (self._folder / "log").open("ab") as log:
            return subprocess.Popen(
                [sys.executable, "-m", f"distributed.cli.{command}", *_LOOPBACK, *arguments],
                env=self._environment,
                stdout=log,
                stderr=log,
            )

    def add_worker(self) -> None:
        """Start one more, which need not be there yet."""
        arguments = ("--local-directory", str(self._folder), *self._arguments)
        self.workers.append(self._start("dask_worker", self.address, *arguments))

    def is_idle(self) -> bool:
        """Whether its workers run nothing, not even for one who has gone."""
        with Client(self.address, set_as_default=False) as client:
            running = client.run(lambda dask_worker: dask_worker.state.executing_count)
            return not any(running.values())

    def end(self) -> None:
        """End what still runs; the nannies of workers end these."""
        for process in (*self.workers, self.scheduler):
            process.terminate()
            try:
                process.wait(WATCHDOG_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def __enter__(self) -> RealCluster:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        tb: TracebackType | None,
    ) -> None:
        self.end()


# ---------------------------------------------------------------- tasks

SECONDS = 0.3


def result(name: str) -> bytes:
    """What `write` leaves."""
    return hashlib.sha256(name.encode()).digest()


def write(folder: str, name: str) -> None:
    """Note the attempt with the process that makes it, take a while, leave the result."""
    place = Path(folder, name)
    if place.exists():
        return
    Path(folder, f"{name}.by-{os.getpid()}").touch()
    time.sleep(SECONDS)
    new = place.with_suffix(f".new-{os.getpid()}")
    new.write_bytes(result(name))
    new.rename(place)


def die(folder: str, name: str) -> None:
    """As `write`, but the worker does not survive the one that is deadly."""
    if name == "deadly":
        os.kill(os.getpid(), signal.SIGKILL)
    write(folder, name)
