"""Orders to a process by lines of JSON."""

from __future__ import annotations

import io
import json
import os
import queue
import sys
import threading
from collections.abc import Iterator
from typing import Any

from mp4ds.packing.processes import release_memory

__all__ = ["Orders", "release_memory", "tell"]


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
