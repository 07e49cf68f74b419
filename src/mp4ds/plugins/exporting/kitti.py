"""The layout of KITTI's raw data: image_00/data/0000000000.png, timestamps, calibrations."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from mp4ds.dataset.views import lens_of
from mp4ds.options import seconds_text
from mp4ds.plugins.exporting.job import ExportedCamera, ExportJob, hold_calibration, that_png_holds
from mp4ds.plugins.exporting.motion import StaticTree, static_transforms

_MOST_CAMERAS = 100  # two digits
_IDENTITY = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]


def write(job: ExportJob) -> None:
    """Write the format."""
    source = job.source
    cameras = that_png_holds(source.cameras, source.ledger)
    for camera in cameras[_MOST_CAMERAS:]:
        source.ledger.leave(
            camera.topic, f"KITTI numbers at most {_MOST_CAMERAS} cameras", len(camera)
        )
    cameras = cameras[:_MOST_CAMERAS]
    job.path.mkdir()
    tree = StaticTree(static_transforms(source.dataset))
    lines = []
    for number, camera in enumerate(cameras):
        _write_camera(job, number, camera)
        lines += _calibration_lines(job, tree, cameras[0], number, camera)
    if lines:
        (job.path / "calib_cam_to_cam.txt").write_text("\n".join([*lines, ""]), encoding="utf-8")
    if cameras:
        times = cameras[0].times
        text = "".join(f"{seconds_text(time)}\n" for time in (times - times[:1]).tolist())
        (job.path / "times.txt").write_text(text, encoding="utf-8")
    if len({len(camera) for camera in cameras}) > 1:
        job.note(
            "cameras have different numbers of frames, so frames with the same number were not "
            "taken at the same time; --sync MS keeps only those that match"
        )


def _write_camera(job: ExportJob, number: int, camera: ExportedCamera) -> None:
    place = f"image_{number:02d}"
    names = [f"{place}/data/{index:010d}.png" for index in range(len(camera))]
    job.write_png_files(camera, place, names)
    with (job.path / place / "timestamps.txt").open("w", encoding="utf-8") as file:
        for text in np.datetime_as_string(camera.times.astype("datetime64[ns]")).tolist():
            file.write(text.replace("T", " ") + "\n")


def _calibration_lines(
    job: ExportJob, tree: StaticTree, first: ExportedCamera, number: int, camera: ExportedCamera
) -> list[str]:
    """The lines of a camera, with the names and order of calib_cam_to_cam.txt."""
    calibration = camera.calibration
    if calibration is None:
        job.note(f"{camera.topic}: not calibrated")
        return []
    model, d = lens_of(calibration)
    if model not in ("none", "plumb_bob", "rational_polynomial"):
        job.note(
            f"{camera.topic}: KITTI has no distortion {model!r}, so it is not in "
            "calib_cam_to_cam.txt"
        )
        return []
    if model == "rational_polynomial":
        job.note(f"{camera.topic}: KITTI's D has 5 parameters, here it has {len(d)}, as in OpenCV")
    hold_calibration(camera, job.source.ledger)
    rotation, projection = calibration.r, calibration.p
    if not projection[0]:
        job.note(f"{camera.topic}: recorded without rectification, so P_rect is K without any")
        k = calibration.k
        rotation, projection = _IDENTITY, [*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0]
    key, (width, height) = f"{number:02d}", camera.size
    lines = [
        _line(f"S_{key}", (width, height)),
        _line(f"K_{key}", calibration.k),
        _line(f"D_{key}", d or [0.0] * 5),
    ]
    pose = tree.pose(first.frame_id, camera.frame_id)
    if pose is None:
        job.note(f"{camera.topic}: no static transforms give R_{key} and T_{key}")
    else:
        lines.append(_line(f"R_{key}", pose[:3, :3].ravel().tolist()))
        lines.append(_line(f"T_{key}", pose[:3, 3].tolist()))
    return [
        *lines,
        _line(f"S_rect_{key}", (width, height)),
        _line(f"R_rect_{key}", rotation),
        _line(f"P_rect_{key}", projection),
    ]


def _line(name: str, values: Iterable[float]) -> str:
    return " ".join([f"{name}:", *(repr(float(value)) for value in values)])
