"""A stream as a folder of image files."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from pathlib import Path

from mp4ds.dataset import Stream
from mp4ds.republish import Reduction, holds_files, image_files

_STAMPS_NAME = "stamps.csv"
_HEAD = ["file", "stamp_ns", "log_time_ns", "frame_id"]


def write_images(
    stream: Stream,
    folder: Path,
    *,
    image_format: str | None,
    jpeg_quality: int,
    reduction: Reduction,
) -> Iterator[None]:
    """Write one file per frame, called by its number, and stamps.csv that tells the times of each.

    Args:
        stream: The stream.
        folder: Where to write; empty.
        image_format: ``png`` or ``jpeg``; None for JPEG files as they were recorded, else PNG.
        jpeg_quality: Of JPEG files that are made, 1 to 100.
        reduction: How much smaller or fewer they are.

    Yields:
        After each file.
    """
    columns, headers = stream.rebuilder.columns, stream.sidecar.headers
    if image_format is None:
        keeps = reduction.size_of(stream) is None and holds_files(stream.sidecar, "jpeg")
        image_format = "jpeg" if keeps else "png"
    suffix = "jpg" if image_format == "jpeg" else "png"
    digits = len(str(len(stream) - 1))
    with (folder / _STAMPS_NAME).open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(_HEAD)
        files = image_files(stream, image_format, reduction, jpeg_quality=jpeg_quality)
        for index, data in files:
            name = f"{index:0{digits}d}.{suffix}"
            (folder / name).write_bytes(data)
            frame_id = headers[int(columns.variant[index])].frame_id
            rows.writerow([name, int(columns.stamp[index]), int(columns.log_time[index]), frame_id])
            yield


def image_names(folder: Path) -> set[str] | None:
    """Names of the files of image folders, by their stamps.csv; None where there is none."""
    if not folder.is_dir():
        return None
    names: set[str] = set()
    for place in folder.iterdir():
        if place.is_dir():
            names.update(f"{place.name}/{name}" for name in _names_in(place / _STAMPS_NAME))
    return names or None


def _names_in(stamps: Path) -> set[str]:
    try:
        rows = csv.reader(io.StringIO(stamps.read_bytes().decode(), newline=""))
        if next(rows, None) != _HEAD:
            return set()
        return {stamps.name, *(row[0] for row in rows if row)}
    except (OSError, ValueError, csv.Error):
        return set()
