"""A remote file that reads like a local one: what is fetched of it, when, and how much is kept."""

from __future__ import annotations

import io
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
"""Kept per open file, for other readers of the same bytes."""

BLOCK = 2**12
"""What is fetched begins and ends at multiples of this many bytes, or at the file's end."""

# in blocks
_IDLE, _KEPT = 2**20 // BLOCK, KEPT_BYTES // BLOCK
_LEAST, _MOST = 2**17 // BLOCK, 2**22 // BLOCK  # read-ahead: at first, and after reading in order
_FILL, _FIRST_BATCH, _BATCH = 2 * _MOST, 2**18 // BLOCK, 2**23 // BLOCK
_GAP = 2**16 // BLOCK  # smaller gaps cost less to fetch than a second request


class Blocks:
    """The most recently fetched blocks of a file, shared by all its readers, in any thread."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._kept: OrderedDict[int, bytes] = OrderedDict()  # by number, the latest last
        self._readers = 0

    def claim(self) -> None:
        """Keep blocks until `release`."""
        with self._lock:
            self._readers += 1

    def release(self) -> None:
        """Drop what is no longer needed."""
        with self._lock:
            self._readers -= 1
            if not self._readers:
                self._shrink(_IDLE)

    def __contains__(self, number: int) -> bool:
        return number in self._kept

    def get(self, number: int) -> bytes | None:
        """A block, if it is kept."""
        with self._lock:
            if number in self._kept:
                self._kept.move_to_end(number)
            return self._kept.get(number)

    def add(self, first: int, data: bytes) -> None:
        """Keep the fetched blocks from one on."""
        with self._lock:
            for start in range(0, len(data), BLOCK):
                number = first + start // BLOCK
                self._kept[number] = data[start : start + BLOCK]
                self._kept.move_to_end(number)
            self._shrink(_KEPT)

    def _shrink(self, count: int) -> None:
        while len(self._kept) > count:
            self._kept.popitem(last=False)


class RemoteFile(io.RawIOBase):
    """A remote file, open for reading; `read` returns less than requested only at the end.

    Sequential reading fetches more and more ahead, random reading little more than requested.
    Ranges announced by `expect` are fetched in batches, each while the one before it is used.

    Args:
        size: Bytes of the file.
        fetch: Fetches ranges; reading raises its errors.
        blocks: The kept bytes of the file.
    """

    def __init__(self, size: int, fetch: Fetch, blocks: Blocks) -> None:
        super().__init__()
        self._size = size
        self._count = -(-size // BLOCK)
        self._fetch = fetch
        self._blocks = blocks
        self._place = 0
        self._after = 0  # the block after the last one that was read
        self._ahead = 0
        self._batches: Iterator[set[int]] = iter(())
        self._batch: set[int] = set()  # the next announced blocks
        self._coming: Future[None] | None = None
        self._worker: ThreadPoolExecutor | None = None
        blocks.claim()

    def expect(self, ranges: Iterable[Range]) -> None:
        """Announce what will be read; replaces earlier announcements.

        Args:
            ranges: In the order of reading; other bytes may be read between.
        """
        self._forget()
        self._worker = ThreadPoolExecutor(1, "mp4ds-fetch")
        self._batches = self._batched(ranges)
        self._batch = next(self._batches, set())

    def _batched(self, ranges: Iterable[Range]) -> Iterator[set[int]]:
        """The blocks of ranges that are to be fetched together.

        The batches grow, since readers may stop early.
        """
        batch: set[int] = set()
        before: set[int] = set()  # those on their way
        most = _FIRST_BATCH
        for start, end in ranges:  # as an index says, which may be damaged
            for number in range(start // BLOCK, min(-(-end // BLOCK), self._count)):
                if number not in self._blocks and number not in before:
                    batch.add(number)
                if len(batch) == most:
                    yield batch
                    before, batch, most = batch, set(), min(2 * most, _BATCH)
        if batch:
            yield batch

    def read(self, size: int | None = -1, /) -> bytes:
        """Read that many bytes, or all that are left."""
        place = self._place
        wanted = self._size if size is None or size < 0 else place + size
        end = max(place, min(wanted, self._size))
        pieces: list[bytes | memoryview] = []
        while place < end:
            number, skipped = divmod(place, BLOCK)
            if number in self._batch:
                self._await_batch()
            block = self._blocks.get(number)
            if block is None:
                self._fill(number, -(-end // BLOCK))
                continue
            pieces.append(memoryview(block)[skipped : end - number * BLOCK])
            place += len(pieces[-1])
            self._after = number + 1
        self._place = place
        return b"".join(pieces)

    def _await_batch(self) -> None:
        """Wait for the next announced batch, and have the one after it fetched meanwhile."""
        coming, self._coming = self._coming or self._submit(self._batch), None
        coming.result()
        self._batch = next(self._batches, set())
        if self._batch:
            self._coming = self._submit(self._batch)

    def _submit(self, batch: set[int]) -> Future[None]:
        if self._worker is None:
            raise ValueError("the file is closed")
        return self._worker.submit(self._load, sorted(batch))

    def _fill(self, number: int, end: int) -> None:
        """Fetch a missing block, and those after it until something is kept."""
        if 0 <= number - self._after <= _GAP:
            self._ahead = min(max(2 * self._ahead, _LEAST), _MOST)
        else:
            self._ahead = _LEAST
        most = min(max(end, number + self._ahead), number + _FILL, self._count)
        stop = next((other for other in range(number, most) if other in self._blocks), most)
        # after a file's last bytes, readers usually want those before them
        first = max(0, min(number, self._count - _LEAST)) if stop == self._count else number
        self._load(range(first, stop))

    def _load(self, numbers: Sequence[int]) -> None:
        """Fetch blocks, given in order."""
        runs: list[Range] = []
        for number in numbers:
            if runs and number - runs[-1][1] < _GAP and number - runs[-1][0] < _MOST:
                runs[-1] = runs[-1][0], number + 1
            else:
                runs.append((number, number + 1))
        ranges = [(first * BLOCK, min(end * BLOCK, self._size)) for first, end in runs]
        for (first, _), data in zip(runs, self._fetch(ranges), strict=True):
            self._blocks.add(first, data)

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
        """Change the position; costs nothing."""
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._place, io.SEEK_END: self._size}[whence]
        if base + offset < 0:
            raise ValueError(f"seek to {base + offset}, before the file")
        self._place = base + offset
        return self._place

    def tell(self) -> int:
        """The position."""
        return self._place

    def close(self) -> None:
        """Stop fetching, and drop what was fetched."""
        if not self.closed:
            self._forget()
            self._blocks.release()
        super().close()

    def _forget(self) -> None:
        if self._worker:
            self._worker.shutdown(wait=False, cancel_futures=True)
        self._worker = self._coming = None
        self._batches, self._batch = iter(()), set()


def expect(stream: object, ranges: Iterable[Range]) -> None:
    """Announce which bytes of a file will be read, so that a remote one fetches them in time.

    Args:
        stream: From ``open("rb")`` of a local path or a `RemotePath`.
        ranges: First byte and end of each, in the order of reading; other bytes may be read
            between.
    """
    if isinstance(stream, RemoteFile):
        stream.expect(ranges)
