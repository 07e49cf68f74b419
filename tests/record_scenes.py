"""A recorder's source that plays a recording: in this process, or in one that is killed.

    python record_scenes.py RECORDING DATASET RATE

records at so many times the recorded speed, until it is ended.
"""

from __future__ import annotations

import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from mp4ds.bags.formats import open_sources
from mp4ds.bags.protocols import Format
from mp4ds.plugins.recording.options import RecordOptions, Wanted
from mp4ds.plugins.recording.record import RecordSummary, open_recorder
from mp4ds.plugins.recording.source import Source
from mp4ds.plugins.ros.node import Service
from mp4ds.records import Message


class PlayedSource(Source):
    """The messages of a recording, then the end.

    Args:
        paths: The recording.
        rate: Times the recorded speed; None for as fast as they are read.
        is_endless: Whether the recorder goes on after the end.
        before: Called before each message, by its number.
        altered: What messages of a topic become, by their number in the topic.
    """

    address = "a recording"

    def __init__(
        self,
        paths: Sequence[Path],
        *,
        rate: float | None = None,
        is_endless: bool = False,
        before: Callable[[int], object] = lambda number: None,
        altered: Mapping[str, Callable[[Message, int], Message]] = {},
    ) -> None:
        self.warnings, self.topics, self.waiting_for = {}, {}, ""
        self._stop: Callable[[object], object] = lambda _: None
        self._paths = list(paths)
        self._rate = rate
        self._is_endless = is_endless
        self._before = before
        self._altered = altered
        with open_sources(self._paths) as reader:
            self.format: Format = reader.format
            self.profile = reader.profile

    def start(self, wanted: Wanted, take: Callable[[Message], None]) -> None:
        threading.Thread(target=self._play, args=(wanted, take), daemon=True).start()

    def _play(self, wanted: Wanted, take: Callable[[Message], None]) -> None:
        begun, first = time.monotonic(), None
        counts: Counter[str] = Counter()
        with open_sources(self._paths) as reader:
            for number, record in enumerate(reader.records()):
                if not isinstance(record, Message) or not wanted(record.channel.topic):
                    continue
                self._before(number)
                first = record.log_time if first is None else first
                if self._rate:
                    due = begun + (record.log_time - first) / 1e9 / self._rate
                    time.sleep(max(0.0, due - time.monotonic()))
                topic = record.channel.topic
                self.topics[topic] = None
                alter = self._altered.get(topic, lambda message, number: message)
                take(alter(replace(record, data=bytes(record.data)), counts[topic]))
                counts[topic] += 1
        if not self._is_endless:
            self._stop(None)

    @property
    def lost(self) -> Counter[str]:
        return Counter()

    def serve(self, services: Sequence[Service]) -> None:
        (self._stop,) = (one.answer for one in services if one.name == "stop")

    def close(self) -> None:
        pass


def recorded(source: PlayedSource, target: Path, **options: Any) -> RecordSummary:
    with open_recorder(
        (), target, RecordOptions(**{"all": True, **options}), source=source
    ) as recorder:
        return recorder.run()


def _main(recording: str, dataset: str, rate: str) -> None:
    source = PlayedSource([Path(recording)], rate=float(rate), is_endless=True)
    with open_recorder((), dataset, RecordOptions(all=True), source=source) as recorder:
        recorder.run()


if __name__ == "__main__":
    _main(*sys.argv[1:])
