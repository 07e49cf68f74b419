"""``mp4ds record``: keyboard controls, progress and results of a recorder."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from mp4ds.cli.keyboard import Keyboard
from mp4ds.cli.nodes import NodeCommand, names_in, say_as_much
from mp4ds.cli.options import JsonFlag, takes
from mp4ds.cli.output import complain, is_quiet, print_json, print_pack, say
from mp4ds.cli.process import caught_signals, report_errors
from mp4ds.cli.record_words import spelled
from mp4ds.errors import OptionError, counted, path_text
from mp4ds.files.sources import salvage_command
from mp4ds.plugins.recording.options import RecordOptions
from mp4ds.plugins.recording.record import RecordProgress, RecordSummary, open_recorder
from mp4ds.plugins.ros.names import NodeNames

if TYPE_CHECKING:
    from rich.table import Table


_LOG_S = 10.0
_SHOWN = 20  # topics
_UNTIMED = "their log time is negative or too large"


class RecordCommand(NodeCommand):
    """The command; it also takes the options of ROS's own recorders."""

    def spelled(self, ctx: Any, args: Sequence[str]) -> tuple[list[str], NodeNames]:
        """Translate arguments in the style of ROS's own recorders."""
        return spelled(args, self.valued(ctx).__contains__)


COMMAND = RecordCommand


@takes(RecordOptions)
def record(
    options: Callable[[], RecordOptions],
    context: typer.Context,
    topics: Annotated[
        Optional[list[str]],  # noqa: UP045 - read at run time by typer
        typer.Argument(metavar="TOPIC...", help="Topic names, or globs in quotes; -a records all."),
    ] = None,
    output: Annotated[
        Optional[str],  # noqa: UP045 - read at run time by typer
        typer.Option(
            "--output",
            "-o",
            metavar="DATASET",
            help="Folder to create; default: named after the time.",
        ),
    ] = None,
    ros1: Annotated[bool, typer.Option("--ros1", help="Record from ROS 1.")] = False,
    ros2: Annotated[
        bool, typer.Option("--ros2", help="Record from ROS 2, with rclpy, or else Cyclone DDS.")
    ] = False,
    log_level: Annotated[
        str,
        typer.Option("--log-level", help="Log verbosity: debug, info, warn, error or fatal."),
    ] = "",
    no_keyboard: Annotated[
        bool, typer.Option("--disable-keyboard-controls", help="Disable the keyboard controls.")
    ] = False,
    progress: Annotated[
        bool,
        typer.Option("--progress/--no-progress", help="Show topics while recording."),
    ] = True,
    as_json: JsonFlag = False,
) -> None:
    """Record topics of a live robot, ROS 1 or ROS 2, into a dataset.

    Ctrl-C ends the recording. It is lossless by default, with the fastest encoder settings. What
    cannot be packed in time waits on disk. Keys: space pauses and resumes, q ends.
    """
    with report_errors(as_json), ExitStack() as stack:
        if ros1 and ros2:
            raise OptionError("--ros1 contradicts --ros2.")
        kind = "ros1" if ros1 else "ros2" if ros2 else None
        names = names_in(context)
        say_as_much(log_level or names.log_level)
        is_silent = as_json or not progress or is_quiet()
        report = stack.enter_context(record_progress(is_quiet=is_silent))
        told = replace(options(), to=kind, names=names)
        # a launch file cannot leave out an argument: an empty one is none
        opened = open_recorder(topics or (), output or None, told, progress=report)
        recorder = stack.enter_context(opened)
        if not is_quiet():
            complain(f"recording from {recorder.address}")
        stack.enter_context(caught_signals(recorder.stop))
        if not no_keyboard:
            stack.enter_context(Keyboard({" ": recorder.toggle_paused, "q": recorder.stop}))
        try:
            summary = recorder.run()
        except KeyboardInterrupt:  # asked twice, as launch files do when their time is over
            commands = "; ".join(map(salvage_command, recorder.unfinished))
            raise KeyboardInterrupt(
                f"interrupted before the recording was finished; recover it: {commands}"
                if commands
                else "interrupted; everything recorded is in datasets"
            ) from None
    if as_json:
        print_json(summary)
    else:
        print_record(summary)
    if summary.dropped or summary.lost or summary.untimed:
        raise typer.Exit(1)


@contextmanager
def record_progress(*, is_quiet: bool) -> Iterator[Callable[[RecordProgress], None]]:
    """On a terminal, a table of the topics; in a log, a line every 10 s; warnings in both.

    Args:
        is_quiet: Print warnings only.
    """
    from rich.console import Console
    from rich.live import Live

    console = Console(stderr=True)
    told: set[str] = set()
    next_line = 0.0

    def warn(state: RecordProgress) -> None:
        for warning in state.warnings:
            if warning not in told:
                told.add(warning)
                complain(warning)
        if state.state.startswith("waiting") and state.state not in told:
            told.add(state.state)
            complain(f"{state.state}: recording starts when it publishes a time")
        for topic, item in state.topics.items():
            for count, what in (
                (item.dropped, "dropping messages: the buffer is full (--buffsize enlarges it)"),
                (item.lost, "the middleware is losing messages"),
                (item.untimed, f"leaving out messages: {_UNTIMED}"),
            ):
                if count and (line := f"{topic}: {what}") not in told:
                    told.add(line)
                    complain(line)

    def log(state: RecordProgress) -> None:
        nonlocal next_line
        warn(state)
        if state.seconds >= next_line and not is_quiet:
            next_line = state.seconds + _LOG_S
            complain(_line(state))

    if is_quiet or not console.is_terminal:
        yield log
        return
    with Live(console=console, auto_refresh=False, transient=True) as live:

        def show(state: RecordProgress) -> None:
            warn(state)
            live.update(_table(state), refresh=True)

        yield show


def _line(state: RecordProgress) -> str:
    count = sum(item.messages for item in state.topics.values())
    rate = sum(item.bytes_per_s for item in state.topics.values())
    parts = [
        f"{state.state} {state.seconds:.0f} s",
        counted(count, "message"),
        f"{rate / 1e6:.1f} MB/s received",
        f"{state.bytes_written / 1e6:.1f} MB written",
    ]
    if state.spool_bytes >= 1e6:
        parts.append(f"{state.spool_bytes / 1e6:.0f} MB to pack")
    if state.waiting_bytes >= 1e6:
        parts.append(f"{state.waiting_bytes / 1e6:.0f} MB buffered")
    return " · ".join(parts)


def _table(state: RecordProgress) -> Table:
    from rich.table import Table
    from rich.text import Text

    table = Table(title=_line(state), title_justify="left", box=None, pad_edge=False)
    for name in ("topic", "messages", "Hz", "MB/s", "lost"):
        table.add_column(
            name, justify="left" if name == "topic" else "right", no_wrap=True, overflow="ellipsis"
        )
    busiest = sorted(state.topics.items(), key=lambda item: -item[1].bytes_per_s)
    for topic, item in busiest[:_SHOWN]:
        gone = item.dropped + item.lost + item.untimed
        table.add_row(
            Text(topic),
            str(item.messages),
            f"{item.hz:.1f}",
            f"{item.bytes_per_s / 1e6:.2f}",
            str(gone) if gone else "",
        )
    if len(busiest) > _SHOWN:
        table.add_row(Text(f"and {len(busiest) - _SHOWN} more"))
    return table


def print_record(summary: RecordSummary) -> None:
    """Print what was recorded."""
    for made in summary.datasets:
        if any(topic.messages for topic in made.topics):
            print_pack(made)
            continue
        topics = ", ".join(topic.topic for topic in made.topics)
        why = f"no message arrived on {topics}" if topics else "no matching topic was published"
        say(f"{path_text(made.dataset)}: empty: {why}")
    for topic, count in summary.dropped.items():
        say(f"{topic}: {counted(count, 'message')} dropped: the buffer was full")
    for topic, count in summary.lost.items():
        say(f"{topic}: {counted(count, 'message')} lost by the middleware")
    for topic, count in summary.untimed.items():
        say(f"{topic}: {counted(count, 'message')} left out: {_UNTIMED}")
