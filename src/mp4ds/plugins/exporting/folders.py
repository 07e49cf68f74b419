"""Image files with their stamps, EuRoC, TUM RGB-D and COLMAP: folders of images and text."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from mp4ds.dataset.dataset import Dataset
from mp4ds.dataset.views import lens_of
from mp4ds.errors import OptionError
from mp4ds.files.outputs import csv_cell
from mp4ds.format.models import Calibration
from mp4ds.format.sidecars import FileNames
from mp4ds.messages.transforms import TransformCollector, quaternion_of
from mp4ds.options import seconds_text
from mp4ds.plugins.exporting.job import (
    IMU,
    NOTE_NAME,
    ExportedCamera,
    ExportJob,
    Measures,
    Row,
    ros_type,
)
from mp4ds.records import Message
from mp4ds.times import INT64_MIN
from mp4ds.video.images import encoding_as

Pose = NDArray[np.float64]
"""Shape (4, 4): a point p of a frame is pose @ p in another; metres."""


def pose_matrix(translation: Iterable[float], quaternion: Iterable[float]) -> Pose:
    """The pose of x, y, z in metres and a quaternion x, y, z, w of any length but 0."""
    x, y, z, w = np.array([*quaternion], np.float64)
    s = 2.0 / (x * x + y * y + z * z + w * w)
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
        [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
        [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)],
    ]
    pose[:3, 3] = [*translation]
    return pose


def inverse(pose: Pose) -> Pose:
    """The pose of the other frame in this one."""
    turned = pose[:3, :3].T
    found = np.eye(4)
    found[:3, :3] = turned
    found[:3, 3] = -turned @ pose[:3, 3]
    return found


def static_poses(dataset: Dataset) -> Callable[[str, str], Pose | None]:
    """Relative poses of frames, by the static transforms of a dataset.

    Args:
        dataset: Its messages and its manifest have them.

    Returns:
        A function that returns the pose of a frame in another one; None if no static transforms
        connect them.
    """
    listed = dataset.manifest.transforms if dataset.manifest else []
    collector = TransformCollector(item.to_record() for item in listed)
    topics = {channel.topic for channel in dataset.channels if collector.takes(channel)}
    if topics:
        for record in dataset.records(start=INT64_MIN, topics=topics):
            if isinstance(record, Message):
                collector.add(record.channel, record.data)
    by_child = {item.child.removeprefix("/"): item for item in collector.transforms}

    def in_root(frame: str) -> tuple[str, Pose]:
        """The root of a frame's tree, and the pose of the frame in it."""
        pose, name, seen = np.eye(4), frame.removeprefix("/"), set[str]()
        while name in by_child and name not in seen:  # a cycle has no root
            seen.add(name)
            item = by_child[name]
            pose = pose_matrix(item.translation, item.rotation) @ pose
            name = item.parent.removeprefix("/")
        return name, pose

    def pose_of(frame: str, within: str) -> Pose | None:
        if not frame or not within:
            return None
        root, own = in_root(frame)
        other_root, other = in_root(within)
        return inverse(other) @ own if root == other_root else None

    return pose_of


def _poses(job: ExportJob) -> Measures | None:
    """The requested poses: before any frame is decoded, as the topic may be unsuitable."""
    topic = job.options.poses
    return Measures(job.dataset, topic, "poses") if topic else None


def _imus(job: ExportJob) -> list[Measures]:
    topics = filter(job.options.chosen, dict.fromkeys(one.topic for one in job.dataset.channels))
    own = (topic for topic in topics if ros_type(job.dataset, topic) == IMU)
    return [Measures(job.dataset, topic) for topic in own]


# ---------------------------------------------------------------- images

_STAMPS_HEAD = ["file", "stamp_ns", "log_time_ns", "frame_id"]


def write_images(job: ExportJob) -> None:
    """Write a folder for each topic: its images, named by their numbers, and their times."""
    names, cameras = FileNames(), dict[str, list[ExportedCamera]]()
    names.name_for(NOTE_NAME)  # is taken
    for camera in job.png_cameras():
        cameras.setdefault(camera.topic, []).append(camera)
    for topic, parts in cameras.items():
        frames, place = job.dataset[topic], names.name_for(topic)
        digits = len(str(len(frames) - 1))
        rows: list[tuple[str | int, ...]] = []
        for camera in parts:
            stream, suffix = camera.stream, camera.recorded_suffix or "png"
            numbers = frames.numbers_of(frames.parts.index(stream))[camera.numbers]
            files = [f"{number:0{digits}d}.{suffix}" for number in numbers.tolist()]
            for n in job.write_files(camera, place, [f"{place}/{file}" for file in files]):
                index = int(camera.numbers[n])
                times = int(stream.stamps[index]), int(stream.log_times[index])
                rows.append((files[n], *times, csv_cell(stream.frame_id(index))))
        with (job.path / place / "stamps.csv").open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([_STAMPS_HEAD, *sorted(rows)])


# ---------------------------------------------------------------- euroc

_IMU_HEAD = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
_POSE_HEAD = (
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
)


def write_euroc(job: ExportJob) -> None:
    """Write mav0/cam0, imu0 ... with data.csv and sensor.yaml: the format of the ASL data sets."""
    poses, cameras, imus = _poses(job), [*job.png_cameras()], _imus(job)
    frames = [*(imu.frame_id for imu in imus), *(camera.frame_id for camera in cameras)]
    body = frames[0] if frames else ""
    static_pose = static_poses(job.dataset)
    job.write_lines("mav0/body.yaml", [f"comment: {json.dumps(body)}"])

    def write_sensor(
        place: str, kind: str, topic: str, pose: Pose | None, lines: Sequence[str] = ()
    ) -> None:
        text = [f"sensor_type: {kind}", f"comment: {json.dumps(topic)}"]
        if pose is not None:
            text += ["T_BS:", "  cols: 4", "  rows: 4", f"  data: {pose.ravel().tolist()}"]
        job.write_lines(f"{place}/sensor.yaml", [*text, *lines])

    def pose_of(frame: str, topic: str) -> Pose | None:
        pose = static_pose(frame, body)
        if pose is None:
            job.note(f"{topic}: no static transforms give T_BS of {frame!r} in {body!r}")
        return pose

    for number, camera in enumerate(cameras):
        place = f"mav0/cam{number}"
        pose = pose_of(camera.frame_id, camera.topic)
        names = [f"{time}.png" for time in camera.times.tolist()]
        job.write_files(camera, place, [f"{place}/data/{name}" for name in names])
        lines = [f"{time},{name}" for time, name in zip(camera.times.tolist(), names, strict=True)]
        job.write_lines(f"{place}/data.csv", ["#timestamp [ns],filename", *lines])
        write_sensor(place, "camera", camera.topic, pose, _described(job, camera))
    for number, imu in enumerate(imus):
        place = f"mav0/imu{number}"
        pose = pose_of(imu.frame_id, imu.topic)
        rows = _csv(_IMU_HEAD, imu.rows())
        job.write_lines(f"{place}/data.csv", rows, place=place, topic=imu.topic)
        write_sensor(place, "imu", imu.topic, pose)
        job.note(f"{imu.topic}: orientation and covariances have no place in an IMU's data.csv")
    if poses is not None:
        job.note(f"{poses.topic}: only position and orientation are kept")
        place = "mav0/pose0"
        turned = ((time, (*v[:3], v[6], *v[3:6])) for time, v in poses.rows())
        rows = _csv(_POSE_HEAD, turned)
        job.write_lines(f"{place}/data.csv", rows, place=place, topic=poses.topic)
        write_sensor(place, "pose", poses.topic, static_pose(poses.body, body))


def _csv(head: str, rows: Iterable[Row]) -> Iterator[str]:
    yield head
    for time, values in rows:
        yield f"{time},{','.join(map(repr, values))}"


def _described(job: ExportJob, camera: ExportedCamera) -> list[str]:
    """What a sensor.yaml says of a camera."""
    width, height = camera.size
    lines = [f"rate_hz: {camera.rate:.6g}", f"resolution: [{width}, {height}]"]
    calibration = job.export_calibration(camera)
    if calibration is None:
        job.note(f"{camera.topic}: not calibrated")
        return lines
    model, d = lens_of(calibration)
    if model == "none":
        model, d = "radial-tangential", [0.0] * 4
    elif model == "plumb_bob" and not d[4]:
        model, d = "radial-tangential", d[:4]
    elif model != "equidistant":
        job.note(f"{camera.topic}: EuRoC has no distortion {model}; it is given by its name")
    k = calibration.k
    return [
        *lines,
        "camera_model: pinhole",
        f"intrinsics: {[k[0], k[4], k[2], k[5]]} # fu, fv, cu, cv",
        f"distortion_model: {json.dumps(model)}",
        f"distortion_coefficients: {d}",
    ]


# ---------------------------------------------------------------- tum


def write_tum(job: ExportJob) -> None:
    """Write rgb, depth, and lists of files by time: the format of the TUM RGB-D benchmark."""
    poses, cameras, imus = _poses(job), [*job.png_cameras()], _imus(job)
    for kind, wanted in (("rgb", False), ("depth", True)):
        alike = [camera for camera in cameras if _is_depth(camera) is wanted]
        for camera in alike[:1]:
            _write_tum_images(job, kind, camera)
        for camera in alike[1:]:
            reason = f"TUM has one {kind} camera, here {alike[0].topic} (select with --topics)"
            job.leave_out(camera.topic, reason, len(camera))
    for imu in imus[:1]:
        rows = ((time, values[3:]) for time, values in imu.rows())
        _write_tum_rows(job, "accelerometer.txt", imu.topic, "timestamp ax ay az", rows)
        job.note(f"{imu.topic}: TUM only keeps an IMU's acceleration")
    if poses is not None:
        job.note(f"{poses.topic}: only position and orientation are kept")
        head = "timestamp tx ty tz qx qy qz qw"
        _write_tum_rows(job, "groundtruth.txt", poses.topic, head, poses.rows())
    if any(camera.calibration for camera in cameras):
        job.note("TUM has no place for calibrations")


def _is_depth(camera: ExportedCamera) -> bool:
    """Whether images are depths: by their encoding, or by topic name if mono16."""
    encoding = camera.view.encoding
    has_light = encoding_as(encoding, "rgb") is not None
    return not has_light or (encoding.name == "mono16" and "depth" in camera.topic.lower())


def _write_tum_images(job: ExportJob, kind: str, camera: ExportedCamera) -> None:
    times = [seconds_text(time) for time in camera.times.tolist()]
    names = [f"{kind}/{time}.png" for time in times]
    job.write_files(camera, kind, names)
    heads = ["color images" if kind == "rgb" else "depth maps", f"file: {camera.topic}"]
    if kind == "depth":
        unit = "as recorded, in ROS one millimetre (depth factor 1000, not TUM's 5000)"
        heads.append(f"unit: {unit}")
        job.note(f"{camera.topic}: depths are in units {unit}")
    lines = map(" ".join, zip(times, names, strict=True))
    job.write_lines(f"{kind}.txt", [*_commented(*heads, "timestamp filename"), *lines])


def _write_tum_rows(job: ExportJob, name: str, topic: str, head: str, rows: Iterable[Row]) -> None:
    def lines() -> Iterator[str]:
        yield from _commented(f"file: {topic}", head)
        for time, values in rows:
            yield " ".join([seconds_text(time), *map(repr, values)])

    job.write_lines(name, lines(), place=name, topic=topic)


def _commented(*heads: str) -> list[str]:
    # a topic may be of several lines
    return [f"# {' '.join(head.splitlines())}" for head in heads]


# ---------------------------------------------------------------- colmap

_MODEL = "sparse/0"
_HALF_PIXEL = 0.5  # COLMAP counts from the corner of a pixel, ROS and OpenCV from its centre


def write_colmap(job: ExportJob) -> None:
    """Write images, and a sparse model of cameras, and of poses if known."""
    poses = _poses(job)
    if poses is not None and not poses.body:
        raise OptionError(
            f"`poses` {poses.topic} does not say whose pose it gives, which is needed for a "
            "camera's pose. Use an Odometry or TransformStamped topic."
        )
    names = FileNames()
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    known: list[tuple[ExportedCamera, Sequence[str]]] = []
    for camera in job.png_cameras():
        place = names.name_for(camera.topic)
        files = [f"{place}/{time}.png" for time in camera.times.tolist()]
        job.write_files(camera, f"images/{place}", [f"images/{file}" for file in files])
        model = colmap_model(camera.calibration) if camera.calibration else None
        if model is None:
            why = "not calibrated"
            if camera.calibration:
                distortion = camera.calibration.distortion_model
                why = f"COLMAP has no model for distortion {distortion!r}"
            job.note(f"{camera.topic}: {why}, so it is not in cameras.txt")
            continue
        job.export_calibration(camera)
        known.append((camera, files))
        width, height = camera.size
        lines.append(f"{len(known)} {model[0]} {width} {height} {' '.join(map(repr, model[1]))}")
    job.write_lines(f"{_MODEL}/cameras.txt", lines)
    # COLMAP refuses a model without these two
    job.write_lines(f"{_MODEL}/points3D.txt", ["# no points"])
    heads = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# no points"]
    images: Iterable[str] = []
    if poses is None:
        job.note("images.txt is empty: it needs the pose of each image (--poses TOPIC)")
    else:
        images = _image_lines(job, known, poses)
    job.write_lines(f"{_MODEL}/images.txt", chain(heads, images))


def colmap_model(calibration: Calibration) -> tuple[str, list[float]] | None:
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


def _image_lines(
    job: ExportJob, cameras: Sequence[tuple[ExportedCamera, Sequence[str]]], poses: Measures
) -> Iterator[str]:
    static_pose = static_poses(job.dataset)
    count, pose_at = interpolated(poses.rows())
    image = 0
    for number, (camera, files) in enumerate(cameras, start=1):
        place = static_pose(camera.frame_id, poses.body)
        if place is None:
            job.note(
                f"{camera.topic}: no static transforms connect {camera.frame_id!r} to "
                f"{poses.body!r}, so its images are not in images.txt"
            )
            continue
        missing = 0
        for time, name in zip(camera.times.tolist(), files, strict=True):
            pose = pose_at(time)
            if pose is None:
                missing += 1
                continue
            image += 1
            seen = inverse(pose @ place)
            x, y, z, w = quaternion_of(seen[:3, :3])
            values = [w, x, y, z, *seen[:3, 3].tolist()]
            yield f"{image} {' '.join(map(repr, values))} {number} {name}\n"
        if missing:
            job.note(
                f"{camera.topic}: {missing} of {len(camera)} images are before the first or "
                "after the last pose, so they are not in images.txt"
            )
    job.keep(poses.topic, count)
    job.places[f"{_MODEL}/images.txt"] = poses.topic
    job.note(f"{poses.topic}: poses of images are interpolated between the recorded ones")


def interpolated(rows: Iterable[Row]) -> tuple[int, Callable[[int], Pose | None]]:
    """Poses of a body over time: of several with the same time, the first.

    Those without an orientation are left out: a quaternion that nobody set is all zeros.

    Args:
        rows: Position x, y, z and quaternion x, y, z, w.

    Returns:
        How many there are, and a function that returns the interpolated pose at a time; None
        outside the first and last.
    """
    found = [(time, row) for time, row in rows if np.isfinite(row).all() and any(row[3:])]
    times = np.array([time for time, _ in found], np.int64)
    times, places = np.unique(times, return_index=True)
    values = np.array([row for _, row in found], np.float64).reshape(-1, 7)[places]

    def at(time: int) -> Pose | None:
        after = int(np.searchsorted(times, time))
        if after < len(times) and times[after] == time:
            return pose_matrix(values[after, :3], values[after, 3:])
        if not 0 < after < len(times):
            return None
        start, end = int(times[after - 1]), int(times[after])
        share = (time - start) / (end - start)
        before, later = values[after - 1], values[after]
        position = (1 - share) * before[:3] + share * later[:3]
        return pose_matrix(position, _between(before[3:], later[3:], share))

    return len(times), at


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
