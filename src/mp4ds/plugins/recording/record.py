"""A live robot -> datasets: messages are written to disk as they arrive, and packed beside."""

from __future__ import annotations

import os
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path

from mp4ds.bags.rosbag2_metadata import METADATA_FILE, NEWEST_VERSION, RECORD, dump_bag_info
from mp4ds.errors import Mp4dsError, OptionError, Refused
from mp4ds.files.outputs import sync
from mp4ds.files.sources import UNFINISHED, is_unfinished, salvage_command
from mp4ds.format.sidecars import load_about
from mp4ds.packing.options import PackSummary
from mp4ds.plugins.recording.options import RecordOptions, Wanted
from mp4ds.plugins.recording.spool import Split
from mp4ds.plugins.ros.node import (
    CLOCK,
    Node,
    Service,
    action,
    chosen_world,
    open_node,
    quick_switches,
)
from mp4ds.plugins.ros.ros2 import is_hidden
from mp4ds.processes import ProcessExecutor
from mp4ds.records import Channel, Message, MetadataRecord
from mp4ds.times import INT64_MAX
from mp4ds.video.codecs import check_codec

_NS = 1_000_000_000
_REPORT_S = 0.2
_CLOCK_POLL_S = 0.01
_FLUSH_S = 0.5
_BEHIND = 1 / 8
"""Of the buffer: with so much in it, nothing is synced, which would hold up writing."""

_NICE = 10
_NODES = {"ros1": "record", "ros2": "rosbag2_recorder"}
"""Node names of ROS's own recorders."""

_LAST_NS = {"ros1": 2**32 * _NS - 1, "ros2": INT64_MAX}
"""The latest time that a bag or rosbag2 can hold."""


@dataclass
class TopicProgress:
    """What came of a topic.

    Attributes:
        messages: Messages received.
        bytes: Their payloads.
        dropped: Messages dropped because the buffer was full.
        untimed: Messages left out because their log time is negative or too large.
        lost: Messages lost, as reported by the middleware.
        hz: Messages per second, recently.
        bytes_per_s: Bytes per second, recently.
    """

    messages: int = 0
    bytes: int = 0
    dropped: int = 0
    untimed: int = 0
    lost: int = 0
    hz: float = 0.0
    bytes_per_s: float = 0.0


@dataclass(frozen=True)
class RecordProgress:
    """Progress of a recording.

    Attributes:
        dataset: The dataset being made.
        seconds: Time since the recording began.
        state: ``recording``, ``paused``, ``finishing`` or ``waiting for /clock``.
        topics: State of each topic, by name.
        waiting_bytes: Bytes of buffered messages.
        spool_bytes: Bytes of messages on disk that are not packed yet.
        bytes_written: Bytes of this dataset so far, including these.
        warnings: Warnings so far, each a sentence.
    """

    dataset: Path
    seconds: float
    state: str
    topics: Mapping[str, TopicProgress]
    waiting_bytes: int
    spool_bytes: int
    bytes_written: int
    warnings: Sequence[str]


@dataclass
class RecordSummary:
    """The result of a recording.

    Attributes:
        datasets: One entry per dataset made.
        seconds: Duration of the recording.
        dropped: Messages dropped because the buffer was full, by topic.
        lost: Messages lost, as reported by the middleware, by topic.
        untimed: Messages left out because their log time is negative or too large, by topic.
        warnings: Warnings, each a sentence.
    """

    datasets: list[PackSummary] = field(default_factory=list)
    seconds: float = 0.0
    dropped: dict[str, int] = field(default_factory=dict)
    lost: dict[str, int] = field(default_factory=dict)
    untimed: dict[str, int] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)


def record(
    topics: Sequence[str] = (),
    dataset: Path | str | None = None,
    options: RecordOptions | None = None,
    *,
    progress: Callable[[RecordProgress], None] | None = None,
) -> RecordSummary:
    """Record topics until interrupted.

    Args:
        topics: Names or globs; may be empty if the options select topics.
        dataset: The folder to make; if None, it is named after the time.
        options: How to record.
        progress: Called a few times a second.

    Returns:
        The result.

    Raises:
        OptionError: An option is wrong.
        RemoteError: There is no ROS, or it cannot be reached.
        TargetError: The dataset cannot be written there.
        WriteError: The disk is full, or failed. What was recorded before is in the folder
            ``NAME.recording``; `mp4ds.pack` with `salvage` makes a dataset of it.
    """
    with open_recorder(topics, dataset, options, progress=progress) as recorder:
        return recorder.run()


@contextmanager
def open_recorder(
    topics: Sequence[str] = (),
    dataset: Path | str | None = None,
    options: RecordOptions | None = None,
    *,
    node: Node | None = None,
    progress: Callable[[RecordProgress], None] | None = None,
) -> Iterator[Recorder]:
    """A recorder that has not started yet; arguments as for `record`.

    Args:
        topics: Names or globs.
        dataset: The folder to make.
        options: How to record.
        node: Where messages come from, closed at the end; None: as the options say.
        progress: Called a few times a second.
    """
    chosen = options or RecordOptions()
    world = node.world if node else chosen_world("record", chosen.to)
    chosen = replace(chosen, names=chosen.names.in_world(world))
    wanted = Wanted(topics, chosen)
    _check(chosen)
    others = _bag_info(chosen.custom_data) if world == "ros2" else []
    made = dataset if dataset is not None else f"{datetime.now():mp4ds_%Y_%m_%d-%H_%M_%S}"
    if node is None:
        node = open_node(world, chosen, chosen.node or _NODES[world])
    with node:
        yield Recorder(Path(made).absolute(), chosen, wanted, node, others, progress)


def _check(options: RecordOptions) -> None:
    """Refuse options that make no sense, before anything is recorded.

    Raises:
        OptionError: One of them is wrong.
    """
    quality = options.quality
    if quality.target is not None:
        raise OptionError(
            f"`quality` {options.quality} takes several tries per video. Record lossless or "
            "visual, then pack the dataset with this quality."
        )
    if options.about is not None:
        load_about(options.about)
    check_codec(
        options.codec, options.preset, lossless=quality.lossless, crf=quality.crf, fast=True
    )


def _bag_info(custom_data: Sequence[str]) -> list[MetadataRecord]:
    """What a rosbag2's metadata.yaml says of the recording as a whole.

    Raises:
        OptionError: An entry is not of the form KEY=VALUE.
    """
    entries = [item.partition("=") for item in custom_data]
    for key, is_told, value in entries:
        if not (key and is_told):
            raise OptionError(f"`custom_data` {key + value!r} is not of the form KEY=VALUE.")
    custom = {key: value for key, _, value in entries}
    distro = os.environ.get("ROS_DISTRO", "")  # where ros2 bag record takes it from
    if not (custom or distro):
        return []
    info = {"version": NEWEST_VERSION, "custom_data": custom or None, "ros_distro": distro}
    content = {"storage": "", "files": "", METADATA_FILE: dump_bag_info(info)}
    return [MetadataRecord(RECORD, content)]


# ---------------------------------------------------------------- receiving


class Source:
    """Receives the messages of wanted topics, including topics that appear later.

    Args:
        node: Closed with this.
        options: How to record.
        wanted: Which topics to receive.
        take: Called with each message, from any thread; it does not block. Each channel has an
            id of its own.

    Attributes:
        warnings: Sentences, each to be shown once.
        topics: Topics subscribed to, with their channel if it is known before the first message.
        waiting_for: The clock topic that the recording waits for; empty once the clock runs.
    """

    def __init__(
        self,
        node: Node,
        options: RecordOptions,
        wanted: Wanted,
        take: Callable[[Message], None],
    ) -> None:
        self.warnings: dict[str, None] = {}
        self.topics: dict[str, Channel | None] = {}
        self.waiting_for = ""
        self._node = node
        self._options = options
        self._wanted = wanted
        self._take = take
        self._failed: Counter[str] = Counter()
        self._sim_time_ns: int | None = None
        self._subscribed: set[str] = set()
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def lost(self) -> Counter[str]:
        """Messages that the middleware reports as lost, or that could not be taken, by topic."""
        recorded_as = self._wanted.recorded_as
        by_node = {recorded_as(topic): count for topic, count in self._node.lost.items()}
        return self._failed + Counter(by_node)

    def warn(self, sentence: str) -> None:
        """Add a warning."""
        self.warnings[sentence] = None

    def start(self) -> None:
        """Start receiving, in threads of its own.

        With a simulated time, it subscribes to topics only once /clock has published a time, as
        `ros2 bag record` does: earlier messages would have none, and latched ones still arrive.

        Raises:
            RemoteError: The middleware refuses.
        """
        names = self._options.names
        if self._options.use_sim_time or names.use_sim_time or self._node.wants_clock:
            self.waiting_for = names.renamed(CLOCK)
            self._node.follow_clock(self._tick)
        else:
            self._look()
        self._thread = threading.Thread(target=self._keep_looking, name="topics", daemon=True)
        self._thread.start()

    def _tick(self, time_ns: int) -> None:
        if time_ns:  # 0 means that the clock has not started
            self._sim_time_ns, self.waiting_for = time_ns, ""

    def _keep_looking(self) -> None:
        is_clear = self.waiting_for == ""  # then it has looked once
        while self.waiting_for:
            if self._ended.wait(_CLOCK_POLL_S):
                return
        poll_s = max(self._options.polling_interval / 1000, self._node.poll_s)
        end = time.monotonic() + self._node.discovery_s
        while self._options.discover or not is_clear or time.monotonic() < end:
            if self._ended.wait(poll_s if is_clear else 0.0):
                return
            try:
                self._look()
                is_clear = True
            except Mp4dsError as error:
                self.warn(f"new topics are not noticed: {error}")
                self._ended.wait(poll_s)

    def _look(self) -> None:
        """Subscribe to new topics."""
        is_ros2, options = self._node.world == "ros2", self._options
        heard = self._node.subscribed_topics() if is_ros2 and options.ignore_leaf else None

        def is_new(topic: str, kind: str) -> bool:
            if topic in self._subscribed or (heard is not None and topic not in heard):
                return False
            is_shown = options.hidden or not is_ros2 or not is_hidden(topic)
            return is_shown and self._wanted(topic, kind)

        for topic, kinds in self._node.topics(is_new).items():
            self._subscribed.add(topic)
            self._subscribe(topic, kinds)

    def _subscribe(self, topic: str, kinds: Sequence[str]) -> None:
        name = self._wanted.recorded_as(topic)

        def receive(channel: Channel, data: bytes, sent_ns: int) -> None:
            # middlewares swallow, or crash on, what a callback raises
            try:
                now = time.time_ns() if self._sim_time_ns is None else self._sim_time_ns
                self._take(Message(channel, now, sent_ns if sent_ns > 0 else now, 0, data))
            except Exception as error:
                self._failed[name] += 1
                self.warn(f"{name}: a message could not be recorded: {error!r}")

        if len(kinds) > 1:
            self.warn(f"{topic}: has several types: only {kinds[0]} is recorded")
        try:
            channel = self._node.subscribe(topic, kinds[0], name, receive)
        except Refused as reason:
            self.warn(f"{topic}: not recorded: {reason}")
            return
        if channel is not None and channel.schema and not channel.schema.data:
            self.warn(
                f"{topic}: recorded without the definition of {kinds[0]}, which was not found"
            )
        self.topics[name] = channel

    def close(self) -> None:
        """Stop receiving."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join()
        self._node.close()


class MessageBuffer:
    """Messages on their way from the threads that receive them to the one that writes them.

    Args:
        most_bytes: Limit of buffered payloads; beyond, the oldest messages are dropped and counted.
        last_ns: The latest log or publish time that the recording can hold; the first one is 0.

    Attributes:
        topics: What came of each topic.
        bytes: Buffered payloads.
    """

    def __init__(self, most_bytes: int, last_ns: int = INT64_MAX) -> None:
        self.topics: dict[str, TopicProgress] = {}
        self._most = most_bytes
        self._last_ns = last_ns
        self.bytes = 0
        self._messages: deque[Message] = deque()
        self._changed = threading.Condition()
        self._is_closed = False

    def put(self, message: Message) -> None:
        """Add a message, from any thread; it never waits."""
        with self._changed:
            if self._is_closed:
                return
            topic = self.topics.setdefault(message.channel.topic, TopicProgress())
            topic.messages += 1
            topic.bytes += len(message.data)
            times = message.log_time, message.publish_time
            if min(times) < 0 or max(times) > self._last_ns:
                topic.untimed += 1
                return
            while self._messages and self.bytes + len(message.data) > self._most:
                dropped = self._messages.popleft()
                self.bytes -= len(dropped.data)
                self.topics[dropped.channel.topic].dropped += 1
            self._messages.append(message)
            self.bytes += len(message.data)
            self._changed.notify()

    def take(self, wait_s: float) -> Message | None:
        """The next message; None if none came in time.

        Raises:
            EOFError: There are no more.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._messages or self._is_closed, wait_s)
            if self._messages:
                message = self._messages.popleft()
                self.bytes -= len(message.data)
                return message
            if self._is_closed:
                raise EOFError
            return None

    def close(self) -> None:
        """Take no more messages; buffered ones are still given out."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()


# ---------------------------------------------------------------- recording


class Recorder:
    """Records until it is stopped; see `open_recorder`.

    A thread of its own takes messages out of a buffer and writes them; the pieces that are complete
    are packed, one after another, by another process.

    Args:
        target: The dataset, an absolute path.
        options: How to record.
        wanted: Which topics to record.
        node: Where messages come from; closed when recording ends.
        others: What the recording holds besides messages.
        progress: Called a few times a second.

    Attributes:
        address: What it is connected to, for display.
        is_paused: Whether the recording is paused.
    """

    def __init__(
        self,
        target: Path,
        options: RecordOptions,
        wanted: Wanted,
        node: Node,
        others: Sequence[MetadataRecord],
        progress: Callable[[RecordProgress], None] | None,
    ) -> None:
        self.address = node.address
        self._target = target
        self._options = options
        self._node = node
        self._others = others
        self._progress = progress
        self._buffer = MessageBuffer(options.buffer * 10**6, _LAST_NS[node.world])
        self._source = Source(node, options, wanted, self._take)
        self._changed = threading.Event()
        self._is_stopped = False
        self.is_paused = options.start_paused
        self._is_split_asked = False
        self._splits: list[Split] = []
        self._process = ProcessExecutor(1, nice=_NICE)
        self._jobs = ThreadPoolExecutor(1, "packing")  # waits for the process
        self._counted: dict[str, tuple[float, TopicProgress]] = {}  # when, and what
        self._error: Exception | None = None

    @property
    def received(self) -> int:
        """Number of messages received so far."""
        return sum(topic.messages for topic in list(self._buffer.topics.values()))

    @property
    def unfinished(self) -> list[Path]:
        """Folders of recordings that are not datasets yet."""
        return [split.folder.path for split in self._splits if split.folder.path.is_dir()]

    # ------------------------------------------------------------ controls

    def pause(self) -> None:
        """Pause: ignore messages from now on."""
        self.is_paused = True

    def resume(self) -> None:
        """Resume after a pause."""
        self.is_paused = False

    def toggle_paused(self) -> None:
        """Pause or resume."""
        self.is_paused = not self.is_paused

    def split(self) -> None:
        """Start a new dataset, with the next message."""
        self._is_split_asked = True

    def stop(self) -> None:
        """Stop; `run` then completes the dataset and returns."""
        self._is_stopped = True
        self._changed.set()

    # ------------------------------------------------------------ running

    def run(self) -> RecordSummary:
        """Record until stopped.

        Raises:
            Mp4dsError: As for `record`.
        """
        self._warn_of_unfinished()
        try:
            # the process ends before the thread that waits for it
            with quick_switches(), self._jobs, self._process:
                begun = self._record()
        finally:
            for split in self._splits:
                split.lock.close()
        for split in self._splits:
            if error := split.error or (self._error if split.made is None else None):
                raise split.failure(error)
        if self._error is not None:
            raise self._error
        received = self._buffer.topics
        return RecordSummary(
            datasets=[split.made for split in self._splits if split.made],
            seconds=time.monotonic() - begun,
            dropped={name: one.dropped for name, one in received.items() if one.dropped},
            lost=dict(self._source.lost),
            untimed={name: one.untimed for name, one in received.items() if one.untimed},
            warnings=list(self._source.warnings),
        )

    def _record(self) -> float:
        """Record until stopped, and pack everything; returns when recording began."""
        begun = time.monotonic()
        self._begin_split()
        writer = threading.Thread(target=self._write, name="spool", daemon=True)
        writer.start()
        try:
            if self._node.world == "ros2":  # `rosbag record` has no services
                self._node.serve(recorder_services(self))
            self._source.start()
            while not self._is_stopped:
                self._changed.wait(_REPORT_S)
                self._changed.clear()
                clock = self._source.waiting_for
                if clock:
                    begun = time.monotonic()
                if self._options.duration and time.monotonic() - begun >= self._options.duration:
                    self._is_stopped = True
                state = f"waiting for {clock}" if clock else "recording"
                self._report(begun, "paused" if self.is_paused else state)
        finally:
            self._source.close()
            self._buffer.close()
            while writer.is_alive():
                writer.join(_REPORT_S)
                self._report(begun, "finishing")
            packed = self._jobs.submit(bool)  # runs after all others
            while wait([packed], _REPORT_S).not_done:
                self._report(begun, "finishing")
        return begun

    def _take(self, message: Message) -> None:
        if not self.is_paused:
            self._buffer.put(message)

    def _begin_split(self) -> None:
        number, target = len(self._splits), self._target
        if self._options.max_duration or self._options.max_size or number:
            target = target.with_name(f"{target.name}_{number}")
        self._splits.append(
            Split(
                target,
                self._options,
                self._node.world,
                self._others,
                self._process,
                self._jobs,
                self._source.warn,
            )
        )
        self._is_split_asked = False

    def _write(self) -> None:
        """Write buffered messages into the spool, until the buffer is closed."""
        with ThreadPoolExecutor(1) as disk:
            try:
                self._write_all(disk)
            except Exception as error:  # it is raised by `run`
                self._error = error
                self._splits[-1].abandon()
                self.stop()

    def _write_all(self, disk: ThreadPoolExecutor) -> None:
        syncing: Future[None] | None = None
        next_flush = time.monotonic() + _FLUSH_S
        while True:
            split = self._splits[-1]
            try:
                message = self._buffer.take(max(0.0, next_flush - time.monotonic()))
            except EOFError:
                split.close(self._announced())
                return
            if message is not None:
                if self._is_split_asked or split.is_full:
                    split.close(self._announced())
                    self._begin_split()
                self._splits[-1].write(message)
            if time.monotonic() >= next_flush:
                self._splits[-1].flush()
                is_behind = self._buffer.bytes > self._options.buffer * 10**6 * _BEHIND
                if not is_behind and (syncing is None or syncing.done()):
                    syncing = disk.submit(_sync, self._splits[-1].paths)
                next_flush = time.monotonic() + _FLUSH_S

    def _announced(self) -> list[Channel]:
        """Channels that are in a dataset even if they have no messages."""
        return [channel for channel in list(self._source.topics.values()) if channel]

    def _report(self, begun: float, state: str) -> None:
        if self._progress is None:
            return
        split, now = self._splits[-1], time.monotonic()
        topics = {
            topic: self._topic(topic, now)
            for topic in sorted({*self._source.topics, *self._buffer.topics})
        }
        self._progress(
            RecordProgress(
                dataset=split.target,
                seconds=now - begun,
                state=state,
                topics=topics,
                waiting_bytes=self._buffer.bytes,
                spool_bytes=sum(split.spool_bytes for split in self._splits),
                bytes_written=split.size,
                warnings=list(self._source.warnings),
            )
        )

    def _topic(self, topic: str, now: float) -> TopicProgress:
        received = self._buffer.topics.get(topic, TopicProgress())
        then, before = self._counted.get(topic, (0.0, received))
        if now - then >= 1.0:
            hz = (received.messages - before.messages) / (now - then)
            rate = (received.bytes - before.bytes) / (now - then)
            before = replace(received, hz=hz, bytes_per_s=rate)
            self._counted[topic] = now, before
        lost, hz, rate = self._source.lost[topic], before.hz, before.bytes_per_s
        return replace(received, lost=lost, hz=hz, bytes_per_s=rate)

    def _warn_of_unfinished(self) -> None:
        """Warn of unfinished recordings next to this one."""
        for folder in sorted(self._target.parent.glob(f"*{UNFINISHED}")):
            if is_unfinished(folder):
                self._source.warn(
                    f"{folder}: unfinished recording; if no recorder is writing it any more, "
                    f"recover it: {salvage_command(folder)}"
                )


def _sync(paths: Sequence[Path]) -> None:
    for path in paths:
        with suppress(OSError):  # what the disk refuses, its writer is told, too
            sync(path)


def recorder_services(recorder: Recorder) -> Sequence[Service]:
    """Those of `ros2 bag record`, except for snapshots."""
    return (
        action("pause", recorder.pause),
        action("resume", recorder.resume),
        Service("is_paused", "", "bool paused", lambda _: {"paused": recorder.is_paused}),
        action("split_bagfile", recorder.split),
        action("stop", recorder.stop),
    )
