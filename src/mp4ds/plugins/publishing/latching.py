"""The messages of a latched channel that late subscribers get."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, Generic, TypeVar

from mp4ds.bags.convert import LATCHED_QOS
from mp4ds.bags.rosbag2_metadata import native_qos
from mp4ds.errors import Refused
from mp4ds.messages.transforms import transform_parser
from mp4ds.messages.wire import WireError
from mp4ds.records import QOS_KEY, Channel

PLAYER_DEPTH = 10
"""rosbag2's history depth: recordings seldom know the depth of their publishers."""

TF_STATIC_DEPTH = 100
"""History depth of tf2's listeners for /tf_static."""

MOST = 1000
_TF_STATIC = "tf_static"
_Item = TypeVar("_Item")


def kept_depth(channel: Channel) -> int:
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


class Kept(Generic[_Item]):
    """The messages of a latched channel that are kept for late subscribers, oldest first.

    For /tf_static, these are the newest transforms of each child frame, as each of many publishers
    may have sent a few. A message that is sent again, after going back, is kept once.

    Args:
        channel: The channel, as recorded.
    """

    def __init__(self, channel: Channel) -> None:
        self._depth = kept_depth(channel)
        self._children = None if is_ros1(channel) else _parser(channel)
        self._kept: list[tuple[bytes | memoryview, frozenset[str] | None, _Item]] = []

    def __iter__(self) -> Iterator[_Item]:
        return (item for _, _, item in self._kept)

    def add(self, payload: bytes | memoryview, item: _Item) -> None:
        """Keep one more.

        Args:
            payload: The serialized message.
            item: What to return for it when iterating.
        """
        kept = [one for one in self._kept if one[0] != payload]
        kept.append((payload, self._children(payload) if self._children else None, item))
        if self._children:
            kept = _uncovered(kept)
        self._kept = kept[-(MOST if self._children else self._depth) :]


_Row = tuple["bytes | memoryview", "frozenset[str] | None", _Item]


def _uncovered(rows: list[_Row[_Item]]) -> list[_Row[_Item]]:
    """The messages with a child frame that is in no later message."""
    later: set[str] = set()
    found = []
    for row in reversed(rows):
        frames = row[1]
        if frames is None or not frames <= later:
            found.append(row)
        later |= frames or set()
    return found[::-1]


def _parser(channel: Channel) -> Callable[[bytes | memoryview], frozenset[str] | None] | None:
    """A function that returns the child frames of a /tf_static message; None for other channels."""
    if channel.topic.rpartition("/")[2] != _TF_STATIC:
        return None
    try:
        parse = transform_parser(channel)
    except (WireError, Refused):
        return None

    def children(payload: bytes | memoryview) -> frozenset[str] | None:
        try:
            return frozenset(one.child for one in parse(memoryview(payload)))
        except WireError:
            return None  # kept in any case

    return children
