"""Packs one recording, or a part of it, into videos, sidecars and verbatim messages."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

from mp4ds.bags.mcap import McapWriter
from mp4ds.bags.protocols import BagReader
from mp4ds.errors import Refused
from mp4ds.format.models import CameraInfo
from mp4ds.messages.serializations import is_calibration, is_camera
from mp4ds.messages.transforms import TransformCollector
from mp4ds.packing.calibrations import Calibrations, Identity
from mp4ds.packing.inspection import CameraMessage, MessageInspector, StreamKey
from mp4ds.packing.manifest import PartRecord, PartStream, declare_rest
from mp4ds.packing.options import TopicSummary
from mp4ds.packing.planning import Piece, Plan
from mp4ds.packing.survey import (
    MAX_STREAMS_PER_CHANNEL,
    SAMPLES,
    Decision,
    StreamSettings,
    Survey,
    decide,
    needs_trial,
    rate_of,
)
from mp4ds.packing.tracks import TrackPlan
from mp4ds.packing.writer import OutOfReach, StreamWriter
from mp4ds.plan import FileNames
from mp4ds.records import Attachment, Channel, Message, Record

Exact = Mapping[tuple[int, StreamKey], str]
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


# ---------------------------------------------------------------- cameras


@dataclass(frozen=True, slots=True)
class _Item:
    """A message of a camera channel.

    Attributes:
        ordinal: Its position among the channel's messages.
        number: Its position among the topic's messages.
        seen: What it holds.
    """

    message: Message
    ordinal: int
    number: int
    seen: CameraMessage


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


@dataclass
class _CameraChannel:
    """A camera channel being packed."""

    inspector: MessageInspector
    count: int = 0
    routes: dict[StreamKey, _Route] = field(default_factory=dict)
    held: list[_Item] = field(default_factory=list)
    is_surveyed: bool = False


class CameraRouter:
    """Routes the images of all camera channels into streams.

    Args:
        reader: The recording.
        folder: Where the streams' files are made.
        settings: How to encode.
        calibrations: Notified of new streams.
        survey: Earlier decisions; None to decide here.
        topic_of: The summary of a channel's topic.
        keep: Stores what no stream can carry exactly.
        exact: Streams that must be lossless although a score is asked for, and why.
    """

    def __init__(
        self,
        reader: BagReader,
        folder: Path,
        settings: StreamSettings,
        calibrations: Calibrations,
        survey: Survey | None,
        *,
        topic_of: Callable[[Channel], TopicSummary],
        keep: Callable[[Message], None],
        exact: Exact,
    ) -> None:
        self._reader = reader
        self._folder = folder
        self._settings = settings
        self._calibrations = calibrations
        self._survey = survey
        self._topic_of = topic_of
        self._keep = keep
        self._exact = exact
        self._names = FileNames()
        self._channels: dict[tuple[object, ...], _CameraChannel] = {}
        self._streams: list[StreamWriter] = []
        self._firsts: dict[Identity, StreamWriter] = {}  # of each channel
        self._renamed: set[str] = set()

    def take(self, message: Message, threads: StreamThreads) -> None:
        """Encode an image, hold it back, or keep it with the reason why no stream accepts it."""
        channel = message.channel
        state = self._state_of(channel)
        ordinal, number = state.count, self._topic_of(channel).messages - 1
        state.count += 1
        try:
            seen = state.inspector.inspect(message)
        except Refused as reason:
            self._settle(state, threads)
            self._keep_verbatim(message, number, str(reason))
            return
        self._calibrations.saw(channel, seen)
        item = _Item(message, ordinal, number, seen)
        if state.is_surveyed:
            state.routes.setdefault(seen.key, _Route([], refusal=NOT_SURVEYED))
        if seen.key in state.routes and not state.held:
            self._write(state, item, threads)
            return
        state.held.append(item)
        held = Counter(other.seen.key for other in state.held)
        enough = held[seen.key] == SAMPLES or len(state.held) == 2 * SAMPLES
        if enough or not needs_trial(seen, self._settings):
            self._settle(state, threads)

    def _state_of(self, channel: Channel) -> _CameraChannel:
        if channel.identity not in self._channels:
            inspector = MessageInspector(channel, transcode=self._settings.options.transcode)
            state = self._channels[channel.identity] = _CameraChannel(inspector)
            decisions = self._survey.decisions.get(channel.id) if self._survey else None
            if decisions is not None:
                state.is_surveyed = True
                state.routes = {item.key: self._route(channel, item) for item in decisions}
        return self._channels[channel.identity]

    def settle(self, threads: StreamThreads) -> None:
        """Write everything held back: the recording has ended."""
        for state in self._channels.values():
            self._settle(state, threads)

    def _settle(self, state: _CameraChannel, threads: StreamThreads) -> None:
        """Decide how to encode the held images, and write them in order."""
        held, state.held = state.held, []
        for key in dict.fromkeys(item.seen.key for item in held):
            if key not in state.routes:
                samples = [item.seen for item in held if item.seen.key == key]
                state.routes[key] = self._plan(samples, held[0].message.channel)
        for item in held:
            self._write(state, item, threads)

    def _plan(self, samples: list[CameraMessage], channel: Channel) -> _Route:
        return self._route(channel, decide(samples, self._settings, self._rate(channel)))

    def _route(self, channel: Channel, decision: Decision) -> _Route:
        reason = self._exact.get((channel.id, decision.key))
        if reason is None:
            return _Route(list(decision.plans), refusal=decision.refusal)
        kept = "partly kept lossless" if self._survey else "kept lossless"
        plans = [
            replace(plan, note=f"{kept}: {reason}")
            for plan in decision.plans
            if plan.coding is not None and plan.is_exact
        ]
        return _Route(plans, refusal="" if plans else reason)

    def _rate(self, channel: Channel) -> float | None:
        # measured in each part of a recording by itself, it would make their videos differ
        return None if self._settings.is_fast else rate_of(self._reader, channel)

    def _write(self, state: _CameraChannel, item: _Item, threads: StreamThreads) -> None:
        route = state.routes[item.seen.key]
        reason = route.refusal
        for stream in self._candidates(state, route, item):
            number = self._streams.index(stream)
            try:
                job = stream.accept(item.message, item.seen, item.ordinal)
            except Refused as refusal:
                reason = str(refusal)
                continue
            self._topic_of(item.message.channel).frames += 1
            if stream.frames == 1:
                self._firsts.setdefault(stream.channel.identity, stream)
                self._calibrations.adopt(stream.channel.identity)
            threads.submit(number, job)
            return
        state.inspector.leave_out(item.seen)
        self._keep_verbatim(item.message, item.number, route.refusal or reason)

    def _candidates(
        self, state: _CameraChannel, route: _Route, item: _Item
    ) -> Iterator[StreamWriter]:
        """The streams that may accept a message; the next one is made when the others refuse."""
        yield from route.streams
        while route.plans and not route.refusal:
            made = sum(len(other.streams) for other in state.routes.values())
            if made == MAX_STREAMS_PER_CHANNEL:
                route.refusal = (
                    f"more than {MAX_STREAMS_PER_CHANNEL} sizes or encodings on one topic"
                )
                return
            plan = route.plans.pop(0)
            try:
                stream = self._new_stream(item, plan)
            except Refused as reason:
                if not route.plans and not route.streams:
                    route.refusal = str(reason)
                continue
            route.streams.append(stream)
            yield stream

    def _new_stream(self, item: _Item, plan: TrackPlan) -> StreamWriter:
        channel = item.message.channel
        stem, renamed = self._names.name_for(channel.topic)
        stream = StreamWriter(
            stem,
            self._folder,
            channel=channel,
            seen=item.seen,
            plan=plan,
            threads=self._settings.threads,
            rate=self._rate(channel),
        )
        self._streams.append(stream)
        if renamed:
            self._renamed.add(stem)
        if stream.note:
            self._topic_of(channel).notes.append(stream.note)
        return stream

    def _keep_verbatim(self, message: Message, number: int, reason: str) -> None:
        self._topic_of(message.channel).count_verbatim(reason, number)
        self._keep(message)

    def finish(self, infos: Mapping[Identity, CameraInfo]) -> list[PartStream]:
        """Complete all videos and write their sidecars; all jobs must have run.

        Args:
            infos: The calibrations of each channel, for its first stream.
        """
        for identity, info in infos.items():
            self._firsts[identity].camera_info = info
        finished = []
        for stream in self._streams:
            if not stream.frames:
                stream.abandon()
                stream.video_path.unlink(missing_ok=True)
                continue
            stem = stream.video_path.stem
            finished.append(PartStream(stem, stream.finish(), stem in self._renamed))
        return finished

    def abandon(self) -> None:
        """Close all videos as they are; the caller removes them."""
        for stream in self._streams:
            stream.abandon()


# ---------------------------------------------------------------- packer

_Made = TypeVar("_Made")


def until_in_reach(make: Callable[[Exact], _Made]) -> _Made:
    """Pack, and repeat with more streams lossless while one cannot reach the score.

    Args:
        make: Packs from the beginning, given the streams that must be lossless.
    """
    exact: dict[tuple[int, StreamKey], str] = {}
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
    """

    _verbatim: McapWriter  # messages.mcap, open while `run` reads

    def __init__(
        self,
        reader: BagReader,
        folder: Path,
        plan: Plan,
        piece: Piece,
        exact: Exact,
        progress: Callable[[PartRecord], None],
    ) -> None:
        self._reader = reader
        self._excerpt = piece.excerpt
        self._selected = plan.options.selected
        self._threads = plan.workers if plan.workers > 1 else 0
        # that of a part is read once more, as parts are put together
        self._compression = "zstd" if piece.is_all else "lz4"
        self._progress = progress
        self._transforms = TransformCollector()
        self._part = PartRecord(folder)
        survey = plan.survey_for(piece)
        self._calibrations = Calibrations(
            [channel for channel in reader.channels if self._selected(channel.topic)],
            plan.options.camera_info,
            survey.pairs if survey else None,
            topic_of=self._part.topic,
            keep=self._keep,
        )
        self._cameras = CameraRouter(
            reader,
            folder,
            plan.streams,
            self._calibrations,
            survey,
            topic_of=self._part.topic,
            keep=self._keep,
            exact=exact,
        )

    def run(self) -> PartRecord:
        """Pack everything of the excerpt.

        Raises:
            SourceError: The recording is damaged.
            OutOfReach: A stream cannot have the score that was asked for.
            OSError: It cannot be written.
        """
        part = self._part
        try:
            with McapWriter(
                part.messages_path,
                profile=self._reader.profile,
                compression=self._compression,
            ) as self._verbatim:
                self._read()
                part.streams = self._cameras.finish(self._calibrations.finish())
                if self._excerpt.others:
                    declare_rest(part, self._reader, self._selected, self._verbatim)
        except BaseException:
            self._cameras.abandon()
            raise
        part.transforms = self._transforms.transforms
        return part

    def _read(self) -> None:
        with StreamThreads(self._threads) as threads:
            for record in self._reader.records(self._excerpt):
                self._take(record, threads)
                self._progress(self._part)
            self._cameras.settle(threads)
        if self._excerpt.others:
            self._part.skipped = dict(self._reader.skipped)
            self._part.losses = list(self._reader.losses)

    def _take(self, record: Record, threads: StreamThreads) -> None:
        part = self._part
        if isinstance(record, Attachment):
            self._verbatim.add_attachment(record)
            return
        if not isinstance(record, Message):
            self._verbatim.add_metadata(record)
            return
        channel = record.channel
        if not self._selected(channel.topic):
            part.left_out[channel.topic] = None
            return
        topic = part.topic(channel)
        topic.messages += 1
        topic.raw_bytes += len(record.data)
        part.saw([record.log_time])
        if is_camera(channel):
            self._cameras.take(record, threads)
        elif is_calibration(channel):
            self._calibrations.take(record)
        else:
            self._transforms.add(channel, record.data)
            self._keep(record)

    def _keep(self, message: Message) -> None:
        self._verbatim.add_channel(message.channel)
        self._verbatim.write(message)
