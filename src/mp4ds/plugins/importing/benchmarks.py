"""The layouts of known data sets: EuRoC MAV, KITTI, TUM RGB-D."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import SourceError
from mp4ds.files.sources import members
from mp4ds.messages.wire import CalibrationFields
from mp4ds.packing.options import ImageFolder
from mp4ds.plugins.importing.scene import (
    IDENTITY,
    Matrix,
    Scene,
    SceneCamera,
    SensorTable,
    euroc_calibration,
    euroc_pose,
    lines_of,
    listed_images,
    of_date,
    of_unit,
    read_table,
    read_times,
    read_yaml,
    split,
    transform,
)
from mp4ds.video.images import image_size

LIST = "data.csv"
_BODY, _WORLD = "body", "world"
_POSES = ("state_groundtruth_estimate", "mocap", "pose")


def sensors(folder: Path) -> list[Path]:
    """The folders of the sensors: those with a list."""
    root = folder / "mav0" if (folder / "mav0").is_dir() else folder
    return sorted(path.parent for path in root.glob(f"*/{LIST}"))


def is_euroc(folder: Path) -> bool:
    """Whether a folder has this layout."""
    return any(map(_is_camera, sensors(folder)))


def _is_camera(sensor: Path) -> bool:
    return (sensor / "data").is_dir()


def find_euroc(folder: Path, options: ImageFolder) -> Scene:
    """The cameras, IMUs and poses of a folder.

    Raises:
        SourceError: A list or calibration is damaged.
    """
    scene = Scene(folder)
    found = sensors(folder)
    for sensor in found:
        described = _described(scene, sensor)
        if _is_camera(sensor):
            _add_camera(scene, sensor, described)
        elif sensor.name.startswith("imu"):
            _add_table(scene, sensor, "imu", sensor.name, 6)
        elif sensor.name.startswith(_POSES):
            _add_poses(scene, sensor)
        else:
            scene.leave_out(sensor, f"{sensor.name}, which is not a camera, IMU or pose")
    root = folder / "mav0" if (folder / "mav0").is_dir() else folder
    for path in sorted(root.iterdir()):
        if path.is_file() and path.suffix == ".yaml":
            scene.files.append(path)
            scene.kept.append(path)
        elif path not in found:
            scene.leave_out(path, f"{path.name}, which has no {LIST}")
    return scene


def _described(scene: Scene, sensor: Path) -> dict[str, Any]:
    """The contents of sensor.yaml, which is kept; its pose becomes a transform."""
    path = sensor / "sensor.yaml"
    if not path.is_file():
        return {}
    scene.files.append(path)
    scene.kept.append(path)
    values = read_yaml(path)
    pose = euroc_pose(path, values)
    if pose is not None and (_is_camera(sensor) or sensor.name.startswith("imu")):
        try:
            scene.transforms.append(transform(_BODY, sensor.name, pose[:3, :3], pose[:3, 3]))
        except ValueError as error:
            raise SourceError(path, f"holds no valid pose: {error}") from None
    return values


def _add_camera(scene: Scene, sensor: Path, described: dict[str, Any]) -> None:
    path, images = sensor / LIST, sensor / "data"
    files, stamps = listed_images(path, images, of_unit("ns", scene.skipped))
    unlisted = len(members(images)) - len(set(files))
    if unlisted:
        scene.skipped[f"files in {images.name} of {sensor.name} that {LIST} does not list"] = (
            unlisted
        )
    calibration = None
    if "intrinsics" in described:
        calibration = euroc_calibration(sensor / "sensor.yaml", described)
    topic = f"/{sensor.name}/image_raw"
    scene.cameras.append(SceneCamera(topic, sensor.name, files, stamps, calibration))
    scene.files += [path, images]


def _add_table(scene: Scene, sensor: Path, kind: str, frame_id: str, values: int) -> None:
    path = sensor / LIST
    stamps, rows = read_table(path, of_unit("ns", scene.skipped), values)
    scene.tables.append(SensorTable(f"/{sensor.name}", kind, frame_id, stamps, rows))
    scene.files.append(path)


def _add_poses(scene: Scene, sensor: Path) -> None:
    """Position and w, x, y, z of the quaternion; a pose cannot hold velocities and biases."""
    path = sensor / LIST
    stamps, rows = read_table(path, of_unit("ns", scene.skipped), 7, more=True)
    poses = rows[:, [0, 1, 2, 4, 5, 6, 3]]
    scene.tables.append(SensorTable(f"/{sensor.name}", "pose", _WORLD, stamps, poses))
    scene.files.append(path)
    if any(len(split(line)) > 8 for _, line in lines_of(path)):
        scene.skipped[f"rows of {sensor.name} of which only the pose was taken"] = len(rows)


# ---------------------------------------------------------------- kitti

_IMAGES = re.compile(r"image_(\d{1,2})")
_NO_DISTORTION = (0.0,) * 5


@dataclass(frozen=True)
class _Calibrations:
    """A file of calibrations: lists of numbers by their names."""

    path: Path
    values: dict[str, Matrix]

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def numbers(self, key: str, *counts: int) -> Matrix:
        """A list of as many numbers as one of the counts.

        Raises:
            SourceError: It is missing, or has another length.
        """
        found = self.values.get(key)
        if found is None or len(found) not in counts or not np.isfinite(found).all():
            listed = " or ".join(map(str, counts))
            raise SourceError(self.path, f"has no list {key} of {listed} numbers")
        return found

    def size(self, key: str) -> tuple[int, int]:
        """Width and height.

        Raises:
            SourceError: They are missing.
        """
        width, height = self.numbers(key, 2).tolist()
        return int(width), int(height)


def is_kitti(folder: Path) -> bool:
    """Whether a folder has one of these layouts."""
    return bool(_raw_cameras(folder) or _odometry_cameras(folder))


def _raw_cameras(folder: Path) -> list[Path]:
    found = sorted(path.parent for path in folder.glob("image_*/timestamps.txt"))
    return [path for path in found if _IMAGES.fullmatch(path.name) and (path / "data").is_dir()]


def _odometry_cameras(folder: Path) -> list[Path]:
    if not (folder / "times.txt").is_file():
        return []
    return sorted(
        path for path in folder.iterdir() if _IMAGES.fullmatch(path.name) and path.is_dir()
    )


def find_kitti(folder: Path, options: ImageFolder) -> Scene:
    """The cameras of a folder.

    Raises:
        SourceError: A list or calibration is damaged.
    """
    raw = _raw_cameras(folder)
    scene = _find_raw(folder, raw) if raw else _find_odometry(folder)
    used = {path for file in scene.files for path in (file, *file.parents)}
    for path in sorted(folder.iterdir()):
        if path not in used:
            scene.leave_out(path, f"{path.name}, which is not a camera")
    return scene


# ---------------------------------------------------------------- raw


def _find_raw(folder: Path, cameras: list[Path]) -> Scene:
    scene = Scene(folder)
    values: _Calibrations | None = None
    # the calibrations of a day are next to its recordings
    for place in (folder.absolute().parent, folder):
        for path in sorted(place.glob("calib_*.txt")):
            scene.files.append(path)
            scene.kept.append(path)
            if path.name == "calib_cam_to_cam.txt":
                values = _read_calibrations(path)
    for camera in cameras:
        files = members(camera / "data")
        stamps = _read_stamps(camera / "timestamps.txt", files, of_date(scene.skipped))
        number = camera.name.removeprefix("image_")
        calibration = _raw_calibration(scene, camera.name, values, number, files)
        scene.cameras.append(
            SceneCamera(f"/{camera.name}/image_raw", camera.name, files, stamps, calibration)
        )
        scene.files += [camera / "timestamps.txt", camera / "data"]
    return scene


def _raw_calibration(
    scene: Scene, name: str, values: _Calibrations | None, number: str, files: list[Path]
) -> CalibrationFields | None:
    """Calibration of rectified or unrectified images, judging by their size; the pose is noted."""
    if not files or values is None or f"P_rect_{number}" not in values:
        return None
    size = image_size(files[0])
    p = values.numbers(f"P_rect_{number}", 12)
    is_recorded, is_rectified = (size == values.size(f"{key}_{number}") for key in ("S", "S_rect"))
    # of equal sizes the images are as recorded, unless their folder's name tells otherwise
    if is_rectified and (not is_recorded or scene.folder.resolve().name.endswith("_sync")):
        _place(scene, name, np.eye(3), _origin(p))
        return _rectified(size, p)
    if not is_recorded:
        scene.skipped[f"calibrations of {name}, made for a different image size"] = 1
        return None
    if f"R_{number}" in values:
        rotation = values.numbers(f"R_{number}", 9).reshape(3, 3)
        translation = values.numbers(f"T_{number}", 3)
        _place(scene, name, rotation.T, -rotation.T @ translation)
    d = values.numbers(f"D_{number}", 5, 8, 12, 14)
    return CalibrationFields(
        width=size[0],
        height=size[1],
        distortion_model="plumb_bob" if len(d) == 5 else "rational_polynomial",
        d=tuple(d.tolist()),
        k=tuple(values.numbers(f"K_{number}", 9).tolist()),
        r=tuple(values.numbers(f"R_rect_{number}", 9).tolist()),
        p=tuple(p.tolist()),
    )


# ---------------------------------------------------------------- odometry


def _find_odometry(folder: Path) -> Scene:
    scene = Scene(folder)
    times, calib = folder / "times.txt", folder / "calib.txt"
    scene.files.append(times)
    values: _Calibrations | None = None
    if calib.is_file():
        values = _read_calibrations(calib)
        scene.files.append(calib)
        scene.kept.append(calib)
    for camera in _odometry_cameras(folder):
        files = members(camera)
        stamps = _read_stamps(times, files, of_unit("s", scene.skipped))
        calibration = None
        key = f"P{int(camera.name.removeprefix('image_'))}"
        if files and values is not None and key in values:
            p = values.numbers(key, 12)
            _place(scene, camera.name, np.eye(3), _origin(p))
            calibration = _rectified(image_size(files[0]), p)
        scene.cameras.append(
            SceneCamera(f"/{camera.name}/image_raw", camera.name, files, stamps, calibration)
        )
        scene.files.append(camera)
    return scene


# ---------------------------------------------------------------- both


def _rectified(size: tuple[int, int], p: Matrix) -> CalibrationFields:
    """The calibration of rectified images, which only have a projection."""
    return CalibrationFields(
        width=size[0],
        height=size[1],
        distortion_model="plumb_bob",
        d=_NO_DISTORTION,
        k=tuple(p.reshape(3, 4)[:, :3].ravel().tolist()),
        r=IDENTITY,
        p=tuple(p.tolist()),
    )


def _origin(p: Matrix) -> Matrix:
    """Position of a rectified camera in the first one, metres: for P = K [I | t] it is -t."""
    matrix = p.reshape(3, 4)
    try:
        return np.asarray(-np.linalg.solve(matrix[:, :3], matrix[:, 3]), np.float64)
    except np.linalg.LinAlgError:
        return np.full(3, np.nan)


def _place(scene: Scene, name: str, rotation: Matrix, translation: Matrix) -> None:
    """Note the pose of a camera in the first one."""
    digits = name.removeprefix("image_")
    first = f"image_{'0' * len(digits)}"
    if name == first:
        return
    try:
        scene.transforms.append(transform(first, name, rotation, translation))
    except ValueError as error:
        raise SourceError(
            scene.folder, f"its calibration gives no pose for {name}: {error}"
        ) from None


def _read_stamps(path: Path, files: list[Path], read: Callable[[str], int]) -> NDArray[np.int64]:
    stamps = read_times(path, [(number, [line]) for number, line in lines_of(path)], read)
    if len(stamps) != len(files):
        place = files[0].parent if files else path.parent
        raise SourceError(
            path, f"has {len(stamps)} times, but there are {len(files)} images in {place}"
        )
    return stamps


def _read_calibrations(path: Path) -> _Calibrations:
    """Lists of numbers by their names; what is not a list of numbers is left out."""
    found: dict[str, Matrix] = {}
    for _, line in lines_of(path):
        key, _, text = line.partition(":")
        try:
            found[key.strip()] = np.array([float(word) for word in text.split()])
        except ValueError:
            continue
    if not found:
        raise SourceError(path, "holds no calibration")
    return _Calibrations(path, found)


# ---------------------------------------------------------------- tum

# list -> the encoding of its images; depths are left in the unit of the files
_CAMERAS = {"rgb": None, "depth": "16UC1"}
_TABLES = {
    "accelerometer": ("accelerometer", "accelerometer", 3),
    "groundtruth": ("pose", "world", 7),
}


def is_tum(folder: Path) -> bool:
    """Whether a folder has this layout."""
    return any((folder / f"{name}.txt").is_file() for name in _CAMERAS)


def find_tum(folder: Path, options: ImageFolder) -> Scene:
    """The colour and depth images, accelerometer and poses of a folder.

    Raises:
        SourceError: A list is damaged.
    """
    scene = Scene(folder)
    seconds = of_unit("s", scene.skipped)
    folders: dict[Path, set[Path]] = {}
    for name, encoding in _CAMERAS.items():
        path = folder / f"{name}.txt"
        if path.is_file():
            files, stamps = listed_images(path, folder, seconds)
            camera = SceneCamera(f"/{name}/image_raw", name, files, stamps, encoding=encoding)
            scene.cameras.append(camera)
            scene.files.append(path)
            for file in files:
                folders.setdefault(file.parent, set()).add(file)
    for place, listed in folders.items():
        scene.files.append(place)
        if place != folder and (unlisted := len(members(place)) - len(listed)):
            scene.skipped[f"files in {place.name} that are not in any list"] = unlisted
    for name, (kind, frame_id, values) in _TABLES.items():
        path = folder / f"{name}.txt"
        if path.is_file():
            stamps, rows = read_table(path, seconds, values)
            scene.tables.append(SensorTable(f"/{name}", kind, frame_id, stamps, rows))
            scene.files.append(path)
    for path in sorted(folder.iterdir()):
        if path not in scene.files:
            scene.leave_out(path, f"{path.name}, which is not part of the layout")
    return scene
