"""``info``: what is in a recording or a dataset, without changing or unpacking it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags import BagReader, open_reader
from mp4ds.dataset import Dataset, Stream
from mp4ds.intervals import intervals, lost_frames
from mp4ds.records import Channel
from mp4ds.remote import location
from mp4ds.sidecar import names_dataset
from mp4ds.streams import Forms, Unsuited
from mp4ds.wire import CodedFields, ImageFields, kind_of


@dataclass
class TopicInfo:
    """What is known of a topic.

    Attributes:
        topic: Its name.
        type_name: Its message type.
        messages: Number of messages.
        rate_hz: Mean rate, from the log times of the first and the last message.
        jitter_ms: Standard deviation of the times between messages.
        gaps: Places where messages are missing by the log times: see `intervals.lost_frames`.
        longest_gap_s: The longest time between two messages.
        content: For images the encoding and size, for calibrations the focal length.
        stored: In a dataset, where and how: codec and file.
        bytes: In a dataset, bytes of the topic's videos.
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
    """What is known of a recording or dataset. Times are nanoseconds.

    Attributes:
        path: What was looked at.
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


def info(path: Path | str) -> Info:
    """Look into a recording, a dataset, or a video with its sidecar.

    Args:
        path: Where it is, or its URL.

    Raises:
        SourceError: It is no recording or cannot be read.
        FormatError: The dataset breaks a rule of the format.
    """
    path = location(path)
    if names_dataset(path):
        with Dataset(path) as dataset:
            return _dataset_info(dataset)
    with open_reader(path) as reader:
        return _recording_info(reader)


def _recording_info(reader: BagReader) -> Info:
    size = sum(file.stat().st_size for file in reader.files)
    result = Info(reader.path, reader.format, reader.profile, size)
    times = reader.times()
    _add_topics(result, list(reader.channels), times)
    by_topic = {item.topic: item for item in result.topics}
    for channel in reader.channels:
        item = by_topic[channel.topic]
        if not item.content and kind_of(channel):
            item.content = _content(reader, channel)
    return result


def _add_topics(
    result: Info, channels: list[Channel], times: Mapping[int, NDArray[np.int64]]
) -> None:
    by_topic: dict[str, list[Channel]] = {}
    for channel in channels:
        by_topic.setdefault(channel.topic, []).append(channel)
    for topic, own in sorted(by_topic.items()):
        found = [times[channel.id] for channel in own if channel.id in times]
        merged = np.sort(np.concatenate(found)) if found else np.empty(0, np.int64)
        types = list(dict.fromkeys(channel.type_name for channel in own))
        item = _timing(TopicInfo(topic, " | ".join(types)), merged)
        if len(own) > 1:
            item.content = f"{len(own)} publishers"
        result.topics.append(item)
        if len(merged):
            first, last = int(merged[0]), int(merged[-1])
            result.start = first if result.start is None else min(result.start, first)
            result.end = last if result.end is None else max(result.end, last)


def _timing(item: TopicInfo, times: NDArray[np.int64]) -> TopicInfo:
    item.messages = len(times)
    if len(times) < 2 or times[-1] == times[0]:
        return item
    steps = intervals(times)
    item.rate_hz = (len(times) - 1) * 1e9 / float(times[-1] - times[0])
    item.jitter_ms = float(steps.std()) / 1e6
    item.gaps = int((lost_frames(steps) > 0).sum())
    item.longest_gap_s = float(steps.max()) / 1e9
    return item


def _content(reader: BagReader, channel: Channel) -> str:
    message = reader.first(channel)
    if message is None:
        return ""
    try:
        fields = Forms(channel).split(message)[1].fields
    except Unsuited as reason:
        return f"unreadable: {reason}"
    if isinstance(fields, ImageFields):
        return f"{fields.encoding} {fields.width}x{fields.height}"
    if isinstance(fields, CodedFields):
        return fields.format
    return intrinsics_text(fields.width, fields.height, fields.distortion_model, fields.k)


def intrinsics_text(width: int, height: int, model: str, k: Any) -> str:
    """One line for a calibration."""
    return (
        f"{width}x{height} {model or '-'} fx={k[0]:.1f} fy={k[4]:.1f} cx={k[2]:.1f} cy={k[5]:.1f}"
    )


def _dataset_info(dataset: Dataset) -> Info:
    whole = dataset.manifest is not None
    files = (
        [dataset.path / entry.name for entry in dataset.manifest.files]
        if dataset.manifest
        else [stream.video_path for stream in dataset.streams]
    )
    result = Info(
        dataset.path,
        "dataset" if whole else "stream",
        dataset.profile,
        sum(file.stat().st_size for file in files if file.is_file()),
    )
    _add_topics(result, dataset.channels, dataset.times())
    by_topic = {item.topic: item for item in result.topics}
    for stream in dataset.streams:
        _add_stream(by_topic, stream)
    if dataset.manifest:
        result.notes += [
            f"{item.topic}: {item.messages} messages stored verbatim from number {item.first} on: "
            f"{item.reason}"
            for item in dataset.manifest.verbatim
        ]
        if dataset.manifest.topics_left_out:
            left_out = ", ".join(dataset.manifest.topics_left_out)
            result.notes.append(f"left out when packed: {left_out}")
    result.notes += [
        f"{stream.topic}: {stream.sidecar.video.quality}"
        for stream in dataset.streams
        if stream.sidecar.video.quality
    ]
    if any(stream.sidecar.stamps == "record-float" for stream in dataset.streams):
        result.notes.append("times are record times that were stored as float seconds: not exact")
    return result


def _add_stream(by_topic: dict[str, TopicInfo], stream: Stream) -> None:
    sidecar = stream.sidecar
    item = by_topic[stream.topic]
    image = f"{sidecar.image.encoding} {sidecar.image.width}x{sidecar.image.height}"
    item.content = ", ".join(filter(None, (item.content, image)))
    stored = f"{sidecar.video.codec} {sidecar.profile}: {sidecar.video.file}"
    item.stored = ", ".join(filter(None, (item.stored, stored)))
    size = stream.video_path.stat().st_size if stream.video_path.is_file() else 0
    item.bytes = (item.bytes or 0) + size
    info_model = sidecar.camera_info
    if info_model and info_model.calibrations:
        calibration = info_model.calibrations[0]
        text = intrinsics_text(
            calibration.width, calibration.height, calibration.distortion_model, calibration.k
        )
        more = len(info_model.calibrations) - 1
        other = by_topic.get(info_model.channel.topic)
        if other is not None:
            other.content = text + (f" (+{more} more)" if more else "")
            other.stored = f"in {stream.path.name}"
