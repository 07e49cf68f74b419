"""Dataset -> ROS 1, ROS 2 or Foxglove, at the recorded times."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from mp4ds.dataset import Dataset
from mp4ds.errors import OptionError
from mp4ds.playing.names import Names, Wanted
from mp4ds.playing.player import Player
from mp4ds.playing.report import PlayerOptions, PlayProgress, PlaySummary
from mp4ds.playing.timeline import Timeline
from mp4ds.publishers import WORLDS, Publisher, open_publisher, sourced
from mp4ds.republish import Reduction

__all__ = [
    "PlayOptions",
    "PlayProgress",
    "PlaySummary",
    "Player",
    "open_player",
    "play",
]

KINDS = {"raw": "raw", "compressed": "jpeg", "ffmpeg": "ffmpeg"}
"""What images can be published as, by the name of the transport: kinds of `mp4ds.republish`."""

_NS = 1_000_000_000
_CLOCK = "/clock"


@dataclass(frozen=True)
class PlayOptions:
    """How to play.

    Attributes:
        to: ``ros1``, ``ros2`` or ``foxglove``; None for what is sourced.
        rate: Seconds of the recording in a second.
        start_offset: Seconds of the recording to leave out at its beginning.
        duration: Seconds of the recording to play; None for all.
        loop: Begin again at the end.
        delay: Seconds to wait before the first message.
        paused: Stand still at first.
        topics: Globs of the topics to play; empty for all.
        exclude: Globs of topics to leave out.
        regex: Play topics too of which a part matches.
        remap: ``/old:=/new`` each.
        prefix: Put before all topics that are not remapped.
        clock: Hz at which /clock is published, besides with each message; None for no clock.
        follow_clock: Play by the /clock of others; None for where /use_sim_time is set (ROS 1)
            and no clock is published.
        immediate: Publish as fast as can be.
        wait_for_subscribers: Wait until every topic has one.
        qos_overrides: YAML file of QoS profiles by topic, as `ros2 bag play` reads it.
        publish_as: ``raw``, ``compressed`` or ``ffmpeg``; None for as recorded.
        jpeg_quality: Of JPEG files that are made, 1 to 100.
        resize: A factor, or width and height, that images get; None for as recorded.
        every: Only each Nth frame.
        max_rate: Most frames in a second; None for all.
        read_ahead: Frames of each stream that are made ahead.
        drop: Leave out frames that cannot be made in time, rather than play slower.
        restamp: ``now``: headers get the time at which they are published.
        lock_step: Topic of whose messages each lets the next frame go.
        host: Address to listen on, for Foxglove.
        port: Port to listen on, for Foxglove.
        origins: Web sites that may connect, for Foxglove, besides its own.
    """

    to: str | None = None
    rate: float = 1.0
    start_offset: float = 0.0
    duration: float | None = None
    loop: bool = False
    delay: float = 0.0
    paused: bool = False
    topics: Sequence[str] = ()
    exclude: Sequence[str] = ()
    regex: str = ""
    remap: Sequence[str] = ()
    prefix: str = ""
    clock: float | None = None
    follow_clock: bool | None = None
    immediate: bool = False
    wait_for_subscribers: bool = False
    qos_overrides: Path | None = None
    publish_as: str | None = None
    jpeg_quality: int = 95
    resize: float | tuple[int, int] | None = None
    every: int = 1
    max_rate: float | None = None
    read_ahead: int = 8
    drop: bool = False
    restamp: str | None = None
    lock_step: str = ""
    host: str = "127.0.0.1"
    port: int = 8765
    origins: Sequence[str] = ()


def play(
    datasets: Sequence[Path | str] | Path | str,
    options: PlayOptions | None = None,
    *,
    progress: Callable[[PlayProgress], None] | None = None,
) -> PlaySummary:
    """Publish datasets as if they were the recording.

    Args:
        datasets: Datasets, or sidecars beside their videos; or URLs. Several are merged by log
            time.
        options: How.
        progress: Called a few times a second.

    Returns:
        What was published, and what was left out.

    Raises:
        OptionError: An option is wrong.
        ConversionError: A topic cannot be published there; names it.
        PublishError: ROS is not there, or was lost.
        FormatError: A dataset is damaged.
    """
    with open_player(datasets, options, progress=progress) as player:
        return player.run()


@contextmanager
def open_player(
    datasets: Sequence[Path | str] | Path | str,
    options: PlayOptions | None = None,
    *,
    publisher: Publisher | None = None,
    progress: Callable[[PlayProgress], None] | None = None,
) -> Iterator[Player]:
    """A player of datasets, which is not running yet. See `play`.

    Args:
        datasets: See `play`.
        options: See `play`.
        publisher: Where to publish, not closed here; None for what the options say.
        progress: See `play`.
    """
    chosen = options or PlayOptions()
    _check(chosen)
    kind = chosen.to or ("" if publisher else sourced())
    world = publisher.world if publisher else WORLDS.get(kind)
    places = [datasets] if isinstance(datasets, str | Path) else datasets
    with ExitStack() as stack:
        opened = [
            stack.enter_context(Dataset(place, jpeg_quality=chosen.jpeg_quality))
            for place in places
        ]
        has_clock = chosen.clock is not None or bool(chosen.follow_clock)
        timeline = Timeline(
            opened,
            world=world,
            wanted=Wanted(
                chosen.topics,
                chosen.exclude,
                regex=chosen.regex,
                without=frozenset({_CLOCK} if has_clock else ()),
            ),
            names=Names(chosen.remap, chosen.prefix),
            kind=KINDS[chosen.publish_as] if chosen.publish_as else None,
            reduction=Reduction(chosen.resize, chosen.every, chosen.max_rate),
            jpeg_quality=chosen.jpeg_quality,
            read_ahead=chosen.read_ahead,
        )
        if publisher is None:
            publisher = stack.enter_context(
                open_publisher(
                    kind,
                    qos_overrides=chosen.qos_overrides,
                    host=chosen.host,
                    origins=chosen.origins,
                    port=chosen.port,
                    span=(timeline.start_ns, timeline.end_ns),
                    is_paced=not chosen.immediate,
                )
            )
        yield Player(
            timeline, publisher, _player_options(chosen, timeline, publisher), progress=progress
        )


def _player_options(chosen: PlayOptions, timeline: Timeline, publisher: Publisher) -> PlayerOptions:
    start = timeline.start_ns + round(chosen.start_offset * _NS)
    if start > timeline.end_ns:
        length = (timeline.end_ns - timeline.start_ns) / _NS
        raise OptionError(
            f"--start-offset {chosen.start_offset:g} is after the end: there are {length:.3f} s"
        )
    follow = chosen.follow_clock
    if follow is None:
        follow = chosen.clock is None and not chosen.immediate and publisher.wants_clock
    return PlayerOptions(
        rate=chosen.rate,
        start_ns=start,
        end_ns=None if chosen.duration is None else start + round(chosen.duration * _NS),
        loop=chosen.loop,
        delay_s=chosen.delay,
        paused=chosen.paused,
        immediate=chosen.immediate,
        clock_hz=chosen.clock,
        follow=follow,
        wait_for_subscribers=chosen.wait_for_subscribers,
        drop=chosen.drop,
        lock_step=chosen.lock_step,
        restamp=chosen.restamp is not None,
    )


def _check(options: PlayOptions) -> None:
    """Refuse what makes no sense, or contradicts itself.

    Raises:
        OptionError: Says what.
    """
    if not (math.isfinite(options.rate) and options.rate > 0):
        raise OptionError(f"--rate {options.rate:g} is not above 0.")
    for name, seconds in (
        ("--start-offset", options.start_offset),
        ("--duration", options.duration or 0.0),
        ("--delay", options.delay),
    ):
        if not (math.isfinite(seconds) and seconds >= 0):
            raise OptionError(f"{name} {seconds:g} is no number of seconds from 0.")
    if options.clock is not None and not 0 < options.clock <= 10_000:
        raise OptionError(f"--clock {options.clock:g} is not from 0 to 10000 Hz.")
    if options.publish_as not in (None, *KINDS):
        raise OptionError(
            f"--publish-as {options.publish_as!r} is not known. Use {', '.join(KINDS)}."
        )
    if options.restamp not in (None, "now"):
        raise OptionError(f"--restamp {options.restamp!r} is not known. Use now.")
    if not 1 <= options.read_ahead <= 10_000:
        raise OptionError(f"--read-ahead {options.read_ahead} is not from 1 to 10000.")
    if not 1 <= options.jpeg_quality <= 100:
        raise OptionError(f"--jpeg-quality {options.jpeg_quality} is not from 1 to 100.")
    if options.follow_clock:
        for name, given in (
            ("--clock", options.clock is not None),
            ("--rate", options.rate != 1.0),
            ("--immediate", options.immediate),
        ):
            if given:
                raise OptionError(f"{name} contradicts --follow-clock: the clock of others leads.")
