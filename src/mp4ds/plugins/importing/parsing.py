"""Parsers for the times, lists and calibrations of folders of images."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds import yamlio
from mp4ds.errors import FormatError, Refused, SourceError
from mp4ds.messages.transforms import Transform, quaternion_of
from mp4ds.messages.wire import CalibrationFields

UNITS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
"""Nanoseconds of each unit."""

MAX_STAMP = 2**31 * 10**9 - 1
"""The latest time that a ROS 2 message can represent, nanoseconds: in 2038."""

ROUNDED = "times finer than a nanosecond, which were rounded"

_CERTAIN_DIGITS = 16  # of nanoseconds since 1970; counts of seconds or images have fewer
_NUMBER = re.compile(r"\+?([0-9]{1,40})(?:(\.[0-9]{0,40})?([eE][-+]?[0-9]{1,2})?)?")


def is_number(text: str) -> bool:
    """Whether a text is a number that may be a time."""
    return _NUMBER.fullmatch(text) is not None


def unit_of(texts: Sequence[str]) -> str | None:
    """The unit of numbers: seconds if one has decimals, nanoseconds if they are long.

    Returns:
        ``s`` or ``ns``; None if unknown.
    """
    if any(not text.lstrip("+").isdigit() for text in texts):
        return "s"
    longest = max((len(text.lstrip("+0")) for text in texts), default=0)
    return "ns" if longest >= _CERTAIN_DIGITS else None


def of_unit(unit: str, found: Counter[str]) -> Callable[[str], int]:
    """A parser for numbers of a unit.

    Args:
        unit: One of `UNITS`.
        found: Gets how many were rounded.

    Returns:
        Text -> nanoseconds; it raises Refused.
    """
    scale = UNITS[unit]

    def read(text: str) -> int:
        if not _NUMBER.fullmatch(text):
            raise Refused(f"{text!r} is not a time in {unit}")
        time = Fraction(text) * scale
        nanoseconds = round(time)
        if not 0 <= nanoseconds <= MAX_STAMP:
            raise Refused(f"{text!r} is not between 1970 and 2038, the range of ROS 2 times")
        if nanoseconds != time:
            found[ROUNDED] += 1
        return nanoseconds

    return read


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


# ---------------------------------------------------------------- calibration

IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
_MAX_BYTES = 2**20
_MAX_SIZE = 2**31

# name in a file -> that of ROS, and how many parameters it may have
_MODELS = {
    "plumb_bob": ("plumb_bob", (4, 5)),
    "radial-tangential": ("plumb_bob", (4, 5)),
    "radtan": ("plumb_bob", (4, 5)),
    "rational_polynomial": ("rational_polynomial", (8, 12, 14)),
    "equidistant": ("equidistant", (4,)),
    "fisheye": ("equidistant", (4,)),
    "none": ("plumb_bob", (0, 4, 5)),
}

_OPENCV_HEADER = re.compile(rb"(?:\xef\xbb\xbf)?%YAML:1\.\d[ \t]*\r?\n(?:---[ \t]*\r?\n)?")
_OPENCV_TAG = re.compile(rb"(?m)(?<=:)[ \t]*!!opencv-matrix(?=[ \t]*\r?$)")


def _without_opencv(data: bytes) -> bytes:
    """YAML without OpenCV FileStorage's extras: its directive, and its matrix tag."""
    if not (header := _OPENCV_HEADER.match(data)):
        return data
    lines = b"#\n" * header[0].count(b"\n")  # keeps line numbers in errors
    return lines + _OPENCV_TAG.sub(b"", data[header.end() :])


def read_yaml(path: Path) -> dict[str, Any]:
    """The values of a small YAML file, which OpenCV may have written.

    Raises:
        SourceError: It is not valid, or uses more of YAML than maps, lists and plain values.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise SourceError(
                path, f"is larger than {_MAX_BYTES} bytes, so it cannot be a calibration"
            )
        return yamlio.load(_without_opencv(path.read_bytes()), str(path))
    except FormatError as error:
        raise SourceError(path, error.problem) from None
    except OSError as error:
        raise SourceError(path, f"cannot be read: {error.strerror}") from None


def ros_calibration(path: Path) -> CalibrationFields:
    """The calibration that ROS's camera_calibration saves.

    Raises:
        SourceError: It is not valid; says what is missing or wrong.
    """
    values = read_yaml(path)
    try:
        k = _matrix(values, "camera_matrix", 9)
        return CalibrationFields(
            width=_side(values, "image_width"),
            height=_side(values, "image_height"),
            **_distortion(
                str(_known(values, "distortion_model")),
                _matrix(values, "distortion_coefficients", None),
            ),
            k=k,
            r=_matrix(values, "rectification_matrix", 9, IDENTITY),
            p=_matrix(values, "projection_matrix", 12, projection(k)),
        )
    except ValueError as error:
        raise SourceError(
            path,
            f"is not a valid calibration: {error}",
            "Give a YAML file saved by ROS's camera_calibration.",
        ) from None


def euroc_calibration(path: Path, values: dict[str, Any]) -> CalibrationFields:
    """The calibration of a camera in EuRoC's sensor.yaml.

    Args:
        path: The file, for errors.
        values: Of `read_yaml`.

    Raises:
        SourceError: It is not valid; says what is missing or wrong.
    """
    try:
        model = str(_known(values, "camera_model"))
        if model != "pinhole":
            raise ValueError(f"camera_model is {model!r}, not pinhole")
        width, height = _numbers(_known(values, "resolution"), "resolution", 2)
        fx, fy, cx, cy = _numbers(_known(values, "intrinsics"), "intrinsics", 4)
        k = (fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0)
        name = str(_known(values, "distortion_model"))
        d = _known(values, "distortion_coefficients")
        d = _numbers(d, "distortion_coefficients", None)
        return CalibrationFields(
            width=_whole(width, "resolution"),
            height=_whole(height, "resolution"),
            # a model that is not known here may be known to those who read the messages
            **(_distortion(name, d) if name in _MODELS else {"distortion_model": name, "d": d}),
            k=k,
            r=IDENTITY,
            p=projection(k),
        )
    except ValueError as error:
        raise SourceError(path, f"is not a valid calibration: {error}") from None


def euroc_pose(path: Path, values: dict[str, Any], body: str, sensor: str) -> list[Transform]:
    """The pose of a sensor in the body, by ``T_BS`` of EuRoC's sensor.yaml; none if it is absent.

    Raises:
        SourceError: It is not valid.
    """
    if "T_BS" not in values:
        return []
    try:
        pose = np.array(_matrix(values, "T_BS", 16)).reshape(4, 4)
        x, y, z = (pose[:3, 3] + 0.0).tolist()  # without negative zeros
        return [Transform(body, sensor, (x, y, z), quaternion_of(pose[:3, :3]))]
    except ValueError as error:
        raise SourceError(path, f"holds no valid pose: {error}") from None


def projection(k: Sequence[float]) -> tuple[float, ...]:
    """The projection matrix, 3 x 4 by rows, of an unrectified camera."""
    return (*k[0:3], 0.0, *k[3:6], 0.0, *k[6:9], 0.0)


def _distortion(name: str, values: tuple[float, ...]) -> dict[str, Any]:
    if name not in _MODELS:
        known = ", ".join(_MODELS)
        raise ValueError(f"distortion_model {name!r} is not known; known are {known}")
    model, counts = _MODELS[name]
    if len(values) not in counts:
        listed = " or ".join(map(str, counts))
        raise ValueError(f"{name} has {listed} distortion_coefficients, not {len(values)}")
    if model == "plumb_bob":  # ROS's also has the third radial coefficient
        values = (*values, *(0.0,) * 5)[:5]
    return {"distortion_model": model, "d": values}


def _known(values: dict[str, Any], key: str) -> Any:
    if key not in values:
        raise ValueError(f"{key} is missing")
    return values[key]


def _side(values: dict[str, Any], key: str) -> int:
    return _whole(_numbers([_known(values, key)], key, 1)[0], key)


def _whole(value: float, key: str) -> int:
    if value != int(value) or not 0 < value < _MAX_SIZE:
        raise ValueError(f"{key} is {value}")
    return int(value)


def _matrix(
    values: dict[str, Any], key: str, count: int | None, default: tuple[float, ...] | None = None
) -> tuple[float, ...]:
    if key not in values and default is not None:
        return default
    matrix = _known(values, key)
    return _numbers(matrix.get("data") if isinstance(matrix, dict) else matrix, key, count)


def _numbers(values: Any, key: str, count: int | None) -> tuple[float, ...]:
    if not isinstance(values, list) or len(values) != (len(values) if count is None else count):
        listed = "numbers" if count is None else f"{count} numbers"
        raise ValueError(f"{key} is not a list of {listed}")
    return tuple(_number(value, key) for value in values)


def _number(value: Any, key: str) -> float:
    try:
        # YAML 1.1 allows floats such as 1., which are strings in the subset
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"{key} holds {value!r}")
    return number


# ---------------------------------------------------------------- lists

MAX_TEXT = 2**30
_MAX_LINE = 2**16


def lines_of(path: Path) -> Iterator[tuple[int, str]]:
    """Number, from 1, and text of each line that is neither blank nor a comment.

    Raises:
        SourceError: It is not a text file, or cannot be read.
    """
    try:
        if path.stat().st_size > MAX_TEXT:
            raise SourceError(path, f"is larger than {MAX_TEXT} bytes, so it cannot be a list")
        with path.open(encoding="utf-8-sig") as stream:
            for number, line in enumerate(iter(lambda: stream.readline(_MAX_LINE), ""), start=1):
                text = line.strip()
                if text and not text.startswith("#"):
                    yield number, text
    except UnicodeDecodeError:
        raise SourceError(path, "is not a text file") from None
    except OSError as error:
        raise SourceError(path, f"cannot be read: {error.strerror}") from None


def split(line: str) -> list[str]:
    """The values of a line: between commas if there is one, else between spaces."""
    if "," in line:
        return [part.strip() for part in line.split(",")]
    return line.split()


Rows = list[tuple[int, list[str]]]


def read_times(path: Path, rows: Rows, read: Callable[[str], int]) -> NDArray[np.int64]:
    """The times at the start of a list's rows.

    Raises:
        SourceError: One is not valid; names its line.
    """
    times = np.empty(len(rows), np.int64)
    for place, (number, values) in enumerate(rows):
        try:
            times[place] = read(values[0])
        except Refused as error:
            raise SourceError(path, f"line {number}: {error}") from None
    return times


def read_table(
    path: Path, read: Callable[[str], int], values: int, *, more: bool = False
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Times and numbers of a list.

    Args:
        path: The file.
        read: Reads a time.
        values: Numbers of each row after the time.
        more: Whether further numbers may follow, which are ignored.

    Raises:
        SourceError: A line has different values; names it.
    """
    rows = [(number, split(line)) for number, line in lines_of(path)]
    times = read_times(path, rows, read)
    table = np.empty((len(rows), values))
    for place, (number, row) in enumerate(rows):
        if len(row) < values + 1 or (len(row) > values + 1 and not more):
            raise SourceError(path, f"line {number} has {len(row)} values, not {values + 1}")
        try:
            table[place] = [float(text) for text in row[1 : values + 1]]
        except ValueError:
            raise SourceError(path, f"line {number} holds something other than numbers") from None
    return times, table


def listed_images(
    path: Path, folder: Path, read: Callable[[str], int], rows: Rows | None = None
) -> tuple[list[Path], NDArray[np.int64]]:
    """The images of a list of times and file names.

    Args:
        path: The list.
        folder: The folder of the files.
        read: Reads a time.
        rows: The lines of the list, if already read.

    Raises:
        SourceError: A line is not a time and name, or its file does not exist.
    """
    if rows is None:
        rows = [
            # in two: a name may have spaces in it
            (number, [part.strip() for part in re.split(r",|\s", line, maxsplit=1)])
            for number, line in lines_of(path)
        ]
    times = read_times(path, rows, read)
    return [_listed(path, folder, number, values) for number, values in rows], times


def _listed(path: Path, folder: Path, number: int, values: list[str]) -> Path:
    if len(values) != 2 or not values[1]:
        raise SourceError(path, f"line {number} is not a time and a file name")
    name = PurePosixPath(values[1])
    if name.is_absolute() or ".." in name.parts:
        raise SourceError(path, f"line {number} names a file outside of {folder}: {name}")
    image = folder / name
    if not image.is_file():
        raise SourceError(path, f"line {number} names {image}, which does not exist")
    return image
