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
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

RAW = "sensor_msgs/Image"
CODED = ("sensor_msgs/CompressedImage", "ffmpeg_image_transport_msgs/FFMPEGPacket")


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
        parts: Iterable[bytes] = (payload,)
        if channel.topic in self.crossed:
            try:
                # a list: what goes wrong is to go wrong here
                parts = list(field_bytes(decoded(channel, payload), skip_data=pixels_ignored))
            except Exception:  # whatever the generated deserialiser trips over
                self.undecodable.add(channel.topic)
                parts = (channel.encoding.encode(), payload)
        elif pixels_ignored:
            parts = without_pixels(channel, payload)
        summary = hashlib.blake2b(digest_size=16)
        for part in parts:
            summary.update(part)
        return summary.digest()


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


def decoded(channel: Channel, payload: bytes) -> Any:
    """A message of ROS as an object."""
    store = typestore(channel.type, channel.encoding, channel.definition)
    decode = store.deserialize_ros1 if channel.encoding == "ros1" else store.deserialize_cdr
    return decode(payload, ros2_name(channel.type))


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


def without_pixels(channel: Channel, payload: bytes) -> tuple[bytes, ...]:
    """An image message's bytes around its pixels, and of a coded one around their length."""
    short = channel.type.replace("/msg/", "/")
    if channel.encoding == "protobuf" and channel.definition:
        message = protobuf_type(channel.definition[1], channel.type).FromString(payload)
        message.ClearField("data")
        return (message.SerializeToString(deterministic=True),)
    if channel.encoding not in ("ros1", "cdr") or short not in (RAW, *CODED):
        raise ValueError(f"topic {channel.topic}: pixels of {channel.type} cannot be ignored")
    try:
        head, _, tail = payload.rpartition(decoded(channel, payload).data.tobytes())
    except Exception:  # a damaged image has no pixels to leave out
        return (payload,)
    return (head if short == RAW else head[:-4], tail)


@lru_cache
def protobuf_type(descriptor_set: bytes, name: str) -> Any:
    """The class of a message, as a recording defines it."""
    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(descriptor_set).file:
        pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName(name))
