"""The largest crf that reaches a target, with few encodings."""

from __future__ import annotations

from collections.abc import Callable


def largest_crf(
    score: Callable[[int], float], target: float, *, guess: int, largest: int
) -> tuple[int, bool, int]:
    """Look for it between 1 and the largest, where scores fall as it grows.

    Between two crf that are known, the next one to try is where a straight line through their
    scores meets the target; where that did not halve what is left, the middle.

    Args:
        score: Encodes with a crf, and tells its score.
        target: The score to reach.
        guess: The crf to begin with.
        largest: That the codec has.

    Returns:
        The crf, whether it reaches the target, and how many were tried. Where none reaches it,
        the crf is the smallest one that was tried: 1.
    """
    known: dict[int, float] = {}

    def at(crf: int) -> float:
        if crf not in known:
            known[crf] = score(crf)
        return known[crf]

    good, bad = 0, largest + 1  # the first does, the second does not, as far as is known
    crf = min(max(guess, 1), largest)
    step = 4
    while bad - good > 1:
        width = bad - good
        if at(crf) >= target:
            good = crf
        else:
            bad = crf
        if good in known and bad in known:
            is_slow = bad - good > width / 2
            crf = (good + bad) // 2 if is_slow else _between(good, bad, known, target)
        elif good in known:  # the last one that was tried was still good enough
            crf, step = min(good + step, largest, bad - 1), step * 2
        else:
            crf, step = max(bad - step, 1), step * 2
    if good in known:
        return good, True, len(known)
    return 1, False, len(known)


def _between(good: int, bad: int, known: dict[int, float], target: float) -> int:
    fall = known[good] - known[bad]
    share = (known[good] - target) / fall if fall > 0 else 0.5
    return min(max(round(good + share * (bad - good)), good + 1), bad - 1)
