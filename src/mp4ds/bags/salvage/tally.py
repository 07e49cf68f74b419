"""How many messages a damaged part of a file held: what its index lists, less what was read."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping

from mp4ds.bags.salvage.losses import Draft, LossLog
from mp4ds.records import Message

_MAX_TIMES = 10**6


class Tally:
    """Messages read of a stretch of a file, a chunk mostly, and those that an index lists.

    Messages of a chunk whose content is in doubt are held until its index was read: only
    those that it lists are given out, since what was unpacked of damaged data may look like
    messages and be none.

    Args:
        log: Where losses are put down.
        topic_of: The topic of a channel, None where it is not known.

    Attributes:
        is_doubtful: Whether messages are held.
    """

    def __init__(self, log: LossLog, topic_of: Callable[[int], str | None]) -> None:
        self._log = log
        self._topic_of = topic_of
        self._held: list[tuple[int, Message]] = []
        self._begin(None)

    def _begin(self, expected: Mapping[int, int] | None) -> None:
        self._expected = None if expected is None else Counter(expected)
        self._read: Counter[int] = Counter()
        self._times: Counter[tuple[int, int]] = Counter()
        self._missing: Counter[int] = Counter()
        self._strays: Counter[tuple[int, int]] = Counter()
        self._index_is_whole = False
        self._listed: list[tuple[int, Mapping[int, int]]] = []
        self._end: int | None = None
        self._span: tuple[int, int] | None = None
        self._is_counted = True
        self._is_verified = False
        self._losses: list[Draft] = []

    def open(
        self,
        expected: Mapping[int, int] | None,
        end: int,
        span: tuple[int, int] | None = None,
    ) -> None:
        """A new stretch begins, the one before being settled.

        Args:
            expected: Messages by channel that an index at the end of the file tells, if any.
            end: Byte where it should end, and its own index begin.
            span: Least and greatest log time that its messages can have, ns, if known.
        """
        self.close()
        self._begin(expected)
        self._end, self._span = end, span

    def extend(self, expected: Mapping[int, int] | None) -> None:
        """Another stretch begins within what is lost, and cannot be told from this one."""
        if expected is None or self._expected is None:
            self._expected = None
        else:
            self._expected.update(expected)

    def verified(self) -> None:
        """All of the stretch is there beyond doubt: an index that says otherwise is wrong."""
        self._is_verified = True

    @property
    def is_doubtful(self) -> bool:
        """Whether messages are held."""
        return bool(self._held)

    def gave(self, channel: int, time: int) -> None:
        """A message was read, with its log time in ns."""
        self._log.gave(time)
        self._met(channel, time)

    def hold(self, channel: int, message: Message) -> None:
        """Keep a message that may be none."""
        self._held.append((channel, message))

    def settle(self) -> list[Message]:
        """The messages held that are to be given out."""
        if not self._held:
            return []
        held, self._held = self._held, []
        listed, self._listed = self._listed, []
        if self._index_is_whole:
            left: Counter[tuple[int, int]] = Counter()
            for channel, times in listed:
                for time, count in times.items():
                    left[channel, time] += count
            sound = []
            for channel, message in held:
                if left[channel, message.log_time] > 0:
                    left[channel, message.log_time] -= 1
                    sound.append((channel, message))
        else:
            sound = [item for item in held if self._is_possible(item[1].log_time)]
        for channel, message in sound:
            self.gave(channel, message.log_time)
        for channel, times in listed:
            self._compare(channel, times)
        return [message for _, message in sound]

    def _is_possible(self, time: int) -> bool:
        return self._span is None or self._span[0] <= time <= self._span[1]

    @property
    def has_losses(self) -> bool:
        """Whether something of the stretch was passed over."""
        return bool(self._losses)

    def stray(self, channel: int, time: int) -> None:
        """A message is there of a channel that is not known: told apart from what is lost."""
        if len(self._strays) < _MAX_TIMES:
            self._strays[channel, time] += 1
        self._met(channel, time)

    def _met(self, channel: int, time: int) -> None:
        self._read[channel] += 1
        if len(self._times) < _MAX_TIMES:
            self._times[channel, time] += 1
        else:
            self._is_counted = False

    def lost(self, offset: int, size: int | None, problem: str) -> Draft:
        """Bytes were passed over."""
        draft = self._log.lost(offset, size, problem)
        if all(draft is not known for known in self._losses):
            self._losses.append(draft)
        if size is None or self._end is None or offset + size > self._end:
            self._index_is_whole = False  # some of it may be lost, and that of others follow
            self._end = None
        return draft

    def count_matches(self, channel: int, count: int, offset: int) -> bool:
        """Whether an index at a byte, with so many messages of a channel, tells nothing new."""
        self._index_is_whole |= offset == self._end
        return not self._losses and not self._held and count == self._read[channel]

    def listed(self, channel: int, times: Mapping[int, int]) -> None:
        """An index lists messages: so many of each log time, ns."""
        if self._held:
            self._listed.append((channel, times))
        else:
            self._compare(channel, times)

    def _compare(self, channel: int, times: Mapping[int, int]) -> None:
        for time, count in times.items():
            self._strays.pop((channel, time), None)  # no other one is missing for it
            missing = count - self._times[channel, time]
            if missing > 0:
                self._missing[channel] += missing

    def close(self) -> None:
        """The stretch has ended: tell what is lost of it."""
        found = min((self._by_counts(), self._by_times()), key=_total)
        if found is None:
            return
        total, missing = found
        topics = [topic for key in missing if (topic := self._topic_of(key))]
        losses = sorted(self._losses, key=lambda draft: draft.size or 0, reverse=True)
        if losses:
            losses[0].add(total, topics)
            for draft in losses[1:]:
                draft.add(0, ())
        elif total:
            problem = "an index lists other messages than there are"
            self._log.lost(None, None, problem).add(0 if self._is_verified else total, topics)
        self._losses = []

    def _by_counts(self) -> tuple[int, Counter[int]] | None:
        """How many messages are lost, in all and by channel, by the index at the end."""
        if self._expected is None:
            return None
        missing = self._expected - self._read
        strays: Counter[int] = Counter()
        for (channel, _), count in self._strays.items():
            strays[channel] += count
        # Those that are not listed stand for others that are.
        excess = (self._read - self._expected) & strays
        return max(0, missing.total() - excess.total()), missing

    def _by_times(self) -> tuple[int, Counter[int]] | None:
        """The same by the index of the stretch itself."""
        if not self._index_is_whole or not self._is_counted:
            return None
        return max(0, self._missing.total() - self._strays.total()), self._missing


def _total(found: tuple[int, Counter[int]] | None) -> float:
    return float("inf") if found is None else found[0]
