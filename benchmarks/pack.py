"""What packing costs on top of encoding, and how much memory it takes.

    python benchmarks/pack.py [--frames N] [--size WxH] [--encoding E] [--rounds N] [--memory]

Bare encoder: the same pictures, in memory and laid out before the measurement starts, given by
PyAV to the same encoder with the same options and threads, and muxed into an mp4. Its figure
holds neither Python's start nor imports nor the making of frames; it is the least that the
coding itself costs. pack's figure holds all it does: Python's start, reading, unpacking chunks,
splitting messages, digests, hashing of source and output, sidecars, manifest. It is given for the
whole process (``mp4ds pack`` on the command line), and without an empty one
(``import mp4ds; mp4ds.pack``). Bare encoder and packs take turns; each round gives one ratio.

``--memory`` instead packs a short and a long recording of the same camera (640x480 Bayer, 30 Hz)
and compares the peaks of resident memory.
"""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from statistics import median

import clips
from measure import job, parse_size, print_machine, print_table, python, spread
from recordings import image_size, write_bag, write_mcap

HERTZ = 30.0
EMPTY = "import mp4ds; mp4ds.pack"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=240)
    parser.add_argument("--size", type=parse_size, default=(1280, 720), help="WxH")
    parser.add_argument("--encoding", choices=clips.CAMERA_FAMILIES, default="bayer_rggb8")
    parser.add_argument("--noise", choices=list(clips.SENSORS), default="low")
    parser.add_argument("--scene", default=None, help="the first that is there by default")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="threads of the encoder")
    parser.add_argument("--memory", action="store_true", help="measure memory instead")
    parser.add_argument("--minutes", type=float, nargs=2, default=(1.0, 4.0), help="for --memory")
    options = parser.parse_args()
    clips.check_data()
    print_machine()
    with tempfile.TemporaryDirectory(prefix="mp4ds-benchmark-") as folder:
        if options.memory:
            compare_memory(Path(folder), options.minutes)
        else:
            specs = clips.specs(options.encoding, options.frames, options.size, (options.noise,))
            wanted = [s for s in specs if options.scene in (None, s.scene)]
            if not wanted:
                raise SystemExit(f"There is no scene {options.scene}: {[s.scene for s in specs]}.")
            compare_cpu(wanted[0], Path(folder), options.rounds, options.jobs)


def compare_cpu(spec: clips.ClipSpec, folder: Path, rounds: int, jobs: int) -> None:
    """CPU time of pack against the bare encoder's."""
    clip = clips.load(spec, folder)
    frames = folder / f"{spec.name}.npy"
    sources = {
        "MCAP, chunks not compressed": folder / "none.mcap",
        "MCAP, zstd chunks": folder / "zstd.mcap",
        "ROS 1 bag": folder / "source.bag",
    }
    for compression in ("none", "zstd"):
        write_mcap(
            folder / f"{compression}.mcap",
            clip,
            len(clip),
            spec.encoding,
            compression=compression,
            hertz=HERTZ,
        )
    write_bag(folder / "source.bag", clip, len(clip), spec.encoding, hertz=HERTZ)
    height, width = image_size(clip[0], spec.encoding)
    print(
        f"- clip: {spec.scene}, noise {spec.noise}, {len(clip)} frames of {width}x{height} "
        f"{spec.encoding}; encoder threads: {jobs}"
    )
    reference = folder / "reference"
    recipe = job("pack", source=sources["ROS 1 bag"], target=reference, jobs=jobs)["recipe"]
    cpu: dict[str, list[float]] = {name: [] for name in (*sources, "bare", "empty")}
    sizes = set()
    for _ in range(rounds):
        cpu["empty"].append(python("-c", EMPTY).cpu)
        for name, source in sources.items():
            # with one camera, the number of jobs is that of the encoder's threads
            encoded = job(
                "bare", dataset=reference, frames=frames, output=folder / "bare.mp4", threads=jobs
            )
            cpu["bare"].append(encoded["cpu"])
            run, size = pack_once(source, folder / "dataset", jobs)
            cpu[name].append(run)
            sizes.add((size, encoded["video"]))
    print(f"- layout and codec: {recipe}; bytes of the video (pack, bare encoder): {sorted(sizes)}")
    print(f"- bare encoder: CPU s {spread(cpu['bare'])}")
    print(f"- empty process (`{EMPTY}`): CPU s {spread(cpu['empty'])}")
    print_table(
        (
            "source",
            "pack, CPU s",
            "whole process / bare",
            "without empty process / bare",
            "ms a frame on top of bare",
        ),
        (ratios(list(sources), name, cpu, len(clip)) for name in sources),
    )


def pack_once(source: Path, dataset: Path, jobs: int) -> tuple[float, int]:
    """CPU seconds of the command, and bytes of the video."""
    run = python(
        "-m", "mp4ds", "pack", str(source), "-o", str(dataset), "--jobs", str(jobs), "--json"
    )
    size = sum(path.stat().st_size for path in dataset.glob("*.mp4"))
    shutil.rmtree(dataset)
    return run.cpu, size


def ratios(
    names: list[str], name: str, cpu: dict[str, list[float]], frames: int
) -> tuple[object, ...]:
    """The row of a source; each of its runs is compared with the bare encoder just before it."""
    bare = cpu["bare"][names.index(name) :: len(names)]
    empty = median(cpu["empty"])
    pairs = list(zip(cpu[name], bare, strict=True))
    return (
        name,
        spread(cpu[name]),
        spread([run / base for run, base in pairs], 3),
        spread([(run - empty) / base for run, base in pairs], 3),
        spread([1000 * (run - empty - base) / frames for run, base in pairs], 1),
    )


def compare_memory(folder: Path, minutes: tuple[float, float]) -> None:
    """Peaks of resident memory of a short and a long recording."""
    peaks: list[int] = []

    def rows() -> Iterator[tuple[object, ...]]:
        for length in minutes:
            source, dataset = folder / "long.mcap", folder / "dataset"
            made = job(
                "write_long", path=source, minutes=length, width=640, height=480, hertz=HERTZ
            )
            packed = job("pack", source=source, target=dataset)
            peaks.append(packed["peak"])
            shutil.rmtree(dataset)
            yield (
                f"{length:g} min",
                made["frames"],
                f"{made['bytes'] / 1e6:.0f}",
                f"{packed['peak'] / 1e6:.1f}",
                f"{packed['cpu']:.1f}",
            )

    print_table(("recording", "frames", "MB", "peak of pack, MB", "CPU s"), rows())
    print(f"\nlong / short: {peaks[1] / peaks[0]:.3f}")


if __name__ == "__main__":
    main()
