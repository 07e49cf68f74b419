"""Reads the records of a damaged file once, goes on after damage, and counts what is lost."""

from __future__ import annotations

import io
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Any, BinaryIO

from numpy.typing import NDArray

from mp4ds.bags.files import DECOMPRESSED, DamageError, OversizeError, open_source
from mp4ds.bags.protocols import BagReader, HoldBack
from mp4ds.bags.ros1 import Fields
from mp4ds.errors import SourceError
from mp4ds.records import MAX_LOSSES, MAX_LOST_TOPICS, Excerpt, Loss, Message, Record, more_places

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
                problem = f"cannot be read: {error.strerror or error}"
                raise SourceError(self._path, problem) from None
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

    def __enter__(self) -> Window:
        return self

    def __exit__(self, *_: object) -> None:
        self._source.close()


# ---------------------------------------------------------------- scan

MAX_UNPROVEN = 64 * 2**20
"""Maximum size of a record accepted although no other record follows it."""


Lose = Callable[[int, int, str], None]
"""Called with bytes that are skipped: their offset and size, and what is wrong, a phrase."""


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


class Scan(ABC):
    """The records of a file, or of a chunk; its subclass knows how a format frames them.

    Args:
        window: What to read.
        lose: Called with what is skipped.

    Attributes:
        lookahead: Number of bytes that suffice to recognise a record.
        outer: Kinds of records that are outside chunks.
    """

    lookahead: int
    outer: Collection[int]

    def __init__(self, window: Window, lose: Lose = lambda *_: None) -> None:
        self._window = window
        self._lose = lose

    @abstractmethod
    def frame(self, view: memoryview) -> RecordFrame | None:
        """The record at the start of these bytes, if they look like one."""

    @abstractmethod
    def find(
        self, view: memoryview, end: int, ahead: int = 0, kinds: Collection[int] | None = None
    ) -> int | None:
        """The start of the first certain record.

        Args:
            view: The bytes to search.
            end: Byte before which it must begin.
            ahead: Bytes from the reader to the view.
            kinds: Only records of these kinds; None for all.
        """

    def here(self) -> RecordFrame | None:
        """The next record, if there is one right here."""
        return self.frame(self._window.peek(self.lookahead))

    def next(self) -> RecordFrame | None:
        """The next record, without consuming it; None at the end."""
        while self._window.peek(1):
            if frame := self.here():
                return frame
            self.resync(self._window.offset, "no valid record here")
        return None

    def body(self, frame: RecordFrame) -> bytes | None:
        """Consume a record. None if it is damaged; the scan has then advanced past it."""
        if not self.is_proven(frame):
            self.resync(self._window.offset, self.cut_or_damaged(frame))
            return None
        whole = self._window.peek(frame.size + self.lookahead)
        following = whole[frame.size :]
        if following and not self.frame(following):
            size = frame.size - frame.head
            if self.find(whole[frame.head :], size, frame.head) is not None:
                self.resync(self._window.offset, "a record has a wrong length")
                return None
        self._window.skip(frame.size)
        return bytes(whole[frame.head : frame.size])

    def is_proven(self, frame: RecordFrame) -> bool:
        """Whether a record is complete and, if it is large, followed by another one."""
        is_cut = frame.size > self._window.size - self._window.offset
        return not is_cut and (frame.size <= MAX_UNPROVEN or self.is_followed(frame.size))

    def is_followed(self, size: int) -> bool:
        """Whether a record, or the end, follows after that many bytes."""
        ahead = self._window.look(size, self.lookahead)
        return not ahead or self.frame(memoryview(ahead)) is not None

    def cut_or_damaged(self, frame: RecordFrame) -> str:
        """What is wrong with an unproven record, in words."""
        if frame.size > self._window.size - self._window.offset:
            return "the file ends within a record"
        return "a record has an impossible length"

    def resync(
        self, start: int, problem: str, *, passed: int = 1, kinds: Collection[int] | None = None
    ) -> None:
        """Advance to the next certain record.

        Args:
            start: Where the damage begins.
            problem: What is wrong, a phrase.
            passed: Bytes ahead of the reader in which no record begins, as is already known.
            kinds: Stop only at a record of these kinds; None for all.
        """
        window, most = self._window, BLOCK + self.lookahead
        window.skip(passed)
        found = None
        while found is None and (view := window.peek(most)):
            end = BLOCK if len(view) == most else len(view)
            found = self.find(view, end, kinds=kinds)
            window.skip(end if found is None else found)
        if window.offset > start:
            self._lose(start, window.offset - start, problem)


# ---------------------------------------------------------------- losses


@dataclass(eq=False)
class Draft:
    """A loss that is still being extended. See `Loss`."""

    offset: int | None
    size: int | None
    problem: str
    messages: int | None = None
    topics: dict[str, None] = field(default_factory=dict)
    start: int | None = None
    end: int | None = None

    @property
    def stop(self) -> int | None:
        """Byte after it, if its place is known."""
        return None if self.offset is None or self.size is None else self.offset + self.size

    def add(self, messages: int, topics: Iterable[str]) -> None:
        """Count messages that were lost."""
        self.messages = (self.messages or 0) + messages
        self.topics.update(dict.fromkeys(topics))

    def finished(self, file: str) -> Loss:
        """The loss."""
        topics = list(self.topics)
        if len(topics) > MAX_LOST_TOPICS:
            more = len(topics) - MAX_LOST_TOPICS + 1
            topics = [*topics[: MAX_LOST_TOPICS - 1], f"... and {more} more"]
        return Loss(file, **{**vars(self), "topics": tuple(topics)})


class LossLog:
    """The losses of one file, in the order found.

    Args:
        file: The file's name.
    """

    def __init__(self, file: str) -> None:
        self._file = file
        self._drafts: list[Draft] = []
        self._more = Draft(None, 0, "")  # the sum of all further ones
        self._number_more = 0
        self._kinds: dict[Hashable, Draft] = {}
        self._last_time: int | None = None
        self._open_ended: list[Draft] = []

    def gave(self, time: int) -> None:
        """Record that a message with a log time, ns, was read."""
        self._last_time = time
        if self._open_ended:
            for draft in self._open_ended:
                draft.end = time
            self._open_ended.clear()

    def lost(
        self, offset: int | None, size: int | None, problem: str, *, join: bool = True
    ) -> Draft:
        """Record bytes that could not be read; contiguous losses are joined.

        Returns:
            The loss they became part of, to be completed.
        """
        last = self._drafts[-1] if self._drafts and not self._number_more else None
        if join and last and offset is not None and last.stop == offset:
            last.size = (last.size or 0) + (size or 0)
            return last
        draft = Draft(offset, size, problem, start=self._last_time)
        if len(self._drafts) < MAX_LOSSES - 1:
            self._drafts.append(draft)
            self._open_ended.append(draft)
            return draft
        return self._one_more(draft)

    def lost_of_kind(self, kind: Hashable, offset: int | None, problem: str) -> Draft:
        """Like `lost`, for something found repeatedly that is one loss.

        Returns:
            The loss of that kind, without a size, since it may be scattered.
        """
        if kind not in self._kinds:
            if len(self._kinds) >= MAX_LOSSES:
                return self._one_more(Draft(None, None, problem))
            self._kinds[kind] = self.lost(offset, None, problem, join=False)
        return self._kinds[kind]

    def _one_more(self, draft: Draft) -> Draft:
        self._number_more += 1
        self._more.problem = more_places(self._number_more)
        self._more.size = (self._more.size or 0) + (draft.size or 0)
        return self._more

    def finish(self, messages: int | None = None) -> list[Loss]:
        """The losses.

        Args:
            messages: How many are lost in total, if known. The largest loss without a count then
                gets the remainder.
        """
        drafts = [*self._drafts, *([self._more] if self._number_more else [])]
        if messages and not drafts:
            drafts = [Draft(None, None, "the file declares more messages than it holds", messages)]
        unknown = [draft for draft in drafts if draft.messages is None]
        if messages is not None and unknown:
            known = sum(draft.messages or 0 for draft in drafts)
            unknown.sort(key=lambda draft: draft.size or 0, reverse=True)
            unknown[0].messages = max(0, messages - known)
            for draft in unknown[1:]:
                draft.messages = 0
        return [draft.finished(self._file) for draft in drafts]


# ---------------------------------------------------------------- tally


class Tally(LossLog):
    """The losses of a file, by the messages read from each section of it, and those indexes list.

    A section is usually a chunk. Messages of a chunk with doubtful content are held until its index
    is read, and only those it lists are returned: damaged data may decompress to what only looks
    like messages.

    Args:
        file: The file's name.
        topic_of: The topic of a channel, None if unknown.

    Attributes:
        held: The messages that are held, and their channels.
        losses: What was skipped of the section.
        is_verified: Whether the section is certainly complete: an index that says otherwise is
            wrong.
    """

    _expected: Counter[int] | None = None
    _index_is_whole = False

    def __init__(self, file: str, topic_of: Callable[[int], str | None]) -> None:
        super().__init__(file)
        self._topic_of = topic_of
        self.held: list[tuple[int, Message]] = []
        self.open(None, None)

    def open(
        self,
        expected: Mapping[int, int] | None,
        end: int | None,
        span: tuple[int, int] | None = None,
    ) -> None:
        """Begin a new section, once the previous one is settled.

        Args:
            expected: Messages by channel from an index at the end of the file, if any.
            end: Byte where it should end and its own index should begin.
            span: Earliest and latest possible log time of its messages, ns, if known.
        """
        self.close()
        self._expected = None if expected is None else Counter(expected)
        self._end, self._span = end, span
        self._read: Counter[int] = Counter()
        self._strays: Counter[int] = Counter()
        self._index_is_whole = False
        self._listed: Counter[int] = Counter()
        self._listed_times: Counter[tuple[int, int]] = Counter()  # only while messages are held
        self.is_verified = False
        self.losses: list[Draft] = []

    def extend(self, expected: Mapping[int, int] | None) -> None:
        """Another section begins within what is lost, and cannot be separated from this one."""
        if expected is None or self._expected is None:
            self._expected = None
        else:
            self._expected.update(expected)

    def take(
        self, channel: int, message: Message, *, is_doubtful: bool = False
    ) -> Sequence[Message]:
        """Count a message that was read, and return it; hold one that may not be one."""
        if is_doubtful:
            self.held.append((channel, message))
            return ()
        self.gave(message.log_time)
        self._read[channel] += 1
        return (message,)

    def settle(self) -> list[Message]:
        """Decide which of the held messages to return."""
        held, self.held = self.held, []
        left, self._listed_times = self._listed_times, Counter()
        first, last = self._span or (0, inf)
        sound: list[Message] = []
        for channel, message in held:
            key = channel, message.log_time
            is_listed = left[key] > 0
            if is_listed if self._index_is_whole else first <= message.log_time <= last:
                left[key] -= 1
                sound += self.take(channel, message)
        return sound

    def stray(self, channel: int, offset: int, problem: str) -> None:
        """Count a message of an unknown channel, separately from lost ones."""
        self.lost_of_kind(problem, offset, problem).add(1, ())
        self._strays[channel] += 1
        self._read[channel] += 1

    def skipped(self, offset: int, size: int | None, problem: str) -> None:
        """Record skipped bytes of the section."""
        draft = self.lost(offset, size, problem)
        if draft not in self.losses:
            self.losses.append(draft)
        if size is None or self._end is None or offset + size > self._end:
            self._index_is_whole = False  # part of it may be lost, and that of others may follow
            self._end = None

    def listed(self, channel: int, times: NDArray[Any], offset: int) -> None:
        """Add the messages that an index at a byte lists, by their log times, ns."""
        self._index_is_whole |= offset == self._end
        self._listed[channel] += len(times)
        if self.held:
            self._listed_times.update((channel, time) for time in times.tolist())

    def close(self) -> None:
        """End the section, and record what is lost of it."""
        indexes = [self._expected, self._listed if self._index_is_whole else None]
        found = [self._missing(index) for index in indexes if index is not None]
        if not found:
            return
        total, missing = min(found, key=lambda one: one[0])
        topics = [topic for key in missing if (topic := self._topic_of(key))]
        losses = sorted(self.losses, key=lambda draft: draft.size or 0, reverse=True)
        if losses:
            losses[0].add(total, topics)
            for draft in losses[1:]:
                draft.add(0, ())
        elif total:
            problem = "an index does not match the messages"
            self.lost(None, None, problem).add(0 if self.is_verified else total, topics)
        self.losses = []

    def _missing(self, expected: Counter[int]) -> tuple[int, Counter[int]]:
        """Number of messages that an index lists and were not read, in total and by channel."""
        missing = expected - self._read
        # what was read as of an unknown channel, and is not listed, makes up for what is listed
        excess = (self._read - expected) & self._strays
        return max(0, missing.total() - excess.total()), missing


def lost_by(error: DamageError) -> str:
    """What is wrong with messages whose payload cannot be decompressed, a phrase."""
    if isinstance(error, OversizeError):
        return f"that decompress to too much ({DECOMPRESSED} is the limit)"
    return "whose compressed data is damaged"


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
        self._tally = tally = Tally(self.path.name, self._topic_of)
        self._found = 0  # valid records
        self._count: int | None = None  # messages that the file states
        self._earliest: int | None = None  # log time from here on; None if no message follows
        held = HoldBack()
        given = 0
        with Window.of_file(self.path) as window:
            self._window = window
            self._scan = self._scan_of(window, self._lose)
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
                if self._tally is not tally:
                    raise RuntimeError(f"{self.path} is salvaged once at a time")
            yield from filter(excerpt.has, held.release(None))
            self.position = window.offset
        if self._is_alone and not self._found and not self.channels:
            raise SourceError(self.path, f"holds no records of {self.kind}")
        self.losses = tally.finish(None if self._count is None else max(0, self._count - given))

    @abstractmethod
    def _scan_of(self, window: Window, lose: Lose) -> Scan:
        """The records in a window."""

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
            self._tally.lost(offset, size, problem).add(0, ())
        else:
            self._tally.skipped(offset, size, problem)

    def _peek_chunk(self, frame: RecordFrame) -> tuple[memoryview, bool]:
        """What there is of a chunk, and whether it is certainly all of it."""
        proven = self._scan.is_proven(frame)
        size = frame.size if proven else min(frame.size, MAX_UNPROVEN)
        return self._window.peek(size), proven

    def _inside(
        self, content: bytes | memoryview, problems: list[str]
    ) -> Iterator[tuple[RecordFrame, bytes]]:
        """The records of a decompressed chunk; what is wrong with it is added to `problems`."""
        scan = self._scan_of(
            Window(io.BytesIO(content), Path(), size=len(content)),
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
                kinds=scan.outer,
            )
            return
        if problems:
            self._lose(offset, window.offset - offset, problems[0])
        else:
            self._tally.is_verified = True
