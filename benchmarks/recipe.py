"""Which settings of lossy encoders need the fewest bits for equal quality, and what they cost.

    python benchmarks/recipe.py [--frames N] [--size WxH] [--recipe NAME ...] [--clip NAME ...]

Clips are those of clips.py: real scenes through a modelled sensor, demosaiced, as a ROS driver
publishes them. Each recipe encodes each clip with several crf. CPU seconds are those of all threads
of the encoder. All encoders are given the same pictures, 4:2:0 of 8 bits and full range, those of
10 bits as the same levels in 10. Frames are scored against them after decoding, rounded to 8 bits:
VMAF (libvmaf), PSNR of luma and chroma, SSIM. (Against a clip of 10 bits, what was merely rounded
to 8 has more VMAF than the clip itself, by 0.1 to 0.2, which is as much as a quarter of the bits.)

A figure is a Bjontegaard rate: how many more bits than the baseline for equal quality, in percent,
the mean over the qualities that both reach between VMAF 97 and 99.5 (others: those of the baseline
there), by linear interpolation of the logarithm of the rate. A clip of which the baseline has less
than 99.5, as those at rest have, is compared over the 2.5 below what it has. "CPU" is that of
encoding, over the same crf. The baseline is the paper's: SVT-AV1, preset 6, 8 bits.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

import clips
from measure import parse_size, print_machine
from mp4ds.video.codecs import TEN_BITS
from mp4ds.video.colour import samples
from mp4ds.video.encoder import ordinary_scheduling
from mp4ds.video.libvmaf import find_ffmpeg
from mp4ds.video.pixels import narrowed, widened
from mp4ds.video.planes import PlaneMaker, Planes
from mp4ds.video.scores import Scorer

RANGE = (97.0, 99.5)
GOP = 60
_SVT_CRF, _X26X_CRF = (8, 14, 20, 26, 32), (8, 12, 16, 20, 24)
CLIPS = tuple((scene, "low") for scene in ("cups", "cars", "people", "lane", "arm"))


@dataclass(frozen=True)
class Recipe:
    """Settings of an encoder.

    Attributes:
        encoder: ffmpeg's name.
        preset: The encoder's.
        pixel_format: Given to the encoder.
        parameters: In the encoder's own words.
        crf: Those tried.
        options: Further options of ffmpeg's encoder.
    """

    encoder: str
    preset: str
    pixel_format: str = "yuv420p"
    parameters: str = ""
    crf: Sequence[int] = _SVT_CRF
    options: dict[str, str] = field(default_factory=dict)


def _svt(parameters: str = "", *, preset: int = 6, bits: int = 10) -> Recipe:
    pixel_format = "yuv420p10le" if bits == 10 else "yuv420p"
    return Recipe("libsvtav1", str(preset), pixel_format, parameters)


_QM = "enable-qm=1:qm-min=8"
_BEST = f"hierarchical-levels=3:{_QM}"
_X265 = "log-level=error"
RECIPES = {
    "paper": _svt(bits=8),
    "restoration off": _svt("enable-restoration=0", bits=8),
    "cdef off": _svt("enable-cdef=0", bits=8),
    "no temporal filter": _svt("enable-tf=0", bits=8),
    "stronger temporal filter": _svt("tf-strength=4", bits=8),
    "aq off": _svt("aq-mode=0", bits=8),
    "variance boost": _svt("enable-variance-boost=1", bits=8),
    "levels 3": _svt("hierarchical-levels=3", bits=8),
    "qp compressed": _svt("qp-scale-compress-strength=1", bits=8),
    "ac-bias": _svt("ac-bias=1.0", bits=8),
    "qm": _svt(_QM, bits=8),
    "qm from 0": _svt("enable-qm=1:qm-min=0", bits=8),
    "transforms to 32": _svt("max-tx-size=32", bits=8),
    "tune 0": _svt("tune=0", bits=8),
    "tune 2": _svt("tune=2", bits=8),
    "preset 7": _svt(bits=8, preset=7),
    "preset 5": _svt(bits=8, preset=5),
    "preset 4": _svt(bits=8, preset=4),
    "10 bits": _svt(),
    "10 bits, qm": _svt(_QM),
    "10 bits, weaker temporal filter": _svt("tf-strength=1"),
    "10 bits, preset 7, qm": _svt(_QM, preset=7),
    "10 bits, levels 3, qm, ac-bias": _svt(f"{_BEST}:ac-bias=1.0"),
    "10 bits, levels 3, qm, ac-bias, preset 5": _svt(f"{_BEST}:ac-bias=1.0", preset=5),
    "10 bits, levels 3, qm, ac-bias, preset 7": _svt(f"{_BEST}:ac-bias=1.0", preset=7),
    "10 bits, levels 3, qm, ac-bias, preset 8": _svt(f"{_BEST}:ac-bias=1.0", preset=8),
    "preset 8": _svt(bits=8, preset=8),
    "10 bits, levels 3, qm": _svt(_BEST),
    "10 bits, levels 3, qm, preset 5": _svt(_BEST, preset=5),
    "10 bits, levels 3, qm, ac-bias 0.5": _svt(f"{_BEST}:ac-bias=0.5"),
    "10 bits, levels 4, qm, ac-bias": _svt(f"hierarchical-levels=4:{_QM}:ac-bias=1.0"),
    "10 bits, levels 3, qm from 10, ac-bias": _svt(
        "hierarchical-levels=3:enable-qm=1:qm-min=10:ac-bias=1.0"
    ),
    "10 bits, levels 3, qm, ac-bias, restoration off": _svt(
        f"{_BEST}:ac-bias=1.0:enable-restoration=0"
    ),
    "film grain 10": _svt("film-grain=10", bits=8),
    "denoised, grain 10": _svt("film-grain=10:film-grain-denoise=1", bits=8),
    "x264 medium": Recipe("libx264", "medium", crf=_X26X_CRF),
    "x264 slow, no psy": Recipe("libx264", "slow", parameters="psy=0", crf=_X26X_CRF),
    "x265 medium": Recipe("libx265", "medium", parameters=_X265, crf=_X26X_CRF),
    "x265 medium, no psy": Recipe(
        "libx265", "medium", parameters=f"{_X265}:psy-rd=0:psy-rdoq=0", crf=_X26X_CRF
    ),
}
"""The first is the baseline."""


@dataclass(frozen=True)
class Point:
    """One encoding of a clip.

    Attributes:
        crf: Of the encoder.
        kilobits: A second, at 30 frames a second.
        cpu: Seconds of encoding.
        vmaf: Mean.
        low: 5th percentile of VMAF.
        psnr: Mean of luma, dB.
        chroma: Mean of both chroma planes, dB.
        ssim: Mean of luma.
    """

    crf: int
    kilobits: float
    cpu: float
    vmaf: float
    low: float
    psnr: float
    chroma: float
    ssim: float


class Clip:
    """The frames of a clip in memory, as planes of 4:2:0 and 8 bits."""

    def __init__(self, scene: str, noise: str, frames: int, size: tuple[int, int]) -> None:
        self.name = f"{scene}, {noise}"
        self.size = size
        spec = clips.ClipSpec(scene, "rgb8", noise, frames, size)
        maker = PlaneMaker("rgb24")
        self.frames = [maker.make((rgb,)) for rgb in clips.make(spec)]

    def pictures(self, pixel_format: str) -> Iterator[av.VideoFrame]:
        """The frames for an encoder; in 10 bits the same pictures."""
        for planes in self.frames:
            frame = av.VideoFrame(*self.size, "yuv420p")
            for index, plane in enumerate(planes):
                samples(frame, index)[...] = plane
            yield widened(frame, full_range=True) if pixel_format == TEN_BITS else frame


def planes_of(frame: av.VideoFrame) -> Planes:
    """Copies of the planes of a frame of 4:2:0, full range, rounded to 8 bits."""
    if frame.format.name == TEN_BITS:
        frame = narrowed(frame)
    y, u, v = (samples(frame, index).copy() for index in range(3))
    return y, u, v


def encode(clip: Clip, recipe: Recipe, crf: int) -> tuple[list[av.Packet], Any, float]:
    """Packets, the encoder's context, and the CPU seconds that it took."""
    context: Any = av.CodecContext.create(recipe.encoder, "w")
    context.width, context.height = clip.size
    context.pix_fmt = recipe.pixel_format
    context.time_base = Fraction(1, 30)
    context.framerate = Fraction(30)
    context.gop_size = GOP
    context.color_range = 2
    context.colorspace = 1
    name = {"libsvtav1": "svtav1-params", "libx264": "x264-params", "libx265": "x265-params"}
    options = {"crf": str(crf), "preset": recipe.preset, **recipe.options}
    if recipe.parameters:
        options[name[recipe.encoder]] = recipe.parameters
    context.options = options
    frames = list(clip.pictures(recipe.pixel_format))
    before = time.process_time()
    with ordinary_scheduling():
        context.open()
    packets = []
    for number, frame in enumerate(frames):
        frame.pts = number
        packets += context.encode(frame)
    packets += context.encode(None)
    return packets, context, time.process_time() - before


def decoded(packets: Sequence[av.Packet], context: Any, encoder: str) -> Iterator[Planes]:
    """The planes of the decoded frames, in the order shown."""
    names = {"libsvtav1": "libdav1d", "libx264": "h264", "libx265": "hevc"}
    decoder: Any = av.CodecContext.create(names[encoder], "r")
    decoder.extradata = context.extradata
    found: list[tuple[int, Planes]] = []
    for packet in [*packets, None]:
        found += ((frame.pts, planes_of(frame)) for frame in decoder.decode(packet))
    return (frame for _, frame in sorted(found, key=lambda pair: pair[0]))


def measure(clip: Clip, recipe: Recipe, scorer: Scorer) -> list[Point]:
    """A point for each crf."""
    points = []
    for crf in recipe.crf:
        packets, context, cpu = encode(clip, recipe, crf)
        size = sum(packet.size for packet in packets)
        scores = scorer.score(clip.frames, decoded(packets, context, recipe.encoder))
        if scores.vmaf is None:
            raise SystemExit("no ffmpeg with libvmaf: pip install imageio-ffmpeg")
        points.append(
            Point(
                crf,
                size * 8 / 1000 / (len(clip.frames) / 30),
                cpu,
                float(scores.vmaf.mean()),
                float(np.percentile(scores.vmaf, 5)),
                float(scores.psnr_y.mean()),
                float((scores.psnr_cb.mean() + scores.psnr_cr.mean()) / 2),
                float(scores.ssim.mean()),
            )
        )
    return points


def rate(
    baseline: Sequence[Point], points: Sequence[Point], metric: str, span: tuple[float, float]
) -> float:
    """More bits than the baseline for equal quality, in percent; nan where they do not overlap."""
    curves = []
    for curve in (baseline, points):
        pairs = sorted((getattr(point, metric), np.log(point.kilobits)) for point in curve)
        curves.append(np.array(pairs).T)
    low = max(span[0], *(curve[0].min() for curve in curves))
    high = min(span[1], *(curve[0].max() for curve in curves))
    if high <= low:
        return float("nan")
    at = np.linspace(low, high, 200)
    ours, theirs = (np.interp(at, *curve) for curve in (curves[1], curves[0]))
    return float(100 * (np.exp(np.mean(ours - theirs)) - 1))


def span_of(baseline: Sequence[Point], metric: str) -> tuple[float, float]:
    """The baseline's range of a metric where its VMAF is in that which is compared."""
    top = min(RANGE[1], max(point.vmaf for point in baseline))
    span = (top - (RANGE[1] - RANGE[0]), top)
    if metric == "vmaf":
        return span
    pairs = np.array(sorted((point.vmaf, getattr(point, metric)) for point in baseline)).T
    low, high = np.interp(span, pairs[0], pairs[1])
    return float(low), float(high)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--size", type=parse_size, default=(640, 480), help="WxH")
    parser.add_argument("--recipe", nargs="+", choices=RECIPES, default=list(RECIPES))
    parser.add_argument("--clip", nargs="+", choices=[scene for scene, _ in CLIPS])
    parser.add_argument(
        "--folder",
        type=Path,
        default=Path(tempfile.gettempdir()) / "mp4ds-recipe",
        help="points that were measured stay here",
    )
    chosen = parser.parse_args()
    clips.check_data()
    os.environ.setdefault("SVT_LOG", "1")  # errors alone
    print_machine()
    print(f"- {chosen.frames} frames of {chosen.size[0]}x{chosen.size[1]}, GOP {GOP}\n", flush=True)
    chosen.folder.mkdir(parents=True, exist_ok=True)
    scorer = Scorer(find_ffmpeg())
    baseline_name = next(iter(RECIPES))
    names = [baseline_name, *(name for name in chosen.recipe if name != baseline_name)]
    results: dict[str, dict[str, list[Point]]] = {name: {} for name in names}
    for scene, noise in CLIPS:
        if chosen.clip and scene not in chosen.clip:
            continue
        clip: Clip | None = None
        for name in names:
            key = f"{scene}-{noise}-{chosen.frames}-{chosen.size[0]}x{chosen.size[1]}-{name}"
            kept = chosen.folder / f"{key.replace(' ', '_').replace(',', '')}.json"
            if not kept.is_file():
                clip = clip or Clip(scene, noise, chosen.frames, chosen.size)
                points = measure(clip, RECIPES[name], scorer)
                kept.write_text(json.dumps([vars(point) for point in points]))
            results[name][f"{scene}, {noise}"] = [
                Point(**values) for values in json.loads(kept.read_text())
            ]
    report(results, baseline_name)


def report(results: dict[str, dict[str, list[Point]]], baseline_name: str) -> None:
    """Print the tables."""
    metrics = {
        "vmaf": "VMAF",
        "low": "VMAF 5 %",
        "psnr": "PSNR-Y",
        "chroma": "PSNR-C",
        "ssim": "SSIM",
    }
    print("| recipe | " + " | ".join(metrics.values()) + " | CPU | worst clip by VMAF |")
    print("| --- |" + " --- |" * (len(metrics) + 2))
    baseline = results[baseline_name]
    for name, by_clip in results.items():
        cells = []
        worst = ("", -np.inf)
        for metric in metrics:
            rates: NDArray[np.float64] = np.array(
                [
                    rate(baseline[clip], points, metric, span_of(baseline[clip], metric))
                    for clip, points in by_clip.items()
                ]
            )
            cells.append(f"{np.nanmean(rates):+.1f} %")
            if metric == "vmaf":
                number = int(np.nanargmax(rates))
                worst = (list(by_clip)[number], float(rates[number]))
        cpu = np.mean(
            [
                sum(point.cpu for point in points) / sum(point.cpu for point in baseline[clip])
                for clip, points in by_clip.items()
            ]
        )
        print(f"| {name} | {' | '.join(cells)} | {cpu:.2f} | {worst[0]} {worst[1]:+.1f} % |")


if __name__ == "__main__":
    main()
