"""What frames of another size cost: ``loader.py sizes``.

Frames of 720p are asked for in 224x224, or as said, from the same files as by ``frames``: by mp4ds
with ``resize=``, by torchcodec with its own Resize transform, by PyAV with swscale's default. Each
reader is in a process of its own with one thread; they take turns within each round. CPU time is
user and system time, opening left out. Some frames are compared with the whole ones reduced by
Pillow's box filter, and have to be more than 25 dB like these; the least is told.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from PIL import Image

import mp4ds
from loader_clips import BATCH, CODECS, PATTERNS, WINDOW, Store, Stored
from loader_peers import Mp4ds, Peer, PyAv, Size, TorchCodec
from measure import cpu_seconds, parse_size, print_table, python
from recordings import TOPIC

_LEAST_DB = 25


def options(parser: argparse.ArgumentParser) -> None:
    """What can be chosen."""
    parser.add_argument("--frames", type=int, default=120, help="of the clip")
    parser.add_argument("--size", type=parse_size, default=(1280, 720), help="WxH of the clip")
    parser.add_argument("--made", type=parse_size, default=(224, 224), help="WxH to make")
    parser.add_argument(
        "--way", nargs="+", default=[f"{codec}-{g}" for codec in CODECS for g in (2, 30)]
    )
    parser.add_argument("--seconds", type=float, default=2.0, help="of each pattern")
    parser.add_argument("--rounds", type=int, default=3)


def run(chosen: argparse.Namespace) -> None:
    """Measure and print."""
    store = Store(chosen.folder, chosen.frames, chosen.size, 0)
    rows = []
    for name in chosen.way:
        store.stored(name)
        found: dict[str, dict[str, list[float]]] = {peer: {} for peer in PEERS}
        least: dict[str, float] = {}
        for number in range(chosen.rounds):
            for peer in [*PEERS][number % len(PEERS) :] + [*PEERS][: number % len(PEERS)]:
                arguments = [chosen.frames, chosen.size, name, peer, chosen.made, chosen.seconds]
                task = json.dumps([str(chosen.folder), *arguments, number])
                figures = json.loads(python(__file__, task).output.splitlines()[-1])
                least[peer] = min(least.get(peer, 99.0), figures.pop("decibel"))
                for pattern, value in figures.items():
                    found[peer].setdefault(pattern, []).append(value)
        for pattern, words in PATTERNS.items():
            costs = [median(values[pattern]) for values in found.values()]
            ratio = min(costs[1:]) / costs[0]
            rows.append([name, words, *(f"{cost:.2f}" for cost in costs), f"{ratio:.2f}"])
        told = ", ".join(f"{peer} {value:.1f}" for peer, value in least.items())
        print(f"- {name}: least dB: {told}", flush=True)
    peers = [f"{peer}, CPU ms a frame" for peer in PEERS]
    print_table(["video", "pattern", *peers, "best other / mp4ds"], rows)


PEERS: dict[str, Callable[[Stored, Size], Peer]] = {
    "mp4ds": lambda stored, size: Mp4ds(stored, size=size),
    "torchcodec": lambda stored, size: TorchCodec(stored, "exact", size=size),
    "pyav": lambda stored, size: PyAv(stored, size=size),
}


def _job(
    folder: str,
    frames: int,
    clip: tuple[int, int],
    name: str,
    peer: str,
    made: tuple[int, int],
    seconds: float,
    seed: int,
) -> dict[str, float]:
    stored = Store(Path(folder), frames, (clip[0], clip[1]), 0).stored(name)
    size = (made[0], made[1])
    read = PEERS[peer](stored, size).read
    read([0])
    figures = {}
    for pattern in PATTERNS:
        random = np.random.default_rng(seed)
        start, cpu, count = time.perf_counter(), cpu_seconds(), 0
        while time.perf_counter() - start < seconds:
            for wanted in _wanted(pattern, frames, random):
                count += len(read(wanted))
        figures[pattern] = 1e3 * (cpu_seconds() - cpu) / count
    numbers = np.linspace(0, frames - 1, 8).astype(int).tolist()
    wholes = mp4ds.open(stored.path.parent)[TOPIC].read(numbers)
    figures["decibel"] = min(map(_decibel, read(numbers), wholes))
    return figures


def _wanted(pattern: str, frames: int, random: np.random.Generator) -> list[list[int]]:
    if pattern == "order":
        return [[number] for number in range(frames)]
    if pattern == "single":
        return [[int(random.integers(frames))]]
    if pattern == "batch":
        return [random.choice(frames, min(BATCH, frames), replace=False).tolist()]
    first = int(random.integers(max(frames - WINDOW, 1)))
    return [list(range(first, min(first + WINDOW, frames)))]


def _decibel(small: Any, whole: Any) -> float:
    size = small.shape[1::-1]
    expected = np.asarray(Image.fromarray(whole).resize(size, Image.Resampling.BOX), np.float32)
    error = np.square(np.asarray(small, np.float32) - expected).mean()
    found = float(10 * np.log10(255**2 / max(float(error), 1e-6)))
    if found < _LEAST_DB:
        raise SystemExit(f"a frame is only {found:.1f} dB like the whole one")
    return found


if __name__ == "__main__":
    print(json.dumps(_job(*json.loads(sys.argv[1]))))
