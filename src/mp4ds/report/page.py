"""The page's files: what never changes, and the data of a dataset as scripts."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict
from datetime import datetime, timezone
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from mp4ds._version import __version__
from mp4ds.dataset import Dataset
from mp4ds.report.cameras import Camera
from mp4ds.report.timing import axis_of, untimed
from mp4ds.report.topics import TopicRow

INDEX_NAME = "index.html"
FOLDER_NAME = "report"
DATA_NAME = "data.js"
PROXIES_NAME = "proxies"

_DATA_SIGN = b"/* made by mp4ds report */\n"
_MOST_NOTES = 200


def index_page() -> bytes:
    """index.html, the same for every dataset."""
    return (files("mp4ds.report") / "page" / INDEX_NAME).read_bytes()


def write_folder(
    folder: Path, dataset: Dataset, cameras: list[Camera], topics: list[TopicRow], notes: list[str]
) -> None:
    """Write all of the report but its index.html and proxies.

    Args:
        folder: Where to.
        dataset: What it is about.
        cameras: In the order of the page.
        topics: Of the dataset.
        notes: What else is worth knowing.

    Raises:
        OSError: The disk refused.
    """
    for part in (files("mp4ds.report") / "page").iterdir():
        if part.name.endswith((".js", ".css")):
            (folder / part.name).write_bytes(part.read_bytes())
    for number, camera in enumerate(cameras):
        columns = _call("columns", number, camera.columns())
        (folder / f"columns-{number}.js").write_bytes(columns)
    facts = _facts(dataset, cameras, topics, notes)
    (folder / DATA_NAME).write_bytes(_DATA_SIGN + _call("dataset", facts))


def _call(name: str, *values: Any) -> bytes:
    """A script that hands values to the page."""
    return f"mp4dsReport.{name}({', '.join(map(as_script, values))});\n".encode()


def as_script(value: Any) -> str:
    """A value as a script has it: ASCII, and safe within an element of a page, too.

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
    dataset: Dataset, cameras: list[Camera], topics: list[TopicRow], notes: list[str]
) -> dict[str, Any]:
    manifest = dataset.manifest
    both = [{"stamp": c.stamps, "log_time": c.log_times} for c in cameras]
    axis, reasons = axis_of(both), untimed(both)
    columns = [c.stamps if axis == "stamp" else c.log_times for c in cameras]
    # at most: the page shows a frame from the latest time so far on
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
    """Figures of the whole dataset; bytes, nanoseconds as text, and None for what is not known."""
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
    """A time in UTC, to the second; empty beyond the calendar."""
    try:
        moment = datetime.fromtimestamp(time_ns // 10**9, timezone.utc)
    except (OverflowError, OSError, ValueError):
        return ""
    return f"{moment:%Y-%m-%d %H:%M:%S} UTC"


def _notes(dataset: Dataset) -> Iterable[str]:
    manifest = dataset.manifest
    if any(stream.sidecar.stamps == "record-float" for stream in dataset.streams):
        yield "Times are record times that were stored as float seconds: they are not exact."
    if manifest is None:
        return
    for item in manifest.verbatim:
        yield (
            f"{item.topic}: {item.messages} messages are in messages.mcap as they were, from "
            f"number {item.first} on: {item.reason}."
        )
    for loss in manifest.losses:
        yield f"Lost when it was packed: {loss.file}: {loss.problem}."
    if manifest.topics_left_out:
        yield f"Left out when it was packed: {', '.join(manifest.topics_left_out)}."
