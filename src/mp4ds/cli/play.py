"""``mp4ds play``: keyboard controls, progress and summary of the player."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import Annotated, Any

import typer

from mp4ds.cli.keyboard import Keyboard
from mp4ds.cli.nodes import NodeCommand, names_in, say_as_much
from mp4ds.cli.options import JsonFlag, takes
from mp4ds.cli.output import be_quiet, complain, is_quiet, print_json, say, shown
from mp4ds.cli.play_words import STORAGES, spelled
from mp4ds.cli.process import caught_signals, report_errors
from mp4ds.errors import OptionError
from mp4ds.plugins.playing.options import PlayOptions
from mp4ds.plugins.playing.play import open_player
from mp4ds.plugins.playing.player import Player, PlayProgress, PlaySummary
from mp4ds.plugins.ros.names import NodeNames

_FASTER = 1.1


def player_keys(player: Player) -> Mapping[str, Callable[[], object]]:
    """The action of each key.

    Space: pause or resume; right or ``s``: next message; left or ``b``: previous message; up and
    down: 10 % faster and slower; ``t``: turn pausing for topics on or off.
    """
    return {
        " ": player.toggle_paused,
        "right": player.play_next,
        "s": player.play_next,
        "left": player.step_back,
        "b": player.step_back,
        "t": player.toggle_topic_pauses,
        "up": lambda: player.set_rate(_rounded(player.rate * _FASTER)),
        "down": lambda: player.set_rate(_rounded(player.rate / _FASTER)),
    }


def _rounded(rate: float) -> float:
    """Without the last digits, so that going faster and then slower gives the same rate again."""
    return float(f"{rate:.9g}")


# ---------------------------------------------------------------- progress and summary

_NS = 1_000_000_000
_SLOW_S = 0.5  # warned about at once; less is only mentioned in the summary


@contextmanager
def play_progress(*, is_quiet: bool) -> Iterator[Callable[[PlayProgress], None]]:
    """Shows the position on a terminal, and warns anywhere if playback cannot keep up.

    Args:
        is_quiet: Do not show the position.
    """
    from rich.console import Console
    from rich.text import Text

    console = Console(stderr=True)
    warned: set[str] = set()

    def warn(state: PlayProgress) -> None:
        if state.slowed_s >= _SLOW_S and "slow" not in warned:
            warned.add("slow")
            note("slowing down: messages are not ready in time (--drop drops late frames instead)")
        if state.dropped and "dropped" not in warned:
            warned.add("dropped")
            note("dropping late frames: they are not decoded in time")

    if is_quiet or not console.is_terminal:
        yield warn
        return
    with console.status("") as status:

        def report(state: PlayProgress) -> None:
            warn(state)
            status.update(Text(_progress_line(state)))

        yield report


def note(text: str) -> None:
    """Print a note to stderr, unless quiet."""
    if not is_quiet():
        complain(text)


def _progress_line(state: PlayProgress) -> str:
    now, length = ((time - state.start_ns) / _NS for time in (state.time_ns, state.end_ns))
    parts = [
        f"{now:.1f} of {length:.1f} s",
        f"{state.rate:g}x {shown(state.state)}".strip(),
        f"{state.messages} messages",
    ]
    if state.slowed_s >= _SLOW_S:
        parts.append(f"slowed by {state.slowed_s:.1f} s")
    if state.dropped:
        parts.append(f"{state.dropped} late frames dropped")
    return " · ".join(parts)


def print_play(summary: PlaySummary) -> None:
    """Print what was played."""
    for topic, count in summary.messages.items():
        say(f"{topic}: {count}")
    for topic, reasons in summary.as_recorded.items():
        for reason, count in reasons.items():
            say(f"{topic}: {count} published as recorded: {reason}")
    for topic, count in summary.not_installed.items():
        say(f"{topic}: {count} not played: the message type is not installed")
    for topic, count in summary.thinned.items():
        say(f"{topic}: {count} frames left out on request")
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


# ---------------------------------------------------------------- play


class PlayCommand(NodeCommand):
    """The command, which also takes the options of `rosbag play` and `ros2 bag play`."""

    def spelled(self, ctx: Any, args: Sequence[str]) -> tuple[list[str], NodeNames]:
        """Translate options of `rosbag play` and `ros2 bag play` to those of this command."""
        return spelled(args, self.valued(ctx).__contains__)


COMMAND = PlayCommand


@takes(PlayOptions)
def play(
    options: Callable[[], PlayOptions],
    context: typer.Context,
    datasets: Annotated[
        list[str],
        typer.Argument(metavar="DATASET...", help="Datasets; several are merged by time."),
    ],
    ros1: Annotated[bool, typer.Option("--ros1", help="Publish to ROS 1.")] = False,
    ros2: Annotated[
        bool, typer.Option("--ros2", help="Publish to ROS 2, with rclpy or else Cyclone DDS.")
    ] = False,
    clock: Annotated[
        bool,
        typer.Option(
            "--clock",
            help="Publish /clock, optionally at the given rate: --clock 50.",
        ),
    ] = False,
    clock_hz: Annotated[
        float,
        typer.Option(
            "--hz",
            help="Rate of --clock; default: 100, or 40 with --ros2.",
            show_default=False,
        ),
    ] = 100.0,
    storage: Annotated[
        str,
        typer.Option("--storage", help="Accepted for compatibility with `ros2 bag play`; ignored."),
    ] = "",
    log_level: Annotated[
        str,
        typer.Option("--log-level", help="Logging level: debug, info, warn, error or fatal."),
    ] = "",
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")] = False,
    no_keyboard: Annotated[
        bool, typer.Option("--disable-keyboard-controls", help="Disable the keyboard controls.")
    ] = False,
    progress: Annotated[
        bool, typer.Option("--progress/--no-progress", help="Show the playback position.")
    ] = True,
    as_json: JsonFlag = False,
) -> None:
    """Play back datasets, publishing to ROS 1 or ROS 2.

    Keys: space pauses or resumes, right and left publish the next or previous message, up and down
    play faster or slower.

    Options can be written as for `rosbag play` or `ros2 bag play`, such as --topics /a /b. With
    --ros2, -x means --exclude-regex, -s means --storage, and -i names a dataset; with --ros1, -p
    means --prefix.
    """
    with report_errors(as_json), ExitStack() as stack:
        names = names_in(context)
        say_as_much(log_level or names.log_level)
        if quiet:
            be_quiet()
        if storage not in ("", *STORAGES):
            raise OptionError(
                f"`storage` {storage!r} is not {' or '.join(STORAGES)}. With --ros2, -s means "
                "--storage; to start later, use --start-offset."
            )
        kinds = {"ros1": ros1, "ros2": ros2}
        chosen = [name for name, on in kinds.items() if on]
        if len(chosen) > 1:
            raise OptionError(f"--{chosen[0]} contradicts --{chosen[1]}.")
        chosen_options = replace(
            options(),
            to=chosen[0] if chosen else None,
            clock=clock_hz if clock else None,
            names=names,
        )
        is_silent = as_json or not progress or is_quiet()
        report = stack.enter_context(play_progress(is_quiet=is_silent))
        player = stack.enter_context(open_player(datasets, chosen_options, progress=report))
        note(f"publishing to {player.address}")
        if player.follows_clock:
            note("following another player's /clock (--no-follow-clock: play independently)")
        caught = stack.enter_context(caught_signals(player.stop))
        if not no_keyboard:
            stack.enter_context(Keyboard(player_keys(player)))
        summary = player.run()
    if as_json:
        print_json(summary)
    else:
        print_play(summary)
    if caught and caught[0] != signal.SIGINT:  # Ctrl-C is how players are ended, and no failure
        raise typer.Exit(128 + caught[0])
