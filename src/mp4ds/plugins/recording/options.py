"""The options of a recorder, and the topics that they choose."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from mp4ds.errors import OptionError
from mp4ds.options import (
    WHAT,
    Parsed,
    Selection,
    about,
    force,
    option,
    parse_size,
    pattern,
)
from mp4ds.plugins.ros.node import SERVICE_EVENTS, NodeOptions
from mp4ds.video.codecs import LOSSLESS, MAX_GOP, QualitySetting, parse_quality


def _parse_duration(value: str | float) -> float:
    """Seconds of ``90``, ``90s``, ``5m`` or ``2h``."""
    text = str(value)
    factor = {"s": 1, "m": 60, "h": 3600}.get(text[-1:])
    try:
        seconds = float(text[:-1] if factor else text) * (factor or 1)
    except ValueError:
        raise OptionError(f"{value!r} is no duration: give seconds, 5m or 2h.") from None
    if not 0 <= seconds < 1e9:
        raise OptionError(f"{seconds:.15g} is not from 0 to 999999999 seconds.")
    return seconds


@dataclass(frozen=True, kw_only=True)
class RecordOptions(NodeOptions):
    """How to record."""

    all: bool = option(
        "Record all topics, including new ones, and all service events (ROS 2).",
        False,
        "-a",
        panel=WHAT,
    )
    all_topics: bool = option("Record all topics, but no service events.", False, panel=WHAT)
    all_services: bool = option("Record all service events (ROS 2).", False, panel=WHAT)
    topic_types: Sequence[str] = option(
        "Record topics of this type; repeatable.", (), metavar="TYPE", panel=WHAT
    )
    regex: Parsed[re.Pattern[str] | None] = pattern(
        "Record topics whose name matches a regular expression.", "-e"
    )
    exclude: Sequence[str] = option(
        "Leave out topics that match; repeatable.", (), "--exclude", metavar="GLOB", panel=WHAT
    )
    exclude_topic_types: Sequence[str] = option(
        "Leave out topics of this type; repeatable.", (), metavar="TYPE", panel=WHAT
    )
    exclude_regex: Parsed[re.Pattern[str] | None] = pattern(
        "Leave out topics whose name matches a regular expression.", "--exclude-regex", "-x"
    )
    of_node: str | None = option(
        "Record the topics that this node subscribes to (ROS 1).",
        None,
        "--node",
        panel=WHAT,
        only=("ros1",),
    )
    limit: int | None = option(
        "Record at most N messages of each topic; stop when all topics have them.",
        None,
        "-l",
        panel=WHAT,
        least=1,
    )
    duration: Parsed[float | None] = option(
        "Stop after this long: seconds, 5m or 2h.",
        None,
        "--duration",
        panel=WHAT,
        metavar="SECONDS",
        parse=_parse_duration,
    )
    max_duration: Parsed[float | None] = option(
        "Start a new dataset after this many seconds, 5m or 2h; 0: never.",
        None,
        "--max-bag-duration",
        "-d",
        panel=WHAT,
        metavar="SECONDS",
        parse=_parse_duration,
    )
    max_size: Parsed[int | None] = option(
        "Start a new dataset at this size, such as 4G.",
        None,
        "--max-size",
        "--max-bag-size",
        metavar="SIZE",
        parse=parse_size,
        panel=WHAT,
    )
    max_splits: int | None = option(
        "Keep at most N datasets; delete the oldest ones of this recorder.",
        panel=WHAT,
        least=1,
    )
    repeat_latched: bool = option(
        "Begin each dataset after a split with the latest latched messages.", False, panel=WHAT
    )
    min_space: Parsed[int | None] = option(
        "Stop when the file system has less free space than this, such as 1G.",
        None,
        "-L",
        metavar="SIZE",
        parse=parse_size,
    )
    keep_last: Parsed[float | None] = option(
        "Keep only the last seconds (60s, 5m), and save them as a dataset at each trigger.",
        None,
        "--keep-last",
        panel=WHAT,
        metavar="SECONDS",
        parse=_parse_duration,
    )
    and_then: Parsed[float | None] = option(
        "Also save this many seconds after a trigger.",
        None,
        "--and-then",
        panel=WHAT,
        metavar="SECONDS",
        parse=_parse_duration,
    )
    trigger: Sequence[str] = option(
        "Save at each message on this topic, recorded or not; with a condition, such as "
        "'/battery:percentage<0.2', whenever it becomes true. Repeatable.",
        (),
        metavar="TOPIC[:FIELD>VALUE]",
        panel=WHAT,
    )
    buffer: int = option(
        "Buffer size in MB; when the buffer is full, the oldest messages are dropped and counted.",
        256,
        "--buffsize",
        "-b",
        least=1,
        most=1_000_000,
    )
    quality: Parsed[QualitySetting] = option(
        "lossless, visual or crf=N.", LOSSLESS, parse=parse_quality
    )
    codec: str | None = option("As in pack; default: the fastest to encode.")
    preset: str | None = option("Encoder preset; default: the fastest.")
    gop: int | None = option(
        "Maximum key frame interval in frames; default: 10, or 30 if lossy.",
        least=1,
        most=MAX_GOP,
    )
    start_paused: bool = option("Start paused.", False, "--start-paused", "--pause", panel=WHAT)
    use_sim_time: bool = option("Take log times from /clock, and wait for it.", False)
    node: str | None = option(
        "Node name; default: that of ROS's own recorder.", None, "--node-name"
    )
    discover: bool = option("Keep looking for new topics.", True, "--discovery/--no-discovery")
    polling_interval: float = option(
        "Milliseconds between two checks for new topics.", 100.0, "--polling-interval", "-p"
    )
    hidden: bool = option(
        "Include hidden topics (ROS 2).", False, "--include-hidden-topics", panel=WHAT
    )
    unpublished: bool = option(
        "Include topics without a publisher (ROS 2, with rclpy).",
        False,
        "--include-unpublished-topics",
        panel=WHAT,
    )
    ignore_leaf: bool = option(
        "Leave out topics without a subscriber.", False, "--ignore-leaf-topics", panel=WHAT
    )
    custom_data: Sequence[str] = option(
        "Entry for custom_data of the rosbag2 metadata (ROS 2); repeatable.",
        (),
        metavar="KEY=VALUE",
    )
    prefix: str = option(
        "What comes before the time in the name of a dataset that is not named.",
        "mp4ds",
        "--output-prefix",
    )
    about: str | None = about()
    force: bool = force()


class Wanted:
    """Which topics are recorded: all that an option or `topics` includes, and none excludes.

    Args:
        topics: Names or globs. As in `rosbag record`, a topic is subscribed to under the name that
            the node's remappings give it, and recorded under the name given here.
        options: The others.

    Attributes:
        by_node: Topics that the node of the option of this name subscribes to.

    Raises:
        OptionError: Nothing is chosen, a pattern is not valid, or two topics are remapped to the
            same one.
    """

    def __init__(self, topics: Sequence[str], options: RecordOptions) -> None:
        is_all = options.all or options.all_topics or options.all_services
        if not (topics or is_all or options.regex or options.topic_types or options.of_node):
            raise OptionError("Name topics, or give `all`, `regex` or `topic_types`.")
        names = options.names
        self.by_node: frozenset[str] = frozenset()
        self._recorded: dict[str, str] = {}
        for topic in topics:
            asked = names.resolved(topic.strip())
            first = self._recorded.setdefault(names.renamed(asked), asked)
            if first != asked:
                raise OptionError(
                    f"{first} and {asked} are the same topic after remapping: name one of them."
                )
        self._named = Selection([*self._recorded]) if topics else None
        self._left_out = Selection((), [names.resolved(topic.strip()) for topic in options.exclude])
        self._options = options

    def __call__(self, topic: str, type_name: str = "") -> bool:
        """Whether a topic is recorded."""
        options = self._options
        if not self._left_out(topic) or type_name in options.exclude_topic_types:
            return False
        if options.exclude_regex and options.exclude_regex.search(topic):
            return False
        is_service = topic.endswith(SERVICE_EVENTS)
        if options.all or (options.all_services if is_service else options.all_topics):
            return True
        is_named = self._named is not None and self._named(topic)
        is_found = options.regex is not None and options.regex.search(topic) is not None
        is_of_node = topic in self.by_node
        return is_named or is_found or is_of_node or type_name in options.topic_types

    @property
    def due(self) -> frozenset[str]:
        """Topics that were named, not by a pattern, as they are recorded."""
        return frozenset(name for name in self._recorded.values() if not set(name) & set("*?["))

    def recorded_as(self, topic: str) -> str:
        """The name under which a topic is recorded."""
        return self._recorded.get(topic, topic)
