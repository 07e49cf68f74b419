"""The layouts of known data sets: EuRoC MAV, TUM RGB-D."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mp4ds.errors import SourceError
from mp4ds.files.sources import members
from mp4ds.packing.options import ImageFolder
from mp4ds.plugins.importing.scene import (
    Scene,
    SceneCamera,
    SensorTable,
    euroc_calibration,
    euroc_pose,
    lines_of,
    listed_images,
    of_unit,
    read_table,
    read_yaml,
    split,
    transform,
)

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
