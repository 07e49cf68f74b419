"""Runs tasks: threads within a process, and processes on a machine."""

from __future__ import annotations

import ctypes
import gc
import io
import json
import os
import queue
import selectors
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import IO, Any, Protocol


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a task ended.

    Attributes:
        task: Its arguments.
        error: Class name and message of its error; None if it succeeded.
        facts: What it reported at its end.
    """

    task: tuple[str, ...]
    error: tuple[str, str] | None = None
    facts: dict[str, Any] = field(default_factory=dict)


class Engine(Protocol):
    """Runs tasks. Each is a call of a function that engines know nothing about.

    The function takes the task's arguments, is idempotent, and leaves its result on disk; so a task
    may be rerun, or run twice at once, and no result passes through the engine.
    """

    def run(
        self,
        tasks: Sequence[tuple[str, ...]],
        on_progress: Callable[[tuple[str, ...], dict[str, Any]], None],
    ) -> Generator[Outcome, None, None]:
        """Run tasks, in any order, several at a time.

        Args:
            tasks: Arguments of each, distinct.
            on_progress: Called with a running task's reports, if the engine receives them.

        Yields:
            The outcome of each task as it ends. Closing the generator ends running tasks.
        """
        ...


# ---------------------------------------------------------------- memory


def release_memory() -> None:
    """Release the memory that a task took.

    Encoders in reference cycles wait for a collector that does not know how large they are, and the
    C library keeps freed memory.
    """
    gc.collect()
    with suppress(OSError, AttributeError):  # not the GNU C library
        ctypes.CDLL("libc.so.6").malloc_trim(0)


# ---------------------------------------------------------------- threads

_DEPTH = 2
_POLL_SECONDS = 0.2


class Workers:
    """A fixed number of threads; jobs of one key run in order on one of them.

    A context manager: leaving it normally waits for all jobs, leaving it with an exception drops
    those not started. The first error of a job is raised at the next call.

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
            BaseException: An earlier job's error.
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
            BaseException: A job's error.
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


# ---------------------------------------------------------------- processes

_STDERR_BYTES = 2_000
_LINE_BYTES = 2**20
_TERMINATE_SECONDS = 5.0
_TRIES = 2


@dataclass
class _Worker:
    """A process, and the task it is working on."""

    process: subprocess.Popen[bytes]
    task: tuple[str, ...] | None
    line: bytearray = field(default_factory=bytearray)
    stderr: bytearray = field(default_factory=bytearray)
    open_pipes: int = 2

    def died(self, task: tuple[str, ...]) -> Outcome:
        """The outcome of a task whose process died."""
        code = self.process.wait()
        tail = self.stderr.decode(errors="replace").strip().splitlines()
        said = f": {tail[-1]}" if tail else ""
        if code < 0:
            name = signal.Signals(-code).name if -code in list(signal.Signals) else str(-code)
            hint = ", perhaps for lack of memory" if -code == signal.SIGKILL else ""
            return Outcome(task, ("Killed", f"its process was killed by {name}{hint}{said}"))
        return Outcome(task, ("Failed", f"its process exited with code {code}{said}"))

    def order(self, task: tuple[str, ...]) -> None:
        """Give it its next task."""
        self.task = task
        with suppress(OSError):  # it has died, as its pipes will show
            _pipe(self.process.stdin).write(json.dumps(task).encode() + b"\n")
            _pipe(self.process.stdin).flush()

    def dismiss(self) -> None:
        """Let it exit: there is nothing more to do."""
        with suppress(OSError):
            _pipe(self.process.stdin).close()


class ProcessEngine:
    """Runs tasks in several processes. See `Engine`.

    A task whose process is killed is tried once more, after all others.

    Args:
        command: The command line of a process, given its first task.
        slots: Processes at a time.
    """

    def __init__(self, command: Callable[[tuple[str, ...]], Sequence[str]], slots: int) -> None:
        self._command = command
        self._slots = slots

    def run(
        self,
        tasks: Sequence[tuple[str, ...]],
        on_progress: Callable[[tuple[str, ...], dict[str, Any]], None],
    ) -> Generator[Outcome, None, None]:
        """See `Engine.run`."""
        shift = _Shift(self._command, tasks, on_progress)
        try:
            while shift.goes_on:
                shift.fill(self._slots)
                yield from shift.listen()
        finally:
            shift.end()


class _Shift:
    """One run of a `ProcessEngine`."""

    def __init__(
        self,
        command: Callable[[tuple[str, ...]], Sequence[str]],
        tasks: Sequence[tuple[str, ...]],
        on_progress: Callable[[tuple[str, ...], dict[str, Any]], None],
    ) -> None:
        self._command = command
        self._on_progress = on_progress
        self._waiting = deque(tasks)
        self._tries = dict.fromkeys(tasks, 0)
        self._workers: list[_Worker] = []
        self._selector = selectors.DefaultSelector()

    @property
    def goes_on(self) -> bool:
        """Whether there is anything left to do or to wait for."""
        return bool(self._waiting or self._workers)

    def fill(self, slots: int) -> None:
        """Start processes while there are tasks for them."""
        while self._waiting and len(self._workers) < slots:
            task = self._next()
            process = subprocess.Popen(
                list(self._command(task)),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                # the terminal's Ctrl-C is for the parent, which ends the others
                start_new_session=True,
            )
            worker = _Worker(process, task)
            self._workers.append(worker)
            for stream, handle in ((process.stdout, self._hear), (process.stderr, _hear_error)):
                self._selector.register(_pipe(stream), selectors.EVENT_READ, (worker, handle))

    def _next(self) -> tuple[str, ...]:
        task = self._waiting.popleft()
        self._tries[task] += 1
        return task

    def listen(self) -> Iterator[Outcome]:
        """Wait for reports from processes, and handle them."""
        for key, _ in self._selector.select():
            worker, handle = key.data
            stream: Any = key.fileobj
            data = stream.read1(65536)
            if data:
                yield from handle(worker, data)
                continue
            self._selector.unregister(stream)
            stream.close()
            worker.open_pipes -= 1
        for worker in [worker for worker in self._workers if not worker.open_pipes]:
            self._workers.remove(worker)
            yield from self._bury(worker)

    def _hear(self, worker: _Worker, data: bytes) -> Iterator[Outcome]:
        worker.line += data
        *lines, rest = bytes(worker.line).split(b"\n")
        worker.line = bytearray(rest[-_LINE_BYTES:])
        for line in lines:
            with suppress(ValueError):
                told = json.loads(line)
                if isinstance(told, dict) and worker.task is not None:
                    self._on_progress(worker.task, told)
                    if "error" in told or "done" in told:
                        error = tuple(told["error"]) if "error" in told else None
                        yield Outcome(worker.task, error, told)
                        self._release(worker, is_ready=bool(told.get("ready")))

    def _release(self, worker: _Worker, *, is_ready: bool) -> None:
        """Note that a process has done its task."""
        worker.task = None
        if is_ready and self._waiting:
            worker.order(self._next())
        else:
            worker.dismiss()

    def _bury(self, worker: _Worker) -> Iterator[Outcome]:
        """Note that a process has ended."""
        task = worker.task
        worker.process.wait()
        _close(worker)
        if task is not None:
            outcome = worker.died(task)
            killed = outcome.error is not None and outcome.error[0] == "Killed"
            if killed and self._tries[task] < _TRIES:
                self._waiting.append(task)
            else:
                yield outcome

    def end(self) -> None:
        """End the remaining processes, gently first."""
        for worker in self._workers:
            worker.process.terminate()
        for worker in self._workers:
            try:
                worker.process.wait(_TERMINATE_SECONDS)
            except subprocess.TimeoutExpired:
                worker.process.kill()
                worker.process.wait()
            _close(worker)
        self._selector.close()


def _hear_error(worker: _Worker, data: bytes) -> Iterator[Outcome]:
    worker.stderr = (worker.stderr + data)[-_STDERR_BYTES:]
    return iter(())


def _pipe(stream: IO[bytes] | None) -> IO[bytes]:
    if stream is None:
        raise ValueError("the process has no such pipe")
    return stream


def _close(worker: _Worker) -> None:
    for stream in (worker.process.stdin, worker.process.stdout, worker.process.stderr):
        if stream is not None:
            with suppress(OSError):
                stream.close()


# ---------------------------------------------------------------- in such a process


class Orders:
    """The tasks of this process: the first, if given, then one for each line of standard input.

    If the input ends during a task, nobody waits for its result: the process exits.
    """

    def __init__(self, *first: list[str]) -> None:
        self._queue: queue.SimpleQueue[list[Any] | None] = queue.SimpleQueue()
        for task in first:
            self._queue.put(task)
        self._busy = bool(first)
        threading.Thread(target=self._watch, daemon=True).start()

    def _watch(self) -> None:
        # unbuffered: Python could not end while another thread waits within a buffer
        for line in io.FileIO(sys.stdin.fileno(), closefd=False):
            self._queue.put(json.loads(line))
        self._queue.put(None)
        if self._busy:
            os._exit(1)

    def __iter__(self) -> Iterator[list[Any]]:
        while True:
            self._busy = False
            task = self._queue.get()
            if task is None:
                return
            self._busy = True
            yield task


def tell(values: Any) -> None:
    """Report to the process that started this one, in a line of JSON."""
    sys.stdout.write(json.dumps(values) + "\n")
    sys.stdout.flush()


def serve(outcome_of: Callable[..., dict[str, Any]]) -> None:
    """Run tasks in a process that a `ProcessEngine` started.

    Args:
        outcome_of: Runs a task, given its arguments. Returns what to report: ``error``, class name
            and sentence, or ``done``; and ``ready`` if this process can take another task.
    """
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    with suppress(BrokenPipeError):
        for task in Orders(sys.argv[1:]):
            outcome = outcome_of(*task)
            tell(outcome)
            if not outcome.get("ready"):
                sys.exit(0 if "done" in outcome else 1)
