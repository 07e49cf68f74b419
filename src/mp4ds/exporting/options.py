"""How to export, and what an export did."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mp4ds.errors import OptionError
from mp4ds.republish import Reduction
from mp4ds.video.codecs import MAX_CRF

PIXELS = ("seen", "native", "rgb", "gray")
_CODECS = ("av1", "h264", "h265")


@dataclass(frozen=True)
class ExportOptions:
    """How to export.

    Attributes:
        topics: Globs of the topics to export; empty for all.
        exclude: Globs of topics to leave out.
        resize: A factor, or width and height in pixels, of images that are given smaller or
            larger; None for as recorded. Calibrations are made to match.
        every: Only every so many frames of each camera, from its first one on.
        max_rate: Most frames of each camera in a second; None for all.
        pixels: ``seen``: as recorded, but Bayer mosaics and YUV as RGB; ``native``: a mosaic
            stays one; ``rgb`` and ``gray``: all images of light.
        tolerance_ns: Only frames for which every camera has one within so many nanoseconds;
            None for all frames.
        poses: Topic of the poses, for euroc, tum and colmap.
        fps: Frames in a second, for lerobot; None for the rate of the first camera.
        state: Topic of ``observation.state``, for lerobot.
        action: Topic of ``action``, for lerobot.
        task: What the robot does, for lerobot.
        codec: ``av1``, ``h264`` or ``h265``: of videos that are encoded, for lerobot.
        crf: Their constant rate factor; less is better. 0 to 63, of h264 and h265 0 to 51.
        force: Replace an existing export.
    """

    topics: Sequence[str] = ()
    exclude: Sequence[str] = ()
    resize: float | tuple[int, int] | None = None
    every: int = 1
    max_rate: float | None = None
    pixels: str = "seen"
    tolerance_ns: int | None = None
    poses: str | None = None
    fps: int | None = None
    state: str | None = None
    action: str | None = None
    task: str = ""
    codec: str = "av1"
    crf: int = 30
    force: bool = False

    def __post_init__(self) -> None:
        if self.pixels not in PIXELS:
            raise OptionError(f"--pixels {self.pixels!r} is not known. Use {', '.join(PIXELS)}.")
        if self.codec not in _CODECS:
            raise OptionError(f"--codec {self.codec!r} is not known. Use {', '.join(_CODECS)}.")
        most = MAX_CRF[self.codec]
        if not 0 <= self.crf <= most:
            raise OptionError(f"--crf {self.crf} is not from 0 to {most}, as {self.codec} has it.")
        if self.fps is not None and not 1 <= self.fps <= 1000:
            raise OptionError(f"--fps {self.fps} is not from 1 to 1000.")

    @property
    def reduction(self) -> Reduction:
        """How much smaller or fewer images are given.

        Raises:
            OptionError: There is no such size, number or rate.
        """
        return Reduction(self.resize, self.every, self.max_rate)


@dataclass(frozen=True)
class ExportSummary:
    """What an export did.

    Every message of the datasets is counted once, as one that the export holds or by the reason
    why it does not.

    Attributes:
        output: The folder or file made.
        format: Its format.
        places: Part of the output -> the topic that is in it.
        messages: Messages that it holds, by topic.
        left_out: Topic -> reason -> messages that it does not hold.
        notes: What else the format does not say as it was recorded.
    """

    output: Path
    format: str
    places: dict[str, str] = field(default_factory=dict)
    messages: dict[str, int] = field(default_factory=dict)
    left_out: dict[str, dict[str, int]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
