"""Running the work of several streams side by side, each stream's in order.

Encoders and digests run without Python's lock, so threads use every core and no frame is
copied between processes. Queues are short: memory is a few frames per worker.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from contextlib import suppress

_DEPTH = 2
_POLL_SECONDS = 0.2


class Workers:
    """A fixed number of threads; jobs of one key run in order on one of them.

    A context manager: leaving it normally waits for all jobs, leaving it with an exception
    drops those not begun. The first error of a job is raised at the next call.

    Args:
        count: Threads; 0 runs each job at once in the calling thread.
    """

    def __init__(self, count: int) -> None:
        self._error: BaseException | None = None
        self._stopped = threading.Event()
        self._queues: list[queue.Queue[Callable[[], None] | None]] = [
            queue.Queue(_DEPTH) for _ in range(count)
        ]
        self._threads = [
            threading.Thread(target=self._run, args=(jobs,), daemon=True) for jobs in self._queues
        ]
        for thread in self._threads:
            thread.start()

    def submit(self, key: int, job: Callable[[], None]) -> None:
        """Run a job after all earlier ones of the same key; waits while the queue is full.

        Raises:
            BaseException: What an earlier job raised.
        """
        if not self._queues:
            job()
            return
        jobs = self._queues[key % len(self._queues)]
        while True:
            self._raise_error()
            try:
                jobs.put(job, timeout=_POLL_SECONDS)
                return
            except queue.Full:
                continue

    def _run(self, jobs: queue.Queue[Callable[[], None] | None]) -> None:
        while (job := jobs.get()) is not None:
            if self._stopped.is_set():
                continue
            try:
                job()
            except BaseException as error:
                self._error = self._error or error
                self._stopped.set()

    def _raise_error(self) -> None:
        if self._error is not None:
            raise self._error

    def join(self) -> None:
        """Wait for all jobs and end the threads.

        Raises:
            BaseException: What a job raised.
        """
        for jobs in self._queues:
            jobs.put(None)
        for thread in self._threads:
            thread.join()
        self._queues, self._threads = [], []
        self._raise_error()

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, exc_type: type[BaseException] | None, *_: object) -> None:
        if exc_type is None:
            self.join()
            return
        self._stopped.set()
        with suppress(BaseException):  # the error that led here is the one to report
            self.join()
