"""Message definitions of ROS 1 and ROS 2 as rosbags' field lists: parse, compare, choose."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import (
    Stores,
    TypesysError,
    get_types_from_idl,
    get_types_from_msg,
    get_typestore,
)
from rosbags.typesys.msg import normalize_msgtype
from rosbags.typesys.store import Typestore

from mp4ds.bags.type_sizes import FILLER, BoundedStore, sizes_of
from mp4ds.errors import OptionError
from mp4ds.records import Schema

if TYPE_CHECKING:
    from rosbags.interfaces.typing import Fielddefs, FieldDesc, Typesdict

HEADER = "std_msgs/msg/Header"

BAD_DEFINITION = (
    TypesysError,
    SerdeError,
    SyntaxError,
    RecursionError,
    LookupError,
    ValueError,
    TypeError,
    AttributeError,
    AssertionError,
)
"""What rosbags raises for a definition that it cannot use."""

BAD_PAYLOAD = (
    SerdeError,
    AssertionError,
    struct.error,
    ValueError,
    LookupError,
    TypeError,
    MemoryError,
)
"""What rosbags raises for a payload that is not of its type."""

MAX_TAIL = 8
"""Bytes after a message that ROS overlooks; after more, the definition is that of another type."""
BUILTIN = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")

_MAX_TEXT, _MAX_IDL, _MAX_LINES = 2**19, 2**17, 2**14
_NO_CODE = re.compile(r'"(?:\\.|[^"\\])*"?|//.*|/[*](?:(?s:.*?)[*]/|(?s:.*))|\'\\?.\'')
# rosbags' parser reads what stands in brackets a hundred times, and multiplies without a bound
_SLOW_IDL = re.compile(r"[(][^()]*[(]|<[^<>;]*<[^<>;]*<|[*]|<<(?!\s*\d{1,2}\b)")
_BRACKET = re.compile(r"[^\w\s]\s*[(]")
_MAX_BRACKETS = 8
_BYTES = {"byte": "uint8", "char": "uint8", "octet": "uint8"}
_RULER = "=" * 80


@dataclass(frozen=True, slots=True)
class World:
    """ROS 1 or ROS 2.

    Attributes:
        name: ``ROS 1`` or ``ROS 2``.
        encoding: Message encoding of its channels.
        schema_encoding: Encoding of the definitions that are made for it.
        standard: The types that it ships.
    """

    name: str
    encoding: str
    schema_encoding: str
    standard: Typesdict


def ros1_world() -> World:
    """ROS 1 with the types of Noetic, of which rosbags has all but those of tf2."""
    tf2 = "tf2_msgs/msg/TFMessage"
    standard = {tf2: get_typestore(Stores.ROS2_HUMBLE).fielddefs[tf2]}
    standard.update(get_typestore(Stores.ROS1_NOETIC).fielddefs)
    return World("ROS 1", "ros1", "ros1msg", standard)


def ros2_world(distribution: str) -> World:
    """ROS 2 with the types of a distribution, such as ``humble``.

    Raises:
        OptionError: The distribution is not known.
    """
    known = {store.value[5:]: store for store in Stores if store.value.startswith("ros2_")}
    if distribution not in known:
        names = ", ".join(known)
        raise OptionError(f"ROS 2 distribution {distribution!r} is not known. Use {names}.")
    # types that came later, too: a recording without definitions may have them
    latest = get_typestore(Stores.LATEST).fielddefs
    standard = {**latest, **get_typestore(known[distribution]).fielddefs}
    return World("ROS 2", "cdr", "ros2msg", standard)


def types_of(schema: Schema, world: World) -> Typesdict:
    """The type of a schema, and all that it refers to; standard ones where it lacks them.

    Raises:
        KeyError: A type is defined nowhere.
        TypesysError: The definition does not parse.
        ValueError: It is larger than those of messages.
    """
    name = normalize_msgtype(schema.name)
    found = _parse(schema, name)
    if not fields_of(found, name) and name in world.standard:
        found.pop(name, None)  # the definition is empty, but perhaps not the type
    # Time, duration and header are the world's own, whatever their definition is called.
    for builtin in (*BUILTIN, HEADER):
        found.pop(builtin, None)
    types = closure(found, name, world.standard)
    sizes_of(types)  # refuses what no message can follow
    return types


def _parse(schema: Schema, name: str) -> Typesdict:
    if len(schema.data) > _MAX_TEXT or schema.data.count(b"\n") > _MAX_LINES:
        raise ValueError("a definition longer than those of messages")
    text = schema.data.decode(errors="replace").replace("\r\n", "\n")
    if not schema.encoding:
        return {}
    if schema.encoding in ("ros2idl", "omgidl") or re.match(r"=+\nIDL: ", text):
        text = re.sub(r"(?m)^[ \t]*#.*$", "", text)  # what it includes stands beside it
        code = _NO_CODE.sub("", text)
        brackets = len(_BRACKET.findall(code))
        if len(text) > _MAX_IDL or brackets > _MAX_BRACKETS or _SLOW_IDL.search(code):
            raise ValueError("IDL that takes too long to parse")
        parts = re.split(r"(?m)^=+\n(?:IDL: .*\n)?", text)
        parsed = (get_types_from_idl(part) for part in parts if part.strip())
        return {key: value for types in parsed for key, value in types.items()}
    text = re.sub(r"(?m)^={20,}[ \t]*$", _RULER, text)
    if schema.encoding == "ros1msg":
        text = re.sub(r"\broslib/Header\b", "std_msgs/Header", text)  # its name before 2010
    return get_types_from_msg(text, name)


def closure(types: Typesdict, root: str, standard: Typesdict) -> Typesdict:
    """A type and all that it refers to, each from the first that has it.

    Raises:
        KeyError: One is in neither.
    """
    found: Typesdict = {}
    todo = [root]
    while todo:
        name = todo.pop()
        if name not in found:
            found[name] = types[name] if name in types else standard[name]
            todo += [part for _, desc in found[name][1] if (part := _shape(desc)[3])]
    return found


def fields_of(types: Typesdict, name: str) -> Fielddefs:
    """A type's fields, none for a type that is not known."""
    fields = types[name][1] if name in types else []
    return [field for field in fields if field[0] != FILLER]


def same_wire(left: Typesdict, left_name: str, right: Typesdict, right_name: str) -> bool:
    """Whether two types serialise alike, whatever their fields are called.

    Headers count as alike: only that of ROS 1 has a sequence number, which conversion knows.
    """
    if left_name == right_name == HEADER:
        return True
    left_fields, right_fields = fields_of(left, left_name), fields_of(right, right_name)
    if len(left_fields) != len(right_fields):
        return False
    for (_, left_desc), (_, right_desc) in zip(left_fields, right_fields, strict=True):
        *left_shape, left_part = _shape(left_desc)
        *right_shape, right_part = _shape(right_desc)
        if left_shape != right_shape or bool(left_part) != bool(right_part):
            return False
        if left_part and not same_wire(left, left_part, right, right_part):
            return False
    return True


@dataclass(frozen=True, slots=True)
class FieldShape:
    """What a field holds.

    Attributes:
        base: A basic type such as ``uint8`` or ``string``; empty for a message.
        message: Name of the message type; empty for a basic type.
        text_bound: Most characters of a string; 0 for any number.
        length: Elements of an array of fixed length; None for anything else.
        bound: Most elements of a sequence, 0 for any number; None for anything else.
    """

    base: str
    message: str
    text_bound: int
    length: int | None
    bound: int | None


def field_shape(desc: FieldDesc) -> FieldShape:
    """What a field of `fields_of` holds."""
    length, bound = None, None
    if desc[0] == Nodetype.ARRAY:
        desc, length = desc[1]
    elif desc[0] == Nodetype.SEQUENCE:
        desc, bound = desc[1]
    if desc[0] == Nodetype.NAME:
        return FieldShape("", str(desc[1]), 0, length, bound)
    if desc[0] == Nodetype.BASE:
        return FieldShape(str(desc[1][0]), "", int(desc[1][1] or 0), length, bound)
    raise ValueError("an array of arrays")


def _shape(desc: FieldDesc) -> tuple[int, int, str, str]:
    """Kind, length of an array, base type, name of a message type; bounds do not matter."""
    kind, count = Nodetype.BASE, 0
    if desc[0] == Nodetype.ARRAY or desc[0] == Nodetype.SEQUENCE:
        kind = desc[0]
        count = desc[1][1] if kind == Nodetype.ARRAY else 0
        desc = desc[1][0]
    if desc[0] == Nodetype.NAME:
        return kind, count, "", str(desc[1])
    base = str(desc[1][0])
    return kind, count, _BYTES.get(base, base), ""


def translate(types: Typesdict, root: str, new_root: str, world: World) -> Typesdict:
    """Definitions for another world: its standard ones where they serialise alike.

    Args:
        types: The definitions, complete.
        root: The type to translate.
        new_root: Its name in the other world.
        world: The other world.
    """
    chosen: Typesdict = {}
    for name in types:
        new_name = new_root if name == root else name
        if new_name in world.standard and same_wire(types, name, world.standard, new_name):
            chosen.update(closure({}, new_name, world.standard))
        else:
            constants, fields = types[name]
            # ROS 1 cannot write bounds; ROS 1 definitions have none to lose.
            chosen.setdefault(new_name, (constants, _without_bounds(fields)))
    return chosen


def _without_bounds(fields: Fielddefs) -> Fielddefs:
    """Fields without bounds of strings and sequences, which do not show on the wire."""
    return [(name, _unbounded(desc)) for name, desc in fields]


def _unbounded(desc: FieldDesc) -> FieldDesc:
    if desc[0] == Nodetype.BASE:
        return (desc[0], (desc[1][0], 0))
    if desc[0] == Nodetype.NAME:
        return desc
    part, count = desc[1]
    if part[0] == Nodetype.BASE:
        part = (part[0], (part[1][0], 0))
    return (desc[0], (part, count if desc[0] == Nodetype.ARRAY else 0))


def make_store(types: Typesdict, world: World) -> Typestore:
    """A store of definitions with the header of a world."""
    own = {name: found for name, found in types.items() if name not in (*BUILTIN, HEADER)}
    return BoundedStore({HEADER: world.standard[HEADER], **own})
