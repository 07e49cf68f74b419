"""Receives messages from ROS 2 without an installed ROS: over DDS, with Eclipse Cyclone DDS."""

from __future__ import annotations

import re
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from mp4ds.bags.protocols import Format
from mp4ds.bags.types import ros2_version
from mp4ds.errors import OptionError, Refused
from mp4ds.plugins.publishing.dds import dds_qos, serve
from mp4ds.plugins.publishing.dds_domain import (
    DdsListener,
    domain_id,
    open_participant,
    publisher_type,
)
from mp4ds.plugins.publishing.ros2_writers import Qos, load_overrides
from mp4ds.plugins.recording.ros2_channels import (
    DISTRIBUTION,
    RECORDER_SERVICES,
    announced_definition,
    asked_qos,
    channel_of,
    is_hidden,
    ros_type,
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
from mp4ds.plugins.recording.type_descriptions import REPLIES, ask_for_definition
from mp4ds.records import Channel, Message

_DEPTH = 100
"""Depth of readers: messages are taken out at once."""

_SETTLE_S = 0.3
"""Seconds from a topic's first publisher to its subscription: the QoS depends on all of them."""

_PREFIX = "rt/"
_HASH = re.compile(rb"(?:^|;)typehash=(RIHS01_[0-9a-f]{64});")
_BATCH = 100
_MOST_ENDPOINTS = 10_000
_CLOCK = "/clock"


@dataclass
class _Topic:
    """A published topic."""

    recorded: str  # the name under which it is recorded
    since: float
    is_wanted: bool
    endpoints: dict[Any, Any] = field(default_factory=dict)
    reader: Any = None
    kind: Any = None  # class of its messages
    definition: str = ""
    asking: threading.Thread | None = None


class DdsSource:
    """Receives as a DDS participant. See `Source`.

    Args:
        options: How to receive; the node's name is used for its services only.

    Raises:
        PublishError: Cyclone DDS is not installed, or finds no network.
        OptionError: There is no such domain, or an option needs rclpy.
    """

    format: Format = "rosbag2"
    profile = "ros2"

    def __init__(self, options: SourceOptions) -> None:
        if options.unpublished:
            raise OptionError("`unpublished` works with rclpy only: source a ROS 2.")
        self.state = SourceState()
        self._options = options
        self._clock = options.names.renamed(_CLOCK)
        overrides = options.qos_overrides
        self._overrides = load_overrides(overrides) if overrides is not None else {}
        domain = domain_id(None)
        self._participant = open_participant(domain)
        self.address = f"DDS domain {domain}, by Cyclone DDS"
        self._listener = DdsListener(self._participant)
        self._topics: dict[str, _Topic] = {}
        self._nodes: dict[Any, list[str]] = defaultdict(
            list
        )  # whose types can be asked for, by participant
        self._count = 0
        self._services: list[Any] = []
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None
        self._sim_time_ns: int | None = None

    def start(self, wanted: Wanted, take: Callable[[Message], None]) -> None:
        """See `Source.start`."""
        if self._options.use_sim_time:
            self.state.waiting_for = self._clock
        self._thread = threading.Thread(
            target=self._look, args=(wanted, take), name="topics", daemon=True
        )
        self._thread.start()

    def serve(self, controls: RecorderControls) -> None:
        """See `Source.serve`."""
        version = ros2_version(DISTRIBUTION)
        self._services = serve(
            self._participant,
            self._listener,
            self._options.names.of_node(self._options.node),
            RECORDER_SERVICES,
            controls,
            version,
        )

    def _look(self, wanted: Wanted, take: Callable[[Message], None]) -> None:
        from cyclonedds.builtin import (
            BuiltinDataReader,
            BuiltinTopicDcpsPublication,
            BuiltinTopicDcpsSubscription,
        )

        found = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        others = BuiltinDataReader(self._participant, BuiltinTopicDcpsSubscription)
        poll_s = self._options.poll_s
        deadline = time.monotonic() + 2 * _SETTLE_S
        while not self._ended.wait(poll_s or _SETTLE_S):
            for endpoint in found.take(_BATCH):
                if endpoint.sample_info.valid_data:
                    self._meet(endpoint, wanted)
            is_waiting = bool(self.state.waiting_for)
            heard = self._subscribed(others) if self._options.ignore_leaf else self._topics
            for name, topic in self._topics.items():
                is_due = name == self._clock or (name in heard and not is_waiting)
                is_due = is_due and time.monotonic() - topic.since > _SETTLE_S
                if is_due and topic.reader is None and self._is_defined(topic):
                    self._subscribe(name, topic, take)
                self._count_lost(topic)
            if is_waiting:
                deadline = time.monotonic() + 2 * _SETTLE_S
            if poll_s is None and time.monotonic() > deadline:
                return

    def _subscribed(self, others: Any) -> set[str]:
        """Topics with subscribers in other processes."""
        from cyclonedds.core import InstanceState

        own = self._participant.guid
        return {
            f"/{endpoint.topic_name.removeprefix(_PREFIX)}"
            for endpoint in others.read(_MOST_ENDPOINTS)
            if endpoint.sample_info.valid_data
            and endpoint.sample_info.instance_state == InstanceState.Alive
            and endpoint.participant_key != own
        }

    def _meet(self, endpoint: Any, wanted: Wanted) -> None:
        name = endpoint.topic_name
        before, behind = REPLIES
        if name.startswith(before) and name.endswith(behind):
            node = name.removeprefix(before).removesuffix(behind)
            self._nodes[endpoint.participant_key].append(node)
        topic = f"/{name.removeprefix(_PREFIX)}"
        is_bare, type_name = not name.startswith(_PREFIX), ros_type(endpoint.type_name)
        if is_bare or not type_name:
            return
        is_wanted = wanted(topic, type_name) and (self._options.hidden or not is_hidden(topic))
        if is_wanted or (topic == self._clock and self._options.use_sim_time):
            met = _Topic(wanted.recorded_as(topic), time.monotonic(), is_wanted)
            known = self._topics.setdefault(topic, met)
            known.endpoints[endpoint.key] = endpoint

    def _is_defined(self, topic: _Topic) -> bool:
        """Whether the definition of a topic's type has been looked for; starts to."""
        if topic.asking is not None:
            return not topic.asking.is_alive()
        endpoint = next(iter(topic.endpoints.values()))
        type_hash, type_name = _hash_of(endpoint.qos), ros_type(endpoint.type_name)
        topic.kind = publisher_type(self._participant, endpoint)
        topic.definition = standard_definition(type_name, type_hash)
        topic.definition = topic.definition or announced_definition(topic.kind, type_hash)
        if topic.definition or not type_hash:
            return True
        topic.asking = threading.Thread(
            target=self._ask, args=(topic, endpoint, type_name, type_hash), daemon=True
        )
        topic.asking.start()
        return False

    def _ask(self, topic: _Topic, endpoint: Any, type_name: str, type_hash: str) -> None:
        """Ask the nodes in a publisher's process for the definition of its type."""
        from cyclonedds.core import DDSException

        version = ros2_version(DISTRIBUTION)
        for node in self._nodes[endpoint.participant_key]:
            if not topic.definition and not self._ended.is_set():
                with suppress(DDSException, Refused):  # the same as no answer
                    topic.definition = ask_for_definition(
                        self._participant, node, type_name, type_hash, version
                    )

    def _subscribe(self, name: str, topic: _Topic, take: Callable[[Message], None]) -> None:
        from cyclonedds.core import DDSException
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic

        endpoints = list(topic.endpoints.values())
        offered = [offered_by(endpoint.qos) for endpoint in endpoints]
        type_hash = _hash_of(endpoints[0].qos)
        type_name = ros_type(endpoints[0].type_name)
        definition = topic.definition
        if len({endpoint.type_name for endpoint in endpoints}) > 1:
            self.state.warn(f"{name}: has several types: only {type_name} is recorded")
        if not definition:
            self.state.warn(
                f"{name}: recorded without the definition of {type_name}, which was not found"
            )
        channel = channel_of(self._count, topic.recorded, type_name, definition, type_hash, offered)
        self._count += 1
        qos = self._overrides.get(name, asked_qos(offered, _DEPTH))
        try:
            made = Topic(self._participant, _PREFIX + name.lstrip("/"), topic.kind)
            topic.reader = DataReader(
                self._participant, made, qos=dds_qos(qos, user_data=_user_data(type_hash))
            )
        except DDSException as error:
            topic.reader = False
            self.state.warn(f"{name}: not recorded: DDS refuses the subscription: {error.msg}")
            return
        receive = told(self.state, name, partial(self._received, channel, take))
        if name == self._clock and self._options.use_sim_time:
            receive = partial(self._tick, receive if topic.is_wanted else None)
        if topic.is_wanted:
            self.state.topics[topic.recorded] = channel
        self._listener.hear(topic.reader, receive)

    def _tick(self, receive: Callable[[Any], None] | None, sample: Any) -> None:
        if now := time_of(sample.payload):  # 0 means that the clock has not started
            self._sim_time_ns, self.state.waiting_for = now, ""
            if receive is not None:
                receive(sample)

    def _received(self, channel: Channel, take: Callable[[Message], None], sample: Any) -> None:
        data = sample.payload
        sent = sample.sample_info.source_timestamp
        now = time.time_ns() if self._sim_time_ns is None else self._sim_time_ns
        take(Message(channel, now, sent if sent > 0 else now, 0, data))

    def _count_lost(self, topic: _Topic) -> None:
        if topic.reader:
            status = topic.reader.get_sample_lost_status()
            if status.total_count:
                self.state.lost[topic.recorded] = status.total_count

    def close(self) -> None:
        """See `Source.close`."""
        if self._ended.is_set():
            return
        self._ended.set()
        if self._thread is not None:
            self._thread.join()
        for topic in self._topics.values():
            if topic.asking is not None:
                topic.asking.join()
        self._listener.close()
        self._services.clear()
        self._topics.clear()
        self._participant = None


def _hash_of(qos: Any) -> str:
    from cyclonedds.core import Policy

    found = _HASH.search(qos[Policy.Userdata].data) if Policy.Userdata in qos else None
    return found[1].decode() if found else ""


def _user_data(type_hash: str) -> str:
    return f"typehash={type_hash};" if type_hash else ""


def offered_by(qos: Any) -> Qos:
    """The QoS of a publisher, as far as discovery shares it: the history depth is unknown.

    Args:
        qos: The QoS in Cyclone DDS.
    """
    from cyclonedds.core import Policy

    is_best_effort = Policy.Reliability.BestEffort in qos
    is_latched = Policy.Durability.TransientLocal in qos
    return Qos(
        reliability="best_effort" if is_best_effort else "reliable",
        durability="transient_local" if is_latched else "volatile",
        deadline_ns=_finite(qos[Policy.Deadline].deadline) if Policy.Deadline in qos else None,
        lifespan_ns=_finite(qos[Policy.Lifespan].lifespan) if Policy.Lifespan in qos else None,
    )


def _finite(nanoseconds: int) -> int | None:
    return nanoseconds if 0 < nanoseconds < 2**63 - 1 else None
