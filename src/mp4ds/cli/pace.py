"""How long work takes still, by its pace."""

from __future__ import annotations

from collections import deque
from itertools import pairwise

_WINDOW_SECONDS = 60.0
_WINDOW_SHARE = 0.02
_WINDOW_PAUSES = 2.0
_STEP_SHARE = 1e-4  # of all work, between two marks: bounds how many there are
_LEAST_STEPS = 3
_ENOUGH_SECONDS = 10.0
_ENOUGH_SHARE, _LEAST_SECONDS = 0.02, 3.0


class Pace:
    """Seconds that work takes still, by the pace of a sliding window.

    The window reaches back over 60 s, or 2 % of all work, or twice the longest pause between two
    advances in it, whichever is longest. So it follows a pace that changes as soon as 2 % of the
    work or a minute went by, and is not fooled by work that is told in large steps. The time
    since the last advance counts as soon as it is longer than the mean pause of the window: who
    waits sees the estimate grow. Nothing is told before three advances in 10 s, or in 3 s if
    they are 2 % of the work.
    """

    def __init__(self) -> None:
        self._marks: deque[tuple[float, float]] = deque()  # when how much was first reached

    def told(self, work: float, total: float, now: float) -> None:
        """Take how much is done.

        Args:
            work: What is done; less than before where work was lost.
            total: All work, in the same unit.
            now: Seconds of a clock that does not go back.
        """
        marks = self._marks
        while marks and marks[-1][1] > work:
            marks.pop()
        if marks and work - marks[-1][1] < total * _STEP_SHARE:
            return
        marks.append((now, work))
        while len(marks) > _LEAST_STEPS + 1 and self._is_enough_without_first(total):
            marks.popleft()

    def _is_enough_without_first(self, total: float) -> bool:
        (start, before), (end, work) = self._marks[1], self._marks[-1]
        longest = max(later - earlier for (earlier, _), (later, _) in pairwise(self._marks))
        seconds = max(_WINDOW_SECONDS, _WINDOW_PAUSES * longest)
        return end - start >= seconds and work - before >= _WINDOW_SHARE * total

    def seconds(self, goal: float, total: float, now: float) -> float | None:
        """Seconds until so much work is done, never negative; None while too little is known."""
        steps = len(self._marks) - 1
        if steps < _LEAST_STEPS:
            return None
        (start, before), (end, work) = self._marks[0], self._marks[-1]
        spent, waited = end - start, now - end
        least = _LEAST_SECONDS if work - before >= _ENOUGH_SHARE * total else _ENOUGH_SECONDS
        if spent < least:
            return None
        pause = spent / steps
        rate = (work - before) / (spent + max(0.0, waited - pause))
        return max(0.0, (goal - work) / rate - min(waited, pause))
