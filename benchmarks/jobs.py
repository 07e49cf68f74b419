"""What packing in parts costs and gains, is killed and resumed with, and takes of memory.

    python benchmarks/jobs.py [--frames N] [--window N] [--jobs N] [--work FOLDER]

One recording of a Bayer camera, 1280x720 at 30 Hz, is packed by `mp4ds pack` in several ways: in
one pass; in parts, by one process and by several; the same, ended by ``kill -9`` when half of the
parts are there, and resumed. Time on the clock and CPU time are those of all processes, with their
start; of one that is resumed, of both runs. Memory is asked for every 20 ms: shared pages are
counted in every process that has them, so the sums are above what is taken. Every way in parts has
to make the same videos, byte for byte.
"""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
from numpy.typing import NDArray

from measure import parser_of, print_machine, print_table, size_of
from recordings import write_bag

WIDTH, HEIGHT = 1280, 720
_POLL_SECONDS = 0.02


def sensor(frames: int) -> Iterator[NDArray[np.uint8]]:
    """A moving scene with sensor noise, which repeats after 16 frames."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:HEIGHT, : 2 * WIDTH]
    scene = 110 + 60 * np.sin(x / 37) * np.cos(y / 23) + 30 * (((x // 64) + (y // 48)) % 2)
    noise = rng.normal(0, 2.5, (16, HEIGHT, WIDTH)).astype(np.float32)
    for number in range(frames):
        shift = number * 3 % WIDTH
        frame = scene[:, shift : shift + WIDTH] + noise[number % 16]
        yield np.clip(frame, 0, 255).astype(np.uint8)


def run(source: Path, target: Path, options: list[str], until: int = 0) -> tuple[float, float, int]:
    """Pack, and end it when so many parts are there.

    Returns:
        Seconds on the clock, CPU seconds, and the largest sum of resident bytes.
    """
    begun = time.perf_counter()
    command = [sys.executable, "-m", "mp4ds", "-q", "pack", source, "-o", target, *options]
    process = subprocess.Popen(list(map(str, command)), start_new_session=True)
    root, cpu, peak = psutil.Process(process.pid), {}, 0
    parts = target.with_name(f".{target.name}.mp4ds-part")
    while process.poll() is None:
        resident = 0
        try:
            for each in (root, *root.children(recursive=True)):
                cpu[each.pid] = sum(each.cpu_times()[:2])
                resident += each.memory_info().rss
        except psutil.Error:  # it has just ended
            pass
        peak = max(peak, resident)
        if until and len(list(parts.glob("0*/dataset.yaml"))) >= until:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            break
        time.sleep(_POLL_SECONDS)
    if process.returncode not in (0, -signal.SIGKILL if until else 0):
        raise SystemExit(f"packing failed with exit code {process.returncode}")
    return time.perf_counter() - begun, sum(cpu.values()), peak


def digest(dataset: Path) -> str:
    """Of the videos."""
    videos = sorted(dataset.glob("*.mp4"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in videos)).hexdigest()


def main() -> None:
    """Measure and print."""
    parser = parser_of(__doc__)
    parser.add_argument("--frames", type=int, default=1500)
    parser.add_argument("--window", type=int, default=75, help="frames of a part")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--work", type=Path, help="where the recording is made")
    chosen = parser.parse_args()
    print_machine()
    with tempfile.TemporaryDirectory(prefix="mp4ds-benchmark-", dir=chosen.work) as name:
        source = Path(name) / "drive.bag"
        write_bag(source, sensor(chosen.frames), "bayer_rggb8")
        print(
            f"- {chosen.frames} frames of {WIDTH}x{HEIGHT} bayer_rggb8, "
            f"{size_of(source) / 1e9:.2f} GB; parts of {chosen.window} frames"
        )
        half = -(-chosen.frames // chosen.window) // 2
        in_parts = ["--window", str(chosen.window), "--jobs"]
        several = [*in_parts, str(chosen.jobs)]
        ways = [
            ("in one pass", ["--window", "10000000"], 0),
            ("in parts, 1 process", [*in_parts, "1"], 0),
            (f"in parts, {chosen.jobs} processes", several, 0),
            ("the same, killed at half of the parts and resumed", several, half),
        ]
        header = ("packed", "clock s", "CPU s, all", "peak of all, MB", "videos")
        print_table(header, rows(source, ways))


def rows(source: Path, told: list[tuple[str, list[str], int]]) -> Iterator[tuple[object, ...]]:
    """One for each way."""
    first = ""
    for number, (name, options, until) in enumerate(told):
        target = source.with_name(f"dataset{number}")
        runs = [run(source, target, options, until)] if until else []
        runs.append(run(source, target, options))
        wall, cpu, peak = zip(*runs, strict=True)
        made = "" if name == "in one pass" else digest(target)
        first = first or made
        same = "the same" if made == first else "DIFFER"
        yield name, f"{sum(wall):.1f}", f"{sum(cpu):.1f}", f"{max(peak) / 1e6:.0f}", made and same


if __name__ == "__main__":
    main()
