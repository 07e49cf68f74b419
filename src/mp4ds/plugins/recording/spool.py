"""Writes what arrives, with as little work as possible, into pieces of a spool that are cut."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

from mp4ds.bags.mcap import McapWriter
from mp4ds.messages.serializations import is_camera
from mp4ds.packing.inspection import begins_anew, depends_on_others
from mp4ds.packing.spool import SpoolFolder
from mp4ds.records import Channel, Message, MetadataRecord
from mp4ds.times import INT64_MAX

WINDOW_NS = 5 * 10**9
"""Log time that a piece covers."""

_LATE_NS = 10**9
"""How much later than its log time a message may come: threads that receive take turns."""

_GROUP_NS = 60 * 10**9
"""How long a piece stays open, at most, for the next key frame of a video."""


class MessageBuffer:
    """Messages on their way from the threads that receive them to the one that writes them.

    Args:
        most_bytes: Limit of buffered payloads; beyond, the oldest messages are dropped and counted.
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
        self._messages: deque[Message] = deque()
        self._changed = threading.Condition()
        self._is_closed = False

    @property
    def bytes(self) -> int:
        """Buffered payloads."""
        return self._bytes

    def put(self, message: Message) -> None:
        """Add a message, from any thread; it never waits."""
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
            while self._messages and self._bytes + len(message.data) > self._most:
                dropped = self._messages.popleft()
                self._bytes -= len(dropped.data)
                self.dropped[dropped.channel.topic] += 1
            self._messages.append(message)
            self._bytes += len(message.data)
            self._changed.notify()

    def take(self, wait_s: float) -> Message | None:
        """The next message; None if none came in time.

        Raises:
            EOFError: There are no more.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._messages or self._is_closed, wait_s)
            if self._messages:
                message = self._messages.popleft()
                self._bytes -= len(message.data)
                return message
            if self._is_closed:
                raise EOFError
            return None

    def close(self) -> None:
        """Take no more messages; buffered ones are still given out."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()


@dataclass
class _Piece:
    """A piece that is open.

    Attributes:
        start: Log time, ns, of its first message.
        packets: Channels of video packets in it, which stay in it until their next key frame.
    """

    number: int
    writer: McapWriter
    start: int
    bytes: int = 0
    channels: set[int] = field(default_factory=set)
    packets: set[int] = field(default_factory=set)


class SpoolWriter:
    """The spool of one dataset.

    Args:
        folder: Where to write it.
        profile: ``ros1`` or ``ros2``.
        others: What the recording holds besides messages.
        on_closed: Called with number and payload bytes of each complete piece, in their order.

    Raises:
        OSError: It cannot be written.
    """

    def __init__(
        self,
        folder: SpoolFolder,
        profile: str,
        others: Sequence[MetadataRecord],
        on_closed: Callable[[int, int], None],
    ) -> None:
        self.raw_bytes: Counter[str] = Counter()  # by topic
        self.bytes = 0
        self.span: tuple[int, int] | None = None
        self._folder = folder
        self._profile = profile
        self._on_closed = on_closed
        self._depends: dict[int, bool] = {}
        self._open: list[_Piece] = []  # all but the newest take what is late
        self._next = 0
        piece = self._begin(0)
        for record in others:
            piece.writer.add_metadata(record)
        self.flush()

    @property
    def paths(self) -> Sequence[Path]:
        """The files that are being written."""
        return [piece.writer.path for piece in self._open]

    def _begin(self, start: int) -> _Piece:
        path = self._folder.piece(self._next)
        writer = McapWriter(path, profile=self._profile, compression="none")
        self._open.append(_Piece(self._next, writer, start))
        self._next += 1
        return self._open[-1]

    def write(self, message: Message) -> None:
        """Write a message, and close the pieces that get no more.

        Raises:
            OSError: It cannot be written.
        """
        time, newest = message.log_time, self._open[-1]
        if self.span is None:
            newest.start = time
        elif abs(time - newest.start) >= WINDOW_NS:
            self.flush()  # or a kill would leave a gap before what the new piece already has
            self._begin(time)
        start, end = self.span or (time, time)
        self.span = min(start, time), max(end, time)
        self._write(self._piece_for(message), message)
        while len(self._open) > 1:
            age = abs(time - self._open[1].start)
            if age < _LATE_NS or (self._open[0].packets and age < _GROUP_NS):
                break
            self._close(self._open.pop(0))

    def _piece_for(self, message: Message) -> _Piece:
        channel = message.channel.id
        for piece, later in pairwise(self._open):
            if message.log_time < later.start:
                return piece
            if channel in piece.packets:
                if not begins_anew(message):
                    return piece
                piece.packets.remove(channel)
        return self._open[-1]

    def _write(self, piece: _Piece, message: Message) -> None:
        channel = message.channel
        if channel.id not in piece.channels:
            piece.channels.add(channel.id)
            piece.writer.add_channel(channel)
            if channel.id not in self._depends:
                is_video = is_camera(channel) and depends_on_others(channel, message)
                self._depends[channel.id] = is_video
            if self._depends[channel.id]:
                piece.packets.add(channel.id)
        piece.writer.write(message)
        self.raw_bytes[channel.topic] += len(message.data)
        piece.bytes += len(message.data)
        self.bytes += len(message.data)

    def flush(self) -> None:
        """Give the system what was written so far, so that it outlives this process.

        Raises:
            OSError: It cannot be written.
        """
        for piece in self._open:
            piece.writer.flush()

    def _close(self, piece: _Piece) -> None:
        piece.writer.finish()
        self._on_closed(piece.number, piece.bytes)

    def close(self, announced: Iterable[Channel]) -> None:
        """Complete all pieces.

        Args:
            announced: Channels, some of which may have no messages.

        Raises:
            OSError: It cannot be written.
        """
        for channel in announced:
            self._open[-1].writer.add_channel(channel)
        while self._open:
            self._close(self._open.pop(0))

    def abandon(self) -> None:
        """Close all files as they are, with what the disk still takes."""
        with suppress(OSError):
            self.flush()
        while self._open:
            self._open.pop().writer.abandon()
