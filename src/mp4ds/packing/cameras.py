"""Camera messages on their way into streams; what no stream takes is handed back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from mp4ds.bags import BagReader
from mp4ds.engine import Workers
from mp4ds.packing.report import TopicSummary
from mp4ds.plan import FileNames, Selection, pair_camera_infos
from mp4ds.records import Channel, Message
from mp4ds.sidecar import StreamSidecar
from mp4ds.streams import CameraInfoWriter, StreamKey, StreamSettings, StreamWriter, Unsuited
from mp4ds.streams.writer import refuse_unsuited
from mp4ds.wire import WireError, wire_for

MAX_STREAMS_PER_CHANNEL = 16
"""A topic that changes its geometry more often than this is not split any further."""

_MAX_PENDING_INFOS = 1000


@dataclass
class _ImageChannel:
    """An image channel being packed."""

    count: int = 0
    streams: dict[StreamKey, StreamWriter] = field(default_factory=dict)
    refused: dict[StreamKey, str] = field(default_factory=dict)


@dataclass
class _InfoChannel:
    """A camera_info channel whose image channel has a stream, or may get one."""

    image_id: int
    writer: CameraInfoWriter
    owner: StreamWriter | None
    count: int = 0
    pending: list[Message] = field(default_factory=list)


class Cameras:
    """Routes image and CameraInfo messages into streams.

    Args:
        reader: The recording.
        folder: Where the streams' files are made.
        selected: The topics chosen.
        settings: How to encode.
        topic_of: The summary of a channel's topic.
        keep: Stores what no stream can carry exactly.
    """

    def __init__(
        self,
        reader: BagReader,
        folder: Path,
        selected: Selection,
        settings: StreamSettings,
        *,
        topic_of: Callable[[Channel], TopicSummary],
        keep: Callable[[Message], None],
    ) -> None:
        self._reader = reader
        self._folder = folder
        self._selected = selected
        self._settings = settings
        self._topic_of = topic_of
        self._keep = keep
        self._names = FileNames()
        self._images: dict[tuple[object, ...], _ImageChannel] = {}
        self._infos: dict[int, _InfoChannel | None] = {}
        self._streams: list[StreamWriter] = []
        self.frames = 0

    def take_image(self, message: Message, workers: Workers) -> None:
        """Encode an image, or keep it with the reason why no stream takes it."""
        topic = self._topic_of(message.channel)
        state = self._images.setdefault(message.channel.identity, _ImageChannel())
        ordinal = state.count
        state.count += 1
        try:
            stream, job = self._accept_image(message, state, ordinal)
        except Unsuited as reason:
            topic.count_verbatim(str(reason), topic.messages - 1)
            self._keep(message)
            return
        if stream.frames == 1:
            self._adopt_infos(message.channel, stream)
        topic.frames += 1
        self.frames += 1
        workers.submit(self._streams.index(stream), job)

    def _accept_image(
        self, message: Message, state: _ImageChannel, ordinal: int
    ) -> tuple[StreamWriter, Callable[[], None]]:
        data = memoryview(message.data)
        try:
            wire = wire_for(message.channel.message_encoding, data)
            parts = wire.split_image(data)
        except WireError as error:
            raise Unsuited(f"it does not parse as an image: {error}") from None
        refuse_unsuited(parts)
        key = StreamKey.of(wire, parts)
        stream = state.streams.get(key) or self._new_stream(message.channel, key, state)
        return stream, stream.accept(message, parts, ordinal)

    def _new_stream(self, channel: Channel, key: StreamKey, state: _ImageChannel) -> StreamWriter:
        if key in state.refused:
            raise Unsuited(state.refused[key])
        if len(state.streams) == MAX_STREAMS_PER_CHANNEL:
            raise Unsuited(f"more than {MAX_STREAMS_PER_CHANNEL} sizes or encodings on one topic")
        stem, renamed = self._names.name_for(channel.topic)
        stats = self._reader.stats().get(channel.id)
        try:
            stream = StreamWriter(
                stem,
                self._folder,
                channel=channel,
                key=key,
                settings=self._settings,
                rate=stats.rate if stats else None,
            )
        except Unsuited as reason:
            state.refused[key] = str(reason)
            raise
        state.streams[key] = stream
        self._streams.append(stream)
        topic = self._topic_of(channel)
        if stream.note:
            topic.notes.append(stream.note)
        if renamed:
            topic.notes.append(f"stored as {stem}.mp4: the plain name was taken")
        return stream

    def take_info(self, message: Message) -> None:
        """Take a CameraInfo into its stream, or keep it if it belongs to none."""
        channel = message.channel
        if channel.id not in self._infos:
            self._infos[channel.id] = self._new_info(channel)
        state = self._infos[channel.id]
        if state is None:
            self._keep(message)
        elif state.owner is not None:
            self._add_info(state, message)
        elif len(state.pending) < _MAX_PENDING_INFOS:
            # a copy: a view would keep the reader's whole chunk in memory
            state.pending.append(replace(message, data=bytes(message.data)))
        else:
            self._give_up(channel.id, state)
            self._keep(message)

    def _new_info(self, channel: Channel) -> _InfoChannel | None:
        chosen = {c.id: c for c in self._reader.channels if self._selected(c.topic)}
        image_id = pair_camera_infos(list(chosen.values())).get(channel.id)
        if image_id is None:
            return None
        images = self._images.get(chosen[image_id].identity)
        streams = [s for s in images.streams.values() if s.frames] if images else []
        return _InfoChannel(image_id, CameraInfoWriter(channel), streams[0] if streams else None)

    def _adopt_infos(self, channel: Channel, stream: StreamWriter) -> None:
        """Let a channel's first stream have the CameraInfo messages that waited for it."""
        for state in self._infos.values():
            if state is None or state.owner is not None or state.image_id != channel.id:
                continue
            state.owner = stream
            pending, state.pending = state.pending, []
            for message in pending:
                self._add_info(state, message)

    def _add_info(self, state: _InfoChannel, message: Message) -> None:
        topic = self._topic_of(message.channel)
        ordinal = state.count
        state.count += 1
        try:
            state.writer.accept(message, ordinal)
            topic.frames += 1
        except Unsuited as reason:
            topic.count_verbatim(str(reason), ordinal)
            self._keep(message)

    def _give_up(self, info_id: int, state: _InfoChannel) -> None:
        for message in state.pending:
            self._keep(message)
        self._infos[info_id] = None

    def finish_infos(self) -> None:
        """Hand each stream its calibrations, and keep what waited for a stream in vain."""
        for info_id, state in list(self._infos.items()):
            if state is None:
                continue
            if state.owner is None:
                self._give_up(info_id, state)
            else:
                state.owner.camera_info = state.writer.to_model()

    def finish_streams(
        self, digest: Callable[[Path], tuple[int, str]]
    ) -> list[tuple[StreamWriter, StreamSidecar]]:
        """Complete all videos and write their sidecars; all jobs must have run.

        Args:
            digest: Gives the size and SHA-256 of a file.
        """
        finished = []
        for stream in self._streams:
            if not stream.frames:
                stream.abandon()
                stream.video_path.unlink(missing_ok=True)
                continue
            sidecar = stream.finish(digest)
            topic = self._topic_of(stream.channel)
            topic.files.append(stream.video_path.name)
            topic.packed_bytes += sum(
                path.stat().st_size for path in (stream.video_path, stream.sidecar_path)
            )
            finished.append((stream, sidecar))
        return finished

    def in_videos(self) -> set[tuple[object, ...]]:
        """Identities of the channels that a sidecar describes; call after `finish_infos`."""
        images = {stream.channel.identity for stream in self._streams if stream.frames}
        infos = {
            state.writer.channel.identity
            for state in self._infos.values()
            if state is not None and state.owner is not None and state.owner.camera_info
        }
        return images | infos

    def abandon(self) -> None:
        """Close all videos as they are; the caller removes them."""
        for stream in self._streams:
            stream.abandon()
