"""What a recording consists of, in the words of MCAP, whatever it was read from.

Neutral, frozen and without I/O: readers make these, everything else passes them on.
A ROS 1 connection and a rosbag2 topic are channels too (spec/index.md, "Channels").
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from mp4ds.errors import counted

QOS_KEY = "offered_qos_profiles"
"""Key of a ROS 2 channel's metadata with the recorded QoS profiles, a YAML text."""

HASH_KEY = "topic_type_hash"
"""Key of a ROS 2 channel's metadata with the hash of its type's description."""


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
        id: Unique within one reader, meaningless outside it.
        topic: Topic name, as the source spells it.
        message_encoding: ``ros1``, ``cdr``, ``protobuf``, ``json`` ...
        schema: The definition, or None if the source has none.
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
        """All fields except the id: channels with the same identity are indistinguishable."""
        metadata = tuple(sorted(self.metadata.items()))
        return (self.topic, self.message_encoding, self.schema, metadata)


@dataclass(frozen=True, slots=True)
class Message:
    """One serialized message.

    Attributes:
        channel: The channel it was recorded on.
        log_time: When it was recorded, nanoseconds.
        publish_time: When it was published, nanoseconds; the log time if unknown.
        sequence: The MCAP sequence number; 0 if the source has none.
        data: The payload, byte for byte.
    """

    channel: Channel
    log_time: int
    publish_time: int
    sequence: int
    data: bytes | memoryview

    def of_channel(self, channel: Channel) -> Message:
        """The same message on another channel."""
        return Message(channel, self.log_time, self.publish_time, self.sequence, self.data)


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
class Excerpt:
    """A part of a recording: a span of log time, and some of the topics.

    Attributes:
        start: The first log time included, nanoseconds; None for open.
        end: The first log time after it, nanoseconds; None for open.
        topics: Only these; None for all.
        without: All except these.
        others: Also all attachments and metadata records, whatever the span.
    """

    start: int | None = None
    end: int | None = None
    topics: frozenset[str] | None = None
    without: frozenset[str] = frozenset()
    others: bool = True

    @property
    def has_messages(self) -> bool:
        """Whether it may contain any messages."""
        if self.start is not None and self.end is not None and self.start >= self.end:
            return False
        return self.topics is None or not self.topics <= self.without

    def has_topic(self, topic: str) -> bool:
        """Whether it includes messages of a topic."""
        return topic not in self.without and (self.topics is None or topic in self.topics)

    def has_time(self, time: int) -> bool:
        """Whether it includes messages of a log time, nanoseconds."""
        return (self.start is None or self.start <= time) and (self.end is None or time < self.end)

    def within(self, other: Excerpt) -> Excerpt:
        """The part of it within the span of another."""
        starts = [time for time in (self.start, other.start) if time is not None]
        ends = [time for time in (self.end, other.end) if time is not None]
        return replace(self, start=max(starts, default=None), end=min(ends, default=None))

    def touches(self, first: int, last: int) -> bool:
        """Whether it includes any log time from `first` to `last`, inclusive."""
        return (self.start is None or self.start <= last) and (self.end is None or first < self.end)

    def has(self, record: Record) -> bool:
        """Whether it includes a record."""
        if isinstance(record, Message):
            return self.has_time(record.log_time) and self.has_topic(record.channel.topic)
        return self.others


EVERYTHING = Excerpt()
"""The whole recording."""


MAX_LOSSES = 1000
"""Losses of a recording that are listed individually; the last one then summarises the rest."""

MAX_LOST_TOPICS = 64
"""Topics that one loss names; the last name then says how many more there are."""


MAX_REASONS = 10
"""Reasons for which messages of one topic are stored verbatim that are told apart."""

OTHER_REASONS = "other reasons"
"""What those beyond the limit are called."""


@dataclass(frozen=True, slots=True)
class Loss:
    """A part of a recording that could not be read.

    Attributes:
        file: Name of the file.
        offset: Byte where it begins, None if it has no place in the file.
        size: Its bytes, some of which may have been read anyway; None if unknown.
        problem: What is wrong, a phrase.
        messages: How many are lost, None if unknown. If only the total of several places is known,
            the largest of them has it.
        topics: Topics known to have lost messages.
        start: Log time of the last message read before it, ns; None if unknown.
        end: Log time of the first message read after it, ns; None if unknown.
        frames: Numbers of the first and the last frame that are lost of a dataset's video; `start`
            and `end` are the log times of these two.
    """

    file: str
    offset: int | None
    size: int | None
    problem: str
    messages: int | None = None
    topics: tuple[str, ...] = ()
    start: int | None = None
    end: int | None = None
    frames: tuple[int, int] | None = None


_MORE_PLACES = " more places that could not be read"


def more_places(number: int) -> str:
    """The problem of a loss that sums up others, of so many places."""
    return f"{number}{_MORE_PLACES}"


def bounded(losses: Sequence[Loss]) -> list[Loss]:
    """Losses of several files; the last one sums up those beyond the limit."""
    if len(losses) <= MAX_LOSSES:
        return list(losses)
    rest = losses[MAX_LOSSES - 1 :]
    problem, size = more_places(sum(map(_places, rest))), sum(loss.size or 0 for loss in rest)
    counts = [loss.messages for loss in rest if loss.messages is not None]
    messages = sum(counts) if len(counts) == len(rest) else None
    return [*losses[: MAX_LOSSES - 1], Loss(rest[0].file, None, size, problem, messages)]


def _places(loss: Loss) -> int:
    number = loss.problem.removesuffix(_MORE_PLACES)
    return int(number) if loss.problem.endswith(_MORE_PLACES) and number.isdecimal() else 1


@dataclass(frozen=True, slots=True)
class ChannelStats:
    """What an index says about a channel without reading its messages.

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

    def plus(self, other: ChannelStats) -> ChannelStats:
        """Both combined; without messages there is no span."""
        if not self.count or not other.count:
            return self if self.count else other
        return ChannelStats(
            self.count + other.count, min(self.start, other.start), max(self.end, other.end)
        )


def latched_text(counts: Mapping[str, int]) -> str:
    """How many latched messages come from before a slice, by topic, in words."""
    messages = counted(sum(counts.values()), "latched message")
    return f"{messages} from before the start: {', '.join(counts)}"
