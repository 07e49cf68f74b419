"""Receives messages from ROS 1, with rospy."""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from mp4ds.bags.protocols import Format
from mp4ds.bags.ros1_records import make_channel
from mp4ds.errors import PublishError
from mp4ds.plugins.publishing.ros1 import ANSWER_S, answer, start_node
from mp4ds.plugins.recording.source import (
    RecorderControls,
    SourceOptions,
    SourceState,
    Wanted,
    told,
)
from mp4ds.records import Channel, Message

_RECEIVED_BYTES = 2**18
"""Bytes read from a socket at a time; rospy's 64 KB take a third more CPU time."""

_LEAST_POLL_S = 0.5
"""Seconds between two queries of the master, at least: they go over the network."""

_CLOCK_POLL_S = 0.01
_DEAF = "the ROS master does not respond: new topics are not noticed"
_TIME = struct.Struct("<II")
_CLOCK = "/clock"


class RospySource:
    """Receives as a node of ROS 1. See `Source`.

    Each publisher of a topic has its own channel, whose metadata is the connection header, as
    `rosbag record` keeps it.

    Args:
        options: How to receive.

    Raises:
        PublishError: rospy is missing, or no master responds.
    """

    format: Format = "bag"
    profile = "ros1"

    def __init__(self, options: SourceOptions) -> None:
        self.state = SourceState()
        self._options = options
        self._rospy, self.address = start_node(options.node, options.names)
        self._subscribers: dict[str, Any] = {}
        self._channels: dict[tuple[str, tuple[tuple[str, str], ...]], Channel] = {}
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None
        self._sim_time_ns: int | None = None

    def start(self, wanted: Wanted, take: Callable[[Message], None]) -> None:
        """See `Source.start`."""
        is_simulated = self._options.use_sim_time or self._follows_clock()
        if is_simulated:
            self.state.waiting_for = self._options.names.renamed(_CLOCK)
            self._subscribe(self.state.waiting_for, self._tick)
        elif not self._look(wanted, take):
            raise PublishError(self.address, "the ROS master no longer responds")
        if self._options.poll_s is not None or is_simulated:
            self._thread = threading.Thread(
                target=self._keep_looking, args=(wanted, take), name="topics", daemon=True
            )
            self._thread.start()

    def serve(self, controls: RecorderControls) -> None:
        """Offer nothing: `rosbag record` has no services."""

    def _follows_clock(self) -> bool:
        return bool(self._rospy.get_param("/use_sim_time", False))

    def _keep_looking(self, wanted: Wanted, take: Callable[[Message], None]) -> None:
        while self.state.waiting_for:
            if self._ended.wait(_CLOCK_POLL_S):
                return
        wait_s = 0.0 if self._sim_time_ns is not None else self._poll_s
        while not self._ended.wait(wait_s):
            if not self._look(wanted, take):
                self.state.warn(_DEAF)
            elif self._options.poll_s is None:
                return
            wait_s = self._poll_s

    @property
    def _poll_s(self) -> float:
        return max(self._options.poll_s or 0.0, _LEAST_POLL_S)

    def _look(self, wanted: Wanted, take: Callable[[Message], None]) -> bool:
        """Subscribe to new topics; returns whether the master responded."""
        try:
            found = answer(self._rospy.get_published_topics, ANSWER_S)
        except (OSError, self._rospy.ROSException):
            return False
        for topic, type_name in found or ():
            if topic not in self._subscribers and wanted(topic, type_name):
                name = wanted.recorded_as(topic)
                receive = told(self.state, name, partial(self._received, name, take))
                self._subscribers[topic] = self._subscribe(topic, receive)
                self.state.topics[name] = None
        return found is not None

    def _subscribe(self, topic: str, receive: Callable[[Any], None]) -> Any:
        return self._rospy.Subscriber(
            topic, self._rospy.AnyMsg, receive, buff_size=_RECEIVED_BYTES, tcp_nodelay=True
        )

    def _received(self, topic: str, take: Callable[[Message], None], message: Any) -> None:
        now = time.time_ns() if self._sim_time_ns is None else self._sim_time_ns
        channel = self._channel(topic, message._connection_header)
        take(Message(channel, now, now, 0, message._buff))

    def _tick(self, message: Any) -> None:
        sec, nsec = _TIME.unpack_from(message._buff)
        if now := sec * 10**9 + nsec:  # 0 means that the clock has not started
            self._sim_time_ns, self.state.waiting_for = now, ""

    def _channel(self, topic: str, header: Mapping[str, str]) -> Channel:
        key = topic, tuple(sorted(header.items()))
        with self._lock:
            if key not in self._channels:
                raw = {name.encode(): value.encode() for name, value in header.items()}
                self._channels[key] = make_channel(len(self._channels), topic.encode(), raw)
            return self._channels[key]

    def close(self) -> None:
        """See `Source.close`."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join(ANSWER_S)
        for subscriber in self._subscribers.values():
            subscriber.unregister()
        self._subscribers.clear()
        self._rospy.signal_shutdown("the recording has ended")
