"""Reading and writing the primitive types of ROS serializations."""

from __future__ import annotations

import struct

from mp4ds.wire.forms import WireError, text


class Reader:
    """Reads primitives in order; `aligned` inserts the padding of CDR.

    Args:
        data: The payload.
        start: Where the fields begin; alignment counts from here.
        order: ``<`` or ``>``.
        aligned: Whether primitives stand at multiples of their size.
    """

    def __init__(self, data: memoryview, start: int, order: str, *, aligned: bool) -> None:
        self._data = data
        self._start = start
        self.offset = start
        self._order = order
        self._aligned = aligned

    def align(self, size: int) -> int:
        """Go to where the next primitive of that size stands; returns the offset."""
        if self._aligned:
            self.offset += -(self.offset - self._start) % size
        return self.offset

    def take(self, code: str, count: int = 1) -> tuple[float, ...]:
        """Read `count` primitives of a struct code."""
        if count == 0:
            return ()
        size = struct.calcsize(code)
        self.align(size)
        end = self.offset + size * count
        if end > len(self._data):
            raise WireError(f"it ends at byte {len(self._data)}, inside of its fields")
        values = struct.unpack_from(f"{self._order}{count}{code}", self._data, self.offset)
        self.offset = end
        return values

    def integer(self, code: str) -> int:
        """Read one integer."""
        return int(self.take(code)[0])

    def raw(self, size: int) -> memoryview:
        """Read bytes as a view."""
        end = self.offset + size
        if end > len(self._data):
            raise WireError(f"it ends at byte {len(self._data)} where a field needs {end}")
        view = self._data[self.offset : end]
        self.offset = end
        return view

    def string(self, *, terminated: bool) -> str:
        """Read a length-prefixed string, in CDR with its closing NUL."""
        size = self.integer("I")
        raw = self.raw(size)
        if terminated:
            if size == 0 or raw[-1] != 0:
                raise WireError("a string does not end in NUL")
            raw = raw[:-1]
        return text(raw)


class Writer:
    """Writes what `Reader` reads, with padding of zeros."""

    def __init__(self, prefix: bytes, order: str, *, aligned: bool) -> None:
        self._data = bytearray(prefix)
        self._start = len(prefix)
        self._order = order
        self._aligned = aligned

    def put(self, code: str, *values: float) -> None:
        """Write primitives of a struct code."""
        if not values:
            return
        if self._aligned:
            self._data += bytes(-(len(self._data) - self._start) % struct.calcsize(code))
        self._data += struct.pack(f"{self._order}{len(values)}{code}", *values)

    def string(self, value: str, *, terminated: bool) -> None:
        """Write a length-prefixed string."""
        raw = value.encode() + (b"\0" if terminated else b"")
        self.put("I", len(raw))
        self._data += raw

    def getvalue(self) -> bytes:
        """All bytes written."""
        return bytes(self._data)
