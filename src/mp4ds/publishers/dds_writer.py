"""Writes serialized messages of one topic to DDS."""

from __future__ import annotations

import time
from typing import Any

from mp4ds.errors import ConversionError, PublishError
from mp4ds.publishers.dds_types import MessageType, dds_topic
from mp4ds.publishers.qos import Qos

_SECOND = 10**9
_PATIENCE = 15.0  # seconds; a subscriber that is silent for 10 s is taken for gone
_UNDER_WAY = 2**18  # bytes that may wait where all are kept; the library allows twice as many
_HANDSHAKE = 0.2  # seconds
_FOREVER = 2**63 - 1


class Writer:
    """A writer of ready messages.

    Args:
        participant: Whose writer it is.
        topic: The topic, as ROS spells it.
        kind: The type of its messages.
        qos: What it offers.

    Raises:
        ConversionError: DDS cannot have the topic.
    """

    def __init__(self, participant: Any, topic: str, kind: MessageType, qos: Qos) -> None:
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
            problem = f"DDS refuses it or its quality of service: {error.msg}"
            raise ConversionError(topic, problem, "Leave it out, or override its QoS.") from None

    def write(self, payload: bytes | memoryview) -> None:
        """Write a message.

        Where only the last few are kept, as players do, it waits for nobody. Where all are kept,
        it waits until subscribers have most of them; the library would do that with Python's
        lock held.
        """
        from cyclonedds.core import DDSException

        message = bytes(payload)
        self._check(message)
        if self._kind.is_empty and len(message) == 4:
            message += b"\0"
        is_much = self._keeps_all and self._under_way + len(message) > _UNDER_WAY
        if is_much and not self.wait(_PATIENCE):
            problem = "a subscriber has taken nothing for 15 s: stop it, or play best effort"
            raise PublishError(self._name, problem)
        self._under_way += len(message)
        try:
            self._writer.write(self._kind.writes(message))
        except DDSException as error:
            if error.code == DDSException.DDS_RETCODE_BAD_PARAMETER:
                raise ConversionError(self._name, "a message is not of its type") from None
            raise PublishError(self._name, f"DDS does not take a message: {error.msg}") from None

    def _check(self, message: bytes) -> None:
        if len(message) < 4:
            raise ConversionError(self._name, "a message lacks the header of CDR")
        if not message[1] & 1 and not self._kind.is_real:
            problem = "a message is big-endian, and its definition, by which to turn it, is missing"
            raise ConversionError(self._name, problem)

    def wait(self, seconds: float) -> bool:
        """Wait until reliable subscribers have all messages; returns whether they do."""
        if not self._is_reliable:
            return True
        try:
            done = bool(self._writer.wait_for_acks(int(seconds * _SECOND)))
        except AttributeError:
            done = False  # how version 11 of the library tells that time is up
        if done:
            self._under_way = 0
        return done

    def subscribers(self) -> int:
        """How many subscribers there are that will get the next message.

        A new one counts when it has been seen for a moment: DDS shakes hands first, and what is
        sent meanwhile it does not get.
        """
        now = time.monotonic()
        connected = self._writer.get_matched_subscriptions()
        self._seen = {handle: self._seen.get(handle, now) for handle in connected}
        return sum(now - since >= _HANDSHAKE for since in self._seen.values())


def dds_qos(qos: Qos, *, user_data: str = "", ignore_own: bool = False) -> Any:
    """A quality of service as Cyclone DDS has it, chosen as rmw_cyclonedds does.

    Args:
        qos: That of ROS.
        user_data: What to tell others, such as the type hash.
        ignore_own: For a reader: whether to overlook what this participant writes.
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


def _user_data(kind: MessageType) -> str:
    return f"typehash={kind.type_hash};" if kind.type_hash else ""


def _topic_name(topic: str, qos: Qos) -> str:
    name = dds_topic(topic, bare=qos.avoid_ros_namespace_conventions)
    if name is None:
        remedy = "Play it under another name."
        raise ConversionError(topic, "ROS 2 has no topics of such names", remedy)
    return name
