"""The format of the TUM RGB-D benchmark: rgb, depth, and lists of files by time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from mp4ds.options import seconds_text
from mp4ds.plugins.exporting.job import (
    ExportedCamera,
    ExportJob,
    of_different_times,
    that_png_holds,
)
from mp4ds.plugins.exporting.motion import Poses, Row, imu_rows, in_order, topics_of
from mp4ds.video.images import encoding_as

_IMU = "sensor_msgs/Imu"


def is_depth(camera: ExportedCamera) -> bool:
    """Whether images are depths: by their encoding, or by topic name if mono16."""
    encoding = camera.view.encoding
    has_light = encoding_as(encoding, "rgb") is not None
    return not has_light or (encoding.name == "mono16" and "depth" in camera.topic.lower())


def write(job: ExportJob) -> None:
    """Write the format."""
    source = job.source
    poses = Poses(source.dataset, job.options.poses) if job.options.poses else None
    cameras = that_png_holds(source.cameras, source.stats)
    job.path.mkdir()
    for kind, wanted in (("rgb", False), ("depth", True)):
        alike = [camera for camera in cameras if is_depth(camera) is wanted]
        for camera in alike[:1]:
            _write_images(job, kind, of_different_times(camera, source.stats))
        for camera in alike[1:]:
            reason = f"TUM has one {kind} camera, here {alike[0].topic} (select with --topics)"
            source.stats.add_left_out(camera.topic, reason, len(camera))
    imus = topics_of(source.dataset, _IMU, source.chosen)
    if imus:
        rows = ((time, values[3:]) for time, values in imu_rows(source.dataset, imus[0]))
        _write_rows(job, "accelerometer.txt", imus[0], "timestamp ax ay az", rows)
        job.note(f"{imus[0]}: TUM only keeps an IMU's acceleration")
    if poses is not None:
        job.note(f"{poses.topic}: only position and orientation are kept")
        head = "timestamp tx ty tz qx qy qz qw"
        _write_rows(job, "groundtruth.txt", poses.topic, head, poses.rows())
    if any(camera.calibration for camera in cameras):
        job.note("TUM has no place for calibrations")


def _write_images(job: ExportJob, kind: str, camera: ExportedCamera) -> None:
    names = [f"{kind}/{seconds_text(time)}.png" for time in camera.times.tolist()]
    job.write_png_files(camera, kind, names)
    heads = ["color images" if kind == "rgb" else "depth maps", f"file: {camera.topic}"]
    if kind == "depth":
        unit = "as recorded, in ROS one millimetre (depth factor 1000, not TUM's 5000)"
        heads.append(f"unit: {unit}")
        job.note(f"{camera.topic}: depths are in units {unit}")
    rows = zip(map(seconds_text, camera.times.tolist()), names, strict=True)
    _write_list(job.path / f"{kind}.txt", [*heads, "timestamp filename"], map(" ".join, rows))


def _write_rows(job: ExportJob, name: str, topic: str, head: str, rows: Iterable[Row]) -> None:
    count = 0

    def lines() -> Iterator[str]:
        nonlocal count
        for time, values in in_order(rows):
            count += 1
            yield " ".join([seconds_text(time), *map(repr, map(float, values))])

    _write_list(job.path / name, [f"file: {topic}", head], lines())
    job.places[name] = topic
    job.source.stats.add_exported(topic, count)


def _write_list(path: Path, heads: Iterable[str], lines: Iterable[str]) -> None:
    with path.open("w", encoding="utf-8") as file:
        # a topic may be of several lines
        file.writelines(f"# {' '.join(head.splitlines())}\n" for head in heads)
        file.writelines(f"{line}\n" for line in lines)
