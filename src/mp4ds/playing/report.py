"""How a timeline is to be played, where a player stands, and what it did."""

from __future__ import annotations

from dataclasses import dataclass, field


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
