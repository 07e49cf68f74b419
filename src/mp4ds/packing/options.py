"""Options, progress and results of a pack."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from importlib import import_module
from operator import index
from pathlib import Path
from typing import Any

from mp4ds.dataset.redaction import Find, Redaction, parse_redaction
from mp4ds.dataset.views import Reduction
from mp4ds.errors import OptionError
from mp4ds.messages.encodings import ENCODINGS
from mp4ds.options import (
    ENCODING,
    LONG,
    Options,
    Parsed,
    SliceOptions,
    Time,
    TopicOptions,
    about,
    argument,
    force,
    jobs,
    latched,
    option,
    parse_time,
    what,
)
from mp4ds.records import MAX_REASONS, OTHER_REASONS, Loss
from mp4ds.video.codecs import (
    ARCHIVE,
    ARCHIVE_GOP,
    DEFAULT_LOSSY,
    LOSSLESS,
    LOSSLESS_GOP,
    LOSSY_GOP,
    LOSSY_TRAINING_GOP,
    MAX_GOP,
    SPEED,
    TRAINING,
    QualitySetting,
    parse_quality,
)

_PLAIN = ("plain",)
NO_VIEW = "none"
"""The choice of a view that is none."""
VIEWS = (DEFAULT_LOSSY, "h264", NO_VIEW)
"""Codecs of views that may be asked for."""


@dataclass(frozen=True, kw_only=True)
class ImportOptions(Options):
    """How a folder of images, or a video, is read as a recording."""

    stamps: str | None = option(
        "Text file with a time per line, in the order of the images or frames; of images also a "
        "time and a file name.",
        metavar="FILE",
        only=("plain", "video"),
    )
    rate: str | None = option(
        "Frame rate of images without times, such as 20 or 30000/1001.", metavar="HZ", only=_PLAIN
    )
    unit: str | None = option(
        "Unit of integer times: s, ms, us or ns; default: ns, if they have enough digits.",
        choices=("s", "ms", "us", "ns"),
        only=("plain", "video"),
    )
    calibration: str | None = option(
        "Calibration as saved by ROS's camera_calibration.",
        metavar="YAML",
        only=("plain", "video"),
    )
    topic: str | None = what(
        "Topic of the raw images; default: /camera/image_raw. That of JPEG files ends in "
        "/compressed, that of video packets in /compressed_video.",
        only=("plain", "video"),
    )
    frame_id: str | None = option(
        "Frame id of the images; default: camera.", only=("plain", "video")
    )
    encoding: str | None = option(
        "Encoding of plain images, such as bayer_rggb8 or 16UC1; default: as in the files.",
        choices=ENCODINGS,
        only=_PLAIN,
    )
    offset: Parsed[Time | None] = option(
        "Time to add to those of the video, such as 1700000000.5 or 2023-11-14T22:13:20; "
        "default: 0.",
        None,
        metavar="TIME",
        parse=parse_time,
        only=("video",),
    )
    decode: bool = option(
        "Decode the frames to RGB images, which are packed like any others, instead of copying "
        "packets.",
        False,
        only=("video", "lerobot"),
    )
    episode: int | None = what(
        "Number of the episode; default: each becomes a dataset.", least=0, only=("lerobot",)
    )

    def absolute(self) -> ImportOptions:
        """The same with absolute paths, for processes elsewhere."""
        stamps, calibration = (
            None if path is None else os.path.abspath(path)  # noqa: PTH100 - keeps links
            for path in (self.stamps, self.calibration)
        )
        return replace(self, stamps=stamps, calibration=calibration)


# ---------------------------------------------------------------- pack


def _parse_crop(value: str | Sequence[int]) -> tuple[int, int, int, int]:
    """x, y, width and height, also of text.

    Raises:
        OptionError: They are not.
    """
    sides = value.split(",") if isinstance(value, str) else value
    with suppress(TypeError, ValueError):
        x, y, width, height = (
            int(side) if isinstance(side, str) else index(side) for side in sides
        )
        if min(x, y) >= 0 < min(width, height):
            return x, y, width, height
    raise OptionError(f"{value!r} is not X,Y,W,H in pixels, such as 0,120,640,240.")


@dataclass(frozen=True, kw_only=True)
class PackOptions(Reduction, SliceOptions, TopicOptions):
    """How to pack."""

    latched: bool = latched()
    salvage: bool = what(
        "Pack what is still readable of a damaged recording.", False, changes=ENCODING
    )
    redact: Parsed[Redaction | Find | Path | None] = option(
        "YAML file of boxes to fill or blur in images, by topic and time; in Python also a "
        "function that finds them.",
        metavar="FILE",
        parse=parse_redaction,
        changes=ENCODING,
    )
    crop: Parsed[tuple[int, int, int, int] | None] = option(
        "Keep this part of the images, in pixels; before `resize`.",
        metavar="X,Y,W,H",
        parse=_parse_crop,
        changes=ENCODING,
    )
    nearest: Sequence[str] = option(
        "Resize images of matching topics without mixing their values: masks and labels.",
        (),
        metavar="GLOB",
        changes=ENCODING,
    )
    camera_info: Sequence[str] = what(
        "Pair a camera topic with its camera_info, if their names do not.",
        (),
        metavar="IMAGE=INFO",
        changes=ENCODING,
    )
    quality: Parsed[QualitySetting | None] = option(
        "lossless, visual, crf=N, or a score to reach: vmaf=99.5, psnr=42, ssim=0.98; default: "
        "lossless, or the quality of a repacked dataset.",
        parse=parse_quality,
        changes=ENCODING,
    )
    codec: str | None = option(
        "h264, h265, ffv1 (lossless), av1, av1-10bit (lossy); default: chosen by trial.",
        changes=ENCODING,
    )
    preset: str | None = option("Encoder preset, such as 6 or veryfast.", changes=ENCODING)
    transcode: bool = option(
        "Re-encode JPEG images at `quality` instead of copying them.", False, changes=ENCODING
    )
    view: str | None = option(
        "Beside exact images, what any player shows: also of JPEG files and video packets, and "
        "where a single video would be smaller. h264 for players without AV1; none for no view at "
        "all; default: of raw images and PNG files, where both videos together are small, or as a "
        "repacked dataset has them.",
        metavar="[av1|h264|none]",
        choices=VIEWS,
        alone=DEFAULT_LOSSY,
        changes=ENCODING,
    )
    purpose: str | None = option(
        "archive: smallest files. speed: fastest packing, as while recording, without views. "
        "training: fastest random access; lossy videos are up to 2.5 times as large, "
        "others up to 15 %; default for smaller or fewer images.",
        None,
        "--for",
        choices=(ARCHIVE, SPEED, TRAINING),
        changes=ENCODING,
    )
    gop: int | None = option(
        "Maximum key frame interval in frames; default: at most 10, or 30 if lossy.",
        least=1,
        most=MAX_GOP,
        changes=ENCODING,
    )
    about: str | None = about()
    window: int | None = option(
        "Frames of the busiest camera per part of a long recording; default: 10 times `gop`, "
        "or 300.",
        panel=LONG,
        least=2,
        most=10_000_000,
        changes=ENCODING,
    )
    jobs: int | None = jobs(
        "Parallel processes; default: one per core. Each holds the encoders of all cameras."
    )
    cluster: str | None = option(
        "Dask scheduler at tcp://HOST:PORT; default: this machine.",
        panel=LONG,
        metavar="ADDRESS",
    )
    join: bool = option("Join the parts packed with --shard into the dataset.", False, panel=LONG)
    keep_going: bool = option("If a part fails, continue with the others.", False, panel=LONG)
    restart: bool = option("Discard an unfinished run and start over.", False, panel=LONG)
    force: bool = force()
    images: ImportOptions | None = argument(
        "How a folder of images, or a video, is read as a recording.", changes=ENCODING
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.nearest and self.resize is None:
            raise OptionError("`nearest` says how images are resized: give `resize`, too.")
        if self.derives and self.purpose is None and self.gop is None:
            object.__setattr__(self, "purpose", TRAINING)
        if self.finds:
            object.__setattr__(self, "restart", True)

    @property
    def redaction(self) -> Redaction | None:
        """What to redact, parsed."""
        return None if self.redact is None else parse_redaction(self.redact)

    @property
    def finds(self) -> bool:
        """Whether a function finds what to redact, which may have changed since, or its model."""
        return self.redaction is not None and self.redaction.find is not None

    @property
    def derives(self) -> bool:
        """Whether images are changed, or left out, before they are packed."""
        return self.reduces or self.crop is not None

    @property
    def reduction(self) -> dict[str, Any]:
        """What is done to images, as a manifest has it; see `ReductionEntry`."""
        resize: Any = self.resize
        is_factor = isinstance(resize, (int, float))
        told: dict[str, Any] = {
            "crop": self.crop and list(self.crop),
            "factor": is_factor and float(resize),
            "size": resize and not is_factor and list(resize),
            "nearest": list(self.nearest),
            "every": self.every > 1 and self.every,
            "max_rate": self.max_rate and float(self.max_rate),
        }
        return {key: value for key, value in told.items() if value}

    @property
    def goal(self) -> QualitySetting:
        """The quality, lossless by default."""
        return self.quality or parse_quality(LOSSLESS)

    @property
    def asks_for_views(self) -> bool:
        """Whether every stream that can have a view is to have one."""
        return self.view not in (None, NO_VIEW)

    @property
    def is_fast(self) -> bool:
        """Whether to encode in the least time, with nothing tried."""
        return self.purpose == SPEED

    @property
    def group_frames(self) -> int:
        """Maximum key frame interval, frames.

        Raises:
            OptionError: `purpose` and `gop` contradict each other.
        """
        is_lossless = self.goal.lossless
        if self.purpose is None or self.is_fast:
            return self.gop or (LOSSLESS_GOP if is_lossless else LOSSY_GOP)
        if self.gop is not None:
            raise OptionError(
                "`purpose` chooses the key frame interval itself. Give `purpose` or `gop`, not "
                "both."
            )
        if self.purpose == ARCHIVE:
            return ARCHIVE_GOP
        return LOSSLESS_GOP if is_lossless else LOSSY_TRAINING_GOP


@dataclass(frozen=True)
class PackProgress:
    """Progress of a pack.

    Attributes:
        dataset: The dataset being made.
        phase: ``planning``, ``packing`` or ``joining``.
        done: Share of the work of this phase that is done, 0 to 1; None if unknown.
        bytes_read: Payload bytes of the messages packed so far.
        bytes_total: Bytes of the source files.
        bytes_written: Bytes of the dataset so far.
        topics: Messages packed so far and in total (None: unknown), by camera topic.
        tasks_done: Parts that are done.
        tasks_total: Number of parts; 0 for a recording packed in one go.
        failed: Parts that failed.
        note: Current activity, if worth reporting.
    """

    dataset: Path
    phase: str
    done: float | None
    bytes_read: int
    bytes_total: int
    bytes_written: int
    topics: Mapping[str, tuple[int, int | None]]
    tasks_done: int = 0
    tasks_total: int = 0
    failed: int = 0
    note: str = ""

    @property
    def frames(self) -> int:
        """Camera messages packed so far."""
        return sum(done for done, _ in self.topics.values())


@dataclass
class TopicSummary:
    """The result for a topic.

    Attributes:
        topic: Its name.
        type_name: Its message type.
        messages: Messages packed.
        frames: Messages of these that are frames of a video or entries of its camera_info.
        raw_bytes: Payload bytes of all messages; 0 where its videos were copied.
        packed_bytes: Bytes of its videos and sidecars; 0 for one that is in messages.mcap.
        files: Its videos.
        verbatim: Reason -> (messages, number of the first) for camera messages stored verbatim.
        notes: What else is worth knowing.
    """

    topic: str
    type_name: str
    messages: int = 0
    frames: int = 0
    raw_bytes: int = 0
    packed_bytes: int = 0
    files: list[str] = field(default_factory=list)
    verbatim: dict[str, tuple[int, int]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def count_verbatim(self, reason: str, number: int) -> None:
        """Count one more message stored verbatim, the topic's message of that number."""
        if reason not in self.verbatim and len(self.verbatim) >= MAX_REASONS:
            reason = OTHER_REASONS
        count, first = self.verbatim.get(reason, (0, number))
        self.verbatim[reason] = (count + 1, first)


@dataclass(frozen=True)
class PackSummary:
    """The result of a pack.

    Attributes:
        dataset: The folder made.
        topics: One entry per topic, in the recording's order.
        source_bytes: Bytes of the source files, or of the packed messages where not all were.
        dataset_bytes: Bytes of the dataset.
        messages_bytes: Bytes of messages.mcap.
        left_out: Topics left out on request.
        skipped: What the source holds and no dataset can: a phrase -> how many.
        losses: What could not be read of a damaged recording.
        is_copy: Whether the videos of a dataset were copied; `raw_bytes` of topics are unknown.
        not_copied: Why a dataset's videos were re-encoded without being asked to.
        latched: Latched messages from before the slice, by topic.
        latched_left_out: Latched topics whose messages from before it are too large.
    """

    dataset: Path
    topics: list[TopicSummary]
    source_bytes: int
    dataset_bytes: int
    messages_bytes: int
    left_out: list[str]
    skipped: dict[str, int]
    losses: list[Loss] = field(default_factory=list)
    is_copy: bool = False
    not_copied: str = ""
    latched: dict[str, int] = field(default_factory=dict)
    latched_left_out: list[str] = field(default_factory=list)


# ---------------------------------------------------------------- plugins

_EXTRAS = {"distributed": "cluster", "pyarrow": "lerobot"}
"""Packages that a plugin may lack -> the extra that has them."""


def plugin(name: str) -> Any:
    """Something of a plugin, such as ``reducing:ReducedReader``: the only way from the core there.

    Raises:
        OptionError: A package that it needs is not installed.
    """
    module, _, found = name.partition(":")
    try:
        return getattr(import_module(f"mp4ds.plugins.{module}"), found)
    except ImportError as error:
        package = (error.name or "").partition(".")[0]
        if package not in _EXTRAS:
            raise
        raise OptionError(
            f"This needs {package}, which is not installed ({error}). Install it: pip install "
            f"'mp4ds[{_EXTRAS[package]}]'"
        ) from None
