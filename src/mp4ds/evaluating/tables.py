"""What the figures come to: recommendations, and the size of data sets."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mp4ds.evaluating.clips import Clip, ClipFile
from mp4ds.evaluating.options import Setting, Target
from mp4ds.evaluating.results import Cell, DataSet, Recommendation, StorageRow
from mp4ds.video import recipe_for
from mp4ds.video.planes import rgb_of
from mp4ds.video.stills import jpeg_bytes

CEILING_MARGIN = 0.2
"""Of VMAF: a target nearer to the ceiling than this cannot be told from noise."""

Rated = tuple[Sequence[Cell], float]
"""What was found of a camera, and the score that it is to reach."""

_JPEG_QUALITIES = (90, 75)
_JPEG_FRAMES = 20
_DAY = 86_400


def reachable_score(target: Target, ceiling: float) -> float:
    """The target, or less where the ceiling is too near.

    Args:
        target: What was asked for.
        ceiling: Score of the clip beside itself.
    """
    return min(target.score, ceiling - CEILING_MARGIN) if target.metric == "vmaf" else target.score


def score_of(cell: Cell, target: Target) -> float:
    """Mean score of a cell in the target's metric."""
    return cell.scores[target.metric].mean


def recommend(cameras: Sequence[Rated], target: Target) -> list[Recommendation]:
    """The smallest and the fastest setting that reach the scores of all cameras.

    Args:
        cameras: At least one.
        target: Its metric is compared.

    Returns:
        None where no setting does.
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

    ordered = sorted(able, key=lambda setting: setting.name)  # so that ties have one outcome
    found = []
    for why, figure in (("smallest", "frame_bytes"), ("fastest", "encode_cpu_seconds")):
        setting = min(ordered, key=lambda item, figure=figure: total(item, figure))  # type: ignore[misc]
        score = min(score_of(cell, target) for cell in cells if cell.setting == setting)
        found.append(Recommendation(why, setting, score, setting.pack_options))
    return found


def pareto(cells: Sequence[Cell], cost: Sequence[float], target: Target) -> list[int]:
    """Numbers of the cells than which none is both better and cheaper, the cheapest first.

    Args:
        cells: Of one camera.
        cost: Of each cell.
        target: Its metric is compared.
    """
    found: list[int] = []
    best = -np.inf
    for number in sorted(range(len(cells)), key=lambda n: (cost[n], -score_of(cells[n], target))):
        if score_of(cells[number], target) > best:
            best = score_of(cells[number], target)
            found.append(number)
    return found


def storage(clip: Clip, path: Path, chosen: Cell, data_set: DataSet) -> list[StorageRow]:
    """What the frames of a data set take in several forms.

    JPEG files are made of some of the clip's frames.

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
