"""What samples of small images cost, of a dataset in full size and of one made of it in theirs.

    python benchmarks/smaller.py [--frames N] [--size WxH] [--samples N] [--quality Q ...]

A recording of three cameras (rgb8, the scenes cups, lane and cars of clips.py at low noise) is
packed as by default, and this dataset packed again with ``--resize``. Then ``FrameDataset`` gives
random samples of all three at that size, in a process of its own for each dataset, in turns. CPU
time is user and system time of all threads, opening and imports left out.

Files stay in ``--folder``.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

import mp4ds
from clips import ClipSpec, check_data, make
from measure import (
    cpu_seconds,
    isolated,
    parse_size,
    parser_of,
    print_machine,
    print_table,
    size_of,
)
from mp4ds.bags.formats import open_reader
from mp4ds.bags.mcap import McapWriter
from mp4ds.bags.protocols import with_own_payload
from mp4ds.packing.options import PackOptions
from mp4ds.records import Message
from recordings import write_mcap

CAMERAS = ("cups", "lane", "cars")


def main() -> None:
    """Measure and print."""
    parser = parser_of(__doc__)
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--size", type=parse_size, default=(320, 240), help="WxH")
    parser.add_argument("--samples", type=int, default=100)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--quality", nargs="+", default=["lossless", "visual"], help="of the small")
    parser.add_argument(
        "--folder", type=Path, default=Path(tempfile.gettempdir()) / "mp4ds-smaller"
    )
    options = parser.parse_args()
    check_data()
    print_machine()
    options.folder.mkdir(parents=True, exist_ok=True)
    recording, full = options.folder / "drive.mcap", options.folder / "full"
    if not recording.exists():
        record(recording, options)
    datasets = {"full size": full}
    if not full.exists():
        mp4ds.pack(recording, full)
    costs = {}
    for quality in options.quality:
        name = f"{options.size[0]}x{options.size[1]}, {quality}"
        datasets[name] = options.folder / f"small-{quality}"
        start = cpu_seconds()
        small = PackOptions(resize=options.size, quality=quality, force=True, jobs=1)
        mp4ds.pack(full, datasets[name], small)
        costs[name] = f"{cpu_seconds() - start:.0f}"
    cells: dict[str, list[float]] = {name: [] for name in datasets}
    for seed in range(options.rounds):
        for name, path in datasets.items():
            cells[name].append(isolated(sample_ms, path, options.size, options.samples, seed))
    print_table(
        ("dataset", "MB", "CPU ms a sample", "CPU s to make it"),
        (
            (name, f"{size_of(path) / 1e6:.1f}", f"{median(cells[name]):.1f}", costs.get(name, ""))
            for name, path in datasets.items()
        ),
    )


def record(path: Path, options: argparse.Namespace) -> None:
    """Write a recording of all cameras."""
    parts = []
    for scene in CAMERAS:
        parts.append(path.with_name(f"{scene}.mcap"))
        frames = make(ClipSpec(scene, "rgb8", "low", options.frames))
        write_mcap(parts[-1], frames, "rgb8", compression="lz4")
    with McapWriter(path, profile="ros2", compression="lz4") as writer:
        for scene, part in zip(CAMERAS, parts, strict=True):
            with open_reader(part) as reader:
                for message in messages_of(reader, scene):
                    writer.add_channel(message.channel)
                    writer.write(message)
            part.unlink()


def messages_of(reader: Any, scene: str) -> Iterator[Message]:
    """The messages of a camera, on topics of its own."""
    for record in reader.records():
        if isinstance(record, Message):
            topic = record.channel.topic.replace("/camera", f"/{scene}")
            own = CAMERAS.index(scene) * 100 + record.channel.id
            yield with_own_payload(record.of_channel(replace(record.channel, id=own, topic=topic)))


def sample_ms(path: Path, size: tuple[int, int], samples: int, seed: int) -> float:
    """CPU milliseconds of a random sample of all cameras."""
    from mp4ds.torch import FrameDataset

    frames = FrameDataset(path, resize=size, sync_tolerance_ns=20_000_000)
    numbers = np.random.default_rng(seed).permutation(len(frames))[:samples].tolist()
    frames[numbers[0]]  # with what is loaded when the first frame is read
    start = cpu_seconds()
    for number in numbers:
        sample = frames[number]
        if any(tuple(sample[topic].shape[1:]) != size[::-1] for topic in frames.topics):
            raise ValueError(f"{path} gives another size")
    return 1000 * (cpu_seconds() - start) / len(numbers)


if __name__ == "__main__":
    main()
