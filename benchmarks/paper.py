"""The tables of the paper, of a clip with a camera's noise (see docs/paper.md).

    python benchmarks/paper.py [--scene cups] [--frames N] [--folder F]

A Bayer camera of 640x480 at 30 Hz is recorded in a bag (see clips.py), and `mp4ds evaluate` is
run on it for each table; its own output is what is printed.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import clips
from measure import print_machine
from recordings import write_bag

HERTZ = 30.0
TABLES = {
    "encoders and presets, and the size of the data set": (
        *("--codecs", "svtav1,x264,x265", "--crf", "16,19,22,25"),
        *("--presets", "6,8,10,veryfast,medium", "--streams", "9", "--hours", "10"),
    ),
    "the crf for each frame rate": (
        *("--codecs", "svtav1", "--presets", "6", "--crf", "20"),
        *("--rates", "2,5,10,30", "--target", "vmaf=99.5"),
    ),
}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--scene", default="cups", choices=clips.MOVING)
    parser.add_argument("--noise", default="low", choices=clips.SENSORS)
    parser.add_argument("--frames", type=int, default=90)
    parser.add_argument("--folder", type=Path, help="keeps the recording and the evaluations")
    arguments = parser.parse_args()
    clips.check_data()
    print_machine()
    with tempfile.TemporaryDirectory() as made:
        folder = arguments.folder or Path(made)
        folder.mkdir(parents=True, exist_ok=True)
        spec = clips.ClipSpec(
            arguments.scene, "bayer_rggb8", arguments.noise, arguments.frames, (640, 480)
        )
        bag = folder / f"{spec.name}.bag"
        if not bag.exists():
            frames = clips.load(spec)
            write_bag(bag, frames, len(frames), spec.encoding, hertz=HERTZ)
        for number, (title, options) in enumerate(TABLES.items()):
            print(f"\n### {title}\n", flush=True)
            command = [sys.executable, "-m", "mp4ds", "evaluate", str(bag), *options]
            output = ("--output", str(folder / f"table{number}"))
            subprocess.run([*command, *output], check=True)


if __name__ == "__main__":
    main()
