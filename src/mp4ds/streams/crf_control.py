"""Which crf each window of a video is encoded with, so that its frames have a score. Pure."""

from __future__ import annotations

from math import ceil

FALLS = {"vmaf": 0.3, "psnr": 0.4, "ssim": 0.001}
"""Metric -> about how much less it is for each crf more, around what is asked for."""

_MOST_UP = 4  # crf from one window to the next
_RANGE = 4  # of how fast scores fall, beside what is assumed
_NOISE = 1e-9  # of sums of floats


class CrfControl:
    """Chooses the crf of one window after the other.

    The mean of all frames does not fall below the target at any time, nor that of a window by
    more than the tolerance: what earlier windows have too much, later ones may lack.

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

    def accepts(self, mean: float, due: float, frames: int) -> bool:
        """Whether a window is good enough.

        Args:
            mean: Score of its frames.
            due: What is asked for.
            frames: How many it has.
        """
        return mean >= self._least(due, frames) - _NOISE

    def _least(self, due: float, frames: int) -> float:
        return due - min(self._tolerance, self._surplus / frames)

    def lower(self, tried: list[tuple[int, float]], due: float, frames: int) -> int:
        """The crf to encode a window with again.

        Args:
            tried: The crf and scores of it so far, none of which was accepted; the last is not
                with the smallest crf.
            due: What is asked for.
            frames: How many it has.
        """
        self._learn(tried)
        crf, mean = tried[-1]
        short = self._least(due, frames) - mean
        # doubled each time: a scene whose scores do not rise comes to an end soon; but a half
        # at the most, as small crf differ more
        step = max(ceil(short / self._fall), 1 << (len(tried) - 1))
        return max(self._smallest, crf // 2, crf - step)

    def keep(self, tried: list[tuple[int, float]], due: float, frames: int) -> None:
        """Take a window as it was encoded last, and choose the crf of the next one.

        Args:
            tried: The crf and scores of it, the last of which was accepted.
            due: What was asked for.
            frames: How many it has.
        """
        self._learn(tried)
        crf, mean = tried[-1]
        self._surplus = max(0.0, self._surplus + (mean - due) * frames)
        room = (due - self._least(due, frames)) / 2  # half of it is for what is not foreseen
        up = int((mean - due + room) / self._fall)
        self.crf = min(crf + min(max(up, 0), _MOST_UP), self._largest)

    def _learn(self, tried: list[tuple[int, float]]) -> None:
        if len(tried) > 1:
            (crf, mean), (lower, better) = tried[-2:]
            found = (better - mean) / (crf - lower)
            self._fall = min(max(found, self._assumed / _RANGE), self._assumed * _RANGE)
