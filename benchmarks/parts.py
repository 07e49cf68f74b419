"""What packing in parts costs, gains and takes: time by workers, memory by length.

    python benchmarks/parts.py workers [--frames N] [--window N] [--jobs N ...]
    python benchmarks/parts.py length [--gigabytes SHORT LONG]

``workers`` packs one recording in one pass and in parts by 1 to N processes, and tells for each the
time on the clock, the CPU time of all, and that of the coordinator alone. The tasks' recorded times
are then dealt out to up to 64 workers as the engine deals them, with the planning before and the
joining after, which are done by one process: what the division allows, given machines that do not
slow each other down.

``length`` packs a short and a long recording of the same camera and compares the peaks of resident
memory, of all processes together. It asks the system for what is resident every 20 ms: shared pages
are counted in every process that has them, so the sums are above what is taken.
"""

from __future__ import annotations

import argparse
import heapq
import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore

from measure import print_machine, print_table
from recordings import START_NS

HERTZ = 30.0
SIMULATED = (1, 2, 4, 8, 16, 32, 64)
_IMAGE = "sensor_msgs/msg/Image"
_POLL_SECONDS = 0.02


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    workers = commands.add_parser("workers")
    workers.add_argument("--frames", type=int, default=2400)
    workers.add_argument("--window", type=int, default=100)
    workers.add_argument("--jobs", type=int, nargs="+", default=[1, 2])
    length = commands.add_parser("length")
    length.add_argument("--gigabytes", type=float, nargs=2, default=(1.0, 8.0))
    child = commands.add_parser("child")
    child.add_argument("arguments")
    options = parser.parse_args()
    if options.command == "child":
        print(json.dumps(_pack(**json.loads(options.arguments))))
        return
    print_machine()
    with tempfile.TemporaryDirectory(prefix="mp4ds-benchmark-") as folder:
        if options.command == "workers":
            compare_workers(Path(folder), options)
        else:
            compare_lengths(Path(folder), options)


# ---------------------------------------------------------------- recordings


def sensor(width: int, height: int, seed: int) -> Iterator[NDArray[np.uint8]]:
    """Bayer frames of a moving scene with sensor noise; the noise repeats after 16 frames."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, : 2 * width]
    scene = 110 + 60 * np.sin(x / 37) * np.cos(y / 23) + 30 * (((x // 64) + (y // 48)) % 2)
    noise = rng.normal(0, 2.5, (16, height, width)).astype(np.float32)
    number = 0
    while True:
        shift = number * 3 % width
        frame = scene[:, shift : shift + width] + noise[number % 16]
        yield np.clip(frame, 0, 255).astype(np.uint8)
        number += 1


def write_recording(path: Path, *, cameras: int, frames: int, width: int, height: int) -> int:
    """A ROS 1 bag; returns its bytes."""
    store = get_typestore(Stores.ROS1_NOETIC)
    make_image, make_header, make_time = (
        store.types[name] for name in (_IMAGE, "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    sources = [sensor(width, height, seed) for seed in range(cameras)]
    with BagWriter(path) as bag:
        topics = [f"/camera{n}/image_raw" for n in range(cameras)]
        connections = [bag.add_connection(topic, _IMAGE, typestore=store) for topic in topics]
        for number in range(frames):
            for camera, (source, connection) in enumerate(zip(sources, connections, strict=True)):
                stamp = START_NS + int(number * 1e9 / HERTZ) + camera * 1000
                header = make_header(number, make_time(*divmod(stamp, 10**9)), f"camera{camera}")
                pixels = next(source)
                image = make_image(
                    header, height, width, "bayer_rggb8", 0, width, pixels.reshape(-1)
                )
                bag.write(connection, stamp + 3_000_000, store.serialize_ros1(image, _IMAGE))
    return path.stat().st_size


# ---------------------------------------------------------------- packing, in a child


def _pack(source: str, target: str, **options: Any) -> dict[str, Any]:
    """Pack, and tell what each task and the phases took."""
    import mp4ds
    from mp4ds.packing import pack
    from mp4ds.packing.engine import Outcome, ProcessEngine

    tasks: list[dict[str, Any]] = []
    marks = {"begin": time.monotonic()}

    class Recorded(ProcessEngine):
        def run(self, *arguments: Any) -> Iterator[Outcome]:
            marks["planned"] = time.monotonic()
            for outcome in super().run(*arguments):
                tasks.append({"name": outcome.task[1], **outcome.facts})
                marks["packed"] = time.monotonic()
                yield outcome

    pack.ProcessEngine = Recorded  # type: ignore[attr-defined,misc]
    mp4ds.pack(source, target, mp4ds.PackOptions(**options))
    marks["end"] = time.monotonic()
    own, children = (
        sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    return {"marks": marks, "tasks": tasks, "own_cpu": own, "children_cpu": children}


def run_pack(source: Path, target: Path, **options: Any) -> dict[str, Any]:
    """Pack in a process of its own and watch the memory of it and its children."""
    arguments = json.dumps({"source": str(source), "target": str(target), **options})
    process = subprocess.Popen(
        [sys.executable, __file__, "child", arguments], stdout=subprocess.PIPE, text=True
    )
    peak = 0
    root = psutil.Process(process.pid)
    while process.poll() is None:
        peak = max(peak, _resident(root))
        time.sleep(_POLL_SECONDS)
    output = process.stdout.read() if process.stdout else ""
    if process.returncode:
        raise SystemExit(f"packing failed with exit code {process.returncode}")
    return {**json.loads(output.splitlines()[-1]), "peak": peak}


def _resident(root: psutil.Process) -> int:
    total = 0
    try:
        for process in (root, *root.children(recursive=True)):
            try:
                total += process.memory_info().rss
            except psutil.Error:
                continue
    except psutil.Error:
        pass
    return total


# ---------------------------------------------------------------- what is compared


def compare_workers(folder: Path, options: argparse.Namespace) -> None:
    """Time by the number of workers."""
    source = folder / "drive.bag"
    size = write_recording(source, cameras=1, frames=options.frames, width=1280, height=720)
    print(f"- recording: {options.frames} frames of 1280x720 bayer_rggb8, {size / 1e9:.2f} GB")
    print(f"- window: {options.window} frames\n")
    rows, last = [], {}
    for jobs in (None, *options.jobs):
        in_parts = {"jobs": jobs, "window": options.window} if jobs else {"window": 10**7}
        done = run_pack(source, folder / f"dataset-{jobs}", **in_parts)
        marks = done["marks"]
        wall = marks["end"] - marks["begin"]
        total = done["own_cpu"] + done["children_cpu"]
        parts = [task for task in done["tasks"] if not task["name"].startswith("source")]
        name = f"{jobs} processes" if jobs else "in one pass"
        coordinator = f"{1000 * done['own_cpu'] / len(parts):.0f}" if parts else ""
        rows.append((name, len(parts), f"{wall:.1f}", f"{total:.1f}", coordinator))
        if jobs == 1:
            last = done
    print_table(("packed", "parts", "clock s", "CPU s, all", "coordinator, CPU ms a part"), rows)
    if last:
        print()
        simulate(last)


def simulate(done: dict[str, Any]) -> None:
    """Deal the recorded tasks out to more workers, in their order."""
    marks = done["marks"]
    before, after = marks["planned"] - marks["begin"], marks["end"] - marks["packed"]
    seconds = [task["seconds"] for task in done["tasks"]]
    alone = before + after + sum(seconds)
    rows = []
    for copies, title in ((1, "this recording"), (20, "20 times as long")):
        for workers in SIMULATED:
            span = before * copies + after * copies + _makespan(seconds * copies, workers)
            rows.append((title, workers, f"{span:.1f}", f"{alone * copies / span:.1f}"))
    print_table(("simulated", "workers", "clock s", "times as fast"), rows)
    print(f"\nplanning {before:.2f} s, joining {after:.2f} s, {len(seconds)} tasks")


def _makespan(seconds: Sequence[float], workers: int) -> float:
    free = [0.0] * workers
    for duration in seconds:
        heapq.heapreplace(free, free[0] + duration)
    return max(free)


def compare_lengths(folder: Path, options: argparse.Namespace) -> None:
    """Peak memory by the length of the recording."""
    width, height = 1280, 720
    rows, peaks = [], []
    for gigabytes in options.gigabytes:
        source = folder / "drive.bag"
        frames = int(gigabytes * 1e9 / (width * height))
        size = write_recording(source, cameras=1, frames=frames, width=width, height=height)
        done = run_pack(source, folder / "dataset")
        wall = done["marks"]["end"] - done["marks"]["begin"]
        peaks.append(done["peak"])
        largest = max((task.get("peak_bytes", 0) for task in done["tasks"]), default=0)
        rows.append(
            (f"{size / 1e9:.2f} GB", frames, len(done["tasks"]), f"{wall:.0f}",
             f"{done['peak'] / 1e6:.0f}", f"{largest / 1e6:.0f}")
        )  # fmt: skip
        _remove(folder)
    print()
    print_table(
        ("recording", "frames", "tasks", "clock s", "peak of all, MB", "of the largest task"), rows
    )
    print(f"\nlong / short: {peaks[1] / peaks[0]:.3f}")


def _remove(folder: Path) -> None:
    for path in folder.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()


if __name__ == "__main__":
    main()
