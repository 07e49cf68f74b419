"""Serialized messages, taken apart and rebuilt byte for byte, without deserializing pixels.

A wire knows one serialization. It splits an image message into head, pixels and tail, and
rebuilds the head from its fields; what it rebuilds is compared with the original by the
caller, so nothing here needs to be trusted (spec/index.md, "Exactness").
"""

from __future__ import annotations

from mp4ds.wire.base import CameraInfoFields, ImageParts, Wire, WireError
from mp4ds.wire.formats import wire_for

__all__ = ["CameraInfoFields", "ImageParts", "Wire", "WireError", "wire_for"]
