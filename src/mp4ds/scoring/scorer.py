"""Scores frames against their originals, one pair at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack
from itertools import chain, zip_longest
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.scoring.errors import ScoringError
from mp4ds.scoring.ffmpeg import Ffmpeg, VmafProcess, scoring_process
from mp4ds.scoring.measures import psnr, ssim
from mp4ds.scoring.scores import Scores

YuvFrame = tuple[NDArray[Any], NDArray[Any], NDArray[Any]]
"""Luma and the two chroma planes of half its sides: uint8, or uint16 of which 10 bits are used."""

_FORMATS = {np.dtype(np.uint8): ("yuv420p", 8), np.dtype(np.uint16): ("yuv420p10le", 10)}
SMALLEST = 16
"""Samples of a side: of less libvmaf and SSIM make nothing."""


class Scorer:
    """Scores clips; may be used for one after the other.

    Args:
        ffmpeg: What computes VMAF, from `find_ffmpeg`; None: there is only PSNR and SSIM.
        threads: Of libvmaf.
    """

    def __init__(self, ffmpeg: Ffmpeg | None, *, threads: int = 1) -> None:
        self._ffmpeg = ffmpeg
        self._threads = threads

    def score(self, reference: Iterable[YuvFrame], decoded: Iterable[YuvFrame]) -> Scores:
        """Compare each frame with its original; only a pair of them is in memory at a time.

        Args:
            reference: The originals, all of one size, with even sides of at least 16 samples.
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
        before: An original that the first one is compared with, to tell how much moves: without,
            libvmaf takes the first frame for a still one, and scores it less.

    Raises:
        ScoringError: As `Scorer.score`.
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
    """Each frame and its original, looked over.

    Raises:
        ScoringError: They do not match.
    """
    first: list[tuple[tuple[int, ...], np.dtype[Any]]] | None = None
    for number, (original, made) in enumerate(zip_longest(reference, decoded)):
        if original is None or made is None:
            longer = "decoded frames" if original is None else "originals"
            raise ScoringError(f"There are more {longer} than the {number} of the others.")
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
    """Refuse frames that are not those of `YuvFrame`."""
    if len(frame) != 3 or frame[0].ndim != 2 or any(p.dtype not in _FORMATS for p in frame):
        raise ScoringError("A frame is three planes of uint8 or uint16.")
    rows, columns = frame[0].shape
    if rows % 2 or columns % 2 or min(rows, columns) < SMALLEST:
        raise ScoringError(
            f"Frames of {columns}x{rows} are not scored: sides are even, {SMALLEST} or more."
        )
    if any(plane.shape != (rows // 2, columns // 2) for plane in frame[1:]):
        raise ScoringError("Chroma planes do not have half the sides of luma.")
