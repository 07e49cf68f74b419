"""Play datasets back to ROS, at their own pace, or in step with another player's clock."""

from __future__ import annotations

import math
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from mp4ds.dataset.dataset import datasets_in
from mp4ds.dataset.recording import HOW_TO_SALVAGE, open_selected
from mp4ds.errors import Refused, RemoteError, advising
from mp4ds.plugins.playing.options import PlayOptions
from mp4ds.plugins.playing.pace import CATCH_UP_NS, NS, FollowedClock, Pace
from mp4ds.plugins.playing.timeline import ReadAhead, Timeline
from mp4ds.plugins.ros.node import Node, Service, action, chosen_world, open_node, quick_switches
from mp4ds.records import Channel, Message


@dataclass(frozen=True)
class PlayProgress:
    """Progress of a player. Times are in nanoseconds of the recording.

    Attributes:
        time_ns: The current time.
        start_ns: Start of what is played.
        end_ns: End of what is played.
        rate: Seconds of the recording per second.
        state: ``playing``, ``paused``, or what it is waiting for.
        so_far: What was played, not to be changed.
    """

    time_ns: int
    start_ns: int
    end_ns: int
    rate: float
    state: str
    so_far: PlaySummary


@dataclass
class PlaySummary:
    """What was played.

    Attributes:
        messages: Number of messages published, by topic.
        not_installed: Number of messages not played because their type is not installed, by topic.
        dropped: Number of late frames dropped.
        slowed_s: Seconds that the clock waited for messages to be read or decoded.
        seconds: Duration of playback.
        loops: How often it started over.
        stopped: Whether it was stopped before the end.
        as_recorded: Images that could not be converted as requested and were published as
            recorded: topic -> reason -> number.
    """

    messages: dict[str, int] = field(default_factory=dict)
    not_installed: dict[str, int] = field(default_factory=dict)
    dropped: int = 0
    slowed_s: float = 0.0
    seconds: float = 0.0
    loops: int = 0
    stopped: bool = False
    as_recorded: dict[str, dict[str, int]] = field(default_factory=dict)


_NODES = {"ros1": "mp4ds_play", "ros2": "rosbag2_player"}
_REPORT_S = 0.2
_WAKE_S = 0.1
_SETTLE_S = 0.2  # as rosbag play: gives subscribers time to connect
_FOLLOW_END_S = 5.0


@dataclass(eq=False)
class _Burst:
    """Messages to publish while paused."""

    left: float
    done: int = 0
    is_sending: bool = False  # one of them is being published, and counts whatever ends the burst


class Player:
    """Plays a timeline once. `run` is called by one thread, the controls by any.

    Args:
        timeline: What to play.
        node: Publishes; not closed here.
        options: How to play it.
        progress: Called a few times a second, by the thread of `run`.
        steady: The monotonic clock, nanoseconds.

    Attributes:
        address: Where it publishes, for display.
        start_ns: Log time of the first message.
        follows_clock: Whether it plays in step with another player's /clock.
        is_paused: Whether playback is paused.
    """

    def __init__(
        self,
        timeline: Timeline,
        node: Node,
        options: PlayOptions | None = None,
        *,
        progress: Callable[[PlayProgress], None] | None = None,
        steady: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.address = node.address
        self.start_ns = timeline.start_ns
        self._timeline = timeline
        self._node = node
        self._options = options = options or PlayOptions()
        self.follows_clock = bool(options.follow_clock)
        self._progress = progress
        self._pace = Pace(options.rate, steady=steady)
        self._start, self._end = timeline.play_from, timeline.play_until
        self._clock_topics = timeline.named("clock_topics", options.clock_topics)
        self._pause_topics = timeline.named("pause_topics", options.pause_topics)
        self._changed = threading.Condition(threading.RLock())
        self._playback: ReadAhead[Message] | None = None
        self.is_paused = self._options.paused
        self._is_stopped = False
        self._is_over = False
        self._is_resting = False  # at the end, kept alive
        self._burst: _Burst | None = None
        self._target: int | None = None  # where to continue
        self._has_looped = False
        self._was_awaited = False  # whether the next message was not ready in time
        self._followed = FollowedClock(steady=steady)
        self._replies = 1  # on the lock-step topic
        self._controlled: int = self._start  # the last stamp on the rate-control topic
        self._pauses_for_topics = True
        self._paused_at: Message | None = None  # the message before which it paused
        self._last_frame: int | None = None  # log time of the last frame published
        self._reached = self._start  # log time of the last message published
        self._tick_s = 1 / options.clock if options.clock else math.inf
        self._next_tick = 0.0 if options.clock else math.inf
        self._next_report = 0.0
        self._installed: dict[int, tuple[Channel, bool]] = {}  # whether its type is, by id()
        self._done = PlaySummary()

    # ------------------------------------------------------------ controls

    @property
    def rate(self) -> float:
        """Seconds of the recording per second."""
        return self._pace.rate

    def pause(self) -> None:
        """Pause playback."""
        self._set_paused(True)

    def resume(self) -> None:
        """Resume playback."""
        self._set_paused(False)

    def toggle_paused(self) -> None:
        """Pause or resume playback."""
        with self._changed:
            self._set_paused(not self.is_paused)

    def _set_paused(self, is_paused: bool) -> None:
        with self._changed:
            self.is_paused = is_paused
            self._burst = None
            if is_paused:
                self._pace.jump(self._time())
                self._pace.pause()
            self._changed.notify_all()

    def toggle_topic_pauses(self) -> None:
        """Turn pausing before messages on chosen topics off, or on again."""
        self._pauses_for_topics = not self._pauses_for_topics

    def set_rate(self, rate: float) -> bool:
        """Change the playback rate; returns False if it is not greater than 0."""
        if not (math.isfinite(rate) and rate > 0):
            return False
        with self._changed:
            self._pace.rate = rate
            self._changed.notify_all()
        return True

    def play_next(self) -> bool:
        """While paused, publish the next message."""
        return self.burst(1) == 1

    def burst(self, messages: int) -> int:
        """While paused, publish messages as fast as possible; 0: all that are left."""
        mine = _Burst(messages or math.inf)
        with self._changed:
            while self._burst is not None and self._can_step():  # one burst at a time
                self._changed.wait(_WAKE_S)
            if messages < 0 or not self._can_step():
                return 0
            self._burst = mine
            self._changed.notify_all()
            while mine.is_sending or (self._burst is mine and self._can_step()):
                self._changed.wait(_WAKE_S)
            if self._burst is mine:
                self._burst = None
            return mine.done

    def _can_step(self) -> bool:
        return self.is_paused and not (self._is_over or self._is_stopped)

    def seek(self, time_ns: int) -> int:
        """Continue at a recording time, or the nearest that is played; returns that time."""
        with self._changed:
            self._target = min(max(time_ns, self._start), self._end + 1)
            self._burst = None
            self._changed.notify_all()
            return min(self._target, self._end)

    def play(self, start_ns: int, end_ns: int | None) -> bool:
        """Play an interval, if the player is waiting at the end."""
        with self._changed:
            if not self._is_resting or start_ns > self._timeline.end_ns:
                return False
            first, last = self._timeline.start_ns, self._timeline.end_ns
            self._start = max(start_ns, first)
            self._end = last if end_ns is None else min(end_ns, last)
            self._target = self._start
            self._changed.notify_all()
        return True

    def stop(self) -> None:
        """Stop playback, and end `run`."""
        # without the lock: a signal handler may interrupt the thread that holds it
        self._is_stopped = True

    # ------------------------------------------------------------ the loop

    def run(self) -> PlaySummary:
        """Play until the end, or until stopped.

        Raises:
            ConversionError: A topic cannot be published there.
            RemoteError: The connection was lost, or none of the message types is installed.
            FormatError: A dataset is damaged; names the topic and the message.
        """
        began = time.monotonic()
        with quick_switches():
            try:
                self._begin()
                while self._node.is_alive and not self._is_stopped and self._advance():
                    pass
            finally:
                self._is_over = True
                if self._playback is not None:
                    self._playback.close()
        self._report(is_last=True)
        self._done.seconds = time.monotonic() - began
        is_whole = self._is_resting or not self._is_stopped
        self._done.stopped = not (is_whole and self._node.is_alive)
        for republisher in self._timeline.republishers:
            for topic, reasons in republisher.as_recorded.items():
                self._done.as_recorded[topic] = dict(reasons)
        return self._done

    def _begin(self) -> None:
        self._advertise(self._timeline.channels)
        self._node.serve(player_services(self))
        if self._options.lock_step:
            self._node.listen(self._options.lock_step, self._on_reply)
        if self._options.rate_control_topic:
            self._node.listen(self._options.rate_control_topic, self._on_stamp)
        if self.follows_clock:
            self._node.follow_clock(self._on_clock)
        self._pace.jump(self._start)
        if self._options.clock_topics or self._options.clock_topics_all:
            self._node.clock(self._start)  # advertised before the first message
        self._read_from(self._start)  # decode ahead while waiting
        self._wait(max(_SETTLE_S, self._options.delay), "waiting")
        channels = [one for one in self._timeline.channels if self._is_installed(one)]
        while self._options.wait_for_subscribers and not self._is_stopped:
            if all(self._node.subscribers(item) > 0 for item in channels):
                break
            self._wait(0.1, "waiting for subscribers")
        if self._target is None and self._node.is_alive and not self._is_stopped:
            self._begin_at(self._start)

    def _advertise(self, channels: Sequence[Channel]) -> None:
        missing: list[Channel] = []
        for channel in channels:
            counts = self._done.messages
            try:
                self._node.advertise(channel)
            except Refused:  # the message type is not installed
                missing.append(channel)
                counts = self._done.not_installed
            counts.setdefault(channel.topic, 0)
            self._installed[id(channel)] = channel, counts is self._done.messages
        if not missing:
            return
        named = ", ".join(sorted({f"{one.topic} ({one.type_name})" for one in missing}))
        if not any(is_installed for _, is_installed in self._installed.values()):
            problem = f"no message type of the recording is installed: {named}"
            raise RemoteError(self._node.address, problem)
        warnings.warn(
            f"These topics are not played, as their message types are not installed: {named}; "
            "install their packages, or leave the topics out with `exclude`.",
            stacklevel=2,
        )

    def _is_installed(self, channel: Channel) -> bool:
        """Whether the type of a channel is installed."""
        if id(channel) not in self._installed:  # of an image that could not be converted
            self._advertise([channel])
        return self._installed[id(channel)][1]

    def _wait(self, seconds: float, state: str) -> None:
        end = time.monotonic() + seconds
        while not self._is_stopped and (left := end - time.monotonic()) > 0:
            self._report(state)
            time.sleep(min(left, 0.05, self._tick()))

    def _tick(self) -> float:
        """Publish /clock if that is due, and return the seconds until it is again."""
        now = time.monotonic()
        if now >= self._next_tick:
            is_behind = self._next_tick + self._tick_s <= now  # those missed are not made up for
            self._next_tick = (now if is_behind else self._next_tick) + self._tick_s
            self._node.clock(self._time())
        return max(0.0, self._next_tick - time.monotonic())

    def _advance(self) -> bool:
        """Publish the next message if it is due, else wait a little; returns False at the end."""
        with self._changed:
            target, self._target = self._target, None
        if target is not None:
            self._read_from(target)
            self._begin_at(target)
        tick = self._tick()
        with self._changed:  # held until `wait`, so that no notification is missed
            try:
                due = self._playback.head() if self._playback else None
            except StopIteration:
                return self._at_end()
            if due is not None and due.log_time > self._end:
                return self._at_end()
            seconds, state = self._seconds_until(due)
            if seconds > 0 or due is None:
                self._report(state)
                is_awaited = self._options.loop or self.is_paused
                if self._followed.silent_s > _FOLLOW_END_S and not is_awaited:
                    self._is_stopped = True
                elif self._target is None:
                    self._changed.wait(min(seconds, tick, _WAKE_S))
                return True
            burst = self._burst
            if burst is not None:
                burst.is_sending = True
        try:
            self._publish(due, burst)
        finally:
            if burst is not None:
                with self._changed:
                    burst.is_sending = False
                    self._changed.notify_all()
        return True

    def _seconds_until(self, due: Message | None) -> tuple[float, str]:
        """How long to wait, and the state meanwhile; 0: publish the message now."""
        if due is not None and not self._is_installed(due.channel):
            return 0.0, "playing"
        pauses = due is not None and due.channel.topic in self._pause_topics
        if pauses and self._pauses_for_topics and due is not self._paused_at:
            self._paused_at = due
            if not self.is_paused:
                self._set_paused(True)
        if self.is_paused:
            is_wanted = due is not None and self._burst is not None
            return 0.0 if is_wanted else math.inf, "paused"
        if due is None:
            self._was_awaited = self._pace.is_running
            return math.inf, "reading ahead"
        if self._timeline.is_frame(due) and self._replies < 1 and due.log_time != self._last_frame:
            return self._hold(due, self._options.lock_step)
        ahead = self._pace.now() - self._controlled
        most = round(self._options.rate_control_max_delay * NS)
        if self._options.rate_control_topic and ahead > most:
            return self._hold(due, self._options.rate_control_topic)
        if self._options.immediate:
            return 0.0, "playing"
        if self.follows_clock:
            state = "waiting for" if self._followed.time_ns is None else "following"
            return self._followed.seconds_until(due.log_time), f"{state} /clock"
        if not self._pace.is_running:
            self._pace.resume()
        skip = self._options.skip_empty
        if skip is not None and due.log_time - self._pace.now() > skip * NS:
            self._pace.jump(due.log_time)
        seconds = self._pace.seconds_until(due.log_time)
        if not self._options.drop:
            waited = self._pace.hold_back(due.log_time, was_awaited=self._was_awaited)
            self._done.slowed_s += waited / NS
        self._was_awaited = False
        return max(seconds, 0.0), "playing"

    def _hold(self, due: Message, topic: str) -> tuple[float, str]:
        """Stop the clock at a message that has to wait for a message on another topic."""
        if self._pace.now() >= due.log_time or topic == self._options.rate_control_topic:
            now = min(self._pace.now(), due.log_time)
            self._pace.pause()
            self._pace.jump(now)
        return math.inf, f"waiting for {topic}"

    def _time(self) -> int:
        """The recording time; never later than a message that is still to be published."""
        if self.follows_clock:
            return max(self._reached, self._followed.time_ns or 0)
        if self._options.immediate:
            return self._reached
        now = self._pace.now()
        if self._options.drop or self._is_resting or not self._pace.is_running:
            return now
        try:
            head = self._playback.head() if self._playback else None
        except Exception:  # the end, or an error that is raised when the message is due
            return min(now, self._end)
        return min(now, head.log_time if head is not None else self._reached)

    # ------------------------------------------------------------ publishing

    def _begin_at(self, time_ns: int) -> None:
        """Continue at the recording time that is read from."""
        with self._changed:
            self._replies, self._last_frame, self._reached = 1, None, time_ns
            self._controlled = time_ns
            self._is_resting = self._was_awaited = False
            self._pace.pause()
            self._pace.jump(time_ns)
        if self._has_looped and self._node.world == "ros2":
            self._wait(self._options.delay, "waiting")
        self._has_looped = False
        for due in self._timeline.latched(time_ns):
            self._send(due, time_ns)

    def _read_from(self, time_ns: int) -> None:
        if self._playback is not None:
            self._playback.close()
        self._playback = self._timeline.play(
            time_ns, is_late=self._is_late, on_ready=self._on_ready
        )

    def _at_end(self) -> bool:
        """Start over, or wait for a control that does; returns whether to continue. Locked."""
        self._burst = None  # no messages left
        self._changed.notify_all()
        if self._options.loop and not self.follows_clock and not self.is_paused:
            if self._target is None:
                self._target, self._has_looped = self._start, True
                self._done.loops += 1
            return True
        end = time.monotonic() + _FOLLOW_END_S
        while not self._is_stopped and self._target is None and self._node.is_alive:
            is_waiting = self.follows_clock and (self._options.loop or time.monotonic() < end)
            self._is_resting = self._options.keep_alive and not self.is_paused
            if not (is_waiting or self.is_paused or self._is_resting):
                return False
            if self._options.loop and not self.is_paused and not self.follows_clock:
                return True  # it was resumed
            self._burst = None
            self._report("at the end")
            self._changed.wait(min(_WAKE_S, self._tick()))
        return True

    def _publish(self, due: Message, burst: _Burst | None) -> None:
        with self._changed:
            if self._target is not None:
                return
        if self._playback is not None:
            next(self._playback)
        if not self._is_installed(due.channel):
            self._done.not_installed[due.channel.topic] += 1
        elif not (self._timeline.is_frame(due) and self._is_late(due.log_time)):
            is_chosen = due.channel.topic in self._clock_topics or self._options.clock_topics_all
            if is_chosen or (self._options.clock is not None and self._options.immediate):
                self._node.clock(due.log_time)
            self._send(due, due.log_time)
            with self._changed:
                self._reached = max(self._reached, due.log_time)
                if self.is_paused:
                    self._pace.jump(due.log_time)
                if burst is not None:
                    burst.done += 1
                    burst.left -= 1
                    if burst.left <= 0 and burst is self._burst:
                        self._burst = None
                        self._changed.notify_all()
                if self._timeline.is_frame(due):
                    if self._options.lock_step and due.log_time != self._last_frame:
                        self._replies -= 1
                    self._last_frame = due.log_time
        self._report("paused" if self.is_paused else "playing")

    def _send(self, due: Message, time_ns: int) -> None:
        if not self._is_installed(due.channel):
            return
        self._node.publish(due.channel, due.data, time_ns)
        topic = due.channel.topic
        self._done.messages[topic] = self._done.messages.get(topic, 0) + 1

    def _report(self, state: str = "", *, is_last: bool = False) -> None:
        if self._progress is None or not (is_last or time.monotonic() >= self._next_report):
            return
        self._next_report = time.monotonic() + _REPORT_S
        with self._changed:
            progress = PlayProgress(
                time_ns=self._time(),
                start_ns=self._start,
                end_ns=self._end,
                rate=self._pace.rate,
                state=state,
                so_far=self._done,
            )
        self._progress(progress)

    # ------------------------------------------------------------ callbacks, from any thread

    def _on_ready(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def _on_reply(self, _: int | None) -> None:
        with self._changed:
            self._replies = 1
            self._changed.notify_all()

    def _on_stamp(self, stamp_ns: int | None) -> None:
        with self._changed:
            self._controlled = self._controlled if stamp_ns is None else stamp_ns
            self._changed.notify_all()

    def _on_clock(self, time_ns: int) -> None:
        with self._changed:
            if self._followed.update(time_ns, self._start):
                self._target = max(time_ns, self._start)
            self._changed.notify_all()

    def _is_late(self, time_ns: int) -> bool:
        """Whether a frame is too late to be published; if so, counts it."""
        if not self._options.drop or self._options.immediate:
            return False
        with self._changed:
            is_playing = self._pace.is_running and not self.is_paused
            is_late = is_playing and self._pace.seconds_until(time_ns) * NS <= -CATCH_UP_NS
            self._done.dropped += is_late
        return is_late


# ---------------------------------------------------------------- services

_PLAY = (
    "builtin_interfaces/Time start_offset\nbuiltin_interfaces/Duration playback_duration\n"
    "builtin_interfaces/Time playback_until_timestamp"
)


def _nanoseconds(time: Any) -> int:
    return int(time.sec * NS + time.nanosec)


def player_services(player: Player) -> Sequence[Service]:
    """Those of `ros2 bag play`. They respond when the request has been carried out."""
    success = "bool success"
    return (
        action("pause", player.pause),
        action("resume", player.resume),
        action("toggle_paused", player.toggle_paused),
        Service("is_paused", "", "bool paused", lambda _: {"paused": player.is_paused}),
        Service("get_rate", "", "float64 rate", lambda _: {"rate": player.rate}),
        Service(
            "set_rate",
            "float64 rate",
            success,
            lambda request: {"success": player.set_rate(request.rate)},
        ),
        Service("play_next", "", success, lambda _: {"success": player.play_next()}),
        Service(
            "burst",
            "uint64 num_messages",
            "uint64 actually_burst",
            lambda request: {"actually_burst": player.burst(request.num_messages)},
        ),
        Service("play", _PLAY, success, partial(_play, player)),
        Service("seek", "builtin_interfaces/Time time", success, partial(_seek, player)),
        action("stop", player.stop),
    )


def _play(player: Player, request: Any) -> Mapping[str, Any]:
    start = player.start_ns + _nanoseconds(request.start_offset)
    length = _nanoseconds(request.playback_duration)
    until = _nanoseconds(request.playback_until_timestamp)
    # clients that leave out an end send 0
    ends = [*([start + length] if length > 0 else []), *([until] if until > 0 else [])]
    return {"success": player.play(start, max(ends, default=None))}


def _seek(player: Player, request: Any) -> Mapping[str, Any]:
    player.seek(_nanoseconds(request.time))
    return {"success": True}


# ---------------------------------------------------------------- playing datasets


def play(
    datasets: Sequence[Path | str] | Path | str,
    options: PlayOptions | None = None,
    *,
    progress: Callable[[PlayProgress], None] | None = None,
) -> PlaySummary:
    """Play back datasets, publishing their messages at the recorded times.

    Args:
        datasets: Datasets, or sidecars next to their videos; paths or URLs. Several are merged by
            log time.
        options: How to play them.
        progress: Called a few times a second.

    Returns:
        What was published, and what was left out.

    Raises:
        OptionError: An option is wrong.
        ConversionError: A topic cannot be published there; names it.
        RemoteError: ROS is not available, or the connection was lost.
        FormatError: A dataset is damaged.
    """
    with open_player(datasets, options, progress=progress) as player:
        return player.run()


@contextmanager
def open_player(
    datasets: Sequence[Path | str] | Path | str,
    options: PlayOptions | None = None,
    *,
    node: Node | None = None,
    progress: Callable[[PlayProgress], None] | None = None,
) -> Iterator[Player]:
    """A player of datasets that is not running yet.

    Args:
        datasets: As for `play`.
        options: As for `play`.
        node: Where to publish, not closed here; None: as the options say.
        progress: As for `play`.
    """
    chosen = options or PlayOptions()
    world = node.world if node else chosen_world("play", chosen.to)
    chosen = replace(chosen, names=chosen.names.in_world(world))
    with ExitStack() as stack:
        stack.enter_context(advising(HOW_TO_SALVAGE))
        opened = [
            stack.enter_context(open_selected(place, chosen.wants, layer=chosen.layer))
            for place in datasets_in(datasets)
        ]
        for dataset in opened:
            dataset.jpeg_quality = chosen.jpeg_quality
        timeline = Timeline(opened, chosen, world)
        node = node or stack.enter_context(open_node(world, chosen, _NODES[world]))
        follow = chosen.follow_clock
        if follow is None:
            follow = not (chosen.leads or chosen.immediate) and node.wants_clock
        chosen = replace(chosen, follow_clock=follow)
        yield Player(timeline, node, chosen, progress=progress)
