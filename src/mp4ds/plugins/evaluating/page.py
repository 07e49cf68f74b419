"""The files of an evaluation's results: tables, plots, and one page."""

from __future__ import annotations

import base64
import csv
import io
import json
from collections.abc import Iterator
from dataclasses import asdict
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

from mp4ds.files.outputs import csv_cell, write_synced
from mp4ds.plugins.evaluating.options import EvaluateOptions
from mp4ds.plugins.evaluating.plots import COSTS, SIZE, plot
from mp4ds.plugins.evaluating.results import (
    CameraEvaluation,
    Cell,
    Evaluation,
    Row,
    score_of,
    told,
    why_of,
)
from mp4ds.video.drawing import png_of, svg_of
from mp4ds.video.scores import METRICS, ScoreSummary

PLOTS = "plots"
"""The folder of an evaluation for plots."""


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
    values = {"options": asdict(options), **asdict(result)}
    text = json.dumps(values, default=str, indent=1)  # paths
    write_synced(folder / "evaluation.json", f"{text}\n".encode())
    for camera in result.cameras:
        for kind in COSTS:
            shapes = plot(camera, kind)
            path = folder / PLOTS / f"{camera.name}-{kind}.svg"
            write_synced(path, svg_of(shapes, SIZE).encode())
            write_synced(path.with_suffix(".png"), png_of(shapes, SIZE))
    write_synced(folder / "index.html", page(result).encode())


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
    setting, machine = figures.pop("setting"), figures.pop("machine")
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
        "machine": machine,
        "recommended": why_of(camera, cell),
    }


# ---------------------------------------------------------------- page


def page(result: Evaluation) -> str:
    """The page.

    Args:
        result: What was found; its pictures are read from its folder.

    Raises:
        OSError: A picture cannot be read.
    """
    template = Template(files(__package__).joinpath("page.html").read_text("utf-8"))
    sections = [*_head(result)]
    for camera in result.cameras:
        sections += _section(result, camera)
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


def _section(result: Evaluation, camera: CameraEvaluation) -> Iterator[str]:
    yield f"<h2>{escape(camera.topic)}</h2>"
    plots = "".join(f"<figure>{svg_of(plot(camera, kind), SIZE)}</figure>" for kind in COSTS)
    yield f'<div class="plots">{plots}</div>'
    for item in told(camera):
        yield f"<p>{escape(item)}</p>" if isinstance(item, str) else _table(item)
    yield "<h3>The same detail in each, enlarged twice</h3>"
    shown = {"encoder input": camera.ground_truth}
    for cell in camera.cells:
        score = f"{camera.target.metric} {score_of(cell, camera.target):.2f}"
        shown[f"{cell.setting.name}: {score}, {cell.kbps:.0f} kbit/s"] = cell.picture
    figures = []
    for words, name in shown.items():
        data = base64.b64encode((result.output / name).read_bytes()).decode()
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
