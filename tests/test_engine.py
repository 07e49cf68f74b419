"""Threads that run the jobs of a key in order, and what happens when one fails."""

from __future__ import annotations

import threading
import time
from collections import defaultdict
from collections.abc import Callable

import pytest

from mp4ds.packing.engine import Workers
from waiting import WATCHDOG_S, until

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
def test_jobs_of_a_key_run_in_order_and_all_run(count: int) -> None:
    done: dict[int, list[int]] = defaultdict(list)
    before = threads()
    with Workers(count) as workers:
        for number in range(200):
            key = number % 7

            def job(key: int = key, number: int = number) -> None:
                time.sleep(0.0005 * (number % 3))
                done[key].append(number)

            workers.submit(key, job)
    assert {key: numbers == sorted(numbers) for key, numbers in done.items()} == dict.fromkeys(
        range(7), True
    )
    assert sum(map(len, done.values())) == 200
    assert threads() == before


def test_a_key_stays_on_its_thread() -> None:
    used: dict[int, set[int]] = defaultdict(set)
    with Workers(3) as workers:
        for number in range(60):
            key = number % 5
            workers.submit(key, lambda key=key: used[key].add(threading.get_ident()))  # type: ignore[misc]
    assert [len(found) for found in used.values()] == [1] * 5
    assert threading.get_ident() not in set().union(*used.values())


def test_without_threads_a_job_runs_at_once() -> None:
    seen: list[int] = []
    with Workers(0) as workers:
        workers.submit(0, lambda: seen.append(threading.get_ident()))
        assert seen == [threading.get_ident()]
        with pytest.raises(BrokenError):
            workers.submit(0, fail())


def test_different_keys_run_side_by_side() -> None:
    barrier = threading.Barrier(2, timeout=WATCHDOG_S)  # passed only by two at once
    with Workers(2) as workers:
        workers.submit(0, lambda: (barrier.wait(), None)[1])
        workers.submit(1, lambda: (barrier.wait(), None)[1])
    assert not barrier.broken


@pytest.mark.parametrize("count", [1, 3])
def test_memory_is_bounded(count: int) -> None:
    """A source that is faster than the encoders waits for them."""
    go, submitted = threading.Event(), []

    def feed(workers: Workers) -> None:
        for number in range(20):
            workers.submit(0, lambda: (go.wait(WATCHDOG_S), None)[1])
            submitted.append(number)

    with Workers(count) as workers:
        feeder = threading.Thread(target=feed, args=(workers,))
        feeder.start()
        until(lambda: submitted)
        time.sleep(0.3)
        assert len(submitted) <= 4
        go.set()
        feeder.join(WATCHDOG_S)
    assert len(submitted) == 20


@pytest.mark.parametrize("count", [1, 2, 5])
def test_the_first_error_reaches_the_caller(count: int) -> None:
    before, ran = threads(), []
    with pytest.raises(BrokenError, match="first"), Workers(count) as workers:  # noqa: PT012
        workers.submit(0, fail("first"))
        until(lambda: workers.submit(0, lambda: ran.append(1)))
    assert ran == []
    assert threads() == before


def test_an_error_of_the_last_job_is_raised_at_the_end() -> None:
    with pytest.raises(BrokenError), Workers(2) as workers:
        workers.submit(1, fail())


def test_even_those_that_are_no_exceptions() -> None:
    def stop() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), Workers(1) as workers:
        workers.submit(0, stop)


def test_an_error_of_the_caller_drops_what_has_not_begun() -> None:
    before, ran = threads(), []
    started, go = threading.Event(), threading.Event()

    def first() -> None:
        started.set()
        go.wait(WATCHDOG_S)
        ran.append("first")

    with pytest.raises(BrokenError, match="the caller's"), Workers(1) as workers:  # noqa: PT012
        workers.submit(0, first)
        workers.submit(0, lambda: ran.append("second"))
        started.wait(WATCHDOG_S)
        opener = threading.Thread(target=lambda: workers._stopped.wait(WATCHDOG_S) and go.set())
        opener.start()
        raise BrokenError("the caller's")
    opener.join()
    assert ran == ["first"]
    assert threads() == before


@pytest.mark.parametrize("wait", [0.0, 0.2])
def test_the_callers_error_is_not_replaced_by_a_jobs(wait: float) -> None:
    """Also where the job fails while the workers are being ended."""
    started = threading.Event()

    def late() -> None:
        started.set()
        time.sleep(wait)
        raise BrokenError("the job's")

    with pytest.raises(BrokenError, match="the caller's"), Workers(1) as workers:  # noqa: PT012
        workers.submit(0, late)
        started.wait(WATCHDOG_S)
        raise BrokenError("the caller's")
