"""A node that plays a recording to a recorder: in this process, or in one that is killed.

    python record_scenes.py RECORDING DATASET RATE

records at so many times the recorded speed, until it is ended.
"""

from __future__ import annotations

import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from mp4ds.bags.formats import open_sources
from mp4ds.errors import Mp4dsError
from mp4ds.plugins.recording.options import RecordOptions
from mp4ds.plugins.recording.record import Recorder, RecordSummary, open_recorder
from mp4ds.plugins.ros.node import Follower, Receive
from mp4ds.processes import ProcessExecutor
from mp4ds.records import Channel, Message


class PlayedNode:
    """The messages of a recording, at their log times, which are those of /clock.

    Args:
        paths: The recording.
        rate: Times the recorded speed; None for as fast as they are read.
        before: Called before each message, by its number.
        altered: What messages of a topic become, by their number in the topic.
    """

    address = "a recording"
    poll_s = discovery_s = 0.0
    wants_clock = True

    def __init__(
        self,
        paths: Sequence[Path],
        *,
        rate: float | None = None,
        before: Callable[[int], object] = lambda number: None,
        altered: Mapping[str, Callable[[Message, int], Message]] = {},
    ) -> None:
        self.lost: Counter[str] = Counter()
        self.stop: Callable[[], object] = lambda: None  # called at the end
        self.time = 0  # of the latest message
        self._paths = list(paths)
        self._rate = rate
        self._before = before
        self._altered = altered
        self._receivers: dict[str, Receive] = {}
        self._followers: dict[str, Receive] = {}
        self._thread = threading.Thread(target=self._play, daemon=True)
        with open_sources(self._paths) as reader:
            self.world = reader.profile
            self._channels: list[Channel] = list(reader.channels)

    def follow_clock(self, on_time: Callable[[int], None]) -> None:
        self._tick = on_time
        on_time(1)  # it runs: topics are looked for

    def topics(self, is_wanted: Callable[[str, str], bool]) -> Mapping[str, Sequence[str]]:
        kinds = {one.topic: [one.type_name] for one in self._channels}
        new = {topic: kind for topic, kind in kinds.items() if is_wanted(topic, *kind)}
        if not new and self._thread.ident is None:  # all that are wanted are subscribed to
            self._thread.start()
        return new

    def subscribe(self, topic: str, kind: str, name: str, receive: Receive) -> None:
        self._receivers[topic] = receive

    def _play(self) -> None:
        begun, first = time.monotonic(), None
        counts: Counter[str] = Counter()
        with open_sources(self._paths) as reader:
            for number, record in enumerate(reader.records()):
                topic = record.channel.topic if isinstance(record, Message) else ""
                taking = [by[topic] for by in (self._receivers, self._followers) if topic in by]
                if not taking:
                    continue
                self._before(number)
                first = record.log_time if first is None else first
                if self._rate:
                    due = begun + (record.log_time - first) / 1e9 / self._rate
                    time.sleep(max(0.0, due - time.monotonic()))
                alter = self._altered.get(topic, lambda message, number: message)
                message = alter(record, counts[topic])
                counts[topic] += 1
                self._tick(message.log_time)
                self.time = message.log_time
                data = bytes(message.data)
                for receive in taking:
                    receive(message.channel, data, message.publish_time)
        self.stop()

    def serve(self, services: object) -> None:
        pass

    def follow(self, topic: str, follower: Follower) -> None:
        taking = {one.id: follower(one) for one in self._channels if one.topic == topic}
        self._followers[topic] = lambda channel, data, _: taking[channel.id](data)

    def close(self) -> None:
        pass

    def __enter__(self) -> PlayedNode:
        return self

    def __exit__(self, *_: object) -> None:
        pass


def recorded(node: PlayedNode, target: Path, **options: Any) -> RecordSummary:
    with played(node, (), target, RecordOptions(**{"all": True, **options})) as recorder:
        return recorder.run()


@contextmanager
def played(node: PlayedNode, *arguments: Any, **options: Any) -> Iterator[Recorder]:
    """A recorder that ends with the recording."""
    with open_recorder(*arguments, node=node, **options) as recorder:
        node.stop = recorder.stop
        yield recorder


def fail_to_pack(piece: int, problem: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the process that packs fail at one of the pieces."""
    submit = ProcessExecutor.submit

    def fail(self: ProcessExecutor, call: Any, folder: Path, number: int, *rest: Any) -> Any:
        if number == piece and not rest:
            raise Mp4dsError(problem)
        return submit(self, call, folder, number, *rest)

    monkeypatch.setattr(ProcessExecutor, "submit", fail)


def _main(recording: str, dataset: str, rate: str) -> None:
    node = PlayedNode([Path(recording)], rate=float(rate))
    with open_recorder((), dataset, RecordOptions(all=True), node=node) as recorder:
        recorder.run()


if __name__ == "__main__":
    _main(*sys.argv[1:])
