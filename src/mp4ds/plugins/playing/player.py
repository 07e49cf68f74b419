"""Publishes a timeline at its own pace, or at that of a clock of others."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

from mp4ds.plugins.playing.timeline import Due, Playback, Restamper, Timeline, quick_switches
from mp4ds.plugins.publishing.publisher import Publisher


@dataclass(frozen=True)
class PlayerOptions:
    """How a timeline is played. Times are nanoseconds of the recording.

    Attributes:
        rate: Seconds of the recording in a second.
        start_ns: Where to begin; None for the first message.
        end_ns: Nothing after this is played; None for all.
        loop: Begin again at the end.
        delay_s: Seconds to wait before.
        paused: Stand still at first.
        immediate: Publish as fast as can be.
        clock_hz: How often /clock is published, besides with each message; None for not at all.
        follow: Play by the /clock of others.
        wait_for_subscribers: Wait until every topic has one.
        drop: Leave out frames that come too late, rather than play slower.
        lock_step: Topic of whose messages each lets the next frame go; empty for none.
        restamp: Give headers the time at which they are published.
    """

    rate: float = 1.0
    start_ns: int | None = None
    end_ns: int | None = None
    loop: bool = False
    delay_s: float = 0.0
    paused: bool = False
    immediate: bool = False
    clock_hz: float | None = None
    follow: bool = False
    wait_for_subscribers: bool = False
    drop: bool = False
    lock_step: str = ""
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
        slowed_s: Seconds that the clock stood since frames were not made in time.
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
        dropped: Frames left out since they were late.
        slowed_s: Seconds that the clock stood since frames were not made in time.
        seconds: How long it took.
        loops: How often it began again.
        stopped: Whether it was ended before its end.
        as_recorded: Where images were to be given in another form, the camera topics of which
            messages stayed as recorded: reason -> how many.
        thinned: Frames left out on request, by topic.
    """

    messages: dict[str, int] = field(default_factory=dict)
    dropped: int = 0
    slowed_s: float = 0.0
    seconds: float = 0.0
    loops: int = 0
    stopped: bool = False
    as_recorded: dict[str, dict[str, int]] = field(default_factory=dict)
    thinned: dict[str, int] = field(default_factory=dict)


# ---------------------------------------------------------------- pace

NS = 1_000_000_000

_TOLD = 8  # times of a clock that its pace is taken from
_JUMP_NS = 2 * NS
"""A clock of others that goes on by more than this at once was moved."""
_MISSED_NS = NS // 5
"""What may be missed of the beginning of a clock, as it takes a while to be connected with it."""


class Pace:
    """Maps this machine's steady clock to the time of the recording. All times are nanoseconds.

    Args:
        rate: Seconds of the recording in a second.
        steady: The machine's clock, which never jumps.
    """

    def __init__(self, rate: float = 1.0, *, steady: Callable[[], int] = time.monotonic_ns) -> None:
        self._steady = steady
        self._rate = rate
        self._is_running = False
        self._at = 0  # time of the recording ...
        self._since = steady()  # ... at this time of the machine

    @property
    def rate(self) -> float:
        """Seconds of the recording in a second."""
        return self._rate

    @rate.setter
    def rate(self, rate: float) -> None:
        self.jump(self.now())
        self._rate = rate

    @property
    def is_running(self) -> bool:
        """Whether it goes on."""
        return self._is_running

    def now(self) -> int:
        """The time of the recording."""
        if not self._is_running:
            return self._at
        return self._at + int((self._steady() - self._since) * self._rate)

    def jump(self, time_ns: int) -> None:
        """Go on from a time of the recording; or stand there, where it stands."""
        self._at, self._since = time_ns, self._steady()

    def run(self) -> None:
        """Go on."""
        self.jump(self.now())
        self._is_running = True

    def stand(self) -> None:
        """Stand still."""
        self.jump(self.now())
        self._is_running = False

    def seconds_until(self, time_ns: int) -> float:
        """Seconds of this machine until a time of the recording; negative where it is past.

        Where it stands still, as if it went on now.
        """
        return (time_ns - self.now()) / self._rate / NS

    def wall_of(self, time_ns: int) -> int:
        """When a time of the recording is or was, as nanoseconds since 1970."""
        return time.time_ns() + int((time_ns - self.now()) / self._rate)


class Ticks:
    """When /clock is due.

    Args:
        hertz: How often, besides with each message; None for never.
    """

    def __init__(self, hertz: float | None) -> None:
        self.is_wanted = hertz is not None
        self._period = 1 / hertz if hertz else math.inf
        self._next = 0.0

    def is_due(self) -> bool:
        """Whether it is due; counts as published then."""
        now = time.monotonic()
        if not self.is_wanted or now < self._next:
            return False
        self._next = max(self._next + self._period, now)  # what was missed is not made up for
        return True

    def published(self) -> None:
        """It was published with a message: the next one is due a period later."""
        self._next = time.monotonic() + self._period

    @property
    def seconds_left(self) -> float:
        """Until it is due."""
        return max(0.0, self._next - time.monotonic()) if self.is_wanted else math.inf


class FollowedClock:
    """The clock of others, which tells its time now and then.

    Between two times it is taken to go on as it did, by no more than one of its steps: the last
    messages of a player may come after the last time that it tells.

    Args:
        steady: This machine's clock, nanoseconds.
    """

    def __init__(self, *, steady: Callable[[], int] = time.monotonic_ns) -> None:
        self._steady = steady
        self._told: deque[tuple[int, int]] = deque(maxlen=_TOLD)  # its time, and this machine's

    @property
    def time_ns(self) -> int | None:
        """The last time that it told; None for nothing yet."""
        return self._told[-1][0] if self._told else None

    def hear(self, time_ns: int, start: int) -> bool:
        """Take a time; returns whether it was moved, or is first heard in the middle.

        Args:
            time_ns: What it tells.
            start: Where the recording starts, nanoseconds.
        """
        before = self.time_ns
        is_moved = time_ns > start + _MISSED_NS
        if before is not None:
            is_moved = not before <= time_ns <= before + _JUMP_NS
            if is_moved or time_ns == before:  # it stands, or is somewhere else
                self._told.clear()
        self._told.append((time_ns, self._steady()))
        return is_moved

    def seconds_until(self, time_ns: int) -> float:
        """Seconds of this machine until it is a time; infinite where that cannot be told yet."""
        if not self._told or time_ns <= self._told[-1][0]:
            return 0.0 if self._told else math.inf
        steps = [later - earlier for (earlier, _), (later, _) in pairwise(self._told)]
        if not steps or time_ns > self._told[-1][0] + max(steps):
            return math.inf
        rate = sum(steps) / max(1, self._told[-1][1] - self._told[0][1])
        waited = self._steady() - self._told[-1][1]
        return max(0.0, (time_ns - self._told[-1][0]) / rate - waited) / NS

    @property
    def silent_s(self) -> float:
        """Seconds since it told a time; 0 where it never did."""
        return (self._steady() - self._told[-1][1]) / NS if self._told else 0.0


# ---------------------------------------------------------------- player

_CATCH_UP_NS = 100_000_000  # how late a message may be for the player to catch up
_REPORT_S = 0.2
_WAKE_S = 0.1
_SETTLE_S = 0.2  # as rosbag play: what was advertised has to get about
_FOLLOW_END_S = 5.0


class Player:
    """Plays a timeline once. `run` belongs to one thread, the controls to any.

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
        self._steps: float = 0  # messages to publish while it stands still
        self._target: int | None = self._start  # where to go on
        self._followed = FollowedClock(steady=steady)
        self._replies = 1  # of the consumer that is waited for
        self._last_frame: int | None = None  # log time of the frame that was published last
        self._history: deque[int] = deque(maxlen=10_000)
        self._reached = self._start  # log time of what was published last
        self._ticks = Ticks(self._options.clock_hz)
        self._next_report = 0.0
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
            self._steps = 0
            if is_paused:
                self._pace.jump(self._time())
                self._pace.stand()
            self._changed.notify_all()

    def set_rate(self, rate: float) -> bool:
        """See `Controls`."""
        if not (math.isfinite(rate) and rate > 0):
            return False
        with self._changed:
            self._pace.rate = rate
            self._changed.notify_all()
        return True

    def play_next(self) -> bool:
        """See `Controls`."""
        return self._step(1)

    def burst(self, messages: int) -> int:
        """See `Controls`."""
        if messages < 0 or not self._step(messages or math.inf):
            return 0
        return messages

    def _step(self, messages: float) -> bool:
        with self._changed:
            if not self._is_paused or self._is_over:
                return False
            self._steps += messages
            self._changed.notify_all()
        return True

    def step_back(self) -> bool:
        """See `Controls`."""
        with self._changed:
            if not self._is_paused or len(self._history) < 2:
                return False
            last = self._history.pop()
            while len(self._history) > 1 and self._history[-1] == last:
                self._history.pop()
            self._target, self._steps = self._history.pop(), 1
            self._changed.notify_all()
        return True

    def seek(self, time_ns: int) -> bool:
        """See `Controls`."""
        with self._changed:
            if not self._start <= time_ns <= self._end:
                return False
            self._target, self._steps = time_ns, 0
            self._history.clear()
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
            PublishError: The receiving side was lost.
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
        self._done.stopped = self._is_stopped or not self._publisher.is_alive
        self._done.as_recorded = self._timeline.as_recorded
        self._done.thinned = self._timeline.thinned
        return self._done

    def _begin(self) -> None:
        for channel in self._timeline.channels:
            self._done.messages.setdefault(channel.topic, 0)
            self._publisher.advertise(channel)
        self._publisher.serve(self)
        if self._options.lock_step:
            self._publisher.listen(self._options.lock_step, self._on_reply)
        if self._options.follow:
            self._publisher.follow_clock(self._on_clock)
        if self._ticks.is_wanted:
            self._publisher.clock(self._start)  # advertised before the first message
        self._read_from(self._start)  # frames are made while it waits
        self._wait(_SETTLE_S + self._options.delay_s, "waiting")
        while self._options.wait_for_subscribers and not self._is_stopped:
            if all(self._publisher.subscribers(item) > 0 for item in self._timeline.channels):
                break
            self._wait(0.1, "waiting for subscribers")

    def _wait(self, seconds: float, state: str) -> None:
        end = time.monotonic() + seconds
        while not self._is_stopped and (left := end - time.monotonic()) > 0:
            self._report(state)
            time.sleep(min(left, 0.05))

    def _advance(self) -> bool:
        """Publish what is due, or wait a little; returns whether it is not over."""
        with self._changed:
            target, self._target = self._target, None
        if target is not None:
            self._jump(target)
        with self._changed:  # held until it waits, so that no message becomes ready unheard
            try:
                due = self._playback.head() if self._playback else None
            except StopIteration:
                return self._at_end()
            if due is not None and due.time_ns > self._end:
                return self._at_end()
            seconds, state = self._seconds_until(due)
            if seconds > 0 or due is None:
                if self._ticks.is_due():
                    self._publisher.clock(self._time())
                self._report(state)
                is_awaited = self._options.loop or self._is_paused
                if self._followed.silent_s > _FOLLOW_END_S and not is_awaited:
                    self._is_stopped = True
                elif self._target is None:
                    self._changed.wait(min(seconds, self._ticks.seconds_left, _WAKE_S))
                return True
        self._publish(due)
        return True

    def _seconds_until(self, due: Due | None) -> tuple[float, str]:
        """How long to wait, and what for; 0: the message is to be published now."""
        if self._is_paused:
            if due is None or self._steps < 1:
                return math.inf, "paused"
            self._steps -= 1
            return 0.0, "paused"
        if due is None:
            return math.inf, "reading ahead"
        if due.is_frame and self._replies < 1 and due.time_ns != self._last_frame:
            if self._pace.now() >= due.time_ns:  # the time stands, too
                self._pace.stand()
                self._pace.jump(due.time_ns)
            return math.inf, f"waiting for {self._options.lock_step}"
        if self._options.immediate:
            return 0.0, "playing"
        if self._options.follow:
            state = "waiting for" if self._followed.time_ns is None else "following"
            return self._followed.seconds_until(due.time_ns), f"{state} /clock"
        return self._until_due(due), "playing"

    def _until_due(self, due: Due) -> float:
        if not self._pace.is_running:
            self._pace.run()
        seconds = self._pace.seconds_until(due.time_ns)
        if -seconds * NS > _CATCH_UP_NS and not self._options.drop:
            self._done.slowed_s -= seconds
            self._pace.jump(due.time_ns)
        return max(seconds, 0.0)

    def _time(self) -> int:
        """The time of the recording, which is not after what is still to be published."""
        if self._options.follow:
            return max(self._reached, self._followed.time_ns or 0)
        now = self._pace.now()
        if self._options.drop or not self._pace.is_running:
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
            self._pace.stand()
            self._pace.jump(time_ns)
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
        """Begin again, or wait for who does; returns whether it goes on."""
        if self._options.loop and not self._options.follow:
            self._done.loops += 1
            self._target = self._start if self._target is None else self._target
            return True
        end = time.monotonic() + _FOLLOW_END_S
        while not self._is_stopped and self._target is None:
            is_waiting = self._options.follow and (self._options.loop or time.monotonic() < end)
            if not (is_waiting or self._is_paused):
                return False
            self._report("at the end")
            self._changed.wait(_WAKE_S)
        return True

    def _publish(self, due: Due) -> None:
        with self._changed:
            if self._target is not None:
                return
        if self._playback is not None:
            self._playback.take()
        if self._ticks.is_wanted:
            self._publisher.clock(due.time_ns)
            self._ticks.published()
        self._send(due, due.time_ns)
        with self._changed:
            self._history.append(due.time_ns)
            self._reached = max(self._reached, due.time_ns)
            if self._is_paused:
                self._pace.jump(due.time_ns)
            if due.is_frame:
                if self._options.lock_step and due.time_ns != self._last_frame:
                    self._replies -= 1
                self._last_frame = due.time_ns
        self._report("paused" if self._is_paused else "playing")

    def _send(self, due: Due, time_ns: int) -> None:
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

    def _on_reply(self) -> None:
        with self._changed:
            self._replies = 1
            self._changed.notify_all()

    def _on_clock(self, time_ns: int) -> None:
        with self._changed:
            if self._followed.hear(time_ns, self._start):
                self._target = max(time_ns, self._start)
            self._changed.notify_all()

    def _is_late(self, time_ns: int) -> bool:
        """Whether it is too late to make a frame; counts it then."""
        if not self._options.drop or self._options.immediate:
            return False
        with self._changed:
            is_going = self._pace.is_running and not self._is_paused
            is_late = is_going and self._pace.seconds_until(time_ns) * NS <= -_CATCH_UP_NS
            self._done.dropped += is_late
        return is_late
