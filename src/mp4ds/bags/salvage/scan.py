"""The records of a damaged file, read once, resuming after damage."""

from __future__ import annotations

import io
import re
import struct
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from mp4ds.bags.files import DamageError, open_source
from mp4ds.bags.mcap_records import MAGIC, PRIVATE_OPCODE
from mp4ds.bags.ros1 import UINT32, Fields, Op, split_header
from mp4ds.errors import SourceError

BLOCK = 2**20
_PIECE = 16 * 2**20


class Window:
    """The part of a file ahead of the reader. A context manager.

    Args:
        source: A stream at byte `offset`.
        path: Its name, for errors.
        size: Bytes of the whole file.
        offset: Position of the stream.

    Attributes:
        offset: Byte at which the window begins.
        size: Bytes of the whole file.
    """

    def __init__(self, source: BinaryIO, path: Path, *, size: int, offset: int = 0) -> None:
        self._source = source
        self._path = path
        self._data = b""
        self._at = 0
        self._ended = False
        self.offset = offset
        self.size = size

    @classmethod
    def of_file(cls, path: Path, offset: int = 0) -> Window:
        """A window over a file.

        Raises:
            SourceError: It cannot be opened, is empty, or a git-lfs pointer.
        """
        stream = open_source(path)
        stream.seek(offset)
        return cls(stream, path, size=path.stat().st_size, offset=offset)

    @classmethod
    def of_content(cls, content: bytes, path: Path) -> Window:
        """A window over the decompressed content of a chunk."""
        window = cls(io.BytesIO(), path, size=len(content))
        window._data, window._ended = content, True
        return window

    @property
    def left(self) -> int:
        """Bytes ahead of the reader."""
        return max(0, self.size - self.offset)

    def peek(self, length: int) -> memoryview:
        """The next bytes; fewer at the end only. Memory is bounded by the file, not by `length`.

        Raises:
            SourceError: They cannot be read.
        """
        if len(self._data) - self._at < length and not self._ended:
            self._fill(length)
        return memoryview(self._data)[self._at : self._at + length]

    def _fill(self, length: int) -> None:
        pieces = [self._data[self._at :]]
        have = len(pieces[0])
        while have < length and not self._ended:
            wanted = min(max(length - have, BLOCK), _PIECE)
            try:
                piece = self._source.read(wanted)
            except OSError as error:
                raise SourceError(
                    self._path, f"cannot be read: {error.strerror or error}"
                ) from None
            self._ended = len(piece) < wanted
            pieces.append(piece)
            have += len(piece)
        self._data, self._at = b"".join(pieces), 0

    def skip(self, length: int) -> None:
        """Advance by that many bytes, which may be more than were peeked."""
        while length > 0:
            step = min(length, len(self._data) - self._at) or len(self.peek(min(length, BLOCK)))
            if not step:
                return
            self._at += step
            self.offset += step
            length -= step

    def look(self, distance: int, length: int) -> bytes:
        """Bytes far ahead, without reading up to them."""
        if self._ended or distance + length <= len(self._data) - self._at:
            return bytes(self.peek(distance + length)[distance:])
        try:
            place = self._source.tell()
            self._source.seek(self.offset + distance)
            ahead = self._source.read(length)
            self._source.seek(place)
        except OSError as error:
            raise SourceError(self._path, f"cannot be read: {error.strerror}") from None
        return ahead

    def close(self) -> None:
        """Close the file."""
        self._source.close()

    def __enter__(self) -> Window:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


# ---------------------------------------------------------------- scan

MAX_UNPROVEN = 64 * 2**20
"""Maximum size of a record accepted although no other record follows it."""


@dataclass(frozen=True, slots=True)
class RecordFrame:
    """A record's extent, from its first bytes.

    Attributes:
        kind: Its kind in the format.
        head: Bytes before its body.
        size: Total bytes.
        fields: The fields in the header of a ROS 1 record.
    """

    kind: int
    head: int
    size: int
    fields: Fields = field(default_factory=Fields)


class Framing(ABC):
    """How a format frames its records.

    Attributes:
        lookahead: Number of bytes that suffice to recognise a record.
        outer: Kinds of records that are outside chunks.
    """

    lookahead: int
    outer: Collection[int]

    @abstractmethod
    def frame(self, view: memoryview) -> RecordFrame | None:
        """The record at the start of these bytes, if they look like one."""

    @abstractmethod
    def find(
        self,
        view: memoryview,
        end: int,
        is_followed: Callable[[int], bool],
        kinds: Collection[int] | None = None,
    ) -> int | None:
        """The start of the first certain record.

        Args:
            view: The bytes to search.
            end: Byte before which it must begin.
            is_followed: Whether a record, or the end, is at a byte of the view or past it.
            kinds: Only records of these kinds; None for all.
        """


class Scan:
    """The records of a file, or of a chunk.

    Args:
        window: What to read.
        framing: How its records are framed.
        lose: Called with skipped bytes: offset, size, a phrase.
    """

    def __init__(
        self, window: Window, framing: Framing, lose: Callable[[int, int, str], None]
    ) -> None:
        self._window = window
        self._framing = framing
        self._lose = lose

    def next(self) -> RecordFrame | None:
        """The next record, without consuming it; None at the end."""
        while True:
            view = self._window.peek(self._framing.lookahead)
            if not view:
                return None
            frame = self._framing.frame(view)
            if frame:
                return frame
            self.resync(self._window.offset, "no valid record here")

    def body(self, frame: RecordFrame) -> bytes | None:
        """Consume a record. None if it is damaged; the scan has then advanced past it."""
        if not self.is_proven(frame):
            self.resync(self._window.offset, self.cut_or_damaged(frame))
            return None
        whole = self._window.peek(frame.size + self._framing.lookahead)
        following = whole[frame.size :]
        if following and not self._framing.frame(following):
            body = whole[frame.head :]
            size = frame.size - frame.head
            if self._framing.find(body, size, self._follows(frame.head)) is not None:
                self.resync(self._window.offset, "a record has a wrong length")
                return None
        self._window.skip(frame.size)
        return bytes(whole[frame.head : frame.size])

    def is_cut(self, frame: RecordFrame) -> bool:
        """Whether the file ends before the record does."""
        return self._window.left < frame.size

    def is_proven(self, frame: RecordFrame) -> bool:
        """Whether a record is complete and, if it is large, followed by another one."""
        if self.is_cut(frame):
            return False
        return frame.size <= MAX_UNPROVEN or self.is_followed(frame.size)

    def is_followed(self, size: int) -> bool:
        """Whether a record, or the end, follows after that many bytes."""
        ahead = self._window.look(size, self._framing.lookahead)
        return not ahead or self._framing.frame(memoryview(ahead)) is not None

    def _follows(self, start: int) -> Callable[[int], bool]:
        return lambda distance: self.is_followed(start + distance)

    def cut_or_damaged(self, frame: RecordFrame) -> str:
        """What is wrong with an unproven record, in words."""
        if self.is_cut(frame):
            return "the file ends within a record"
        return "a record has an impossible length"

    def resync(
        self,
        start: int,
        problem: str,
        *,
        passed: int = 1,
        kinds: Collection[int] | None = None,
    ) -> None:
        """Advance to the next certain record.

        Args:
            start: Where the damage begins.
            problem: What is wrong, a phrase.
            passed: Bytes ahead of the reader in which no record begins, as is already known.
            kinds: Stop only at a record of these kinds; None for all.
        """
        window, reach = self._window, self._framing.lookahead
        window.skip(passed)
        while True:
            view = window.peek(BLOCK + reach)
            at_end = len(view) < BLOCK + reach
            end = len(view) if at_end else BLOCK
            found = self._framing.find(view, end, self._follows(0), kinds)
            if found is not None:
                window.skip(found)
                break
            window.skip(len(view) if at_end else BLOCK)
            if at_end:
                break
        if window.offset > start:
            self._lose(start, window.offset - start, problem)


# ---------------------------------------------------------------- ROS 1

MAX_HEADER = 2**16
"""Maximum size of a record's header: a few fields, and the topic of a connection."""

_ROS1_OP = re.compile(rb"\x04\x00\x00\x00op=[\x02\x04-\x07]")
_MAX_BEFORE_OP = 512
_MAX_FOUND_HEADER = 4096
_TIME = struct.Struct("<II")

# Sizes of the fields that a record of a kind must have.
_FIELDS: Mapping[int, Mapping[bytes, int]] = {
    Op.MESSAGE: {b"conn": 4, b"time": 8},
    Op.BAG: {b"index_pos": 8},
    Op.INDEX: {b"ver": 4, b"conn": 4, b"count": 4},
    Op.CHUNK: {b"size": 4},
    Op.CHUNK_INFO: {b"chunk_pos": 8, b"count": 4, b"start_time": 8, b"end_time": 8},
    Op.CONNECTION: {b"conn": 4},
}


class Ros1Framing(Framing):
    """Finds records by the fields of their headers.

    An uncompressed chunk is framed by its header alone, so that its records are read like any other
    in the file: damage to one does not hide the others.
    """

    lookahead = MAX_HEADER + 8
    outer: Collection[int] = frozenset({Op.CHUNK, Op.INDEX, Op.CHUNK_INFO})

    def frame(self, view: memoryview) -> RecordFrame | None:
        """The record at the start of these bytes; its header has all fields of its kind."""
        if len(view) < 8:
            return None
        (length,) = UINT32.unpack_from(view)
        if length > MAX_HEADER or length + 8 > len(view):
            return None
        try:
            fields = Fields(split_header(bytes(view[4 : 4 + length])))
        except DamageError:
            return None
        op = fields.get(b"op", b"")
        needed = _FIELDS.get(op[0]) if len(op) == 1 else None
        if needed is None:
            return None
        if any(len(fields.get(name, b"")) != size for name, size in needed.items()):
            return None
        head = length + 8
        (body,) = UINT32.unpack_from(view, length + 4)
        if op[0] == Op.CHUNK:
            if b"compression" not in fields:
                return None
            if fields[b"compression"] == b"none":
                body = 0
        return RecordFrame(op[0], head, head + body, fields)

    def find(
        self,
        view: memoryview,
        end: int,
        is_followed: Callable[[int], bool],
        kinds: Collection[int] | None = None,
    ) -> int | None:
        """The start of the first record: a header with all its fields is proof enough."""
        for match in _ROS1_OP.finditer(view):
            if kinds is None or view[match.end() - 1] in kinds:
                start = self._start(view, match.start())
                if start is not None and start < end:
                    return start
            if match.start() > end + _MAX_BEFORE_OP:
                break
        return None

    def _start(self, view: memoryview, op: int) -> int | None:
        """The start of the record whose field ``op`` is at a byte."""
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


# ---------------------------------------------------------------- MCAP

_FRAME = struct.Struct("<BQ")
_HEAD = _FRAME.size
MAX_LENGTH = 2**40
_COMPRESSIONS = (b"", b"lz4", b"zstd")

# Bytes of the fields in the bodies of records, a string or map as the format of its length.
_LAYOUTS: Mapping[int, tuple[int | str, ...]] = {
    Opcode.SCHEMA: (2, "<I", "<I", "<I"),
    Opcode.CHANNEL: (4, "<I", "<I", "<I"),
    Opcode.CHUNK: (28, "<I", "<Q"),
    Opcode.MESSAGE_INDEX: (2, "<I"),
    Opcode.ATTACHMENT: (16, "<I", "<I", "<Q", 4),
    Opcode.METADATA: ("<I", "<I"),
}
_SHORTEST = {
    Opcode.FOOTER: 20,
    Opcode.MESSAGE: 22,
    Opcode.DATA_END: 4,
    **{
        kind: sum(struct.calcsize(part) if isinstance(part, str) else part for part in layout)
        for kind, layout in _LAYOUTS.items()
    },
}


def _table(known: Mapping[int, int], other: int) -> NDArray[np.int64]:
    table = np.full(256, other, np.int64)
    for opcode, value in known.items():
        table[opcode] = value
    return table


# Records that are not searched for have no possible length.
_SHORTEST_OF = _table(_SHORTEST, MAX_LENGTH)
_LONGEST_OF = _table(
    {**dict.fromkeys(_SHORTEST, MAX_LENGTH), Opcode.DATA_END: 4, Opcode.FOOTER: 20}, 0
)


def _fields_end(kind: int, body: memoryview) -> int | None:
    """Bytes of a record's body by its fields; None if they are not those of its kind."""
    at = 0
    ends = []
    try:
        for part in _LAYOUTS[kind]:
            at += part if isinstance(part, int) else 0
            if isinstance(part, str):
                at += struct.calcsize(part) + int(struct.unpack_from(part, body, at)[0])
            ends.append(at)
    except (KeyError, struct.error):
        return None
    if kind == Opcode.MESSAGE_INDEX and (at - _SHORTEST[kind]) % 16:
        return None
    if kind == Opcode.CHUNK and bytes(body[32 : ends[1]]) not in _COMPRESSIONS:
        return None
    return at


class McapFraming(Framing):
    """Finds records by opcode and length; MCAP has no sync markers.

    In sequence, anything the format allows is a record. After damage, it must be of a kind whose
    fields match the length of its frame, or a message of a known channel followed by another
    record.

    Args:
        channels: Ids of the known channels; may grow.
        longest: Bytes of a record are fewer.
    """

    lookahead = 2**16
    outer: Collection[int] = frozenset(
        {
            Opcode.CHUNK,
            Opcode.MESSAGE_INDEX,
            Opcode.ATTACHMENT,
            Opcode.METADATA,
            Opcode.DATA_END,
            Opcode.FOOTER,
        }
    )

    def __init__(self, channels: Collection[int], longest: int = MAX_LENGTH) -> None:
        self._channels = channels
        self._longest = longest

    def frame(self, view: memoryview) -> RecordFrame | None:
        """The record at the start of these bytes: any that the format allows."""
        if len(view) < _HEAD:
            return None
        opcode, length = _FRAME.unpack_from(view)
        if length >= self._longest or length < _SHORTEST.get(opcode, 0):
            return None
        if not 1 <= opcode <= Opcode.DATA_END and opcode < PRIVATE_OPCODE:
            return None
        if opcode == Opcode.CHUNK:
            needed = _fields_end(opcode, view[_HEAD:])
            if needed is None or needed > length:
                return None
        return RecordFrame(opcode, _HEAD, _HEAD + length)

    def find(
        self,
        view: memoryview,
        end: int,
        is_followed: Callable[[int], bool],
        kinds: Collection[int] | None = None,
    ) -> int | None:
        """The start of the first certain record."""
        for start in self._candidates(view, end):
            if kinds is not None and view[start] not in kinds:
                continue
            size = self._sure_size(view[start:])
            if size == 0 or (size and is_followed(start + size)):
                return start
        return None

    def _candidates(self, view: memoryview, end: int) -> list[int]:
        """Places of an opcode followed by a plausible length."""
        data = np.frombuffer(view, np.uint8)[: end + _HEAD]
        if len(data) < _HEAD:
            return []
        kinds = data[: -_HEAD + 1]
        mask = (data[7 : len(data) - 1] == 0) & (data[8:] == 0)
        mask &= (kinds - np.uint8(Opcode.FOOTER)) <= Opcode.DATA_END - Opcode.FOOTER
        places = np.flatnonzero(mask)
        if not len(places):
            return []
        lengths = np.zeros(len(places), np.int64)
        for byte in range(6):
            lengths |= data[places + 1 + byte].astype(np.int64) << (8 * byte)
        found = kinds[places]
        keep = (lengths >= _SHORTEST_OF[found]) & (lengths <= _LONGEST_OF[found])
        keep[found == Opcode.MESSAGE] &= self._is_known(data, places[found == Opcode.MESSAGE])
        result: list[int] = places[keep & (places < end)].tolist()
        return result

    def _is_known(self, data: NDArray[np.uint8], places: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Whether messages at these places are of known channels."""
        low = np.minimum(places + _HEAD, len(data) - 1)
        high = np.minimum(places + _HEAD + 1, len(data) - 1)
        ids = data[low].astype(np.int64) | data[high].astype(np.int64) << 8
        # the last few may extend beyond the view: the strict check decides
        return np.isin(ids, list(self._channels)) | (places + _HEAD + 1 >= len(data))

    def _sure_size(self, view: memoryview) -> int | None:
        """0 for a certain record, its size if another must follow, None for no record."""
        frame = self.frame(view)
        if frame is None:
            return None
        body, length = view[_HEAD:], frame.size - _HEAD
        if frame.kind == Opcode.MESSAGE:
            is_known = int.from_bytes(body[:2], "little") in self._channels
            return frame.size if is_known else None
        if frame.kind == Opcode.FOOTER:
            return 0 if bytes(body[20 : 20 + len(MAGIC)]) == MAGIC else None
        if frame.kind == Opcode.DATA_END:
            return frame.size
        return 0 if _fields_end(frame.kind, body) == length else None
