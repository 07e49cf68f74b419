"""Plots of quality against bitrate and against time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import ceil, floor, log10

from mp4ds.plugins.evaluating.results import CameraEvaluation, score_of
from mp4ds.video.drawing import Dot, Line, Shape, Text

SIZE = (640, 420)
"""Width and height of a plot, pixels."""

COSTS = {
    "bitrate": ("kbit/s", "quality against bitrate"),
    "time": ("CPU seconds per frame", "quality against time"),
}
"""For each plot: the label of the cost of a setting, and the plot's title."""

_LEFT, _RIGHT, _TOP, _BOTTOM = 64, 490, 38, 368
_LEGEND = _RIGHT + 18
_SPARE = 1.15  # factor between the outermost cost and the frame
_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c6d31", "#666666")
_GRID, _INK, _FRONT, _TARGET = "#e4e4e4", "#333333", "#999999", "#cc0000"
_NAMES = {"vmaf": "VMAF", "psnr_y": "PSNR Y, dB", "psnr_cb": "PSNR Cb, dB",
          "psnr_cr": "PSNR Cr, dB", "ssim": "SSIM"}  # fmt: skip


def plot(camera: CameraEvaluation, kind: str) -> list[Shape]:
    """A plot of all settings of a camera.

    Args:
        camera: With at least one cell.
        kind: One of `COSTS`.
    """
    label, title = COSTS[kind]
    costs = [
        max(1e-9, cell.encode_cpu_seconds / camera.clip.frames if kind == "time" else cell.kbps)
        for cell in camera.cells
    ]
    scores = [score_of(cell, camera.target) for cell in camera.cells]
    shapes, place = _frame(
        costs, [*scores, camera.reachable, camera.ceiling[camera.target.metric].mean]
    )
    shapes += [
        Text((SIZE[0] / 2, 12), f"{camera.topic}: {title}", "middle"),
        Text((_LEFT, _TOP - 14), _NAMES[camera.target.metric]),
        Text(((_LEFT + _RIGHT) / 2, _BOTTOM + 36), label, "middle"),
    ]
    _, height = place(costs[0], camera.reachable)
    shapes.append(Line([(_LEFT, height), (_RIGHT, height)], _TARGET, dashed=True))
    target = f"target {camera.reachable:.4g}"
    shapes.append(Text((_LEFT + 6, height - 9), target, color=_TARGET))
    front = [place(costs[n], scores[n]) for n in pareto(costs, scores)]
    if len(front) > 1:
        shapes.append(Line(front, _FRONT, 6))
    groups: dict[str, list[int]] = {}
    for number, cell in enumerate(camera.cells):
        groups.setdefault(f"{cell.setting.codec} {cell.setting.preset}", []).append(number)
    legend = _TOP + 8
    for number, (name, members) in enumerate(groups.items()):
        color = _COLORS[number % len(_COLORS)]
        places = [place(costs[n], scores[n]) for n in members]
        if len(places) > 1:
            shapes.append(Line(places, color, 1.5))
        for n, dot in zip(members, places, strict=True):
            tip = f"{camera.cells[n].setting.name}: {scores[n]:.3f}, {costs[n]:.4g} {label}"
            shapes.append(Dot(dot, color, 3.5, tip))
        shapes += [Dot((_LEGEND, legend), color), Text((_LEGEND + 12, legend), name)]
        legend += 20
    shapes.append(Line([(_LEGEND - 7, legend), (_LEGEND + 7, legend)], _FRONT, 6))
    shapes.append(Text((_LEGEND + 12, legend), "Pareto front"))
    return shapes


def pareto(costs: Sequence[float], scores: Sequence[float]) -> list[int]:
    """Indices of what nothing cheaper is as good as, the cheapest first."""
    found: list[int] = []
    for number in sorted(range(len(costs)), key=lambda n: (costs[n], -scores[n])):
        if not found or scores[number] > scores[found[-1]]:
            found.append(number)
    return found


def _frame(
    costs: Sequence[float], scores: Sequence[float]
) -> tuple[list[Shape], Callable[[float, float], tuple[float, float]]]:
    """Axes of costs, which are logarithmic, and of scores; and where a pair of both is."""
    least, most = min(costs) / _SPARE, max(costs) * _SPARE
    margin = max((max(scores) - min(scores)) * 0.05, 1e-6 * max(1.0, abs(max(scores))))
    low, high = min(scores) - margin, max(scores) + margin

    def place(cost: float, score: float) -> tuple[float, float]:
        across = (log10(cost) - log10(least)) / (log10(most) - log10(least))
        up = (score - low) / (high - low)
        return _LEFT + across * (_RIGHT - _LEFT), _BOTTOM - up * (_BOTTOM - _TOP)

    shapes: list[Shape] = []
    powers = range(floor(log10(least)), ceil(log10(most)) + 1)
    for cost in (times * 10.0**power for power in powers for times in (1, 2, 5)):
        if least <= cost <= most:
            x, _ = place(cost, low)
            shapes.append(Line([(x, _BOTTOM), (x, _TOP)], _GRID))
            shapes.append(Text((x, _BOTTOM + 14), f"{cost:g}", "middle"))
    step = _round_step((high - low) / 6)
    for score in (step * n for n in range(ceil(low / step), floor(high / step) + 1)):
        _, y = place(least, score)
        shapes.append(Line([(_LEFT, y), (_RIGHT, y)], _GRID))
        shapes.append(Text((_LEFT - 6, y), f"{score:.6g}", "end"))
    shapes.append(Line([(_LEFT, _TOP), (_LEFT, _BOTTOM), (_RIGHT, _BOTTOM)], _INK))
    return shapes, place


def _round_step(step: float) -> float:
    power = 10.0 ** floor(log10(step))
    return next(times * power for times in (1, 2, 5, 10) if times * power >= step * 0.999)
