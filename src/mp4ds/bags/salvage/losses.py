"""The losses of a file, counted against what its indexes list."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass, field
from math import inf
from typing import Any

from numpy.typing import NDArray

from mp4ds.bags.files import DECOMPRESSED, DamageError, OversizeError
from mp4ds.records import (
    MAX_LOSSES,
    MAX_LOST_TOPICS,
    Loss,
    Message,
    more_places,
)


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
        if (
            join
            and last is not None
            and offset is not None
            and last.offset is not None
            and last.size is not None
            and last.offset + last.size == offset
        ):
            last.size += size or 0
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


class Tally:
    """Messages read from a section of a file, usually a chunk, and those that an index lists.

    Messages of a chunk with doubtful content are held until its index is read, and only those it
    lists are returned: damaged data may decompress to something that only looks like messages.

    Args:
        log: Where losses are recorded.
        topic_of: The topic of a channel, None if unknown.

    Attributes:
        held: The messages that are held, and their channels.
        losses: What was skipped of the section.
        is_verified: Whether the section is certainly complete: an index that says otherwise is
            wrong.
    """

    def __init__(self, log: LossLog, topic_of: Callable[[int], str | None]) -> None:
        self._log = log
        self._topic_of = topic_of
        self.held: list[tuple[int, Message]] = []
        self._begin(None)

    def _begin(self, expected: Mapping[int, int] | None) -> None:
        self._expected = None if expected is None else Counter(expected)
        self._read: Counter[int] = Counter()
        self._strays: Counter[int] = Counter()
        self._index_is_whole = False
        self._listed: Counter[int] = Counter()
        self._listed_times: Counter[tuple[int, int]] = Counter()  # only while messages are held
        self._end: int | None = None
        self._span: tuple[int, int] | None = None
        self.is_verified = False
        self.losses: list[Draft] = []

    def open(
        self,
        expected: Mapping[int, int] | None,
        end: int,
        span: tuple[int, int] | None = None,
    ) -> None:
        """Begin a new section, once the previous one is settled.

        Args:
            expected: Messages by channel from an index at the end of the file, if any.
            end: Byte where it should end and its own index should begin.
            span: Earliest and latest possible log time of its messages, ns, if known.
        """
        self.close()
        self._begin(expected)
        self._end, self._span = end, span

    def extend(self, expected: Mapping[int, int] | None) -> None:
        """Another section begins within what is lost, and cannot be separated from this one."""
        if expected is None or self._expected is None:
            self._expected = None
        else:
            self._expected.update(expected)

    def gave(self, channel: int, time: int) -> None:
        """Count a message that was read, with its log time in ns."""
        self._log.gave(time)
        self._read[channel] += 1

    def hold(self, channel: int, message: Message) -> None:
        """Hold a message that may not be one."""
        self.held.append((channel, message))

    def settle(self) -> list[Message]:
        """Decide which of the held messages to return."""
        held, self.held = self.held, []
        left, self._listed_times = self._listed_times, Counter()
        first, last = self._span or (0, inf)
        sound = []
        for channel, message in held:
            key = channel, message.log_time
            is_listed = left[key] > 0
            if is_listed if self._index_is_whole else first <= message.log_time <= last:
                left[key] -= 1
                sound.append(message)
                self.gave(channel, message.log_time)
        return sound

    def stray(self, channel: int) -> None:
        """Count a message of an unknown channel, separately from lost ones."""
        self._strays[channel] += 1
        self._read[channel] += 1

    def lost(self, offset: int, size: int | None, problem: str) -> Draft:
        """Record skipped bytes."""
        draft = self._log.lost(offset, size, problem)
        if all(draft is not known for known in self.losses):
            self.losses.append(draft)
        if size is None or self._end is None or offset + size > self._end:
            self._index_is_whole = False  # part of it may be lost, and that of others may follow
            self._end = None
        return draft

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
            self._log.lost(None, None, problem).add(0 if self.is_verified else total, topics)
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
