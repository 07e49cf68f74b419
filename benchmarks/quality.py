"""What it takes to keep a score: `--quality vmaf=99.0` on the clips of clips.py.

    python benchmarks/quality.py [--quality Q] [--frames N] [--size WxH] [--clip NAME ...]

Each clip, a real scene through a modelled sensor, becomes a recording and is packed by one process,
one encoder thread, in one pass. Printed are

    mean, 5 %, worst window    what the sidecar says
    crf                        that of the search on the first images
    windows                    how many; of them limited by their originals, and encoded again
    pack s                     of the whole pack
    visual / this              bytes of the same clip with --quality visual beside these
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import clips
import mp4ds
from measure import parse_size, parser_of, print_machine, print_table
from recordings import write_mcap


def measured(spec: clips.ClipSpec, quality: str, folder: Path) -> list[str]:
    """The row of a clip."""
    source = folder / "clip.mcap"
    write_mcap(source, clips.make(spec), spec.encoding, compression="none")
    # one window of the pack, so that it is done by this process
    options = {"window": 10 * spec.frames + 2, "jobs": 1, "force": True}
    begun = time.perf_counter()
    mp4ds.pack(source, folder / "kept", mp4ds.PackOptions(quality=quality, **options))
    seconds = time.perf_counter() - begun
    mp4ds.pack(source, folder / "visual", mp4ds.PackOptions(quality="visual", **options))
    with mp4ds.open(folder / "kept") as kept, mp4ds.open(folder / "visual") as visual:
        video = kept.streams[0].sidecar.video
        beside = (visual.streams[0].sidecar.video.size or 0) / (video.size or 1)
    if video.quality is None:
        return [spec.name, "lossless", *[""] * 4]
    found = video.quality
    return [
        f"{spec.scene}, {spec.encoding}, {spec.noise}",
        f"{found.mean:.2f}, {found.p5:.2f}, {found.worst_window:.2f}",
        video.options["crf"],
        f"{found.windows}; {found.limited}, {found.reencoded}",
        f"{seconds:.1f}",
        f"{beside:.2f}",
    ]


def main() -> None:
    """Measure and print."""
    parser = parser_of(__doc__)
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
    header = ["clip", "mean, 5 %, worst window", "crf", "windows", "pack s", "visual / this"]
    with tempfile.TemporaryDirectory(prefix="mp4ds-benchmark-") as folder:
        print_table(header, (measured(spec, options.quality, Path(folder)) for spec in specs))


if __name__ == "__main__":
    main()
