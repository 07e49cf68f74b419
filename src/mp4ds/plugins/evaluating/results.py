"""The results of an evaluation, conclusions for each camera, and both in words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mp4ds.errors import size_text
from mp4ds.plugins.evaluating.clips import Clip
from mp4ds.plugins.evaluating.options import ScoreGoal, Setting
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
        machine: Name of the machine that measured the times.
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
    machine: str


@dataclass(frozen=True, slots=True)
class RateRow:
    """The setting that reaches the target at one rate.

    Attributes:
        rate: Frames per second.
        frames: Of the clip that was tried.
        cell: Of the largest crf that reaches the target.
        reached: Whether it does; otherwise it is the best setting.
        ceiling: Score of the clip against itself.
    """

    rate: float
    frames: int
    cell: Cell
    reached: bool
    ceiling: float


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
        clip: What was tried on.
        ceiling: Scores of the clip against itself, which no setting can exceed.
        target: The score to reach.
        reachable: The same, or lower if the ceiling is too close.
        cells: By setting, in the order of the grid.
        recommended: The smallest and the fastest setting that reach the target; empty if none.
        ground_truth: Name of the PNG file of the clip's detail.
        rates: By rate and preset; empty if not asked for.
        data_set: The data set that `storage` is for, in words.
        storage: The cost of storing it, in several forms; empty if there is no frame rate.
        notes: Anything else worth knowing.
    """

    topic: str
    name: str
    clip: Clip
    ceiling: Mapping[str, ScoreSummary]
    target: ScoreGoal
    reachable: float
    cells: Sequence[Cell]
    recommended: Sequence[Recommendation]
    ground_truth: str
    rates: Sequence[RateRow] = ()
    data_set: str = ""
    storage: Sequence[StorageRow] = ()
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


# ---------------------------------------------------------------- conclusions

CEILING_MARGIN = 0.2
"""In VMAF: a target closer to the ceiling than this is indistinguishable from noise."""


def reachable_score(target: ScoreGoal, ceiling: Mapping[str, ScoreSummary]) -> float:
    """The target, or less if the ceiling is too close.

    Args:
        target: The requested target.
        ceiling: Scores of the clip against itself.
    """
    if target.metric != "vmaf":
        return target.score
    return min(target.score, ceiling["vmaf"].mean - CEILING_MARGIN)


def score_of(cell: Cell, target: ScoreGoal) -> float:
    """Mean score of a cell in the target's metric."""
    return cell.scores[target.metric].mean


def recommend(
    cameras: Sequence[tuple[Sequence[Cell], float]], target: ScoreGoal
) -> list[Recommendation]:
    """The smallest and the fastest setting that reach the scores of all cameras.

    Args:
        cameras: At least one: its cells, and the score to reach.
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
    cells = [cell for own, _ in cameras for cell in own if cell.setting in able]

    def total(setting: Setting, figure: str) -> float:
        return sum(float(getattr(cell, figure)) for cell in cells if cell.setting == setting)

    found = []
    for why, figure in (("smallest", "frame_bytes"), ("fastest", "encode_cpu_seconds")):
        # by name, so that ties are resolved consistently
        costs = {(total(setting, figure), setting.name): setting for setting in able}
        if costs:
            setting = costs[min(costs)]
            score = min(score_of(cell, target) for cell in cells if cell.setting == setting)
            found.append(Recommendation(why, setting, score, setting.pack_options))
    return found


# ---------------------------------------------------------------- in words

Row = dict[str, str]
"""A row of a table: headings and texts."""


def told(camera: CameraEvaluation) -> Iterator[str | list[Row]]:
    """What was found for a camera, in sentences and tables."""
    clip, target = camera.clip, camera.target
    width, height = clip.image_size
    rate = f" at {clip.rate:.2f} Hz" if clip.rate else ""
    yield (
        f"{camera.topic}: {clip.encoding} {width}x{height}{rate}; clip of {clip.frames} of "
        f"{clip.source_frames} frames, starting at {clip.start:.2f} s"
    )
    yield [_cell_row(camera, cell) for cell in camera.cells]
    scores = ", ".join(f"{name} {value.mean:.2f}" for name, value in camera.ceiling.items())
    yield f"ceiling, the clip scored against itself: {scores}"
    if camera.rates:
        yield f"crf that reaches {target.metric} {target.score:g}, by frame rate:"
        yield [_rate_row(row, target) for row in camera.rates]
    if camera.storage:
        yield f"{camera.data_set}:"
        yield [_storage_row(row) for row in camera.storage]
    yield from (f"note: {note}" for note in camera.notes)
    for item in camera.recommended:
        yield f"{item.why}: {item.options} ({target.metric} {item.score:.2f})"


def _cell_row(camera: CameraEvaluation, cell: Cell) -> Row:
    def score(metric: str, statistic: str = "mean", digits: int = 2) -> str:
        summary = cell.scores.get(metric)
        return f"{getattr(summary, statistic):.{digits}f}" if summary else ""

    return {
        "codec": cell.setting.codec,
        "preset": cell.setting.preset,
        "crf": str(cell.setting.crf),
        "kbit/s": f"{cell.kbps:.0f}",
        "B/frame": f"{cell.frame_bytes:.0f}",
        "fps": f"{cell.encode_fps:.1f}",
        "CPU s": f"{cell.encode_cpu_seconds:.2f}",
        "decoded/CPU s": f"{cell.decode_fps:.0f}",
        "VMAF": score("vmaf"),
        "harmonic": score("vmaf", "harmonic_mean"),
        "5 %": score("vmaf", "percentile_5"),
        "least": score("vmaf", "minimum"),
        "PSNR Y": score("psnr_y"),
        "PSNR Cb": score("psnr_cb"),
        "PSNR Cr": score("psnr_cr"),
        "SSIM": score("ssim", digits=4),
        "whole": size_text(cell.whole_bytes),
        "time": _time_text(cell.whole_seconds),
        "best": why_of(camera, cell),
    }


def why_of(camera: CameraEvaluation, cell: Cell) -> str:
    """Why a cell is recommended; empty if it is not."""
    return " ".join(item.why for item in camera.recommended if item.setting == cell.setting)


def _rate_row(row: RateRow, target: ScoreGoal) -> Row:
    cell = row.cell
    return {
        "Hz": f"{row.rate:g}",
        "frames": str(row.frames),
        "codec": cell.setting.codec,
        "preset": cell.setting.preset,
        "crf": str(cell.setting.crf),
        "score": f"{score_of(cell, target):.2f}" + ("" if row.reached else " (not reached)"),
        "ceiling": f"{row.ceiling:.2f}",
        "B/frame": f"{cell.frame_bytes:.0f}",
        "ms/frame": f"{cell.encode_seconds / row.frames * 1000:.1f}",
        "kbit/s": f"{cell.kbps:.0f}",
    }


def _storage_row(row: StorageRow) -> Row:
    return {
        "stored as": row.form,
        "B/frame": f"{row.frame_bytes:.0f}",
        "size": f"{row.gigabytes:.1f} GB",
        "days": "" if row.days is None else f"{row.days:.2f}",
        "CPU days": "" if row.cpu_days is None else f"{row.cpu_days:.2f}",
    }


def _time_text(seconds: float) -> str:
    """A duration in a suitable unit."""
    for limit, unit, size in ((120, "s", 1), (7200, "min", 60), (172_800, "h", 3600)):
        if seconds < limit:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds / 86_400:.1f} days"
