"""``mp4ds play``: keyboard controls, progress and summary of the player."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
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
from mp4ds.cli.output import QUIET, Row, complain, is_set, say, say_counts, show, shown
from mp4ds.plugins.playing.options import PlayOptions
from mp4ds.plugins.playing.player import Player, PlayProgress, PlaySummary, open_player
from mp4ds.plugins.ros.node import SERVICE_EVENTS

_FASTER = 1.1
_NS = 1_000_000_000
_SLOW_S = 0.5  # warned about at once; less is only mentioned in the summary


def _refuse(_: click.Context, parameter: click.Parameter, value: object) -> None:
    if value:
        raise click.UsageError(
            f"{parameter.opts[0]} is not supported: services are not called. Unpack the events of "
            "services (--topics '*/_service_event') for `ros2 bag play`, which calls them."
        )


@command(
    cls=NodeCommand,
    # what `rosbag play` and `ros2 bag play` write in another way
    lists={
        "--topics": ("--topics", ""),
        "--exclude-topics": ("--exclude-topics", ""),
        "--clock-topics": ("--clock-topics", ""),
        "--pause-topics": ("--pause-topics", ""),
        "--services": ("--topics", SERVICE_EVENTS),
        "--exclude-services": ("--exclude-topics", SERVICE_EVENTS),
        "--remap": ("--remap", ""),
        "-m": ("--remap", ""),
        "--bags": ("", ""),
        "--input": ("", ""),
    },
    letters={
        "ros1": {"-p": "--prefix"},
        "ros2": {"-x": "--exclude-regex", "-s": "--storage", "-i": "--input"},
    },
    defaults={"--clock": {"": "100", "ros2": "40"}},
    remaps=("--remap", "-m"),
    takes_paths=True,
)
@argument(
    "datasets", "DATASET...", "Datasets; several are merged by time.", nargs=-1, required=True
)
@option(
    "--storage",
    type=click.Choice(["sqlite3", "mcap"]),
    expose_value=False,
    metavar="TEXT",
    help="Accepted for compatibility with `ros2 bag play`; ignored.",
)
# messages are played in the order in which they were received
@option("--message-order", type=click.Choice(["received"]), hidden=True, expose_value=False)
@option("--progress-bar-update-rate", "bar_rate", type=float, hidden=True)
@accepted("--disable-loan-message", "--try-future-version")
@accepted("--storage-config-file", "--progress-bar-separation-lines", values=1)
@option(
    "--publish-service-requests", is_flag=True, hidden=True, callback=_refuse, expose_value=False
)
@option("--service-requests-source", hidden=True, callback=_refuse, expose_value=False)
@takes(RosOptions, "ros")
@takes(PlayOptions)
def play_command(
    datasets: Sequence[str], bar_rate: float | None, ros: RosOptions, options: PlayOptions
) -> None:
    """Play back datasets, publishing to ROS 1 or ROS 2.

    Keys: space pauses or resumes, right publishes the next message, up and down play faster or
    slower.

    Options can be written as for `rosbag play` or `ros2 bag play`, such as --topics /a /b. With
    --ros2, -x means --exclude-regex, -s means --storage, and -i names a dataset; with --ros1, -p
    means --prefix.
    """
    options = replace(options, to=ros.to, names=node_names(ros))
    is_shown = ros.progress and bar_rate != 0
    with ExitStack() as stack:
        report = stack.enter_context(node_progress(_rows, _warnings, is_shown=is_shown))
        player = stack.enter_context(open_player(datasets, options, progress=report))
        if not is_set(QUIET):
            complain(f"publishing to {player.address}")
            if player.follows_clock:
                complain("following another player's /clock (--no-follow-clock: do not follow)")
        caught = stack.enter_context(node_controls(ros, player.stop, player_keys(player)))
        summary = player.run()
    show(summary, _print)
    if caught and caught[0] != signal.SIGINT:  # Ctrl-C is how players are ended, and no failure
        raise click.exceptions.Exit(128 + caught[0])


def player_keys(player: Player) -> Mapping[str, Callable[[], object]]:
    """The action of each key.

    Space: pause or resume; right or ``s``: next message; up and down: 10 % faster and
    slower; ``t``: turn pausing for topics on or off.
    """
    return {
        " ": player.toggle_paused,
        "right": player.play_next,
        "s": player.play_next,
        "t": player.toggle_topic_pauses,
        "up": lambda: player.set_rate(_rounded(player.rate * _FASTER)),
        "down": lambda: player.set_rate(_rounded(player.rate / _FASTER)),
    }


def _rounded(rate: float) -> float:
    """Without the last digits, so that going faster and then slower gives the same rate again."""
    return float(f"{rate:.9g}")


def _warnings(state: PlayProgress) -> Iterator[str]:
    if state.so_far.slowed_s >= _SLOW_S and not is_set(QUIET):
        yield "slowing down: messages are not ready in time (--drop drops late frames instead)"
    if state.so_far.dropped and not is_set(QUIET):
        yield "dropping late frames: they are not decoded in time"


def _rows(state: PlayProgress) -> list[Row]:
    now, length = state.time_ns - state.start_ns, max(1, state.end_ns - state.start_ns)
    texts = [
        f"{now / _NS:.1f} of {length / _NS:.1f} s",
        f"{state.rate:g}x {shown(state.state)}".strip(),
        f"{sum(state.so_far.messages.values())} messages",
        f"slowed by {state.so_far.slowed_s:.1f} s" if state.so_far.slowed_s >= _SLOW_S else "",
        f"{state.so_far.dropped} late frames dropped" if state.so_far.dropped else "",
    ]
    return [Row("playing", "  ".join(filter(None, texts)), min(1.0, now / length))]


def _print(summary: PlaySummary) -> None:
    """Print what was played."""
    for topic, count in summary.messages.items():
        say(f"{topic}: {count}")
    say_counts(summary.as_recorded, "published as recorded")
    say_counts(summary.not_installed, "not played: the message type is not installed")
    total = sum(summary.messages.values())
    text = f"{total} messages in {summary.seconds:.1f} s"
    if summary.loops:
        text += f", started over {summary.loops} times"
    if summary.stopped:
        text += ", stopped before the end"
    say(text)
    if summary.slowed_s >= 0.1:
        say(f"took {summary.slowed_s:.1f} s longer: messages were not ready in time")
    if summary.dropped:
        say(f"{summary.dropped} late frames dropped")
