"""``mp4ds info``; calibrations as Python code."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Optional

import typer

from mp4ds.cli.options import JsonFlag
from mp4ds.cli.output import print_info, print_json, print_overview, print_speeds, say
from mp4ds.cli.process import report_errors
from mp4ds.cli.progress import progress_of
from mp4ds.dataset.collections import datasets_in
from mp4ds.errors import OptionError, SourceError, counted, path_text
from mp4ds.files.outputs import digest_file
from mp4ds.files.urls import location
from mp4ds.format.sidecars import MANIFEST_NAME, load_manifest
from mp4ds.options import SliceOptions
from mp4ds.plugins import info as facts
from mp4ds.plugins.card import card as card_of
from mp4ds.plugins.intrinsics import CameraCalibrations, Intrinsics, ListedCalibration
from mp4ds.plugins.intrinsics import intrinsics as intrinsics_of


def info(
    paths: Annotated[
        list[str],
        typer.Argument(
            metavar="PATH...",
            help="A .bag, rosbag2 folder, .mcap, dataset or sidecar; or datasets, or a folder of "
            "them.",
        ),
    ],
    intrinsics: Annotated[
        bool,
        typer.Option("--intrinsics", help="Print the cameras' calibrations as Python code."),
    ] = False,
    speed: Annotated[
        bool,
        typer.Option("--speed", help="Read some frames of a dataset and show how long one takes."),
    ] = False,
    checksums: Annotated[
        bool,
        typer.Option(
            "--checksums", help="Print the SHA-256 of a dataset's files in the format of sha256sum."
        ),
    ] = False,
    card: Annotated[
        bool,
        typer.Option("--card", help="Print a dataset card for Hugging Face: README.md."),
    ] = False,
    start: Annotated[
        Optional[str],  # noqa: UP045 - read at run time by typer
        typer.Option("--start", metavar="TIME", help="Begin at this time, written as for `pack`."),
    ] = None,
    end: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option("--end", metavar="TIME", help="Stop before this time."),
    ] = None,
    duration: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            "--duration",
            metavar="SECONDS",
            help="Length of the slice: seconds from --start, or before --end.",
        ),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Show what is in a recording or a dataset."""
    if intrinsics and speed:
        with report_errors(as_json):
            raise OptionError("Give --intrinsics or --speed, not both.")
    with report_errors(as_json):
        found = _found(paths)
        asked = SliceOptions(start=start, end=end, duration=duration).slice
        if len(found) > 1 and (intrinsics or speed or asked or checksums):
            raise OptionError("These options work with one recording or dataset only.")
    if intrinsics:
        _print_intrinsics(paths[0], as_json)
    elif speed:
        _print_speeds(paths[0], as_json)
    elif checksums:
        _print_checksums(found[0], as_json)
    elif card:
        _print_card(found, as_json)
    elif len(found) > 1:
        _print_overview(found, as_json)
    else:
        with report_errors(as_json):
            result = facts.info(found[0], asked)
        if as_json:
            print_json(result)
        else:
            print_info(result)


def _found(paths: Sequence[str]) -> list[Path]:
    """What to show: one recording, or datasets."""
    try:
        return datasets_in(paths)
    except SourceError:
        if len(paths) > 1:
            raise
        return [location(paths[0])]  # a recording's folder, or nothing


def _print_checksums(path: Path, as_json: bool) -> None:
    """Print the hashes of a dataset's files from its manifest, and that of the manifest itself."""
    with report_errors(as_json):
        if not (path / MANIFEST_NAME).is_file():
            raise OptionError(f"{path} is not a dataset; only datasets have checksums.")
        told = {item.name: item.sha256 for item in load_manifest(path / MANIFEST_NAME).files}
        told[MANIFEST_NAME] = digest_file(path / MANIFEST_NAME)[1]
    if as_json:
        print_json(told)
        return
    for name, sha256 in told.items():
        say(f"{sha256}  {name}")


def _print_card(found: Sequence[Path], as_json: bool) -> None:
    with report_errors(as_json):
        text = card_of(found)
    if as_json:
        print_json({"card": text})
        return
    for line in text.splitlines():
        say(line)


def _print_overview(found: Sequence[Path], as_json: bool) -> None:
    with report_errors(as_json), progress_of("reading", as_json) as tell:
        rows = []
        for number, path in enumerate(found):
            if tell:
                tell(path.name, number / len(found))
            rows.append(facts.brief(path))
    if as_json:
        print_json(rows)
    else:
        print_overview(rows)


def _print_intrinsics(path: str, as_json: bool) -> None:
    with report_errors(as_json), progress_of("reading", as_json):
        result = intrinsics_of(path)
    if as_json:
        print_json(result)
    else:
        print_intrinsics(result)


def _print_speeds(path: str, as_json: bool) -> None:
    with report_errors(as_json), progress_of("reading", as_json):
        speeds = facts.reading_speeds(path)
    if as_json:
        print_json(speeds)
    else:
        print_speeds(speeds)


# ---------------------------------------------------------------- calibrations

_MODELS = {
    "plumb_bob": "D in the order of OpenCV",
    "rational_polynomial": "D in the order of OpenCV",
    "equidistant": "for cv2.fisheye",
}


def print_intrinsics(result: Intrinsics) -> None:
    """Print the calibrations of all cameras, one after another, and the static transforms."""
    say(f"# {path_text(result.path)}: {result.kind}, {counted(len(result.cameras), 'camera')}")
    say("import numpy as np")
    for camera in result.cameras:
        _print_camera(camera)
    if result.transforms:
        _print_transforms(result)


def _print_camera(camera: CameraCalibrations) -> None:
    say("")
    sizes = ", ".join(f"{width}x{height}" for width, height in camera.sizes) or "size not known"
    if camera.topic:
        say(f"# {camera.topic}: {sizes}, frame {camera.frame_id!r}")
    else:
        say(f"# {camera.info_topic}: calibrations without an image topic")
    if not camera.calibrations:
        say("# no calibration")
    for calibration in camera.calibrations:
        _print_calibration(camera, calibration)
    if camera.more:
        say(f"# ... and {camera.more} more calibration changes")


def _print_calibration(camera: CameraCalibrations, calibration: ListedCalibration) -> None:
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
        say("# for the recorded images, cropped to the ROI and binned (REP 104):")
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
