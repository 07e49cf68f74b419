"""A slice of a long recording: what is read, the time it takes, and whether it is the same.

    python benchmarks/slices.py [--minutes 10] [--seconds 10] [--remote] [--work FOLDER]

A camera of 320x240 mono8 at 15 Hz with its calibrations, written as a ROS 1 bag, a rosbag2 folder
and an MCAP by rosbags and mcap, and packed once as a dataset. The slice is taken from the middle,
by `pack` and of the dataset also by `unpack`, each in a new process that has imported all it needs;
bytes read are those of its read calls (Linux). With `--remote` it is taken of `s3://`, of a server
on this machine, and the bytes are those asked for; its times are mostly the server's own, which
handles the whole file for each range.
`tools/compare.py` then compares what comes back with the same span of the source.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import s3fs

from measure import parser_of, print_machine, print_table, python, size_of
from recordings import START_NS, write_bag, write_mcap
from remote_servers import BUCKET, s3_server

ROOT = Path(__file__).parents[1]
HERTZ = 15.0
_PROGRAM = """
import json, pathlib, sys, time
import mp4ds
from mp4ds.packing.options import PackOptions
from mp4ds.unpacking.unpack import UnpackOptions
source, small, target, to, start, duration = sys.argv[1:]
span = {"start": start, "duration": duration}
def run(source, target, **options):
    if to:
        mp4ds.unpack(source, to, target, UnpackOptions(**options))
    else:
        mp4ds.pack(source, target, PackOptions(**options))
def read():
    return int(pathlib.Path("/proc/self/io").read_text().split()[1])
run(small, target + ".warm")  # imports all
bytes_before, begun, used = read(), time.perf_counter(), time.process_time()
run(source, target, **span)
print(json.dumps([time.perf_counter() - begun, time.process_time() - used, read() - bytes_before]))
"""


def frames(count: int) -> Iterator[NDArray[np.uint8]]:
    """A gradient that moves, with noise."""
    rng = np.random.default_rng(1)
    ramp = np.add.outer(np.arange(240), np.arange(320 + count))
    noise = rng.integers(0, 6, (240, 640), np.uint8)
    for number in range(count):
        at = int(rng.integers(0, 320))
        moved = (ramp[:, number : number + 320] // 3 % 240).astype(np.uint8)
        yield moved + noise[:, at : at + 320]


def is_equal(source: Path, dataset: Path, to: str, work: Path, span: tuple[int, int]) -> str:
    """What `tools/compare.py` says of the slice."""
    output = dataset
    if not to:
        output = work / ("again" + source.suffix)
        python("-m", "mp4ds", "-q", "unpack", dataset, "-o", output, "--force")
    command = [sys.executable, str(ROOT / "tools" / "compare.py"), source, output]
    command += ["--start", str(span[0]), "--end", str(span[1])]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.stdout.splitlines()[-1]


def main() -> None:
    """Run the command line."""
    parser = parser_of(__doc__)
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--seconds", type=float, default=10)
    parser.add_argument("--remote", action="store_true")
    parser.add_argument("--work", type=Path)
    options = parser.parse_args()
    print_machine()
    with tempfile.TemporaryDirectory(dir=options.work) as place:
        table = lines(Path(place), options.minutes * 60, options.seconds, is_remote=options.remote)
        print_table(["", "of", "s", "CPU s", "read", "compared"], table)


def lines(work: Path, length: float, duration: float, *, is_remote: bool) -> Iterator[list[object]]:
    """Make the recordings, and give the lines of the table."""
    count = round(length * HERTZ)
    start = length / 2
    first = START_NS + round(start * 1e9)
    span = first, first + round(duration * 1e9)
    bag, mcap, dataset = work / "drive.bag", work / "drive.mcap", work / "dataset"
    write_bag(bag, frames(count), "mono8", hertz=HERTZ)
    write_mcap(mcap, frames(count), "mono8", compression="zstd", hertz=HERTZ)
    python("-m", "rosbags.convert", "--src", bag, "--dst", work / "rosbag2")
    write_bag(work / "small.bag", frames(8), "mono8", hertz=HERTZ)
    for source, target in ((bag, dataset), (work / "small.bag", work / "small")):
        python("-m", "mp4ds", "-q", "pack", source, "-o", target)
    rows = [
        ("pack", "bag", bag, bag, ""),
        ("pack", "MCAP, zstd", mcap, mcap, ""),
        ("pack", "rosbag2, sqlite3", work / "rosbag2", work / "rosbag2", ""),
        ("pack", "dataset", dataset, bag, ""),
        ("unpack", "dataset", dataset, bag, "bag"),
    ]
    with s3_server() as server:
        os.environ |= {
            "AWS_ENDPOINT_URL": server.url,
            "AWS_ACCESS_KEY_ID": "a",
            "AWS_SECRET_ACCESS_KEY": "b",
            "AWS_DEFAULT_REGION": "us-east-1",
        }
        files = s3fs.S3FileSystem(use_listings_cache=False)
        if not files.exists(BUCKET):
            files.mkdir(BUCKET)
        for number, (command, what, source, recorded, to) in enumerate(rows):
            url = f"s3://{BUCKET}/{number}/{source.name}"
            if is_remote:
                files.put(str(source), url, recursive=source.is_dir())
            server.forget()
            target = work / f"out{number}{'.bag' if to else ''}"
            small = work / ("small" if source is dataset else "small.bag")
            where = url if is_remote else str(source)
            begin = f"{first // 10**9}.{first % 10**9:09d}"
            told = python("-c", _PROGRAM, where, small, target, to, begin, duration).output
            wall, cpu, read = json.loads(told)
            if is_remote:
                asked = [item.span for item in server.requests if item.method == "GET"]
                read = sum(min(s[1] + 1, size_of(source)) - s[0] for s in asked if s)
                files.rm(url, recursive=True)
            result = is_equal(recorded, target, to, work, span)
            share = f"{read / 1e6:.1f} MB of {size_of(source) / 1e6:.0f}"
            yield [command, what, f"{wall:.1f}", f"{cpu:.1f}", share, result]


if __name__ == "__main__":
    main()
