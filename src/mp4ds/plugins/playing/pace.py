"""The clocks that set the pace of a player: its own, or another player's; and lateness."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from itertools import pairwise

NS = 1_000_000_000

_RECENT = 8  # times of another clock from which its rate is estimated
_JUMP_NS = 2 * NS
"""Another player's clock that advances by more than this at once has jumped."""
_MISSED_NS = NS // 5
"""How much of the beginning of a clock may be missed, since it takes a while to connect to it."""

CATCH_UP_NS = 100_000_000
"""How late a message may be because it was not ready."""

_SUSPENDED_NS = 10 * NS
"""A longer stall is a suspension: Ctrl-Z, or a machine that was asleep."""


class Pace:
    """Maps the machine's monotonic clock to recording time. All times are in nanoseconds.

    Args:
        rate: Seconds of the recording per second.
        steady: The monotonic clock.

    Attributes:
        is_running: Whether time passes.
    """

    def __init__(self, rate: float = 1.0, *, steady: Callable[[], int] = time.monotonic_ns) -> None:
        self._steady = steady
        self._rate = rate
        self.is_running = False
        self._at = 0  # recording time ...
        self._since = steady()  # ... at this time of the monotonic clock
        # how late messages are, nanoseconds: not ready in time, or the player was not scheduled
        self._unready = self._stalled = 0

    @property
    def rate(self) -> float:
        """Seconds of the recording per second."""
        return self._rate

    @rate.setter
    def rate(self, rate: float) -> None:
        self.jump(self.now())
        self._rate = rate

    def now(self) -> int:
        """The recording time."""
        if not self.is_running:
            return self._at
        return self._at + int((self._steady() - self._since) * self._rate)

    def jump(self, time_ns: int) -> None:
        """Continue from another recording time; stay paused if it is paused."""
        self._at, self._since = time_ns, self._steady()
        self._unready = self._stalled = 0

    def resume(self) -> None:
        """Let time pass."""
        self.jump(self.now())
        self.is_running = True

    def pause(self) -> None:
        """Stop time."""
        self.jump(self.now())
        self.is_running = False

    def seconds_until(self, time_ns: int) -> float:
        """Real seconds until a recording time; negative if it is past.

        If it is paused, as if it were resumed now.
        """
        return (time_ns - self.now()) / self._rate / NS

    def hold_back(self, time_ns: int, *, was_awaited: bool) -> int:
        """Let the clock wait for a message that was not ready in time.

        After the machine was busy elsewhere, it catches up, as every player does. If messages are
        read or decoded more slowly than they are played, the clock has to wait for them.

        Args:
            time_ns: When the message is due, in recording time.
            was_awaited: Whether the player had to wait until it was ready.

        Returns:
            How long the clock waits, real nanoseconds.
        """
        late = -round(self.seconds_until(time_ns) * NS)
        more = late - self._unready - self._stalled
        if late <= 0:
            self._unready = self._stalled = 0
        elif more > 0:
            self._unready += more if was_awaited else 0
            self._stalled += 0 if was_awaited else more
        else:
            self._stalled = max(0, self._stalled + more)
            self._unready = late - self._stalled
        waiting = self._unready if self._unready > CATCH_UP_NS else 0
        suspended = self._stalled if self._stalled > _SUSPENDED_NS else 0
        self._unready -= waiting
        self._stalled -= suspended
        self._at -= round((waiting + suspended) * self._rate)
        return waiting


class FollowedClock:
    """Another player's clock, which publishes its time now and then.

    Between two published times it is assumed to run on at its recent rate, but no further than one
    of its steps: the last messages of a player may come after the last time that it publishes.

    Args:
        steady: The monotonic clock, nanoseconds.
    """

    def __init__(self, *, steady: Callable[[], int] = time.monotonic_ns) -> None:
        self._steady = steady
        self._heard: deque[tuple[int, int]] = deque(maxlen=_RECENT)  # its time, and ours

    @property
    def time_ns(self) -> int | None:
        """The last time that was received; None for none yet."""
        return self._heard[-1][0] if self._heard else None

    def update(self, time_ns: int, start: int) -> bool:
        """Receive a time; returns whether the clock jumped, or was joined in the middle.

        Args:
            time_ns: The time received.
            start: Start of the recording, nanoseconds.
        """
        before = self.time_ns
        is_moved = time_ns > start + _MISSED_NS
        if before is not None:
            is_moved = not before <= time_ns <= before + _JUMP_NS
            if is_moved or time_ns == before:  # it is paused, or has jumped
                self._heard.clear()
        self._heard.append((time_ns, self._steady()))
        return is_moved

    def seconds_until(self, time_ns: int) -> float:
        """Real seconds until it reaches a time; infinite if that is not known yet."""
        if not self._heard or time_ns <= self._heard[-1][0]:
            return 0.0 if self._heard else math.inf
        steps = [later - earlier for (earlier, _), (later, _) in pairwise(self._heard)]
        if not steps or time_ns > self._heard[-1][0] + max(steps):
            return math.inf
        rate = sum(steps) / max(1, self._heard[-1][1] - self._heard[0][1])
        waited = self._steady() - self._heard[-1][1]
        return max(0.0, (time_ns - self._heard[-1][0]) / rate - waited) / NS

    @property
    def silent_s(self) -> float:
        """Seconds since the last time was received; 0 if none ever was."""
        return (self._steady() - self._heard[-1][1]) / NS if self._heard else 0.0
