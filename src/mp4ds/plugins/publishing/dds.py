"""The ROS 2 publisher that needs no ROS: over DDS, with Eclipse Cyclone DDS."""

from __future__ import annotations

import re
import struct
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from mp4ds.bags.types import RosVersion, make_store, ros2_version, types_of
from mp4ds.errors import ConversionError, OptionError, PublishError
from mp4ds.plugins.publishing.dds_domain import (
    DdsListener,
    DdsType,
    Types,
    dds_topic,
    domain_id,
    make_struct,
    message_type,
    open_participant,
)
from mp4ds.plugins.publishing.names import PLAIN, NodeNames
from mp4ds.plugins.publishing.publisher import Controls
from mp4ds.plugins.publishing.ros2_writers import (
    CLOCK,
    CLOCK_QOS,
    CLOCK_TYPE,
    PARTING_S,
    PLAYER_SERVICES,
    Qos,
    Service,
    Writers,
    clock_message,
)
from mp4ds.records import Channel, Schema

_SECOND = 10**9
_PATIENCE = 15.0  # seconds; DDS considers a subscriber that is silent for 10 s gone
_UNDER_WAY = 2**18  # unacknowledged bytes with keep_all; the library allows twice as many
_HANDSHAKE = 0.2  # seconds
_YEAR = 366 * 86400.0  # seconds, the longest wait that the library accepts
_FOREVER = 2**63 - 1


class DdsWriter:
    """A writer of serialized messages.

    Args:
        participant: The DDS participant.
        topic: The ROS name of the topic.
        kind: The message type.
        qos: The QoS profile to offer.

    Raises:
        ConversionError: DDS refuses the topic.
    """

    def __init__(self, participant: Any, topic: str, kind: DdsType, qos: Qos) -> None:
        from cyclonedds.core import DDSException
        from cyclonedds.pub import DataWriter
        from cyclonedds.topic import Topic

        self._name = topic
        self._kind = kind
        self._is_reliable = qos.is_reliable
        self._keeps_all = qos.is_reliable and qos.history == "keep_all"
        self._under_way = 0
        self._seen: dict[int, float] = {}
        name = _topic_name(topic, qos)
        try:
            dds = Topic(participant, name, kind.writes)
            self._writer = DataWriter(
                participant, dds, qos=dds_qos(qos, user_data=_user_data(kind))
            )
        except DDSException as error:
            problem = f"DDS refuses it or its QoS: {error.msg}"
            raise ConversionError(topic, problem, "Leave it out, or override its QoS.") from None

    def write(self, payload: bytes | memoryview) -> None:
        """Write a message.

        With keep_last, which players use, it does not wait. With keep_all, it waits until
        subscribers have most of the messages; the library would do that while holding the GIL.
        """
        from cyclonedds.core import DDSException

        message = bytes(payload)
        self._check(message)
        if self._kind.is_empty and len(message) == 4:
            message += b"\0"
        is_much = self._keeps_all and self._under_way + len(message) > _UNDER_WAY
        if is_much and not self.wait(_PATIENCE):
            problem = (
                "a subscriber has received nothing for 15 s: stop it, or offer best_effort QoS"
            )
            raise PublishError(self._name, problem)
        self._under_way += len(message)
        try:
            self._writer.write(self._kind.writes(message))
        except DDSException as error:
            if error.code == DDSException.DDS_RETCODE_BAD_PARAMETER:
                raise ConversionError(self._name, "a message is not of its type") from None
            raise PublishError(self._name, f"DDS refuses a message: {error.msg}") from None

    def _check(self, message: bytes) -> None:
        if len(message) < 4:
            raise ConversionError(self._name, "a message has no CDR header")
        if not message[1] & 1 and not self._kind.is_real:
            problem = "a message is big-endian, and cannot be converted without its definition"
            raise ConversionError(self._name, problem)

    def wait(self, seconds: float) -> bool:
        """Wait until reliable subscribers have all messages; returns whether they do."""
        if not self._is_reliable:
            return True
        try:
            done = bool(self._writer.wait_for_acks(int(min(seconds, _YEAR) * _SECOND)))
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
        return sum(now - since >= _HANDSHAKE for since in self._seen.values())


def dds_qos(qos: Qos, *, user_data: str = "", ignore_own: bool = False) -> Any:
    """A QoS profile for Cyclone DDS, mapped as by rmw_cyclonedds.

    Args:
        qos: The ROS profile.
        user_data: User data to announce, such as the type hash.
        ignore_own: For a reader: whether to ignore what this participant writes.
    """
    from cyclonedds.core import Policy
    from cyclonedds.core import Qos as DdsQos

    kept = Policy.History.KeepAll
    if qos.history == "keep_last":
        kept = Policy.History.KeepLast(qos.depth)
    lease = _FOREVER if qos.lease_ns is None else qos.lease_ns
    liveliness = {
        "automatic": Policy.Liveliness.Automatic,
        "manual_by_node": Policy.Liveliness.ManualByParticipant,
        "manual_by_topic": Policy.Liveliness.ManualByTopic,
    }[qos.liveliness]
    policies = [
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.WriterDataLifecycle(autodispose=False),
        kept,
        Policy.Reliability.Reliable(int(_PATIENCE * _SECOND))
        if qos.is_reliable
        else Policy.Reliability.BestEffort,
        liveliness(lease),
    ]
    if qos.is_latched:
        unlimited = (-1, -1, -1)
        policies += [
            Policy.Durability.TransientLocal,
            Policy.DurabilityService(0, kept, *unlimited),
        ]
    if qos.deadline_ns is not None:
        policies.append(Policy.Deadline(qos.deadline_ns))
    if qos.lifespan_ns is not None:
        policies.append(Policy.Lifespan(qos.lifespan_ns))
    if user_data:
        policies.append(Policy.Userdata(user_data.encode()))
    if ignore_own:
        policies.append(Policy.IgnoreLocal.Participant)
    return DdsQos(*policies)


def _user_data(kind: DdsType) -> str:
    return f"typehash={kind.type_hash};" if kind.type_hash else ""


def _topic_name(topic: str, qos: Qos) -> str:
    name = dds_topic(topic, bare=qos.avoid_ros_namespace_conventions)
    if name is None:
        remedy = "Rename it with `remap`."
        raise ConversionError(topic, "its name is not valid in ROS 2", remedy)
    return name


# ---------------------------------------------------------------- services

_READER_PATIENCE = 0.1  # seconds to wait for the client's reader to connect, as in ROS
_HEADER = "uint64 client_guid\nint64 sequence_number\n"
_FILLER = "structure_needs_at_least_one_member"
_CLIENT = re.compile(rb"(?:^|;)clientid=([^;]*);")


def serve(
    participant: Any,
    listener: DdsListener,
    node: str,
    services: Sequence[Service],
    controls: Any,
    version: RosVersion,
) -> list[Any]:
    """Offer services.

    Args:
        participant: The DDS participant.
        listener: Receives the requests; they are answered on its thread.
        node: Name of the node that they belong to.
        services: The services.
        controls: The player or recorder that they control.
        version: The types of ROS 2.

    Returns:
        Objects to keep while the services are offered.
    """
    return [
        _Server(
            participant, listener, f"/{node}/{service.name}", service, controls, number, version
        )
        for number, service in enumerate(services, 1)
    ]


class _Server:
    def __init__(
        self,
        participant: Any,
        listener: DdsListener,
        name: str,
        service: Service,
        controls: Any,
        number: int,
        version: RosVersion,
    ) -> None:
        from cyclonedds.pub import DataWriter
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic

        self._service = service
        self._controls = controls
        request, request_hash = message_class(f"{service.kind}_Request", service.request, version)
        self._reply, reply_hash = message_class(
            f"{service.kind}_Response", service.response, version
        )
        # lets clients match the reader and the writer of a service
        own = f"serviceid={_identity(participant, number)};"
        self._reader = DataReader(
            participant,
            Topic(participant, f"rq{name}Request", request),
            qos=dds_qos(Qos(), user_data=f"{own}typehash={request_hash};"),
        )
        self._writer = DataWriter(
            participant,
            Topic(participant, f"rr{name}Reply", self._reply),
            qos=dds_qos(Qos(), user_data=f"{own}typehash={reply_hash};"),
        )
        listener.hear(self._reader, self._on_request)

    def _on_request(self, request: Any) -> None:
        fields = dict(self._service.answer(self._controls, request))
        reply = self._reply(
            client_guid=request.client_guid,
            sequence_number=request.sequence_number,
            **(fields or {_FILLER: 0}),
        )
        self._wait_for_reader(request.sample_info.publication_handle)
        self._writer.write(reply)

    def _wait_for_reader(self, writer: int) -> None:
        """Wait until the client's reader is connected, so that it gets the reply."""
        endpoint = self._reader.get_matched_publication_data(writer)
        client = _client_of(endpoint)
        end = time.monotonic() + _READER_PATIENCE
        while client and client not in self._connected() and time.monotonic() < end:
            time.sleep(0.01)

    def _connected(self) -> set[bytes]:
        writer = self._writer
        readers = writer.get_matched_subscriptions()
        return {_client_of(writer.get_matched_subscription_data(reader)) for reader in readers}


def message_class(kind: str, definition: str, version: RosVersion) -> tuple[Any, str]:
    """The class of a request or response with the service header, and its type hash.

    Args:
        kind: Its type, such as ``Seek_Request``.
        definition: Its fields, as in a message definition.
        version: The types of ROS 2.
    """
    name = f"rosbag2_interfaces/srv/{kind}"
    types, type_hash = service_types(name, definition, version)
    return make_struct(types, name, has_fields=True), type_hash


def service_types(name: str, definition: str, version: RosVersion) -> tuple[Types, str]:
    """The types of a request or response with what goes before it, and its type hash.

    Args:
        name: Its type, such as ``rosbag2_interfaces/srv/Seek_Request``.
        definition: Its fields, as of a message.
        version: The types of ROS 2.
    """
    short = name.replace("/srv/", "/msg/")  # as definitions of messages are parsed
    types = types_of(Schema(short, "ros2msg", definition.encode()), version)
    types[name] = types.pop(short)
    type_hash = make_store(types, version).hash_rihs01(name)
    whole = types_of(Schema(short, "ros2msg", (_HEADER + definition).encode()), version)
    whole[name] = whole.pop(short)
    return whole, type_hash


def _identity(participant: Any, number: int) -> str:
    """A unique id of a service: the participant, and a number within it."""
    return ".".join(f"{byte:x}" for byte in participant.guid.bytes[:12] + number.to_bytes(4, "big"))


def _client_of(endpoint: Any) -> bytes:
    from cyclonedds.core import Policy

    if endpoint is None or Policy.Userdata not in endpoint.qos:
        return b""
    found = _CLIENT.search(endpoint.qos[Policy.Userdata].data)
    return found[1] if found else b""


# ---------------------------------------------------------------- publisher

_DISTRIBUTION = "jazzy"  # its definitions are used if a recording has none
_TIME = struct.Struct("<iI")
_CDR_HEADER = 4  # bytes


class DdsPublisher:
    """Publishes to ROS 2, as a DDS participant.

    ROS 2 nodes with any DDS middleware can subscribe. Messages are sent as recorded, except that
    DDS pads them to a multiple of 4 bytes, and that the byte order becomes this machine's.

    Channels share writers (`Writers`).

    Args:
        domain: The DDS domain, 0 to 232; None for that of ROS_DOMAIN_ID, else 0.
        overrides: Topic -> QoS profile to offer instead of the recorded one.
        node: Name of the node that the services belong to, if `names` has none.
        names: Name, namespace and remappings of the node.
        parting_s: How long to wait at the end for acknowledgements, may be infinite; topics that
            are not acknowledged by then are named in a warning. None: 3 s, without a warning.

    Raises:
        OptionError: There is no such domain.
        PublishError: Cyclone DDS is not installed, or finds no network.
    """

    world: str | None = "ros2"

    def __init__(
        self,
        *,
        domain: int | None = None,
        overrides: Mapping[str, Qos] = {},
        node: str = "rosbag2_player",
        names: NodeNames = PLAIN,
        parting_s: float | None = None,
    ) -> None:
        self._domain = domain_id(domain)
        self._node = names.of_node(node)
        self._clock_topic = names.renamed(CLOCK)
        self._parting_s = parting_s
        self._types: RosVersion = ros2_version(_DISTRIBUTION)
        self._participant = open_participant(self._domain)
        self._listener = DdsListener(self._participant)
        self._writers: Writers[DdsWriter] = Writers(overrides)
        self._services: list[Any] = []
        self._clock: DdsWriter | None = None
        self._is_open = True

    @property
    def address(self) -> str:
        """Its domain, for display."""
        return f"ROS 2, domain {self._domain} (Cyclone DDS)"

    def advertise(self, channel: Channel) -> None:
        """Announce a channel before its first message."""

        def make(qos: Qos) -> DdsWriter:
            kind = message_type(channel, self._types)
            return DdsWriter(self._participant, channel.topic, kind, qos)

        self._writers.add(channel, channel.schema, make)

    def publish(self, channel: Channel, payload: bytes | memoryview, time_ns: int) -> None:
        """Publish a message of an advertised channel.

        Raises:
            ConversionError: The message is not of its type.
            PublishError: With keep_all, a subscriber has received nothing for 15 s.
        """
        self._writers[channel].write(payload)

    def clock(self, time_ns: int) -> None:
        """Publish a recording time as /clock."""
        if self._clock is None:
            kind = message_type(_clock_channel(), self._types)
            self._clock = DdsWriter(self._participant, self._clock_topic, kind, CLOCK_QOS)
        self._clock.write(clock_message(time_ns))

    def subscribers(self, channel: Channel) -> int:
        """How many subscribers a channel's topic has now."""
        return self._writers[channel].subscribers()

    def follow_clock(self, on_time: Callable[[int], None]) -> None:
        """Call back with each time, in nanoseconds, that another node publishes as /clock."""
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic

        kind = message_type(_clock_channel(), self._types)
        topic = Topic(self._participant, dds_topic(self._clock_topic), kind.writes)
        qos = dds_qos(CLOCK_QOS, user_data=_user_data(kind), ignore_own=True)
        reader = DataReader(self._participant, topic, qos=qos)
        self._listener.hear(reader, lambda sample: on_time(_time_of(sample.payload)))

    def listen(self, topic: str, on_message: Callable[[int | None], None]) -> None:
        """Call back for each message of other nodes on a topic, as soon as it has a publisher."""
        name = dds_topic(topic)
        if name is None:
            raise OptionError(f"{topic!r} is not a valid ROS 2 topic name.")
        self._listener.seek(name, lambda: on_message(None))

    def serve(self, controls: Controls) -> None:
        """Offer the services of `ros2 bag play` to clients that use rmw_cyclonedds."""
        self._services += serve(
            self._participant, self._listener, self._node, PLAYER_SERVICES, controls, self._types
        )

    @property
    def wants_clock(self) -> bool:
        """False: in ROS 2, simulated time is configured for each node."""
        return False

    @property
    def is_alive(self) -> bool:
        """Whether it is open: it cannot be shut down from outside."""
        return self._is_open

    def close(self) -> None:
        """Wait until subscribers have what was sent, as long as they may take, and leave."""
        if not self._is_open:
            return
        self._is_open = False
        is_asked = self._parting_s is not None
        end = time.monotonic() + (PARTING_S if self._parting_s is None else self._parting_s)
        self._writers.wait(
            lambda writer: writer.wait(max(0.0, end - time.monotonic())), warns=is_asked
        )
        self._listener.close()
        self._services.clear()
        self._writers.clear()
        self._clock = None
        self._participant = None

    def __enter__(self) -> DdsPublisher:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _clock_channel() -> Channel:
    return Channel(0, CLOCK, "cdr", Schema(CLOCK_TYPE, "", b""))


def _time_of(payload: bytes) -> int:
    """Nanoseconds of a Clock message, which the library has converted to our byte order."""
    sec, nanosec = _TIME.unpack_from(payload, _CDR_HEADER)
    return int(sec) * _SECOND + int(nanosec)
