"""What lossless packing saves, for each family of images.

    python benchmarks/lossless.py [--frames N] [--size WxH] [--family F ...] [--scene S ...]

Each clip (clips.py, depth_clips.py) is written as a ROS 2 MCAP with zstd chunks, as a robot records
it, packed with `mp4ds.pack`, and decoded. Every image of every dataset is compared with the clip,
byte for byte.

- packed: the dataset as a whole (videos, sidecars, manifest, messages.mcap), made as mp4ds chooses
  by itself, by trial; named by layout and codec. ``video`` is its video alone.
- MCAP, zstd MCAP: the recording, its messages verbatim.
- PNG: of the pictures as they look to a program that knows pixel formats and nothing of mp4ds: a
  mosaic is grey as it stands, YUV is planes, a float's four bytes are
  four grey pictures in one. By Pillow with its defaults; rgb of 16 bits by ffmpeg.
"""

from __future__ import annotations

import argparse
import io
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from statistics import geometric_mean
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from rosbags.typesys import Stores, get_typestore

import clips
import mp4ds
from measure import parse_size, parser_of, print_machine, print_table, size_of
from mp4ds.messages.encodings import ENCODINGS
from mp4ds.messages.layouts import bind
from mp4ds.records import Message
from recordings import CHUNK_BYTES, HERTZ, IMAGE, TOPIC, times, write_mcap


@dataclass(frozen=True, slots=True)
class Result:
    """What became of one clip, in bytes.

    Attributes:
        clip: Scene and noise.
        frames: How many.
        raw: The pixels.
        others: Other ways to store them, by name.
        packed: The dataset.
        video: Its video alone; 0 where all was stored verbatim.
        recipe: Layout and codec.
    """

    clip: str
    frames: int
    raw: int
    others: dict[str, int]
    packed: int
    video: int
    recipe: str


def main() -> None:
    """Measure and print."""
    parser = parser_of(__doc__)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--size", type=parse_size, help="WxH; each scene's own by default")
    parser.add_argument("--family", action="append", choices=clips.FAMILIES)
    parser.add_argument("--scene", action="append", help="only these scenes")
    parser.add_argument("--noise", action="append", choices=list(clips.SENSORS))
    options = parser.parse_args()
    clips.check_data()
    print_machine()
    print(f"- MCAP: chunks of {CHUNK_BYTES} bytes, zstd at the mcap library's level")
    families = {}
    for family in options.family or clips.FAMILIES:
        print(f"\n### {family}")
        header = ("clip", "frames", "raw MB", "MCAP", "zstd MCAP", "PNG", "packed", "MB", "video")
        families[family] = results = []
        print_table(header, rows(family, options, results))
    print("\n### All families")
    header = ("family", "clips", "packed as", "raw / packed", "smaller than PNG")
    summary = (summary_row(name, found) for name, found in families.items() if found)
    print_table((*header, "smaller than zstd MCAP"), summary)


def rows(
    family: str, options: argparse.Namespace, results: list[Result]
) -> Iterator[tuple[object, ...]]:
    """One for each clip of a family, whose results are kept."""
    noises = tuple(options.noise or clips.SENSORS)
    for spec in clips.specs(family, options.frames, options.size, noises):
        if options.scene and spec.scene not in options.scene:
            continue
        with tempfile.TemporaryDirectory(prefix="mp4ds-benchmark-") as folder:
            result = measure(spec, Path(folder))
        results.append(result)
        sizes = (f"{size / 1e6:.3f}" for size in result.others.values())
        yield (
            *(result.clip, result.frames, f"{result.raw / 1e6:.2f}", *sizes),
            *(f"**{result.recipe}**", f"**{result.packed / 1e6:.3f}**"),
            f"{result.video / 1e6:.3f}" if result.video else "",
        )


def measure(spec: clips.ClipSpec, folder: Path) -> Result:
    """All ways of one clip."""
    clip = clips.load(spec)
    others = {}
    for name in ("MCAP", "zstd MCAP"):
        path = folder / f"{name}.mcap"
        compression = "zstd" if "zstd" in name else "none"
        write_mcap(path, clip, spec.encoding, compression=compression)
        others[name] = path.stat().st_size
    others["PNG"] = png_bytes(clip, spec.encoding)
    dataset = folder / "dataset"
    mp4ds.pack(folder / "zstd MCAP.mcap", dataset)
    check(clip, dataset, spec.name)
    with mp4ds.open(dataset) as opened:
        videos = [stream.sidecar.video for stream in opened.streams]
    recipe = ", ".join(f"{video.layout} {video.codec}" for video in videos) or "verbatim"
    video = sum(path.stat().st_size for path in dataset.glob("*.mp4"))
    name = f"{spec.scene} {spec.noise}"
    return Result(name, len(clip), clip.nbytes, others, size_of(dataset), video, recipe)


def check(clip: NDArray[Any], dataset: Path, name: str) -> None:
    """Every image comes back with the bytes of its pixels, so that one NaN is not another."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    stamps = (stamp for stamp, _ in times(HERTZ))
    missing = dict(zip(stamps, clip, strict=False))
    with mp4ds.open(dataset) as opened:
        found = {frame.stamp_ns: frame.data for topic in opened for frame in topic}
        for record in opened.messages_file.in_file_order():
            if isinstance(record, Message) and record.channel.topic == TOPIC:
                image: Any = store.deserialize_cdr(record.data, IMAGE)
                stamp = image.header.stamp
                found[stamp.sec * 10**9 + stamp.nanosec] = image.data
    exact = found.keys() == missing.keys() and all(
        pixels.tobytes() == missing[stamp].tobytes() for stamp, pixels in found.items()
    )
    if not exact:
        raise SystemExit(f"{name}: images do not come back exactly.")


def png_bytes(clip: NDArray[Any], name: str) -> int:
    """Of a PNG file for each plain picture."""
    encoding = ENCODINGS[name]
    if encoding.mosaic:
        encoding = ENCODINGS["mono8" if encoding.bytes_per_sample == 1 else "mono16"]
    layout, total = bind(encoding.general, encoding), 0
    for frame in clip:
        planes = [np.ascontiguousarray(p) for p in layout.to_picture(frame.copy())]
        if layout.pixel_format.startswith("gbrp"):  # which Pillow writes no PNG of
            green, blue, red = planes
            total += _ffmpeg_png_bytes(np.stack([red, green, blue], axis=-1))
            continue
        for plane in planes:
            file = io.BytesIO()
            Image.fromarray(plane).save(file, "PNG")
            total += file.tell()
    return total


def _ffmpeg_png_bytes(rgb: NDArray[Any]) -> int:
    frame = av.VideoFrame.from_ndarray(rgb, format="rgb48be")
    context: Any = av.CodecContext.create("png", "w")
    context.options = {"pred": "mixed"}  # a filter chosen for each row, as libpng does
    context.width, context.height = frame.width, frame.height
    context.pix_fmt, context.time_base = "rgb48be", Fraction(1, 30)
    return sum(packet.size for given in (frame, None) for packet in context.encode(given))


def summary_row(family: str, results: Sequence[Result]) -> tuple[object, ...]:
    """Geometric means over the clips of a family (least to most)."""
    ratios = (
        [one.raw / one.packed for one in results],
        *([one.others[name] / one.packed for one in results] for name in ("PNG", "zstd MCAP")),
    )
    texts = [f"{geometric_mean(r):.2f} ({min(r):.2f} to {max(r):.2f})" for r in ratios]
    recipes = ", ".join(sorted({one.recipe for one in results}))
    return family, len(results), recipes, *texts


if __name__ == "__main__":
    main()
