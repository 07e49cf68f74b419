"""What a stream's video is made from: pictures encoded here, or copied packets."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from mp4ds.bags.mcap import compressed_size
from mp4ds.errors import EncoderRefusedError, OptionError, Refused
from mp4ds.format.models import Color, LayoutParameters
from mp4ds.messages.encodings import ENCODINGS
from mp4ds.messages.layouts import Layout, bind, layout_for
from mp4ds.packing.inspection import CameraMessage, StreamKey
from mp4ds.packing.options import PackOptions
from mp4ds.plan import (
    LOSSLESS,
    Purpose,
    QualitySetting,
    QualityTarget,
    parse_quality,
    visual_setting,
)
from mp4ds.video.codecs import (
    AV1,
    DEFAULT_LOSSY,
    PURPOSE_PRESET,
    Recipe,
    fastest_preset,
    lossless_codecs,
    recipe_for,
)
from mp4ds.video.encoder import VideoEncoder
from mp4ds.video.packets import PacketWriter
from mp4ds.video.trial import Choice, choose


@dataclass(frozen=True, slots=True)
class StreamSettings:
    """How to encode streams.

    Attributes:
        quality: The requested quality.
        codec: Name of the codec, or None for the default.
        preset: Preset of the encoder, or None for the default.
        gop: Most frames between key frames.
        threads: Threads of each encoder.
        transcode: Whether JPEG topics are re-encoded.
        purpose: What the dataset is for; None for nothing in particular.
        known: Texts of plans to prefer, where there is a choice.
    """

    quality: QualitySetting
    codec: str | None
    preset: str | None
    gop: int
    threads: int
    transcode: bool = False
    purpose: Purpose | None = None
    known: frozenset[str] = frozenset()

    @classmethod
    def of(cls, options: PackOptions, threads: int) -> StreamSettings:
        """Those of a pack.

        Raises:
            OptionError: An option is not valid.
        """
        return cls(
            quality=options.quality or parse_quality(LOSSLESS),
            codec=options.codec,
            preset=options.preset,
            gop=options.group_frames,
            threads=threads,
            transcode=options.transcode,
            purpose=options.purpose,
        )

    @property
    def is_fast(self) -> bool:
        """Whether to encode in the least time, with nothing tried."""
        return self.purpose is not None and self.purpose.is_speed


class Track(Protocol):
    """A video being written.

    Attributes:
        note: What the user should know about it; empty if nothing.
    """

    note: str

    def refuses(self, seen: CameraMessage) -> str | None:
        """Why the track cannot carry a message exactly, or None if it can."""
        ...

    def write(self, seen: CameraMessage, tick: int) -> None:
        """Write a message's frame.

        Args:
            seen: The message.
            tick: Presentation time in ticks, greater than the last.

        Raises:
            Refused: The video cannot reach the requested score.
            OSError: It cannot be written.
        """
        ...

    def close(self) -> None:
        """Finish the file.

        Raises:
            Refused: The video cannot reach the requested score.
            OSError: It cannot be written.
        """
        ...

    def abandon(self) -> None:
        """Close the file as it is; the caller removes it."""
        ...

    def describe(self) -> dict[str, Any]:
        """The fields of `mp4ds.format.models.Video`, except for the file."""
        ...


class TrackPlan(Protocol):
    """A way to make a track."""

    @property
    def profile(self) -> str:
        """The profile in the stream's sidecar."""
        ...

    @property
    def exact(self) -> bool:
        """Whether messages are restored byte for byte."""
        ...

    @property
    def note(self) -> str:
        """What the user should know about it; empty if nothing."""
        ...

    @property
    def text(self) -> str:
        """All that decides about the video, in words."""
        ...

    def open(
        self,
        path: Path,
        seen: CameraMessage,
        settings: StreamSettings,
        rate: float | None,
    ) -> Track:
        """Begin the file.

        Args:
            path: The video to make.
            seen: The first message.
            settings: How to encode.
            rate: Frames per second, where known.

        Raises:
            Refused: The encoder does not support such pictures.
        """
        ...


@dataclass(frozen=True, slots=True)
class PicturePlan:
    """Pictures, encoded here. See `TrackPlan`.

    Attributes:
        layout: How pixels become the picture.
        recipe: Codec and options.
        gop: Most frames between key frames; 0 for those of the settings.
    """

    layout: Layout
    recipe: Recipe
    profile: str
    exact: bool
    note: str = ""
    gop: int = 0

    @property
    def text(self) -> str:
        """All that decides about the video, in words."""
        return Choice(self.layout.name, self.layout.parameters, self.recipe, 0.0, self.gop).text

    def open(
        self,
        path: Path,
        seen: CameraMessage,
        settings: StreamSettings,
        rate: float | None,
    ) -> Track:
        """See `TrackPlan.open`."""
        return _PictureTrack(self, path, seen.key, settings, rate)


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetPlan(PicturePlan):
    """Pictures, encoded here until they reach a score. See `TrackPlan`."""

    target: QualityTarget

    def open(
        self,
        path: Path,
        seen: CameraMessage,
        settings: StreamSettings,
        rate: float | None,
    ) -> Track:
        """See `TrackPlan.open`."""
        from mp4ds.packing.target import TargetTrack

        return TargetTrack(self, path, seen.key, settings, rate)


def _recipes(plan: PicturePlan) -> Iterator[Recipe]:
    """The recipe of a plan, then those of other codecs that can hold its pictures exactly."""
    yield plan.recipe
    pixel_format = plan.layout.pixel_format
    for codec in lossless_codecs(pixel_format) if plan.recipe.lossless else ():
        if codec != plan.recipe.codec:
            yield recipe_for(pixel_format, lossless=True, codec=codec)


class _PictureTrack:
    """See `Track`."""

    def __init__(
        self,
        plan: PicturePlan,
        path: Path,
        key: StreamKey,
        settings: StreamSettings,
        rate: float | None,
    ) -> None:
        self._layout = layout = plan.layout
        self.note = plan.note
        width, height = layout.picture_size(key.width, key.height)
        refusals: list[str] = []
        for recipe in _recipes(plan):
            try:
                self._encoder = VideoEncoder(
                    path,
                    recipe,
                    picture_format=layout.pixel_format,
                    width=width,
                    height=height,
                    gop=plan.gop or settings.gop,
                    threads=settings.threads,
                    rate=rate,
                )
            except EncoderRefusedError as error:
                path.unlink(missing_ok=True)
                refusals.append(str(error))
                continue
            self._plan = replace(plan, recipe=recipe)
            if refusals:
                coded = f"coded as {recipe.codec}: {refusals[0]}"
                self.note = "; ".join(filter(None, (plan.note, coded)))
            return
        raise Refused(refusals[0])

    def refuses(self, seen: CameraMessage) -> str | None:
        """See `Track.refuses`."""
        if seen.pixels is None:
            return "it has no pixels"
        return self._layout.refuses(seen.pixels)

    def write(self, seen: CameraMessage, tick: int) -> None:
        """See `Track.write`."""
        if seen.pixels is not None:
            self._encoder.write(self._layout.to_picture(seen.pixels), tick)

    def close(self) -> None:
        """See `Track.close`."""
        self._encoder.close()

    def abandon(self) -> None:
        """See `Track.abandon`."""
        self._encoder.abandon()

    def describe(self) -> dict[str, Any]:
        """See `Track.describe`."""
        encoder = self._encoder
        return picture_facts(self._plan, (encoder.width, encoder.height), encoder.options)


def picture_facts(
    plan: PicturePlan, size: tuple[int, int], options: Mapping[str, str]
) -> dict[str, Any]:
    """`Track.describe` for a video that is encoded here.

    Args:
        plan: How it was made.
        size: Columns and rows of its pictures.
        options: Of the encoder.
    """
    layout, recipe = plan.layout, plan.recipe
    values = layout.parameters.to_values()
    return {
        "layout": layout.name,
        "parameters": LayoutParameters.model_validate(values) if values else None,
        "codec": recipe.codec,
        "pixel_format": recipe.pixel_format,
        "width": size[0],
        "height": size[1],
        "color": _color(recipe) if layout.is_shown else None,
        "encoder": recipe.encoder,
        "options": dict(options),
    }


@dataclass(frozen=True, slots=True)
class PacketPlan:
    """Packets, copied. See `TrackPlan`."""

    profile: str = "lossless"
    exact: bool = True
    note: str = ""
    text: str = "copied"

    def open(
        self,
        path: Path,
        seen: CameraMessage,
        settings: StreamSettings,
        rate: float | None,
    ) -> Track:
        """See `TrackPlan.open`."""
        return _PacketTrack(path, seen, rate, self.note)


class _PacketTrack:
    """See `Track`."""

    def __init__(
        self,
        path: Path,
        seen: CameraMessage,
        rate: float | None,
        note: str,
    ) -> None:
        self.note = note
        self._key = seen.key
        self._begun = False
        self._writer = PacketWriter(
            path,
            seen.key.codec,
            width=seen.key.width,
            height=seen.key.height,
            parameters=seen.parameters,
            rate=rate,
        )

    def refuses(self, seen: CameraMessage) -> str | None:
        """See `Track.refuses`."""
        if not self._begun:
            try:
                self._writer.begin(seen.parts.body)
            except Refused as reason:
                return str(reason)
            self._begun = True
        return None

    def write(self, seen: CameraMessage, tick: int) -> None:
        """See `Track.write`."""
        self._writer.write(seen.parts.body, tick, keyframe=seen.keyframe)

    def close(self) -> None:
        """See `Track.close`."""
        self._writer.close()

    def abandon(self) -> None:
        """See `Track.abandon`."""
        self._writer.abandon()

    def describe(self) -> dict[str, Any]:
        """See `Track.describe`."""
        key = self._key
        return {
            "layout": layout_for(ENCODINGS[key.encoding], lossless=False).name,
            "codec": key.codec,
            "width": key.width,
            "height": key.height,
        }


def _color(recipe: Recipe) -> Color:
    return Color(
        primaries="bt709",
        transfer="bt709",
        matrix=recipe.matrix,
        range="full" if recipe.full_range else "limited",
    )


# ---------------------------------------------------------------- planning

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
        return [PacketPlan(note=_KEPT_JPEG if can_shrink else "")]
    if not _is_lossless(first.key.encoding, settings):
        plan = _lossy_plan(first.key, settings, rate)
        target = settings.quality.target
        if target is None:
            return [plan]
        return _target_plans(plan, target, samples, runs, settings, rate)
    if settings.is_fast:
        return _fast_plans(samples[0], settings)
    return _lossless_plans(samples, settings)


_SCORE_PRESET = "8"
"""SVT-AV1's preset for a score: a window is encoded several times, and preset 7 at its lowest crf
gets less close to a noisy original."""


def _lossy_plan(key: StreamKey, settings: StreamSettings, rate: float | None) -> PicturePlan:
    quality = settings.quality
    layout = layout_for(ENCODINGS[key.encoding], lossless=False)
    crf, preset = quality.crf, settings.preset
    if settings.is_fast and quality.target is None:
        preset = preset or fastest_preset(settings.codec or DEFAULT_LOSSY)
    if crf is None:  # the search for a score starts there
        crf, table_preset = visual_setting(rate)
        if settings.codec in (None, *AV1):
            usual = PURPOSE_PRESET if settings.purpose else str(table_preset)
            preset = preset or (_SCORE_PRESET if quality.target else usual)
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
    target: QualityTarget,
    samples: Sequence[CameraMessage],
    runs: Iterable[Iterable[CameraMessage]] | None,
    settings: StreamSettings,
    rate: float | None,
) -> list[TrackPlan]:
    """A plan that reaches a score, and one for images that cannot."""
    from mp4ds.packing.target import target_plan

    key = samples[0].key
    is_jpeg = key.body == "jpeg"
    try:
        found = target_plan(plan, target, key, runs or [samples], settings, rate)
    except EncoderRefusedError as error:
        raise Refused(str(error)) from None
    except Refused as reason:
        if is_jpeg:  # which is smaller than any lossless video of its pixels
            raise
        return _lossless_plans(samples, settings, f"kept lossless: {reason}")
    if is_jpeg:
        return [found]
    general = layout_for(plan.layout.encoding, lossless=True)
    recipe = recipe_for(general.pixel_format, lossless=True)
    return [found, PicturePlan(general, recipe, "lossless", exact=True)]


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
        gop=settings.gop,
        threads=settings.threads,
        purpose=settings.purpose,
        known=settings.known,
    )
    codec = settings.codec if asked else None  # otherwise they were meant for lossy videos
    try:
        try:
            best = tried(codec=codec, preset=settings.preset if asked else None)
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
    plan = PicturePlan(layout, best.recipe, "lossless", exact=True, note=note, gop=best.gop)
    general = layout_for(encoding, lossless=True)
    if general.name == layout.name:
        return [plan]
    recipe = recipe_for(general.pixel_format, lossless=True)
    return [plan, PicturePlan(general, recipe, "lossless", exact=True)]


def _fast_plans(seen: CameraMessage, settings: StreamSettings) -> list[TrackPlan]:
    """Without loss, by what encodes in the least time (spec/notes.md)."""
    layout = layout_for(ENCODINGS[seen.key.encoding], lossless=True)
    able = lossless_codecs(layout.pixel_format)
    codec, preset = settings.codec, settings.preset
    if codec is None or codec not in able:  # of those that are, H.264 has the fastest presets
        codec, preset = ("h264" if "h264" in able else able[0]), None
    preset = preset or fastest_preset(codec)
    recipe = recipe_for(layout.pixel_format, lossless=True, codec=codec, preset=preset)
    return [PicturePlan(layout, recipe, "lossless", exact=True)]


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
