"""``mp4ds pack``, also known as ``mp4ds repack``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Optional

import typer

from mp4ds.cli.options import JsonFlag, parse_share, takes
from mp4ds.cli.output import print_json, print_pack, print_speeds, say
from mp4ds.cli.process import report_errors
from mp4ds.cli.progress import pack_progress
from mp4ds.errors import OptionError
from mp4ds.files.urls import remote
from mp4ds.packing.options import PackOptions, PackSummary
from mp4ds.packing.pack import pack as run
from mp4ds.packing.pack import pack_each, pack_share


@takes(PackOptions)
def pack(
    options: Callable[[], PackOptions],
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="SOURCE...",
            help="A .bag, rosbag2 folder, .mcap or dataset; or the parts of a split recording.",
        ),
    ],
    output: Annotated[
        Optional[str],  # noqa: UP045 - read at run time by typer
        typer.Option(
            "--output",
            "-o",
            metavar="DATASET",
            help="Folder to create; if it ends in a slash, one dataset per SOURCE is made in it. "
            "Default: named after SOURCE, in the current folder.",
        ),
    ] = None,
    shard: Annotated[
        Optional[str],  # noqa: UP045 - read at run time by typer
        typer.Option("--shard", metavar="I/N", help="Pack only share I of N shares of the parts."),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Pack a recording into a dataset of mp4 files, or repack a dataset.

    Lossless by default: `mp4ds unpack` restores every message exactly. To resume a long pack that
    was interrupted, run the same command again. Repacking a dataset keeps exact what was exact.
    """
    summaries: list[PackSummary] = []
    with report_errors(as_json), pack_progress(as_json, whole=not shard) as progress:
        chosen = options()
        into = output if output and output.endswith("/") else None
        if shard and (chosen.join or into):
            raise OptionError("`shard` cannot be combined with `join` or with several datasets.")
        if shard:
            pack_share(sources, output, parse_share(shard), chosen, progress=progress)
        elif into:
            summaries = pack_each(sources, into, chosen, progress=progress)
        else:
            summaries = [run(sources, output, chosen, progress=progress)]
    if as_json:
        print_json(summaries if into or shard else summaries[0])
        return
    for summary in summaries:
        print_pack(summary)
        if chosen.purpose is not None and not remote(summary.dataset):
            from mp4ds.plugins.info import reading_speeds  # not for every short pack

            with report_errors(as_json):
                print_speeds(reading_speeds(summary.dataset))
    if shard:
        say(f"share {shard} is packed; once all shares are, run --join to make the dataset")


repack = pack
