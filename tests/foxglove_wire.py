"""Foxglove's messages as protobuf and ROS 2 messages, with their schemas.

Written with Foxglove's own generated code where there is some. Nothing here uses mp4ds, so that
its tests have an independent source.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessages
from mcap_protobuf.schema import build_file_descriptor_set

from scenes import Record, typestore

# ---------------------------------------------------------------- protobuf


def _is_list(field: Any) -> bool:
    """Whether a field is repeated; protobuf told it by a label before version 6.31."""
    if hasattr(field, "is_repeated"):
        return bool(field.is_repeated)
    return bool(field.label == field.LABEL_REPEATED)


def message_class(msgtype: str) -> type[Message]:
    """The protobuf class of ``foxglove_msgs/msg/X``, generated from Foxglove's schemas."""
    name = msgtype.rpartition("/")[2]
    module = importlib.import_module(f"foxglove_schemas_protobuf.{name}_pb2")
    found: type[Message] = getattr(module, name)
    return found


@cache
def renumbered_class(msgtype: str) -> tuple[type[Message], bytes]:
    """The same message whose fields have other numbers, and its schema.

    The numbers run backwards, beyond those of one byte, so that the timestamp is written last.
    """
    described = build_file_descriptor_set(message_class(msgtype))
    for fields in (m.field for m in described.file[-1].message_type):
        for place, field in enumerate(fields):
            field.number = 30 - 3 * place
    name = message_class(msgtype).DESCRIPTOR.full_name
    found: type[Message] = GetMessages(described.file)[name]
    return found, described.SerializeToString()


def fill(message: Message, values: Mapping[str, Any]) -> Message:
    """Set the fields of a protobuf message; names are lower case in `values`."""
    for field in message.DESCRIPTOR.fields:
        given = values.get(field.name.lower())
        if given is None:
            continue
        if _is_time(field):
            getattr(message, field.name).FromNanoseconds(given)
        elif field.message_type:
            getattr(message, field.name).SetInParent()
            fill(getattr(message, field.name), given)
        elif _is_list(field):
            getattr(message, field.name).extend(float(number) for number in given)
        elif field.type == FieldDescriptor.TYPE_BYTES:
            is_bytes = isinstance(given, bytes)
            data = given if is_bytes else np.asarray(given, np.uint8).tobytes()
            setattr(message, field.name, data)
        else:
            setattr(message, field.name, given)
    return message


def _is_time(field: FieldDescriptor) -> bool:
    kind = field.message_type
    return kind is not None and kind.full_name == "google.protobuf.Timestamp"


def _protobuf(record: Record) -> bytes:
    return fill(message_class(record.msgtype)(), record.values).SerializeToString()


def _protobuf_stamp_last(record: Record) -> bytes:
    """As protobuf allows, the fields are in another order: the timestamp after the data."""
    values = dict(record.values)
    last = {"timestamp": values.pop("timestamp")}
    parts = (fill(message_class(record.msgtype)(), part) for part in (values, last))
    return b"".join(part.SerializeToString() for part in parts)


def _protobuf_and_more(record: Record) -> bytes:
    """With a field, number 999, that the schema does not know: written by a newer one."""
    return _protobuf(record) + b"\xba\x3e\x04more"


def _protobuf_renumbered(record: Record) -> bytes:
    return fill(renumbered_class(record.msgtype)[0](), record.values).SerializeToString()


# ---------------------------------------------------------------- all of them


@dataclass(frozen=True)
class Serialization:
    """How messages and schemas are written into MCAP.

    Attributes:
        encoding: Of messages, MCAP's name.
        schema_encoding: MCAP's name.
        payload: A record's bytes.
        schema: (name, data) of the schema of a ROS type.
    """

    encoding: str
    schema_encoding: str
    payload: Callable[[Record], bytes]
    schema: Callable[[str], tuple[str, bytes]]


def _full_name(msgtype: str) -> str:
    return f"foxglove.{msgtype.rpartition('/')[2]}"


def _descriptor_set(msgtype: str) -> tuple[str, bytes]:
    described: FileDescriptorSet = build_file_descriptor_set(message_class(msgtype))
    return _full_name(msgtype), described.SerializeToString()


def _ros2_definition(msgtype: str) -> tuple[str, bytes]:
    return msgtype, typestore("cdr").generate_msgdef(msgtype, ros_version=2)[0].encode()


SERIALIZATIONS = {
    "protobuf": Serialization("protobuf", "protobuf", _protobuf, _descriptor_set),
    "protobuf-stamp-last": Serialization(
        "protobuf", "protobuf", _protobuf_stamp_last, _descriptor_set
    ),
    "protobuf-unknown-field": Serialization(
        "protobuf", "protobuf", _protobuf_and_more, _descriptor_set
    ),
    "protobuf-renumbered": Serialization(
        "protobuf",
        "protobuf",
        _protobuf_renumbered,
        lambda msgtype: (_full_name(msgtype), renumbered_class(msgtype)[1]),
    ),
    "foxglove-ros2": Serialization(
        "cdr", "ros2msg", lambda record: record.payload("cdr"), _ros2_definition
    ),
}
