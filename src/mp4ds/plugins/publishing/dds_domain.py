"""A DDS domain as ROS 2 uses it: types, and messages of other participants."""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from operator import getitem
from typing import Any

from mp4ds.bags.types import (
    RosVersion,
    by_library,
    field_shape,
    incomprehensible,
    make_store,
    ros2_version,
    types_of,
)
from mp4ds.errors import ConversionError, OptionError, PublishError, Refused
from mp4ds.records import HASH_KEY, Channel

_LAST = 232
_LOCAL = (
    "<CycloneDDS><Domain><General><AllowMulticast>false</AllowMulticast></General><Discovery>"
    "<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>"
    '<Peers><Peer address="localhost"/></Peers></Discovery></Domain></CycloneDDS>'
)


def domain_id(asked: int | None) -> int:
    """The requested domain, else that of ROS_DOMAIN_ID, else 0.

    Raises:
        OptionError: There is no such domain.
    """
    variable = os.environ.get("ROS_DOMAIN_ID", "").strip()
    if asked is None and not variable:
        return 0
    text = variable if asked is None else str(asked)
    where = "ROS_DOMAIN_ID" if asked is None else "The domain"
    if not text.isascii() or not text.isdigit() or len(text) > 9 or int(text) > _LAST:
        raise OptionError(f"{where} is {text!r}; it has to be from 0 to {_LAST}.")
    return int(text)


def open_participant(domain: int) -> Any:
    """A participant of a domain, configured by CYCLONEDDS_URI.

    Discovery is limited to this machine if ROS_LOCALHOST_ONLY or ROS_AUTOMATIC_DISCOVERY_RANGE say
    so, as in ROS 2.

    Raises:
        PublishError: Cyclone DDS is not installed, or cannot join the domain.
    """
    where = f"DDS domain {domain}"
    try:
        from cyclonedds.core import DDSException
        from cyclonedds.domain import Domain, DomainParticipant
    except ImportError:
        problem = (
            "Cyclone DDS is not installed, and no ROS 2 is sourced; source ROS 2, "
            "or run: pip install 'mp4ds[dds]'"
        )
        raise PublishError(where, problem) from None
    try:
        if not _is_local():
            return DomainParticipant(domain)
        config = ",".join(filter(None, (_LOCAL, os.environ.get("CYCLONEDDS_URI"))))
        opened = Domain(domain, config)
        participant = DomainParticipant(domain)
        participant.mp4ds_domain = opened  # lives as long
        return participant
    except DDSException as error:
        problem = f"cannot be joined: {error.msg}; check the network and CYCLONEDDS_URI"
        raise PublishError(where, problem) from None


def _is_local() -> bool:
    discovery = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").strip().upper()
    return discovery == "LOCALHOST" or os.environ.get("ROS_LOCALHOST_ONLY", "").strip() == "1"


# ---------------------------------------------------------------- types

_NO_DDS_TYPE = "DDS has no such type"
Types = dict[str, Any]
"""Definitions by name, as `types_of` finds them."""

_FILLER = "structure_needs_at_least_one_member"
_NAME = re.compile(r"[A-Za-z]\w*(?:/[A-Za-z]\w*)+", re.ASCII)
_TOPIC = re.compile(r"/?[A-Za-z_]\w*(?:/[A-Za-z_]\w*)*", re.ASCII)
_HASH = re.compile(r"RIHS01_[0-9a-f]{64}")
_MAX_NESTING = 50
_MAX_SIZE = 2**28  # bytes of fixed-size parts: the library counts them in 32 bits
_BASES = {
    "bool": "bool",
    "octet": "byte",
    "byte": "byte",
    "char": "uint8",
    **{f"{sign}int{bits}": f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)},
    "float32": "float32",
    "float64": "float64",
    "string": "string",
}


def as_is(kind: Any) -> Any:
    """Make the messages of a class hold serialized CDR, including the header of 4 bytes.

    The class is patched, since the library takes a base class for an IDL type.
    """

    def make(self: Any, payload: bytes) -> None:
        self.payload = payload

    def serialize(
        self: Any, buffer: Any = None, endianness: Any = None, use_version_2: Any = None
    ) -> bytes:
        return bytes(self.payload)

    def deserialize(
        cls: Any, data: bytes, has_header: bool = True, use_version_2: Any = None
    ) -> Any:
        return cls(data)

    kind.__init__ = make
    kind.serialize = serialize
    kind.deserialize = classmethod(deserialize)
    kind.deserialize_key = classmethod(deserialize)  # called when a writer has left
    return kind


@dataclass(frozen=True, slots=True)
class DdsType:
    """How messages of a channel are written.

    Attributes:
        writes: The class of the messages, which are created from bytes.
        type_hash: ``RIHS01_...``; empty if the definition is unknown.
        is_real: Whether it announces the real type.
        is_empty: Whether it has no fields: messages have one byte, which some recordings lack.
    """

    writes: Any
    type_hash: str
    is_real: bool
    is_empty: bool


def dds_topic(topic: str, *, bare: bool = False) -> str | None:
    """The DDS name of a topic, such as ``rt/camera/image``; None if it is not valid in ROS 2.

    Args:
        topic: The ROS name.
        bare: Without the prefix of ROS.
    """
    if not _TOPIC.fullmatch(topic) or "__" in topic:
        return None
    return topic.strip("/") if bare else f"rt/{topic.strip('/')}"


def dds_name(type_name: str) -> str:
    """The DDS name of a type: ``std_msgs/msg/String`` -> ``std_msgs.msg.dds_.String_``."""
    *rooms, name = type_name.split("/")
    return ".".join((*rooms, "dds_", f"{name}_"))


def opaque_type(name: str) -> Any:
    """A class for messages of a type of which only the DDS name, with dots, is known."""
    from cyclonedds.idl import make_idl_struct

    short = name.rpartition(".")[2]
    return as_is(make_idl_struct(short, name, {}, dataclassify=False))


def message_type(channel: Channel, version: RosVersion) -> DdsType:
    """How messages of a channel are written.

    Raises:
        ConversionError: The name of the type is not valid in ROS 2.
    """
    name = _full_name(channel.type_name)
    if not _NAME.fullmatch(name):
        problem = f"{channel.type_name!r} is not a ROS 2 message type"
        raise ConversionError(channel.topic, problem, "Leave the topic out.")
    type_hash = _metadata_hash(channel)
    try:
        types = _known_types(channel, version)
        type_hash = type_hash or _computed_hash(types, name, version)
        real = as_is(make_struct(types, name))
    except Refused:
        return DdsType(opaque_type(dds_name(name)), type_hash, False, False)
    is_empty = types[name][1][0][0] == _FILLER
    return DdsType(real, type_hash, True, is_empty)


def recorded_hash(channel: Channel) -> str:
    """The hash of a channel's type, RIHS01_...: as recorded, else of its definition; or empty."""
    if recorded := _metadata_hash(channel):
        return recorded
    try:
        version = ros2_version("jazzy")
        return _computed_hash(
            _known_types(channel, version), _full_name(channel.type_name), version
        )
    except (Refused, KeyError):
        return ""


def _metadata_hash(channel: Channel) -> str:
    recorded = channel.metadata.get(HASH_KEY, "")
    return recorded if _HASH.fullmatch(recorded) else ""


def _computed_hash(types: Types, name: str, version: RosVersion) -> str:
    hashed = make_store(types, version).hash_rihs01
    return by_library(incomprehensible(name), hashed, name)


def _full_name(name: str) -> str:
    """The full name: ``std_msgs/String`` is short for ``std_msgs/msg/String``."""
    rooms = name.split("/")
    return f"{rooms[0]}/msg/{rooms[1]}" if len(rooms) == 2 else name


def _known_types(channel: Channel, version: RosVersion) -> Types:
    if channel.schema is None:
        raise Refused(_NO_DDS_TYPE)
    return {
        name: (constants, fields or [_filler(version)])
        for name, (constants, fields) in types_of(channel.schema, version).items()
    }


def _filler(version: RosVersion) -> Any:
    return version.standard["std_msgs/msg/Empty"][1][0]


def make_struct(types: Types, name: str, *, has_fields: bool = False) -> Any:
    """Create the class of a type, after those of the types it refers to.

    Args:
        types: All definitions.
        name: Which one.
        has_fields: Whether messages have fields; otherwise, only their bytes.

    Raises:
        Refused: DDS cannot have this type.
    """
    return _StructMaker(types, has_fields).struct(name)[0]


class _StructMaker:
    def __init__(self, types: Types, has_fields: bool) -> None:
        self._types = types
        self._has_fields = has_fields
        self._made: dict[str, tuple[Any, int]] = {}
        self._open: list[str] = []

    def struct(self, name: str) -> tuple[Any, int]:
        """The class of a type, and the size of its fixed-size parts in bytes."""
        from cyclonedds.idl import make_idl_struct

        if name in self._made:
            return self._made[name]
        if name in self._open or len(self._open) >= _MAX_NESTING or not _NAME.fullmatch(name):
            raise Refused(_NO_DDS_TYPE)
        self._open.append(name)
        fields: dict[str, Any] = {}
        total = 0
        for field, desc in self._types[name][1]:
            if field in fields or field.startswith("__"):
                raise Refused(_NO_DDS_TYPE)
            fields[field], size = self._field(desc)
            total += size
        if total > _MAX_SIZE:
            raise Refused(_NO_DDS_TYPE)
        self._open.pop()
        short = f"{name.rpartition('/')[2]}_"
        make = partial(make_idl_struct, dataclassify=self._has_fields)
        made = by_library(_NO_DDS_TYPE, make, short, dds_name(name), fields)
        self._made[name] = made, total
        return made, total

    def _field(self, desc: Any) -> tuple[Any, int]:
        from cyclonedds.idl import types

        shape = field_shape(desc)
        if shape.message:
            kind, size = self.struct(shape.message)
        else:
            kind, size = _base(shape.base, shape.text_bound), 8
        if shape.length is not None:
            made = by_library(_NO_DDS_TYPE, getitem, types.array, (kind, shape.length))
            return made, size * shape.length
        if shape.bound is not None:
            bounded = (kind, shape.bound) if shape.bound else kind
            return by_library(_NO_DDS_TYPE, getitem, types.sequence, bounded), 24
        return kind, size


def _base(name: str, bound: int) -> Any:
    from cyclonedds.idl import types

    if name not in _BASES:
        raise Refused(_NO_DDS_TYPE)
    if name == "string":
        return types.bounded_str[bound] if bound else str
    return bool if name == "bool" else getattr(types, _BASES[name])


# ---------------------------------------------------------------- listening

_PATIENCE = 50_000_000  # ns between checks for new publishers
_BATCH = 100
_KEPT = 1000  # history depth of readers
_TYPE_PATIENCE = 2_000_000_000  # ns to wait for another participant to describe a type


class DdsListener:
    """Calls back for each message of other nodes, from a thread that runs until `close`.

    The library's own listeners are not used: they would wait for the GIL while it is held by a
    write that waits for the very thread they run on.

    Args:
        participant: The participant that the readers belong to.
    """

    def __init__(self, participant: Any) -> None:
        self._participant = participant
        self._lock = threading.Lock()
        self._readers: list[tuple[Any, Callable[[Any], None]]] = []
        self._sought: list[_Sought] = []
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    def hear(self, reader: Any, on_sample: Callable[[Any], None]) -> None:
        """Call back with each valid sample that a reader receives."""
        with self._lock:
            self._readers.append((reader, on_sample))
        self._start()

    def seek(self, topic: str, on_message: Callable[[], None]) -> None:
        """Call back for each message of any type on a topic, as soon as it has a publisher.

        Args:
            topic: Its DDS name.
            on_message: Called for each message.
        """
        with self._lock:
            self._sought.append(_Sought(self._participant, topic, on_message))
        self._start()

    def close(self) -> None:
        """End the thread, and release the readers and the participant."""
        self._ended.set()
        if self._thread and self._thread is not threading.current_thread():
            self._thread.join()
        self._readers.clear()
        self._sought.clear()
        self._participant = None

    def _start(self) -> None:
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="mp4ds-dds", daemon=True)
            self._thread.start()

    def _run(self) -> None:
        from cyclonedds.core import WaitSet

        waiting = WaitSet(self._participant)
        attached: list[Any] = []
        while not self._ended.is_set():
            with self._lock:
                readers, sought = list(self._readers), list(self._sought)
            for reader, _ in readers[len(attached) :]:
                attached.append(_has_data(reader))
                waiting.attach(attached[-1])
            for one in sought:
                for reader in one.found():
                    self.hear(reader, one.on_sample)
            waiting.wait(_PATIENCE)
            for reader, on_sample in readers:
                self._take(reader, on_sample)

    def _take(self, reader: Any, on_sample: Callable[[Any], None]) -> None:
        for sample in reader.take(_BATCH):
            if self._ended.is_set():
                return
            if sample.sample_info.valid_data:
                on_sample(sample)


def _has_data(reader: Any) -> Any:
    from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState

    return ReadCondition(reader, SampleState.Any | ViewState.Any | InstanceState.Any)


class _Sought:
    """A topic whose type is unknown until it has a publisher."""

    def __init__(self, participant: Any, topic: str, on_message: Callable[[], None]) -> None:
        from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication

        self._participant = participant
        self._topic = topic
        self._on_message = on_message
        self._known: set[str] = set()
        self._publications = BuiltinDataReader(participant, BuiltinTopicDcpsPublication)

    def on_sample(self, _: Any) -> None:
        """A message was received."""
        self._on_message()

    def found(self) -> list[Any]:
        """Readers for the publishers discovered since the last call, one per type."""
        readers = []
        own = self._participant.guid
        for endpoint in self._publications.take(_BATCH):
            is_new = endpoint.sample_info.valid_data and endpoint.topic_name == self._topic
            if is_new and endpoint.participant_key != own and endpoint.type_name not in self._known:
                self._known.add(endpoint.type_name)
                readers += self._reader(endpoint)
        return readers

    def _reader(self, endpoint: Any) -> list[Any]:
        from cyclonedds.core import DDSException, Policy, Qos
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic

        best_effort = Policy.Reliability.BestEffort in endpoint.qos
        hashed = _TYPE_HASH.search(_user_data(endpoint.qos))
        qos = Qos(
            Policy.Reliability.BestEffort if best_effort else Policy.Reliability.Reliable(0),
            Policy.History.KeepLast(_KEPT),
            Policy.IgnoreLocal.Participant,
            # nodes look for the hash, and warn if it is missing
            *([Policy.Userdata(hashed[0])] if hashed else []),
        )
        try:
            topic = Topic(
                self._participant, self._topic, publisher_type(self._participant, endpoint)
            )
            return [DataReader(self._participant, topic, qos=qos)]
        except DDSException:
            return []  # another type of this topic: a participant can have only one


def publisher_type(participant: Any, endpoint: Any) -> Any:
    """The class of a publisher's messages. If it announces its type, readers need the same.

    Args:
        participant: Our participant.
        endpoint: The publisher, as discovered.
    """
    from cyclonedds.core import DDSException
    from cyclonedds.dynamic import get_types_for_typeid

    if endpoint.type_id is not None:
        try:
            return as_is(get_types_for_typeid(participant, endpoint.type_id, _TYPE_PATIENCE)[0])
        except DDSException:
            pass  # the name is all that ROS compares
    return opaque_type(endpoint.type_name.replace("::", "."))


_TYPE_HASH = re.compile(rb"typehash=RIHS\d\d_[0-9a-f]+;")


def _user_data(qos: Any) -> bytes:
    """The user data of a reader or writer."""
    from cyclonedds.core import Policy

    return bytes(qos[Policy.Userdata].data) if Policy.Userdata in qos else b""
