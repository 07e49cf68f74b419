"""``mp4ds play``: the keyboard of a player, where it stands, and what it did."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mp4ds.cli.keyboard import Keyboard
from mp4ds.cli.nodes import NodeCommand, names_in, say_as_much
from mp4ds.cli.options import JsonFlag, takes
from mp4ds.cli.output import be_quiet, complain, is_quiet, print_json, say, shown
from mp4ds.cli.play_words import STORAGES, spelled
from mp4ds.cli.process import caught_signals, told_errors
from mp4ds.errors import OptionError
from mp4ds.plugins.playing.play import PlayOptions, open_player
from mp4ds.plugins.publishing.publisher import Controls

if TYPE_CHECKING:
    from mp4ds.plugins.playing.player import PlayProgress, PlaySummary
    from mp4ds.plugins.publishing.names import NodeNames

_FASTER = 1.1


def player_keys(controls: Controls) -> Mapping[str, Callable[[], object]]:
    """What each key does to a player.

    Space: pause or resume; right or ``s``: one message; left or ``b``: one back; up and down: 10 %
    faster and slower; ``t``: pause for topics or not.
    """
    return {
        " ": controls.toggle_paused,
        "right": controls.play_next,
        "s": controls.play_next,
        "left": controls.step_back,
        "b": controls.step_back,
        "t": controls.toggle_topic_pauses,
        "up": lambda: controls.set_rate(_rounded(controls.rate * _FASTER)),
        "down": lambda: controls.set_rate(_rounded(controls.rate / _FASTER)),
    }


def _rounded(rate: float) -> float:
    """Without the last digits, so that faster and slower cancel."""
    return float(f"{rate:.9g}")


# ---------------------------------------------------------------- what is shown

_NS = 1_000_000_000
_SLOW_S = 0.5  # that is told at once; less is no more than told at the end


@contextmanager
def play_progress(*, is_quiet: bool) -> Iterator[Callable[[PlayProgress], None]]:
    """On a terminal, a line that tells where it stands; anywhere, that it cannot keep up.

    Args:
        is_quiet: No line.
    """
    from rich.console import Console
    from rich.text import Text

    console = Console(stderr=True)
    told: set[str] = set()

    def warn(state: PlayProgress) -> None:
        if state.slowed_s >= _SLOW_S and "slow" not in told:
            told.add("slow")
            tell("messages are not ready in time: the clock waits (--drop leaves out frames)")
        if state.dropped and "dropped" not in told:
            told.add("dropped")
            tell("frames are not made in time: late ones are left out")

    if is_quiet or not console.is_terminal:
        yield warn
        return
    with console.status("") as status:

        def report(state: PlayProgress) -> None:
            warn(state)
            status.update(Text(_standing(state)))

        yield report


def tell(text: str) -> None:
    """Say something beside the result."""
    if not is_quiet():
        complain(text)


def _standing(state: PlayProgress) -> str:
    now, length = ((time - state.start_ns) / _NS for time in (state.time_ns, state.end_ns))
    parts = [
        f"{now:.1f} of {length:.1f} s",
        f"{state.rate:g}x {shown(state.state)}".strip(),
        f"{state.messages} messages",
    ]
    if state.slowed_s >= _SLOW_S:
        parts.append(f"slowed by {state.slowed_s:.1f} s")
    if state.dropped:
        parts.append(f"{state.dropped} late frames left out")
    return " · ".join(parts)


def print_play(summary: PlaySummary) -> None:
    """Tell what was played."""
    for topic, count in summary.messages.items():
        say(f"{topic}: {count}")
    for topic, reasons in summary.as_recorded.items():
        for reason, count in reasons.items():
            say(f"{topic}: {count} as recorded: {reason}")
    for topic, count in summary.not_installed.items():
        say(f"{topic}: {count} left out, of a type that is not installed")
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
        say(f"{summary.slowed_s:.1f} s longer than recorded: messages were not ready in time")
    if summary.dropped:
        say(f"{summary.dropped} frames left out, since they were late")


# ---------------------------------------------------------------- play


class PlayCommand(NodeCommand):
    """The command, which understands how the options of other players are typed."""

    def spelled(self, ctx: Any, args: Sequence[str]) -> tuple[list[str], NodeNames]:
        """Arguments in the words of `rosbag play` and `ros2 bag play`, as the command has them."""
        return spelled(args, self.valued(ctx).__contains__)


COMMAND = PlayCommand


@takes(PlayOptions, without=("to", "clock"))
def play(
    options: Callable[[], PlayOptions],
    context: typer.Context,
    datasets: Annotated[
        list[str], typer.Argument(metavar="DATASET...", help="Datasets; several are merged.")
    ],
    ros1: Annotated[bool, typer.Option("--ros1", help="Into ROS 1.")] = False,
    ros2: Annotated[
        bool, typer.Option("--ros2", help="Into ROS 2, by rclpy or else by Cyclone DDS.")
    ] = False,
    foxglove: Annotated[
        bool, typer.Option("--foxglove", help="To Foxglove, as a WebSocket server.")
    ] = False,
    clock: Annotated[
        bool,
        typer.Option(
            "--clock",
            help="Publish /clock, and lead those that follow it; a rate may stand behind it.",
        ),
    ] = False,
    clock_hz: Annotated[
        float, typer.Option("--hz", help="The rate of --clock; 40 with --ros2.")
    ] = 100.0,
    storage: Annotated[
        str, typer.Option("--storage", help="sqlite3 or mcap: of no meaning for datasets.")
    ] = "",
    log_level: Annotated[
        str,
        typer.Option("--log-level", help="debug, info, warn, error or fatal: what is told."),
    ] = "",
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")] = False,
    no_keyboard: Annotated[
        bool, typer.Option("--disable-keyboard-controls", help="Leave the keyboard alone.")
    ] = False,
    progress: Annotated[
        bool, typer.Option("--progress/--no-progress", help="A line that tells where it is.")
    ] = True,
    as_json: JsonFlag = False,
) -> None:
    """Publish datasets as if they were the recording: into ROS 1, ROS 2 or Foxglove.

    Keys: space pauses; right: one message; left: one back; up and down: faster and slower.

    With --ros2, -x is --exclude-regex, -s is --storage and -i a dataset, as in `ros2 bag play`;
    with --ros1, -p is --prefix, as in `rosbag play`. Lists such as --topics /a /b are understood.
    """
    with told_errors(as_json), ExitStack() as stack:
        names = names_in(context)
        say_as_much(log_level or names.log_level)
        if quiet:
            be_quiet()
        if storage not in ("", *STORAGES):
            raise OptionError(
                f"`storage` {storage!r} is none of {', '.join(STORAGES)}. With --ros2, -s is "
                "--storage; seconds to leave out are --start-offset."
            )
        kinds = {"ros1": ros1, "ros2": ros2, "foxglove": foxglove}
        chosen = [name for name, on in kinds.items() if on]
        if len(chosen) > 1:
            raise OptionError(f"--{chosen[0]} contradicts --{chosen[1]}.")
        told = replace(
            options(),
            to=chosen[0] if chosen else None,
            clock=clock_hz if clock else None,
            names=names,
        )
        is_silent = as_json or not progress or is_quiet()
        report = stack.enter_context(play_progress(is_quiet=is_silent))
        player = stack.enter_context(open_player(datasets, told, progress=report))
        tell(f"publishing to {player.address}")
        if player.follows_clock:
            tell("the /clock of another player leads (--clock: this one, --no-follow-clock: none)")
        caught = stack.enter_context(caught_signals(player.stop))
        if not no_keyboard:
            stack.enter_context(Keyboard(player_keys(player)))
        summary = player.run()
    if as_json:
        print_json(summary)
    else:
        print_play(summary)
    if caught:
        raise typer.Exit(128 + caught[0])
