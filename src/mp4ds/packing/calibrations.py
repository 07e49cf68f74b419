"""Calibrations on their way into the sidecars of the streams that they belong to."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from mp4ds.packing.report import TopicSummary
from mp4ds.pairing import INFO_WINDOW, StampPairing, choose_pairs, pair_camera_infos
from mp4ds.records import Channel, Message
from mp4ds.streams import CameraInfoWriter, Forms, Seen, StreamWriter, Unsuited
from mp4ds.wire import is_calibration, is_camera

_MAX_PENDING = 1000
"""Calibrations that wait for their stream; of a topic with more, all are kept verbatim."""


@dataclass
class _InfoChannel:
    """A calibration channel whose stream is there, or may come."""

    writer: CameraInfoWriter
    owner: StreamWriter | None = None
    pending: list[tuple[Message, int]] = field(default_factory=list)


def unpaired_infos(channels: Sequence[Channel], pairs: Mapping[int, int]) -> set[int]:
    """Ids of the calibration channels that stamps may pair with images."""
    if not any(map(is_camera, channels)):
        return set()
    return {channel.id for channel in filter(is_calibration, channels)} - set(pairs)


class Calibrations:
    """Hands calibrations to the streams of their images.

    Args:
        channels: The recording's, as far as they are packed.
        chosen: Pairs that the user names, ``IMAGE=INFO``.
        surveyed: Pairs that stamps told before, by id; None to look at the stamps here.
        topic_of: The summary of a channel's topic.
        keep: Stores what belongs to no stream.

    Raises:
        OptionError: A chosen pair cannot be.
    """

    def __init__(
        self,
        channels: Sequence[Channel],
        chosen: Sequence[str],
        surveyed: Mapping[int, int] | None = None,
        *,
        topic_of: Callable[[Channel], TopicSummary],
        keep: Callable[[Message], None],
    ) -> None:
        self._topic_of = topic_of
        self._keep = keep
        self._channels = {channel.id: channel for channel in channels}
        self._pairs = pair_camera_infos(channels, chosen=choose_pairs(chosen, channels))
        self._by_stamp = None
        if surveyed is not None:
            self._pairs.update(surveyed)
        elif unpaired_infos(channels, self._pairs):
            self._by_stamp = StampPairing()
        self._forms: dict[int, Forms] = {}
        self._infos: dict[int, _InfoChannel | None] = {}
        self._counts: Counter[tuple[object, ...]] = Counter()
        self._streams: dict[tuple[object, ...], StreamWriter] = {}

    def take(self, message: Message) -> None:
        """Take a calibration into its stream, or keep it if it belongs to none."""
        channel = message.channel
        # its place among those of all channels that cannot be told apart from its own
        ordinal = self._counts[channel.identity]
        self._counts[channel.identity] += 1
        if channel.id not in self._infos:
            self._infos[channel.id] = self._new(channel)
        state = self._infos[channel.id]
        if state is None:
            self._keep(message)
        elif state.owner is not None:
            self._add(state, message, ordinal)
        elif len(state.pending) < _MAX_PENDING:
            # a copy: a view would keep the reader's whole chunk in memory
            state.pending.append((replace(message, data=bytes(message.data)), ordinal))
            self._pair_by_stamp(message, state)
        else:
            self._give_up(channel.id, state)
            self._keep(message)

    def saw(self, channel: Channel, seen: Seen) -> None:
        """Take notice of an image's stamp, for calibrations that names leave unpaired."""
        if self._by_stamp is not None:
            size = seen.key.width, seen.key.height
            self._by_stamp.add(channel, seen.parts, size=size)

    def adopt(self, stream: StreamWriter) -> None:
        """Let a channel's first stream have the calibrations that waited for it."""
        self._streams.setdefault(stream.channel.identity, stream)
        self._settle()

    def finish(self) -> None:
        """Hand each stream its calibrations, and keep what waited for a stream in vain."""
        if self._by_stamp is not None:
            self._pairs.update(self._by_stamp.decide(self._pairs))
            self._settle()
        for info_id, state in list(self._infos.items()):
            if state is None:
                continue
            if state.owner is None:
                self._give_up(info_id, state)
            else:
                state.owner.camera_info = state.writer.to_model()

    def _new(self, channel: Channel) -> _InfoChannel | None:
        if channel.id not in self._pairs and self._by_stamp is None:
            return None
        return _InfoChannel(CameraInfoWriter(channel), self._owner_of(channel.id))

    def _owner_of(self, info_id: int) -> StreamWriter | None:
        image_id = self._pairs.get(info_id)
        if image_id is None:
            return None
        stream = self._streams.get(self._channels[image_id].identity)
        # a stream has the calibrations of one channel
        owned = any(state and state.owner is stream for state in self._infos.values())
        return None if owned else stream

    def _pair_by_stamp(self, message: Message, state: _InfoChannel) -> None:
        channel = message.channel
        if self._by_stamp is None or channel.id in self._pairs:
            return
        forms = self._forms.setdefault(channel.id, Forms(channel))
        try:
            self._by_stamp.add(channel, forms.split(message)[1])
        except Unsuited:
            return  # it is kept verbatim when it is taken or given up
        if len(state.pending) % INFO_WINDOW == 0:
            self._pairs.update(self._by_stamp.decide(self._pairs, final=False))
            self._settle()

    def _settle(self) -> None:
        """Give owners to the channels that have none yet, as far as they are known."""
        for info_id, state in self._infos.items():
            if state is None or state.owner is not None:
                continue
            state.owner = self._owner_of(info_id)
            if state.owner is not None:
                pending, state.pending = state.pending, []
                for message, ordinal in pending:
                    self._add(state, message, ordinal)

    def _add(self, state: _InfoChannel, message: Message, ordinal: int) -> None:
        topic = self._topic_of(message.channel)
        try:
            state.writer.accept(message, ordinal)
            topic.frames += 1
        except Unsuited as reason:
            topic.count_verbatim(str(reason), ordinal)
            self._keep(message)

    def _give_up(self, info_id: int, state: _InfoChannel) -> None:
        for message, _ in state.pending:
            self._keep(message)
        self._infos[info_id] = None
