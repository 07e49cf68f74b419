"""The command line: the only place that prints or exits.

Exit codes: 0 the whole job was done; 1 it failed or problems were found; 2 the input or the
options are wrong; 130 interrupted.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, Optional

import typer

from mp4ds._version import __version__
from mp4ds.errors import Mp4dsError

if TYPE_CHECKING:
    from rich.console import Console

    from mp4ds.info import Info
    from mp4ds.packing import PackSummary

app = typer.Typer(
    name="mp4ds",
    help="Robot camera recordings as ordinary mp4 files, and back again exactly.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)

JsonFlag = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
TopicsOption = Annotated[
    Optional[list[str]],  # noqa: UP045 - read at run time by typer
    typer.Option("--topics", "-t", metavar="GLOB", help="Only topics that match; may be repeated."),
]
ExcludeOption = Annotated[
    Optional[list[str]],  # noqa: UP045
    typer.Option("--exclude", "-x", metavar="GLOB", help="Leave out topics that match."),
]
ForceFlag = Annotated[bool, typer.Option("--force", "-f", help="Replace an existing output.")]


@app.callback(invoke_without_command=True)
def _top(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    if version:
        print(f"mp4ds {__version__}")
        raise typer.Exit


@app.command()
def pack(
    sources: Annotated[
        list[Path],
        typer.Argument(
            metavar="SOURCE...", help="A .bag, a rosbag2 folder or an .mcap; or several parts."
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DATASET", help="The folder to make.")
    ],
    topics: TopicsOption = None,
    exclude: ExcludeOption = None,
    quality: Annotated[
        str, typer.Option("--quality", "-q", help="lossless, visual, or crf=N.")
    ] = "lossless",
    codec: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option("--codec", help="h264, h265, av1 or ffv1; the best by default."),
    ] = None,
    preset: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option("--preset", help="The encoder's preset, such as 6 or veryfast."),
    ] = None,
    gop: Annotated[
        int, typer.Option("--gop", min=1, max=100_000, help="Most frames between key frames.")
    ] = 60,
    jobs: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option("--jobs", "-j", min=1, max=256, help="Cores to use; all by default."),
    ] = None,
    force: ForceFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Pack a recording into a dataset of mp4 files.

    Lossless by default: `mp4ds unpack` gives every message back as it was.
    """
    from mp4ds.packing import PackOptions
    from mp4ds.packing import pack as run

    options = PackOptions(
        topics=topics or (),
        exclude=exclude or (),
        quality=quality,
        codec=codec,
        preset=preset,
        gop=gop,
        jobs=jobs,
        force=force,
    )
    with _errors(as_json), _pack_progress(as_json) as progress:
        summary = run(sources, output, options, progress=progress)
    if as_json:
        _print_json(summary)
    else:
        _print_pack(summary)


@app.command()
def unpack(
    dataset: Annotated[Path, typer.Argument(help="A dataset, or a sidecar beside its video.")],
    to: Annotated[str, typer.Option("--to", help="bag, rosbag2, mcap or images.")],
    output: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--output", "-o", metavar="OUT", help="What to make."),
    ] = None,
    storage: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option("--storage", help="sqlite3 or mcap, for rosbag2; as recorded by default."),
    ] = None,
    image_format: Annotated[
        str, typer.Option("--image-format", help="png (exact) or jpeg, for images.")
    ] = "png",
    topics: TopicsOption = None,
    exclude: ExcludeOption = None,
    force: ForceFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Write a dataset's recording again: as a bag, rosbag2, MCAP, or images.

    Messages are converted between ROS 1 and ROS 2 where the target asks for it.
    """
    from mp4ds.unpacking import UnpackOptions
    from mp4ds.unpacking import unpack as run

    options = UnpackOptions(
        storage=storage,
        topics=topics or (),
        exclude=exclude or (),
        image_format=image_format,
        force=force,
    )
    with _errors(as_json), _unpack_progress(as_json) as progress:
        summary = run(dataset, to, output, options, progress=progress)
    if as_json:
        _print_json(summary)
        return
    total = sum(summary.messages.values())
    noun = "images" if to == "images" else "messages"
    print(f"{summary.output}: {total} {noun} of {len(summary.messages)} topics")
    if summary.converted:
        print(f"converted between ROS 1 and ROS 2: {', '.join(summary.converted)}")
    for what, count in summary.omitted.items():
        print(f"not held by this format: {count} {what}")
    if summary.left_out:
        print(f"left out: {', '.join(summary.left_out)}")


@app.command()
def validate(
    path: Annotated[Path, typer.Argument(help="A sidecar, a dataset, or a folder of datasets.")],
    deep: Annotated[
        bool, typer.Option("--deep", help="Also decode every frame and compare every message.")
    ] = False,
    as_json: JsonFlag = False,
) -> None:
    """List every problem of a dataset; exit code 1 if there is one."""
    from mp4ds.checks import validate as run

    with _errors(as_json), _status(as_json) as report:
        problems = run(path, deep=deep, progress=report)
    if as_json:
        _print_json({"path": path, "deep": deep, "problems": problems})
    else:
        for problem in problems:
            print(problem)
        count = len(problems)
        depth = "every frame and message was compared" if deep else "frames were not decoded"
        print(f"{path}: {f'{count} problem' + 's' * (count > 1) if count else 'no problem'}; {depth}")
    raise typer.Exit(1 if problems else 0)


@app.command()
def info(
    path: Annotated[Path, typer.Argument(help="A bag, rosbag2 folder, MCAP, dataset or sidecar.")],
    as_json: JsonFlag = False,
) -> None:
    """Show what is in a recording or a dataset."""
    from mp4ds.info import info as run

    with _errors(as_json):
        result = run(path)
    if as_json:
        _print_json(result)
    else:
        _print_info(result)


@app.command()
def demo(
    output: Annotated[Path, typer.Argument(help="The .bag file to make.")] = Path("demo.bag"),
    seconds: Annotated[float, typer.Option("--seconds", min=0.1, max=3600.0)] = 3.0,
    force: ForceFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Make a small recording: two cameras (Bayer and rgb), calibrations, imu and tf."""
    from mp4ds.demo import demo as run

    with _errors(as_json):
        messages = run(output, seconds=seconds, force=force)
    if as_json:
        _print_json({"output": output, "messages": messages})
    else:
        print(f"{output}: {messages} messages")


def main() -> NoReturn:
    """Run the command line and exit."""
    app()
    sys.exit(0)


@contextmanager
def _errors(as_json: bool) -> Iterator[None]:
    """Turn errors raised on purpose into one sentence and an exit code."""
    try:
        yield
    except KeyboardInterrupt:
        _fail("interrupted; the unfinished output was removed", 130, as_json)
    except Mp4dsError as error:
        _fail(str(error), error.exit_code, as_json)
    except MemoryError:
        _fail("out of memory; try fewer --jobs", 1, as_json)


def _fail(message: str, code: int, as_json: bool) -> NoReturn:
    if as_json:
        _print_json({"error": message, "exit_code": code})
    print(f"mp4ds: {message}", file=sys.stderr)
    raise typer.Exit(code)


def _jsonable(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    return str(value)


def _print_json(value: Any) -> None:
    print(json.dumps(value, default=_jsonable, indent=2))


def _console() -> Console:
    from rich.console import Console

    return Console(stderr=True)


@contextmanager
def _pack_progress(as_json: bool) -> Iterator[Callable[[Any], None] | None]:
    console = _console()
    if as_json or not console.is_terminal:
        yield None
        return
    from rich.progress import (
        BarColumn,
        DownloadColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
        TransferSpeedColumn,
    )

    with Progress(
        TextColumn("packing"),
        BarColumn(),
        DownloadColumn(binary_units=False),
        TransferSpeedColumn(),
        TextColumn("-> {task.fields[written]}, {task.fields[frames]} frames"),
        TimeRemainingColumn(),
        console=console,
        transient=True,
    ) as bar:
        task = bar.add_task("pack", total=None, written="0 B", frames=0)

        def report(state: Any) -> None:
            bar.update(
                task,
                completed=state.bytes_read,
                total=state.bytes_total,
                written=_size(state.bytes_written),
                frames=state.frames,
            )

        yield report


@contextmanager
def _unpack_progress(as_json: bool) -> Iterator[Callable[[Any], None] | None]:
    console = _console()
    if as_json or not console.is_terminal:
        yield None
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
    from rich.progress import TimeRemainingColumn

    with Progress(
        TextColumn("unpacking"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("messages"),
        TimeRemainingColumn(),
        console=console,
        transient=True,
    ) as bar:
        task = bar.add_task("unpack", total=None)
        yield lambda state: bar.update(
            task, completed=state.messages, total=state.messages_total or None
        )


@contextmanager
def _status(as_json: bool) -> Iterator[Callable[[str], None] | None]:
    console = _console()
    if as_json or not console.is_terminal:
        yield None
        return
    with console.status("validating") as status:
        yield status.update


def _size(count: float) -> str:
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.2f} TB"


def _print_table(columns: list[tuple[str, str]], rows: list[list[str]]) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name, justify in columns:
        fold = justify == "fold"
        table.add_column(
            name,
            justify="left" if fold else justify,  # type: ignore[arg-type]
            overflow="fold",
            no_wrap=not fold,
        )
    for row in rows:
        table.add_row(*row)
    if not console.is_terminal:
        console.width = 160
    console.print(table, markup=False) if False else console.print(table)


def _print_pack(summary: PackSummary) -> None:
    rows = []
    for topic in summary.topics:
        stored = ", ".join(topic.files)
        if not stored:
            stored = "messages.mcap" if topic.frames < topic.messages or not topic.messages else "in a sidecar"
        ratio = topic.raw_bytes / topic.packed_bytes if topic.packed_bytes else None
        rows.append(
            [
                topic.topic,
                topic.type_name,
                str(topic.messages),
                str(topic.frames) if topic.files else "",
                _size(topic.raw_bytes),
                _size(topic.packed_bytes) if topic.packed_bytes else "",
                f"{ratio:.2f}" if ratio else "",
                stored,
            ]
        )
    _print_table(
        [
            ("topic", "fold"),
            ("type", "fold"),
            ("messages", "right"),
            ("frames", "right"),
            ("raw", "right"),
            ("packed", "right"),
            ("ratio", "right"),
            ("stored in", "fold"),
        ],
        rows,
    )
    for topic in summary.topics:
        for reason, (count, first) in topic.verbatim.items():
            print(
                f"{topic.topic}: {count} of {topic.messages} messages stored verbatim in "
                f"messages.mcap: {reason} (first: message {first})"
            )
        for note in topic.notes:
            print(f"{topic.topic}: {note}")
    if summary.left_out:
        print(f"left out: {', '.join(summary.left_out)}")
    if not any(topic.files for topic in summary.topics):
        print("no topic became a video: all messages are in messages.mcap as they were")
    ratio = summary.source_bytes / summary.dataset_bytes
    print(
        f"{summary.dataset}: {_size(summary.source_bytes)} -> {_size(summary.dataset_bytes)} "
        f"({ratio:.2f} times smaller), of which messages.mcap {_size(summary.messages_bytes)}"
    )


def _print_info(result: Info) -> None:
    print(f"{result.path}: {result.kind}, profile {result.profile or '-'}, {_size(result.bytes)}")
    if result.start is not None and result.end is not None:
        from datetime import datetime, timezone

        start = datetime.fromtimestamp(result.start / 1e9, timezone.utc)
        print(
            f"{start:%Y-%m-%d %H:%M:%S} UTC, {(result.end - result.start) / 1e9:.2f} s, "
            f"{sum(topic.messages for topic in result.topics)} messages"
        )
    _print_table(
        [
            ("topic", "fold"),
            ("type", "fold"),
            ("messages", "right"),
            ("Hz", "right"),
            ("jitter ms", "right"),
            ("gaps", "right"),
            ("longest s", "right"),
            ("size", "right"),
            ("content", "fold"),
            ("stored", "fold"),
        ],
        [
            [
                topic.topic,
                topic.type_name,
                str(topic.messages),
                _number(topic.rate_hz, 2),
                _number(topic.jitter_ms, 2),
                str(topic.gaps) if topic.gaps else "",
                _number(topic.longest_gap_s, 3),
                _size(topic.bytes) if topic.bytes is not None else "",
                topic.content,
                topic.stored,
            ]
            for topic in result.topics
        ],
    )
    for note in result.notes:
        print(note)


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"
