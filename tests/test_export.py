"""Exports, read again with libraries that are not the project's."""

from __future__ import annotations

import csv
import json
import os
import re
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import yaml
from PIL import Image

import mp4ds
from commands import call, program
from export_scenes import (
    COLOUR,
    DEPTH,
    FRAMES,
    GREY,
    HEIGHT,
    IMU,
    JOINTS,
    ODOMETRY,
    WIDTH,
    drive,
    joints_at,
    pack_drive,
    pixels_of,
    pose_at,
    stamps_of,
)
from mp4ds.plugins.exporting.folders import interpolated
from scenes import PERIOD, Record, Scene, scene

MADE = drive()
FX, CX, CY = 0.9 * WIDTH, WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5
D = [-0.3, 0.1, 1e-3, -2e-4]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The drive, lossless; not to be changed."""
    return pack_drive(tmp_path_factory.mktemp("export"), MADE)


def export(
    dataset: Path | list[Path], to: str, output: Path, **options: Any
) -> mp4ds.ExportSummary:
    summary = mp4ds.export(dataset, to, output, mp4ds.ExportOptions(**options))  # type: ignore[arg-type]
    check_account(summary, dataset)
    return summary


def check_account(summary: mp4ds.ExportSummary, datasets: Path | list[Path]) -> None:
    """Every message of the recording is held, or left out for a reason."""
    count = len(datasets) if isinstance(datasets, list) else 1
    sent = Counter(message.topic for message in MADE.messages)
    found = Counter(summary.messages)
    for topic, reasons in summary.left_out.items():
        assert all(number > 0 for number in reasons.values())
        found[topic] += sum(reasons.values())
    assert +found == Counter({topic: count * number for topic, number in sent.items()})


def read_png(path: Path) -> np.ndarray[Any, Any]:
    with Image.open(path) as image:
        image.load()
        return np.asarray(image)


def rows_of(path: Path) -> list[list[str]]:
    with path.open() as file:
        return [*csv.reader(file)]


# ---------------------------------------------------------------- EuRoC


def test_euroc(dataset: Path, tmp_path: Path) -> None:
    summary = export(dataset, "euroc", tmp_path / "out", poses=ODOMETRY)
    assert summary.places == {
        "mav0/cam0": COLOUR,
        "mav0/cam1": GREY,
        "mav0/cam2": DEPTH,
        "mav0/imu0": IMU,
        "mav0/pose0": ODOMETRY,
    }
    for number, topic in enumerate((COLOUR, GREY, DEPTH)):
        folder = tmp_path / "out/mav0" / f"cam{number}"
        head, *rows = rows_of(folder / "data.csv")
        assert head == ["#timestamp [ns]", "filename"]
        assert [int(row[0]) for row in rows] == stamps_of(MADE, topic)
        for index, (time, name) in enumerate(rows):
            assert name == f"{time}.png"
            assert (read_png(folder / "data" / name) == pixels_of(topic, index)).all()
        assert len(list((folder / "data").iterdir())) == FRAMES
    sensor = yaml.safe_load((tmp_path / "out/mav0/cam1/sensor.yaml").read_text())
    assert sensor["resolution"] == [WIDTH, HEIGHT]
    assert sensor["intrinsics"] == pytest.approx([FX, FX, CX, CY])
    assert sensor["distortion_model"] == "radial-tangential"
    assert sensor["distortion_coefficients"] == D
    assert sensor["rate_hz"] == pytest.approx(1e9 / PERIOD, rel=0.02)
    # the body is the IMU, which is above the base; the camera beside it is a quarter turned
    pose = np.array(sensor["T_BS"]["data"]).reshape(4, 4)
    turned = [[0, -1, 0, 0], [1, 0, 0, 0.25], [0, 0, 1, 0], [0, 0, 0, 1]]
    assert pose == pytest.approx(np.array(turned), abs=1e-12)
    assert "T_BS" not in yaml.safe_load((tmp_path / "out/mav0/cam2/sensor.yaml").read_text())
    assert any(DEPTH in note and "T_BS" in note for note in summary.notes)


# ---------------------------------------------------------------- TUM


def test_tum(dataset: Path, tmp_path: Path) -> None:
    summary = export(dataset, "tum", tmp_path / "out", poses=ODOMETRY)
    for kind, topic in (("rgb", COLOUR), ("depth", DEPTH)):
        lines = (tmp_path / "out" / f"{kind}.txt").read_text().splitlines()
        rows = [line.split() for line in lines if not line.startswith("#")]
        nanoseconds = [int(time.replace(".", "")) for time, _ in rows]
        assert nanoseconds == stamps_of(MADE, topic)
        for index, (time, name) in enumerate(rows):
            assert name == f"{kind}/{time}.png"
            assert (read_png(tmp_path / "out" / name) == pixels_of(topic, index)).all()
    (reason,) = summary.left_out[GREY]
    assert COLOUR in reason
    truth = np.loadtxt(tmp_path / "out/groundtruth.txt")
    assert truth.shape == (FRAMES + 1, 8)
    assert truth[3, 1:] == pytest.approx([pose_at(3)[1], 0, 0, 0, 0, 0, 1])
    acceleration = np.loadtxt(tmp_path / "out/accelerometer.txt")
    assert (np.diff(acceleration[:, 0]) >= 0).all()
    assert acceleration[:, 3] == pytest.approx([9.81] * 4 * FRAMES)


def test_frames_that_belong_together(dataset: Path, tmp_path: Path) -> None:
    options = {"topics": [COLOUR, GREY], "tolerance_ns": 100_000}
    summary = export(dataset, "euroc", tmp_path / "out", **options)
    first, second = (stamps_of(MADE, topic) for topic in (COLOUR, GREY))
    near = [n for n in range(FRAMES) if abs(first[n] - second[n]) <= 100_000]
    assert 0 < len(near) < FRAMES
    assert summary.messages[COLOUR] == summary.messages[GREY] == len(near)
    data = tmp_path / "out/mav0/cam1/data"
    for number in near:
        assert (read_png(data / f"{second[number]}.png") == pixels_of(GREY, number)).all()


# ---------------------------------------------------------------- COLMAP


def test_colmap(dataset: Path, tmp_path: Path) -> None:
    summary = export(dataset, "colmap", tmp_path / "out", poses=ODOMETRY)
    model = tmp_path / "out/sparse/0"
    lines = (model / "cameras.txt").read_text().splitlines()
    cameras = [line.split() for line in lines if not line.startswith("#")]
    assert [camera[:4] for camera in cameras] == [
        [number, "OPENCV", str(WIDTH), str(HEIGHT)] for number in ("1", "2")
    ]
    # the middle of the first pixel is at one half
    expected = [FX, FX, CX + 0.5, CY + 0.5, *D]
    assert [float(value) for value in cameras[0][4:]] == pytest.approx(expected)
    rows = (model / "images.txt").read_text().splitlines()[2:]
    images = [row.split() for row in rows if row]
    assert rows[1::2] == [""] * len(images)
    assert [row[0] for row in images] == [str(n + 1) for n in range(2 * FRAMES)]
    for row in images:
        assert (tmp_path / "out/images" / row[9]).is_file()
    assert (model / "points3D.txt").is_file()
    assert any(DEPTH in note and "cameras.txt" in note for note in summary.notes)


def test_pycolmap_reads_it(dataset: Path, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    export(dataset, "colmap", tmp_path / "out", poses=ODOMETRY)
    model = pycolmap.Reconstruction(tmp_path / "out/sparse/0")
    assert (len(model.cameras), len(model.images)) == (2, 2 * FRAMES)
    stamps = stamps_of(MADE, GREY)
    images = sorted((one for one in model.images.values() if one.camera_id == 2), key=_name_of)
    for stamp, image in zip(stamps, images, strict=True):
        assert image.name == f"left_image_raw/{stamp}.png"
        along = 0.1 * (stamp - pose_at(0)[0]) / PERIOD
        assert image.projection_center() == pytest.approx([along, 0.25, 1.0], abs=1e-6)
        # a point 2 m before the camera, which is a quarter turned: its y axis points backwards
        before = np.array([along - 0.2, 0.25 + 0.4, 1.0 + 2.0])
        expected = projected(np.array([0.2, 0.1, 1.0]), [*D, 0.0])
        assert image.project_point(before) == pytest.approx(expected, abs=1e-4)
    mp4ds.export(dataset, "colmap", tmp_path / "bare")
    assert len(pycolmap.Reconstruction(tmp_path / "bare/sparse/0").cameras) == 2


def _name_of(image: Any) -> str:
    return str(image.name)


def projected(point: np.ndarray[Any, Any], d: list[float], fisheye: bool = False) -> list[float]:
    """Where OpenCV sees a point, in COLMAP's pixels."""
    import cv2

    k = np.array([[FX, 0, CX], [0, FX, CY], [0, 0, 1.0]])
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    where = project(point.reshape(1, 1, 3), np.zeros(3), np.zeros(3), k, np.array(d))[0]
    return [float(value) + 0.5 for value in where.ravel()]


@pytest.mark.parametrize(
    "model", ["plumb_bob", "Brown Conrady", "rational_polynomial", "equidistant", ""]
)
def test_pycolmap_distorts_as_opencv(model: str, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    made = with_lens(model, rectified=True)
    source = pack_drive(tmp_path, Scene([m for m in made.messages if m.topic.startswith("/front")]))
    mp4ds.export(source, "colmap", tmp_path / "out")
    (camera,) = pycolmap.Reconstruction(tmp_path / "out/sparse/0").cameras.values()
    for x, y in ((0.0, 0.0), (0.2, -0.1), (-0.3, 0.2)):
        point = np.array([x, y, 1.0])
        expected = projected(point, LENSES[model][0], fisheye=model == "equidistant")
        assert camera.img_from_cam(point) == pytest.approx(expected, abs=1e-3)


# ---------------------------------------------------------------- lenses, rows, and images again

RADIAL = "radial-tangential"
LENSES = {
    "plumb_bob": ([*D, 0.5], "plumb_bob", [*D, 0.5]),
    "Brown Conrady": ([*D, 0.0], RADIAL, D),
    "rational_polynomial": ([*D, *range(1, 5)], "rational_polynomial", [*D, *range(1, 5)]),
    "equidistant": (D, "equidistant", D),
    "vendor": ([1.0], "vendor", [1.0]),
    "": ([], RADIAL, [0.0] * 4),
}
"""As recorded -> coefficients, and model and coefficients as EuRoC has them."""
CAMERAS = {  # layout -> folders of images, and their topics; lists of the IMU and the poses
    "euroc": (
        [("mav0/cam0/data", COLOUR), ("mav0/cam1/data", GREY), ("mav0/cam2/data", DEPTH)],
        ("mav0/imu0/data.csv", ",", 6, "mav0/pose0/data.csv", 1, [0, 0, 1, 0, 0, 0]),
    ),
    "tum": (
        [("rgb", COLOUR), ("depth", DEPTH)],
        ("accelerometer.txt", None, 3, "groundtruth.txt", 1, [0, 0, 0, 0, 0, 1]),
    ),
}


def with_lens(model: str, *, rectified: bool) -> Scene:
    """The drive with another lens; an unrectified camera has zeros for R and P."""

    def changed(message: Record) -> Record:
        if not message.topic.endswith("camera_info"):
            return message
        lens = {"distortion_model": model, "d": [*LENSES[model][0]]}
        bare = {} if rectified else {"r": [0.0] * 9, "p": [0.0] * 12}
        return replace(message, values={**message.values, **lens, **bare})

    return Scene([changed(message) for message in MADE.messages])


@pytest.mark.parametrize("model", LENSES)
def test_lenses_of_euroc(model: str, tmp_path: Path) -> None:
    made = with_lens(model, rectified=model != "Brown Conrady")
    source = pack_drive(tmp_path, Scene([m for m in made.messages if m.topic.startswith("/front")]))
    mp4ds.export(source, "euroc", tmp_path / "out")
    sensor = yaml.safe_load((tmp_path / "out/mav0/cam0/sensor.yaml").read_text())
    _, name, d = LENSES[model]
    assert (sensor["distortion_model"], sensor["distortion_coefficients"]) == (name, d)
    assert sensor["intrinsics"] == pytest.approx([FX, FX, CX, CY])


@pytest.mark.parametrize("to", CAMERAS)
def test_images_are_imported_again_and_rows_are_as_sent(
    to: str, dataset: Path, tmp_path: Path
) -> None:
    export(dataset, to, tmp_path / "out", poses=ODOMETRY)
    cameras, (imu, comma, z, poses, x, turn) = CAMERAS[to]
    for number, (folder, topic) in enumerate(cameras):
        images = mp4ds.PackOptions(images=mp4ds.ImportOptions())
        mp4ds.pack(tmp_path / "out" / folder, tmp_path / f"{number}", images)
        with mp4ds.open(tmp_path / f"{number}") as again:
            frames = list(again["/camera/image_raw"])
            assert [frame.stamp_ns for frame in frames] == stamps_of(MADE, topic)
            for place, frame in enumerate(frames):
                assert (frame.data == pixels_of(topic, place)).all()
    sent = [message.values for message in MADE.messages if message.topic == IMU]
    rows = np.loadtxt(tmp_path / "out" / imu, delimiter=comma)
    assert sorted(rows[:, z]) == sorted(one["linear_acceleration"]["z"] for one in sent)
    lines = (tmp_path / "out" / poses).read_text().splitlines()
    words = [re.split("[, ]", line) for line in lines if not line.startswith("#")]
    assert [(int(row[0].replace(".", "")), float(row[x])) for row in words] == [
        pose_at(number) for number in range(FRAMES + 1)
    ]
    assert {tuple(map(float, row[2:])) for row in words} == {tuple(map(float, turn))}


def test_cameras_without_a_common_frame(dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(mp4ds.OptionError, match="not every camera has a frame at this time"):
        export(dataset, "euroc", tmp_path / "out", topics=[COLOUR, GREY], tolerance_ns=0)
    assert list(tmp_path.iterdir()) == []


# ---------------------------------------------------------------- poses


def test_poses_between_two() -> None:
    half = 0.5**0.5
    rows = [(200, (2.0, 0, 0, 0, 0, -half, -half)), (100, (1.0, 0, 0, 0, 0, 0, 1.0))]
    count, pose_at = interpolated(iter(rows))
    assert count == 2
    assert pose_at(99) is None
    assert pose_at(201) is None
    middle = pose_at(150)
    assert middle is not None
    assert middle[:3, 3].tolist() == [1.5, 0, 0]
    angle = np.pi / 4  # half of the quarter, the shorter way round
    assert middle[0, :2] == pytest.approx([np.cos(angle), -np.sin(angle)])


# ---------------------------------------------------------------- which frames, and how


def test_smaller_and_fewer(dataset: Path, tmp_path: Path) -> None:
    options = {"topics": ["/front/*"], "every": 3, "resize": 0.5}
    summary = export(dataset, "euroc", tmp_path / "out", **options)
    assert summary.messages[COLOUR] == 3
    assert summary.left_out[COLOUR] == {"left out on request (--every, --max-rate)": FRAMES - 3}
    stamps = stamps_of(MADE, COLOUR)[::3]
    folder = tmp_path / "out/mav0/cam0"
    assert sorted(path.stem for path in (folder / "data").iterdir()) == [*map(str, stamps)]
    image = read_png(folder / "data" / f"{stamps[1]}.png").astype(float)
    whole = pixels_of(COLOUR, 3).reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean(axis=(1, 3))
    assert np.abs(image - whole).max() <= 1.5
    sensor = yaml.safe_load((folder / "sensor.yaml").read_text())
    half = [FX / 2, FX / 2, (CX + 0.5) / 2 - 0.5, (CY + 0.5) / 2 - 0.5]
    assert sensor["intrinsics"] == pytest.approx(half)


def test_mosaics(tmp_path: Path) -> None:
    made = scene("bayer_rggb8", frames=2, noisy=False)
    dataset = pack_drive(tmp_path, made)
    mosaic = next(m.values["data"] for m in made.messages if m.topic == "/cam/image_raw")
    mosaic = np.asarray(mosaic).reshape(48, 64)
    for native in (True, False):
        options = mp4ds.ExportOptions(native=native, topics=["/cam/image_raw"])
        summary = mp4ds.export(dataset, "tum", tmp_path / f"{native}", options)
        image = read_png(min((tmp_path / f"{native}/rgb").iterdir()))
        assert any("Bayer mosaic" in note for note in summary.notes) is not native
        if native:
            assert (image == mosaic).all()
        else:  # where the sensor has a colour, interpolation leaves it
            assert image.shape == (48, 64, 3)
            assert (image[::2, ::2, 0] == mosaic[::2, ::2]).all()
    both = mp4ds.ExportOptions(native=True, resize=0.5)
    with pytest.raises(mp4ds.OptionError, match="which `native` keeps: use it or `resize`"):
        mp4ds.export(dataset, "tum", tmp_path / "both", both)
    other = mp4ds.ExportOptions(topics=["/imu"])
    with pytest.raises(mp4ds.OptionError, match=r"/imu: a folder of images has no place for"):
        mp4ds.export(dataset, "images", tmp_path / "other", other)


def test_what_png_cannot_hold(tmp_path: Path) -> None:
    dataset = pack_drive(tmp_path, scene("32FC1", frames=3, with_info=False))
    summary = mp4ds.export(dataset, "euroc", tmp_path / "out")
    assert summary.left_out["/cam/image_raw"] == {"PNG cannot hold 32FC1 images": 3}
    with pytest.raises(mp4ds.OptionError, match="PNG cannot hold 32FC1"):
        mp4ds.export(
            dataset, "euroc", tmp_path / "none", mp4ds.ExportOptions(topics=["/cam/image_raw"])
        )
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize("topic", ["/../../image,=1", "/mp4ds_export.json"])
def test_names_from_the_recording_do_no_harm(topic: str, tmp_path: Path) -> None:
    made, name = scene("mono8", frames=2), "=1+1,\n../x"
    for place, item in enumerate(made.messages):
        if item.topic == "/cam/image_raw":
            fields = {**item.values, "header": {**item.values["header"], "frame_id": name}}
            made.messages[place] = replace(item, topic=topic, values=fields)
    mp4ds.export(pack_drive(tmp_path, made), "images", tmp_path / "out")
    (folder,) = (path for path in (tmp_path / "out").iterdir() if path.is_dir())
    assert sorted(path.name for path in folder.iterdir()) == ["0.png", "1.png", "stamps.csv"]
    with (folder / "stamps.csv").open(newline="") as file:
        assert [row[3] for row in csv.reader(file)][1:] == [f"'{name}"] * 2


# ---------------------------------------------------------------- LeRobot


@pytest.fixture(scope="module")
def lerobot_folder(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes of the drive."""
    pytest.importorskip("pyarrow")
    folder = tmp_path_factory.mktemp("lerobot") / "out"
    summary = export(
        [dataset, dataset],
        "lerobot",
        folder,
        topics=[COLOUR, JOINTS, IMU],
        state=JOINTS,
        action=JOINTS,
        task="push the cube",
        fps=30,
        codec="h264",
        crf=10,
    )
    assert summary.places["videos/observation.images.front_image_raw"] == COLOUR
    return folder


def lerobot_frames(fps: int = 30) -> list[tuple[int, list[float]]]:
    """For each frame of an episode the camera's frame and the joints that are nearest to it."""
    stamps, joints = stamps_of(MADE, COLOUR), [joints_at(n) for n in range(3 * FRAMES)]
    found = []
    for number in range(round((stamps[-1] - stamps[0]) * fps / 1e9) + 1):
        time = stamps[0] + round(number * 10**9 / fps)
        frame = min(range(FRAMES), key=lambda n: abs(stamps[n] - time))
        found.append((frame, min(joints, key=lambda item: abs(item[0] - time))[1]))
    return found


def test_lerobot_tables(lerobot_folder: Path) -> None:
    import pyarrow.parquet as pq

    info = json.loads((lerobot_folder / "meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["total_episodes"]) == ("v3.0", 30, 2)
    length = len(lerobot_frames())
    assert info["total_frames"] == 2 * length
    feature = info["features"]["observation.images.front_image_raw"]
    assert feature["shape"] == [HEIGHT, WIDTH, 3]
    assert info["features"]["observation.state"]["names"] == ["shoulder", "elbow"]
    for episode in range(2):
        path = info["data_path"].format(chunk_index=0, file_index=episode)
        table = pq.read_table(lerobot_folder / path).to_pydict()
        assert table["frame_index"] == list(range(length))
        assert table["index"] == list(range(episode * length, (episode + 1) * length))
        assert table["episode_index"] == [episode] * length
        assert table["timestamp"] == pytest.approx([n / 30 for n in range(length)])
        for state, (_, joints) in zip(table["observation.state"], lerobot_frames(), strict=True):
            assert state == pytest.approx(joints)
    tasks = pq.read_table(lerobot_folder / "meta/tasks.parquet").to_pydict()
    assert tasks == {"task_index": [0], "task": ["push the cube"]}
    statistics = json.loads((lerobot_folder / "meta/stats.json").read_text())
    pixels = np.stack([pixels_of(COLOUR, n) for n in range(FRAMES)]) / 255
    for name, expected in (("mean", pixels.mean((0, 1, 2))), ("std", pixels.std((0, 1, 2)))):
        found = np.array(statistics["observation.images.front_image_raw"][name])
        assert found.shape == (3, 1, 1)
        assert found.ravel() == pytest.approx(expected, abs=0.02)


@pytest.mark.parametrize("decoder", ["mp4ds", pytest.param("torchcodec", marks=pytest.mark.slow)])
def test_lerobot_videos_have_the_range_that_its_decoder_takes_them_for(
    decoder: str, tmp_path: Path
) -> None:
    """AV1 of the full range is encoded anew: torchcodec would give it another contrast."""
    pytest.importorskip("pyarrow")
    made = scene("rgb8", frames=6, with_info=False, noisy=False)
    dataset = pack_drive(tmp_path, made, quality="visual")
    mp4ds.export(
        dataset, "lerobot", tmp_path / "out", mp4ds.ExportOptions(topics=["/cam/image_raw"], fps=30)
    )
    path = tmp_path / "out/videos/observation.images.cam_image_raw/chunk-000/file-000.mp4"
    with av.open(str(path)) as container:
        context = container.streams.video[0].codec_context
        assert (context.name, context.color_range, context.colorspace) == ("libdav1d", 1, 1)
    with mp4ds.open(path) as video, mp4ds.open(dataset) as own:
        shown, expected = next(iter(video)).read([4]), own["/cam/image_raw"].read([4])
    if decoder == "torchcodec":
        try:
            from torchcodec.decoders import VideoDecoder
        except (ImportError, RuntimeError, OSError):
            pytest.skip("needs torchcodec")
        shown = VideoDecoder(str(path), dimension_order="NHWC")[4:5].numpy()
    light = [image[0].mean(-1).ravel() for image in (expected, shown)]
    assert np.polyfit(*light, 1)[0] == pytest.approx(1, abs=0.04)


LEROBOT = "MP4DS_LEROBOT"
"""Environment variable: the Python of an environment with LeRobot (CONTRIBUTING.md)."""
LOAD = """
import sys
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

root, out = sys.argv[1:]
camera = "observation.images.front_image_raw"
loaded = LeRobotDataset("local/drive", root=root)
items = [loaded[number] for number in range(len(loaded))]
near = LeRobotDataset("local/drive", root=root, delta_timestamps={camera: [-1 / loaded.fps, 0]})
np.savez(
    out,
    episodes=loaded.num_episodes,
    tasks=[item["task"] for item in items],
    pair=near[len(near) - 1][camera].numpy(),
    images=np.stack([item[camera].numpy() for item in items]),
    **{
        name: np.stack([item[name].numpy() for item in items])
        for name in ("timestamp", "episode_index", "observation.state", "action")
    },
)
"""


def test_lerobot_loads_it(lerobot_folder: Path, tmp_path: Path) -> None:
    """LeRobot's own loader, in an environment of its own, for it needs an older PyAV."""
    python = os.environ.get(LEROBOT)
    if not python:
        pytest.skip(f"{LEROBOT} does not name the Python of an environment with LeRobot")
    env = {"HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "hub")}
    program(python, "-c", LOAD, lerobot_folder, tmp_path / "loaded.npz", env=env)
    loaded, frames = np.load(tmp_path / "loaded.npz"), lerobot_frames()
    length = len(frames)
    assert loaded["episodes"] == 2
    assert loaded["tasks"].tolist() == ["push the cube"] * 2 * length
    assert loaded["episode_index"].tolist() == [0] * length + [1] * length
    assert loaded["timestamp"] == pytest.approx([*(n / 30 for n in range(length))] * 2)
    for image, states, actions, (frame, joints) in zip(
        loaded["images"], loaded["observation.state"], loaded["action"], 2 * frames, strict=True
    ):
        expected = pixels_of(COLOUR, frame).astype(float)
        assert np.abs(image.transpose(1, 2, 0) * 255 - expected).mean() < 8  # of others: over 20
        assert states == pytest.approx(joints)
        assert actions == pytest.approx(joints)
    assert (loaded["pair"] == loaded["images"][-2:]).all()


DEPTHS = np.arange(96 * 128).reshape(96, 128)  # millimetres; 0 is no measurement
DEPTH_KEY = "observation.images.cam_depth"
LOAD_DEPTH = """
import sys
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

root, out, key = sys.argv[1:]
np.save(out, LeRobotDataset("local/depth", root=root)[1][key].numpy()[0])
"""


@pytest.mark.parametrize("loader", ["formula", "lerobot"])
@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_lerobot_depth(encoding: str, loader: str, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    (tmp_path / "in").mkdir()
    metres = np.where(DEPTHS == 0, np.nan, DEPTHS / 1000).astype("f4")
    pixels, suffix = (metres, "tiff") if encoding == "32FC1" else (DEPTHS.astype("u2"), "png")
    for number in range(3):
        Image.fromarray(pixels).save(tmp_path / f"in/{number}.{suffix}")
    images = mp4ds.ImportOptions(
        rate="10", topic="/cam/depth", encoding=encoding if suffix == "png" else None
    )
    mp4ds.pack(tmp_path / "in", tmp_path / "ds", mp4ds.PackOptions(images=images))
    summary = mp4ds.export(tmp_path / "ds", "lerobot", tmp_path / "out")
    assert summary.messages == {"/cam/depth": 3}
    (note,) = (note for note in summary.notes if "/cam/depth: its depths" in note)
    assert "0.67 mm off on average, at most 2.0 mm; 0.0 % of the pixels have no" in note
    feature = json.loads((tmp_path / "out/meta/info.json").read_text())["features"][DEPTH_KEY]
    assert feature["shape"] == [96, 128, 1]
    unit = "m" if encoding == "32FC1" else "mm"
    assert (feature["info"]["is_depth_map"], feature["info"]["depth_unit"]) == (True, unit)
    statistics = json.loads((tmp_path / "out/meta/stats.json").read_text())[DEPTH_KEY]
    assert np.array(statistics["max"]) == pytest.approx(DEPTHS.max() / (1000 if unit == "m" else 1))
    assert np.array(statistics["mean"]).shape == (1, 1, 1)
    with av.open(str(tmp_path / f"out/videos/{DEPTH_KEY}/chunk-000/file-000.mp4")) as container:
        frames = list(container.decode(video=0))
        assert [frame.key_frame for frame in frames] == [True, False, True]
        codes = frames[1].to_ndarray(format="gray12le")
    low, high = np.log(0.01 + 3.5), np.log(10 + 3.5)
    found = np.rint(1000 * (np.exp(low + codes / 4095 * (high - low)) - 3.5))
    if loader == "lerobot":
        if not (python := os.environ.get(LEROBOT)):
            pytest.skip(f"{LEROBOT} does not name the Python of an environment with LeRobot")
        env = {"HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "hub")}
        args = (tmp_path / "out", tmp_path / "depth.npy", DEPTH_KEY)
        program(python, "-c", LOAD_DEPTH, *args, env=env)
        found = np.load(tmp_path / "depth.npy")
    assert np.abs(found - DEPTHS.clip(10, 10_000)).max() < 2.01


def test_frames_that_are_dropped_and_doubled(dataset: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    slow: dict[str, Any] = {"topics": [COLOUR], "fps": 10, "action": f"{JOINTS}:position[elbow]"}
    summary = export(dataset, "lerobot", tmp_path / "slow", **slow)
    info = json.loads((tmp_path / "slow/meta/info.json").read_text())
    assert info["features"]["action"]["names"] == ["elbow"]
    given = len(lerobot_frames(10))
    assert summary.messages == {COLOUR: given, JOINTS: given}
    assert sum(summary.left_out[COLOUR].values()) == FRAMES - given
    fast = {**slow, "fps": 60, "codec": "h265", "resize": 2.0}
    summary = export(dataset, "lerobot", tmp_path / "fast", **fast)
    length, used = len(lerobot_frames(60)), summary.messages[COLOUR]
    assert any(f"{length - used} of {length} frames repeat" in note for note in summary.notes)


def test_a_library_that_is_missing(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.delitem(sys.modules, "mp4ds.plugins.exporting.lerobot", raising=False)
    with pytest.raises(mp4ds.OptionError, match=re.escape("pip install 'mp4ds[lerobot]'")):
        mp4ds.export(dataset, "lerobot", tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


# ---------------------------------------------------------------- the command


def test_the_command(dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = call("export", "tum", dataset, "-o", out, "-t", COLOUR, "--json")
    assert done.code == 0, done.err
    told = json.loads(done.out)
    assert told["messages"] == {COLOUR: FRAMES}
    assert told["left_out"][GREY] == {"not selected": FRAMES}
    note = json.loads((out / "mp4ds_export.json").read_text())
    assert note["left_out"] == told["left_out"]
    with pytest.raises(mp4ds.TargetExistsError):
        mp4ds.export(dataset, "tum", out)
    again = call("export", "tum", dataset, "-o", out, "-t", DEPTH, "--force", "--every", "2")
    assert again.code == 0, again.err
    assert f"left out: {FRAMES // 2} messages of {DEPTH}: left out on request" in again.out
    assert not (out / "rgb").exists()


@pytest.mark.parametrize(
    ("to", "options", "words"),
    [
        ("nuscenes", {}, "format 'nuscenes' is not known"),
        ("lerobot", {"poses": ODOMETRY}, "`poses` works with"),
        ("euroc", {"poses": IMU}, "`poses` /imu is of type sensor_msgs/Imu"),
        ("euroc", {"poses": "/none"}, "not a ROS topic"),
        ("euroc", {"topics": ["/nothing*"]}, "matches no topic"),
        ("tum", {"topics": ["/chatter"]}, "TUM cannot hold any topic"),
        ("lerobot", {"codec": "ffv1"}, "`codec` 'ffv1' is not known"),
        ("lerobot", {"codec": "h264", "crf": 60}, "not from 0 to 51"),
        ("euroc", {"tolerance_ns": -1}, "`tolerance_ns` -1 is below 0"),
        ("euroc", {"every": 0}, "`every` 0"),
    ],
)
def test_bad_options(
    to: str, options: dict[str, Any], words: str, dataset: Path, tmp_path: Path
) -> None:
    with pytest.raises(mp4ds.OptionError, match=words):
        mp4ds.export(dataset, to, tmp_path / "out", mp4ds.ExportOptions(**options))
    assert list(tmp_path.iterdir()) == []


def test_who_made_it_goes_along(dataset: Path, tmp_path: Path) -> None:
    (tmp_path / "about.yaml").write_text("title: A drive\nlicense: CC-BY-4.0\n")
    about = mp4ds.PackOptions(about=str(tmp_path / "about.yaml"))
    mp4ds.pack(dataset, tmp_path / "told", about)
    mp4ds.export(tmp_path / "told", "euroc", tmp_path / "out", mp4ds.ExportOptions(every=4))
    note = json.loads((tmp_path / "out" / "mp4ds_export.json").read_text())
    assert note["about"] == [{"title": "A drive", "license": "CC-BY-4.0"}]
