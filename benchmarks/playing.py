"""What `mp4ds play` does in ROS 1 beside ``rosbag play`` of the recording itself.

    python benchmarks/playing.py [--seconds S] [--rounds N] [--only SECTION ...] [--folder F]

needs ROS 1 (see `.ci/run`): a real master, in a network of its own where that is possible, players
and an ordinary subscriber, by rospy. A grey camera of the scene ``cups`` with the noise of daylight
(see clips.py) is recorded at 640x480 and 30 Hz, and at 2448x2048 and 10 Hz, and packed. Sections:

- timing: how much later than planned messages arrive. The player's zero is not known to others, so
  that of each run is its least late message. Players take turns.
- clock: /clock at 100 Hz: how often it comes, and whether it ever runs back.
- rate: the recording's time over that of arrival, from the first message to the last, in percent of
  what was asked for.
- most: frames a second at which all arrive and the asked rate is kept within 3 %: in steps of a
  quarter, the last one that holds. CPU time is that of the player at the recorded rate, less what a
  single frame costs, and that of the subscriber, who for the bag of JPEG files decodes them. MB is
  what is read for a frame.
- step: two players, of which the second follows the first one's /clock: how much messages of the
  same stamp are apart.
"""

from __future__ import annotations

import argparse
import io
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from rosbags.rosbag1 import Reader, Writer
from rosbags.typesys import Stores, get_typestore

import clips
from measure import print_machine, print_table
from measure import python as measured
from recordings import TOPIC, write_bag

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from roscore import PLAY, Core, missing, python

RECEIVER = str(Path(__file__).with_name("playing_receiver.py"))
NS = 10**9
JPEG_QUALITY = 90
COMPRESSED = "sensor_msgs/msg/CompressedImage"
RATES = (0.1, 0.5, 1.0, 2.0, 10.0)
STEP = 1.25
MAX_RATE = 64.0


@dataclass(frozen=True)
class Camera:
    """A recorded camera, in all forms that are played."""

    name: str
    hertz: float
    bag: Path
    jpeg: Path
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
        player_cpu: Seconds of the player, with its start.
        receiver_cpu: Seconds of the subscriber while it received.
    """

    stamps: NDArray[np.int64]
    arrivals: NDArray[np.float64]
    player_cpu: float
    receiver_cpu: float

    @property
    def hertz(self) -> float:
        """Messages a second."""
        return (len(self.arrivals) - 1) / float(self.arrivals[-1] - self.arrivals[0])


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
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
    bag, jpeg = folder / f"{spec.name}.bag", folder / f"{spec.name}-jpeg.bag"
    if not jpeg.exists():
        bag.unlink(missing_ok=True)
        write_bag(bag, clips.make(spec), count, "mono8", hertz=hertz)
        part = jpeg.with_suffix(".part")
        part.unlink(missing_ok=True)
        write_jpeg_bag(part, bag)
        part.rename(jpeg)
    packed = {}
    for quality in ("lossless", "visual"):
        packed[quality] = folder / f"{spec.name}-{quality}"
        if not packed[quality].exists():
            command = ("-m", "mp4ds", "pack", str(bag), "-o", str(packed[quality]))
            measured(
                *command, "--quality", quality
            )  # SVT-AV1 changes the scheduling of its process
    times = {stamp: time for _, stamp, time in images(bag)}
    return Camera(name, hertz, bag, jpeg, packed["lossless"], packed["visual"], times)


def images(bag: Path) -> Iterator[tuple[Any, int, int]]:
    """Message, stamp and log time of each image of a bag, nanoseconds."""
    store = get_typestore(Stores.ROS1_NOETIC)
    with Reader(bag) as reader:
        for connection, time, data in reader.messages():
            if connection.topic == TOPIC:
                message: Any = store.deserialize_ros1(data, connection.msgtype)
                stamp = message.header.stamp
                yield message, stamp.sec * NS + stamp.nanosec, time


def write_jpeg_bag(path: Path, bag: Path) -> None:
    """The same images as JPEG files, on the same topic."""
    store = get_typestore(Stores.ROS1_NOETIC)
    with Writer(path) as writer:
        connection = writer.add_connection(TOPIC, COMPRESSED, typestore=store)
        for message, _, time in images(bag):
            pixels = message.data.reshape(message.height, message.width)
            file = io.BytesIO()
            Image.fromarray(pixels).save(file, "jpeg", quality=JPEG_QUALITY)
            data = np.frombuffer(file.getvalue(), np.uint8)
            made = store.types[COMPRESSED](message.header, "jpeg", data)
            writer.write(connection, time, store.serialize_ros1(made, COMPRESSED))


def size_of(path: Path) -> int:
    """Bytes of a file, or of the files in a folder."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


# ---------------------------------------------------------------- playing

OPTIONS = ("--delay", "1.5", "--topics", TOPIC)


def ours(dataset: Path, *options: str) -> list[str]:
    """The command that plays a dataset."""
    quiet = ("--ros1", "--no-progress", "--no-follow-clock", "--disable-keyboard-controls")
    return python("mp4ds", "play", str(dataset), *quiet, *options, *OPTIONS)


def theirs(bag: Path, *options: str) -> list[str]:
    """The command that plays a bag."""
    return [PLAY, "--quiet", *options, "--bags", str(bag), *OPTIONS]


def play(
    core: Core, *commands: Sequence[str], topics: Sequence[str] = (TOPIC,), decode: bool = False
) -> dict[str, Played]:
    """What arrives by topic while players run; the first is started last, and measured."""
    result = core.folder / "received.npz"
    result.unlink(missing_ok=True)
    receiver = core.script(RECEIVER, str(result), "decode" if decode else "keep", *topics)
    if receiver.next() != "ready":
        raise SystemExit("the subscriber has not started")
    others = [core.start(*command) for command in commands[1:]]
    if others:
        time.sleep(6)
    player = core.start(*commands[0])
    _, status, usage = os.wait4(player.pid, 0)
    player.returncode = os.waitstatus_to_exitcode(status)
    if player.returncode:
        raise SystemExit(f"failed with exit code {player.returncode}: {' '.join(commands[0])}")
    time.sleep(1)
    for other in others:
        end(other)
    cpu = receiver.ask("done")
    receiver.end()
    with np.load(result) as arrays:
        return {
            topic: Played(
                arrays[f"stamps{i}"],
                arrays[f"arrivals{i}"],
                usage.ru_utime + usage.ru_stime,
                cpu,
            )
            for i, topic in enumerate(topics)
        }


def end(follower: subprocess.Popen[str]) -> None:
    """Wait for one that follows, which the last /clock of its leader may not let end."""
    try:
        follower.wait(10)
    except subprocess.TimeoutExpired:
        follower.terminate()
        follower.wait(60)


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
                    played = play(core, command)[TOPIC]
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


def clock(core: Core, cameras: Sequence[Camera], _: int) -> None:
    """How /clock comes."""

    def rows() -> Iterator[list[object]]:
        for camera in cameras:
            for name, command in players(camera, "--clock"):
                found = play(core, command, topics=("/clock",))["/clock"]
                steps = np.diff(found.stamps)
                gaps = np.diff(found.arrivals)
                backward = int((steps < 0).sum())
                share = [f"{1000 * value:.1f}" for value in np.percentile(gaps, (50, 99, 100))]
                yield [camera.name, name, f"{found.hertz:.1f}", backward, *share]

    print_table(
        ("camera", "player", "Hz", "runs back", "gap p50, ms", "gap p99, ms", "gap max, ms"), rows()
    )


def rate(core: Core, cameras: Sequence[Camera], _: int) -> None:
    """Whether a rate is kept."""
    camera = cameras[0]
    length = camera.frames / camera.hertz

    def rows() -> Iterator[list[object]]:
        for asked, (name, _) in product(RATES, players(camera)):
            seconds = min(length, max(1.0, 3 * asked))
            options = ("--rate", f"{asked:g}", "--duration", f"{seconds:g}")
            played = play(core, dict(players(camera, *options))[name])[TOPIC]
            first, last = (camera.log_times[int(played.stamps[i])] for i in (0, -1))
            found = (last - first) / NS / float(played.arrivals[-1] - played.arrivals[0])
            yield [f"{asked:g}", name, len(played.stamps), f"{100 * (found / asked - 1):+.2f} %"]

    print_table(("rate", "player", "messages", "off by"), rows())


def most(core: Core, cameras: Sequence[Camera], _: int) -> None:
    """How many frames a second, and what a frame costs."""

    def rows() -> Iterator[list[object]]:
        for camera in cameras:
            forms: list[tuple[str, Path, Callable[..., list[str]]]] = [
                ("mp4ds, lossless", camera.lossless, ours),
                ("mp4ds, visual", camera.visual, ours),
                ("rosbag play", camera.bag, theirs),
                ("rosbag play, JPEG", camera.jpeg, theirs),
            ]
            for name, path, command in forms:
                decode = path == camera.jpeg
                whole = play(core, command(path), decode=decode)[TOPIC]
                single = play(core, command(path, "--duration", "0.001"), decode=decode)[TOPIC]
                frames = len(whole.stamps) - len(single.stamps)
                cpu = (
                    1000 * (whole.player_cpu - single.player_cpu) / frames,
                    1000 * (whole.receiver_cpu - single.receiver_cpu) / frames,
                )
                hertz = highest(core, camera, lambda *o, c=command, p=path: c(p, *o), decode=decode)
                megabytes = f"{size_of(path) / camera.frames / 1e6:.3f}"
                yield [camera.name, name, f"{hertz:.0f}", *(f"{ms:.1f}" for ms in cpu), megabytes]

    header = ("camera", "player", "frames/s", "player CPU, ms", "subscriber CPU, ms", "MB")
    print_table(header, rows())


def highest(
    core: Core, camera: Camera, command: Callable[..., list[str]], *, decode: bool
) -> float:
    """The highest rate at which all frames arrive in time, Hz; 0 if even the recorded one fails."""
    kept, asked = 0.0, 1.0
    while asked <= MAX_RATE:
        played = play(core, command("--rate", f"{asked:g}"), decode=decode)[TOPIC]
        if len(played.stamps) < camera.frames or played.hertz < 0.97 * asked * camera.hertz:
            break
        kept = played.hertz
        asked *= STEP
    return kept


def step(core: Core, cameras: Sequence[Camera], _: int) -> None:
    """Two players that keep in step."""
    second = "/second" + TOPIC

    def rows() -> Iterator[list[object]]:
        for camera in cameras:
            follow = ("--ros1", "--follow-clock", "--no-progress", "--prefix", "/second")
            follower = python("mp4ds", "play", str(camera.lossless), *follow, "--topics", TOPIC)
            for name, leader in players(camera, "--clock"):
                found = play(core, leader, follower, topics=(TOPIC, second))
                arrivals = [
                    dict(zip(played.stamps.tolist(), played.arrivals.tolist(), strict=True))
                    for played in (found[TOPIC], found[second])
                ]
                both = arrivals[0].keys() & arrivals[1].keys()
                apart = np.array([abs(arrivals[1][key] - arrivals[0][key]) for key in both])
                share = f"{len(both)} of {camera.frames}"
                yield [camera.name, name, share, *percentiles(apart)]

    print_table(("camera", "leader", "pairs", "p50, ms", "p90, ms", "p99, ms", "max, ms"), rows())


SECTIONS = {"timing": timing, "clock": clock, "rate": rate, "most": most, "step": step}

if __name__ == "__main__":
    main()
