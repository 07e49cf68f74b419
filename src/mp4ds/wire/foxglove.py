"""What Foxglove's camera messages hold, whatever their serialization.

Fields and their meaning: docs.foxglove.dev, "Foxglove schemas".
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from mp4ds.wire.forms import (
    MAX_BLANK,
    CalibrationFields,
    CodedFields,
    Fields,
    ImageFields,
    WireError,
    check_floats,
    join_stamp,
)

Kind = Literal["time", "text", "u32", "doubles", "data"]
Span = tuple[int, int]

_HEADER: dict[str, Kind] = {"timestamp": "time", "frame_id": "text"}
_SIZE: dict[str, Kind] = {"width": "u32", "height": "u32"}
_CODED: dict[str, Kind] = {**_HEADER, "data": "data", "format": "text"}
_MATRIX_SIZES = {"K": 9, "R": 9, "P": 12}
_MAX_DISTORTION = 1024
_INT64 = 1 << 63

TYPES: Mapping[str, Mapping[str, Kind]] = {
    "foxglove.RawImage": {**_HEADER, **_SIZE, "encoding": "text", "step": "u32", "data": "data"},
    "foxglove.CompressedImage": _CODED,
    "foxglove.CompressedVideo": _CODED,
    "foxglove.CameraCalibration": {
        **_HEADER,
        **_SIZE,
        "distortion_model": "text",
        "D": "doubles",
        "K": "doubles",
        "R": "doubles",
        "P": "doubles",
    },
}
"""The fields of each type and what they hold (spec/registry.md, "Message types")."""


def fields_of_type(type_name: str) -> Mapping[str, Kind]:
    """Names and kinds of the fields of a message type.

    Raises:
        WireError: It is none of `TYPES`.
    """
    if type_name not in TYPES:
        raise WireError(f"type {type_name!r} is not modelled")
    return TYPES[type_name]


def join_fields(type_name: str, values: Mapping[str, Any]) -> Fields:
    """What a message says besides its header and body.

    Args:
        type_name: One of `TYPES`.
        values: All its fields of text, numbers and lists of numbers, by name.

    Raises:
        WireError: A calibration cannot be modelled.
    """
    if type_name == "foxglove.RawImage":
        return ImageFields(
            encoding=values["encoding"],
            width=values["width"],
            height=values["height"],
            step=values["step"],
            is_bigendian=0,
        )
    if type_name != "foxglove.CameraCalibration":
        return CodedFields(values["format"])
    for name, size in _MATRIX_SIZES.items():
        if len(values[name]) != size:
            raise WireError(f"it has {len(values[name])} values in {name}, not {size}")
    if len(values["D"]) > _MAX_DISTORTION:
        raise WireError(f"it has {len(values['D'])} distortion parameters")
    check_floats((*values["D"], *values["K"], *values["R"], *values["P"]))
    return CalibrationFields(
        height=values["height"],
        width=values["width"],
        distortion_model=values["distortion_model"],
        d=tuple(values["D"]),
        k=tuple(values["K"]),
        r=tuple(values["R"]),
        p=tuple(values["P"]),
    )


def join_wide_stamp(sec: int, nanosec: int) -> int:
    """Nanoseconds, where seconds may be beyond what a column holds.

    Raises:
        WireError: A stamp that does not come back from them, or needs more than 64 bits.
    """
    stamp = join_stamp(sec, nanosec)
    if not -_INT64 <= stamp < _INT64:
        raise WireError("its stamp is beyond 64-bit nanoseconds")
    return stamp


@dataclass(frozen=True, slots=True)
class Pieces:
    """A message cut at its slots.

    Attributes:
        between: The bytes before, between and after the slots.
        names: The slots in the order in which they stand; ``body`` is the last before the body.
    """

    between: tuple[bytes, ...]
    names: tuple[str, ...]

    @classmethod
    def cut(cls, data: memoryview, spans: Mapping[str, Span]) -> Pieces:
        """Cut a message.

        Args:
            data: The message.
            spans: Where each slot begins and ends, in the order in which they stand.
        """
        ends = (0, *(end for _, end in spans.values()))
        starts = (*(start for start, _ in spans.values()), len(data))
        between = tuple(bytes(data[end:start]) for end, start in zip(ends, starts, strict=True))
        return cls(between, tuple(spans))

    def fill(self, values: Mapping[str, bytes]) -> tuple[bytes, bytes]:
        """The message with its slots filled, as the bytes before and after the body."""
        head, parts = b"", [self.between[0]]
        for name, piece in zip(self.names, self.between[1:], strict=True):
            parts.append(values[name])
            if name == "body":
                head, parts = b"".join(parts), []
            parts.append(piece)
        rest = b"".join(parts)
        return (head, rest) if "body" in self.names else (rest, b"")


def check_around(size: int) -> None:
    """Refuse a message that holds too much besides its data.

    Args:
        size: Bytes around its data.

    Raises:
        WireError: They are more than a blank may have.
    """
    if size > MAX_BLANK:
        raise WireError(f"{size} bytes stand around its data")
