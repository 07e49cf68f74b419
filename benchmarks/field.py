"""One recording in the forms that the field uses: how small, and how near to what was recorded.

    python benchmarks/field.py [--frames N] [--size WxH] [--noise N ...] [--roscompress PROGRAM]
                               [--plot SVG]

Clips of clips.py, rgb8 at 30 Hz, each recorded as an MCAP file of a camera and its camera_info:

- rosbag2, zstd: as ``ros2 bag record --compression-mode message --compression-format zstd`` keeps
  it, written by rosbags.
- roscompress: what ``pymcap-cli roscompress`` makes of the MCAP with its own settings; left out
  where the program is missing (``pip install 'pymcap-cli[video,pointcloud]'``).
- ffmpeg_image_transport: the packets of its default settings, encoded by PyAV: x264, a key frame
  every 15, qmax 10, 8.2 Mbit/s.
- LeRobot v3: a video with LeRobot's default settings, encoded as LeRobot calls PyAV.
- mp4ds, and mp4ds visual: ``mp4ds pack``, and with ``--quality visual``.

Sizes are those of all files. PSNR is that of all values of all frames in RGB, against the recorded
ones; lossless forms are compared to the byte.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from statistics import geometric_mean
from typing import Any

import numpy as np
from mcap.reader import make_reader
from numpy.typing import NDArray
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Writer
from rosbags.typesys import Stores, get_typestore

import clips
import mp4ds
from loader_readers import write_video
from measure import (
    figure_of,
    parse_size,
    parser_of,
    print_machine,
    print_table,
    psnr,
    save,
    size_of,
)
from recordings import write_mcap

TRANSPORT = {"qmax": "10", "b": "8242880", "g": "15", "bf": "0"}
"""Of x264, as ffmpeg_image_transport 3 sets it unless asked."""
Pixels = NDArray[np.uint8]
Made = tuple[Path, Path | None]
"""A file or folder, which counts as a whole, and what its frames are read from, if it is lossy."""
Make = Callable[[Path, Pixels, Path], Made]


def rosbag2(source: Path, frames: Pixels, folder: Path) -> Made:
    """Each message compressed by itself."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    target = folder / "rosbag2"
    writer = Writer(target, version=9)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with source.open("rb") as stream, writer:
        connections: dict[str, Any] = {}
        for schema, channel, message in make_reader(stream).iter_messages():
            if channel.topic not in connections and schema:
                connections[channel.topic] = writer.add_connection(
                    channel.topic, schema.name, typestore=store
                )
            writer.write(connections[channel.topic], message.log_time, message.data)
    return target, None


def roscompress(program: str) -> Make:
    """An MCAP of CompressedVideo."""

    def make(source: Path, frames: Pixels, folder: Path) -> Made:
        target, readable = folder / "roscompress.mcap", folder / "roscompress"
        command = [program, "roscompress", str(source), "--output", str(target)]
        subprocess.run(command, check=True, capture_output=True)
        mp4ds.pack(target, readable)  # copies its packets, so that frames can be read
        return target, readable

    return make


def transport(source: Path, frames: Pixels, folder: Path) -> Made:
    """The same packets in an mp4."""
    target = folder / "transport.mp4"
    write_video(target, iter(frames), "libx264", TRANSPORT)
    return target, target


def lerobot(source: Path, frames: Pixels, folder: Path) -> Made:
    """A video alone; the table beside it is small."""
    target = folder / "lerobot.mp4"
    write_video(target, iter(frames))
    return target, target


def packed(quality: str) -> Make:
    """A dataset."""

    def make(source: Path, frames: Pixels, folder: Path) -> Made:
        target = folder / quality
        mp4ds.pack(source, target, mp4ds.PackOptions(quality=quality))
        return target, target

    return make


def forms(program: str | None) -> dict[str, Make]:
    """All forms that can be made here.

    Args:
        program: What is called for roscompress; None without it.
    """
    return {
        "rosbag2, zstd": rosbag2,
        **({"roscompress": roscompress(program)} if program else {}),
        "ffmpeg_image_transport": transport,
        "LeRobot v3": lerobot,
        "mp4ds": packed("lossless"),
        "mp4ds visual": packed("visual"),
    }


def error_of(video: Path | None, frames: Pixels) -> float:
    """The mean squared error of the values of a video; 0 without."""
    if video is None:
        return 0.0
    with mp4ds.open(video) as dataset:
        (topic,) = dataset.topics
        stream = dataset[topic]
        if len(stream) != len(frames):
            raise SystemExit(f"{video} has {len(stream)} frames of {len(frames)}.")
        total = 0.0
        for number, frame in enumerate(frames):
            found = stream.read([number], format="rgb")[0]
            total += float(np.mean((found.astype(np.float64) - frame) ** 2))
    return total / len(frames)


def rows(options: argparse.Namespace) -> Iterator[tuple[object, ...]]:
    """One for each clip and form, and one for each form of all clips."""
    ratios, errors = defaultdict(list), defaultdict(list)
    for scene in clips.MOVING:
        for noise in options.noise:
            spec = clips.ClipSpec(scene, "rgb8", noise, options.frames, options.size)
            frames = clips.load(spec)
            for form, ratio, error in measure(frames, forms(shutil.which(options.roscompress))):
                ratios[form].append(ratio)
                errors[form].append(error)
                yield scene, noise, form, f"{ratio:.1f}", psnr(error)
    quality = {form: psnr(float(np.mean(found))) for form, found in errors.items()}
    for form, found in ratios.items():
        told = f"{geometric_mean(found):.1f} ({min(found):.1f} to {max(found):.1f})"
        yield "all", "", form, told, quality[form]
    if options.plot:
        draw({form: (found, quality[form]) for form, found in ratios.items()}, options.plot)


def measure(frames: Pixels, makers: dict[str, Make]) -> Iterator[tuple[str, float, float]]:
    """Raw size over size, and the error, of each form."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        source = folder / "clip.mcap"
        write_mcap(source, frames, "rgb8", compression="none")
        for form, make in makers.items():
            path, video = make(source, frames, folder)
            yield form, source.stat().st_size / size_of(path), error_of(video, frames)


def draw(found: Mapping[str, tuple[Sequence[float], str]], path: Path) -> None:
    """Draw how much smaller each form is, and how near.

    Args:
        found: Form -> raw size over size of each clip, and the PSNR as text.
        path: The SVG to make.
    """
    figure, axes = figure_of((9, 3.4))
    for row, (form, (ratios, quality)) in enumerate(reversed(found.items())):
        color = "#1d6ff2" if form.startswith("mp4ds") else "#8a94a6"
        middle = geometric_mean(ratios)
        axes.barh(row, middle, color=color, height=0.6)
        axes.plot([min(ratios), max(ratios)], [row, row], color="#1f2937", linewidth=1.2)
        is_exact = quality == "exact"
        text = f"{middle:.3g}\u00d7, {quality if is_exact else f'{quality} dB'}"
        weight = "bold" if is_exact else "normal"
        place = {"xytext": (8, 0), "textcoords": "offset points", "va": "center"}
        axes.annotate(text, (max(ratios), row), fontweight=weight, **place)
    axes.set_yticks(range(len(found)), [*reversed(found)])
    axes.set(xscale="log", xlim=(1, 5000), xlabel="times smaller than raw; least to most")
    axes.xaxis.set_major_formatter("{x:.0f}")
    axes.grid(visible=False, axis="y")
    axes.set_axisbelow(True)
    save(figure, path)


def main() -> None:
    """Measure and print."""
    parser = parser_of(__doc__)
    parser.add_argument("--frames", type=int, default=90)
    parser.add_argument("--size", type=parse_size, default=(640, 480), help="WxH")
    parser.add_argument("--noise", nargs="+", choices=clips.SENSORS, default=[*clips.SENSORS])
    parser.add_argument("--roscompress", default="pymcap-cli", metavar="PROGRAM")
    parser.add_argument("--plot", type=Path, metavar="SVG", help="drawn with matplotlib")
    options = parser.parse_args()
    clips.check_data()
    print_machine()
    header = ("clip", "noise", "form", "smaller than raw", "PSNR of RGB, dB")
    print_table(header, rows(options))


if __name__ == "__main__":
    main()
