"""Quality against what it costs: one plot of a camera's settings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from mp4ds.evaluating.results import CameraEvaluation, Cell
from mp4ds.evaluating.tables import pareto, score_of
from mp4ds.video.drawing import Dot, Line, Shape, Text

SIZE = (640, 420)
"""Width and height of a plot, pixels."""

_LEFT, _RIGHT, _TOP, _BOTTOM = 64, 150, 34, 52
_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c6d31", "#666666")
_GRID, _INK, _FRONT = "#e4e4e4", "#333333", "#999999"
_NAMES = {"vmaf": "VMAF", "psnr_y": "PSNR Y, dB", "psnr_cb": "PSNR Cb, dB",
          "psnr_cr": "PSNR Cr, dB", "ssim": "SSIM"}  # fmt: skip
COSTS = {
    "bitrate": ("kbps", "kbit/s", "quality against bitrate"),
    "time": ("encode_cpu_seconds", "CPU seconds per frame", "quality against time"),
}
"""Of each plot what a setting costs, how that is called, and its title."""


@dataclass(frozen=True, slots=True)
class _Axis:
    """Where figures are drawn.

    Attributes:
        low: The least figure.
        high: The greatest one.
        begin: Place of the least one, pixels.
        end: Place of the greatest one, pixels.
        is_log: Whether equal quotients are equally far apart.
    """

    low: float
    high: float
    begin: float
    end: float
    is_log: bool

    def at(self, value: float) -> float:
        """Place of a figure."""
        low, high = self.low, self.high
        if self.is_log:
            low, high, value = math.log(low), math.log(high), math.log(value)
        return self.begin + (value - low) / (high - low) * (self.end - self.begin)

    def ticks(self) -> list[float]:
        """Round figures within it, about six."""
        if self.is_log:
            powers = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
            found = [m * 10.0**p for p in powers for m in (1, 2, 5)]
        else:
            step = _round_step((self.high - self.low) / 6)
            first = math.ceil(self.low / step)
            found = [step * n for n in range(first, math.floor(self.high / step) + 1)]
        return [value for value in found if self.low <= value <= self.high]


def _round_step(step: float) -> float:
    power = 10.0 ** math.floor(math.log10(step))
    return next(m * power for m in (1, 2, 5, 10) if m * power >= step * 0.999)


def cost_of(camera: CameraEvaluation, cell: Cell, kind: str) -> float:
    """What a setting costs in one of `COSTS`."""
    value = float(getattr(cell, COSTS[kind][0]))
    return max(1e-9, value / camera.frames if kind == "time" else value)


def plot(camera: CameraEvaluation, kind: str) -> list[Shape]:
    """A plot of all settings of a camera.

    Args:
        camera: With at least one cell.
        kind: One of `COSTS`.
    """
    cells, target = camera.cells, camera.target
    costs = [cost_of(camera, cell, kind) for cell in cells]
    scores = [score_of(cell, target) for cell in cells]
    across = _log_axis(costs, _LEFT, SIZE[0] - _RIGHT)
    up = _score_axis([*scores, camera.reachable, camera.ceiling[target.metric].mean])
    shapes = _frame(across, up, f"{camera.topic}: {COSTS[kind][2]}", COSTS[kind][1])
    shapes.append(Text((_LEFT, _TOP - 10), _NAMES[target.metric]))
    shapes += _level(up, camera.reachable, f"target {camera.reachable:.4g}", "#cc0000")
    front = pareto(cells, costs, target)
    if len(front) > 1:
        places = [(across.at(costs[n]), up.at(scores[n])) for n in front]
        shapes.append(Line(places, _FRONT, 6))
    groups = list(dict.fromkeys((cell.setting.codec, cell.setting.preset) for cell in cells))
    for number, group in enumerate(groups):
        color = _COLORS[number % len(_COLORS)]
        own = [n for n, c in enumerate(cells) if (c.setting.codec, c.setting.preset) == group]
        places = [(across.at(costs[n]), up.at(scores[n])) for n in own]
        if len(places) > 1:
            shapes.append(Line(places, color, 1.5))
        for n, place in zip(own, places, strict=True):
            tip = f"{cells[n].setting.name}: {scores[n]:.3f}, {costs[n]:.4g} {COSTS[kind][1]}"
            shapes.append(Dot(place, color, 3.5, tip))
        legend = _TOP + 12 + 20 * number
        shapes.append(Dot((SIZE[0] - _RIGHT + 18, legend), color))
        shapes.append(Text((SIZE[0] - _RIGHT + 30, legend), " ".join(group)))
    legend = _TOP + 12 + 20 * len(groups)
    shapes.append(
        Line([(SIZE[0] - _RIGHT + 11, legend), (SIZE[0] - _RIGHT + 25, legend)], _FRONT, 6)
    )
    shapes.append(Text((SIZE[0] - _RIGHT + 30, legend), "none is better"))
    return shapes


def _log_axis(values: Sequence[float], begin: float, end: float) -> _Axis:
    return _Axis(min(values) / 1.15, max(values) * 1.15, begin, end, is_log=True)


def _score_axis(values: Sequence[float]) -> _Axis:
    low, high = min(values), max(values)
    margin = max((high - low) * 0.05, 1e-6 * max(1.0, abs(high)))
    return _Axis(low - margin, high + margin, SIZE[1] - _BOTTOM, _TOP + 4, is_log=False)


def _frame(across: _Axis, up: _Axis, title: str, label: str) -> list[Shape]:
    bottom, top = up.begin, up.end
    shapes: list[Shape] = [Text((SIZE[0] / 2, 12), title, "middle")]
    for value in across.ticks():
        x = across.at(value)
        shapes.append(Line([(x, bottom), (x, top)], _GRID))
        shapes.append(Text((x, bottom + 14), f"{value:g}", "middle"))
    for value in up.ticks():
        y = up.at(value)
        shapes.append(Line([(across.begin, y), (across.end, y)], _GRID))
        shapes.append(Text((across.begin - 6, y), f"{value:.6g}", "end"))
    corner = [(across.begin, top), (across.begin, bottom), (across.end, bottom)]
    shapes.append(Line(corner, _INK))
    shapes.append(Text(((across.begin + across.end) / 2, bottom + 36), label, "middle"))
    return shapes


def _level(up: _Axis, score: float, words: str, color: str) -> list[Shape]:
    y = up.at(score)
    return [
        Line([(_LEFT, y), (SIZE[0] - _RIGHT, y)], color, dashed=True),
        Text((_LEFT + 6, y - 9), words, color=color),
    ]
