"""The table of folder layouts, and plain folders."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import OptionError, Refused, SourceError, SourceNotFoundError
from mp4ds.files.sources import members
from mp4ds.files.urls import remote
from mp4ds.messages.encodings import ENCODINGS
from mp4ds.packing.options import ImageFolder
from mp4ds.plugins.importing.benchmarks import (
    find_euroc,
    find_tum,
    is_euroc,
    is_tum,
)
from mp4ds.plugins.importing.reader import ImagesReader
from mp4ds.plugins.importing.scene import (
    UNITS,
    Rows,
    Scene,
    SceneCamera,
    at_rate,
    is_number,
    lines_of,
    listed_images,
    of_unit,
    read_times,
    ros_calibration,
    split,
    unit_of,
)
from mp4ds.video.images import STILL_SUFFIXES, image_kind, image_size

_MOST = 8  # cameras; more words are not names of cameras
_LOOKED_AT = 8
# a number, except for that of a camera such as cam0
_NUMBER = re.compile(r"(?<!\d)(?<!cam)(?<!camera)\d+|(?<=cam)\d{2,}|(?<=camera)\d{2,}", re.I)
_HEX = re.compile(r"[0-9a-f]+", re.I)
_WORD = re.compile(r"[^\W_]+")
_ADVICE = (
    "A single rate cannot give their times. Give `stamps` FILE with a time and a file name per "
    "line, or put each camera's images into a folder of its own."
)


def by_camera(folder: Path, images: Sequence[Path]) -> Mapping[str, list[Path]]:
    """The images of each camera by its name, which is empty if there is one camera.

    There are several if the names have different words or extensions and the same numbers:
    ``color_0001.jpg`` and ``depth_0001.png``.

    Args:
        folder: For errors.
        images: In order.

    Raises:
        SourceError: It is unclear whether they are from one camera.
    """
    kinds: dict[str, list[Path]] = {}
    for path in images:
        kinds.setdefault(_NUMBER.sub("#", path.stem) + path.suffix.lower(), []).append(path)
    numbers = [[_numbers(path) for path in paths] for paths in kinds.values()]
    cameras = {"": list(images)}
    if _may_be_cameras(images, numbers):
        if any(found != numbers[0] for found in numbers):
            first, second = (paths[0].name for paths in list(kinds.values())[:2])
            raise SourceError(
                folder,
                f"holds images of several kinds, judging by names such as {first} and {second}, "
                "but their numbers differ",
                _ADVICE,
            )
        cameras = dict(zip(_names(list(kinds)), kinds.values(), strict=True))
    for paths in cameras.values():
        _check_turns(folder, paths)
    return cameras


def _numbers(path: Path) -> tuple[int, ...]:
    return tuple(map(int, _NUMBER.findall(path.stem)))


def _may_be_cameras(images: Sequence[Path], numbers: Sequence[list[tuple[int, ...]]]) -> bool:
    """Whether there are a few kinds that share numbers."""
    if not 1 < len(numbers) <= _MOST or min(map(len, numbers)) < 2:
        return False
    endings = {path.suffix.lower() for path in images}
    if len(endings) < len(numbers) and all(_HEX.fullmatch(path.stem) for path in images):
        return False  # hexadecimal letters are digits, too
    return len(set().union(*numbers)) < len(images)


def _names(kinds: Sequence[str]) -> list[str]:
    """A name for each camera: the words that differ, else its files' extension."""
    words = [_WORD.findall(Path(kind).stem) for kind in kinds]
    shared = set(words[0]).intersection(*words)
    names = ["_".join(word for word in own if word not in shared) for own in words]
    if len(set(names)) < len(names):
        endings = [Path(kind).suffix[1:] for kind in kinds]
        names = ["_".join(filter(None, pair)) for pair in zip(names, endings, strict=True)]
    if len(set(names)) < len(names):
        return [f"camera{number}" for number in range(len(names))]
    return [name or "camera" for name in names]


def _check_turns(folder: Path, images: Sequence[Path]) -> None:
    """Refuse interleaved images of two cameras; one camera may well change its size."""
    kinds = [_kind(path) for path in images[:_LOOKED_AT]]
    changes = [place for place in range(1, len(kinds)) if kinds[place] != kinds[place - 1]]
    if len(changes) >= len(set(kinds)) > 1:
        first, second = (
            f"{images[place].name} ({kinds[place]})" for place in (changes[0] - 1, changes[0])
        )
        raise SourceError(
            folder,
            f"holds images of several kinds interleaved, such as {first} and {second}",
            _ADVICE,
        )


def _kind(path: Path) -> str:
    try:
        return image_kind(path)
    except SourceError:  # JPEG files are kept whatever they contain
        return path.suffix.lower()


# ---------------------------------------------------------------- plain

_TOPIC, _FRAME = "/camera/image_raw", "camera"
_LISTED = 3
_IN_NS = re.compile(r"(?<![A-Za-z])ns\b")


def images_in(folder: Path) -> list[Path]:
    """The images directly in a folder, in the order of the numbers in their names."""
    found = [path for path in members(folder) if path.suffix.lower() in STILL_SUFFIXES]
    return sorted(found, key=_in_order)


def _in_order(path: Path) -> tuple[list[tuple[int, str]], str]:
    """Sorts 9 before 10, with or without leading zeros."""
    parts = re.split(r"([0-9]+)", path.name)
    return [(int(part or 0), "") if n % 2 else (0, part) for n, part in enumerate(parts)], path.name


def find_plain(folder: Path, options: ImageFolder) -> Scene:
    """The images of a folder: of one camera, or of several if a rate gives their times.

    Raises:
        SourceError: There are none, or their times are unknown.
        OptionError: An option is wrong.
    """
    if options.stamps and options.rate:
        raise OptionError(
            "`stamps` gives the times that `rate` would make up. Give only one of them."
        )
    scene = Scene(folder)
    images = images_in(folder)
    if not images:
        raise SourceError(folder, "holds no images" + _elsewhere(folder))
    if options.rate:
        scene.cameras += _by_rate(folder, images, options)
        files = images
    else:
        if options.stamps:
            files, stamps = _by_list(scene, images, Path(options.stamps), options.unit)
        else:
            files, stamps = images, _by_name(scene, images, options.unit)
        scene.cameras.append(_camera("", files, stamps, options))
    if unused := len(images) - len(set(files)):
        scene.skipped["images without a time"] = unused
    read = {Path(path).resolve() for path in (options.stamps, options.calibration) if path}
    others = [path for path in members(folder) if path.resolve() not in read]
    others = [path for path in others if path.suffix.lower() not in STILL_SUFFIXES]
    if others:
        scene.skipped[f"files in {folder.resolve().name} that are not images"] = len(others)
    scene.files.append(folder)
    return scene


def _camera(
    name: str, files: list[Path], stamps: NDArray[np.int64], options: ImageFolder
) -> SceneCamera:
    return SceneCamera(
        options.topic or (f"/{name}/image_raw" if name else _TOPIC),
        options.frame_id if options.frame_id is not None else name or _FRAME,
        files,
        stamps,
        encoding=options.encoding,
    )


def _by_rate(folder: Path, images: list[Path], options: ImageFolder) -> list[SceneCamera]:
    """The cameras whose images are in a folder, all starting at the same time."""
    found = by_camera(folder, images)
    given = [key for key in ("topic", "frame_id", "encoding") if getattr(options, key) is not None]
    if len(found) > 1 and given:
        raise OptionError(
            f"`{given[0]}` is for the images of one camera, but {folder} holds those of "
            f"{', '.join(found)}. Put each into a folder of its own."
        )
    try:
        return [
            _camera(name, files, at_rate(len(files), options.rate or ""), options)
            for name, files in found.items()
        ]
    except Refused as error:
        raise OptionError(f"`rate`: {error}") from None


def _elsewhere(folder: Path) -> str:
    """Where images are, if not in the folder itself."""
    places = [path for path in sorted(folder.iterdir()) if path.is_dir() and images_in(path)]
    if not places:
        return ", and is not in a known layout"
    listed = ", ".join(path.name for path in places[:_LISTED])
    more = ", ..." if len(places) > _LISTED else ""
    return f" itself, and is not in a known layout; there are some in {listed}{more}"


def _by_list(
    scene: Scene, images: list[Path], path: Path, unit: str | None
) -> tuple[list[Path], NDArray[np.int64]]:
    """The images of a list of times, which may also name them."""
    rows: Rows = [(number, split(line)) for number, line in lines_of(path)]
    header = rows.pop(0)[1] if rows and not any(map(is_number, rows[0][1])) else []
    if not rows:
        raise SourceError(path, "holds no times")
    time, name = _columns(path, *rows[0])
    if path.parent.resolve() != scene.folder.resolve():
        scene.files.append(path)
    chosen: Rows = []
    for number, values in rows:
        if len(values) <= max(time, name or 0):
            raise SourceError(path, f"line {number} has {len(values)} values, fewer than before")
        chosen.append((number, [values[time], *([] if name is None else [values[name]])]))
    if unit is None and len(header) > time and _IN_NS.search(header[time]):
        unit = "ns"
    unit = unit or unit_of([values[0] for _, values in chosen if is_number(values[0])])
    if unit is None:
        raise OptionError(f"{path}: its times are integers of an unknown unit. Give `unit`.")
    read = of_unit(unit, scene.skipped)
    if name is not None:
        return listed_images(path, scene.folder, read, chosen)
    stamps = read_times(path, chosen, read)
    if len(stamps) != len(images):
        raise SourceError(
            path, f"has {len(stamps)} times, but there are {len(images)} images in {scene.folder}"
        )
    return images, stamps


def _columns(path: Path, number: int, values: list[str]) -> tuple[int, int | None]:
    """Positions of a line's time, and of an image name, if any."""
    time = next((place for place, value in enumerate(values) if is_number(value)), None)
    if time is None:
        raise SourceError(path, f"line {number} has no time")
    names = (place for place, value in enumerate(values) if _is_image(value))
    return time, next(names, None)


def _is_image(name: str) -> bool:
    return name.lower().endswith(STILL_SUFFIXES)


def _by_name(scene: Scene, images: list[Path], unit: str | None) -> NDArray[np.int64]:
    names = [path.stem for path in images]
    if all(map(is_number, names)):
        unit = unit or unit_of(names)
    elif unit is not None:
        wrong = next(path for path in images if not is_number(path.stem))
        raise SourceError(
            wrong, "has a name that is not a time", "Give `stamps` FILE or `rate` HZ."
        )
    if unit is None or not all(map(is_number, names)):
        raise SourceError(
            scene.folder,
            "holds images whose names are not times in nanoseconds or decimal seconds",
            "Give `stamps` FILE, `rate` HZ, or the `unit` of the names.",
        )
    read = of_unit(unit, scene.skipped)
    stamps = np.empty(len(images), np.int64)
    for place, path in enumerate(images):
        try:
            stamps[place] = read(path.stem)
        except Refused as error:
            raise SourceError(path, f"has a name that is not a time: {error}") from None
    return stamps


# ---------------------------------------------------------------- layouts

_PLAIN_ONLY = ("stamps", "rate", "unit", "topic", "frame_id", "encoding")


@dataclass(frozen=True, slots=True)
class FolderLayout:
    """A layout of folders.

    Attributes:
        matches: Whether a folder has it.
        find: Finds what it holds.
        is_calibrated: Whether it has its own calibrations.
    """

    matches: Callable[[Path], bool]
    find: Callable[[Path, ImageFolder], Scene]
    is_calibrated: bool


LAYOUTS: Mapping[str, FolderLayout] = {
    "euroc": FolderLayout(is_euroc, find_euroc, is_calibrated=True),
    "tum": FolderLayout(is_tum, find_tum, is_calibrated=False),
    "plain": FolderLayout(lambda folder: True, find_plain, is_calibrated=False),
}
"""Layouts, in the order in which they are tried."""


def open_images(folder: Path, options: ImageFolder) -> ImagesReader:
    """Open a folder of images as a recording.

    Args:
        folder: The folder, on this machine.
        options: How to read it.

    Raises:
        SourceError: It cannot be read; says why and what to do.
        OptionError: The options do not apply to its layout.
    """
    if remote(folder):
        raise SourceError(folder, "cannot be read remotely", "Download it first.")
    if not folder.exists():
        raise SourceNotFoundError(folder)
    if not folder.is_dir():
        raise SourceError(folder, "is not a folder of images")
    _check(options)
    try:
        name = options.layout or next(key for key in LAYOUTS if LAYOUTS[key].matches(folder))
        layout = LAYOUTS[name]
        _check_for(name, layout, options)
        if not layout.matches(folder):
            raise SourceError(folder, f"does not have the layout {name}", "Omit `layout`.")
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
        raise OptionError(f"`layout` {options.layout!r} is not one of {', '.join(LAYOUTS)}.")
    if options.unit is not None and options.unit not in UNITS:
        raise OptionError(f"`unit` {options.unit!r} is not one of {', '.join(UNITS)}.")
    if options.encoding is not None and options.encoding not in ENCODINGS:
        raise OptionError(f"`encoding` {options.encoding!r} is not one of {', '.join(ENCODINGS)}.")
    if options.topic is not None and not options.topic.strip("/"):
        raise OptionError(f"`topic` {options.topic!r} is not a topic name.")


def _check_for(name: str, layout: FolderLayout, options: ImageFolder) -> None:
    """Refuse options for other layouts."""
    given = [key for key in _PLAIN_ONLY if getattr(options, key) is not None]
    if name != "plain" and given:
        raise OptionError(
            f"`{given[0]}` is for plain folders of images, but this one has the layout {name}, "
            f"which already defines it. Give `layout` plain, or omit `{given[0]}`."
        )
    if layout.is_calibrated and options.calibration:
        raise OptionError(
            f"`calibration` cannot be used with the layout {name}, which has its own."
        )


def _calibrate(scene: Scene, path: Path) -> None:
    """Give all cameras a calibration that matches their size.

    Raises:
        SourceError: It is not valid, or made for a different image size.
    """
    calibration = ros_calibration(path)
    for camera in scene.cameras:
        size = image_size(camera.files[0]) if camera.files else None
        if size not in (None, (calibration.width, calibration.height)):
            raise SourceError(
                path,
                f"is for images of {calibration.width}x{calibration.height}, but those of "
                f"{camera.topic} are {size[0]}x{size[1]}",
            )
    scene.cameras = [replace(camera, calibration=calibration) for camera in scene.cameras]
    if path.resolve() not in {file.resolve() for file in scene.files}:
        scene.files.append(path)
    scene.kept.append(path)
