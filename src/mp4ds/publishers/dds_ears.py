"""Hears what others publish in DDS: one thread that takes messages and finds publishers."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from mp4ds.publishers.dds_types import as_is, opaque_type

_PATIENCE = 50_000_000  # ns that the thread sleeps at most: then it looks for new publishers
_BATCH = 100
_KEPT = 1000  # messages that may wait to be taken
_TYPE_PATIENCE = 2_000_000_000  # ns to wait for another participant to tell of a type


class Ears:
    """Calls back for each message of others; a thread that runs until `close`.

    Only this thread calls back. Listeners of the library are not used: they would wait for
    Python's lock while it is held by a write that waits for the very thread they run on.

    Args:
        participant: The participant of which the readers are.
    """

    def __init__(self, participant: Any) -> None:
        self._participant = participant
        self._lock = threading.Lock()
        self._readers: list[tuple[Any, Callable[[Any], None]]] = []
        self._sought: list[_Sought] = []
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    def hear(self, reader: Any, on_sample: Callable[[Any], None]) -> None:
        """Call with each valid sample that a reader gets."""
        with self._lock:
            self._readers.append((reader, on_sample))
        self._start()

    def seek(self, topic: str, on_message: Callable[[], None]) -> None:
        """Call for each message of a topic, whatever its type, from when it has a publisher.

        Args:
            topic: Its DDS name.
            on_message: Called for each message.
        """
        with self._lock:
            self._sought.append(_Sought(self._participant, topic, on_message))
        self._start()

    def close(self) -> None:
        """End the thread, and let go of the readers and of the participant."""
        self._ended.set()
        if self._thread and self._thread is not threading.current_thread():
            self._thread.join()
        self._readers.clear()
        self._sought.clear()
        self._participant = None

    def _start(self) -> None:
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="mp4ds-dds", daemon=True)
            self._thread.start()

    def _run(self) -> None:
        from cyclonedds.core import WaitSet

        waiting = WaitSet(self._participant)
        attached: list[Any] = []
        while not self._ended.is_set():
            with self._lock:
                readers, sought = list(self._readers), list(self._sought)
            for reader, _ in readers[len(attached) :]:
                attached.append(_has_data(reader))
                waiting.attach(attached[-1])
            for one in sought:
                for reader in one.found():
                    self.hear(reader, one.on_sample)
            waiting.wait(_PATIENCE)
            for reader, on_sample in readers:
                self._take(reader, on_sample)

    def _take(self, reader: Any, on_sample: Callable[[Any], None]) -> None:
        for sample in reader.take(_BATCH):
            if self._ended.is_set():
                return
            if sample.sample_info.valid_data:
                on_sample(sample)


def _has_data(reader: Any) -> Any:
    from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState

    return ReadCondition(reader, SampleState.Any | ViewState.Any | InstanceState.Any)


class _Sought:
    """A topic whose type will be known when somebody publishes it."""

    def __init__(self, participant: Any, topic: str, on_message: Callable[[], None]) -> None:
        from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication

        self._participant = participant
        self._topic = topic
        self._on_message = on_message
        self._known: set[str] = set()
        self._publications = BuiltinDataReader(participant, BuiltinTopicDcpsPublication)

    def on_sample(self, _: Any) -> None:
        """A message came."""
        self._on_message()

    def found(self) -> list[Any]:
        """Readers of the types of publishers that have appeared since the last call."""
        readers = []
        own = self._participant.guid
        for endpoint in self._publications.take(_BATCH):
            is_new = endpoint.sample_info.valid_data and endpoint.topic_name == self._topic
            if is_new and endpoint.participant_key != own and endpoint.type_name not in self._known:
                self._known.add(endpoint.type_name)
                readers += self._reader(endpoint)
        return readers

    def _reader(self, endpoint: Any) -> list[Any]:
        from cyclonedds.core import DDSException, Policy, Qos
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic

        best_effort = Policy.Reliability.BestEffort in endpoint.qos
        qos = Qos(
            Policy.Reliability.BestEffort if best_effort else Policy.Reliability.Reliable(0),
            Policy.History.KeepLast(_KEPT),
            Policy.IgnoreLocal.Participant,
        )
        try:
            topic = Topic(self._participant, self._topic, self._class(endpoint))
            return [DataReader(self._participant, topic, qos=qos)]
        except DDSException:
            return []  # a second type of the topic: a participant knows one

    def _class(self, endpoint: Any) -> Any:
        """The publisher's own type where it tells it, as readers then have to have it."""
        from cyclonedds.core import DDSException
        from cyclonedds.dynamic import get_types_for_typeid

        if endpoint.type_id is not None:
            try:
                found = get_types_for_typeid(self._participant, endpoint.type_id, _TYPE_PATIENCE)
                return as_is(found[0])
            except DDSException:
                pass  # ROS goes by the name alone
        return opaque_type(endpoint.type_name.replace("::", "."))
