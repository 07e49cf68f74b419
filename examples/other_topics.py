"""Read the topics that are not videos: messages.mcap of a dataset is an ordinary MCAP file.

python examples/other_topics.py DATASET     (packed from ROS 2)
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory


def main(path: str) -> None:
    """Decode every message that has a definition, and print how many there are of each topic."""
    counts: Counter[str] = Counter()
    with (Path(path) / "messages.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for schema, channel, _, message in reader.iter_decoded_messages():
            counts[f"{channel.topic} ({schema.name if schema else '-'})"] += 1
            if hasattr(message, "linear_acceleration") and counts.total() < 100:
                print(f"{channel.topic}: acceleration {message.linear_acceleration.z:.2f} m/s2")
    for name, count in counts.items():
        print(f"{name}: {count} messages")


if __name__ == "__main__":
    main(sys.argv[1])
