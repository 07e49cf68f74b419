"""``mp4ds record``: keyboard controls, progress and results of a recorder."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace

import click

from mp4ds.cli.nodes import (
    NodeCommand,
    RosOptions,
    accepted,
    node_controls,
    node_names,
    node_progress,
)
from mp4ds.cli.options import argument, command, option, takes
from mp4ds.cli.output import QUIET, Row, complain, is_set, say, say_counts, show
from mp4ds.cli.pack import print_pack
from mp4ds.errors import path_text
from mp4ds.files.sources import salvage_command
from mp4ds.options import WHERE, parse_pattern
from mp4ds.plugins.recording.options import RecordOptions
from mp4ds.plugins.recording.record import RecordProgress, RecordSummary, open_recorder
from mp4ds.plugins.ros.node import SERVICE_EVENTS

_SHOWN = 20  # topics
_UNTIMED = "their log time is negative or too large"
_MB = 10**6
_KEPT_S = 60.0
"""What --snapshot-mode keeps."""


@command(
    cls=NodeCommand,
    # what `rosbag record` and `ros2 bag record` write in another way
    lists={
        "--topics": ("", ""),
        "--topic": ("", ""),
        "--services": ("", SERVICE_EVENTS),
        "--exclude": ("--exclude", ""),
        "--exclude-topics": ("--exclude", ""),
        "--exclude-services": ("--exclude", SERVICE_EVENTS),
        "--topic-types": ("--topic-types", ""),
        "--exclude-topic-types": ("--exclude-topic-types", ""),
        "--custom-data": ("--custom-data", ""),
    },
    letters={
        "ros1": {"-e": "--match", "--regex": "--match"},
        "ros2": {"-b": "--max-size", "-s": "--storage"},
    },
)
@argument("topics", "TOPIC...", "Topic names, or globs in quotes; -a records all.", nargs=-1)
@option(
    "--output",
    "--output-name",
    "-o",
    "-O",
    panel=WHERE,
    metavar="DATASET",
    help="Folder to create; default: named after the time.",
)
@option("--match", is_flag=True, hidden=True)
@option("--split", is_flag=True, hidden=True)
@option("--size", type=int, hidden=True)
@option("--snapshot-mode", "snapshots", is_flag=True, hidden=True)
@option("--max-cache-size", "cache", type=int, hidden=True)
@option("--max-cache-duration", "kept", type=float, default=_KEPT_S, hidden=True)
@accepted("-j", "--bz2", "--lz4", "--tcpnodelay")
@accepted("--storage", "--storage-preset-profile", "--storage-config-file", values=1)
@accepted("--compression-mode", "--compression-format", "--chunksize", values=1)
@accepted("--compression-queue-size", "--compression-threads", values=1)
@accepted("--compression-threads-priority", "--serialization-format", values=1)
@takes(RosOptions, "ros")
@takes(RecordOptions)
def record_command(
    topics: Sequence[str],
    output: str | None,
    match: bool,
    split: bool,
    size: int | None,
    snapshots: bool,
    cache: int | None,
    kept: float,
    ros: RosOptions,
    options: RecordOptions,
) -> None:
    """Record topics of a live robot, ROS 1 or ROS 2, into a dataset.

    Ctrl-C ends the recording. It is lossless by default, with the fastest encoder settings. What
    cannot be packed in time waits on disk. Keys: space pauses and resumes, q ends.

    With --keep-last 60s it looks back instead: the last minute becomes a dataset at each trigger.
    These are the key s, the signal SIGUSR1, the service ~/snapshot, and messages on a --trigger
    topic.
    """
    options = replace(options, to=ros.to, names=node_names(ros))
    if match:  # with -e, topics are regular expressions for rosbag record
        topics, options = (), replace(options, regex=_whole(topics))
    if ros.ros1 and options.exclude_regex:  # where ROS 2 searches, ROS 1 matches
        options = replace(options, exclude_regex=_whole([options.exclude_regex.pattern]))
    if split:
        options = replace(options, duration=None, max_duration=options.duration)
    if size is not None:
        options = replace(options, max_size=f"{size}M")
    if cache is not None:
        options = replace(options, buffer=max(1, cache // _MB))
    if snapshots and options.keep_last is None:
        options = replace(options, keep_last=kept)
    with ExitStack() as stack:
        report = stack.enter_context(node_progress(_rows, _warnings, is_shown=ros.progress))
        # a launch file cannot leave out an argument: an empty one is none
        opened = open_recorder(topics, output or None, options, progress=report)
        recorder = stack.enter_context(opened)
        if not is_set(QUIET):
            complain(f"recording from {recorder.address}")
        keys = {" ": recorder.toggle_paused, "q": recorder.stop, "s": recorder.snapshot}
        signals = {"SIGUSR1": recorder.snapshot} if options.keep_last else {}
        stack.enter_context(node_controls(ros, recorder.stop, keys, signals))
        try:
            summary = recorder.run()
        except KeyboardInterrupt:  # asked twice, as launch files do when their time is over
            commands = "; ".join(map(salvage_command, recorder.unfinished))
            raise KeyboardInterrupt(
                f"interrupted before the recording was finished; recover it: {commands}"
                if commands
                else "interrupted; everything recorded is in datasets"
            ) from None
    show(summary, _print)
    if options.keep_last and not summary.datasets and not summary.failed:
        say("nothing was saved: there was no trigger")
    is_whole = not (summary.dropped or summary.lost or summary.untimed or summary.failed)
    if not is_whole or summary.is_short_of_space:
        raise click.exceptions.Exit(1)


def _whole(patterns: Sequence[str]) -> str:
    for pattern in patterns:  # refused as typed, not within ours
        parse_pattern(pattern)
    return f"^(?:{'|'.join(patterns)})$"


def _warnings(state: RecordProgress) -> Iterator[str]:
    yield from state.warnings
    for path, is_complete in state.saved.items() if not is_set(QUIET) else ():
        yield f"saving {path_text(path)}"
        if is_complete:
            yield f"saved {path_text(path)}"
    if state.state.startswith("waiting"):
        yield f"{state.state}: recording starts when it publishes a time"
    for topic, item in state.topics.items():
        if item.dropped:
            yield f"{topic}: dropping messages: the buffer is full (--buffsize enlarges it)"
        if item.lost:
            yield f"{topic}: the middleware is losing messages"
        if item.untimed:
            yield f"{topic}: leaving out messages: {_UNTIMED}"


def _rows(state: RecordProgress) -> list[Row]:
    """All of it, and the busiest topics; a bar shows which part of the data rate is theirs."""
    rate = sum(item.bytes_per_s for item in state.topics.values())
    texts = [
        f"{state.seconds:.0f} s",
        f"{rate / 1e6:.1f} MB/s",
        f"{state.bytes_written / 1e6:.1f} MB written",
    ]
    if state.spool_bytes >= 1e6:
        texts.append(f"{state.spool_bytes / 1e6:.0f} MB to pack")
    if state.waiting_bytes >= 1e6:
        texts.append(f"{state.waiting_bytes / 1e6:.0f} MB buffered")
    rows = [Row(state.state, "  ".join(texts))]
    busiest = sorted(state.topics.items(), key=lambda item: -item[1].bytes_per_s)
    for topic, item in busiest[:_SHOWN]:
        text = f"{item.messages:7}  {item.hz:6.1f} Hz  {item.bytes_per_s / 1e6:7.2f} MB/s"
        if gone := item.dropped + item.lost + item.untimed:
            text += f"  {gone} lost"
        rows.append(Row(topic, text, item.bytes_per_s / rate if rate else 0.0))
    if len(busiest) > _SHOWN:
        rows.append(Row(f"and {len(busiest) - _SHOWN} more"))
    return rows


def _print(summary: RecordSummary) -> None:
    """Print what was recorded."""
    for made in summary.datasets:
        if any(topic.messages for topic in made.topics):
            print_pack(made)
            continue
        topics = ", ".join(topic.topic for topic in made.topics)
        why = f"no message arrived on {topics}" if topics else "no matching topic was published"
        say(f"{path_text(made.dataset)}: empty: {why}")
    for problem in summary.failed:
        say(problem)
    say_counts(summary.dropped, "dropped: the buffer was full")
    say_counts(summary.lost, "lost by the middleware")
    say_counts(summary.untimed, f"left out: {_UNTIMED}")
