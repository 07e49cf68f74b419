"""``mp4ds evaluate``."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Optional

import typer

from mp4ds.cli.failures import told_errors
from mp4ds.cli.options import ClusterOption
from mp4ds.cli.output import print_json
from mp4ds.errors import OptionError

if TYPE_CHECKING:
    from mp4ds.evaluating import EvaluateProgress

_AGAIN = "what was measured is kept: run the same command again to go on"


def evaluate(
    source: Annotated[
        str,
        typer.Argument(help="A .bag, rosbag2 folder, .mcap, dataset, video or folder of images."),
    ],
    output: Annotated[
        Optional[str],  # noqa: UP045 - read at run time by typer
        typer.Option(
            "--output", "-o", metavar="DIR", help="For the results; NAME_evaluation by default."
        ),
    ] = None,
    codecs: Annotated[
        str,
        typer.Option(
            "--codecs",
            help="Of svtav1, x264 and x265, with commas between; or as --codec of mp4ds pack.",
        ),
    ] = "svtav1,x264,x265",
    crf: Annotated[
        str, typer.Option("--crf", help="Such as 16:25, 16:25:3 or 16,20,24.")
    ] = "16:25:3",
    presets: Annotated[
        str,
        typer.Option(
            "--presets", help="Such as 6,8,medium; each is tried with the codecs that have it."
        ),
    ] = "",
    topics: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option("--topics", "-t", metavar="GLOB", help="Only cameras that match."),
    ] = None,
    exclude: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option("--exclude", "-x", metavar="GLOB", help="Leave out cameras that match."),
    ] = None,
    start: Annotated[
        Optional[float],  # noqa: UP045
        typer.Option(
            "--start", metavar="SECONDS", help="Where the clips begin; from the middle by default."
        ),
    ] = None,
    duration: Annotated[
        Optional[float],  # noqa: UP045
        typer.Option("--duration", metavar="SECONDS", help="Of the clips, instead of --frames."),
    ] = None,
    frames: Annotated[int, typer.Option("--frames", min=1, help="Of a clip.")] = 150,
    fps: Annotated[float, typer.Option("--fps", help="Of a folder of images.")] = 30.0,
    target: Annotated[
        str, typer.Option("--target", help="The score to reach: vmaf, psnr_y ... or ssim.")
    ] = "vmaf=99.5",
    rates: Annotated[
        str,
        typer.Option(
            "--rates",
            metavar="HZ",
            help="Such as 2,5,10,20,30,60: the crf that reaches the target at these rates.",
        ),
    ] = "",
    streams: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option("--streams", min=1, help="Cameras of a data set, whose size is told."),
    ] = None,
    hours: Annotated[
        Optional[float],  # noqa: UP045
        typer.Option("--hours", help="How long they record."),
    ] = None,
    gop: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(
            "--gop", min=1, max=100_000, help="Most frames from a key frame to the next; 60."
        ),
    ] = None,
    threads: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(
            "--threads",
            min=1,
            max=1024,
            help="Of an encoder; all cores by default, one on a cluster.",
        ),
    ] = None,
    jobs: Annotated[
        int,
        typer.Option("--jobs", "-j", min=1, max=1024, help="Settings at a time; 1 for true times."),
    ] = 1,
    cluster: ClusterOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Try encoder settings on clips of a recording: quality, size and time.

    Makes a folder with tables, plots and a page, and recommends what to pack with. An evaluation
    that was interrupted goes on when the same command is run again.
    """
    from mp4ds.cli.evaluate_output import print_evaluation
    from mp4ds.evaluating import EvaluateOptions
    from mp4ds.evaluating import evaluate as run
    from mp4ds.video.codecs import LOSSY_GOP

    with told_errors(as_json), _interruptible(), _progress(as_json) as report:
        options = EvaluateOptions(
            codecs=_words(codecs),
            crf=_words(crf),
            presets=_words(presets),
            topics=topics or (),
            exclude=exclude or (),
            start=start,
            duration=duration,
            frames=frames,
            fps=fps,
            gop=gop or LOSSY_GOP,
            threads=threads,
            jobs=jobs,
            cluster=cluster,
            target=target,
            rates=_numbers("--rates", rates),
            streams=streams,
            hours=hours,
        )
        result = run(source, options, output=output, progress=report)
    if as_json:
        print_json(result)
    else:
        print_evaluation(result)


def _words(text: str) -> Sequence[str]:
    return [word.strip() for word in text.split(",") if word.strip()]


def _numbers(name: str, text: str) -> Sequence[float]:
    try:
        return [float(word) for word in _words(text)]
    except ValueError:
        raise OptionError(f"{name} {text!r} is no list of numbers, such as 2,5,10.") from None


@contextmanager
def _interruptible() -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"interrupted; {_AGAIN}") from None


@contextmanager
def _progress(as_json: bool) -> Iterator[Callable[[EvaluateProgress], None] | None]:
    """On a terminal, a bar for the settings of each camera."""
    from rich.console import Console

    console = Console(stderr=True)
    if as_json or not console.is_terminal:
        yield None
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    from mp4ds.cli.output import shown

    with Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        console=console,
        transient=True,
    ) as bar:
        task = bar.add_task("evaluating", total=None)

        def report(state: EvaluateProgress) -> None:
            text = f"{shown(state.camera)}: {state.what}"
            bar.update(task, description=text, completed=state.done, total=state.total)

        yield report
