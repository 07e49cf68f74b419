"""A folder of images without a layout: its times are in a list, in the names, or a rate."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import OptionError, SourceError
from mp4ds.importing.kinds import by_camera
from mp4ds.importing.options import ImageFolder
from mp4ds.importing.scene import (
    Camera,
    Rows,
    Scene,
    lines_of,
    listed_images,
    read_times,
    split,
)
from mp4ds.importing.times import NoTimeError, at_rate, is_number, of_unit, unit_of
from mp4ds.source_files import members
from mp4ds.video.stills import STILL_SUFFIXES

_TOPIC, _FRAME = "/camera/image_raw", "camera"
_LISTED = 3
_IN_NS = re.compile(r"(?<![A-Za-z])ns\b")


def images_in(folder: Path) -> list[Path]:
    """The images directly in a folder, in the order of the numbers in their names."""
    found = [path for path in members(folder) if path.suffix.lower() in STILL_SUFFIXES]
    return sorted(found, key=_in_order)


def _in_order(path: Path) -> tuple[list[tuple[int, str]], str]:
    """Orders 9 before 10, with zeros before it or without."""
    parts = re.split(r"([0-9]+)", path.name)
    return [(int(part or 0), "") if n % 2 else (0, part) for n, part in enumerate(parts)], path.name


def find_plain(folder: Path, options: ImageFolder) -> Scene:
    """The images of a folder: of one camera, or of several where a rate tells their times.

    Raises:
        SourceError: There are none, or nothing tells their times.
        OptionError: An option is wrong.
    """
    if options.stamps and options.rate:
        raise OptionError("--stamps tells the times that --rate makes up. Give one of them.")
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
        scene.skipped[f"files in {folder.resolve().name} that are no images"] = len(others)
    scene.files.append(folder)
    return scene


def _camera(
    name: str, files: list[Path], stamps: NDArray[np.int64], options: ImageFolder
) -> Camera:
    return Camera(
        options.topic or (f"/{name}/image_raw" if name else _TOPIC),
        options.frame_id if options.frame_id is not None else name or _FRAME,
        files,
        stamps,
        encoding=options.encoding,
    )


def _by_rate(folder: Path, images: list[Path], options: ImageFolder) -> list[Camera]:
    """The cameras whose images are in a folder, all from the same time on."""
    found = by_camera(folder, images)
    given = [key for key in ("topic", "frame_id", "encoding") if getattr(options, key) is not None]
    if len(found) > 1 and given:
        raise OptionError(
            f"--{given[0].replace('_', '-')} is for the images of one camera, and {folder} holds "
            f"those of {', '.join(found)}. Put each into a folder of its own."
        )
    try:
        return [
            _camera(name, files, at_rate(len(files), options.rate or ""), options)
            for name, files in found.items()
        ]
    except NoTimeError as error:
        raise OptionError(f"--rate: {error}") from None


def _elsewhere(folder: Path) -> str:
    """Where images are, if not in the folder itself."""
    places = [path for path in sorted(folder.iterdir()) if path.is_dir() and images_in(path)]
    if not places:
        return ", and no layout that is known"
    listed = ", ".join(path.name for path in places[:_LISTED])
    more = ", ..." if len(places) > _LISTED else ""
    return f" itself, and no layout that is known; there are some in {listed}{more}"


def _by_list(
    scene: Scene, images: list[Path], path: Path, unit: str | None
) -> tuple[list[Path], NDArray[np.int64]]:
    """The images of a list of times, which may name them."""
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
        raise OptionError(f"{path}: its times are whole numbers of an unknown unit. Give --unit.")
    read = of_unit(unit, scene.skipped)
    if name is not None:
        return listed_images(path, scene.folder, read, chosen)
    stamps = read_times(path, chosen, read)
    if len(stamps) != len(images):
        raise SourceError(
            path, f"has {len(stamps)} times, and there are {len(images)} images in {scene.folder}"
        )
    return images, stamps


def _columns(path: Path, number: int, values: list[str]) -> tuple[int, int | None]:
    """Where a line has its time, and the name of an image, if it has one."""
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
        raise SourceError(wrong, "has a name that is no time", "Give --stamps FILE or --rate HZ.")
    if unit is None or not all(map(is_number, names)):
        raise SourceError(
            scene.folder,
            "holds images whose names are no times in nanoseconds or decimal seconds",
            "Give --stamps FILE, --rate HZ, or the --unit of the names.",
        )
    read = of_unit(unit, scene.skipped)
    stamps = np.empty(len(images), np.int64)
    for place, path in enumerate(images):
        try:
            stamps[place] = read(path.stem)
        except NoTimeError as error:
            raise SourceError(path, f"has a name that is no time: {error}") from None
    return stamps
