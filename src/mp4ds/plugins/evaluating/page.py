"""The files of an evaluation's results: tables, plots, and one page."""

from __future__ import annotations

import base64
import csv
import io
import json
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path
from typing import Any

from mp4ds.files.outputs import csv_cell, write_synced
from mp4ds.plugins.evaluating.options import EvaluateOptions
from mp4ds.plugins.evaluating.results import (
    CameraEvaluation,
    Cell,
    Evaluation,
    pareto,
    score_of,
)
from mp4ds.video.drawing import Dot, Line, Shape, Text, png_of, svg_of
from mp4ds.video.scores import METRICS

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
"""For each plot: the cost of a setting, its label, and the plot's title."""


@dataclass(frozen=True, slots=True)
class _Axis:
    """How values map to pixels.

    Attributes:
        low: The lowest value.
        high: The highest value.
        begin: Position of the lowest value, pixels.
        end: Position of the highest value, pixels.
        is_log: Whether the scale is logarithmic.
    """

    low: float
    high: float
    begin: float
    end: float
    is_log: bool

    def at(self, value: float) -> float:
        """Position of a value."""
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
    shapes.append(Text((SIZE[0] - _RIGHT + 30, legend), "Pareto front"))
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


# ---------------------------------------------------------------- page

_STYLE = """
body { font: 14px/1.45 system-ui, sans-serif; color: #222; margin: 2em auto; max-width: 1340px;
       padding: 0 1em; overflow-wrap: anywhere; }
.scroll { overflow-x: auto; margin: 1em 0; overflow-wrap: normal; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: 2px 9px; text-align: right; border-bottom: 1px solid #e4e4e4; }
th { border-bottom: 1px solid #888; }
td.word, th.word { text-align: left; }
tr.chosen { background: #e7f4e4; }
.plots, .pictures { display: flex; flex-wrap: wrap; gap: 12px; }
figure { margin: 0; max-width: 100%; }
figure img, figure svg { display: block; max-width: 100%; height: auto; }
figure img { image-rendering: pixelated; }
figcaption { font-size: 12px; }
code { background: #f2f2f2; padding: 1px 4px; }
.first { font-size: 16px; line-height: 1.8; }
"""
_CELL_HEADS = (
    *("codec", "preset", "crf", "kbit/s", "bytes/frame", "frames/s", "CPU s/frame"),
    *("decoded frames/CPU s", "VMAF", "harmonic", "5 %", "min"),
    *("PSNR Y", "PSNR Cb", "PSNR Cr", "SSIM", "all, MB", "all, min"),
)
_STATISTICS = ("mean", "harmonic_mean", "percentile_5", "minimum")


def page(result: Evaluation) -> str:
    """The page.

    Args:
        result: What was found; its pictures are read from its folder.

    Raises:
        OSError: A picture cannot be read.
    """
    title = escape(f"Evaluation of {result.source.name}")
    body = "\n".join([f"<h1>{title}</h1>", *_head(result), *_sections(result)])
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{title}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n"
    )


def _head(result: Evaluation) -> Iterator[str]:
    source = escape(result.source.name)
    for item in result.recommended:
        yield (
            f"<p class=first>The {escape(item.why)} that reaches every camera's target (score at "
            f"least {item.score:.2f}): <code>mp4ds pack {source} -o DATASET "
            f"{escape(item.options)}</code></p>"
        )
    if not result.recommended:
        yield "<p class=first>None of the settings reaches every camera's target.</p>"
    for topic, reason in result.left_out.items():
        yield f"<p>{escape(topic)} was left out: {escape(reason)}.</p>"
    versions = ", ".join(f"{name} {version}" for name, version in result.versions.items())
    yield f"<p>Measured with {escape(versions)}.</p>"


def _paragraph(what: str, options: str, score: str) -> str:
    return f"<p>The {escape(what)}: <code>{escape(options)}</code> ({escape(score)}).</p>"


def _sections(result: Evaluation) -> Iterator[str]:
    for camera in result.cameras:
        yield f"<h2>{escape(camera.topic)}</h2>"
        for item in camera.recommended:
            score = f"{camera.target.metric} {item.score:.2f}"
            yield _paragraph(f"{item.why} that reaches the target", item.options, score)
        yield f"<p>{escape(_facts(camera))}</p>"
        yield from (f"<p>Note: {escape(note)}.</p>" for note in camera.notes)
        plots = "".join(f"<figure>{svg_of(plot(camera, kind), SIZE)}</figure>" for kind in COSTS)
        yield f'<div class="plots">{plots}</div>'
        yield _cells(camera)
        yield from _rates(camera)
        yield from _storage(camera)
        yield from _pictures(result, camera)


def _facts(camera: CameraEvaluation) -> str:
    width, height = camera.size
    rate = f"{camera.rate:.2f} Hz, " if camera.rate else ""
    ceiling = ", ".join(f"{name} {value.mean:.2f}" for name, value in camera.ceiling.items())
    return (
        f"{camera.encoding}, {width}x{height}, {rate}{camera.source_frames} images; clip of "
        f"{camera.frames} frames starting at {camera.start:.2f} s, {camera.seconds:.2f} s long. "
        f"Scored against itself, the clip has {ceiling}: no setting can score higher. The target "
        f"is {camera.target.metric} {camera.reachable:.2f}."
    )


def _table(heads: Sequence[str], rows: Iterable[tuple[bool, Sequence[str]]], words: int) -> str:
    """A table without the columns that are empty, such as scores that were not computed."""
    rows = list(rows)
    kept = [n for n in range(len(heads)) if any(values[n] for _, values in rows)]

    def cells(tag: str, values: Sequence[str]) -> str:
        return "".join(
            f"<{tag}{' class=word' if n < words else ''}>{escape(values[n])}</{tag}>" for n in kept
        )

    lines = [f"<tr>{cells('th', heads)}</tr>"]
    for is_chosen, values in rows:
        lines.append(f"<tr{' class=chosen' if is_chosen else ''}>{cells('td', values)}</tr>")
    return '<div class="scroll"><table>\n' + "\n".join(lines) + "\n</table></div>"


def _cells(camera: CameraEvaluation) -> str:
    chosen = {item.setting for item in camera.recommended}
    rows = ((cell.setting in chosen, _cell(camera, cell)) for cell in camera.cells)
    return _table(_CELL_HEADS, rows, 2)


def _cell(camera: CameraEvaluation, cell: Cell) -> list[str]:
    setting = cell.setting
    return [
        *(setting.codec, setting.preset, str(setting.crf)),
        f"{cell.kbps:.1f}",
        f"{cell.frame_bytes:.0f}",
        f"{cell.encode_fps:.1f}",
        f"{cell.encode_cpu_seconds / camera.frames:.4f}",
        f"{cell.decode_fps:.0f}",
        *(_score(cell, "vmaf", statistic, 3) for statistic in _STATISTICS),
        *(_score(cell, metric, "mean", 2) for metric in ("psnr_y", "psnr_cb", "psnr_cr")),
        _score(cell, "ssim", "mean", 5),
        f"{cell.whole_bytes / 1e6:.1f}",
        f"{cell.whole_seconds / 60:.1f}",
    ]


def _score(cell: Cell, metric: str, statistic: str, digits: int) -> str:
    summary = cell.scores.get(metric)
    return "" if summary is None else f"{getattr(summary, statistic):.{digits}f}"


def _rates(camera: CameraEvaluation) -> Iterator[str]:
    if not camera.rates:
        return
    yield f"<h3>crf that reaches {camera.target.metric} {camera.target.score:g}, by frame rate</h3>"
    heads = (
        *("Hz", "frames", "codec", "preset", "crf", "score", "ceiling", "bytes/frame"),
        *("s/frame", "kbit/s"),
    )
    rows = (
        (
            False,
            [
                f"{row.rate:g}",
                str(row.frames),
                row.setting.codec,
                row.setting.preset,
                str(row.setting.crf) + ("" if row.reached else " (does not reach it)"),
                f"{row.score:.3f}",
                f"{row.ceiling:.3f}",
                f"{row.frame_bytes:.0f}",
                f"{row.frame_seconds:.4f}",
                f"{row.kbps:.1f}",
            ],
        )
        for row in camera.rates
    )
    yield _table(heads, rows, 0)


def _storage(camera: CameraEvaluation) -> Iterator[str]:
    data_set = camera.data_set
    if data_set is None:
        return
    yield f"<h3>{data_set.described}</h3>"
    rows = (
        (
            row.days is not None,
            [
                row.form,
                f"{row.frame_bytes:.0f}",
                f"{row.gigabytes:.2f}",
                "" if row.days is None else f"{row.days:.3f}",
                "" if row.cpu_days is None else f"{row.cpu_days:.3f}",
            ],
        )
        for row in camera.storage
    )
    yield _table(("stored as", "bytes/frame", "GB", "days to encode", "CPU days"), rows, 1)


def _pictures(result: Evaluation, camera: CameraEvaluation) -> Iterator[str]:
    yield "<h3>The same detail in each, enlarged twice</h3>"
    shown = [("encoder input", camera.ground_truth)]
    for cell in camera.cells:
        score = _score(cell, camera.target.metric, "mean", 2)
        words = f"{cell.setting.name}: {camera.target.metric} {score}, {cell.kbps:.0f} kbit/s"
        shown.append((words, cell.picture))
    figures = []
    for words, name in shown:
        data = base64.b64encode((result.output / name).read_bytes()).decode()
        figures.append(
            f'<figure><img src="data:image/png;base64,{data}" alt="{escape(words)}">'
            f"<figcaption>{escape(words)}</figcaption></figure>"
        )
    yield f'<div class="pictures">{"".join(figures)}</div>'


# ---------------------------------------------------------------- files

_FIGURES = (
    "encode_seconds",
    "encode_cpu_seconds",
    "encode_fps",
    "decode_fps",
    "size",
    "frame_bytes",
    "kbps",
    "whole_bytes",
    "whole_seconds",
)


def write_files(result: Evaluation, options: EvaluateOptions) -> None:
    """Write all files into the folder of an evaluation.

    Args:
        result: What was found.
        options: What was asked for.

    Raises:
        OSError: It cannot be written.
    """
    folder = result.output
    write_synced(folder / "evaluation.csv", table(result).encode())
    write_synced(folder / "evaluation.json", document(result, options).encode())
    for camera in result.cameras:
        for kind in COSTS:
            shapes = plot(camera, kind)
            path = folder / "plots" / f"{camera.name}-{kind}.svg"
            write_synced(path, svg_of(shapes, SIZE).encode())
            write_synced(path.with_suffix(".png"), png_of(shapes, SIZE))
    write_synced(folder / "index.html", page(result).encode())


def table(result: Evaluation) -> str:
    """The figures of all cells as CSV, a line for each."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(_columns()), lineterminator="\n")
    writer.writeheader()
    for camera in result.cameras:
        for cell in camera.cells:
            writer.writerow(_row(camera, cell))
    return text.getvalue()


def _columns() -> Iterator[str]:
    yield from ("topic", "codec", "preset", "crf", "gop", "frames", *_FIGURES)
    for metric in METRICS:
        yield from (f"{metric}_{statistic}" for statistic in _STATISTICS)
    yield from ("machine", "recommended")


def _row(camera: CameraEvaluation, cell: Cell) -> dict[str, Any]:
    setting = {
        name: csv_cell(value) if isinstance(value, str) else value
        for name, value in asdict(cell.setting).items()
    }
    scores = {
        f"{metric}_{statistic}": f"{getattr(summary, statistic):.6f}"
        for metric, summary in cell.scores.items()
        for statistic in _STATISTICS
    }
    why = [item.why for item in camera.recommended if item.setting == cell.setting]
    figures = {name: getattr(cell, name) for name in _FIGURES}
    return {
        "topic": csv_cell(camera.topic),
        **setting,
        "frames": camera.frames,
        **{name: round(value, 6) for name, value in figures.items()},
        **scores,
        "machine": csv_cell(cell.machine),
        "recommended": " ".join(why),
    }


def document(result: Evaluation, options: EvaluateOptions) -> str:
    """Everything as JSON."""
    values = {"options": asdict(options), **asdict(result)}
    return json.dumps(values, default=_plain, indent=1) + "\n"


def _plain(value: Any) -> Any:
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} is not told")
