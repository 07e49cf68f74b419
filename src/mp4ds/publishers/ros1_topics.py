"""A topic of ROS 1, whose messages each subscriber gets at its own pace.

rospy sets up the connections; what is sent over them is decided here, and not in rospy's
``publish()``, because

- rospy latches the last message of a topic, ROS 1's own player the last one of each publisher
  that was recorded;
- rospy's queues are bounded by messages alone: a hundred images for a subscriber that stands still
  are gigabytes;
- rospy cannot tell when a queue is empty, and what is in it when the node ends is lost.
"""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

MAX_BYTES = 128 << 20
"""What waits for one subscriber of a topic: nearly a second of a 5 MB camera at 30 Hz."""

_LENGTH = struct.Struct("<I")


@dataclass(frozen=True, slots=True)
class MessageType:
    """What ROS 1 calls a type.

    Attributes:
        name: Such as ``sensor_msgs/Image``.
        md5sum: By which publishers and subscribers know that they mean the same.
        definition: The text, with those of the types it refers to; may be empty.
    """

    name: str
    md5sum: str
    definition: bytes


class Sender:
    """Sends to one subscriber, on a thread of its own, so that nobody waits for a slow one.

    Args:
        transport: rospy's connection to it.
        messages: How many may wait, 0 for as many as `MAX_BYTES` allows; beyond, the oldest is
            dropped.
    """

    def __init__(self, transport: Any, messages: int) -> None:
        self.dropped = 0
        self._transport = transport
        self._messages = messages
        self._queue: deque[bytes] = deque()
        self._bytes = 0
        self._taken = 0
        self._is_sending = False
        self._is_behind = False  # was waited for in vain
        self._is_over = False
        self._changed = threading.Condition()
        connection = transport.socket
        if connection is not None:
            # A small message would wait for the receipt of the one before: 40 ms on Linux.
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        threading.Thread(target=self._run, name="ros1-sender", daemon=True).start()

    def put(self, data: bytes, wait_s: float) -> None:
        """Queue a message.

        Args:
            data: As it is sent.
            wait_s: How long to wait for a subscriber that takes nothing, if its queue is full.
        """
        with self._changed:
            if wait_s and not self._is_behind:
                self._wait_for_room(len(data), wait_s)
            while self._queue and self._is_full(len(data)):
                self._bytes -= len(self._queue.popleft())
                self.dropped += 1
            self._queue.append(data)
            self._bytes += len(data)
            self._changed.notify_all()

    def flush(self, deadline: float) -> None:
        """Wait until all is sent, but not beyond a time of ``time.monotonic()``."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._is_over or not (self._queue or self._is_sending),
                max(0.0, deadline - time.monotonic()),
            )

    def end(self) -> None:
        """Send nothing more."""
        with self._changed:
            self._is_over = True
            self._queue.clear()
            self._bytes = 0
            self._changed.notify_all()

    def _is_full(self, more: int) -> bool:
        is_long = 0 < self._messages <= len(self._queue)
        return bool(self._queue) and (is_long or self._bytes + more > MAX_BYTES)

    def _wait_for_room(self, more: int, wait_s: float) -> None:
        while self._is_full(more) and not self._is_over:
            before = self._taken
            self._changed.wait(wait_s)  # until the next is taken
            if self._taken == before:
                self._is_behind = True
                return

    def _run(self) -> None:
        while (data := self._next()) is not None:
            try:
                self._transport.write_data(data)
            except Exception:  # the socket's errors, rospy's, and those of a race between both
                break
        self.end()
        self._transport.close()

    def _next(self) -> bytes | None:
        with self._changed:
            self._is_sending = False
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._is_over or self._queue)
            if self._is_over:
                return None
            data = self._queue.popleft()
            self._bytes -= len(data)
            self._taken += 1
            self._is_sending = True
            if not self._queue:
                self._is_behind = False
            self._changed.notify_all()
            return data


class Topic:
    """A topic that is advertised.

    Args:
        name: As it is advertised.
        kind: The type of its messages.
        make_publisher: Makes a publisher of rospy without a queue; called with a name, a type and
            who is told of subscribers.
        messages: How many may wait for each subscriber.
    """

    def __init__(
        self,
        name: str,
        kind: MessageType,
        make_publisher: Callable[[str, MessageType, Any], Any],
        *,
        messages: int,
    ) -> None:
        self.kind = kind
        self._messages = messages
        self._lock = threading.Lock()
        self._senders: dict[Any, Sender] = {}
        self._latched: dict[str, bytes] = {}  # by who published it
        self._dropped = 0
        with self._lock:  # the first may come before rospy returns
            self._publisher = make_publisher(name, kind, self)
            self._greet()

    @property
    def subscribers(self) -> int:
        """How many there are now."""
        return int(self._publisher.get_num_connections())

    @property
    def dropped(self) -> int:
        """Messages that were dropped since a subscriber was too slow."""
        with self._lock:
            return self._dropped + sum(sender.dropped for sender in self._senders.values())

    def mark_latched(self) -> None:
        """Tell subscribers to come that it is latched."""
        self._publisher.impl.add_headers({"latching": "1"})

    def publish(
        self, payload: bytes | memoryview, *, caller: str | None = None, wait_s: float = 0.0
    ) -> None:
        """Send a message to all subscribers.

        Args:
            payload: The message; not kept unless it is latched.
            caller: Who published it, if the last one of each is to be latched.
            wait_s: How long to wait for a subscriber that takes nothing and has a full queue.
        """
        with self._lock:
            self._greet()
            if not self._senders and caller is None:
                return
            data = b"".join((_LENGTH.pack(len(payload)), payload))
            for sender in self._senders.values():
                sender.put(data, wait_s)
            if caller is not None:
                self._latched.pop(caller, None)  # the latest comes last
                self._latched[caller] = data

    def flush(self, deadline: float) -> None:
        """Wait until all is sent, but not beyond a time of ``time.monotonic()``."""
        with self._lock:
            senders = list(self._senders.values())
        for sender in senders:
            sender.flush(deadline)

    def end(self) -> None:
        """Send nothing more."""
        with self._lock:
            for sender in self._senders.values():
                sender.end()

    def peer_subscribe(self, *_: object) -> None:
        """Called by rospy when it has made a connection."""
        with self._lock:
            self._greet()

    def peer_unsubscribe(self, *_: object) -> None:
        """Called by rospy when it has lost one: its sender ends by itself."""

    def _greet(self) -> None:
        """Give those that have come what is latched, before anything else; forget the others."""
        connections = self._publisher.impl.connections
        if len(connections) == len(self._senders) and all(c in self._senders for c in connections):
            return
        for gone in self._senders.keys() - set(connections):
            sender = self._senders.pop(gone)
            sender.end()
            self._dropped += sender.dropped
        for connection in connections:
            if connection not in self._senders:
                sender = self._senders[connection] = Sender(connection, self._messages)
                for data in self._latched.values():
                    sender.put(data, 0.0)
