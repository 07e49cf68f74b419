"""``mp4ds evaluate``, and what it prints."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Optional

import typer

from mp4ds.cli.options import JsonFlag, takes
from mp4ds.cli.output import Column, print_json, print_table, say, size_text
from mp4ds.cli.process import told_errors
from mp4ds.errors import counted, interrupted, path_text
from mp4ds.plugins.evaluating.evaluate import evaluate as run
from mp4ds.plugins.evaluating.options import EvaluateOptions

if TYPE_CHECKING:
    from mp4ds.plugins.evaluating.results import (
        CameraEvaluation,
        Cell,
        EvaluateProgress,
        Evaluation,
    )

_CELLS = [
    *(Column(name) for name in ("codec", "preset", "crf", "kbit/s")),
    *(Column("B/frame", spare=9), Column("fps", spare=1), Column("CPU s", spare=6)),
    *(Column("decoded/CPU s", spare=7), Column("VMAF"), Column("harmonic", spare=8)),
    *(Column("5 %", spare=4), Column("least", spare=3), Column("PSNR Y"), Column("SSIM", spare=5)),
    *(Column("whole"), Column("time", spare=2)),
]
_RATES = [
    Column(name)
    for name in (
        *("Hz", "frames", "codec", "preset", "crf", "score", "ceiling"),
        *("B/frame", "ms/frame", "kbit/s"),
    )
]
_STORAGE = [
    Column("stored as", "text"),
    *(Column(name) for name in ("B/frame", "size", "days", "CPU days")),
]


def print_evaluation(result: Evaluation) -> None:
    """Print what was found."""
    for camera in result.cameras:
        _print_camera(camera)
    for topic, reason in result.left_out.items():
        say(f"{topic}: left out: {reason}")
    if len(result.cameras) > 1:
        for item in result.recommended:
            say(f"{item.why} for all cameras: {item.options} (score at least {item.score:.2f})")
        if not result.recommended:
            say("no setting reaches every camera's target")
    known = f", {result.known} of them in an earlier run" if result.known else ""
    tried = counted(result.tried + result.known, "setting")
    say(f"{path_text(result.output)}/index.html: {tried} tried{known}")


def _print_camera(camera: CameraEvaluation) -> None:
    rate = f" at {camera.rate:.2f} Hz" if camera.rate else ""
    say(
        f"{camera.topic}: {camera.encoding} {camera.size[0]}x{camera.size[1]}{rate}; clip of "
        f"{camera.frames} of {camera.source_frames} frames, starting at {camera.start:.2f} s"
    )
    print_table(_CELLS, [_cell_row(cell) for cell in camera.cells])
    ceiling = ", ".join(f"{name} {value.mean:.2f}" for name, value in camera.ceiling.items())
    say(f"ceiling, the clip scored against itself: {ceiling}")
    if camera.rates:
        print_table(_RATES, _rate_rows(camera))
    if camera.storage and camera.data_set:
        data_set = camera.data_set
        say(f"{data_set.described}, {data_set.frames:.0f} frames:")
        print_table(_STORAGE, _storage_rows(camera))
    for note in camera.notes:
        say(f"note: {note}")
    for item in camera.recommended:
        say(f"{item.why}: {item.options} ({camera.target.metric} {item.score:.2f})")


def _score(cell: Cell, metric: str, statistic: str, digits: int) -> str:
    summary = cell.scores.get(metric)
    return "" if summary is None else f"{getattr(summary, statistic):.{digits}f}"


def _cell_row(cell: Cell) -> list[str]:
    setting = cell.setting
    return [
        setting.codec,
        setting.preset,
        str(setting.crf),
        f"{cell.kbps:.0f}",
        f"{cell.frame_bytes:.0f}",
        f"{cell.encode_fps:.1f}",
        f"{cell.encode_cpu_seconds:.2f}",
        f"{cell.decode_fps:.0f}",
        *(
            _score(cell, "vmaf", statistic, 2)
            for statistic in ("mean", "harmonic_mean", "percentile_5", "minimum")
        ),
        _score(cell, "psnr_y", "mean", 2),
        _score(cell, "ssim", "mean", 4),
        size_text(cell.whole_bytes),
        time_text(cell.whole_seconds),
    ]


def _rate_rows(camera: CameraEvaluation) -> list[list[str]]:
    return [
        [
            f"{row.rate:g}",
            str(row.frames),
            row.setting.codec,
            row.setting.preset,
            str(row.setting.crf),
            f"{row.score:.2f}" + ("" if row.reached else " (not reached)"),
            f"{row.ceiling:.2f}",
            f"{row.frame_bytes:.0f}",
            f"{row.frame_seconds * 1000:.1f}",
            f"{row.kbps:.0f}",
        ]
        for row in camera.rates
    ]


def _storage_rows(camera: CameraEvaluation) -> list[list[str]]:
    return [
        [
            row.form,
            f"{row.frame_bytes:.0f}",
            f"{row.gigabytes:.1f} GB",
            "" if row.days is None else f"{row.days:.2f}",
            "" if row.cpu_days is None else f"{row.cpu_days:.2f}",
        ]
        for row in camera.storage
    ]


def time_text(seconds: float) -> str:
    """A duration in a suitable unit."""
    for limit, unit, size in ((120, "s", 1), (7200, "min", 60), (172_800, "h", 3600)):
        if seconds < limit:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds / 86_400:.1f} days"


# ---------------------------------------------------------------- evaluate

_AGAIN = "results so far are kept: run the same command again to resume"


@takes(EvaluateOptions)
def evaluate(
    options: Callable[[], EvaluateOptions],
    source: Annotated[
        str,
        typer.Argument(help="A .bag, rosbag2 folder, .mcap, dataset, video or folder of images."),
    ],
    output: Annotated[
        Optional[str],  # noqa: UP045 - read at run time by typer
        typer.Option(
            "--output",
            "-o",
            metavar="DIR",
            help="Folder for the results; default: NAME_evaluation.",
        ),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Compare encoder settings on clips of a recording: quality, size and time.

    Writes a folder with tables, plots and a page, and recommends options for `mp4ds pack`. To
    resume an interrupted evaluation, run the same command again.
    """
    with told_errors(as_json), _interruptible(), _progress(as_json) as report:
        result = run(source, options(), output=output, progress=report)
    if as_json:
        print_json(result)
    else:
        print_evaluation(result)


@contextmanager
def _interruptible() -> Iterator[None]:
    try:
        yield
    except (KeyboardInterrupt, SystemExit) as error:
        raise interrupted(error, _AGAIN) from None


@contextmanager
def _progress(as_json: bool) -> Iterator[Callable[[EvaluateProgress], None] | None]:
    """On a terminal, a bar for the settings of each camera."""
    from rich.console import Console

    console = Console(stderr=True)
    if as_json or not console.is_terminal:
        yield None
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    from mp4ds.cli.output import shown

    with Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        console=console,
        transient=True,
    ) as bar:
        task = bar.add_task("evaluating", total=None)

        def report(state: EvaluateProgress) -> None:
            text = f"{shown(state.camera)}: {state.what}"
            bar.update(task, description=text, completed=state.done, total=state.total)

        yield report
