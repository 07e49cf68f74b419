"""Where a recorder gets its messages from: a node that subscribes to wanted topics."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence

from mp4ds.bags.protocols import Format
from mp4ds.errors import Mp4dsError, Refused
from mp4ds.plugins.recording.options import RecordOptions, Wanted
from mp4ds.plugins.ros.node import CLOCK, Node, NodeOptions, Service, open_node
from mp4ds.plugins.ros.qos import load_overrides
from mp4ds.plugins.ros.ros2 import is_hidden
from mp4ds.records import Channel, Message

_CLOCK_POLL_S = 0.01
_NODES = {"ros1": "record", "ros2": "rosbag2_recorder"}
"""Node names of ROS's own recorders."""


class Source:
    """Receives the messages of wanted topics, including topics that appear later.

    Args:
        node: Closed with this.
        options: How to record.

    Attributes:
        profile: ``ros1`` or ``ros2``.
        format: The format of ROS's own recorder.
        address: What it is connected to, to be displayed.
        warnings: Sentences, each to be shown once.
        topics: Topics subscribed to, with their channel if it is known before the first message.
        waiting_for: The clock topic that the recording waits for; empty once the clock runs.
    """

    def __init__(self, node: Node, options: RecordOptions) -> None:
        self.profile = node.world or ""
        self.format: Format = "bag" if node.world == "ros1" else "rosbag2"
        self.address = node.address
        self.warnings: dict[str, None] = {}
        self.topics: dict[str, Channel | None] = {}
        self.waiting_for = ""
        self._node = node
        self._options = options
        self._recorded_as: Callable[[str], str] = str
        self._failed: Counter[str] = Counter()
        self._sim_time_ns: int | None = None
        self._subscribed: set[str] = set()
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def lost(self) -> Counter[str]:
        """Messages that the middleware reports as lost, or that could not be taken, by topic."""
        by_node = {self._recorded_as(topic): count for topic, count in self._node.lost.items()}
        return self._failed + Counter(by_node)

    def warn(self, sentence: str) -> None:
        """Add a warning."""
        self.warnings[sentence] = None

    def start(self, wanted: Wanted, take: Callable[[Message], None]) -> None:
        """Start receiving, in threads of its own.

        With a simulated time, it subscribes to topics only once /clock has published a time, as
        `ros2 bag record` does: earlier messages would have none, and latched ones still arrive.

        Args:
            wanted: Which topics to receive.
            take: Called with each message, from any thread; it does not block. Each channel has an
                id of its own.

        Raises:
            PublishError: The middleware refuses.
        """
        self._recorded_as = wanted.recorded_as
        names = self._options.names
        if self._options.use_sim_time or names.use_sim_time or self._node.wants_clock:
            self.waiting_for = names.renamed(CLOCK)
            self._node.follow_clock(self._tick)
        else:
            self._look(wanted, take)
        self._thread = threading.Thread(
            target=self._keep_looking, args=(wanted, take), name="topics", daemon=True
        )
        self._thread.start()

    def serve(self, services: Sequence[Service]) -> None:
        """Offer remote control, as `ros2 bag record` does; `rosbag record` has none."""
        if self.profile == "ros2":
            self._node.serve(services)

    def _tick(self, time_ns: int) -> None:
        if time_ns:  # 0 means that the clock has not started
            self._sim_time_ns, self.waiting_for = time_ns, ""

    def _keep_looking(self, wanted: Wanted, take: Callable[[Message], None]) -> None:
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
                self._look(wanted, take)
                is_clear = True
            except Mp4dsError as error:
                self.warn(f"new topics are not noticed: {error}")
                self._ended.wait(poll_s)

    def _look(self, wanted: Wanted, take: Callable[[Message], None]) -> None:
        """Subscribe to new topics."""
        is_leaf_wanted = not self._options.ignore_leaf or self.profile != "ros2"
        heard = None if is_leaf_wanted else self._node.subscribed_topics()

        def is_new(topic: str, kind: str) -> bool:
            is_shown = self._options.hidden or self.profile != "ros2" or not is_hidden(topic)
            is_due = topic not in self._subscribed and (heard is None or topic in heard)
            return is_due and is_shown and wanted(topic, kind)

        for topic, kinds in self._node.topics(is_new).items():
            self._subscribed.add(topic)
            self._subscribe(topic, kinds, take)

    def _subscribe(self, topic: str, kinds: Sequence[str], take: Callable[[Message], None]) -> None:
        name = self._recorded_as(topic)

        def receive(channel: Channel, data: bytes, sent_ns: int) -> None:
            # middlewares swallow, or crash on, what a callback raises
            try:
                now = time.time_ns() if self._sim_time_ns is None else self._sim_time_ns
                take(Message(channel, now, sent_ns if sent_ns > 0 else now, 0, data))
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


def open_source(kind: str, options: RecordOptions) -> Source:
    """Open a source.

    Args:
        kind: ``ros1`` or ``ros2``.
        options: How to record.

    Raises:
        OptionError: An option is not valid there.
        PublishError: The middleware is not installed, or cannot be reached.
    """
    node = open_node(
        kind,
        NodeOptions(
            options.node or _NODES[kind],
            options.names,
            overrides=load_overrides(options.qos_overrides),
            unpublished=options.unpublished,
        ),
    )
    return Source(node, options)
