"""The table of layouts of folders, and how a folder tells which one it has."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from mp4ds.errors import OptionError, SourceError, SourceNotFoundError
from mp4ds.importing.calibration import ros_calibration
from mp4ds.importing.euroc import find_euroc, is_euroc
from mp4ds.importing.kitti import find_kitti, is_kitti
from mp4ds.importing.options import ImageFolder
from mp4ds.importing.plain import find_plain
from mp4ds.importing.reader import ImagesReader
from mp4ds.importing.scene import Scene
from mp4ds.importing.times import UNITS
from mp4ds.importing.tum import find_tum, is_tum
from mp4ds.layouts import ENCODINGS
from mp4ds.remote import remote
from mp4ds.video.image_files import image_size

_PLAIN_ONLY = ("stamps", "rate", "unit", "topic", "frame_id", "encoding")


@dataclass(frozen=True, slots=True)
class FolderLayout:
    """A layout of folders.

    Attributes:
        matches: Whether a folder has it.
        find: Finds what it holds.
        is_calibrated: Whether it tells calibrations of its own.
    """

    matches: Callable[[Path], bool]
    find: Callable[[Path, ImageFolder], Scene]
    is_calibrated: bool


LAYOUTS: Mapping[str, FolderLayout] = {
    "euroc": FolderLayout(is_euroc, find_euroc, is_calibrated=True),
    "kitti": FolderLayout(is_kitti, find_kitti, is_calibrated=True),
    "tum": FolderLayout(is_tum, find_tum, is_calibrated=False),
    "plain": FolderLayout(lambda folder: True, find_plain, is_calibrated=False),
}
"""In the order in which they are tried."""


def open_images(folder: Path, options: ImageFolder) -> ImagesReader:
    """Open a folder of images as a recording.

    Args:
        folder: The folder, on this machine.
        options: How it is read.

    Raises:
        SourceError: It cannot be read as asked; says why and what to do.
        OptionError: The options do not suit its layout.
    """
    if remote(folder):
        raise SourceError(folder, "is not read where it is", "Download it first.")
    if not folder.exists():
        raise SourceNotFoundError(folder)
    if not folder.is_dir():
        raise SourceError(folder, "is no folder of images")
    _check(options)
    try:
        name = options.layout or next(key for key in LAYOUTS if LAYOUTS[key].matches(folder))
        layout = LAYOUTS[name]
        _check_for(name, layout, options)
        if not layout.matches(folder):
            raise SourceError(folder, f"is not laid out as {name} is", "Leave out --layout.")
        scene = layout.find(folder, options)
    except OSError as error:
        if isinstance(error, SourceError):
            raise
        raise SourceError(error.filename or folder, f"cannot be read: {error.strerror}") from None
    if options.calibration:
        _calibrate(scene, Path(options.calibration))
    if not any(len(camera.files) for camera in scene.cameras):
        raise SourceError(folder, "holds no images")
    return ImagesReader(scene)


def _check(options: ImageFolder) -> None:
    if options.layout is not None and options.layout not in LAYOUTS:
        raise OptionError(f"--layout {options.layout!r} is not one of {', '.join(LAYOUTS)}.")
    if options.unit is not None and options.unit not in UNITS:
        raise OptionError(f"--unit {options.unit!r} is not one of {', '.join(UNITS)}.")
    if options.encoding is not None and options.encoding not in ENCODINGS:
        raise OptionError(f"--encoding {options.encoding!r} is not one of {', '.join(ENCODINGS)}.")
    if options.topic is not None and not options.topic.strip("/"):
        raise OptionError(f"--topic {options.topic!r} is not a topic name.")


def _check_for(name: str, layout: FolderLayout, options: ImageFolder) -> None:
    """Refuse options that go with other layouts only."""
    given = [key for key in _PLAIN_ONLY if getattr(options, key) is not None]
    if name != "plain" and given:
        raise OptionError(
            f"--{given[0].replace('_', '-')} is for plain folders of images, and this one has the "
            f"layout {name}, which tells it. Give --layout plain, or leave it out."
        )
    if layout.is_calibrated and options.calibration:
        raise OptionError(f"--calibration is not for the layout {name}, which has its own.")


def _calibrate(scene: Scene, path: Path) -> None:
    """Give all cameras a calibration that is theirs by its size.

    Raises:
        SourceError: It is none, or made for images of another size.
    """
    calibration = ros_calibration(path)
    for camera in scene.cameras:
        size = image_size(camera.files[0]) if camera.files else None
        if size not in (None, (calibration.width, calibration.height)):
            raise SourceError(
                path,
                f"is for images of {calibration.width}x{calibration.height}, and those of "
                f"{camera.topic} have {size[0]}x{size[1]}",
            )
    scene.cameras = [replace(camera, calibration=calibration) for camera in scene.cameras]
    if path.resolve() not in {file.resolve() for file in scene.files}:
        scene.files.append(path)
    scene.kept.append(path)
