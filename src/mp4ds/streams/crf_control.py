"""Which crf each window of a video is encoded with, so that its frames have a score. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from math import ceil

FALLS = {"vmaf": 0.3, "psnr": 0.4, "ssim": 0.001}
"""Metric -> about how much less it is for each crf more, around what is asked for."""

_MOST_UP = 8  # crf from one window to the next
_RANGE = 4  # of how fast scores fall, beside what is assumed
_LAVISH = 0.5  # of the tolerance: a window with more too much is encoded again, with fewer bits
_MOST_TRIMS = 2  # times
_NOISE = 1e-9  # of sums of floats


class CrfControl:
    """Chooses the crf of one window after the other.

    The mean of all frames does not fall below the target at any time, nor that of a window by
    more than the tolerance: what earlier windows have too much, later ones may lack. Nor is a
    window much better than it is to be, where a second try with fewer bits can tell.

    Args:
        start: The crf of the first window.
        smallest: That may be chosen.
        largest: That may be chosen.
        tolerance: How far below the target the mean of a window may be.
        fall: About how much less a score is for each crf more.
    """

    def __init__(
        self, start: int, smallest: int, largest: int, tolerance: float, fall: float
    ) -> None:
        self.crf = start
        self._smallest, self._largest = smallest, largest
        self._tolerance = tolerance
        self._assumed = self._fall = fall
        self._surplus = 0.0  # of all frames together

    def accepted(self, tried: Mapping[int, float], due: float, frames: int) -> int | None:
        """The largest crf of those tried that is good enough; None where none is.

        Args:
            tried: Crf -> the mean score of the window's frames.
            due: What is asked for.
            frames: How many it has.
        """
        least = self._least(due, frames) - _NOISE
        return max((crf for crf, mean in tried.items() if mean >= least), default=None)

    def next(self, tried: Mapping[int, float], due: float, frames: int) -> int | None:
        """The crf to encode a window with again; None where no more is to be tried.

        Args:
            tried: Crf -> the mean score of the window, in the order they were tried.
            due: What is asked for.
            frames: How many it has.
        """
        self._learn(tried)
        best = self.accepted(tried, due, frames)
        if best is None:
            return self._better(tried, due, frames)
        is_lavish = tried[best] - due > _LAVISH * self._tolerance
        return self._smaller(tried, best, due) if is_lavish else None

    def keep(self, tried: Mapping[int, float], crf: int, due: float, frames: int) -> None:
        """Take a window as it was encoded with a crf, and choose that of the next one.

        Args:
            tried: Crf -> the mean score of the window.
            crf: The one accepted.
            due: What was asked for.
            frames: How many it has.
        """
        mean = tried[crf]
        self._surplus = max(0.0, self._surplus + (mean - due) * frames)
        room = (due - self._least(due, frames)) / 2  # half of it is for what is not foreseen
        up = int((mean - due + room) / self._fall)
        self.crf = min(crf + min(max(up, 0), _MOST_UP), self._largest)

    def _least(self, due: float, frames: int) -> float:
        return due - min(self._tolerance, self._surplus / frames)

    def _better(self, tried: Mapping[int, float], due: float, frames: int) -> int | None:
        crf, mean = min(tried.items())
        if crf == self._smallest:
            return None
        short = self._least(due, frames) - mean
        # doubled each time: a scene whose scores do not rise comes to an end soon; but a half
        # at the most, as small crf differ more
        step = max(ceil(short / self._fall), 1 << (len(tried) - 1))
        return max(self._smallest, crf // 2, crf - step)

    def _smaller(self, tried: Mapping[int, float], best: int, due: float) -> int | None:
        if len(tried) > _MOST_TRIMS:
            return None
        refused = min((crf for crf in tried if crf > best), default=self._largest + 1)
        crf = min(best + int((tried[best] - due) / self._fall), refused - 1)
        return crf if crf > best else None

    def _learn(self, tried: Mapping[int, float]) -> None:
        if len(tried) > 1:
            (crf, mean), (other, its_mean) = list(tried.items())[-2:]
            found = (its_mean - mean) / (crf - other)
            self._fall = min(max(found, self._assumed / _RANGE), self._assumed * _RANGE)
