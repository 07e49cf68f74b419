"""Calibrations in YAML: as ROS's camera_calibration saves them, and EuRoC's sensor.yaml."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, BeforeValidator, Field, FiniteFloat, ValidationError

from mp4ds import yamlio
from mp4ds.errors import FormatError, SourceError
from mp4ds.format.sidecars import model_problems
from mp4ds.messages.transforms import Transform, quaternion_of
from mp4ds.messages.wire import CalibrationFields

_IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
_MAX_BYTES = 2**20

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
        OSError: It cannot be read.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise SourceError(
                path, f"is larger than {_MAX_BYTES} bytes, so it cannot be a calibration"
            )
        return yamlio.load(_without_opencv(path.read_bytes()), str(path))
    except FormatError as error:
        raise SourceError(path, error.problem) from None


# ---------------------------------------------------------------- what the files have to hold


def _listed(value: Any) -> Any:
    """The numbers of a list, or of a matrix as OpenCV and ROS write it."""
    found = value.get("data") if isinstance(value, dict) else value
    if not isinstance(found, list) or any(isinstance(item, bool) for item in found):
        raise ValueError("it is not a list of numbers")
    return found


# YAML 1.1 has floats such as 1., which are strings in the subset: pydantic reads these, too
_Numbers = Annotated[tuple[FiniteFloat, ...], BeforeValidator(_listed)]
_Four = Annotated[_Numbers, Field(min_length=4, max_length=4)]
_Nine = Annotated[_Numbers, Field(min_length=9, max_length=9)]
_Twelve = Annotated[_Numbers, Field(min_length=12, max_length=12)]
_Sixteen = Annotated[_Numbers, Field(min_length=16, max_length=16)]


def _whole(value: Any) -> Any:
    """A number that may be written as a float, which may be a string as above."""
    if isinstance(value, bool):
        raise ValueError("it is not a number")
    return float(value) if isinstance(value, str) else value


_Side = Annotated[int, BeforeValidator(_whole), Field(gt=0, lt=2**31)]


class _Saved(BaseModel):
    image_width: _Side
    image_height: _Side
    camera_matrix: _Nine
    distortion_model: str
    distortion_coefficients: _Numbers
    rectification_matrix: _Nine = _IDENTITY
    projection_matrix: _Twelve = ()


class _Pinhole(BaseModel):
    camera_model: Literal["pinhole"]
    resolution: tuple[_Side, _Side]
    intrinsics: _Four
    distortion_model: str
    distortion_coefficients: _Numbers


class _Posed(BaseModel):
    T_BS: _Sixteen


@contextmanager
def _checking(path: Path, what: str, remedy: str = "") -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        reason = str(error)
        if isinstance(error, ValidationError):
            reason = ": ".join(model_problems(error)[0])
        raise SourceError(path, f"is not a valid {what}: {reason}", remedy) from None


# ---------------------------------------------------------------- what is made of them


def ros_calibration(path: Path) -> CalibrationFields:
    """The calibration that ROS's camera_calibration saves.

    Raises:
        SourceError: It is not valid; says what is missing or wrong.
        OSError: It cannot be read.
    """
    values = read_yaml(path)
    with _checking(path, "calibration", "Give a YAML file saved by ROS's camera_calibration."):
        saved = _Saved.model_validate(values)
        model, d = _distortion(saved.distortion_model, saved.distortion_coefficients)
        k = saved.camera_matrix
        return CalibrationFields(
            width=saved.image_width,
            height=saved.image_height,
            distortion_model=model,
            d=d,
            k=k,
            r=saved.rectification_matrix,
            p=saved.projection_matrix or _projection(k),
        )


def euroc_calibration(path: Path, values: dict[str, Any]) -> CalibrationFields | None:
    """The calibration of a camera in EuRoC's sensor.yaml; None if it has none.

    Args:
        path: The file, for errors.
        values: Of `read_yaml`.

    Raises:
        SourceError: It is not valid; says what is missing or wrong.
    """
    if "intrinsics" not in values:
        return None
    with _checking(path, "calibration"):
        found = _Pinhole.model_validate(values)
        model, d = found.distortion_model, found.distortion_coefficients
        if model in _MODELS:  # others may be known to those who read the messages
            model, d = _distortion(model, d)
        fx, fy, cx, cy = found.intrinsics
        k = (fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0)
        width, height = found.resolution
        return CalibrationFields(height, width, model, d, k, _IDENTITY, _projection(k))


def euroc_pose(path: Path, values: dict[str, Any], body: str, sensor: str) -> list[Transform]:
    """The pose of a sensor in the body, by ``T_BS`` of EuRoC's sensor.yaml; none if it is absent.

    Raises:
        SourceError: It is not valid.
    """
    if "T_BS" not in values:
        return []
    with _checking(path, "pose"):
        pose = np.array(_Posed.model_validate(values).T_BS).reshape(4, 4)
        x, y, z = (pose[:3, 3] + 0.0).tolist()  # without negative zeros
        return [Transform(body, sensor, (x, y, z), quaternion_of(pose[:3, :3]))]


def _projection(k: Sequence[float]) -> tuple[float, ...]:
    """The projection matrix, 3 x 4 by rows, of an unrectified camera."""
    return (*k[0:3], 0.0, *k[3:6], 0.0, *k[6:9], 0.0)


def _distortion(name: str, values: tuple[float, ...]) -> tuple[str, tuple[float, ...]]:
    """A distortion in the terms of ROS."""
    if name not in _MODELS:
        known = ", ".join(_MODELS)
        raise ValueError(f"distortion_model {name!r} is not known; known are {known}")
    model, counts = _MODELS[name]
    if len(values) not in counts:
        listed = " or ".join(map(str, counts))
        raise ValueError(f"{name} has {listed} distortion_coefficients, not {len(values)}")
    if model == "plumb_bob":  # ROS's also has the third radial coefficient
        values = (*values, *(0.0,) * 5)[:5]
    return model, values
