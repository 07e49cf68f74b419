"""Message definitions of ROS 1 and ROS 2: parsing, comparing and bounding them; stamps."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import TYPE_CHECKING, Any, TypeVar

from rosbags.interfaces import Msgdef, Nodetype
from rosbags.serde import SerdeError
from rosbags.serde.utils import SIZEMAP
from rosbags.typesys import Stores, TypesysError, get_typestore
from rosbags.typesys.idl import get_types_from_idl
from rosbags.typesys.msg import get_types_from_msg, normalize_msgtype
from rosbags.typesys.store import Typestore
from rosbags.typesys.stores import empty

from mp4ds.errors import Refused
from mp4ds.records import Schema

if TYPE_CHECKING:
    from rosbags.interfaces.typing import Fielddefs, FieldDesc, Typesdict

FILLER = "structure_needs_at_least_one_member"
"""Name of the field that empty messages have in ROS 2."""

_BYTES_OF: Mapping[Any, int] = SIZEMAP
_MAX_PARTS = 5000  # fields of all types, with the items that rosbags' code spells out
_MAX_STEPS = 2**16  # fields of a message whose sequences have one item
_MAX_EMPTY = 2**16  # messages without any byte in one, besides two for each of its bytes
_MAX_DEPTH = 100
_READING = (
    *("deserialize_cdr_le", "deserialize_cdr_be", "deserialize_ros1", "getsize_ros1_to_cdr"),
    *("ros1_to_cdr", "getsize_cdr_to_ros1", "cdr_to_ros1"),
)

_RAISED = (
    *(TypesysError, SerdeError, AssertionError, AttributeError, LookupError, MemoryError),
    *(RecursionError, SyntaxError, TypeError, ValueError, struct.error),
)
_Made = TypeVar("_Made")


def by_library(problem: str, call: Callable[..., _Made], *args: Any) -> _Made:
    """The result of rosbags, or a library like it, for a definition or a message.

    It raises all kinds of errors for invalid input. None of our own code may run in `call`, or our
    bugs would be mistaken for damaged messages.

    Raises:
        Refused: The library cannot use it; says `problem`.
    """
    try:
        return call(*args)
    except Refused:
        raise
    except _RAISED:
        raise Refused(problem) from None


def incomprehensible(name: str) -> str:
    """The error for a type whose definition a library cannot use."""
    return f"the definition of type {name} cannot be parsed"


# ---------------------------------------------------------------- fields


@dataclass(frozen=True, slots=True)
class FieldShape:
    """The type of a field.

    Attributes:
        base: A basic type such as ``uint8`` or ``string``; empty for a message.
        message: Name of the message type; empty for a basic type.
        text_bound: Maximum number of characters of a string; 0 for no limit.
        length: Elements of an array of fixed length; None for anything else.
        bound: Maximum number of elements of a sequence, 0 for no limit; None for anything else.
    """

    base: str
    message: str
    text_bound: int
    length: int | None
    bound: int | None

    @property
    def is_several(self) -> bool:
        """Whether it is an array or a sequence."""
        return self.length is not None or self.bound is not None


def field_shape(desc: FieldDesc) -> FieldShape:
    """The shape of a field of `fields_of`."""
    length, bound = None, None
    if desc[0] == Nodetype.ARRAY:
        desc, length = desc[1]
    elif desc[0] == Nodetype.SEQUENCE:
        desc, bound = desc[1]
    if desc[0] == Nodetype.NAME:
        return FieldShape("", str(desc[1]), 0, length, bound)
    if desc[0] == Nodetype.BASE:
        return FieldShape(str(desc[1][0]), "", int(desc[1][1] or 0), length, bound)
    raise Refused("it holds arrays of arrays")


def fields_of(types: Typesdict, name: str) -> Fielddefs:
    """A type's fields; none for an unknown type."""
    fields = types[name][1] if name in types else []
    return [field for field in fields if field[0] != FILLER]


def shapes_of(types: Typesdict, name: str) -> list[FieldShape]:
    """The shapes of a type's fields.

    Raises:
        Refused: It holds arrays of arrays.
    """
    return [field_shape(desc) for _, desc in fields_of(types, name)]


# ---------------------------------------------------------------- bounds


def sizes_of(types: Typesdict) -> dict[str, int]:
    """The minimum size of a message of each type, with empty sequences: bytes in any serialization.

    Args:
        types: Definitions, complete.

    Raises:
        Refused: A type contains itself, or is larger than any real message.
    """
    # bytes; fields, including those of its parts and of one item per sequence; and levels of nested
    # messages, including those in sequences
    sizes: dict[str, tuple[int, int, int]] = {}

    def size_of(name: str, level: int) -> tuple[int, int, int]:
        if name in sizes:
            return sizes[name]
        if level > _MAX_DEPTH:
            raise Refused(f"{name} contains itself, or is nested too deeply")
        least, steps, depth = 0, 1, 0
        for shape in shapes_of(types, name):
            part_least, part_steps, part_depth = _BYTES_OF.get(shape.base, 1), 0, 0
            if shape.message:
                part_least, part_steps, part_depth = size_of(shape.message, level + 1)
            elif shape.base == "string":
                part_least, part_steps = 4, 1
            depth = max(depth, part_depth + 1)
            if shape.bound is not None:
                part_least = 4
            length = 1 if shape.length is None else shape.length
            least += length * part_least
            steps += 1 + length * part_steps
        if steps > _MAX_STEPS or depth > _MAX_DEPTH:
            raise Refused(f"{name} has more fields than any real message")
        sizes[name] = least, steps, depth
        return sizes[name]

    parts = 0
    for name in types:
        size_of(name, 1)
        for shape in shapes_of(types, name):
            is_plain = shape.base not in ("", "string")
            parts += 1 if is_plain else 1 + (1 if shape.length is None else shape.length)
    if parts > _MAX_PARTS:
        raise Refused(f"its definition has more than {_MAX_PARTS} fields")
    return {name: least for name, (least, _, _) in sizes.items()}


def has_empty_items(types: Typesdict, sizes: dict[str, int]) -> bool:
    """Whether there are arrays of messages of zero bytes."""
    return any(
        shape.is_several and shape.message and not sizes[shape.message]
        for name in types
        for shape in shapes_of(types, name)
    )


class BoundedStore(Typestore):
    """A store whose types refuse messages shorter than their minimum size.

    This bounds the items of a sequence by the bytes left, before they are read; items of zero bytes
    are counted.

    Args:
        types: Definitions, complete except for time and duration.
    """

    def __init__(self, types: Typesdict) -> None:
        super().__init__(empty)
        self._sizes = sizes_of({**self.fielddefs, **types})
        by_library("its definition cannot be parsed", self.register, types)
        self._data: object = None
        self._empty_left = 0

    def get_msgdef(self, typename: str) -> Msgdef[object]:
        """The functions for a type, compiled when first asked for."""
        found = self.cache.get(typename)
        if found is None:
            found = by_library(incomprehensible(typename), super().get_msgdef, typename)
            least = self._sizes[typename]
            check = partial(_checked, least=least) if least else self._counted
            checked: dict[str, Any] = {name: check(getattr(found, name)) for name in _READING}
            found = self.cache[typename] = replace(found, **checked)
        return found

    def _counted(self, read: Callable[..., Any]) -> Callable[..., Any]:
        def counted(data: memoryview, *rest: Any) -> Any:
            if data is not self._data:
                self._data, self._empty_left = data, _MAX_EMPTY + 2 * len(data)
            self._empty_left -= 1
            if self._empty_left < 0:
                raise SerdeError("an array in it declares too many elements of no bytes")
            return read(data, *rest)

        return counted


def _checked(read: Callable[..., Any], least: int) -> Callable[..., Any]:
    def checked(data: memoryview, position: int, *rest: Any) -> Any:
        if position + least > len(data):
            raise SerdeError("a message in it is cut short")
        return read(data, position, *rest)

    return checked


# ---------------------------------------------------------------- definitions

HEADER = "std_msgs/msg/Header"

MAX_TAIL = 8
"""Trailing bytes after a message that ROS ignores; with more, the definition must be wrong."""
BUILTIN = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")

_MAX_TEXT, _MAX_IDL, _MAX_LINES = 2**19, 2**17, 2**14
_NO_CODE = re.compile(r'"(?:\\.|[^"\\])*"?|//.*|/[*](?:(?s:.*?)[*]/|(?s:.*))|\'\\?.\'')
# rosbags' parser re-reads what is in brackets a hundred times, and multiplies without bounds
_SLOW_IDL = re.compile(r"[(][^()]*[(]|<[^<>;]*<[^<>;]*<|[*]|<<(?!\s*\d{1,2}\b)")
_BRACKET = re.compile(r"[^\w\s]\s*[(]")
_MAX_BRACKETS = 8
_BYTES = {"byte": "uint8", "char": "uint8", "octet": "uint8"}
_RULER = "=" * 80


SCHEMA_ENCODINGS = {"ros1": "ros1msg", "cdr": "ros2msg"}
"""Encoding of messages -> that of the definitions generated for them."""


@cache  # they take a while to load
def ros1_types() -> Typesdict:
    """The standard types of ROS 1 Noetic; rosbags has all except tf2's."""
    tf2 = "tf2_msgs/msg/TFMessage"
    standard = {tf2: get_typestore(Stores.ROS2_HUMBLE).fielddefs[tf2]}
    return {**standard, **get_typestore(Stores.ROS1_NOETIC).fielddefs}


@cache
def ros2_types(distribution: str = "humble") -> Typesdict:
    """The standard types of a distribution of ROS 2, for definitions that were not recorded."""
    # including later types: a recording without definitions may have them
    latest = get_typestore(Stores.LATEST).fielddefs
    return {**latest, **get_typestore(Stores(f"ros2_{distribution}")).fielddefs}


def standard_of(message_encoding: str) -> Typesdict:
    """The standard types of the ROS whose messages have an encoding, ``ros1`` or ``cdr``."""
    return ros1_types() if message_encoding == "ros1" else ros2_types()


def name_of(schema: Schema) -> str:
    """The type's name as ROS 2 spells it."""
    name: str = normalize_msgtype(schema.name)
    return name


def types_of(schema: Schema, standard: Typesdict) -> Typesdict:
    """The type of a schema and everything it refers to; missing ones are taken from the standard.

    Raises:
        Refused: A type is not defined, the definition does not parse, or it is larger than any real
            one.
    """
    problem = incomprehensible(schema.name)
    name = by_library(problem, normalize_msgtype, schema.name)
    found = _parse(schema, name, problem)
    if not fields_of(found, name) and name in standard:
        found.pop(name, None)  # the definition is empty, but perhaps not the type
    # Time, duration and header are each ROS's own, whatever their definitions are called.
    for builtin in (*BUILTIN, HEADER):
        found.pop(builtin, None)
    if name not in found and name not in standard:
        raise Refused(f"no definition of type {schema.name} is known")
    types = closure(found, name, standard)
    sizes_of(types)  # refuses definitions that no message can match
    return types


def _parse(schema: Schema, name: str, problem: str) -> Typesdict:
    if len(schema.data) > _MAX_TEXT or schema.data.count(b"\n") > _MAX_LINES:
        raise Refused(f"the definition of type {schema.name} is longer than any real one")
    text = schema.data.decode(errors="replace").replace("\r\n", "\n")
    if not schema.encoding:
        return {}
    if schema.encoding in ("ros2idl", "omgidl") or re.match(r"=+\nIDL: ", text):
        text = re.sub(r"(?m)^[ \t]*#.*$", "", text)  # included definitions are beside it
        code = _NO_CODE.sub("", text)
        brackets = len(_BRACKET.findall(code))
        if len(text) > _MAX_IDL or brackets > _MAX_BRACKETS or _SLOW_IDL.search(code):
            raise Refused(f"the IDL of type {schema.name} takes too long to parse")
        parts = re.split(r"(?m)^=+\n(?:IDL: .*\n)?", text)
        parsed = (by_library(problem, get_types_from_idl, part) for part in parts if part.strip())
        return {key: value for types in parsed for key, value in types.items()}
    text = re.sub(r"(?m)^={20,}[ \t]*$", _RULER, text)
    if schema.encoding == "ros1msg":
        text = re.sub(r"\broslib/Header\b", "std_msgs/Header", text)  # its name before 2010
    return by_library(problem, get_types_from_msg, text, name)


def closure(types: Typesdict, root: str, standard: Typesdict) -> Typesdict:
    """A type and everything it refers to, each from the first collection that has it.

    Raises:
        Refused: One is in neither collection.
    """
    found: Typesdict = {}
    todo = [root]
    while todo:
        name = todo.pop()
        if name not in types and name not in standard:
            raise Refused(f"no definition of type {name} is known")
        if name not in found:
            found[name] = types[name] if name in types else standard[name]
            todo += [shape.message for shape in shapes_of(found, name) if shape.message]
    return found


def same_wire(left: Typesdict, left_name: str, right: Typesdict, right_name: str) -> bool:
    """Whether two types serialise identically, whatever their fields are called.

    Headers count as identical: only that of ROS 1 has a sequence number, which conversion handles.
    """
    if left_name == right_name == HEADER:
        return True
    left_shapes, right_shapes = shapes_of(left, left_name), shapes_of(right, right_name)
    if len(left_shapes) != len(right_shapes):
        return False

    def bytes_of(shape: FieldShape) -> tuple[object, ...]:
        """What determines its bytes, except for the message type; bounds do not."""
        base = _BYTES.get(shape.base, shape.base)
        return base, bool(shape.message), shape.length, shape.bound is None

    return all(
        bytes_of(one) == bytes_of(other)
        and (not one.message or same_wire(left, one.message, right, other.message))
        for one, other in zip(left_shapes, right_shapes, strict=True)
    )


def translate(types: Typesdict, root: str, new_root: str, standard: Typesdict) -> Typesdict:
    """Definitions for the other ROS; standard ones where they serialise identically.

    Args:
        types: The definitions, complete.
        root: The type to translate.
        new_root: Its name in the other ROS.
        standard: The standard types of the other ROS.
    """
    chosen: Typesdict = {}
    for name in types:
        new_name = new_root if name == root else name
        if new_name in standard and same_wire(types, name, standard, new_name):
            chosen.update(closure({}, new_name, standard))
        else:
            constants, fields = types[name]
            # Bounds are not on the wire. ROS 1 cannot write them, its definitions have none.
            plain = [(field, _unbounded(desc)) for field, desc in fields]
            chosen.setdefault(new_name, (constants, plain))
    return chosen


def _unbounded(desc: Any) -> Any:
    """A field without the bounds of strings and sequences."""
    if desc[0] == Nodetype.BASE:
        return (desc[0], (desc[1][0], 0))
    if desc[0] == Nodetype.NAME:
        return desc
    part, count = desc[1]
    return (desc[0], (_unbounded(part), count if desc[0] == Nodetype.ARRAY else 0))


def make_store(types: Typesdict, standard: Typesdict) -> Typestore:
    """A type store of definitions with the header of the ROS of these standard types."""
    own = {name: found for name, found in types.items() if name not in (*BUILTIN, HEADER)}
    return BoundedStore({HEADER: standard[HEADER], **own})
