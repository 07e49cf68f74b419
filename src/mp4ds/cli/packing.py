"""``mp4ds pack`` and ``mp4ds import``: what makes datasets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Optional

import typer

from mp4ds.cli.options import Command, ForceFlag, JsonFlag, parse_share, takes
from mp4ds.cli.output import print_json, print_pack, print_speeds, say
from mp4ds.cli.process import told_errors
from mp4ds.cli.progress import pack_progress
from mp4ds.errors import OptionError
from mp4ds.files.urls import remote
from mp4ds.packing.options import ImageFolder, PackOptions, PackSummary

_ONLY_OF_RECORDINGS = (
    *("topics", "exclude", "camera_info", "window", "cluster", "join", "keep_going", "salvage"),
)


@takes(PackOptions, without=("images",))
def pack(
    options: Callable[[], PackOptions],
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="SOURCE...",
            help="A .bag, a rosbag2 folder, an .mcap or a dataset; or several parts.",
        ),
    ],
    output: Annotated[
        str,
        typer.Option(
            "--output",
            "-o",
            metavar="DATASET",
            help="The folder to make; with a slash at its end, one dataset per SOURCE in it.",
        ),
    ],
    shard: Annotated[
        Optional[str],  # noqa: UP045 - read at run time by typer
        typer.Option("--shard", metavar="I/N", help="Pack one share of the parts only."),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Pack a recording, or a dataset again, into a dataset of mp4 files.

    Lossless by default: `mp4ds unpack` gives every message back as it was. A pack that was
    interrupted goes on when the same command is run again. Of a dataset, what was exact stays so.
    """
    from mp4ds.packing.pack import pack as run
    from mp4ds.packing.pack import pack_each, pack_share

    summaries: list[PackSummary] = []
    with told_errors(as_json), pack_progress(as_json, whole=not shard) as progress:
        chosen = options()
        if shard and (chosen.join or output.endswith("/")):
            raise OptionError("`shard` goes neither with `join` nor with several datasets.")
        if shard:
            pack_share(sources, output, parse_share(shard), chosen, progress=progress)
        elif output.endswith("/"):
            summaries = pack_each(sources, output, chosen, progress=progress)
        else:
            summaries = [run(sources, output, chosen, progress=progress)]
    if as_json:
        print_json(summaries if output.endswith("/") or shard else summaries[0])
        return
    for summary in summaries:
        print_pack(summary)
        if chosen.purpose is not None and not remote(summary.dataset):
            from mp4ds.plugins.info import reading_speeds

            with told_errors(as_json):
                print_speeds(reading_speeds(summary.dataset))
    if shard:
        say(f"share {shard} is packed; when all are, --join makes the dataset")


repack = pack

# ---------------------------------------------------------------- import

imports = typer.Typer(
    name="import",
    help="Make a dataset of images, or of a video of the paper's tool.",
    no_args_is_help=True,
    rich_markup_mode=None,
)

_Output = Annotated[
    str, typer.Option("--output", "-o", metavar="DATASET", help="The folder to make.")
]


@imports.command(cls=Command)
@takes(ImageFolder, PackOptions, without=("images", *_ONLY_OF_RECORDINGS))
def images(
    images_as: Callable[[], ImageFolder],
    options: Callable[[], PackOptions],
    folder: Annotated[
        str, typer.Argument(metavar="FOLDER", help="Of images, or of a layout that is known.")
    ],
    output: _Output,
    as_json: JsonFlag = False,
) -> None:
    """Make a dataset of a folder of images with times.

    EuRoC, KITTI and TUM RGB-D folders give all their cameras at once. Lossless by default. A run
    that was interrupted goes on when the same command is run again.
    """
    from mp4ds.packing.pack import pack as run

    with told_errors(as_json), pack_progress(as_json) as progress:
        chosen = replace(options(), images=images_as())
        summary = run(folder, output, chosen, progress=progress)
    if as_json:
        print_json(summary)
    else:
        print_pack(summary)


@imports.command("ros-mp4", cls=Command)
def ros_mp4(
    video: Annotated[str, typer.Argument(metavar="VIDEO", help="The mp4.")],
    sidecar: Annotated[str, typer.Argument(metavar="YAML", help="The YAML that came with it.")],
    output: _Output,
    force: ForceFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Make a dataset of a video and YAML of the tool published with the paper.

    The video is not encoded anew: its packets are copied.
    """
    from mp4ds.plugins.importing.ros_mp4 import import_ros_mp4

    with told_errors(as_json):
        summary = import_ros_mp4(video, sidecar, output, force=force)
    if as_json:
        print_json(summary)
    else:
        print_pack(summary)
