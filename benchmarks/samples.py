"""What samples for training cost: bytes, likeness, and CPU time, beside LeRobot's videos.

    python benchmarks/samples.py [--clip NAME ...] [--size WxH ...] [--frames N]

Clips (clips.py) are packed with ``--quality visual``, alone and with ``--for training``, and
encoded as LeRobot does. A sample is a window of consecutive frames that ends at a random one. It
is read as a batch of its own, as in a shuffled training on many recordings, where two frames of a
batch are hardly ever close together: of our datasets by FrameDataset, of LeRobot's video by
torchcodec as LeRobot calls it, without its conversion to floats. There is one camera; another one
costs as much again. CPU time is of all threads of the process. All take turns in short runs, of
which the median is given. ``kept`` is a later epoch of ``--for training`` with ``cache="ram"``.
"""

from __future__ import annotations

import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch

import clips
import mp4ds
from loader_readers import EmulatedLeRobot, Stored, versions, write_lerobot_video
from measure import parse_size, parser_of, print_machine, print_table
from mp4ds.torch import FrameDataset
from mp4ds.video.colour import samples as plane_of
from mp4ds.video.pixels import PictureConverter, picture_to_frame
from mp4ds.video.scores import find_ffmpeg, scores_of
from recordings import TOPIC, write_mcap

WINDOWS = (1, 2, 8)
PACKED: dict[str, dict[str, Any]] = {"visual": {}, "--for training": {"purpose": "training"}}
LEROBOT, KEPT = "LeRobot, torchcodec", "kept"
Reader = Callable[[list[int], int], Any]
"""Reads the frames of a window, of that many."""


def main() -> None:
    """Measure and print."""
    parser = parser_of(__doc__)
    scenes = ["cups", "people", "arm"]
    parser.add_argument("--clip", nargs="+", choices=clips.MOVING, default=scenes)
    sizes = [(224, 224), (320, 240), (640, 480)]
    parser.add_argument("--size", nargs="+", type=parse_size, default=sizes, help="WxH")
    parser.add_argument("--frames", type=int, default=240)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--reads", type=int, default=8, help="samples of a run")
    options = parser.parse_args()
    clips.check_data()
    torch.set_num_threads(1)  # as in a worker of a DataLoader
    print_machine()
    print(f"- {versions()}")
    rows: list[tuple[object, ...]] = []
    for size, scene in product(options.size, options.clip):
        with tempfile.TemporaryDirectory(prefix="mp4ds-benchmark-") as made:
            spec = clips.ClipSpec(scene, "rgb8", "low", options.frames, size)
            pixels = np.stack(list(clips.make(spec)))
            found = measured(Path(made), pixels, options.rounds, options.reads)
            for name, cells in found.items():
                rows.append(("{}x{}".format(*size), scene, name, *cells))
                print("-", *rows[-1], flush=True)
    times = (f"CPU ms, {window} frame{'s' * (window > 1)}" for window in WINDOWS)
    print_table(("size", "clip", "stored as", "kB a frame", "VMAF", *times), rows)


def measured(
    folder: Path, pixels: np.ndarray[Any, Any], rounds: int, reads: int
) -> dict[str, tuple[str, ...]]:
    """Bytes, VMAF and times of a clip, by how it is stored."""
    source, frames = folder / "clip.mcap", len(pixels)
    write_mcap(source, pixels, "rgb8", compression="none")
    videos: dict[str, Path] = {}
    readers: dict[str, Reader] = {}
    for number, (name, given) in enumerate(PACKED.items()):
        dataset = folder / str(number)
        mp4ds.pack(source, dataset, mp4ds.PackOptions(quality="visual", **given))
        (videos[name],) = dataset.glob("*.mp4")
        readers[name] = of_dataset(dataset)
    readers[KEPT] = of_dataset(dataset, cache="ram")
    videos[LEROBOT] = folder / "lerobot.mp4"
    write_lerobot_video(videos[LEROBOT], pixels)
    peer = EmulatedLeRobot(Stored("lerobot", videos[LEROBOT], None, frames), floats=False)
    readers[LEROBOT] = lambda window, _: torch.stack([peer.read(window)])
    times: dict[tuple[str, int], list[float]] = defaultdict(list)
    for last, window in product(range(frames), WINDOWS):
        readers[KEPT](numbers_of(last, window), window)  # the first epoch
    random = np.random.default_rng(0)
    for number, window in product(range(rounds), WINDOWS):
        drawn = [numbers_of(last, window) for last in random.integers(frames, size=reads).tolist()]
        names = list(readers)
        for name in [*names[number % len(names) :], *names[: number % len(names)]]:
            begun = time.process_time()
            for one in drawn:
                readers[name](one, window)
            times[name, window].append((time.process_time() - begun) / reads * 1e3)
    found: dict[str, tuple[str, ...]] = {}
    for name in readers:
        told = ("", "")
        if name in videos:
            shown = (readers[name]([number], 1) for number in range(frames))
            told = f"{videos[name].stat().st_size / frames / 1e3:.2f}", f"{vmaf(pixels, shown):.2f}"
        found[name] = (*told, *(f"{median(times[name, window]):.2f}" for window in WINDOWS))
    return found


def numbers_of(last: int, window: int) -> list[int]:
    """The frames of a window; before the first there are no others."""
    return [max(last + step, 0) for step in range(1 - window, 1)]


def of_dataset(path: Path, **options: Any) -> Reader:
    """Reads windows of a dataset of one camera as batches."""
    datasets = {
        window: FrameDataset(path, offsets=range(1 - window, 1), **options) for window in WINDOWS
    }

    def read(numbers: list[int], window: int) -> Any:
        dataset = datasets[window]
        return dataset.collate(dataset.__getitems__([numbers[-1]]))[TOPIC]

    return read


def vmaf(pixels: np.ndarray[Any, Any], shown: Iterator[Any]) -> float:
    """The mean of frames, each in a batch of its own."""
    decoded = (planes_of(np.asarray(one).reshape(-1, *one.shape[-3:])[0]) for one in shown)
    scores = scores_of(map(planes_of, pixels), decoded, ("vmaf",), ffmpeg=find_ffmpeg())
    return float(scores["vmaf"].mean())


def planes_of(rgb: np.ndarray[Any, Any]) -> tuple[np.ndarray[Any, Any], ...]:
    """Planes of 4:2:0."""
    if rgb.shape[0] == 3:  # channels first
        rgb = rgb.transpose(1, 2, 0)
    pixels = np.ascontiguousarray(rgb)
    frame = picture_to_frame((pixels,), "rgb24", "yuv420p", PictureConverter())
    return tuple(plane_of(frame, index).copy() for index in range(3))


if __name__ == "__main__":
    main()
