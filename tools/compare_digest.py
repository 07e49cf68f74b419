"""What of a message has to be equal, reduced to 16 bytes: for ``compare.py``."""

from __future__ import annotations

import fnmatch
import hashlib
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, cast

import numpy as np
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

IMAGES = ("sensor_msgs/Image", "sensor_msgs/CompressedImage")


@dataclass(frozen=True)
class Channel:
    """Everything that tells one channel from another."""

    topic: str
    type: str
    encoding: str
    definition: tuple[str, bytes] | None
    metadata: tuple[tuple[str, str], ...]


@dataclass
class Digester:
    """Reduces payloads to 16 bytes.

    Attributes:
        ignore: Topic globs whose pixels are left out.
        crossed: Topics that are compared field by field between ROS 1 and ROS 2.
    """

    ignore: Sequence[str] = ()
    crossed: frozenset[str] = frozenset()
    undecodable: set[str] = field(default_factory=set)

    def digest(self, channel: Channel, payload: bytes) -> bytes:
        """Digest of what has to be equal."""
        pixels_ignored = any(fnmatch.fnmatchcase(channel.topic, glob) for glob in self.ignore)
        parts: Iterable[bytes | memoryview] = (payload,)
        if channel.topic in self.crossed:
            parts = self._fields(channel, payload, skip_data=pixels_ignored)
        elif pixels_ignored:
            try:
                parts = list(without_pixels(channel, payload))
            except (struct.error, IndexError):
                parts = (payload,)  # a damaged image has no pixels to leave out
        summary = hashlib.blake2b(digest_size=16)
        for part in parts:
            summary.update(part)
        return summary.digest()

    def _fields(self, channel: Channel, payload: bytes, *, skip_data: bool) -> Iterator[bytes]:
        name = ros2_name(channel.type)
        try:
            store = typestore(channel.type, channel.encoding, channel.definition)
            decode = store.deserialize_ros1 if channel.encoding == "ros1" else store.deserialize_cdr
            # a list: what goes wrong is to go wrong here
            return iter(list(field_bytes(decode(payload, name), skip_data=skip_data)))
        except Exception:  # whatever the generated deserialiser trips over
            self.undecodable.add(channel.topic)
            return iter((channel.encoding.encode(), payload))


def ros2_name(name: str) -> str:
    """``sensor_msgs/Image`` and ``sensor_msgs/msg/Image`` are one type."""
    package, _, rest = name.partition("/")
    return name if "/" in rest or not rest else f"{package}/msg/{rest}"


@lru_cache(maxsize=256)  # most topics, of most recordings, are of a few types
def typestore(of: str, encoding: str, definition: tuple[str, bytes] | None) -> Any:
    """A typestore with the recording's own definition, else the distribution's."""
    fallback = Stores.ROS1_NOETIC if encoding == "ros1" else Stores.LATEST
    form, text = definition or ("", b"")
    if not text:
        return get_typestore(fallback)
    store, name = get_typestore(Stores.EMPTY), ros2_name(of)
    parse = get_types_from_idl if form == "ros2idl" else get_types_from_msg
    arguments = (text.decode(),) if form == "ros2idl" else (text.decode(), name)
    try:
        store.register(cast(Any, parse)(*arguments))
        store.get_msgdef(name)
    except Exception:
        return get_typestore(fallback)
    return store


def field_bytes(value: Any, *, skip_data: bool = False) -> Iterator[bytes]:
    """The values of a deserialised message, the same for ROS 1 and ROS 2."""
    if hasattr(value, "__msgtype__"):
        for name in value.__dataclass_fields__:
            if name == "seq" and value.__msgtype__ == "std_msgs/msg/Header":
                continue
            if name == "structure_needs_at_least_one_member" or (skip_data and name == "data"):
                continue
            yield f"{name.lower()}:".encode()  # CameraInfo's D, K, R, P became lower case
            yield from field_bytes(getattr(value, name))
    elif isinstance(value, np.ndarray):
        yield f"[{value.size}]".encode()
        yield np.ascontiguousarray(value, value.dtype.newbyteorder("<")).tobytes()
    elif isinstance(value, (list, tuple)):
        yield f"[{len(value)}]".encode()
        for item in value:
            yield from field_bytes(item)
    elif isinstance(value, float):
        yield struct.pack("<d", value)
    else:
        yield (value if isinstance(value, str) else str(int(value))).encode() + b";"


def without_pixels(channel: Channel, payload: bytes) -> Iterator[bytes | memoryview]:
    """An image message's bytes around its pixels; a compressed one's also without their length."""
    view, short = memoryview(payload), channel.type.replace("/msg/", "/")
    if channel.encoding == "protobuf" and channel.definition:
        number = data_field_number(channel.definition[1], channel.type)
        return (view[a:b] for n, _, a, b in protobuf_fields(payload) if n != number)
    if channel.encoding not in ("ros1", "cdr") or short not in IMAGES:
        raise ValueError(f"topic {channel.topic}: pixels of {channel.type} cannot be ignored")
    base = 4 if channel.encoding == "cdr" else 0
    order = ">" if base and payload[1] == 0 else "<"
    at = base

    def number32() -> int:
        nonlocal at
        at += (base - at) % 4 if base else 0
        (value,) = struct.unpack_from(order + "I", payload, at)
        at += 4
        return int(value)

    def skip_text() -> None:
        nonlocal at
        size = number32()
        at += size

    for _ in range(2 if base else 3):
        number32()  # seq and stamp
    skip_text()  # frame_id
    if short == IMAGES[0]:
        number32()  # height
        number32()  # width
    skip_text()  # encoding or format
    if short == IMAGES[0]:
        at += 1  # is_bigendian
        number32()  # step
    size = number32()
    head = at if short == IMAGES[0] else at - 4
    return iter((view[:head], view[at + size :]))


def protobuf_fields(data: bytes) -> Iterator[tuple[int, int, int, int]]:
    """Number, start of value, start and end of each field at the top level of a message."""
    at = 0

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while True:
            byte = data[at]
            value |= (byte & 0x7F) << shift
            at, shift = at + 1, shift + 7
            if byte < 0x80:
                return value

    while at < len(data):
        start = at
        tag = varint()
        size = {1: 8, 5: 4}.get(tag & 7, 0)
        if tag & 7 in (0, 2):
            size = varint()
        value = at
        at += size if tag & 7 else 0
        yield tag >> 3, value, start, at


def data_field_number(descriptor_set: bytes, type_name: str) -> int:
    """Number of the field ``data`` of a message, which a schema may choose freely."""
    for file in FileDescriptorSet.FromString(descriptor_set).file:
        for message in file.message_type:
            if f"{file.package}.{message.name}" == type_name:
                return next(field.number for field in message.field if field.name == "data")
    raise ValueError(f"{type_name} has no definition")
