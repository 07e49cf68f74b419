"""``mp4ds unpack`` and ``mp4ds export``: what is made of datasets."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Optional

import typer

from mp4ds.cli.options import DatasetArgument, JsonFlag, takes
from mp4ds.cli.output import print_json, print_unpack, say, status_line, unpack_progress
from mp4ds.cli.process import told_errors
from mp4ds.plugins.exporting.export import export as run_export
from mp4ds.plugins.exporting.job import ExportOptions, ExportSummary
from mp4ds.unpacking.unpack import UnpackOptions
from mp4ds.unpacking.unpack import unpack as run


@takes(UnpackOptions)
def unpack(
    options: Callable[[], UnpackOptions],
    dataset: DatasetArgument,
    to: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option("--to", help="bag, rosbag2, mcap or images; by default as it was recorded."),
    ] = None,
    output: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option("--output", "-o", metavar="OUT", help="What to make, else NAME_unpacked."),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Write a dataset's recording again: as a bag, rosbag2, MCAP, or images.

    Messages are converted between ROS 1 and ROS 2 where the target asks for it.
    """
    with told_errors(as_json), unpack_progress(as_json) as progress:
        summary = run(dataset, to, output, options(), progress=progress)
    if as_json:
        print_json(summary)
        return
    print_unpack(summary, "images" if to == "images" else "messages")


@takes(ExportOptions)
def export(
    options: Callable[[], ExportOptions],
    to: Annotated[
        str,
        typer.Argument(metavar="FORMAT", help="euroc, tum, kitti, colmap, rerun or lerobot."),
    ],
    datasets: Annotated[
        list[str],
        typer.Argument(
            metavar="DATASET...", help="A dataset; for lerobot also several, each an episode."
        ),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="OUT", help="The folder to make; for rerun an .rrd file."
        ),
    ],
    as_json: JsonFlag = False,
) -> None:
    """Write a dataset in the format of another tool, as far as that can hold it.

    What it cannot hold is counted by topic and told, here and in mp4ds_export.json.
    """
    with told_errors(as_json), status_line(as_json, "exporting") as tell:
        summary = run_export(datasets, to, output, options(), progress=tell)
    if as_json:
        print_json(summary)
    else:
        _print_export(summary)


def _print_export(summary: ExportSummary) -> None:
    """Print what was written, and every message that was not."""
    total = sum(summary.messages.values())
    say(f"{summary.output}: {total} messages of {len(summary.messages)} topics")
    for place, topic in summary.places.items():
        say(f"{place}: {topic}")
    for note in summary.notes:
        say(f"note: {note}")
    for topic, reasons in summary.left_out.items():
        for reason, count in reasons.items():
            say(f"left out: {count} messages of {topic}: {reason}")
