"""The table of serializations."""

from __future__ import annotations

from mp4ds.wire.base import Wire, WireError
from mp4ds.wire.ros import RosWire

_ROS1 = RosWire("ros1", b"", "<", ros2=False)
_CDR_LE = RosWire("cdr-le", b"\x00\x01\x00\x00", "<", ros2=True)
_CDR_BE = RosWire("cdr-be", b"\x00\x00\x00\x00", ">", ros2=True)

WIRES: dict[str, Wire] = {wire.name: wire for wire in (_ROS1, _CDR_LE, _CDR_BE)}
"""By the name that sidecars use (spec/registry.md, "Wires")."""


def wire_for(message_encoding: str, data: memoryview) -> Wire:
    """The wire of a payload.

    Args:
        message_encoding: The channel's, ``ros1`` or ``cdr``.
        data: The payload; CDR tells its byte order in its first bytes.

    Raises:
        WireError: No wire knows this serialization.
    """
    if message_encoding == "ros1":
        return _ROS1
    if message_encoding == "cdr":
        for wire in (_CDR_LE, _CDR_BE):
            if data[:4] == wire.prefix:
                return wire
        raise WireError(f"its CDR encapsulation {bytes(data[:4]).hex()} is not the plain one")
    raise WireError(f"serialization {message_encoding!r} is not modelled")
