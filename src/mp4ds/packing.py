"""Source -> dataset: one pass over a recording, images into videos, all the rest verbatim."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from mp4ds._version import __version__
from mp4ds.bags import BagReader, SourceHasher, open_sources, open_writer
from mp4ds.engine import Workers
from mp4ds.errors import SourceError, WriteError
from mp4ds.outputs import digest_file, staged
from mp4ds.plan import (
    CAMERA_INFO_TYPES,
    IMAGE_TYPES,
    FileNames,
    Selection,
    pair_camera_infos,
    parse_quality,
)
from mp4ds.records import Attachment, Channel, Message, MetadataRecord
from mp4ds.sidecar import (
    FORMAT_VERSION,
    MANIFEST_NAME,
    MESSAGES_NAME,
    FileEntry,
    Manifest,
    Source,
    StreamEntry,
    StreamSidecar,
    TimeRange,
    Verbatim,
    dump_document,
)
from mp4ds.streams import CameraInfoWriter, StreamKey, StreamSettings, StreamWriter, Unsuited
from mp4ds.streams.writer import refuse_unsuited
from mp4ds.video import check_codec, tool_versions
from mp4ds.video.codecs import DEFAULT_GOP
from mp4ds.wire import WireError, wire_for

MAX_STREAMS_PER_CHANNEL = 16
"""A topic that changes its geometry more often than this is not split any further."""

_MAX_PENDING_INFOS = 1000
_MAX_REASONS = 10


@dataclass(frozen=True)
class PackOptions:
    """How to pack.

    Attributes:
        topics: Globs of the topics to pack; empty for all.
        exclude: Globs of topics to leave out.
        quality: ``lossless``, ``visual`` or ``crf=N``.
        codec: ``h264``, ``h265``, ``av1`` or ``ffv1``; None chooses by measurement.
        preset: The encoder's preset; None chooses.
        gop: Most frames from one key frame to the next.
        jobs: Streams encoded side by side; None for one per core.
        force: Replace an existing dataset.
    """

    topics: Sequence[str] = ()
    exclude: Sequence[str] = ()
    quality: str = "lossless"
    codec: str | None = None
    preset: str | None = None
    gop: int = DEFAULT_GOP
    jobs: int | None = None
    force: bool = False


@dataclass(frozen=True)
class PackProgress:
    """Where a pack stands.

    Attributes:
        bytes_read: Bytes of the source consumed.
        bytes_total: Bytes of the source.
        bytes_written: Bytes of the dataset so far.
        frames: Frames accepted so far.
    """

    bytes_read: int
    bytes_total: int
    bytes_written: int
    frames: int


@dataclass
class TopicSummary:
    """What became of a topic.

    Attributes:
        topic: Its name.
        type_name: Its message type.
        messages: Messages packed.
        frames: Messages of these that are frames of a video or entries of its camera_info.
        raw_bytes: Payload bytes of all messages.
        packed_bytes: Bytes of its videos and sidecars; 0 for one that is in messages.mcap.
        files: Its videos.
        verbatim: Reason -> (messages, number of the first) for camera messages stored verbatim.
        notes: What else is worth knowing.
    """

    topic: str
    type_name: str
    messages: int = 0
    frames: int = 0
    raw_bytes: int = 0
    packed_bytes: int = 0
    files: list[str] = field(default_factory=list)
    verbatim: dict[str, tuple[int, int]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def count_verbatim(self, reason: str, number: int) -> None:
        """Count one more message stored verbatim, the topic's message of that number."""
        if reason not in self.verbatim and len(self.verbatim) >= _MAX_REASONS:
            reason = "other reasons"
        count, first = self.verbatim.get(reason, (0, number))
        self.verbatim[reason] = (count + 1, first)


@dataclass(frozen=True)
class PackSummary:
    """What a pack did.

    Attributes:
        dataset: The folder made.
        topics: One entry per topic, in the recording's order.
        source_bytes: Bytes of the source files.
        dataset_bytes: Bytes of the dataset.
        messages_bytes: Bytes of messages.mcap.
        left_out: Topics left out on request.
    """

    dataset: Path
    topics: list[TopicSummary]
    source_bytes: int
    dataset_bytes: int
    messages_bytes: int
    left_out: list[str]


def pack(
    sources: Sequence[Path | str] | Path | str,
    dataset: Path | str,
    options: PackOptions | None = None,
    *,
    progress: Callable[[PackProgress], None] | None = None,
) -> PackSummary:
    """Pack a recording into a dataset.

    Args:
        sources: A bag, rosbag2 folder or MCAP file, or several that belong together.
        dataset: The folder to make.
        options: How; the default loses nothing.
        progress: Called after every few messages.

    Returns:
        What became of each topic.

    Raises:
        SourceError: The recording cannot be read. Nothing is left behind.
        TargetError: The dataset may not be written there.
        WriteError: The disk refused. Nothing is left behind.
        OptionError: An option is wrong.
    """
    chosen = options or PackOptions()
    paths = [Path(sources)] if isinstance(sources, (str, Path)) else [Path(p) for p in sources]
    target = Path(os.path.abspath(dataset))  # noqa: PTH100 - keeps links, unlike resolve()
    quality = parse_quality(chosen.quality)
    check_codec(chosen.codec, lossless=quality.lossless)
    with (
        open_sources(paths) as reader,
        staged(target, force=chosen.force, replaceable=is_dataset) as folder,
    ):
        folder.mkdir()
        packer = _Packer(reader, folder, chosen, progress)
        packer.settings = StreamSettings(
            quality=quality,
            codec=chosen.codec,
            preset=chosen.preset,
            gop=chosen.gop,
            threads=packer.encoder_threads,
        )
        try:
            summary = packer.run(target)
        except OSError as error:
            if isinstance(error, SourceError) or error.errno is None:
                raise
            raise WriteError(target, error) from error
    return summary


def is_dataset(path: Path) -> bool:
    """Whether a folder is one that pack made, or empty, and may be replaced when asked."""
    return path.is_dir() and ((path / MANIFEST_NAME).is_file() or not any(path.iterdir()))


@dataclass
class _ImageChannel:
    """An image channel being packed."""

    count: int = 0
    streams: dict[StreamKey, StreamWriter] = field(default_factory=dict)
    refused: dict[StreamKey, str] = field(default_factory=dict)


@dataclass
class _InfoChannel:
    """A camera_info channel whose image channel may get a stream."""

    image_id: int
    writer: CameraInfoWriter
    owner: StreamWriter | None
    count: int = 0
    pending: list[Message] = field(default_factory=list)


class _Packer:
    """The state of one pack."""

    settings: StreamSettings

    def __init__(
        self,
        reader: BagReader,
        folder: Path,
        options: PackOptions,
        progress: Callable[[PackProgress], None] | None,
    ) -> None:
        self._reader = reader
        self._folder = folder
        self._options = options
        self._progress = progress
        self._selected = Selection(options.topics, options.exclude)
        self._names = FileNames()
        self._images: dict[tuple[object, ...], _ImageChannel] = {}
        self._infos: dict[int, _InfoChannel | None] = {}
        self._topics: dict[str, TopicSummary] = {}
        self._streams: list[StreamWriter] = []
        self._left_out: dict[str, None] = {}
        self._declared: set[int] = set()
        self._span: tuple[int, int] | None = None
        self._frames = 0
        self._total = sum(path.stat().st_size for path in reader.files)
        cores = os.cpu_count() or 1
        cameras = sum(c.type_name in IMAGE_TYPES for c in reader.channels) or 1
        self._jobs = min(options.jobs or cores, cameras)
        self.encoder_threads = max(1, -(-(options.jobs or cores) // self._jobs))

    def run(self, target: Path) -> PackSummary:
        """Pack everything; the manifest is written last."""
        self._selected.check(channel.topic for channel in self._reader.channels)
        hasher = SourceHasher(self._reader.path, self._reader.files)
        messages_path = self._folder / MESSAGES_NAME
        with open_writer(
            messages_path,
            "mcap",
            name=MESSAGES_NAME,
            profile=self._reader.profile,
            library=f"mp4ds {__version__}",
            storage="mcap",
        ) as verbatim:
            self._verbatim = verbatim
            try:
                with Workers(self._jobs if self._jobs > 1 else 0) as workers:
                    self._workers = workers
                    for number, record in enumerate(self._reader.records()):
                        self._take(record)
                        if number % 16 == 0:
                            hasher.advance(self._reader.position)
                            self._report()
                self._finish_channels()
            except BaseException:
                for stream in self._streams:
                    stream.abandon()
                raise
        sidecars = self._finish_streams()
        hasher.advance(None)
        manifest = self._manifest(hasher, sidecars)
        (self._folder / MANIFEST_NAME).write_bytes(dump_document(manifest))
        self._report(done=True)
        return PackSummary(
            dataset=target,
            topics=list(self._topics.values()),
            source_bytes=self._total,
            dataset_bytes=_folder_size(self._folder),
            messages_bytes=messages_path.stat().st_size,
            left_out=list(self._left_out),
        )

    def _take(self, record: object) -> None:
        if isinstance(record, Message):
            self._take_message(record)
        elif isinstance(record, Attachment):
            self._verbatim.add_attachment(record)
        elif isinstance(record, MetadataRecord):
            self._verbatim.add_metadata(record)

    def _take_message(self, message: Message) -> None:
        channel = message.channel
        if not self._selected(channel.topic):
            self._left_out[channel.topic] = None
            return
        topic = self._topic(channel)
        topic.messages += 1
        topic.raw_bytes += len(message.data)
        start, end = self._span or (message.log_time, message.log_time)
        self._span = (min(start, message.log_time), max(end, message.log_time))
        try:
            if channel.type_name in IMAGE_TYPES:
                self._take_image(message, topic)
                return
            if channel.type_name in CAMERA_INFO_TYPES and self._take_info(message):
                return
        except Unsuited as reason:
            topic.count_verbatim(str(reason), topic.messages - 1)
        self._keep(message)

    def _topic(self, channel: Channel) -> TopicSummary:
        if channel.topic not in self._topics:
            self._topics[channel.topic] = TopicSummary(channel.topic, channel.type_name)
        return self._topics[channel.topic]

    def _keep(self, message: Message) -> None:
        self._declare(message.channel)
        self._verbatim.write(message)

    def _declare(self, channel: Channel) -> None:
        if channel.id not in self._declared:
            self._declared.add(channel.id)
            self._verbatim.add_channel(channel)

    def _take_image(self, message: Message, topic: TopicSummary) -> None:
        state = self._images.setdefault(message.channel.identity, _ImageChannel())
        ordinal = state.count
        state.count += 1
        data = memoryview(message.data)
        try:
            wire = wire_for(message.channel.message_encoding, data)
            parts = wire.split_image(data)
        except WireError as error:
            raise Unsuited(f"it does not parse as an image: {error}") from None
        refuse_unsuited(parts)
        key = StreamKey.of(wire, parts)
        stream = state.streams.get(key)
        if stream is None:
            stream = self._new_stream(message.channel, key, state)
        job = stream.accept(message, parts, ordinal)
        if stream.frames == 1:
            self._adopt_infos(message.channel, stream)
        topic.frames += 1
        self._frames += 1
        self._workers.submit(self._streams.index(stream), job)

    def _new_stream(
        self, channel: Channel, key: StreamKey, state: _ImageChannel
    ) -> StreamWriter:
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
                settings=self.settings,
                rate=stats.rate if stats else None,
            )
        except Unsuited as reason:
            state.refused[key] = str(reason)
            raise
        state.streams[key] = stream
        self._streams.append(stream)
        topic = self._topic(channel)
        if stream.note:
            topic.notes.append(stream.note)
        if renamed:
            topic.notes.append(f"stored as {stem}.mp4: the plain name was taken")
        return stream

    def _take_info(self, message: Message) -> bool:
        """Take a CameraInfo into its stream; False if it belongs to none."""
        channel = message.channel
        if channel.id not in self._infos:
            self._infos[channel.id] = self._new_info(channel)
        state = self._infos[channel.id]
        if state is None:
            return False
        if state.owner is not None:
            self._add_info(state, message)
        elif len(state.pending) < _MAX_PENDING_INFOS:
            # a copy: a view would keep the reader's whole chunk in memory
            state.pending.append(replace(message, data=bytes(message.data)))
        else:
            self._give_up(channel.id, state)
            return False
        return True

    def _new_info(self, channel: Channel) -> _InfoChannel | None:
        chosen = {c.id: c for c in self._reader.channels if self._selected(c.topic)}
        image_id = pair_camera_infos(list(chosen.values())).get(channel.id)
        if image_id is None:
            return None
        images = self._images.get(chosen[image_id].identity)
        streams = [s for s in images.streams.values() if s.frames] if images else []
        return _InfoChannel(image_id, CameraInfoWriter(channel), streams[0] if streams else None)

    def _adopt_infos(self, channel: Channel, stream: StreamWriter) -> None:
        """Let a channel's first stream have the CameraInfo messages that were waiting for it."""
        for state in self._infos.values():
            if state is None or state.owner is not None or state.image_id != channel.id:
                continue
            state.owner = stream
            pending, state.pending = state.pending, []
            for message in pending:
                self._add_info(state, message)

    def _add_info(self, state: _InfoChannel, message: Message) -> None:
        topic = self._topic(message.channel)
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

    def _finish_channels(self) -> None:
        """Bring what waited in vain to messages.mcap, and channels without any message."""
        for info_id, state in list(self._infos.items()):
            if state is None:
                continue
            if state.owner is None:
                self._give_up(info_id, state)
            else:
                state.owner.camera_info = state.writer.to_model()
        in_videos = {stream.channel.identity for stream in self._streams if stream.frames}
        in_videos |= {
            state.writer.channel.identity
            for state in self._infos.values()
            if state is not None and state.owner is not None and state.owner.camera_info
        }
        for channel in self._reader.channels:
            if not self._selected(channel.topic):
                self._left_out[channel.topic] = None
            elif channel.identity not in in_videos:
                self._topic(channel)
                self._declare(channel)
        for schema in self._reader.unused_schemas:
            self._verbatim.add_schema(schema)

    def _finish_streams(self) -> list[tuple[StreamWriter, StreamSidecar]]:
        finished = []
        for stream in self._streams:
            if not stream.frames:
                stream.abandon()
                stream.video_path.unlink(missing_ok=True)
                continue
            sidecar = stream.finish(digest_file)
            topic = self._topics[stream.channel.topic]
            topic.files.append(stream.video_path.name)
            topic.packed_bytes += sum(
                path.stat().st_size for path in (stream.video_path, stream.sidecar_path)
            )
            finished.append((stream, sidecar))
        return finished

    def _manifest(
        self, hasher: SourceHasher, streams: list[tuple[StreamWriter, StreamSidecar]]
    ) -> Manifest:
        digests = {
            sidecar.video.file: (sidecar.video.size or 0, sidecar.video.sha256 or "")
            for _, sidecar in streams
        }
        for name in (MESSAGES_NAME, *(stream.sidecar_path.name for stream, _ in streams)):
            digests[name] = digest_file(self._folder / name)
        return Manifest(
            mp4ds=FORMAT_VERSION,
            kind="dataset",
            profile=self._options.quality,
            format=self._reader.format,
            recording_profile=self._reader.profile,
            library=self._reader.library,
            sources=[
                Source(name=name, size=size, sha256=sha256) for name, size, sha256 in hasher.digests
            ],
            messages=sum(topic.messages for topic in self._topics.values()),
            topics_left_out=list(self._left_out),
            time_range=TimeRange(start=self._span[0], end=self._span[1]) if self._span else None,
            streams=[
                StreamEntry(
                    topic=stream.channel.topic,
                    sidecar=stream.sidecar_path.name,
                    video=sidecar.video.file,
                    frames=sidecar.frames,
                )
                for stream, sidecar in streams
            ],
            verbatim=[
                Verbatim(topic=topic.topic, messages=count, first=first, reason=reason)
                for topic in self._topics.values()
                for reason, (count, first) in topic.verbatim.items()
            ],
            files=[
                FileEntry(name=name, size=size, sha256=sha256)
                for name, (size, sha256) in sorted(digests.items())
            ],
            tools={"mp4ds": __version__, **tool_versions()},
        )

    def _report(self, *, done: bool = False) -> None:
        if self._progress is None:
            return
        self._progress(
            PackProgress(
                bytes_read=self._total if done else min(self._reader.position, self._total),
                bytes_total=self._total,
                bytes_written=_folder_size(self._folder),
                frames=self._frames,
            )
        )


def _folder_size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.iterdir())
