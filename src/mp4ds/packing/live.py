"""A recording that is being made, packed while its messages come.

Nothing waits: an image that its encoder has no time for is kept verbatim, what there is no memory
for is dropped and counted. What came is on the disk within two seconds, but for the frames that an
encoder holds (spec/index.md, "Unfinished recordings").
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from mp4ds.bags.protocols import BagReader, Format
from mp4ds.files.sources import JOURNAL_NAME
from mp4ds.packing.engine import Workers
from mp4ds.packing.journal import Journal
from mp4ds.packing.manifest import PartRecord
from mp4ds.packing.packer import TOO_LATE, Packer, PartSettings
from mp4ds.records import Channel, Excerpt, Message, Record
from mp4ds.times import INT64_MAX

LATE_S = 0.5
"""Seconds that an image may wait for its encoder."""

_CHECKPOINT_S = 0.5
_NICE = 10
_BEHIND = 1 / 8
"""Of the buffer: where so much waits, images are not encoded but written as they came."""


class Intake:
    """Messages on their way from those who receive them to the one who packs them.

    Args:
        most_bytes: Payloads that wait at most; beyond, the oldest messages are dropped and counted.
        last_ns: The latest log or publish time that the recording can hold; the first one is 0.
    """

    def __init__(self, most_bytes: int, last_ns: int = INT64_MAX) -> None:
        self.dropped: Counter[str] = Counter()
        self.untimed: Counter[str] = Counter()  # with a time that no recording can hold
        self.received: Counter[str] = Counter()
        self.received_bytes: Counter[str] = Counter()
        self._most = most_bytes
        self._last_ns = last_ns
        self._bytes = 0
        self._waiting: deque[Message] = deque()
        self._changed = threading.Condition()
        self._is_closed = False

    @property
    def is_behind(self) -> bool:
        """Whether so much waits that it should be taken out in the quickest way."""
        return self._bytes > self._most * _BEHIND

    @property
    def waiting_bytes(self) -> int:
        """Payloads that wait."""
        return self._bytes

    def put(self, message: Message) -> None:
        """Take a message, from any thread; it never waits."""
        topic = message.channel.topic
        with self._changed:
            if self._is_closed:
                return
            self.received[topic] += 1
            self.received_bytes[topic] += len(message.data)
            times = message.log_time, message.publish_time
            if min(times) < 0 or max(times) > self._last_ns:
                self.untimed[topic] += 1
                return
            while self._waiting and self._bytes + len(message.data) > self._most:
                gone = self._waiting.popleft()
                self._bytes -= len(gone.data)
                self.dropped[gone.channel.topic] += 1
            self._waiting.append(message)
            self._bytes += len(message.data)
            self._changed.notify()

    def take(self, wait_s: float) -> Message | None:
        """The next message; None where none came in time.

        Raises:
            EOFError: There are no more.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._is_closed, wait_s)
            if self._waiting:
                message = self._waiting.popleft()
                self._bytes -= len(message.data)
                return message
            if self._is_closed:
                raise EOFError
            return None

    def close(self) -> None:
        """Take nothing more; what waits is still given out."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()


class PromptWorkers(Workers):
    """A thread for each key; nobody waits for one, but is told that it is late. See `Workers`.

    Args:
        is_behind: Whether there are more urgent things to do than jobs.
    """

    def __init__(self, is_behind: Callable[[], bool] = lambda: False) -> None:
        super().__init__(0)
        self._is_behind = is_behind
        self._begun: dict[int, deque[float]] = {}
        self._jobs: dict[int, deque[Callable[[], None]]] = {}
        self._own: dict[int, threading.Thread] = {}
        self._work = threading.Condition()
        self._is_ending = False

    def submit(self, key: int, job: Callable[[], None]) -> None:
        """See `Workers.submit`; it does not wait."""
        self._raise_error()
        with self._work:
            if key not in self._own:
                self._begun[key], self._jobs[key] = deque(), deque()
                self._own[key] = threading.Thread(target=self._run_jobs, args=(key,), daemon=True)
                self._own[key].start()
            self._begun[key].append(time.monotonic())
            self._jobs[key].append(job)
            self._work.notify_all()

    def is_late(self, key: int) -> bool:
        """Whether there is no time for a job: another has waited for `LATE_S`."""
        return self._is_behind() or self.age(key) > LATE_S

    def age(self, key: int) -> float:
        """Seconds since the job that is next, or at work, came; 0 where there is none."""
        with suppress(IndexError, KeyError):
            return time.monotonic() - self._begun[key][0]
        return 0.0

    def _run_jobs(self, key: int) -> None:
        jobs, begun = self._jobs[key], self._begun[key]
        if sys.platform == "linux":  # where threads have priorities: to receive comes first
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
        while True:
            with self._work:
                self._work.wait_for(lambda: jobs or self._is_ending)
                if not jobs:
                    return
                job = jobs.popleft()
            try:
                if self._error is None:
                    job()
            except BaseException as error:
                self._error = self._error or error
            begun.popleft()
            del job  # and the message that it holds

    def join(self) -> None:
        """See `Workers.join`."""
        with self._work:
            self._is_ending = True
            self._work.notify_all()
        for thread in self._own.values():
            thread.join()
        self._raise_error()


class LiveRecording(BagReader):
    """What is told of a recording while it is made.

    Args:
        path: Where it is made.
        format: What it would have been recorded as: ``bag`` or ``rosbag2``.
        profile: ``ros1`` or ``ros2``.
        others: What it holds besides messages.
    """

    files = ()
    channels: Sequence[Channel] = ()

    def __init__(
        self,
        path: Path,
        format: Format,  # noqa: A002
        profile: str,
        others: Sequence[Record] = (),
    ) -> None:
        self.path = path
        self.format = format
        self.profile = profile
        self.channels: list[Channel] = []
        self._others = others

    def _records(self, excerpt: Excerpt) -> Iterator[Record]:
        """What it holds besides messages, which come to `LivePacker`."""
        del excerpt
        return iter(self._others)


class LivePacker(Packer):
    """Packs messages as they come. See `Packer`; of its results nothing differs.

    Args:
        recording: What is recorded.
        folder: The folder to fill, empty.
        settings: How; of live streams.
        journal: Where to note what is done.
        intake: Where messages come from.
        announced: The channels known so far, some of which may have no messages.
        is_over: Asked between messages whether no more belong to this recording.
        on_read: Called when the last message was taken, before videos are finished.
    """

    def __init__(
        self,
        recording: LiveRecording,
        folder: Path,
        settings: PartSettings,
        journal: Journal,
        *,
        intake: Intake,
        announced: Callable[[], Iterable[Channel]],
        is_over: Callable[[PartRecord], bool],
        on_read: Callable[[], None],
    ) -> None:
        super().__init__(recording, folder, settings, journal=journal)
        self._recording = recording
        self._folder = folder
        self._intake = intake
        self._announced = announced
        self._is_over = is_over
        self._on_read = on_read

    @property
    def part(self) -> PartRecord:
        """What was packed so far."""
        return self._part

    def _read(self) -> None:
        channels: dict[int, Channel] = {}
        next_checkpoint = time.monotonic() + _CHECKPOINT_S
        with _Syncing(self._folder) as syncing, PromptWorkers(self._is_behind) as workers:
            for record in self._recording.records():
                self._take(record, workers)
            while not self._is_over(self._part):
                try:
                    message = self._intake.take(max(0.0, next_checkpoint - time.monotonic()))
                except EOFError:
                    break
                if message is not None:
                    channels[message.channel.id] = message.channel
                    self._take(message, workers)
                if time.monotonic() >= next_checkpoint:
                    self._verbatim.flush()
                    if not self._intake.is_behind:
                        syncing.ask()
                    next_checkpoint = time.monotonic() + _CHECKPOINT_S
            channels |= {channel.id: channel for channel in self._announced()}
            self._recording.channels = list(channels.values())
            self._on_read()
            self._cameras.settle(workers)
        self._calibrations.finish()

    def _is_behind(self) -> bool:
        return self._intake.is_behind

    def _keep(self, message: Message, reason: str = "") -> None:
        # where there is no time to encode, there is none to compress either
        self._verbatim.add_channel(message.channel)
        self._verbatim.write(message, compress=reason != TOO_LATE)


class _Syncing:
    """Lets the disk have what was written, on a thread of its own. A context manager."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._asked = threading.Event()
        self._is_ending = False
        self._thread = threading.Thread(target=self._run, name="sync", daemon=True)

    def ask(self) -> None:
        """Have everything that was written so far put onto the disk soon."""
        self._asked.set()

    def _run(self) -> None:
        while self._asked.wait() and not self._is_ending:
            self._asked.clear()
            # the journal first, without which a frame is of no use
            for path in sorted(self._folder.iterdir(), key=lambda path: path.name != JOURNAL_NAME):
                with suppress(OSError):  # what the disk refuses, its writer is told, too
                    _sync(path)
            with suppress(OSError):
                _sync(self._folder)

    def __enter__(self) -> _Syncing:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_ending = True
        self._asked.set()
        self._thread.join()


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        getattr(os, "fdatasync", os.fsync)(descriptor)
    finally:
        os.close(descriptor)
