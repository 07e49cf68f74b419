"""Keeps encoders from taking the machine for themselves."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_THREADS = Path("/proc/self/task")


@contextmanager
def ordinary_scheduling() -> Iterator[None]:
    """Give threads that are made or changed in here the scheduling that the caller has.

    SVT-AV1, where it may, puts its threads and the one that opens it above everything else on the
    machine (SCHED_FIFO). On a robot, or with other work beside it, that stops the others; and what
    is started from such a thread inherits it. Nothing is done where the system has no such classes.
    """
    if not _THREADS.is_dir():
        yield
        return
    own = os.sched_getscheduler(0), os.sched_getparam(0)
    before = _classes()
    try:
        yield
    finally:
        with suppress(OSError):
            os.sched_setscheduler(0, *own)
        for thread, scheduler in _classes().items():
            if scheduler != before.get(thread, own[0]):
                with suppress(OSError):  # it has ended, or may not be changed
                    os.sched_setscheduler(thread, *own)


def _classes() -> dict[int, int]:
    """Number of the scheduling class of each thread of this process."""
    found = {}
    for thread in _THREADS.iterdir():
        with suppress(OSError):  # it has ended
            found[int(thread.name)] = os.sched_getscheduler(int(thread.name))
    return found
