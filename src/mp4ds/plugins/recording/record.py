"""A live robot -> datasets: messages are written to disk as they arrive, and packed beside."""

from __future__ import annotations

import os
import shutil
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import partial
from itertools import chain, count
from pathlib import Path

from mp4ds.bags.latched import MOST_BYTES, LatchedMessages, has_late
from mp4ds.bags.rosbag2_metadata import METADATA_FILE, NEWEST_VERSION, RECORD, dump_bag_info
from mp4ds.errors import Mp4dsError, OptionError, Refused, TargetError
from mp4ds.files.sources import UNFINISHED, is_unfinished, salvage_command
from mp4ds.format.sidecars import load_about
from mp4ds.messages.serializations import is_camera
from mp4ds.packing.options import PackSummary
from mp4ds.packing.spool import remove_dataset
from mp4ds.plugins.recording.lookback import LookBack, at_first_free
from mp4ds.plugins.recording.options import RecordOptions, Trigger, Wanted
from mp4ds.plugins.recording.receiving import MessageBuffer, Source, TopicProgress
from mp4ds.plugins.recording.spool import Split, sync_all
from mp4ds.plugins.ros.node import Node, Service, action, chosen_world, open_node, quick_switches
from mp4ds.processes import ProcessExecutor
from mp4ds.records import Channel, Loss, Message, MetadataRecord
from mp4ds.times import INT64_MAX
from mp4ds.video.codecs import check_codec

_NS = 1_000_000_000
_REPORT_S = 0.2
_FLUSH_S = 0.5
_BEHIND = 1 / 8
"""Of the buffer: with so much in it, nothing is synced, which would hold up writing."""

_TIME = "%Y_%m_%d-%H_%M_%S"
_NICE = 10
_QUIET_S = 1.0
"""For how long further messages on a trigger's topic mean the same."""

_NODES = {"ros1": "record", "ros2": "rosbag2_recorder"}
"""Node names of ROS's own recorders."""

_LAST_NS = {"ros1": 2**32 * _NS - 1, "ros2": INT64_MAX}
"""The latest time that a bag or rosbag2 can hold."""


@dataclass(frozen=True)
class RecordProgress:
    """Progress of a recording.

    Attributes:
        dataset: The dataset being made.
        seconds: Time since the recording began.
        state: ``recording``, ``looking back``, ``paused``, ``finishing`` or ``waiting for /clock``.
        topics: State of each topic, by name.
        waiting_bytes: Bytes of buffered messages.
        spool_bytes: Bytes of messages on disk that are not packed yet.
        bytes_written: Bytes of this dataset so far, including these.
        saved: Datasets that a recorder that looks back saves: whether they are complete.
        warnings: Warnings so far, each a sentence.
    """

    dataset: Path
    seconds: float
    state: str
    topics: Mapping[str, TopicProgress]
    waiting_bytes: int
    spool_bytes: int
    bytes_written: int
    saved: Mapping[Path, bool]
    warnings: Sequence[str]


@dataclass
class RecordSummary:
    """The result of a recording.

    Attributes:
        datasets: One entry per dataset made.
        failed: Looking back, why something that was to be saved is no dataset, and where it is.
        seconds: Duration of the recording.
        dropped: Messages dropped because the buffer was full, by topic.
        lost: Messages lost, as reported by the middleware, by topic.
        untimed: Messages left out because their log time is negative or too large, by topic.
        is_short_of_space: Whether it stopped because of `min_space`.
        warnings: Warnings, each a sentence.
    """

    datasets: list[PackSummary] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    seconds: float = 0.0
    dropped: dict[str, int] = field(default_factory=dict)
    lost: dict[str, int] = field(default_factory=dict)
    untimed: dict[str, int] = field(default_factory=dict)
    is_short_of_space: bool = False
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
    if dataset is not None and chosen.prefix != RecordOptions.prefix:
        raise OptionError("`prefix` is for a dataset that is not named.")
    default = chosen.prefix if chosen.keep_last else f"{chosen.prefix}_{datetime.now():{_TIME}}"
    made = dataset if dataset is not None else default
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
    for text in options.trigger:
        Trigger(text)
    splits = options.max_duration or options.max_size or options.max_splits
    if options.keep_last is None:
        if options.and_then is not None or options.trigger:
            raise OptionError("`and_then` and `trigger` need `keep_last`.")
    elif splits or options.limit:
        raise OptionError(
            "`keep_last` contradicts `max_duration`, `max_size`, `max_splits` and `limit`."
        )
    elif options.repeat_latched:
        raise OptionError(
            "`keep_last` saves latched messages with each dataset: leave out `repeat_latched`."
        )
    elif options.keep_last == 0:
        raise OptionError("`keep_last` must be more than 0 seconds.")
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
        self._buffer = MessageBuffer(options.buffer * 10**6, _LAST_NS[node.world], options.limit)
        self._due = wanted.due
        self._source = Source(node, options, wanted, self._take)
        self._changed = threading.Event()
        self._is_stopped = False
        self.is_paused = options.start_paused
        self._is_split_asked = False
        self._is_short_of_space = False
        self._latched: dict[int, LatchedMessages] = {}  # by channel
        self._splits: list[Split] = []
        self._look_back: LookBack | None = None
        self._triggers: deque[tuple[int, int]] = deque()  # times, and how many messages are before
        self._quiet_until = 0.0
        self._told_dropped: Counter[str] = Counter()  # messages, by topic
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
        return [split.folder.path for split in self._all_splits if split.folder.path.is_dir()]

    @property
    def _all_splits(self) -> list[Split]:
        """All datasets, and what is looked back at."""
        looks = self._look_back
        made = [looks, *looks.saved] if looks else self._splits
        return [split for split in made if not split.is_removed]

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

    def snapshot(self) -> bool:
        """Save what a recorder that looks back has, from any thread or a handler of signals.

        Returns:
            Whether it does: it looks back, and runs.
        """
        is_ready = self._look_back is not None and not self._source.waiting_for
        if is_ready and not self._is_stopped:
            self._triggers.append((self._source.now, self._buffer.put_in))
            return True
        return False

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
        for folder in sorted(self._target.parent.glob(f"*{UNFINISHED}")):
            if is_unfinished(folder):
                self._source.warn(
                    f"{folder}: unfinished recording; if no recorder is writing it any more, "
                    f"recover it: {salvage_command(folder)}"
                )
        if self._has_no_space():
            problem = f"its file system has less than {self._options.min_space} bytes free"
            raise TargetError(self._target, problem, "Make room, or choose a smaller `min_space`.")
        try:
            # the process ends before the thread that waits for it
            with quick_switches(), self._jobs, self._process:
                begun = self._record()
        finally:
            for split in self._all_splits:
                split.lock.close()
        for split in self._all_splits:
            error = split.error or (self._error if split.made is None else None)
            if error and (self._look_back is None or self._error is not None):
                is_ours = isinstance(error, Mp4dsError) and error is not split.error
                raise error if is_ours else split.left(error)
        if self._error is not None:
            raise self._error
        received = self._buffer.topics
        failed = [one.left(one.error) for one in self._all_splits if one.error]
        if self._look_back and self._look_back.unsaved:
            failed.append(self._look_back.left(self._look_back.unsaved))
        return RecordSummary(
            datasets=[split.made for split in self._all_splits if split.made],
            failed=[str(error) for error in failed],
            seconds=time.monotonic() - begun,
            dropped={name: one.dropped for name, one in received.items() if one.dropped},
            lost=dict(self._source.lost),
            untimed={name: one.untimed for name, one in received.items() if one.untimed},
            is_short_of_space=self._is_short_of_space,
            warnings=list(self._source.warnings),
        )

    def _has_no_space(self) -> bool:
        least = self._options.min_space
        with suppress(OSError):  # a folder that is not there is told of later
            return least is not None and shutil.disk_usage(self._target.parent).free < least
        return False

    def _record(self) -> float:
        """Record until stopped, and pack everything; returns when recording began."""
        begun = time.monotonic()
        self._begin_split()
        writer = threading.Thread(target=self._write, name="spool", daemon=True)
        writer.start()
        try:
            self._serve()
            self._source.start()
            while not self._is_stopped:
                self._changed.wait(_REPORT_S)
                self._changed.clear()
                state = "looking back" if self._look_back else "recording"
                if clock := self._source.waiting_for:
                    begun, state = time.monotonic(), f"waiting for {clock}"
                if self._options.duration and time.monotonic() - begun >= self._options.duration:
                    self._is_stopped = True
                if self._options.limit and self._buffer.has_all({*self._source.topics, *self._due}):
                    self._is_stopped = True
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

    def _serve(self) -> None:
        unfit = "split_bagfile" if self._look_back else "snapshot"
        services = [one for one in recorder_services(self) if one.name != unfit]
        if self._node.world == "ros1":  # `rosbag record` has no services
            services = [one for one in services if one.name == "snapshot"]
        self._node.serve(services)
        for text in self._options.trigger:
            trigger, names = Trigger(text), self._options.names
            topic = names.renamed(names.resolved(trigger.topic))
            self._node.follow(topic, partial(self._watch, trigger, text))

    def _watch(self, trigger: Trigger, text: str, channel: Channel) -> Callable[[bytes], None]:
        """What is called with each message on a trigger's topic."""
        try:
            is_triggered = trigger.watch(channel)
        except Refused as reason:
            self._source.warn(f"--trigger {text!r} cannot trigger: {reason}")
            return lambda data: None

        def on_message(data: bytes) -> None:
            now = time.monotonic()
            # those that come while what follows is saved belong to it
            if is_triggered(data) and now >= self._quiet_until and self.snapshot():
                self._quiet_until = now + max(_QUIET_S, self._options.and_then or 0)

        return on_message

    def _new_paths(self) -> Iterator[Path]:
        """Paths for the next dataset that is saved, where nothing is."""
        stem = f"{self._target.name}_{datetime.now():{_TIME}}"
        for number in count():
            path = self._target.with_name(f"{stem}_{number}" if number else stem)
            if not (os.path.lexists(path) or os.path.lexists(f"{path}{UNFINISHED}")):
                yield path

    def _begin_split(self) -> None:
        node, warn = self._node, self._source.warn
        spool = self._options, node.world, self._others, self._process, self._jobs, warn
        if self._options.keep_last:
            spans = [round(s * _NS) for s in (self._options.keep_last, self._options.and_then or 0)]
            self._look_back = at_first_free(
                self._new_paths(), lambda path: LookBack(path, self._new_paths, *spans, *spool)
            )
            self._splits.append(self._look_back)
            return
        number, target = len(self._splits), self._target
        if self._options.max_duration or self._options.max_size or number:
            target = target.with_name(f"{target.name}_{number}")
        self._splits.append(Split(target, *spool))
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
            disk.submit(sync_all, self._written())

    def _write_all(self, disk: ThreadPoolExecutor) -> None:
        syncing = disk.submit(sync_all, self._written())
        next_flush = time.monotonic() + _FLUSH_S
        while True:
            split = self._splits[-1]
            try:
                message = self._buffer.take(max(0.0, next_flush - time.monotonic()))
            except EOFError:
                self._save_snapshots(self._buffer.gone)
                self._close_split()
                return
            self._save_snapshots(self._buffer.gone - (message is not None))
            if message is not None:
                if not self._look_back and (self._is_split_asked or split.is_full):
                    self._close_split()
                    self._begin_split()
                    syncing = disk.submit(sync_all, self._written())
                    latched = chain.from_iterable(self._latched.values())
                    for one in sorted(latched, key=lambda one: one.log_time):
                        self._splits[-1].write(replace(one, log_time=message.log_time))
                self._splits[-1].write(message)
                if self._options.repeat_latched and has_late(message.channel):
                    self._keep_latched(message)
            elif self._look_back:
                self._look_back.advance(self._source.now)
            if time.monotonic() >= next_flush:
                self._splits[-1].flush()
                if self._has_no_space() and not self._is_short_of_space:
                    self._is_short_of_space = True
                    self._source.warn("stopped: the file system has less free space than asked for")
                    self.stop()
                is_behind = self._buffer.bytes > self._options.buffer * 10**6 * _BEHIND
                if not is_behind and syncing.done():
                    syncing = disk.submit(sync_all, self._written())
                next_flush = time.monotonic() + _FLUSH_S

    def _written(self) -> list[Path]:
        return [path for split in self._splits for path in split.written()]

    def _close_split(self) -> None:
        counts = Counter({topic: one.dropped for topic, one in dict(self._buffer.topics).items()})
        new, self._told_dropped = counts - self._told_dropped, counts
        name, problem = self._splits[-1].target.name, "dropped: the recorder's buffer was full"
        losses = [Loss(name, None, None, problem, new[topic], (topic,)) for topic in sorted(new)]
        self._splits[-1].close(self._announced(), losses)
        if most := self._options.max_splits:
            self._jobs.submit(self._remove_old, most)  # when it is made

    def _remove_old(self, most: int) -> None:
        """Remove the oldest datasets that were made but for so many."""
        for split in [one for one in self._all_splits if one.made][:-most]:
            split.is_removed = True
            try:
                remove_dataset(split.target)
            except OSError as error:
                self._source.warn(f"{split.target}: could not be removed: {error.strerror}")

    def _keep_latched(self, message: Message) -> None:
        known = self._latched
        if is_camera(message.channel):
            return
        known.setdefault(message.channel.id, LatchedMessages(message.channel)).add(message)
        while sum(one.size for one in known.values()) > MOST_BYTES:
            largest = max(known, key=lambda key: known[key].size)
            topic = next(iter(known.pop(largest))).channel.topic
            self._source.warn(f"{topic}: its latched messages are too large to be repeated")

    def _save_snapshots(self, written: int) -> None:
        """Begin to save at the triggers that came after so many messages."""
        while self._look_back and self._triggers and self._triggers[0][1] <= written:
            self._look_back.save(self._triggers.popleft()[0], self._announced())

    def _announced(self) -> list[Channel]:
        """Channels that are in a dataset even if they have no messages."""
        return [channel for channel in list(self._source.topics.values()) if channel]

    def _report(self, begun: float, state: str) -> None:
        if self._progress is None:
            return
        split, now = self._splits[-1], time.monotonic()
        looks = self._look_back
        datasets: Sequence[Split] = [*looks.saved] if looks else self._splits
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
                spool_bytes=sum(one.spool_bytes for one in datasets),
                bytes_written=split.size,
                saved={one.target: one.made is not None for one in datasets} if looks else {},
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


def recorder_services(recorder: Recorder) -> Sequence[Service]:
    """Those of `ros2 bag record`."""
    return (
        Service("snapshot", "", "bool success", lambda _: {"success": recorder.snapshot()}),
        action("pause", recorder.pause),
        action("resume", recorder.resume),
        Service("is_paused", "", "bool paused", lambda _: {"paused": recorder.is_paused}),
        action("split_bagfile", recorder.split),
        action("stop", recorder.stop),
    )
