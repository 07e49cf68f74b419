"""The command line: the only place that prints or exits.

Exit codes: 0 the whole job was done; 1 it failed or problems were found; 2 the input or the
options are wrong; 130 interrupted.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from copy import copy
from pathlib import Path
from typing import Annotated, NoReturn, Optional

import typer
from typer.main import get_command_name

from mp4ds._version import __version__
from mp4ds.cli.arguments import parse_resize, parse_share, parse_size, spelled
from mp4ds.cli.conformance import conformance_dump
from mp4ds.cli.evaluate import evaluate
from mp4ds.cli.export import export
from mp4ds.cli.failures import told_errors
from mp4ds.cli.imports import imports
from mp4ds.cli.options import (
    ClusterOption,
    CodecOption,
    DatasetArgument,
    EveryOption,
    ExcludeOption,
    ForceFlag,
    GopOption,
    JobsOption,
    JpegQualityOption,
    JsonFlag,
    MaxRateOption,
    MemoryOption,
    PresetOption,
    PurposeOption,
    ResizeOption,
    RestartFlag,
    TopicsOption,
    TranscodeFlag,
)
from mp4ds.cli.output import (
    print_info,
    print_json,
    print_pack,
    print_unpack,
    print_validation,
    say,
    status_line,
    unpack_progress,
)
from mp4ds.cli.play import play
from mp4ds.cli.process import exit_code_of, prepare_process
from mp4ds.cli.progress import pack_progress
from mp4ds.cli.report import frames, report
from mp4ds.errors import OptionError

app = typer.Typer(
    name="mp4ds",
    help="Robot camera recordings as ordinary mp4 files, and back again exactly.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback(invoke_without_command=True)
def _top(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    if version:
        say(f"mp4ds {__version__}")
        raise typer.Exit


@app.command()
def pack(
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="SOURCE...", help="A .bag, a rosbag2 folder or an .mcap; or several parts."
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
    topics: TopicsOption = None,
    exclude: ExcludeOption = None,
    quality: Annotated[
        str,
        typer.Option(
            "--quality",
            "-q",
            help="lossless, visual, crf=N, or a score to keep: vmaf=99.5, psnr=42, ssim=0.98.",
        ),
    ] = "lossless",
    codec: CodecOption = None,
    preset: PresetOption = None,
    transcode: TranscodeFlag = False,
    camera_info: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(
            "--camera-info",
            metavar="IMAGE=INFO",
            help="Topics that belong together, where names and stamps do not tell.",
        ),
    ] = None,
    purpose: PurposeOption = None,
    gop: GopOption = None,
    window: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(
            "--window",
            min=2,
            max=10_000_000,
            help="Frames of the busiest camera in a part of a long recording; 10 times --gop.",
        ),
    ] = None,
    jobs: JobsOption = None,
    memory: MemoryOption = None,
    cluster: ClusterOption = None,
    shard: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option("--shard", metavar="I/N", help="Pack one share of the parts only."),
    ] = None,
    join: Annotated[
        bool, typer.Option("--join", help="Make the dataset of what the shards packed.")
    ] = False,
    keep_going: Annotated[
        bool, typer.Option("--keep-going", help="Where a part fails, go on with the others.")
    ] = False,
    salvage: Annotated[
        bool, typer.Option("--salvage", help="Pack what can be read of a damaged recording.")
    ] = False,
    restart: RestartFlag = False,
    force: ForceFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Pack a recording into a dataset of mp4 files.

    Lossless by default: `mp4ds unpack` gives every message back as it was. A pack that was
    interrupted goes on when the same command is run again.
    """
    from mp4ds.packing import PackOptions, PackSummary, pack_each, pack_share
    from mp4ds.packing import pack as run

    summaries: list[PackSummary] = []
    with told_errors(as_json), pack_progress(as_json, whole=not shard) as progress:
        options = PackOptions(
            topics=topics or (),
            exclude=exclude or (),
            quality=quality,
            codec=codec,
            preset=preset,
            transcode=transcode,
            camera_info=camera_info or (),
            purpose=purpose,
            gop=gop,
            window=window,
            jobs=jobs,
            memory=parse_size(memory),
            cluster=cluster,
            join=join,
            keep_going=keep_going,
            salvage=salvage,
            restart=restart,
            force=force,
        )
        if shard and (join or output.endswith("/")):
            raise OptionError("--shard goes neither with --join nor with several datasets.")
        if shard:
            pack_share(sources, output, parse_share(shard), options, progress=progress)
        elif output.endswith("/"):
            summaries = pack_each(sources, output, options, progress=progress)
        else:
            summaries = [run(sources, output, options, progress=progress)]
    if as_json:
        print_json(summaries if output.endswith("/") or shard else summaries[0])
        return
    for summary in summaries:
        print_pack(summary)
    if shard:
        say(f"share {shard} is packed; when all are, --join makes the dataset")


@app.command()
def unpack(
    dataset: DatasetArgument,
    to: Annotated[str, typer.Option("--to", help="bag, rosbag2, mcap or images.")],
    output: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option("--output", "-o", metavar="OUT", help="What to make, else NAME_unpacked."),
    ] = None,
    storage: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option("--storage", help="sqlite3 or mcap, for rosbag2; as recorded, or mcap."),
    ] = None,
    image_format: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            "--image-format",
            help="png (exact) or jpeg, for images; JPEG files as recorded, else png.",
        ),
    ] = None,
    images: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            "--images",
            metavar="KIND",
            help="Give all cameras as raw, jpeg, png, compressed-video or ffmpeg; as recorded by "
            "default.",
        ),
    ] = None,
    jpeg_quality: JpegQualityOption = 95,
    resize: ResizeOption = None,
    every: EveryOption = 1,
    max_rate: MaxRateOption = None,
    topics: TopicsOption = None,
    exclude: ExcludeOption = None,
    skip_unconvertible: Annotated[
        bool,
        typer.Option("--skip-unconvertible", help="Leave out what OUT cannot hold, and count it."),
    ] = False,
    force: ForceFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Write a dataset's recording again: as a bag, rosbag2, MCAP, or images.

    Messages are converted between ROS 1 and ROS 2 where the target asks for it.
    """
    from mp4ds.unpacking import UnpackOptions
    from mp4ds.unpacking import unpack as run

    with told_errors(as_json), unpack_progress(as_json) as progress:
        options = UnpackOptions(
            storage=storage,
            topics=topics or (),
            exclude=exclude or (),
            image_format=image_format,
            images=images,
            jpeg_quality=jpeg_quality,
            resize=parse_resize(resize),
            every=every,
            max_rate=max_rate,
            force=force,
            skip_unconvertible=skip_unconvertible,
        )
        summary = run(dataset, to, output, options, progress=progress)
    if as_json:
        print_json(summary)
        return
    print_unpack(summary, "images" if to == "images" else "messages")


app.add_typer(imports)
app.command()(export)
app.command()(play)
app.command()(report)
app.command()(frames)
app.command()(evaluate)
app.command()(conformance_dump)


@app.command()
def validate(
    path: Annotated[str, typer.Argument(help="A sidecar, a dataset, or a folder of datasets.")],
    deep: Annotated[
        bool, typer.Option("--deep", help="Also hash and decode all, and compare every message.")
    ] = False,
    as_json: JsonFlag = False,
) -> None:
    """List every problem of a dataset; exit code 1 if there is one."""
    from mp4ds.checks import validate as run
    from mp4ds.remote import location

    with told_errors(as_json), status_line(as_json) as report:
        where = location(path)
        problems = run(where, deep=deep, progress=report)
    if as_json:
        print_json({"path": where, "deep": deep, "problems": problems})
    else:
        print_validation(where, problems, deep=deep)
    raise typer.Exit(1 if problems else 0)


@app.command()
def info(
    path: Annotated[str, typer.Argument(help="A bag, rosbag2 folder, MCAP, dataset or sidecar.")],
    intrinsics: Annotated[
        bool,
        typer.Option(
            "--intrinsics", help="Show the cameras' calibrations, to be pasted into Python."
        ),
    ] = False,
    as_json: JsonFlag = False,
) -> None:
    """Show what is in a recording or a dataset."""
    if intrinsics:
        _print_intrinsics(path, as_json)
        return
    from mp4ds.info import info as run

    with told_errors(as_json):
        result = run(path)
    if as_json:
        print_json(result)
    else:
        print_info(result)


def _print_intrinsics(path: str, as_json: bool) -> None:
    from mp4ds.cli.calibrations import print_intrinsics
    from mp4ds.intrinsics import intrinsics as run

    with told_errors(as_json), status_line(as_json, "reading"):
        result = run(path)
    if as_json:
        print_json(result)
    else:
        print_intrinsics(result)


@app.command()
def demo(
    output: Annotated[Path, typer.Argument(help="The .bag file to make.")] = Path("demo.bag"),
    seconds: Annotated[float, typer.Option("--seconds", min=0.1, max=3600.0)] = 3.0,
    force: ForceFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Make a small recording: two cameras (Bayer and rgb), calibrations, imu and tf."""
    from mp4ds.demo import demo as run

    with told_errors(as_json):
        messages = run(output, seconds=seconds, force=force)
    if as_json:
        print_json({"output": output, "messages": messages})
    else:
        say(f"{output}: {messages} messages")


def _app_for(arguments: Sequence[str]) -> typer.Typer:
    """The command line with the one command that is asked for: building all takes its time."""
    name = arguments[0] if arguments else ""
    asked = [
        command
        for command in app.registered_commands
        if command.callback and get_command_name(command.callback.__name__) == name
    ]
    if not asked:
        return app
    one = copy(app)
    one.registered_commands, one.registered_groups = asked, []
    return one


def main() -> NoReturn:
    """Run the command line and exit."""
    arguments = spelled(sys.argv[1:])
    prepare_process()
    sys.exit(
        exit_code_of(lambda: _app_for(arguments)(args=arguments), as_json="--json" in arguments)
    )
