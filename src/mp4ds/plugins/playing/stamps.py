"""The stamps in messages, which players may move."""

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
from mp4ds.errors import Refused
from mp4ds.records import Channel

NS = 1_000_000_000
_DISTRIBUTION = "humble"
_TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_POSE = 7 * 8  # bytes: a translation and a quaternion of doubles
_ENCAPSULATION = 4


class HeaderStamps:
    """The stamps in messages of one channel: of their header, or of their transforms' headers.

    Args:
        channel: Any; without ROS or a header, there are no stamps.
    """

    def __init__(self, channel: Channel) -> None:
        self._is_ros1 = channel.message_encoding == "ros1"
        self._places = self._find(channel)

    @property
    def has_any(self) -> bool:
        """Whether messages of the channel have stamps."""
        return self._places is not None

    def moved(self, payload: bytes | memoryview, move: Callable[[int], int]) -> bytes | bytearray:
        """A copy of a message with changed stamps.

        Args:
            payload: Of the channel.
            move: Maps a stamp to its new value, nanoseconds. Zero stays zero.

        Raises:
            ValueError: It is not of the channel's type, or a stamp is out of range.
        """
        made = bytearray(payload)
        if self._places is None:
            return made
        order = "<" if self._is_ros1 or made[1:2] != b"\0" else ">"
        code = struct.Struct(f"{order}{'I' if self._is_ros1 else 'i'}I")
        try:
            for place in self._places(made, order):
                seconds, nanoseconds = code.unpack_from(made, place)
                if seconds or nanoseconds:
                    code.pack_into(made, place, *divmod(move(seconds * NS + nanoseconds), NS))
        except struct.error as error:
            raise ValueError(str(error)) from None
        return made

    def _find(self, channel: Channel) -> Callable[[bytearray, str], Iterator[int]] | None:
        schema = channel.schema
        if channel.message_encoding not in ("ros1", "cdr") or schema is None or not schema.name:
            return None
        name = name_of(schema)
        if name in _TRANSFORMS:
            return self._of_transforms
        version = ros1_version() if self._is_ros1 else ros2_version(_DISTRIBUTION)
        try:
            fields = fields_of(types_of(schema, version), name)
        except Refused:
            return None
        if fields and field_shape(fields[0][1]) == FieldShape("", HEADER, 0, None, None):
            return self._of_header
        return None

    def _of_header(self, _: bytearray, __: str) -> Iterator[int]:
        yield 4  # after the sequence number of ROS 1, or the encapsulation of CDR

    def _of_transforms(self, data: bytearray, order: str) -> Iterator[int]:
        number = struct.Struct(f"{order}I")
        start = 0 if self._is_ros1 else _ENCAPSULATION
        (count,) = number.unpack_from(data, start)
        place = start + 4
        for _ in range(count):
            place = self._aligned(place, 4) + (4 if self._is_ros1 else 0)
            yield place
            place += 8
            for _name in ("frame_id", "child_frame_id"):
                place = self._aligned(place, 4)
                place += 4 + number.unpack_from(data, place)[0]
            place = self._aligned(place, 8) + _POSE

    def _aligned(self, place: int, size: int) -> int:
        if self._is_ros1:
            return place
        return place + -(place - _ENCAPSULATION) % size
