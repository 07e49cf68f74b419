"""Topics whose messages trigger a recorder that looks back, each or by the value of a field."""

from __future__ import annotations

import operator
import re
import struct
from collections.abc import Callable, Mapping
from typing import Any

from mp4ds.bags.convert import decoder_of
from mp4ds.bags.types import FieldShape, field_shape, fields_of, name_of, standard_of, types_of
from mp4ds.errors import OptionError, Refused
from mp4ds.records import Channel

_STEP = r"[A-Za-z_]\w*(?:\[\d+\])?"
_TRIGGER = re.compile(
    rf"\s*(?P<topic>[^\s:]+)\s*"
    rf"(?::\s*(?P<field>{_STEP}(?:\.{_STEP})*)\s*(?P<sign>[<>]=?|[=!]=)\s*(?P<value>\S.*?)\s*)?",
    re.ASCII,
)
_SIGNS: Mapping[str, Callable[[Any, Any], bool]] = {
    ">=": operator.ge,
    "<=": operator.le,
    "==": operator.eq,
    "!=": operator.ne,
    ">": operator.gt,
    "<": operator.lt,
}
_TRUTHS = {"true": True, "false": False}
_QUOTES = ("'", '"')


class Trigger:
    """A topic, and perhaps a condition on a field of its messages.

    Args:
        text: ``TOPIC``, or ``TOPIC:FIELD>VALUE`` with one of > >= < <= == !=; a field may be
            nested, ``a.b``, and an element of an array, ``a[0]``.

    Attributes:
        topic: As written.

    Raises:
        OptionError: It is neither.
    """

    def __init__(self, text: str) -> None:
        match = _TRIGGER.fullmatch(text)
        if match is None:
            raise OptionError(
                f"`trigger` {text!r} is neither TOPIC nor TOPIC:FIELD>VALUE, with one of "
                f"{' '.join(_SIGNS)}, such as /battery:percentage<0.2"
            )
        self.topic: str = match["topic"]
        self._field, self._sign, self._value = match["field"], match["sign"], match["value"]
        self._is_met = False

    def watch(self, channel: Channel) -> Callable[[bytes], bool]:
        """What tells of each message of a channel whether it triggers.

        A condition triggers when it becomes true; before the first message it is false. It is also
        false where an array has no such element.

        Raises:
            Refused: Messages of this type have no such field, or it cannot be compared so.
        """
        if self._field is None:
            return lambda _: True
        steps = [_step(text) for text in self._field.split(".")]
        shape = self._shape(channel, steps)
        value = self._compared(shape)
        compare = _SIGNS[self._sign]
        try:
            decode = decoder_of(channel)
        except OptionError as error:
            raise Refused(str(error)) from None

        def is_triggered(data: bytes) -> bool:
            was_met = self._is_met
            try:
                found = decode(memoryview(data))
                for name, index in steps:
                    found = getattr(found, name)
                    found = found if index is None else found[index]
                self._is_met = bool(compare(found, value))
            except (IndexError, Refused):
                self._is_met = False
            return self._is_met and not was_met

        return is_triggered

    def _shape(self, channel: Channel, steps: list[tuple[str, int | None]]) -> FieldShape:
        """That of the field.

        Raises:
            Refused: There is no such field, or it has no single value.
        """
        if channel.schema is None:
            raise Refused("the type of its messages is not known")
        types = types_of(channel.schema, standard_of(channel.message_encoding))
        kind, shape = name_of(channel.schema), None
        for name, index in steps:
            fields = dict(fields_of(types, kind)) if kind else {}
            if name not in fields:
                known = f"a {kind} has {', '.join(fields) or 'no fields'}" if kind else "no message"
                raise Refused(f"there is no field {name!r}: {known}")
            shape = field_shape(fields[name])
            if shape.is_several and index is None:
                raise Refused(f"{name} is an array: choose an element, such as {name}[0]")
            if index is not None and not shape.is_several:
                raise Refused(f"{name} is no array")
            if index is not None and shape.length is not None and index >= shape.length:
                raise Refused(f"{name} has {shape.length} elements, [0] to [{shape.length - 1}]")
            kind = shape.message
        if shape is None or kind:
            parts = ", ".join(f"{self._field}.{name}" for name, _ in fields_of(types, kind))
            raise Refused(f"{self._field} is a {kind}: choose one of its fields, {parts}")
        return shape

    def _compared(self, shape: FieldShape) -> Any:
        """The value, as one of the field.

        Raises:
            Refused: It is none, or there is no order.
        """
        text = self._value
        is_ordered = shape.base != "bool" and "string" not in shape.base
        if not is_ordered and self._sign not in ("==", "!="):
            raise Refused(f"{self._field} is a {shape.base}: compare it with == or !=")
        if "string" in shape.base:
            is_quoted = len(text) > 1 and text[0] == text[-1] and text[0] in _QUOTES
            return text[1:-1] if is_quoted else text
        problem = f"{self._field} is a {shape.base}, which {text!r} is not"
        try:
            if shape.base == "bool":
                return _TRUTHS[text.lower()]
            if re.fullmatch(r"[+-]?\d+", text):
                return int(text)
            value = float(text)
            is_single = shape.base == "float32"  # where 0.1 is another number
            return struct.unpack("f", struct.pack("f", value))[0] if is_single else value
        except (KeyError, ValueError, OverflowError):
            raise Refused(problem) from None


def _step(text: str) -> tuple[str, int | None]:
    """Name of a field, and the number of its element."""
    name, _, index = text.rstrip("]").partition("[")
    return name, int(index) if index else None
