"""EuRoC, the format of the ASL data sets: mav0/cam0, imu0 ... with data.csv and sensor.yaml."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

from mp4ds.dataset.views import lens_of
from mp4ds.format.models import Calibration
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
    Row,
    StaticTree,
    frame_of,
    imu_rows,
    in_order,
    static_transforms,
    topics_of,
)

_IMU = "sensor_msgs/Imu"
_IMU_HEAD = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
_POSE_HEAD = (
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
)


def write(job: ExportJob) -> None:
    """Write the format."""
    source = job.source
    poses = Poses(source.dataset, job.options.poses) if job.options.poses else None
    cameras = that_png_holds(source.cameras, source.stats)
    cameras = [of_different_times(camera, source.stats) for camera in cameras]
    imus = topics_of(source.dataset, _IMU, source.chosen)
    frames = [frame_of(source.dataset, topic) for topic in imus]
    body = next(iter([*frames, *(camera.frame_id for camera in cameras)]), "")
    tree = StaticTree(static_transforms(source.dataset))
    root = job.path / "mav0"
    root.mkdir(parents=True)
    (root / "body.yaml").write_text(f"comment: {json.dumps(body)}\n", encoding="utf-8")
    for number, camera in enumerate(cameras):
        pose = _known_pose(job, tree, camera.frame_id, body, camera.topic)
        _write_camera(job, f"mav0/cam{number}", camera, pose)
    for number, (topic, frame) in enumerate(zip(imus, frames, strict=True)):
        pose = _known_pose(job, tree, frame, body, topic)
        place = f"mav0/imu{number}"
        _write_rows(job, place, topic, _IMU_HEAD, imu_rows(source.dataset, topic))
        _write_sensor(job.path / place, "imu", topic, pose, [])
        job.note(f"{topic}: orientation and covariances have no place in an IMU's data.csv")
    if poses is not None:
        job.note(f"{poses.topic}: only position and orientation are kept")
        rows = ((time, (*v[:3], v[6], *v[3:6])) for time, v in poses.rows())
        _write_rows(job, "mav0/pose0", poses.topic, _POSE_HEAD, rows)
        pose = tree.pose(poses.body, body)
        _write_sensor(job.path / "mav0/pose0", "pose", poses.topic, pose, [])


def _known_pose(job: ExportJob, tree: StaticTree, frame: str, body: str, topic: str) -> Pose | None:
    pose = tree.pose(frame, body)
    if pose is None:
        job.note(f"{topic}: no static transforms give T_BS of {frame!r} in {body!r}")
    return pose


def _write_camera(job: ExportJob, place: str, camera: ExportedCamera, pose: Pose | None) -> None:
    names = [f"{time}.png" for time in camera.times.tolist()]
    job.write_png_files(camera, place, [f"{place}/data/{name}" for name in names])
    with (job.path / place / "data.csv").open("w", encoding="utf-8") as file:
        file.write("#timestamp [ns],filename\n")
        file.writelines(
            f"{time},{name}\n" for time, name in zip(camera.times.tolist(), names, strict=True)
        )
    width, height = camera.size
    lines = [f"rate_hz: {camera.rate:.6g}", f"resolution: [{width}, {height}]"]
    calibration = hold_calibration(camera, job.source.stats)
    if calibration is None:
        job.note(f"{camera.topic}: not calibrated")
    else:
        model, coefficients = distortion(calibration)
        if model not in ("radial-tangential", "equidistant"):
            job.note(f"{camera.topic}: EuRoC has no distortion {model}; it is given by its name")
        k = calibration.k
        lines += [
            "camera_model: pinhole",
            f"intrinsics: {[k[0], k[4], k[2], k[5]]} # fu, fv, cu, cv",
            f"distortion_model: {json.dumps(model)}",
            f"distortion_coefficients: {coefficients}",
        ]
    _write_sensor(job.path / place, "camera", camera.topic, pose, lines)


def distortion(calibration: Calibration) -> tuple[str, list[float]]:
    """Name and coefficients of a distortion, in EuRoC's terms if it has them."""
    model, d = lens_of(calibration)
    if model == "none":
        return "radial-tangential", [0.0] * 4
    if model == "plumb_bob" and not d[4]:
        return "radial-tangential", d[:4]
    return model, d


def _write_rows(job: ExportJob, place: str, topic: str, head: str, rows: Iterator[Row]) -> None:
    folder = job.path / place
    folder.mkdir()
    count = 0
    with (folder / "data.csv").open("w", encoding="utf-8") as file:
        file.write(f"{head}\n")
        for time, values in in_order(rows):
            file.write(f"{time},{','.join(map(repr, map(float, values)))}\n")
            count += 1
    job.places[place] = topic
    job.source.stats.add_exported(topic, count)


def _write_sensor(
    folder: Path, kind: str, topic: str, pose: Pose | None, lines: Sequence[str]
) -> None:
    text = [f"sensor_type: {kind}", f"comment: {json.dumps(topic)}"]
    if pose is not None:
        text += ["T_BS:", "  cols: 4", "  rows: 4", f"  data: {pose.ravel().tolist()}"]
    (folder / "sensor.yaml").write_text("\n".join([*text, *lines, ""]), encoding="utf-8")
