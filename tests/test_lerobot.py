"""Datasets in the words of LeRobot, beside an export of the same datasets."""

from __future__ import annotations

import json
import os
import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mp4ds
from commands import program
from scenes import Scene
from test_examples import ROOT
from test_vectors import COMMAND, JOINTS, LEFT, RIGHT, TASK, packed, robot

torch = pytest.importorskip("torch")
pq = pytest.importorskip("pyarrow.parquet")

from mp4ds.torch import LeRobotDataset  # noqa: E402

FPS = 20
FRONT, SIDE = "observation.images.left_image_raw", "observation.images.right_image_raw"
VECTORS: dict[str, Any] = {"state": JOINTS, "action": f"{COMMAND}:data"}


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two recordings, of which the second begins later; not to be changed."""
    later = Scene([one for one in robot().messages if one.log_time > robot().messages[20].log_time])
    return [packed(tmp_path_factory.mktemp("arm"), made) for made in (robot(), later)]


@pytest.fixture(scope="module")
def exported(drives: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("export") / "out"
    options = mp4ds.ExportOptions(
        topics=[LEFT, RIGHT], fps=FPS, task="push", codec="h264", crf=4, **VECTORS
    )
    mp4ds.export(drives, "lerobot", folder, options)
    return folder


def dataset(drives: list[Path], **options: Any) -> LeRobotDataset:
    given: dict[str, Any] = {"topics": [LEFT, RIGHT], "fps": FPS, "task": "push", **VECTORS}
    return LeRobotDataset(drives, **{**given, **options})


def test_samples_are_those_of_the_export(drives: list[Path], exported: Path) -> None:
    own = dataset(drives)
    number = 0
    for episode in range(2):
        table = pq.read_table(exported / f"data/chunk-000/file-{episode:03d}.parquet").to_pydict()
        shown = {}
        for key in (FRONT, SIDE):
            path = exported / f"videos/{key}/chunk-000/file-{episode:03d}.mp4"
            with mp4ds.open(path) as video:
                frames = next(iter(video))
                shown[key] = frames.read(range(len(frames))).transpose(0, 3, 1, 2) / 255
        for row in range(len(table["index"])):
            sample = own[number]
            assert list(sample) == [FRONT, SIDE, *table, "task"]
            for key in table:
                assert torch.equal(sample[key], torch.tensor(table[key][row])), key
            for key, images in shown.items():
                assert sample[key].dtype == torch.float32
                assert np.abs(sample[key].numpy() - images[row]).mean() < 0.01  # of others: 0.05
            assert sample["task"] == "push"
            number += 1
    assert number == len(own) == own.num_frames


def test_delta_timestamps_and_episodes(drives: list[Path]) -> None:
    deltas = {FRONT: [-0.05, 0], SIDE: [0], "observation.state": [0], "action": [0, 0.05, 0.1]}
    own = pickle.loads(pickle.dumps(dataset(drives, delta_timestamps=deltas, return_uint8=True)))
    plain = dataset(drives, return_uint8=True)
    first, second = plain.meta.episodes["length"]
    for number in (0, first - 1, first, first + second - 1):
        sample = own[number]
        start, end = (0, first) if number < first else (first, first + second)
        for key, seconds in deltas.items():
            wanted = [number + round(time * FPS) for time in seconds]
            rows = np.clip(wanted, start, end - 1).tolist()
            expected = torch.stack([plain[row][key] for row in rows])
            # LeRobot leaves out the dimension of a single image, but not of a single state
            assert torch.equal(sample[key], expected[0] if key == SIDE else expected)
            padded = [want != row for want, row in zip(wanted, rows, strict=True)]
            assert sample[f"{key}_is_pad"].tolist() == padded
    last = dataset(drives, delta_timestamps=deltas, return_uint8=True, episodes=[1])
    assert (len(last), last.num_episodes, last.meta.total_episodes) == (second, 1, 2)
    assert last.absolute_to_relative_idx == {first + n: n for n in range(second)}
    for key, value in own[first + 3].items():
        assert value == last[3][key] if key == "task" else torch.equal(value, last[3][key])


LEROBOT = "MP4DS_LEROBOT"
"""Environment variable: the Python of an environment with LeRobot (CONTRIBUTING.md)."""
COMPARE = """
import json, sys
from lerobot.datasets.lerobot_dataset import LeRobotDataset as Theirs
from mp4ds.torch import LeRobotDataset

options, root, *drives = sys.argv[1:]
options = json.loads(options)
deltas = options.pop("delta_timestamps")
worst = {}
for given in ({}, {"delta_timestamps": deltas, "return_uint8": True}):
    own = LeRobotDataset(drives, **options, **given)
    theirs = Theirs("local/drives", root=root, **given)
    assert len(own) == len(theirs)
    for number in range(len(own)):
        one, other = own[number], theirs[number]
        assert one.keys() == other.keys() and one.pop("task") == other.pop("task")
        for key, value in other.items():
            assert (one[key].shape, one[key].dtype) == (value.shape, value.dtype), key
            scale = 255 if given and value.ndim > 2 else 1
            away = float((one[key].float() - value.float()).abs().mean()) / scale
            worst[key] = max(away, worst.get(key, 0.0))
assert own.meta.shapes == theirs.meta.shapes and own.meta.names == theirs.meta.names
for key, values in own.meta.stats.items():
    for name, value in values.items():
        assert (value == theirs.meta.stats[key][name]).all(), (key, name)
print(json.dumps(worst))
"""
ACT = [
    *("--policy.type=act", "--policy.device=cpu", "--policy.push_to_hub=false"),
    *("--policy.chunk_size=8", "--policy.n_action_steps=8", "--policy.dim_model=64"),
    *("--policy.n_heads=4", "--policy.dim_feedforward=128", "--policy.optimizer_lr=1e-4"),
    *("--policy.pretrained_backbone_weights=null", "--dataset.use_imagenet_stats=false"),
    *("--steps=20", "--log_freq=1", "--batch_size=4", "--num_workers=0", "--seed=1"),
    *("--save_checkpoint=false", "--wandb.enable=false"),
]


@pytest.fixture
def lerobot(tmp_path: Path) -> Any:
    """Runs a program in the environment of LeRobot."""
    python = os.environ.get(LEROBOT)
    if not python:
        pytest.skip(f"{LEROBOT} does not name the Python of an environment with LeRobot")
    env = {"PYTHONPATH": str(ROOT / "src"), "OMP_NUM_THREADS": "1"}
    env |= {"HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "hub")}
    return lambda *words: program(python, *words, env=env)


def test_lerobot_gives_the_same_samples(lerobot: Any, drives: list[Path], exported: Path) -> None:
    deltas = {FRONT: [-0.05, 0], SIDE: [0], "observation.state": [0], "action": [0, 0.05, 0.1]}
    options = {"topics": [LEFT, RIGHT], "fps": FPS, "task": "push", "delta_timestamps": deltas}
    found = lerobot("-c", COMPARE, json.dumps({**options, **VECTORS}), exported, *drives)
    away = json.loads(found.out.splitlines()[-1])
    assert len(away) == 9 + 4
    assert max(away.pop(key) for key in (FRONT, SIDE)) < 0.03  # other colours, of torchcodec
    assert set(away.values()) == {0.0}


@pytest.mark.slow
def test_lerobot_trains_on_them(
    lerobot: Any, drives: list[Path], exported: Path, tmp_path: Path
) -> None:
    """Its own program, 20 steps of ACT, beside a run on the export."""
    words = [*drives, "--topics", LEFT, RIGHT, "--task", "push", "--fps", FPS]
    words += [word for key, value in VECTORS.items() for word in (f"--{key}", value)]
    runs = {
        "own": [ROOT / "examples/train_lerobot.py", *words, "--"],
        "export": [
            *("-m", "lerobot.scripts.lerobot_train", "--dataset.repo_id=local/drives"),
            f"--dataset.root={exported}",
        ],
    }
    losses = {}
    for name, run in runs.items():
        done = lerobot(*run, *ACT, f"--output_dir={tmp_path / name}")
        losses[name] = [float(loss) for loss in re.findall(r" loss:([0-9.]+)", done.err)]
        assert len(losses[name]) == 20
    assert losses["own"] == pytest.approx(losses["export"], rel=0.01)


def test_tasks_and_single_numbers(drives: list[Path]) -> None:
    seen: list[Any] = []

    def darker(image: torch.Tensor) -> torch.Tensor:
        seen.append(image.shape)
        return image // 2

    told = {"task": None, "episode_topic": TASK, "state": f"{JOINTS}:position[elbow]"}
    own = dataset(drives[:1], **told, image_transforms=darker, return_uint8=True)
    assert own.meta.episodes["tasks"] == [["push"], ["pull"]]
    sample = own[len(own) - 1]
    assert (sample["task"], int(sample["task_index"]), int(sample["episode_index"])) == (
        "pull",
        1,
        1,
    )
    assert sample["observation.state"].shape == ()  # as LeRobot has them
    assert seen == [(3, 48, 64)] * 2
    assert int(sample[FRONT].max()) < 128
    assert LeRobotDataset(drives[:1]).meta.fps == 30  # that of the camera


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (
            {"delta_timestamps": {"action": [0.03]}},
            "action has 0.03 s, which is no multiple",
        ),
        (
            {"delta_timestamps": {"reward": [0]}},
            f"'reward', which is not one of {FRONT}, {SIDE}",
        ),
        ({"episodes": [2]}, "episodes has 2, but there are 2, from 0"),
        ({"episodes": []}, "episodes is empty"),
    ],
)
def test_wrong_options(drives: list[Path], options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(mp4ds.OptionError) as caught:
        dataset(drives, **options)
    assert sentence in str(caught.value)
    with pytest.raises(TypeError, match="LeRobotDataset has no 'offsets'"):
        dataset(drives, offsets=(0, 1))
