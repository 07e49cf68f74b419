"""Clusters on this machine's loopback: processes of Dask, started and ended by their number."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from threading import Thread
from types import TracebackType
from urllib.parse import urlsplit

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


class Relay:
    """A way to a scheduler that can be broken; a context manager that closes it.

    Args:
        address: The scheduler's.
    """

    def __init__(self, address: str) -> None:
        parts = urlsplit(address)
        assert parts.hostname
        assert parts.port
        self._target = (parts.hostname, parts.port)
        self._ends: list[socket.socket] = []
        self._server = socket.create_server(("127.0.0.1", 0))
        self.address = f"tcp://127.0.0.1:{self._server.getsockname()[1]}"
        self._threads = [Thread(target=self._accept)]
        self._threads[0].start()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                here, _ = self._server.accept()
                there = socket.create_connection(self._target)
                self._ends += [here, there]
                for ends in ((here, there), (there, here)):
                    self._threads.append(Thread(target=self._pass_on, args=ends))
                    self._threads[-1].start()

    @staticmethod
    def _pass_on(one: socket.socket, other: socket.socket) -> None:
        with one, suppress(OSError):
            while data := one.recv(2**16):
                other.sendall(data)
            other.shutdown(socket.SHUT_RDWR)

    def break_connections(self) -> None:
        """End those that there are; others can be made."""
        ends, self._ends = self._ends, []
        for end in ends:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def __enter__(self) -> Relay:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        tb: TracebackType | None,
    ) -> None:
        self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        self.break_connections()
        for thread in self._threads:
            thread.join()
