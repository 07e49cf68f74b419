"""Draw random frames of every camera of a dataset, with their stamps and intrinsics.

python examples/frames.py DATASET
"""

from __future__ import annotations

import random
import sys

import mp4ds


def main(path: str) -> None:
    """Print a line for three random frames of each camera."""
    with mp4ds.open(path) as dataset:
        for stream in dataset:
            for index in sorted(random.sample(range(len(stream)), min(3, len(stream)))):
                frame = stream[index]
                focal = frame.intrinsics.k[0] if frame.intrinsics else float("nan")
                print(
                    f"{stream.topic} frame {index}: stamp {frame.stamp_ns} ns, "
                    f"{frame.encoding} {frame.data.shape}, mean {frame.data.mean():.1f}, fx {focal}"
                )


if __name__ == "__main__":
    main(sys.argv[1])
