"""All topics of a dataset: messages, bytes, and where they are stored."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from mp4ds.dataset import Dataset
from mp4ds.layouts import ENCODINGS
from mp4ds.records import Message
from mp4ds.sidecar import MESSAGES_NAME
from mp4ds.streams import Stream

_MOST_READ = 2**30
"""Bytes of messages.mcap that are read to find out how much of it each topic is."""


@dataclass
class TopicRow:
    """One topic of the page's table.

    Attributes:
        topic: Its name.
        type_name: Its message type, of several publishers all.
        messages: Number of messages.
        rate_hz: Mean rate by log time, or None.
        stored: Names of its files.
        recorded_bytes: Of its messages' data as recorded; None where it is not known.
        stored_bytes: Of its videos and sidecars; None where it has none.
        is_camera: Whether it has a video.
    """

    topic: str
    type_name: str
    messages: int = 0
    rate_hz: float | None = None
    stored: str = MESSAGES_NAME
    recorded_bytes: int | None = None
    stored_bytes: int | None = None
    is_camera: bool = False

    @property
    def ratio(self) -> float | None:
        """How many times smaller it is stored; None where it is not known."""
        if not self.recorded_bytes or not self.stored_bytes:
            return None
        return self.recorded_bytes / self.stored_bytes


def topic_rows(dataset: Dataset) -> list[TopicRow]:
    """The topics of a dataset, by name.

    Raises:
        FormatError: The dataset is damaged.
        SourceError: messages.mcap cannot be read.
    """
    times = dataset.times()
    rows: dict[str, TopicRow] = {}
    for channel in dataset.channels:
        row = rows.setdefault(channel.topic, TopicRow(channel.topic, channel.type_name))
        if channel.type_name not in row.type_name.split(" | "):
            row.type_name += f" | {channel.type_name}"
        row.messages += len(times.get(channel.id, ()))
    for topic, row in rows.items():
        found = [times[c.id] for c in dataset.channels if c.topic == topic and c.id in times]
        merged = np.concatenate(found) if found else np.empty(0, np.int64)
        span = int(merged.max()) - int(merged.min()) if len(merged) else 0
        row.rate_hz = (len(merged) - 1) * 1e9 / span if span else None
    sizes = _bytes_in_messages(dataset)
    for topic, row in rows.items():
        row.recorded_bytes = None if sizes is None else sizes.get(topic, 0)
    for stream in dataset.streams:
        _add_stream(rows, stream)
    return [rows[topic] for topic in sorted(rows)]


def _add_stream(rows: dict[str, TopicRow], stream: Stream) -> None:
    info = stream.sidecar.camera_info
    if info is not None and info.channel.topic in rows:
        row = rows[info.channel.topic]
        if row.messages and not row.is_camera:
            row.stored, row.recorded_bytes = stream.path.name, None
    row = rows[stream.topic]
    recorded = recorded_bytes(stream)
    if not row.is_camera:
        row.is_camera, row.stored, row.stored_bytes = True, "", 0
        row.recorded_bytes = row.recorded_bytes or 0
    row.stored = ", ".join(filter(None, (row.stored, stream.sidecar.video.file)))
    files = (stream.video_path, stream.path)
    row.stored_bytes = (row.stored_bytes or 0) + sum(
        file.stat().st_size for file in files if file.is_file()
    )
    row.recorded_bytes = (
        None if recorded is None or row.recorded_bytes is None else row.recorded_bytes + recorded
    )


def recorded_bytes(stream: Stream) -> int | None:
    """Bytes of a stream's images as recorded; None where files were made into pixels.

    Packets are counted as large as their video.
    """
    sidecar = stream.sidecar
    if sidecar.body == "pixels":
        image = sidecar.image
        return len(stream) * ENCODINGS[image.encoding].size(image.step, image.height)
    if sidecar.body == "packet" and stream.video_path.is_file():
        return stream.video_path.stat().st_size
    return None


def _bytes_in_messages(dataset: Dataset) -> Counter[str] | None:
    """Bytes of each topic's messages in messages.mcap; None where the file is too large to ask."""
    sizes: Counter[str] = Counter()
    if dataset.manifest is None:
        return sizes
    if (dataset.path / MESSAGES_NAME).stat().st_size > _MOST_READ:
        return None
    for record in dataset.recorded_records():
        if isinstance(record, Message):
            sizes[record.channel.topic] += len(record.data)
    return sizes
