"""Ways of making RGB of halved chroma: how near the original they are, and what they cost.

    python benchmarks/colours.py VIDEO... [--crf CRF ...] [--frames N]

Videos are reduced to half their sides, so that their own halved chroma does not count, coded by
SVT-AV1 as `visual` is, and decoded. The PSNR is that of RGB; the time that of one thread and a
frame of 720p, the least of many. "Linear" is between the centres of chroma samples. Then what the
limited range costs beside the full one: before coding, and in bytes at equal PSNR.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import av
import numpy as np
from av.video.reformatter import VideoReformatter
from numpy.typing import NDArray

from measure import print_machine, print_table
from mp4ds.video import colour
from mp4ds.video.pixels import PictureConverter
from mp4ds.video.scores import psnr

_BICUBIC, _NEAREST, _CARE = 0x4, 0x10, 0x6000 | 0x40000 | 0x80000  # libswscale's flags
_LINEAR = (0, 24), (1, 8), (-1, 0), (2, 0)
_CURVE = (14, 16, 18, 20, 24, 30)
Convert = Callable[[av.VideoFrame], NDArray[np.uint8]]


def ours(frame: av.VideoFrame) -> NDArray[np.uint8]:
    """As spec/index.md says, "Colours"."""
    return colour.rgb(frame, "bt709", full_range=True)


def by_numpy(frame: av.VideoFrame) -> NDArray[np.uint8]:
    """The same where nothing was compiled."""
    kept, colour._compiled = colour._compiled, lambda: None  # type: ignore[assignment]
    try:
        return ours(frame)
    finally:
        colour._compiled = kept


def linear(frame: av.VideoFrame) -> NDArray[np.uint8]:
    """With other weights, by numpy."""
    kept, colour._TAPS = colour._TAPS, _LINEAR
    try:
        return by_numpy(frame)
    finally:
        colour._TAPS = kept


def libswscale(flags: int, *steps: str) -> Convert:
    """By libswscale, in one step or several."""
    reformatters = [VideoReformatter() for _ in steps]

    def convert(frame: av.VideoFrame) -> NDArray[np.uint8]:
        for reformatter, step in zip(reformatters, steps, strict=True):
            options: dict[str, Any] = {"interpolation": flags, "threads": 1}
            for side in ("src", "dst"):
                options |= {f"{side}_colorspace": "ITU709", f"{side}_color_range": "JPEG"}
            frame = reformatter.reformat(frame, format=step, **options)
        plane: Any = frame.planes[0]
        rows = np.frombuffer(plane, np.uint8).reshape(frame.height, -1)
        return rows[:, : 3 * frame.width].reshape(frame.height, frame.width, 3)

    return convert


WAYS: dict[str, Convert] = {
    "mp4ds": ours,
    "mp4ds, by numpy": by_numpy,
    "linear, by numpy": linear,
    "libswscale, bicubic": libswscale(_BICUBIC | _CARE, "gbrp", "rgb24"),
    "libswscale, nearest": libswscale(_NEAREST, "rgb24"),
}


def halved(path: str, count: int) -> list[NDArray[np.uint8]]:
    """The first frames of a video, in half the size."""
    found: list[NDArray[np.uint8]] = []
    with av.open(path) as video:
        for frame in video.decode(video=0):
            rgb = frame.to_ndarray(format="rgb24")
            rows, columns = (side // 4 * 4 for side in rgb.shape[:2])
            blocks = rgb[:rows, :columns].reshape(rows // 2, 2, columns // 2, 2, 3)
            found.append(blocks.mean((1, 3)).round().astype(np.uint8))
            if len(found) == count:
                break
    return found


def coded(
    pictures: list[NDArray[np.uint8]], crf: int, *, full_range: bool = True
) -> tuple[list[av.VideoFrame], int]:
    """What is decoded of pictures, and the bytes that they take."""
    converter = PictureConverter(full_range=full_range)
    encoder: Any = av.CodecContext.create("libsvtav1", "w")
    encoder.height, encoder.width = pictures[0].shape[:2]
    encoder.pix_fmt, encoder.time_base = "yuv420p", Fraction(1, 30)
    encoder.options = {
        "crf": str(crf),
        "preset": "7",
        "svtav1-params": f"color-range={int(full_range)}",
    }
    decoder: Any = av.CodecContext.create("libdav1d", "r")
    packets = []
    for number, picture in enumerate(pictures):
        frame = av.VideoFrame.from_numpy_buffer(picture, format="rgb24")
        frame = converter.convert(frame, "yuv420p")
        frame.pts = number
        packets += encoder.encode(frame)
    packets += encoder.encode(None)
    frames = [frame for packet in packets for frame in decoder.decode(packet)]
    return [*frames, *decoder.decode(None)], sum(packet.size for packet in packets)


def cost_of_range(pictures: list[NDArray[np.uint8]], crfs: list[int]) -> list[str]:
    """Of the limited one: dB before coding, and per cent of bytes at the PSNR of each crf."""
    curves, lost = {}, []
    for full_range in (True, False):
        converter = PictureConverter(full_range=full_range)
        frames = [
            converter.convert(av.VideoFrame.from_numpy_buffer(picture, format="rgb24"), "yuv420p")
            for picture in pictures
        ]
        lost.append(mean_psnr(frames, pictures, full_range))
        found = {crf: coded(pictures, crf, full_range=full_range) for crf in _CURVE}
        curves[full_range] = [
            (mean_psnr(frames, pictures, full_range), size) for frames, size in found.values()
        ]
    likeness, sizes = zip(*sorted(curves[False]), strict=True)
    told = [f"{lost[0] - lost[1]:.2f} dB"]
    for crf in crfs:
        due, size = curves[True][_CURVE.index(crf)]
        needed = np.exp(np.interp(due, likeness, np.log(sizes)))
        told.append(f"{100 * (needed / size - 1):+.0f} %")
    return told


def mean_psnr(
    frames: list[av.VideoFrame], pictures: list[NDArray[np.uint8]], full_range: bool
) -> float:
    """Of RGB, in dB."""
    pairs = zip(frames, pictures, strict=True)
    found = (psnr(colour.rgb(a, "bt709", full_range=full_range), b) for a, b in pairs)
    return float(np.mean(list(found)))


def least_ms(convert: Convert) -> float:
    """Of a frame of 720p."""
    frame = av.VideoFrame(1280, 720, "yuv420p")
    least = float("inf")
    for _ in range(50):
        start = time.perf_counter()
        convert(frame)
        least = min(least, time.perf_counter() - start)
    return 1000 * least


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("videos", nargs="+")
    parser.add_argument("--crf", type=int, nargs="+", default=[20, 30])
    parser.add_argument("--frames", type=int, default=20)
    options = parser.parse_args()
    print_machine()
    print(f"- compiled: {colour._compiled() is not None}\n")
    header, values = ["way", "ms"], {name: [] for name in WAYS}
    ranges = []
    for path in options.videos:
        pictures = halved(path, options.frames)
        ranges.append((path.rsplit("/", 1)[-1], *cost_of_range(pictures, [18, 30])))
        for crf in options.crf:
            header.append(f"{path.rsplit('/', 1)[-1]}, crf {crf}")
            frames, _ = coded(pictures, crf)
            for name, convert in WAYS.items():
                pairs = zip(frames, pictures, strict=True)
                found = [psnr(convert(frame), picture) for frame, picture in pairs]
                values[name].append(f"{np.mean(found):.2f}")
    rows = [(name, f"{least_ms(way):.2f}", *values[name]) for name, way in WAYS.items()]
    print_table(header, rows)
    print_table(("limited range", "before coding", "bytes as of crf 18", "of crf 30"), ranges)


if __name__ == "__main__":
    main()
