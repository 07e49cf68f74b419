"""The page's files: static ones, and the data of a dataset as scripts."""

from __future__ import annotations

import json
from collections import Counter
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from mp4ds._version import __version__
from mp4ds.dataset.dataset import Dataset
from mp4ds.dataset.stream import Stream
from mp4ds.errors import FormatError, SourceError
from mp4ds.format.fields import MESSAGES_NAME
from mp4ds.messages.encodings import ENCODINGS
from mp4ds.plugins.info import notes_of, topics_of
from mp4ds.plugins.reporting.cameras import ReportedCamera, axis_of, untimed
from mp4ds.records import Message

PAGE = files("mp4ds.plugins.reporting") / "page"
"""The page's static files."""

INDEX_NAME = "index.html"
FOLDER_NAME = "report"
DATA_NAME = "data.js"

_DATA_SIGN = b"/* made by mp4ds report */\n"
_MOST_NOTES = 200
_MOST_READ = 2**30
"""Maximum size of messages.mcap up to which it is read to measure each topic's share."""


def write_folder(
    folder: Path, dataset: Dataset, cameras: list[ReportedCamera], problems: list[str]
) -> None:
    """Write all of the report except index.html and proxies.

    Args:
        folder: Where to.
        dataset: The dataset.
        cameras: In the order of the page.
        problems: What could not be shown of the dataset; gets what cannot be read now.

    Raises:
        OSError: It cannot be written.
    """
    for part in PAGE.iterdir():
        if part.name.endswith((".js", ".css")):
            (folder / part.name).write_bytes(part.read_bytes())
    for number, camera in enumerate(cameras):
        columns = _call("columns", number, camera.columns())
        (folder / f"columns-{number}.js").write_bytes(columns)
    facts = _facts(dataset, cameras, problems)
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


def _facts(dataset: Dataset, cameras: list[ReportedCamera], problems: list[str]) -> dict[str, Any]:
    manifest = dataset.manifest
    both = [{"stamp": c.stream.stamps, "log_time": c.stream.log_times} for c in cameras]
    axis, reasons = axis_of(both), untimed(both)
    # running maximum: the page shows a frame from the latest time so far
    base = min((int(columns[axis][0]) for columns in both), default=0)
    timed = [number for number, reason in enumerate(reasons) if not reason]
    try:
        topics = _topic_rows(dataset)
    except (FormatError, SourceError) as error:
        problems.append(str(error))
        topics = []
    notes = list(dict.fromkeys([*problems, *notes_of(dataset)]))
    more = [f"and {len(notes) - _MOST_NOTES} more"] if len(notes) > _MOST_NOTES else []
    return {
        "name": dataset.path.resolve().name,
        "version": __version__,
        "axis": axis,
        "base": str(base),
        "summary": _summary(dataset, topics),
        "reference": timed[0] if len(timed) > 1 else None,
        "cameras": [
            camera.facts(
                number, cameras[timed[0]] if number in timed[1:] else None, reasons[number]
            )
            for number, camera in enumerate(cameras)
        ],
        "topics": topics,
        "transforms": [item.model_dump() for item in manifest.transforms] if manifest else [],
        "notes": [*notes[:_MOST_NOTES], *more],
    }


def _summary(dataset: Dataset, topics: list[dict[str, Any]]) -> dict[str, Any]:
    """Figures of the whole dataset: bytes, and nanoseconds as text, as BigInt reads them."""
    manifest = dataset.manifest
    summary: dict[str, Any] = {
        "messages": sum(row["messages"] for row in topics),
        "topics": len(topics),
    }
    if manifest is None:
        return summary | {"profile": dataset.streams[0].sidecar.profile}
    if span := manifest.time_range:
        summary |= {"start": str(span.start), "end": str(span.end)}
    return summary | {
        "profile": manifest.profile,
        "format": manifest.format,
        "bytes": sum(entry.size for entry in manifest.files),
        "source_bytes": sum(source.size for source in manifest.sources),
        "sources": [source.name for source in manifest.sources][:_MOST_NOTES],
    }


# ---------------------------------------------------------------- topics


def _topic_rows(dataset: Dataset) -> list[dict[str, Any]]:
    """The topics by name, with the bytes that each had in the recording.

    Raises:
        FormatError: The dataset is damaged.
        SourceError: messages.mcap cannot be read.
    """
    recorded = _recorded_bytes(dataset)
    rows = []
    for item in topics_of(dataset):
        size = recorded.get(item.topic)
        rows.append(
            {
                "topic": item.topic,
                "type_name": item.type_name,
                "messages": item.messages,
                "rate_hz": item.rate_hz,
                "stored": item.stored or MESSAGES_NAME,
                "recorded_bytes": size,
                "stored_bytes": item.bytes,
                "ratio": size / item.bytes if size and item.bytes else None,
            }
        )
    return rows


def _recorded_bytes(dataset: Dataset) -> dict[str, int]:
    """Bytes of each topic's messages as recorded, where known without reading a large file."""
    sizes: Counter[str] = Counter(dict.fromkeys(dataset.all_topics, 0))
    if dataset.manifest is not None:
        if (dataset.path / MESSAGES_NAME).stat().st_size > _MOST_READ:
            return {}
        for record in dataset.messages_file.in_file_order():
            if isinstance(record, Message):
                sizes[record.channel.topic] += len(record.data)
    unknown = set()
    for stream in dataset.streams:
        size = _image_bytes(stream)
        if size is None:
            unknown.add(stream.topic)
        sizes[stream.topic] += size or 0
        if stream.sidecar.camera_info is not None:
            unknown.add(stream.sidecar.camera_info.channel.topic)
    return {topic: size for topic, size in sizes.items() if topic not in unknown}


def _image_bytes(stream: Stream) -> int | None:
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
