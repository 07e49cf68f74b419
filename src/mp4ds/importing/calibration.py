"""Calibrations in YAML: of ROS's camera_calibration, and of EuRoC's sensors."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mp4ds import yamlio
from mp4ds.errors import FormatError, SourceError
from mp4ds.importing.geometry import Matrix
from mp4ds.wire import CalibrationFields

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
}

_OPENCV_HEADER = re.compile(rb"(?:\xef\xbb\xbf)?%YAML:1\.\d[ \t]*\r?\n(?:---[ \t]*\r?\n)?")
_OPENCV_TAG = re.compile(rb"(?m)(?<=:)[ \t]*!!opencv-matrix(?=[ \t]*\r?$)")


def _without_opencv(data: bytes) -> bytes:
    """YAML without what only OpenCV's FileStorage writes: its directive, and a tag of matrices."""
    if not (header := _OPENCV_HEADER.match(data)):
        return data
    lines = b"#\n" * header[0].count(b"\n")  # errors name the line
    return lines + _OPENCV_TAG.sub(b"", data[header.end() :])


def read_yaml(path: Path) -> dict[str, Any]:
    """The values of a small YAML file, which OpenCV may have written.

    Raises:
        SourceError: It is none, or uses more of YAML than maps, lists and plain values.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise SourceError(path, f"is larger than {_MAX_BYTES} bytes, and no calibration")
        return yamlio.load(_without_opencv(path.read_bytes()), str(path))
    except FormatError as error:
        raise SourceError(path, error.problem) from None
    except OSError as error:
        raise SourceError(path, f"cannot be read: {error.strerror}") from None


def ros_calibration(path: Path) -> CalibrationFields:
    """The calibration that ROS's camera_calibration saves.

    Raises:
        SourceError: It is none; says what is missing or wrong.
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
            f"is no calibration: {error}",
            "Give a YAML file as ROS's camera_calibration saves it.",
        ) from None


def euroc_calibration(path: Path, values: dict[str, Any]) -> CalibrationFields:
    """The calibration of a camera in EuRoC's sensor.yaml.

    Args:
        path: The file, for errors.
        values: Of `read_yaml`.

    Raises:
        SourceError: It is none; says what is missing or wrong.
    """
    try:
        model = str(_known(values, "camera_model"))
        if model != "pinhole":
            raise ValueError(f"camera_model is {model!r}, not pinhole")
        width, height = _numbers(_known(values, "resolution"), "resolution", 2)
        fx, fy, cx, cy = _numbers(_known(values, "intrinsics"), "intrinsics", 4)
        k = (fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0)
        coefficients = _known(values, "distortion_coefficients")
        return CalibrationFields(
            width=_whole(width, "resolution"),
            height=_whole(height, "resolution"),
            **_distortion(
                str(_known(values, "distortion_model")),
                _numbers(coefficients, "distortion_coefficients", None),
            ),
            k=k,
            r=IDENTITY,
            p=projection(k),
        )
    except ValueError as error:
        raise SourceError(path, f"is no calibration: {error}") from None


def euroc_pose(path: Path, values: dict[str, Any]) -> Matrix | None:
    """``T_BS`` of EuRoC's sensor.yaml: the pose of the sensor in the body, shape (4, 4).

    Raises:
        SourceError: It is none.
    """
    if "T_BS" not in values:
        return None
    try:
        return np.array(_matrix(values, "T_BS", 16)).reshape(4, 4)
    except ValueError as error:
        raise SourceError(path, f"tells no pose: {error}") from None


def projection(k: Sequence[float]) -> tuple[float, ...]:
    """The projection matrix, 3 x 4 by rows, of a camera that is not rectified."""
    return (*k[0:3], 0.0, *k[3:6], 0.0, *k[6:9], 0.0)


def _distortion(name: str, values: tuple[float, ...]) -> dict[str, Any]:
    if name not in _MODELS:
        known = ", ".join(_MODELS)
        raise ValueError(f"distortion_model {name!r} is not known; there are {known}")
    model, counts = _MODELS[name]
    if len(values) not in counts:
        listed = " or ".join(map(str, counts))
        raise ValueError(
            f"{name} has {listed} distortion_coefficients, and there are {len(values)}"
        )
    if model == "plumb_bob":  # ROS's has the third radial one, too
        values = (*values, 0.0)[:5]
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
        raise ValueError(f"{key} is no list of {listed}")
    return tuple(_number(value, key) for value in values)


def _number(value: Any, key: str) -> float:
    try:
        # YAML 1.1 has spellings of floats, such as 1., that are texts in the subset
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"{key} holds {value!r}")
    return number
