"""Tests wait for events and count work: how long anything takes is a matter of the machine."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import Any

WATCHDOG_S = 300.0
"""Seconds after which a test gives up: far more than anything takes."""


def until(is_so: Callable[[], object], process: subprocess.Popen[Any] | None = None) -> None:
    """Wait for something.

    Args:
        is_so: Gives a true value then.
        process: By which it is to come, so that it must not end before.

    Raises:
        AssertionError: It does not come; the process is killed.
    """
    end = time.monotonic() + WATCHDOG_S
    while not is_so():
        is_late = time.monotonic() > end
        if is_late or (process and process.poll() is not None and not is_so()):
            said: object = ""
            if process:
                process.kill()
                said = process.communicate()
            raise AssertionError(f"it {'hangs' if is_late else 'ended before'}: {said}")
        time.sleep(0.005)


def is_alive(pid: int) -> bool:
    """Whether a process runs; one that has ended, and of which nobody has asked, does not."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    with suppress(OSError):  # where there is no /proc
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return True


def lines_run(call: Callable[[], object]) -> int:
    """How many lines of Python something runs: few where all is left to numpy or a library."""
    count = 0

    def trace(_: FrameType, event: str, __: object) -> Any:
        nonlocal count
        count += event == "line"
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        call()
    finally:
        sys.settrace(before)
    return count
