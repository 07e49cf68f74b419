"""Packs one recording, or a part of it, into videos, sidecars and verbatim messages."""

from __future__ import annotations

import base64
from array import array
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import xxhash

from mp4ds.bags.mcap import McapWriter
from mp4ds.bags.protocols import BagReader
from mp4ds.dataset.concat import identities
from mp4ds.errors import Refused
from mp4ds.format.fields import FORMAT_VERSION, MAX_FRAMES, digests_model, exceeds_padding
from mp4ds.format.manifest import RedactionEntry
from mp4ds.format.models import (
    EXACT_SUFFIX,
    CameraInfo,
    ChannelModel,
    Header,
    Image,
    PngFile,
    StreamSidecar,
    VideoModel,
    video_facts,
)
from mp4ds.format.sidecars import FileNames, dump_document
from mp4ds.messages.png import zlib_fingerprint
from mp4ds.messages.serializations import is_calibration, is_camera
from mp4ds.messages.transforms import TransformCollector
from mp4ds.messages.wire import CodedFields
from mp4ds.packing.inspection import (
    Calibrations,
    CameraMessage,
    Identity,
    MessageInspector,
    MessageTable,
    StreamKey,
)
from mp4ds.packing.manifest import PartRecord
from mp4ds.packing.planning import (
    MAX_STREAMS_PER_CHANNEL,
    SAMPLES,
    Decision,
    Piece,
    Plan,
    decide,
    needs_trial,
)
from mp4ds.packing.tracks import Track, TrackPlan, open_track
from mp4ds.records import EVERYTHING, Attachment, Channel, Message
from mp4ds.times import PresentationClock

Exact = Mapping[tuple[Identity, StreamKey], str]
"""Channel id and key of streams that no longer need to reach a score -> why."""

NOT_SURVEYED = (
    "images of its size or encoding were not in the parts of the recording that were surveyed"
)


# ---------------------------------------------------------------- threads

_AHEAD = 2  # jobs of a thread that may wait: each holds an image


class StreamThreads:
    """A few threads; jobs of one stream run in order on one of them.

    A context manager: leaving it normally waits for all jobs, leaving it with an exception drops
    those not started. After the first error of a job no other is run; the next call raises it.

    Args:
        count: Threads; 0 runs each job at once in the calling thread.
    """

    def __init__(self, count: int) -> None:
        self._error: BaseException | None = None
        self._threads = [ThreadPoolExecutor(1) for _ in range(count)]
        self._jobs: list[deque[Future[None]]] = [deque() for _ in range(count)]

    def submit(self, stream: int, job: Callable[[], None]) -> None:
        """Run a job after all earlier ones of its stream; waits while too many are waiting.

        Raises:
            BaseException: An earlier job's error.
        """
        if not self._threads:
            job()
            return
        number = stream % len(self._threads)
        jobs = self._jobs[number]
        if len(jobs) > _AHEAD:
            jobs.popleft().result()
        if self._error is not None:
            raise self._error
        jobs.append(self._threads[number].submit(self._run, job))

    def _run(self, job: Callable[[], None]) -> None:
        if self._error is None:
            try:
                job()
            except BaseException as error:
                self._error = error

    def __enter__(self) -> StreamThreads:
        return self

    def __exit__(self, exc_type: type[BaseException] | None, *_: object) -> None:
        for thread in self._threads:
            thread.shutdown(cancel_futures=exc_type is not None)
        if exc_type is None and self._error is not None:
            raise self._error


# ---------------------------------------------------------------- streams


class OutOfReach(Exception):  # noqa: N818 - no failure: packing starts anew without that score
    """A stream that was started cannot reach the requested score.

    Args:
        stream: Identifies it among the streams of a pack.
        reason: What was tried.
    """

    def __init__(self, stream: tuple[Identity, StreamKey], reason: str) -> None:
        super().__init__(stream, reason)
        self.stream, self.reason = stream, reason


class StreamWriter:
    """One stream being written: accepts messages in order, then makes its sidecar.

    `accept` decides at once and keeps the columns; the job that it returns does the costly
    work and may run in another thread, in order with the stream's other jobs.

    Args:
        stem: Path of video and sidecar, without ending.
        number: Of the stream.
        seen: The first of its messages.
        plan: How the video is made.
        threads: Of an encoder.
        rate: Frames per second, where known.

    Raises:
        Refused: The encoder does not take such pictures.
    """

    def __init__(
        self,
        stem: Path,
        number: int,
        seen: CameraMessage,
        plan: TrackPlan,
        threads: int,
        rate: float | None,
    ) -> None:
        self.number = number
        self.channel = seen.message.channel
        self.camera_info: CameraInfo | None = None
        self._view_path, self._sidecar_path = Path(f"{stem}.mp4"), Path(f"{stem}.yaml")
        self._path = Path(f"{stem}{EXACT_SUFFIX}") if plan.view else self._view_path
        self._plan = plan
        self._table = MessageTable[Header](seen.form, MAX_FRAMES)
        self._digests = array("Q")
        self._clock = PresentationClock()
        self._track = open_track(plan, self._path, self._view_path, seen, threads, rate)
        self._key = seen.key

    @property
    def frames(self) -> int:
        """Messages accepted so far."""
        return len(self._table)

    def accept(self, seen: CameraMessage, ordinal: int) -> Callable[[], None]:
        """Take a message whose key is this stream's.

        Args:
            seen: The message; its payload must stay as it is until the job has run.
            ordinal: Its place among the channel's messages.

        Returns:
            The job that writes its frame, and raises what `finish` does.

        Raises:
            Refused: The stream cannot carry it exactly; nothing was changed.
        """
        message, parts = seen.message, seen.parts
        self._table.check(message, parts)
        proven = self._track.prove(seen)
        self._table.add(
            message,
            parts,
            ordinal,
            describe=lambda template: self._header(seen, template),
            extra=seen.wrap,
        )
        tick = self._clock.tick(parts.stamp, message.log_time)

        def write() -> None:
            if self._plan.is_exact:
                self._digests.append(xxhash.xxh64_intdigest(message.data))
            try:
                self._track.write(proven, tick)
            except Refused as reason:
                raise self._out_of_reach(reason) from None

        return write

    def finish(self) -> StreamSidecar:
        """Complete the video and write the sidecar; all jobs must have run.

        Returns:
            The sidecar.

        Raises:
            OutOfReach: The video cannot have the score that was asked for.
            OSError: It cannot be written.
        """
        try:
            self._track.close()
        except Refused as reason:
            raise self._out_of_reach(reason) from None
        key, view = self._key, self._track.view
        sidecar = StreamSidecar(
            mp4ds=FORMAT_VERSION,
            kind="stream",
            profile=self._plan.profile,
            frames=self.frames,
            channel=ChannelModel.from_record(self.channel),
            wire=key.wire,
            body=key.body,
            image=Image(
                encoding=key.encoding,
                width=key.width,
                height=key.height,
                step=key.step,
                is_bigendian=key.is_bigendian,
            ),
            headers=self._table.headers,
            video=_video_model(self._track, self._path),
            view=_video_model(view, self._view_path) if view else None,
            predicted=self._plan.is_predicted or self._plan.coding is None or view is None,
            camera_info=self.camera_info,
            columns=self._table.to_model(),
            digests=digests_model(self._digests) if self._plan.is_exact else None,
        )
        self._sidecar_path.write_bytes(dump_document(sidecar))
        return sidecar

    def _out_of_reach(self, reason: Refused) -> OutOfReach:
        return OutOfReach((self.channel.identity, self._key), str(reason))

    def _header(self, seen: CameraMessage, template: str | None) -> Header:
        """The model of a message's header.

        Raises:
            Refused: The headers would become too large.
        """
        fields, wrap = seen.parts.fields, seen.wrap
        padding = None if wrap.padding is None else base64.b64encode(wrap.padding).decode()
        if exceeds_padding((padding, *(head.padding for head in self._table.headers))):
            raise Refused("too much padding between rows, different in each image")
        recipe = wrap.png and {**asdict(wrap.png), "deflate": zlib_fingerprint()}
        return Header(
            frame_id=seen.parts.frame_id,
            format=fields.format if isinstance(fields, CodedFields) else None,
            template=template,
            framing=wrap.framing,
            prefix=wrap.prefix.hex(),
            png=PngFile.model_validate(recipe) if recipe else None,
            padding=padding,
        )

    def abandon(self) -> None:
        """Stop writing, and remove the videos."""
        self._track.abandon()
        self._path.unlink(missing_ok=True)
        self._view_path.unlink(missing_ok=True)


def _video_model(track: Track, path: Path) -> VideoModel:
    made = track.describe()
    return VideoModel.model_validate({**made, **video_facts(path, made["codec"])})


# ---------------------------------------------------------------- cameras


@dataclass
class _Route:
    """Where the messages of one key go: into the first stream that accepts them.

    Attributes:
        plans: Plans for further streams, the best first.
        streams: Existing streams, in the order of the plans.
        refusal: Why there is no stream for what none of these accept.
    """

    plans: list[TrackPlan]
    streams: list[StreamWriter] = field(default_factory=list)
    refusal: str = ""


class _Camera:
    """A camera channel being packed.

    Args:
        packer: What it is packed by.
        channel: The channel; others of the recording may equal it.
    """

    def __init__(self, packer: Packer, channel: Channel) -> None:
        plan = packer.plan
        self._packer = packer
        self._channel = channel
        self._topic = packer.part.topic(channel)
        self._inspector = MessageInspector(channel, transcode=plan.options.transcode)
        # measured in each part of a recording by itself, it would make their videos differ
        stats = None if plan.options.is_fast else packer.reader.stats().get(channel.id)
        self._rate = stats.rate if stats else None
        self._count = 0
        self._held: list[tuple[CameraMessage, int, int]] = []  # with ordinal, and number in topic
        decisions = packer.decisions.get(channel.id)
        self._is_surveyed = decisions is not None
        self._routes = {item.key: self._route(item) for item in decisions or ()}
        self.first: StreamWriter | None = None

    def _route(self, decision: Decision) -> _Route:
        reason = self._packer.exact.get((self._channel.identity, decision.key))
        if reason is None:
            return _Route(list(decision.plans), refusal=decision.refusal)
        kept = "partly kept lossless" if self._is_surveyed else "kept lossless"
        plans = [
            replace(plan, note=f"{kept}: {reason}")
            for plan in decision.plans
            if plan.coding is not None and plan.is_exact
        ]
        return _Route(plans, refusal="" if plans else reason)

    def take(self, message: Message) -> None:
        """Encode an image, hold it back, or keep it with the reason why no stream accepts it."""
        ordinal, number = self._count, self._topic.messages - 1
        self._count += 1
        try:
            seen = self._inspector.inspect(message)
        except Refused as reason:
            self.settle()
            self._keep_verbatim(message, number, str(reason))
            return
        if self._is_surveyed:
            self._routes.setdefault(seen.key, _Route([], refusal=NOT_SURVEYED))
        if seen.key in self._routes and not self._held:
            self._write(seen, ordinal, number)
            return
        self._held.append((seen, ordinal, number))
        held = sum(other.key == seen.key for other, *_ in self._held)
        enough = held == SAMPLES or len(self._held) == 2 * SAMPLES
        if enough or not needs_trial(seen, self._packer.plan.options):
            self.settle()

    def settle(self) -> None:
        """Decide how to encode the held images, and write them in order."""
        held, self._held = self._held, []
        plan = self._packer.plan
        for key in dict.fromkeys(seen.key for seen, *_ in held):
            if key not in self._routes:
                samples = [seen for seen, *_ in held if seen.key == key]
                decision = decide(samples, plan.options, plan.threads, self._rate)
                self._routes[key] = self._route(decision)
        for item in held:
            self._write(*item)

    def _write(self, seen: CameraMessage, ordinal: int, number: int) -> None:
        route = self._routes[seen.key]
        reason = route.refusal
        for stream in self._candidates(route, seen):
            try:
                job = stream.accept(seen, ordinal)
            except Refused as refusal:
                reason = str(refusal)
                continue
            if self.first is None:
                self.first = stream
                self._packer.calibrations.adopt(self._channel.identity)
            self._packer.threads.submit(stream.number, job)
            return
        self._inspector.leave_out(seen)
        self._keep_verbatim(seen.message, number, route.refusal or reason)

    def _candidates(self, route: _Route, seen: CameraMessage) -> Iterator[StreamWriter]:
        """The streams that may accept a message; the next one is made when the others refuse."""
        yield from route.streams
        while route.plans and not route.refusal:
            made = sum(len(other.streams) for other in self._routes.values())
            if made == MAX_STREAMS_PER_CHANNEL:
                route.refusal = (
                    f"more than {MAX_STREAMS_PER_CHANNEL} sizes or encodings on one topic"
                )
                return
            plan = route.plans.pop(0)
            try:
                stream = self._packer.new_stream(seen, plan, self._rate)
            except Refused as reason:
                if not route.plans and not route.streams:
                    route.refusal = str(reason)
                continue
            if plan.note:
                self._topic.notes.append(plan.note)
            route.streams.append(stream)
            yield stream

    def _keep_verbatim(self, message: Message, number: int, reason: str) -> None:
        self._topic.count_verbatim(reason, number)
        self._packer.keep(message)


# ---------------------------------------------------------------- packer

_Made = TypeVar("_Made")
_UNPAIRED = "no images are known to be its own (`camera_info` names them)"


def until_in_reach(make: Callable[[Exact], _Made]) -> _Made:
    """Pack, and repeat with more streams lossless while one cannot reach the score.

    Args:
        make: Packs from the beginning, given the streams that must be lossless.
    """
    exact: dict[tuple[Identity, StreamKey], str] = {}
    while True:
        try:
            return make(exact)
        except OutOfReach as error:
            if error.stream in exact:
                raise
            exact = {**exact, error.stream: error.reason}


class Packer:
    """Packs an excerpt of a recording into a folder.

    Args:
        reader: The recording, open.
        folder: The folder to fill, empty.
        plan: How.
        piece: What.
        exact: Streams that must be lossless although a score is asked for, and why.
        progress: Called after each record with what was packed so far.

    Attributes:
        part: What was packed so far.
        decisions: How images of each surveyed channel are stored, by its id.
        calibrations: Notified of new streams.
        threads: Run the jobs of streams; while `run` reads.
    """

    threads: StreamThreads
    _verbatim: McapWriter  # messages.mcap, open while `run` reads

    def __init__(
        self,
        reader: BagReader,
        folder: Path,
        plan: Plan,
        piece: Piece,
        exact: Exact,
        progress: Callable[[PartRecord], None] = lambda _: None,
    ) -> None:
        self.reader, self.plan, self.exact = reader, plan, exact
        self.decisions = {} if piece.is_solo else plan.decisions
        self.part = PartRecord(folder)
        self._excerpt = piece.excerpt
        self._selected = plan.options.selected
        # that of a part is read once more, as parts are put together
        self._compression = "zstd" if piece.excerpt == EVERYTHING else "lz4"
        self._progress = progress
        self._transforms = TransformCollector()
        channels = [channel for channel in reader.channels if self._selected(channel.topic)]
        self.calibrations = Calibrations(channels, plan.pairs, self.part.topic, self.keep)
        self._names = FileNames()
        self._streams: list[StreamWriter] = []
        self._cameras: dict[Identity, _Camera] = {}
        self._takers: dict[int, Callable[[Message], None] | None] = {}

    def run(self) -> PartRecord:
        """Pack everything of the excerpt.

        Raises:
            SourceError: The recording is damaged.
            OutOfReach: A stream cannot have the score that was asked for.
            OSError: It cannot be written.
        """
        part = self.part
        try:
            with McapWriter(
                part.messages_path, profile=self.reader.profile, compression=self._compression
            ) as self._verbatim:
                self._read()
                self._finish_streams()
                if self._excerpt.others:
                    self._declare_rest()
        except BaseException:
            for stream in self._streams:
                stream.abandon()
            raise
        part.transforms = self._transforms.transforms
        if self.reader.redaction:
            part.redactions = [RedactionEntry.model_validate(self.reader.redaction)]
        return part

    def _read(self) -> None:
        part = self.part
        with StreamThreads(self.plan.workers if self.plan.workers > 1 else 0) as self.threads:
            for record in self.reader.records(self._excerpt):
                if isinstance(record, Message):
                    self._take(record)
                elif isinstance(record, Attachment):
                    self._verbatim.add_attachment(record)
                else:
                    self._verbatim.add_metadata(record)
                self._progress(part)
            for camera in self._cameras.values():
                camera.settle()
        if self._excerpt.others:
            part.skipped = dict(self.reader.skipped)
            part.losses = list(self.reader.losses)

    def _take(self, message: Message) -> None:
        channel, log_time = message.channel, message.log_time
        if channel.id not in self._takers:
            self._takers[channel.id] = self._taker(channel)
        take = self._takers[channel.id]
        if take is None:
            return
        topic = self.part.topics[channel.topic]
        topic.messages += 1
        topic.raw_bytes += len(message.data)
        start, end = self.part.span or (log_time, log_time)
        self.part.span = min(start, log_time), max(end, log_time)
        take(message)

    def _taker(self, channel: Channel) -> Callable[[Message], None] | None:
        """What takes the messages of a channel; None if they are left out."""
        if not self._selected(channel.topic):
            self.part.left_out[channel.topic] = None
            return None
        self.part.topic(channel)
        self.calibrations.meet(channel)
        if is_camera(channel):
            if channel.identity not in self._cameras:
                self._cameras[channel.identity] = _Camera(self, channel)
            return self._cameras[channel.identity].take
        if is_calibration(channel):
            if self.plan.frames and not self.calibrations.have_images(channel):
                adapted = ", so it is not adapted" if self.reader.reduction.get("images") else ""
                self.part.topic(channel).notes.append(_UNPAIRED + adapted)
            return self.calibrations.take
        return self.keep

    def keep(self, message: Message) -> None:
        """Store a message verbatim."""
        self._verbatim.add_channel(message.channel)
        self._verbatim.write(message)
        self._transforms.add(message.channel, message.data)

    def new_stream(self, seen: CameraMessage, plan: TrackPlan, rate: float | None) -> StreamWriter:
        """Begin a stream.

        Raises:
            Refused: The encoder does not take such pictures.
        """
        name = self._names.name_for(seen.message.channel.topic)
        stem, number = self.part.folder / name, len(self._streams)
        try:
            stream = StreamWriter(stem, number, seen, plan, self.plan.threads, rate)
        except Refused:
            self._names.release(name)  # for the next plan
            raise
        self._streams.append(stream)
        return stream

    def _finish_streams(self) -> None:
        """Complete all videos and write their sidecars; all jobs have run."""
        for identity, info in self.calibrations.finish().items():
            if first := self._cameras[identity].first:
                first.camera_info = info
        for stream in self._streams:
            if stream.frames:
                self.part.streams.append(stream.finish())
            else:
                stream.abandon()

    def _declare_rest(self) -> None:
        """Keep what the recording declares besides its messages."""
        in_videos = identities(self.part.streams)
        for channel in self.reader.channels:
            if not self._selected(channel.topic):
                self.part.left_out[channel.topic] = None
            elif channel.identity not in in_videos:
                self.part.topic(channel)
                self._verbatim.add_channel(channel)
        for schema in self.reader.unused_schemas:
            self._verbatim.add_schema(schema)
