"""Reads the records of a damaged file once, and goes on after damage."""

from __future__ import annotations

import io
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mp4ds.bags.files import open_source
from mp4ds.bags.protocols import BagReader, HoldBack
from mp4ds.bags.ros1 import Fields
from mp4ds.bags.salvage.losses import LossLog, Tally
from mp4ds.errors import SourceError
from mp4ds.records import Excerpt, Loss, Message, Record

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
    def of_content(cls, content: bytes) -> Window:
        """A window over the decompressed content of a chunk."""
        window = cls(io.BytesIO(), Path(), size=len(content))
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


# ---------------------------------------------------------------- the reader


class FileSalvage(BagReader):
    """Reads what is readable of a file, record by record, and says what is not.

    It never fails because of damage. For an intact recording, it gives the same as the usual
    reader. Messages come in log-time order if the index at the end of the file is readable, and
    they are not too far out of it; otherwise in file order. Some doubtful messages are included: if
    a checksum shows that a chunk is damaged but not where, the loss says so.

    Unlike other readers, it reads once at a time: its state is that of the last `records`.

    Args:
        path: The file.
        is_alone: Whether it is an error, not just a loss, if nothing can be read.

    Attributes:
        magic: The first bytes of such a file.
        kind: What such a file is, in words.
    """

    magic: bytes
    kind: str
    position = 0
    losses: Sequence[Loss] = ()

    _framing: Framing
    _index_offset: int | None = None  # where the final index begins: no message is lost from there
    _is_timed = False  # whether the file's index tells how long messages must wait for earlier ones

    def __init__(self, path: Path, *, is_alone: bool = True) -> None:
        self.path = path
        self.files = [path]
        self._is_alone = is_alone

    def _records(self, excerpt: Excerpt) -> Iterator[Record]:
        """Everything readable, of which all but the excerpt is dropped.

        Raises:
            RuntimeError: `records` was called again before this one was exhausted.
        """
        self.losses = []
        self._log = log = LossLog(self.path.name)
        self._tally = Tally(log, self._topic_of)
        self._found = 0  # valid records
        self._count: int | None = None  # messages that the file states
        self._earliest: int | None = None  # log time from here on; None if no message follows
        held = HoldBack()
        given = 0
        with Window.of_file(self.path) as window:
            self._window = window
            self._scan = Scan(window, self._framing, self._lose)
            for record in self._scanned():
                self.position = window.offset
                given += isinstance(record, Message)
                if record is None:
                    if self._is_timed:
                        yield from filter(excerpt.has, held.release(self._earliest))
                elif self._is_timed and isinstance(record, Message):
                    held.add(record)
                elif excerpt.has(record):
                    yield record
                if self._log is not log:
                    raise RuntimeError(f"{self.path} is salvaged once at a time")
            yield from filter(excerpt.has, held.release(None))
            self.position = window.offset
        if self._is_alone and not self._found and not self.channels:
            raise SourceError(self.path, f"holds no records of {self.kind}")
        self.losses = log.finish(None if self._count is None else max(0, self._count - given))

    @abstractmethod
    def _scanned(self) -> Iterator[Record | None]:
        """All records in the order of the file; None where `_earliest` may be later than before."""

    def _topic_of(self, channel_id: int) -> str | None:
        channel = self._channels.get(channel_id)
        return channel.topic if channel else None

    def _begins(self) -> bool:
        """Whether the file begins with its magic bytes, which are consumed."""
        if bytes(self._window.peek(len(self.magic))) == self.magic:
            self._window.skip(len(self.magic))
            return True
        self._scan.resync(0, f"the first bytes are not those of {self.kind}", passed=0)
        return False

    def _lose(self, offset: int, size: int, problem: str) -> None:
        if self._index_offset is not None and offset >= self._index_offset:
            self._log.lost(offset, size, problem).add(0, ())
        else:
            self._tally.lost(offset, size, problem)

    def _peek_chunk(self, frame: RecordFrame) -> tuple[memoryview, bool]:
        """What there is of a chunk, and whether it is certainly all of it."""
        proven = self._scan.is_proven(frame)
        size = frame.size if proven else min(frame.size, MAX_UNPROVEN)
        return self._window.peek(size), proven

    def _inside(
        self, content: bytes | memoryview, problems: list[str]
    ) -> Iterator[tuple[RecordFrame, bytes]]:
        """The records of a decompressed chunk; what is wrong with it is added to `problems`."""
        scan = Scan(
            Window.of_content(bytes(content)),
            self._framing,
            lambda _offset, _size, problem: problems.append(f"in a chunk, {problem}"),
        )
        while frame := scan.next():
            body = scan.body(frame)
            if body is not None:
                yield frame, body

    def _leave_chunk(
        self, frame: RecordFrame, used: int, problems: Sequence[str], *, proven: bool, whole: bool
    ) -> None:
        """Advance past a chunk, and record what is lost of it.

        Args:
            frame: The chunk.
            used: Bytes of it up to the end of its content, as far as known.
            problems: What is wrong with it.
            proven: Whether it is certainly all there.
            whole: Whether all of its content could be decompressed.
        """
        window, scan = self._window, self._scan
        offset = window.offset
        if whole and used != frame.size and scan.is_followed(used):
            window.skip(used)  # the content is complete: the record's length is wrong
        elif proven and (whole or scan.is_followed(frame.size)):
            window.skip(frame.size)
        else:
            scan.resync(
                offset if problems else offset + used,
                problems[0] if problems else scan.cut_or_damaged(frame),
                passed=used,
                kinds=self._framing.outer,
            )
            return
        if problems:
            self._lose(offset, window.offset - offset, problems[0])
        else:
            self._tally.is_verified = True
