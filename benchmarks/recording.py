"""`mp4ds record` beside ``rosbag record`` in ROS 1, from the same publisher in one run.

    python benchmarks/recording.py [--seconds S] [--kills N] [--hours H] [--only SECTION ...]
                                   [--folder F] [--plot F.svg]

needs ROS 1 (see `.ci/run`): a real master, in a network of its own where that is possible, a rospy
node that publishes, and ROS's own recorder. Sections:

- steady: two Bayer cameras of 640x480 at 30 Hz and an IMU of 200 Hz: whether all messages are
  there, with the bytes, stamps and connection headers of ``rosbag record``; what both cost.
- overload: four cameras of 2448x2048 at 15 Hz, which no two cores can encode, from a publisher
  that waits for its subscribers: what of that which ``rosbag record`` kept is not there, and how
  much memory it took. What waits to be packed at the end is packed then.
- look-back: four cameras of 1280x720 at 30 Hz, of which all is recorded, then only looked back at
  (``--keep-last 60s --and-then 10s``, triggers after 75 and 95 s): memory and disk over time, as
  CSV, and what the first 30 s cost.
- long: two cameras of 320x240 at 1 Hz for 12 hours of their clock, as fast as they are packed, with
  ``--max-duration 1h``; needs no ROS. Memory over time as CSV, and whether all datasets are valid.
- kills: N times ``kill -9`` at a random moment: seconds between the last message that is there and
  the end, and whether all before are those that ``rosbag record`` has.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import psutil
import xxhash
from rosbags.rosbag1 import Reader

import clips
from measure import figure_of, parser_of, print_machine, print_table, save, size_of
from recordings import write_bag

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from mp4ds.bags.formats import open_sources
from mp4ds.bags.protocols import with_own_payload
from mp4ds.dataset.checks import validate
from mp4ds.format.sidecars import MANIFEST_NAME, load_manifest
from mp4ds.plugins.recording import spool
from mp4ds.plugins.recording.options import RecordOptions
from mp4ds.plugins.recording.record import RecordProgress, open_recorder
from mp4ds.records import Message
from record_scenes import PlayedNode
from roscore import RECORD, Core, missing, python
from waiting import until

PUBLISHER = str(Path(__file__).with_name("recording_publisher.py"))
OTHERS = "/rosout.*|/clock"
STEADY = (2, "640x480", 30, 200, 30)
LOOK_BACK = (4, "1280x720", 30, 200, 30)
OVERLOAD = (4, "2448x2048", 15, 0, 0)
NS = 10**9
BACKLOG_BYTES = 100_000_000
"""Of messages that are not packed yet: how far a robot is ahead that waits."""

Samples = list[tuple[float, float, float, float]]
"""Seconds, MiB of the recorder, MiB of what packs, and MB on disk or hours recorded."""


@dataclass
class Cost:
    """What a process and its children have cost so far.

    Attributes:
        cpu: Seconds, user and system.
        written: Bytes that it had written to disk.
        peak: Bytes of memory at most.
    """

    cpu: float
    written: int
    peak: int

    @classmethod
    def of(cls, pid: int) -> Cost:
        """Of a process that runs, and those that it has started."""
        process = psutil.Process(pid)
        status = Path("/proc", str(pid), "status").read_text()
        inner = [cls.of(child.pid) for child in process.children()]
        return cls(
            sum(process.cpu_times()[:2]) + sum(one.cpu for one in inner),
            process.io_counters().write_bytes + sum(one.written for one in inner),
            1024 * int(status.partition("VmHWM:")[2].split()[0]) + sum(one.peak for one in inner),
        )


Messages = Mapping[str, Sequence[tuple[int, str]]]
"""Stamp in the header, ns, and digest of each message, by topic."""


def messages(bag: Path) -> tuple[Messages, dict[str, Any]]:
    """What is in a bag, and the connection headers by topic."""
    found, heads = defaultdict(list), {}
    with Reader(bag) as reader:
        for connection in reader.connections:
            ext = connection.ext
            told = (connection.msgtype, connection.digest, ext.callerid, ext.latching)
            heads[connection.topic] = (*told, connection.msgdef.data)
        for connection, _, data in reader.messages():
            secs, nsecs = int.from_bytes(data[4:8], "little"), int.from_bytes(data[8:12], "little")
            digest = xxhash.xxh64_hexdigest(data)
            found[connection.topic].append((secs * NS + nsecs, digest))
    return dict(found), heads


def ours(target: Path, *options: str) -> list[str]:
    """The command that records into a dataset."""
    given = ("-a", "--ros1", "-o", str(target), "--exclude-regex", OTHERS)
    return python("mp4ds", "record", *given, "--disable-keyboard-controls", *options)


def theirs(bag: Path) -> list[str]:
    """The command of ROS's own recorder."""
    return [RECORD, "-a", "-O", str(bag), "-x", OTHERS]


def publisher(core: Core, *robot: object) -> Any:
    """A robot; see recording_publisher.py."""
    command = python(PUBLISHER, *map(str, robot))
    path = {"PYTHONPATH": str(Path(PUBLISHER).parent)}
    return subprocess.Popen(
        command, env={**core.environment, **path}, stdout=subprocess.PIPE, text=True
    )


def said(process: Any) -> Any:
    """What a robot says next."""
    line = process.stdout.readline()
    if not line:
        raise SystemExit(f"the publisher ended: {process.wait()}")
    return json.loads(line)


def end(process: subprocess.Popen[str]) -> int:
    """End a recorder as Ctrl-C does."""
    process.send_signal(2)
    return process.wait()


def unpacked(dataset: Path, folder: Path) -> Path:
    """The bag of a dataset."""
    bag = folder / "again.bag"
    bag.unlink(missing_ok=True)
    command = [sys.executable, "-m", "mp4ds", "-q", "unpack", str(dataset), "--to", "bag"]
    subprocess.run([*command, "-o", str(bag)], check=True)
    return bag


def beside(core: Core, folder: Path, seconds: float, *robot: Any) -> None:
    """Record with both, and print what each has and cost."""
    dataset, bag = folder / "live", folder / "rosbag.bag"
    for path in (dataset, bag):
        shutil.rmtree(path, ignore_errors=True)
        path.unlink(missing_ok=True)
    recorders = {"mp4ds": core.start(*ours(dataset)), "rosbag": core.start(*theirs(bag))}
    source = publisher(core, *robot, seconds, 2)
    assert said(source) == "begun"
    before = {name: Cost.of(one.pid) for name, one in recorders.items()}
    begun = time.monotonic()
    sent = said(source)
    source.wait()
    elapsed = time.monotonic() - begun
    after = {name: Cost.of(one.pid) for name, one in recorders.items()}
    print(f"- published for {elapsed:.1f} s")
    for path in sorted(folder.glob("live.recording/*")):
        size = path.stat().st_size if path.is_file() else 0
        print(f"- on disk at the end: {path.name}, {size / 1e6:.0f} MB")
    codes = {}
    for name, one in recorders.items():
        begun = time.monotonic()
        codes[name] = end(one)
        print(f"- {name} took {time.monotonic() - begun:.1f} s to finish")
    for line in (core.folder / "python.log").read_text().splitlines():
        if "dropped" in line:
            print(f"- {line}")
    print()
    (found, heads), (due, their_heads) = messages(unpacked(dataset, folder)), messages(bag)
    rows = [
        (
            name,
            f"{100 * (after[name].cpu - before[name].cpu) / elapsed:.0f} %",
            f"{(after[name].written - before[name].written) / 1e6 / elapsed:.1f}",
            f"{after[name].peak / 2**20:.0f}",
            f"{size_of(path) / 1e6:.0f}",
            codes[name],
        )
        for name, path in (("mp4ds", dataset), ("rosbag", bag))
    ]
    print_table(("", "CPU of a core", "MB/s to disk", "peak MiB", "MB in all", "exit code"), rows)
    print()
    kept = {
        one.topic: f"{one.messages}: {one.reason}"
        for one in load_manifest(dataset / "dataset.yaml").verbatim
    }
    rows = []
    for topic in sorted({*due, *found}):
        one, other = dict(found.get(topic, [])), dict(due.get(topic, []))
        missing_here = [stamp for stamp in other if one.get(stamp) != other[stamp]]
        rows.append(
            (
                topic,
                sent.get(topic, ""),
                len(found.get(topic, [])),
                len(due.get(topic, [])),
                len(missing_here),
                kept.get(topic, ""),
                "equal" if heads.get(topic) == their_heads.get(topic) else "DIFFERS",
            )
        )
    columns = ("topic", "published", "in mp4ds", "in rosbag", "only in rosbag, or other bytes")
    print_table((*columns, "verbatim", "connection"), rows)


# ---------------------------------------------------------------- looking back


def look_back(core: Core, folder: Path, plot: Path | None) -> None:
    """Record all, then look back, and print memory and disk over time."""
    rows = []
    looking = ("--keep-last", "60s", "--and-then", "10s")
    for options, seconds, triggers in ((), 30, []), (looking, 120, [75.0, 95.0]):
        for path in folder.glob("live*"):
            shutil.rmtree(path)
        recorder = core.start(*ours(folder / "live", *options))
        source = publisher(core, *LOOK_BACK, seconds, 1)
        assert said(source) == "begun"
        print(" ".join(("record", *options)), "\n\nseconds,recorder MiB,packing MiB,disk MB")
        samples: Samples = []
        rows.append((" ".join(options), *_watched(recorder, source, folder, triggers, samples)))
        for path in sorted(folder.glob("live*/dataset.yaml")):
            frames = [stream.frames for stream in load_manifest(path).streams]
            print(f"- {path.parent.name}: {size_of(path.parent) / 1e6:.0f} MB, frames {frames}")
        print()
    if plot:
        draw(plot, samples)
    columns = ("", "CPU of a core", "MB/s to disk", "peak MiB", "peak disk MB", "exit code")
    print_table(columns, rows)


def _watched(
    recorder: Any, source: Any, folder: Path, triggers: list[float], samples: Samples
) -> tuple[str, str, str, str, int]:
    """Print a line each second, until all is published and the recorder has ended."""
    begun, process = time.monotonic(), psutil.Process(recorder.pid)
    before, told = Cost.of(recorder.pid), False
    while recorder.poll() is None:
        time.sleep(1.0)
        at = time.monotonic() - begun
        with suppress(psutil.Error, OSError, IndexError):  # it is ending
            if at < 31:
                cost, elapsed = Cost.of(recorder.pid), at
            sizes = [one.memory_info().rss / 2**20 for one in (process, *process.children())]
            links = {path.stat().st_ino: path.stat() for path in folder.rglob("live*/**/*.*")}
            held = sum(one.st_blocks * 512 for one in links.values()) / 1e6
            samples.append((at, sizes[0], sum(sizes[1:]), held))
            print(",".join(f"{one:.0f}" for one in samples[-1]), flush=True)
        if triggers and at >= triggers[0]:
            triggers.pop(0)
            recorder.send_signal(signal.SIGUSR1)
        if source.poll() is not None and not told:
            recorder.send_signal(signal.SIGINT)
            told = True
    return (
        f"{100 * (cost.cpu - before.cpu) / elapsed:.0f} %",
        f"{(cost.written - before.written) / 1e6 / elapsed:.0f}",
        f"{max(one[1] + one[2] for one in samples):.0f}",
        f"{max(one[3] for one in samples):.0f}",
        recorder.returncode,
    )


def draw(path: Path, samples: Samples) -> None:
    """Draw memory and disk of looking back over time."""
    seconds, recorder, packing, disk = zip(*samples, strict=True)
    figure, axes = figure_of((9, 3.4))
    axes.stackplot(
        seconds, recorder, packing, labels=("recorder", "what packs"), colors=("#1d6ff2", "#9cc2ff")
    )
    most = max(one + other for one, other in zip(recorder, packing, strict=True))
    axes.set(xlabel="seconds", ylabel="memory, MiB", ylim=(0, 1.3 * most))
    beside = axes.twinx()
    beside.plot(seconds, [one / 1e3 for one in disk], color="#1f2937", label="on disk")
    beside.set(ylabel="GB on disk", ylim=(0, None))
    beside.spines["top"].set_visible(False)
    figure.legend(frameon=False, loc="upper center", ncols=3)
    save(figure, path)


# ---------------------------------------------------------------- hours


class Robot(PlayedNode):
    """Two cameras at 1 Hz for hours of their clock, as fast as they are packed.

    Args:
        bag: A minute of one camera, repeated with other stamps.
        hours: How long.
    """

    def __init__(self, bag: Path, hours: float) -> None:
        super().__init__([bag])
        self._hours = hours
        self.is_behind = False  # the recorder
        self._cameras = {
            (one.id, camera): replace(one, id=2 * one.id + camera, topic=f"/cam{camera}{one.topic}")
            for one in self._channels
            for camera in (0, 1)
        }
        self._channels = [*self._cameras.values()]
        with open_sources([bag]) as reader:
            records = [one for one in reader.records() if isinstance(one, Message)]
            self._told = [*map(with_own_payload, records)]
        self.time = self.start = self._told[0].log_time

    def _play(self) -> None:
        for minute in range(round(60 * self._hours)):
            for message in self._told:
                while self.is_behind:
                    time.sleep(0.01)
                self.time = message.log_time + 60 * NS * minute
                stamp = struct.pack("<II", *divmod(self.time, NS))
                data = bytes(message.data[:4]) + stamp + bytes(message.data[12:])
                self._tick(self.time)
                for camera in (0, 1):
                    channel = self._cameras[message.channel.id, camera]
                    self._receivers[channel.topic](channel, data, self.time)
        self.stop()


def long(folder: Path, hours: float) -> None:
    """Record hours, and print memory over time, and what there is in the end."""
    bag, begun = folder / "minute.bag", time.monotonic()
    samples: Samples = []
    for path in folder.glob("long_*"):
        shutil.rmtree(path)
    scene = "cups" if clips.data_folder() else clips.DEMO
    spec = clips.ClipSpec(scene, "bayer_rggb8", "low", 60, (320, 240))
    bag.unlink(missing_ok=True)
    write_bag(bag, clips.make(spec), spec.encoding, hertz=1.0)
    robot, process = Robot(bag, hours), psutil.Process()

    def watch(state: RecordProgress) -> None:
        robot.is_behind = state.waiting_bytes + state.spool_bytes > BACKLOG_BYTES
        at = time.monotonic() - begun
        if not samples or at - samples[-1][0] >= 1:
            with suppress(psutil.Error):  # a process has ended
                children = sum(one.memory_info().rss for one in process.children())
                rss = process.memory_info().rss / 2**20
                samples.append((at, rss, children / 2**20, (robot.time - robot.start) / 3600e9))
                print(",".join(f"{one:.2f}" for one in samples[-1]), flush=True)

    spool.WINDOW_NS = 150 * NS  # with as many frames as five seconds have at 30 Hz
    options = RecordOptions(all=True, max_duration=3600)
    print("seconds,recorder MiB,packing MiB,hours recorded")
    target = folder / "long"
    with open_recorder((), target, options, node=robot, progress=watch) as recorder:
        robot.stop = recorder.stop
        summary = recorder.run()
    ended = time.monotonic() - begun
    tenth = len(samples) // 10 or 1
    parts = [max(one[1] + one[2] for one in part) for part in (samples[:tenth], samples[-tenth:])]
    print(f"\n- {hours:.1f} hours in {ended:.0f} s; dropped: {summary.dropped}")
    print(f"- peak MiB of the first tenth and of the last: {parts[0]:.0f}, {parts[1]:.0f}")
    made = [one.dataset for one in summary.datasets]
    frames = sum(one.frames for path in made for one in load_manifest(path / MANIFEST_NAME).streams)
    problems = [problem for path in made for problem in validate(path, deep=True)]
    print(f"- {len(made)} datasets, {frames} frames; problems: {len(problems)}")


# ---------------------------------------------------------------- kills


def kills(core: Core, folder: Path, count: int) -> None:
    """Kill the recorder again and again, and print what was lost."""
    chance = random.Random(7)
    bag = folder / "rosbag.bag"
    bag.unlink(missing_ok=True)
    reference = core.start(*theirs(bag))
    source = publisher(core, *STEADY, 0, 1)
    assert said(source) == "begun"
    made: list[tuple[Path, int]] = []
    for number in range(count):
        # each in a folder of its own: the next one would recover it
        shutil.rmtree(folder / f"kill{number}", ignore_errors=True)
        dataset = folder / f"kill{number}" / "drive"
        dataset.parent.mkdir()
        recorder = core.start(*ours(dataset))
        unfinished = dataset.with_name(f"{dataset.name}.recording")
        until(lambda path=unfinished: size_of(path) > 1_000_000)
        time.sleep(chance.uniform(1.0, 6.0))
        killed = time.time_ns()
        recorder.kill()
        recorder.wait()
        made.append((unfinished, killed))
    source.terminate()
    source.wait()
    end(reference)
    due, _ = messages(bag)
    lost: dict[str, list[float]] = defaultdict(list)
    wrong = 0
    for unfinished, killed in made:
        dataset = unfinished.with_name(unfinished.name.removesuffix(".recording"))
        command = [sys.executable, "-m", "mp4ds", "-q", "pack", "--salvage", str(unfinished)]
        subprocess.run([*command, "-o", str(dataset)], check=True)
        found, _ = messages(unpacked(dataset, folder))
        for topic, there in found.items():
            first, last = there[0][0], there[-1][0]
            expected = [item for item in due[topic] if first <= item[0] <= last]
            if there != expected:
                wrong += 1
                missing, other = len({*expected} - {*there}), len({*there} - {*expected})
                print(f"- {topic}: {missing} of {len(expected)} missing, {other} not in rosbag")
            lost[topic].append((killed - last) / NS)
    rows = [
        (topic, len(times), f"{max(times):.2f}", f"{sorted(times)[len(times) // 2]:.2f}")
        for topic, times in sorted(lost.items())
    ]
    print_table(("topic", "kills", "most seconds lost", "median"), rows)
    print(f"\ntopics of which something before the last message differs: {wrong}")


SECTIONS = ("steady", "overload", "look-back", "long", "kills")


def main() -> None:
    """Measure and print."""
    parser = parser_of(__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="of the steady recording")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--hours", type=float, default=12.0, help="of the long one")
    parser.add_argument("--only", action="append", choices=SECTIONS, help="all by default")
    parser.add_argument("--folder", type=Path, help="keeps the recordings")
    parser.add_argument("--plot", type=Path, metavar="SVG", help="of looking back, by matplotlib")
    arguments = parser.parse_args()
    sections = arguments.only or SECTIONS
    if (why := missing()) and {*sections} != {"long"}:
        raise SystemExit(why)
    clips.check_data()
    print_machine()
    with tempfile.TemporaryDirectory() as made:
        folder = arguments.folder or Path(made)
        folder.mkdir(parents=True, exist_ok=True)
        logs = Path(made, "logs")
        logs.mkdir()
        for name in sections:
            print(f"\n### {name}\n\n- load before: {os.getloadavg()[0]:.2f}\n", flush=True)
            if name == "long":
                long(folder, arguments.hours)
                continue
            with closing(Core(logs)) as core:
                if name == "steady":
                    beside(core, folder, arguments.seconds, *STEADY)
                elif name == "overload":
                    beside(core, folder, 10.0, *OVERLOAD)
                elif name == "look-back":
                    look_back(core, folder, arguments.plot)
                else:
                    kills(core, folder, arguments.kills)


if __name__ == "__main__":
    main()
