"""How long opening takes: ``loader.py open``.

A dataset of a long recording (two hours at 60 Hz of eleven cameras: the frames are tiny, times are
jittered and digests are real in form), and a folder of many short datasets. Measured is a Python
process of its own, from its start to its end, that imports, opens, and gets

- the stamps of the first camera, or the first dataset;
- all stamps of all;
- one frame, the first, or one in the middle.

The last rows are processes that only import. With ``--cold`` the system's cache is
told to forget the files before each.

The long dataset is a short one that was packed, with its videos repeated by copying packets, and
its sidecars and manifest made anew for them.
"""

from __future__ import annotations

import argparse
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from loader_clips import HERTZ, write_cameras
from measure import Run, print_table, python, spread
from recordings import times

SIDE = 16
_SHORT = 4320  # frames of what is packed; each video is repeated


def options(parser: argparse.ArgumentParser) -> None:
    """What can be chosen."""
    parser.add_argument("--streams", type=int, default=11)
    parser.add_argument("--frames", type=int, default=432_000, help="of each stream")
    parser.add_argument("--datasets", type=int, default=500)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--cold", action="store_true", help="files are not in the system's cache")


TASKS = {
    "first stamps": "first_stamps",
    "all stamps": "all_stamps",
    "first frame": "first_frame",
    "middle frame": "middle_frame",
}
_CODE = """
import pathlib, sys
import mp4ds
mp4ds.open
task, *paths = sys.argv[1:]
if task == "many":
    task, root = paths
    paths = sorted(pathlib.Path(root).iterdir())
opened = [mp4ds.open(path) for path in paths if task != "torch"]
streams = [stream for dataset in opened for stream in dataset]
if task == "first_stamps":
    found = streams[0].stamps[0]
elif task == "all_stamps":
    found = sum(len(stream.stamps) for stream in streams)
elif task == "first_frame":
    found = streams[0][0].data.shape
elif task == "middle_frame":
    found = streams[-1][len(streams[-1]) // 2].data.shape
elif task == "torch":
    from mp4ds.torch import FrameDataset
    found = paths and len(FrameDataset(paths, sync_tolerance_ns=10**7))
lines = pathlib.Path("/proc/self/status").read_text().splitlines()
print(next(line.split()[1] for line in lines if line.startswith("VmHWM")))
"""


def run(chosen: argparse.Namespace) -> None:
    """Measure and print."""
    folder = chosen.folder / "open"
    folder.mkdir(exist_ok=True)
    long = long_dataset(folder, chosen.streams, chosen.frames)
    many = many_datasets(folder, chosen.datasets)
    sizes = (_megabytes(long), _megabytes(many))
    print(f"- {chosen.streams} streams of {chosen.frames} frames: {sizes[0]:.0f} MB")
    print(f"- {chosen.datasets} datasets of two cameras: {sizes[1]:.0f} MB")
    print(f"- files in the system's cache: {'no' if chosen.cold else 'yes'}", flush=True)
    rows: dict[tuple[str, str], list[str]] = {}
    for text, task in TASKS.items():
        rows["long", text] = [task, os.fspath(long)]
    for text, task in TASKS.items():
        rows["many", text] = ["many", task, os.fspath(many)]
    if _has_torch():
        rows["many", "mp4ds.torch.FrameDataset"] = ["many", "torch", os.fspath(many)]
        rows["nothing", "import mp4ds.torch"] = ["torch"]
    rows["nothing", "import mp4ds.open"] = ["import"]
    header = ("opened", "to", "CPU s", "s", "largest memory, MB")
    print_table(header, _measured(rows, chosen.rounds, folder if chosen.cold else None))


def _measured(
    rows: dict[tuple[str, str], list[str]], rounds: int, cold: Path | None
) -> Iterator[tuple[object, ...]]:
    runs: dict[tuple[str, str], list[Run]] = {row: [] for row in rows}
    for number in range(rounds + 1):
        for row, arguments in rows.items():
            if cold:
                _forget(cold)
            run = python("-c", _CODE, *arguments)
            if number:  # the first one fills caches and compiles
                runs[row].append(run)
    for (opened, text), found in runs.items():
        peaks = [int(each.output) / 1024 for each in found]
        cpu, wall = [each.cpu for each in found], [each.wall for each in found]
        yield opened, text, spread(cpu), spread(wall), f"{median(peaks):.0f}"


def _has_torch() -> bool:
    from importlib.util import find_spec

    return find_spec("torch") is not None and find_spec("mp4ds.torch") is not None


def _forget(folder: Path) -> None:
    """Let the system drop the files from its cache."""
    for path in folder.rglob("*"):
        if path.is_file():
            descriptor = os.open(path, os.O_RDONLY)
            os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
            os.close(descriptor)


def _megabytes(folder: Path) -> float:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6


# ---------------------------------------------------------------- making


def short_dataset(folder: Path, streams: int, frames: int) -> Path:
    """A small dataset of tiny images."""
    import mp4ds

    path = folder / f"short-{streams}x{frames}"
    if not path.exists():
        ramp = np.arange(SIDE * SIDE, dtype=np.uint8).reshape(SIDE, SIDE)
        cameras = {
            f"/camera{number}/image_raw": [ramp + np.uint8(i % 200) for i in range(frames)]
            for number in range(streams)
        }
        recording = folder / "recording.mcap"
        write_cameras(recording, dict(cameras), "mono8")
        mp4ds.pack(recording, path, mp4ds.PackOptions(codec="h264", window=2 * _SHORT))
        recording.unlink()
    return path


def many_datasets(folder: Path, count: int) -> Path:
    """A folder of copies of a short dataset."""
    short = short_dataset(folder, 2, 10 * HERTZ)
    many = folder / f"many-{count}"
    if not many.exists():
        part = folder / f"many-{count}.part"
        for number in range(count):
            shutil.copytree(short, part / f"{number:05}", dirs_exist_ok=True)
        part.rename(many)
    return many


def long_dataset(folder: Path, streams: int, frames: int) -> Path:
    """A dataset of many frames."""
    from mp4ds.format.sidecars import MANIFEST_NAME, load_manifest

    long = folder / f"long-{streams}x{frames}"
    if long.exists():
        return long
    short = short_dataset(folder, streams, _SHORT)
    part = folder / f"{long.name}.part"
    shutil.rmtree(part, ignore_errors=True)
    shutil.copytree(short, part)
    manifest = load_manifest(short / MANIFEST_NAME)
    entries = [
        lengthen(part / entry.sidecar, frames, number)
        for number, entry in enumerate(manifest.streams)
    ]
    _write_manifest(part, manifest, entries)
    part.rename(long)
    return long


def lengthen(path: Path, frames: int, number: int) -> Any:
    """Let a stream have more frames: its video repeated, its columns made anew.

    Args:
        path: The sidecar.
        frames: How many it gets.
        number: Of the stream, for other jitter in each.
    """
    from mp4ds.format.sidecars import load_stream

    sidecar = load_stream(path)
    video = path.parent / sidecar.video.file
    stamps, log_times = times(frames + number, 60.0)
    stamps, log_times = stamps[:frames], log_times[:frames]
    _repeat(video, sidecar.frames, stamps, log_times)
    longer = sidecar.model_copy(
        update={
            "frames": frames,
            "video": _with_digest(sidecar.video, video),
            "columns": _columns(stamps, log_times),
            "digests": _digests(frames, number),
        }
    )
    _dump(longer, path)
    return longer


def _repeat(video: Path, count: int, stamps: Any, log_times: Any) -> None:
    from mp4ds.times import PresentationClock
    from mp4ds.video.packets import join_segments

    frames = len(stamps)
    if frames % count:
        raise SystemExit(f"--frames: give a multiple of {count}")
    clock = PresentationClock()
    ticks = map(clock.tick, stamps.tolist(), log_times.tolist())
    longer = video.with_suffix(".long.mp4")
    join_segments([video] * (frames // count), ticks, longer)
    longer.rename(video)


def _columns(stamps: Any, log_times: Any) -> Any:
    from mp4ds.dataset.rebuild import columns_model

    published = stamps + np.random.default_rng(1).integers(500_000, 1_500_000, len(stamps))
    numbers = np.arange(len(stamps))
    return columns_model(
        {
            "log_time": log_times,
            "publish_time": published,
            "sequence": numbers,
            "stamp": stamps,
            "variant": np.zeros_like(numbers),
            "ordinal": numbers,
        }
    )


def _digests(count: int, seed: int) -> Any:
    from mp4ds.format.fields import Digests

    words = np.random.default_rng(seed).integers(0, 2**63, count)
    text = words.astype(">u8").tobytes().hex()
    width = 12 * 16
    lines = [
        " ".join(text[i : i + 16] for i in range(start, min(start + width, len(text)), 16))
        for start in range(0, len(text), width)
    ]
    return Digests(algorithm="xxh64", values="\n".join(lines) + "\n")


def _with_digest(video: Any, path: Path) -> Any:
    from mp4ds.files.outputs import digest_file

    size, sha256 = digest_file(path)
    return video.model_copy(update={"size": size, "sha256": sha256})


def _write_manifest(folder: Path, manifest: Any, sidecars: list[Any]) -> None:
    from mp4ds.files.outputs import digest_file
    from mp4ds.format.sidecars import MANIFEST_NAME

    frames = sidecars[0].frames
    files = []
    for entry in manifest.files:
        size, sha256 = digest_file(folder / entry.name)
        files.append(entry.model_copy(update={"size": size, "sha256": sha256}))
    streams = [entry.model_copy(update={"frames": frames}) for entry in manifest.streams]
    changed = {"files": files, "streams": streams, "messages": frames * len(streams)}
    _dump(manifest.model_copy(update=changed), folder / MANIFEST_NAME)


def _dump(model: Any, path: Path) -> None:
    from mp4ds.format.sidecars import dump_document

    path.write_bytes(dump_document(model))
