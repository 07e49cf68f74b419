"""Tests wait for events: nothing is said of how long they take on a busy machine."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable
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
