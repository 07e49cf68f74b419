"""What `mp4ds play` does in ROS 1 beside ``rosbag play`` of the recording itself.

    python benchmarks/playing.py [--seconds S] [--rounds N] [--only SECTION ...] [--folder F]

needs ROS 1 (see `.ci/run`): a real master, in a network of its own where that is possible, players
and an ordinary subscriber, by rospy. A grey camera of the scene ``cups`` with the noise of daylight
(see clips.py) is recorded at 640x480 and 30 Hz, and at 2448x2048 and 10 Hz, and packed. Sections:

- timing: how much later than planned messages arrive. The player's zero is not known to others, so
  that of each run is its least late message. Players take turns.
- rate: the recording's time over that of arrival, from the first message to the last, in percent of
  what was asked for.
- most: frames a second at which all arrive and the asked rate is kept within 3 %: in steps of a
  quarter, the last one that holds; and what is read for a frame.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Reader
from rosbags.typesys import Stores, get_typestore

import clips
from measure import parser_of, print_machine, print_table, size_of
from measure import python as measured
from recordings import TOPIC, write_bag

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from roscore import PLAY, Core, missing, python

RECEIVER = str(Path(__file__).with_name("playing_receiver.py"))
NS = 10**9
RATES = (0.1, 0.5, 1.0, 2.0, 10.0)
STEP = 1.25
MAX_RATE = 64.0


@dataclass(frozen=True)
class Camera:
    """A recorded camera, in all forms that are played."""

    name: str
    hertz: float
    bag: Path
    lossless: Path
    visual: Path
    log_times: dict[int, int]  # by stamp, ns

    @property
    def frames(self) -> int:
        """How many were recorded."""
        return len(self.log_times)


@dataclass(frozen=True)
class Played:
    """What a subscriber got, and what it cost.

    Attributes:
        stamps: Of the messages in order of arrival, nanoseconds.
        arrivals: Seconds.
    """

    stamps: NDArray[np.int64]
    arrivals: NDArray[np.float64]

    @property
    def hertz(self) -> float:
        """Messages a second."""
        return (len(self.arrivals) - 1) / float(self.arrivals[-1] - self.arrivals[0])


def main() -> None:
    """Measure and print."""
    parser = parser_of(__doc__)
    parser.add_argument("--seconds", type=float, default=10.0, help="of each recording")
    parser.add_argument("--rounds", type=int, default=3, help="of the timing")
    parser.add_argument("--only", action="append", choices=SECTIONS, help="all by default")
    parser.add_argument("--folder", type=Path, help="keeps the recordings")
    arguments = parser.parse_args()
    if why := missing():
        raise SystemExit(why)
    clips.check_data()
    print_machine()
    with tempfile.TemporaryDirectory() as made:
        folder = arguments.folder or Path(made)
        folder.mkdir(parents=True, exist_ok=True)
        cameras = [
            make_camera(folder, size, hertz, arguments.seconds)
            for size, hertz in (((640, 480), 30.0), ((2448, 2048), 10.0))
        ]
        logs = Path(made, "logs")
        logs.mkdir()
        with Core(logs) as core:
            for name in arguments.only or SECTIONS:
                print(f"\n### {name}\n\n- load before: {os.getloadavg()[0]:.2f}", flush=True)
                SECTIONS[name](core, cameras, arguments.rounds)


# ---------------------------------------------------------------- recordings


def make_camera(folder: Path, size: tuple[int, int], hertz: float, seconds: float) -> Camera:
    """Record a camera and pack it, unless it is there already."""
    name, count = f"{size[0]}x{size[1]}", round(seconds * hertz)
    spec = clips.ClipSpec(
        "cups" if clips.data_folder() else clips.DEMO, "mono8", "low", count, size
    )
    bag = folder / f"{spec.name}.bag"
    if not bag.exists():
        write_bag(bag, clips.make(spec), "mono8", hertz=hertz)
    packed = {}
    for quality in ("lossless", "visual"):
        packed[quality] = folder / f"{spec.name}-{quality}"
        if not packed[quality].exists():
            # by itself, since SVT-AV1 changes the scheduling of its process
            measured("-m", "mp4ds", "pack", bag, "-o", packed[quality], "--quality", quality)
    times = dict(images(bag))
    return Camera(name, hertz, bag, packed["lossless"], packed["visual"], times)


def images(bag: Path) -> Iterator[tuple[int, int]]:
    """Stamp and log time of each image of a bag, nanoseconds."""
    store = get_typestore(Stores.ROS1_NOETIC)
    with Reader(bag) as reader:
        for connection, time, data in reader.messages():
            if connection.topic == TOPIC:
                message: Any = store.deserialize_ros1(data, connection.msgtype)
                stamp = message.header.stamp
                yield stamp.sec * NS + stamp.nanosec, time


# ---------------------------------------------------------------- playing

OPTIONS = ("--delay", "1.5", "--topics", TOPIC)


def ours(dataset: Path, *options: str) -> list[str]:
    """The command that plays a dataset."""
    quiet = ("--ros1", "--no-progress", "--no-follow-clock", "--disable-keyboard-controls")
    return python("mp4ds", "play", str(dataset), *quiet, *options, *OPTIONS)


def theirs(bag: Path, *options: str) -> list[str]:
    """The command that plays a bag."""
    return [PLAY, "--quiet", *options, "--bags", str(bag), *OPTIONS]


def play(core: Core, command: Sequence[str]) -> Played:
    """What arrives while a player runs."""
    result = core.folder / "received.npz"
    result.unlink(missing_ok=True)
    receiver = core.script(RECEIVER, str(result), TOPIC)
    if receiver.next() != "ready":
        raise SystemExit("the subscriber has not started")
    if code := core.start(*command).wait():
        raise SystemExit(f"failed with exit code {code}: {' '.join(command)}")
    time.sleep(1)
    receiver.ask("done")
    receiver.end()
    with np.load(result) as arrays:
        return Played(arrays["stamps"], arrays["arrivals"])


def percentiles(values: NDArray[np.float64]) -> list[str]:
    """Milliseconds: median, 90 %, 99 % and most."""
    return [f"{1000 * value:.2f}" for value in np.percentile(values, (50, 90, 99, 100))]


# ---------------------------------------------------------------- sections


def timing(core: Core, cameras: Sequence[Camera], rounds: int) -> None:
    """How late messages arrive."""

    def rows() -> Iterator[list[object]]:
        for camera in cameras:
            late: dict[str, list[NDArray[np.float64]]] = {}
            for _ in range(rounds):
                for name, command in players(camera):
                    played = play(core, command)
                    late.setdefault(name, []).append(lateness(camera, played))
            for name, found in late.items():
                joined = np.concatenate(found)
                share = f"{len(joined)} of {rounds * camera.frames}"
                yield [camera.name, f"{camera.hertz:g}", name, share, *percentiles(joined)]

    print_table(
        ("camera", "Hz", "player", "arrived", "p50, ms", "p90, ms", "p99, ms", "max, ms"), rows()
    )


def players(camera: Camera, *options: str) -> list[tuple[str, list[str]]]:
    """All players of raw images."""
    return [
        ("mp4ds, lossless", ours(camera.lossless, *options)),
        ("mp4ds, visual", ours(camera.visual, *options)),
        ("rosbag play", theirs(camera.bag, *options)),
    ]


def lateness(camera: Camera, played: Played) -> NDArray[np.float64]:
    """Seconds that messages came later than the least late one."""
    planned = np.array([camera.log_times[stamp] for stamp in played.stamps.tolist()])
    late = played.arrivals - (planned - planned[0]) / NS
    return late - late.min()


def rate(core: Core, cameras: Sequence[Camera], _: int) -> None:
    """Whether a rate is kept."""
    camera = cameras[0]
    length = camera.frames / camera.hertz

    def rows() -> Iterator[list[object]]:
        for asked, (name, _) in product(RATES, players(camera)):
            seconds = min(length, max(1.0, 3 * asked))
            options = ("--rate", f"{asked:g}", "--duration", f"{seconds:g}")
            played = play(core, dict(players(camera, *options))[name])
            first, last = (camera.log_times[int(played.stamps[i])] for i in (0, -1))
            found = (last - first) / NS / float(played.arrivals[-1] - played.arrivals[0])
            yield [f"{asked:g}", name, len(played.stamps), f"{100 * (found / asked - 1):+.2f} %"]

    print_table(("rate", "player", "messages", "off by"), rows())


def most(core: Core, cameras: Sequence[Camera], _: int) -> None:
    """How many frames a second."""

    def rows() -> Iterator[list[object]]:
        for camera in cameras:
            sources = (camera.lossless, camera.visual, camera.bag)
            for source, (name, _) in zip(sources, players(camera), strict=True):
                hertz = highest(core, camera, name)
                megabytes = f"{size_of(source) / camera.frames / 1e6:.3f}"
                yield [camera.name, name, f"{hertz:.0f}", megabytes]

    print_table(("camera", "player", "frames/s", "MB"), rows())


def highest(core: Core, camera: Camera, player: str) -> float:
    """The highest rate at which all frames arrive in time, Hz; 0 if even the recorded one fails."""
    kept, asked = 0.0, 1.0
    while asked <= MAX_RATE:
        played = play(core, dict(players(camera, "--rate", f"{asked:g}"))[player])
        if len(played.stamps) < camera.frames or played.hertz < 0.97 * asked * camera.hertz:
            break
        kept = played.hertz
        asked *= STEP
    return kept


SECTIONS = {"timing": timing, "rate": rate, "most": most}

if __name__ == "__main__":
    main()
