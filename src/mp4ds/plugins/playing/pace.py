"""The clocks that a player goes by: its own, that of others, and what is late by them."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from itertools import pairwise

NS = 1_000_000_000

_TOLD = 8  # times of a clock that its pace is taken from
_JUMP_NS = 2 * NS
"""A clock of others that goes on by more than this at once was moved."""
_MISSED_NS = NS // 5
"""What may be missed of the beginning of a clock, as it takes a while to be connected with it."""

CATCH_UP_NS = 100_000_000
"""How late a message may be for want of being ready."""

_SUSPENDED_NS = 10 * NS
"""A longer stall was meant: Ctrl-Z, or a machine that slept."""


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
    """When /clock is due: so many times a second, as long as the machine can.

    Args:
        hertz: How often; None for never.
    """

    def __init__(self, hertz: float | None) -> None:
        self._period = 1 / hertz if hertz else math.inf
        self._next = 0.0 if hertz else math.inf

    def is_due(self) -> bool:
        """Whether it is due; counts as published then."""
        now = time.monotonic()
        if now < self._next:
            return False
        self._next += self._period
        if self._next <= now:  # what was missed is not made up for
            self._next = now + self._period
        return True

    @property
    def seconds_left(self) -> float:
        """Until it is due."""
        return max(0.0, self._next - time.monotonic())


class Lateness:
    """Why messages are late: they were not ready, or the player was not scheduled. Nanoseconds.

    What is late since the machine was busy elsewhere is made up for, as every player does. Where
    messages are read or decoded more slowly than they are played, the clock has to wait.
    """

    def __init__(self) -> None:
        self._unready = 0
        self._stalled = 0

    def clear(self) -> None:
        """Begin anew, as after a jump."""
        self._unready = self._stalled = 0

    def met(self, late: int, *, was_awaited: bool) -> int:
        """Take a message that is due; returns by how much the clock has to wait for its like.

        Args:
            late: How late it is; negative where it is early.
            was_awaited: Whether there was no message at all for a while.
        """
        more = late - self._unready - self._stalled
        if late <= 0:
            self.clear()
        elif more > 0:
            self._unready += more if was_awaited else 0
            self._stalled += 0 if was_awaited else more
        else:
            self._stalled = max(0, self._stalled + more)
            self._unready = late - self._stalled
        waiting = self._unready if self._unready > CATCH_UP_NS else 0
        self._unready -= waiting
        return waiting

    def suspended(self) -> int:
        """How long the player did not run at all, where nobody would want that made up for."""
        gone = self._stalled if self._stalled > _SUSPENDED_NS else 0
        self._stalled -= gone
        return gone


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
