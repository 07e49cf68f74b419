"""Dataset -> ROS 1, ROS 2 or Foxglove, at the recorded times."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from mp4ds.dataset.collections import datasets_in
from mp4ds.dataset.dataset import Dataset
from mp4ds.errors import OptionError
from mp4ds.options import (
    Options,
    argument,
    every,
    exclude,
    jpeg_quality,
    max_rate,
    option,
    resize,
    topics,
)
from mp4ds.plugins.playing.player import Player, PlayerOptions, PlayProgress, PlaySummary
from mp4ds.plugins.playing.timeline import Names, Timeline, Wanted
from mp4ds.plugins.publishing.names import PLAIN, NodeNames
from mp4ds.plugins.publishing.publisher import WORLDS, Publisher, open_publisher, sourced
from mp4ds.unpacking.pictures import Reduction

KINDS = {"raw": "raw", "compressed": "jpeg", "ffmpeg": "ffmpeg"}
"""What images can be published as, by the name of the transport: kinds of `mp4ds.unpacking`."""

_NS = 1_000_000_000
_CLOCK = "/clock"


@dataclass(frozen=True)
class PlayOptions(Options):
    """How to play."""

    to: str | None = option("ros1, ros2 or foxglove; what is sourced by default.")
    rate: float = option("Times the recorded speed.", 1.0, "-r")
    start_offset: float = option(
        "Seconds to leave out at first.", 0.0, "--start-offset", "--start", "-s"
    )
    duration: float | None = option(
        "Seconds to play.", None, "--duration", "--playback-duration", "-u"
    )
    until_sec: float | None = option(
        "The last time to play, seconds since 1970; with `duration`, whichever is later.",
        None,
        "--playback-until-sec",
    )
    until_nsec: int | None = option("The same in nanoseconds.", None, "--playback-until-nsec")
    loop: bool = option("Start over at the end.", False, "-l")
    keep_alive: bool = option("Stay at the end, for those that come late.", False, "-k")
    delay: float = option(
        "Seconds to wait before the first message, in ROS 2 of each loop.", 0.0, "-d"
    )
    paused: bool = option("Stand still at first.", False, "--pause", "--start-paused", "-p")
    topics: Sequence[str] = topics()
    exclude: Sequence[str] = exclude("--exclude", "--exclude-topics")
    regex: str = option("Topics that match as a whole.", "", "-e")
    exclude_regex: str = option("Leave out topics that match as a whole.", "")
    remap: Sequence[str] = option("Give a topic another name.", (), "-m", metavar="OLD:=NEW")
    prefix: str = option("Put before the topics.", "")
    clock: float | None = option("Hz at which /clock is published, to lead those that follow it.")
    clock_topics: Sequence[str] = option(
        "Publish /clock before each message of these topics.", (), metavar="TOPIC"
    )
    clock_topics_all: bool = option("Publish /clock before each message.", False)
    follow_clock: bool | None = option(
        "Play by the /clock of another player; by default where /use_sim_time is set (ROS 1) and "
        "there is no `clock`.",
        None,
        "--follow-clock/--no-follow-clock",
    )
    immediate: bool = option("As fast as can be.", False, "-i")
    skip_empty: float | None = option(
        "Skip times of more seconds without a message.", metavar="SECONDS"
    )
    pause_topics: Sequence[str] = option(
        "Pause before each message of these topics.", (), metavar="TOPIC"
    )
    rate_control_topic: str = option(
        "Wait where the stamps of this topic fall behind; ROS 1.", "", metavar="TOPIC"
    )
    rate_control_max_delay: float = option("How far, seconds.", 1.0)
    wait_for_subscribers: bool = option("Begin when all topics have one.", False)
    wait_for_all_acked: int | None = option(
        "Wait at the end until all is acknowledged, for so many ms at most, 0 for ever; ROS 2.",
        None,
        metavar="MS",
        least=0,
    )
    queue: int = option(
        "Messages that may wait for a subscriber in ROS 1; 0 for any number.", 0, least=0
    )
    qos_overrides: Path | None = option(
        "QoS by topic, for ROS 2.", None, "--qos-profile-overrides-path", metavar="YAML"
    )
    publish_as: str | None = option("Cameras as raw, compressed (JPEG) or ffmpeg (video packets).")
    jpeg_quality: int = jpeg_quality()
    resize: float | tuple[int, int] | None = resize()
    every: int = every()
    max_rate: float | None = max_rate()
    read_ahead: int = option(
        "Frames of each camera that are made ahead.",
        8,
        "--read-ahead",
        "--read-ahead-queue-size",
        least=1,
        most=10_000,
    )
    drop: bool = option("Leave out frames that come late, keep the speed.", False)
    restamp: str | None = option("Give headers the time of publishing.", metavar="now")
    lock_step: str = option(
        "The next frame goes when a message came on this topic.", "", metavar="TOPIC"
    )
    host: str = option("To listen on, for Foxglove.", "127.0.0.1")
    port: int = option("To listen on, for Foxglove.", 8765, least=0, most=65535)
    origins: Sequence[str] = option(
        "A web site that may connect, such as http://robot:8080, besides Foxglove's and those of "
        "this machine.",
        (),
        "--allow-origin",
        metavar="URL",
    )
    names: NodeNames = argument("What ROS calls the node and its topics.", PLAIN)


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
    chosen = replace(chosen, names=chosen.names.in_world(world))
    places = datasets_in(datasets)
    with ExitStack() as stack:
        opened = [
            stack.enter_context(Dataset(place, jpeg_quality=chosen.jpeg_quality))
            for place in places
        ]
        leads = chosen.clock is not None or bool(chosen.clock_topics) or chosen.clock_topics_all
        timeline = Timeline(
            opened,
            world=world,
            wanted=Wanted(
                chosen.topics,
                chosen.exclude,
                regex=chosen.regex,
                exclude_regex=chosen.exclude_regex,
                without=frozenset({_CLOCK} if leads or chosen.follow_clock else ()),
            ),
            names=Names(chosen.remap, chosen.prefix, chosen.names),
            kind=KINDS[chosen.publish_as] if chosen.publish_as else None,
            reduction=Reduction(chosen.resize, chosen.every, chosen.max_rate),
            jpeg_quality=chosen.jpeg_quality,
            read_ahead=chosen.read_ahead,
        )
        if publisher is None:
            publisher = stack.enter_context(_opened(kind, chosen, timeline))
        follow = chosen.follow_clock
        if follow is None:
            follow = not (leads or chosen.immediate) and publisher.wants_clock
        player_options = replace(
            _player_options(chosen, timeline), follow=follow, delays_loops=world == "ros2"
        )
        yield Player(timeline, publisher, player_options, progress=progress)


def _opened(kind: str, chosen: PlayOptions, timeline: Timeline) -> Publisher:
    for name, needed, is_given in (
        ("wait_for_all_acked", "ros2", chosen.wait_for_all_acked is not None),
        ("queue", "ros1", chosen.queue > 0),
        ("rate_control_topic", "ros1", bool(chosen.rate_control_topic)),
    ):
        if is_given and kind != needed:
            raise OptionError(f"`{name}` goes with `{needed}`.")
    patience = chosen.wait_for_all_acked
    return open_publisher(
        kind,
        names=chosen.names,
        qos_overrides=chosen.qos_overrides,
        parting_s=None if patience is None else patience / 1000 or math.inf,
        queue_size=chosen.queue,
        host=chosen.host,
        origins=chosen.origins,
        port=chosen.port,
        span=(timeline.start_ns, timeline.end_ns),
        is_paced=not chosen.immediate,
    )


def _player_options(chosen: PlayOptions, timeline: Timeline) -> PlayerOptions:
    start = timeline.start_ns + round(chosen.start_offset * _NS)
    if start > timeline.end_ns:
        length = (timeline.end_ns - timeline.start_ns) / _NS
        raise OptionError(
            f"`start_offset` {chosen.start_offset:g} is after the end: there are {length:.3f} s"
        )
    skip = chosen.skip_empty
    clock_with = timeline.named("clock_topics", chosen.clock_topics)
    return PlayerOptions(
        rate=chosen.rate,
        start_ns=start,
        end_ns=_end(chosen, start),
        loop=chosen.loop,
        keep_alive=chosen.keep_alive,
        delay_s=chosen.delay,
        paused=chosen.paused,
        immediate=chosen.immediate,
        clock_hz=chosen.clock,
        clock_with=None if chosen.clock_topics_all else clock_with,
        wait_for_subscribers=chosen.wait_for_subscribers,
        drop=chosen.drop,
        skip_empty_ns=None if skip is None else round(skip * _NS),
        pause_topics=timeline.named("pause_topics", chosen.pause_topics),
        lock_step=chosen.lock_step,
        rate_control=chosen.rate_control_topic,
        rate_control_ns=round(chosen.rate_control_max_delay * _NS),
        restamp=chosen.restamp is not None,
    )


def _end(chosen: PlayOptions, start: int) -> int | None:
    """The last time that is played; None for the end. Of several the later one, as in ROS 2."""
    ends = []
    if chosen.duration is not None:
        ends.append(start + round(chosen.duration * _NS))
    if chosen.until_sec is not None and chosen.until_sec >= 0:
        ends.append(round(chosen.until_sec * _NS))
    if chosen.until_nsec is not None and chosen.until_nsec >= 0:
        ends.append(chosen.until_nsec)
    return max(ends, default=None)


def _check(options: PlayOptions) -> None:
    """Refuse what makes no sense, or contradicts itself.

    Raises:
        OptionError: Says what.
    """
    if not (math.isfinite(options.rate) and options.rate > 0):
        raise OptionError(f"`rate` {options.rate:g} is not above 0.")
    for name, seconds in (
        ("start_offset", options.start_offset),
        ("duration", options.duration or 0.0),
        ("delay", options.delay),
        ("skip_empty", options.skip_empty or 0.0),
        ("rate_control_max_delay", options.rate_control_max_delay),
    ):
        if not (math.isfinite(seconds) and seconds >= 0):
            raise OptionError(f"`{name}` {seconds:g} is no number of seconds from 0.")
    if options.clock is not None and not 0 < options.clock <= 10_000:
        raise OptionError(f"`clock` {options.clock:g} is not from 0 to 10000 Hz.")
    if options.until_sec is not None and not math.isfinite(options.until_sec):
        raise OptionError(f"`until_sec` {options.until_sec:g} is no number of seconds.")
    if options.clock_topics and options.clock_topics_all:
        raise OptionError("`clock_topics` contradicts `clock_topics_all`.")
    for name, given in (
        ("clock_topics", bool(options.clock_topics)),
        ("clock_topics_all", options.clock_topics_all),
    ):
        if given and options.clock is not None:
            raise OptionError(f"`{name}` contradicts `clock`, which goes by a rate.")
    if options.publish_as not in (None, *KINDS):
        raise OptionError(
            f"`publish_as` {options.publish_as!r} is not known. Use {', '.join(KINDS)}."
        )
    if options.restamp not in (None, "now"):
        raise OptionError(f"`restamp` {options.restamp!r} is not known. Use now.")
    if options.follow_clock:
        for name, given in (
            ("clock", options.clock is not None),
            ("clock_topics", bool(options.clock_topics)),
            ("clock_topics_all", options.clock_topics_all),
            ("rate", options.rate != 1.0),
            ("immediate", options.immediate),
        ):
            if given:
                raise OptionError(
                    f"`{name}` contradicts `follow_clock`: the clock of others leads."
                )
