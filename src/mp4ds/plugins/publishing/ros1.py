"""Publishes messages in ROS 1, through rospy."""

from __future__ import annotations

import logging
import os
import re
import socket
import struct
import tempfile
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from concurrent.futures import TimeoutError as TimedOut
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from mp4ds.bags.convert import Converter
from mp4ds.errors import ConversionError, OptionError, PublishError
from mp4ds.plugins.publishing.latching import is_ros1
from mp4ds.plugins.publishing.names import PLAIN, NodeNames
from mp4ds.plugins.publishing.publisher import Controls
from mp4ds.records import Channel

MAX_BYTES = 128 << 20
"""What waits for one subscriber of a topic: nearly a second of a 5 MB camera at 30 Hz."""

_LENGTH = struct.Struct("<I")


@dataclass(frozen=True, slots=True)
class RosType:
    """What ROS 1 calls a type.

    Attributes:
        name: Such as ``sensor_msgs/Image``.
        md5sum: By which publishers and subscribers know that they mean the same.
        definition: The text, with those of the types it refers to; may be empty.
    """

    name: str
    md5sum: str
    definition: bytes


class Sender:
    """Sends to one subscriber, on a thread of its own, so that nobody waits for a slow one.

    Args:
        transport: rospy's connection to it.
        messages: How many may wait, 0 for as many as `MAX_BYTES` allows; beyond, the oldest is
            dropped.
    """

    def __init__(self, transport: Any, messages: int) -> None:
        self.dropped = 0
        self._transport = transport
        self._messages = messages
        self._queue: deque[bytes] = deque()
        self._bytes = 0
        self._taken = 0
        self._is_sending = False
        self._is_behind = False  # was waited for in vain
        self._is_over = False
        self._changed = threading.Condition()
        connection = transport.socket
        if connection is not None:
            # A small message would wait for the receipt of the one before: 40 ms on Linux.
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        threading.Thread(target=self._run, name="ros1-sender", daemon=True).start()

    def put(self, data: bytes, wait_s: float) -> None:
        """Queue a message.

        Args:
            data: As it is sent.
            wait_s: How long to wait for a subscriber that takes nothing, if its queue is full.
        """
        with self._changed:
            if wait_s and not self._is_behind:
                self._wait_for_room(len(data), wait_s)
            while self._queue and self._is_full(len(data)):
                self._bytes -= len(self._queue.popleft())
                self.dropped += 1
            self._queue.append(data)
            self._bytes += len(data)
            self._changed.notify_all()

    def flush(self, deadline: float) -> None:
        """Wait until all is sent, but not beyond a time of ``time.monotonic()``."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._is_over or not (self._queue or self._is_sending),
                max(0.0, deadline - time.monotonic()),
            )

    def end(self) -> None:
        """Send nothing more."""
        with self._changed:
            self._is_over = True
            self._queue.clear()
            self._bytes = 0
            self._changed.notify_all()

    def _is_full(self, more: int) -> bool:
        is_long = 0 < self._messages <= len(self._queue)
        return bool(self._queue) and (is_long or self._bytes + more > MAX_BYTES)

    def _wait_for_room(self, more: int, wait_s: float) -> None:
        while self._is_full(more) and not self._is_over:
            before = self._taken
            self._changed.wait(wait_s)  # until the next is taken
            if self._taken == before:
                self._is_behind = True
                return

    def _run(self) -> None:
        while (data := self._next()) is not None:
            try:
                self._transport.write_data(data)
            except Exception:  # the socket's errors, rospy's, and those of a race between both
                break
        self.end()
        self._transport.close()

    def _next(self) -> bytes | None:
        with self._changed:
            self._is_sending = False
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._is_over or self._queue)
            if self._is_over:
                return None
            data = self._queue.popleft()
            self._bytes -= len(data)
            self._taken += 1
            self._is_sending = True
            if not self._queue:
                self._is_behind = False
            self._changed.notify_all()
            return data


class AdvertisedTopic:
    """A topic that is advertised.

    Args:
        name: As it is advertised.
        kind: The type of its messages.
        make_publisher: Makes a publisher of rospy without a queue; called with a name, a type and
            who is told of subscribers.
        messages: How many may wait for each subscriber.
    """

    def __init__(
        self,
        name: str,
        kind: RosType,
        make_publisher: Callable[[str, RosType, Any], Any],
        *,
        messages: int,
    ) -> None:
        self.kind = kind
        self._messages = messages
        self._lock = threading.Lock()
        self._senders: dict[Any, Sender] = {}
        self._latched: dict[str, bytes] = {}  # by who published it
        self._dropped = 0
        with self._lock:  # the first may come before rospy returns
            self._publisher = make_publisher(name, kind, self)
            self._greet()

    @property
    def subscribers(self) -> int:
        """How many there are now."""
        return int(self._publisher.get_num_connections())

    @property
    def dropped(self) -> int:
        """Messages that were dropped since a subscriber was too slow."""
        with self._lock:
            return self._dropped + sum(sender.dropped for sender in self._senders.values())

    def mark_latched(self) -> None:
        """Tell subscribers to come that it is latched."""
        self._publisher.impl.add_headers({"latching": "1"})

    def publish(
        self, payload: bytes | memoryview, *, caller: str | None = None, wait_s: float = 0.0
    ) -> None:
        """Send a message to all subscribers.

        Args:
            payload: The message; not kept unless it is latched.
            caller: Who published it, if the last one of each is to be latched.
            wait_s: How long to wait for a subscriber that takes nothing and has a full queue.
        """
        with self._lock:
            self._greet()
            if not self._senders and caller is None:
                return
            data = b"".join((_LENGTH.pack(len(payload)), payload))
            for sender in self._senders.values():
                sender.put(data, wait_s)
            if caller is not None:
                self._latched.pop(caller, None)  # the latest comes last
                self._latched[caller] = data

    def flush(self, deadline: float) -> None:
        """Wait until all is sent, but not beyond a time of ``time.monotonic()``."""
        with self._lock:
            senders = list(self._senders.values())
        for sender in senders:
            sender.flush(deadline)

    def end(self) -> None:
        """Send nothing more."""
        with self._lock:
            for sender in self._senders.values():
                sender.end()

    def peer_subscribe(self, *_: object) -> None:
        """Called by rospy when it has made a connection."""
        with self._lock:
            self._greet()

    def peer_unsubscribe(self, *_: object) -> None:
        """Called by rospy when it has lost one: its sender ends by itself."""

    def _greet(self) -> None:
        """Give those that have come what is latched, before anything else; forget the others."""
        connections = self._publisher.impl.connections
        if len(connections) == len(self._senders) and all(c in self._senders for c in connections):
            return
        for gone in self._senders.keys() - set(connections):
            sender = self._senders.pop(gone)
            sender.end()
            self._dropped += sender.dropped
        for connection in connections:
            if connection not in self._senders:
                sender = self._senders[connection] = Sender(connection, self._messages)
                for data in self._latched.values():
                    sender.put(data, 0.0)


# ---------------------------------------------------------------- the node

_T = TypeVar("_T")

ANSWER_S = 4.0
"""For the master to answer, seconds."""

_BACKLOG = 1024
_LOGGING = "version: 1\nincremental: true\n"


def start_node(
    node: str,
    names: NodeNames = PLAIN,
) -> tuple[Any, str]:
    """Make this process a node; returns rospy, and where its master is.

    Args:
        node: Its name, to which a number is added; where `names` has one, that is the whole name.
        names: What it is called, and where it is.

    Raises:
        OptionError: The address of the master is none.
        PublishError: There is no rospy, or no master answers.
    """
    rosgraph, rospy = _imported()
    try:
        master = str(rosgraph.get_master_uri())
        # init_node() would ask for ever
        has_master = answer(rosgraph.is_master_online, ANSWER_S)
    except ValueError as error:
        raise OptionError(f"The address of the ROS master is wrong: {error}.") from None
    if not has_master:
        problem = "no ROS master answers there; start roscore, or set ROS_MASTER_URI"
        raise PublishError(master, problem)
    if rospy.core.is_initialized() or rospy.is_shutdown():
        raise PublishError(master, "this process was a ROS node already; start another one")
    try:
        with _own_logging():
            rospy.init_node(
                node,
                argv=[f"__{key}:={value}" for key, value in _told(names)],
                anonymous=True,
                disable_signals=True,
                disable_rostime=True,  # this process tells the time, and waits for nobody's
                disable_rosout=True,  # /rosout may be a topic of the recording
            )
            _receive_many()
    except (rospy.ROSException, ValueError, OSError) as error:
        raise PublishError(master, f"no node can be started ({error})") from None
    return rospy, master


def _told(names: NodeNames) -> list[tuple[str, str]]:
    told = (("name", names.node), ("ns", names.namespace))
    return [(key, value) for key, value in told if value]


def _receive_many() -> None:
    """Let many subscribers come at once: beyond rospy's 5, they try again after seconds."""
    from rospy.impl.tcpros_base import init_tcpros_server

    server = init_tcpros_server().tcp_ros_server
    if server is not None:
        server.server_sock.listen(_BACKLOG)


def _imported() -> tuple[Any, Any]:
    before = logging.getLoggerClass()
    try:
        import rosgraph
        import rospy
    except ImportError as error:
        problem = (
            f"ROS 1 cannot be used here ({error}); source its setup.bash, or install python3-rospy "
            "and use an environment made by python3 -m venv --system-site-packages"
        )
        raise PublishError("rospy", problem) from None
    finally:
        logging.setLoggerClass(before)  # rosgraph sets its own for the whole process
    return rosgraph, rospy


@contextmanager
def _own_logging() -> Iterator[None]:
    """Keep rospy from configuring the logging of the whole process, unless the user asks for it."""
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder, "logging.yaml")
        config.write_text(_LOGGING)
        mine = {"ROS_PYTHON_LOG_CONFIG_FILE": str(config), "ROS_LOG_DIR": folder}
        mine = {key: value for key, value in mine.items() if key not in os.environ}
        os.environ.update(mine)
        try:
            yield
        finally:
            for key in mine:
                del os.environ[key]


def answer(call: Callable[[], _T], seconds: float) -> _T | None:
    """What a call returns, None if that takes too long: rospy's calls have no time-out."""
    future: Future[_T] = Future()

    def ask() -> None:
        try:
            future.set_result(call())
        except Exception as error:
            future.set_exception(error)

    threading.Thread(target=ask, daemon=True).start()
    try:
        return future.result(seconds)
    except TimedOut:
        return None


def is_name(name: str) -> bool:
    """Whether a topic may be called so."""
    import rosgraph.names

    return bool(name.strip("/")) and bool(rosgraph.names.is_legal_name(name))


def raw_class(kind: RosType) -> Any:
    """A message class whose one field is the serialized message."""
    import genpy

    def serialize(self: Any, buff: Any) -> None:
        buff.write(self.payload)

    def deserialize(self: Any, data: bytes) -> Any:
        self.payload = bytes(data)
        return self

    members = {
        "__slots__": ["payload"],
        "_slot_types": ["uint8[]"],
        "_type": kind.name,
        "_md5sum": kind.md5sum,
        "_full_text": kind.definition,
        "_has_header": False,
        "serialize": serialize,
        "deserialize": deserialize,
    }
    return type(kind.name.rpartition("/")[2], (genpy.Message,), members)


def set_bool_class() -> Any:
    """The class of std_srvs/SetBool, which need not be installed."""
    request = "8b94c1b53db61fb6aed406028ad6332a", b"bool data\n"
    response = "937c9679a518e3a18d831e57125ea522", b"bool success\nstring message\n"
    members = {
        "_type": "std_srvs/SetBool",
        "_md5sum": "09fb03525b03e7ea1fd3992bafd87e16",
        "_request_class": raw_class(RosType("std_srvs/SetBoolRequest", *request)),
        "_response_class": raw_class(RosType("std_srvs/SetBoolResponse", *response)),
    }
    return type("SetBool", (), members)


# ---------------------------------------------------------------- the publisher

_FLUSH_S = 3.0  # for what waits to be sent
_FAREWELL_S = 0.5  # for subscribers to read it: those of rospy forget it when the publisher goes
_TIME = struct.Struct("<II")
_NS = 1_000_000_000
_CLOCK = RosType("rosgraph_msgs/Clock", "a9c97c1d230cfc112e270351a944ee47", b"time clock\n")
_CLOCK_QUEUE = 10  # an old time is of no use, but the first of some may be that of a message
_RENAME = "Leave the topic out with `exclude`, or rename it with `remap`."
_REMEDY = "Leave the topic out with `exclude`."


class RospyPublisher:
    """Publishes in ROS 1 as a node of its own. There can be one in a process, and only once.

    rospy is that of the ROS 1 that is sourced, or any other that Python finds. A subscriber that is
    too slow loses the oldest messages, as with every publisher of ROS 1, and holds up nobody.

    Args:
        node: Name of the node, where `names` has none; a number is added to it.
        names: What the node and /clock are called.
        queue_size: Messages that may wait for each subscriber of a topic, as with
            ``rosbag play --queue``; 0 for any number. More than 128 MiB never wait.
        wait_s: How long a message waits for a subscriber that takes nothing and has a full queue,
            before its oldest message is dropped; seconds. Above 0 a player that does not keep to a
            time is as fast as its subscribers, and they lose nothing. One that was waited for in
            vain is not waited for again before it has caught up.

    Raises:
        OptionError: An option makes no sense.
        PublishError: There is no rospy, or no master answers.
    """

    world: str | None = "ros1"

    def __init__(
        self,
        *,
        node: str = "mp4ds_play",
        names: NodeNames = PLAIN,
        queue_size: int = 100,
        wait_s: float = 0.0,
    ) -> None:
        if queue_size < 0 or wait_s < 0:
            raise OptionError("A queue of ROS 1 cannot be shorter than 0. Use 100, or 0 for any.")
        self._rospy, self._master = start_node(node, names)
        self._clock_topic = names.renamed("/clock")
        self._queue_size, self._wait_s = queue_size, wait_s
        self._topics: dict[str, AdvertisedTopic] = {}
        self._channels: dict[int, tuple[Channel, AdvertisedTopic, str | None]] = {}  # by id()
        self._converter: Converter | None = None
        self._is_closed = False

    @property
    def address(self) -> str:
        """Its master, to be shown."""
        return f"ROS 1, {self._master}"

    def advertise(self, channel: Channel) -> None:
        """See `Publisher`."""
        self._check_alive()
        topic = self._topic(channel.topic, self._kind(channel), self._queue_size)
        caller = None
        if is_ros1(channel):
            caller = channel.metadata.get("callerid", "")
            topic.mark_latched()
        self._channels[id(channel)] = channel, topic, caller

    def publish(self, channel: Channel, payload: bytes | memoryview, time_ns: int) -> None:
        """See `Publisher`."""
        _, topic, caller = self._channels[id(channel)]
        self._check_alive()
        topic.publish(payload, caller=caller, wait_s=self._wait_s)

    def clock(self, time_ns: int) -> None:
        """See `Publisher`."""
        if not 0 <= time_ns < _NS << 32:
            problem = f"ROS 1 cannot tell the time {time_ns} ns, only those of 1970 to 2106"
            raise ConversionError("/clock", problem, "Play without a clock.")
        self._check_alive()
        topic = self._topic(self._clock_topic, _CLOCK, _CLOCK_QUEUE)
        topic.publish(_TIME.pack(*divmod(time_ns, _NS)))

    def subscribers(self, channel: Channel) -> int:
        """See `Publisher`."""
        return self._channels[id(channel)][1].subscribers

    @property
    def dropped(self) -> int:
        """Messages that subscribers did not get because they were too slow, so far."""
        return sum(topic.dropped for topic in self._topics.values())

    def follow_clock(self, on_time: Callable[[int], None]) -> None:
        """See `Publisher`."""

        def on_message(message: Any) -> None:
            if len(message._buff) == _TIME.size:
                seconds, nanoseconds = _TIME.unpack(message._buff)
                on_time(seconds * _NS + nanoseconds)

        self._subscribe(self._clock_topic, on_message)

    def listen(self, topic: str, on_message: Callable[[int | None], None]) -> None:
        """See `Publisher`."""
        self._subscribe(topic, lambda message: on_message(_stamp_of(message)))

    def serve(self, controls: Controls) -> None:
        """Offer ``~pause_playback``, a std_srvs/SetBool, as rosbag play does."""

        def handle(request: Any) -> Any:
            is_wanted = request.payload != b"\0"
            is_change = is_wanted != controls.is_paused
            if is_change:
                (controls.pause if is_wanted else controls.resume)()
                told = f"Playback is now {'paused' if is_wanted else 'resumed'}"
            else:
                told = f"Bag is already {'paused.' if is_wanted else 'running.'}"
            text = told.encode()
            return service._response_class(struct.pack("<BI", is_change, len(text)) + text)

        service = set_bool_class()
        self._rospy.Service("~pause_playback", service, handle)

    @property
    def wants_clock(self) -> bool:
        """See `Publisher`."""
        try:
            found = answer(lambda: self._rospy.get_param("/use_sim_time", False), ANSWER_S)
        except (OSError, self._rospy.ROSException) as error:
            raise PublishError(self._master, f"the ROS master was lost ({error})") from None
        return bool(found)

    @property
    def is_alive(self) -> bool:
        """See `Publisher`."""
        return not self._rospy.is_shutdown()

    def close(self) -> None:
        """See `Publisher`."""
        if self._is_closed:
            return
        self._is_closed = True
        deadline = time.monotonic() + _FLUSH_S
        for topic in self._topics.values():
            topic.flush(deadline)
        if self.is_alive and any(topic.subscribers for topic in self._topics.values()):
            time.sleep(_FAREWELL_S)
        # A master that is gone is not waited for.
        answer(lambda: self._rospy.signal_shutdown("the player has ended"), ANSWER_S)
        for topic in self._topics.values():
            topic.end()

    def __enter__(self) -> RospyPublisher:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _check_alive(self) -> None:
        if not self.is_alive:
            raise PublishError(self._master, "the node was shut down by somebody else; play again")

    def _kind(self, channel: Channel) -> RosType:
        if channel.message_encoding != "ros1":
            problem = f"its messages are {channel.message_encoding or 'of no known encoding'}"
            raise ConversionError(channel.topic, f"{problem}, not of ROS 1", _REMEDY)
        if not channel.metadata.get("md5sum"):
            told = {key: value for key, value in channel.metadata.items() if key != "md5sum"}
            self._converter = self._converter or Converter("ros1")
            channel = self._converter.channel(replace(channel, metadata=told))
        schema, md5sum = channel.schema, channel.metadata.get("md5sum")
        if schema is None or not schema.name or not md5sum:
            problem = f"the definition of its type {channel.type_name!r} is not known"
            raise ConversionError(channel.topic, problem, _REMEDY)
        return RosType(schema.name.replace("/msg/", "/"), md5sum, schema.data)

    def _topic(self, name: str, kind: RosType, queue_size: int) -> AdvertisedTopic:
        """The topic of that name, advertised; channels of one topic share it."""
        if not is_name(name):
            raise ConversionError(name, "ROS 1 cannot have a topic of that name", _RENAME)
        resolved = self._rospy.resolve_name(name)
        topic = self._topics.get(resolved)
        if topic is None:
            make = self._make_publisher
            topic = self._topics[resolved] = AdvertisedTopic(name, kind, make, messages=queue_size)
        if topic.kind.md5sum != kind.md5sum:
            problem = (
                f"it has messages of types that differ, {topic.kind.name} ({topic.kind.md5sum}) "
                f"and {kind.name} ({kind.md5sum}), and a topic of ROS 1 has one type"
            )
            raise ConversionError(name, problem, "Leave it out, or play the recordings apart.")
        return topic

    def _make_publisher(self, name: str, kind: RosType, listener: Any) -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # rospy's advice on queues, of which it is to have none
            return self._rospy.Publisher(name, raw_class(kind), subscriber_listener=listener)

    def _subscribe(self, topic: str, on_message: Callable[[Any], None]) -> None:
        if not is_name(topic):
            raise OptionError(f"ROS 1 has no topic named {topic!r}. Give one such as /reply.")
        self._rospy.Subscriber(topic, self._rospy.AnyMsg, on_message, tcp_nodelay=True)


_HEADER = re.compile(r"(?:\s|#[^\n]*\n)*(?:std_msgs/)?Header\s")


def _stamp_of(message: Any) -> int | None:
    """The stamp of a message that begins with a header, nanoseconds."""
    definition = (message._connection_header or {}).get("message_definition", "")
    if not _HEADER.match(definition) or len(message._buff) < 12:
        return None
    _, seconds, nanoseconds = struct.unpack_from("<III", message._buff)
    return int(seconds * _NS + nanoseconds)
