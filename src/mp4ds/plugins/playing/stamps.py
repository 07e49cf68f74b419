"""The stamps in messages, which players may replace by the time of publishing."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator

from mp4ds.bags.types import (
    HEADER,
    FieldShape,
    field_shape,
    fields_of,
    name_of,
    ros1_version,
    ros2_version,
    types_of,
)
from mp4ds.errors import ConversionError, Refused
from mp4ds.records import Channel

_NS = 1_000_000_000
_DISTRIBUTION = "humble"
_TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_POSE = 7 * 8  # bytes: a translation and a quaternion of doubles
_ENCAPSULATION = 4
_Places = Callable[[bytearray, str, bool], Iterator[int]]


class Restamper:
    """Replaces the stamps in messages: of their header, or of their transforms' headers.

    Equal stamps stay equal, and zero stays zero.
    """

    def __init__(self) -> None:
        self._known: dict[int, tuple[Channel, _Places | None]] = {}

    def restamped(
        self, channel: Channel, payload: bytes | memoryview, wall_of: Callable[[int], int]
    ) -> bytes | memoryview:
        """A message with new stamps; unchanged if it has none.

        Args:
            channel: Channel of the message.
            payload: The serialized message.
            wall_of: Maps recording time to wall-clock time, both in nanoseconds.

        Raises:
            ConversionError: The message is not of the channel's type, or a stamp is out of range.
        """
        if id(channel) not in self._known:
            self._known[id(channel)] = channel, _places_in(channel)
        places = self._known[id(channel)][1]
        if places is None:
            return payload
        is_ros1 = channel.message_encoding == "ros1"
        made = bytearray(payload)
        order = "<" if is_ros1 or made[1:2] != b"\0" else ">"
        stamp = struct.Struct(f"{order}{'I' if is_ros1 else 'i'}I")
        try:
            for place in places(made, order, is_ros1):
                seconds, nanoseconds = stamp.unpack_from(made, place)
                if seconds or nanoseconds:
                    time = wall_of(seconds * _NS + nanoseconds)
                    stamp.pack_into(made, place, *divmod(time, _NS))
        except struct.error as error:
            problem = f"cannot replace the stamp of a message: {error}"
            raise ConversionError(channel.topic, problem) from None
        return memoryview(made)


def _places_in(channel: Channel) -> _Places | None:
    """Where the stamps are in a channel's messages; None if they have none, or are not of ROS."""
    schema = channel.schema
    if channel.message_encoding not in ("ros1", "cdr") or schema is None or not schema.name:
        return None
    name = name_of(schema)
    if name in _TRANSFORMS:
        return _of_transforms
    is_ros1 = channel.message_encoding == "ros1"
    version = ros1_version() if is_ros1 else ros2_version(_DISTRIBUTION)
    try:
        fields = fields_of(types_of(schema, version), name)
    except Refused:
        return None
    has_header = fields and field_shape(fields[0][1]) == FieldShape("", HEADER, 0, None, None)
    return _of_header if has_header else None


def _of_header(_: bytearray, __: str, ___: bool) -> Iterator[int]:
    yield 4  # after the sequence number of ROS 1, or the encapsulation of CDR


def _of_transforms(data: bytearray, order: str, is_ros1: bool) -> Iterator[int]:
    number = struct.Struct(f"{order}I")

    def aligned(place: int, size: int) -> int:
        return place if is_ros1 else place + -(place - _ENCAPSULATION) % size

    place = 0 if is_ros1 else _ENCAPSULATION
    (count,) = number.unpack_from(data, place)
    place += 4
    for _ in range(count):
        place = aligned(place, 4) + (4 if is_ros1 else 0)
        yield place
        place += 8
        for _name in ("frame_id", "child_frame_id"):
            place = aligned(place, 4)
            place += 4 + number.unpack_from(data, place)[0]
        place = aligned(place, 8) + _POSE
