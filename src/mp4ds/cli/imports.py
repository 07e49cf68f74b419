"""``mp4ds import``: what is no recording of ROS into a dataset."""

from __future__ import annotations

from typing import Annotated, Optional

import typer

from mp4ds.cli.arguments import parse_size
from mp4ds.cli.failures import told_errors
from mp4ds.cli.options import (
    CodecOption,
    ForceFlag,
    GopOption,
    JobsOption,
    JsonFlag,
    MemoryOption,
    PresetOption,
    PurposeOption,
    RestartFlag,
    TranscodeFlag,
)
from mp4ds.cli.output import print_json, print_pack
from mp4ds.cli.progress import pack_progress

imports = typer.Typer(
    name="import",
    help="Make a dataset of images, or of a video of the paper's tool.",
    no_args_is_help=True,
    rich_markup_mode=None,
)

_Output = Annotated[
    str, typer.Option("--output", "-o", metavar="DATASET", help="The folder to make.")
]


@imports.command()
def images(
    folder: Annotated[
        str, typer.Argument(metavar="FOLDER", help="Of images, or of a layout that is known.")
    ],
    output: _Output,
    layout: Annotated[
        Optional[str],  # noqa: UP045 - read at run time by typer
        typer.Option("--layout", help="euroc, kitti, tum or plain; as found by default."),
    ] = None,
    stamps: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            "--stamps", metavar="FILE", help="Times, one a line; or times and file names."
        ),
    ] = None,
    rate: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option("--rate", metavar="HZ", help="Where there are no times, such as 20."),
    ] = None,
    unit: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option("--unit", help="Of times that are whole numbers: s, ms, us or ns."),
    ] = None,
    calibration: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option("--calibration", metavar="YAML", help="As ROS's camera_calibration saves it."),
    ] = None,
    topic: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option("--topic", "-t", help="Of plain images; /camera/image_raw by default."),
    ] = None,
    frame_id: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option("--frame-id", help="Of plain images; camera by default."),
    ] = None,
    encoding: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            "--encoding", help="Of plain images, such as bayer_rggb8 or 16UC1; as in the files."
        ),
    ] = None,
    quality: Annotated[
        str, typer.Option("--quality", "-q", help="lossless, visual, crf=N, or vmaf=99.5.")
    ] = "lossless",
    codec: CodecOption = None,
    preset: PresetOption = None,
    transcode: TranscodeFlag = False,
    purpose: PurposeOption = None,
    gop: GopOption = None,
    jobs: JobsOption = None,
    memory: MemoryOption = None,
    restart: RestartFlag = False,
    force: ForceFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Make a dataset of a folder of images with times.

    EuRoC, KITTI and TUM RGB-D folders give all their cameras at once. Lossless by default. A run
    that was interrupted goes on when the same command is run again.
    """
    from mp4ds.importing import ImageFolder
    from mp4ds.packing import PackOptions
    from mp4ds.packing import pack as run

    with told_errors(as_json), pack_progress(as_json) as progress:
        options = PackOptions(
            quality=quality,
            codec=codec,
            preset=preset,
            transcode=transcode,
            purpose=purpose,
            gop=gop,
            jobs=jobs,
            memory=parse_size(memory),
            restart=restart,
            force=force,
            images=ImageFolder(
                layout=layout,
                stamps=stamps,
                rate=rate,
                unit=unit,
                calibration=calibration,
                topic=topic,
                frame_id=frame_id,
                encoding=encoding,
            ),
        )
        summary = run(folder, output, options, progress=progress)
    if as_json:
        print_json(summary)
    else:
        print_pack(summary)


@imports.command("ros-mp4")
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
    from mp4ds.packing.ros_mp4 import import_ros_mp4

    with told_errors(as_json):
        summary = import_ros_mp4(video, sidecar, output, force=force)
    if as_json:
        print_json(summary)
    else:
        print_pack(summary)
