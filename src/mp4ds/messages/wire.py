"""The neutral parts of camera messages, and what serializations have in common.

A form handles one message type in one serialization. It splits a message into its body, its times
and a blank, and a template of the blank makes the message again; the caller compares the result
with the original, so nothing here needs to be trusted (spec/index.md, "Exactness").
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from mp4ds.errors import Refused

NS = 10**9
MAX_BLANK = 1 << 16
"""Maximum size of a blank, bytes: what a message may hold besides its body."""


@dataclass(frozen=True, slots=True)
class ImageFields:
    """A raw image's description of its pixels.

    Attributes:
        encoding: ROS image encoding.
        width: Columns.
        height: Rows.
        step: Bytes per row.
        is_bigendian: The byte as it stands; 0 if the type has none.
    """

    encoding: str
    width: int
    height: int
    step: int
    is_bigendian: int = 0


@dataclass(frozen=True, slots=True)
class CodedFields:
    """A message's description of its coded picture or packet.

    Attributes:
        format: The format or encoding, to the letter.
        width: Columns of the image, 0 if the type does not say.
        height: Rows of the image, 0 if the type does not say.
    """

    format: str
    width: int = 0
    height: int = 0


@dataclass(frozen=True, slots=True)
class CalibrationFields:
    """The calibration of a camera: all fields except the header.

    Attributes:
        height: Rows.
        width: Columns.
        distortion_model: As UTF-8.
        d: Distortion parameters.
        k: Intrinsic matrix, 3 x 3, by rows.
        r: Rectification matrix, 3 x 3, by rows.
        p: Projection matrix, 3 x 4, by rows.
        binning_x: Columns binned into one.
        binning_y: Rows binned into one.
        roi: x_offset, y_offset, height, width.
        roi_do_rectify: The byte as it stands.
    """

    height: int
    width: int
    distortion_model: str
    d: tuple[float, ...]
    k: tuple[float, ...]
    r: tuple[float, ...]
    p: tuple[float, ...]
    binning_x: int = 0
    binning_y: int = 0
    roi: tuple[int, int, int, int] = (0, 0, 0, 0)
    roi_do_rectify: int = 0


Fields = ImageFields | CodedFields | CalibrationFields


@dataclass(frozen=True, slots=True)
class Parts:
    """A camera message, split into parts.

    Attributes:
        stamp: Header stamp, nanoseconds.
        seq: Header sequence number; None if the type has none, as in ROS 2.
        pts: Presentation time of a packet; None if the type has none.
        frame_id: As UTF-8.
        fields: Its other fields.
        body: Pixels or coded picture, a view into the payload; empty for a calibration.
        blank: The message with stamp, seq, pts and body blank.
    """

    stamp: int
    seq: int | None
    pts: int | None
    frame_id: str
    fields: Fields
    body: memoryview
    blank: bytes


@dataclass(frozen=True, slots=True)
class Slots:
    """What differs, besides the body, between messages that share a blank."""

    stamp: int
    seq: int | None = None
    pts: int | None = None


Span = tuple[int, int]


Reading = tuple[tuple[int, int | None, int | None, str, Fields], Mapping[str, Span], Span]
"""What a message holds, and where.

Its `Parts` other than body and blank, in their order; start and end of each slot that it has, in
order: ``stamp``, ``seq``, ``pts``, and ``body``, which includes the body's length; and start and
end of the body, empty at the end of a message without one.
"""


class Form(ABC):
    """One message type in one serialization.

    Attributes:
        wire: Name of the serialization in sidecars.
        body_alignment: Of what follows the body, which so depends on the body's length.
    """

    wire: str
    body_alignment = 1

    @abstractmethod
    def read(self, data: memoryview) -> Reading:
        """Read a message.

        Raises:
            Refused: The payload does not parse, or cannot be modelled; says why.
        """

    @abstractmethod
    def slot(self, name: str, slots: Slots, body_size: int) -> bytes:
        """The bytes of a slot; of ``body``, its length.

        Raises:
            Refused: This serialization cannot represent a value.
        """

    def plain(self, frame_id: str, fields: Fields) -> bytes | None:
        """The blank as written by a plain serializer; None if that is not modelled."""
        return None

    def split(self, data: memoryview) -> Parts:
        """Split a message.

        Raises:
            Refused: The payload does not parse, or cannot be modelled; says why.
        """
        values, spans, (start, end) = self.read(data)
        if (around := len(data) - (end - start)) > MAX_BLANK:
            raise Refused(f"it has {around} bytes besides its data")
        # a blank keeps the body's length as far as what follows depends on it
        kept = (end - start) % self.body_alignment
        head, tail = Template(self, data, spans, kept).around(_BLANK, kept)
        return Parts(*values, data[start:end], b"".join((head, bytes(kept), tail)))

    def template(self, blank: bytes) -> Template:
        """The template of a blank.

        Raises:
            Refused: It is not a blank message of this form.
        """
        _, spans, (start, end) = self.read(memoryview(blank))
        kept = end - start
        for name, (first, last) in spans.items():
            size = last - first - (kept if name == "body" else 0)
            if kept >= self.body_alignment or size != len(self.slot(name, _BLANK, kept)):
                raise Refused("a blank message has times or data")
        return Template(self, memoryview(blank), spans, kept)


_BLANK = Slots(0)


class Template:
    """A blank with located slots.

    Args:
        form: Of the message.
        blank: The blank, or a message whose slots are not looked at.
        spans: As in `Reading`.
        kept: Length of the body in the blank.
    """

    def __init__(self, form: Form, blank: memoryview, spans: Mapping[str, Span], kept: int) -> None:
        self._form = form
        self._kept = kept
        end = 0
        # what is before each slot
        self._before: list[tuple[bytes, str]] = []
        for name, (start, after) in spans.items():
            self._before.append((bytes(blank[end:start]), name))
            end = after
        self._rest = bytes(blank[end:])

    def around(self, slots: Slots, body_size: int) -> tuple[bytes, bytes]:
        """The bytes before and after the body.

        Args:
            slots: The values to fill in.
            body_size: Bytes of the body.

        Raises:
            Refused: This serialization cannot represent a value.
        """
        head = b""
        parts: list[bytes] = []
        for before, name in self._before:
            parts += (before, self._form.slot(name, slots, body_size))
            if name == "body":
                head, parts = b"".join(parts), []
        rest = b"".join((*parts, self._rest))
        return (head, rest) if head else (rest, b"")

    def padding(self, body_size: int) -> int:
        """Zero bytes needed after a body whose length differs from the recorded one."""
        return (self._kept - body_size) % self._form.body_alignment


def prove(template: Template, parts: Parts, data: memoryview) -> bool:
    """Whether a message's template and parts restore the message's bytes."""
    head, tail = template.around(Slots(parts.stamp, parts.seq, parts.pts), len(parts.body))
    end = len(data) - len(tail)  # the body itself is a view of the message
    return len(head) + len(parts.body) == end and data[: len(head)] == head and data[end:] == tail


# ---------------------------------------------------------------- values

MAX_DISTORTION = 1024


def make_fields(kind: type[Fields], values: Mapping[str, Any]) -> Fields:
    """The fields of a message besides its header and body.

    Args:
        kind: Of the message.
        values: By name; those that a type does not have may be absent.

    Raises:
        Refused: A value of a calibration is infinite or not a number, which YAML cannot hold.
    """
    if any(value - value != 0 for name in "dkrp" for value in values.get(name, ())):
        raise Refused("a calibration value is not finite")
    return kind(
        **{field.name: values[field.name] for field in fields(kind) if field.name in values}
    )


def join_stamp(sec: int, nanosec: int) -> int:
    """Nanoseconds.

    Raises:
        Refused: The stamp cannot be restored from them.
    """
    if not 0 <= nanosec < NS:
        raise Refused("its stamp has a second or more in nanoseconds")
    return sec * NS + nanosec


def text(raw: memoryview) -> str:
    """Decode a string of a message.

    Raises:
        Refused: It is not UTF-8.
    """
    try:
        return str(raw, "utf-8")
    except UnicodeDecodeError:
        raise Refused("a string is not UTF-8") from None


# ---------------------------------------------------------------- primitive types


class PrimitiveReader:
    """Reads primitives and strings in order, of ROS 1 or CDR.

    Args:
        data: The payload.
        start: Where the fields begin; alignment counts from here.
        order: ``<`` or ``>``.
        is_cdr: Whether primitives are at multiples of their size, and strings end in NUL.
    """

    def __init__(self, data: memoryview, start: int, order: str, *, is_cdr: bool) -> None:
        self._data = data
        self._start = start
        self.offset = start
        self._order = order
        self._is_cdr = is_cdr

    def take(self, code: str, count: int = 1) -> tuple[float, ...]:
        """Read `count` primitives of a struct code."""
        if count == 0:
            return ()
        size = struct.calcsize(code)
        if self._is_cdr:
            self.offset += -(self.offset - self._start) % size
        return struct.unpack(f"{self._order}{count}{code}", self.raw(size * count))

    def integer(self, code: str) -> int:
        """Read one integer."""
        return int(self.take(code)[0])

    def raw(self, size: int) -> memoryview:
        """Read bytes as a view."""
        end = self.offset + size
        if end > len(self._data):
            raise Refused(f"it ends at byte {len(self._data)}, but a field extends to byte {end}")
        view = self._data[self.offset : end]
        self.offset = end
        return view

    def string(self) -> str:
        """Read a length-prefixed string, in CDR with its terminating NUL."""
        raw = self.raw(self.integer("I"))
        if self._is_cdr:
            if not len(raw) or raw[-1] != 0:
                raise Refused("a string does not end in NUL")
            raw = raw[:-1]
        return text(raw)


class PrimitiveWriter:
    """Writes what `PrimitiveReader` reads, with zero padding."""

    def __init__(self, prefix: bytes, order: str, *, is_cdr: bool) -> None:
        self._data = bytearray(prefix)
        self._start = len(prefix)
        self._order = order
        self._is_cdr = is_cdr

    def put(self, code: str, *values: float) -> None:
        """Write primitives of a struct code."""
        if not values:
            return
        if self._is_cdr:
            self._data += bytes(-(len(self._data) - self._start) % struct.calcsize(code))
        self._data += struct.pack(f"{self._order}{len(values)}{code}", *values)

    def string(self, value: str) -> None:
        """Write a length-prefixed string."""
        raw = value.encode() + (b"\0" if self._is_cdr else b"")
        self.put("I", len(raw))
        self._data += raw

    def getvalue(self) -> bytes:
        """All bytes written."""
        return bytes(self._data)
