"""``mp4ds export``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer

from mp4ds.cli.arguments import parse_resize
from mp4ds.cli.failures import told_errors
from mp4ds.cli.options import (
    EveryOption,
    ExcludeOption,
    ForceFlag,
    JsonFlag,
    MaxRateOption,
    ResizeOption,
    TopicsOption,
)
from mp4ds.cli.output import print_json, say, status_line

if TYPE_CHECKING:
    from mp4ds.exporting import ExportSummary

_NS_PER_MS = 1_000_000


def export(
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
    topics: TopicsOption = None,
    exclude: ExcludeOption = None,
    resize: ResizeOption = None,
    every: EveryOption = 1,
    max_rate: MaxRateOption = None,
    pixels: Annotated[
        str,
        typer.Option(
            "--pixels",
            metavar="KIND",
            help="seen: as recorded, but Bayer and YUV as RGB; native keeps a mosaic; rgb; gray.",
        ),
    ] = "seen",
    sync: Annotated[
        Optional[float],  # noqa: UP045 - read at run time by typer
        typer.Option(
            "--sync",
            metavar="MS",
            min=0.0,
            max=1e9,
            help="Only frames of which every camera has one within so many milliseconds.",
        ),
    ] = None,
    poses: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option("--poses", metavar="TOPIC", help="Of poses, for euroc, tum and colmap."),
    ] = None,
    fps: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(
            "--fps", min=1, max=1000, help="Of lerobot; the rate of the first camera by default."
        ),
    ] = None,
    state: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option("--state", metavar="TOPIC", help="observation.state of lerobot."),
    ] = None,
    action: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option("--action", metavar="TOPIC", help="action of lerobot."),
    ] = None,
    task: Annotated[
        str, typer.Option("--task", metavar="TEXT", help="What the robot does, for lerobot.")
    ] = "",
    codec: Annotated[
        str, typer.Option("--codec", help="av1, h264 or h265: of videos made for lerobot.")
    ] = "av1",
    crf: Annotated[
        int, typer.Option("--crf", min=0, max=63, help="Their quality; less is better.")
    ] = 30,
    force: ForceFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Write a dataset in the format of another tool, as far as that can hold it.

    What it cannot hold is counted by topic and told, here and in mp4ds_export.json.
    """
    from mp4ds.exporting import ExportOptions
    from mp4ds.exporting import export as run

    with told_errors(as_json), status_line(as_json, "exporting") as tell:
        options = ExportOptions(
            topics=topics or (),
            exclude=exclude or (),
            resize=parse_resize(resize),
            every=every,
            max_rate=max_rate,
            pixels=pixels,
            tolerance_ns=round(sync * _NS_PER_MS) if sync is not None else None,
            poses=poses,
            fps=fps,
            state=state,
            action=action,
            task=task,
            codec=codec,
            crf=crf,
            force=force,
        )
        summary = run(datasets, to, output, options, progress=tell)
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
