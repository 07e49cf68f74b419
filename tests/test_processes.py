"""Calls in processes and jobs in threads: their order, how they end, and that nothing is left."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from mp4ds.errors import Mp4dsError, OptionError
from mp4ds.packing.packer import StreamThreads
from mp4ds.processes import ProcessExecutor, each
from waiting import WATCHDOG_S, is_alive, until

COUNTS = [0, 1, 2, 5]


class BrokenError(Exception):
    """A job's own error."""


def fail(message: str = "broken") -> Callable[[], None]:
    def job() -> None:
        raise BrokenError(message)

    return job


def threads() -> int:
    return threading.active_count()


@pytest.mark.parametrize("count", COUNTS)
def test_jobs_of_a_stream_run_in_order_and_all_run(count: int) -> None:
    done: dict[int, list[int]] = defaultdict(list)
    used: dict[int, set[int]] = defaultdict(set)
    before = threads()
    with StreamThreads(count) as workers:
        for number in range(200):
            key = number % 7

            def job(key: int = key, number: int = number) -> None:
                time.sleep(0.0005 * (number % 3))
                done[key].append(number)
                used[key].add(threading.get_ident())

            workers.submit(key, job)
    assert {key: numbers == sorted(numbers) for key, numbers in done.items()} == dict.fromkeys(
        range(7), True
    )
    assert sum(map(len, done.values())) == 200
    assert [len(found) for found in used.values()] == [1] * 7  # each on one thread
    assert (threading.get_ident() in set().union(*used.values())) == (count == 0)
    assert threads() == before


def test_different_streams_run_side_by_side() -> None:
    barrier = threading.Barrier(2, timeout=WATCHDOG_S)  # passed only by two at once
    with StreamThreads(2) as workers:
        workers.submit(0, lambda: (barrier.wait(), None)[1])
        workers.submit(1, lambda: (barrier.wait(), None)[1])
    assert not barrier.broken


@pytest.mark.parametrize("count", [1, 3])
def test_memory_is_bounded(count: int) -> None:
    """A source that is faster than the encoders waits for them."""
    go, submitted = threading.Event(), []

    def feed(workers: StreamThreads) -> None:
        for number in range(20):
            workers.submit(0, lambda: (go.wait(WATCHDOG_S), None)[1])
            submitted.append(number)

    with StreamThreads(count) as workers:
        feeder = threading.Thread(target=feed, args=(workers,))
        feeder.start()
        until(lambda: submitted)
        time.sleep(0.3)
        assert len(submitted) <= 4
        go.set()
        feeder.join(WATCHDOG_S)
    assert len(submitted) == 20


@pytest.mark.parametrize("count", [0, 1, 5])
def test_the_first_error_reaches_the_caller(count: int) -> None:
    before, ran = threads(), []
    with pytest.raises(BrokenError, match="last"), StreamThreads(count) as workers:
        workers.submit(0, fail("last"))
    with pytest.raises(BrokenError, match="first"), StreamThreads(count) as workers:  # noqa: PT012
        workers.submit(0, fail("first"))
        until(lambda: workers.submit(0, lambda: ran.append(1)))
    assert ran == []
    assert threads() == before


def test_an_error_of_the_caller_drops_what_has_not_begun(monkeypatch: pytest.MonkeyPatch) -> None:
    before, ran = threads(), []
    started, go = threading.Event(), threading.Event()
    end = ThreadPoolExecutor.shutdown

    def shutdown(thread: ThreadPoolExecutor, **options: bool) -> None:
        end(thread, **{**options, "wait": False})
        go.set()
        end(thread)

    monkeypatch.setattr(ThreadPoolExecutor, "shutdown", shutdown)

    def first() -> None:
        started.set()
        go.wait(WATCHDOG_S)
        ran.append("first")
        raise BrokenError("the job's")

    with pytest.raises(BrokenError, match="the caller's"), StreamThreads(1) as workers:  # noqa: PT012
        workers.submit(0, first)
        workers.submit(0, lambda: ran.append("second"))
        started.wait(WATCHDOG_S)
        raise BrokenError("the caller's")
    assert ran == ["first"]
    assert threads() == before


# ---------------------------------------------------------------- processes

CODE = {
    "quick": "pass",
    "noisy": "import sys; print('x' * 3_000_000); sys.stderr.write('y' * 300_000)",
    "error": "from mp4ds.errors import SourceError; raise SourceError('drive.bag', 'is damaged')",
    "system": "open('/none/such')",
    "memory": "bytearray(2**60)",
    "crash": "import sys; sys.stderr.write('first\\nlast words\\n'); sys.exit(3)",
    "quiet": "import sys; sys.exit()",
    "odd": "raise ArithmeticError('odd')",
    "killed": "import os, signal; os.kill(os.getpid(), signal.SIGKILL)",
}
SENTENCES = {
    "error": "drive.bag: is damaged.",
    "system": "/none/such: No such file or directory",
    "memory": "out of memory; try fewer `jobs`",
    "crash": "its process exited with code 3: last words",
    "quiet": "its process exited with code 0",
    "odd": "its process exited with code 1: ArithmeticError: odd",
    "killed": "its process was killed by SIGKILL, perhaps for lack of memory",
}


@pytest.mark.parametrize("processes", [1, 3])
def test_every_call_has_its_outcome(processes: int) -> None:
    with ProcessExecutor(processes) as executor:
        calls = {name: executor.submit(exec, code) for name, code in CODE.items()}
        errors = {name: call.exception() for name, call in calls.items()}
    assert {name: str(error) for name, error in errors.items() if error} == SENTENCES
    assert {error.exit_code for error in errors.values() if isinstance(error, Mp4dsError)} == {1, 2}


def test_no_more_than_so_many_run_at_a_time(tmp_path: Path) -> None:
    code = (
        "import os, pathlib, time\n"
        f"here = pathlib.Path({str(tmp_path)!r}); mine = here / str(os.getpid()); mine.touch()\n"
        "met = here.with_name('met')\n"
        "while not met.exists() and len(list(here.iterdir())) < 2: time.sleep(0.01)\n"
        "met.touch(); time.sleep(0.1); seen = len(list(here.iterdir())); mine.unlink()\n"
        "if seen > 2: raise OSError(f'{seen} at a time')"
    )
    with ProcessExecutor(2) as executor:
        for call in [executor.submit(exec, code, {}) for _ in range(8)]:
            call.result()


def test_a_call_whose_process_is_killed_is_made_once_more(tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    once = f"import os\nif not os.path.exists({str(mark)!r}):\n open({str(mark)!r}, 'w')\n "
    with ProcessExecutor(1) as executor:
        assert executor.submit(exec, f"{once}os.kill(os.getpid(), 9)").exception() is None
    mark.unlink()
    with ProcessExecutor(1) as executor:  # nobody waits for it before all calls are to end
        call = executor.submit(exec, f"{once}os.kill(os.getpid(), 9)")
    assert call.exception() is None


class Counter:
    """Something that a process may keep from call to call; it is counted in the other process."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self) -> int:
        self.calls += 1
        return self.calls


def test_what_is_called_stays_in_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that a recording need not be opened again."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))
    counter = Counter()
    with ProcessExecutor(1) as executor:
        calls = [executor.submit(counter) for _ in range(3)]
        assert [call.result() for call in calls] == [1, 2, 3]
    assert counter.calls == 0


SLEEP = "import os, pathlib, time; pathlib.Path({!r}, str(os.getpid())).touch(); time.sleep(60)"


def test_an_error_of_the_caller_ends_what_runs(tmp_path: Path) -> None:
    calls = []
    with pytest.raises(BrokenError), ProcessExecutor(2) as executor:  # noqa: PT012
        calls += [executor.submit(exec, SLEEP.format(str(tmp_path))) for _ in range(4)]
        until(lambda: len(list(tmp_path.iterdir())) == 2)
        raise BrokenError
    assert not any(is_alive(int(path.name)) for path in tmp_path.iterdir())
    assert [call.cancelled() for call in calls] == [False, False, True, True]
    with pytest.raises(RuntimeError):
        executor.submit(os.getpid)


def test_a_process_ends_when_its_caller_is_killed(tmp_path: Path) -> None:
    """It works for nobody: the socket of its calls is closed then."""
    caller = (
        "from mp4ds.processes import ProcessExecutor\n"
        f"ProcessExecutor(1).submit(exec, {SLEEP.format(str(tmp_path))!r}).result()"
    )
    with subprocess.Popen([sys.executable, "-c", caller]) as process:
        until(lambda: list(tmp_path.iterdir()), process)
        process.send_signal(signal.SIGKILL)
        process.wait()
    (pid,) = (int(path.name) for path in tmp_path.iterdir())
    until(lambda: not is_alive(pid))


# ---------------------------------------------------------------- each of several items


def squared(number: int) -> tuple[int, int]:
    return number * number, os.getpid()


def failing(number: int) -> int:
    if number == 2:
        raise OptionError("two")
    return number


@pytest.mark.parametrize("jobs", [1, 3])
def test_items_in_their_order(jobs: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By modules that are found where the caller finds them, not in the current folder."""
    (tmp_path / "queue.py").write_text("raise SystemExit('from the current folder')")
    monkeypatch.chdir(tmp_path)
    found = list(each(squared, range(6), jobs))
    assert [(item, made[0]) for item, made in found] == [(n, n * n) for n in range(6)]
    assert (os.getpid() in {made[1] for _, made in found}) == (jobs == 1)
    with pytest.raises(OptionError, match="two"):
        list(each(failing, range(5), jobs))


def held(place: Path, number: int) -> None:
    """Work that lasts until it is ended, and tidies up then."""
    made = place / str(number)
    try:
        made.touch()  # from then on, it may be ended
        time.sleep(WATCHDOG_S)
    finally:
        made.unlink()


def test_an_interrupt_ends_all_and_tidies_up(tmp_path: Path) -> None:
    caller = (
        "from functools import partial; from pathlib import Path\n"
        "from mp4ds.processes import each; from test_processes import held\n"
        f"try: list(each(partial(held, Path({str(tmp_path)!r})), range(4), 2))\n"
        "except KeyboardInterrupt: print('interrupted')"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    command = [sys.executable, "-c", caller]
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE) as process:
        until(lambda: len(list(tmp_path.iterdir())) == 2, process)
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=WATCHDOG_S)
    assert out == b"interrupted\n"
    assert list(tmp_path.iterdir()) == []
