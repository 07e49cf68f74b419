"""What ``mp4ds play`` shows: where it stands, that it cannot keep up, what it did."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from mp4ds.cli.output import complain, say, shown

if TYPE_CHECKING:
    from mp4ds.playing import PlayProgress, PlaySummary

_NS = 1_000_000_000
_SLOW_S = 0.5  # that is told at once; less is no more than told at the end


@contextmanager
def play_progress(*, is_quiet: bool) -> Iterator[Callable[[PlayProgress], None]]:
    """On a terminal, a line that tells where it stands; anywhere, that it cannot keep up.

    Args:
        is_quiet: No line.
    """
    from rich.console import Console
    from rich.text import Text

    console = Console(stderr=True)
    told: set[str] = set()

    def warn(state: PlayProgress) -> None:
        if state.slowed_s >= _SLOW_S and "slow" not in told:
            told.add("slow")
            tell("frames are not made in time: the clock waits for them (--drop leaves them out)")
        if state.dropped and "dropped" not in told:
            told.add("dropped")
            tell("frames are not made in time: late ones are left out")

    if is_quiet or not console.is_terminal:
        yield warn
        return
    with console.status("") as status:

        def report(state: PlayProgress) -> None:
            warn(state)
            status.update(Text(_standing(state)))

        yield report


def tell(text: str) -> None:
    """Say something beside the result."""
    complain(text)


def _standing(state: PlayProgress) -> str:
    now, length = ((time - state.start_ns) / _NS for time in (state.time_ns, state.end_ns))
    parts = [
        f"{now:.1f} of {length:.1f} s",
        f"{state.rate:g}x {shown(state.state)}".strip(),
        f"{state.messages} messages",
    ]
    if state.slowed_s >= _SLOW_S:
        parts.append(f"slowed by {state.slowed_s:.1f} s")
    if state.dropped:
        parts.append(f"{state.dropped} late frames left out")
    return " · ".join(parts)


def print_play(summary: PlaySummary) -> None:
    """Tell what was played."""
    for topic, count in summary.messages.items():
        say(f"{topic}: {count}")
    for topic, reasons in summary.as_recorded.items():
        for reason, count in reasons.items():
            say(f"{topic}: {count} as recorded: {reason}")
    for topic, count in summary.thinned.items():
        say(f"{topic}: {count} frames left out on request")
    total = sum(summary.messages.values())
    text = f"{total} messages in {summary.seconds:.1f} s"
    if summary.loops:
        text += f", begun again {summary.loops} times"
    if summary.stopped:
        text += ", stopped before the end"
    say(text)
    if summary.slowed_s >= 0.1:
        say(f"{summary.slowed_s:.1f} s longer than recorded, since frames were not made in time")
    if summary.dropped:
        say(f"{summary.dropped} frames left out, since they were late")
