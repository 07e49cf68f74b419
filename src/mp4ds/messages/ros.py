"""Camera messages in ROS 1's serialization and ROS 2's CDR.

The two differ in order, alignment and header. ROS 1: little-endian, unaligned, header with seq,
strings without NUL (wiki.ros.org/msg, "Fields"). CDR: a four-byte encapsulation, primitives
aligned to their size from there, strings with NUL (OMG DDSI-RTPS 2.5, 10; plain CDR only).
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mp4ds.messages.wire import (
    MAX_BLANK,
    NS,
    CalibrationFields,
    CodedFields,
    Fields,
    ImageFields,
    Parts,
    PrimitiveReader,
    PrimitiveWriter,
    Slots,
    WireError,
    check_floats,
    join_stamp,
)

_MAX_DISTORTION = 1024
_ALIGNMENT = 4  # of what follows a body: strings

# (name, code): struct codes, s for a string, d* for a length-prefixed array of doubles
_HEADER = (("header", ""),)
_TIME = (("time", ""), ("frame_id", "s"))
_BODY = ("body", "")
_SIZE = (("width", "I"), ("height", "I"))
_MATRICES = (("distortion_model", "s"), ("d", "d*"), ("k", "9d"), ("r", "9d"), ("p", "12d"))
_BINNING = (("binning_x", "I"), ("binning_y", "I"))
_ROI = tuple((f"roi_{name}", "I") for name in ("x_offset", "y_offset", "height", "width"))

_Layout = tuple[tuple[str, str], ...]

LAYOUTS: Mapping[str, tuple[type[Fields], _Layout]] = {
    "sensor_msgs/Image": (
        ImageFields,
        (*_HEADER, *_SIZE[::-1], ("encoding", "s"), ("is_bigendian", "B"), ("step", "I"), _BODY),
    ),
    "sensor_msgs/CompressedImage": (CodedFields, (*_HEADER, ("format", "s"), _BODY)),
    "sensor_msgs/CameraInfo": (
        CalibrationFields,
        (*_HEADER, *_SIZE[::-1], *_MATRICES, *_BINNING, *_ROI, ("roi_do_rectify", "B")),
    ),
    "ffmpeg_image_transport_msgs/FFMPEGPacket": (
        CodedFields,
        (
            *_HEADER,
            *(("width", "i"), ("height", "i"), ("format", "s"), ("pts", "Q")),
            *(("flags", "B"), ("is_bigendian", "B"), _BODY),
        ),
    ),
    "foxglove_msgs/RawImage": (
        ImageFields,
        (*_TIME, *_SIZE, ("encoding", "s"), ("step", "I"), _BODY),
    ),
    "foxglove_msgs/CompressedImage": (CodedFields, (*_TIME, _BODY, ("format", "s"))),
    "foxglove_msgs/CompressedVideo": (CodedFields, (*_TIME, _BODY, ("format", "s"))),
    "foxglove_msgs/CameraCalibration": (CalibrationFields, (*_TIME, *_SIZE, *_MATRICES)),
}
"""The fields of each type, in the order of its definition (spec/registry.md, "Message types")."""


@dataclass(frozen=True, slots=True)
class RosWire:
    """One of the three plain serializations of ROS.

    Attributes:
        name: ``ros1``, ``cdr-le`` or ``cdr-be``.
        prefix: The encapsulation at the start of a payload.
        order: Byte order, in struct's notation.
        ros2: Whether it is CDR: aligned, NUL-terminated, without seq.
    """

    name: str
    prefix: bytes
    order: str
    ros2: bool

    def reader(self, data: memoryview) -> PrimitiveReader:
        """Reads a payload's fields.

        Raises:
            WireError: It does not begin as expected.
        """
        if bytes(data[: len(self.prefix)]) != self.prefix:
            raise WireError("it does not begin like a plain serialization of its kind")
        return PrimitiveReader(data, len(self.prefix), self.order, aligned=self.ros2)


@dataclass(frozen=True, slots=True)
class _Places:
    """Byte offsets of a message's slots; None for a slot it does not have."""

    order: str
    sec_code: str
    stamp: int
    seq: int | None
    pts: int | None
    body: int | None

    def fill(self, message: bytearray, slots: Slots, body_size: int) -> None:
        """Write all slots into a message, or into its part before the body."""
        sec, nanosec = divmod(slots.stamp, NS)
        try:
            struct.pack_into(f"{self.order}{self.sec_code}I", message, self.stamp, sec, nanosec)
            if self.seq is not None:
                struct.pack_into(f"{self.order}I", message, self.seq, slots.seq or 0)
            if self.pts is not None:
                struct.pack_into(f"{self.order}Q", message, self.pts, slots.pts or 0)
            if self.body is not None:
                struct.pack_into(f"{self.order}I", message, self.body - 4, body_size)
        except struct.error:
            raise WireError("a time or number is beyond what its message has bits for") from None


class RosForm:
    """A message type in a ROS serialization. See `mp4ds.messages.wire.Form`."""

    def __init__(self, wire: RosWire, type_name: str) -> None:
        self._wire = wire
        self._kind, self._layout = LAYOUTS[type_name]
        self._sec_code = "i" if wire.ros2 else "I"
        names = [name for name, _ in self._layout]
        has_tail = "body" in names and names[-1] != "body"
        self._is_aligned_after = wire.ros2 and has_tail
        self._is_plain = "pts" not in names and not has_tail

    @property
    def wire(self) -> str:
        """See `Form.wire`."""
        return self._wire.name

    def split(self, data: memoryview) -> Parts:
        """See `Form.split`."""
        values, places, body_size = self._read(data)
        start = len(data) if places.body is None else places.body
        end = start + body_size
        around = start + len(data) - end
        if around > MAX_BLANK:
            raise WireError(f"it has {around} bytes besides its data")
        # the alignment of what follows depends on the body's length, so the blank keeps it modulo 4
        kept = body_size % _ALIGNMENT if self._is_aligned_after else 0
        blank = bytearray(data[:start])
        places.fill(blank, Slots(0), kept)
        return Parts(
            stamp=join_stamp(values["sec"], values["nanosec"]),
            seq=values.get("seq"),
            pts=values.get("pts"),
            frame_id=values["frame_id"],
            fields=self._fields(values),
            body=data[start:end],
            blank=bytes(blank + bytes(kept) + data[end:]),
        )

    def template(self, blank: bytes) -> RosTemplate:
        """See `Form.template`."""
        _, places, kept = self._read(memoryview(blank))
        if kept >= (_ALIGNMENT if self._is_aligned_after else 1):
            raise WireError("a blank message has data")
        return RosTemplate(blank, places, kept if self._is_aligned_after else None)

    def plain(self, frame_id: str, fields: Fields) -> bytes | None:
        """See `Form.plain`."""
        if not self._is_plain:
            return None
        wire = self._wire
        writer = PrimitiveWriter(wire.prefix, wire.order, aligned=wire.ros2)
        for name, code in self._layout:
            if name in ("header", "time"):
                if name == "header" and not wire.ros2:
                    writer.put("I", 0)
                writer.put("I", 0, 0)
                if name == "header":
                    writer.string(frame_id, terminated=wire.ros2)
            elif name == "body":
                writer.put("I", 0)
            elif name == "frame_id":
                writer.string(frame_id, terminated=wire.ros2)
            else:
                _put(writer, code, _value(fields, name), terminated=wire.ros2)
        return writer.getvalue()

    def _read(self, data: memoryview) -> tuple[dict[str, Any], _Places, int]:
        """All field values, the positions of the slots, and the size of the body."""
        ros2 = self._wire.ros2
        reader = self._wire.reader(data)
        values: dict[str, Any] = {}
        at: dict[str, int] = {}
        body_size = 0
        for name, code in self._layout:
            if name in ("header", "time"):
                if name == "header" and not ros2:
                    at["seq"] = reader.offset
                    values["seq"] = reader.integer("I")
                at["stamp"] = reader.align(4)
                values["sec"] = reader.integer(self._sec_code)
                values["nanosec"] = reader.integer("I")
                if name == "header":
                    values["frame_id"] = reader.string(terminated=ros2)
            elif name == "body":
                body_size = reader.integer("I")
                at["body"] = reader.offset
                reader.raw(body_size)
            else:
                if name == "pts":
                    at["pts"] = reader.align(8)
                values[name] = _take(reader, code, terminated=ros2)
        places = _Places(
            order=self._wire.order,
            sec_code=self._sec_code,
            stamp=at["stamp"],
            seq=at.get("seq"),
            pts=at.get("pts"),
            body=at.get("body"),
        )
        return values, places, body_size

    def _fields(self, values: Mapping[str, Any]) -> Fields:
        if self._kind is ImageFields:
            return ImageFields(
                encoding=values["encoding"],
                width=values["width"],
                height=values["height"],
                step=values["step"],
                is_bigendian=values.get("is_bigendian", 0),
            )
        if self._kind is CodedFields:
            return CodedFields(values["format"], values.get("width", 0), values.get("height", 0))
        check_floats((*values["d"], *values["k"], *values["r"], *values["p"]))
        return CalibrationFields(
            height=values["height"],
            width=values["width"],
            distortion_model=values["distortion_model"],
            d=values["d"],
            k=values["k"],
            r=values["r"],
            p=values["p"],
            binning_x=values.get("binning_x", 0),
            binning_y=values.get("binning_y", 0),
            roi=tuple(values.get(name, 0) for name, _ in _ROI),
            roi_do_rectify=values.get("roi_do_rectify", 0),
        )


class RosTemplate:
    """A blank of a ROS serialization. See `mp4ds.messages.wire.Template`."""

    def __init__(self, blank: bytes, places: _Places, kept: int | None) -> None:
        self._places = places
        split = len(blank) if places.body is None else places.body
        self._head, self._tail = blank[:split], blank[split + (kept or 0) :]
        self._kept = kept

    def around(self, slots: Slots, body_size: int) -> tuple[bytes, bytes]:
        """See `Template.around`."""
        head = bytearray(self._head)
        self._places.fill(head, slots, body_size)
        return bytes(head), self._tail

    def padding(self, body_size: int) -> int:
        """See `Template.padding`."""
        return 0 if self._kept is None else (self._kept - body_size) % _ALIGNMENT


def _take(reader: PrimitiveReader, code: str, *, terminated: bool) -> Any:
    if code == "s":
        return reader.string(terminated=terminated)
    if code == "d*":
        count = reader.integer("I")
        if count > _MAX_DISTORTION:
            raise WireError(f"it has {count} distortion parameters")
        return reader.take("d", count)
    if len(code) > 1:
        return reader.take(code[-1], int(code[:-1]))
    return reader.integer(code)


def _put(writer: PrimitiveWriter, code: str, value: Any, *, terminated: bool) -> None:
    if code == "s":
        writer.string(value, terminated=terminated)
    elif code == "d*":
        writer.put("I", len(value))
        writer.put("d", *value)
    elif len(code) > 1:
        writer.put(code[-1], *value)
    else:
        writer.put(code, value)


def _value(fields: Fields, name: str) -> Any:
    names = [name for name, _ in _ROI]
    if isinstance(fields, CalibrationFields) and name in names:
        return fields.roi[names.index(name)]
    return getattr(fields, name)
