"""The results of an evaluation, and conclusions for each camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mp4ds.errors import counted
from mp4ds.plugins.evaluating.clips import Clip, ClipFile
from mp4ds.plugins.evaluating.options import ScoreGoal, Setting
from mp4ds.video.codecs import recipe_for
from mp4ds.video.images import jpeg_bytes
from mp4ds.video.planes import rgb_of
from mp4ds.video.scores import ScoreSummary


@dataclass(frozen=True)
class Cell:
    """The results of one setting on one clip.

    Attributes:
        setting: How it was encoded.
        encode_seconds: Time to encode the clip.
        encode_cpu_seconds: CPU time of that, over all threads.
        decode_fps: Frames decoded per second of CPU time.
        size: Bytes of the coded frames of the clip.
        frame_bytes: Bytes of a frame of a long video.
        kbps: Kilobits per second of a long video.
        encode_fps: Frames encoded per second.
        scores: Of the clip, by metric.
        picture: Name of the PNG file of its detail, in the folder of the evaluation.
        whole_bytes: Bytes of the camera's whole recording.
        whole_seconds: Time to encode the camera's whole recording.
        machine: Name of the machine that measured the times; empty if unknown.
    """

    setting: Setting
    encode_seconds: float
    encode_cpu_seconds: float
    decode_fps: float
    size: int
    frame_bytes: float
    kbps: float
    encode_fps: float
    scores: Mapping[str, ScoreSummary]
    picture: str
    whole_bytes: float
    whole_seconds: float
    machine: str = ""


@dataclass(frozen=True, slots=True)
class RateRow:
    """The setting that reaches the target at one rate.

    Attributes:
        rate: Frames per second.
        frames: Of the clip that was tried.
        setting: The largest crf that reaches the target.
        reached: Whether it does; otherwise it is the best setting.
        score: Of the target's metric, mean.
        frame_bytes: Bytes of a frame of a long video.
        frame_seconds: Time to encode a frame.
        kbps: Kilobits per second.
        ceiling: Score of the clip against itself.
        tried: Number of encodings in the search.
    """

    rate: float
    frames: int
    setting: Setting
    reached: bool
    score: float
    frame_bytes: float
    frame_seconds: float
    kbps: float
    ceiling: float
    tried: int


@dataclass(frozen=True, slots=True)
class StorageRow:
    """The cost of one way of storing frames.

    Attributes:
        form: ``raw``, ``YUV 4:4:4``, ``RGB``, ``JPEG 90``, ``JPEG 75`` or a setting.
        frame_bytes: Bytes of a frame.
        gigabytes: Size of the data set, in units of 10^9 bytes.
        days: Time to encode it here, one camera after another; None if not encoded.
        cpu_days: CPU time of that.
    """

    form: str
    frame_bytes: float
    gigabytes: float
    days: float | None = None
    cpu_days: float | None = None


@dataclass(frozen=True, slots=True)
class DataSet:
    """A data set whose size is estimated.

    Attributes:
        streams: Cameras.
        hours: How long they record.
        rate: Frames per second of each.
    """

    streams: int
    hours: float
    rate: float

    @property
    def frames(self) -> float:
        """Frames of all cameras."""
        return self.streams * self.hours * 3600 * self.rate

    @property
    def described(self) -> str:
        """A description in words."""
        cameras = counted(self.streams, "camera")
        hours = f"{self.hours:g} hour{'s' * (self.hours != 1)}"
        return f"{cameras} for {hours} at {self.rate:.2f} Hz"


@dataclass(frozen=True, slots=True)
class Recommendation:
    """A setting that reaches the target.

    Attributes:
        why: ``smallest`` or ``fastest``.
        setting: What to pack with.
        score: Mean of the target's metric.
        options: The corresponding options of ``mp4ds pack``.
    """

    why: str
    setting: Setting
    score: float
    options: str


@dataclass
class CameraEvaluation:
    """The results for one camera.

    Attributes:
        topic: Of its images.
        name: Of its files.
        encoding: ROS encoding of its images.
        size: Width and height of an image.
        rate: Images per second.
        frames: Of the clip.
        start: Seconds from the camera's first image at which the clip begins.
        seconds: Duration of the clip.
        source_frames: Total number of images.
        raw_bytes: Bytes of an image as recorded.
        ceiling: Scores of the clip against itself, which no setting can exceed.
        target: The score to reach.
        reachable: The same, or lower if the ceiling is too close.
        cells: By setting, in the order of the grid.
        recommended: The smallest and the fastest setting that reach the target; empty if none.
        rates: By rate and preset; empty if not asked for.
        data_set: The data set that `storage` is for.
        storage: The cost of storing it, in several forms.
        ground_truth: Name of the PNG file of the clip's detail.
        notes: Anything else worth knowing.
    """

    topic: str
    name: str
    encoding: str
    size: tuple[int, int]
    rate: float | None
    frames: int
    start: float
    seconds: float
    source_frames: int
    raw_bytes: int
    ceiling: Mapping[str, ScoreSummary]
    target: ScoreGoal
    reachable: float
    cells: Sequence[Cell]
    recommended: Sequence[Recommendation]
    rates: Sequence[RateRow]
    data_set: DataSet | None
    storage: Sequence[StorageRow]
    ground_truth: str
    notes: list[str] = field(default_factory=list)


@dataclass
class Evaluation:
    """The results for a recording.

    Attributes:
        source: The evaluated source.
        output: The folder with the results.
        cameras: In the order of their topics.
        left_out: Topics of cameras that were not evaluated, and why.
        versions: Of the software that made the videos and scores.
        recommended: The smallest and the fastest setting that reach the targets of all cameras,
            with their lowest score; empty if none.
        tried: Cells measured in this run.
        known: Cells measured in an earlier one.
    """

    source: Path
    output: Path
    cameras: list[CameraEvaluation]
    left_out: dict[str, str]
    versions: dict[str, str]
    recommended: Sequence[Recommendation] = ()
    tried: int = 0
    known: int = 0


@dataclass(frozen=True, slots=True)
class EvaluateProgress:
    """Progress of an evaluation.

    Attributes:
        camera: Current topic.
        what: Current activity.
        done: Settings of this camera that are done, not counting searches.
        total: Settings of this camera.
    """

    camera: str
    what: str
    done: int
    total: int


# ---------------------------------------------------------------- tables

CEILING_MARGIN = 0.2
"""In VMAF: a target closer to the ceiling than this is indistinguishable from noise."""

Rated = tuple[Sequence[Cell], float]
"""The results for a camera, and the score to reach."""

_JPEG_QUALITIES = (90, 75)
_JPEG_FRAMES = 20
_DAY = 86_400


def reachable_score(target: ScoreGoal, ceiling: float) -> float:
    """The target, or less if the ceiling is too close.

    Args:
        target: The requested target.
        ceiling: Score of the clip against itself.
    """
    return min(target.score, ceiling - CEILING_MARGIN) if target.metric == "vmaf" else target.score


def score_of(cell: Cell, target: ScoreGoal) -> float:
    """Mean score of a cell in the target's metric."""
    return cell.scores[target.metric].mean


def recommend(cameras: Sequence[Rated], target: ScoreGoal) -> list[Recommendation]:
    """The smallest and the fastest setting that reach the scores of all cameras.

    Args:
        cameras: At least one.
        target: The target, whose metric is compared.

    Returns:
        None if no setting does.
    """
    able = set.intersection(
        *(
            {cell.setting for cell in cells if score_of(cell, target) >= due}
            for cells, due in cameras
        )
    )
    if not able:
        return []
    cells = [cell for own, _ in cameras for cell in own if cell.setting in able]

    def total(setting: Setting, figure: str) -> float:
        return sum(float(getattr(cell, figure)) for cell in cells if cell.setting == setting)

    # so that ties are resolved consistently
    ordered = sorted(able, key=lambda setting: setting.name)
    found = []
    for why, figure in (("smallest", "frame_bytes"), ("fastest", "encode_cpu_seconds")):
        setting = min(ordered, key=lambda item, figure=figure: total(item, figure))  # type: ignore[misc]
        score = min(score_of(cell, target) for cell in cells if cell.setting == setting)
        found.append(Recommendation(why, setting, score, setting.pack_options))
    return found


def pareto(cells: Sequence[Cell], cost: Sequence[float], target: ScoreGoal) -> list[int]:
    """Indices of the Pareto-optimal cells, the cheapest first.

    Args:
        cells: Of one camera.
        cost: Of each cell.
        target: The target, whose metric is compared.
    """
    found: list[int] = []
    best = -np.inf
    for number in sorted(range(len(cells)), key=lambda n: (cost[n], -score_of(cells[n], target))):
        if score_of(cells[number], target) > best:
            best = score_of(cells[number], target)
            found.append(number)
    return found


def storage(clip: Clip, path: Path, chosen: Cell, data_set: DataSet) -> list[StorageRow]:
    """The cost of storing the frames of a data set, in several forms.

    JPEG files are made from some of the clip's frames.

    Args:
        clip: Of the camera.
        path: Of the clip's frames.
        chosen: The setting to compare with.
        data_set: How many frames there are.
    """
    width, height = clip.image_size
    plain = 3 * width * height
    forms: list[tuple[str, float]] = [
        ("raw", clip.raw_bytes),
        ("YUV 4:4:4", plain),
        ("RGB", plain),
    ]
    for quality in _JPEG_QUALITIES:
        forms.append((f"JPEG {quality}", jpeg_frame_bytes(path, quality)))
    rows = [StorageRow(form, size, size * data_set.frames / 1e9) for form, size in forms]
    scale = data_set.frames / clip.frames / _DAY
    rows.append(
        StorageRow(
            chosen.setting.name,
            chosen.frame_bytes,
            chosen.frame_bytes * data_set.frames / 1e9,
            days=chosen.encode_seconds * scale,
            cpu_days=chosen.encode_cpu_seconds * scale,
        )
    )
    return rows


def jpeg_frame_bytes(path: Path, quality: int) -> float:
    """Mean bytes of JPEG files of some frames of a clip.

    Args:
        path: Of the clip's frames.
        quality: 1 to 100.
    """
    file = ClipFile(path)
    clip = file.clip
    recipe = recipe_for(clip.picture_format, lossless=False, crf=1)
    numbers = np.unique(np.linspace(0, clip.frames - 1, _JPEG_FRAMES).round().astype(int))
    is_grey = clip.picture_format == "gray"
    sizes = [
        jpeg_bytes(rgb_of(file.planes(int(number)), recipe), quality, is_grey=is_grey)
        for number in numbers
    ]
    return sum(sizes) / len(sizes)
