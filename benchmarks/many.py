"""Many datasets at once: what the table, the validation, the page and the loader of a folder cost.

    python benchmarks/many.py [--datasets 500] [--work FOLDER]

The datasets are copies of one, of two cameras and 3 s, each with its own manifest. Time is on the
clock; CPU time and the peak of resident memory are those of the largest process of a command.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from measure import print_machine, print_table

COMMANDS = (
    ("info FOLDER",),
    ("validate FOLDER", "--jobs", "1"),
    ("validate FOLDER",),
    ("validate FOLDER", "--deep"),
    ("report FOLDER",),
)
_LOADER = """
import sys, time
from mp4ds.torch import FrameDataset
import random
data = FrameDataset(sys.argv[1], topics=["/left/image_raw"])
random.seed(0)
for number in random.sample(range(len(data)), 200):
    data[number]
"""


def measured(command: list[str]) -> tuple[float, float, float]:
    """Seconds on the clock, CPU seconds with all children, and MB of the largest process."""
    begun = time.perf_counter()
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"failed with exit code {process.returncode}: {' '.join(command)}")
    return (
        time.perf_counter() - begun,
        usage.ru_utime + usage.ru_stime,
        usage.ru_maxrss / 1024,
    )


def rows(folder: Path) -> Iterator[list[object]]:
    """A row for each command."""
    for words, *options in COMMANDS:
        name = words.split()[0]
        command = [sys.executable, "-m", "mp4ds", name, str(folder), *options]
        wall, cpu, memory = measured(command)
        told = " ".join([f"mp4ds {words}", *options])
        yield [told, f"{wall:.1f}", f"{cpu:.1f}", f"{memory:.0f}"]
    wall, cpu, memory = measured([sys.executable, "-c", _LOADER, str(folder)])
    yield ["FrameDataset(FOLDER), 200 frames", f"{wall:.1f}", f"{cpu:.1f}", f"{memory:.0f}"]


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--datasets", type=int, default=500)
    parser.add_argument("--work", type=Path)
    options = parser.parse_args()
    print_machine()
    with tempfile.TemporaryDirectory(dir=options.work) as place:
        work, folder = Path(place), Path(place) / "drives"
        for words in (("demo", "demo.bag"), ("pack", "demo.bag", "-o", "one")):
            command = [sys.executable, "-m", "mp4ds", *words]
            subprocess.run(command, cwd=work, check=True, stdout=subprocess.DEVNULL)
        for number in range(options.datasets):
            shutil.copytree(work / "one", folder / f"drive-{number:03d}")
        print_table(["command", "s", "CPU s", "MB"], rows(folder))


if __name__ == "__main__":
    main()
