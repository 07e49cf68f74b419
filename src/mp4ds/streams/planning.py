"""How the messages of a stream are stored in videos: the choice of the tracks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

from mp4ds.bags.mcap_write import compressed_size
from mp4ds.errors import OptionError
from mp4ds.layouts import ENCODINGS, Parameters, bind, layout_for
from mp4ds.plan import Target, visual_setting
from mp4ds.streams.columns import Unsuited
from mp4ds.streams.look import Seen, StreamKey
from mp4ds.streams.tracks import (
    OutOfReach,
    PacketPlan,
    PicturePlan,
    StreamSettings,
    TargetPlan,
    TrackPlan,
)
from mp4ds.video import choose, recipe_for, remade
from mp4ds.video.codecs import AV1
from mp4ds.video.encoder import EncoderRefusedError

_KEPT_JPEG = "JPEG files are kept as they are; --transcode encodes them anew"
_NEGLIGIBLE = 1 / 50
"""Of the raw size: a video as small as this is kept although zstd would be smaller still."""


def needs_trial(seen: Seen, settings: StreamSettings) -> bool:
    """Whether `plan_tracks` is better for having several messages."""
    if seen.pixels is None:
        return False
    if settings.quality.target is not None:
        return True
    return seen.key.body != "jpeg" and _is_lossless(seen.key.encoding, settings)


def _is_lossless(encoding: str, settings: StreamSettings) -> bool:
    return settings.quality.lossless or ENCODINGS[encoding].lossy is None


def plan_tracks(
    samples: Sequence[Seen],
    settings: StreamSettings,
    rate: float | None,
    runs: Iterable[Iterable[Seen]] | None = None,
) -> list[TrackPlan]:
    """How the messages of one key are stored in videos.

    Args:
        samples: The first messages, at least one.
        settings: What was asked for.
        rate: Frames per second, where known.
        runs: Of messages of the same key, from several places of the recording, by which the crf
            for a score is chosen. None: the samples.

    Returns:
        The best plan first; the last one takes every message of the key.

    Raises:
        Unsuited: A video would be larger than the messages are by zstd, or cannot have the
            score that was asked for.
        ScoringError: VMAF cannot be computed.
    """
    first = samples[0]
    if first.pixels is None:
        can_shrink = first.key.codec == "mjpeg" and not settings.quality.lossless
        return [PacketPlan(note=_KEPT_JPEG if can_shrink else "")]
    if not _is_lossless(first.key.encoding, settings):
        plan = _lossy_plan(first.key, settings, rate)
        target = settings.quality.target
        if target is None:
            return [plan]
        return _target_plans(plan, target, samples, runs, settings, rate)
    return _lossless_plans(samples, settings)


def _lossy_plan(key: StreamKey, settings: StreamSettings, rate: float | None) -> PicturePlan:
    quality = settings.quality
    layout = layout_for(ENCODINGS[key.encoding], lossless=False)
    crf, preset = quality.crf, settings.preset
    if crf is None:  # a score is looked for from there
        crf, table_preset = visual_setting(rate)
        if settings.codec in (None, *AV1):
            preset = preset or str(table_preset)
    recipe = recipe_for(
        layout.pixel_format,
        lossless=False,
        codec=settings.codec,
        crf=crf,
        preset=preset,
        varied=quality.target is not None,
    )
    return PicturePlan(layout, recipe, str(quality), exact=False)


def _target_plans(
    plan: PicturePlan,
    target: Target,
    samples: Sequence[Seen],
    runs: Iterable[Iterable[Seen]] | None,
    settings: StreamSettings,
    rate: float | None,
) -> list[TrackPlan]:
    """A plan that keeps a score, and one for images that cannot have it."""
    from mp4ds.streams.target import target_plan

    key = samples[0].key
    is_jpeg = key.body == "jpeg"
    try:
        found = target_plan(plan, target, key, runs or [samples], settings, rate)
    except EncoderRefusedError as error:
        raise Unsuited(str(error)) from None
    except OutOfReach as reason:
        if is_jpeg:  # which is smaller than any lossless video of its pixels
            raise Unsuited(str(reason)) from None
        return _lossless_plans(samples, settings, f"kept lossless: {reason}")
    if is_jpeg:
        return [found]
    general = layout_for(plan.layout.encoding, lossless=True)
    recipe = recipe_for(general.pixel_format, lossless=True)
    return [found, PicturePlan(general, recipe, "lossless", exact=True)]


def _lossless_plans(
    samples: Sequence[Seen], settings: StreamSettings, note: str = ""
) -> list[TrackPlan]:
    encoding = ENCODINGS[samples[0].key.encoding]
    pixels = [seen.pixels for seen in samples if seen.pixels is not None]
    asked = settings.quality.lossless
    if not (asked or note):
        note = f"{encoding.name} is kept lossless"
    tried = partial(choose, pixels, encoding, gop=settings.gop, threads=settings.threads)
    codec = settings.codec if asked else None  # else they were meant for lossy videos
    try:
        try:
            best = tried(codec=codec, preset=settings.preset if asked else None)
        except (OptionError, EncoderRefusedError) as error:
            if codec is None:
                raise
            best = tried(codec=None, preset=None)
            note = "; ".join(filter(None, (note, f"coded as {best.recipe.codec}: {error}")))
    except EncoderRefusedError as error:
        raise Unsuited(str(error)) from None
    _refuse_noise(samples, best.bytes_per_frame)
    layout = bind(best.layout, encoding, best.parameters)
    plan = PicturePlan(layout, best.recipe, "lossless", exact=True, note=note)
    general = layout_for(encoding, lossless=True)
    if general.name == layout.name:
        return [plan]
    recipe = recipe_for(general.pixel_format, lossless=True)
    return [plan, PicturePlan(general, recipe, "lossless", exact=True)]


def _refuse_noise(samples: Sequence[Seen], video_size: float) -> None:
    """Refuse what a video would not make smaller.

    Raises:
        Unsuited: Tells both sizes.
    """
    bodies = [seen.parts.body for seen in samples]
    raw = sum(map(len, bodies)) / len(bodies)
    if video_size <= raw * _NEGLIGIBLE:
        return
    verbatim = compressed_size(bodies) / len(bodies)
    if video_size > verbatim:
        raise Unsuited(
            f"a video would not be smaller: about {video_size / verbatim:.2f} times as large"
        )


def plan_to_values(plan: TrackPlan) -> dict[str, Any]:
    """A plan as JSON has it."""
    values = {"profile": plan.profile, "exact": plan.exact, "note": plan.note}
    if isinstance(plan, PicturePlan):
        layout = plan.layout
        values["layout"] = layout.name
        values["encoding"] = layout.encoding.name
        values["parameters"] = layout.parameters.to_values()
        values["recipe"] = asdict(plan.recipe)
    if isinstance(plan, TargetPlan):
        values["target"] = asdict(plan.target)
    return values


def plan_from_values(values: Mapping[str, Any]) -> TrackPlan:
    """The plan that `plan_to_values` was given.

    Raises:
        ValueError: It is none, or encodes as this version never does.
    """
    common = {name: values[name] for name in ("profile", "exact", "note")}
    if "recipe" not in values:
        return PacketPlan(**common)
    parameters = Parameters.from_values(values["parameters"])
    layout = bind(values["layout"], ENCODINGS[values["encoding"]], parameters)
    recipe = remade(layout.pixel_format, values["recipe"])
    if "target" in values:
        return TargetPlan(layout, recipe, target=Target(**values["target"]), **common)
    return PicturePlan(layout, recipe, **common)
