"""What the distance of key frames costs and gives: bytes of a frame, and frames at random.

    python benchmarks/groups.py [--frames N] [--size WxH] [--gop N ...] [--kind K ...]

The moving camera of loader_clips.py is packed by `mp4ds.pack`, without loss and for the eye, with
each number of frames from one key frame to the next; then frames at random places are read one by
one. CPU time is of the reading process, opening left out.
"""

from __future__ import annotations

import argparse
import random
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import mp4ds
from loader_clips import moving
from measure import parse_size, print_machine, print_table
from mp4ds import PackOptions
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
    options = parser.parse_args()
    print_machine()
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
