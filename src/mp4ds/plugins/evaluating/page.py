"""What an evaluation found, in words, tables, plots, and on one page."""

from __future__ import annotations

import base64
import csv
import io
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from html import escape
from importlib.resources import files
from math import ceil, floor, log10
from pathlib import Path
from string import Template
from typing import Any

from mp4ds.errors import size_text
from mp4ds.files.outputs import csv_cell
from mp4ds.plugins.evaluating.trials import (
    CameraEvaluation,
    Cell,
    Evaluation,
    mean_score,
)
from mp4ds.video.scores import METRICS, ScoreSummary

PLOTS = "plots"
"""The folder of an evaluation for plots."""


def write_files(result: Evaluation, folder: Path, options: dict[str, Any]) -> None:
    """Write all files into the folder of an evaluation.

    Args:
        result: What was found.
        folder: Where the pictures are, and the other files will be.
        options: What was asked for.

    Raises:
        OSError: It cannot be written.
    """
    (folder / PLOTS).mkdir()
    (folder / "evaluation.csv").write_text(table(result), encoding="utf-8")
    values = {"options": options, **asdict(result)}
    text = json.dumps(values, default=str, indent=1)  # paths
    (folder / "evaluation.json").write_text(f"{text}\n", encoding="utf-8")
    for camera in result.cameras:
        for kind in COSTS:
            path = folder / PLOTS / f"{camera.name}-{kind}.svg"
            path.write_text(plot(camera, kind), encoding="utf-8")
    (folder / "index.html").write_text(page(result, folder), encoding="utf-8")


def table(result: Evaluation) -> str:
    """The figures of all cells as CSV, a line for each."""
    text = io.StringIO()
    rows = [_figures(camera, cell) for camera in result.cameras for cell in camera.cells]
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(
        {name: csv_cell(value) if isinstance(value, str) else value for name, value in row.items()}
        for row in rows
    )
    return text.getvalue()


def _figures(camera: CameraEvaluation, cell: Cell) -> dict[str, Any]:
    figures = asdict(cell)
    setting = figures.pop("setting")
    del figures["picture"]
    scores: dict[str, dict[str, float]] = figures.pop("scores")
    return {
        "topic": camera.topic,
        **setting,
        "frames": camera.clip.frames,
        **{name: round(value, 6) for name, value in figures.items()},
        **{
            f"{metric}_{statistic}": f"{scores[metric][statistic]:.6f}" if metric in scores else ""
            for metric in METRICS
            for statistic in ScoreSummary.__slots__
        },
        "recommended": why_of(camera, cell),
    }


# ---------------------------------------------------------------- in words

Row = dict[str, str]
"""A row of a table: headings and texts."""


def findings_of(camera: CameraEvaluation) -> Iterator[str | list[Row]]:
    """What was found for a camera, in sentences and tables."""
    clip = camera.clip
    width, height = clip.image_size
    rate = f" at {clip.rate:.2f} Hz" if clip.rate else ""
    yield (
        f"{camera.topic}: {clip.encoding} {width}x{height}{rate}; clip of {clip.frames} of "
        f"{clip.source_frames} frames, starting at {clip.start:.2f} s"
    )
    yield [_cell_row(camera, cell) for cell in camera.cells]
    scores = ", ".join(f"{name} {value.mean:.2f}" for name, value in camera.ceiling.items())
    yield f"ceiling, the clip scored against itself: {scores}"
    yield from (f"note: {note}" for note in camera.notes)
    for item in camera.recommended:
        yield f"{item.why}: {item.options} ({camera.target.metric} {item.score:.2f})"


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


def _time_text(seconds: float) -> str:
    """A duration in a suitable unit."""
    for limit, unit, size in ((120, "s", 1), (7200, "min", 60), (172_800, "h", 3600)):
        if seconds < limit:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds / 86_400:.1f} days"


# ---------------------------------------------------------------- plots

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
_NAMES = {"vmaf": "VMAF", "psnr": "PSNR Y, dB", "ssim": "SSIM"}


def plot(camera: CameraEvaluation, kind: str) -> str:
    """A plot of all settings of a camera, as an SVG element.

    Args:
        camera: With at least one cell.
        kind: One of `COSTS`.
    """
    label, title = COSTS[kind]
    costs = [
        max(1e-9, cell.encode_cpu_seconds / camera.clip.frames if kind == "time" else cell.kbps)
        for cell in camera.cells
    ]
    scores = [mean_score(cell.scores, camera.target) for cell in camera.cells]
    shapes, place = _frame(
        costs, [*scores, camera.reachable, mean_score(camera.ceiling, camera.target)]
    )
    shapes += [
        _text((SIZE[0] / 2, 12), f"{camera.topic}: {title}", "middle"),
        _text((_LEFT, _TOP - 14), _NAMES[camera.target.metric]),
        _text(((_LEFT + _RIGHT) / 2, _BOTTOM + 36), label, "middle"),
    ]
    _, height = place(costs[0], camera.reachable)
    shapes.append(_line([(_LEFT, height), (_RIGHT, height)], _TARGET, dashed=True))
    target = f"target {camera.reachable:.4g}"
    shapes.append(_text((_LEFT + 6, height - 9), target, color=_TARGET))
    front = [place(costs[n], scores[n]) for n in pareto(costs, scores)]
    if len(front) > 1:
        shapes.append(_line(front, _FRONT, 6))
    groups: dict[str, list[int]] = {}
    for number, cell in enumerate(camera.cells):
        groups.setdefault(f"{cell.setting.codec} {cell.setting.preset}", []).append(number)
    legend = _TOP + 8
    for number, (name, members) in enumerate(groups.items()):
        color = _COLORS[number % len(_COLORS)]
        places = [place(costs[n], scores[n]) for n in members]
        if len(places) > 1:
            shapes.append(_line(places, color, 1.5))
        for n, dot in zip(members, places, strict=True):
            tip = f"{camera.cells[n].setting.name}: {scores[n]:.3f}, {costs[n]:.4g} {label}"
            shapes.append(_dot(dot, color, 3.5, tip))
        shapes += [_dot((_LEGEND, legend), color), _text((_LEGEND + 12, legend), name)]
        legend += 20
    shapes.append(_line([(_LEGEND - 7, legend), (_LEGEND + 7, legend)], _FRONT, 6))
    shapes.append(_text((_LEGEND + 12, legend), "Pareto front"))
    width, height = SIZE
    parts = "\n".join(shapes)  # later ones cover earlier ones
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" '
        f'viewBox="0 0 {width} {height}" font-family="sans-serif" font-size="12">\n'
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>\n{parts}\n</svg>\n'
    )


def pareto(costs: Sequence[float], scores: Sequence[float]) -> list[int]:
    """Indices of what nothing cheaper is as good as, the cheapest first."""
    found: list[int] = []
    for number in sorted(range(len(costs)), key=lambda n: (costs[n], -scores[n])):
        if not found or scores[number] > scores[found[-1]]:
            found.append(number)
    return found


def _frame(
    costs: Sequence[float], scores: Sequence[float]
) -> tuple[list[str], Callable[[float, float], tuple[float, float]]]:
    """Axes of costs, which are logarithmic, and of scores; and where a pair of both is."""
    least, most = min(costs) / _SPARE, max(costs) * _SPARE
    margin = max((max(scores) - min(scores)) * 0.05, 1e-6 * max(1.0, abs(max(scores))))
    low, high = min(scores) - margin, max(scores) + margin

    def place(cost: float, score: float) -> tuple[float, float]:
        across = (log10(cost) - log10(least)) / (log10(most) - log10(least))
        up = (score - low) / (high - low)
        return _LEFT + across * (_RIGHT - _LEFT), _BOTTOM - up * (_BOTTOM - _TOP)

    shapes: list[str] = []
    powers = range(floor(log10(least)), ceil(log10(most)) + 1)
    for cost in (times * 10.0**power for power in powers for times in (1, 2, 5)):
        if least <= cost <= most:
            x, _ = place(cost, low)
            shapes.append(_line([(x, _BOTTOM), (x, _TOP)], _GRID))
            shapes.append(_text((x, _BOTTOM + 14), f"{cost:g}", "middle"))
    step = _round_step((high - low) / 6)
    for score in (step * n for n in range(ceil(low / step), floor(high / step) + 1)):
        _, y = place(least, score)
        shapes.append(_line([(_LEFT, y), (_RIGHT, y)], _GRID))
        shapes.append(_text((_LEFT - 6, y), f"{score:.6g}", "end"))
    shapes.append(_line([(_LEFT, _TOP), (_LEFT, _BOTTOM), (_RIGHT, _BOTTOM)], _INK))
    return shapes, place


def _line(
    points: Sequence[tuple[float, float]], color: str, width: float = 1, *, dashed: bool = False
) -> str:
    """A line through points, in pixels from the top left."""
    places = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    dashes = ' stroke-dasharray="5 4"' if dashed else ""
    return (
        f'<polyline points="{places}" fill="none" stroke="{color}" '
        f'stroke-width="{width:g}"{dashes}/>'
    )


def _dot(place: tuple[float, float], color: str, radius: float = 4, tip: str = "") -> str:
    """A disc around a place, with a tooltip."""
    x, y = place
    title = f"<title>{escape(tip)}</title>" if tip else ""
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}" fill="{color}">{title}</circle>'


def _text(place: tuple[float, float], words: str, anchor: str = "start", color: str = _INK) -> str:
    """Words, of which the start, middle or end is at a place; it is at half of their height."""
    x, y = place
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" '
        f'dominant-baseline="central" fill="{color}">{escape(words)}</text>'
    )


def _round_step(step: float) -> float:
    power = 10.0 ** floor(log10(step))
    return next(times * power for times in (1, 2, 5, 10) if times * power >= step * 0.999)


# ---------------------------------------------------------------- page


def page(result: Evaluation, folder: Path) -> str:
    """The page.

    Args:
        result: What was found.
        folder: Where its pictures are.

    Raises:
        OSError: A picture cannot be read.
    """
    template = Template(files(__package__).joinpath("page.html").read_text("utf-8"))
    sections = [*_head(result)]
    for camera in result.cameras:
        sections += _section(folder, camera)
    title = escape(f"Evaluation of {result.source.name}")
    return template.substitute(title=title, body="\n".join(sections))


def _head(result: Evaluation) -> Iterator[str]:
    source = escape(result.source.name)
    for item in result.recommended:
        yield (
            f"<p class=first>The {item.why} that reaches every camera's target (score at "
            f"least {item.score:.2f}): <code>mp4ds pack {source} -o DATASET "
            f"{escape(item.options)}</code></p>"
        )
    if not result.recommended:
        yield "<p class=first>None of the settings reaches every camera's target.</p>"
    for topic, reason in result.left_out.items():
        yield f"<p>{escape(topic)} was left out: {escape(reason)}.</p>"
    versions = ", ".join(f"{name} {version}" for name, version in result.versions.items())
    yield f"<p>Measured with {escape(versions)}.</p>"


def _section(folder: Path, camera: CameraEvaluation) -> Iterator[str]:
    yield f"<h2>{escape(camera.topic)}</h2>"
    plots = "".join(f"<figure>{plot(camera, kind)}</figure>" for kind in COSTS)
    yield f'<div class="plots">{plots}</div>'
    for item in findings_of(camera):
        yield f"<p>{escape(item)}</p>" if isinstance(item, str) else _table(item)
    yield "<h3>The same detail in each, enlarged twice</h3>"
    shown = {"encoder input": camera.ground_truth}
    for cell in camera.cells:
        score = f"{camera.target.metric} {mean_score(cell.scores, camera.target):.2f}"
        shown[f"{cell.setting.name}: {score}, {cell.kbps:.0f} kbit/s"] = cell.picture
    figures = []
    for words, name in shown.items():
        data = base64.b64encode((folder / name).read_bytes()).decode()
        figures.append(
            f'<figure><img src="data:image/png;base64,{data}" alt="{escape(words)}">'
            f"<figcaption>{escape(words)}</figcaption></figure>"
        )
    yield f'<div class="pictures">{"".join(figures)}</div>'


def _table(rows: list[Row]) -> str:
    """A table without the columns that are empty, such as scores that were not computed."""
    kept = [name for name in rows[0] if any(row[name] for row in rows)]
    lines = ["<tr>" + "".join(f"<th>{escape(name)}</th>" for name in kept) + "</tr>"]
    for row in rows:
        cells = "".join(f"<td>{escape(row[name])}</td>" for name in kept)
        lines.append(f"<tr{' class=chosen' if row.get('best') else ''}>{cells}</tr>")
    return '<div class="scroll"><table>\n' + "\n".join(lines) + "\n</table></div>"
