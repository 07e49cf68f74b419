"""Episodes of a LeRobotDataset become datasets, and are the same when exported again.

The folder is written with PyAV and pyarrow, or by LeRobot; what comes out is read with PyAV and
mcap.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

import mp4ds
from commands import call, program, refused
from test_export import LEROBOT
from test_import import messages, stamp
from test_import_video import picture, shown

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

LENGTHS = [7, 10]
FPS = 30
KEY = "observation.images.front"
CAMERA = "/observation/images/front/compressed_video"
NAMES = ["a.pos", "b.pos", "gripper"]
TASKS = ["push the cube", "open the drawer"]
STATES = np.random.default_rng(1).normal(size=(sum(LENGTHS), 3)).astype(np.float32)


def write_folder(root: Path, *, begins_with_key: bool = True) -> Path:
    """Two episodes in one video and one table; the task of the second one changes."""
    video = root / f"videos/{KEY}/chunk-000/file-000.mp4"
    for path in (video, root / "data/chunk-000/x", root / "meta/episodes/chunk-000/x"):
        path.parent.mkdir(parents=True)
    options = {"g": "2", "bf": "0", "forced-idr": "1", "x264-params": "scenecut=0"}
    with av.open(str(video), "w") as container:
        stream: Any = container.add_stream("libx264", rate=FPS, options=options)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for number in range(sum(LENGTHS)):
            frame = av.VideoFrame.from_ndarray(picture(number), "rgb24")
            frame.pts, frame.time_base = number, Fraction(1, FPS)
            if number == LENGTHS[0] and begins_with_key:
                frame.pict_type = av.video.frame.PictureType.I
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    places = np.concatenate([np.arange(length) for length in LENGTHS])
    episodes = np.repeat(np.arange(2), LENGTHS)
    table = {
        "observation.state": pa.array(STATES.tolist(), pa.list_(pa.float32(), 3)),
        "action": pa.array((STATES * 2).tolist(), pa.list_(pa.float32())),
        "next.reward": pa.array(places / 10, pa.float32()),
        "next.done": pa.array(places == 9),
        "grid": pa.array(
            [[[n, 1], [2, 3]] for n in places.tolist()], pa.list_(pa.list_(pa.int64()))
        ),
        "timestamp": pa.array((places / FPS).astype(np.float32)),
        "frame_index": pa.array(places),
        "episode_index": pa.array(episodes),
        "index": pa.array(np.arange(sum(LENGTHS))),
        "task_index": pa.array((np.arange(sum(LENGTHS)) > 12).astype(np.int64)),
    }
    pq.write_table(pa.table(table), root / "data/chunk-000/file-000.parquet")
    pq.write_table(pa.table({"task_index": [0, 1], "task": TASKS}), root / "meta/tasks.parquet")
    rows = {"episode_index": [0, 1], "length": LENGTHS}
    for prefix in ("data", f"videos/{KEY}"):
        rows |= {f"{prefix}/chunk_index": [0, 0], f"{prefix}/file_index": [0, 0]}
    begins: dict[str, Any] = {f"videos/{KEY}/from_timestamp": [0.0, LENGTHS[0] / FPS]}
    pq.write_table(pa.table({**rows, **begins}), root / "meta/episodes/chunk-000/file-000.parquet")
    features = {
        KEY: {"dtype": "video", "shape": [48, 64, 3], "names": ["height", "width", "channels"]},
        "observation.state": {"dtype": "float32", "shape": [3], "names": NAMES},
        "action": {"dtype": "float32", "shape": [3], "names": {"motors": NAMES}},
        "next.reward": {"dtype": "float32", "shape": [1], "names": None},
        "next.done": {"dtype": "bool", "shape": [1], "names": None},
        "grid": {"dtype": "int64", "shape": [2, 2], "names": None},
    }
    write_info(root, {"codebase_version": "v3.0", "fps": FPS, "features": features})
    return root


def write_info(root: Path, info: Any) -> None:
    (root / "meta/info.json").write_text(json.dumps(info))


def imported(root: Path, target: Path, **options: Any) -> mp4ds.PackSummary:
    images = mp4ds.ImportOptions(**options)
    return mp4ds.pack(root, target, mp4ds.PackOptions(images=images))


def test_every_episode_becomes_a_dataset(tmp_path: Path) -> None:
    root = write_folder(tmp_path / "in")
    command = ["import", "lerobot", root, "-o", tmp_path / "out", "--json"]
    assert len(json.loads(call(*command).out)) == 2
    assert json.loads(call(*command).out) == []  # both are there
    first = 0
    for number, length in enumerate(LENGTHS):
        own = range(first, first + length)
        first += length
        dataset = tmp_path / f"out/episode_{number:06d}"
        assert mp4ds.validate(dataset, deep=True) == []
        stored = next(dataset.glob("*.mp4"))
        due = shown(root / f"videos/{KEY}/chunk-000/file-000.mp4")[own.start : own.stop]
        assert len(shown(stored)) == length
        assert all(map(np.array_equal, shown(stored), due))
        mp4ds.unpack(dataset, "mcap", tmp_path / "again.mcap", mp4ds.UnpackOptions(force=True))
        found = messages(tmp_path / "again.mcap")
        times = [round(float(np.float32(place / FPS)) * 1e9) for place in range(length)]
        for topic, factor in (("/observation/state", 1), ("/action", 2)):
            rows = found[topic]
            assert [stamp(message) for _, message in rows] == times
            assert [time for time, _ in rows] == times
            positions = np.array([message.position for _, message in rows])
            assert np.array_equal(positions, factor * STATES[own].astype(float))
            assert all(list(message.name) == NAMES for _, message in rows)
        assert [time for time, _ in found[CAMERA]] == times
        rewards = [message.data for _, message in found["/next/reward"]]
        assert rewards == [float(np.float32(place / 10)) for place in range(length)]
        assert [message.data for _, message in found["/next/done"]] == [
            n == 9 for n in range(length)
        ]
        sides = [(one.size, one.stride) for one in found["/grid"][0][1].layout.dim]
        assert sides == [(2, 4), (2, 2)]
        assert list(found["/grid"][3][1].data) == [3, 1, 2, 3]
        tasks = [(time, message.data) for time, message in found["/task"]]
        changed = [(times[6], TASKS[1])] if number else []
        assert tasks == [(0, TASKS[0]), *changed]


def test_exported_again_it_is_the_same(tmp_path: Path) -> None:
    root = write_folder(tmp_path / "in")
    datasets = [tmp_path / f"{number}" for number in range(2)]
    for number, dataset in enumerate(datasets):
        imported(root, dataset, episode=number)
    chosen: dict[str, Any] = {"state": "/observation/state", "action": "/action", "task": "/task"}
    options = mp4ds.ExportOptions(**chosen)
    summary = mp4ds.export(datasets, "lerobot", tmp_path / "out", options)
    assert summary.messages["/task"] == 3
    expected = pq.read_table(root / "data/chunk-000/file-000.parquet").to_pydict()
    paths = sorted((tmp_path / "out/data/chunk-000").iterdir())
    found = pa.concat_tables([pq.read_table(path) for path in paths]).to_pydict()
    for name in ("observation.state", "action", "timestamp", "episode_index", "task_index"):
        assert found[name] == expected[name], name
    assert pq.read_table(tmp_path / "out/meta/tasks.parquet")["task"].to_pylist() == TASKS
    info = json.loads((tmp_path / "out/meta/info.json").read_text())
    assert info["features"]["observation.state"]["names"] == NAMES
    with pytest.raises(mp4ds.OptionError, match="`task` /action is not a topic of std_msgs/String"):
        mp4ds.export(datasets, "lerobot", tmp_path / "no", mp4ds.ExportOptions(task="/action"))


def test_an_episode_that_does_not_begin_with_a_key_frame(tmp_path: Path) -> None:
    root = write_folder(tmp_path / "in", begins_with_key=False)
    imported(root, tmp_path / "0", episode=0)
    with pytest.raises(mp4ds.SourceError, match=r"frame 7 is not a key frame.*Give `decode`"):
        imported(root, tmp_path / "1", episode=1)
    imported(root, tmp_path / "1", episode=1, decode=True)
    with mp4ds.open(tmp_path / "1") as dataset:
        frames = [frame.data.astype(int) for frame in dataset["/observation/images/front"]]
    assert len(frames) == LENGTHS[1]
    for number, frame in enumerate(frames, LENGTHS[0]):
        assert np.abs(frame - picture(number)).mean() < 6


def _with(**changes: Any) -> Callable[[Path], None]:
    def change(root: Path) -> None:
        info = json.loads((root / "meta/info.json").read_text())
        write_info(root, {**info, **changes})

    return change


def _feature(name: str, **feature: Any) -> Callable[[Path], None]:
    def change(root: Path) -> None:
        info = json.loads((root / "meta/info.json").read_text())
        own = {**info["features"].get(name, {}), **feature}
        write_info(root, {**info, "features": {**info["features"], name: own}})

    return change


def _column(path: str, name: str, values: list[Any]) -> Callable[[Path], None]:
    def change(root: Path) -> None:
        table = pq.read_table(root / path).to_pydict()
        pq.write_table(pa.table({**table, name: values}), root / path)

    return change


def _climbing(root: Path) -> None:
    _feature("../x", dtype="video", shape=[1])(root)
    for name in ("chunk_index", "file_index", "from_timestamp"):
        _column(EPISODES, f"videos/../x/{name}", [0, 0])(root)


EPISODES, DATA = "meta/episodes/chunk-000/file-000.parquet", "data/chunk-000/file-000.parquet"
HOSTILE: dict[str, tuple[Callable[[Path], Any], str]] = {
    "version": (_with(codebase_version="v2.1"), "is a LeRobotDataset v2.1, not v3"),
    "fps": (_with(fps=0), "fps is 0"),
    "features": (_with(features=[1]), "info.json: is not valid"),
    "json": (lambda root: (root / "meta/info.json").write_text("{"), "info.json: is not valid"),
    "shape": (_feature("action", shape=[-3]), "shape of action is not positive"),
    "huge": (_feature("action", shape=[10**6, 10**6]), "more than"),
    "info": (_feature(KEY, info=[1]), "is no mapping"),
    "climbs": (_with(data_path="../data.parquet"), "data_path is not data/chunk-"),
    "attribute": (_with(video_path="{chunk_index.__class__}"), "video_path is not videos/"),
    "key": (_climbing, "names a file outside of its folder"),
    "no-column": (_feature("other", dtype="float32", shape=[1]), "is damaged.*other"),
    "count": (_feature("action", shape=[4]), "not of 4 numbers each"),
    "no-video": (_column(EPISODES, f"videos/{KEY}/file_index", [5, 5]), "file-005.mp4: does not"),
    "other-frames": (_column(EPISODES, f"videos/{KEY}/from_timestamp", [0.0, 9.0]), "other frames"),
    "begin": (_column(EPISODES, f"videos/{KEY}/from_timestamp", [0.0, 1e300]), "begins at 1e"),
    "length": (_column(EPISODES, "length", [7, 11]), "it has 10 rows of episode 1, not 11"),
    "times": (_column(DATA, "timestamp", [float("nan")] * 17), "timestamps are not seconds"),
    "back": (_column(DATA, "timestamp", [0.5] * 17), "timestamps do not increase"),
    "numbers": (_column(DATA, "frame_index", [1] * 17), "are not numbered from 0"),
    "ragged": (_column(DATA, "action", [[1.0]] * 16 + [[1.0] * 35]), "differ in length"),
    "nulls": (_column(DATA, "observation.state", [None] * 17), "it is not|rows are not|damaged"),
    "tasks": (_column("meta/tasks.parquet", "task_index", [7, 8]), "tasks.parquet: is damaged"),
    "table": (lambda root: (root / DATA).write_bytes(b"PAR1"), "file-000.parquet: is damaged"),
    "video": (
        lambda root: (root / f"videos/{KEY}/chunk-000/file-000.mp4").write_bytes(b"x"),
        "file-000.mp4: is not an mp4",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", HOSTILE)
def test_what_is_wrong_with_a_folder_is_told(case: str, tmp_path: Path) -> None:
    root = write_folder(tmp_path / "in")
    change, problem = HOSTILE[case]
    change(root)
    done = call("import", "lerobot", root, "-o", tmp_path / "out", "--episode", 1)
    refused(done, 2)
    assert re.search(problem, done.err), done.err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("numbers", "problem"), [([1, -1], "it has an episode -1"), ([1, 1], "has episode 1 twice")]
)
def test_no_episode_is_passed_over(numbers: list[int], problem: str, tmp_path: Path) -> None:
    root = write_folder(tmp_path / "in")
    _column(EPISODES, "episode_index", numbers)(root)
    command = ["import", "lerobot", root, "-o", tmp_path / "out"]
    refused(call(*command), 2, problem)
    if numbers == [1, 1]:
        refused(call(*command, "--episode", 1), 2, problem)
    assert not (tmp_path / "out").exists()


def test_what_has_no_message_is_counted(tmp_path: Path) -> None:
    root = write_folder(tmp_path / "in")
    (root / "meta/tasks.parquet").unlink()
    _feature("spoken", dtype="language", shape=[1])(root)
    _feature("seen", dtype="image", shape=[4, 4, 3])(root)
    _column(DATA, "spoken", [[{"role": "user", "content": "go"}]] * sum(LENGTHS))(root)
    _column(DATA, "seen", [{"bytes": b"x", "path": "x.png"}] * sum(LENGTHS))(root)
    _column(DATA, "more", [1] * sum(LENGTHS))(root)
    assert imported(root, tmp_path / "ds", episode=0).skipped == {
        "rows of spoken, whose type has no message": 7,
        "images of seen, which are not in a video": 7,
        "numbers of tasks, of which no texts are there": 7,
        "columns that are not features": 1,
    }


def test_which_episodes(tmp_path: Path) -> None:
    root = write_folder(tmp_path / "in")
    out = ["-o", tmp_path / "out"]
    refused(call("import", "lerobot", root, *out, "--episode", 2), 2, "has no --episode 2")
    refused(call("import", "images", root, *out), 2, "has 2 episodes")
    refused(call("import", "lerobot", tmp_path, *out), 2, "is not a LeRobotDataset v3")
    (root / EPISODES).unlink()
    refused(call("import", "lerobot", root, *out), 2, "has no episodes")


MAKE = """
import sys
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

root, out = sys.argv[1:]
names = ["height", "width", "channels"]
features = {
    "observation.images.front": {"dtype": "video", "shape": (96, 128, 3), "names": names},
    "observation.images.depth": {
        "dtype": "video", "shape": (96, 128, 1), "names": names, "info": {"is_depth_map": True}
    },
    "observation.state": {"dtype": "float32", "shape": (2,), "names": ["a", "b"]},
}
made = LeRobotDataset.create("local/x", fps=30, features=features, root=root, use_videos=True)
y, x = np.mgrid[:96, :128]
for episode, length in enumerate((5, 8)):
    for number in range(length):
        made.add_frame({
            "observation.images.front": np.stack([x + 9 * number, y, x + y], -1).astype(np.uint8),
            "observation.images.depth": (x * 40 + y * 10 + number)[..., None].astype(np.uint16),
            "observation.state": np.array([number, episode], np.float32) / 7,
            "task": f"task {episode}",
        })
    made.save_episode()
made.finalize()
loaded = LeRobotDataset("local/x", root=root)
items = [loaded[number] for number in range(5, 13)]
np.savez(
    out,
    **{key: np.stack([item[key].numpy() for item in items]) for key in (*features, "timestamp")},
)
"""


def test_what_lerobot_records(tmp_path: Path) -> None:
    python = os.environ.get(LEROBOT)
    if not python:
        pytest.skip(f"{LEROBOT} does not name the Python of an environment with LeRobot")
    env = {"HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "hub")}
    program(python, "-c", MAKE, tmp_path / "in", tmp_path / "loaded.npz", env=env)
    imported(tmp_path / "in", tmp_path / "ds", episode=1)
    loaded = np.load(tmp_path / "loaded.npz")
    with mp4ds.open(tmp_path / "ds") as dataset:
        colours = [frame.data for frame in dataset[CAMERA]]
        depths = np.stack([frame.data for frame in dataset["/observation/images/depth"]])
        states = [one.decoded.position for one in dataset.messages(["/observation/state"])]
        stamps = dataset[CAMERA].stamps
    due = loaded["observation.images.front"].transpose(0, 2, 3, 1) * 255
    assert np.abs(np.stack(colours).astype(float) - due).mean() < 2
    assert (
        np.abs(depths - loaded["observation.images.depth"][:, 0]).max() <= 1
    )  # exp, by another library
    assert np.array_equal(np.array(states), loaded["observation.state"].astype(float))
    assert np.array_equal((stamps / 1e9).astype(np.float32), loaded["timestamp"])
