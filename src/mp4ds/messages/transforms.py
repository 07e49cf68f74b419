"""Static transforms between coordinate frames, read from /tf_static for extrinsics.

This is a convenience copy: the messages themselves are stored verbatim, so whatever does not parse,
or makes no sense, can be left out without harm.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import Refused
from mp4ds.messages.serializations import decoder_of_schema, from_json, ros_type, wire_of
from mp4ds.messages.wire import PrimitiveReader
from mp4ds.records import Channel, Schema

MAX_TRANSFORMS = 1000
"""Maximum number of child frames in a collector."""

_MAX_MESSAGE = 1 << 20
_MAX_IN_MESSAGE = 10 * MAX_TRANSFORMS
_MAX_SCHEMA = 1 << 20
_TOLERANCE = 0.01  # of a rotation's squared norm, as in tf2
# whether a message has several, and whether each has a header
_ROS_TYPES = {
    "tf2_msgs/TFMessage": (True, True),
    "tf/tfMessage": (True, True),
    "foxglove_msgs/FrameTransforms": (True, False),
    "foxglove_msgs/FrameTransform": (False, False),
}
_FOXGLOVE_TYPES = frozenset({"foxglove.FrameTransform", "foxglove.FrameTransforms"})


@dataclass(frozen=True, slots=True)
class Transform:
    """Pose of a frame in another: a point p of the child is rotation * p + translation there.

    Attributes:
        parent: The frame in which the child is placed.
        child: The frame whose pose this is.
        translation: x, y, z in metres.
        rotation: x, y, z, w of a unit quaternion.
    """

    parent: str
    child: str
    translation: tuple[float, float, float]
    rotation: tuple[float, float, float, float]

    @property
    def is_usable(self) -> bool:
        """Whether tf2 would accept it: two frames, finite numbers, a rotation of norm 1."""
        return (
            bool(self.parent and self.child)
            and _name(self.parent) != _name(self.child)
            and all(map(math.isfinite, (*self.translation, *self.rotation)))
            and abs(sum(value * value for value in self.rotation) - 1) < _TOLERANCE
        )


def is_tf_static(channel: Channel) -> bool:
    """Whether the last part of a channel's topic is tf_static."""
    return channel.topic.strip("/").rpartition("/")[2] == "tf_static"


Parser = Callable[[memoryview], list[Transform]]


def transform_parser(channel: Channel) -> Parser | None:
    """A parser of the transforms in a channel's messages, usable or not.

    Supports tf2_msgs/TFMessage, tf/tfMessage and the ROS types of foxglove_msgs in ROS 1 and CDR;
    foxglove.FrameTransform and foxglove.FrameTransforms in protobuf (by the recorded descriptor)
    and JSON. In the latter two, an absent translation is zero and an absent rotation is the
    identity.

    It raises `Refused` for a message that does not parse, or is unreasonably large (more than
    1 MiB).

    Returns:
        None if the type is not one of transforms, or its descriptor does not parse.
    """
    encoding, name, schema = channel.message_encoding, ros_type(channel.type_name), channel.schema
    many = channel.type_name.endswith("s")
    read: Parser
    if encoding in ("ros1", "cdr") and name in _ROS_TYPES:
        read = partial(_parse_ros, encoding, name)
    elif schema is None or channel.type_name not in _FOXGLOVE_TYPES:
        return None
    elif encoding == "json":
        read = partial(_read_nodes, from_json, many)
    elif encoding == "protobuf" and len(schema.data) <= _MAX_SCHEMA:
        try:
            read = partial(_read_nodes, decoder_of_schema(schema), many)
        except Refused:
            return None
    else:
        return None

    def parse(data: memoryview) -> list[Transform]:
        if len(data) > _MAX_MESSAGE:
            raise Refused(f"it has {len(data)} bytes")
        return read(data)

    return parse


def _name(frame_id: str) -> str:
    """A frame's name as tf2 compares it."""
    return frame_id.removeprefix("/")


# ---------------------------------------------------------------- ROS


def _parse_ros(encoding: str, name: str, data: memoryview) -> list[Transform]:
    wire = wire_of(encoding, data)
    cdr = wire != "ros1"
    order = ">" if wire == "cdr-be" else "<"
    reader = PrimitiveReader(data, 4 if cdr else 0, order, is_cdr=cdr)
    is_list, has_header = _ROS_TYPES[name]
    found = []
    # a message that declares more than it holds gives an error
    for _ in range(reader.integer("I") if is_list else 1):
        if has_header and not cdr:
            reader.take("I")  # seq
        reader.take("I", 2)  # stamp
        parent, child = reader.string(), reader.string()
        x, y, z = reader.take("d", 3)
        qx, qy, qz, qw = reader.take("d", 4)
        found.append(Transform(parent, child, (x, y, z), (qx, qy, qz, qw)))
    return found


# ---------------------------------------------------------------- Foxglove


def _read_nodes(
    decode: Callable[[memoryview], Any], many: bool, data: memoryview
) -> list[Transform]:
    """The transforms of a message, which decodes to JSON or an object of protobuf."""
    message = decode(data)
    try:
        nodes = _value(message, "transforms", []) if many else [message]
        if len(nodes) > _MAX_IN_MESSAGE:
            raise ValueError(f"it has {len(nodes)} transforms")
        return [_read_node(node) for node in nodes]
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        raise Refused(f"its fields are not those of a transform: {error}") from None


def _read_node(node: Any) -> Transform:
    names = [_value(node, f"{end}_frame_id", "") for end in ("parent", "child")]
    if not all(isinstance(name, str) for name in names):
        raise TypeError("the name of a frame is not a string")
    x, y, z = _numbers(_part(node, "translation"), "xyz", (0.0, 0.0, 0.0))
    qx, qy, qz, qw = _numbers(_part(node, "rotation"), "xyzw", (0.0, 0.0, 0.0, 1.0))
    return Transform(names[0], names[1], (x, y, z), (qx, qy, qz, qw))


def _value(node: Any, name: str, default: Any) -> Any:
    return node.get(name, default) if isinstance(node, dict) else getattr(node, name)


def _part(node: Any, name: str) -> Any:
    if isinstance(node, dict):
        return node.get(name)
    return getattr(node, name) if node.HasField(name) else None


def _numbers(node: Any, names: str, absent: tuple[float, ...]) -> list[float]:
    values = absent if node is None else [_value(node, name, 0.0) for name in names]
    if not all(isinstance(value, (int, float)) for value in values):
        raise TypeError("a coordinate is not a number")
    return [float(value) for value in values]


# ---------------------------------------------------------------- rotations

_ROUNDED = 1e-2  # of a rotation given with few digits


def quaternion_of(rotation: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """The unit quaternion x, y, z, w of a rotation, w not negative.

    It is the eigenvector of the largest eigenvalue of a symmetric matrix (I. Bar-Itzhack, 2000),
    which is the nearest rotation to a matrix with rounded digits.

    Args:
        rotation: Shape (3, 3).

    Raises:
        ValueError: It is not a rotation.
    """
    m = rotation
    is_near = np.abs(m @ m.T - np.eye(3)).max(initial=0) < _ROUNDED
    if not np.isfinite(m).all() or not is_near or np.linalg.det(m) < 0:
        raise ValueError("the rotation is not valid")
    symmetric = np.empty((4, 4))
    symmetric[:3, :3] = m + m.T - np.trace(m) * np.eye(3)
    vector = [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]]
    symmetric[3, :3] = symmetric[:3, 3] = vector
    symmetric[3, 3] = np.trace(m)
    found = np.linalg.eigh(symmetric)[1][:, -1]
    x, y, z, w = (found if found[3] >= 0 else -found).tolist()
    return x, y, z, w


# ---------------------------------------------------------------- collecting


class TransformCollector:
    """The static transforms of a recording: the latest of each child frame.

    A convenience copy of what is stored verbatim: messages that do not parse and transforms that
    tf2 would refuse are left out, and so are child frames beyond `MAX_TRANSFORMS`.

    Args:
        known: Those of earlier messages, in order.
    """

    def __init__(self, known: Iterable[Transform] = ()) -> None:
        self._latest: dict[str, Transform] = {}
        self._parsers: dict[tuple[str, Schema | None], Parser | None] = {}
        self._take(known)

    @staticmethod
    def takes(channel: Channel) -> bool:
        """Whether a channel has static transforms."""
        name = channel.type_name
        is_transform = name in _FOXGLOVE_TYPES or ros_type(name) in _ROS_TYPES
        return is_transform and is_tf_static(channel)

    def add(self, channel: Channel, data: bytes | memoryview) -> None:
        """Take a message, if it is one of static transforms."""
        if not self.takes(channel):
            return
        key = (channel.message_encoding, channel.schema)
        if key not in self._parsers:
            self._parsers[key] = transform_parser(channel)
        parse = self._parsers[key]
        with suppress(Refused):
            self._take(parse(memoryview(data)) if parse else [])

    def _take(self, transforms: Iterable[Transform]) -> None:
        for transform in transforms:
            child = _name(transform.child)
            has_room = child in self._latest or len(self._latest) < MAX_TRANSFORMS
            if transform.is_usable and has_room:
                self._latest[child] = transform

    @property
    def transforms(self) -> list[Transform]:
        """All of them, in the order in which their children were first seen."""
        return list(self._latest.values())

    def between(self, frame_ids: Iterable[str]) -> list[Transform]:
        """The transforms that connect cameras with each other and with the rest of the robot.

        These are the ones between each camera's frame and the root of its tree, so that there is a
        path from any camera to any other, and to the frames above them.

        Args:
            frame_ids: The cameras' frames.

        Returns:
            A part of `transforms`, in the same order.
        """
        kept: set[str] = set()
        for frame_id in frame_ids:
            child = _name(frame_id)
            # stops where another camera's path continued, and in a cycle
            while child in self._latest and child not in kept:
                kept.add(child)
                child = _name(self._latest[child].parent)
        return [transform for child, transform in self._latest.items() if child in kept]
