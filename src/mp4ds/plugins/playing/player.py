"""Publishes a timeline at its own pace, or at that of a clock of others."""

from __future__ import annotations

import math
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from mp4ds.errors import PublishError, Refused
from mp4ds.plugins.playing.pace import CATCH_UP_NS, NS, FollowedClock, Lateness, Pace, Ticks
from mp4ds.plugins.playing.timeline import Due, Playback, Restamper, Timeline, quick_switches
from mp4ds.plugins.publishing.publisher import Publisher
from mp4ds.records import Channel


@dataclass(frozen=True)
class PlayerOptions:
    """How a timeline is played. Times are nanoseconds of the recording, topics as published.

    Attributes:
        rate: Seconds of the recording in a second.
        start_ns: Where to begin; None for the first message.
        end_ns: Nothing after this is played; None for all.
        loop: Start over at the end.
        keep_alive: Stay at the end, for those that come late.
        delay_s: Seconds to wait before.
        delays_loops: Whether to wait as long before each loop.
        paused: Stand still at first.
        immediate: Publish as fast as can be.
        clock_hz: How often /clock is published; None for not at all.
        clock_with: Topics before whose messages /clock is published; None for all.
        follow: Play by the /clock of others.
        wait_for_subscribers: Wait until every topic has one.
        drop: Leave out frames that come too late, rather than play slower.
        skip_empty_ns: Longer times without a message are skipped; None for none.
        pause_topics: Topics before whose messages it stands still.
        lock_step: Topic of whose messages each lets the next frame go; empty for none.
        rate_control: Topic whose stamps this player keeps to; empty for none.
        rate_control_ns: How far it may be ahead of them.
        restamp: Give headers the time at which they are published.
    """

    rate: float = 1.0
    start_ns: int | None = None
    end_ns: int | None = None
    loop: bool = False
    keep_alive: bool = False
    delay_s: float = 0.0
    delays_loops: bool = False
    paused: bool = False
    immediate: bool = False
    clock_hz: float | None = None
    clock_with: frozenset[str] | None = frozenset()
    follow: bool = False
    wait_for_subscribers: bool = False
    drop: bool = False
    skip_empty_ns: int | None = None
    pause_topics: frozenset[str] = frozenset()
    lock_step: str = ""
    rate_control: str = ""
    rate_control_ns: int = NS
    restamp: bool = False


@dataclass(frozen=True)
class PlayProgress:
    """Where a player stands. Times are nanoseconds of the recording.

    Attributes:
        time_ns: The time now.
        start_ns: Of what is played.
        end_ns: Of what is played.
        rate: Seconds of the recording in a second.
        state: ``playing``, ``paused``, or what it waits for.
        messages: How many were published.
        slowed_s: Seconds that the clock stood since messages were not read or decoded in time.
        dropped: Frames left out since they were late.
    """

    time_ns: int
    start_ns: int
    end_ns: int
    rate: float
    state: str
    messages: int
    slowed_s: float
    dropped: int


@dataclass
class PlaySummary:
    """What was played.

    Attributes:
        messages: Messages published, by topic.
        not_installed: Messages left out since their type is not installed, by topic.
        dropped: Frames left out since they were late.
        slowed_s: Seconds that the clock stood since messages were not read or decoded in time.
        seconds: How long it took.
        loops: How often it started over.
        stopped: Whether it was ended before its end.
        as_recorded: Where images were to be given in another form, the camera topics of which
            messages stayed as recorded: reason -> how many.
        thinned: Frames left out on request, by topic.
    """

    messages: dict[str, int] = field(default_factory=dict)
    not_installed: dict[str, int] = field(default_factory=dict)
    dropped: int = 0
    slowed_s: float = 0.0
    seconds: float = 0.0
    loops: int = 0
    stopped: bool = False
    as_recorded: dict[str, dict[str, int]] = field(default_factory=dict)
    thinned: dict[str, int] = field(default_factory=dict)


# ---------------------------------------------------------------- player

_REPORT_S = 0.2
_WAKE_S = 0.1
_SETTLE_S = 0.2  # as rosbag play: what was advertised has to get about
_FOLLOW_END_S = 5.0


@dataclass(eq=False)
class _Burst:
    """Messages to publish while it stands still."""

    left: float
    done: int = 0


class Player:
    """Plays a timeline once. `run` belongs to one thread, the controls to any other.

    Args:
        timeline: What to play.
        publisher: Where; not closed here.
        options: How.
        progress: Called a few times a second, by the thread that runs it.
        steady: This machine's clock, nanoseconds.
    """

    def __init__(
        self,
        timeline: Timeline,
        publisher: Publisher,
        options: PlayerOptions | None = None,
        *,
        progress: Callable[[PlayProgress], None] | None = None,
        steady: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._timeline = timeline
        self._publisher = publisher
        self._options = options or PlayerOptions()
        self._progress = progress
        self._pace = Pace(self._options.rate, steady=steady)
        start, end = self._options.start_ns, self._options.end_ns
        self._start = timeline.start_ns if start is None else max(start, timeline.start_ns)
        self._end = timeline.end_ns if end is None else min(end, timeline.end_ns)
        self._changed = threading.Condition(threading.RLock())
        self._playback: Playback | None = None
        self._read_ns: int | None = None  # where the playback begins, before it is used
        self._is_paused = self._options.paused
        self._is_stopped = False
        self._is_over = False
        self._is_resting = False  # at the end, kept alive
        self._burst: _Burst | None = None
        self._target: int | None = self._start  # where to go on
        self._has_looped = False
        self._lateness = Lateness()
        self._was_awaited = False  # whether the next message was not ready when it was asked for
        self._followed = FollowedClock(steady=steady)
        self._replies = 1  # of the consumer that is waited for
        self._controlled: int = self._start  # the last stamp of the topic that controls the rate
        self._pauses_for_topics = True
        self._paused_at: Due | None = None  # the message that it was paused before
        self._last_frame: int | None = None  # log time of the frame that was published last
        self._history: deque[int] = deque(maxlen=10_000)
        self._reached = self._start  # log time of what was published last
        self._ticks = Ticks(self._options.clock_hz)
        self._next_report = 0.0
        self._missing: dict[int, Channel] = {}  # by id()
        self._done = PlaySummary()
        self._restamper = Restamper() if self._options.restamp else None

    @property
    def address(self) -> str:
        """Where it publishes, to be shown."""
        return self._publisher.address

    @property
    def follows_clock(self) -> bool:
        """Whether it plays by the /clock of others."""
        return self._options.follow

    # ------------------------------------------------------------ controls

    @property
    def is_paused(self) -> bool:
        """See `Controls`."""
        return self._is_paused

    @property
    def rate(self) -> float:
        """See `Controls`."""
        return self._pace.rate

    @property
    def start_ns(self) -> int:
        """See `Controls`."""
        return self._timeline.start_ns

    def pause(self) -> None:
        """See `Controls`."""
        self._set_paused(True)

    def resume(self) -> None:
        """See `Controls`."""
        self._set_paused(False)

    def toggle_paused(self) -> None:
        """See `Controls`."""
        with self._changed:
            self._set_paused(not self._is_paused)

    def _set_paused(self, is_paused: bool) -> None:
        with self._changed:
            self._is_paused = is_paused
            self._burst = None
            self._lateness.clear()
            if is_paused:
                self._pace.jump(self._time())
                self._pace.stand()
            self._changed.notify_all()

    def toggle_topic_pauses(self) -> None:
        """See `Controls`."""
        self._pauses_for_topics = not self._pauses_for_topics

    def set_rate(self, rate: float) -> bool:
        """See `Controls`."""
        if not (math.isfinite(rate) and rate > 0):
            return False
        with self._changed:
            self._pace.rate = rate
            self._lateness.clear()
            self._changed.notify_all()
        return True

    def play_next(self) -> bool:
        """See `Controls`."""
        return self.burst(1) == 1

    def burst(self, messages: int) -> int:
        """See `Controls`."""
        mine = _Burst(messages or math.inf)
        with self._changed:
            while self._burst is not None and self._can_step():  # one at a time
                self._changed.wait(_WAKE_S)
            if messages < 0 or not self._can_step():
                return 0
            self._burst = mine
            self._changed.notify_all()
            while self._burst is mine and self._can_step():
                self._changed.wait(_WAKE_S)
            if self._burst is mine:
                self._burst = None
            return mine.done

    def _can_step(self) -> bool:
        return self._is_paused and not (self._is_over or self._is_stopped)

    def step_back(self) -> bool:
        """See `Controls`."""
        with self._changed:
            if not self._is_paused or len(self._history) < 2:
                return False
            last = self._history.pop()
            while len(self._history) > 1 and self._history[-1] == last:
                self._history.pop()
            self._target, self._burst = self._history.pop(), None
            return self.play_next()

    def seek(self, time_ns: int) -> int:
        """See `Controls`."""
        with self._changed:
            self._target = min(max(time_ns, self._start), self._end + 1)
            self._burst = None
            self._history.clear()
            self._changed.notify_all()
            return min(self._target, self._end)

    def play(self, start_ns: int, end_ns: int | None) -> bool:
        """See `Controls`."""
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
        """See `Controls`."""
        # no lock: a signal may interrupt the very thread that holds it
        self._is_stopped = True

    # ------------------------------------------------------------ the loop

    def run(self) -> PlaySummary:
        """Play until the end, or until it is stopped.

        Raises:
            ConversionError: A topic cannot be published there.
            PublishError: The receiving side was lost, or has none of the types.
            FormatError: A dataset is damaged; names the topic and the message.
        """
        began = time.monotonic()
        with quick_switches():
            try:
                self._begin()
                while self._publisher.is_alive and not self._is_stopped and self._advance():
                    pass
            finally:
                self._is_over = True
                if self._playback is not None:
                    self._playback.close()
        self._report(is_last=True)
        self._done.seconds = time.monotonic() - began
        is_whole = self._is_resting or not self._is_stopped
        self._done.stopped = not (is_whole and self._publisher.is_alive)
        self._done.as_recorded = self._timeline.as_recorded
        self._done.thinned = self._timeline.thinned
        return self._done

    def _begin(self) -> None:
        self._advertise()
        self._publisher.serve(self)
        if self._options.lock_step:
            self._publisher.listen(self._options.lock_step, self._on_reply)
        if self._options.rate_control:
            self._publisher.listen(self._options.rate_control, self._on_stamp)
        if self._options.follow:
            self._publisher.follow_clock(self._on_clock)
        self._pace.jump(self._start)
        if self._options.clock_with != frozenset():
            self._publisher.clock(self._start)  # advertised before the first message
        self._read_from(self._start)  # frames are made while it waits
        self._wait(max(_SETTLE_S, self._options.delay_s), "waiting")
        channels = [one for one in self._timeline.channels if id(one) not in self._missing]
        while self._options.wait_for_subscribers and not self._is_stopped:
            if all(self._publisher.subscribers(item) > 0 for item in channels):
                break
            self._wait(0.1, "waiting for subscribers")

    def _advertise(self) -> None:
        for channel in self._timeline.channels:
            try:
                self._publisher.advertise(channel)
            except Refused:  # a type that is not installed
                self._missing[id(channel)] = channel
                self._done.not_installed.setdefault(channel.topic, 0)
            else:
                self._done.messages.setdefault(channel.topic, 0)
        if not self._missing:
            return
        missing = self._missing.values()
        named = ", ".join(sorted({f"{one.topic} ({one.type_name})" for one in missing}))
        problem = f"types of messages are not installed there: {named}"
        if len(self._missing) == len(self._timeline.channels):
            raise PublishError(self._publisher.address, problem)
        remedy = "install their packages, or leave the topics out with `exclude`"
        warnings.warn(f"Not played, for their {problem}; {remedy}.", stacklevel=2)

    def _wait(self, seconds: float, state: str) -> None:
        end = time.monotonic() + seconds
        while not self._is_stopped and (left := end - time.monotonic()) > 0:
            self._tick()
            self._report(state)
            time.sleep(min(left, 0.05, self._ticks.seconds_left))

    def _tick(self) -> None:
        if self._ticks.is_due():
            self._publisher.clock(self._time())

    def _advance(self) -> bool:
        """Publish what is due, or wait a little; returns whether it is not over."""
        with self._changed:
            target, self._target = self._target, None
        if target is not None:
            self._jump(target)
        self._tick()
        with self._changed:  # held until it waits, so that no message becomes ready unheard
            try:
                due = self._playback.head() if self._playback else None
            except StopIteration:
                return self._at_end()
            if due is not None and due.time_ns > self._end:
                return self._at_end()
            seconds, state = self._seconds_until(due)
            if seconds > 0 or due is None:
                self._report(state)
                is_awaited = self._options.loop or self._is_paused
                if self._followed.silent_s > _FOLLOW_END_S and not is_awaited:
                    self._is_stopped = True
                elif self._target is None:
                    self._changed.wait(min(seconds, self._ticks.seconds_left, _WAKE_S))
                return True
            burst = self._burst
        self._publish(due, burst)
        return True

    def _seconds_until(self, due: Due | None) -> tuple[float, str]:
        """How long to wait, and what for; 0: the message is to be published now."""
        if due is not None and id(due.channel) in self._missing:
            return 0.0, "playing"
        self._pause_before(due)
        if self._is_paused:
            is_wanted = due is not None and self._burst is not None
            return 0.0 if is_wanted else math.inf, "paused"
        if due is None:
            self._was_awaited = self._pace.is_running
            return math.inf, "reading ahead"
        if due.is_frame and self._replies < 1 and due.time_ns != self._last_frame:
            return self._stand(due, self._options.lock_step)
        if self._is_ahead():
            return self._stand(due, self._options.rate_control)
        if self._options.immediate:
            return 0.0, "playing"
        if self._options.follow:
            state = "waiting for" if self._followed.time_ns is None else "following"
            return self._followed.seconds_until(due.time_ns), f"{state} /clock"
        return self._until_due(due), "playing"

    def _pause_before(self, due: Due | None) -> None:
        is_one = due is not None and due.channel.topic in self._options.pause_topics
        if is_one and self._pauses_for_topics and due is not self._paused_at:
            self._paused_at = due
            if not self._is_paused:
                self._set_paused(True)

    def _stand(self, due: Due, topic: str) -> tuple[float, str]:
        """Let the time stand where it reached a message that has to wait for others."""
        if self._pace.now() >= due.time_ns or topic == self._options.rate_control:
            now = min(self._pace.now(), due.time_ns)
            self._pace.stand()
            self._pace.jump(now)
            self._lateness.clear()
        return math.inf, f"waiting for {topic}"

    def _is_ahead(self) -> bool:
        ahead = self._pace.now() - self._controlled
        return bool(self._options.rate_control) and ahead > self._options.rate_control_ns

    def _until_due(self, due: Due) -> float:
        if not self._pace.is_running:
            self._pace.run()
        skip = self._options.skip_empty_ns
        if skip is not None and due.time_ns - self._pace.now() > skip:
            self._pace.jump(due.time_ns)
        seconds = self._pace.seconds_until(due.time_ns)
        if not self._options.drop:
            waited = self._lateness.met(-round(seconds * NS), was_awaited=self._was_awaited)
            self._done.slowed_s += waited / NS
            behind = (waited + self._lateness.suspended()) * self._pace.rate
            if behind:
                self._pace.jump(self._pace.now() - round(behind))
        self._was_awaited = False
        return max(seconds, 0.0)

    def _time(self) -> int:
        """The time of the recording, which is not after what is still to be published."""
        if self._options.follow:
            return max(self._reached, self._followed.time_ns or 0)
        if self._options.immediate:
            return self._reached
        now = self._pace.now()
        if self._options.drop or self._is_resting or not self._pace.is_running:
            return now
        try:
            head = self._playback.head() if self._playback else None
        except Exception:  # the end, or an error that is told when it is due
            return min(now, self._end)
        return min(now, head.time_ns if head is not None else self._reached)

    # ------------------------------------------------------------ what it does

    def _jump(self, time_ns: int) -> None:
        """Go on at a time of the recording."""
        if self._read_ns != time_ns:
            self._read_from(time_ns)
        self._read_ns = None
        with self._changed:
            self._replies, self._last_frame, self._reached = 1, None, time_ns
            self._controlled = time_ns
            self._is_resting = self._was_awaited = False
            self._pace.stand()
            self._pace.jump(time_ns)
            self._lateness.clear()
        if self._has_looped and self._options.delays_loops:
            self._wait(self._options.delay_s, "waiting")
        self._has_looped = False
        if time_ns > self._timeline.start_ns:
            for due in self._timeline.latched(time_ns):
                self._send(due, time_ns)

    def _read_from(self, time_ns: int) -> None:
        if self._playback is not None:
            self._playback.close()
        self._playback = self._timeline.play(
            time_ns, is_late=self._is_late, on_ready=self._on_ready
        )
        self._read_ns = time_ns

    def _at_end(self) -> bool:
        """Start over, or wait for who does; returns whether it goes on. Holds the lock."""
        self._burst = None  # there is nothing left
        self._changed.notify_all()
        if self._options.loop and not self._options.follow and not self._is_paused:
            if self._target is None:
                self._target, self._has_looped = self._start, True
                self._done.loops += 1
            return True
        end = time.monotonic() + _FOLLOW_END_S
        while not self._is_stopped and self._target is None and self._publisher.is_alive:
            is_waiting = self._options.follow and (self._options.loop or time.monotonic() < end)
            self._is_resting = self._options.keep_alive and not self._is_paused
            if not (is_waiting or self._is_paused or self._is_resting):
                return False
            if self._options.loop and not self._is_paused and not self._options.follow:
                return True  # it was resumed
            self._burst = None
            self._report("at the end")
            self._tick()
            self._changed.wait(min(_WAKE_S, self._ticks.seconds_left))
        return True

    def _publish(self, due: Due, burst: _Burst | None) -> None:
        with self._changed:
            if self._target is not None:
                return
        if self._playback is not None:
            self._playback.take()
        if id(due.channel) in self._missing:
            self._done.not_installed[due.channel.topic] += 1
        elif not (due.is_frame and self._is_late(due.time_ns)):
            if self._has_clock(due):
                self._publisher.clock(due.time_ns)
            self._send(due, due.time_ns)
            self._sent(due, burst)
        self._report("paused" if self._is_paused else "playing")

    def _has_clock(self, due: Due) -> bool:
        """Whether /clock goes with a message: on request, or where no time passes between two."""
        chosen, hertz = self._options.clock_with, self._options.clock_hz
        is_chosen = chosen is None or due.channel.topic in chosen
        return is_chosen or (hertz is not None and self._options.immediate)

    def _sent(self, due: Due, burst: _Burst | None) -> None:
        with self._changed:
            self._history.append(due.time_ns)
            self._reached = max(self._reached, due.time_ns)
            if self._is_paused:
                self._pace.jump(due.time_ns)
            if burst is not None:
                burst.done += 1
                burst.left -= 1
                if burst.left <= 0 and burst is self._burst:
                    self._burst = None
                    self._changed.notify_all()
            if due.is_frame:
                if self._options.lock_step and due.time_ns != self._last_frame:
                    self._replies -= 1
                self._last_frame = due.time_ns

    def _send(self, due: Due, time_ns: int) -> None:
        if id(due.channel) in self._missing:
            return
        payload = due.payload
        if self._restamper is not None:
            payload = self._restamper.restamped(due.channel, payload, self._pace.wall_of)
        self._publisher.publish(due.channel, payload, time_ns)
        topic = due.channel.topic
        self._done.messages[topic] = self._done.messages.get(topic, 0) + 1

    def _report(self, state: str = "", *, is_last: bool = False) -> None:
        if self._progress is None or not (is_last or time.monotonic() >= self._next_report):
            return
        self._next_report = time.monotonic() + _REPORT_S
        with self._changed:
            standing = PlayProgress(
                time_ns=self._time(),
                start_ns=self._start,
                end_ns=self._end,
                rate=self._pace.rate,
                state=state,
                messages=sum(self._done.messages.values()),
                slowed_s=self._done.slowed_s,
                dropped=self._done.dropped,
            )
        self._progress(standing)

    # ------------------------------------------------------------ what others tell, from any thread

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
            if self._followed.hear(time_ns, self._start):
                self._target = max(time_ns, self._start)
            self._changed.notify_all()

    def _is_late(self, time_ns: int) -> bool:
        """Whether it is too late for a frame; counts it then."""
        if not self._options.drop or self._options.immediate:
            return False
        with self._changed:
            is_going = self._pace.is_running and not self._is_paused
            is_late = is_going and self._pace.seconds_until(time_ns) * NS <= -CATCH_UP_NS
            self._done.dropped += is_late
        return is_late
