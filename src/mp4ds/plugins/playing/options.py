"""The options of a player, and the topics that they choose."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from mp4ds.errors import OptionError
from mp4ds.options import (
    WHAT,
    Parsed,
    Selection,
    jpeg_quality,
    option,
    parse_number,
    pattern,
    seconds,
    what,
    where,
)
from mp4ds.plugins.ros.node import CLOCK, NodeOptions
from mp4ds.unpacking.pictures import FrameOptions

KINDS = {"raw": "raw", "compressed": "jpeg", "ffmpeg": "ffmpeg"}
"""Transport that cameras are published as -> kind of image in `mp4ds.unpacking`."""

_IMMEDIATE_WAIT_S = 2.0


def _parse_rate(value: str | float) -> float:
    rate = parse_number(value)
    if not 0 < rate < math.inf:
        raise OptionError(f"{value} is not greater than 0.")
    return rate


def rooted(topic: str) -> str:
    """The name of a topic with its leading slash, which users may leave out."""
    return "/" + topic.strip().lstrip("/")


@dataclass(frozen=True, kw_only=True)
class PlayOptions(FrameOptions, NodeOptions):
    """How to play datasets back."""

    exclude: Sequence[str] = what(
        "Leave out matching topics.", (), *("--exclude", "--exclude-topics", "-x"), metavar="GLOB"
    )
    rate: Parsed[float] = option(
        "Playback rate; 2 is twice as fast.", 1.0, "-r", metavar="FACTOR", parse=_parse_rate
    )
    start_offset: Parsed[float] = seconds(
        "Start this many seconds into the recording.",
        0.0,
        *("--start-offset", "--start", "-s"),
        panel=WHAT,
    )
    duration: Parsed[float | None] = seconds(
        "Play only this many seconds.",
        None,
        *("--duration", "--playback-duration", "-u"),
        panel=WHAT,
    )
    until_sec: float | None = what(
        "Play until this time, in seconds since 1970, or for `duration`, whichever is later.",
        None,
        "--playback-until-sec",
    )
    until_nsec: int | None = what(
        "Play until this time, in nanoseconds since 1970.", None, "--playback-until-nsec"
    )
    loop: bool = option("Loop playback.", False, "-l")
    keep_alive: bool = option("Keep running at the end, for late subscribers.", False, "-k")
    delay: Parsed[float] = seconds(
        "Seconds to wait before playing; in ROS 2, before each loop.", 0.0, "-d"
    )
    paused: bool = option("Start paused.", False, "--pause", "--start-paused", "-p")
    regex: Parsed[re.Pattern[str] | None] = pattern(
        "Only topics that fully match a regular expression, and those of `topics`.", "-e"
    )
    exclude_regex: Parsed[re.Pattern[str] | None] = pattern(
        "Leave out topics that fully match a regular expression."
    )
    remap: Sequence[str] = where("Rename a topic; repeatable.", (), "-m", metavar="OLD:=NEW")
    prefix: str = where("Prefix for all topics that are not remapped.", "")
    clock: float | None = option(
        "Publish /clock, at this rate if one is given; default: 100, or 40 with --ros2.",
        None,
        "--clock",
        "--hz",
        metavar="[HZ]",
    )
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
    skip_empty: Parsed[float | None] = seconds(
        "Skip gaps between messages that are longer than this.", panel=WHAT
    )
    pause_topics: Sequence[str] = option(
        "Pause before each message on these topics.", (), metavar="TOPIC"
    )
    rate_control_topic: str = option(
        "Wait when playback gets too far ahead of the header stamps on this topic (ROS 1).",
        "",
        metavar="TOPIC",
        only=("ros1",),
    )
    rate_control_max_delay: Parsed[float] = seconds(
        "Seconds that playback may be ahead of `rate_control_topic`.", 1.0
    )
    wait_for_subscribers: bool = option("Wait for a subscriber on each topic first.", False)
    wait_for_all_acked: int | None = option(
        "At the end, wait this many milliseconds at most for subscribers to acknowledge all "
        "messages; 0: wait forever (ROS 2).",
        None,
        metavar="MS",
        least=0,
        only=("ros2",),
    )
    queue: int = option(
        "Outgoing queue per subscriber, in messages; 0: no limit but 128 MiB (ROS 1).",
        0,
        least=0,
        only=("ros1",),
    )
    publish_as: str | None = option(
        "Publish cameras as raw, compressed (JPEG) or ffmpeg (video packets); "
        "default: as recorded.",
        choices=KINDS,
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
    lock_step: str = option(
        "Publish the next frame only after a message on this topic.", "", metavar="TOPIC"
    )

    def __post_init__(self) -> None:
        """Refuse options that are invalid or contradict each other."""
        super().__post_init__()
        _ = self.rules
        if self.clock is not None and not 0 < self.clock <= 10_000:
            raise OptionError(f"`clock` {self.clock:g} is not a rate above 0 and up to 10000 Hz.")
        if self.until_sec is not None and not math.isfinite(self.until_sec):
            raise OptionError(f"`until_sec` {self.until_sec:g} is not a number of seconds.")
        clocks = {
            "clock": self.clock is not None,
            "clock_topics": bool(self.clock_topics),
            "clock_topics_all": self.clock_topics_all,
        }
        given = [name for name, is_given in clocks.items() if is_given]
        if len(given) > 1:
            raise OptionError(f"`{given[-1]}` contradicts `{given[0]}`: choose one.")
        others = {"rate": self.rate != 1.0, "immediate": self.immediate}
        given += [name for name, is_given in others.items() if is_given]
        if self.follow_clock and given:
            raise OptionError(
                f"`{given[0]}` contradicts `follow_clock`: another player's clock sets the pace."
            )

    @property
    def parting_s(self) -> float | None:
        """How long to wait at the end for acknowledgements; 0 was given for ever."""
        patience = self.wait_for_all_acked
        return None if patience is None else patience / 1000 or math.inf

    @property
    def wait_s(self) -> float:
        """How long to wait for a subscriber with a full queue."""
        return _IMMEDIATE_WAIT_S if self.immediate else 0.0

    @property
    def leads(self) -> bool:
        """Whether it publishes /clock."""
        return self.clock is not None or bool(self.clock_topics) or self.clock_topics_all

    @cached_property
    def rules(self) -> Mapping[str, str]:
        """What `remap` says: old names, from the root on, and new ones."""
        rules = {}
        for rule in self.remap:
            old, found, new = rule.partition(":=")
            if not (found and old.strip("/ ") and new.strip("/ ")):
                raise OptionError(
                    f"`remap` {rule!r} is not a remapping; write it as /old/topic:=/new/topic."
                )
            rules[rooted(old)] = new
        return rules

    def renamed(self, topic: str) -> str:
        """The name that a topic is published under: by `remap` or else `prefix`, then by `names`.

        Rules of `names` may be for topics that are not played.
        """
        new = self.rules.get(rooted(topic))
        if new is None:
            prefix = self.prefix.rstrip("/")
            new = f"{prefix}/{topic.lstrip('/')}" if prefix else topic
        return self.names.renamed(new)

    def wants(self, topic: str) -> bool:
        """Whether a topic is played: it is excluded by nothing, and included by something.

        That is `topics` or `regex`; without both, all are. A recorded /clock is not played beside
        another one.
        """
        has_clock = self.leads or self.follow_clock
        if not Selection((), self.exclude)(topic) or (topic == CLOCK and has_clock):
            return False
        if self.exclude_regex and self.exclude_regex.fullmatch(topic):
            return False
        if self.regex and self.regex.fullmatch(topic):
            return True
        return bool(self.topics or not self.regex) and self.selected(topic)

    def check_topics(self, topics: Sequence[str]) -> None:
        """Refuse patterns that match no topic.

        Raises:
            OptionError: Names the pattern and the topics of the recording.
        """
        self.selected.check(topics)
        for name, regex in (("regex", self.regex), ("exclude_regex", self.exclude_regex)):
            if regex is not None and not any(map(regex.fullmatch, topics)):
                raise OptionError(
                    f"`{name}` {regex.pattern!r} fully matches no topic; use .* for any text, as "
                    "in '.*camera.*'."
                )
