"""A node of ROS 1, by rospy.

Imported only if rospy is installed.
"""

from __future__ import annotations

import os
import socket
import struct
import tempfile
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from concurrent.futures import TimeoutError as TimedOut
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import genpy
import rosgraph
import rosgraph.names
import rospy
import rospy.core
from rospy.impl.tcpros_base import init_tcpros_server

from mp4ds.bags.convert import Converter
from mp4ds.bags.latched import is_ros1
from mp4ds.bags.ros1 import make_channel
from mp4ds.errors import ConversionError, OptionError, RemoteError
from mp4ds.plugins.ros.node import CLOCK, Follower, Node, NodeNames, NodeOptions, Receive, Service
from mp4ds.records import Channel

MAX_BYTES = 128 << 20
"""Queue limit per subscriber and topic: nearly a second of a 5 MB camera at 30 Hz."""


class Sender:
    """Sends to one subscriber, in a thread of its own, so that a slow one delays no others.

    Args:
        transport: rospy's connection to it.
        messages: Queue size, 0 for as many as `MAX_BYTES` allows; when the queue is full, the
            oldest message is dropped.

    Attributes:
        dropped: Messages dropped so far.
    """

    def __init__(self, transport: Any, messages: int) -> None:
        self.dropped = 0
        self._transport = transport
        self._messages = messages
        self._queue: deque[bytes] = deque()
        self._bytes = 0
        self._taken = 0
        self._is_sending = False
        self._is_behind = False  # a wait for it has timed out
        self._is_over = False
        self._changed = threading.Condition()
        connection = transport.socket
        if connection is not None:
            # Nagle's algorithm would delay small messages: 40 ms on Linux.
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        threading.Thread(target=self._run, name="ros1-sender", daemon=True).start()

    def put(self, data: bytes, wait_s: float) -> None:
        """Queue a message.

        Args:
            data: The bytes to send.
            wait_s: How long to wait for a subscriber that receives nothing, if its queue is full.
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
        """Wait until everything is sent, or until a ``time.monotonic()`` deadline."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._is_over or not (self._queue or self._is_sending),
                max(0.0, deadline - time.monotonic()),
            )

    def end(self) -> None:
        """Discard the queue, and send nothing more."""
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
            except Exception:  # errors of the socket, of rospy, and of a race between both
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
    """An advertised topic.

    Args:
        name: The name.
        kind: The class of its messages.
        messages: Queue size per subscriber.
    """

    def __init__(self, name: str, kind: Any, *, messages: int) -> None:
        self.kind = kind
        self._messages = messages
        self._lock = threading.Lock()
        self._senders: dict[Any, Sender] = {}
        self._latched: dict[str, bytes] = {}  # by who published it
        # a subscriber may connect before rospy returns
        with self._lock, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # rospy's advice to use its queues
            self._publisher = rospy.Publisher(name, kind, subscriber_listener=self)
            self._greet()

    @property
    def subscribers(self) -> int:
        """Number of current subscribers."""
        return int(self._publisher.get_num_connections())

    def mark_latched(self) -> None:
        """Announce to later subscribers that the topic is latched."""
        self._publisher.impl.add_headers({"latching": "1"})

    def publish(
        self, payload: bytes | memoryview, *, caller: str | None = None, wait_s: float = 0.0
    ) -> None:
        """Send a message to all subscribers.

        Args:
            payload: The message; not kept unless it is latched.
            caller: The node that published it, if the last message of each node is latched.
            wait_s: How long to wait for a subscriber that receives nothing and has a full queue.
        """
        with self._lock:
            self._greet()
            if not self._senders and caller is None:
                return
            data = b"".join((struct.pack("<I", len(payload)), payload))
            for sender in self._senders.values():
                sender.put(data, wait_s)
            if caller is not None:
                self._latched.pop(caller, None)  # the latest comes last
                self._latched[caller] = data

    @property
    def senders(self) -> list[Sender]:
        """Those to its current subscribers."""
        with self._lock:
            return list(self._senders.values())

    def peer_subscribe(self, *_: object) -> None:
        """Called by rospy when a subscriber has connected."""
        with self._lock:
            self._greet()

    def peer_unsubscribe(self, *_: object) -> None:
        """Called by rospy when a subscriber has disconnected: its sender ends by itself."""

    def _greet(self) -> None:
        """Send new subscribers the latched messages first; forget those that are gone."""
        connections = self._publisher.impl.connections
        if len(connections) == len(self._senders) and all(c in self._senders for c in connections):
            return
        for gone in self._senders.keys() - set(connections):
            self._senders.pop(gone).end()
        for connection in connections:
            if connection not in self._senders:
                sender = self._senders[connection] = Sender(connection, self._messages)
                for data in self._latched.values():
                    sender.put(data, 0.0)


# ---------------------------------------------------------------- the node

_T = TypeVar("_T")

_ANSWER_S = 4.0
"""Seconds to wait for an answer of the master."""


def _start_node(node: str, names: NodeNames) -> str:
    """Make this process a node; returns the address of the master.

    Args:
        node: Its name, to which a number is appended, unless `names` has a name.
        names: Name and namespace of the node.

    Raises:
        OptionError: The address of the master is not valid.
        RemoteError: No master answers.
    """
    try:
        master = str(rosgraph.get_master_uri())
        # init_node() would wait for it forever
        has_master = _answer(rosgraph.is_master_online, _ANSWER_S)
    except ValueError as error:
        raise OptionError(f"The address of the ROS master is not valid: {error}.") from None
    if not has_master:
        problem = "no ROS master answers; start roscore, or set ROS_MASTER_URI"
        raise RemoteError(master, problem)
    if rospy.core.is_initialized() or rospy.is_shutdown():
        raise RemoteError(
            master, "a process can be a ROS node only once, and this one was; start a new process"
        )
    arguments = (("name", names.node), ("ns", names.namespace))
    try:
        with _own_logging():
            rospy.init_node(
                node,
                argv=[f"__{key}:={value}" for key, value in arguments if value],
                anonymous=True,
                disable_signals=True,
                disable_rostime=True,  # this process publishes the time, and must not wait for it
                disable_rosout=True,  # /rosout may be a topic of the recording
            )
            server = init_tcpros_server().tcp_ros_server
            if server is not None:  # beyond rospy's 5 at once, subscribers retry only after seconds
                server.server_sock.listen(1024)
    except (rospy.ROSException, ValueError, OSError) as error:
        raise RemoteError(master, f"cannot start a node ({error})") from None
    return master


@contextmanager
def _own_logging() -> Iterator[None]:
    """Keep rospy from configuring the logging of the process, unless the user configured it."""
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder, "logging.yaml")
        config.write_text("version: 1\nincremental: true\n")
        mine = {"ROS_PYTHON_LOG_CONFIG_FILE": str(config), "ROS_LOG_DIR": folder}
        mine = {key: value for key, value in mine.items() if key not in os.environ}
        os.environ.update(mine)
        try:
            yield
        finally:
            for key in mine:
                del os.environ[key]


def _answer(call: Callable[[], _T], seconds: float) -> _T | None:
    """The result of a call, or None after a timeout, as rospy's calls have none."""
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


def _is_name(name: str) -> bool:
    """Whether a topic name is valid."""
    return bool(name.strip("/") and rosgraph.names.is_legal_name(name))


def _raw_class(name: str, md5sum: str, definition: bytes) -> Any:
    """A message class whose only field is the serialized message."""

    def serialize(self: Any, buff: Any) -> None:
        buff.write(self.payload)

    def deserialize(self: Any, data: bytes) -> Any:
        self.payload = bytes(data)
        return self

    members = {
        "__slots__": ["payload"],
        "_slot_types": ["uint8[]"],
        "_type": name,
        "_md5sum": md5sum,
        "_full_text": definition,
        "_has_header": False,
        "serialize": serialize,
        "deserialize": deserialize,
    }
    return type(name.rpartition("/")[2], (genpy.Message,), members)


_SET_BOOL = (
    *("SetBool", "09fb03525b03e7ea1fd3992bafd87e16"),
    *("8b94c1b53db61fb6aed406028ad6332a", b"bool data\n"),
)
_TRIGGER = (
    *("Trigger", "937c9679a518e3a18d831e57125ea522"),
    *("d41d8cd98f00b204e9800998ecf8427e", b""),
)
"""Of services of std_srvs, which may not be installed: type, checksum, that of the request, and the
definition of the request."""


def _serve(name: str, kind: Sequence[Any], answer: Callable[[bytes], tuple[bool, str]]) -> None:
    """Offer a service.

    Args:
        name: Of the service.
        kind: Its type.
        answer: Called with a request; returns whether it succeeded, and a message.
    """
    type_name, md5sum, *request = kind
    fields = b"bool success\nstring message\n"
    response = _raw_class(
        f"std_srvs/{type_name}Response", "937c9679a518e3a18d831e57125ea522", fields
    )
    members = {
        "_type": f"std_srvs/{type_name}",
        "_md5sum": md5sum,
        "_request_class": _raw_class(f"std_srvs/{type_name}Request", *request),
        "_response_class": response,
    }

    def handle(request: Any) -> Any:
        is_done, said = answer(request.payload)
        text = said.encode()
        return response(struct.pack("<BI", is_done, len(text)) + text)

    rospy.Service(name, type(type_name, (), members), handle)


# ---------------------------------------------------------------- publishing and receiving

_FLUSH_S = 3.0  # to send what is queued
_FAREWELL_S = 0.5  # for subscribers to read it: rospy's drop unread data at a disconnect
_TIME = struct.Struct("<II")
_NS = 1_000_000_000
_CLOCK = _raw_class("rosgraph_msgs/Clock", "a9c97c1d230cfc112e270351a944ee47", b"time clock\n")
_CLOCK_QUEUE = 10  # old times are of no use, but one of the last few may belong to a message
_REMEDY = "Leave the topic out with `exclude`."


class Ros1Node(Node):
    """A node of ROS 1. A process can have one only once.

    It uses the rospy of the ROS 1 that is sourced, or any other that Python finds. A subscriber
    that is too slow loses the oldest messages, as with every ROS 1 publisher, and delays no others.
    Each publisher of a topic has its own channel, whose metadata is the connection header, as
    `rosbag record` keeps it.

    Args:
        options: How it takes part.
        name: Its name, to which a number is appended, unless the options have one.

    Raises:
        OptionError: The address of the master is not valid.
        RemoteError: No master answers.
    """

    world = "ros1"
    poll_s = 0.5  # the master is asked over the network

    def __init__(self, options: NodeOptions, name: str) -> None:
        super().__init__(options)
        self._master = _start_node(name, options.names)
        self._clock_topic = options.names.renamed(CLOCK)
        self._topics: dict[str, AdvertisedTopic] = {}
        self._channels: dict[int, tuple[Channel, AdvertisedTopic, str | None]] = {}  # by id()
        self._converter: Converter | None = None
        self._received: dict[tuple[str, tuple[tuple[str, str], ...]], Channel] = {}
        self._lock = threading.Lock()
        self._subscribers: list[Any] = []
        self._is_closed = False

    @property
    def address(self) -> str:
        """Its master."""
        return f"ROS 1, {self._master}"

    # ------------------------------------------------------------ publishing

    def advertise(self, channel: Channel) -> None:
        """Announce a channel."""
        self._check_alive()
        topic = self._topic(channel.topic, self._kind(channel), self._options.queue)
        caller = None
        if is_ros1(channel):
            caller = channel.metadata.get("callerid", "")
            topic.mark_latched()
        self._channels[id(channel)] = channel, topic, caller

    def publish(self, channel: Channel, payload: bytes | memoryview, time_ns: int) -> None:
        """Publish a message."""
        _, topic, caller = self._channels[id(channel)]
        self._check_alive()
        topic.publish(payload, caller=caller, wait_s=self._options.wait_s)

    def clock(self, time_ns: int) -> None:
        """Publish a recording time as /clock."""
        if not 0 <= time_ns < _NS << 32:
            problem = f"ROS 1 has times from 1970 to 2106 only, not {time_ns} ns"
            raise ConversionError("/clock", problem, "Play without /clock.")
        self._check_alive()
        topic = self._topic(self._clock_topic, _CLOCK, _CLOCK_QUEUE)
        topic.publish(_TIME.pack(*divmod(time_ns, _NS)))

    def subscribers(self, channel: Channel) -> int:
        """How many subscribers the channel's topic has now."""
        return self._channels[id(channel)][1].subscribers

    def _check_alive(self) -> None:
        if not self.is_alive:
            raise RemoteError(self._master, "the node was shut down from outside; play again")

    def _kind(self, channel: Channel) -> Any:
        if channel.message_encoding != "ros1":
            encoding = channel.message_encoding or "unknown"
            problem = f"its message encoding is {encoding}, not ros1"
            raise ConversionError(channel.topic, problem, _REMEDY)
        if not channel.metadata.get("md5sum"):
            metadata = {key: value for key, value in channel.metadata.items() if key != "md5sum"}
            self._converter = self._converter or Converter("ros1")
            channel = self._converter.channel(replace(channel, metadata=metadata))
        schema, md5sum = channel.schema, channel.metadata.get("md5sum")
        if schema is None or not schema.name or not md5sum:
            problem = f"the definition of its type {channel.type_name!r} is unknown"
            raise ConversionError(channel.topic, problem, _REMEDY)
        return _raw_class(schema.name.replace("/msg/", "/"), md5sum, schema.data)

    def _topic(self, name: str, kind: Any, queue_size: int) -> AdvertisedTopic:
        """The topic of that name, advertised; channels of one topic share it."""
        if not _is_name(name):
            remedy = "Leave the topic out with `exclude`, or rename it with `remap`."
            raise ConversionError(name, "its name is not valid in ROS 1", remedy)
        resolved = rospy.resolve_name(name)
        topic = self._topics.get(resolved)
        if topic is None:
            topic = self._topics[resolved] = AdvertisedTopic(name, kind, messages=queue_size)
        if topic.kind._md5sum != kind._md5sum:
            problem = (
                f"it has messages of different types, {topic.kind._type} ({topic.kind._md5sum}) "
                f"and {kind._type} ({kind._md5sum}), and a ROS 1 topic has one type"
            )
            raise ConversionError(name, problem, "Leave it out, or play the recordings separately.")
        return topic

    # ------------------------------------------------------------ receiving

    @property
    def wants_clock(self) -> bool:
        """Whether /use_sim_time is set."""
        return bool(self._of_master(lambda: rospy.get_param("/use_sim_time", False)))

    def _of_master(self, call: Callable[[], _T]) -> _T:
        try:
            found = _answer(call, _ANSWER_S)
        except (OSError, rospy.ROSException) as error:
            raise RemoteError(self._master, f"lost the ROS master ({error})") from None
        if found is None:
            raise RemoteError(self._master, "the ROS master does not respond")
        return found

    def follow_clock(self, on_time: Callable[[int], None]) -> None:
        """Subscribe to /clock."""

        def on_message(message: Any) -> None:
            if len(message._buff) == _TIME.size:
                seconds, nanoseconds = _TIME.unpack(message._buff)
                on_time(seconds * _NS + nanoseconds)

        self._subscribe(self._clock_topic, on_message)

    def follow(self, topic: str, follower: Follower) -> None:
        """Subscribe; a channel is known with its first message."""
        if not _is_name(topic):
            raise OptionError(f"{topic!r} is not a valid ROS 1 topic name, such as /reply.")
        takers: dict[int, Callable[[bytes], object]] = {}

        def receive(channel: Channel, data: bytes, _: int) -> None:
            if channel.id not in takers:
                takers[channel.id] = follower(channel)
            takers[channel.id](data)

        self.subscribe(topic, "", topic, receive)

    def topics(self, is_wanted: Callable[[str, str], bool]) -> Mapping[str, Sequence[str]]:
        """Topics that the master knows."""
        found = self._of_master(rospy.get_published_topics)
        return {topic: [kind] for topic, kind in found if is_wanted(topic, kind)}

    def subscribed_topics(self, node: str = "") -> frozenset[str]:
        """Topics with subscribers that the master knows."""
        own = rospy.get_name()
        _, subscribed, _ = self._of_master(rosgraph.Master(own).getSystemState)
        return frozenset(
            topic for topic, nodes in subscribed if (node in nodes if node else {*nodes} - {own})
        )

    def subscribe(self, topic: str, kind: str, name: str, receive: Receive) -> None:
        """Subscribe; each connection tells its own channel."""

        def on_message(message: Any) -> None:
            header: Mapping[str, str] = message._connection_header
            key = name, tuple(sorted(header.items()))
            with self._lock:
                if key not in self._received:
                    raw = {field.encode(): value.encode() for field, value in header.items()}
                    self._received[key] = make_channel(len(self._received), name.encode(), raw)
            receive(self._received[key], message._buff, 0)

        self._subscribe(topic, on_message)

    def _subscribe(self, topic: str, on_message: Callable[[Any], None]) -> None:
        # 256 KB are read at a time; rospy's 64 take a third more CPU time
        how = {"buff_size": 2**18, "tcp_nodelay": True}
        self._subscribers.append(rospy.Subscriber(topic, rospy.AnyMsg, on_message, **how))

    def serve(self, services: Sequence[Service]) -> None:
        """Offer what is usual of these.

        ``~pause_playback``, a std_srvs/SetBool, as rosbag play does; ``~snapshot``, a
        std_srvs/Trigger.
        """
        answers = {service.name: service.answer for service in services}

        def pause(request: bytes) -> tuple[bool, str]:
            is_wanted = request != b"\0"
            is_change = is_wanted != answers["is_paused"](None)["paused"]
            if is_change:
                answers["pause" if is_wanted else "resume"](None)
                return True, f"Playback is now {'paused' if is_wanted else 'resumed'}"
            return False, f"Bag is already {'paused.' if is_wanted else 'running.'}"

        def snapshot(_: bytes) -> tuple[bool, str]:
            is_done = answers["snapshot"](None)["success"]
            return is_done, "saving" if is_done else "not recording"

        if "is_paused" in answers:
            _serve("~pause_playback", _SET_BOOL, pause)
        if "snapshot" in answers:
            _serve("~snapshot", _TRIGGER, snapshot)

    # ------------------------------------------------------------ the end

    @property
    def is_alive(self) -> bool:
        """Whether the node has not been shut down."""
        return not rospy.is_shutdown()

    def close(self) -> None:
        """Send what is still waiting, for a limited time, and shut down the node."""
        if self._is_closed:
            return
        self._is_closed = True
        for subscriber in self._subscribers:
            subscriber.unregister()
        deadline = time.monotonic() + _FLUSH_S
        for topic in self._topics.values():
            for sender in topic.senders:
                sender.flush(deadline)
        if self.is_alive and any(topic.subscribers for topic in self._topics.values()):
            time.sleep(_FAREWELL_S)
        # The master may be gone.
        _answer(lambda: rospy.signal_shutdown("the node is closed"), _ANSWER_S)
        for topic in self._topics.values():
            for sender in topic.senders:
                sender.end()
