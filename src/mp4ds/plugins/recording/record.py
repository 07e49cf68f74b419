"""A live robot -> datasets: messages are encoded and written to disk as they arrive."""

from __future__ import annotations

import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

from mp4ds.bags.rosbag2_metadata import METADATA_FILE, NEWEST_VERSION, RECORD, dump_bag_info
from mp4ds.errors import Mp4dsError, OptionError, RecordError, TargetError, WriteError
from mp4ds.files.outputs import check_target, move_into_place, sync, work_folder
from mp4ds.files.sources import JOURNAL_NAME, UNFINISHED, is_unfinished, salvage_command
from mp4ds.format.manifest import About
from mp4ds.format.sidecars import load_about
from mp4ds.options import Options, argument, force, option, parse_size
from mp4ds.packing.journal import Journal
from mp4ds.packing.live import Intake, LivePacker, LiveRecording
from mp4ds.packing.manifest import (
    Origin,
    PartRecord,
    dataset_files,
    folder_size,
    summarize,
    write_manifest,
)
from mp4ds.packing.options import PackSummary
from mp4ds.packing.packer import PartSettings
from mp4ds.packing.planning import available_cores
from mp4ds.packing.tracks import StreamSettings
from mp4ds.plan import LOSSLESS, MAX_GOP, SPEED, Purpose, Selection, parse_quality
from mp4ds.plugins.playing.timeline import quick_switches
from mp4ds.plugins.publishing.names import PLAIN, NodeNames
from mp4ds.plugins.publishing.publisher import sourced
from mp4ds.plugins.recording.source import Source, SourceOptions, Wanted, open_source
from mp4ds.records import Message, MetadataRecord
from mp4ds.times import INT64_MAX
from mp4ds.video.codecs import LOSSLESS_GOP, LOSSY_GOP, check_codec

_NS = 1_000_000_000
_REPORT_S = 0.2
_LAST_NS = {"ros1": 2**32 * _NS - 1, "ros2": INT64_MAX}
"""The latest time that a bag or rosbag2 can hold."""

_NODES = {"ros1": "record", "ros2": "rosbag2_recorder"}
"""Node names of ROS's own recorders."""


@dataclass(frozen=True)
class RecordOptions(Options):
    """How to record."""

    to: str | None = option("ros1 or ros2; default: the one that is sourced.")
    all: bool = option(
        "Record all topics, including new ones, and all service events (ROS 2).", False, "-a"
    )
    all_topics: bool = option("Record all topics, but no service events.", False)
    all_services: bool = option("Record all service events (ROS 2).", False)
    topic_types: Sequence[str] = option(
        "Record topics of this type; repeatable.", (), metavar="TYPE"
    )
    regex: str = option("Record topics whose name matches a regular expression.", "", "-e")
    exclude: Sequence[str] = option(
        "Leave out topics that match; repeatable.", (), "--exclude", metavar="GLOB"
    )
    exclude_topic_types: Sequence[str] = option(
        "Leave out topics of this type; repeatable.", (), metavar="TYPE"
    )
    exclude_regex: str = option(
        "Leave out topics whose name matches a regular expression.", "", "--exclude-regex", "-x"
    )
    duration: float | None = option("Stop after N seconds.", None, "--duration")
    max_duration: float | None = option(
        "Start a new dataset after this many seconds; 0: never.",
        None,
        "--max-bag-duration",
        "-d",
        metavar="SECONDS",
    )
    max_size: int | None = option(
        "Start a new dataset at this size, such as 4G.",
        None,
        "--max-size",
        metavar="SIZE",
        parse=parse_size,
    )
    buffer: int = option(
        "Buffer size in MB; when the buffer is full, the oldest messages are dropped and counted.",
        256,
        "--buffsize",
        "-b",
        least=1,
        most=1_000_000,
    )
    quality: str = option("lossless, visual or crf=N.", LOSSLESS)
    codec: str | None = option("As in pack; default: the fastest to encode.")
    preset: str | None = option("Encoder preset; default: the fastest.")
    gop: int | None = option(
        "Maximum key frame interval in frames; default: 10, or 30 if lossy.",
        least=1,
        most=MAX_GOP,
    )
    start_paused: bool = option("Start paused.", False, "--start-paused", "--pause")
    use_sim_time: bool = option("Take log times from /clock, and wait for it.", False)
    node: str | None = option(
        "Node name; default: that of ROS's own recorder.", None, "--node-name"
    )
    discover: bool = option("Keep looking for new topics.", True, "--discovery/--no-discovery")
    polling_interval: float = option(
        "Milliseconds between two checks for new topics.", 100.0, "--polling-interval", "-p"
    )
    hidden: bool = option("Include hidden topics (ROS 2).", False, "--include-hidden-topics")
    unpublished: bool = option(
        "Include topics without a publisher (ROS 2, with rclpy).",
        False,
        "--include-unpublished-topics",
    )
    ignore_leaf: bool = option(
        "Leave out topics without a subscriber (ROS 2).", False, "--ignore-leaf-topics"
    )
    qos_overrides: Path | None = option(
        "QoS profiles to subscribe with, by topic (ROS 2).",
        None,
        "--qos-profile-overrides-path",
        metavar="YAML",
    )
    custom_data: Sequence[str] = option(
        "Entry for custom_data of the rosbag2 metadata (ROS 2); repeatable.",
        (),
        metavar="KEY=VALUE",
    )
    about: str | None = option(
        "YAML file with title, description, authors, license, doi, links or keywords.",
        metavar="FILE",
    )
    force: bool = force()
    names: NodeNames = argument("Name, namespace and remappings of the node.", PLAIN)


@dataclass(frozen=True)
class TopicProgress:
    """State of a topic.

    Attributes:
        messages: Messages received.
        hz: Messages per second, recently.
        bytes_per_s: Bytes per second, recently.
        verbatim: Camera messages stored as received, not encoded.
        dropped: Messages dropped because the buffer was full.
        lost: Messages lost, as reported by the middleware.
        untimed: Messages left out because their log time is negative or too large.
    """

    messages: int
    hz: float
    bytes_per_s: float
    verbatim: int
    dropped: int
    lost: int
    untimed: int


@dataclass(frozen=True)
class RecordProgress:
    """Progress of a recording.

    Attributes:
        dataset: The dataset being made.
        seconds: Time since the recording began.
        state: ``recording``, ``paused``, ``finishing`` or ``waiting for /clock``.
        topics: State of each topic, by name.
        waiting_bytes: Bytes of buffered messages.
        bytes_written: Bytes of this dataset so far.
        warnings: Warnings so far, each a sentence.
    """

    dataset: Path
    seconds: float
    state: str
    topics: Mapping[str, TopicProgress]
    waiting_bytes: int
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
        PublishError: There is no ROS, or it cannot be reached.
        TargetError: The dataset cannot be written there.
        RecordError: The disk is full, or failed. What was recorded before is in the folder
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
    source: Source | None = None,
    progress: Callable[[RecordProgress], None] | None = None,
) -> Iterator[Recorder]:
    """A recorder that has not started yet; arguments as for `record`.

    Args:
        topics: Names or globs.
        dataset: The folder to make.
        options: How to record.
        source: Where messages come from, closed at the end; None to open one by the options.
        progress: Called a few times a second.
    """
    chosen = options or RecordOptions()
    is_all = chosen.all or chosen.all_topics or chosen.all_services
    if not (topics or is_all or chosen.regex or chosen.topic_types):
        raise OptionError("Name topics, or give `all`, `regex` or `topic_types`.")
    kind = source.profile if source else chosen.to or sourced("record")
    names = chosen.names.in_world(kind)
    wanted = Wanted(
        topics,
        types=chosen.topic_types,
        regex=chosen.regex,
        all_topics=chosen.all or chosen.all_topics,
        all_services=chosen.all or chosen.all_services,
        exclude=chosen.exclude,
        exclude_types=chosen.exclude_topic_types,
        exclude_regex=chosen.exclude_regex,
        names=names,
    )
    settings = _settings(chosen)
    about = load_about(chosen.about) if chosen.about is not None else None
    others = _bag_info(chosen.custom_data) if kind == "ros2" else []
    if source is None:
        source = open_source(
            kind,
            SourceOptions(
                chosen.node or _NODES[kind],
                use_sim_time=chosen.use_sim_time or bool(names.use_sim_time),
                poll_s=chosen.polling_interval / 1000 if chosen.discover else None,
                hidden=chosen.hidden,
                unpublished=chosen.unpublished,
                ignore_leaf=chosen.ignore_leaf,
                qos_overrides=chosen.qos_overrides,
                names=names,
            ),
        )
    with ExitStack() as stack:
        stack.callback(source.close)
        target = (
            Path(dataset)
            if dataset is not None
            else Path(f"{datetime.now():mp4ds_%Y_%m_%d-%H_%M_%S}")
        )
        made = target.absolute()
        yield Recorder(made, chosen, settings, wanted, source, about, others, progress)


def _settings(options: RecordOptions) -> StreamSettings:
    quality = parse_quality(options.quality)
    if quality.target is not None:
        raise OptionError(
            f"`quality` {options.quality} takes several tries per video. Record lossless or "
            "visual, then pack the dataset with this quality."
        )
    for name, seconds in (("duration", options.duration), ("max_duration", options.max_duration)):
        if seconds is not None and not 0 <= seconds < 1e9:
            raise OptionError(f"`{name}` {seconds:g} is not a number of seconds, 0 or more.")
    return StreamSettings(
        quality=quality,
        codec=check_codec(
            options.codec, options.preset, lossless=quality.lossless, crf=quality.crf
        ),
        preset=options.preset,
        gop=options.gop or (LOSSLESS_GOP if quality.lossless else LOSSY_GOP),
        threads=1 if quality.lossless else available_cores(),
        purpose=Purpose(SPEED),
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


class Recorder:
    """Records until it is stopped; see `open_recorder`.

    Args:
        target: The dataset, an absolute path.
        options: How to record.
        settings: How to encode.
        wanted: Which topics to record.
        source: Where messages come from.
        about: Description of the recording.
        others: What it holds besides messages.
        progress: Called a few times a second.
    """

    def __init__(
        self,
        target: Path,
        options: RecordOptions,
        settings: StreamSettings,
        wanted: Wanted,
        source: Source,
        about: About | None,
        others: Sequence[MetadataRecord],
        progress: Callable[[RecordProgress], None] | None,
    ) -> None:
        self._target = target
        self._options = options
        self._settings = settings
        self._wanted = wanted
        self._source = source
        self._about = about
        self._others = others
        self._progress = progress
        self._intake = Intake(options.buffer * 10**6, _LAST_NS[source.profile])
        self._changed = threading.Event()
        self._is_stopped = False
        self._is_paused = options.start_paused
        self._splits: list[_Split] = []
        self._rates: dict[str, tuple[float, int, int, float, float]] = {}
        self.address = source.address

    @property
    def received(self) -> int:
        """Number of messages received so far."""
        return sum(self._intake.received.values())

    @property
    def unfinished(self) -> list[Path]:
        """Folders of recordings that are not datasets yet."""
        return [split.folder for split in self._splits if split.folder.is_dir()]

    # ------------------------------------------------------------ controls

    @property
    def is_paused(self) -> bool:
        """Whether the recording is paused."""
        return self._is_paused

    def pause(self) -> None:
        """Pause: ignore messages from now on."""
        self._is_paused = True

    def resume(self) -> None:
        """Resume after a pause."""
        self._is_paused = False

    def toggle_paused(self) -> None:
        """Pause or resume."""
        self._is_paused = not self._is_paused

    def split(self) -> None:
        """Start a new dataset."""
        if self._splits:
            self._splits[-1].is_asked = True

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
        with quick_switches():
            return self._run()

    def _run(self) -> RecordSummary:
        summary = RecordSummary()
        self._warn_of_unfinished()
        begun = time.monotonic()
        self._begin_split()
        try:
            self._source.serve(self)
            self._source.start(self._wanted, self._take)
            while not self._is_stopped:
                self._changed.wait(_REPORT_S)
                self._changed.clear()
                if self._source.state.waiting_for:
                    begun = time.monotonic()
                self._go_on(begun)
        finally:
            self._source.close()
            self._intake.close()
            self._drain(begun)
            for split in self._splits:
                self._finish(split, begun)
        summary.datasets = [split.made for split in self._splits if split.made]
        summary.seconds = time.monotonic() - begun
        summary.dropped = dict(self._intake.dropped)
        summary.lost = dict(self._source.state.lost)
        summary.untimed = dict(self._intake.untimed)
        summary.warnings = list(self._source.state.warnings)
        return summary

    def _take(self, message: Message) -> None:
        if not self._is_paused:
            self._intake.put(message)

    def _go_on(self, begun: float) -> None:
        current = self._splits[-1]
        if current.error is not None:
            self._is_stopped = True
        elif current.is_read:
            self._begin_split()
        if self._options.duration and time.monotonic() - begun >= self._options.duration:
            self._is_stopped = True
        clock = self._source.state.waiting_for
        state = f"waiting for {clock}" if clock else "recording"
        self._report(begun, "paused" if self._is_paused else state)

    def _begin_split(self) -> None:
        number = len(self._splits)
        is_numbered = bool(self._options.max_duration or self._options.max_size or number)
        target = self._target
        if is_numbered:
            target = target.with_name(f"{target.name}_{number}")
        self._splits.append(_Split(self, target, is_spare=number > 0, tell=self._changed.set))

    def _drain(self, begun: float) -> None:
        """Write what is still buffered, into further datasets where the current one is complete."""
        while True:
            split = self._splits[-1]
            while not split.is_read and not split.join(_REPORT_S):
                self._report(begun, "finishing")
            if split.error is not None or not self._intake.waiting_bytes:
                return
            self._begin_split()

    def _finish(self, split: _Split, begun: float) -> None:
        """Wait until a dataset is complete.

        Raises:
            Mp4dsError: It could not be made.
        """
        while not split.join(_REPORT_S):
            self._report(begun, "finishing")
        split.raise_error()

    def _report(self, begun: float, state: str) -> None:
        if self._progress is None:
            return
        split, now = self._splits[-1], time.monotonic()
        verbatim = split.verbatim
        topics = {
            topic: self._topic(topic, now, verbatim.get(topic, 0))
            for topic in sorted({*self._source.state.topics, *self._intake.received})
        }
        self._progress(
            RecordProgress(
                dataset=split.target,
                seconds=now - begun,
                state=state,
                topics=topics,
                waiting_bytes=self._intake.waiting_bytes,
                bytes_written=split.size,
                warnings=list(self._source.state.warnings),
            )
        )

    def _topic(self, topic: str, now: float, verbatim: int) -> TopicProgress:
        count, size = self._intake.received[topic], self._intake.received_bytes[topic]
        then, its_count, its_size, hz, rate = self._rates.get(topic, (now, count, size, 0.0, 0.0))
        if now - then >= 1.0 or topic not in self._rates:
            elapsed = max(now - then, _REPORT_S)
            hz, rate = (count - its_count) / elapsed, (size - its_size) / elapsed
            self._rates[topic] = (now, count, size, hz, rate)
        return TopicProgress(
            messages=count,
            hz=hz,
            bytes_per_s=rate,
            verbatim=verbatim,
            dropped=self._intake.dropped[topic],
            lost=self._source.state.lost[topic],
            untimed=self._intake.untimed[topic],
        )

    def _warn_of_unfinished(self) -> None:
        """Warn of unfinished recordings next to this one."""
        for folder in sorted(self._target.parent.glob(f"*{UNFINISHED}")):
            if is_unfinished(folder):
                self._source.state.warn(
                    f"{folder}: unfinished recording; if no recorder is writing it any more, "
                    f"recover it: {salvage_command(folder)}"
                )


class _Split:
    """One dataset of a recording, made in its own thread."""

    def __init__(
        self, recorder: Recorder, target: Path, *, is_spare: bool, tell: Callable[[], None]
    ) -> None:
        options, source = recorder._options, recorder._source
        self.target = target
        self.made: PackSummary | None = None
        self.error: BaseException | None = None
        self.is_read = False
        self.is_asked = False
        self._is_spare = is_spare  # not made if no message is left for it
        self._tell = tell
        self._force = options.force
        self._about = recorder._about
        self._most_ns = round((options.max_duration or 0) * _NS)
        self._most_bytes = options.max_size
        self._next_look = 0.0
        self.folder = target.with_name(target.name + UNFINISHED)
        check_target(target, force=options.force, owned=dataset_files)
        try:
            self.folder.mkdir()
        except FileExistsError:
            raise TargetError(
                self.folder,
                "already exists: a recording of this name was not finished",
                f"Choose another name, or recover that one first: {salvage_command(self.folder)}",
            ) from None
        except OSError as error:
            raise WriteError(target, error) from None
        facts = {"format": source.format, "profile": source.profile}
        self._profile = str(recorder._settings.quality)
        self._journal = Journal(self.folder, {**facts, "quality": self._profile})
        self._recording = LiveRecording(target, source.format, source.profile, recorder._others)
        self._packer = LivePacker(
            self._recording,
            self.folder,
            PartSettings(recorder._settings, selected=Selection()),
            self._journal,
            intake=recorder._intake,
            announced=lambda: [*filter(None, list(source.state.topics.values()))],
            is_over=self._is_over,
            on_read=self._on_read,
        )
        self._thread = threading.Thread(target=self._run, name="recording", daemon=True)
        self._thread.start()

    @property
    def size(self) -> int:
        """Bytes of its files so far."""
        with suppress(OSError):
            return folder_size(self.folder)
        return 0

    @property
    def verbatim(self) -> Counter[str]:
        """Camera messages stored as received, by topic."""
        topics = list(self._packer.part.topics.values())
        return Counter({t.topic: sum(count for count, _ in t.verbatim.values()) for t in topics})

    def _is_over(self, part: PartRecord) -> bool:
        if self.error is not None or self.is_asked:
            return True
        if self._most_ns and part.span and part.span[1] - part.span[0] >= self._most_ns:
            return True
        if self._most_bytes and time.monotonic() >= self._next_look:
            self._next_look = time.monotonic() + _REPORT_S
            return self.size >= self._most_bytes
        return False

    def _on_read(self) -> None:
        self.is_read = True
        self._tell()

    def _run(self) -> None:
        try:
            part = self._packer.run()
            if self._is_spare and not part.span:
                for path in (part.messages_path, self._journal.path):
                    path.unlink()
                with suppress(OSError):  # somebody else put a file there
                    self.folder.rmdir()
                return
            origin = Origin(about=self._about)
            write_manifest(part, self._recording, origin, self._profile)
            self.made = summarize(part, self.target, None, origin)
            self._journal.close()
            (self.folder / JOURNAL_NAME).unlink()
            sync(self.folder)
            with work_folder(self.target.parent, f".{self.target.name}.") as old:
                move_into_place(
                    self.folder,
                    self.target,
                    old / self.target.name,
                    force=self._force,
                    owned=dataset_files,
                )
        except BaseException as error:
            self.error = error
        finally:
            self._journal.close()
            self._tell()

    def join(self, seconds: float) -> bool:
        """Wait until it is complete; returns whether it is."""
        self._thread.join(seconds)
        return not self._thread.is_alive()

    def raise_error(self) -> None:
        """Raise the error it failed with, if any.

        Raises:
            RecordError: The disk is full, or failed.
        """
        if self.error is None:
            return
        if isinstance(self.error, OSError) and not isinstance(self.error, Mp4dsError):
            raise RecordError(self.folder, self.target, self.error) from self.error
        raise self.error
