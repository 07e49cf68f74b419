"""Both ways into ROS 2 behind one face: DDS with a peer process, and rclpy with a peer node."""

from __future__ import annotations

import base64
import gc
import os
import random
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from rosbags.convert.converter import default_message
from rosbags.typesys import Stores, get_typestore

import fake_rclpy
from mp4ds.plugins.playing.options import PlayOptions
from mp4ds.plugins.ros.node import Node, open_node
from mp4ds.plugins.ros.ros2 import Qos
from mp4ds.records import Channel, Schema
from roscore import Process
from waiting import WATCHDOG_S, until

LOOPBACK = (
    '<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo"/></Interfaces>'
    "<AllowMulticast>false</AllowMulticast></General><Discovery>"
    '<ParticipantIndex>auto</ParticipantIndex><Peers><Peer address="127.0.0.1"/></Peers>'
    "</Discovery></Domain></CycloneDDS>"
)
STORE = get_typestore(Stores.ROS2_JAZZY)


def _domains() -> Iterator[int]:
    """Domains of this process of pytest, none of which another one draws, in any order."""
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:])
    own = range(worker, 200, int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")))
    while True:
        # publishers of an earlier test live until the garbage collector finds them
        gc.collect()
        yield from random.SystemRandom().sample(own, len(own))


_DOMAINS = _domains()
KINDS = (
    "std_msgs/msg/Header",
    "std_msgs/msg/String",
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/Imu",
    "tf2_msgs/msg/TFMessage",
)


def channel(topic: str, kind: str, *, qos: str = "", encoding: str = "ros2msg") -> Channel:
    """A channel as a recording has it."""
    definition = STORE.generate_msgdef(kind, ros_version=2)[0] if encoding == "ros2msg" else ""
    schema = Schema(kind, encoding, definition.encode())
    return Channel(1, topic, "cdr", schema, {"offered_qos_profiles": qos})


def message(kind: str, number: int, *, little_endian: bool = True) -> bytes:
    """A message that is told from others by its number."""
    value = default_message(STORE, kind)
    if kind == "std_msgs/msg/String":
        value.data = f"message {number}"
    elif kind == "std_msgs/msg/Header":
        value.frame_id, value.stamp.sec = f"frame {number}", number
    elif kind == "tf2_msgs/msg/TFMessage":
        part = default_message(STORE, "geometry_msgs/msg/TransformStamped")
        part.header.stamp.sec, part.child_frame_id = number, "camera"
        value.transforms = [part]
    else:
        value.header.stamp.sec, value.header.frame_id = number, f"frame {number}"
    return bytes(STORE.serialize_cdr(value, kind, little_endian=little_endian))


def padded(payload: bytes) -> bytes:
    """As DDS delivers it: a multiple of 4 bytes."""
    return payload.ljust((len(payload) + 3) // 4 * 4, b"\0")


def connect(side: Side, publisher: Any, recorded: Channel) -> None:
    """Subscribe, and send messages until they arrive: from then on each one does.

    Two participants of DDS find each other in several steps, and each side knows only its own.
    """
    topic, kind = recorded.topic, recorded.type_name
    publisher.advertise(recorded)
    side.peer.subscribe(topic, kind)
    sent: list[bytes] = []

    def arrives() -> bool:
        sent.append(message(kind, 1000 + len(sent)))
        publisher.publish(recorded, sent[-1], 0)
        return bool(side.peer.received(topic, 1, 0.5))

    until(arrives)
    until(lambda: padded(sent[-1]) in map(padded, side.peer.received(topic, 1)))
    side.peer.forget(topic)


class DdsPeer(Process):
    """A process that subscribes, publishes and calls, without a line of the package."""

    def ask(self, what: str, *arguments: Any, **options: Any) -> Any:
        return super().ask(what, arguments, options)

    def subscribe(self, topic: str, kind: str, **options: Any) -> None:
        self.ask("subscribe", f"rt{topic}", kind, **options)

    def received(self, topic: str, count: int, seconds: float = WATCHDOG_S) -> list[bytes]:
        told = self.ask("received", f"rt{topic}", count, seconds)
        return [base64.b64decode(message) for message in told]

    def forget(self, topic: str) -> None:
        self.ask("forget", f"rt{topic}")

    @contextmanager
    def stopped(self, topic: str) -> Iterator[None]:
        self.stop()
        try:
            yield
        finally:
            self.resume()

    def connected(self, topic: str, count: int) -> int:
        return int(self.ask("connected", f"rt{topic}", count))

    def publish(self, topic: str, kind: str, payload: bytes, **options: Any) -> None:
        self.ask("publish", f"rt{topic}", kind, base64.b64encode(payload).decode(), **options)

    def call(self, name: str, kind: str, request: dict[str, Any]) -> dict[str, Any]:
        values = [
            [value.sec, value.nanosec] if hasattr(value, "sec") else value
            for value in request.values()
        ]
        number, fields = self.ask("call", name, kind, values)
        assert number == 77
        fields.pop("structure_needs_at_least_one_member", None)
        return dict(fields)


class Controls:
    """Controls of a player or recorder that note what was asked of them."""

    def __init__(self) -> None:
        self.asked: list[tuple[Any, ...]] = []
        self.is_paused = True
        self.rate = 2.5
        self.start_ns = 100 * 10**9

    def __getattr__(self, name: str) -> Callable[..., Any]:
        def noted(*arguments: Any) -> Any:
            self.asked.append((name, *arguments))
            return 3 if name == "burst" else True

        return noted


class Side:
    """One way into ROS 2: how a node is made, and who is on the other side."""

    def __init__(self, peer: Any) -> None:
        self.peer = peer

    def open(
        self, name: str = "rosbag2_player", overrides: Mapping[str, Qos] = {}, **options: Any
    ) -> Node:
        node = open_node("ros2", PlayOptions(**options), name)
        vars(node)["_overrides"] = overrides  # as read from a file
        return node

    @contextmanager
    def stopped(self, publisher: Any, recorded: Channel) -> Iterator[None]:
        """A subscriber of a channel that no longer acknowledges anything."""
        connect(self, publisher, recorded)
        with self.peer.stopped(recorded.topic):
            yield


def alone_in_ros2(monkeypatch: pytest.MonkeyPatch) -> int:
    """Keep ROS 2 to loopback, in a domain where no other test is, which is returned."""
    domain = next(_DOMAINS)
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    for name in ("ROS_LOCALHOST_ONLY", "ROS_AUTOMATIC_DISCOVERY_RANGE"):
        monkeypatch.delenv(name, raising=False)
    return domain


@contextmanager
def dds_side(monkeypatch: pytest.MonkeyPatch) -> Iterator[Side]:
    """Cyclone DDS on loopback, in a domain where no other test is."""
    pytest.importorskip("cyclonedds")
    domain = alone_in_ros2(monkeypatch)
    script = str(Path(__file__).with_name("dds_peer.py"))
    peer = DdsPeer([sys.executable, script, str(domain)], dict(os.environ))
    assert peer.next() == "ready"
    try:
        yield Side(peer)
    finally:
        peer.end()


@contextmanager
def rclpy_side(monkeypatch: pytest.MonkeyPatch) -> Iterator[Side]:
    """rclpy as it would be with a ROS 2 that is sourced."""
    bus = fake_rclpy.install(monkeypatch)
    yield Side(fake_rclpy.FakePeer(bus))


SIDES = {"dds": dds_side, "rclpy": rclpy_side}


@pytest.fixture(params=SIDES)
def side(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Side]:
    """Each of them."""
    with SIDES[request.param](monkeypatch) as found:
        yield found
