"""``mp4ds play``."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated, Any, Optional

import typer

from mp4ds.cli.arguments import parse_resize
from mp4ds.cli.failures import told_errors
from mp4ds.cli.options import (
    EveryOption,
    JpegQualityOption,
    JsonFlag,
    MaxRateOption,
    ResizeOption,
    TopicsOption,
)
from mp4ds.cli.output import print_json
from mp4ds.cli.play_output import play_progress, print_play, tell
from mp4ds.cli.process import ending_signals
from mp4ds.errors import OptionError

_DEFAULT_CLOCK_HZ = 100.0


def play(
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
    rate: Annotated[float, typer.Option("--rate", "-r", help="Times the recorded speed.")] = 1.0,
    start_offset: Annotated[
        float,
        typer.Option("--start-offset", "--start", "-s", help="Seconds to leave out at first."),
    ] = 0.0,
    duration: Annotated[
        Optional[float],  # noqa: UP045 - read at run time by typer
        typer.Option("--duration", "--playback-duration", "-u", help="Seconds to play."),
    ] = None,
    loop: Annotated[bool, typer.Option("--loop", "-l", help="Begin again at the end.")] = False,
    delay: Annotated[
        float, typer.Option("--delay", "-d", help="Seconds to wait before the first message.")
    ] = 0.0,
    pause: Annotated[
        bool, typer.Option("--pause", "--start-paused", "-p", help="Stand still at first.")
    ] = False,
    topics: TopicsOption = None,
    exclude: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(
            "--exclude", "--exclude-topics", "-x", metavar="GLOB", help="Leave out topics."
        ),
    ] = None,
    regex: Annotated[
        str, typer.Option("--regex", "-e", help="Topics of which a part matches.")
    ] = "",
    remap: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option("--remap", "-m", metavar="OLD:=NEW", help="Give a topic another name."),
    ] = None,
    prefix: Annotated[str, typer.Option("--prefix", help="Put before the topics.")] = "",
    clock: Annotated[
        bool,
        typer.Option(
            "--clock",
            help="Publish /clock, and lead those that follow it; a rate may stand behind it.",
        ),
    ] = False,
    clock_hz: Annotated[
        float, typer.Option("--hz", help="The rate of --clock, besides with each message.")
    ] = _DEFAULT_CLOCK_HZ,
    follow_clock: Annotated[
        Optional[bool],  # noqa: UP045
        typer.Option(
            "--follow-clock/--no-follow-clock",
            help="Play by the /clock of another player; by default where /use_sim_time is set "
            "(ROS 1) and there is no --clock.",
        ),
    ] = None,
    immediate: Annotated[
        bool, typer.Option("--immediate", "-i", help="As fast as can be.")
    ] = False,
    wait_for_subscribers: Annotated[
        bool, typer.Option("--wait-for-subscribers", help="Begin when all topics have one.")
    ] = False,
    qos_overrides: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(
            "--qos-profile-overrides-path", metavar="YAML", help="QoS by topic, for ROS 2."
        ),
    ] = None,
    publish_as: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            "--publish-as", help="Cameras as raw, compressed (JPEG) or ffmpeg (video packets)."
        ),
    ] = None,
    jpeg_quality: JpegQualityOption = 95,
    resize: ResizeOption = None,
    every: EveryOption = 1,
    max_rate: MaxRateOption = None,
    read_ahead: Annotated[
        int,
        typer.Option(
            "--read-ahead",
            "--read-ahead-queue-size",
            help="Frames of each camera that are made ahead.",
        ),
    ] = 8,
    drop: Annotated[
        bool, typer.Option("--drop", help="Leave out frames that come late, keep the speed.")
    ] = False,
    restamp: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option("--restamp", metavar="now", help="Give headers the time of publishing."),
    ] = None,
    lock_step: Annotated[
        str,
        typer.Option(
            "--lock-step",
            metavar="TOPIC",
            help="The next frame goes when a message came on this topic.",
        ),
    ] = "",
    host: Annotated[str, typer.Option("--host", help="To listen on, for Foxglove.")] = "127.0.0.1",
    port: Annotated[
        int, typer.Option("--port", min=0, max=65535, help="To listen on, for Foxglove.")
    ] = 8765,
    allow_origin: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(
            "--allow-origin",
            metavar="URL",
            help="A web site that may connect, such as http://robot:8080, besides Foxglove's and "
            "those of this machine.",
        ),
    ] = None,
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
    """
    from mp4ds.playing import PlayOptions, open_player

    with told_errors(as_json), ExitStack() as stack:
        kinds = {"ros1": ros1, "ros2": ros2, "foxglove": foxglove}
        chosen = [name for name, on in kinds.items() if on]
        if len(chosen) > 1:
            raise OptionError(f"--{chosen[0]} contradicts --{chosen[1]}.")
        options = PlayOptions(
            to=chosen[0] if chosen else None,
            rate=rate,
            start_offset=start_offset,
            duration=duration,
            loop=loop,
            delay=delay,
            paused=pause,
            topics=topics or (),
            exclude=exclude or (),
            regex=regex,
            remap=remap or (),
            prefix=prefix,
            clock=clock_hz if clock else None,
            follow_clock=follow_clock,
            immediate=immediate,
            wait_for_subscribers=wait_for_subscribers,
            qos_overrides=qos_overrides,
            publish_as=publish_as,
            jpeg_quality=jpeg_quality,
            resize=parse_resize(resize),
            every=every,
            max_rate=max_rate,
            read_ahead=read_ahead,
            drop=drop,
            restamp=restamp,
            lock_step=lock_step,
            host=host,
            port=port,
            origins=allow_origin or (),
        )
        report = stack.enter_context(play_progress(is_quiet=as_json or not progress))
        player = stack.enter_context(open_player(datasets, options, progress=report))
        tell(f"publishing to {player.address}")
        if player.follows_clock:
            tell("the /clock of another player leads (--clock: this one, --no-follow-clock: none)")
        caught = stack.enter_context(_signals(player.stop))
        if not no_keyboard:
            from mp4ds.cli.keys import Keyboard

            stack.enter_context(Keyboard(player))
        summary = player.run()
    if as_json:
        print_json(summary)
    else:
        print_play(summary)
    if caught:
        raise typer.Exit(128 + caught[0])


@contextmanager
def _signals(stop: Callable[[], None]) -> Iterator[list[int]]:
    """Ends the player at Ctrl-C and the like, after the message that is being sent."""
    caught: list[int] = []

    def end(number: int, _: Any) -> None:
        if caught:  # asked again: whatever holds it up is not waited for
            raise KeyboardInterrupt
        caught.append(number)
        stop()

    before = {number: signal.signal(number, end) for number in (signal.SIGINT, *ending_signals())}
    try:
        yield caught
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
