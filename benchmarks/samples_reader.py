"""What samples.py runs in an environment that has LeRobot and mp4ds."""

from __future__ import annotations

import json
import sys
import time
from collections import defaultdict
from itertools import product
from statistics import median
from typing import Any

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset as Theirs

from mp4ds.torch import LeRobotDataset

FPS = 30
FULL, LEROBOT, KEPT, TRAINING = "full size", "LeRobot's own", "kept", "--for training"


def main() -> None:
    """Print, as JSON: decibels, and CPU milliseconds for each window, by what is read."""
    asked = json.loads(sys.argv[1])
    torch.set_num_threads(1)  # as in a worker of a DataLoader
    names = [*asked["stored"], KEPT]
    datasets = {
        (name, window): opened(name, window, asked)
        for name, window in product(names, asked["windows"])
    }
    frames = len(datasets[LEROBOT, asked["windows"][0]])
    for window in asked["windows"]:
        for number in range(frames):  # the first epoch
            datasets[KEPT, window][number]
    times: dict[tuple[str, int], list[float]] = defaultdict(list)
    random = np.random.default_rng(0)
    for turn, window in product(range(asked["rounds"]), asked["windows"]):
        drawn = random.integers(frames, size=asked["reads"]).tolist()
        for name in [*names[turn % len(names) :], *names[: turn % len(names)]]:
            begun = time.process_time()
            for number in drawn:
                datasets[name, window][number]
            times[name, window].append((time.process_time() - begun) / asked["reads"] * 1e3)
    found = {}
    for name in names:
        each = [median(times[name, window]) for window in asked["windows"]]
        found[name] = (likeness(name, datasets, asked), each)
    print(json.dumps(found))


def opened(name: str, window: int, asked: dict[str, Any]) -> Any:
    """A dataset whose samples have so many frames of each camera."""
    keys = [f"observation.images.{topic[1:].replace('/', '_')}" for topic in asked["topics"]]
    past = [step / FPS for step in range(1 - window, 1)]
    deltas = {"delta_timestamps": dict.fromkeys(keys, past)} if window > 1 else {}
    path = asked["stored"].get(name) or asked["stored"][TRAINING]
    if name == LEROBOT:
        return Theirs("local/drive", root=path, return_uint8=True, **deltas)
    options: dict[str, Any] = {"resize": asked["size"]} if name == FULL else {}
    if name == KEPT:
        options["cache"] = "ram"
    return LeRobotDataset(
        path, topics=asked["topics"], fps=FPS, return_uint8=True, **options, **deltas
    )


def likeness(name: str, datasets: dict[tuple[str, int], Any], asked: dict[str, Any]) -> str:
    """PSNR of the first camera of a dataset of that size."""
    if name in (FULL, KEPT):
        return ""
    exact = LeRobotDataset(
        asked["stored"][FULL],
        topics=asked["topics"][:1],
        fps=FPS,
        return_uint8=True,
        resize=asked["size"],
        layer="exact",
    )
    key = next(iter(exact.meta.camera_keys))
    errors = []
    for number in range(0, len(exact), 4):
        one = datasets[name, 1][number][key].float()
        errors.append(
            float(((exact[number][key].float() - one.reshape(3, *one.shape[-2:])) ** 2).mean())
        )
    return f"{10 * np.log10(255**2 / np.mean(errors)):.2f}"


if __name__ == "__main__":
    main()
