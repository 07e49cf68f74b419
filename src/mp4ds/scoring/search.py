"""The largest crf that reaches a target, with few encodings."""

from __future__ import annotations

from collections.abc import Callable

_STEP = 4  # of crf, where nothing is known of how fast scores fall


def largest_crf(
    score: Callable[[int], float],
    target: float,
    *,
    guess: int,
    largest: int,
    smallest: int = 1,
    fall: float | None = None,
    most: int | None = None,
) -> tuple[int, bool, int]:
    """Look for it between the smallest and the largest, where scores fall as it grows.

    Between two crf that are known, the next one to try is where a straight line through their
    scores meets the target; where that did not halve what is left, the middle.

    Args:
        score: Encodes with a crf, and tells its score.
        target: The score to reach.
        guess: The crf to begin with.
        largest: That the codec has.
        smallest: That is tried.
        fall: About how much less the score is for each crf more, by which the first steps are
            chosen; None: not known.
        most: The search ends after so many were tried, with the best it has; None: when it is
            sure.

    Returns:
        The crf, whether it reaches the target, and how many were tried. Where none reaches it,
        the crf is the smallest one that was tried.
    """
    known: dict[int, float] = {}

    def at(crf: int) -> float:
        if crf not in known:
            known[crf] = score(crf)
        return known[crf]

    good, bad = smallest - 1, largest + 1  # the first does, the second does not, as far as is known
    crf = min(max(guess, smallest), largest)
    least = _STEP if fall is None else 1  # that it goes on; doubled each time
    while bad - good > 1 and (most is None or len(known) < most):
        width = bad - good
        found = at(crf)
        if found >= target:
            good = crf
        else:
            bad = crf
        if good in known and bad in known:
            is_slow = bad - good > width / 2
            crf = (good + bad) // 2 if is_slow else _between(good, bad, known, target)
            continue
        step = max(least, round(abs(found - target) / fall)) if fall else least
        least *= 2
        # the last one that was tried was still good enough, or not yet
        if good in known:
            crf = min(good + step, largest, bad - 1)
        else:  # a half at the most: small crf differ more
            crf = max(bad - step, bad // 2, smallest)
    if good in known:
        return good, True, len(known)
    return min(known), False, len(known)


def _between(good: int, bad: int, known: dict[int, float], target: float) -> int:
    fall = known[good] - known[bad]
    share = (known[good] - target) / fall if fall > 0 else 0.5
    return min(max(round(good + share * (bad - good)), good + 1), bad - 1)
