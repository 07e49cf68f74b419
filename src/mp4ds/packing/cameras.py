"""Camera messages on their way into streams; what no stream takes is handed back."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from mp4ds.bags import BagReader
from mp4ds.engine import Workers
from mp4ds.packing.calibrations import Calibrations
from mp4ds.packing.part import PartStream
from mp4ds.packing.report import TopicSummary
from mp4ds.packing.survey import (
    MAX_STREAMS_PER_CHANNEL,
    SAMPLES,
    Decision,
    Survey,
    decide,
    rate_of,
)
from mp4ds.plan import FileNames
from mp4ds.records import Channel, Message
from mp4ds.streams import (
    Looker,
    PicturePlan,
    Seen,
    StreamKey,
    StreamSettings,
    StreamWriter,
    TrackPlan,
    Unsuited,
    needs_trial,
)

Exact = Mapping[tuple[int, StreamKey], str]
"""Id of a channel and key of streams that no score is asked of any more -> why."""

NOT_SURVEYED = "images of its size or encoding were not met where the recording was looked into"


@dataclass(frozen=True, slots=True)
class _Item:
    """A message of a camera channel.

    Attributes:
        ordinal: Its place among the channel's messages.
        number: Its place among the topic's messages.
        seen: What it holds.
    """

    message: Message
    ordinal: int
    number: int
    seen: Seen


@dataclass
class _Route:
    """Where the messages of one key go: into the first of the streams that takes them.

    Attributes:
        plans: How further streams for them may be made, the best first.
        streams: Those that were made, in the order of the plans.
        refusal: Why there is no stream for what none of these takes.
    """

    plans: list[TrackPlan]
    streams: list[StreamWriter] = field(default_factory=list)
    refusal: str = ""


@dataclass
class _CameraChannel:
    """A camera channel being packed."""

    looker: Looker
    count: int = 0
    routes: dict[StreamKey, _Route] = field(default_factory=dict)
    held: list[_Item] = field(default_factory=list)
    is_surveyed: bool = False


class Cameras:
    """Routes the images of all camera channels into streams.

    Args:
        reader: The recording.
        folder: Where the streams' files are made.
        settings: How to encode.
        calibrations: Takes notice of new streams.
        survey: What was decided before; None to decide here.
        topic_of: The summary of a channel's topic.
        keep: Stores what no stream can carry exactly.
        exact: Streams that are to be lossless although a score is asked for, and why.
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
        self._renamed: set[str] = set()

    def take(self, message: Message, workers: Workers) -> None:
        """Encode an image, hold it back, or keep it with the reason why no stream takes it."""
        channel = message.channel
        state = self._state_of(channel)
        ordinal, number = state.count, self._topic_of(channel).messages - 1
        state.count += 1
        try:
            seen = state.looker.look(message)
        except Unsuited as reason:
            self._settle(state, workers)
            self._keep_verbatim(message, number, str(reason))
            return
        self._calibrations.saw(channel, seen)
        item = _Item(message, ordinal, number, seen)
        if state.is_surveyed:
            state.routes.setdefault(seen.key, _Route([], refusal=NOT_SURVEYED))
        if seen.key in state.routes and not state.held:
            self._write(state, item, workers)
            return
        state.held.append(item)
        held = Counter(other.seen.key for other in state.held)
        enough = held[seen.key] == SAMPLES or len(state.held) == 2 * SAMPLES
        if enough or not needs_trial(seen, self._settings):
            self._settle(state, workers)

    def _state_of(self, channel: Channel) -> _CameraChannel:
        if channel.identity not in self._channels:
            looker = Looker(channel, transcode=self._settings.transcode)
            state = self._channels[channel.identity] = _CameraChannel(looker)
            decisions = self._survey.decisions.get(channel.id) if self._survey else None
            if decisions is not None:
                state.is_surveyed = True
                state.routes = {item.key: self._route(channel, item) for item in decisions}
        return self._channels[channel.identity]

    def settle(self, workers: Workers) -> None:
        """Write everything that is held back: the recording is at its end."""
        for state in self._channels.values():
            self._settle(state, workers)

    def _settle(self, state: _CameraChannel, workers: Workers) -> None:
        """Decide how the held images are encoded, and write them in their order."""
        held, state.held = state.held, []
        for key in dict.fromkeys(item.seen.key for item in held):
            if key not in state.routes:
                samples = [item.seen for item in held if item.seen.key == key]
                state.routes[key] = self._plan(samples, held[0].message.channel)
        for item in held:
            self._write(state, item, workers)

    def _plan(self, samples: list[Seen], channel: Channel) -> _Route:
        return self._route(channel, decide(samples, self._settings, self._rate(channel)))

    def _route(self, channel: Channel, decision: Decision) -> _Route:
        reason = self._exact.get((channel.id, decision.key))
        if reason is None:
            return _Route(list(decision.plans), refusal=decision.refusal)
        kept = "partly kept lossless" if self._survey else "kept lossless"
        plans: list[TrackPlan] = [
            replace(plan, note=f"{kept}: {reason}")
            for plan in decision.plans
            if isinstance(plan, PicturePlan) and plan.exact
        ]
        return _Route(plans, refusal="" if plans else reason)

    def _rate(self, channel: Channel) -> float | None:
        return rate_of(self._reader, channel)

    def _write(self, state: _CameraChannel, item: _Item, workers: Workers) -> None:
        route = state.routes[item.seen.key]
        reason = route.refusal
        for stream in self._candidates(state, route, item):
            try:
                job = stream.accept(item.message, item.seen, item.ordinal)
            except Unsuited as refusal:
                reason = str(refusal)
                continue
            self._topic_of(item.message.channel).frames += 1
            if stream.frames == 1:
                self._calibrations.adopt(stream)
            workers.submit(self._streams.index(stream), job)
            return
        state.looker.leave_out(item.seen)
        self._keep_verbatim(item.message, item.number, route.refusal or reason)

    def _candidates(
        self, state: _CameraChannel, route: _Route, item: _Item
    ) -> Iterator[StreamWriter]:
        """The streams that may take a message; the next one is made when the others refuse."""
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
            except Unsuited as reason:
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
            settings=self._settings,
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

    def finish(self) -> list[PartStream]:
        """Complete all videos and write their sidecars; all jobs must have run."""
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
