"""A participant of DDS that takes part in ROS 2 without an installed ROS, by Eclipse Cyclone DDS.

Imported only if Cyclone DDS is installed.
"""

from __future__ import annotations

import os
import re
import secrets
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from cyclonedds.builtin import (
    BuiltinDataReader,
    BuiltinTopicDcpsPublication,
    BuiltinTopicDcpsSubscription,
)
from cyclonedds.core import (
    DDSException,
    InstanceState,
    Policy,
    ReadCondition,
    SampleState,
    ViewState,
    WaitSet,
)
from cyclonedds.core import Qos as DdsQos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from mp4ds.bags.types import by_library, make_store
from mp4ds.errors import ConversionError, OptionError, Refused, RemoteError
from mp4ds.plugins.ros.dds_types import (
    FILLER,
    DdsType,
    announced_definition,
    as_is,
    dds_topic,
    make_struct,
    message_type,
    publisher_type,
    ros_type,
    service_types,
)
from mp4ds.plugins.ros.node import NodeOptions, Service
from mp4ds.plugins.ros.ros2 import (
    Qos,
    Ros2Node,
    described_definition,
    finite,
    standard_definition,
    standard_types,
)
from mp4ds.records import Channel, Schema

_NS = 10**9
_BATCH = 100
_LAST_DOMAIN = 232
_LOCAL = (
    "<CycloneDDS><Domain><General><AllowMulticast>false</AllowMulticast></General><Discovery>"
    "<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>"
    '<Peers><Peer address="localhost"/></Peers></Discovery></Domain></CycloneDDS>'
)


def _domain() -> int:
    """That of ROS_DOMAIN_ID, else 0.

    Raises:
        OptionError: There is no such domain.
    """
    text = os.environ.get("ROS_DOMAIN_ID", "").strip() or "0"
    if not text.isascii() or not text.isdigit() or len(text) > 9 or int(text) > _LAST_DOMAIN:
        raise OptionError(f"ROS_DOMAIN_ID is {text!r}; it has to be from 0 to {_LAST_DOMAIN}.")
    return int(text)


def _open_participant(domain: int) -> Any:
    """A participant of a domain, configured by CYCLONEDDS_URI.

    Discovery is limited to this machine if ROS_LOCALHOST_ONLY or ROS_AUTOMATIC_DISCOVERY_RANGE say
    so, as in ROS 2.

    Raises:
        RemoteError: It cannot join the domain.
    """
    discovery = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").strip().upper()
    is_local = os.environ.get("ROS_LOCALHOST_ONLY", "").strip() == "1" or discovery == "LOCALHOST"
    try:
        if not is_local:
            return DomainParticipant(domain)
        config = ",".join(filter(None, (_LOCAL, os.environ.get("CYCLONEDDS_URI"))))
        opened = Domain(domain, config)
        participant = DomainParticipant(domain)
        participant.mp4ds_domain = opened  # lives as long
        return participant
    except DDSException as error:
        problem = f"cannot be joined: {error.msg}; check the network and CYCLONEDDS_URI"
        raise RemoteError(f"DDS domain {domain}", problem) from None


# ---------------------------------------------------------------- QoS

_PATIENCE_S = 15.0  # DDS considers a subscriber that is silent for 10 s gone
_HASH = re.compile(rb"(?:^|;)typehash=(RIHS\d\d_[0-9a-f]{64});")


def _dds_qos(qos: Qos, user_data: str, *, is_reader: bool = False, unacknowledged: int = 0) -> Any:
    """A QoS profile for Cyclone DDS, mapped as by rmw_cyclonedds.

    The depth is that for late subscribers. What is not taken or acknowledged yet may be more:
    nobody is told when it is overwritten, and publishers and subscribers match whatever they keep.

    Args:
        qos: The ROS profile.
        user_data: User data to announce, such as the type hash.
        is_reader: It is for a reader, which ignores what this participant writes. It keeps all: a
            thread takes out what comes.
        unacknowledged: How many messages a writer keeps at least that subscribers do not have yet.
    """
    kept = late = Policy.History.KeepAll
    if qos.history == "keep_last" and not is_reader:
        late = Policy.History.KeepLast(qos.depth)
        kept = Policy.History.KeepLast(max(qos.depth, unacknowledged))
    lease = qos.liveliness_lease_duration or 2**63 - 1
    liveliness = {
        "automatic": Policy.Liveliness.Automatic,
        "manual_by_node": Policy.Liveliness.ManualByParticipant,
        "manual_by_topic": Policy.Liveliness.ManualByTopic,
    }[qos.liveliness]
    policies = [
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.WriterDataLifecycle(autodispose=False),
        kept,
        Policy.Reliability.Reliable(int(_PATIENCE_S * _NS))
        if qos.is_reliable
        else Policy.Reliability.BestEffort,
        liveliness(lease),
    ]
    if qos.is_latched:
        service = Policy.DurabilityService(0, late, -1, -1, -1)  # without limits
        policies += [Policy.Durability.TransientLocal, service]
    if qos.deadline is not None:
        policies.append(Policy.Deadline(qos.deadline))
    if qos.lifespan is not None:
        policies.append(Policy.Lifespan(qos.lifespan))
    if user_data:
        policies.append(Policy.Userdata(user_data.encode()))
    if is_reader:
        policies.append(Policy.IgnoreLocal.Participant)
    return DdsQos(*policies)


def _offered_by(qos: Any) -> Qos:
    """The QoS of a publisher, as far as discovery shares it: the history depth is unknown."""
    is_best_effort = Policy.Reliability.BestEffort in qos
    is_latched = Policy.Durability.TransientLocal in qos
    return Qos(
        reliability="best_effort" if is_best_effort else "reliable",
        durability="transient_local" if is_latched else "volatile",
        deadline=finite(qos[Policy.Deadline].deadline) if Policy.Deadline in qos else None,
        lifespan=finite(qos[Policy.Lifespan].lifespan) if Policy.Lifespan in qos else None,
    )


def _user_data(endpoint: Any, pattern: re.Pattern[bytes]) -> str:
    """What the user data of a reader or writer says; empty for nothing."""
    if endpoint is None or Policy.Userdata not in endpoint.qos:
        return ""
    found = pattern.search(endpoint.qos[Policy.Userdata].data)
    return found[1].decode(errors="replace") if found else ""


def _told(type_hash: str) -> str:
    """The user data that tells a type hash: nodes look for it, and warn if it is missing."""
    return f"typehash={type_hash};" if type_hash else ""


# ---------------------------------------------------------------- writing

_UNDER_WAY = 2**18  # unacknowledged bytes with keep_all; the library allows twice as many
_HANDSHAKE_S = 0.2
_YEAR_S = 366 * 86400.0  # the longest wait that the library accepts


class _DdsWriter:
    """A writer of serialized messages.

    Raises:
        ConversionError: DDS refuses the topic.
    """

    def __init__(self, participant: Any, topic: str, kind: DdsType, qos: Qos) -> None:
        name = dds_topic(topic, bare=qos.avoid_ros_namespace_conventions)
        if name is None:
            remedy = "Rename it with `remap`."
            raise ConversionError(topic, "its name is not valid in ROS 2", remedy)
        self._name = topic
        self._kind = kind
        self._is_reliable = qos.is_reliable
        self._keeps_all = qos.is_reliable and qos.history == "keep_all"
        self._under_way = 0
        self._seen: dict[int, float] = {}
        try:
            dds = Topic(participant, name, kind.writes)
            told = _told(kind.type_hash)
            kept = _dds_qos(qos, told, unacknowledged=kind.unacknowledged)
            self._writer = DataWriter(participant, dds, qos=kept)
        except DDSException as error:
            problem = f"DDS refuses it or its QoS: {error.msg}"
            raise ConversionError(topic, problem, "Leave it out, or override its QoS.") from None

    def write(self, payload: bytes) -> None:
        """Write a message.

        With keep_last, which players use, it does not wait. With keep_all, it waits until
        subscribers have most of the messages; the library would do that while holding the GIL.
        """
        if len(payload) < 4:
            raise ConversionError(self._name, "a message has no CDR header")
        if not payload[1] & 1 and not self._kind.is_real:
            problem = "a message is big-endian, and cannot be converted without its definition"
            raise ConversionError(self._name, problem)
        if self._kind.is_empty and len(payload) == 4:
            payload += b"\0"
        is_much = self._keeps_all and self._under_way + len(payload) > _UNDER_WAY
        if is_much and not self.wait(_PATIENCE_S):
            problem = (
                "a subscriber has received nothing for 15 s: stop it, or offer best_effort QoS"
            )
            raise RemoteError(self._name, problem)
        self._under_way += len(payload)
        try:
            self._writer.write(self._kind.writes(payload))
        except DDSException as error:
            if error.code == DDSException.DDS_RETCODE_BAD_PARAMETER:
                raise ConversionError(self._name, "a message is not of its type") from None
            raise RemoteError(self._name, f"DDS refuses a message: {error.msg}") from None

    def wait(self, seconds: float) -> bool:
        if not self._is_reliable:
            return True
        try:
            done = bool(self._writer.wait_for_acks(int(min(seconds, _YEAR_S) * _NS)))
        except AttributeError:
            done = False  # how version 11 of the library reports a timeout
        if done:
            self._under_way = 0
        return done

    def subscribers(self) -> int:
        """How many subscribers will get the next message.

        A new one counts after a moment, as it does not get what is sent during the DDS handshake.
        """
        now = time.monotonic()
        connected = self._writer.get_matched_subscriptions()
        self._seen = {handle: self._seen.get(handle, now) for handle in connected}
        return sum(now - since >= _HANDSHAKE_S for since in self._seen.values())


# ---------------------------------------------------------------- the node

_SETTLE_S = 0.3
"""Seconds from a topic's first publisher to its subscription: the QoS depends on all of them."""

_PREFIX = "rt/"
_MOST_ENDPOINTS = 10_000
_LOOK_NS = 50_000_000  # between two checks for new readers
_DESCRIBES = re.compile(r"rr/(.+)/get_type_descriptionReply")
"""DDS topic of the replies of a node that can be asked for the definitions of its types."""


@dataclass
class _Found:
    """A topic that others publish, by its DDS name."""

    since: float
    publishers: dict[Any, Any] = field(default_factory=dict)
    kind: Any = None  # class of its messages, once that and the definition are looked for
    definition: str = ""
    asking: threading.Thread | None = None

    def is_of(self, kind: str) -> bool:
        """Whether that is the class and definition of a type: a topic may have several."""
        return self.kind is not None and ros_type(self.kind.__idl_typename__) == kind


class DdsNode(Ros2Node):
    """A participant of DDS. ROS 2 nodes with any DDS middleware can subscribe and publish.

    Messages are sent as recorded, except that DDS pads them to a multiple of 4 bytes, and that the
    byte order becomes this machine's.

    Callbacks come from a thread of its own. The library's own listeners are not used: they would
    wait for the GIL while it is held by a write that waits for the very thread they run on.

    Args:
        options: How it takes part.
        name: Its name, if the options have none; used for its services only.

    Raises:
        OptionError: There is no such domain, or an option needs rclpy.
        RemoteError: There is no network.
    """

    discovery_s = 2 * _SETTLE_S

    def __init__(self, options: NodeOptions, name: str) -> None:
        if options.unpublished:
            raise OptionError("`unpublished` works with rclpy only: source a ROS 2.")
        super().__init__(options)
        self._name = options.names.of_node(name)
        self._domain = _domain()
        self._participant = _open_participant(self._domain)
        self._publications = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        self._subscriptions = BuiltinDataReader(self._participant, BuiltinTopicDcpsSubscription)
        self._lock = threading.RLock()
        self._found: dict[str, _Found] = {}
        self._describing: dict[Any, list[str]] = defaultdict(list)  # nodes, by participant
        self._readers: list[tuple[Any, Callable[[Any], None]]] = []

    @property
    def address(self) -> str:
        """Its domain."""
        return f"ROS 2, domain {self._domain} (Cyclone DDS)"

    def _make_writer(self, channel: Channel, qos: Qos) -> _DdsWriter:
        return _DdsWriter(self._participant, channel.topic, message_type(channel), qos)

    # ------------------------------------------------------------ receiving

    def _read(
        self, topic: str, kind: str, qos: Qos, on_message: Callable[[bytes, int], object]
    ) -> Any:
        name = _PREFIX + topic.lstrip("/")
        found = self._found.get(name, _Found(0.0))
        if publisher := _publisher_of(found, kind):
            message_class = found.kind
            if not found.is_of(kind):
                message_class = publisher_type(self._participant, publisher)
            type_hash = _user_data(publisher, _HASH)
        else:
            made = message_type(Channel(0, topic, "cdr", Schema(kind, "", b""), {}))
            message_class, type_hash = made.writes, made.type_hash

        def on_sample(sample: Any) -> None:
            on_message(sample.payload, sample.sample_info.source_timestamp)

        try:
            reader = DataReader(
                self._participant,
                Topic(self._participant, name, message_class),
                qos=_dds_qos(qos, _told(type_hash), is_reader=True),
            )
        except DDSException as error:
            raise Refused(f"DDS refuses the subscription: {error.msg}") from None
        self._hear(reader, on_sample)
        return reader

    def _hear(self, reader: Any, on_sample: Callable[[Any], None]) -> None:
        """Call back with each valid sample that a reader gets."""
        with self._lock:
            self._readers.append((reader, on_sample))
            if len(self._readers) == 1:
                self._start(self._run)

    def _run(self) -> None:
        waiting = WaitSet(self._participant)
        attached: list[Any] = []
        any_state = SampleState.Any | ViewState.Any | InstanceState.Any
        while not self._ended.is_set():
            with self._lock:
                readers = list(self._readers)
            for reader, _ in readers[len(attached) :]:
                attached.append(ReadCondition(reader, any_state))
                waiting.attach(attached[-1])
            waiting.wait(_LOOK_NS)
            for reader, on_sample in readers:
                for sample in reader.take(_BATCH):
                    if self._ended.is_set():
                        return
                    if sample.sample_info.valid_data:
                        on_sample(sample)

    def _discover(self) -> None:
        """Take note of new publishers of others."""
        own = self._participant.guid
        with self._lock:
            for publisher in self._publications.take(_BATCH):
                if not publisher.sample_info.valid_data or publisher.participant_key == own:
                    continue
                name = publisher.topic_name
                if describes := _DESCRIBES.fullmatch(name):
                    self._describing[publisher.participant_key].append(describes[1])
                found = self._found.setdefault(name, _Found(time.monotonic()))
                found.publishers[publisher.key] = publisher

    def topics(self, is_wanted: Callable[[str, str], bool]) -> Mapping[str, Sequence[str]]:
        """Topics whose publishers and definitions are known; the latter are asked for."""
        self._discover()
        self._count_lost()
        ready: dict[str, list[str]] = {}
        for name, found in self._found.items():
            topic = f"/{name.removeprefix(_PREFIX)}"
            if not name.startswith(_PREFIX) or time.monotonic() - found.since <= _SETTLE_S:
                continue
            kinds = {ros_type(one.type_name): None for one in found.publishers.values()}
            wanted = [kind for kind in kinds if kind and is_wanted(topic, kind)]
            if wanted and self._is_defined(found, wanted[0]):
                ready[topic] = wanted
        return ready

    def subscribed_topics(self, node: str = "") -> frozenset[str]:
        """Topics with subscribers in other processes."""
        own = self._participant.guid
        return frozenset(
            f"/{one.topic_name.removeprefix(_PREFIX)}"
            for one in self._subscriptions.read(_MOST_ENDPOINTS)
            if one.sample_info.valid_data
            and one.sample_info.instance_state == InstanceState.Alive
            and one.participant_key != own
        )

    def _is_defined(self, found: _Found, kind: str) -> bool:
        """Whether the definition of a topic's type has been looked for; starts to."""
        if found.kind is None:
            publisher = _publisher_of(found, kind)
            type_hash = _user_data(publisher, _HASH)
            made = publisher_type(self._participant, publisher)
            found.definition = standard_definition(kind, type_hash)
            found.definition = found.definition or announced_definition(made, type_hash)
            if type_hash and not found.definition:
                found.asking = self._start(self._ask, found, publisher, kind, type_hash)
            found.kind = made  # at last, as several threads look
        return found.asking is None or not found.asking.is_alive()

    def _ask(self, found: _Found, publisher: Any, kind: str, type_hash: str) -> None:
        """Ask the nodes in a publisher's process for the definition of its type."""
        for node in self._describing[publisher.participant_key]:
            if not found.definition:
                with suppress(DDSException, Refused):  # the same as no answer
                    found.definition = _ask_for_definition(
                        self._participant, node, kind, type_hash, self._ended
                    )

    def _announced(self, topic: str, kind: str) -> tuple[list[Qos], str, str]:
        found = self._found[_PREFIX + topic.lstrip("/")]
        offered = [_offered_by(one.qos) for one in found.publishers.values()]
        definition = found.definition if found.is_of(kind) else ""
        return offered, _user_data(_publisher_of(found, kind), _HASH), definition

    def _kinds_of(self, topic: str) -> Sequence[str]:
        self._discover()
        found = self._found.get(_PREFIX + topic.lstrip("/"), _Found(0.0))
        kinds = [ros_type(one.type_name) for one in found.publishers.values()]
        return kinds if kinds and self._is_defined(found, kinds[0]) else []

    def _count_lost(self) -> None:
        for topic, reader in self._received.items():
            if lost := reader.get_sample_lost_status().total_count:
                self.lost[topic] = lost

    def serve(self, services: Sequence[Service]) -> None:
        """Offer services to clients that use rmw_cyclonedds; answers come on the node's thread."""
        for number, service in enumerate(services, 1):
            name = f"/{self._name}/{service.name}"
            self._hear(*_offered(self._participant, name, service, number))

    # ------------------------------------------------------------ the end

    @property
    def is_alive(self) -> bool:
        """Whether it is open: it cannot be shut down from outside."""
        return not self._ended.is_set()

    def close(self) -> None:
        """Wait for acknowledgements, and leave."""
        if self._ended.is_set():
            return
        self._part()
        self._end_threads()
        self._count_lost()
        self._readers.clear()
        self._received.clear()
        self._publications = self._subscriptions = self._participant = None


def _publisher_of(found: _Found, kind: str) -> Any:
    """One of the publishers of a type; None if there is none."""
    known = (one for one in found.publishers.values() if ros_type(one.type_name) == kind)
    return next(known, None)


# ---------------------------------------------------------------- services

_READER_PATIENCE_S = 0.1  # to wait for the client's reader to connect, as in ROS
_POLL_S = 0.01
_CLIENT = re.compile(rb"(?:^|;)clientid=([^;]*);")


def _offered(
    participant: Any, name: str, service: Service, number: int
) -> tuple[Any, Callable[[Any], None]]:
    """Offer a service.

    Args:
        participant: The DDS participant.
        name: Of the service.
        service: What it does.
        number: Unique among the services of the participant.

    Returns:
        The reader of requests, and what answers one.
    """
    kind = f"rosbag2_interfaces/srv/{service.kind}"
    types, request_hash = service_types(f"{kind}_Request", service.request)
    request_kind = make_struct(types, f"{kind}_Request", has_fields=True)
    types, reply_hash = service_types(f"{kind}_Response", service.response)
    reply_kind = make_struct(types, f"{kind}_Response", has_fields=True)
    # a unique id lets clients match the reader and the writer of a service
    unique = participant.guid.bytes[:12] + number.to_bytes(4, "big")
    own = f"serviceid={'.'.join(f'{byte:x}' for byte in unique)};"
    reader = DataReader(
        participant,
        Topic(participant, f"rq{name}Request", request_kind),
        qos=_dds_qos(Qos(), own + _told(request_hash)),
    )
    writer = DataWriter(
        participant,
        Topic(participant, f"rr{name}Reply", reply_kind),
        qos=_dds_qos(Qos(), own + _told(reply_hash)),
    )

    def connected() -> set[str]:
        data = writer.get_matched_subscription_data
        return {_user_data(data(one), _CLIENT) for one in writer.get_matched_subscriptions()}

    def on_request(request: Any) -> None:
        fields = dict(service.answer(request))
        reply = reply_kind(
            client_guid=request.client_guid,
            sequence_number=request.sequence_number,
            **(fields or {FILLER: 0}),
        )
        # the client's reader gets the reply only once it is connected
        handle = request.sample_info.publication_handle
        client = _user_data(reader.get_matched_publication_data(handle), _CLIENT)
        end = time.monotonic() + _READER_PATIENCE_S
        while client and client not in connected() and time.monotonic() < end:
            time.sleep(_POLL_S)
        writer.write(reply)

    return reader, on_request


# ---------------------------------------------------------------- descriptions of types

_PACKAGE = "type_description_interfaces"
_SERVICE = f"{_PACKAGE}/srv/GetTypeDescription"
_REQUEST = "string type_name\nstring type_hash\nbool include_type_sources"
_RESPONSE = f"""bool successful
string failure_reason
{_PACKAGE}/TypeDescription type_description
{_PACKAGE}/TypeSource[] type_sources
{_PACKAGE}/KeyValue[] extra_information"""
_ANSWER_S = 2.0  # some middlewares reply in another way, and nodes may be gone


def _ask_for_definition(
    participant: Any, node: str, type_name: str, type_hash: str, ended: threading.Event
) -> str:
    """The definition of a type, from the `get_type_description` service of a node.

    Args:
        participant: The DDS participant.
        node: Full name of the node without the leading slash, such as ``robot/camera``.
        type_name: Such as ``sensor_msgs/msg/Image``.
        type_hash: As announced by the publisher, which the definition must have.
        ended: Set when nobody waits for the answer any more.

    Returns:
        The text, with the definitions of its parts; empty if no reply comes in time, or the one
        that comes is not proven by the hash.
    """
    guid = secrets.randbits(63)
    types, _ = service_types(f"{_SERVICE}_Request", _REQUEST)
    replies, _ = service_types(f"{_SERVICE}_Response", _RESPONSE)
    kind = as_is(make_struct(types, f"{_SERVICE}_Request"))
    reply_kind = as_is(make_struct(replies, f"{_SERVICE}_Response"))
    name = f"{node}/get_type_description"
    # a server replies once it has discovered the reader with the same client id
    qos = _dds_qos(Qos(), f"clientid={guid:x};")
    writer = DataWriter(participant, Topic(participant, f"rq/{name}Request", kind), qos=qos)
    reader = DataReader(participant, Topic(participant, f"rr/{name}Reply", reply_kind), qos=qos)
    end = time.monotonic() + _ANSWER_S
    while not (writer.get_matched_subscriptions() and reader.get_matched_publications()):
        if ended.is_set() or time.monotonic() > end:
            return ""
        time.sleep(_POLL_S)
    store: Any = make_store(types, standard_types())
    request = store.types[f"{_SERVICE}_Request"](
        client_guid=guid,
        sequence_number=1,
        type_name=type_name,
        type_hash=type_hash,
        include_type_sources=True,
    )
    writer.write(kind(bytes(store.serialize_cdr(request, f"{_SERVICE}_Request"))))
    parse: Any = make_store(replies, standard_types()).deserialize_cdr
    while not ended.is_set() and time.monotonic() < end:
        for sample in reader.take(1):
            if sample.sample_info.valid_data:
                reply = by_library("", parse, sample.payload, f"{_SERVICE}_Response")
                if reply.client_guid == guid:
                    sources = reply.type_sources if reply.successful else ()
                    texts = {one.type_name: one.raw_file_contents for one in sources}
                    return described_definition(texts, type_name, type_hash)
        time.sleep(_POLL_S)
    return ""
