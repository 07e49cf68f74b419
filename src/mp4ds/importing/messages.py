"""Messages of ROS 2 for what a folder holds, in plain CDR."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from mp4ds.wire import Fields, Slots, plain_message
from mp4ds.wire.cursor import Writer
from mp4ds.wire.forms import NS
from mp4ds.wire.transforms import Transform

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
INFO = "sensor_msgs/msg/CameraInfo"
TRANSFORMS = "tf2_msgs/msg/TFMessage"

_WIRE, _PREFIX = "cdr-le", b"\x00\x01\x00\x00"
_UNKNOWN = (-1.0, *(0.0 for _ in range(8)))  # a covariance of what is not measured
_NOT_TOLD = (0.0,) * 9


def camera_message(
    type_name: str, frame_id: str, fields: Fields, stamp: int, body: bytes = b""
) -> bytes:
    """An image or a calibration.

    Args:
        type_name: `IMAGE`, `COMPRESSED` or `INFO`.
        frame_id: Coordinate frame.
        fields: Of the type.
        stamp: Nanoseconds.
        body: Pixels or file of an image.

    Raises:
        WireError: It has no place in the serialization.
    """
    return plain_message(_WIRE, type_name, frame_id, fields, Slots(stamp), body)


def transforms_message(stamp: int, transforms: Sequence[Transform]) -> bytes:
    """A tf2_msgs/TFMessage."""
    writer = _new()
    writer.put("I", len(transforms))
    for item in transforms:
        _header(writer, stamp, item.parent)
        writer.string(item.child, terminated=True)
        writer.put("d", *item.translation, *item.rotation)
    return writer.getvalue()


def _imu(stamp: int, frame_id: str, row: Sequence[float]) -> bytes:
    """Angular velocity x, y, z in rad/s, then acceleration x, y, z in m/s^2."""
    turn, acceleration = row[:3], row[3:]
    writer = _new()
    _header(writer, stamp, frame_id)
    writer.put("d", 0.0, 0.0, 0.0, 1.0, *_UNKNOWN, *turn, *_NOT_TOLD, *acceleration, *_NOT_TOLD)
    return writer.getvalue()


def _accelerometer(stamp: int, frame_id: str, row: Sequence[float]) -> bytes:
    """Acceleration x, y, z in m/s^2: an Imu that measures nothing else."""
    writer = _new()
    _header(writer, stamp, frame_id)
    writer.put("d", 0.0, 0.0, 0.0, 1.0, *_UNKNOWN, 0.0, 0.0, 0.0, *_UNKNOWN, *row, *_NOT_TOLD)
    return writer.getvalue()


def _pose(stamp: int, frame_id: str, row: Sequence[float]) -> bytes:
    """Position x, y, z in metres, then the quaternion x, y, z, w."""
    writer = _new()
    _header(writer, stamp, frame_id)
    writer.put("d", *row)
    return writer.getvalue()


TABLES: Mapping[str, tuple[str, Callable[[int, str, Sequence[float]], bytes]]] = {
    "imu": ("sensor_msgs/msg/Imu", _imu),
    "accelerometer": ("sensor_msgs/msg/Imu", _accelerometer),
    "pose": ("geometry_msgs/msg/PoseStamped", _pose),
}
"""Kinds of tables -> message type, and what makes a message of stamp, frame and row."""


def _new() -> Writer:
    return Writer(_PREFIX, "<", aligned=True)


def _header(writer: Writer, stamp: int, frame_id: str) -> None:
    writer.put("I", *divmod(stamp, NS))
    writer.string(frame_id, terminated=True)
