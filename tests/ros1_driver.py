"""Publishes what is in a recording through mp4ds, as it is told in JSON.

    ros1_driver.py RECORDING [OPTIONS]

OPTIONS are those of `PlayOptions` in JSON. Each line of the input is a call of a method of
`Driver`, or of its node, with its arguments, each line of the output what it returns.
"""

from __future__ import annotations

import json
import signal
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

from mp4ds.bags.formats import open_reader
from mp4ds.errors import Mp4dsError
from mp4ds.plugins.playing.options import PlayOptions
from mp4ds.plugins.ros.node import Service, action, open_node
from mp4ds.records import Channel, Message


def say(what: Any) -> None:
    sys.stdout.write(json.dumps(what) + "\n")  # at once: threads say things too
    sys.stdout.flush()


class Driver:
    """Publishes what is in a recording."""

    def __init__(self, path: str, options: dict[str, Any]) -> None:
        with open_reader(Path(path)) as reader:
            records = list(reader.records())
        self.messages = [
            Message(r.channel, r.log_time, r.publish_time, r.sequence, bytes(r.data))
            for r in records
            if isinstance(r, Message)
        ]
        self.channels: list[Channel] = []
        for message in self.messages:
            if not any(message.channel is channel for channel in self.channels):
                self.channels.append(message.channel)
        self.is_paused = False
        self.publisher = open_node("ros1", PlayOptions(**options), "mp4ds_play")
        self.waited = 0
        ros1: Any = sys.modules["mp4ds.plugins.ros.ros1"]  # since the node is open
        wait = ros1.Sender._wait_for_room

        def counted(sender: Any, more: int, wait_s: float) -> None:
            wait(sender, more, wait_s)
            self.waited += sender._is_behind

        ros1.Sender._wait_for_room = counted

    def node(self) -> str:
        import rospy

        return str(rospy.get_name())

    def advertise(self) -> int:
        for channel in self.channels:
            self.publisher.advertise(channel)
        return len(self.channels)

    def advertise_one(self, index: int) -> None:
        self.publisher.advertise(self.channels[index])

    def topics(self) -> list[str]:
        return [channel.topic for channel in self.channels]

    def subscribers(self) -> list[int]:
        return [self.publisher.subscribers(channel) for channel in self.channels]

    def await_subscribers(self, count: int) -> bool:
        """Wait until each channel has so many."""
        deadline = time.monotonic() + 120
        while any(found < count for found in self.subscribers()):
            if time.monotonic() > deadline:
                return False
            time.sleep(0.01)
        return True

    def publish(self, first: int = 0, last: int | None = None, rounds: int = 1) -> int:
        """Publish messages as fast as can be; returns how often one waited in vain."""
        before = self.waited
        for _ in range(rounds):
            for message in self.messages[first:last]:
                data = memoryview(message.data)
                self.publisher.publish(message.channel, data, message.log_time)
        return self.waited - before

    def clock(self, *times: int) -> int:
        for time_ns in times:
            self.publisher.clock(time_ns)
            time.sleep(0.02)
        return len(times)

    def follow_clock(self) -> None:
        self.publisher.follow_clock(lambda time_ns: say(["clock", time_ns]))

    def listen(self, topic: str) -> None:
        self.publisher.listen(topic, lambda stamp: say(["heard", topic, stamp]))

    def serve(self) -> None:
        paused = Service("is_paused", "", "", lambda _: {"paused": self.is_paused})
        changes = {"pause": True, "resume": False}
        services = [action(name, partial(self._set, value)) for name, value in changes.items()]
        self.publisher.serve([paused, *services])

    def _set(self, is_paused: bool) -> None:
        self.is_paused = is_paused

    def dropped(self) -> int:
        topics = self.publisher._topics.values()
        return sum(sender.dropped for topic in topics for sender in topic.senders)

    def close(self) -> None:
        self.publisher.close()
        self.publisher.close()


def main() -> None:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())  # with rospy's farewell to the master
    try:
        driver = Driver(sys.argv[1], json.loads(sys.argv[2]))
    except Mp4dsError as error:
        say([type(error).__name__, str(error)])
        return
    say("ready")
    for line in sys.stdin:
        method, *arguments = json.loads(line)
        try:
            found = getattr(driver if hasattr(driver, method) else driver.publisher, method)
            say(found(*arguments) if callable(found) else found)
        except Mp4dsError as error:
            say([type(error).__name__, str(error)])
        if method == "close":
            return


if __name__ == "__main__":
    main()
