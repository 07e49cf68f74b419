"""What a stream's video is made of: pictures that are encoded here, or packets as they came."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from mp4ds.coded import Refused
from mp4ds.errors import Mp4dsError
from mp4ds.layouts import ENCODINGS, Layout, layout_for
from mp4ds.plan import Quality, Target
from mp4ds.records import Channel
from mp4ds.sidecar import Color, LayoutParameters
from mp4ds.streams.columns import Unsuited
from mp4ds.streams.look import Seen, StreamKey
from mp4ds.video import PacketWriter, Recipe, VideoEncoder, recipe_for
from mp4ds.video.codecs import lossless_codecs
from mp4ds.video.encoder import EncoderRefusedError


@dataclass(frozen=True, slots=True)
class StreamSettings:
    """How streams are to be encoded.

    Attributes:
        quality: What was asked for.
        codec: Name of the codec, or None for the default.
        preset: Preset of the encoder, or None for the default.
        gop: Most frames between key frames.
        threads: Threads of each encoder.
        transcode: Whether JPEG topics are encoded anew.
    """

    quality: Quality
    codec: str | None
    preset: str | None
    gop: int
    threads: int
    transcode: bool = False


class Track(Protocol):
    """A video being written.

    Attributes:
        note: What the user should know of it; empty if nothing.
    """

    note: str

    def refuses(self, seen: Seen) -> str | None:
        """Why the track cannot carry a message exactly, or None if it can."""
        ...

    def write(self, seen: Seen, tick: int) -> None:
        """Write a message's frame.

        Args:
            seen: The message.
            tick: Presentation time in ticks, greater than the last.

        Raises:
            OSError: The disk refused.
        """
        ...

    def close(self) -> None:
        """Finish the file.

        Raises:
            OSError: The disk refused.
        """
        ...

    def abandon(self) -> None:
        """Close the file as it is; the caller removes it."""
        ...

    def describe(self) -> dict[str, Any]:
        """What `mp4ds.sidecar.Video` says of it, but for the file."""
        ...


class TrackPlan(Protocol):
    """How a track may be made."""

    @property
    def profile(self) -> str:
        """What the stream's sidecar calls it."""
        ...

    @property
    def exact(self) -> bool:
        """Whether messages come back to the byte."""
        ...

    @property
    def note(self) -> str:
        """What the user should know of it; empty if nothing."""
        ...

    def open(self, path: Path, seen: Seen, settings: StreamSettings, rate: float | None) -> Track:
        """Begin the file.

        Args:
            path: The video to make.
            seen: The first message.
            settings: How to encode.
            rate: Frames per second, where known.

        Raises:
            Unsuited: The encoder does not take such pictures.
        """
        ...


@dataclass(frozen=True, slots=True)
class PicturePlan:
    """Pictures, encoded here. See `TrackPlan`."""

    layout: Layout
    recipe: Recipe
    profile: str
    exact: bool
    note: str = ""

    def open(self, path: Path, seen: Seen, settings: StreamSettings, rate: float | None) -> Track:
        """See `TrackPlan.open`."""
        return _PictureTrack(self, path, seen.key, settings, rate)


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetPlan(PicturePlan):
    """Pictures, encoded here until they have a score. See `TrackPlan`."""

    target: Target

    def open(self, path: Path, seen: Seen, settings: StreamSettings, rate: float | None) -> Track:
        """See `TrackPlan.open`."""
        from mp4ds.streams.target import TargetTrack

        return TargetTrack(self, path, seen.key, settings, rate)


class OutOfReach(Exception):  # noqa: N818 - no error: the stream is made lossless
    """A score that frames do not have with any crf; says how far they are from it."""


class OutOfReachError(Mp4dsError):
    """A stream that was begun cannot have the score that was asked for.

    Args:
        channel: Of its messages.
        key: Of its messages.
        reason: What was tried.
    """

    def __init__(self, channel: Channel, key: StreamKey, reason: str) -> None:
        self.stream = (channel.id, key)
        self.reason = reason
        super().__init__(
            f"{channel.topic}: {reason}. Ask for less, or pack it with --quality lossless."
        )


def _recipes(plan: PicturePlan) -> Iterator[Recipe]:
    """The recipe of a plan, then those of the other codecs that hold its pictures exactly."""
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
                    gop=settings.gop,
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
        raise Unsuited(refusals[0])

    def refuses(self, seen: Seen) -> str | None:
        """See `Track.refuses`."""
        if seen.pixels is None:
            return "it has no pixels"
        return self._layout.refuses(seen.pixels)

    def write(self, seen: Seen, tick: int) -> None:
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
    """What `Track.describe` says of a video that is encoded here.

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
    """Packets as they came. See `TrackPlan`."""

    profile: str = "lossless"
    exact: bool = True
    note: str = ""

    def open(self, path: Path, seen: Seen, settings: StreamSettings, rate: float | None) -> Track:
        """See `TrackPlan.open`."""
        return _PacketTrack(path, seen, rate, self.note)


class _PacketTrack:
    """See `Track`."""

    def __init__(self, path: Path, seen: Seen, rate: float | None, note: str) -> None:
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

    def refuses(self, seen: Seen) -> str | None:
        """See `Track.refuses`."""
        if not self._begun:
            try:
                self._writer.begin(seen.parts.body)
            except Refused as reason:
                return str(reason)
            self._begun = True
        return None

    def write(self, seen: Seen, tick: int) -> None:
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
