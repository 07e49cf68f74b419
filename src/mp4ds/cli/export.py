"""``mp4ds export``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click

from mp4ds.cli.options import argument, command, option, takes
from mp4ds.cli.output import say, show
from mp4ds.cli.progress import progress_of
from mp4ds.errors import counted, path_text
from mp4ds.options import WHERE
from mp4ds.plugins.exporting.export import export
from mp4ds.plugins.exporting.job import ExportOptions, ExportSummary


@command()
@argument("to", "FORMAT", "euroc, tum, colmap or lerobot.")
@argument(
    "datasets",
    "DATASET...",
    "A dataset; for lerobot one or more, each an episode.",
    nargs=-1,
    required=True,
)
@option(
    "--output",
    "-o",
    panel=WHERE,
    required=True,
    metavar="OUT",
    type=click.Path(path_type=Path),
    help="Folder to create.",
)
@takes(ExportOptions)
def export_command(to: str, datasets: Sequence[str], output: Path, options: ExportOptions) -> None:
    """Export a dataset to another tool's format, keeping what that format supports.

    What is left out is counted by topic and listed, here and in mp4ds_export.json.
    """
    with progress_of("exporting") as tell:
        summary = export(datasets, to, output, options, progress=tell)
    show(summary, _print)


def _print(summary: ExportSummary) -> None:
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
