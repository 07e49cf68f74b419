"""How to unpack, and what an unpack did."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mp4ds.republish import Reduction, Republished


@dataclass(frozen=True)
class UnpackOptions:
    """How to unpack.

    Attributes:
        storage: ``sqlite3`` or ``mcap``, for rosbag2; None for what the source had.
        topics: Globs of the topics to unpack; empty for all.
        exclude: Globs of topics to leave out.
        image_format: ``png`` or ``jpeg``, for images; None for JPEG files as they were recorded,
            and PNG for all else.
        images: How camera messages are given: one of `mp4ds.republish.KINDS`, or None for as
            they were recorded.
        jpeg_quality: Of JPEG files that are made, 1 to 100.
        resize: A factor, or width and height in pixels, of images that are given smaller or
            larger; None for as recorded. Calibrations are made to match.
        every: Only every so many frames of each stream, from its first one on.
        max_rate: Most frames of each stream in a second; None for all.
        force: Replace an existing target.
        skip_unconvertible: Leave out and count what the target cannot hold.
    """

    storage: str | None = None
    topics: Sequence[str] = ()
    exclude: Sequence[str] = ()
    image_format: str | None = None
    images: str | None = None
    jpeg_quality: int = 95
    resize: float | tuple[int, int] | None = None
    every: int = 1
    max_rate: float | None = None
    force: bool = False
    skip_unconvertible: bool = False

    @property
    def reduction(self) -> Reduction:
        """How much smaller or fewer images are given.

        Raises:
            OptionError: There is no such size, number or rate.
        """
        return Reduction(self.resize, self.every, self.max_rate)


@dataclass(frozen=True)
class UnpackProgress:
    """Where an unpack stands: messages written, and how many there are (0: not known)."""

    messages: int
    messages_total: int


@dataclass(frozen=True)
class UnpackSummary:
    """What an unpack did.

    Attributes:
        output: The recording or folder made.
        messages: Messages written, by topic.
        converted: Types converted between ROS 1 and ROS 2, by topic.
        omitted: What the target cannot hold and was left out: a phrase -> how many.
        left_out: Topics left out on request.
        republished: What became of the topics whose images are given in another form.
        as_recorded: Where another form was asked for, the camera topics of which messages stay
            as recorded: reason -> how many.
        unconvertible: Topics of which messages are left out, as the target cannot hold them:
            reason -> how many.
        thinned: Topics of which messages are left out, as fewer were asked for -> how many.
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
