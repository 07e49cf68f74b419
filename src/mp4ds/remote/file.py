"""A remote file, read by ranges: what is fetched, and what of it is kept."""

from __future__ import annotations

import io
from bisect import bisect_left, bisect_right
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from threading import Lock
from typing import Any

Range = tuple[int, int]
"""First byte, and the one after the last."""

Fetch = Callable[[Sequence[Range]], list[bytes]]
"""Fetches ranges, all at once."""

KEPT_BYTES = 32 * 2**20
"""Of each file, as long as it is open: what comes after the reader finds its bytes here."""

_IDLE_BYTES = 2**20
_LEAST, _MOST = 2**17, 2**22  # read ahead: at first, and after a while of reading in order
_FILL_BYTES = 2 * _MOST
_FIRST_BATCH_BYTES, _BATCH_BYTES, _BATCH_RANGES = 2**19, 2**23, 256
_GAP = 2**16  # less costs less to fetch than to ask twice


class Segments:
    """The bytes of a file that were fetched last, for all who read it at the time.

    Threads may share it.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._data: OrderedDict[int, bytes] = OrderedDict()  # by first byte, the latest last
        self._starts: list[int] = []
        self._size = 0
        self._users = 0

    def claim(self) -> None:
        """Keep bytes until `release`."""
        with self._lock:
            self._users += 1

    def release(self) -> None:
        """Drop what nobody may want any more."""
        with self._lock:
            self._users -= 1
            if not self._users:
                self._shrink(_IDLE_BYTES)

    def add(self, start: int, data: bytes) -> None:
        """Keep bytes that were fetched; none are kept within others."""
        end = start + len(data)
        with self._lock:
            number = bisect_right(self._starts, start) - 1
            if number >= 0 and self._end(number) >= end:
                self._data.move_to_end(self._starts[number])
                return
            number = bisect_left(self._starts, start)
            while number < len(self._starts) and self._end(number) <= end:
                self._size -= len(self._data.pop(self._starts.pop(number)))
            self._starts.insert(number, start)
            self._data[start] = data
            self._size += len(data)
            self._shrink(KEPT_BYTES)

    def _end(self, number: int) -> int:
        start = self._starts[number]
        return start + len(self._data[start])

    def _shrink(self, size: int) -> None:
        while self._size > size and self._data:
            start, data = self._data.popitem(last=False)
            del self._starts[bisect_left(self._starts, start)]
            self._size -= len(data)

    def at(self, place: int) -> tuple[int, bytes] | None:
        """The kept bytes that hold a place, and where they begin."""
        with self._lock:
            number = bisect_right(self._starts, place) - 1
            if number < 0:
                return None
            start = self._starts[number]
            data = self._data[start]
            if place >= start + len(data):
                return None
            self._data.move_to_end(start)
            return start, data

    def hold(self, start: int, end: int) -> bool:
        """Whether all bytes of a range are kept."""
        while start < end:
            found = self.at(start)
            if found is None:
                return False
            start = found[0] + len(found[1])
        return True

    def next_start(self, place: int, default: int) -> int:
        """Where the next kept bytes begin after a place."""
        with self._lock:
            number = bisect_right(self._starts, place)
            return self._starts[number] if number < len(self._starts) else default


class RemoteFile(io.RawIOBase):
    """A remote file, open for reading; `read` gives less than was asked for at the end only.

    Reading in order fetches more and more ahead, reading elsewhere little more than is asked
    for. What was announced by `expect` is fetched while what comes before it is being used.

    Args:
        size: Bytes of the file.
        fetch: Fetches ranges; what it raises, reading raises.
        segments: What is kept of the file.
    """

    def __init__(self, size: int, fetch: Fetch, segments: Segments) -> None:
        super().__init__()
        self._size = size
        self._fetch = fetch
        self._segments = segments
        self._place = 0
        self._read_to = 0
        self._ahead = 0
        self._plan: _Plan | None = None
        segments.claim()

    def expect(self, ranges: Iterable[Range]) -> None:
        """See `mp4ds.remote.expect`; replaces what was announced before."""
        self._drop_plan()
        missing = (span for span in ranges if not self._segments.hold(*span))
        self._plan = _Plan(missing, self._load)

    def read(self, size: int | None = -1, /) -> bytes:
        """Read so many bytes, or all that are left."""
        place = self._place
        wanted = self._size if size is None or size < 0 else place + size
        end = max(place, min(wanted, self._size))
        pieces: list[bytes | memoryview] = []
        while place < end:
            if self._plan:
                self._plan.reach(place)
            found = self._segments.at(place)
            if found is None:
                self._fill(place, end)
                continue
            start, data = found
            piece = memoryview(data)[place - start : end - start]
            pieces.append(piece)
            place += len(piece)
            self._read_to = place
        self._place = place
        return b"".join(pieces)

    def _fill(self, place: int, end: int) -> None:
        """Fetch what is missing from a place on, and something after it."""
        if 0 <= place - self._read_to <= _GAP:
            self._ahead = min(max(2 * self._ahead, _LEAST), _MOST)
        else:
            self._ahead = _LEAST
        wanted = min(max(end, place + self._ahead), place + _FILL_BYTES, self._size)
        stop = self._segments.next_start(place, wanted)
        # Who asks for a file's last bytes wants what stands before them next.
        start = max(0, min(place, self._size - _LEAST)) if stop == self._size else place
        self._load([(start, min(stop, wanted))])

    def _load(self, ranges: Iterable[Range]) -> None:
        pieces = list(_split(ranges, _MOST))
        for (start, _), data in zip(pieces, self._fetch(pieces), strict=True):
            self._segments.add(start, data)

    def readinto(self, buffer: Any, /) -> int:
        """Read into a buffer."""
        view = memoryview(buffer).cast("B")
        data = self.read(len(view))
        view[: len(data)] = data
        return len(data)

    def readable(self) -> bool:
        """Always."""
        return True

    def seekable(self) -> bool:
        """Always."""
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        """Go on elsewhere; costs nothing."""
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._place, io.SEEK_END: self._size}[whence]
        if base + offset < 0:
            raise ValueError(f"seek to {base + offset}, before the file")
        self._place = base + offset
        return self._place

    def tell(self) -> int:
        """Where reading goes on."""
        return self._place

    def close(self) -> None:
        """Stop fetching, and let go of what was fetched."""
        if not self.closed:
            self._drop_plan()
            self._segments.release()
        super().close()

    def _drop_plan(self) -> None:
        if self._plan:
            self._plan.close()
            self._plan = None


def _split(ranges: Iterable[Range], most: int) -> Iterator[Range]:
    """Ranges in pieces of so many bytes at most."""
    for start, end in ranges:
        for first in range(start, end, most):
            yield first, min(first + most, end)


class _Plan:
    """Fetches announced ranges in batches, each while the one before it is being used.

    Args:
        ranges: In the order of reading.
        load: Fetches ranges and keeps them.
    """

    def __init__(self, ranges: Iterable[Range], load: Callable[[Iterable[Range]], None]) -> None:
        self._batches = _batches(ranges)
        self._load = load
        self._worker = ThreadPoolExecutor(1, "mp4ds-fetch")
        self._current: list[Range] = []
        self._next: list[Range] = []
        self._coming: Future[None] | None = None
        self._begin_next()

    def reach(self, place: int) -> None:
        """Wait for the bytes at a place, where they are the next that were announced."""
        while _holds(self._next, place) and not _holds(self._current, place):
            if self._coming is None:
                self._coming = self._worker.submit(self._load, self._next)
            coming, self._coming = self._coming, None
            coming.result()
            self._current = self._next
            self._begin_next()
            if self._next:
                self._coming = self._worker.submit(self._load, self._next)

    def _begin_next(self) -> None:
        self._next = next(self._batches, [])

    def close(self) -> None:
        """Fetch no more."""
        self._worker.shutdown(wait=False, cancel_futures=True)


def _holds(ranges: Sequence[Range], place: int) -> bool:
    return any(start <= place < end for start, end in ranges)


def _batches(ranges: Iterable[Range]) -> Iterator[list[Range]]:
    """Ranges to be fetched at once; those that lie close to each other as one.

    The batches grow, since who reads a little may stop.
    """
    batch: list[Range] = []
    size, most = 0, _FIRST_BATCH_BYTES
    for start, end in _split(ranges, _MOST):
        length = end - start
        if batch and (size + length > most or len(batch) == _BATCH_RANGES):
            yield batch
            batch, size, most = [], 0, min(2 * most, _BATCH_BYTES)
        if batch and 0 <= start - batch[-1][1] <= _GAP:
            size += start - batch[-1][1]
            batch[-1] = batch[-1][0], end
        else:
            batch.append((start, end))
        size += length
    if batch:
        yield batch
