"""How images are stored: decided by the first of each kind, or for all parts of a recording."""

from __future__ import annotations

import tempfile
from collections.abc import Collection, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path

from mp4ds.bags.mcap import compressed_size
from mp4ds.bags.protocols import BagReader
from mp4ds.errors import EncoderRefusedError, OptionError, Refused
from mp4ds.messages.encodings import ENCODINGS
from mp4ds.messages.layouts import layout_for
from mp4ds.packing.inspection import CameraMessage, MessageInspector, StreamKey
from mp4ds.packing.options import PackOptions
from mp4ds.packing.tracks import FALLS, TrackPlan, WindowCoder, out_of_reach
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
    visual_setting,
)
from mp4ds.video.encoder import Coding, choose
from mp4ds.video.scores import SMALLEST, largest_crf

SAMPLES = 6
"""Images of a stream that show how it is best encoded."""

MAX_STREAMS_PER_CHANNEL = 16
"""Limit of streams for a channel that keeps changing its geometry."""

_MAX_LOOKS = 64
_KEPT_JPEG = "JPEG files are kept as they are; --transcode re-encodes them"
_MANY = 6  # files, after which any number may follow
_STREAM_BYTES = 3_000  # bytes of a video without frames, and of its sidecar
_NEGLIGIBLE = 1 / 50
"""Share of the raw size below which a video is kept even if zstd would be smaller."""


@dataclass(frozen=True, slots=True)
class Decision:
    """How images of one key are stored.

    Attributes:
        key: What they have in common.
        plans: The best first, ending with one for every image; none if they get no video.
        refusal: Why they get none.
    """

    key: StreamKey
    plans: Sequence[TrackPlan] = ()
    refusal: str = ""

    @property
    def texts(self) -> list[str]:
        """All of it in words: the same for equal decisions, in every process."""
        return [str(self.key), *(plan.text for plan in self.plans), self.refusal]


def decide(
    samples: Sequence[CameraMessage],
    options: PackOptions,
    threads: int,
    rate: float | None,
    known: Collection[str] = (),
) -> Decision:
    """How images are stored, by looking at the first of them.

    Args:
        samples: The first images of one key, at least one, at most `SAMPLES`.
        options: What was asked for.
        threads: Of an encoder.
        rate: Frames per second, where known.
        known: Texts of plans to prefer, where there is a choice.

    Raises:
        ScoringError: A score is asked for that cannot be computed.
    """
    first = samples[0]
    try:
        if first.pixels is None:
            can_shrink = first.key.codec == "mjpeg" and not options.goal.lossless
            plans = [TrackPlan(note=_KEPT_JPEG if can_shrink else "")]
        elif not _is_lossless(first.key, options):
            plans = _lossy_plans(samples, options, threads, rate)
        elif options.is_fast:
            plans = [_fast_plan(first.key, options)]
        else:
            plans = _lossless_plans(samples, options, threads, known)
        return Decision(first.key, plans)
    except Refused as reason:
        return Decision(first.key, refusal=str(reason))


def needs_trial(seen: CameraMessage, options: PackOptions) -> bool:
    """Whether `decide` benefits from having several messages."""
    if seen.pixels is None or options.is_fast:
        return False
    is_tried = seen.key.body != "jpeg" and _is_lossless(seen.key, options)
    return is_tried or options.goal.target is not None


def _is_lossless(key: StreamKey, options: PackOptions) -> bool:
    return options.goal.lossless or ENCODINGS[key.encoding].lossy is None


# ---------------------------------------------------------------- lossy

_SCORE_PRESET = "8"
"""SVT-AV1's preset for a score: a window is encoded several times, and preset 7 at its lowest crf
gets less close to a noisy original."""

_MOST_SEARCHED = 5  # encodings of the samples
_USUAL_RATE = 30.0


def _lossy_plans(
    samples: Sequence[CameraMessage], options: PackOptions, threads: int, rate: float | None
) -> list[TrackPlan]:
    quality = options.goal
    key, target = samples[0].key, quality.target
    layout = layout_for(ENCODINGS[key.encoding], lossless=False)
    crf, preset = quality.crf, options.preset
    if options.is_fast and target is None:
        preset = preset or fastest_preset(options.codec or DEFAULT_LOSSY)
    if crf is None:  # the search for a score starts there
        crf, table_preset = visual_setting(rate)
        if options.codec in (None, *AV1):
            usual = PURPOSE_PRESET if options.purpose else str(table_preset)
            preset = preset or (_SCORE_PRESET if target else usual)
    recipe = recipe_for(
        layout.pixel_format,
        lossless=False,
        codec=options.codec,
        crf=crf,
        preset=preset,
        varied=target is not None,
    )
    coding = Coding(layout, recipe, options.group_frames)
    if target is None:
        return [TrackPlan(coding, str(quality))]
    coder = WindowCoder(coding, (key.width, key.height), target, threads, rate)
    is_jpeg = key.body == "jpeg"
    try:
        plan = TrackPlan(coding.with_crf(_start_crf(coder, samples)), str(target), target)
    except EncoderRefusedError as error:
        raise Refused(str(error)) from None
    except Refused as reason:
        if is_jpeg:  # which is smaller than any lossless video of its pixels
            raise
        return _lossless_plans(samples, options, threads, note=f"kept lossless: {reason}")
    # for images that cannot reach it
    return [plan] if is_jpeg else [plan, _general_plan(key, options)]


def _start_crf(coder: WindowCoder, samples: Sequence[CameraMessage]) -> int:
    """The crf at which the first images of a stream reach the score.

    Raises:
        Refused: No crf reaches it.
    """
    target, codec = coder.target, coder.coding.recipe.codec
    if min(coder.coded_size) < SMALLEST:
        raise Refused(f"images with less than {SMALLEST} rows or columns have no {target}")
    step = round(TIMESCALE / (coder.rate or _USUAL_RATE)) or 1
    known: dict[int, float] = {}
    with (
        tempfile.TemporaryDirectory(prefix="mp4ds-") as name,
        closing(coder.spool(Path(name, "frames.yuv"))) as spool,
    ):
        for seen in samples:
            coder.keep(seen, spool)
        due = coder.reachable(spool)

        def score(crf: int) -> float:
            ticks = range(0, len(spool) * step, step)
            known[crf] = coder.mean(coder.encode(spool, ticks, crf, Path(name, "sample.mp4")))
            return known[crf]

        least = LEAST_CRF[codec]
        crf, reached = largest_crf(
            score,
            due,
            guess=coder.coding.crf,
            largest=MAX_CRF[codec],
            smallest=least,
            fall=FALLS[target.metric],
            most=_MOST_SEARCHED,
        )
    # a few frames have less VMAF than many, compared with their originals too: where they fall
    # a little short, the first window tells
    if not reached and crf == least and known[crf] < due - target.tolerance:
        raise out_of_reach(target, due, f"crf {crf} gives {known[crf]:.2f}")
    return crf


# ---------------------------------------------------------------- lossless


def _general_plan(key: StreamKey, options: PackOptions) -> TrackPlan:
    """For every image of an encoding."""
    layout = layout_for(ENCODINGS[key.encoding], lossless=True)
    recipe = recipe_for(layout.pixel_format, lossless=True)
    return TrackPlan(Coding(layout, recipe, options.group_frames))


def _lossless_plans(
    samples: Sequence[CameraMessage],
    options: PackOptions,
    threads: int,
    known: Collection[str] = (),
    note: str = "",
) -> list[TrackPlan]:
    encoding = ENCODINGS[samples[0].key.encoding]
    pixels = [seen.pixels for seen in samples if seen.pixels is not None]
    asked = options.goal.lossless
    if not (asked or note):
        note = f"{encoding.name} is kept lossless"
    tried = partial(
        choose,
        pixels,
        encoding,
        gop=options.group_frames,
        threads=threads,
        purpose=options.purpose,
        known=known,
    )
    codec = options.codec if asked else None  # otherwise they were meant for lossy videos
    try:
        try:
            best = tried(codec=codec, preset=options.preset if asked else None)
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
    plan = TrackPlan(best, note=note)
    if best.layout.name == encoding.general:
        return [plan]
    return [plan, _general_plan(samples[0].key, options)]


def _fast_plan(key: StreamKey, options: PackOptions) -> TrackPlan:
    """By what encodes in the least time (spec/notes.md)."""
    layout = layout_for(ENCODINGS[key.encoding], lossless=True)
    able = lossless_codecs(layout.pixel_format)
    codec, preset = options.codec, options.preset
    if codec is None or codec not in able:  # of those that are, H.264 has the fastest presets
        codec, preset = ("h264" if "h264" in able else able[0]), None
    preset = preset or fastest_preset(codec)
    recipe = recipe_for(layout.pixel_format, lossless=True, codec=codec, preset=preset)
    return TrackPlan(Coding(layout, recipe, options.group_frames))


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


# ---------------------------------------------------------------- all parts of a recording


def survey_channel(
    reader: BagReader,
    channel: Channel,
    starts: Sequence[int | None],
    options: PackOptions,
    known: Collection[str],
) -> list[Decision]:
    """Look at a camera channel where its parts begin, and decide for each key that is there.

    Args:
        reader: The recording, indexed.
        channel: One whose messages do not depend on each other.
        starts: Log times, ns, at which parts begin; None for the recording's start.
        options: What was asked for.
        known: As for `decide`.
    """
    inspector = MessageInspector(channel, transcode=options.transcode)
    stats = reader.stats().get(channel.id)
    decisions: dict[StreamKey, Decision] = {}
    step = -(-len(starts) // _MAX_LOOKS) or 1
    for start in starts[::step]:
        excerpt = Excerpt(start=start, topics=frozenset([channel.topic]), others=False)
        samples = _samples(inspector, channel, reader.records(excerpt), options)
        if samples and samples[0].key not in decisions:
            # one thread: on other cores, a pack that is resumed has to decide the same
            decision = decide(samples, options, 1, stats.rate if stats else None, known)
            decisions[decision.key] = decision
            if len(decisions) == MAX_STREAMS_PER_CHANNEL:
                break
    return list(decisions.values())


def _samples(
    inspector: MessageInspector, channel: Channel, records: Iterator[object], options: PackOptions
) -> list[CameraMessage]:
    """The first images of one key, as many as needed to decide."""
    samples: list[CameraMessage] = []
    for record in islice(records, 4 * SAMPLES):
        if isinstance(record, Message) and record.channel.id == channel.id:
            with suppress(Refused):
                seen = inspector.inspect(record)
                if not samples or seen.key == samples[0].key:
                    samples.append(seen)
        enough = SAMPLES if samples and needs_trial(samples[0], options) else 1
        if len(samples) == enough:
            break
    return samples
