"""Protobuf messages as objects, by the recorded schema."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mp4ds.wire.forms import WireError


def protobuf_decoder(type_name: str, schema: bytes) -> Callable[[bytes], Any]:
    """What makes an object of a serialized message; it raises WireError for what is none.

    Args:
        type_name: Full name of the message's type.
        schema: A serialized FileDescriptorSet that declares it and all that it refers to.

    Raises:
        WireError: It does not.
    """
    # only recordings with protobuf need it
    from google.protobuf.message import DecodeError

    try:
        message_class = _message_class(type_name, schema)
    except (DecodeError, LookupError, ValueError, TypeError, RecursionError):
        raise WireError(f"its schema does not declare {type_name}") from None

    def decode(data: bytes) -> Any:
        try:
            return message_class.FromString(data)
        except (DecodeError, ValueError):  # the latter by protobuf's pure Python
            raise WireError(f"it is no {type_name}") from None

    return decode


def _message_class(type_name: str, schema: bytes) -> Any:
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message_factory import GetMessageClass

    waiting = {file.name: file for file in FileDescriptorSet.FromString(schema).file}
    pool = DescriptorPool()

    def add(name: str) -> None:
        """A file after those that it imports."""
        file = waiting.pop(name, None)
        if file is not None:
            for dependency in file.dependency:
                add(dependency)
            pool.Add(file)

    while waiting:
        add(next(iter(waiting)))
    return GetMessageClass(pool.FindMessageTypeByName(type_name))
