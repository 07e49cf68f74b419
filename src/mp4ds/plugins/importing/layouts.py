"""Folders of images: EuRoC MAV, TUM RGB-D, and plain ones; and videos."""

from __future__ import annotations

import re
from array import array
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from itertools import chain
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import OptionError, Refused, SourceError, SourceNotFoundError
from mp4ds.files.sources import members
from mp4ds.files.urls import remote
from mp4ds.format.models import EXACT_SUFFIX
from mp4ds.format.sidecars import MANIFEST_NAME
from mp4ds.messages.wire import CalibrationFields
from mp4ds.packing.options import ImportOptions, plugin
from mp4ds.plugins.importing.calibrations import (
    euroc_calibration,
    euroc_pose,
    read_yaml,
    ros_calibration,
)
from mp4ds.plugins.importing.reader import ImagesReader, reading
from mp4ds.video.clips import Clip, open_video
from mp4ds.video.images import STILL_SUFFIXES, image_size

_LEROBOT = "meta/info.json"


def open_images(folder: Path, options: ImportOptions) -> ImagesReader:
    """Open a folder of images, or a video, as a recording.

    Args:
        folder: The folder or video, on this machine.
        options: How to read it.

    Raises:
        SourceError: It cannot be read; says why and what to do.
        OptionError: The options do not apply to its layout.
    """
    if remote(folder):
        raise SourceError(folder, "cannot be read remotely", "Download it first.")
    if not folder.exists():
        raise SourceNotFoundError(folder)
    if options.episode is not None or (folder / _LEROBOT).is_file():
        with reading(folder):
            reader: ImagesReader = plugin("importing.lerobot:open_episode")(folder, options)
        return reader
    if options.topic is not None and not options.topic.strip("/"):
        raise OptionError(f"`topic` {options.topic!r} is not a topic name.")
    with reading(folder):
        reader = ImagesReader(folder)
        if folder.is_file():
            options.check_for("video")
            _add_video(reader, options)
        elif any((sensor / "data").is_dir() for sensor in _sensors(folder)):
            options.check_for("euroc")
            _add_euroc(reader)
        elif any((folder / f"{name}.txt").is_file() for name in _CAMERAS):
            options.check_for("tum")
            _add_tum(reader, options)
        else:
            options.check_for("plain")
            _add_plain(reader, options)
    if options.calibration:
        reader.add_file(Path(options.calibration), is_kept=True)
    reader.finish()
    return reader


def episodes_in(folder: Path) -> list[int]:
    """The numbers of the episodes of a LeRobotDataset v3.

    Raises:
        SourceError: It is not one, or has none.
        OptionError: The library for its tables is missing.
    """
    if not (folder / _LEROBOT).is_file():
        raise SourceError(folder, f"is not a LeRobotDataset v3: it has no {_LEROBOT}")
    with reading(folder):
        found: list[int] = plugin("importing.lerobot:episodes_in")(folder)
    return found


def _calibration(
    options: ImportOptions, topic: str, images: Sequence[Path], size: tuple[int, int] | None = None
) -> CalibrationFields | None:
    """The given calibration for the images of a camera, whose size may be known.

    Raises:
        SourceError: It is not valid, or made for a different image size.
    """
    if not options.calibration:
        return None
    found = ros_calibration(Path(options.calibration))
    size = image_size(images[0]) if images else size
    if size not in (None, (found.width, found.height)):
        raise SourceError(
            Path(options.calibration),
            f"is for images of {found.width}x{found.height}, but those of {topic} are "
            f"{size[0]}x{size[1]}",
        )
    return found


# ---------------------------------------------------------------- euroc

_LIST = "data.csv"
_BODY, _WORLD = "body", "world"
_POSES = ("state_groundtruth_estimate", "mocap", "pose")


def _root(folder: Path) -> Path:
    return folder / "mav0" if (folder / "mav0").is_dir() else folder


def _sensors(folder: Path) -> list[Path]:
    """The folders of the sensors: those with a list."""
    return sorted(path.parent for path in _root(folder).glob(f"*/{_LIST}"))


def _add_euroc(reader: ImagesReader) -> None:
    """Add cameras, IMUs and poses."""
    sensors, lists = _sensors(reader.path), ListReader("ns", reader.left_out)
    for sensor in sensors:
        name, is_camera, path = sensor.name, (sensor / "data").is_dir(), sensor / _LIST
        described: dict[str, Any] = {}
        if (sensor / "sensor.yaml").is_file():
            reader.add_file(sensor / "sensor.yaml", is_kept=True)
            described = read_yaml(sensor / "sensor.yaml")
        if is_camera or name.startswith("imu"):
            reader.transforms += euroc_pose(sensor / "sensor.yaml", described, _BODY, name)
        if is_camera:
            _add_euroc_camera(reader, sensor, described, lists)
        elif name.startswith("imu"):
            reader.add_table(f"/{name}", "imu", name, *lists.table(path, 6))
        elif name.startswith(_POSES):
            # position and w, x, y, z of the quaternion; a pose holds no velocities and biases
            shortened = f"rows of {name} of which only the pose was taken"
            stamps, rows = lists.table(path, 7, shortened=shortened)
            reader.add_table(f"/{name}", "pose", _WORLD, stamps, rows[:, [0, 1, 2, 4, 5, 6, 3]])
        else:
            reader.leave_out(sensor, f"{name}, which is not a camera, IMU or pose")
            continue
        reader.add_file(path)
    for path in sorted(_root(reader.path).iterdir()):
        if path.is_file() and path.suffix == ".yaml":
            reader.add_file(path, is_kept=True)
        elif path not in sensors:
            reader.leave_out(path, f"{path.name}, which has no {_LIST}")


def _add_euroc_camera(
    reader: ImagesReader, sensor: Path, described: dict[str, Any], lists: ListReader
) -> None:
    images = sensor / "data"
    files, stamps = lists.images(sensor / _LIST, images)
    if unlisted := len(members(images)) - len(set(files)):
        what = f"files in {images.name} of {sensor.name} that {_LIST} does not list"
        reader.left_out[what] = unlisted
    calibration = euroc_calibration(sensor / "sensor.yaml", described)
    topic = f"/{sensor.name}/image_raw"
    reader.add_camera(topic, sensor.name, files, stamps, calibration=calibration)
    reader.add_file(images)


# ---------------------------------------------------------------- tum

# list -> the encoding of its images; depths are left in the unit of the files
_CAMERAS = {"rgb": None, "depth": "16UC1"}
_TABLES = {
    "accelerometer": ("accelerometer", 3, "accelerometer"),
    "groundtruth": ("pose", 7, _WORLD),
}


def _add_tum(reader: ImagesReader, options: ImportOptions) -> None:
    """Add the colour and depth images, accelerometer and poses."""
    folder, lists = reader.path, ListReader("s", reader.left_out)
    listed: dict[Path, set[Path]] = {}
    for name, encoding in _CAMERAS.items():
        path = folder / f"{name}.txt"
        if path.is_file():
            files, stamps = lists.images(path, folder)
            topic = f"/{name}/image_raw"
            calibration = _calibration(options, topic, files)
            reader.add_camera(
                topic, name, files, stamps, calibration=calibration, encoding=encoding
            )
            reader.add_file(path)
            for file in files:
                listed.setdefault(file.parent, set()).add(file)
    for place, own in listed.items():
        reader.add_file(place)
        if place != folder and (unlisted := len(members(place)) - len(own)):
            reader.left_out[f"files in {place.name} that are not in any list"] = unlisted
    for name, (kind, values, frame_id) in _TABLES.items():
        path = folder / f"{name}.txt"
        if path.is_file():
            reader.add_table(f"/{name}", kind, frame_id, *lists.table(path, values))
            reader.add_file(path)
    for path in sorted(folder.iterdir()):
        if path not in reader.files:
            reader.leave_out(path, f"{path.name}, which is not part of the layout")


# ---------------------------------------------------------------- video


def _named(options: ImportOptions) -> tuple[str, str]:
    """Topic and frame id of the only camera."""
    frame_id = options.frame_id if options.frame_id is not None else "camera"
    return options.topic or "/camera/image_raw", frame_id


def _add_video(reader: ImagesReader, options: ImportOptions) -> None:
    """Add the frames of a video.

    Raises:
        SourceError: They cannot be messages, or there are not as many times.
    """
    is_half = reader.path.name.endswith(EXACT_SUFFIX)
    if is_half or (reader.path.parent / MANIFEST_NAME).is_file():
        raise SourceError(
            reader.path,
            "is a video of a dataset, which also has its stamps and what makes it exact",
            "Use the dataset itself: `mp4ds pack`, `unpack` and the others take it.",
        )
    clip = Clip(open_video(reader.path), pictures="rgb24" if options.decode else "")
    reader.add_file(reader.path)
    stamps, source = clip.file.times, reader.path
    if options.stamps:
        source = Path(options.stamps)
        rows, lists = _listed(reader, source, options.unit)
        stamps = lists.times(source, rows)
        if len(stamps) != len(clip.numbers):
            raise SourceError(
                source, f"has {len(stamps)} times, but {reader.path} has {len(clip.numbers)} frames"
            )
        if (back := np.flatnonzero(np.diff(stamps) < 0)).size:
            problem = f"line {rows[back[0] + 1][0]}: it is earlier than the time before"
            raise SourceError(source, problem)
    elif options.unit:
        raise OptionError("`unit` is that of `stamps`. Give a list of times, too.")
    offset = options.offset.ns if options.offset else 0
    if stamps[0] + offset < 0 or int(stamps[-1]) + offset > MAX_STAMP:
        problem = "has times before 1970 or after 2038, the range of ROS 2 times"
        raise SourceError(source, problem, "Give `offset`.")
    topic, frame_id = _named(options)
    calibration = _calibration(options, topic, (), clip.file.size)
    stamps = stamps + offset
    reader.add_clip(topic, frame_id, clip, stamps, calibration=calibration)


# ---------------------------------------------------------------- plain

_LISTED = 3
_IN_NS = re.compile(r"(?<![A-Za-z])ns\b")
_MOST = 8  # cameras; more words are not names of cameras
# a number, except for that of a camera such as cam0
_NUMBER = re.compile(r"(?<!\d)(?<!cam)(?<!camera)\d+|(?<=cam)\d{2,}|(?<=camera)\d{2,}", re.I)
_HEX = re.compile(r"[0-9a-f]+", re.I)


def images_in(folder: Path) -> list[Path]:
    """The images directly in a folder, in the order of the numbers in their names."""
    found = [path for path in members(folder) if path.suffix.lower() in STILL_SUFFIXES]
    return sorted(found, key=_in_order)


def _in_order(path: Path) -> tuple[list[tuple[int, str]], str]:
    """Sorts 9 before 10, with or without leading zeros."""
    parts = re.split(r"([0-9]+)", path.name)
    return [(int(part or 0), "") if n % 2 else (0, part) for n, part in enumerate(parts)], path.name


def _add_plain(reader: ImagesReader, options: ImportOptions) -> None:
    """Add the images of one camera.

    Raises:
        SourceError: There are none, or their times are unknown.
        OptionError: An option is wrong.
    """
    if options.stamps and options.rate:
        raise OptionError(
            "`stamps` gives the times that `rate` would make up. Give only one of them."
        )
    folder = reader.path
    images = files = images_in(folder)
    if not images:
        raise SourceError(folder, "holds no images" + _elsewhere(folder))
    if options.rate:
        _check_one_camera(folder, images)
        try:
            stamps = at_rate(len(images), options.rate)
        except Refused as error:
            raise OptionError(f"`rate`: {error}") from None
    elif options.stamps:
        files, stamps = _by_list(reader, images, Path(options.stamps), options.unit)
    else:
        stamps = _by_name(reader, images, options.unit)
    topic, frame_id = _named(options)
    reader.add_camera(
        topic,
        frame_id,
        files,
        stamps,
        calibration=_calibration(options, topic, files),
        encoding=options.encoding,
    )
    if unused := len(images) - len(set(files)):
        reader.left_out["images without a time"] = unused
    read = {Path(path).resolve() for path in (options.stamps, options.calibration) if path}
    others = [path for path in members(folder) if path.resolve() not in read]
    others = [path for path in others if path.suffix.lower() not in STILL_SUFFIXES]
    if others:
        reader.left_out[f"files in {folder.resolve().name} that are not images"] = len(others)
    reader.add_file(folder)


def _check_one_camera(folder: Path, images: Sequence[Path]) -> None:
    """Refuse images of several cameras: names with different words, and the same numbers.

    Raises:
        SourceError: They are ``color_0001.jpg`` and ``depth_0001.png``, or the like.
    """
    kinds: dict[str, list[Path]] = {}
    for path in images:
        kinds.setdefault(_NUMBER.sub("#", path.stem) + path.suffix.lower(), []).append(path)
    if not 1 < len(kinds) <= _MOST or min(map(len, kinds.values())) < 2:
        return
    endings = {path.suffix.lower() for path in images}
    if len(endings) < len(kinds) and all(_HEX.fullmatch(path.stem) for path in images):
        return  # hexadecimal letters are digits, too
    if len({tuple(map(int, _NUMBER.findall(path.stem))) for path in images}) < len(images):
        first, second = (paths[0].name for paths in list(kinds.values())[:2])
        raise SourceError(
            folder,
            f"holds images of several cameras, judging by names such as {first} and {second}",
            "Put each camera's images into a folder of its own.",
        )


def _elsewhere(folder: Path) -> str:
    """Where images are, if not in the folder itself."""
    places = [path for path in sorted(folder.iterdir()) if path.is_dir() and images_in(path)]
    if not places:
        return ", and is not in a known layout"
    listed = ", ".join(path.name for path in places[:_LISTED])
    more = ", ..." if len(places) > _LISTED else ""
    return f" itself, and is not in a known layout; there are some in {listed}{more}"


def _by_list(
    reader: ImagesReader, images: list[Path], path: Path, unit: str | None
) -> tuple[list[Path], NDArray[np.int64]]:
    """The images of a list of times, which may also name them."""
    chosen, lists = _listed(reader, path, unit)
    if len(chosen[0][1]) > 1:
        return lists.images(path, reader.path, chosen)
    stamps = lists.times(path, chosen)
    if len(stamps) != len(images):
        raise SourceError(
            path, f"has {len(stamps)} times, but there are {len(images)} images in {reader.path}"
        )
    return images, stamps


def _listed(reader: ImagesReader, path: Path, unit: str | None) -> tuple[list[Row], ListReader]:
    """The times of a list, each with the name of an image if it has names, and their reader."""
    rows = rows_of(path)
    first = next(rows, None)
    header: list[str] = []
    if first and not any(map(is_number, first[1])):
        header = first[1]
        first = next(rows, None)
    if first is None:
        raise SourceError(path, "holds no times")
    time, name = _columns(path, *first)
    if path.parent.resolve() != reader.path.resolve():
        reader.add_file(path)
    chosen: list[Row] = []
    for number, values in chain([first], rows):
        if len(values) <= max(time, name or 0):
            raise SourceError(path, f"line {number} has {len(values)} values, fewer than before")
        chosen.append((number, [values[time], *([] if name is None else [values[name]])]))
    if unit is None and len(header) > time and _IN_NS.search(header[time]):
        unit = "ns"
    unit = unit or unit_of([values[0] for _, values in chosen if is_number(values[0])])
    if unit is None:
        raise OptionError(f"{path}: its times are integers of an unknown unit. Give `unit`.")
    return chosen, ListReader(unit, reader.left_out)


def _columns(path: Path, number: int, values: list[str]) -> tuple[int, int | None]:
    """Positions of a line's time, and of an image name, if any."""
    time = next((place for place, value in enumerate(values) if is_number(value)), None)
    if time is None:
        raise SourceError(path, f"line {number} has no time")
    names = (place for place, value in enumerate(values) if value.lower().endswith(STILL_SUFFIXES))
    return time, next(names, None)


def _by_name(reader: ImagesReader, images: list[Path], unit: str | None) -> NDArray[np.int64]:
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
            reader.path,
            "holds images whose names are not times in nanoseconds or decimal seconds",
            "Give `stamps` FILE, `rate` HZ, or the `unit` of the names.",
        )
    lists = ListReader(unit, reader.left_out)
    stamps = np.empty(len(images), np.int64)
    for place, path in enumerate(images):
        try:
            stamps[place] = lists.time(path.stem)
        except Refused as error:
            raise SourceError(path, f"has a name that is not a time: {error}") from None
    return stamps


# ---------------------------------------------------------------- lists

MAX_STAMP = 2**31 * 10**9 - 1
"""The latest time that a ROS 2 message can represent, nanoseconds: in 2038."""

ROUNDED = "times finer than a nanosecond, which were rounded"

Row = tuple[int, list[str]]
"""Number of a line, from 1, and its values."""

_UNITS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
_CERTAIN_DIGITS = 16  # of nanoseconds since 1970; counts of seconds or images have fewer
_TIME = re.compile(r"\+?([0-9]{1,40})(?:(\.[0-9]{0,40})?([eE][-+]?[0-9]{1,2})?)?")
_MAX_TEXT = 2**30
_MAX_LINE = 2**16


def is_number(text: str) -> bool:
    """Whether a text is a number that may be a time."""
    return _TIME.fullmatch(text) is not None


def unit_of(texts: Sequence[str]) -> str | None:
    """The unit of numbers: seconds if one has decimals, nanoseconds if they are long.

    Returns:
        ``s`` or ``ns``; None if unknown.
    """
    if any(not text.lstrip("+").isdigit() for text in texts):
        return "s"
    longest = max((len(text.lstrip("+0")) for text in texts), default=0)
    return "ns" if longest >= _CERTAIN_DIGITS else None


def at_rate(count: int, rate: str) -> NDArray[np.int64]:
    """Times of images at a rate, from 0 on, rounded to nanoseconds.

    Args:
        count: Number of images.
        rate: Images per second, such as ``20``, ``29.97`` or ``30000/1001``.

    Raises:
        Refused: It is not a rate.
    """
    try:
        found = Fraction(rate)
    except (ValueError, ZeroDivisionError):
        found = Fraction(0)
    if not Fraction(1, 10**6) <= found <= 10**6:
        raise Refused(f"{rate!r} is not a rate in Hz")
    times = [round(number * 10**9 / found) for number in range(count)]
    if times and times[-1] > MAX_STAMP:
        raise Refused(f"{rate!r} Hz is too slow for {count} images")
    return np.array(times, np.int64)


def rows_of(path: Path) -> Iterator[Row]:
    """The lines of a list that are neither blank nor comments.

    Values are between commas if there is one in the line, else between spaces.

    Raises:
        SourceError: It is not a text file, or too large for a list.
        OSError: It cannot be read.
    """
    for number, line in _lines_of(path):
        yield number, [part.strip() for part in line.split(",")] if "," in line else line.split()


def _lines_of(path: Path) -> Iterator[tuple[int, str]]:
    if path.stat().st_size > _MAX_TEXT:
        raise SourceError(path, f"is larger than {_MAX_TEXT} bytes, so it cannot be a list")
    try:
        with path.open(encoding="utf-8-sig") as stream:
            for number, line in enumerate(iter(lambda: stream.readline(_MAX_LINE + 1), ""), 1):
                if len(line) > _MAX_LINE:  # what follows of it would be taken for another line
                    raise SourceError(path, f"line {number} is too long for a list")
                text = line.strip()
                if text and not text.startswith("#"):
                    yield number, text
    except UnicodeDecodeError:
        raise SourceError(path, "is not a text file") from None


class ListReader:
    """Reads lists whose lines begin with a time.

    Args:
        unit: Of the times: ``s``, ``ms``, ``us`` or ``ns``.
        left_out: Counts what is not taken as it is: a phrase -> how many.
    """

    def __init__(self, unit: str, left_out: Counter[str]) -> None:
        self._unit, self._left_out = unit, left_out

    def time(self, text: str) -> int:
        """Nanoseconds of a time.

        Raises:
            Refused: It is none.
        """
        if not is_number(text):
            raise Refused(f"{text!r} is not a time in {self._unit}")
        exact = Fraction(text) * _UNITS[self._unit]
        nanoseconds = round(exact)
        if not 0 <= nanoseconds <= MAX_STAMP:
            raise Refused(f"{text!r} is not between 1970 and 2038, the range of ROS 2 times")
        if nanoseconds != exact:
            self._left_out[ROUNDED] += 1
        return nanoseconds

    def times(self, path: Path, rows: Iterable[Row]) -> NDArray[np.int64]:
        """The times at the start of a list's rows.

        Raises:
            SourceError: One is not valid; names its line.
        """
        return np.array([self._time_of(path, row) for row in rows], np.int64)

    def _time_of(self, path: Path, row: Row) -> int:
        try:
            return self.time(row[1][0])
        except Refused as error:
            raise SourceError(path, f"line {row[0]}: {error}") from None

    def table(
        self, path: Path, count: int, *, shortened: str = ""
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Times and numbers of a list.

        A number may be NaN or infinite: a sensor says so, and a message can hold it.

        Args:
            path: The file.
            count: Numbers of each row after the time.
            shortened: The phrase that counts rows with further numbers, which are not taken;
                empty if there may be none.

        Raises:
            SourceError: A line has different values; names it.
        """
        times, numbers = array("q"), array("d")
        for number, row in rows_of(path):
            times.append(self._time_of(path, (number, row)))
            if len(row) <= count or (len(row) > count + 1 and not shortened):
                raise SourceError(path, f"line {number} has {len(row)} values, not {count + 1}")
            if len(row) > count + 1:
                self._left_out[shortened] += 1
            try:
                numbers.extend(map(float, row[1 : count + 1]))
            except ValueError:
                problem = f"line {number} holds something other than numbers"
                raise SourceError(path, problem) from None
        return np.array(times, np.int64), np.array(numbers, np.float64).reshape(-1, count)

    def images(
        self, path: Path, folder: Path, rows: Sequence[Row] | None = None
    ) -> tuple[list[Path], NDArray[np.int64]]:
        """The images of a list of times and file names.

        Args:
            path: The list.
            folder: The folder of the files.
            rows: The time and name of each, if already read.

        Raises:
            SourceError: A line is not a time and name, or its file does not exist.
        """
        if rows is None:
            rows = [
                # in two: a name may have spaces in it
                (number, [part.strip() for part in re.split(r",|\s", line, maxsplit=1)])
                for number, line in _lines_of(path)
            ]
        times = self.times(path, rows)
        return [_image_of(path, folder, *row) for row in rows], times


def _image_of(path: Path, folder: Path, number: int, values: list[str]) -> Path:
    if len(values) != 2 or not values[1]:
        raise SourceError(path, f"line {number} is not a time and a file name")
    name = PurePosixPath(values[1])
    if name.is_absolute() or ".." in name.parts:
        raise SourceError(path, f"line {number} names a file outside of {folder}: {name}")
    image = folder / name
    if not image.is_file():
        raise SourceError(path, f"line {number} names {image}, which does not exist")
    return image
