"""What packing costs on top of encoding, and how much memory it takes.

    python benchmarks/pack.py [--frames N] [--size WxH] [--rounds N] [--memory]

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

import os
import shutil
import tempfile
from collections.abc import Iterator
from fractions import Fraction
from itertools import cycle, islice
from pathlib import Path
from statistics import median

import av
import numpy as np

import clips
import mp4ds
from measure import (
    cpu_seconds,
    isolated,
    parse_size,
    parser_of,
    print_machine,
    print_table,
    python,
    size_of,
    spread,
)
from mp4ds.messages.encodings import ENCODINGS, NO_PARAMETERS
from mp4ds.messages.layouts import bind
from mp4ds.video.pixels import PictureConverter, picture_to_frame
from recordings import HERTZ, image_size, write_bag, write_mcap

EMPTY = "import mp4ds; mp4ds.pack"
PACK = """
import sys, mp4ds
mp4ds.pack(sys.argv[1], sys.argv[2])
status = open("/proc/self/status").read()
print(status.partition("VmHWM:")[2].split()[0])
"""
"""Packs, and prints the peak of resident memory, kB. A process's ru_maxrss is no good: it begins
with what its parent had."""


def main() -> None:
    """Measure and print."""
    parser = parser_of(__doc__)
    parser.add_argument("--frames", type=int, default=240)
    parser.add_argument("--size", type=parse_size, default=(1280, 720), help="WxH")
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
            spec, *_ = clips.specs("bayer_rggb8", options.frames, options.size, ("low",))
            compare_cpu(spec, Path(folder), options.rounds, options.jobs)


def compare_cpu(spec: clips.ClipSpec, folder: Path, rounds: int, jobs: int) -> None:
    """CPU time of pack against the bare encoder's."""
    clip, frames = clips.load(spec), folder / "clip.npy"
    np.save(frames, clip)
    sources = {
        "MCAP, chunks not compressed": folder / "none.mcap",
        "MCAP, zstd chunks": folder / "zstd.mcap",
        "ROS 1 bag": folder / "source.bag",
    }
    for path in sources.values():
        if path.suffix == ".mcap":
            write_mcap(path, clip, spec.encoding, compression=path.stem)
        else:
            write_bag(path, clip, spec.encoding)
    height, width = image_size(clip[0], spec.encoding)
    print(
        f"- clip: {spec.scene}, noise {spec.noise}, {len(clip)} frames of {width}x{height} "
        f"{spec.encoding}; encoder threads: {jobs}"
    )
    reference = folder / "reference"
    mp4ds.pack(sources["ROS 1 bag"], reference, mp4ds.PackOptions(jobs=jobs))
    with mp4ds.open(reference) as dataset:
        video = dataset.streams[0].sidecar.video
    cpu: dict[str, list[float]] = {name: [] for name in (*sources, "bare", "empty")}
    sizes = set()
    for _ in range(rounds):
        cpu["empty"].append(python("-c", EMPTY).cpu)
        for name, source in sources.items():
            # with one camera, the number of jobs is that of the encoder's threads
            encoded = isolated(encode_bare, reference, frames, folder / "bare.mp4", jobs)
            cpu["bare"].append(encoded)
            run, size = pack_once(source, folder / "dataset", jobs)
            cpu[name].append(run)
            sizes.add((size, size_of(folder / "bare.mp4")))
    print(f"- layout and codec: {video.layout} {video.codec}")
    print(f"- bytes of the video (pack, bare encoder): {sorted(sizes)}")
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
    run = python("-m", "mp4ds", "-q", "pack", source, "-o", dataset, "--jobs", jobs)
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
            frames, size = isolated(write_long, source, length)
            run = python("-c", PACK, source, dataset)
            peaks.append(1024 * int(run.output))
            shutil.rmtree(dataset)
            yield (
                f"{length:g} min",
                frames,
                f"{size / 1e6:.0f}",
                f"{peaks[-1] / 1e6:.1f}",
                f"{run.cpu:.1f}",
            )

    print_table(("recording", "frames", "MB", "peak of pack, MB", "CPU s"), rows())
    print(f"\nlong / short: {peaks[1] / peaks[0]:.3f}")


# ---------------------------------------------------------------- in processes of their own


def encode_bare(packed: Path, frames: Path, output: Path, threads: int) -> float:
    """CPU seconds of encoding the same pictures with the same encoder through PyAV alone.

    Loading the frames, laying them out as the stream's picture, converting them to the
    encoder's pixel format and all imports are done before the measurement starts.

    Args:
        packed: What pack made of the clip: tells encoder, options and times.
        frames: The clip as .npy.
        output: The .mp4 to make.
        threads: Of the encoder.
    """
    with mp4ds.open(packed) as dataset:
        (stream,) = dataset.streams
        sidecar, stamps = stream.sidecar, stream.stamps
    video, values = sidecar.video, sidecar.video.parameters
    parameters = values or NO_PARAMETERS
    layout = bind(video.layout, ENCODINGS[sidecar.image.encoding], parameters)
    converter, coded = PictureConverter(), video.pixel_format or layout.pixel_format
    ticks = ((stamps - stamps[0]) // 1000).tolist()
    prepared = []
    for pixels in np.load(frames):
        picture = tuple(np.ascontiguousarray(plane) for plane in layout.to_picture(pixels))
        prepared.append(picture_to_frame(picture, layout.pixel_format, coded, converter))
    time_base = Fraction(1, 1_000_000)
    begun = cpu_seconds()
    scale = str(time_base.denominator)
    options = {"video_track_timescale": scale, "movie_timescale": scale}
    with av.open(str(output), "w", format="mp4", options=options) as container:
        made = container.add_stream(video.encoder, rate=30, options=dict(video.options))
        made.width, made.height = video.width, video.height
        made.pix_fmt = video.pixel_format
        made.time_base = made.codec_context.time_base = time_base
        made.codec_context.thread_count = threads
        for frame, tick in zip(prepared, ticks, strict=True):
            frame.pts, frame.time_base = tick, time_base
            container.mux(made.encode(frame))
        container.mux(made.encode(None))
    return cpu_seconds() - begun


def write_long(path: Path, minutes: float) -> tuple[int, int]:
    """Frames and bytes of a recording of a few noisy frames over and over, one at a time."""
    (spec,) = clips.specs("bayer_rggb8", 30, (640, 480), ("low",))[:1]
    count = round(minutes * 60 * HERTZ)
    frames = islice(cycle(clips.load(spec)), count)
    write_mcap(path, frames, spec.encoding, compression="none")
    return count, path.stat().st_size


if __name__ == "__main__":
    main()
