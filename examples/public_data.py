"""A public recording, end to end: into a dataset, how small, how good, as a page, and out again.

python examples/public_data.py KIND SOURCE OUT [--rate HZ] [--frames N] [--crf A:B:STEP]

KIND is recording (a bag or MCAP, such as one of EuRoC, TUM RGB-D or nuScenes) or images (a folder
of one camera, with --rate). docs/public-data.md says where to get each. OUT gets two datasets
(lossless, visual), an evaluation of encoder settings with VMAF where that is installed, a report,
and an export; a table is printed.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import mp4ds


def main() -> None:
    """Go through all steps and print what each came to."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("kind", choices=["recording", "images"])
    parser.add_argument("source", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--rate", help="of a plain folder of images")
    parser.add_argument("--frames", type=int, default=60, help="of the clip that is evaluated")
    parser.add_argument("--crf", default="14:50:6", help="what is evaluated")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    print("| step | result |\n| --- | --- |")
    for step, result in steps(options):
        print(f"| {step} | {result} |", flush=True)


def steps(options: argparse.Namespace) -> Iterator[tuple[str, str]]:
    """What is done, and what it came to."""
    images = None
    if options.kind == "images":
        images = mp4ds.ImportOptions(rate=options.rate)
    sizes = {}
    for quality in ("lossless", "visual"):
        target = options.out / quality
        chosen = mp4ds.PackOptions(
            quality=quality, images=images, transcode=quality == "visual", force=True
        )
        mp4ds.pack(options.source, target, chosen)
        sizes[quality] = size_of(target)
    exact = options.out / "lossless"
    problems = mp4ds.validate(exact, deep=True)
    yield "validate lossless --deep", f"{len(problems)} problems"
    with mp4ds.open(exact) as dataset:
        for stream in dataset.streams:
            count, (width, height) = len(stream), stream.image_size
            yield f"{stream.topic}", f"{count} frames, {stream.encoding} {width}x{height}"
        pixels = sum(frame.data.nbytes for topic in dataset for frame in topic)
    source = size_of(options.source)
    yield "pixels", f"{pixels / 1e6:.1f} MB"
    yield "source", f"{source / 1e6:.1f} MB"
    for quality, size in sizes.items():
        yield quality, f"{size / 1e6:.1f} MB, {pixels / size:.1f} times smaller than the pixels"
    yield from evaluation(exact, options)
    summary = mp4ds.report(exact)
    yield "report", f"{summary.index}, {len(summary.cameras)} cameras"
    target = options.out / "euroc"
    exported = mp4ds.export(exact, "euroc", target, mp4ds.ExportOptions(force=True))
    left = sum(count for reasons in exported.left_out.values() for count in reasons.values())
    yield "export euroc", f"{sum(exported.messages.values())} messages held, {left} left out"


def evaluation(dataset: Path, options: argparse.Namespace) -> Iterator[tuple[str, str]]:
    """The smallest setting for each camera that reaches a score."""
    target = "vmaf=97" if find_spec("imageio_ffmpeg") else "psnr_y=42"
    chosen = mp4ds.EvaluateOptions(
        codecs=["av1", "h264"],
        presets=["8", "veryfast"],
        crf=[options.crf],
        frames=options.frames,
        target=target,
    )
    found = mp4ds.evaluate(dataset, chosen, output=options.out / "evaluation")
    for camera in found.cameras:
        if not camera.recommended:
            yield f"evaluate {camera.topic}", f"no setting of the grid reaches {target}"
            continue
        best = camera.recommended[0]
        cell = next(cell for cell in camera.cells if cell.setting == best.setting)
        score = f"{best.score:.1f} ({target})"
        yield (
            f"evaluate {camera.topic}",
            f"{best.options}: {score}, {cell.frame_bytes / 1e3:.1f} kB/frame",
        )


def size_of(path: Path) -> int:
    """Bytes of a file, or of all files in a folder."""
    if path.is_file():
        return path.stat().st_size
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())


if __name__ == "__main__":
    main()
