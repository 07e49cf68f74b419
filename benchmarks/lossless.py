"""What lossless packing saves and costs, for each family of images.

    python benchmarks/lossless.py [--frames N] [--size WxH] [--family F ...] [--cache FOLDER]
                                  [--keep FILE]

Each clip (clips.py, depth_clips.py) is written as a ROS 2 MCAP with zstd chunks, as a robot
records it, packed with `mp4ds.pack`, and decoded. Every image of every dataset is compared with
the clip, byte for byte.

- packed: the dataset as a whole (videos, sidecars, manifest, messages.mcap), made as mp4ds
  chooses by itself, by trial; named by layout and codec. ``video`` is its video alone.
- h264, h265, ffv1: the dataset made with ``--codec``, where that makes another video.
- MCAP, zstd MCAP: the recording, its messages verbatim.
- PNG, FFV1, x264, RVL: see others.py. In MB, as the rest.
- at least as small: whether the dataset is no larger than the smallest of PNG, zstd MCAP, FFV1
  and x264; else by how much it is. A short clip pays for the sidecar with few frames, so the
  same is told of the video alone.

Encode: frames per CPU second of `mp4ds.pack`, all included but imports: reading the zstd chunks,
the trial, digests, hashing. Decode: of iterating over the frames.
``--keep`` writes the figures as JSON lines; clips that are in the file are not measured again.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import geometric_mean
from typing import Any

import clips
import others
from jobs import HERTZ
from measure import job, parse_size, print_machine, print_table
from others import Way
from recordings import CHUNK_BYTES, write_mcap

CODECS = ("h264", "h265", "ffv1")
NOISE = "noise"
FAMILIES = (*clips.FAMILIES, NOISE)
BASELINES = ("PNG", "zstd MCAP", "FFV1", "x264")
COLUMNS = ("MCAP", *BASELINES, "RVL")


@dataclass(frozen=True, slots=True)
class Result:
    """What became of one clip.

    Attributes:
        family: One of `FAMILIES`.
        clip: Scene and noise.
        frames: How many.
        raw: Bytes of the pixels.
        video: Bytes of the videos that mp4ds makes by itself.
        packed: The dataset that it makes by itself; named by layout and codec.
        others: All other ways, by name; those of ``--codec`` by the codec.
        reasons: Why images were stored verbatim, with their number.
    """

    family: str
    clip: str
    frames: int
    raw: int
    video: int
    packed: Way
    others: dict[str, Way]
    reasons: dict[str, int]

    @property
    def best(self) -> int:
        """Bytes of the smallest of `BASELINES`."""
        return min(self.others[name].size for name in BASELINES if name in self.others)

    @property
    def stored(self) -> int:
        """Bytes of pixels without the dataset's other files; verbatim: with them."""
        return self.video or self.packed.size

    def to_json(self) -> str:
        """One line."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, line: str) -> Result:
        """The result of `to_json`."""
        values = json.loads(line)
        ways = {name: Way(**way) for name, way in values["others"].items()}
        return cls(**{**values, "packed": Way(**values["packed"]), "others": ways})


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--size", type=parse_size, help="WxH; each scene's own by default")
    parser.add_argument("--family", action="append", choices=FAMILIES)
    parser.add_argument("--scene", action="append", help="only these scenes")
    parser.add_argument("--noise", action="append", choices=list(clips.SENSORS))
    parser.add_argument("--codec", action="append", choices=CODECS, help="only these of --codec")
    parser.add_argument("--cache", type=Path, help="folder that keeps the clips")
    parser.add_argument("--keep", type=Path, help="file that keeps the figures")
    options = parser.parse_args()
    clips.check_data()
    print_machine()
    print_noise()
    print(f"- MCAP: chunks of {CHUNK_BYTES} bytes, zstd at the mcap library's level")
    found: list[Result] = []
    for family in options.family or FAMILIES:
        specs = [
            s
            for s in specs_of(family, options)
            if options.scene is None or s.scene in options.scene
        ]
        results = list(measured(family, specs, options))
        if not results:
            print(f"\n{family}: there is no clip of it here.")
            continue
        found += results
        print(f"\n### {family}")
        print_sizes(results)
        print_table(("way", "encode frames / CPU s", "decode frames / CPU s"), speeds(results))
        for text in sorted({f"{r.clip}: {reason}" for r in results for reason in r.reasons}):
            print(f"\nStored verbatim, {text}.")
    print("\n### All families")
    print_summary(found)


def specs_of(family: str, options: argparse.Namespace) -> list[clips.ClipSpec]:
    """All clips of a family; pure noise is a family of its own."""
    noises = tuple(options.noise or clips.SENSORS)
    encodings = clips.FAMILIES if family == NOISE else (family,)
    specs = [s for e in encodings for s in clips.specs(e, options.frames, options.size, noises)]
    return [spec for spec in specs if (spec.scene == NOISE) == (family == NOISE)]


def print_noise() -> None:
    """The sensors, in figures."""
    for name, sensor in clips.SENSORS.items():
        gain = sensor.gain(255)
        print(
            f"- {name} noise: read {sensor.read_electrons * gain:.3f} levels, gain {gain:.4f}; "
            f"standard deviation {sensor.deviation(0, 255):.2f} in black, "
            f"{sensor.deviation(128, 255):.2f} at 128, {sensor.deviation(255, 255):.2f} in white"
        )


def measured(
    family: str, specs: Iterable[clips.ClipSpec], options: argparse.Namespace
) -> Iterator[Result]:
    """The results of clips, kept or measured now."""
    keep: Path | None = options.keep
    codecs = options.codec or CODECS
    lines = keep.read_text().splitlines() if keep and keep.exists() else []
    kept = {(r.family, r.clip): r for r in map(Result.from_json, lines)}
    for spec in specs:
        result = kept.get((family, clip_name(family, spec)))
        if result is None:
            with tempfile.TemporaryDirectory(prefix="mp4ds-benchmark-") as folder:
                cache = options.cache or Path(folder)
                result = measure(family, spec, codecs, cache, Path(folder))
            if keep:
                with keep.open("a") as file:
                    file.write(result.to_json() + "\n")
        yield result


def clip_name(family: str, spec: clips.ClipSpec) -> str:
    """Scene and noise, and the encoding where the family does not tell."""
    return f"{spec.scene} {spec.encoding if family == NOISE else spec.noise}"


def measure(
    family: str, spec: clips.ClipSpec, codecs: Sequence[str], cache: Path, folder: Path
) -> Result:
    """All ways of one clip."""
    clip = clips.load(spec, cache)
    sources = {"MCAP": folder / "none.mcap", "zstd MCAP": folder / "zstd.mcap"}
    found = {}
    for name, path in sources.items():
        write_mcap(path, clip, len(clip), spec.encoding, compression=path.stem, hertz=HERTZ)
        found[name] = Way(name, path.stat().st_size)
    plain = others.plain(clip, spec.encoding)
    found["PNG"] = others.png(plain)
    found["FFV1"] = others.ffv1(plain, folder)
    if way := others.x264(plain, folder):
        found["x264"] = way
    if spec.encoding == "16UC1":
        found["RVL"] = others.rvl_files(clip)
    arguments = {"source": sources["zstd MCAP"], "folder": folder, "codecs": [None, *codecs]}
    packed = job("recipes", frames=cache / f"{spec.name}.npy", **arguments)["results"]
    for codec, item in zip(codecs, packed[1:], strict=True):
        # another codec was used where this one has no lossless form
        if item["recipe"] not in (None, packed[0]["recipe"]) and codec in item["codecs"]:
            found[codec] = _way(spec, item, len(clip))
    return Result(
        family,
        clip_name(family, spec),
        len(clip),
        clip.nbytes,
        packed[0]["video"],
        _way(spec, packed[0], len(clip)),
        found,
        packed[0]["reasons"],
    )


def _way(spec: clips.ClipSpec, item: dict[str, Any], frames: int) -> Way:
    if not item["decoded"]["exact"]:
        raise SystemExit(f"{spec.name}, {item['recipe']}: images do not come back exactly.")
    decode = frames / item["decoded"]["cpu"] if item["codecs"] else None
    return Way(item["recipe"], item["dataset"], frames / item["cpu"], decode)


def print_sizes(results: Sequence[Result]) -> None:
    """One row for each clip; columns that no clip has are left out."""
    columns = [name for name in COLUMNS if any(name in r.others for r in results)]
    codecs = [name for name in CODECS if any(name in r.others for r in results)]

    def cell(result: Result, name: str) -> str:
        way = result.others.get(name)
        if way is None:
            return ""
        layout = way.name.removesuffix(f" {name}") if name in CODECS else ""
        return f"{layout} {way.size / 1e6:.3f}".lstrip()

    rows = (
        (
            result.clip,
            result.frames,
            f"{result.raw / 1e6:.2f}",
            *(cell(result, name) for name in columns),
            *(cell(result, name) for name in codecs),
            f"**{result.packed.name}**",
            f"**{result.packed.size / 1e6:.3f}**",
            f"{result.video / 1e6:.3f}" if result.video else "",
            f"{result.raw / result.packed.size:.2f}",
            verdict(result.packed.size / result.best),
            verdict(result.stored / result.best),
        )
        for result in results
    )
    header = ("clip", "frames", "raw MB", *columns, *(f"--codec {name}" for name in codecs))
    end = ("packed", "MB", "video", "raw / packed", "at least as small", "video alone")
    print_table((*header, *end), rows)


def verdict(ratio: float) -> str:
    """``yes``, or how much larger."""
    if ratio <= 1:
        return "yes"
    percent = 100 * (ratio - 1)
    return f"{percent:.1f} % larger" if percent >= 0.05 else "< 0.05 % larger"


def speeds(results: Sequence[Result]) -> Iterator[tuple[object, ...]]:
    """Frames per CPU second of each way, geometric mean over the clips that have it."""
    ways: dict[str, list[Way]] = {}
    for result in results:
        ways.setdefault(f"mp4ds {result.packed.name}", []).append(result.packed)
        for name, way in result.others.items():
            ways.setdefault(f"--codec {name}" if name in CODECS else name, []).append(way)

    def mean(found: list[Way], which: str) -> str:
        values = [value for way in found if (value := getattr(way, which))]
        return f"{geometric_mean(values):.1f}" if values else ""

    for name, found in ways.items():
        if mean(found, "encode"):
            yield f"{name} ({len(found)})", mean(found, "encode"), mean(found, "decode")


def print_summary(results: Sequence[Result]) -> None:
    """One row for each family: geometric mean over its clips (least to most), and the worst."""

    def row(family: str) -> tuple[object, ...]:
        own = [result for result in results if result.family == family]
        sizes = [result.packed.size for result in own]
        ratios = (
            [r.raw / size for r, size in zip(own, sizes, strict=True)],
            [r.others["PNG"].size / size for r, size in zip(own, sizes, strict=True)],
            [r.others["zstd MCAP"].size / size for r, size in zip(own, sizes, strict=True)],
        )
        texts = [f"{geometric_mean(v):.2f} ({min(v):.2f} to {max(v):.2f})" for v in ratios]
        chosen = ", ".join(sorted({result.packed.name for result in own}))
        worst = max(own, key=lambda r: r.packed.size / r.best)
        alone = max(own, key=lambda r: r.stored / r.best)
        return (
            family,
            len(own),
            chosen,
            *texts,
            f"{verdict(worst.packed.size / worst.best)} ({worst.clip})",
            f"{verdict(alone.stored / alone.best)} ({alone.clip})",
        )

    header = ("family", "clips", "packed as", "raw / packed", "smaller than PNG")
    end = ("smaller than zstd MCAP", "at least as small, worst clip", "video alone, worst clip")
    families = dict.fromkeys(result.family for result in results)
    print_table((*header, *end), (row(family) for family in families))


if __name__ == "__main__":
    main()
