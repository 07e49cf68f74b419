"""What `--for` and views cost: bytes, and the time of frames at random and in order.

    python benchmarks/groups.py [--frames N] [--size WxH] [--kind K ...] [--clip NAME ...]

Real scenes (clips.py) are packed by `mp4ds.pack`, with each ``--for`` and without a view; then
frames at random places are read one by one, and all in order: the exact ones of lossless images,
and those of their view. CPU time is of the reading process, opening left out. All columns are
relative to the default.
"""

from __future__ import annotations

import random
import tempfile
import time
from itertools import product
from pathlib import Path
from typing import Any, Literal

import clips
import mp4ds
from measure import cpu_seconds, parse_size, parser_of, print_machine, print_table
from mp4ds import PackOptions
from recordings import TOPIC, write_mcap

KINDS = {
    "mono8, lossless": ("mono8", "lossless"),
    "bayer_rggb8, lossless": ("bayer_rggb8", "lossless"),
    "rgb8, lossless": ("rgb8", "lossless"),
    "rgb8, visual": ("rgb8", "visual"),
}
"""Encoding and quality."""
Layer = Literal["exact", "view"]
LAYERS: tuple[Layer, Layer] = ("exact", "view")
CHOICES: dict[str, dict[str, Any]] = {
    "(default)": {},
    "--view none": {"view": "none"},
    "--for training": {"purpose": "training"},
    "--for archive": {"purpose": "archive"},
}


def main() -> None:
    """Measure and print."""
    parser = parser_of(__doc__)
    parser.add_argument("--frames", type=int, default=480)
    parser.add_argument("--size", type=parse_size, default=(640, 480), help="WxH")
    parser.add_argument("--kind", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--reads", type=int, default=60)
    scenes = ["cups", "people", "arm"]
    parser.add_argument("--clip", nargs="+", choices=clips.MOVING, default=scenes)
    options = parser.parse_args()
    clips.check_data()
    print_machine()
    rows: list[tuple[object, ...]] = []
    for scene, kind in product(options.clip, options.kind):
        encoding, quality = KINDS[kind]
        base: tuple[float, ...] = ()
        with tempfile.TemporaryDirectory(prefix="mp4ds-benchmark-") as made:
            folder = Path(made)
            spec = clips.ClipSpec(scene, encoding, "low", options.frames, options.size)
            source = folder / "clip.mcap"
            write_mcap(source, clips.make(spec), encoding, compression="none")
            for name, given in CHOICES.items():
                dataset = folder / name
                begun = cpu_seconds()
                mp4ds.pack(source, dataset, PackOptions(quality=quality, **given))
                seconds = cpu_seconds() - begun
                reading = [read(dataset, options.reads, layer) for layer in LAYERS]
                at_random, in_order = zip(*reading, strict=True)
                found = (bytes_per_frame(dataset), *at_random, *in_order, seconds)
                base = base or found
                ratios = [f"{one / other:.2f}" for one, other in zip(found, base, strict=True)]
                rows.append((scene, kind, name, form_of(dataset), *ratios))
                print("-", *rows[-1], flush=True)
    head = ("clip", "images", "packed", "form", "bytes", "exact at random", "view at random")
    print_table((*head, "exact in order", "view in order", "packing"), rows)


def form_of(dataset: Path) -> str:
    """Codec and key frames of each video of a stream."""
    with mp4ds.open(dataset) as opened:
        videos = opened.streams[0].sidecar.videos
    return " + ".join(
        f"{video.codec}{' preset ' * (video.codec == 'av1')}"
        f"{video.options['preset'] if video.codec == 'av1' else ''}, key frame every "
        f"{video.options['g'] if video.codec != 'png' else 1}"
        for video in videos
    )


def bytes_per_frame(dataset: Path) -> float:
    """Of all videos of a stream."""
    with mp4ds.open(dataset) as opened:
        (stream,) = opened.streams
        return sum(path.stat().st_size for path, _ in stream.videos) / len(stream)


def read(dataset: Path, reads: int, layer: Layer) -> tuple[float, float]:
    """CPU seconds of a frame at a random place, and of one that is read in order."""
    numbers = random.Random(0)
    with mp4ds.open(dataset, layer=layer) as opened:
        stream = opened[TOPIC]
        stream.read([0])
        begun = time.process_time()
        for _ in range(reads):
            stream.read([numbers.randrange(len(stream))], format="native")
        random_seconds = (time.process_time() - begun) / reads
    with mp4ds.open(dataset, layer=layer) as opened:
        stream = opened[TOPIC]
        begun = time.process_time()
        for _ in stream:
            pass
        return random_seconds, (time.process_time() - begun) / len(stream)


if __name__ == "__main__":
    main()
