"""How much decoded frames differ from their originals: VMAF, PSNR and SSIM of each frame.

PSNR and SSIM are computed here. VMAF is computed by libvmaf in an ffmpeg process: that of the
optional package imageio-ffmpeg, or one on the PATH.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from itertools import chain, zip_longest
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import ScoringError
from mp4ds.video.libvmaf import Ffmpeg, VmafProcess, scoring_process

Plane = NDArray[Any]
"""Samples of one plane, uint8 or uint16, shape (rows, columns)."""

MAX_PSNR = {8: 60.0, 10: 72.0}
"""PSNR of identical planes by bits of a sample, dB: libvmaf's bound, so that it is a number."""

_WEIGHTS = (0.01, 0.03)  # of the constants that keep SSIM's quotients from 0 / 0
_BLOCK = 4  # side of the blocks of which four make a window


def psnr(reference: Plane, decoded: Plane, *, bits: int = 8) -> float:
    """Peak signal-to-noise ratio of a plane, dB, at most `MAX_PSNR`.

    Args:
        reference: The original.
        decoded: Of the same shape and type.
        bits: Of a sample: 8 or 10.
    """
    difference = reference.astype(np.int32) - decoded
    error = float(np.mean(np.square(difference, dtype=np.int64)))
    if not error:
        return MAX_PSNR[bits]
    peak = 2**bits - 1
    return min(10 * float(np.log10(peak * peak / error)), MAX_PSNR[bits])


def ssim(reference: Plane, decoded: Plane, *, bits: int = 8) -> float:
    """Structural similarity of a plane: 1 where both are the same.

    The mean over windows of 8 x 8 samples at steps of 4, as in ffmpeg's ssim.

    Args:
        reference: The original, at least 8 samples high and wide.
        decoded: Of the same shape and type.
        bits: Of a sample: 8 or 10.
    """
    a, b = (_whole_blocks(plane) for plane in (reference, decoded))
    sum_a, sum_b = _window_sums(a), _window_sums(b)
    squares = _window_sums(a * a + b * b)
    products = _window_sums(a * b)
    count = (2 * _BLOCK) ** 2
    peak = 2**bits - 1
    # of sums over a window instead of means: by its count, or its count and count - 1
    c1 = int((_WEIGHTS[0] * peak) ** 2 * count + 0.5)
    c2 = int((_WEIGHTS[1] * peak) ** 2 * count * (count - 1) + 0.5)
    sums = sum_a * sum_a + sum_b * sum_b
    variances = count * squares - sums
    covariance = count * products - sum_a * sum_b
    luminance = (2.0 * sum_a * sum_b + c1) / (sums + c1)
    structure = (2.0 * covariance + c2) / (variances + c2)
    return float(np.mean(luminance * structure))


def _whole_blocks(plane: Plane) -> NDArray[np.int64]:
    """As integers wide enough for squares, without incomplete blocks."""
    rows, columns = (side // _BLOCK * _BLOCK for side in plane.shape)
    if min(rows, columns) < 2 * _BLOCK:
        raise ValueError(f"planes of {plane.shape[1]}x{plane.shape[0]} samples have no window")
    return plane[:rows, :columns].astype(np.int64)


def _window_sums(values: NDArray[np.int64]) -> NDArray[np.int64]:
    rows, columns = values.shape
    blocks = values.reshape(rows // _BLOCK, _BLOCK, columns // _BLOCK, _BLOCK).sum(axis=(1, 3))
    pairs = blocks[:, :-1] + blocks[:, 1:]
    found: NDArray[np.int64] = pairs[:-1] + pairs[1:]
    return found


# ---------------------------------------------------------------- scores

METRICS = ("vmaf", "psnr_y", "psnr_cb", "psnr_cr", "ssim")
"""What is scored: VMAF 0 to 100, PSNR of each plane in dB, SSIM of the luma."""


@dataclass(frozen=True, slots=True)
class ScoreSummary:
    """A summary of the scores of a clip's frames.

    Attributes:
        mean: Arithmetic mean.
        harmonic_mean: As in libvmaf, of the scores plus 1, minus 1: bad frames weigh more.
        percentile_5: 5 % of the frames are worse.
        minimum: Of the worst frame.
    """

    mean: float
    harmonic_mean: float
    percentile_5: float
    minimum: float


@dataclass(frozen=True, slots=True, eq=False)
class Scores:
    """Scores of each frame of a clip, float64, shape (frames,).

    Attributes:
        vmaf: 0 to 100; None if there is no libvmaf.
        psnr_y: Of luma, dB.
        psnr_cb: Of blue chroma, dB.
        psnr_cr: Of red chroma, dB.
        ssim: Of luma, at most 1.
    """

    vmaf: NDArray[np.float64] | None
    psnr_y: NDArray[np.float64]
    psnr_cb: NDArray[np.float64]
    psnr_cr: NDArray[np.float64]
    ssim: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.psnr_y)

    def summaries(self) -> dict[str, ScoreSummary]:
        """A summary of each of `METRICS`; without VMAF if it was not computed."""
        found = {name: getattr(self, name) for name in METRICS}
        return {name: summary_of(values) for name, values in found.items() if values is not None}


def summary_of(values: NDArray[np.float64]) -> ScoreSummary:
    """Summarise the scores of frames.

    Args:
        values: One per frame, at least one; none below -1.
    """
    return ScoreSummary(
        mean=float(np.mean(values)),
        harmonic_mean=float(1 / np.mean(1 / (values + 1)) - 1),
        percentile_5=float(np.percentile(values, 5)),
        minimum=float(np.min(values)),
    )


# ---------------------------------------------------------------- scorer

YuvFrame = tuple[NDArray[Any], NDArray[Any], NDArray[Any]]
"""Luma and two chroma planes of half its width and height: uint8, or uint16 with 10 bits used."""

_FORMATS = {np.dtype(np.uint8): ("yuv420p", 8), np.dtype(np.uint16): ("yuv420p10le", 10)}
SMALLEST = 16
"""Samples of a side; libvmaf and SSIM cannot score less."""


class Scorer:
    """Scores clips; can be reused.

    Args:
        ffmpeg: The ffmpeg for VMAF, from `find_ffmpeg`; None: only PSNR and SSIM.
        threads: Of libvmaf.
    """

    def __init__(self, ffmpeg: Ffmpeg | None, *, threads: int = 1) -> None:
        self._ffmpeg = ffmpeg
        self._threads = threads

    def score(self, reference: Iterable[YuvFrame], decoded: Iterable[YuvFrame]) -> Scores:
        """Compare each frame with its original; only one pair is in memory at a time.

        Args:
            reference: The originals, all of one size, with even width and height of at least 16.
            decoded: As many frames, of the same size and type.

        Raises:
            ScoringError: They do not match, there are none, or libvmaf failed.
        """
        pairs = _pairs(reference, decoded)
        first = _first(pairs)
        bits = _FORMATS[first[0][0].dtype][1]
        measured: list[tuple[float, ...]] = []
        with ExitStack() as stack:
            process = None
            if self._ffmpeg is not None:
                process = stack.enter_context(_process_for(first[0], self._ffmpeg, self._threads))
            for original, made in chain([first], pairs):
                if process is not None:
                    process.write(original, made)
                measured.append(_measure(original, made, bits))
            vmaf = process.finish() if process is not None else None
        if vmaf is not None and len(vmaf) != len(measured):
            raise ScoringError(f"libvmaf scored {len(vmaf)} of {len(measured)} frames.")
        psnr_y, psnr_cb, psnr_cr, similarity = np.array(measured, np.float64).T
        return Scores(vmaf, psnr_y, psnr_cb, psnr_cr, similarity)


def psnr_scores(reference: Iterable[YuvFrame], decoded: Iterable[YuvFrame]) -> NDArray[np.float64]:
    """PSNR of the luma of each frame, dB. See `Scorer.score`."""
    return _luma_scores(psnr, reference, decoded)


def ssim_scores(reference: Iterable[YuvFrame], decoded: Iterable[YuvFrame]) -> NDArray[np.float64]:
    """SSIM of the luma of each frame. See `Scorer.score`."""
    return _luma_scores(ssim, reference, decoded)


def _luma_scores(
    measure: Callable[..., float], reference: Iterable[YuvFrame], decoded: Iterable[YuvFrame]
) -> NDArray[np.float64]:
    pairs = _pairs(reference, decoded)
    first = _first(pairs)
    bits = _FORMATS[first[0][0].dtype][1]
    every = chain([first], pairs)
    return np.array([measure(a[0], b[0], bits=bits) for a, b in every], np.float64)


def vmaf_scores(
    reference: Iterable[YuvFrame],
    decoded: Iterable[YuvFrame],
    *,
    ffmpeg: Ffmpeg,
    threads: int = 1,
    before: YuvFrame | None = None,
) -> NDArray[np.float64]:
    """VMAF of each frame.

    Args:
        reference: As for `Scorer.score`.
        decoded: As for `Scorer.score`.
        ffmpeg: From `find_ffmpeg`.
        threads: Of libvmaf.
        before: The original before the first one, for libvmaf's motion feature: without it, the
            first frame counts as still and scores lower.

    Raises:
        ScoringError: As for `Scorer.score`.
    """
    pairs = _pairs(reference, decoded)
    first = _first(pairs)
    count = 0
    with _process_for(first[0], ffmpeg, threads) as process:
        if before is not None:
            process.write(before, before)
        for original, made in chain([first], pairs):
            process.write(original, made)
            count += 1
        found = process.finish()
    if before is not None:
        found = found[1:]
    if len(found) != count:
        raise ScoringError(f"libvmaf scored {len(found)} of {count} frames.")
    return found


def _process_for(
    frame: YuvFrame, ffmpeg: Ffmpeg, threads: int
) -> AbstractContextManager[VmafProcess]:
    height, width = frame[0].shape
    pixel_format = _FORMATS[frame[0].dtype][0]
    return scoring_process(
        ffmpeg, width=width, height=height, pixel_format=pixel_format, threads=threads
    )


def _first(pairs: Iterator[tuple[YuvFrame, YuvFrame]]) -> tuple[YuvFrame, YuvFrame]:
    """The first of them.

    Raises:
        ScoringError: There is none.
    """
    first = next(pairs, None)
    if first is None:
        raise ScoringError("There are no frames to score.")
    return first


def _measure(original: YuvFrame, made: YuvFrame, bits: int) -> tuple[float, ...]:
    noise = [psnr(a, b, bits=bits) for a, b in zip(original, made, strict=True)]
    return (*noise, ssim(original[0], made[0], bits=bits))


def _pairs(
    reference: Iterable[YuvFrame], decoded: Iterable[YuvFrame]
) -> Iterator[tuple[YuvFrame, YuvFrame]]:
    """Each frame and its original, checked.

    Raises:
        ScoringError: They do not match.
    """
    first: list[tuple[tuple[int, ...], np.dtype[Any]]] | None = None
    for number, (original, made) in enumerate(zip_longest(reference, decoded)):
        if original is None or made is None:
            longer = "decoded frames" if original is None else "originals"
            raise ScoringError(f"There are more {longer} than the {number} in the other sequence.")
        if first is None:
            first = _kind(original)
            _check(original)
        for name, frame in (("Original", original), ("Decoded frame", made)):
            if _kind(frame) != first:
                raise ScoringError(
                    f"{name} {number} differs from the first original in size or type."
                )
        yield original, made


def _kind(frame: YuvFrame) -> list[tuple[tuple[int, ...], np.dtype[Any]]]:
    return [(plane.shape, plane.dtype) for plane in frame]


def _check(frame: YuvFrame) -> None:
    """Refuse frames that are not a `YuvFrame`."""
    if len(frame) != 3 or frame[0].ndim != 2 or any(p.dtype not in _FORMATS for p in frame):
        raise ScoringError("A frame is three planes of uint8 or uint16.")
    rows, columns = frame[0].shape
    if rows % 2 or columns % 2 or min(rows, columns) < SMALLEST:
        raise ScoringError(
            f"Frames of {columns}x{rows} are not scored: sides are even, {SMALLEST} or more."
        )
    if any(plane.shape != (rows // 2, columns // 2) for plane in frame[1:]):
        raise ScoringError("Chroma planes do not have half the sides of luma.")


# ---------------------------------------------------------------- search

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
    """Find the largest crf that reaches a target; scores fall as crf grows.

    Between two known crf, try where a straight line through their scores meets the target; if that
    did not halve the interval, the middle.

    Args:
        score: Encodes with a crf and returns its score.
        target: The score to reach.
        guess: The crf to begin with.
        largest: The largest crf of the codec.
        smallest: The smallest crf to try.
        fall: Approximate drop of the score per crf, which sets the first steps; None: unknown.
        most: Maximum number of trials, after which the best so far is taken; None: no limit.

    Returns:
        The crf, whether it reaches the target, and the number of trials. If none reaches it, the
        crf is the smallest one tried.
    """
    known: dict[int, float] = {}

    def at(crf: int) -> float:
        if crf not in known:
            known[crf] = score(crf)
        return known[crf]

    good, bad = smallest - 1, largest + 1  # the first does, the second does not, as far as is known
    crf = min(max(guess, smallest), largest)
    least = _STEP if fall is None else 1  # that it continues; doubled each time
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
