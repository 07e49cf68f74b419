"""Bounds of message types: a definition of a few lines can tell of messages without end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from rosbags.interfaces import Msgdef, Nodetype
from rosbags.serde import SerdeError
from rosbags.serde.utils import SIZEMAP
from rosbags.typesys.store import Typestore
from rosbags.typesys.stores import empty

if TYPE_CHECKING:
    from rosbags.interfaces.typing import FieldDesc, Typesdict

FILLER = "structure_needs_at_least_one_member"
"""Name of the field that empty messages have in ROS 2."""

_MAX_PARTS = 5000  # fields of all types, with the items that rosbags' code spells out
_MAX_STEPS = 2**16  # fields of a message whose sequences have one item
_MAX_EMPTY = 2**16  # messages without any byte in one, besides two for each of its bytes
_MAX_DEPTH = 100
_READING = (
    "deserialize_cdr_le",
    "deserialize_cdr_be",
    "deserialize_ros1",
    "getsize_ros1_to_cdr",
    "ros1_to_cdr",
    "getsize_cdr_to_ros1",
    "cdr_to_ros1",
)


class Size(NamedTuple):
    """What a message of a type has at least, its sequences being empty.

    Attributes:
        least: Bytes, in any serialization.
        steps: Fields, with those of its parts, and of one item of each sequence.
        depth: Levels of messages within messages, those in sequences too.
    """

    least: int
    steps: int
    depth: int


def sizes_of(types: Typesdict) -> dict[str, Size]:
    """The size of each type.

    Args:
        types: Definitions, complete.

    Raises:
        ValueError: A type holds itself, or more than any message has.
        KeyError: A type is not defined.
    """
    sizes: dict[str, Size] = {}
    parts = 0
    for name in types:
        todo = [name]
        while todo:
            missing = [part for part in _messages(types, todo[-1]) if part not in sizes]
            if not missing:
                sizes[todo[-1]] = _size(types, todo[-1], sizes)
                todo.pop()
            elif len(todo) > _MAX_DEPTH:
                raise ValueError(f"{name} holds itself, or too many levels of messages")
            else:
                todo.append(missing[0])
        parts += sum(_spelled_out(desc) for _, desc in types[name][1])
    if parts > _MAX_PARTS:
        raise ValueError(f"has more than {_MAX_PARTS} fields")
    return sizes


def has_empty_items(types: Typesdict, sizes: dict[str, Size]) -> bool:
    """Whether there are arrays of messages without any byte."""
    return any(
        desc[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE)
        and desc[1][0][0] == Nodetype.NAME
        and not sizes[str(desc[1][0][1])].least
        for _, fields in types.values()
        for _, desc in fields
    )


class BoundedStore(Typestore):
    """A store whose types read no message of which the least bytes are not there.

    So the items of a sequence are bounded by the bytes that are left, before they are read;
    those that have no bytes are counted.

    Args:
        types: Definitions, complete but for time and duration.
    """

    def __init__(self, types: Typesdict) -> None:
        super().__init__(empty)
        self._sizes = sizes_of({**self.fielddefs, **types})
        self.register(types)
        self._data: object = None
        self._empty_left = 0

    def get_msgdef(self, typename: str) -> Msgdef[object]:
        """See rosbags."""
        found = self.cache.get(typename)
        if found is None:
            found = super().get_msgdef(typename)
            least = self._sizes[typename].least
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
                raise SerdeError("a message in it claims too many without any byte")
            return read(data, *rest)

        return counted


def _checked(read: Callable[..., Any], least: int) -> Callable[..., Any]:
    def checked(data: memoryview, position: int, *rest: Any) -> Any:
        if position + least > len(data):
            raise SerdeError("a message in it is cut short")
        return read(data, position, *rest)

    return checked


def _item(desc: FieldDesc) -> Any:
    """A field, or what an array or sequence holds."""
    return desc[1][0] if desc[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE) else desc


def _messages(types: Typesdict, name: str) -> list[str]:
    items = (_item(desc) for _, desc in types[name][1])
    return [str(item[1]) for item in items if item[0] == Nodetype.NAME]


def _length(desc: FieldDesc) -> int:
    return int(desc[1][1]) if desc[0] == Nodetype.ARRAY else 1


def _spelled_out(desc: FieldDesc) -> int:
    item = _item(desc)
    is_plain = item[0] == Nodetype.BASE and item[1][0] != "string"
    return 1 if is_plain else 1 + _length(desc)


def _size(types: Typesdict, name: str, sizes: dict[str, Size]) -> Size:
    least, steps, depth = 0, 1, 0
    for field, desc in types[name][1]:
        item, length = _item(desc), _length(desc)
        if field == FILLER:
            continue
        part = Size(SIZEMAP.get(item[1][0], 1), 0, 0)
        if item[0] == Nodetype.NAME:
            part = sizes[str(item[1])]
        elif item[1][0] == "string":
            part = Size(4, 1, 0)
        depth = max(depth, part.depth + 1)
        if desc[0] == Nodetype.SEQUENCE:
            part = Size(4, part.steps, 0)
        least += length * part.least
        steps += 1 + length * part.steps
    if steps > _MAX_STEPS or depth > _MAX_DEPTH:
        raise ValueError(f"{name} holds more than any message has")
    return Size(least, steps, depth)
