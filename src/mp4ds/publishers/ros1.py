"""Publishes messages in ROS 1, through rospy."""

from __future__ import annotations

import struct
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from mp4ds.bags.convert import Converter
from mp4ds.errors import ConversionError, OptionError, PublishError
from mp4ds.publishers.protocol import Controls
from mp4ds.publishers.ros1_node import (
    ANSWER_S,
    answer,
    is_name,
    raw_class,
    set_bool_class,
    start_node,
)
from mp4ds.publishers.ros1_topics import MessageType, Topic
from mp4ds.records import Channel

_FLUSH_S = 3.0  # for what waits to be sent
_FAREWELL_S = 0.5  # for subscribers to read it: those of rospy forget it when the publisher goes
_TIME = struct.Struct("<II")
_NS = 1_000_000_000
_CLOCK = MessageType("rosgraph_msgs/Clock", "a9c97c1d230cfc112e270351a944ee47", b"time clock\n")
_CLOCK_QUEUE = 10  # an old time is of no use, but the first of some may be that of a message
_RENAME = "Leave the topic out with --exclude, or rename it with --remap."
_REMEDY = "Leave the topic out with --exclude."


class RospyPublisher:
    """Publishes in ROS 1 as a node of its own. There can be one in a process, and only once.

    rospy is that of the ROS 1 that is sourced, or any other that Python finds. A subscriber that is
    too slow loses the oldest messages, as with every publisher of ROS 1, and holds up nobody.

    Args:
        node: Name of the node; a number is added to it.
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
        self, *, node: str = "mp4ds_play", queue_size: int = 100, wait_s: float = 0.0
    ) -> None:
        if queue_size < 0 or wait_s < 0:
            raise OptionError("A queue of ROS 1 cannot be shorter than 0. Use 100, or 0 for any.")
        self._rospy, self._master = start_node(node)
        self._queue_size, self._wait_s = queue_size, wait_s
        self._topics: dict[str, Topic] = {}
        self._channels: dict[int, tuple[Channel, Topic, str | None]] = {}  # by id()
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
        if channel.metadata.get("latching", "").lower() in ("1", "true"):
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
        self._topic("/clock", _CLOCK, _CLOCK_QUEUE).publish(_TIME.pack(*divmod(time_ns, _NS)))

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

        self._subscribe("/clock", on_message)

    def listen(self, topic: str, on_message: Callable[[], None]) -> None:
        """See `Publisher`."""
        self._subscribe(topic, lambda _: on_message())

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

    def _kind(self, channel: Channel) -> MessageType:
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
        return MessageType(schema.name.replace("/msg/", "/"), md5sum, schema.data)

    def _topic(self, name: str, kind: MessageType, queue_size: int) -> Topic:
        """The topic of that name, advertised; channels of one topic share it."""
        if not is_name(name):
            raise ConversionError(name, "ROS 1 cannot have a topic of that name", _RENAME)
        resolved = self._rospy.resolve_name(name)
        topic = self._topics.get(resolved)
        if topic is None:
            make = self._make_publisher
            topic = self._topics[resolved] = Topic(name, kind, make, messages=queue_size)
        if topic.kind.md5sum != kind.md5sum:
            problem = (
                f"it has messages of types that differ, {topic.kind.name} ({topic.kind.md5sum}) "
                f"and {kind.name} ({kind.md5sum}), and a topic of ROS 1 has one type"
            )
            raise ConversionError(name, problem, "Leave it out, or play the recordings apart.")
        return topic

    def _make_publisher(self, name: str, kind: MessageType, listener: Any) -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # rospy's advice on queues, of which it is to have none
            return self._rospy.Publisher(name, raw_class(kind), subscriber_listener=listener)

    def _subscribe(self, topic: str, on_message: Callable[[Any], None]) -> None:
        if not is_name(topic):
            raise OptionError(f"ROS 1 has no topic named {topic!r}. Give one such as /reply.")
        self._rospy.Subscriber(topic, self._rospy.AnyMsg, on_message, tcp_nodelay=True)
