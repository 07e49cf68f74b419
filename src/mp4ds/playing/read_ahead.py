"""Threads that read ahead: what they made waits in a bounded queue."""

from __future__ import annotations

import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Generic, TypeVar

T = TypeVar("T")

_SWITCH_S = 0.001


class ReadAhead(Generic[T]):
    """An iterator whose items are made by a thread of its own, a bounded number ahead.

    Args:
        items: What makes them; used by the thread alone.
        depth: Most items that wait.
        on_ready: Called, by the thread, when an item can be had where there was none.
    """

    def __init__(
        self, items: Iterator[T], depth: int, *, on_ready: Callable[[], None] | None = None
    ) -> None:
        self._items = items
        self._depth = depth
        self._on_ready = on_ready
        self._changed = threading.Condition()
        self._waiting: deque[T] = deque()
        self._is_closed = False
        self._is_done = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def __len__(self) -> int:
        """Items that wait."""
        return len(self._waiting)

    def __iter__(self) -> Iterator[T]:
        return self

    def __next__(self) -> T:
        with self._changed:
            while not self._waiting and not self._is_done and not self._is_closed:
                self._changed.wait()
            return self._take()

    def head(self) -> T | None:
        """The next item, which stays; None while it is not made yet.

        Raises:
            StopIteration: There are no more.
            BaseException: What the source raised.
        """
        with self._changed:
            if self._waiting:
                return self._waiting[0]
            if self._is_done or self._is_closed:
                return self._take()
            return None

    def _take(self) -> T:
        if self._waiting:
            item = self._waiting.popleft()
            self._changed.notify_all()
            return item
        if self._error is not None:
            raise self._error
        raise StopIteration

    def _work(self) -> None:
        try:
            for item in self._items:
                if not self._put(item):
                    break
        except BaseException as error:
            self._error = error
        finally:
            close = getattr(self._items, "close", None)
            if close is not None:  # a generator has files open
                close()
            with self._changed:
                self._is_done = True
                self._changed.notify_all()
            self._tell()

    def _put(self, item: T) -> bool:
        with self._changed:
            while len(self._waiting) >= self._depth and not self._is_closed:
                self._changed.wait()
            if self._is_closed:
                return False
            is_first = not self._waiting
            self._waiting.append(item)
            self._changed.notify_all()
        if is_first:
            self._tell()
        return True

    def _tell(self) -> None:
        if self._on_ready is not None:
            self._on_ready()

    def stop(self) -> None:
        """Tell the thread to end after the item that it makes."""
        with self._changed:
            self._is_closed = True
            self._waiting.clear()
            self._changed.notify_all()

    def join(self) -> None:
        """Wait until the thread ended and what it read from is closed."""
        self._thread.join()


@contextmanager
def quick_switches() -> Iterator[None]:
    """Lets a thread that waits for the interpreter have it sooner than Python does by default."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before)
