"""COLMAP: images, and a sparse model of cameras, and of poses if known."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mp4ds.dataset.views import lens_of
from mp4ds.errors import OptionError
from mp4ds.format.models import Calibration
from mp4ds.plan import FileNames
from mp4ds.plugins.exporting.job import (
    ExportedCamera,
    ExportJob,
    hold_calibration,
    of_different_times,
    that_png_holds,
)
from mp4ds.plugins.exporting.motion import (
    Pose,
    Poses,
    StaticTree,
    in_order,
    inverse,
    pose_matrix,
    quaternion_of,
    static_transforms,
)

_MODEL = "sparse/0"
_HALF_PIXEL = 0.5  # COLMAP counts from the corner of a pixel, ROS and OpenCV from its centre


def write(job: ExportJob) -> None:
    """Write the format."""
    source = job.source
    poses = _poses(job)  # first: no frame is decoded if the topic is unsuitable
    cameras = that_png_holds(source.cameras, source.stats)
    cameras = [of_different_times(camera, source.stats) for camera in cameras]
    folder = job.path / _MODEL
    folder.mkdir(parents=True)
    names = FileNames()
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    images: list[tuple[int, ExportedCamera, Sequence[str]]] = []
    for camera in cameras:
        place, _ = names.name_for(camera.topic)
        files = [f"{place}/{time}.png" for time in camera.times.tolist()]
        job.write_png_files(camera, f"images/{place}", [f"images/{file}" for file in files])
        calibration = camera.calibration
        if calibration is None:
            job.note(f"{camera.topic}: not calibrated, so it is not in cameras.txt")
            continue
        found = model_of(calibration)
        if found is None:
            job.note(
                f"{camera.topic}: COLMAP has no model for distortion "
                f"{calibration.distortion_model!r}, so it is not in cameras.txt"
            )
            continue
        hold_calibration(camera, source.stats)
        images.append((len(images) + 1, camera, files))
        width, height = camera.size
        values = " ".join(map(repr, found[1]))
        lines.append(f"{len(images)} {found[0]} {width} {height} {values}")
    (folder / "cameras.txt").write_text("\n".join([*lines, ""]), encoding="utf-8")
    _write_images(job, images, poses)


def model_of(calibration: Calibration) -> tuple[str, list[float]] | None:
    """COLMAP's camera model and its parameters, the simplest that is equal; None if it has none."""
    k = calibration.k
    values = [k[0], k[4], k[2] + _HALF_PIXEL, k[5] + _HALF_PIXEL]
    model, d = lens_of(calibration)
    if model == "none":
        return "PINHOLE", values
    if model == "equidistant":
        return "OPENCV_FISHEYE", [*values, *d]
    if model == "plumb_bob" and not d[4]:
        return "OPENCV", [*values, *d[:4]]
    if model in ("plumb_bob", "rational_polynomial") and len(d) <= 8:
        return "FULL_OPENCV", [*values, *(d + [0.0] * 3)[:8]]
    return None


@dataclass(frozen=True)
class PoseTrack:
    """Poses of a body over time, for interpolation.

    Attributes:
        times: Nanoseconds, increasing, shape (poses,).
        values: Position x, y, z and quaternion x, y, z, w; shape (poses, 7).
    """

    times: NDArray[np.int64]
    values: NDArray[np.float64]

    @classmethod
    def of(cls, rows: Iterable[tuple[int, tuple[float, ...]]]) -> PoseTrack:
        """The poses of rows by time; the first of several with the same time."""
        found = [*in_order(rows)]
        times = np.array([time for time, _ in found], np.int64)
        values = np.array([row for _, row in found], np.float64).reshape(-1, 7)
        times, places = np.unique(times, return_index=True)
        return cls(times, values[places])

    def at(self, time: int) -> Pose | None:
        """The interpolated pose at a time; None outside the first and last."""
        after = int(np.searchsorted(self.times, time))
        if after < len(self.times) and self.times[after] == time:
            return pose_matrix(self.values[after, :3], self.values[after, 3:])
        if not 0 < after < len(self.times):
            return None
        start, end = int(self.times[after - 1]), int(self.times[after])
        share = (time - start) / (end - start)
        before, later = self.values[after - 1], self.values[after]
        position = (1 - share) * before[:3] + share * later[:3]
        return pose_matrix(position, _between(before[3:], later[3:], share))


def _between(
    start: NDArray[np.float64], end: NDArray[np.float64], share: float
) -> NDArray[np.float64]:
    """The rotation at a fraction of the shorter way from one quaternion to another."""
    start, end = start / np.linalg.norm(start), end / np.linalg.norm(end)
    cosine = float(start @ end)
    if cosine < 0:
        end, cosine = -end, -cosine
    angle = float(np.arccos(min(1.0, cosine)))
    if angle < 1e-6:
        return start + share * (end - start)
    found: NDArray[np.float64] = (
        np.sin((1 - share) * angle) * start + np.sin(share * angle) * end
    ) / np.sin(angle)
    return found


def _poses(job: ExportJob) -> Poses | None:
    """The requested poses.

    Raises:
        OptionError: The topic does not exist, has the wrong type, or names no child frame.
    """
    if not job.options.poses:
        return None
    poses = Poses(job.source.dataset, job.options.poses)
    if not poses.body:
        raise OptionError(
            f"`poses` {poses.topic} does not say whose pose it gives, which is needed for a "
            "camera's pose. Use an Odometry or TransformStamped topic."
        )
    return poses


def _write_images(
    job: ExportJob, images: Sequence[tuple[int, ExportedCamera, Sequence[str]]], poses: Poses | None
) -> None:
    folder = job.path / _MODEL
    (folder / "points3D.txt").write_text("# no points\n", encoding="utf-8")
    with (folder / "images.txt").open("w", encoding="utf-8") as file:
        file.write("# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# no points\n")
        if poses is None:  # COLMAP refuses a model without the file
            job.note("images.txt is empty: it needs the pose of each image (--poses TOPIC)")
            return
        tree = StaticTree(static_transforms(job.source.dataset))
        track = PoseTrack.of(poses.rows())
        number = 0
        for camera_id, camera, files in images:
            place = tree.pose(camera.frame_id, poses.body)
            if place is None:
                job.note(
                    f"{camera.topic}: no static transforms connect {camera.frame_id!r} to "
                    f"{poses.body!r}, so its images are not in images.txt"
                )
                continue
            missing = 0
            for time, name in zip(camera.times.tolist(), files, strict=True):
                pose = track.at(time)
                if pose is None:
                    missing += 1
                    continue
                number += 1
                seen = inverse(pose @ place)
                x, y, z, w = quaternion_of(seen[:3, :3])
                values = [w, x, y, z, *seen[:3, 3].tolist()]
                file.write(f"{number} {' '.join(map(repr, values))} {camera_id} {name}\n\n")
            if missing:
                job.note(
                    f"{camera.topic}: {missing} of {len(camera)} images are before the first or "
                    "after the last pose, so they are not in images.txt"
                )
    job.source.stats.add_exported(poses.topic, len(track.times))
    job.places[f"{_MODEL}/images.txt"] = poses.topic
    job.note(f"{poses.topic}: poses of images are interpolated between the recorded ones")
