"""``mp4ds report`` and ``mp4ds frames``: commands for looking at datasets."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from mp4ds.cli.options import (
    DatasetArgument,
    DatasetsArgument,
    JobsOption,
    JsonFlag,
    cores,
    takes,
)
from mp4ds.cli.output import print_json, printed, say
from mp4ds.cli.process import report_errors
from mp4ds.cli.progress import progress_of
from mp4ds.dataset.collections import datasets_in
from mp4ds.errors import OptionError, counted, path_text, size_text
from mp4ds.plugins.reporting.report import ReportOptions, ReportSummary, reports
from mp4ds.plugins.reporting.report import report as run_report
from mp4ds.plugins.reporting.server import ReportServer
from mp4ds.plugins.reporting.stills import StillOptions
from mp4ds.plugins.reporting.stills import frames as run_frames


@takes(ReportOptions)
def report(
    options: Callable[[], ReportOptions],
    datasets: DatasetsArgument,
    serve: Annotated[
        bool, typer.Option("--serve", help="Serve the report to browsers on this machine.")
    ] = False,
    port: Annotated[
        int, typer.Option("--port", min=0, max=65535, help="Port for --serve; 0 picks a free one.")
    ] = 0,
    jobs: JobsOption = None,
    as_json: JsonFlag = False,
) -> None:
    """Make an HTML report: synchronised cameras, timing, topics, calibrations.

    Open its index.html in a browser, from disk or with --serve; it works offline. Several datasets,
    or a folder of them, get an overview page with a picture of each and links to their reports.
    """
    with report_errors(as_json):
        found, chosen = datasets_in(datasets), options()
        if len(found) > 1:
            if serve:
                raise OptionError("--serve works with one dataset only.")
            _reports(datasets, found, chosen, cores(jobs), as_json)
            return
        with progress_of("reporting", as_json) as tell:
            summary = run_report(found[0], chosen, progress=tell)
        if as_json:
            print_json(
                {
                    "index": summary.index,
                    "bytes": summary.bytes,
                    "cameras": summary.cameras,
                    "problems": summary.problems,
                }
            )
        else:
            _print_report(summary)
        if serve:
            _serve(summary, port, as_json)
    if summary.problems:
        raise typer.Exit(1)


def _reports(
    datasets: Sequence[str],
    found: Sequence[Path],
    options: ReportOptions,
    jobs: int,
    as_json: bool,
) -> None:
    """Make the reports of several datasets, and the page that leads to them."""
    folder = options.output
    if folder is None and len(datasets) == 1 and Path(datasets[0]).is_dir():
        folder = Path(datasets[0])
    if folder is None:
        raise OptionError("Give `output`: where to write the overview page of several datasets.")
    with progress_of("reporting", as_json) as tell:
        summary = reports(found, folder, replace(options, output=None), jobs=jobs, progress=tell)
    if as_json:
        print_json(summary)
    else:
        for problem in summary.problems:
            say(f"not shown: {problem}")
        say(f"{path_text(summary.index)}: {counted(summary.datasets, 'dataset')}")
    if summary.problems:
        raise typer.Exit(1)


def _print_report(summary: ReportSummary) -> None:
    for camera in summary.cameras:
        note = f": {camera.note}" if camera.note else ""
        say(f"{camera.topic}: plays {_PLAYS[camera.plays]}{note}")
    for problem in summary.problems:
        say(f"not shown: {problem}")
    say(f"{path_text(summary.index)}: {size_text(summary.bytes)}")


_PLAYS = {"video": "its own video", "proxy": "a proxy", "nothing": "nothing"}


def _serve(summary: ReportSummary, port: int, as_json: bool) -> None:
    with ReportServer(summary.files, summary.start, port=port) as server:
        told = sys.stderr if as_json else sys.stdout
        with printed():
            print(f"{server.url} (Ctrl-C ends)", file=told, flush=True)
        server.serve()


@takes(StillOptions)
def frames(
    options: Callable[[], StillOptions],
    dataset: DatasetArgument,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="IMAGE", help="The .png or .jpg to write.")
    ],
    as_json: JsonFlag = False,
) -> None:
    """Save one frame as an image, or many frames as a contact sheet."""
    with report_errors(as_json):
        summary = run_frames(dataset, output, options())
    if as_json:
        print_json(summary)
        return
    first, last = summary.frames[0], summary.frames[-1]
    if first is last:
        place = f"{path_text(summary.output)}: frame {first.index} of {summary.topic}"
        say(f"{place}, stamp {first.stamp_ns} ns")
    else:
        say(
            f"{path_text(summary.output)}: {len(summary.frames)} frames of {summary.topic}, from "
            f"frame {first.index} to {last.index}"
        )
