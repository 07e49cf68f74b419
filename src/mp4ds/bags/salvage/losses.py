"""What could not be read, put together while a recording is read."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, field

from mp4ds.records import MAX_LOSSES, MAX_LOST_TOPICS, Loss

_MORE = " more places that could not be read"


@dataclass(eq=False)
class Draft:
    """A loss that is not complete. See `Loss`."""

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
        return Loss(
            file,
            self.offset,
            self.size,
            self.problem,
            self.messages,
            tuple(topics),
            self.start,
            self.end,
        )


class LossLog:
    """The losses of one file, in the order in which they were found.

    Args:
        file: The file's name.
    """

    def __init__(self, file: str) -> None:
        self._file = file
        self._drafts: list[Draft] = []
        self._more: list[Draft] = []  # what all further ones were summed up in: none or one
        self._number_more = 0
        self._kinds: dict[Hashable, Draft] = {}
        self._last_time: int | None = None
        self._open_ended: list[Draft] = []

    def gave(self, time: int) -> None:
        """A message of a log time, ns, was read."""
        self._last_time = time
        if self._open_ended:
            for draft in self._open_ended:
                draft.end = time
            self._open_ended.clear()

    def lost(
        self, offset: int | None, size: int | None, problem: str, *, join: bool = True
    ) -> Draft:
        """Bytes that could not be read; joined to the loss before where they follow it.

        Returns:
            The loss that they became part of, to be completed.
        """
        last = self._drafts[-1] if self._drafts and not self._more else None
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
        """As `lost`, for what is found again and again and is one loss.

        Returns:
            The loss of that kind, without a size: it may be scattered.
        """
        if kind not in self._kinds:
            if len(self._kinds) >= MAX_LOSSES:
                return self._one_more(Draft(None, None, problem))
            self._kinds[kind] = self.lost(offset, None, problem, join=False)
        return self._kinds[kind]

    def _one_more(self, draft: Draft) -> Draft:
        self._number_more += 1
        if not self._more:
            self._more.append(Draft(None, 0, ""))
        more = self._more[0]
        more.problem = f"{self._number_more}{_MORE}"
        more.size = (more.size or 0) + (draft.size or 0)
        return more

    def finish(self, messages: int | None = None) -> list[Loss]:
        """The losses.

        Args:
            messages: How many are lost in all, where something tells. The largest loss that
                does not know its number then has what the others leave.
        """
        drafts = [*self._drafts, *self._more]
        if messages and not drafts:
            drafts = [Draft(None, None, "the file counts more messages than it holds", messages)]
        unknown = [draft for draft in drafts if draft.messages is None]
        if messages is not None and unknown:
            known = sum(draft.messages or 0 for draft in drafts)
            unknown.sort(key=lambda draft: draft.size or 0, reverse=True)
            unknown[0].messages = max(0, messages - known)
            for draft in unknown[1:]:
                draft.messages = 0
        return [draft.finished(self._file) for draft in drafts]


def bounded(losses: Sequence[Loss]) -> list[Loss]:
    """Losses of several files, of which the last sums up what is too much."""
    if len(losses) <= MAX_LOSSES:
        return list(losses)
    rest = losses[MAX_LOSSES - 1 :]
    number = sum(_places(loss) for loss in rest)
    counts = [loss.messages for loss in rest if loss.messages is not None]
    more = Loss(
        rest[0].file,
        None,
        sum(loss.size or 0 for loss in rest),
        f"{number}{_MORE}",
        sum(counts) if len(counts) == len(rest) else None,
    )
    return [*losses[: MAX_LOSSES - 1], more]


def _places(loss: Loss) -> int:
    number = loss.problem.removesuffix(_MORE)
    return int(number) if loss.problem.endswith(_MORE) and number.isdecimal() else 1
