"""The layout of TUM RGB-D: lists of times and file names, with the times in decimal seconds."""

from __future__ import annotations

from pathlib import Path

from mp4ds.importing.options import ImageFolder
from mp4ds.importing.scene import Camera, Scene, Table, listed_images, read_table
from mp4ds.importing.times import of_unit
from mp4ds.source_files import members

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
            camera = Camera(f"/{name}/image_raw", name, files, stamps, encoding=encoding)
            scene.cameras.append(camera)
            scene.files.append(path)
            for file in files:
                folders.setdefault(file.parent, set()).add(file)
    for place, listed in folders.items():
        scene.files.append(place)
        if place != folder and (unlisted := len(members(place)) - len(listed)):
            scene.skipped[f"files in {place.name} that no list names"] = unlisted
    for name, (kind, frame_id, values) in _TABLES.items():
        path = folder / f"{name}.txt"
        if path.is_file():
            stamps, rows = read_table(path, seconds, values)
            scene.tables.append(Table(f"/{name}", kind, frame_id, stamps, rows))
            scene.files.append(path)
    for path in sorted(folder.iterdir()):
        if path not in scene.files:
            scene.leave_out(path, f"{path.name}, which is not of the layout")
    return scene
