"""A publisher that keeps what it is given, and datasets to be played."""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.convert.converter import default_message
from rosbags.typesys import Stores, get_typestore

from mp4ds.bags.formats import open_reader, open_writer
from mp4ds.errors import Refused
from mp4ds.messages.serializations import form_of
from mp4ds.messages.wire import ImageFields, Slots
from mp4ds.plugins.playing.options import PlayOptions
from mp4ds.plugins.playing.player import Player, PlaySummary, open_player
from mp4ds.records import Channel, Message, Schema
from sources import typestore
from waiting import WATCHDOG_S

ROS2 = get_typestore(Stores.ROS2_JAZZY)


@dataclass
class Sent:
    """One thing that was published: a message, or a time of /clock."""

    topic: str
    payload: bytes
    time_ns: int
    at: float
    channel: Channel | None = None


@dataclass
class RecordingPublisher:
    """Keeps everything; counts as having a subscriber everywhere."""

    world: str = "ros1"
    address: str = "nowhere"
    wants_clock: bool = False
    is_alive: bool = True
    busy_s: float = 0.0
    advertised: list[Channel] = field(default_factory=list)
    sent: list[Sent] = field(default_factory=list)
    clocks: list[Sent] = field(default_factory=list)
    on_time: Callable[[int], None] | None = None
    on_message: Callable[[int | None], None] | None = None
    services: dict[str, Any] = field(default_factory=dict)
    subscriber_count: int = 1
    on_sent: Callable[[Sent], None] | None = None
    not_installed: frozenset[str] = frozenset()
    has_ended: bool = False  # what plays in a thread

    def advertise(self, channel: Channel) -> None:
        if channel.type_name in self.not_installed:
            raise Refused("it is not installed")
        self.advertised.append(channel)

    def publish(self, channel: Channel, payload: bytes | memoryview, time_ns: int) -> None:
        if not any(channel is item for item in self.advertised):
            raise LookupError(f"{channel.topic} was not advertised")
        if self.busy_s:
            time.sleep(self.busy_s)
        sent = Sent(channel.topic, bytes(payload), time_ns, time.monotonic(), channel)
        self.sent.append(sent)
        if self.on_sent:
            self.on_sent(sent)

    def clock(self, time_ns: int) -> None:
        self.clocks.append(Sent("/clock", b"", time_ns, time.monotonic()))

    def subscribers(self, _: Channel) -> int:
        return self.subscriber_count

    def follow_clock(self, on_time: Callable[[int], None]) -> None:
        self.on_time = on_time

    def listen(self, _: str, on_message: Callable[[int | None], None]) -> None:
        self.on_message = on_message

    def serve(self, services: Any) -> None:
        self.services = {service.name: service.answer for service in services}


def run(
    dataset: Path | list[Path], publisher: RecordingPublisher | None = None, **options: Any
) -> tuple[RecordingPublisher, PlaySummary]:
    """Play to the end."""
    publisher = publisher or RecordingPublisher()
    with open_player(dataset, PlayOptions(**options), node=publisher) as player:
        return publisher, player.run()


@contextmanager
def running(
    dataset: Path, publisher: RecordingPublisher | None = None, **options: Any
) -> Iterator[tuple[Player, RecordingPublisher]]:
    """A player that runs in a thread, stopped at the end."""
    publisher = publisher or RecordingPublisher()
    failures: list[BaseException] = []
    with open_player(dataset, PlayOptions(**options), node=publisher) as player:

        def work() -> None:
            try:
                player.run()
            except BaseException as error:
                failures.append(error)
            publisher.has_ended = True

        thread = threading.Thread(target=work)
        thread.start()
        try:
            yield player, publisher
        finally:
            player.stop()
            thread.join(WATCHDOG_S)
    assert publisher.has_ended
    assert not failures


START = 1_700_000_000 * 10**9
STEP = 50_000_000  # between frames, ns
MS = 1_000_000


def make_drive(path: Path, *, frames: int = 20, topic: str = "/camera", late: int = 0) -> Path:
    """A ROS 1 bag: a grey camera at 20 Hz, tf at 40 Hz, static transforms of two callers.

    Args:
        path: The .bag to make.
        frames: Of the camera.
        topic: Where the camera is.
        late: Nanoseconds by which all is later.
    """
    channels = {
        "image": ros1_channel(0, f"{topic}/image_raw", "sensor_msgs/Image", "/driver"),
        "tf": ros1_channel(1, "/tf", "tf2_msgs/TFMessage", "/odometry"),
    }
    for number, caller in ((2, "/base"), (3, "/arm")):
        channel = ros1_channel(number, "/tf_static", "tf2_msgs/TFMessage", caller)
        channels[caller] = replace(channel, metadata={**channel.metadata, "latching": "1"})
    rows: list[tuple[int, str, bytes]] = []
    for seq in range(frames):
        stamp = START + late + seq * STEP
        rows.append((stamp + 5 * MS, "image", image(seq, stamp)))
        rows += [
            (stamp + shift, "tf", transform("odom", stamp + shift)) for shift in (0, STEP // 2)
        ]
    rows += [(START + late + MS, caller, transform(caller, START)) for caller in ("/base", "/arm")]
    with open_writer(path, "bag", name=path.name, profile="ros1", library="", storage="") as writer:
        for channel in channels.values():
            writer.add_channel(channel)
        for log_time, name, payload in sorted(rows, key=lambda row: row[0]):
            writer.write(Message(channels[name], log_time, log_time, 0, payload))
    return path


def image(seq: int, stamp: int) -> bytes:
    """A grey image of 160 x 120 in the serialization of ROS 1, which shows its number."""
    rows, columns = np.mgrid[0:120, 0:160]
    pixels = (128 + 90 * np.sin((rows + 3 * seq) / 20) * np.cos(columns / 30)).astype(np.uint8)
    pixels += np.random.default_rng(seq).integers(0, 3, pixels.shape, np.uint8)
    form = form_of("ros1", "sensor_msgs/Image", b"")
    blank = form.plain("camera", ImageFields("mono8", 160, 120, 160, 0)) or b""
    head, tail = form.template(blank).around(Slots(stamp, seq), pixels.size)
    return head + pixels.tobytes() + tail


def transform(child: str, stamp: int) -> bytes:
    """A TFMessage of one transform in the serialization of ROS 1."""
    name = child.encode()
    return (
        struct.pack("<I", 1)
        + struct.pack("<IIII4s", 0, *divmod(stamp, 10**9), 4, b"base")
        + struct.pack(f"<I{len(name)}s", len(name), name)
        + struct.pack("<7d", 1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0)
    )


Recorded = tuple[str, bytes, int]


def recorded(path: Path) -> list[Recorded]:
    """Topic, payload and log time of every message of a recording, in its order."""
    with open_reader(path) as reader:
        return [
            (record.channel.topic, bytes(record.data), record.log_time)
            for record in reader.records()
            if isinstance(record, Message)
        ]


STATIC = ("base", "lidar", "camera", "imu")
"""Child frames of /tf_static, of a publisher each."""


def profiles(*depths: int, durability: str = "transient_local") -> str:
    """QoS profiles as rosbag2 records them, of publishers that keep so many; 0: it is not told."""
    return "\n".join(
        f"- history: {'keep_last' if depth else 'unknown'}\n  depth: {depth}\n"
        f"  reliability: reliable\n  durability: {durability}\n  liveliness: automatic"
        for depth in depths
    )


def static_channel(*depths: int) -> Channel:
    """/tf_static in ROS 2: rosbag2 makes one channel of all its publishers."""
    return ros2_channel(1, "/tf_static", "tf2_msgs/msg/TFMessage", profiles(*depths))


def ros1_channel(number: int, topic: str, kind: str, callerid: str) -> Channel:
    """A channel of a bag, with the definition and md5sum of its type."""
    package, name = kind.split("/")
    definition, md5sum = typestore("ros1").generate_msgdef(f"{package}/msg/{name}", ros_version=1)
    schema = Schema(kind, "ros1msg", definition.encode())
    return Channel(number, topic, "ros1", schema, {"md5sum": md5sum, "callerid": callerid})


def ros2_channel(number: int, topic: str, kind: str, qos: str = "") -> Channel:
    """A channel of rosbag2, with the definition of its type."""
    definition = ROS2.generate_msgdef(kind, ros_version=2)[0].encode()
    return Channel(
        number, topic, "cdr", Schema(kind, "ros2msg", definition), {"offered_qos_profiles": qos}
    )


def static_transform(child: str, second: int = 0) -> bytes:
    """A TFMessage of one transform in CDR."""
    made = default_message(ROS2, "tf2_msgs/msg/TFMessage")
    part = default_message(ROS2, "geometry_msgs/msg/TransformStamped")
    part.header.frame_id, part.child_frame_id = "map", child
    part.header.stamp.sec, part.transform.rotation.w = second, 1.0
    made.transforms = [part]
    return bytes(ROS2.serialize_cdr(made, "tf2_msgs/msg/TFMessage"))


def text(said: str) -> bytes:
    """A std_msgs/String in CDR."""
    data = said.encode() + b"\0"
    return b"\0\1\0\0" + struct.pack("<I", len(data)) + data


def make_ros2(path: Path) -> Path:
    """An MCAP of ROS 2 without a camera: /chatter at 20 Hz, /tf_static of four publishers, /map."""
    channels = {
        "/chatter": ros2_channel(0, "/chatter", "std_msgs/msg/String"),
        "/tf_static": static_channel(1, 1, 1, 1),
        "/map": ros2_channel(2, "/map", "std_msgs/msg/String", profiles(0)),
    }
    rows = [(START + n * STEP, "/chatter", text(f"{n}")) for n in range(20)]
    rows += [
        (START + (n + 1) * MS, "/tf_static", static_transform(child))
        for n, child in enumerate(STATIC)
    ]
    rows += [(START + (20 + n) * MS, "/map", text(f"map {n}")) for n in range(2)]
    with open_writer(
        path, "mcap", name=path.name, profile="ros2", library="", storage="mcap"
    ) as writer:
        for channel in channels.values():
            writer.add_channel(channel)
        for log_time, topic, payload in sorted(rows):
            writer.write(Message(channels[topic], log_time, log_time, 0, payload))
    return path
