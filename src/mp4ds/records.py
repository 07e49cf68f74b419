"""What a recording consists of, in the words of MCAP, whatever it was read from.

Neutral, frozen and without I/O: readers make these, everything else passes them on.
A ROS 1 connection and a rosbag2 topic are channels too (spec/index.md, "Channels").
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Schema:
    """A message definition.

    Attributes:
        name: Type name as the source spells it, such as ``sensor_msgs/msg/Image``.
        encoding: ``ros1msg``, ``ros2msg``, ``ros2idl``, ``protobuf``, ``jsonschema`` ...;
            empty when the source holds no definition.
        data: The definition, byte for byte.
    """

    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Channel:
    """One topic of one publisher; several channels may share a topic.

    Attributes:
        id: Unique within one reader, and without meaning outside of it.
        topic: Topic name, as the source spells it.
        message_encoding: ``ros1``, ``cdr``, ``protobuf``, ``json`` ...
        schema: The definition, or None where the source has none at all.
        metadata: For ROS 1 the connection header (callerid, latching, md5sum ...);
            for ROS 2 ``offered_qos_profiles`` and ``topic_type_hash``; all verbatim.
    """

    id: int
    topic: str
    message_encoding: str
    schema: Schema | None
    metadata: Mapping[str, str] = field(default_factory=dict)

    @property
    def type_name(self) -> str:
        """The type's name, empty for a channel without a schema."""
        return self.schema.name if self.schema else ""

    @property
    def identity(self) -> tuple[object, ...]:
        """All fields but the id: channels of the same identity cannot be told apart."""
        metadata = tuple(sorted(self.metadata.items()))
        return (self.topic, self.message_encoding, self.schema, metadata)


@dataclass(frozen=True, slots=True)
class Message:
    """One serialized message.

    Attributes:
        channel: The channel it was recorded on.
        log_time: When it was recorded, nanoseconds.
        publish_time: When it was published, nanoseconds; the log time where not known.
        sequence: The MCAP sequence number; 0 where the source has none.
        data: The payload, byte for byte.
    """

    channel: Channel
    log_time: int
    publish_time: int
    sequence: int
    data: bytes | memoryview


@dataclass(frozen=True, slots=True)
class Attachment:
    """An MCAP attachment. Times are nanoseconds."""

    name: str
    media_type: str
    create_time: int
    log_time: int
    data: bytes


@dataclass(frozen=True, slots=True)
class MetadataRecord:
    """A named MCAP metadata record."""

    name: str
    metadata: Mapping[str, str]


Record = Message | Attachment | MetadataRecord


@dataclass(frozen=True, slots=True)
class ChannelStats:
    """What an index tells of a channel without reading its messages.

    Attributes:
        count: Number of messages.
        start: Earliest log time, nanoseconds.
        end: Latest log time, nanoseconds.
    """

    count: int
    start: int
    end: int

    @property
    def rate(self) -> float | None:
        """Mean rate in Hz, or None below two messages or without a time span."""
        if self.count < 2 or self.end <= self.start:
            return None
        return (self.count - 1) * 1e9 / (self.end - self.start)
