"""Calls that run in processes of this machine, and calls of its system."""

from __future__ import annotations

import ctypes
import gc
import os
import pickle
import queue
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future
from contextlib import suppress
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from mp4ds.errors import Mp4dsError, sentence_of

_Item = TypeVar("_Item")
_P = ParamSpec("_P")
_T = TypeVar("_T")


_SWAP = 2  # RENAME_EXCHANGE of Linux, RENAME_SWAP of macOS
_AT_FDCWD = -100


def swap_names(one: Path, other: Path) -> bool:
    """Give two files or folders the name of one another, at once.

    Returns:
        Whether that was done; False if the system or file system cannot.
    """
    names = os.fsencode(one), os.fsencode(other)
    with suppress(AttributeError, OSError, TypeError):  # the system lacks the function or library
        libc = ctypes.CDLL(None)
        if sys.platform == "darwin":
            return not libc.renamex_np(*names, _SWAP)
        return not libc.renameat2(_AT_FDCWD, names[0], _AT_FDCWD, names[1], _SWAP)
    return False


def available_cores() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def memory_bytes() -> int:
    """This machine's memory, or the container's limit if lower, bytes."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    for name in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        with suppress(OSError, ValueError):
            total = min(total, int(Path(name).read_text()))
    return total


def each(
    work: Callable[[_Item], _T], items: Sequence[_Item], jobs: int | None = 1
) -> Iterator[tuple[_Item, _T]]:
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
    with ProcessExecutor(workers) as executor:
        calls = [executor.submit(work, item) for item in items]
        for item, call in zip(items, calls, strict=True):
            yield item, call.result()


def failure_of(error: BaseException) -> Mp4dsError:
    """An error of a call as one that users can meet."""
    if isinstance(error, Mp4dsError):
        return error
    if isinstance(error, MemoryError):
        return Mp4dsError("out of memory")
    said = sentence_of(error) if isinstance(error, OSError) else str(error)
    return Mp4dsError(said or type(error).__name__)


def release_memory() -> None:
    """Release the memory that a call took.

    Encoders in reference cycles wait for a collector that does not know how large they are, and the
    C library keeps freed memory.
    """
    gc.collect()
    with suppress(OSError, AttributeError):  # not the GNU C library
        ctypes.CDLL("libc.so.6").malloc_trim(0)


# ---------------------------------------------------------------- processes

_STDERR_BYTES = 2_000
_TERMINATE_SECONDS = 10.0
_KEPT_BYTES = 400 * 2**20


_Pickled = tuple[bytes, bytes]
"""A function and its arguments: a process keeps the function that it was given last, with all that
this holds."""


class ProcessExecutor(Executor):
    """Runs calls in processes of its own, each of them one call at a time, waited for by a thread.

    Unlike those of a `ProcessPoolExecutor`, its processes do not import the caller's main module,
    which would have to be guarded; and where one of them is killed, its call alone is made once
    more. Errors of the system arrive as `Mp4dsError`, which survives pickling.

    A context manager: leaving it with an exception ends running calls.

    Args:
        processes: How many there are at most.
        nice: Added to their niceness.
    """

    def __init__(self, processes: int, *, nice: int = 0) -> None:
        self._most, self._nice = processes, nice
        self._is_closed = self._is_ended = False
        self._taking = threading.Lock()  # no thread is joined that has not been started
        # calls, and what gets their results; None ends a thread
        self._calls: queue.SimpleQueue[tuple[Future[Any], _Pickled] | None] = queue.SimpleQueue()
        self._threads: list[threading.Thread] = []
        self._processes: set[_Process] = set()

    def submit(self, fn: Callable[_P, _T], /, *args: _P.args, **kwargs: _P.kwargs) -> Future[_T]:
        """Make a call in a process, of a function that can be pickled."""
        future: Future[_T] = Future()
        call = pickle.dumps(fn), pickle.dumps((args, kwargs))
        with self._taking:
            if self._is_closed:
                raise RuntimeError("no more calls after shutdown")
            self._calls.put((future, call))
            if len(self._threads) < self._most:
                # a daemon, unlike those of a ThreadPoolExecutor: a process that is interrupted
                # again while it ends its calls waits for none of them
                thread = threading.Thread(target=self._work, daemon=True)
                self._threads.append(thread)
                thread.start()
        return future

    def _work(self) -> None:
        """Make calls, one after another; in a thread."""
        process: _Process | None = None
        while (taken := self._calls.get()) is not None:
            future, call = taken
            if not future.set_running_or_notify_cancel():
                continue
            answer: object = None
            try:
                for _ in range(2):  # once more if its process was killed
                    if process is not None and not process.is_ready:
                        self._processes.discard(process)
                        process.close()
                        process = None
                    if process is None:
                        process = _Process(self._nice)
                        self._processes.add(process)
                        if self._is_ended:
                            process.terminate()
                    answer = process.make(call)
                    if self._is_ended or not process.was_killed:
                        break
            except OSError as error:
                answer = error
            if isinstance(answer, BaseException):
                future.set_exception(answer)
            else:
                future.set_result(answer)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Take no more calls.

        Args:
            wait: Wait for those that were taken.
            cancel_futures: Drop those that are waiting, and end those that are running.
        """
        with self._taking:
            self._is_closed = True
        if cancel_futures:
            self._is_ended = True
            with suppress(queue.Empty):
                while True:
                    if taken := self._calls.get_nowait():
                        taken[0].cancel()
            ended = list(self._processes)
            for process in ended:
                process.terminate()
            for process in ended:
                process.wait_or_kill()
        for _ in self._threads:
            self._calls.put(None)
        for thread in self._threads if wait else ():
            thread.join()
        while wait and self._processes:
            self._processes.pop().close()

    def __exit__(self, exc_type: type[BaseException] | None, *_: object) -> None:
        self.shutdown(cancel_futures=exc_type is not None)


class _Process:
    """A process of a `ProcessExecutor`.

    Attributes:
        is_ready: Whether it can be given another call.
        was_killed: Whether a signal ended it.
    """

    def __init__(self, nice: int) -> None:
        self.is_ready = True
        self.was_killed = False
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the process
        self._calls, theirs = Pipe()
        with theirs:
            socket = theirs.fileno()
            # Not by -m, which would import what lies in the current folder first; and modules are
            # found where this process finds them.
            path = [place for place in sys.path if isinstance(place, str)]
            program = f"import sys; sys.path[:] = {path!r}; from {__name__} import serve; serve()"
            self._process = subprocess.Popen(
                [sys.executable, "-c", program, str(socket), str(nice)],
                stdin=subprocess.DEVNULL,
                stdout=self._stderr,
                stderr=self._stderr,
                pass_fds=[socket],
                # the terminal's Ctrl-C is for this process, which ends the others
                start_new_session=True,
            )

    def make(self, call: _Pickled) -> Any:
        """Make a call; returns its result, or the error to raise."""
        self._stderr.seek(0)
        self._stderr.truncate()  # earlier calls told nothing of this one
        try:
            self._calls.send(call)
            result, error, self.is_ready = self._calls.recv()
        except (OSError, EOFError):
            self.is_ready = False
            return self._death()
        except Exception as unpickled:
            return unpickled
        return result if error is None else error

    def _death(self) -> Mp4dsError:
        code = self._process.wait()
        self._stderr.seek(max(0, self._stderr.seek(0, os.SEEK_END) - _STDERR_BYTES))
        lines = self._stderr.read().decode(errors="replace").strip().splitlines()
        said = f": {lines[-1]}" if lines else ""
        if code >= 0:
            return Mp4dsError(f"its process exited with code {code}{said}")
        self.was_killed = True
        name = signal.Signals(-code).name if -code in list(signal.Signals) else str(-code)
        hint = ", perhaps for lack of memory" if -code == signal.SIGKILL else ""
        return Mp4dsError(f"its process was killed by {name}{hint}{said}")

    def terminate(self) -> None:
        """Ask it to end."""
        self._process.terminate()

    def wait_or_kill(self) -> None:
        """Wait until it has ended, for a while."""
        try:
            self._process.wait(_TERMINATE_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()

    def close(self) -> None:
        """Let it end: there is nothing more to do."""
        self.is_ready = False
        self._calls.close()
        self._process.wait()
        self._stderr.close()


# ---------------------------------------------------------------- in such a process


def serve() -> None:
    """Be such a process: take calls from an inherited socket, and answer each there."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    socket, nice = map(int, sys.argv[1:])
    os.nice(nice)
    caller: Connection[Any, Any] = Connection(socket)
    calls: queue.SimpleQueue[_Pickled | None] = queue.SimpleQueue()
    is_busy = threading.Event()
    threading.Thread(target=_listen, args=(caller, calls, is_busy), daemon=True).start()
    function: Callable[..., Any] | None = None
    pickled = b""
    with suppress(BrokenPipeError):
        while (call := calls.get()) is not None:
            is_busy.set()
            if function is None or pickled != call[0]:
                function, pickled = pickle.loads(call[0]), call[0]
            args, kwargs = pickle.loads(call[1])
            result, error = None, None
            try:
                result = function(*args, **kwargs)
            except MemoryError:
                error = Mp4dsError("out of memory; try fewer `jobs`")
            except (Mp4dsError, OSError) as caught:
                error = failure_of(caught)
            release_memory()
            # memory fragmented by large encoders is only released by exiting
            caller.send((result, error, error is None and _resident_bytes() < _KEPT_BYTES))
            is_busy.clear()


def _listen(
    caller: Connection[Any, Any],
    calls: queue.SimpleQueue[_Pickled | None],
    is_busy: threading.Event,
) -> None:
    """Take calls; when the last has come, this process ends, and at once if nobody waits."""
    with suppress(EOFError, OSError):
        while True:
            calls.put(caller.recv())
    calls.put(None)
    if is_busy.is_set():
        os._exit(1)


def _resident_bytes() -> int:
    """This process's memory; 0 if unknown."""
    with suppress(OSError, ValueError, IndexError):
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return 0
