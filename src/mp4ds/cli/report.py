"""``mp4ds report`` and ``mp4ds frames``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer

from mp4ds.cli.arguments import parse_resize
from mp4ds.cli.failures import told_errors
from mp4ds.cli.options import DatasetArgument, ForceFlag, JsonFlag
from mp4ds.cli.output import print_json, printed, say, size_text, status_line

if TYPE_CHECKING:
    from mp4ds.report import ReportSummary


def report(
    dataset: DatasetArgument,
    output: Annotated[
        Optional[Path],  # noqa: UP045 - read at run time by typer
        typer.Option(
            "--output",
            "-o",
            metavar="FOLDER",
            help="Where to write it; into the dataset if not said.",
        ),
    ] = None,
    serve: Annotated[
        bool, typer.Option("--serve", help="Then show it to this machine's browsers.")
    ] = False,
    port: Annotated[
        int, typer.Option("--port", min=0, max=65535, help="Of --serve; a free one by default.")
    ] = 0,
    proxies: Annotated[
        str,
        typer.Option(
            "--proxies",
            metavar="WHICH",
            help="Small videos for what no browser shows (auto), for all, or none.",
        ),
    ] = "auto",
    proxy_width: Annotated[
        int, typer.Option("--proxy-width", metavar="PIXELS", help="Most columns of a proxy.")
    ] = 640,
    scores: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--scores", metavar="JSON", help="Quality scores of frames, to be plotted."),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", "-f", help="Replace an index.html that is no report.")
    ] = False,
    as_json: JsonFlag = False,
) -> None:
    """Make a page of a dataset: all cameras in step, timing, topics, calibrations.

    Open its index.html in a browser, from the disk or by --serve; it needs no network.
    """
    from mp4ds.report import ReportOptions
    from mp4ds.report import report as run

    with told_errors(as_json):
        with status_line(as_json, "making the report") as tell:
            options = ReportOptions(
                output=output,
                proxies=proxies,
                proxy_width=proxy_width,
                scores=scores,
                force=force,
            )
            summary = run(dataset, options, progress=tell)
        if as_json:
            print_json(
                {
                    "index": summary.index,
                    "bytes": summary.bytes,
                    "cameras": summary.cameras,
                    "problems": summary.problems,
                }
            )
        else:
            _print_report(summary)
        if serve:
            _serve(summary, port, as_json)
    if summary.problems:
        raise typer.Exit(1)


def _print_report(summary: ReportSummary) -> None:
    for camera in summary.cameras:
        note = f": {camera.note}" if camera.note else ""
        say(f"{camera.topic}: plays {_PLAYS[camera.plays]}{note}")
    for problem in summary.problems:
        say(f"not shown: {problem}")
    say(f"{summary.index}: {size_text(summary.bytes)}")


_PLAYS = {"video": "its own video", "proxy": "a proxy", "nothing": "nothing"}


def _serve(summary: ReportSummary, port: int, as_json: bool) -> None:
    from mp4ds.report.server import ReportServer

    with ReportServer(summary.files, summary.start, port=port) as server:
        told = sys.stderr if as_json else sys.stdout
        with printed():
            print(f"{server.url} (Ctrl-C ends)", file=told, flush=True)
        server.serve()


def frames(
    dataset: DatasetArgument,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="IMAGE", help="A .png or .jpg to make.")
    ],
    topic: Annotated[
        str, typer.Option("--topic", "-t", help="Of the camera, where there are several.")
    ] = "",
    at: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            "--at",
            metavar="TIME",
            help="+SECONDS from the first frame, SECONDS.FRACTION or NANOSECONDS since 1970, an "
            "ISO date, or #NUMBER of the frame.",
        ),
    ] = None,
    sheet: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option("--sheet", metavar="5x4", help="So many frames beside and below each other."),
    ] = None,
    resize: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option("--resize", metavar="0.5|WxH", help="Size of the frame, or of each."),
    ] = None,
    exact: Annotated[
        bool,
        typer.Option("--exact", help="The samples as recorded, as unpack --to images has them."),
    ] = False,
    force: ForceFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Save the frame of a time as an image, or many frames as a contact sheet."""
    from mp4ds.report.stills import StillOptions, parse_sheet
    from mp4ds.report.stills import frames as run

    with told_errors(as_json):
        options = StillOptions(
            topic=topic,
            at=at,
            sheet=parse_sheet(sheet) if sheet is not None else None,
            resize=parse_resize(resize),
            exact=exact,
            force=force,
        )
        summary = run(dataset, output, options)
    if as_json:
        print_json(summary)
        return
    first, last = summary.frames[0], summary.frames[-1]
    if first is last:
        say(f"{summary.output}: frame {first.index} of {summary.topic}, stamp {first.stamp_ns} ns")
    else:
        say(
            f"{summary.output}: {len(summary.frames)} frames of {summary.topic}, from frame "
            f"{first.index} to {last.index}"
        )
