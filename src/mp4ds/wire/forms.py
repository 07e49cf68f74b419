"""The neutral parts of camera messages, and what every serialization can do with them.

A message is taken apart into its body (pixels, or a coded picture), its times, and a *blank*:
the same message with stamp, sequence number, presentation time and body blank. The blank is
still a message of its serialization, so a template made from it finds its slots again, and
fills them for another message (spec/index.md, "Blank messages").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

NS = 10**9
MAX_BLANK = 1 << 16
"""Largest blank, bytes: what a message may hold besides its body."""


class WireError(ValueError):
    """A payload that does not parse as its type; the message says where it ends."""


@dataclass(frozen=True, slots=True)
class ImageFields:
    """What a raw image says of its pixels.

    Attributes:
        encoding: ROS image encoding.
        width: Columns.
        height: Rows.
        step: Bytes per row.
        is_bigendian: The byte as it stands; 0 where the type has none.
    """

    encoding: str
    width: int
    height: int
    step: int
    is_bigendian: int


@dataclass(frozen=True, slots=True)
class CodedFields:
    """What a message says of the coded picture or packet that it holds.

    Attributes:
        format: The format or encoding, to the letter.
        width: Columns of the image, 0 where the type does not say.
        height: Rows of the image, 0 where the type does not say.
    """

    format: str
    width: int = 0
    height: int = 0


@dataclass(frozen=True, slots=True)
class CalibrationFields:
    """The calibration of a camera: all fields but the header.

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
    """A camera message, taken apart.

    Attributes:
        stamp: Header stamp, nanoseconds.
        seq: Header sequence number; None where the type has none, as in ROS 2.
        pts: Presentation time of a packet; None where the type has none.
        frame_id: As UTF-8.
        fields: The rest of what it says.
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
    """What differs between the messages that share a blank, besides the body."""

    stamp: int
    seq: int | None = None
    pts: int | None = None


class Template(Protocol):
    """A blank whose slots are found."""

    def around(self, slots: Slots, body_size: int) -> tuple[bytes, bytes]:
        """The bytes before and after the body.

        Args:
            slots: The values to fill in.
            body_size: Bytes of the body.

        Raises:
            WireError: A value has no place in this serialization.
        """
        ...

    def padding(self, body_size: int) -> int:
        """Zero bytes that a body of another length than the recorded one needs after it.

        What follows a body may be aligned by its length.
        """
        ...


class Form(Protocol):
    """One message type in one serialization."""

    @property
    def wire(self) -> str:
        """Name of the serialization, as sidecars spell it."""
        ...

    def split(self, data: memoryview) -> Parts:
        """Take a message apart.

        Raises:
            WireError: The payload does not parse, or cannot be modelled; says why.
        """
        ...

    def template(self, blank: bytes) -> Template:
        """The template of a blank.

        Raises:
            WireError: It is no blank message of this form.
        """
        ...

    def plain(self, frame_id: str, fields: Fields) -> bytes | None:
        """The blank as a plain serializer writes it; None where that is not modelled."""
        ...


def prove(template: Template, parts: Parts, data: memoryview) -> bool:
    """Whether a message's template and parts give the message's bytes again."""
    head, tail = template.around(Slots(parts.stamp, parts.seq, parts.pts), len(parts.body))
    end = len(data) - len(tail)  # the body itself is a view of what is there
    return len(head) + len(parts.body) == end and data[: len(head)] == head and data[end:] == tail


def join_stamp(sec: int, nanosec: int) -> int:
    """Nanoseconds.

    Raises:
        WireError: A stamp that does not come back from them.
    """
    if not 0 <= nanosec < NS:
        raise WireError("its stamp has a second or more in nanoseconds")
    return sec * NS + nanosec


def text(raw: memoryview) -> str:
    """Decode a string of a message.

    Raises:
        WireError: It is not UTF-8.
    """
    try:
        return str(raw, "utf-8")
    except UnicodeDecodeError:
        raise WireError("a string is not UTF-8") from None


def check_floats(values: Sequence[float]) -> None:
    """Refuse what YAML cannot hold; such a message is stored verbatim.

    Raises:
        WireError: A value is infinite or not a number.
    """
    if any(value - value != 0 for value in values):
        raise WireError("a calibration value is not finite")
