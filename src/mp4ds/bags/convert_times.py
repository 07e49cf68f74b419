"""Times that one ROS has and the other has not: negative ones, and those after 2038.

Seconds are unsigned in ROS 1, and have a sign in ROS 2, in 32 bits each.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import is_dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from rosbags.typesys.store import Typestore

from mp4ds.bags.typedefs import BUILTIN, HEADER, field_shape, fields_of

if TYPE_CHECKING:
    from rosbags.interfaces.typing import Typesdict

TIME = BUILTIN[0]
Where = Literal["nowhere", "header", "anywhere"]


def where_times_are(types: Typesdict, name: str) -> Where:
    """Whether messages of a type have times: none, one in the header they begin with, or others."""

    def has_time(part: str) -> bool:
        return part == TIME or any(has_time(inner) for _, inner, _ in _parts(types, part))

    parts = _parts(types, name)
    is_headed = bool(parts) and parts[0] == (0, HEADER, False)
    others = name == TIME or any(has_time(part) for _, part, _ in parts[is_headed:])
    return "anywhere" if others else "header" if is_headed else "nowhere"


def _parts(types: Typesdict, name: str) -> list[tuple[int, str, bool]]:
    """Of the fields that are messages: place, type, and whether they are several."""
    shapes = [field_shape(desc) for _, desc in fields_of(types, name)]
    return [
        (place, shape.message, shape.length is not None or shape.bound is not None)
        for place, shape in enumerate(shapes)
        if shape.message
    ]


def time_beyond(where: Where, data: bytes | memoryview, name: str, store: Typestore) -> int | None:
    """Seconds of a time in a message that only ROS 2 takes for negative; None where there is none.

    Args:
        where: From `where_times_are`.
        data: The message in little-endian CDR.
        name: Its type.
        store: What parses it.
    """
    if where == "nowhere":
        return None
    if where == "header":
        seconds = struct.unpack_from("<i", data, 4)[0]
        return int(seconds) if seconds < 0 else None
    words = np.frombuffer(data, "<i4", count=len(data) // 4)
    if not (words < 0).any():  # as CDR has them: at multiples of four
        return None
    return next((sec for sec in _seconds(store.deserialize_cdr(data, name)) if sec < 0), None)


def _seconds(value: Any) -> Iterator[int]:
    if is_dataclass(value):
        if getattr(value, "__msgtype__", "") == TIME:
            yield int(getattr(value, "sec"))  # noqa: B009 - of rosbags' making
        for name in value.__dataclass_fields__:
            yield from _seconds(getattr(value, name))
    elif isinstance(value, list):
        for item in value:
            yield from _seconds(item)
