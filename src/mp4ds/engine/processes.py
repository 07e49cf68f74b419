"""Tasks in processes of this machine.

A process is started for a task, and tells what it does by lines of JSON on its standard output,
the last of which has ``done`` or ``error``. If that line says that it is ``ready``, it is given
its next task as a line of JSON on its standard input. It ends when that is closed, so none
outlives the one that started it; one that dies takes no other task with it than its own.
"""

from __future__ import annotations

import json
import selectors
import signal
import subprocess
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import IO, Any

from mp4ds.engine.protocol import Outcome

_STDERR_BYTES = 2_000
_LINE_BYTES = 2**20
_TERMINATE_SECONDS = 5.0
_TRIES = 2


@dataclass
class _Worker:
    """A process, and the task that it is at work on."""

    process: subprocess.Popen[bytes]
    task: tuple[str, ...] | None
    line: bytearray = field(default_factory=bytearray)
    stderr: bytearray = field(default_factory=bytearray)
    open_pipes: int = 2

    def died(self, task: tuple[str, ...]) -> Outcome:
        """The outcome of a task that the process did not live to tell."""
        code = self.process.wait()
        tail = self.stderr.decode(errors="replace").strip().splitlines()
        said = f": {tail[-1]}" if tail else ""
        if code < 0:
            name = signal.Signals(-code).name if -code in list(signal.Signals) else str(-code)
            hint = ", perhaps for want of memory" if -code == signal.SIGKILL else ""
            return Outcome(task, ("Killed", f"its process was ended by {name}{hint}{said}"))
        return Outcome(task, ("Failed", f"its process ended with code {code}{said}"))

    def order(self, task: tuple[str, ...]) -> None:
        """Give it its next task."""
        self.task = task
        with suppress(OSError):  # it has died, which its pipes tell
            _pipe(self.process.stdin).write(json.dumps(task).encode() + b"\n")
            _pipe(self.process.stdin).flush()

    def dismiss(self) -> None:
        """Let it end: there is nothing more to do."""
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
        """Whether there is anything to do or to wait for."""
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
                start_new_session=True,  # the terminal's Ctrl-C is for the one that ends the others
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
        """Wait until processes tell something, and take it in."""
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
        """Take notice that a process has done its task."""
        worker.task = None
        if is_ready and self._waiting:
            worker.order(self._next())
        else:
            worker.dismiss()

    def _bury(self, worker: _Worker) -> Iterator[Outcome]:
        """Take notice of a process that has ended."""
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
        """End the processes that are left, gently first."""
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
