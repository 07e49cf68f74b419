"""Receives what a recorder records: subscribes to topics, and buffers their messages."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from mp4ds.errors import Mp4dsError, Refused
from mp4ds.plugins.recording.options import RecordOptions, Wanted
from mp4ds.plugins.ros.node import CLOCK, Node
from mp4ds.plugins.ros.ros2 import is_hidden
from mp4ds.records import Channel, Message
from mp4ds.times import INT64_MAX

_CLOCK_POLL_S = 0.01


@dataclass
class TopicProgress:
    """What came of a topic.

    Attributes:
        messages: Messages received.
        bytes: Their payloads.
        dropped: Messages dropped because the buffer was full.
        untimed: Messages left out because their log time is negative or too large.
        lost: Messages lost, as reported by the middleware.
        hz: Messages per second, recently.
        bytes_per_s: Bytes per second, recently.
    """

    messages: int = 0
    bytes: int = 0
    dropped: int = 0
    untimed: int = 0
    lost: int = 0
    hz: float = 0.0
    bytes_per_s: float = 0.0


class Source:
    """Receives the messages of wanted topics, including topics that appear later.

    Args:
        node: Closed with this.
        options: How to record.
        wanted: Which topics to receive.
        take: Called with each message, from any thread; it does not block. Each channel has an
            id of its own.

    Attributes:
        warnings: Sentences, each to be shown once.
        topics: Topics subscribed to, with their channel if it is known before the first message.
        waiting_for: The clock topic that the recording waits for; empty once the clock runs.
    """

    def __init__(
        self, node: Node, options: RecordOptions, wanted: Wanted, take: Callable[[Message], None]
    ) -> None:
        self.warnings: dict[str, None] = {}
        self.topics: dict[str, Channel | None] = {}
        self.waiting_for = ""
        self._node = node
        self._options = options
        self._wanted = wanted
        self._take = take
        self._failed: Counter[str] = Counter()
        self._sim_time_ns: int | None = None
        self._subscribed: set[str] = set()
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def lost(self) -> Counter[str]:
        """Messages that the middleware reports as lost, or that could not be taken, by topic."""
        recorded_as = self._wanted.recorded_as
        by_node = {recorded_as(topic): count for topic, count in self._node.lost.items()}
        return self._failed + Counter(by_node)

    @property
    def now(self) -> int:
        """The log time of a message that arrives now, ns."""
        return time.time_ns() if self._sim_time_ns is None else self._sim_time_ns

    def warn(self, sentence: str) -> None:
        """Add a warning."""
        self.warnings[sentence] = None

    def start(self) -> None:
        """Start receiving, in threads of its own.

        With a simulated time, it subscribes to topics only once /clock has published a time, as
        `ros2 bag record` does: earlier messages would have none, and latched ones still arrive.

        Raises:
            RemoteError: The middleware refuses.
        """
        names = self._options.names
        if self._options.use_sim_time or names.use_sim_time or self._node.wants_clock:
            self.waiting_for = names.renamed(CLOCK)
            self._node.follow_clock(self._tick)
        else:
            self._look()
        self._thread = threading.Thread(target=self._keep_looking, name="topics", daemon=True)
        self._thread.start()

    def _tick(self, time_ns: int) -> None:
        if time_ns:  # 0 means that the clock has not started
            self._sim_time_ns, self.waiting_for = time_ns, ""

    def _keep_looking(self) -> None:
        is_clear = self.waiting_for == ""  # then it has looked once
        while self.waiting_for:
            if self._ended.wait(_CLOCK_POLL_S):
                return
        poll_s = max(self._options.polling_interval / 1000, self._node.poll_s)
        end = time.monotonic() + self._node.discovery_s
        while self._options.discover or not is_clear or time.monotonic() < end:
            if self._ended.wait(poll_s if is_clear else 0.0):
                return
            try:
                self._look()
                is_clear = True
            except Mp4dsError as error:
                self.warn(f"new topics are not noticed: {error}")
                self._ended.wait(poll_s)

    def _look(self) -> None:
        """Subscribe to new topics."""
        is_ros2, options = self._node.world == "ros2", self._options
        heard = self._node.subscribed_topics() if options.ignore_leaf else None
        if options.of_node:
            node = options.names.resolved(options.of_node)
            self._wanted.by_node = self._node.subscribed_topics(node)

        def is_new(topic: str, kind: str) -> bool:
            if topic in self._subscribed or (heard is not None and topic not in heard):
                return False
            is_shown = options.hidden or not is_ros2 or not is_hidden(topic)
            return is_shown and self._wanted(topic, kind)

        for topic, kinds in self._node.topics(is_new).items():
            self._subscribed.add(topic)
            self._subscribe(topic, kinds)

    def _subscribe(self, topic: str, kinds: Sequence[str]) -> None:
        name = self._wanted.recorded_as(topic)

        def receive(channel: Channel, data: bytes, sent_ns: int) -> None:
            # middlewares swallow, or crash on, what a callback raises
            try:
                now = self.now
                self._take(Message(channel, now, sent_ns if sent_ns > 0 else now, 0, data))
            except Exception as error:
                self._failed[name] += 1
                self.warn(f"{name}: a message could not be recorded: {error!r}")

        if len(kinds) > 1:
            self.warn(f"{topic}: has several types: only {kinds[0]} is recorded")
        try:
            channel = self._node.subscribe(topic, kinds[0], name, receive)
        except Refused as reason:
            self.warn(f"{topic}: not recorded: {reason}")
            return
        if channel is not None and channel.schema and not channel.schema.data:
            self.warn(
                f"{topic}: recorded without the definition of {kinds[0]}, which was not found"
            )
        self.topics[name] = channel

    def close(self) -> None:
        """Stop receiving."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join()
        self._node.close()


class MessageBuffer:
    """Messages on their way from the threads that receive them to the one that writes them.

    Args:
        most_bytes: Limit of buffered payloads; beyond, the oldest messages are dropped and counted.
        last_ns: The latest log or publish time that the recording can hold; the first one is 0.
        limit: Messages of each topic to take; later ones are left out.

    Attributes:
        topics: What came of each topic.
        bytes: Buffered payloads.
        put_in: Messages put in so far.
        gone: Messages taken out, or dropped, so far.
    """

    def __init__(self, most_bytes: int, last_ns: int = INT64_MAX, limit: int | None = None) -> None:
        self.topics: dict[str, TopicProgress] = {}
        self._most = most_bytes
        self._last_ns = last_ns
        self._limit = limit
        self.bytes = self.put_in = self.gone = 0
        self._messages: deque[Message] = deque()
        self._changed = threading.Condition()
        self._is_closed = False

    def put(self, message: Message) -> None:
        """Add a message, from any thread; it never waits."""
        with self._changed:
            if self._is_closed:
                return
            topic = self.topics.setdefault(message.channel.topic, TopicProgress())
            if topic.messages == self._limit:
                return
            topic.messages += 1
            topic.bytes += len(message.data)
            times = message.log_time, message.publish_time
            if min(times) < 0 or max(times) > self._last_ns:
                topic.untimed += 1
                return
            while self._messages and self.bytes + len(message.data) > self._most:
                dropped = self._next()
                self.topics[dropped.channel.topic].dropped += 1
            self._messages.append(message)
            self.put_in += 1
            self.bytes += len(message.data)
            self._changed.notify()

    def take(self, wait_s: float) -> Message | None:
        """The next message; None if none came in time.

        Raises:
            EOFError: There are no more.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._messages or self._is_closed, wait_s)
            if self._messages:
                return self._next()
            if self._is_closed:
                raise EOFError
            return None

    def _next(self) -> Message:
        message = self._messages.popleft()
        self.gone += 1
        self.bytes -= len(message.data)
        return message

    def has_all(self, topics: Iterable[str]) -> bool:
        """Whether there are topics, and each has all the messages that are taken of it."""
        found = [self.topics.get(topic, TopicProgress()).messages for topic in topics]
        return set(found) == {self._limit}

    def close(self) -> None:
        """Take no more messages; buffered ones are still given out."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
