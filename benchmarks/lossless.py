"""What lossless packing saves and costs: against PNG files and a zstd-compressed MCAP.

    python benchmarks/lossless.py [--frames N] [--size WxH] [--family E ...] [--cache FOLDER]

Each clip (see clips.py) is written as a ROS 2 MCAP with zstd chunks, as a robot records it, and
packed. A dataset counts as a whole: videos, sidecars, manifest and messages.mcap. After it was
measured, every decoded frame is compared with the clip.

- PNG: one file per frame, Pillow's default settings (zlib level 6), a mosaic as grey.
- packed: with the codec that mp4ds chooses by itself; below it the others that ``--codec`` offers.
- encode: frames per CPU second of ``mp4ds.pack``, all included but imports: reading the zstd
  chunks, digests, hashing. decode: of iterating over the stream's frames.
"""

from __future__ import annotations

import argparse
import io
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import geometric_mean

from PIL import Image

import clips
from measure import job, parse_size, print_machine, print_table
from recordings import CHUNK_BYTES, write_mcap

HERTZ = 30.0
CODECS = ("h264", "h265", "av1", "ffv1")
HEADER = (
    "clip",
    "noise",
    "frames",
    "raw MB",
    "as",
    "MB",
    "raw / packed",
    "smaller than PNG",
    "smaller than zstd MCAP",
    "encode frames / CPU s",
    "decode frames / CPU s",
)


@dataclass
class Result:
    """One way of storing one clip.

    Attributes:
        way: ``PNG``, ``zstd MCAP`` or ``mp4ds`` with the codec.
        size: Bytes.
        encode: Frames per CPU second.
        decode: Frames per CPU second.
    """

    way: str
    size: int
    encode: float | None = None
    decode: float | None = None
    default: bool = False


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--size", type=parse_size, help="WxH; each scene's own by default")
    parser.add_argument("--family", action="append", choices=clips.FAMILIES)
    parser.add_argument("--scene", action="append", help="only these scenes")
    parser.add_argument("--noise", action="append", choices=list(clips.SENSORS))
    parser.add_argument("--cache", type=Path, help="folder that keeps the clips")
    options = parser.parse_args()
    clips.check_data()
    print_machine()
    print_noise()
    print(f"- MCAP: chunks of {CHUNK_BYTES} bytes, zstd at the mcap library's level")
    summary = []
    for family in options.family or clips.FAMILIES:
        noises = tuple(options.noise or clips.SENSORS)
        specs = clips.specs(family, options.frames, options.size, noises)
        specs = [spec for spec in specs if not options.scene or spec.scene in options.scene]
        results: list[list[Result]] = []
        if not specs:
            print(f"\n{family}: there is no clip of it here.")
            continue
        print(f"\n### {family}")
        print_table(HEADER, rows(specs, options.cache, results))
        summary.append(summary_row(family, results))
    print("\n### Default codec, geometric mean over the clips (least to most)")
    print_table(
        ("family", "clips", "raw / packed", "smaller than PNG", "smaller than zstd MCAP"), summary
    )


def print_noise() -> None:
    """The sensors, in figures."""
    for name, sensor in clips.SENSORS.items():
        gain = sensor.gain(255)
        print(
            f"- {name} noise: read {sensor.read_electrons * gain:.3f} levels, gain {gain:.4f}; "
            f"standard deviation {sensor.deviation(0, 255):.2f} in black, "
            f"{sensor.deviation(128, 255):.2f} at 128, {sensor.deviation(255, 255):.2f} in white"
        )


def rows(
    specs: list[clips.ClipSpec], cache: Path | None, results: list[list[Result]]
) -> Iterator[tuple[object, ...]]:
    """Table rows of all clips; keeps the results."""
    for spec in specs:
        with tempfile.TemporaryDirectory(prefix="mp4ds-benchmark-") as folder:
            clip = clips.load(spec, cache or Path(folder))
            found = list(measure(spec, clip, cache or Path(folder), Path(folder)))
        results.append([Result("raw", clip.nbytes), *found])
        png, mcap = found[0].size, found[1].size
        for result in found:
            yield (
                spec.scene,
                spec.noise,
                len(clip),
                f"{clip.nbytes / 1e6:.1f}",
                f"**{result.way}**" if result.default else result.way,
                f"{result.size / 1e6:.2f}",
                f"{clip.nbytes / result.size:.2f}",
                f"{png / result.size:.2f}",
                f"{mcap / result.size:.2f}",
                f"{result.encode:.1f}" if result.encode else "",
                f"{result.decode:.1f}" if result.decode else "",
            )


def measure(
    spec: clips.ClipSpec, clip: clips.Pixels, cache: Path, folder: Path
) -> Iterator[Result]:
    """PNG first, then the source, then mp4ds with its default and with all other codecs."""
    yield png_files(clip)
    source = folder / "source.mcap"
    write_mcap(source, clip, len(clip), spec.encoding, compression="zstd", hertz=HERTZ)
    yield Result("zstd MCAP", source.stat().st_size)
    used = set()
    for codec in (None, *CODECS):
        if codec in used:
            continue
        dataset = folder / f"dataset-{codec}"
        packed = job("pack", source=source, target=dataset, codec=codec)
        if codec and packed["codec"] != codec:
            continue  # it has no lossless form for these pictures
        used.add(packed["codec"])
        decoded = job("decode", dataset=dataset, frames=cache / f"{spec.name}.npy")
        if not decoded["exact"]:
            raise SystemExit(f"{spec.name}, {packed['codec']}: frames do not come back exactly.")
        yield Result(
            f"mp4ds {packed['codec']}",
            packed["dataset"],
            len(clip) / packed["cpu"],
            len(clip) / decoded["cpu"],
            default=codec is None,
        )


def png_files(clip: clips.Pixels) -> Result:
    """Each frame as a PNG file with Pillow's default settings."""
    files = [io.BytesIO() for _ in clip]
    start = time.process_time()
    for pixels, file in zip(clip, files, strict=True):
        Image.fromarray(pixels).save(file, "PNG")
    encoded = time.process_time()
    for file in files:
        Image.open(file).load()
    decoded = time.process_time()
    size = sum(len(file.getbuffer()) for file in files)
    return Result("PNG", size, len(clip) / (encoded - start), len(clip) / (decoded - encoded))


def summary_row(family: str, results: list[list[Result]]) -> tuple[object, ...]:
    """What the default codec reaches over all clips of a family."""
    ratios: list[list[float]] = [[], [], []]
    for raw, png, mcap, *ways in results:
        default = next(way for way in ways if way.default)
        for values, other in zip(ratios, (raw, png, mcap), strict=True):
            values.append(other.size / default.size)
    texts = [f"{geometric_mean(v):.2f} ({min(v):.2f} to {max(v):.2f})" for v in ratios]
    return (family, len(results), *texts)


if __name__ == "__main__":
    main()
