"""The options of a recorder, the topics that they choose, and those that trigger it."""

from __future__ import annotations

import operator
import re
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mp4ds.bags.convert import decoder_of
from mp4ds.bags.types import FieldShape, field_shape, fields_of, name_of, standard_of, types_of
from mp4ds.errors import OptionError, Refused
from mp4ds.options import (
    WHAT,
    Parsed,
    Selection,
    about,
    force,
    option,
    parse_size,
    pattern,
    seconds,
    what,
)
from mp4ds.plugins.ros.node import SERVICE_EVENTS, NodeOptions
from mp4ds.records import Channel
from mp4ds.video.codecs import LOSSLESS, MAX_GOP, QualitySetting, parse_quality


@dataclass(frozen=True, kw_only=True)
class RecordOptions(NodeOptions):
    """How to record."""

    all: bool = what(
        "Record all topics, including new ones, and all service events (ROS 2).", False, "-a"
    )
    all_topics: bool = what("Record all topics, but no service events.", False)
    all_services: bool = what("Record all service events (ROS 2).", False)
    topic_types: Sequence[str] = what("Record topics of this type; repeatable.", (), metavar="TYPE")
    regex: Parsed[re.Pattern[str] | None] = pattern(
        "Record topics whose name matches a regular expression.", "-e"
    )
    exclude: Sequence[str] = what(
        "Leave out topics that match; repeatable.", (), "--exclude", metavar="GLOB"
    )
    exclude_topic_types: Sequence[str] = what(
        "Leave out topics of this type; repeatable.", (), metavar="TYPE"
    )
    exclude_regex: Parsed[re.Pattern[str] | None] = pattern(
        "Leave out topics whose name matches a regular expression.", "--exclude-regex", "-x"
    )
    of_node: str | None = what(
        "Record the topics that this node subscribes to (ROS 1).", None, "--node", only=("ros1",)
    )
    limit: int | None = what(
        "Record at most N messages of each topic; stop when all topics have them.",
        None,
        "-l",
        least=1,
    )
    duration: Parsed[float | None] = seconds(
        "Stop after this long: seconds, 5m or 2h.", None, "--duration", panel=WHAT
    )
    max_duration: Parsed[float | None] = seconds(
        "Start a new dataset after this many seconds, 5m or 2h; 0: never.",
        None,
        "--max-bag-duration",
        "-d",
        panel=WHAT,
    )
    max_size: Parsed[int | None] = what(
        "Start a new dataset at this size, such as 4G.",
        None,
        "--max-size",
        "--max-bag-size",
        metavar="SIZE",
        parse=parse_size,
    )
    max_splits: int | None = what(
        "Keep at most N datasets; delete the oldest ones of this recorder.", least=1
    )
    repeat_latched: bool = what(
        "Begin each dataset after a split with the latest latched messages.", False
    )
    min_space: Parsed[int | None] = option(
        "Stop when the file system has less free space than this, such as 1G.",
        None,
        "-L",
        metavar="SIZE",
        parse=parse_size,
    )
    keep_last: Parsed[float | None] = seconds(
        "Keep only the last seconds (60s, 5m), and save them as a dataset at each trigger.",
        None,
        "--keep-last",
        panel=WHAT,
    )
    and_then: Parsed[float | None] = seconds(
        "Also save this many seconds after a trigger.", None, "--and-then", panel=WHAT
    )
    trigger: Sequence[str] = what(
        "Save at each message on this topic, recorded or not; with a condition, such as "
        "'/battery:percentage<0.2', whenever it becomes true. Repeatable.",
        (),
        metavar="TOPIC[:FIELD>VALUE]",
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
        "Maximum key frame interval in frames; default: 10, or 30 if lossy.", least=1, most=MAX_GOP
    )
    start_paused: bool = what("Start paused.", False, "--start-paused", "--pause")
    use_sim_time: bool = option("Take log times from /clock, and wait for it.", False)
    node: str | None = option(
        "Node name; default: that of ROS's own recorder.", None, "--node-name"
    )
    discover: bool = option("Keep looking for new topics.", True, "--discovery/--no-discovery")
    polling_interval: float = option(
        "Milliseconds between two checks for new topics.", 100.0, "--polling-interval", "-p"
    )
    hidden: bool = what("Include hidden topics (ROS 2).", False, "--include-hidden-topics")
    unpublished: bool = what(
        "Include topics without a publisher (ROS 2, with rclpy).",
        False,
        "--include-unpublished-topics",
    )
    ignore_leaf: bool = what(
        "Leave out topics without a subscriber.", False, "--ignore-leaf-topics"
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


# ---------------------------------------------------------------- triggers

_STEP = r"[A-Za-z_]\w*(?:\[\d+\])?"
_TRIGGER = re.compile(
    rf"\s*(?P<topic>[^\s:]+)\s*"
    rf"(?::\s*(?P<field>{_STEP}(?:\.{_STEP})*)\s*(?P<sign>[<>]=?|[=!]=)\s*(?P<value>\S.*?)\s*)?",
    re.ASCII,
)
_SIGNS: Mapping[str, Callable[[Any, Any], bool]] = {
    ">=": operator.ge,
    "<=": operator.le,
    "==": operator.eq,
    "!=": operator.ne,
    ">": operator.gt,
    "<": operator.lt,
}


class Trigger:
    """A topic, and perhaps a condition on a field of its messages.

    Args:
        text: ``TOPIC``, or ``TOPIC:FIELD>VALUE`` with one of > >= < <= == !=; a field may be
            nested, ``a.b``, and an element of an array, ``a[0]``.

    Attributes:
        topic: As written.

    Raises:
        OptionError: It is neither.
    """

    def __init__(self, text: str) -> None:
        match = _TRIGGER.fullmatch(text)
        if match is None:
            raise OptionError(
                f"`trigger` {text!r} is neither TOPIC nor TOPIC:FIELD>VALUE, with one of "
                f"{' '.join(_SIGNS)}, such as /battery:percentage<0.2"
            )
        self.topic: str = match["topic"]
        self._field, self._sign, self._value = match["field"], match["sign"], match["value"]
        self._is_met = False

    def watch(self, channel: Channel) -> Callable[[bytes], bool]:
        """What tells of each message of a channel whether it triggers.

        A condition triggers when it becomes true; before the first message it is false. It is also
        false where an array has no such element.

        Raises:
            Refused: Messages of this type have no such field, or it cannot be compared so.
        """
        if self._field is None:
            return lambda _: True
        steps = []  # the name of each field, and the number of its element
        for text in self._field.split("."):
            name, _, index = text.rstrip("]").partition("[")
            steps.append((name, int(index) if index else None))
        shape = self._shape(channel, steps)
        value = self._compared(shape)
        compare = _SIGNS[self._sign]
        try:
            decode = decoder_of(channel)
        except OptionError as error:
            raise Refused(str(error)) from None

        def is_triggered(data: bytes) -> bool:
            was_met = self._is_met
            try:
                found = decode(memoryview(data))
                for name, index in steps:
                    found = getattr(found, name)
                    found = found if index is None else found[index]
                self._is_met = bool(compare(found, value))
            except (IndexError, Refused):
                self._is_met = False
            return self._is_met and not was_met

        return is_triggered

    def _shape(self, channel: Channel, steps: list[tuple[str, int | None]]) -> FieldShape:
        """That of the field.

        Raises:
            Refused: There is no such field, or it has no single value.
        """
        if channel.schema is None:
            raise Refused("the type of its messages is not known")
        types = types_of(channel.schema, standard_of(channel.message_encoding))
        kind, shape = name_of(channel.schema), None
        for name, index in steps:
            fields = dict(fields_of(types, kind)) if kind else {}
            if name not in fields:
                known = f"a {kind} has {', '.join(fields) or 'no fields'}" if kind else "no message"
                raise Refused(f"there is no field {name!r}: {known}")
            shape = field_shape(fields[name])
            if shape.is_several and index is None:
                raise Refused(f"{name} is an array: choose an element, such as {name}[0]")
            if index is not None and not shape.is_several:
                raise Refused(f"{name} is no array")
            if index is not None and shape.length is not None and index >= shape.length:
                raise Refused(f"{name} has {shape.length} elements, [0] to [{shape.length - 1}]")
            kind = shape.message
        if shape is None or kind:
            parts = ", ".join(f"{self._field}.{name}" for name, _ in fields_of(types, kind))
            raise Refused(f"{self._field} is a {kind}: choose one of its fields, {parts}")
        return shape

    def _compared(self, shape: FieldShape) -> Any:
        """The value, as one of the field.

        Raises:
            Refused: It is none, or there is no order.
        """
        text = self._value
        is_ordered = shape.base != "bool" and "string" not in shape.base
        if not is_ordered and self._sign not in ("==", "!="):
            raise Refused(f"{self._field} is a {shape.base}: compare it with == or !=")
        if "string" in shape.base:
            is_quoted = len(text) > 1 and text[0] == text[-1] and text[0] in "'\""
            return text[1:-1] if is_quoted else text
        problem = f"{self._field} is a {shape.base}, which {text!r} is not"
        try:
            if shape.base == "bool":
                return {"true": True, "false": False}[text.lower()]
            if re.fullmatch(r"[+-]?\d+", text):
                return int(text)
            value = float(text)
            is_single = shape.base == "float32"  # where 0.1 is another number
            return struct.unpack("f", struct.pack("f", value))[0] if is_single else value
        except (KeyError, ValueError, OverflowError):
            raise Refused(problem) from None
