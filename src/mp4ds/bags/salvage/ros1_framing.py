"""How the records of a ROS 1 bag begin (wiki.ros.org/Bags/Format/2.0)."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Collection, Mapping

from rosbags.rosbag1 import ReaderError
from rosbags.rosbag1.reader import RecordType

from mp4ds.bags.ros1_records import UINT32, split_header
from mp4ds.bags.salvage.scan import Frame

MAX_HEADER = 2**16
"""Bytes of a record's header: a few fields, and the topic of a connection."""

_OP = re.compile(rb"\x04\x00\x00\x00op=[\x02\x04-\x07]")
_MAX_BEFORE_OP = 512
_MAX_FOUND_HEADER = 4096
_TIME = struct.Struct("<II")

# Sizes of the fields that a record of a kind must have.
_FIELDS: Mapping[int, Mapping[bytes, int]] = {
    RecordType.MSGDATA: {b"conn": 4, b"time": 8},
    RecordType.BAGHEADER: {b"index_pos": 8},
    RecordType.IDXDATA: {b"ver": 4, b"conn": 4, b"count": 4},
    RecordType.CHUNK: {b"size": 4},
    RecordType.CHUNK_INFO: {b"chunk_pos": 8, b"count": 4, b"start_time": 8, b"end_time": 8},
    RecordType.CONNECTION: {b"conn": 4},
}


class Ros1Framing:
    """Records by the fields of their headers. See `Framing`.

    A chunk that is not compressed is framed by its header alone, so that its records stand
    in the file like any other: damage to one does not hide the others.
    """

    lookahead = MAX_HEADER + 8
    outer: Collection[int] = frozenset(
        {RecordType.CHUNK, RecordType.IDXDATA, RecordType.CHUNK_INFO}
    )

    def frame(self, view: memoryview) -> Frame[int] | None:
        """See `Framing.frame`."""
        if len(view) < 8:
            return None
        (length,) = UINT32.unpack_from(view)
        if length > MAX_HEADER or length + 8 > len(view):
            return None
        try:
            fields = dict(split_header(bytes(view[4 : 4 + length])))
        except (ReaderError, struct.error):
            return None
        op = fields.get(b"op", b"")
        needed = _FIELDS.get(op[0]) if len(op) == 1 else None
        if needed is None:
            return None
        if any(len(fields.get(name, b"")) != size for name, size in needed.items()):
            return None
        head = length + 8
        (body,) = UINT32.unpack_from(view, length + 4)
        if op[0] == RecordType.CHUNK:
            if b"compression" not in fields:
                return None
            if fields[b"compression"] == b"none":
                body = 0
        return Frame(op[0], head, head + body, fields)

    def find(
        self,
        view: memoryview,
        end: int,
        is_followed: Callable[[int], bool],
        kinds: Collection[int] | None = None,
    ) -> int | None:
        """See `Framing.find`; a header with all its fields is beyond doubt by itself."""
        for match in _OP.finditer(view):
            if kinds is None or view[match.end() - 1] in kinds:
                start = self._start(view, match.start())
                if start is not None and start < end:
                    return start
            if match.start() > end + _MAX_BEFORE_OP:
                break
        return None

    def _start(self, view: memoryview, op: int) -> int | None:
        """Where the record begins whose field ``op`` is there."""
        first = max(0, op - _MAX_BEFORE_OP)
        before = bytes(view[first:op])
        for start in range(len(before) - 4, -1, -1):
            if before[start + 2] or before[start + 3]:
                continue
            (length,) = UINT32.unpack_from(before, start)
            if not op - first - start + 4 <= length <= _MAX_FOUND_HEADER:
                continue
            if self.frame(view[first + start :]):
                return first + start
        return None


def number(field: bytes) -> int:
    """A field that is an unsigned number."""
    return int.from_bytes(field, "little")


def time(field: bytes) -> int:
    """A field that is a time, nanoseconds."""
    seconds, nanoseconds = _TIME.unpack(field)
    return int(seconds) * 10**9 + int(nanoseconds)
