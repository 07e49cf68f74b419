"""What a worker of a Dask cluster runs: a task, once its memory is free there."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from mp4ds.engine.memory import give_back

_PATIENCE_SECONDS = 3.0
_MIB = 2**20


class TaskFailedError(Exception):
    """What a task failed with, in strings: the error itself may not survive the journey.

    Args:
        kind: Name of its class.
        sentence: What it says.
    """

    def __init__(self, kind: str, sentence: str) -> None:
        self.kind = kind
        self.sentence = sentence
        super().__init__(kind, sentence)


class Room:
    """The memory of a worker, as its tasks share it out among themselves.

    Args:
        size: Bytes.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self._taken = 0
        self._changed = threading.Condition()

    @contextmanager
    def taken(self, count: int) -> Iterator[bool]:
        """Hold some of it.

        Args:
            count: Bytes.

        Yields:
            Whether they came free in a few seconds.
        """
        with self._changed:
            has_room = self._changed.wait_for(
                lambda: self._taken + count <= self.size, _PATIENCE_SECONDS
            )
            self._taken += count * has_room
        try:
            yield has_room
        finally:
            with self._changed:
                self._taken -= count * has_room
                self._changed.notify_all()


def attempt(task: tuple[str, ...], *, function: Callable[..., None], task_bytes: int) -> None:
    """Run a task in a thread of this worker.

    Where other tasks hold the worker's memory, it goes back to the scheduler, which gives it to
    another worker or here again: a task that waited here would keep a thread, and would run
    even if it is no longer wanted.

    Args:
        task: Strings that the function takes.
        function: What to call.
        task_bytes: Memory that it takes.

    Raises:
        TaskFailedError: It failed, or this worker is too small.
        Reschedule: There is no room now.
    """
    from distributed import Reschedule, get_worker

    worker = get_worker()
    limit: int | None = worker.memory_manager.memory_limit
    if not limit:
        return _call(function, task, worker.address)
    if limit < task_bytes:
        raise TaskFailedError(
            "OptionError",
            f"on worker {worker.address}: it has {limit // _MIB} MiB of memory, and a task takes "
            f"up to {-(-task_bytes // _MIB)} MiB. Start workers with a larger --memory-limit.",
        )
    # The worker keeps it, for all packs that it works for share its memory.
    room: Room = vars(worker).setdefault("mp4ds_room", Room(limit))
    with room.taken(task_bytes) as has_room:
        if not has_room:
            raise Reschedule
        return _call(function, task, worker.address)


def _call(function: Callable[..., None], task: tuple[str, ...], where: str) -> None:
    try:
        function(*task)
    except MemoryError:
        raise TaskFailedError("MemoryError", f"on worker {where}: out of memory.") from None
    except Exception as error:
        kind = type(error).__name__
        raise TaskFailedError(kind, f"on worker {where}: {str(error) or kind}") from None
    finally:
        give_back()  # with too much of it, a worker is paused and takes no more tasks
