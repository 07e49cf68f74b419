"""Where a recorder gets its messages from, and which topics it records."""

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
        names: Namespace and remappings of the node. As in `rosbag record`, a topic is subscribed
            to under its new name and recorded under the name given here.

    Raises:
        OptionError: A pattern is not valid, or two topics are remapped to the same one.
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
                    f"{first} and {asked} are the same topic after remapping: name one of them."
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
        """The name under which a topic is recorded."""
        return self._recorded.get(topic, topic)


def _compiled(option: str, pattern: str) -> re.Pattern[str] | None:
    try:
        return re.compile(pattern) if pattern else None
    except re.error as error:
        raise OptionError(
            f"`{option}` {pattern!r} is not a valid regular expression: {error}."
        ) from None


@dataclass
class SourceState:
    """State of a source, updated by its own threads.

    Attributes:
        lost: Messages lost, as reported by the middleware, by topic.
        warnings: Sentences, each to be shown once.
        topics: Topics subscribed to, with their channel if it is known before the first message.
        waiting_for: The clock topic that the recording waits for; empty once the clock runs.
    """

    lost: Counter[str] = field(default_factory=Counter)
    warnings: dict[str, None] = field(default_factory=dict)
    topics: dict[str, Channel | None] = field(default_factory=dict)
    waiting_for: str = ""

    def warn(self, sentence: str) -> None:
        """Add a warning."""
        self.warnings[sentence] = None


def told(state: SourceState, topic: str, receive: Callable[..., None]) -> Callable[..., None]:
    """A callback for middlewares, which swallow, or crash on, what a callback raises.

    Args:
        state: Where to count each message that could not be recorded.
        topic: The topic of the messages.
        receive: Records a message.
    """

    def call(*message: Any) -> None:
        try:
            receive(*message)
        except Exception as error:
            state.lost[topic] += 1
            state.warn(f"{topic}: a message could not be recorded: {error!r}")

    return call


class RecorderControls(Protocol):
    """What remote controls (services, keys) may do to a recorder."""

    @property
    def is_paused(self) -> bool:
        """Whether it is paused."""
        ...

    def pause(self) -> None:
        """Pause: ignore messages from now on."""
        ...

    def resume(self) -> None:
        """Resume after a pause."""
        ...

    def split(self) -> None:
        """Start a new dataset."""
        ...

    def stop(self) -> None:
        """Stop, and complete the dataset."""
        ...


class Source(Protocol):
    """Receives the messages of wanted topics, including topics that appear later.

    Attributes:
        format: The format of ROS's own recorder: ``bag`` or ``rosbag2``.
        profile: ``ros1`` or ``ros2``.
        address: What it is connected to, to be displayed.
        state: Its state.
    """

    format: Format
    profile: str
    address: str
    state: SourceState

    def start(self, wanted: Wanted, take: Callable[[Message], None]) -> None:
        """Start receiving, in threads of its own.

        With a simulated time, it subscribes to topics only once /clock has published a time, as
        `ros2 bag record` does: earlier messages would have none, and latched ones still arrive.

        Args:
            wanted: Which topics to receive.
            take: Called with each message, from any thread; it does not block. Each channel has an
                id of its own.

        Raises:
            PublishError: The middleware refuses.
        """
        ...

    def serve(self, controls: RecorderControls) -> None:
        """Offer the services of `ros2 bag record` (ROS 2)."""
        ...

    def close(self) -> None:
        """Stop receiving."""
        ...


@dataclass(frozen=True, slots=True)
class SourceOptions:
    """How a source receives.

    Attributes:
        node: Name of the node, if `names` has none.
        use_sim_time: Whether log times are those of /clock.
        poll_s: Seconds between two checks for new topics; None to check only once.
        hidden: Whether to include hidden topics (ROS 2).
        unpublished: Whether to include topics without a publisher (rclpy).
        ignore_leaf: Whether to leave out topics without a subscriber (ROS 2).
        qos_overrides: YAML file of QoS profiles by topic.
        names: Name, namespace and remappings of the node.
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
    """Open a source.

    Args:
        kind: ``ros1`` or ``ros2``; ROS 2 is rclpy if a ROS 2 is sourced, else Cyclone DDS.
        options: How to receive.

    Raises:
        PublishError: The middleware is not installed, or cannot be reached.
    """
    if kind == "ros2" and find_spec("rclpy") is None:
        kind = "dds"
    module, _, name = _SOURCES[kind].partition(":")
    made: Source = getattr(import_module(f"mp4ds.plugins.recording.{module}"), name)(options)
    return made
