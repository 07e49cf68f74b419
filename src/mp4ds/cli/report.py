"""``mp4ds report``, ``mp4ds frames`` and ``mp4ds evaluate``: commands for looking at datasets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

import click

from mp4ds.cli.options import (
    argument,
    command,
    datasets_argument,
    jobs_option,
    output_option,
    takes,
)
from mp4ds.cli.output import print_table, progress_of, say, show
from mp4ds.dataset.dataset import datasets_in
from mp4ds.errors import OptionError, counted, path_text, size_text
from mp4ds.plugins.evaluating.evaluate import EvaluateOptions, evaluate
from mp4ds.plugins.evaluating.page import findings_of
from mp4ds.plugins.evaluating.trials import Evaluation
from mp4ds.plugins.reporting.report import (
    OverviewSummary,
    ReportOptions,
    ReportSummary,
    report,
    reports,
)
from mp4ds.plugins.reporting.stills import StillOptions, StillSummary, frames

_PLAYS = {"video": "plays its video", "stills": "shows stills", "nothing": "shows nothing"}


@command()
@datasets_argument
@jobs_option
@takes(ReportOptions)
def report_command(datasets: Sequence[str], jobs: int | None, options: ReportOptions) -> None:
    """Make an HTML report: synchronised cameras, timing, topics, calibrations.

    Open its index.html in a browser, from disk; it works offline. Several datasets, or a folder of
    them, get an overview page with a picture of each and links to their reports.
    """
    found = datasets_in(datasets)
    if len(found) == 1:
        with progress_of("reporting") as tell:
            summary: ReportSummary | OverviewSummary = report(found[0], options, progress=tell)
        show(summary, _print_report)
    else:
        folder = options.output
        if folder is None and len(datasets) == 1 and Path(datasets[0]).is_dir():
            folder = Path(datasets[0])
        if folder is None:
            problem = "Give `output`: where to write the overview page of several datasets."
            raise OptionError(problem)
        options = replace(options, output=None)
        with progress_of("reporting") as tell:
            summary = reports(found, folder, options, jobs=jobs, progress=tell)
        show(summary, _print_reports)
    if summary.problems:
        raise click.exceptions.Exit(1)


def _print_reports(summary: OverviewSummary) -> None:
    for problem in summary.problems:
        say(f"not shown: {problem}")
    say(f"{path_text(summary.index)}: {counted(summary.datasets, 'dataset')}")


def _print_report(summary: ReportSummary) -> None:
    for camera in summary.cameras:
        note = f": {camera.note}" if camera.note else ""
        say(f"{camera.topic}: {_PLAYS[camera.plays]}{note}")
    for problem in summary.problems:
        say(f"not shown: {problem}")
    say(f"{path_text(summary.index)}: {size_text(summary.bytes)}")


@command()
@argument("dataset", "DATASET", "A dataset, or a sidecar next to its video.")
@output_option(
    "IMAGE", "The .png or .jpg to write.", required=True, type=click.Path(path_type=Path)
)
@takes(StillOptions)
def frames_command(dataset: str, output: Path, options: StillOptions) -> None:
    """Save one frame as an image."""
    show(frames(dataset, output, options), _print_still)


def _print_still(summary: StillSummary) -> None:
    place = path_text(summary.output)
    say(f"{place}: frame {summary.index} of {summary.topic}, stamp {summary.stamp_ns} ns")


# ---------------------------------------------------------------- evaluate

_SPARE = (
    *("best", "PSNR Cr", "PSNR Cb", "B/frame", "harmonic", "decoded/CPU s"),
    *("CPU s", "SSIM", "5 %", "least", "time", "fps"),
)


def print_evaluation(result: Evaluation) -> None:
    """Print what was found."""
    for item in chain.from_iterable(map(findings_of, result.cameras)):
        if isinstance(item, str):
            say(item)
        else:
            print_table(item, {}, spare=_SPARE)
    for topic, reason in result.left_out.items():
        say(f"{topic}: left out: {reason}")
    if len(result.cameras) > 1:
        for best in result.recommended:
            say(f"{best.why} for all cameras: {best.options} (score at least {best.score:.2f})")
        if not result.recommended:
            say("no setting reaches every camera's target")
    tried = counted(result.tried, "setting")
    say(f"{path_text(result.output)}/index.html: {tried} tried")


@command()
@argument("source", "SOURCE", "A .bag, rosbag2 folder, .mcap, dataset or video.")
@output_option("DIR", "Folder for the results; default: NAME_evaluation.")
@takes(EvaluateOptions)
def evaluate_command(source: str, output: str | None, options: EvaluateOptions) -> None:
    """Compare encoder settings on clips of a recording: quality, size and time.

    Writes a folder with tables, plots and a page, and recommends options for `mp4ds pack`.
    """
    with progress_of("evaluating") as tell:
        result = evaluate(source, options, output=output, progress=tell)
    show(result, print_evaluation)
