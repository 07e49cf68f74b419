"""What it takes to keep a score: `--quality vmaf=99.0` on the clips of clips.py.

    python benchmarks/quality.py [--quality Q] [--frames N] [--size WxH] [--clip NAME ...]

Each clip, a real scene through a modelled sensor, becomes a recording and is packed by one process,
one encoder thread, in one pass. Printed are

    mean, 5 %, worst window    what the sidecar tells
    crf                        that of the search, and the least and most of the windows
    search                     encodings of samples before the stream began
    windows                    how many (of them limited by their originals), and their encodings
    search s, windows s        seconds of encoding, decoding and scoring
    pack s                     of the whole pack
    visual / this              bytes of the same clip with --quality visual beside these
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

import clips
import mp4ds
from measure import parse_size, print_machine, print_table
from mp4ds.packing.target import CrfControl, WindowCoder
from recordings import write_mcap

HERTZ = 30.0
SAMPLES = "sample.mp4"


@dataclass
class Watch:
    """What encodings took.

    Attributes:
        search: Seconds of each encoding of samples.
        windows: Of each encoding of a window.
        crfs: Of each window, as it was kept.
    """

    search: list[float] = field(default_factory=list)
    windows: list[float] = field(default_factory=list)
    crfs: list[int] = field(default_factory=list)


@contextmanager
def watched() -> Iterator[Watch]:
    """Measure the encodings of packs."""
    watch, encode, keep = Watch(), WindowCoder.encode, CrfControl.keep

    def timed(
        coder: WindowCoder, frames: Any, ticks: Sequence[int], crf: int, path: Path
    ) -> np.ndarray[Any, Any]:
        begun = time.perf_counter()
        found = encode(coder, frames, ticks, crf, path)
        is_sample = path.name == SAMPLES
        (watch.search if is_sample else watch.windows).append(time.perf_counter() - begun)
        return found

    def kept(control: CrfControl, tried: Any, crf: int, *facts: Any) -> None:
        watch.crfs.append(crf)
        keep(control, tried, crf, *facts)

    with (
        mock.patch.object(WindowCoder, "encode", timed),
        mock.patch.object(CrfControl, "keep", kept),
    ):
        yield watch


def measured(spec: clips.ClipSpec, quality: str, folder: Path) -> list[str]:
    """The row of a clip."""
    source = folder / "clip.mcap"
    write_mcap(
        source, clips.make(spec), spec.frames, spec.encoding, compression="none", hertz=HERTZ
    )
    # one window of the pack, so that it is done by this process
    options = {"window": 10 * spec.frames + 2, "jobs": 1, "force": True}
    begun = time.perf_counter()
    with watched() as watch:
        mp4ds.pack(source, folder / "kept", mp4ds.PackOptions(quality=quality, **options))
    seconds = time.perf_counter() - begun
    mp4ds.pack(source, folder / "visual", mp4ds.PackOptions(quality="visual", **options))
    with mp4ds.open(folder / "kept") as kept, mp4ds.open(folder / "visual") as visual:
        video = kept.streams[0].sidecar.video
        beside = (visual.streams[0].sidecar.video.size or 0) / (video.size or 1)
    if video.quality is None:
        return [spec.name, "lossless", *[""] * 7]
    found, crfs = video.quality, watch.crfs
    return [
        f"{spec.scene}, {spec.encoding}, {spec.noise}",
        f"{found.mean:.2f}, {found.p5:.2f}, {found.worst_window:.2f}",
        f"{video.options['crf']}; {min(crfs)} to {max(crfs)}",
        str(len(watch.search)),
        f"{found.windows} ({found.limited}), {len(watch.windows)}",
        f"{sum(watch.search):.1f}",
        f"{sum(watch.windows):.1f}",
        f"{seconds:.1f}",
        f"{beside:.2f}",
    ]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--quality", default="vmaf=99.0")
    parser.add_argument("--frames", type=int, default=240)
    parser.add_argument("--size", type=parse_size, default=(640, 480), help="WxH")
    parser.add_argument("--encoding", choices=clips.CAMERA_FAMILIES, default="bayer_rggb8")
    parser.add_argument("--noise", choices=list(clips.SENSORS), default="low")
    parser.add_argument("--clip", nargs="*", default=None, help=", ".join(clips.MOVING))
    options = parser.parse_args()
    clips.check_data()
    print_machine()
    print(f"- {options.quality}, {options.frames} frames of {options.size}", flush=True)
    scenes = options.clip or list(clips.MOVING) if clips.data_folder() else [clips.DEMO]
    specs = [
        clips.ClipSpec(scene, options.encoding, options.noise, options.frames, options.size)
        for scene in scenes
    ]
    header = [
        *("clip", "mean, 5 %, worst window", "crf", "search", "windows"),
        *("search s", "windows s", "pack s", "visual / this"),
    ]
    with tempfile.TemporaryDirectory(prefix="mp4ds-benchmark-") as folder:
        print_table(header, (measured(spec, options.quality, Path(folder)) for spec in specs))


if __name__ == "__main__":
    main()
