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

from mp4ds.packing.packer import StreamThreads
from mp4ds.processes import ProcessExecutor
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


def test_a_call_whose_process_is_killed_is_made_once_more(tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    once = f"import os\nif not os.path.exists({str(mark)!r}):\n open({str(mark)!r}, 'w')\n "
    with ProcessExecutor(1) as executor:
        assert executor.submit(exec, f"{once}os.kill(os.getpid(), 9)").exception() is None
    mark.unlink()
    with ProcessExecutor(1) as executor:  # nobody waits for it before all calls are to end
        call = executor.submit(exec, f"{once}os.kill(os.getpid(), 9)")
    assert call.exception() is None


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
