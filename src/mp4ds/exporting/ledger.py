"""The account of an export: each message is held, or left out for a reason."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from mp4ds.dataset import Dataset
from mp4ds.records import Channel
from mp4ds.wire import is_camera

AS_RECORDED = "stored as recorded in messages.mcap, not as video"
NOT_CHOSEN = "not chosen"


class Ledger:
    """Counts the messages of a dataset, by topic.

    Attributes:
        held: Messages that the export holds, by topic.
        left_out: Topic -> reason -> messages.
    """

    def __init__(self, dataset: Dataset) -> None:
        self._totals: Counter[str] = Counter()
        times = dataset.times()
        self._channels: dict[str, Channel] = {}
        for channel in dataset.channels:
            self._channels[channel.topic] = channel
            self._totals[channel.topic] += len(times.get(channel.id, ()))
        self.held: dict[str, int] = {}
        self.left_out: dict[str, dict[str, int]] = {}

    def total(self, topic: str) -> int:
        """Messages of a topic that the dataset has."""
        return self._totals[topic]

    def hold(self, topic: str, count: int = 1) -> None:
        """The export holds so many messages more."""
        self.held[topic] = self.held.get(topic, 0) + count

    def leave(self, topic: str, reason: str, count: int) -> None:
        """So many messages more are left out."""
        if count:
            reasons = self.left_out.setdefault(topic, {})
            reasons[reason] = reasons.get(reason, 0) + count

    def settle(self, chosen: Callable[[str], bool], name: str) -> None:
        """Give the messages that nobody counted their reason.

        Args:
            chosen: Whether a topic was asked for.
            name: Of the format.
        """
        for topic, total in self._totals.items():
            told = self.held.get(topic, 0) + sum(self.left_out.get(topic, {}).values())
            channel = self._channels[topic]
            if not chosen(topic):
                reason = NOT_CHOSEN
            elif is_camera(channel):
                reason = AS_RECORDED
            else:
                reason = f"{name} has no place for {channel.type_name or 'such messages'}"
            self.leave(topic, reason, total - told)
