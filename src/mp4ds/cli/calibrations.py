"""Calibrations as Python code: what is printed can be pasted into a program that uses OpenCV."""

from __future__ import annotations

from collections.abc import Sequence

from mp4ds.cli.output import say
from mp4ds.intrinsics import Camera, Intrinsics, ListedCalibration

_MODELS = {
    "plumb_bob": "D in the order of OpenCV",
    "rational_polynomial": "D in the order of OpenCV",
    "equidistant": "for cv2.fisheye",
}


def print_intrinsics(result: Intrinsics) -> None:
    """Print the calibrations of all cameras, one after the other, and the static transforms."""
    say(f"# {result.path}: {result.kind}, {len(result.cameras)} cameras")
    say("import numpy as np")
    for camera in result.cameras:
        _print_camera(camera)
    if result.transforms:
        _print_transforms(result)


def _print_camera(camera: Camera) -> None:
    say("")
    sizes = ", ".join(f"{width}x{height}" for width, height in camera.sizes) or "size not known"
    if camera.topic:
        say(f"# {camera.topic}: {sizes}, frame {camera.frame_id!r}")
    else:
        say(f"# {camera.info_topic}: calibrations that belong to no images")
    if not camera.calibrations:
        say("# no calibration")
    for calibration in camera.calibrations:
        _print_calibration(camera, calibration)
    if camera.more:
        say(f"# ... and {camera.more} more changes of the calibration")


def _print_calibration(camera: Camera, calibration: ListedCalibration) -> None:
    since = (
        f"from message {calibration.message} at {calibration.log_time} ns"
        if calibration.message is not None
        else "not from a message"
    )
    model = calibration.distortion_model
    hint = f" ({_MODELS[model]})" if model in _MODELS else ""
    say(
        f"# {camera.info_topic}, {since}: {calibration.width}x{calibration.height}, "
        f"{model or 'no distortion model'}{hint}, frame {calibration.frame_id!r}"
    )
    if calibration.k[0][0] == 0:
        say("# not calibrated: K is zero")
    _print_matrix("K", calibration.k)
    say(f"D = np.array({calibration.d})")
    _print_matrix("R", calibration.r)
    _print_matrix("P", calibration.p)
    if calibration.binning:
        say("binning = ({}, {})".format(*calibration.binning))
    if calibration.roi:
        say(f"roi = {calibration.roi}")
    if calibration.k_effective or calibration.p_effective:
        say("# of the images as they are, cut to the ROI and binned (REP 104):")
        _print_matrix("K_effective", calibration.k_effective or calibration.k)
        _print_matrix("P_effective", calibration.p_effective or calibration.p)


def _print_matrix(name: str, rows: Sequence[Sequence[float]]) -> None:
    start = f"{name} = np.array(["
    lines = (",\n" + " " * len(start)).join(str(list(row)) for row in rows)
    for line in f"{start}{lines}])".split("\n"):
        say(line)


def _print_transforms(result: Intrinsics) -> None:
    say("")
    say("# static transforms: a point p of the child is rotation * p + translation in the parent;")
    say("# (parent, child, translation x y z in metres, rotation x y z w)")
    say("transforms = [")
    for item in result.transforms:
        values = f"{list(item.translation)}, {list(item.rotation)}"
        say(f"    ({item.parent!r}, {item.child!r}, {values}),")
    say("]")
