"""What VMAF `--quality visual` gives, by resolution and frame rate.

    python benchmarks/visual.py [--frames N] [--clip NAME ...] [--size WxH ...]

The table of `visual` (spec/registry.md, Profiles) is the paper's, by frame rate alone. Clips are
those of clips.py, real scenes through a modelled sensor; lower rates have one frame of several.
They are encoded as `mp4ds pack --quality visual` does, and scored as `mp4ds evaluate` does; so
is the clip beside itself, which is the most that VMAF can have (its ceiling).
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from pathlib import Path

import clips
from measure import parse_size, print_machine, print_table
from mp4ds.plan import visual_setting
from mp4ds.times import TIMESCALE
from mp4ds.video.codecs import LOSSY_GOP, recipe_for
from mp4ds.video.encoder import VideoEncoder
from mp4ds.video.libvmaf import find_ffmpeg
from mp4ds.video.planes import PLANES_FORMAT, PlaneMaker, Planes, decoded_planes
from mp4ds.video.scores import Scorer

SIZES = ((320, 240), (640, 480), (960, 540))
_HERTZ = 30
_STEPS = (1, 3, 6, 15)  # 30, 10, 5 and 2 frames a second


def rows(spec: clips.ClipSpec, steps: tuple[int, ...], folder: Path) -> Iterator[list[str]]:
    """A row for each frame rate."""
    maker, scorer = PlaneMaker("rgb24"), Scorer(find_ffmpeg())
    frames = [maker.make((rgb,)) for rgb in clips.make(spec)]
    for step in steps:
        seen, rate = frames[::step], _HERTZ / step
        crf, preset = visual_setting(rate)
        video = folder / "clip.mp4"
        size = encode(video, seen, rate, crf, str(preset))
        found = scorer.score(seen, decoded_planes(video)).vmaf
        ceiling = scorer.score(seen, seen).vmaf
        if found is None or ceiling is None:
            raise SystemExit("no ffmpeg with libvmaf: pip install imageio-ffmpeg")
        height, width = frames[0][0].shape
        yield [
            spec.scene,
            f"{width}x{height}",
            f"{rate:g}",
            f"{crf}, {preset}",
            f"{found.mean():.2f}",
            f"{ceiling.mean():.2f}",
            f"{ceiling.mean() - found.mean():.2f}",
            f"{size / len(seen) / 1000:.1f}",
        ]


def encode(
    path: Path, frames: list[Planes], rate: float, crf: int, preset: str, gop: int = LOSSY_GOP
) -> int:
    """Make a video; its bytes."""
    recipe = recipe_for("rgb24", lossless=False, codec="av1", crf=crf, preset=preset)
    height, width = frames[0][0].shape
    encoder = VideoEncoder(
        path,
        recipe,
        picture_format=PLANES_FORMAT,
        width=width,
        height=height,
        gop=gop,
        threads=0,
        rate=rate,
    )
    for number, planes in enumerate(frames):
        encoder.write(planes, round(number * TIMESCALE / rate))
    encoder.close()
    return path.stat().st_size


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--noise", choices=list(clips.SENSORS), default="low")
    parser.add_argument("--size", type=parse_size, nargs="+", default=SIZES, help="WxH")
    parser.add_argument("--clip", nargs="+", choices=list(clips.MOVING), default=list(clips.MOVING))
    chosen = parser.parse_args()
    clips.check_data()
    print_machine()
    print(f"- {chosen.frames} frames, noise {chosen.noise}", flush=True)
    header = [
        *("clip", "size", "frames a second", "crf, preset"),
        *("VMAF", "ceiling", "below it", "kB a frame"),
    ]
    with tempfile.TemporaryDirectory(prefix="mp4ds-benchmark-") as folder:
        table = (
            row
            for scene in chosen.clip
            for size in chosen.size
            for row in rows(
                clips.ClipSpec(scene, "rgb8", chosen.noise, chosen.frames, tuple(size)),
                _STEPS if tuple(size) == (640, 480) else _STEPS[:1],
                Path(folder),
            )
        )
        print_table(header, table)


if __name__ == "__main__":
    main()
