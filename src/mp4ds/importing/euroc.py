"""The layout of EuRoC MAV and other data sets of ETH's ASL: a folder for each sensor, CSV lists."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mp4ds.errors import SourceError
from mp4ds.importing.calibration import euroc_calibration, euroc_pose, read_yaml
from mp4ds.importing.geometry import transform
from mp4ds.importing.options import ImageFolder
from mp4ds.importing.scene import (
    Camera,
    Scene,
    Table,
    lines_of,
    listed_images,
    read_table,
    split,
)
from mp4ds.importing.times import of_unit
from mp4ds.source_files import members

LIST = "data.csv"
_BODY, _WORLD = "body", "world"
_POSES = ("state_groundtruth_estimate", "mocap")


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
            scene.leave_out(sensor, f"{sensor.name}, which is neither camera, IMU nor pose")
    root = folder / "mav0" if (folder / "mav0").is_dir() else folder
    for path in sorted(root.iterdir()):
        if path.is_file() and path.suffix == ".yaml":
            scene.files.append(path)
            scene.kept.append(path)
        elif path not in found:
            scene.leave_out(path, f"{path.name}, which has no {LIST}")
    return scene


def _described(scene: Scene, sensor: Path) -> dict[str, Any]:
    """What sensor.yaml says, which is kept; its pose becomes a transform."""
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
            raise SourceError(path, f"tells no pose: {error}") from None
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
    scene.cameras.append(Camera(topic, sensor.name, files, stamps, calibration))
    scene.files += [path, images]


def _add_table(scene: Scene, sensor: Path, kind: str, frame_id: str, values: int) -> None:
    path = sensor / LIST
    stamps, rows = read_table(path, of_unit("ns", scene.skipped), values)
    scene.tables.append(Table(f"/{sensor.name}", kind, frame_id, stamps, rows))
    scene.files.append(path)


def _add_poses(scene: Scene, sensor: Path) -> None:
    """Position and w, x, y, z of the quaternion; velocities and biases have no place in a pose."""
    path = sensor / LIST
    stamps, rows = read_table(path, of_unit("ns", scene.skipped), 7, more=True)
    poses = rows[:, [0, 1, 2, 4, 5, 6, 3]]
    scene.tables.append(Table(f"/{sensor.name}", "pose", _WORLD, stamps, poses))
    scene.files.append(path)
    if any(len(split(line)) > 8 for _, line in lines_of(path)):
        scene.skipped[f"rows of {sensor.name} of which the pose alone was taken"] = len(rows)
