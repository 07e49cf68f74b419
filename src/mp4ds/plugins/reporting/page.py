"""The page's files: static ones, and the data of a dataset as scripts."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from mp4ds._version import __version__
from mp4ds.dataset.dataset import Dataset
from mp4ds.dataset.stream import Stream
from mp4ds.errors import counted
from mp4ds.format.fields import MESSAGES_NAME
from mp4ds.messages.encodings import ENCODINGS
from mp4ds.plugins.reporting.cameras import ReportedCamera, axis_of, untimed
from mp4ds.records import Message

_MOST_READ = 2**30
"""Maximum size of messages.mcap up to which it is read to measure each topic's share."""


@dataclass
class TopicRow:
    """One topic of the page's table.

    Attributes:
        topic: Its name.
        type_name: Its message type; all types if publishers differ.
        messages: Number of messages.
        rate_hz: Mean rate by log time, or None.
        stored: Names of its files.
        recorded_bytes: Of its messages' data as recorded; None if unknown.
        stored_bytes: Of its videos and sidecars; None if it has none.
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
        """Compression ratio; None if unknown."""
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
    """Bytes of a stream's images as recorded; None if files were converted to pixels.

    Packets count as the size of their video.
    """
    sidecar = stream.sidecar
    if sidecar.body == "pixels":
        image = sidecar.image
        return len(stream) * ENCODINGS[image.encoding].size(image.step, image.height)
    if sidecar.body == "packet" and stream.video_path.is_file():
        return stream.video_path.stat().st_size
    return None


def _bytes_in_messages(dataset: Dataset) -> Counter[str] | None:
    """Bytes of each topic's messages in messages.mcap; None if the file is too large to read."""
    sizes: Counter[str] = Counter()
    if dataset.manifest is None:
        return sizes
    if (dataset.path / MESSAGES_NAME).stat().st_size > _MOST_READ:
        return None
    for record in dataset.recorded_records():
        if isinstance(record, Message):
            sizes[record.channel.topic] += len(record.data)
    return sizes


# ---------------------------------------------------------------- page

INDEX_NAME = "index.html"
FOLDER_NAME = "report"
DATA_NAME = "data.js"
PROXIES_NAME = "proxies"

_DATA_SIGN = b"/* made by mp4ds report */\n"
_MOST_NOTES = 200


def index_page() -> bytes:
    """index.html, the same for every dataset."""
    return (files("mp4ds.plugins.reporting") / "page" / INDEX_NAME).read_bytes()


def write_folder(
    folder: Path,
    dataset: Dataset,
    cameras: list[ReportedCamera],
    topics: list[TopicRow],
    notes: list[str],
) -> None:
    """Write all of the report except index.html and proxies.

    Args:
        folder: Where to.
        dataset: The dataset.
        cameras: In the order of the page.
        topics: Of the dataset.
        notes: What else is worth knowing.

    Raises:
        OSError: It cannot be written.
    """
    for part in (files("mp4ds.plugins.reporting") / "page").iterdir():
        if part.name.endswith((".js", ".css")):
            (folder / part.name).write_bytes(part.read_bytes())
    for number, camera in enumerate(cameras):
        columns = _call("columns", number, camera.columns())
        (folder / f"columns-{number}.js").write_bytes(columns)
    facts = _facts(dataset, cameras, topics, notes)
    (folder / DATA_NAME).write_bytes(_DATA_SIGN + _call("dataset", facts))


def _call(name: str, *values: Any) -> bytes:
    """A script that passes values to the page."""
    return f"mp4dsReport.{name}({', '.join(map(as_script, values))});\n".encode()


def as_script(value: Any) -> str:
    """A value as JavaScript: ASCII, and safe inside an HTML element.

    Numbers that are not finite become null.
    """
    return json.dumps(_finite(value), separators=(",", ":")).replace("<", "\\u003c")


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return value


def _facts(
    dataset: Dataset, cameras: list[ReportedCamera], topics: list[TopicRow], notes: list[str]
) -> dict[str, Any]:
    manifest = dataset.manifest
    both = [{"stamp": c.stamps, "log_time": c.log_times} for c in cameras]
    axis, reasons = axis_of(both), untimed(both)
    columns = [c.stamps if axis == "stamp" else c.log_times for c in cameras]
    # running maximum: the page shows a frame from the latest time so far
    base = min((int(times[0]) for times in columns), default=0)
    timed = [number for number, reason in enumerate(reasons) if not reason]
    reference = timed[0] if len(timed) > 1 else None
    return {
        "name": dataset.path.resolve().name,
        "version": __version__,
        "axis": axis,
        "base": str(base),
        "summary": _summary(dataset, topics),
        "reference": reference,
        "cameras": [
            camera.facts(
                number, cameras[timed[0]] if number in timed[1:] else None, reasons[number]
            )
            for number, camera in enumerate(cameras)
        ],
        "topics": [{**asdict(row), "ratio": row.ratio} for row in topics],
        "transforms": [item.model_dump() for item in manifest.transforms] if manifest else [],
        "notes": _shortened([*notes, *_notes(dataset)]),
    }


def _shortened(notes: Iterable[str]) -> list[str]:
    listed = list(dict.fromkeys(notes))
    if len(listed) <= _MOST_NOTES:
        return listed
    return [*listed[:_MOST_NOTES], f"and {len(listed) - _MOST_NOTES} more"]


def _summary(dataset: Dataset, topics: list[TopicRow]) -> dict[str, Any]:
    """Figures of the whole dataset: bytes, nanoseconds as text, and None if unknown."""
    manifest = dataset.manifest
    summary: dict[str, Any] = {
        "messages": sum(row.messages for row in topics),
        "topics": len(topics),
        "profile": manifest.profile if manifest else dataset.streams[0].sidecar.profile,
    }
    if manifest is None:
        return summary
    summary |= {
        "format": manifest.format,
        "recording_profile": manifest.recording_profile,
        "bytes": sum(entry.size for entry in manifest.files),
        "source_bytes": sum(source.size for source in manifest.sources),
        "sources": [source.name for source in manifest.sources][:_MOST_NOTES],
        "tools": manifest.tools,
        "left_out": len(manifest.topics_left_out),
    }
    if manifest.time_range:
        start, end = manifest.time_range.start, manifest.time_range.end
        summary |= {"start": str(start), "end": str(end), "start_text": utc_text(start)}
    return summary


def utc_text(time_ns: int) -> str:
    """A time in UTC, to the second; empty outside the calendar."""
    try:
        moment = datetime.fromtimestamp(time_ns // 10**9, timezone.utc)
    except (OverflowError, OSError, ValueError):
        return ""
    return f"{moment:%Y-%m-%d %H:%M:%S} UTC"


def _notes(dataset: Dataset) -> Iterable[str]:
    manifest = dataset.manifest
    if any(stream.sidecar.stamps == "record-float" for stream in dataset.streams):
        yield "Times are record times stored as float seconds, so they are not exact."
    if manifest is None:
        return
    if manifest.about:
        yield from manifest.about.lines
    for item in manifest.verbatim:
        yield (
            f"{item.topic}: {counted(item.messages, 'message')} stored verbatim in messages.mcap, "
            f"the first is number {item.first}: {item.reason}."
        )
    for loss in manifest.losses:
        yield f"Lost when packing: {loss.file}: {loss.problem}."
    if manifest.topics_left_out:
        yield f"Left out when packing: {', '.join(manifest.topics_left_out)}."
