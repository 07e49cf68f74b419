"""The files that tell what an evaluation found."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from mp4ds.evaluating.options import EvaluateOptions
from mp4ds.evaluating.page import page
from mp4ds.evaluating.plots import COSTS, SIZE, plot
from mp4ds.evaluating.results import CameraEvaluation, Cell, Evaluation
from mp4ds.outputs import write_synced
from mp4ds.scoring import METRICS
from mp4ds.video.drawing import png_of, svg_of

_STATISTICS = ("mean", "harmonic_mean", "percentile_5", "minimum")
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
        OSError: The disk refused.
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
    setting = asdict(cell.setting)
    scores = {
        f"{metric}_{statistic}": f"{getattr(summary, statistic):.6f}"
        for metric, summary in cell.scores.items()
        for statistic in _STATISTICS
    }
    why = [item.why for item in camera.recommended if item.setting == cell.setting]
    figures = {name: getattr(cell, name) for name in _FIGURES}
    return {
        "topic": camera.topic,
        **setting,
        "frames": camera.frames,
        **{name: round(value, 6) for name, value in figures.items()},
        **scores,
        "machine": cell.machine,
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
