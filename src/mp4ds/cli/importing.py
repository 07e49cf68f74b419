"""``mp4ds import``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated

import typer

from mp4ds.cli.options import Command, ForceFlag, JsonFlag, quietable, takes
from mp4ds.cli.output import print_json, print_pack
from mp4ds.cli.process import report_errors
from mp4ds.cli.progress import pack_progress
from mp4ds.packing.options import ImageFolder, PackOptions
from mp4ds.packing.pack import pack as run
from mp4ds.plugins.importing.ros_mp4 import import_ros_mp4

imports = typer.Typer(
    name="import",
    help="Make a dataset from images, or from a video made by the paper's tool.",
    no_args_is_help=True,
    rich_markup_mode=None,
)

_Output = Annotated[
    str, typer.Option("--output", "-o", metavar="DATASET", help="Folder to create.")
]


@imports.command(cls=Command)
@quietable
@takes(ImageFolder, PackOptions)
def images(
    images_as: Callable[[], ImageFolder],
    options: Callable[[], PackOptions],
    folder: Annotated[
        str, typer.Argument(metavar="FOLDER", help="Folder of images, plain or in a known layout.")
    ],
    output: _Output,
    as_json: JsonFlag = False,
) -> None:
    """Make a dataset from a folder of timestamped images.

    EuRoC and TUM RGB-D folders are imported with all their cameras. Lossless by default. To
    resume a long import that was interrupted, run the same command again.
    """
    with report_errors(as_json), pack_progress(as_json) as progress:
        chosen = replace(options(), images=images_as())
        summary = run(folder, output, chosen, progress=progress)
    if as_json:
        print_json(summary)
    else:
        print_pack(summary)


@imports.command("ros-mp4", cls=Command)
@quietable
def ros_mp4(
    video: Annotated[str, typer.Argument(metavar="VIDEO", help="The mp4 file.")],
    sidecar: Annotated[
        str, typer.Argument(metavar="YAML", help="The YAML file that belongs to it.")
    ],
    output: _Output,
    force: ForceFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Convert an mp4 and YAML made by the tool published with the paper.

    The video is not re-encoded: its packets are copied.
    """
    with report_errors(as_json):
        summary = import_ros_mp4(video, sidecar, output, force=force)
    if as_json:
        print_json(summary)
    else:
        print_pack(summary)
