"""A damaged file, read once: records, resuming after damage, and recovering chunks."""

from __future__ import annotations

import io
from bz2 import BZ2Decompressor
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Generic, NamedTuple, Protocol, TypeVar

import lz4.frame
import zstandard

from mp4ds.bags.files import (
    DECOMPRESSED,
    ZSTD_MAGIC,
    ZSTD_PIECE,
    DamageError,
    OversizeError,
    ZstdStream,
    most_held,
    open_source,
)
from mp4ds.errors import SourceError

if TYPE_CHECKING:
    from mp4ds.bags.files import Decompressor

BLOCK = 2**20
_PIECE = 16 * 2**20
_MAX_AHEAD = 64 * 2**20


class Window:
    """The part of a file ahead of the reader. A context manager.

    Args:
        source: A stream at byte `offset`.
        path: Its name, for errors.
        size: Bytes of the whole file, if known.
        offset: Position of the stream.

    Attributes:
        offset: Byte at which the window begins.
        size: Bytes of the whole file, None if unknown.
    """

    def __init__(
        self, source: BinaryIO | ZstdStream, path: Path, *, size: int | None = None, offset: int = 0
    ) -> None:
        self._source = source
        self._path = path
        self._data = b""
        self._at = 0
        self._ended = False
        self._probe: io.FileIO | None = None
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
    def position(self) -> int:
        """Bytes of the file that the reader has reached."""
        return self._source.tell() if isinstance(self._source, ZstdStream) else self.offset

    @property
    def problem(self) -> str:
        """Why the content ended before the file did, a phrase; empty if it did not."""
        return self._source.problem if isinstance(self._source, ZstdStream) else ""

    @property
    def left(self) -> int | None:
        """Bytes ahead of the reader; None if unknown."""
        if self.size is not None:
            return max(0, self.size - self.offset)
        return len(self._data) - self._at if self._ended else None

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

    def look(self, distance: int, length: int) -> bytes | None:
        """Bytes far ahead, without reading up to them; None if that is impossible."""
        if self._ended or distance + length <= len(self._data) - self._at:
            return bytes(self.peek(distance + length)[distance:])
        if self.size is None:
            if distance > _MAX_AHEAD:
                return None
            return bytes(self.peek(distance + length)[distance:])
        try:
            if self._probe is None:
                self._probe = io.FileIO(self._path)
            self._probe.seek(self.offset + distance)
            return self._probe.read(length) or b""
        except OSError as error:
            raise SourceError(self._path, f"cannot be read: {error.strerror}") from None

    def close(self) -> None:
        """Close the file."""
        self._source.close()
        if self._probe:
            self._probe.close()

    def __enter__(self) -> Window:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


# ---------------------------------------------------------------- scan

MAX_UNPROVEN = 64 * 2**20
"""Maximum size of a record accepted although no other record follows it."""

_KindT = TypeVar("_KindT")


@dataclass(frozen=True, slots=True)
class RecordFrame(Generic[_KindT]):
    """A record's extent, from its first bytes.

    Attributes:
        kind: Its kind in the format.
        head: Bytes before its body.
        size: Total bytes.
        fields: The fields in its head.
    """

    kind: _KindT
    head: int
    size: int
    fields: dict[bytes, bytes] = field(default_factory=dict)


class Framing(Protocol):
    """How a format frames its records.

    Attributes:
        lookahead: Number of bytes that suffice to recognise a record.
        outer: Kinds of records that are outside chunks.
    """

    lookahead: int
    outer: Collection[int]

    def frame(self, view: memoryview) -> RecordFrame[int] | None:
        """The record at the start of these bytes, if they look like one."""
        ...

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
        ...


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

    def next(self) -> RecordFrame[int] | None:
        """The next record, without consuming it; None at the end."""
        while True:
            view = self._window.peek(self._framing.lookahead)
            if not view:
                return None
            frame = self._framing.frame(view)
            if frame:
                return frame
            self.resync(self._window.offset, "no valid record here")

    def body(self, frame: RecordFrame[int]) -> bytes | None:
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

    def is_cut(self, frame: RecordFrame[int]) -> bool:
        """Whether the file ends before the record does."""
        left = self._window.left
        if left is None:
            left = len(self._window.peek(min(frame.size, MAX_UNPROVEN)))
            return left < min(frame.size, MAX_UNPROVEN)
        return left < frame.size

    def is_proven(self, frame: RecordFrame[int]) -> bool:
        """Whether a record is complete and, if it is large, followed by another one."""
        if self.is_cut(frame):
            return False
        return frame.size <= MAX_UNPROVEN or self.is_followed(frame.size)

    def is_followed(self, size: int) -> bool:
        """Whether a record, or the end, follows after that many bytes."""
        ahead = self._window.look(size, self._framing.lookahead)
        if ahead is None:
            return size <= 2**30  # a stream: accepted up to this size
        return not ahead or self._framing.frame(memoryview(ahead)) is not None

    def _follows(self, start: int) -> Callable[[int], bool]:
        return lambda distance: self.is_followed(start + distance)

    def cut_or_damaged(self, frame: RecordFrame[int]) -> str:
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


# ---------------------------------------------------------------- damaged chunks

_UNPACKED_PIECE = 2**12
_SMALL_PIECE = 64
"""Bytes decompressed at a time from damaged data: the piece with the damage yields nothing."""

_CLOSE = 16
"""Bytes at the end, of a marker and a checksum, that are decompressed one by one."""

_LZ4_RATIO = 255
_LZ4_BLOCK = 2**23  # the largest is 4 MiB, and one may be pending

_MAX_AT_ONCE = 64 * 2**20

_MAGIC = {b"BZh": "bz2", b"\x04\x22\x4d\x18": "lz4", ZSTD_MAGIC: "zstd"}


class Unpacked(NamedTuple):
    """Content of a chunk.

    Attributes:
        content: The recovered content, from the beginning.
        used: Bytes of the data that belong to it; 0 if unknown.
        problem: What is wrong, a phrase; empty if nothing is.
        is_sound: Whether the content is correct, though some of it may be missing.
    """

    content: bytes
    used: int
    problem: str
    is_sound: bool = True


def lost_by(error: DamageError) -> str:
    """What is wrong with messages whose payload cannot be decompressed, a phrase."""
    if isinstance(error, OversizeError):
        return f"that decompress to too much ({DECOMPRESSED} is the limit)"
    return "whose compressed data is damaged"


def unpack(compression: str, data: memoryview, size: int) -> Unpacked:
    """Decompress as much as possible.

    Args:
        compression: Its name: ``none`` or empty, ``bz2``, ``lz4`` or ``zstd``; if damaged, it is
            inferred from the data.
        data: As stored; may be cut short.
        size: Expected size; no more is decompressed, and no more than data of this length can hold.
    """
    if compression in ("", "none"):
        content = bytes(data[:size])
        problem = "" if len(content) == size else "a chunk is cut short"
        return Unpacked(content, len(content), problem)
    most = most_held(len(data))
    limit = f", the limit ({DECOMPRESSED} sets another)" if size > most else ""
    size = min(size, most)
    start = bytes(data[:4])
    found = next((name for magic, name in _MAGIC.items() if start.startswith(magic)), compression)
    if found not in _MACHINES:
        return Unpacked(
            b"", 0, f"a chunk is compressed with {compression!r}, which is not supported"
        )
    gathered = io.BytesIO()  # pieces in a list would need the memory twice
    left = size + 1
    machine = _MACHINES[found]()
    step = len(data) if size <= _MAX_AT_ONCE else _UNPACKED_PIECE
    at = 0
    try:
        while at < len(data) and left > 0 and not machine.eof:
            for piece in machine.pieces(data[at : at + step], left):
                left -= gathered.write(piece)
            at += step
    except _DAMAGE:
        if step > _UNPACKED_PIECE:
            gathered, left = _by_pieces(found, data, size)
        problem = f"the {found} data of a chunk is damaged"
        gathered.truncate(size)
        return Unpacked(gathered.getvalue(), 0, problem, found == "bz2")
    if not machine.eof and left <= 0:
        problem = f"the {found} data of a chunk unpacks to more than {size} bytes{limit}"
        # bz2 verifies a block at its end, which was not reached here
        gathered.truncate(0 if found == "bz2" else size)
        return Unpacked(gathered.getvalue(), 0, problem, False)
    content = gathered.getvalue()
    if not machine.eof:
        return Unpacked(content, 0, f"the {found} data of a chunk is cut short")
    used = min(at, len(data)) - machine.unused
    if len(content) != size:
        problem = f"a chunk holds {len(content)} bytes instead of {size}"
        return Unpacked(content, used, problem, found == "bz2")
    return Unpacked(content, used, "")


def _by_pieces(compression: str, data: memoryview, size: int) -> tuple[io.BytesIO, int]:
    """What can be decompressed before the damage."""
    machine = _MACHINES[compression]()
    gathered = io.BytesIO()
    left = size
    try:
        for start, end in _small_pieces(len(data)):
            piece = b"".join(machine.pieces(data[start:end], left))
            left -= len(piece)
            if compression == "bz2" and left <= 0 and not machine.eof:
                break  # its last block was not verified
            gathered.write(piece)
            if left <= 0 or machine.eof:
                break
    except _DAMAGE:
        pass
    return gathered, left


def _small_pieces(length: int) -> Iterator[tuple[int, int]]:
    body = max(0, length - _CLOSE)
    for start in range(0, body, _SMALL_PIECE):
        yield start, min(start + _SMALL_PIECE, body)
    for start in range(body, length):
        yield start, start + 1


_DAMAGE = (OSError, RuntimeError, EOFError, ValueError, zstandard.ZstdError)


class _BlockMachine:
    """A decompressor of bz2 or lz4, which have the same methods."""

    def __init__(self, make: Callable[[], Decompressor]) -> None:
        self._machine = make()

    @property
    def eof(self) -> bool:
        return self._machine.eof

    @property
    def unused(self) -> int:
        return len(self._machine.unused_data or b"")

    def pieces(self, data: memoryview, size: int) -> Iterator[bytes]:
        # lz4 allocates the given maximum: the data cannot yield more than this at once.
        room = min(_LZ4_RATIO * len(data) + _LZ4_BLOCK, _PIECE)
        left: bytes | memoryview = data
        while size > 0:
            piece = self._machine.decompress(left, max_length=min(size, room))
            yield piece
            size -= len(piece)
            if not piece or self._machine.eof or self._machine.needs_input:
                break
            left, room = b"", _LZ4_BLOCK


class _Zstd:
    def __init__(self) -> None:
        self._machine = zstandard.ZstdDecompressor().decompressobj()
        self._not_fed = 0

    @property
    def eof(self) -> bool:
        return self._machine.eof

    @property
    def unused(self) -> int:
        return len(self._machine.unused_data) + self._not_fed

    def pieces(self, data: memoryview, size: int) -> Iterator[bytes]:
        # It has no limit: small pieces bound the output of each.
        for at in range(0, len(data), ZSTD_PIECE):
            if size < 0 or self._machine.eof:
                self._not_fed = len(data) - at
                break
            piece = self._machine.decompress(data[at : at + ZSTD_PIECE])
            yield piece
            size -= len(piece)


_Machine = _BlockMachine | _Zstd
_MACHINES: dict[str, Callable[[], _Machine]] = {
    "bz2": partial(_BlockMachine, BZ2Decompressor),
    "lz4": partial(_BlockMachine, lz4.frame.LZ4FrameDecompressor),
    "zstd": _Zstd,
}
