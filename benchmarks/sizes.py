"""The size of a camera's recording in each form: raw, PNG, JPEG, lossless, and for the eye.

    python benchmarks/sizes.py [--frames N] [--size WxH] [--encoding E ...] [--noise N ...]

Clips of clips.py are recorded at 30 Hz and packed by `mp4ds.pack`; a dataset counts as a whole. PNG
is of the recorded pixels, JPEG of the colours that they show, by Pillow with its defaults.
"""

from __future__ import annotations

import argparse
import io
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

import clips
import mp4ds
from measure import parse_size, parser_of, print_machine, print_table, size_of
from recordings import TOPIC, write_bag

JPEG = (90, 75)
PACKED = ("lossless", "visual")


def main() -> None:
    """Measure and print."""
    parser = parser_of(__doc__)
    parser.add_argument("--frames", type=int, default=90)
    parser.add_argument("--size", type=parse_size, default=(640, 480), help="WxH")
    encodings = ("bayer_rggb8", "mono8", "rgb8")
    parser.add_argument("--encoding", nargs="+", choices=encodings, default=encodings[:1])
    parser.add_argument("--noise", nargs="+", choices=clips.SENSORS, default=[*clips.SENSORS])
    options = parser.parse_args()
    clips.check_data()
    print_machine()
    forms = ("raw", "PNG", *(f"JPEG {quality}" for quality in JPEG), *PACKED)
    header = (
        *("clip", "encoding", "noise", "frames"),
        *(f"{form}, kB/frame" for form in forms),
        *(f"raw / {form}" for form in PACKED),
    )
    print_table(header, rows(options))


def rows(options: argparse.Namespace) -> Iterator[tuple[object, ...]]:
    """One for each clip."""
    for scene in clips.MOVING:
        for encoding in options.encoding:
            for noise in options.noise:
                spec = clips.ClipSpec(scene, encoding, noise, options.frames, options.size)
                frames = clips.load(spec)
                sizes = [size / len(frames) / 1000 for size in measure(frames, encoding)]
                ratios = [f"{sizes[0] / size:.1f}" for size in sizes[-len(PACKED) :]]
                told = (f"{size:.1f}" for size in sizes)
                yield scene, encoding, noise, len(frames), *told, *ratios


def measure(frames: NDArray[Any], encoding: str) -> list[int]:
    """Bytes of all frames in each form."""
    with tempfile.TemporaryDirectory() as made:
        bag = Path(made, "clip.bag")
        write_bag(bag, frames, encoding)
        found = [frames.nbytes, sum(still(pixels, "PNG") for pixels in frames)]
        packed = []
        for quality in PACKED:
            target = Path(made, quality)
            mp4ds.pack(bag, target, mp4ds.PackOptions(quality=quality))
            packed.append(size_of(target))
        with mp4ds.open(Path(made, "lossless")) as dataset:
            seen = "gray" if encoding == "mono8" else "rgb"
            for jpeg in JPEG:
                shown = (dataset[TOPIC].read([i], format=seen)[0] for i in range(len(frames)))
                found.append(sum(still(pixels, "JPEG", quality=jpeg) for pixels in shown))
    return [*found, *packed]


def still(pixels: NDArray[Any], kind: str, **options: Any) -> int:
    """Bytes of a picture as a file."""
    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(stream, kind, **options)
    return stream.tell()


if __name__ == "__main__":
    main()
