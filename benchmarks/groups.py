"""What the distance of key frames costs and gives: bytes of a frame, and frames at random.

    python benchmarks/groups.py [--frames N] [--size WxH] [--gop N ...] [--kind K ...]
    python benchmarks/groups.py --purpose [--frames N] [--size WxH] [--kind K ...] [--clip NAME ...]
    python benchmarks/groups.py --lossy [--frames N] [--size WxH] [--clip NAME ...]

The moving camera of loader_clips.py is packed by `mp4ds.pack`, without loss and for the eye, with
each number of frames from one key frame to the next; then frames at random places are read one by
one. CPU time is of the reading process, opening left out.

``--purpose`` packs real scenes (clips.py) with each ``--for``, and reads them in order, too.

``--lossy`` encodes real scenes (clips.py) as `visual` does, with several presets of SVT-AV1 and
distances of key frames, and two crf. Bytes are compared at equal PSNR of luma, by interpolation of
their logarithm. A frame at random is read in 64x48, so that decoding is what it costs.
"""

from __future__ import annotations

import argparse
import random
import tempfile
import time
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import clips
import mp4ds
import visual
from loader_clips import moving
from measure import cpu_seconds, parse_size, print_machine, print_table
from mp4ds import PackOptions
from mp4ds.video.planes import PlaneMaker, Planes, decoded_planes
from recordings import TOPIC, write_mcap

Pixels = NDArray[Any]


def _mosaic(rgb: Pixels) -> Pixels:
    mosaic = np.ascontiguousarray(rgb[..., 1])
    mosaic[::2, ::2] = rgb[::2, ::2, 0]
    mosaic[1::2, 1::2] = rgb[1::2, 1::2, 2]
    return mosaic


KINDS: dict[str, tuple[str, str, Callable[[Pixels], Pixels]]] = {
    # encoding, quality, and its pixels from those of the clip
    "mono8, lossless": ("mono8", "lossless", lambda rgb: np.ascontiguousarray(rgb[..., 1])),
    "bayer_rggb8, lossless": ("bayer_rggb8", "lossless", _mosaic),
    "rgb8, lossless": ("rgb8", "lossless", lambda rgb: rgb),
    "rgb8, visual": ("rgb8", "visual", lambda rgb: rgb),
}
GOPS = (1, 10, 30, 60, 120, 240)
PURPOSES = (None, "training", "training=40", "archive")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=480)
    parser.add_argument("--size", type=parse_size, default=(640, 480), help="WxH")
    parser.add_argument("--gop", type=int, nargs="+", default=GOPS)
    parser.add_argument("--kind", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--reads", type=int, default=60)
    parser.add_argument("--purpose", action="store_true")
    parser.add_argument("--lossy", action="store_true")
    parser.add_argument(
        "--clip", nargs="+", choices=clips.MOVING, default=["cups", "people", "arm"]
    )
    options = parser.parse_args()
    print_machine()
    if options.lossy:
        lossy(options)
        return
    if options.purpose:
        purposes(options)
        return
    rows = []
    for kind in options.kind:
        with tempfile.TemporaryDirectory(prefix="mp4ds-benchmark-") as folder:
            rows += list(measure(Path(folder), kind, options))
    head = ("images", "key frame every", "bytes a frame", "to 60", "random frames / CPU s", "to 60")
    print_table(head, rows)


def measure(folder: Path, kind: str, options: argparse.Namespace) -> list[tuple[object, ...]]:
    """The rows of one kind of images."""
    encoding, quality, pixels_of = KINDS[kind]
    source = folder / "clip.mcap"
    write_mcap(
        source,
        (pixels_of(rgb) for rgb in moving(options.frames, options.size)),
        options.frames,
        encoding,
        compression="none",
        hertz=30.0,
    )
    found: dict[int, tuple[float, float]] = {}
    for gop in options.gop:
        dataset = folder / f"gop-{gop}"
        mp4ds.pack(source, dataset, PackOptions(quality=quality, gop=gop, window=10_000))
        found[gop] = read(dataset, options)
    base = found.get(60, found[max(found)])
    return [
        (kind, gop, f"{size:.0f}", f"{size / base[0]:.3f}", f"{speed:.1f}",
         f"{speed / base[1]:.2f}")
        for gop, (size, speed) in found.items()
    ]  # fmt: skip


# ---------------------------------------------------------------- purposes


def purposes(options: argparse.Namespace) -> None:
    """Measure and print what each purpose chooses, and what it costs beside the default."""
    clips.check_data()
    rows: list[tuple[object, ...]] = []
    for scene, kind in product(options.clip, options.kind):
        encoding, quality, pixels_of = KINDS[kind]
        base: tuple[float, ...] = ()
        with tempfile.TemporaryDirectory(prefix="mp4ds-benchmark-") as name:
            folder = Path(name)
            spec = clips.ClipSpec(scene, "rgb8", "low", options.frames, options.size)
            images = map(pixels_of, clips.make(spec))
            source = folder / "clip.mcap"
            write_mcap(source, images, options.frames, encoding, compression="none", hertz=30.0)
            for purpose in PURPOSES:
                dataset = folder / f"{purpose}"
                begun = cpu_seconds()
                mp4ds.pack(source, dataset, PackOptions(quality=quality, purpose=purpose))
                seconds = cpu_seconds() - begun
                size, speed = read(dataset, options)
                found = (size, 1 / speed, in_order(dataset), seconds)
                base = base or found
                ratios = [f"{one / other:.2f}" for one, other in zip(found, base, strict=True)]
                rows.append((scene, kind, purpose or "(default)", form_of(dataset), *ratios))
                print("-", *rows[-1], flush=True)
    head = ("clip", "images", "`--for`", "form", "bytes", "CPU at random", "in order", "packing")
    print_table(head, rows)


def form_of(dataset: Path) -> str:
    """Codec and options of a stream, as far as they differ between purposes."""
    with mp4ds.open(dataset) as opened:
        video = opened.streams[0].sidecar.video
    options = video.options
    fast = options.get("coder") == "rice" or "cabac=0" in options.get("x264-params", "")
    preset = f" preset {options['preset']}" if video.codec == "av1" else ""
    return f"{video.codec}{preset}{', fast coder' * fast}, key frame every {options['g']}"


def in_order(dataset: Path) -> float:
    """CPU seconds of a frame that is read in order."""
    with mp4ds.open(dataset) as opened:
        stream = opened[TOPIC]
        begun = time.process_time()
        for _ in stream:
            pass
        return (time.process_time() - begun) / len(stream)


# ---------------------------------------------------------------- lossy, at equal quality

RECIPES = (("8", 60), ("7", 30), ("7", 20), ("6", 10), ("5", 15), ("4", 15), ("4", 120))
"""Preset and distance of key frames; the first is what the others are compared with."""
CRFS = (18, 32)


def lossy(options: argparse.Namespace) -> None:
    """Measure and print the presets and distances."""
    clips.check_data()
    rows: list[tuple[object, ...]] = []
    for scene in options.clip:
        spec = clips.ClipSpec(scene, "rgb8", "low", options.frames, options.size)
        maker = PlaneMaker("rgb24")
        frames = [maker.make((rgb,)) for rgb in clips.make(spec)]
        base: list[Encoded] = []
        for preset, gop in RECIPES:
            with tempfile.TemporaryDirectory(prefix="mp4ds-benchmark-") as folder:
                path = Path(folder) / "clip.mp4"
                made = [encoded(path, frames, preset, gop, crf, options.reads) for crf in CRFS]
            base = base or made
            ratios = [f"{size_at(made, item.decibel) / item.size:.3f}" for item in base]
            rows.append(
                (
                    *(scene, preset, gop, *ratios),
                    f"{1e3 * made[0].read:.1f}",
                    f"{made[0].read / base[0].read:.2f}",
                    f"{made[0].encode / base[0].encode:.2f}",
                )
            )
            print("-", *rows[-1], flush=True)
    bytes_at = [f"bytes at the PSNR of crf {crf}" for crf in CRFS]
    head = ("clip", "preset", "key frame every", *bytes_at, "random frame, CPU ms", "to the first")
    print_table((*head, "encoding, CPU, to the first"), rows)


class Encoded(NamedTuple):
    """One video: bytes, PSNR of luma, CPU seconds of encoding and of reading a frame."""

    size: int
    decibel: float
    encode: float
    read: float


def encoded(
    path: Path, frames: list[Planes], preset: str, gop: int, crf: int, reads: int
) -> Encoded:
    """Encode as `visual` does, decode, and read frames at random."""
    begun = cpu_seconds()
    size = visual.encode(path, frames, 30.0, crf, preset, gop)
    encode = cpu_seconds() - begun
    both = zip(frames, decoded_planes(path), strict=True)
    error = np.mean([np.square(a[0].astype(np.int32) - b[0]).mean() for a, b in both])
    numbers = random.Random(0)
    with mp4ds.open(path) as opened:
        (video,) = opened.videos
        video.read([0], resize=(64, 48))
        begun = cpu_seconds()
        for _ in range(reads):
            video.read([numbers.randrange(len(video))], resize=(64, 48))
        read = (cpu_seconds() - begun) / reads
    return Encoded(size, float(10 * np.log10(255**2 / error)), encode, read)


def size_at(made: list[Encoded], decibel: float) -> float:
    """Bytes at a PSNR, by interpolation of their logarithm."""
    (a, b) = made
    share = (decibel - a.decibel) / (b.decibel - a.decibel)
    return float(np.exp((1 - share) * np.log(a.size) + share * np.log(b.size)))


def read(dataset: Path, options: argparse.Namespace) -> tuple[float, float]:
    """Bytes of a frame, and frames at random that are read in a second of CPU time."""
    numbers = random.Random(0)
    with mp4ds.open(dataset) as opened:
        stream = opened[TOPIC]
        size = stream.video_path.stat().st_size / len(stream)
        stream.read([0])
        begun = time.process_time()
        for _ in range(options.reads):
            stream.read([numbers.randrange(len(stream))], format="native")
        return size, options.reads / (time.process_time() - begun)


if __name__ == "__main__":
    main()
