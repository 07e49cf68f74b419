"""A stream as a folder of image files."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

from mp4ds.dataset import Stream
from mp4ds.republish import files_of, holds_files
from mp4ds.video import ImageFile


def write_images(
    stream: Stream, folder: Path, *, image_format: str, jpeg_quality: int
) -> Iterator[None]:
    """Write one file per frame, and stamps.csv that tells the times of each.

    Args:
        stream: The stream.
        folder: Where to write; empty.
        image_format: ``png`` or ``jpeg``.
        jpeg_quality: Of JPEG files that are made, 1 to 100.

    Yields:
        After each file.
    """
    columns, headers = stream.rebuilder.columns, stream.sidecar.headers
    suffix = "jpg" if image_format == "jpeg" else "png"
    digits = len(str(len(stream) - 1))
    with (folder / "stamps.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["file", "stamp_ns", "log_time_ns", "frame_id"])
        for index, data in enumerate(_files(stream, image_format, jpeg_quality)):
            name = f"{index:0{digits}d}.{suffix}"
            (folder / name).write_bytes(data)
            frame_id = headers[int(columns.variant[index])].frame_id
            rows.writerow([name, int(columns.stamp[index]), int(columns.log_time[index]), frame_id])
            yield


def _files(stream: Stream, image_format: str, jpeg_quality: int) -> Iterator[bytes | memoryview]:
    """The recorded JPEG files where these are wanted, else files of the frames."""
    if image_format == "jpeg" and holds_files(stream.sidecar, "jpeg"):
        return files_of(stream)
    writer = ImageFile(stream.sidecar.image.encoding, image_format, quality=jpeg_quality)
    return (writer.encode(frame.data) for frame in stream)
