"""Decisions made about a recording before it is packed in pieces, so that all of them agree."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

from mp4ds.bags.protocols import BagReader
from mp4ds.errors import Refused
from mp4ds.messages.serializations import MessageSplitter, is_calibration
from mp4ds.packing.calibrations import StampPairing
from mp4ds.packing.inspection import CameraMessage, MessageInspector, StreamKey
from mp4ds.packing.tracks import StreamSettings, TrackPlan, needs_trial, plan_tracks
from mp4ds.records import Channel, Excerpt, Message

SAMPLES = 6
"""Images of a stream that show how it is best encoded."""

MAX_STREAMS_PER_CHANNEL = 16
"""Limit of streams for a channel that keeps changing its geometry."""

_MAX_LOOKS = 64
# for a score: sampled places besides the first, and images at each
_PLACES, _RUN = 2, 30
_PAIRING_MESSAGES = 5_000


@dataclass(frozen=True, slots=True)
class Decision:
    """How images of one key are stored.

    Attributes:
        key: What they have in common.
        plans: The best first; none if no video is made from them.
        refusal: Why there is none.
    """

    key: StreamKey
    plans: list[TrackPlan]
    refusal: str = ""


@dataclass(frozen=True, slots=True)
class Survey:
    """What all pieces of a recording must agree on.

    Attributes:
        decisions: For the keys of each camera channel, by its id; without channels packed by a
            single piece.
        pairs: Calibration channels paired by stamps: their id -> that of the images.
    """

    decisions: Mapping[int, Sequence[Decision]] = field(default_factory=dict)
    pairs: Mapping[int, int] = field(default_factory=dict)

    @property
    def texts(self) -> list[list[str]]:
        """All of it in words: the same for equal surveys, in every process."""
        pairs = [[f"{info} belongs to {image}"] for info, image in sorted(self.pairs.items())]
        return pairs + [
            [f"{channel}: {item.key}", *(plan.text for plan in item.plans), item.refusal]
            for channel, items in sorted(self.decisions.items())
            for item in items
        ]


def rate_of(reader: BagReader, channel: Channel) -> float | None:
    """Messages per second of a channel, where an index tells."""
    stats = reader.stats().get(channel.id)
    return stats.rate if stats else None


def decide(
    samples: Sequence[CameraMessage],
    settings: StreamSettings,
    rate: float | None,
    runs: Iterable[Iterable[CameraMessage]] | None = None,
) -> Decision:
    """How images are stored, by looking at the first of them.

    Args:
        samples: The first images of one key, at least one, at most `SAMPLES`.
        settings: What was asked for.
        rate: Frames per second, where known.
        runs: Of messages of the same key, from several places of the recording; one of them at a
            time is held. None: the samples.

    Raises:
        ScoringError: A score is asked for that cannot be computed.
    """
    key = samples[0].key
    try:
        return Decision(key, plan_tracks(samples, settings, rate, runs))
    except Refused as reason:
        return Decision(key, [], str(reason))


def survey_channel(
    reader: BagReader, channel: Channel, starts: Sequence[int | None], settings: StreamSettings
) -> list[Decision]:
    """Look at a camera channel where its parts begin, and decide for each key that is there.

    Args:
        reader: The recording, indexed.
        channel: One whose messages do not depend on each other.
        starts: Log times, ns, at which parts begin; None for the recording's start.
        settings: What was asked for.
    """
    inspector = MessageInspector(channel, transcode=settings.transcode)
    decisions: dict[StreamKey, Decision] = {}
    step = -(-len(starts) // _MAX_LOOKS) or 1
    for start in starts[::step]:
        samples = _samples(reader, channel, start, inspector, settings)
        if samples and samples[0].key not in decisions:
            key = samples[0].key
            places = dict.fromkeys((start, *_places_between(starts)))
            runs = (_run(reader, channel, place, inspector, key) for place in places)
            decisions[key] = decide(samples, settings, rate_of(reader, channel), runs)
            if len(decisions) == MAX_STREAMS_PER_CHANNEL:
                break
    return list(decisions.values())


def _places_between(starts: Sequence[int | None]) -> list[int | None]:
    """Some parts' beginnings, all over the recording."""
    return [starts[len(starts) * n // (_PLACES + 1)] for n in range(1, _PLACES + 1)]


def _run(
    reader: BagReader,
    channel: Channel,
    start: int | None,
    inspector: MessageInspector,
    key: StreamKey,
) -> Iterator[CameraMessage]:
    """Images of a key from a log time on; of another one's stretch there are none."""
    left = _RUN
    excerpt = Excerpt(start=start, topics=frozenset([channel.topic]), others=False)
    for number, record in enumerate(reader.records(excerpt)):
        if isinstance(record, Message) and record.channel.id == channel.id:
            with suppress(Refused):
                seen = inspector.inspect(record)
                if seen.key == key:
                    yield seen
                    left -= 1
        if not left or number == 4 * _RUN:
            return


def _samples(
    reader: BagReader,
    channel: Channel,
    start: int | None,
    inspector: MessageInspector,
    settings: StreamSettings,
) -> list[CameraMessage]:
    """The first images of one key from a log time on, as many as needed to decide."""
    samples: list[CameraMessage] = []
    excerpt = Excerpt(start=start, topics=frozenset([channel.topic]), others=False)
    for number, record in enumerate(reader.records(excerpt)):
        if isinstance(record, Message) and record.channel.id == channel.id:
            with suppress(Refused):
                seen = inspector.inspect(record)
                if not samples or seen.key == samples[0].key:
                    samples.append(seen)
        enough = SAMPLES if samples and needs_trial(samples[0], settings) else 1
        if len(samples) == enough or number == 4 * SAMPLES:
            break
    return samples


def survey_pairs(
    reader: BagReader,
    cameras: Sequence[Channel],
    infos: Sequence[Channel],
    pairs: Mapping[int, int],
) -> dict[int, int]:
    """Pair calibrations with images by the stamps of the recording's first messages.

    Args:
        reader: The recording, indexed.
        cameras: Camera channels whose messages do not depend on each other.
        infos: Calibration channels, some of which are unpaired.
        pairs: Existing pairs.
    """
    topics = frozenset(channel.topic for channel in (*cameras, *infos))
    forms = {channel.id: MessageSplitter(channel) for channel in infos}
    inspectors = {channel.id: MessageInspector(channel) for channel in cameras}
    pairing = StampPairing()
    found = dict(pairs)
    records = reader.records(Excerpt(topics=topics, others=False))
    for number, record in enumerate(records):
        if not isinstance(record, Message) or number == _PAIRING_MESSAGES:
            break
        channel = record.channel
        try:
            if is_calibration(channel) and channel.id in forms:
                pairing.add(channel, forms[channel.id].split(record)[1])
            elif channel.id in inspectors:
                seen = inspectors[channel.id].inspect(record)
                pairing.add(channel, seen.parts, size=(seen.key.width, seen.key.height))
        except Refused:
            continue
        if number % 100 == 0:
            found.update(pairing.decide(found, final=False))
            if all(channel.id in found for channel in infos):
                break
    found.update(pairing.decide(found))
    return {info: image for info, image in found.items() if info not in pairs}
