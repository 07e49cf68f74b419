"""What samples for training cost: bytes, likeness, and CPU time, beside LeRobot.

    python benchmarks/samples.py --lerobot PYTHON [--size WxH ...] [--cameras N ...] [--frames N]

A recording of four cameras (rgb8, scenes of clips.py at low noise) is packed as by default. Of this
dataset, a small one is made with ``--resize --quality visual --for training``, and ``mp4ds export
lerobot --resize`` makes what LeRobot reads. Then ``mp4ds.torch.LeRobotDataset`` and LeRobot's own,
both in the environment of PYTHON (which has LeRobot and mp4ds), give windows of consecutive frames
that end at a random one, as bytes, and one at a time: in a shuffled training on many recordings,
two samples of a batch are hardly ever close together. CPU time is of all threads of the process,
opening left out; all take turns in short runs, of which the median is given. ``kept`` is a later
epoch with ``cache=``. PSNR is of the first camera, in RGB, against the frames of the recording
in that size.

Files stay in ``--folder``.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

import mp4ds
from clips import ClipSpec, check_data, make
from measure import parse_size, parser_of, print_machine, print_table
from mp4ds.bags.formats import open_reader
from mp4ds.bags.mcap import McapWriter
from mp4ds.bags.protocols import with_own_payload
from mp4ds.packing.options import PackOptions
from mp4ds.records import Message
from recordings import HERTZ, write_mcap

SCENES = ("cups", "lane", "cars", "people")
TOPICS = [f"/{scene}/image_raw" for scene in SCENES]
FULL, TRAINING, LEROBOT, KEPT = "full size", "--for training", "LeRobot's own", "kept"


def main() -> None:
    """Measure and print."""
    parser = parser_of(__doc__)
    parser.add_argument("--lerobot", required=True, metavar="PYTHON")
    sizes = [(224, 224), (320, 240), (640, 480)]
    parser.add_argument("--size", nargs="+", type=parse_size, default=sizes, help="WxH")
    parser.add_argument("--cameras", nargs="+", type=int, default=[2, 4])
    parser.add_argument("--window", nargs="+", type=int, default=[1, 2, 8])
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--reads", type=int, default=8, help="samples of a run")
    folder = Path(tempfile.gettempdir()) / "mp4ds-samples"
    parser.add_argument("--folder", type=Path, default=folder)
    options = parser.parse_args()
    check_data()
    print_machine()
    options.folder.mkdir(parents=True, exist_ok=True)
    full = options.folder / "full"
    if not full.exists():
        recording = options.folder / "drive.mcap"
        record(recording, options.frames)
        mp4ds.pack(recording, full, PackOptions(force=True))
    rows: list[tuple[object, ...]] = []
    for size, cameras in product(options.size, options.cameras):
        stored = {FULL: full, **made(full, size, cameras, options.folder)}
        found = measured(stored, size, cameras, options)
        for name, (decibels, times) in found.items():
            path = stored.get(name)
            kilobytes = path and f"{videos_of(path, SCENES[:cameras]) / options.frames / 1e3:.1f}"
            each = (f"{time:.2f}" for time in times)
            rows.append(("{}x{}".format(*size), cameras, name, kilobytes or "", decibels, *each))
            print("-", *rows[-1], flush=True)
    times = (f"CPU ms, {window} frame{'s' * (window > 1)}" for window in options.window)
    print_table(("size", "cameras", "read from", "kB a sample", "dB", *times), rows)


# ---------------------------------------------------------------- what is read


def record(path: Path, frames: int) -> None:
    """Write a recording of all cameras."""
    with McapWriter(path, profile="ros2", compression="lz4") as writer:
        for scene in SCENES:
            part = path.with_name(f"{scene}.mcap")
            clip = make(ClipSpec(scene, "rgb8", "low", frames))
            write_mcap(part, clip, "rgb8", compression="lz4")
            with open_reader(part) as reader:
                for message in messages_of(reader, scene):
                    writer.add_channel(message.channel)
                    writer.write(message)
            part.unlink()


def messages_of(reader: Any, scene: str) -> Iterator[Message]:
    """The messages of a camera, on topics of its own."""
    for found in reader.records():
        if isinstance(found, Message):
            topic = found.channel.topic.replace("/camera", f"/{scene}", 1)
            own = SCENES.index(scene) * 100 + found.channel.id
            yield with_own_payload(found.of_channel(replace(found.channel, id=own, topic=topic)))


def made(full: Path, size: tuple[int, int], cameras: int, folder: Path) -> dict[str, Path]:
    """Datasets and an export of that size and so many cameras."""
    begin = folder / "{}x{}-{}".format(*size, cameras)
    found = {
        TRAINING: begin.with_name(f"{begin.name}-training"),
        LEROBOT: begin.with_name(f"{begin.name}-lerobot"),
    }
    topics = TOPICS[:cameras]
    if not found[TRAINING].exists():
        wanted = PackOptions(resize=size, topics=topics, quality="visual", purpose="training")
        mp4ds.pack(full, found[TRAINING], wanted)
    if not found[LEROBOT].exists():
        exported = mp4ds.ExportOptions(topics=topics, resize=size)
        mp4ds.export(full, "lerobot", found[LEROBOT], exported)
    return found


def videos_of(path: Path, scenes: tuple[str, ...]) -> int:
    """Bytes of what is read for samples: not of what makes them exact."""
    found = [file for file in path.rglob("*.mp4") if any(map(str(file).count, scenes))]
    return sum(file.stat().st_size for file in found if not file.name.endswith(".exact.mp4"))


# ---------------------------------------------------------------- how it is read


def measured(
    stored: dict[str, Path], size: tuple[int, int], cameras: int, options: argparse.Namespace
) -> dict[str, tuple[str, list[float]]]:
    """Decibels and times of samples, by where they come from."""
    asked = {
        "stored": {name: str(path) for name, path in stored.items()},
        "size": size,
        "topics": TOPICS[:cameras],
        "windows": options.window,
        "rounds": options.rounds,
        "reads": options.reads,
    }
    environment = {**os.environ, "HF_HUB_OFFLINE": "1"}
    result = subprocess.run(
        [options.lerobot, __file__, "--read", json.dumps(asked)],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        env=environment,
    )
    return json.loads(result.stdout.splitlines()[-1])  # type: ignore[no-any-return]


# ---------------------------------------------------------------- in LeRobot's environment


def read(asked: dict[str, Any]) -> None:
    """Print, as JSON: decibels, and CPU milliseconds for each window, by what is read."""
    import torch

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
    from lerobot.datasets.lerobot_dataset import LeRobotDataset as Theirs

    from mp4ds.torch import LeRobotDataset

    keys = [f"observation.images.{topic[1:].replace('/', '_')}" for topic in asked["topics"]]
    past = [step / HERTZ for step in range(1 - window, 1)]
    deltas = {"delta_timestamps": dict.fromkeys(keys, past)} if window > 1 else {}
    path = asked["stored"].get(name) or asked["stored"][TRAINING]
    if name == LEROBOT:
        return Theirs("local/drive", root=path, return_uint8=True, **deltas)
    options: dict[str, Any] = {"resize": asked["size"]} if name == FULL else {}
    if name == KEPT:
        options["cache"] = f"{path}-kept"
    return LeRobotDataset(
        path, topics=asked["topics"], fps=HERTZ, return_uint8=True, **options, **deltas
    )


def likeness(name: str, datasets: dict[tuple[str, int], Any], asked: dict[str, Any]) -> str:
    """PSNR of the first camera of a dataset of that size."""
    from mp4ds.torch import LeRobotDataset

    if name in (FULL, KEPT):
        return ""
    exact = LeRobotDataset(
        asked["stored"][FULL],
        topics=asked["topics"][:1],
        fps=HERTZ,
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
    if sys.argv[1:2] == ["--read"]:
        read(json.loads(sys.argv[2]))
    else:
        main()
