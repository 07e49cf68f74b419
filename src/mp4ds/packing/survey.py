"""Decisions made before a recording is packed: how images are stored, whose calibrations are whose.

All pieces of a long recording agree on them.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from mp4ds.bags.mcap import compressed_size
from mp4ds.bags.protocols import BagReader
from mp4ds.errors import EncoderRefusedError, OptionError, Refused
from mp4ds.messages.encodings import ENCODINGS
from mp4ds.messages.layouts import bind, layout_for
from mp4ds.messages.serializations import MessageSplitter, is_calibration
from mp4ds.packing.calibrations import StampPairing
from mp4ds.packing.inspection import CameraMessage, MessageInspector, StreamKey
from mp4ds.packing.options import PackOptions
from mp4ds.packing.tracks import FALLS, Coding, TrackPlan, WindowCoder, out_of_reach
from mp4ds.plan import (
    LOSSLESS,
    QualitySetting,
    QualityTarget,
    parse_quality,
    visual_setting,
)
from mp4ds.records import Channel, Excerpt, Message
from mp4ds.times import TIMESCALE
from mp4ds.video.codecs import (
    AV1,
    DEFAULT_LOSSY,
    LEAST_CRF,
    MAX_CRF,
    PURPOSE_PRESET,
    fastest_preset,
    lossless_codecs,
    recipe_for,
)
from mp4ds.video.encoder import choose
from mp4ds.video.scores import SMALLEST, largest_crf


@dataclass(frozen=True, slots=True)
class StreamSettings:
    """How to encode streams.

    Attributes:
        options: Of the pack.
        threads: Of each encoder.
        known: Texts of plans to prefer, where there is a choice.
    """

    options: PackOptions
    threads: int
    known: frozenset[str] = frozenset()

    @property
    def quality(self) -> QualitySetting:
        """The requested quality."""
        return self.options.quality or parse_quality(LOSSLESS)

    @property
    def is_fast(self) -> bool:
        """Whether to encode in the least time, with nothing tried."""
        purpose = self.options.purpose
        return purpose is not None and purpose.is_speed


# ---------------------------------------------------------------- one key

_KEPT_JPEG = "JPEG files are kept as they are; --transcode re-encodes them"
_MANY = 6  # files, after which any number may follow
_STREAM_BYTES = 3_000  # bytes of a video without frames, and of its sidecar
_NEGLIGIBLE = 1 / 50
"""Share of the raw size below which a video is kept even if zstd would be smaller."""


def needs_trial(seen: CameraMessage, settings: StreamSettings) -> bool:
    """Whether `plan_tracks` benefits from having several messages."""
    if seen.pixels is None or settings.is_fast:
        return False
    if settings.quality.target is not None:
        return True
    return seen.key.body != "jpeg" and _is_lossless(seen.key.encoding, settings)


def _is_lossless(encoding: str, settings: StreamSettings) -> bool:
    return settings.quality.lossless or ENCODINGS[encoding].lossy is None


def plan_tracks(
    samples: Sequence[CameraMessage],
    settings: StreamSettings,
    rate: float | None,
    runs: Iterable[Iterable[CameraMessage]] | None = None,
) -> list[TrackPlan]:
    """How the messages of one key are stored in videos.

    Args:
        samples: The first messages, at least one.
        settings: The requested settings.
        rate: Frames per second, where known.
        runs: Runs of messages of the same key from several places of the recording, to choose the
            crf for a score. None: the samples.

    Returns:
        The best plan first; the last one accepts every message of the key.

    Raises:
        Refused: A video would be larger than the messages compressed by zstd, or cannot reach the
            requested score.
        ScoringError: VMAF cannot be computed.
    """
    first = samples[0]
    if first.pixels is None:
        can_shrink = first.key.codec == "mjpeg" and not settings.quality.lossless
        return [TrackPlan(note=_KEPT_JPEG if can_shrink else "")]
    if not _is_lossless(first.key.encoding, settings):
        plan = _lossy_plan(first.key, settings, rate)
        if plan.coding is None or plan.target is None:
            return [plan]
        return _scored_plans(plan.coding, plan.target, samples, runs, settings, rate)
    if settings.is_fast:
        return _fast_plans(samples[0], settings)
    return _lossless_plans(samples, settings)


_SCORE_PRESET = "8"
"""SVT-AV1's preset for a score: a window is encoded several times, and preset 7 at its lowest crf
gets less close to a noisy original."""


def _lossy_plan(key: StreamKey, settings: StreamSettings, rate: float | None) -> TrackPlan:
    quality = settings.quality
    layout = layout_for(ENCODINGS[key.encoding], lossless=False)
    crf, preset = quality.crf, settings.options.preset
    if settings.is_fast and quality.target is None:
        preset = preset or fastest_preset(settings.options.codec or DEFAULT_LOSSY)
    if crf is None:  # the search for a score starts there
        crf, table_preset = visual_setting(rate)
        if settings.options.codec in (None, *AV1):
            usual = PURPOSE_PRESET if settings.options.purpose else str(table_preset)
            preset = preset or (_SCORE_PRESET if quality.target else usual)
    recipe = recipe_for(
        layout.pixel_format,
        lossless=False,
        codec=settings.options.codec,
        crf=crf,
        preset=preset,
        varied=quality.target is not None,
    )
    return TrackPlan(
        Coding(layout, recipe, settings.options.group_frames), str(quality), quality.target
    )


def _scored_plans(
    coding: Coding,
    target: QualityTarget,
    samples: Sequence[CameraMessage],
    runs: Iterable[Iterable[CameraMessage]] | None,
    settings: StreamSettings,
    rate: float | None,
) -> list[TrackPlan]:
    """A plan that reaches a score, and one for images that cannot."""
    key = samples[0].key
    is_jpeg = key.body == "jpeg"
    coder = WindowCoder(coding, (key.width, key.height), target, settings.threads, rate)
    try:
        if min(coder.coded_size) < SMALLEST:
            raise Refused(f"images with less than {SMALLEST} rows or columns have no {target}")
        with tempfile.TemporaryDirectory(prefix="mp4ds-") as folder:
            crf = _start_crf(coder, runs or [samples], Path(folder))
    except EncoderRefusedError as error:
        raise Refused(str(error)) from None
    except Refused as reason:
        if is_jpeg:  # which is smaller than any lossless video of its pixels
            raise
        return _lossless_plans(samples, settings, f"kept lossless: {reason}")
    found = TrackPlan(coding.with_crf(crf), str(target), target)
    return (
        [found] if is_jpeg else [found, _general_plan(key.encoding, settings.options.group_frames)]
    )


_MOST_SEARCHED = 5  # encodings of the samples
_USUAL_RATE = 30.0


def _start_crf(coder: WindowCoder, runs: Iterable[Iterable[CameraMessage]], folder: Path) -> int:
    """The crf at which samples of a stream reach the score.

    Raises:
        Refused: No crf reaches it.
    """
    maker, target = coder.maker(), coder.target
    least = LEAST_CRF[coder.coding.recipe.codec]
    spools = []
    try:
        for number, run in enumerate(runs):
            spools.append(coder.spool(folder / f"{number}.yuv"))
            for seen in run:
                if seen.pixels is not None:
                    spools[-1].append(maker.make(coder.coding.layout.to_picture(seen.pixels)))
        filled = [spool for spool in spools if len(spool)]
        due = float(np.mean([coder.reachable(spool) for spool in filled]))

        known: dict[int, float] = {}

        def score(crf: int) -> float:
            video = folder / "sample.mp4"
            step = round(TIMESCALE / (coder.rate or _USUAL_RATE)) or 1
            found = []
            for spool in filled:
                ticks = range(0, len(spool) * step, step)
                found.append(coder.mean(coder.encode(spool, ticks, crf, video)))
            known[crf] = float(np.mean(found))
            return known[crf]

        crf, reached, _ = largest_crf(
            score,
            due,
            guess=coder.coding.crf,
            largest=MAX_CRF[coder.coding.recipe.codec],
            smallest=least,
            fall=FALLS[target.metric],
            most=_MOST_SEARCHED,
        )
        # a few frames have less VMAF than many, compared with their originals too: where they fall
        # a little short, the first window tells
        if not reached and crf == least and known[crf] < due - target.tolerance:
            raise out_of_reach(target, due, f"crf {crf} gives {known[crf]:.2f}")
        return crf
    finally:
        for spool in spools:
            spool.close()


def _general_plan(encoding: str, gop: int) -> TrackPlan:
    """Without loss, for every image of an encoding."""
    layout = layout_for(ENCODINGS[encoding], lossless=True)
    return TrackPlan(Coding(layout, recipe_for(layout.pixel_format, lossless=True), gop))


def _lossless_plans(
    samples: Sequence[CameraMessage], settings: StreamSettings, note: str = ""
) -> list[TrackPlan]:
    encoding = ENCODINGS[samples[0].key.encoding]
    pixels = [seen.pixels for seen in samples if seen.pixels is not None]
    asked = settings.quality.lossless
    if not (asked or note):
        note = f"{encoding.name} is kept lossless"
    tried = partial(
        choose,
        pixels,
        encoding,
        gop=settings.options.group_frames,
        threads=settings.threads,
        purpose=settings.options.purpose,
        known=settings.known,
    )
    codec = settings.options.codec if asked else None  # otherwise they were meant for lossy videos
    try:
        try:
            best = tried(codec=codec, preset=settings.options.preset if asked else None)
        except (OptionError, EncoderRefusedError) as error:
            if codec is None:
                raise
            best = tried(codec=None, preset=None)
            note = "; ".join(filter(None, (note, f"coded as {best.recipe.codec}: {error}")))
    except EncoderRefusedError as error:
        raise Refused(str(error)) from None
    _refuse_noise(samples, best.bytes_per_frame)
    if codec is None:
        _refuse_few(samples, best.bytes_per_frame)
    layout = bind(best.layout, encoding, best.parameters)
    plan = TrackPlan(Coding(layout, best.recipe, best.gop), note=note)
    if layout.name == encoding.general:
        return [plan]
    return [plan, _general_plan(encoding.name, settings.options.group_frames)]


def _fast_plans(seen: CameraMessage, settings: StreamSettings) -> list[TrackPlan]:
    """Without loss, by what encodes in the least time (spec/notes.md)."""
    layout = layout_for(ENCODINGS[seen.key.encoding], lossless=True)
    able = lossless_codecs(layout.pixel_format)
    codec, preset = settings.options.codec, settings.options.preset
    if codec is None or codec not in able:  # of those that are, H.264 has the fastest presets
        codec, preset = ("h264" if "h264" in able else able[0]), None
    preset = preset or fastest_preset(codec)
    recipe = recipe_for(layout.pixel_format, lossless=True, codec=codec, preset=preset)
    return [TrackPlan(Coding(layout, recipe, settings.options.group_frames))]


def _refuse_noise(samples: Sequence[CameraMessage], video_size: float) -> None:
    """Refuse images that a video would not make smaller.

    Raises:
        Refused: Gives both sizes.
    """
    bodies = [seen.parts.body for seen in samples]
    raw = sum(map(len, bodies)) / len(bodies)
    if video_size <= raw * _NEGLIGIBLE:
        return
    verbatim = compressed_size(bodies) / len(bodies)
    if video_size > verbatim:
        raise Refused(
            f"a video would not be smaller: about {video_size / verbatim:.2f} times as large"
        )


def _refuse_few(samples: Sequence[CameraMessage], video_size: float) -> None:
    """Refuse a few files that are smaller than their video with its index and sidecar.

    Raises:
        Refused: They are.
    """
    is_file = samples[0].key.body in ("png", "rvl")
    if not is_file or len(samples) >= _MANY:
        return
    stored = sum(len(seen.parts.body) for seen in samples)
    if stored < _STREAM_BYTES + len(samples) * video_size:
        raise Refused("so few small files take less than a video with its sidecar")


# ---------------------------------------------------------------- the recording

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
    inspector = MessageInspector(channel, transcode=settings.options.transcode)
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
