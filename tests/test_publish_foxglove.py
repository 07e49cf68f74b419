"""Foxglove clients get every message of a recording as it is, its time, and control the player."""

from __future__ import annotations

import base64
import json
import os
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from chromium import chromium
from each import each
from foxglove_client import PAUSE, PLAY, Client
from foxglove_scenes import FOXGLOVE, FOXGLOVE_SOURCES
from mp4ds.bags.formats import open_sources
from mp4ds.errors import ConversionError, OptionError, PublishError
from mp4ds.plugins.publishing.foxglove import FoxglovePublisher
from mp4ds.plugins.publishing.publisher import Publisher
from mp4ds.plugins.reporting.server import ReportServer
from mp4ds.records import Channel, Message, Schema
from player_scenes import STATIC, static_channel, static_transform
from sources import SOURCES, scene
from waiting import WATCHDOG_S

pytest.importorskip("foxglove")

STRING = Schema("std_msgs/msg/String", "ros2msg", b"string data\n")
LATCHED = {
    "ros1": {"latching": "1"},
    "ros2-old": {"offered_qos_profiles": "- history: 1\n  durability: 1\n  depth: 1\n"},
    "ros2-new": {"offered_qos_profiles": "- durability: transient_local\n  depth: 1\n"},
}
NOT_LATCHED = {
    "nothing": {},
    "ros1": {"latching": "0"},
    "ros2-old": {"offered_qos_profiles": "- history: 1\n  durability: 2\n"},
    "ros2-mixed": {
        "offered_qos_profiles": "- durability: transient_local\n- durability: volatile\n"
    },
}


def string_channel(topic: str = "/text", metadata: Mapping[str, str] | None = None) -> Channel:
    return Channel(1, topic, "cdr", STRING, metadata or {})


@pytest.fixture
def publisher() -> Iterator[FoxglovePublisher]:
    with FoxglovePublisher(port=0, backlog=4096) as made:
        yield made


class RecordedControls:
    """A player that keeps what it was asked for."""

    def __init__(self, first: int, last: int) -> None:
        self.is_paused = False
        self.rate = 1.0
        self.calls: list[tuple[Any, ...]] = []
        self._span = first, last

    def pause(self) -> None:
        self.calls.append(("pause",))
        self.is_paused = True

    def resume(self) -> None:
        self.calls.append(("resume",))
        self.is_paused = False

    def toggle_paused(self) -> None:
        self.is_paused = not self.is_paused

    def set_rate(self, rate: float) -> bool:
        self.calls.append(("set_rate", rate))
        if rate > 0:
            self.rate = rate
        return rate > 0

    def play_next(self) -> bool:
        raise NotImplementedError

    def step_back(self) -> bool:
        raise NotImplementedError

    def burst(self, messages: int) -> int:
        raise NotImplementedError

    def seek(self, time_ns: int) -> int:
        self.calls.append(("seek", time_ns))
        return min(max(time_ns, self._span[0]), self._span[1])

    def play(self, start_ns: int, end_ns: int | None) -> bool:
        raise NotImplementedError

    def toggle_topic_pauses(self) -> None:
        raise NotImplementedError

    @property
    def start_ns(self) -> int:
        return self._span[0]

    def stop(self) -> None:
        raise NotImplementedError


def announced_as(client: Client, channel: Channel) -> int:
    """The id under which a channel is announced with everything that it is."""
    schema = channel.schema or Schema("", "", b"")
    is_binary = schema.encoding in ("protobuf", "flatbuffer")
    data = base64.b64encode(schema.data).decode() if is_binary else schema.data.decode()
    found = [
        number
        for number, told in client.channels.items()
        if (told["topic"], told["encoding"], told["schemaName"], told["schema"])
        == (channel.topic, channel.message_encoding, schema.name, data)
        and told.get("schemaEncoding", "") == schema.encoding
        and told.get("metadata", {}) == channel.metadata
    ]
    assert len(found) == 1, channel.topic
    return found[0]


def subscribe(client: Client, publisher: Publisher, *channels: Channel) -> dict[int, int]:
    """Subscribe to channels that were advertised; their ids, by id()."""
    client.wait(lambda: len(client.channels) >= len({str(c.identity) for c in channels}))
    ids = {id(channel): announced_as(client, channel) for channel in channels}
    client.subscribe(*set(ids.values()))
    end = time.monotonic() + WATCHDOG_S
    while not all(publisher.subscribers(channel) for channel in channels):
        assert time.monotonic() < end
        time.sleep(0.005)
    return ids


# ---------------------------------------------------------------- messages


RECORDINGS = {
    **{
        name: (SOURCES[name], scene)
        for name in ("bag-none", "rosbag2-sqlite3-v9", "rosbag2-mcap-v5", "mcap-ros1-zstd")
    },
    **{name: (write, None) for name, write in FOXGLOVE_SOURCES.items()},
}


@pytest.mark.parametrize("name", RECORDINGS)
def test_every_message_of_a_recording_arrives(
    name: str, tmp_path: Path, publisher: FoxglovePublisher
) -> None:
    write, make = RECORDINGS[name]
    paths = write(tmp_path, make("rgb8") if make else FOXGLOVE["raw-bgr8"]())
    with open_sources(paths) as reader, Client(publisher.address) as client:
        messages = [record for record in reader.records() if isinstance(record, Message)]
        channels = {id(message.channel): message.channel for message in messages}
        assert len(channels) > 2
        for channel in channels.values():
            publisher.advertise(channel)
        ids = subscribe(client, publisher, *channels.values())
        for message in messages:
            publisher.publish(message.channel, message.data, message.log_time)
        expected = [(ids[id(m.channel)], m.log_time, bytes(m.data)) for m in messages]
        client.wait(lambda: len(client.messages) >= len(expected))
        assert client.messages == expected


@pytest.mark.parametrize("encoding", ["ros1", "cdr", "protobuf", "flatbuffer", "json", "cbor", ""])
@pytest.mark.parametrize("schema", [None, Schema("some/Type", "", b"")])
def test_channels_without_a_definition(
    encoding: str, schema: Schema | None, publisher: FoxglovePublisher
) -> None:
    channel = Channel(1, "/odd", encoding, schema, {})
    publisher.advertise(channel)
    with Client(publisher.address) as client:
        client.wait(lambda: bool(client.channels))
        (told,) = client.channels.values()
        assert (told["topic"], told["encoding"], told["schema"]) == ("/odd", encoding, "")
        assert told["schemaName"] == (schema.name if schema else "")
        client.subscribe(told["id"])
        while not publisher.subscribers(channel):
            time.sleep(0.005)
        publisher.publish(channel, memoryview(b"\x00\xff"), 2**64 - 1)
        client.wait(lambda: bool(client.messages))
        assert client.messages == [(told["id"], 2**64 - 1, b"\x00\xff")]


def test_what_is_no_utf8_is_announced_as_text(publisher: FoxglovePublisher) -> None:
    schema = Schema("a/A", "ros1msg", b"float64 t # \xb0C\n")
    channel = Channel(1, "/t", "ros1", schema, {"callerid": "/n\udcff"})
    publisher.advertise(channel)
    with Client(publisher.address) as client:
        client.wait(lambda: bool(client.channels))
        (told,) = client.channels.values()
        assert told["schema"] == "float64 t # �C\n"
        assert told["metadata"] == {"callerid": "/n?"}


def test_two_channels_on_one_topic(publisher: FoxglovePublisher) -> None:
    first = string_channel("/both", {"callerid": "/a"})
    second = string_channel("/both", {"callerid": "/b"})
    same_as_second = string_channel("/both", {"callerid": "/b"})
    for channel in (first, second, same_as_second):
        publisher.advertise(channel)
        publisher.advertise(channel)
    with Client(publisher.address) as client:
        client.wait(lambda: len(client.channels) == 2)
        ids = subscribe(client, publisher, second)
        assert [publisher.subscribers(c) for c in (first, second, same_as_second)] == [0, 1, 1]
        ids |= subscribe(client, publisher, first)
        for time_ns, channel in enumerate([first, second, same_as_second, first]):
            publisher.publish(channel, str(time_ns).encode(), time_ns)
        a, b = ids[id(first)], ids[id(second)]
        client.wait(lambda: len(client.messages) == 4)
        assert client.messages == [(a, 0, b"0"), (b, 1, b"1"), (b, 2, b"2"), (a, 3, b"3")]


def test_a_topic_that_is_advertised_while_clients_are_there(publisher: FoxglovePublisher) -> None:
    with Client(publisher.address) as client:
        late = string_channel("/late")
        publisher.advertise(late)
        (number,) = subscribe(client, publisher, late).values()
        publisher.publish(late, b"x", 5)
        client.wait(lambda: bool(client.messages))
        assert client.messages == [(number, 5, b"x")]
        client.unsubscribe(number)
        while publisher.subscribers(late):
            time.sleep(0.005)


def test_many_topics_while_clients_are_there() -> None:
    with FoxglovePublisher(port=0) as publisher, Client(publisher.address) as client:
        for n in range(1000):
            publisher.advertise(string_channel(f"/topic{n}"))
        client.wait(lambda: len(client.channels) == 1000)


def test_subscribers_come_and_leave(publisher: FoxglovePublisher) -> None:
    channel = string_channel()
    publisher.advertise(channel)
    assert publisher.subscribers(channel) == 0
    with Client(publisher.address) as one:
        subscribe(one, publisher, channel)
        with Client(publisher.address) as other:
            other.wait(lambda: bool(other.channels))
            other.subscribe(*other.channels)
            while publisher.subscribers(channel) != 2:
                time.sleep(0.005)
    while publisher.subscribers(channel):
        time.sleep(0.005)


@pytest.mark.parametrize("time_ns", [-1, 2**64])
def test_a_time_that_cannot_be_told_is_refused(time_ns: int, publisher: FoxglovePublisher) -> None:
    publisher.advertise(channel := string_channel())
    with pytest.raises(ConversionError, match=f"/text.* {time_ns} ns"):
        publisher.publish(channel, b"", time_ns)


def test_what_waits_is_sent_before_it_closes() -> None:
    channel = string_channel()
    with FoxglovePublisher(port=0, backlog=4096) as publisher, Client(publisher.address) as client:
        publisher.advertise(channel)
        subscribe(client, publisher, channel)
        for n in range(100):
            publisher.publish(channel, bytes(100_000), n)
        closing = threading.Thread(target=publisher.close)
        closing.start()
        client.wait_closed()
        closing.join()
        assert [time_ns for _, time_ns, _ in client.messages] == list(range(100))
        assert not publisher.is_alive
        with pytest.raises(PublishError, match="closed"):
            publisher.publish(channel, b"", 100)


# ---------------------------------------------------------------- latched


@pytest.mark.parametrize(("how", "kept"), {"ros1": 1, "ros2-old": 3, "ros2-new": 3}.items())
def test_latched_messages_reach_late_subscribers(
    how: str, kept: int, publisher: FoxglovePublisher
) -> None:
    latched = string_channel("/map", LATCHED[how])
    other = string_channel("/map", {**LATCHED[how], "callerid": "/other"})
    silent = string_channel("/silent", LATCHED[how])
    for channel in (latched, other, silent):
        publisher.advertise(channel)
    for n in range(3):
        publisher.publish(latched, b"map %d" % n, n)
    publisher.publish(other, memoryview(b"another"), 7)
    with Client(publisher.address) as client:
        ids = subscribe(client, publisher, latched, other, silent)
        client.wait(lambda: len(client.messages) == kept + 1)
        publisher.publish(latched, b"map 3", 9)
        client.wait(lambda: len(client.messages) == kept + 2)
        expected = [(ids[id(latched)], n, b"map %d" % n) for n in range(3)][-kept:]
        assert sorted(client.messages[:-1], key=lambda m: m[1]) == [
            *expected,
            (ids[id(other)], 7, b"another"),
        ]
        assert client.messages[-1] == (ids[id(latched)], 9, b"map 3")


def test_late_subscribers_get_all_static_transforms(publisher: FoxglovePublisher) -> None:
    channel = static_channel(1, 1, 1, 1)
    publisher.advertise(channel)
    sent = [static_transform(child) for child in STATIC]
    for n, payload in enumerate(sent):
        publisher.publish(channel, payload, n)
    with Client(publisher.address) as client:
        subscribe(client, publisher, channel)
        client.wait(lambda: len(client.messages) == len(sent))
        assert [data for _, _, data in client.messages] == sent


def test_each_of_two_that_cannot_be_told_apart_is_latched(publisher: FoxglovePublisher) -> None:
    pair = [string_channel("/tf_static", LATCHED["ros1"]) for _ in range(2)]
    for n, channel in enumerate(pair):
        publisher.advertise(channel)
        publisher.publish(channel, b"%d" % n, n)
    with Client(publisher.address) as client:
        subscribe(client, publisher, pair[0])
        client.wait(lambda: len(client.messages) == 2)
        assert [data for _, _, data in client.messages] == [b"0", b"1"]


@pytest.mark.parametrize("how", NOT_LATCHED)
def test_what_is_not_latched_is_not_sent_again(how: str, publisher: FoxglovePublisher) -> None:
    channel = string_channel("/map", NOT_LATCHED[how])
    publisher.advertise(channel)
    publisher.publish(channel, b"before", 1)
    with Client(publisher.address) as client:
        subscribe(client, publisher, channel)
        publisher.publish(channel, b"after", 2)
        client.wait(lambda: bool(client.messages))
        assert [data for _, _, data in client.messages] == [b"after"]


# ---------------------------------------------------------------- time and controls


def test_the_clock_is_told(publisher: FoxglovePublisher) -> None:
    publisher.advertise(channel := string_channel())
    with Client(publisher.address) as client:
        assert client.info["capabilities"] == ["time"]
        assert "dataStartTime" not in client.info
        subscribe(client, publisher, channel)
        for n in range(50):
            publisher.clock(n)
            publisher.publish(channel, b"", 1000 + n)
        publisher.clock(-5)
        publisher.clock(2**64)
        client.wait(lambda: len(client.times) == 52)
        client.drain(0.2)
        assert client.times == [*range(50), 0, 2**64 - 1]


def test_the_time_of_messages_is_told_where_no_clock_is(publisher: FoxglovePublisher) -> None:
    plain, latched = string_channel("/plain"), string_channel("/map", LATCHED["ros1"])
    with Client(publisher.address) as client:
        publisher.advertise(plain)
        publisher.advertise(latched)
        for n in range(10, 200):
            publisher.publish(plain, b"", n)
            publisher.publish(latched, b"", 1)
        client.wait(lambda: 199 in client.times)
        assert client.times == sorted(set(client.times))
        assert client.times[0] == 10


def test_clients_control_the_player() -> None:
    span = 5_000_000_000, 4_000_000_000_123_456_789
    controls = RecordedControls(*span)
    with FoxglovePublisher(port=0, span=span) as publisher, Client(publisher.address) as client:
        assert sorted(client.info["capabilities"]) == ["playbackControl", "time"]
        assert client.info["dataStartTime"] == {"sec": 5, "nsec": 0}
        assert client.info["dataEndTime"] == {"sec": 4_000_000_000, "nsec": 123_456_789}
        publisher.serve(controls)

        client.request(PAUSE, 1.0, name="pause")
        state = client.state("pause")
        assert (state.is_paused, state.speed, state.did_seek) == (True, 1.0, False)
        assert controls.calls == [("pause",)]

        client.request(PLAY, 1.1, name="faster")
        state = client.state("faster")
        assert (state.is_paused, state.speed) == (False, pytest.approx(1.1))
        assert controls.calls[1:] == [("set_rate", 1.1), ("resume",)]

        client.request(PLAY, 1.1, seek=7_000_000_000, name="seek")
        state = client.state("seek")
        assert (state.did_seek, state.time, state.is_paused) == (True, 7_000_000_000, False)
        assert controls.calls[3:] == [("seek", 7_000_000_000), ("resume",)]

        client.request(PAUSE, 1.1, seek=1, name="before the begin")
        state = client.state("before the begin")
        assert (state.did_seek, state.time, state.is_paused) == (True, span[0], True)

        client.request(PLAY, 0.0, name="no rate")
        assert client.state("no rate").speed == pytest.approx(1.1)


def test_clients_are_told_what_other_controls_do() -> None:
    controls = RecordedControls(0, 100)
    channel = string_channel()
    with FoxglovePublisher(port=0, span=(0, 100)) as publisher, Client(publisher.address) as client:
        publisher.advertise(channel)
        publisher.serve(controls)
        publisher.publish(channel, b"", 50)
        client.wait(lambda: any(not state.is_paused for state in client.states))
        controls.toggle_paused()
        client.wait(lambda: any(state.is_paused for state in client.states))
        assert client.states[-1].time == 50
        controls.rate = 2.5
        client.wait(lambda: client.states[-1].speed == 2.5)
        # one that comes while nothing changes
        with Client(publisher.address) as late:
            late.wait(lambda: bool(late.states))
            assert (late.states[0].is_paused, late.states[0].speed) == (True, 2.5)
        # back to the begin, as a loop does
        assert not any(state.did_seek for state in client.states)
        publisher.publish(channel, b"", 3)
        client.wait(lambda: client.states[-1].did_seek)
        assert client.states[-1].time == 3


def test_a_jump_that_a_client_wanted_is_told_once() -> None:
    channel = string_channel()
    with FoxglovePublisher(port=0, span=(0, 100)) as publisher, Client(publisher.address) as client:
        publisher.advertise(channel)
        publisher.serve(RecordedControls(0, 100))
        publisher.publish(channel, b"", 90)
        client.request(PLAY, 1.0, seek=10, name="back")
        client.state("back")
        publisher.publish(channel, b"", 10)
        publisher.publish(channel, b"", 11)
        client.wait(lambda: client.states[-1].time == 11)
        assert [state.request for state in client.states if state.did_seek] == ["back"]


def test_a_request_without_a_player_is_answered() -> None:
    with FoxglovePublisher(port=0, span=(0, 1)) as publisher, Client(publisher.address) as client:
        client.request(PLAY, 1.0)
        client.wait(lambda: bool(client.statuses))
        assert not client.states


# ---------------------------------------------------------------- clients that are slow


def stalled(publisher: FoxglovePublisher, channel: int) -> socket.socket:
    """A client that subscribes and then takes nothing."""
    host, port = publisher.address.removeprefix("ws://").split(":")
    made = socket.create_connection((host, int(port)))
    key = base64.b64encode(os.urandom(16)).decode()
    made.sendall(
        (
            f"GET / HTTP/1.1\r\nHost: {host}:{port}\r\nUpgrade: websocket\r\n"
            f"Connection: Upgrade\r\nSec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
        ).encode()
    )
    assert b"101" in made.recv(12)
    wanted = {"op": "subscribe", "subscriptions": [{"id": 1, "channelId": channel}]}
    text = json.dumps(wanted).encode()
    made.sendall(bytes([0x81, 0x80 | len(text), 0, 0, 0, 0]) + text)
    return made


def test_a_slow_client_stops_nobody() -> None:
    channel, frame = string_channel(), bytes(1_000_000)
    with FoxglovePublisher(port=0, backlog=16) as publisher, Client(publisher.address) as client:
        publisher.advertise(channel)
        (number,) = subscribe(client, publisher, channel).values()
        with stalled(publisher, number):
            while publisher.subscribers(channel) != 2:
                time.sleep(0.005)
            for n in range(100):
                publisher.publish(channel, frame, n)
                client.wait(lambda n=n: len(client.messages) > n)
            assert [time_ns for _, time_ns, _ in client.messages] == list(range(100))
            publisher.close()


def test_what_waits_for_a_slow_client_is_bounded() -> None:
    program = """
import resource, socket, sys, time
sys.path.insert(0, sys.argv[1])
from test_publish_foxglove import *
channel, frame = string_channel(), bytes(4_000_000)
publisher = FoxglovePublisher(port=0, backlog=8)
publisher.advertise(channel)
with Client(publisher.address) as client:
    client.wait(lambda: bool(client.channels))
    number = next(iter(client.channels))
slow = stalled(publisher, number)
while not publisher.subscribers(channel):
    time.sleep(0.005)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for n in range(100):
    publisher.publish(channel, frame, n)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)
publisher.close()
"""
    run = subprocess.run(
        [sys.executable, "-c", program, str(Path(__file__).parent)],
        capture_output=True,
        text=True,
        timeout=WATCHDOG_S,
        check=True,
    )
    # of the 400 MB, what is under way counts too
    assert int(run.stdout) < 150


# ---------------------------------------------------------------- what cannot be


@pytest.mark.parametrize(
    ("origin", "is_let_in"),
    [
        *((None, True), ("https://app.foxglove.dev", True), ("http://localhost:8080", True)),
        *(("http://127.0.0.1:3000", True), ("http://[::1]:3000", True), ("file://", True)),
        *(("http://robot:8080", True), ("https://robot:8080", False), ("null", False)),
        *(("https://evil.example", False), ("http://localhost.evil.example", False)),
        *(("https://app.foxglove.dev.evil.example", False), ("http://app.foxglove.dev", False)),
        *(("http://[", False), ("", False), ("HTTPS://evil.example", False)),
    ],
)
def test_web_sites_are_let_in_by_their_origin(origin: str | None, is_let_in: bool) -> None:
    with FoxglovePublisher(port=0, origins=["http://robot:8080"]) as publisher:
        headers = {} if origin is None else {"Origin": origin}
        try:
            with connect(
                publisher.address,
                subprotocols=[Subprotocol("foxglove.sdk.v1")],
                additional_headers=headers,
            ) as client:
                answered = json.loads(client.recv(20))["op"]
        except InvalidStatus as error:
            answered = error.response.status_code
    assert answered == ("serverInfo" if is_let_in else 403)


@pytest.mark.browser
def test_a_browser_reaches_neither_door_from_another_origin(tmp_path: Path) -> None:
    """The SDK's own port, which a site might find, takes only who trusts its certificate."""
    tries = """Promise.all(%s.map(url => new Promise(done => {
      const socket = new WebSocket(url, ['foxglove.sdk.v1']);
      socket.onmessage = () => done(true);
      socket.onerror = () => done(false);
    })))"""
    page = tmp_path / "page.html"
    page.write_text("<!doctype html><title>a page</title>")
    (tmp_path / "profile").mkdir()
    with (
        FoxglovePublisher(port=0, span=(0, 10)) as publisher,
        ReportServer({"/": page}, "/") as server,
        chromium(tmp_path / "profile") as browser,
    ):
        inner = publisher._server.port
        doors = [publisher.address, f"wss://127.0.0.1:{inner}", f"ws://127.0.0.1:{inner}"]
        browser.open("data:text/html,<p>a page", ready="true")
        assert browser.evaluate(tries % doors) == [False, False, False]
        serving = threading.Thread(target=server.serve)
        serving.start()
        try:
            browser.open(server.url, ready="document.title === 'a page'")
            assert browser.evaluate(tries % doors) == [True, False, False]
        finally:
            server.stop()
            serving.join()


def test_odd_clients_leave_the_gate_open(
    publisher: FoxglovePublisher, capfd: pytest.CaptureFixture[str]
) -> None:
    port = int(publisher.address.rpartition(":")[2])
    head = b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * 200 + b"\r\n"
    for said in (b"", b"\x16\x03\x01", b"\r\n\r\n", head, b"x" * 200_000, head + b"x" * 99):
        with socket.create_connection(("127.0.0.1", port), 20) as odd:
            odd.sendall(said)
            odd.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    with Client(publisher.address) as client:
        assert client.info["op"] == "serverInfo"
    assert capfd.readouterr() == ("", "")


def test_a_port_that_is_taken(publisher: FoxglovePublisher) -> None:
    port = int(publisher.address.rpartition(":")[2])
    with pytest.raises(PublishError, match=rf"ws://127\.0\.0\.1:{port}: .*in use.*`port`") as error:
        FoxglovePublisher(port=port)
    assert "os error" not in str(error.value)


def test_a_host_that_is_not_there() -> None:
    with pytest.raises(PublishError, match=r"ws://nowhere\.invalid:0"):
        FoxglovePublisher(host="nowhere.invalid", port=0)


def test_the_package_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(PublishError, match=r"pip install 'mp4ds\[foxglove\]'"):
        FoxglovePublisher(port=0)


@each(
    "wrong",
    [{"port": -1}, {"port": 65536}, {"span": (-1, 5)}, {"span": (5, 4)}, {"backlog": 0}],
    ids=str,
)
def test_options_that_cannot_be(wrong: dict[str, Any]) -> None:
    with pytest.raises(OptionError):
        FoxglovePublisher(**{"port": 0, **wrong})


def test_what_foxglove_has_not(publisher: FoxglovePublisher) -> None:
    with pytest.raises(OptionError, match="`foxglove`"):
        publisher.follow_clock(lambda time_ns: None)
    with pytest.raises(OptionError, match=r"`foxglove`.*/next"):
        publisher.listen("/next", lambda _: None)
    assert publisher.world is None
    assert not publisher.wants_clock
    assert publisher.is_alive


def test_an_address_of_ipv6() -> None:
    try:
        with socket.socket(socket.AF_INET6) as tried:
            tried.bind(("::1", 0))
    except OSError:
        pytest.skip("no IPv6 here")
    with FoxglovePublisher(host="::1", port=0) as publisher:
        assert publisher.address.startswith("ws://[::1]:")
        with Client(publisher.address) as client:
            assert client.info["name"] == "mp4ds"


def test_nothing_is_written_to_the_console() -> None:
    program = """
import sys
sys.path.insert(0, sys.argv[1])
from test_publish_foxglove import *
with FoxglovePublisher(port=0) as publisher:
    for caller in "ab":
        publisher.advertise(string_channel("/both", {"callerid": caller}))
    with Client(publisher.address) as client:
        client.wait(lambda: len(client.channels) == 2)
        client.subscribe(12345)
        client.wait(lambda: bool(client.statuses))
"""
    run = subprocess.run(
        [sys.executable, "-c", program, str(Path(__file__).parent)],
        capture_output=True,
        text=True,
        timeout=WATCHDOG_S,
        check=True,
    )
    assert run.stdout == ""
    assert run.stderr == ""
