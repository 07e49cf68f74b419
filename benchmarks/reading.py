"""What reading costs, against the libraries that read the same files.

    python benchmarks/reading.py [--gigabytes N] [--rounds N] [--format F ...]

The recording has a camera (640x480, three bytes a pixel: noise on a gradient, 0.9 MB a message)
and an IMU (ten messages of 0.3 kB an image), written by rosbags and mcap with their own sizes of
chunks. Read are:

- mp4ds, pass: `records()`, everything in log-time order;
- mp4ds, 8 spans: eight consecutive excerpts of equal length, one reader;
- mcap: `mcap.reader.make_reader(...).iter_messages()`, and the same with ``validate_crcs``;
- rosbags: `Reader.messages()` of a bag or a rosbag2 folder, and `AnyReader.messages()`.

Nothing is deserialized. Messages and payload bytes are counted, and compared. Each figure is CPU
time, user and system, of opening and iterating in a process of its own; imports are not in it. The
ways take turns within each round. The file is in the system's cache.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from measure import print_machine, print_table, python, spread
from recordings import START_NS

SIZE = 480, 640, 3
IMUS = 10
PERIOD_NS = 33_333_333
SPANS = 8
TOPICS = {"/camera/image_raw": "sensor_msgs/msg/Image", "/imu": "sensor_msgs/msg/Imu"}
FORMATS = {
    "bag, none": ("bag", "none"),
    "bag, lz4": ("bag", "lz4"),
    "MCAP, none": ("mcap", "none"),
    "MCAP, lz4": ("mcap", "lz4"),
    "MCAP, zstd": ("mcap", "zstd"),
}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--gigabytes", type=float, default=2.0, help="of payload")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--format", action="append", choices=FORMATS, help="all by default")
    parser.add_argument("--job", help=argparse.SUPPRESS)
    parser.add_argument("--path", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.job:
        print(json.dumps(measured(JOBS[options.job], options.path)))
        return
    print_machine()
    frames = round(options.gigabytes * 1e9 / np.prod(SIZE))
    print(f"- {frames} images, {frames * IMUS} IMU messages; {options.rounds} rounds")
    rows = (
        row
        for name in options.format or FORMATS
        for row in compare(name, *FORMATS[name], frames, options.rounds)
    )
    print_table(("recording", "read by", "CPU s", "/ best library"), rows)


def compare(
    name: str, kind: str, compression: str, frames: int, rounds: int
) -> Iterator[tuple[object, ...]]:
    """The rows of one recording."""
    ways = [way for way in JOBS if way.startswith((kind, "mp4ds"))]
    cpu: dict[str, list[float]] = {way: [] for way in ways}
    with tempfile.TemporaryDirectory(prefix="mp4ds-benchmark-") as folder:
        path = write(Path(folder), kind, compression, frames)
        for _ in range(rounds):
            for way in ways:
                run = python(__file__, "--job", way, "--path", str(path))
                seconds, *counted = json.loads(run.output)
                expected = [frames * (1 + IMUS), sum(map(len, payloads(0))) * frames]
                if counted != expected:
                    raise SystemExit(f"{way} read {counted} of {name} instead of {expected}")
                cpu[way].append(seconds)
    best = min(median(cpu[way]) for way in ways if not way.startswith("mp4ds"))
    for way in ways:
        yield name, way, spread(cpu[way]), f"{median(cpu[way]) / best:.2f}"


# ---------------------------------------------------------------- writing


def payloads(number: int) -> list[bytes]:
    """An image, and the IMU messages that follow it."""
    # One field of noise, shifted: a new one for each image would take longer than all else.
    ramp, noise = _ramp_and_noise()
    start = number * 7919 % len(ramp)
    imu = noise[start : start + 320].tobytes()
    return [(ramp + noise[start : start + len(ramp)]).tobytes(), *[imu] * IMUS]


@cache
def _ramp_and_noise() -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    rows, columns, samples = SIZE
    ramp = np.linspace(40, 200, columns)[None, :, None] + np.zeros((rows, 1, samples))
    noise = np.random.default_rng(1).normal(15, 5, 2 * ramp.size).clip(0, 55)
    return ramp.astype(np.uint8).ravel(), noise.astype(np.uint8)


def recorded(frames: int) -> Iterator[tuple[str, int, bytes]]:
    """Topic, log time and payload of each message."""
    for number in range(frames):
        log_time = START_NS + number * PERIOD_NS
        image, *imus = payloads(number)
        yield "/camera/image_raw", log_time, image
        for place, imu in enumerate(imus, 1):
            yield "/imu", log_time + place * 3_000_000, imu


def write(folder: Path, kind: str, compression: str, frames: int) -> Path:
    """The recording, for MCAP as a rosbag2 folder, so that rosbags reads it, too."""
    if kind == "bag":
        write_bag(folder / "drive.bag", recorded(frames), compression)
        return folder / "drive.bag"
    path = folder / "drive_0.mcap"
    write_mcap(path, recorded(frames), compression)
    write_metadata(folder, path.name, frames)
    return path


def write_bag(path: Path, messages: Iterable[tuple[str, int, bytes]], compression: str) -> None:
    """A ROS 1 bag."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    writer = Writer(path)
    if compression != "none":
        writer.set_compression(Writer.CompressionFormat[compression.upper()])
    with writer:
        connections = {
            topic: writer.add_connection(topic, msgtype, typestore=store)
            for topic, msgtype in TOPICS.items()
        }
        for topic, log_time, payload in messages:
            writer.write(connections[topic], log_time, payload)


def write_mcap(path: Path, messages: Iterable[tuple[str, int, bytes]], compression: str) -> None:
    """An MCAP file of ROS 2."""
    from mcap.writer import CompressionType, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType[compression.upper()])
        writer.start("ros2", "recorder")
        channels = {}
        for topic, msgtype in TOPICS.items():
            definition = store.generate_msgdef(msgtype, ros_version=2)[0].encode()
            schema = writer.register_schema(msgtype, "ros2msg", definition)
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        for topic, log_time, payload in messages:
            writer.add_message(channels[topic], log_time, payload, log_time)
        writer.finish()  # type: ignore[no-untyped-call]


def write_metadata(folder: Path, name: str, frames: int) -> None:
    """A metadata.yaml of version 5."""
    span = {
        "duration": {"nanoseconds": frames * PERIOD_NS},
        "starting_time": {"nanoseconds_since_epoch": START_NS},
        "message_count": frames * (1 + IMUS),
    }
    topics = [
        {
            "topic_metadata": {
                "name": topic,
                "type": msgtype,
                "serialization_format": "cdr",
                "offered_qos_profiles": "",
            },
            "message_count": frames * (IMUS if topic == "/imu" else 1),
        }
        for topic, msgtype in TOPICS.items()
    ]
    information = {
        "version": 5,
        "storage_identifier": "mcap",
        **span,
        "topics_with_message_count": topics,
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [name],
        "files": [{"path": name, **span}],
    }
    text = json.dumps({"rosbag2_bagfile_information": information})  # JSON is YAML, too
    (folder / "metadata.yaml").write_text(text)


# ---------------------------------------------------------------- reading

Opener = Callable[[Path], Any]


def measured(way: Callable[[], Opener], path: Path) -> tuple[float, int, int]:
    """CPU seconds, messages and payload bytes of one way to read."""
    read = way()  # imports
    before = time.process_time()
    count = size = 0
    with read(path) as messages:
        for length in messages:
            count += 1
            size += length
    return time.process_time() - before, count, size


def by_mp4ds(spans: int) -> Opener:
    """Our reader, in one pass or in several spans."""
    from mp4ds.bags.formats import open_reader
    from mp4ds.records import EVERYTHING, Excerpt, Message

    @contextmanager
    def read(path: Path) -> Iterator[Iterator[int]]:
        with open_reader(path) as reader:
            yield lengths(reader)

    def lengths(reader: Any) -> Iterator[int]:
        for excerpt in excerpts(reader) if spans > 1 else [EVERYTHING]:
            for record in reader.records(excerpt):
                if isinstance(record, Message):
                    yield len(record.data)

    def excerpts(reader: Any) -> list[Any]:
        stats = reader.stats().values()
        start, end = min(item.start for item in stats), max(item.end for item in stats)
        edges = np.linspace(start, end, spans + 1, dtype=np.int64).tolist()[1:-1]
        return [Excerpt(a, b) for a, b in zip([None, *edges], [*edges, None], strict=True)]

    return read


def by_mcap(*, validate: bool) -> Opener:
    """The mcap library."""
    from mcap.reader import make_reader

    @contextmanager
    def read(path: Path) -> Iterator[Iterator[int]]:
        with path.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=validate)
            yield (len(message.data) for _, _, message in reader.iter_messages())

    return read


def by_rosbags(name: str) -> Opener:
    """A reader of rosbags."""
    from rosbags import highlevel, rosbag1, rosbag2

    @contextmanager
    def read(path: Path) -> Iterator[Iterator[int]]:
        path = path if path.suffix == ".bag" else path.parent
        opened: Any = {
            "rosbag1": lambda: rosbag1.Reader(path),
            "rosbag2": lambda: rosbag2.Reader(path),
            "any": lambda: highlevel.AnyReader([path]),
        }[name]()
        with opened as reader:
            yield (len(data) for _, _, data in reader.messages())

    return read


JOBS: dict[str, Callable[[], Opener]] = {
    "mp4ds, pass": lambda: by_mp4ds(1),
    f"mp4ds, {SPANS} spans": lambda: by_mp4ds(SPANS),
    "bag: rosbags Reader": lambda: by_rosbags("rosbag1"),
    "bag: rosbags AnyReader": lambda: by_rosbags("any"),
    "mcap: mcap": lambda: by_mcap(validate=False),
    "mcap: mcap, checksums": lambda: by_mcap(validate=True),
    "mcap: rosbags Reader, checksums": lambda: by_rosbags("rosbag2"),
}


if __name__ == "__main__":
    main()
