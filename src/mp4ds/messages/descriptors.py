"""Messages in protobuf of any type, decoded by the descriptors recorded with them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mp4ds.messages.wire import WireError


def decoder_of_schema(type_name: str, schema: bytes) -> Callable[[memoryview], Any]:
    """A decoder of messages of any type; it raises WireError for invalid ones.

    Args:
        type_name: Full name of the messages' type.
        schema: A serialized FileDescriptorSet that declares it and everything it refers to.

    Raises:
        WireError: It does not.
    """
    # only recordings with protobuf need it
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message import DecodeError
    from google.protobuf.message_factory import GetMessageClass, GetMessages

    try:
        pool = DescriptorPool()
        GetMessages(FileDescriptorSet.FromString(schema).file, pool)
        # by name, as a type may be declared inside another one
        message_class = GetMessageClass(pool.FindMessageTypeByName(type_name))
    except (DecodeError, LookupError, ValueError, TypeError, RecursionError):
        raise WireError(f"its schema does not declare {type_name}") from None

    def decode(data: memoryview) -> Any:
        try:
            return message_class.FromString(bytes(data))
        except (DecodeError, ValueError):  # the latter by protobuf's pure Python
            raise WireError(f"it is not a {type_name}") from None

    return decode
