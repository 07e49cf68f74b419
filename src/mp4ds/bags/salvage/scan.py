"""Records one after the other, and after damage the next one that can be told to be one."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

from mp4ds.bags.salvage.window import BLOCK, Window

MAX_UNPROVEN = 64 * 2**20
"""Bytes of a record that is taken for one though no other record follows it."""

_KindT = TypeVar("_KindT")


@dataclass(frozen=True, slots=True)
class Frame(Generic[_KindT]):
    """Where a record begins and ends, by its first bytes.

    Attributes:
        kind: What its format calls it.
        head: Bytes before its body.
        size: Bytes of all of it.
        fields: What its head holds.
    """

    kind: _KindT
    head: int
    size: int
    fields: dict[bytes, bytes] = field(default_factory=dict)


class Framing(Protocol):
    """How a format frames its records.

    Attributes:
        lookahead: So many bytes are enough to tell a record.
        outer: Kinds of records that stand in no chunk.
    """

    lookahead: int
    outer: Collection[int]

    def frame(self, view: memoryview) -> Frame[int] | None:
        """The record that these bytes begin with, if they look like one."""
        ...

    def find(
        self,
        view: memoryview,
        end: int,
        is_followed: Callable[[int], bool],
        kinds: Collection[int] | None = None,
    ) -> int | None:
        """Where the first record begins that shows beyond doubt.

        Args:
            view: Where to look.
            end: Byte before which it must begin.
            is_followed: Whether a record, or the end, stands at a byte of the view or past it.
            kinds: Only records of these kinds; None for all.
        """
        ...


class Scan:
    """The records of a file, or of a chunk.

    Args:
        window: What to read.
        framing: How its records are framed.
        lose: Is told of bytes that were passed over: offset, size, a phrase.
    """

    def __init__(
        self, window: Window, framing: Framing, lose: Callable[[int, int, str], None]
    ) -> None:
        self._window = window
        self._framing = framing
        self._lose = lose

    def next(self) -> Frame[int] | None:
        """The next record, not yet taken; None at the end."""
        while True:
            view = self._window.peek(self._framing.lookahead)
            if not view:
                return None
            frame = self._framing.frame(view)
            if frame:
                return frame
            self.resync(self._window.offset, "what stands there is no record")

    def body(self, frame: Frame[int]) -> bytes | None:
        """Take a record. None where it is damaged; the scan then has gone on."""
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

    def is_cut(self, frame: Frame[int]) -> bool:
        """Whether the file ends before the record does."""
        left = self._window.left
        if left is None:
            left = len(self._window.peek(min(frame.size, MAX_UNPROVEN)))
            return left < min(frame.size, MAX_UNPROVEN)
        return left < frame.size

    def is_proven(self, frame: Frame[int]) -> bool:
        """Whether a record is all there and, if it is large, another one follows it."""
        if self.is_cut(frame):
            return False
        return frame.size <= MAX_UNPROVEN or self.is_followed(frame.size)

    def is_followed(self, size: int) -> bool:
        """Whether a record, or the end, stands after so many bytes."""
        ahead = self._window.look(size, self._framing.lookahead)
        if ahead is None:
            return size <= 2**30  # a stream: so much is believed
        return not ahead or self._framing.frame(memoryview(ahead)) is not None

    def _follows(self, start: int) -> Callable[[int], bool]:
        return lambda distance: self.is_followed(start + distance)

    def cut_or_damaged(self, frame: Frame[int]) -> str:
        """What is wrong with a record that is not proven."""
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
        """Go on to the next record that shows beyond doubt.

        Args:
            start: Where the damage begins.
            problem: What is wrong, a phrase.
            passed: Bytes before the reader of which it is known that no record begins there.
            kinds: Only to a record of these kinds; None for all.
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
