"""How to unpack, and what came of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from mp4ds.options import WHAT, SliceOptions, force, jpeg_quality, latched, option
from mp4ds.records import Loss
from mp4ds.unpacking.pictures import KINDS, ReductionOptions
from mp4ds.unpacking.republish import Republished


@dataclass(frozen=True, kw_only=True)
class UnpackOptions(SliceOptions, ReductionOptions):
    """How to unpack."""

    latched: bool = latched()
    salvage: bool = option("Restore what can be read of a damaged dataset.", False, panel=WHAT)
    storage: str | None = option(
        "Storage of rosbag2: sqlite3 or mcap; default: as recorded, else mcap.",
        choices=("sqlite3", "mcap"),
    )
    image_format: str | None = option(
        "png (exact) or jpeg, for `to` images; default: JPEG files as recorded, others as png.",
        choices=("png", "jpeg"),
    )
    images: str | None = option(
        "Convert all cameras to raw, jpeg, png, compressed-video or ffmpeg messages; "
        "default: as recorded.",
        metavar="KIND",
        choices=KINDS,
    )
    jpeg_quality: int = jpeg_quality()
    skip_unconvertible: bool = option(
        "Leave out, and count, what the output format cannot hold.", False
    )
    force: bool = force()


@dataclass(frozen=True)
class UnpackProgress:
    """Progress of an unpack: messages written, and their total (0: unknown)."""

    messages: int
    messages_total: int


@dataclass(frozen=True)
class UnpackSummary:
    """The result of an unpack.

    Attributes:
        output: The recording or folder made.
        messages: Messages written, by topic.
        converted: Types converted between ROS 1 and ROS 2, by topic.
        omitted: What the target cannot hold and was left out: a phrase -> how many.
        left_out: Topics left out on request.
        republished: The results for topics whose images are converted.
        as_recorded: If a conversion was requested, the camera topics with messages that stay as
            recorded: reason -> how many.
        unconvertible: Topics with messages left out because the target cannot hold them:
            reason -> how many.
        thinned: Topics with messages left out because fewer were requested -> how many.
        latched: Latched messages from before the slice, by topic.
        latched_left_out: Latched topics whose messages from before it are too large.
        losses: What could not be read, if a damaged dataset is salvaged.
        notes: Other deviations from the recording.
    """

    output: Path
    messages: dict[str, int] = field(default_factory=dict)
    converted: list[str] = field(default_factory=list)
    omitted: dict[str, int] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)
    republished: dict[str, Republished] = field(default_factory=dict)
    as_recorded: dict[str, dict[str, int]] = field(default_factory=dict)
    thinned: dict[str, int] = field(default_factory=dict)
    unconvertible: dict[str, dict[str, int]] = field(default_factory=dict)
    latched: dict[str, int] = field(default_factory=dict)
    latched_left_out: list[str] = field(default_factory=list)
    losses: list[Loss] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
