"""Serialized messages, taken apart and rebuilt byte for byte, without deserializing pixels.

A form knows one message type in one serialization. It splits a message into its body, its times
and a blank, and fills a blank again; what it rebuilds is compared with the original by the
caller, so nothing here needs to be trusted (spec/index.md, "Exactness").
"""

from __future__ import annotations

from mp4ds.wire.formats import (
    WIRES,
    form_of,
    is_calibration,
    is_camera,
    kind_of,
    plain_message,
    wire_of,
)
from mp4ds.wire.forms import (
    CalibrationFields,
    CodedFields,
    Fields,
    Form,
    ImageFields,
    Parts,
    Slots,
    Template,
    WireError,
    prove,
)

__all__ = [
    "WIRES",
    "CalibrationFields",
    "CodedFields",
    "Fields",
    "Form",
    "ImageFields",
    "Parts",
    "Slots",
    "Template",
    "WireError",
    "form_of",
    "is_calibration",
    "is_camera",
    "kind_of",
    "plain_message",
    "prove",
    "wire_of",
]
