"""Foxglove's messages as protobuf, JSON, flatbuffers and ROS 2 messages, with their schemas.

Written with Foxglove's own generated code where there is some. Nothing here uses mp4ds, so that
its tests have an independent source.
"""

from __future__ import annotations

import base64
import importlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import flatbuffers
import numpy as np
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass
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
    pool = DescriptorPool()
    for file in described.file:
        pool.AddSerializedFile(file.SerializeToString())
    name = message_class(msgtype).DESCRIPTOR.full_name
    found: type[Message] = GetMessageClass(pool.FindMessageTypeByName(name))
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
            setattr(message, field.name, as_bytes(given))
        else:
            setattr(message, field.name, given)
    return message


def _is_time(field: FieldDescriptor) -> bool:
    kind = field.message_type
    return kind is not None and kind.full_name == "google.protobuf.Timestamp"


def as_bytes(data: Any) -> bytes:
    """Bytes, or an array of them."""
    return data if isinstance(data, bytes) else np.asarray(data, np.uint8).tobytes()


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


# ---------------------------------------------------------------- JSON


def _json_value(message: Mapping[str, Any], field: FieldDescriptor) -> Any:
    given = message.get(field.name.lower())
    if _is_time(field):
        return {"sec": given // 10**9, "nsec": given % 10**9}
    if field.message_type:
        return {f.name: _json_value(given or {}, f) for f in field.message_type.fields}
    if _is_list(field):
        return [float(number) for number in given]
    if field.type == FieldDescriptor.TYPE_BYTES:
        return base64.b64encode(as_bytes(given)).decode()
    return field.default_value if given is None else given


def _python_json(record: Record) -> bytes:
    """With spaces, escapes and ``1.0``."""
    fields = message_class(record.msgtype).DESCRIPTOR.fields
    return json.dumps({f.name: _json_value(record.values, f) for f in fields}).encode()


def _javascript_json(record: Record) -> bytes:
    """Without spaces, as UTF-8, and ``1`` for a float."""

    def number(digits: str) -> int | float:
        value = float(digits)
        return int(value) if value.is_integer() else value

    value = json.loads(_python_json(record), parse_float=number)
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False).encode()


def json_schema(descriptor: Descriptor) -> dict[str, Any]:
    """JSON Schema of a message, as Foxglove spells times and bytes."""
    rules: dict[str, Any] = {"title": descriptor.full_name, "type": "object", "properties": {}}
    for field in descriptor.fields:
        if _is_time(field):
            parts = {"sec": {"type": "integer", "minimum": 0}, "nsec": {"type": "integer"}}
            rule: dict[str, Any] = {"type": "object", "title": "time", "properties": parts}
        elif field.message_type:
            rule = json_schema(field.message_type)
        elif field.type == FieldDescriptor.TYPE_BYTES:
            rule = {"type": "string", "contentEncoding": "base64"}
        elif field.type == FieldDescriptor.TYPE_STRING:
            rule = {"type": "string"}
        else:
            rule = {"type": "number" if field.type == FieldDescriptor.TYPE_DOUBLE else "integer"}
        rules["properties"][field.name] = (
            {"type": "array", "items": rule} if _is_list(field) else rule
        )
    return rules


# ---------------------------------------------------------------- flatbuffers


def _flatbuffer(record: Record) -> bytes:
    builder = flatbuffers.Builder(0)
    builder.Finish(_table(builder, message_class(record.msgtype).DESCRIPTOR, record.values))
    return bytes(builder.Output())


def _table(builder: flatbuffers.Builder, descriptor: Descriptor, values: Mapping[str, Any]) -> int:
    """Strings, vectors and tables first, then the table that refers to them."""
    module = flatbuffer_module(descriptor.name)
    children: dict[str, Any] = {}
    for field in descriptor.fields:
        given = values.get(field.name.lower())
        if field.message_type and not _is_time(field):
            children[field.name] = _table(builder, field.message_type, given or {})
        elif field.type == FieldDescriptor.TYPE_STRING:
            children[field.name] = builder.CreateString(given or "")
        elif field.type == FieldDescriptor.TYPE_BYTES:
            children[field.name] = builder.CreateByteVector(as_bytes(given))
        elif _is_list(field):
            children[field.name] = builder.CreateNumpyVector(np.asarray(given, float))
        else:
            children[field.name] = given
    module.Start(builder)
    for name, child in children.items():
        if child is not None:
            add = "".join(part[0].upper() + part[1:] for part in name.split("_"))
            # a struct is written in the table itself
            place = _time(builder, child) if _is_time(descriptor.fields_by_name[name]) else child
            getattr(module, f"Add{add}")(builder, place)
    end: int = module.End(builder)
    return end


def _time(builder: flatbuffers.Builder, nanoseconds: int) -> int:
    made: int = flatbuffer_module("Time").CreateTime(builder, *divmod(nanoseconds, 10**9))
    return made


def flatbuffer_module(name: str) -> Any:
    """The generated module of one of Foxglove's flatbuffer schemas."""
    return importlib.import_module(f"foxglove_schemas_flatbuffer.{name}")


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


def _bfbs(msgtype: str) -> tuple[str, bytes]:
    schema = files("foxglove_schemas_flatbuffer") / f"{msgtype.rpartition('/')[2]}.bfbs"
    return _full_name(msgtype), schema.read_bytes()


def _json_rules(msgtype: str) -> tuple[str, bytes]:
    rules = json_schema(message_class(msgtype).DESCRIPTOR)
    return _full_name(msgtype), json.dumps(rules, indent=2).encode()


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
    "json": Serialization("json", "jsonschema", _javascript_json, _json_rules),
    "json-python": Serialization("json", "jsonschema", _python_json, _json_rules),
    "flatbuffer": Serialization("flatbuffer", "flatbuffer", _flatbuffer, _bfbs),
    "foxglove-ros2": Serialization(
        "cdr", "ros2msg", lambda record: record.payload("cdr"), _ros2_definition
    ),
}
