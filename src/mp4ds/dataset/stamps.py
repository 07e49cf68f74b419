"""Frames by stamp."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import FrameNotFoundError, OptionError
from mp4ds.times import nanoseconds

_WANTED = {
    "nearest": "near",
    "before": "at or before",
    "after": "at or after",
    "exact": "of exactly",
}
_INT64 = np.iinfo(np.int64)


class StampIndex:
    """Finds frames by stamp; the first of several with the same stamp.

    Args:
        topic: For errors.
        stamps: Nanoseconds, shape (frames,), at least one.
    """

    def __init__(self, topic: str, stamps: NDArray[np.int64]) -> None:
        self._topic = topic
        self._order = np.argsort(stamps, kind="stable")
        self._sorted = stamps[self._order]

    def find(self, stamp_ns: int, *, mode: str, tolerance_ns: int | None) -> int:
        """Number of the frame for a time.

        Args:
            stamp_ns: Nanoseconds.
            mode: ``nearest``, the earlier of two equally near; ``before``: the
                last at or before the time; ``after``: the first at or after it; ``exact``.
            tolerance_ns: Maximum nanoseconds between them, or None for no limit.

        Raises:
            FrameNotFoundError: There is none.
            OptionError: There is no such mode or tolerance.
        """
        if mode not in _WANTED:
            raise OptionError(f"mode {mode!r} is not known: use {', '.join(_WANTED)}")
        stamp = self._time(stamp_ns)
        tolerance = None if tolerance_ns is None else nanoseconds(tolerance_ns, "tolerance_ns")
        if tolerance is not None and tolerance < 0:
            raise OptionError(f"tolerance is {tolerance} ns: use 0 or more")
        earlier, later = self._around(stamp)
        near = [place for place in (earlier, later) if place is not None]
        nearest = min(near, key=lambda place: abs(self._stamp(place) - stamp))
        place = {"before": earlier, "after": later}.get(mode, nearest)
        if place is not None:
            distance = abs(self._stamp(place) - stamp)
            most = 0 if mode == "exact" else tolerance
            if most is None or distance <= most:
                return int(self._order[place])
        within = "" if tolerance is None else f"within {tolerance} ns "
        wanted = _WANTED[mode] if not within else f"{within}{_WANTED[mode]}"
        raise FrameNotFoundError(self._topic, stamp, wanted, self._stamp(nearest))

    def between(self, start_ns: int, end_ns: int) -> NDArray[np.int64]:
        """Numbers of the frames with start_ns <= stamp < end_ns, by stamp."""
        first, last = (self._place(self._time(time)) for time in (start_ns, end_ns))
        return self._order[first : max(first, last)]

    def _time(self, time: int) -> int:
        example = "half a second after the first frame is stamps[0] + 500_000_000"
        return nanoseconds(time, f"a time of {self._topic}", example)

    def _place(self, stamp: int) -> int:
        """How many stamps are smaller."""
        if stamp > _INT64.max:
            return len(self._sorted)
        value = np.int64(max(stamp, _INT64.min))
        return int(np.searchsorted(self._sorted, value, side="left"))

    def _around(self, stamp: int) -> tuple[int | None, int | None]:
        """Indices of the last stamp at or before a time, and of the first at or after it."""
        place = self._place(stamp)
        later = place if place < len(self._sorted) else None
        if later is not None and self._stamp(later) == stamp:
            return later, later
        earlier = self._place(self._stamp(place - 1)) if place else None
        return earlier, later

    def _stamp(self, place: int) -> int:
        return int(self._sorted[place])
