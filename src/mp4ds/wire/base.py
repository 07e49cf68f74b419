"""The neutral parts of camera messages, and what every serialization can do with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

NS = 10**9


class WireError(ValueError):
    """A payload that does not parse as its type; the message says where it ends."""


@dataclass(frozen=True, slots=True)
class ImageParts:
    """A `sensor_msgs/Image`, taken apart.

    Attributes:
        stamp: Header stamp, nanoseconds; None where it has no exact value in nanoseconds.
        seq: Header sequence number; None in ROS 2, which has none.
        frame_id: As UTF-8.
        height: Rows.
        width: Columns.
        encoding: ROS image encoding.
        is_bigendian: The byte as it stands.
        step: Bytes per row.
        size: Bytes of pixel data.
        head: All bytes before the pixels.
        pixels: The pixel data; a view into the payload.
        tail: All bytes after the pixels.
    """

    stamp: int | None
    seq: int | None
    frame_id: str
    height: int
    width: int
    encoding: str
    is_bigendian: int
    step: int
    size: int
    head: memoryview
    pixels: memoryview
    tail: memoryview


@dataclass(frozen=True, slots=True)
class CameraInfoFields:
    """The calibration in a `sensor_msgs/CameraInfo`: all fields but the header.

    Attributes:
        height: Rows.
        width: Columns.
        distortion_model: As UTF-8.
        d: Distortion parameters.
        k: Intrinsic matrix, 3 x 3, by rows.
        r: Rectification matrix, 3 x 3, by rows.
        p: Projection matrix, 3 x 4, by rows.
        binning_x: Columns binned into one.
        binning_y: Rows binned into one.
        roi: x_offset, y_offset, height, width.
        roi_do_rectify: The byte as it stands.
    """

    height: int
    width: int
    distortion_model: str
    d: tuple[float, ...]
    k: tuple[float, ...]
    r: tuple[float, ...]
    p: tuple[float, ...]
    binning_x: int
    binning_y: int
    roi: tuple[int, int, int, int]
    roi_do_rectify: int


class Wire(Protocol):
    """One serialization of camera messages."""

    @property
    def name(self) -> str:
        """The name that sidecars use."""
        ...

    def split_image(self, data: memoryview) -> ImageParts:
        """Take an image message apart.

        Raises:
            WireError: The payload is too short or not of this serialization.
        """
        ...

    def image_head(self, parts: ImageParts) -> bytes:
        """The head as a plain serializer writes it: padding zero, fields from `parts`."""
        ...

    def patch_head(self, template: bytes, stamp: int, seq: int | None) -> bytes:
        """A head equal to the template but for its stamp and sequence number."""
        ...

    def split_camera_info(self, data: memoryview) -> tuple[int, int | None, str, CameraInfoFields]:
        """Stamp (ns), seq, frame_id and calibration.

        Raises:
            WireError: The payload is not one that can be modelled.
        """
        ...

    def camera_info(
        self, stamp: int, seq: int | None, frame_id: str, fields: CameraInfoFields
    ) -> bytes:
        """The message as a plain serializer writes it."""
        ...


def join_stamp(sec: int, nanosec: int) -> int | None:
    """Nanoseconds, or None for a stamp that does not come back from them."""
    return sec * NS + nanosec if 0 <= nanosec < NS else None


def text(raw: memoryview) -> str:
    """Decode a string of a message.

    Raises:
        WireError: It is not UTF-8.
    """
    try:
        return str(raw, "utf-8")
    except UnicodeDecodeError:
        raise WireError("a string is not UTF-8") from None


def check_floats(values: Sequence[float]) -> None:
    """Refuse what YAML cannot hold; such a message is stored verbatim.

    Raises:
        WireError: A value is infinite or not a number.
    """
    if any(value - value != 0 for value in values):
        raise WireError("a calibration value is not finite")
