"""Receives messages from ROS 2 with rclpy, whatever its middleware."""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from mp4ds.bags.protocols import Format
from mp4ds.errors import ConversionError, PublishError
from mp4ds.plugins.publishing.ros2 import message_class, qos_profile, serve
from mp4ds.plugins.publishing.ros2_writers import CLOCK, CLOCK_QOS, CLOCK_TYPE, Qos, load_overrides
from mp4ds.plugins.recording.ros2_channels import (
    RECORDER_SERVICES,
    asked_qos,
    channel_of,
    installed_definition,
    is_hidden,
    standard_definition,
    time_of,
)
from mp4ds.plugins.recording.source import (
    RecorderControls,
    SourceOptions,
    SourceState,
    Wanted,
    told,
)
from mp4ds.records import Channel, Message

_DEPTH = 100
"""Depth of subscriptions: messages are taken out at once."""

_SPIN_S = 0.1
_INFINITE_NS = 2**63 - 1


class RclpySource:
    """Receives as a node of the ROS that is sourced. See `Source`.

    The packages with the message types have to be installed.

    Args:
        options: How to receive.

    Raises:
        PublishError: No ROS 2 is sourced.
    """

    format: Format = "rosbag2"
    profile = "ros2"

    def __init__(self, options: SourceOptions) -> None:
        try:
            import rclpy
            from rclpy.context import Context
            from rclpy.executors import SingleThreadedExecutor
        except ImportError as error:
            problem = f"rclpy is missing ({error}); source a ROS 2 first"
            raise PublishError("ROS 2", problem) from None
        self.state = SourceState()
        self._options = options
        overrides = options.qos_overrides
        self._overrides = load_overrides(overrides) if overrides is not None else {}
        self._context = Context()
        rclpy.init(args=[], context=self._context)
        names = options.names
        self._node = rclpy.create_node(
            names.node or options.node, context=self._context, namespace=names.namespace or None
        )
        self.address = f"ROS 2, by rclpy as {self._node.get_name()}"
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._subscriptions: dict[str, Any] = {}
        self._sim_time_ns: int | None = None
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, wanted: Wanted, take: Callable[[Message], None]) -> None:
        """See `Source.start`."""
        if self._options.use_sim_time:
            self.state.waiting_for = self._options.names.renamed(CLOCK)
            kind = message_class(CLOCK, CLOCK_TYPE)
            self._node.create_subscription(
                kind, self.state.waiting_for, self._tick, qos_profile(CLOCK_QOS), raw=True
            )
        else:
            self._look(wanted, take)
        self._thread = threading.Thread(
            target=self._spin, args=(wanted, take), name="mp4ds-rclpy", daemon=True
        )
        self._thread.start()

    def serve(self, controls: RecorderControls) -> None:
        """See `Source.serve`."""
        serve(self._node, RECORDER_SERVICES, controls)

    def _spin(self, wanted: Wanted, take: Callable[[Message], None]) -> None:
        from rclpy.executors import ExternalShutdownException

        every_s = math.inf if self._options.poll_s is None else self._options.poll_s
        next_look = 0.0 if self.state.waiting_for else time.monotonic() + every_s
        try:
            while not self._ended.is_set() and self._context.ok():
                self._executor.spin_once(timeout_sec=_SPIN_S)
                if not self.state.waiting_for and time.monotonic() >= next_look:
                    self._look(wanted, take)
                    next_look = time.monotonic() + every_s
        except ExternalShutdownException:
            pass

    def _look(self, wanted: Wanted, take: Callable[[Message], None]) -> None:
        """Subscribe to new topics."""
        for topic, kinds in self._node.get_topic_names_and_types():
            if topic in self._subscriptions or not any(wanted(topic, kind) for kind in kinds):
                continue
            if is_hidden(topic) and not self._options.hidden:
                continue
            if self._options.ignore_leaf and not self._node.count_subscribers(topic):
                continue
            publishers = self._node.get_publishers_info_by_topic(topic)
            if not (publishers or self._options.unpublished):
                continue
            if len(kinds) > 1:
                self._subscriptions[topic] = None
                self.state.warn(f"{topic}: not recorded: it has several types, {', '.join(kinds)}")
                continue
            self._subscriptions[topic] = self._subscribe(
                topic, wanted.recorded_as(topic), kinds[0], publishers, take
            )

    def _subscribe(
        self,
        topic: str,
        name: str,
        type_name: str,
        publishers: Sequence[Any],
        take: Callable[[Message], None],
    ) -> Any:
        try:
            kind = message_class(topic, type_name)
        except ConversionError as error:
            self.state.warn(f"{topic}: not recorded: {error.problem}")
            return None
        offered = [offered_by(item.qos_profile) for item in publishers]
        hashes = [_hash_text(getattr(item, "topic_type_hash", None)) for item in publishers]
        type_hash = hashes[0] if hashes else ""
        share = [Path(p, "share") for p in os.environ.get("AMENT_PREFIX_PATH", "").split(":") if p]
        definition = installed_definition(type_name, share)
        definition = definition or standard_definition(type_name, type_hash)
        if not definition:
            self.state.warn(
                f"{topic}: recorded without the definition of {type_name}, which was not found"
            )
        channel = channel_of(
            len(self._subscriptions), name, type_name, definition, type_hash, offered
        )
        usual = asked_qos(offered, _DEPTH) if offered else Qos(depth=_DEPTH)
        qos = self._overrides.get(topic, usual)
        self.state.topics[name] = channel
        receive = told(self.state, topic, partial(self._received, channel, take))
        # rclpy passes the source timestamp only to callbacks of exactly two arguments
        return self._node.create_subscription(
            kind, topic, lambda raw, info: receive(raw, info), qos_profile(qos), raw=True
        )

    def _received(
        self, channel: Channel, take: Callable[[Message], None], raw: bytes, info: Any
    ) -> None:
        now = time.time_ns() if self._sim_time_ns is None else self._sim_time_ns
        sent = info["source_timestamp"]
        take(Message(channel, now, sent if sent > 0 else now, 0, raw))

    def _tick(self, raw: bytes) -> None:
        if now := time_of(raw):  # 0 means that the clock has not started
            self._sim_time_ns, self.state.waiting_for = now, ""

    def close(self) -> None:
        """See `Source.close`."""
        if self._ended.is_set():
            return
        self._ended.set()
        if self._thread is not None:
            self._thread.join()
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()


def offered_by(profile: Any) -> Qos:
    """The QoS of an rclpy profile."""
    history = profile.history.name.lower()
    liveliness = profile.liveliness.name.lower()
    return Qos(
        history=history if history in ("keep_last", "keep_all") else "keep_last",
        depth=max(1, profile.depth),
        reliability=profile.reliability.name.lower(),
        durability=profile.durability.name.lower(),
        deadline_ns=_finite(profile.deadline),
        lifespan_ns=_finite(profile.lifespan),
        liveliness=liveliness if liveliness.startswith("manual") else "automatic",
        lease_ns=_finite(profile.liveliness_lease_duration),
    )


def _finite(duration: Any) -> int | None:
    nanoseconds = int(duration.nanoseconds)
    return nanoseconds if 0 < nanoseconds < _INFINITE_NS else None


def _hash_text(type_hash: Any) -> str:
    """A type hash of rclpy (Jazzy and later) as ``RIHS01_...``; empty if there is none."""
    value = bytes(getattr(type_hash, "value", None) or b"")
    return f"RIHS{type_hash.version:02}_{value.hex()}" if any(value) else ""
