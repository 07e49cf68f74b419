"""``mp4ds unpack`` and ``mp4ds export``: commands that convert datasets."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Optional

import typer

from mp4ds.cli.options import DatasetsArgument, JobsOption, JsonFlag, cores, takes
from mp4ds.cli.output import print_json, print_unpack, say
from mp4ds.cli.process import report_errors
from mp4ds.cli.progress import progress_of
from mp4ds.dataset.collections import datasets_in
from mp4ds.errors import counted, path_text
from mp4ds.plugins.exporting.export import export as run_export
from mp4ds.plugins.exporting.job import ExportOptions, ExportSummary
from mp4ds.unpacking.options import UnpackOptions, UnpackProgress
from mp4ds.unpacking.unpack import unpack as run
from mp4ds.unpacking.unpack import unpack_each


@takes(UnpackOptions)
def unpack(
    options: Callable[[], UnpackOptions],
    datasets: DatasetsArgument,
    to: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option("--to", help="bag, rosbag2, mcap or images; default: the recorded format."),
    ] = None,
    output: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            "--output",
            "-o",
            metavar="OUT",
            help="Output, or a folder for the outputs of several datasets; default: NAME_unpacked.",
        ),
    ] = None,
    jobs: JobsOption = None,
    as_json: JsonFlag = False,
) -> None:
    """Turn a dataset back into a recording: a bag, rosbag2, MCAP or images.

    Messages are converted between ROS 1 and ROS 2 if the output format requires it.
    """
    with report_errors(as_json), progress_of("unpacking", as_json) as tell:
        noun = "image" if to == "images" else "message"
        found, chosen = datasets_in(datasets), options()

        def progress(state: UnpackProgress) -> None:
            total = state.messages_total
            if tell:
                unit = noun if len(found) == 1 else "dataset"
                done = f"{state.messages} of {total}" if total else f"{state.messages}"
                tell(f"{done} {unit}s", state.messages / total if total else None)

        if len(found) == 1:
            summaries = [run(found[0], to, output, chosen, progress=progress)]
        else:
            summaries = unpack_each(found, to, output, chosen, jobs=cores(jobs), progress=progress)
    if as_json:
        print_json(summaries[0] if len(found) == 1 else summaries)
        return
    for summary in summaries:
        print_unpack(summary, noun)


@takes(ExportOptions)
def export(
    options: Callable[[], ExportOptions],
    to: Annotated[
        str,
        typer.Argument(metavar="FORMAT", help="euroc, tum, colmap or lerobot."),
    ],
    datasets: Annotated[
        list[str],
        typer.Argument(
            metavar="DATASET...", help="A dataset; for lerobot one or more, each an episode."
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="OUT", help="Folder to create.")
    ],
    as_json: JsonFlag = False,
) -> None:
    """Export a dataset to another tool's format, keeping what that format supports.

    What is left out is counted by topic and listed, here and in mp4ds_export.json.
    """
    with report_errors(as_json), progress_of("exporting", as_json) as tell:
        summary = run_export(datasets, to, output, options(), progress=tell)
    if as_json:
        print_json(summary)
    else:
        _print_export(summary)


def _print_export(summary: ExportSummary) -> None:
    """Print what was written, and every message that was not."""
    total = sum(summary.messages.values())
    topics = counted(len(summary.messages), "topic")
    say(f"{path_text(summary.output)}: {counted(total, 'message')} of {topics}")
    for place, topic in summary.places.items():
        say(f"{place}: {topic}")
    for note in summary.notes:
        say(f"note: {note}")
    for topic, reasons in summary.left_out.items():
        for reason, count in reasons.items():
            say(f"left out: {counted(count, 'message')} of {topic}: {reason}")
