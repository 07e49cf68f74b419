"""Play datasets back to ROS 1 or ROS 2, at the recorded times."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from mp4ds.dataset.collections import datasets_in
from mp4ds.dataset.dataset import Dataset
from mp4ds.dataset.salvage import HOW_TO_SALVAGE
from mp4ds.errors import OptionError, advising
from mp4ds.options import WHAT, WHERE, argument, jpeg_quality, option
from mp4ds.plugins.playing.player import Player, PlayerOptions, PlayProgress, PlaySummary
from mp4ds.plugins.playing.timeline import Names, Timeline, Wanted
from mp4ds.plugins.publishing.names import PLAIN, NodeNames
from mp4ds.plugins.publishing.publisher import Publisher, open_publisher, sourced
from mp4ds.unpacking.pictures import ReductionOptions

KINDS = {"raw": "raw", "compressed": "jpeg", "ffmpeg": "ffmpeg"}
"""Transport that cameras are published as -> kind of image in `mp4ds.unpacking`."""

_NS = 1_000_000_000
_CLOCK = "/clock"


@dataclass(frozen=True, kw_only=True)
class PlayOptions(ReductionOptions):
    """How to play datasets back."""

    exclude: Sequence[str] = option(
        "Leave out matching topics.",
        (),
        "--exclude",
        "--exclude-topics",
        "-x",
        panel=WHAT,
        metavar="GLOB",
    )
    to: str | None = argument("ros1 or ros2; default: the ROS that is sourced.")
    rate: float = option("Playback rate; 2 is twice as fast.", 1.0, "-r")
    start_offset: float = option(
        "Start this many seconds into the recording.",
        0.0,
        "--start-offset",
        "--start",
        "-s",
        panel=WHAT,
    )
    duration: float | None = option(
        "Play only this many seconds.", None, "--duration", "--playback-duration", "-u", panel=WHAT
    )
    until_sec: float | None = option(
        "Play until this time, in seconds since 1970, or for `duration`, whichever is later.",
        None,
        "--playback-until-sec",
        panel=WHAT,
    )
    until_nsec: int | None = option(
        "Play until this time, in nanoseconds since 1970.",
        None,
        "--playback-until-nsec",
        panel=WHAT,
    )
    loop: bool = option("Loop playback.", False, "-l")
    keep_alive: bool = option("Keep running at the end, for late subscribers.", False, "-k")
    delay: float = option("Seconds to wait before playing; in ROS 2, before each loop.", 0.0, "-d")
    paused: bool = option("Start paused.", False, "--pause", "--start-paused", "-p")
    regex: str = option(
        "Only topics that fully match a regular expression, and those of `topics`.",
        "",
        "-e",
        panel=WHAT,
    )
    exclude_regex: str = option(
        "Leave out topics that fully match a regular expression.", "", panel=WHAT
    )
    remap: Sequence[str] = option(
        "Rename a topic; repeatable.", (), "-m", metavar="OLD:=NEW", panel=WHERE
    )
    prefix: str = option(
        "Prefix for all topics that are not remapped.",
        "",
        panel=WHERE,
    )
    clock: float | None = argument("Publish /clock at this rate in Hz; default: do not publish it.")
    clock_topics: Sequence[str] = option(
        "Publish /clock just before each message on these topics.", (), metavar="TOPIC"
    )
    clock_topics_all: bool = option("Publish /clock just before each message.", False)
    follow_clock: bool | None = option(
        "Play in step with another player's /clock; default: if /use_sim_time is set (ROS 1) and "
        "`clock` is not given.",
        None,
        "--follow-clock/--no-follow-clock",
    )
    immediate: bool = option("Publish as fast as possible.", False, "-i")
    skip_empty: float | None = option(
        "Skip gaps between messages that are longer than this.", metavar="SECONDS", panel=WHAT
    )
    pause_topics: Sequence[str] = option(
        "Pause before each message on these topics.", (), metavar="TOPIC"
    )
    rate_control_topic: str = option(
        "Wait when playback gets too far ahead of the header stamps on this topic (ROS 1).",
        "",
        metavar="TOPIC",
    )
    rate_control_max_delay: float = option(
        "Seconds that playback may be ahead of `rate_control_topic`.", 1.0
    )
    wait_for_subscribers: bool = option("Wait for a subscriber on each topic first.", False)
    wait_for_all_acked: int | None = option(
        "At the end, wait this many milliseconds at most for subscribers to acknowledge all "
        "messages; 0: wait forever (ROS 2).",
        None,
        metavar="MS",
        least=0,
    )
    queue: int = option(
        "Outgoing queue per subscriber, in messages; 0: no limit but 128 MiB (ROS 1).", 0, least=0
    )
    qos_overrides: Path | None = option(
        "QoS profiles by topic (ROS 2).", None, "--qos-profile-overrides-path", metavar="YAML"
    )
    publish_as: str | None = option(
        "Publish cameras as raw, compressed (JPEG) or ffmpeg (video packets); default: as recorded."
    )
    jpeg_quality: int = jpeg_quality()
    read_ahead: int = option(
        "Frames per camera to decode ahead.",
        8,
        "--read-ahead",
        "--read-ahead-queue-size",
        least=1,
        most=10_000,
    )
    drop: bool = option("Drop late frames instead of playing slower.", False)
    restamp: str | None = option("Set header stamps to the time of publishing.", metavar="now")
    lock_step: str = option(
        "Publish the next frame only after a message on this topic.", "", metavar="TOPIC"
    )
    names: NodeNames = argument("Name, namespace and remappings of the ROS node.", PLAIN)


def play(
    datasets: Sequence[Path | str] | Path | str,
    options: PlayOptions | None = None,
    *,
    progress: Callable[[PlayProgress], None] | None = None,
) -> PlaySummary:
    """Play back datasets, publishing their messages at the recorded times.

    Args:
        datasets: Datasets, or sidecars next to their videos; paths or URLs. Several are merged by
            log time.
        options: How to play them.
        progress: Called a few times a second.

    Returns:
        What was published, and what was left out.

    Raises:
        OptionError: An option is wrong.
        ConversionError: A topic cannot be published there; names it.
        PublishError: ROS is not available, or the connection was lost.
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
    """A player of datasets that is not running yet.

    Args:
        datasets: As for `play`.
        options: As for `play`.
        publisher: Where to publish, not closed here; None: as the options say.
        progress: As for `play`.
    """
    chosen = options or PlayOptions()
    _check(chosen)
    kind = chosen.to or ("" if publisher else sourced())
    world = publisher.world if publisher else kind
    chosen = replace(chosen, names=chosen.names.in_world(world))
    places = datasets_in(datasets)
    with ExitStack() as stack:
        stack.enter_context(advising(HOW_TO_SALVAGE))
        leads = chosen.clock is not None or bool(chosen.clock_topics) or chosen.clock_topics_all
        wanted = Wanted(
            chosen.topics,
            chosen.exclude,
            regex=chosen.regex,
            exclude_regex=chosen.exclude_regex,
            without=frozenset({_CLOCK} if leads or chosen.follow_clock else ()),
        )
        opened = [
            stack.enter_context(Dataset(place, jpeg_quality=chosen.jpeg_quality, selected=wanted))
            for place in places
        ]
        timeline = Timeline(
            opened,
            world=world,
            wanted=wanted,
            names=Names(chosen.remap, chosen.prefix, chosen.names),
            kind=KINDS[chosen.publish_as] if chosen.publish_as else None,
            reduction=chosen.reduction,
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
            raise OptionError(f"`{name}` needs `{needed}`.")
    patience = chosen.wait_for_all_acked
    return open_publisher(
        kind,
        names=chosen.names,
        qos_overrides=chosen.qos_overrides,
        parting_s=None if patience is None else patience / 1000 or math.inf,
        queue_size=chosen.queue,
        is_paced=not chosen.immediate,
    )


def _player_options(chosen: PlayOptions, timeline: Timeline) -> PlayerOptions:
    start = timeline.start_ns + round(chosen.start_offset * _NS)
    if start > timeline.end_ns:
        length = (timeline.end_ns - timeline.start_ns) / _NS
        raise OptionError(
            f"`start_offset` {chosen.start_offset:g} is past the end: the recording has "
            f"{length:.3f} s."
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
    """The last time to play; None for the end. Of several, the latest, as in `ros2 bag play`."""
    ends = []
    if chosen.duration is not None:
        ends.append(start + round(chosen.duration * _NS))
    if chosen.until_sec is not None and chosen.until_sec >= 0:
        ends.append(round(chosen.until_sec * _NS))
    if chosen.until_nsec is not None and chosen.until_nsec >= 0:
        ends.append(chosen.until_nsec)
    return max(ends, default=None)


def _check(options: PlayOptions) -> None:
    """Refuse options that are invalid or contradict each other.

    Raises:
        OptionError: Names the option.
    """
    if not (math.isfinite(options.rate) and options.rate > 0):
        raise OptionError(f"`rate` {options.rate:g} is not greater than 0.")
    for name, seconds in (
        ("start_offset", options.start_offset),
        ("duration", options.duration or 0.0),
        ("delay", options.delay),
        ("skip_empty", options.skip_empty or 0.0),
        ("rate_control_max_delay", options.rate_control_max_delay),
    ):
        if not (math.isfinite(seconds) and seconds >= 0):
            raise OptionError(f"`{name}` {seconds:g} is not a number of seconds, 0 or more.")
    if options.clock is not None and not 0 < options.clock <= 10_000:
        raise OptionError(f"`clock` {options.clock:g} is not a rate from 0 to 10000 Hz.")
    if options.until_sec is not None and not math.isfinite(options.until_sec):
        raise OptionError(f"`until_sec` {options.until_sec:g} is not a number of seconds.")
    if options.clock_topics and options.clock_topics_all:
        raise OptionError("`clock_topics` contradicts `clock_topics_all`.")
    for name, given in (
        ("clock_topics", bool(options.clock_topics)),
        ("clock_topics_all", options.clock_topics_all),
    ):
        if given and options.clock is not None:
            raise OptionError(f"`{name}` contradicts `clock`, which publishes at a fixed rate.")
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
                    f"`{name}` contradicts `follow_clock`: another player's clock sets the pace."
                )
