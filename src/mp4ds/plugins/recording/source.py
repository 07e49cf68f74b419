"""What a recorder gets its messages from, and which topics it wants."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

from mp4ds.bags.protocols import Format
from mp4ds.errors import OptionError
from mp4ds.plan import Selection
from mp4ds.plugins.publishing.names import PLAIN, SERVICE_EVENTS, NodeNames
from mp4ds.records import Channel, Message


class Wanted:
    """Which topics are recorded.

    Those that one of `topics`, `types`, `regex`, `all_topics` and `all_services` includes, or all
    if none of these is given, except for those that are excluded.

    Args:
        topics: Names or globs.
        types: Names of message types.
        regex: A pattern, searched for in the topic's name; empty for none.
        all_topics: Include all topics but those of service events.
        all_services: Include those of service events (ROS 2).
        exclude: Names or globs.
        exclude_types: Names of message types.
        exclude_regex: A pattern, searched for in the topic's name; empty for none.
        names: Namespace of the node, and rules for the names of `topics`: as `rosbag record` does,
            the recorder subscribes to a topic by its new name, and records it by the one given
            here.

    Raises:
        OptionError: A pattern is not valid, or the rules make one topic of two.
    """

    def __init__(
        self,
        topics: Sequence[str] = (),
        *,
        types: Sequence[str] = (),
        regex: str = "",
        all_topics: bool = False,
        all_services: bool = False,
        exclude: Sequence[str] = (),
        exclude_types: Sequence[str] = (),
        exclude_regex: str = "",
        names: NodeNames = PLAIN,
    ) -> None:
        self._recorded: dict[str, str] = {}
        for topic in topics:
            asked = names.resolved(topic.strip())
            first = self._recorded.setdefault(names.renamed(asked), asked)
            if first != asked:
                raise OptionError(
                    f"{first} and {asked} are one topic by the rules of ROS: name one."
                )
        self._named = Selection([*self._recorded]) if topics else None
        self._types = {*types}
        self._regex = _compiled("regex", regex)
        is_all = not (topics or types or regex or all_topics or all_services)
        self._all_topics, self._all_services = all_topics or is_all, all_services or is_all
        left_out = [names.resolved(topic.strip()) for topic in exclude]
        self._exclude = Selection(left_out) if exclude else None
        self._exclude_types = {*exclude_types}
        self._exclude_regex = _compiled("exclude_regex", exclude_regex)

    def __call__(self, topic: str, type_name: str = "") -> bool:
        """Whether a topic is recorded."""
        if self._exclude and self._exclude(topic):
            return False
        if self._exclude_regex and self._exclude_regex.search(topic):
            return False
        if type_name in self._exclude_types:
            return False
        if self._all_services if topic.endswith(SERVICE_EVENTS) else self._all_topics:
            return True
        is_named = self._named is not None and self._named(topic)
        is_found = self._regex is not None and self._regex.search(topic) is not None
        return is_named or is_found or type_name in self._types

    def recorded_as(self, topic: str) -> str:
        """The name that a topic has in the recording."""
        return self._recorded.get(topic, topic)


def _compiled(option: str, pattern: str) -> re.Pattern[str] | None:
    try:
        return re.compile(pattern) if pattern else None
    except re.error as error:
        raise OptionError(f"`{option}` {pattern!r} is not a valid pattern: {error}.") from None


@dataclass
class SourceState:
    """What a source tells besides its messages; written by its own threads.

    Attributes:
        lost: Messages that the middleware says it lost, by topic.
        warnings: Sentences to be shown once each.
        topics: Those that are subscribed to; with the channel, where that is known before messages
            come.
        waiting_for: The clock without which nothing is recorded yet; empty once it runs.
    """

    lost: Counter[str] = field(default_factory=Counter)
    warnings: dict[str, None] = field(default_factory=dict)
    topics: dict[str, Channel | None] = field(default_factory=dict)
    waiting_for: str = ""


def told(state: SourceState, topic: str, receive: Callable[..., None]) -> Callable[..., None]:
    """What middlewares are to call: they keep to themselves, or die of, what a callback raises.

    Args:
        state: Told of each message that could not be taken.
        topic: Of the messages.
        receive: Takes a message.
    """

    def call(*message: Any) -> None:
        try:
            receive(*message)
        except Exception as error:
            state.lost[topic] += 1
            state.warnings[f"{topic}: a message could not be taken: {error!r}"] = None

    return call


class RecorderControls(Protocol):
    """What others may ask of a recorder."""

    @property
    def is_paused(self) -> bool:
        """Whether messages are left out."""
        ...

    def pause(self) -> None:
        """Leave out what comes from now on."""
        ...

    def resume(self) -> None:
        """Record again."""
        ...

    def split(self) -> None:
        """Begin another dataset."""
        ...

    def stop(self) -> None:
        """Stop, and finish what was recorded."""
        ...


class Source(Protocol):
    """Receives messages of the topics that are wanted, those that appear later too.

    Attributes:
        format: What its messages would have been recorded as by ROS's own recorder.
        profile: ``ros1`` or ``ros2``.
        address: Where it listens, for users.
        state: What it tells.
    """

    format: Format
    profile: str
    address: str
    state: SourceState

    def start(self, wanted: Wanted, take: Callable[[Message], None]) -> None:
        """Begin to receive, on threads of its own.

        With a simulated time, as `ros2 bag record` does, it subscribes to nothing else until
        /clock tells one: what came before would have no time, and what is latched still comes.

        Args:
            wanted: Which topics.
            take: Called with each message, from any thread; it never waits. A channel has one id,
                and another id than all others.

        Raises:
            PublishError: The middleware refuses.
        """
        ...

    def serve(self, controls: RecorderControls) -> None:
        """Offer the services of `ros2 bag record`, in ROS 2."""
        ...

    def close(self) -> None:
        """Receive nothing more."""
        ...


@dataclass(frozen=True, slots=True)
class SourceOptions:
    """How a source receives.

    Attributes:
        node: Name of the node.
        use_sim_time: Whether log times are those of /clock.
        poll_s: Seconds between looks for new topics; None for one look only.
        hidden: Whether topics are taken of which a part begins with an underscore.
        unpublished: Whether topics are taken that nobody publishes yet, by rclpy.
        ignore_leaf: Whether topics without a subscriber are left out, in ROS 2.
        qos_overrides: YAML of QoS by topic.
        names: What ROS calls the node, where it is not `node`, and /clock.
    """

    node: str
    use_sim_time: bool = False
    poll_s: float | None = 0.1
    hidden: bool = False
    unpublished: bool = False
    ignore_leaf: bool = False
    qos_overrides: Path | None = None
    names: NodeNames = PLAIN


_SOURCES: Mapping[str, str] = {
    "ros1": "ros1:RospySource",
    "ros2": "ros2:RclpySource",
    "dds": "dds:DdsSource",
}


def open_source(kind: str, options: SourceOptions) -> Source:
    """A source.

    Args:
        kind: ``ros1`` or ``ros2``; for ROS 2 that is Cyclone DDS where no ROS 2 is sourced.
        options: How it receives.

    Raises:
        PublishError: The middleware is not there.
    """
    if kind == "ros2" and find_spec("rclpy") is None:
        kind = "dds"
    module, _, name = _SOURCES[kind].partition(":")
    made: Source = getattr(import_module(f"mp4ds.plugins.recording.{module}"), name)(options)
    return made
