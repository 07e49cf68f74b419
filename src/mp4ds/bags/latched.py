"""The messages of latched channels that late subscribers get."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

from mp4ds.bags.protocols import (
    WHOLE,
    BagReader,
    RecordingSlice,
    in_span,
    stats_of,
    with_own_payload,
)
from mp4ds.bags.rosbag2_metadata import native_qos
from mp4ds.errors import Refused, SourceError
from mp4ds.messages.serializations import is_camera
from mp4ds.messages.transforms import is_tf_static, transform_parser
from mp4ds.options import SliceOptions
from mp4ds.records import QOS_KEY, Channel, Excerpt, Message

_FOREVER = """
    sec: 9223372036
    nsec: 854775807"""
_QOS = f"""\
- history: 1
  depth: {{depth}}
  reliability: 1
  durability: {{durability}}
  deadline:{_FOREVER}
  lifespan:{_FOREVER}
  liveliness: 1
  liveliness_lease_duration:{_FOREVER}
  avoid_ros_namespace_conventions: false"""
LATCHED_QOS = _QOS.format(depth=1, durability=1)
"""Keep the last one, reliable, transient local: what ROS 1 calls latching."""
DEFAULT_QOS = _QOS.format(depth=10, durability=2)
"""Keep the last ten, reliable, volatile: the default of publishers in ROS 2."""

PLAYER_DEPTH = 10
"""rosbag2's history depth: recordings seldom know the depth of their publishers."""

TF_STATIC_DEPTH = 100
"""History depth of tf2's listeners for /tf_static."""

MOST = 1000

MOST_BYTES = 2**28
"""Of the latched messages from before a slice."""


def is_latched(channel: Channel) -> bool:
    """Whether late subscribers get the last message: latching, or transient local."""
    if is_ros1(channel):
        return True
    qos = channel.metadata.get(QOS_KEY, "")
    found = re.findall(r"durability[\"']?\s*:\s*[\"']?(\w+)", qos)
    return bool(found) and set(found) <= {"1", "transient_local"}


def has_late(channel: Channel) -> bool:
    """Whether late subscribers get earlier messages: /tf_static counts as latched in any case."""
    return is_latched(channel) or is_tf_static(channel)


def latched_depth(channel: Channel) -> int:
    """How many messages of a latched channel late subscribers get.

    A ROS 1 channel has one publisher, which latches one message. rosbag2 merges all publishers of a
    topic into one channel; each of them kept as many messages as its own profile says. Publishers
    that started after the recorder have no profile in it.
    """
    if is_ros1(channel):
        return 1
    if _parser(channel):
        return TF_STATIC_DEPTH
    qos = channel.metadata.get(QOS_KEY, "")
    if qos == LATCHED_QOS:  # written by mp4ds for a latching ROS 1 publisher
        return 1
    total = sum(_depth(profile) for profile in native_qos(qos))
    return min(max(total, PLAYER_DEPTH), MOST)


def _depth(profile: Mapping[str, Any]) -> int:
    depth, history = profile.get("depth"), profile.get("history")
    if type(depth) is int and depth > 0 and history == "keep_last":
        return depth
    return MOST if history == "keep_all" else PLAYER_DEPTH


def is_ros1(channel: Channel) -> bool:
    """Whether it is latched in the sense of ROS 1."""
    return channel.metadata.get("latching", "").lower() in ("1", "true")


class LatchedMessages:
    """The messages of a latched channel that are kept for late subscribers, oldest first.

    For /tf_static, these are the newest transforms of each child frame, as each of many publishers
    may have sent a few. A message that is sent again, after going back, is kept once.

    Args:
        channel: The channel, as recorded.

    Attributes:
        size: Bytes of the kept messages.
    """

    def __init__(self, channel: Channel) -> None:
        self._depth = latched_depth(channel)
        self._children = None if is_ros1(channel) else _parser(channel)
        self._kept: list[tuple[Message, frozenset[str] | None]] = []
        self.size = 0

    def __iter__(self) -> Iterator[Message]:
        return (message for message, _ in self._kept)

    def add(self, message: Message) -> None:
        """Keep one more."""
        rows = [one for one in self._kept if one[0].data != message.data]
        rows.append((message, self._children(message.data) if self._children else None))
        most = self._depth
        if self._children:
            # only messages with a child frame that is in no later message
            later: set[str] = set()
            kept = []
            for row in reversed(rows):
                if row[1] is None or not row[1] <= later:
                    kept.append(row)
                later |= row[1] or set()
            rows, most = kept[::-1], MOST
        self._kept = rows[-most:]
        self.size = sum(len(one.data) for one in self)


def _parser(channel: Channel) -> Callable[[bytes | memoryview], frozenset[str] | None] | None:
    """A function that returns the child frames of a /tf_static message; None for other channels."""
    parse = transform_parser(channel) if is_tf_static(channel) else None
    if parse is None:
        return None

    def children(payload: bytes | memoryview) -> frozenset[str] | None:
        try:
            return frozenset(one.child for one in parse(memoryview(payload)))
        except Refused:
            return None  # kept in any case

    return children


def take_slice(
    reader: BagReader, asked: SliceOptions, selected: Callable[[str], bool] = lambda _: True
) -> None:
    """Let a reader give a slice of its recording, with latched messages if requested.

    Args:
        reader: Of the whole recording.
        asked: The slice.
        selected: Whether a topic's latched messages are wanted: others take no room of theirs.

    Raises:
        OptionError: It is empty, or a time is not valid.
        SourceError: The recording is damaged, or without messages.
    """
    first, last = ends_of(reader)
    span = Excerpt(*asked.slice_times(first, last, reader.path))
    latched: tuple[Sequence[Message], Sequence[str]] = ((), ())
    if asked.latched and span.start is not None:
        latched = latched_before(reader, Excerpt(end=span.start), selected)
    reader.slice = RecordingSlice(span, *latched)


def ends_of(reader: BagReader) -> tuple[int, int]:
    """Where the times of slices begin, and the last log time of a whole recording, nanoseconds.

    Raises:
        SourceError: The recording is damaged, or without messages.
    """
    kept, reader.slice = reader.slice, WHOLE
    try:
        known = [item for item in reader.stats().values() if item.count]
        if not known or not reader.is_indexed:
            known = [item for item in stats_of(reader.times()).values() if item.count]
    finally:
        reader.slice = kept
    if not known:
        raise SourceError(reader.path, "has no messages to take a slice of")
    first, last = min(item.start for item in known), max(item.end for item in known)
    return max(first, reader.begin or first), last


def latched_before(
    reader: BagReader, before: Excerpt, selected: Callable[[str], bool] = lambda _: True
) -> tuple[Sequence[Message], Sequence[str]]:
    """The latched messages from before a slice, by log time; images are never among them.

    Args:
        reader: Of the whole recording.
        before: What is before the slice.
        selected: Whether a topic's latched messages are wanted.

    Returns:
        The messages, and the topics left out since the messages are too large.
    """
    own = {
        channel.id: channel
        for channel in reader.channels
        if selected(channel.topic) and has_late(channel) and not is_camera(channel)
    }
    # some readers scan the whole recording for the times
    times = reader.times() if own else {}
    own = {key: own[key] for key in own if key in times and len(in_span(times[key], before))}
    if not own:
        return (), ()
    kept = {key: LatchedMessages(channel) for key, channel in own.items()}
    topics = frozenset(channel.topic for channel in own.values())
    left_out: dict[str, None] = {}
    size = 0
    for message in reader.records(replace(before, topics=topics, others=False)):
        if not isinstance(message, Message) or message.channel.id not in kept:
            continue
        one = kept[message.channel.id]
        size -= one.size
        one.add(with_own_payload(message))
        size += one.size
        while size > MOST_BYTES:
            largest = max(kept, key=lambda key: kept[key].size)
            size -= kept.pop(largest).size
            left_out[own[largest].topic] = None
    return sorted(chain.from_iterable(kept.values()), key=lambda one: one.log_time), [*left_out]
