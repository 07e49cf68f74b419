"""``mp4ds info --intrinsics``: every calibration, ready for OpenCV, and the static transforms."""

from __future__ import annotations

import ast
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mp4ds
from commands import call
from export_scenes import transforms
from foxglove_scenes import FOXGLOVE_SOURCES, foxglove_scene
from mp4ds.dataset.views import effective
from mp4ds.messages.transforms import Transform
from mp4ds.messages.wire import CalibrationFields
from mp4ds.plugins.info import CameraCalibrations, Intrinsics, intrinsics
from scenes import INFO, START, TF, Record, Scene, calibration, scene
from sources import SOURCES, write_bag, write_mcap

FOCUS = [100.0, 100.0, 100.0, 125.0, 125.0, 100.0, 150.0, 150.0]  # of one message after the other
CHANGES = [0, 3, 5, 6]
SOME_SOURCES = ("bag-lz4", "bag-split", "rosbag2-sqlite3-v9", "rosbag2-mcap-split",
                "mcap-ros2-zstd", "mcap-unindexed")  # fmt: skip
LINKS = [
    ("base", "rig", (0.5, 0.0, 1.5), (0.0, 0.0, 0.6, 0.8)),
    ("rig", "cam", (0.0, 0.25, 0.0), (0.5, -0.5, 0.5, -0.5)),
    ("base", "lidar", (0.0, 0.0, 2.0), (0.0, 0.0, 0.0, 1.0)),
]


def focused(made: Scene, focus: Sequence[float] = FOCUS) -> Scene:
    """A scene whose calibrations change."""
    messages, number = [], 0
    for record in made.messages:
        if "d" in record.values and "k" in record.values:
            k = [focus[number], 0, 31.5, 0, focus[number], 23.5, 0, 0, 1]
            record = replace(record, values={**record.values, "k": k})
            number += 1
        messages.append(record)
    return Scene(messages, made.silent)


def infos(made: Scene) -> list[Record]:
    return [record for record in made.messages if "k" in record.values]


def recorded(folder: Path, made: Scene, *, packed: bool) -> Path:
    """A bag of a scene, or the dataset of it."""
    path = folder / "drive.bag"
    write_bag(path, made)
    return mp4ds.pack(path, folder / "dataset").dataset if packed else path


def camera_of(result: Intrinsics) -> CameraCalibrations:
    (camera,) = result.cameras
    return camera


# ---------------------------------------------------------------- recordings and datasets


def check_focused(camera: CameraCalibrations, made: Scene) -> None:
    assert camera.frame_id == "cam"
    assert camera.sizes == [(64, 48)]
    assert camera.more == 0
    assert [item.message for item in camera.calibrations] == CHANGES
    sent = infos(made)
    for item in camera.calibrations:
        assert item.message is not None
        record = sent[item.message]
        assert item.log_time == record.log_time
        assert (item.width, item.height, item.frame_id) == (64, 48, "cam")
        assert item.distortion_model == "plumb_bob"
        assert item.k == np.reshape(record.values["k"], (3, 3)).tolist()
        assert item.d == record.values["d"]
        assert item.r == np.eye(3).tolist()
        assert item.p == np.reshape(record.values["p"], (3, 4)).tolist()
        assert (item.binning, item.roi, item.k_effective, item.p_effective) == (None,) * 4


@pytest.mark.parametrize("source", [*SOME_SOURCES, *FOXGLOVE_SOURCES])
def test_recordings_of_every_kind(source: str, tmp_path: Path) -> None:
    topics = "/cam/image_raw", "/cam/camera_info"
    made, write = focused(scene("mono8")), {**SOURCES, **FOXGLOVE_SOURCES}[source]
    if source in FOXGLOVE_SOURCES:
        topics = "/camera/image", "/camera/calibration"
        made = focused(foxglove_scene(partial(scene, "mono8"), frames=8, width=64, height=48))
    camera = camera_of(intrinsics(write(tmp_path, made)[0]))
    if source == "bag-split":  # one part has the calibrations of its own messages
        assert camera.calibrations[0].message == 0
        return
    assert (camera.topic, camera.info_topic) == topics
    check_focused(camera, made)


@pytest.mark.parametrize("source", ["bag-none", "mcap-ros2-zstd"])
def test_a_dataset_says_what_its_recording_says(source: str, tmp_path: Path) -> None:
    made = focused(scene("mono8"))
    paths = SOURCES[source](tmp_path, made)
    mp4ds.pack(paths, tmp_path / "dataset")
    packed, recorded = intrinsics(tmp_path / "dataset"), intrinsics(paths[0])
    assert packed.kind == "dataset"
    assert packed.cameras == recorded.cameras
    alone = intrinsics(tmp_path / "dataset" / "cam_image_raw.mp4")
    assert (alone.kind, alone.cameras) == ("stream", packed.cameras)
    check_focused(camera_of(packed), made)


def named(made: Scene, names: dict[str, str]) -> Scene:
    messages = [replace(record, topic=names.get(record.topic, record.topic))
                for record in made.messages]  # fmt: skip
    return Scene(messages, made.silent)


def test_names_that_tell_nothing_are_paired_on_request(tmp_path: Path) -> None:
    made = named(focused(scene("mono8")), {"/cam/image_raw": "/eye", "/cam/camera_info": "/lens"})
    path = SOURCES["bag-none"](tmp_path, made)[0]
    told = {topic.topic: topic.notes for topic in mp4ds.pack(path, tmp_path / "alone").topics}
    assert "no images are known to be its own" in told["/lens"][0]
    mp4ds.pack(path, tmp_path / "dataset", mp4ds.PackOptions(camera_info=["/eye=/lens"]))
    camera = camera_of(intrinsics(tmp_path / "dataset"))
    assert (camera.topic, camera.info_topic) == ("/eye", "/lens")
    check_focused(camera, made)


# ---------------------------------------------------------------- transforms

PATH = [Transform(*link) for link in LINKS[:2]]


@pytest.mark.parametrize("source", ["bag-none", "mcap-ros2-zstd"])
def test_static_transforms_of_a_recording(source: str, tmp_path: Path) -> None:
    made = scene("mono8")
    path = SOURCES[source](tmp_path, Scene([transforms(LINKS), *made.messages]))[0]
    assert intrinsics(path).transforms == PATH
    moving = tmp_path / "moving"
    moving.mkdir()
    path = SOURCES[source](moving, Scene([transforms(LINKS, "/tf"), *made.messages]))[0]
    assert intrinsics(path).transforms == []


# ---------------------------------------------------------------- effective K

Pixels = st.integers(0, 2000)
Positive = st.floats(0.5, 4000)
WHOLE = (700, 2, 320.5, 0, 710, 240.25, 0, 0, 1)


def fields(
    binning: tuple[int, int], roi: tuple[int, int, int, int], k: Sequence[float] = WHOLE
) -> CalibrationFields:
    p = (*k[:3], -70.5, *k[3:6], 3.0, *k[6:9], 0.0)
    return CalibrationFields(
        480, 640, "plumb_bob", (), tuple(map(float, k)), (1.0,) * 9, tuple(map(float, p)),
        *binning, roi,
    )  # fmt: skip


@settings(deadline=None)
@given(st.tuples(st.integers(0, 4), st.integers(0, 4)), st.tuples(Pixels, Pixels),
       st.tuples(Positive, Positive, Positive, Positive),
       st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.floats(0.1, 9)))  # fmt: skip
def test_effective_matrices_project_into_the_recorded_image(
    binning: tuple[int, int], offset: tuple[int, int], focal: Any, point: Any
) -> None:
    """A pixel (u, v) of the full resolution is ((u - x) / bx, (v - y) / by) of the image."""
    k = (focal[0], 0, focal[2], 0, focal[1], focal[3], 0, 0, 1)
    own = fields(binning, (*offset, 100, 100), k)
    for whole, cut, where in zip(
        (own.k, own.p), effective(own), (np.array(point), np.array([*point, 1.0])), strict=True
    ):
        full = np.reshape(whole, (3, -1)) @ where
        seen = np.array(cut) @ where
        scale = np.maximum(1, binning)
        expected = (full[:2] / full[2] - np.array(offset)) / scale
        np.testing.assert_allclose(seen[:2] / seen[2], expected, rtol=1e-9, atol=1e-6)


# ---------------------------------------------------------------- the command


def command(path: Path, *options: str) -> tuple[str, dict[str, Any]]:
    """What the command prints, and the names that this sets when it is run as Python."""
    result = call("info", path, "--intrinsics", *options)
    assert result.code == 0, result.err
    names: dict[str, Any] = {}
    if "--json" not in options:
        exec(compile(result.out, "printed", "exec"), names)
    return result.out, names


@pytest.mark.parametrize("packed", [False, True])
def test_what_is_printed_is_python_for_opencv(packed: bool, tmp_path: Path) -> None:
    made = focused(scene("mono8"))
    path = recorded(tmp_path, Scene([transforms(LINKS), *made.messages]), packed=packed)
    text, names = command(path)
    (*_, last) = camera_of(intrinsics(path)).calibrations
    for name, value in (("K", last.k), ("D", last.d), ("R", last.r), ("P", last.p)):
        np.testing.assert_array_equal(names[name], value)
    for number in CHANGES:
        record = infos(made)[number]
        assert f"/cam/camera_info, from message {number} at {record.log_time} ns: 64x48" in text
    picture = np.zeros((48, 64), np.uint8)
    assert cv2.undistort(picture, names["K"], names["D"]).shape == (48, 64)
    maps = cv2.initUndistortRectifyMap(
        names["K"], names["D"], names["R"], names["P"], (64, 48), cv2.CV_32FC1
    )
    assert maps[0].shape == (48, 64)


def test_nothing_that_a_recording_says_becomes_code(tmp_path: Path) -> None:
    """Names are in comments, or quoted; a line break in one ends neither."""
    evil = "/a\nimport os #'\"\\\u2028os = 1\r\x85x"
    lens = {**calibration(64, 48), "distortion_model": evil, "width": 64, "height": 48,
            "header": {"frame_id": evil}}  # fmt: skip
    link = {"header": {"frame_id": evil}, "child_frame_id": "b" + evil,
            "transform": {"rotation": {"w": 1.0}}}  # fmt: skip
    other = {**link, "header": {"frame_id": "b" + evil}, "child_frame_id": evil[1:]}
    records = [
        Record(evil + "/camera_info", INFO, START, lens),
        Record(evil + "/tf_static", TF, START, {"transforms": [link, other]}),
    ]
    cdr = Scene([replace(item, cdr=item.payload("cdr")) for item in records])
    write_mcap(tmp_path / "drive.mcap", cdr)
    text, names = command(tmp_path / "drive.mcap")
    for node in ast.parse(text).body:
        if isinstance(node, ast.Import):
            assert ast.unparse(node) == "import numpy as np"
        else:
            assert isinstance(node, ast.Assign)
            assert ast.unparse(node.targets[0]) in {"K", "D", "R", "P", "transforms"}
    assert "os" not in names
    found = intrinsics(tmp_path / "drive.mcap").transforms
    assert names.get("transforms", []) == [
        (item.parent, item.child, list(item.translation), list(item.rotation)) for item in found
    ]
