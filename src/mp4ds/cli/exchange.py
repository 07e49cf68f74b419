"""``mp4ds import``, ``mp4ds export`` and ``mp4ds demo``: from other things, and to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import click

import mp4ds
from mp4ds.cli.options import argument, command, option, output_option, takes
from mp4ds.cli.output import say, show
from mp4ds.cli.pack import print_pack
from mp4ds.cli.progress import pack_progress, progress_of
from mp4ds.errors import counted, path_text
from mp4ds.options import HOW, WHERE
from mp4ds.packing.options import ImageFolder, PackOptions
from mp4ds.plugins.demo import demo
from mp4ds.plugins.exporting.export import export
from mp4ds.plugins.exporting.job import ExportOptions, ExportSummary

_force = option("--force", "-f", is_flag=True, panel=WHERE, help="Replace an existing output.")


@click.group("import")
def import_command() -> None:
    """Make a dataset from images, or from a video made by the paper's tool."""


@command("images")
@argument("folder", "FOLDER", "Folder of images, plain or in a known layout.")
@output_option("DATASET", "Folder to create.", required=True)
@takes(ImageFolder, "images")
@takes(PackOptions, without=("camera_info", "join", "salvage"))
def images_command(folder: str, output: str, images: ImageFolder, options: PackOptions) -> None:
    """Make a dataset from a folder of timestamped images.

    EuRoC and TUM RGB-D folders are imported with all their cameras. Lossless by default. To
    resume a long import that was interrupted, run the same command again.
    """
    with pack_progress() as progress:
        summary = mp4ds.pack(folder, output, replace(options, images=images), progress=progress)
    show(summary, print_pack)


@command("ros-mp4")
@argument("video", "VIDEO", "The mp4 file.")
@argument("sidecar", "YAML", "The YAML file that belongs to it.")
@output_option("DATASET", "Folder to create.", required=True)
@_force
def ros_mp4_command(video: str, sidecar: str, output: str, force: bool) -> None:
    """Convert an mp4 and YAML made by the tool published with the paper.

    The video is not re-encoded: its packets are copied.
    """
    show(mp4ds.import_ros_mp4(video, sidecar, output, force=force), print_pack)


import_command.add_command(images_command)
import_command.add_command(ros_mp4_command)


@command()
@argument(
    "output",
    "OUTPUT",
    "What to write: .mcap, .bag (ROS 1), or no suffix for rosbag2.  [default: demo.mcap]",
    default="demo.mcap",
    type=click.Path(path_type=Path),
)
@option(
    "--seconds",
    type=float,
    default=3.0,
    panel=HOW,
    metavar="N",
    help="Length of the recording.  [default: 3]",
)
@_force
def demo_command(output: Path, seconds: float, force: bool) -> None:
    """Make a small test recording: two cameras (Bayer and RGB), calibrations, IMU, tf."""
    messages = demo(output, seconds=seconds, force=force)
    text = f"{path_text(output)}: {counted(messages, 'message')}"
    show({"output": output, "messages": messages}, lambda _: say(text))


@command()
@argument("to", "FORMAT", "euroc, tum, colmap or lerobot.")
@argument(
    "datasets",
    "DATASET...",
    "A dataset; for lerobot one or more, each an episode.",
    nargs=-1,
    required=True,
)
@output_option("OUT", "Folder to create.", required=True, type=click.Path(path_type=Path))
@takes(ExportOptions)
def export_command(to: str, datasets: Sequence[str], output: Path, options: ExportOptions) -> None:
    """Export a dataset to another tool's format, keeping what that format supports.

    What is left out is counted by topic and listed, here and in mp4ds_export.json.
    """
    with progress_of("exporting") as tell:
        summary = export(datasets, to, output, options, progress=tell)
    show(summary, _print_export)


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
