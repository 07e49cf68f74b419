"""The results of an evaluation, conclusions for each camera, and both in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mp4ds.plugins.evaluating.trials import Cell, Clip, Setting
from mp4ds.video.scores import ScoreSummary


@dataclass(frozen=True, slots=True)
class ScoreGoal:
    """The score that a setting has to reach.

    Attributes:
        metric: One of `mp4ds.video.scores.METRICS`.
        score: Required mean over the frames.
    """

    metric: str = "vmaf"
    score: float = 99.5


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
