"""``info``: what is in a recording or a dataset, or in many datasets."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.formats import open_reader
from mp4ds.bags.latched import take_slice
from mp4ds.bags.protocols import BagReader
from mp4ds.dataset.dataset import Dataset
from mp4ds.errors import Refused, SourceError, counted
from mp4ds.files.urls import location
from mp4ds.format.models import Calibration
from mp4ds.format.sidecars import MANIFEST_NAME, load_manifest, names_dataset
from mp4ds.messages.serializations import MessageSplitter, kind_of
from mp4ds.messages.wire import CalibrationFields, CodedFields, ImageFields
from mp4ds.options import SliceOptions, iso_text
from mp4ds.packing.planning import open_recording
from mp4ds.records import Channel, latched_text
from mp4ds.times import intervals, lost_frames


@dataclass
class TopicInfo:
    """Information about a topic.

    Attributes:
        topic: Its name.
        type_name: Its message type.
        messages: Number of messages.
        rate_hz: Mean rate, from the log times of the first and the last message.
        jitter_ms: Standard deviation of the times between messages.
        gaps: Places where messages are missing, judging by log times: see `lost_frames`.
        longest_gap_s: The longest time between two messages.
        content: For images the encoding and size, for calibrations the focal length.
        stored: In a dataset, where and how: codec and file.
        bytes: In a dataset, bytes of the topic's videos and their sidecars.
    """

    topic: str
    type_name: str
    messages: int = 0
    rate_hz: float | None = None
    jitter_ms: float | None = None
    gaps: int = 0
    longest_gap_s: float | None = None
    content: str = ""
    stored: str = ""
    bytes: int | None = None


@dataclass
class Info:
    """Information about a recording or dataset. Times are nanoseconds.

    Attributes:
        path: The recording or dataset.
        kind: ``bag``, ``rosbag2``, ``mcap``, ``dataset`` or ``stream``.
        profile: ``ros1``, ``ros2`` ...
        bytes: Size on disk.
        start: Earliest log time.
        end: Latest log time.
        topics: By name.
        notes: What else is worth knowing.
    """

    path: Path
    kind: str
    profile: str
    bytes: int
    start: int | None = None
    end: int | None = None
    topics: list[TopicInfo] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def info(path: Path | str, asked: SliceOptions | None = None) -> Info:
    """Inspect a recording, a dataset, or a video with its sidecar.

    Args:
        path: Its path or URL.
        asked: The slice to inspect. For a slice of a dataset, what would be unpacked.

    Raises:
        SourceError: It is not a recording or cannot be read.
        FormatError: The dataset breaks a rule of the format.
        OptionError: The slice is empty.
    """
    place = location(path)
    if asked is not None and not asked.is_slice:
        asked = None
    if asked is None and names_dataset(place):
        with Dataset(place) as dataset:
            return _dataset_info(dataset)
    with open_recording([place]) if asked else open_reader(place) as reader:
        if asked:
            take_slice(reader, asked)
        size = sum(file.stat().st_size for file in reader.files)
        times, channels = reader.times(), list(reader.channels)
        topics = _topics(channels, times)
        by_topic = {item.topic: item for item in topics}
        for channel in channels:
            item = by_topic[channel.topic]
            if not item.content and kind_of(channel):
                item.content = _content(reader, channel)
        return Info(reader.path, reader.format, reader.profile, size, *_span(times), topics)


def _span(times: Mapping[int, NDArray[np.int64]]) -> tuple[int | None, int | None]:
    """The time of the first and of the last message."""
    known = [found for found in times.values() if len(found)]
    first = min((int(found[0]) for found in known), default=None)
    return first, max((int(found[-1]) for found in known), default=None)


def _topics(channels: Sequence[Channel], times: Mapping[int, NDArray[np.int64]]) -> list[TopicInfo]:
    by_topic: dict[str, list[Channel]] = {}
    for channel in channels:
        by_topic.setdefault(channel.topic, []).append(channel)
    topics = []
    for topic, own in sorted(by_topic.items()):
        found = [times[channel.id] for channel in own if channel.id in times]
        merged = np.sort(np.concatenate(found)) if found else np.empty(0, np.int64)
        types = dict.fromkeys(channel.type_name for channel in own)
        item = TopicInfo(topic, " | ".join(types), len(merged))
        if len(merged) > 1 and merged[-1] > merged[0]:
            steps = intervals(merged)
            item.rate_hz = (len(merged) - 1) * 1e9 / float(merged[-1] - merged[0])
            item.jitter_ms = float(steps.std()) / 1e6
            item.gaps = int((lost_frames(steps) > 0).sum())
            item.longest_gap_s = float(steps.max()) / 1e9
        if len(own) > 1:
            item.content = f"{len(own)} publishers"
        topics.append(item)
    return topics


def _content(reader: BagReader, channel: Channel) -> str:
    message = reader.first(channel)
    if message is None:
        return ""
    try:
        fields = MessageSplitter(channel).split(message)[1].fields
    except Refused as reason:
        return f"unreadable: {reason}"
    if isinstance(fields, ImageFields):
        return f"{fields.encoding} {fields.width}x{fields.height}"
    if isinstance(fields, CodedFields):
        return fields.format
    return _intrinsics_text(fields)


def _intrinsics_text(of: CalibrationFields | Calibration) -> str:
    """A calibration in one line."""
    k, model = of.k, of.distortion_model or "-"
    return f"{of.width}x{of.height} {model} fx={k[0]:.1f} fy={k[4]:.1f} cx={k[2]:.1f} cy={k[5]:.1f}"


def _dataset_info(dataset: Dataset) -> Info:
    manifest = dataset.manifest
    files = (
        [dataset.path / entry.name for entry in manifest.files]
        if manifest
        else [path for stream in dataset.streams for path, _ in stream.videos]
    )
    return Info(
        dataset.path,
        "dataset" if manifest else "stream",
        dataset.profile,
        sum(file.stat().st_size for file in files if file.is_file()),
        *_span(dataset.times()),
        topics_of(dataset),
        notes_of(dataset),
    )


def topics_of(dataset: Dataset) -> list[TopicInfo]:
    """The topics of a dataset by name, and where they are stored.

    Raises:
        FormatError: The dataset is damaged.
        SourceError: messages.mcap cannot be read.
    """
    topics = _topics(dataset.channels, dataset.times())
    by_topic = {item.topic: item for item in topics}
    for stream in dataset.streams:
        sidecar, item = stream.sidecar, by_topic[stream.topic]
        image = f"{sidecar.image.encoding} {sidecar.image.width}x{sidecar.image.height}"
        item.content = ", ".join(filter(None, (item.content, image)))
        stored = f"{sidecar.video.codec} {sidecar.profile}: {sidecar.video.file}"
        view = f"view: {sidecar.view.file}" if sidecar.view else ""
        item.stored = ", ".join(filter(None, (item.stored, stored, view)))
        sizes = [path.stat().st_size for path in stream.files if path.is_file()]
        item.bytes = (item.bytes or 0) + sum(sizes)
        info = sidecar.camera_info
        if info and info.calibrations and (other := by_topic.get(info.channel.topic)):
            more = len(info.calibrations) - 1
            other.content = _intrinsics_text(info.calibrations[0])
            other.content += f" (+{more} more)" if more else ""
            other.stored = f"in {stream.path.name}"
    return topics


def notes_of(dataset: Dataset) -> list[str]:
    """What else is worth knowing about a dataset."""
    notes: list[str] = []
    manifest = dataset.manifest
    if manifest:
        notes += [
            f"{item.topic}: {counted(item.messages, 'message')} stored verbatim, the first is "
            f"number {item.first}: {item.reason}"
            for item in manifest.verbatim
        ]
        if dataset.latched_before:
            notes.append(latched_text(dataset.latched_before))
        if manifest.about:
            notes += manifest.about.lines
        if manifest.derived_from:
            earlier = (f"{item.name} ({item.profile})" for item in manifest.derived_from)
            notes.append(f"repacked from {', '.join(earlier)}")
        notes += filter(None, [manifest.reduced])
        notes += [f"lost when packed: {loss.file}: {loss.problem}" for loss in manifest.losses]
        if manifest.topics_left_out:
            notes.append(f"left out when packed: {', '.join(manifest.topics_left_out)}")
    if absence := dataset.absence():
        notes.append(f"{absence}; frames are those of the views")
    sidecars = [(stream.topic, stream.sidecar) for stream in dataset.streams]
    notes += [f"{topic}: {it.video.quality}" for topic, it in sidecars if it.video.quality]
    if any(sidecar.stamps == "record-float" for _, sidecar in sidecars):
        notes.append("times are record times stored as float seconds, so they are not exact")
    return notes


# ---------------------------------------------------------------- many datasets


@dataclass(frozen=True)
class Brief:
    """A dataset's summary from its manifest.

    Attributes:
        path: The dataset.
        profile: Its profile.
        format: Of the recording.
        messages: Number of messages.
        frames: How many of these are video frames, by topic.
        start: First log time, nanoseconds; None without messages.
        end: Last log time, nanoseconds.
        bytes: Of its files.
        title: Its title.
    """

    path: Path
    profile: str
    format: str
    messages: int
    frames: dict[str, int]
    start: int | None
    end: int | None
    bytes: int
    title: str = ""

    @property
    def seconds(self) -> float:
        """From the first message to the last."""
        return 0.0 if self.start is None or self.end is None else (self.end - self.start) / 1e9

    @property
    def begins(self) -> str:
        """Date and time of the first message, UTC, to the second; empty without messages."""
        return "" if self.start is None else iso_text(self.start - self.start % 10**9)


def brief(path: Path) -> Brief:
    """Summarise a dataset from its manifest.

    Raises:
        SourceError: It is not a dataset.
        FormatError: The manifest breaks a rule of the format.
    """
    if not (path / MANIFEST_NAME).is_file():
        raise SourceError(path, "is not a dataset", "Give folders made by `mp4ds pack`.")
    manifest = load_manifest(path / MANIFEST_NAME)
    by_topic: Counter[str] = Counter()
    for stream in manifest.streams:
        by_topic[stream.topic] += stream.frames
    span = manifest.time_range
    return Brief(
        path=path,
        profile=manifest.profile,
        format=manifest.format,
        messages=manifest.messages,
        frames=dict(by_topic),
        start=span.start if span else None,
        end=span.end if span else None,
        bytes=sum(entry.size for entry in manifest.files),
        title=(manifest.about and manifest.about.title) or "",
    )
