"""Windows of a stream that have to reach a score.

A window is kept on disk as planes, encoded, decoded and scored, and encoded again with a lower crf
until it is good enough.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import cached_property
from math import ceil
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import Refused
from mp4ds.format.fields import SCORE_STEPS
from mp4ds.packing.inspection import CameraMessage
from mp4ds.times import TIMESCALE
from mp4ds.video.codecs import LEAST_CRF, MAX_CRF, QualityTarget
from mp4ds.video.encoder import Coding, VideoEncoder, coded_size
from mp4ds.video.pixels import PLANES_FORMAT, PlaneMaker, Planes, PlaneSpool, decoded_planes
from mp4ds.video.scores import SMALLEST, Ffmpeg, find_ffmpeg, scores_of

FALLS = {"vmaf": 0.3, "psnr": 0.4, "ssim": 0.001}
"""Metric -> about how much it drops per crf step, near typical targets."""

_MOST_UP = 8  # maximum crf increase from one window to the next
_RANGE = 4  # factor by which the fall of scores may differ from the assumed one
# of the tolerance: a window that exceeds the target by more is re-encoded with fewer bits
_LAVISH = 0.5
_MOST_TRIMS = 2  # times
# of a stream's first images, which are few: the search for its first crf
_MOST_TRIMS_OF_FIRST = 5
_NOISE = 1e-9  # of sums of floats


class CrfControl:
    """Chooses the crf of each window in turn.

    The mean of all frames never falls below the target, nor that of a window by more than the
    tolerance: the surplus of earlier windows can be used by later ones. Nor is a window much better
    than required, if a second try with fewer bits can avoid it.

    Args:
        start: The crf of the first window.
        smallest: The smallest allowed.
        largest: The largest allowed.
        tolerance: How far below the target the mean of a window may be.
        fall: About how much a score drops per crf step.
        most_trims: How many tries there are at most where one with fewer bits may do.
    """

    def __init__(
        self,
        start: int,
        smallest: int,
        largest: int,
        tolerance: float,
        fall: float,
        most_trims: int = _MOST_TRIMS,
    ) -> None:
        self._most_trims = most_trims
        self.crf = start
        self._smallest, self._largest = smallest, largest
        self._tolerance = tolerance
        self._assumed = self._fall = fall
        self._surplus = 0.0  # over all frames

    def accepted(self, tried: Mapping[int, float], due: float, frames: int) -> int | None:
        """The largest crf of those tried that is good enough; None if none is.

        Args:
            tried: Crf -> the mean score of the window's frames.
            due: The required score.
            frames: Number of its frames.
        """
        least = self._least(due, frames) - _NOISE
        return max((crf for crf, mean in tried.items() if mean >= least), default=None)

    def next(self, tried: Mapping[int, float], due: float, frames: int) -> int | None:
        """The crf to re-encode a window with; None if no further try is needed.

        Args:
            tried: Crf -> the mean score of the window, in the order they were tried.
            due: The required score.
            frames: Number of its frames.
        """
        self._learn(tried)
        best = self.accepted(tried, due, frames)
        if best is None:
            return self._better(tried, due, frames)
        is_lavish = tried[best] - due > _LAVISH * self._tolerance
        return self._smaller(tried, best, due) if is_lavish else None

    def keep(self, tried: Mapping[int, float], crf: int, due: float, frames: int) -> None:
        """Accept a window as encoded with a crf, and choose the crf of the next one.

        Args:
            tried: Crf -> the mean score of the window.
            crf: The one accepted.
            due: The required score.
            frames: Number of its frames.
        """
        mean = tried[crf]
        self._surplus = max(0.0, self._surplus + (mean - due) * frames)
        room = (due - self._least(due, frames)) / 2  # keep half in reserve
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
        if len(tried) > self._most_trims:
            return None
        refused = min((crf for crf in tried if crf > best), default=self._largest + 1)
        crf = min(best + int((tried[best] - due) / self._fall), refused - 1)
        return crf if crf > best else None

    def _learn(self, tried: Mapping[int, float]) -> None:
        if len(tried) > 1:
            (crf, mean), (other, its_mean) = list(tried.items())[-2:]
            found = (its_mean - mean) / (crf - other)
            self._fall = min(max(found, self._assumed / _RANGE), self._assumed * _RANGE)


# ---------------------------------------------------------------- windows

_FRAMES = 60  # of a window, or one group of pictures if that is longer
_MOST_FRAMES = 240
_USUAL_RATE = 30.0


def window_frames(gop: int) -> int:
    """Frames of a window: whole groups of pictures, so that windows cost no more key frames.

    Args:
        gop: Maximum key frame interval, frames.
    """
    return min(max(1, _FRAMES // gop) * gop, _MOST_FRAMES)


@dataclass
class Tries:
    """The encodings of a window.

    Attributes:
        due: The score required of it.
        scores: Crf -> the scores of its frames, in steps of the metric.
        means: Crf -> their mean, in the order of the tries.
    """

    due: float
    scores: dict[int, NDArray[np.int64]] = field(default_factory=dict)
    means: dict[int, float] = field(default_factory=dict)


@dataclass(frozen=True)
class WindowCoder:
    """Encodes and scores windows.

    Attributes:
        coding: How images are encoded; the crf varies.
        size: Columns and rows of an image.
        target: The target, whose metric is measured.
        threads: Of the encoder, and of libvmaf.
        rate: Frames per second, if known.
    """

    coding: Coding
    size: tuple[int, int]
    target: QualityTarget
    threads: int
    rate: float | None

    @cached_property
    def coded_size(self) -> tuple[int, int]:
        """Columns and rows of a coded picture."""
        return coded_size(self.coding.recipe, *self.coding.layout.picture_size(*self.size))

    @cached_property
    def ffmpeg(self) -> Ffmpeg | None:
        """The ffmpeg that computes VMAF, if that is the metric.

        Raises:
            ScoringError: There is none; says how to get one.
        """
        return find_ffmpeg() if self.target.metric == "vmaf" else None

    @cached_property
    def _maker(self) -> PlaneMaker:
        return PlaneMaker(self.coding.layout.pixel_format)

    def spool(self, path: Path) -> PlaneSpool:
        """Keeps planes in a file."""
        return PlaneSpool(path, *self.coded_size)

    def keep(self, seen: CameraMessage, spool: PlaneSpool) -> None:
        """Add the planes of an image to a spool."""
        if seen.pixels is not None:
            spool.append(self._maker.make(self.coding.layout.to_picture(seen.pixels)))

    def encode(
        self, frames: PlaneSpool, ticks: Sequence[int], crf: int, path: Path
    ) -> NDArray[np.int64]:
        """Encode a window.

        Args:
            frames: The window's frames, at least one.
            ticks: When each is shown, increasing.
            crf: Constant rate factor.
            path: The video to make.

        Returns:
            The scores of its frames, in steps of the metric (`SCORE_STEPS`).

        Raises:
            EncoderRefusedError: The encoder does not support such pictures.
            ScoringError: libvmaf failed.
            OSError: It cannot be written.
        """
        width, height = self.coded_size
        with VideoEncoder(
            path,
            self.coding.with_crf(crf).recipe,
            picture_format=PLANES_FORMAT,
            width=width,
            height=height,
            gop=self.coding.gop,
            threads=self.threads,
            rate=self.rate,
        ) as encoder:
            for planes, tick in zip(frames, ticks, strict=True):
                encoder.write(planes, tick - ticks[0])
        return self._scores(frames, decoded_planes(path))

    def start_crf(self, samples: Sequence[CameraMessage]) -> int:
        """The crf at which the first images of a stream reach the score.

        Raises:
            Refused: No crf reaches it.
        """
        target, control = self.target, self.control(_MOST_TRIMS_OF_FIRST)
        if min(self.coded_size) < SMALLEST:
            raise Refused(f"images with less than {SMALLEST} rows or columns have no {target}")
        step = round(TIMESCALE / (self.rate or _USUAL_RATE)) or 1
        with (
            tempfile.TemporaryDirectory(prefix="mp4ds-") as name,
            closing(self.spool(Path(name, "frames.yuv"))) as spool,
        ):
            for seen in samples:
                self.keep(seen, spool)
            ticks = range(0, len(spool) * step, step)
            tries = self.tries(control, spool, ticks, lambda _: Path(name, "sample.mp4"))
        crf = control.accepted(tries.means, tries.due, len(samples))
        if crf is None:
            crf, mean = min(tries.means.items())
            # a few frames have less VMAF than many, compared with their originals too: where they
            # fall a little short, the first window tells
            if mean < tries.due - target.tolerance:
                raise out_of_reach(target, tries.due, f"crf {crf} gives {mean:.2f}")
        return crf

    def control(self, most_trims: int = _MOST_TRIMS) -> CrfControl:
        """What chooses the crf of windows."""
        codec, target = self.coding.recipe.codec, self.target
        bounds = LEAST_CRF[codec], MAX_CRF[codec]
        fall = FALLS[target.metric]
        return CrfControl(self.coding.crf, *bounds, target.tolerance, fall, most_trims)

    def tries(
        self,
        control: CrfControl,
        frames: PlaneSpool,
        ticks: Sequence[int],
        place: Callable[[int], Path],
    ) -> Tries:
        """Encode a window until it is good enough, or no crf is.

        Args:
            control: Chooses each crf.
            frames: As for `encode`.
            ticks: As for `encode`.
            place: The video to make with a crf.
        """
        tries = Tries(self.target.score)
        crf: int | None = control.crf
        while crf is not None:
            scores = self.encode(frames, ticks, crf, place(crf))
            tries.scores[crf], tries.means[crf] = scores, self.mean(scores)
            is_first = len(tries.means) == 1
            if is_first and control.accepted(tries.means, tries.due, len(frames)) is None:
                tries.due = self.reachable(frames)
            crf = control.next(tries.means, tries.due, len(frames))
        return tries

    def reachable(self, frames: PlaneSpool) -> float:
        """The score required of a window: the target, or less if it is out of reach.

        VMAF underrates still scenes, even compared with themselves.

        Raises:
            ScoringError: libvmaf failed.
        """
        target = self.target
        if target.metric != "vmaf":
            return target.score
        ceiling = self.mean(self._scores(frames, frames))
        return min(target.score, ceiling - target.tolerance)

    def mean(self, scores: NDArray[np.int64]) -> float:
        """The mean of scores given in steps."""
        return float(np.mean(scores)) / SCORE_STEPS[self.target.metric]

    def _scores(self, frames: PlaneSpool, decoded: Iterable[Planes]) -> NDArray[np.int64]:
        metric = "psnr_y" if self.target.metric == "psnr" else self.target.metric
        # motion in the first frame is measured with the second
        before = frames.frame(1) if self.ffmpeg is not None and len(frames) > 1 else None
        found = scores_of(
            frames, decoded, [metric], ffmpeg=self.ffmpeg, threads=self.threads, before=before
        )[metric]
        return np.rint(found * SCORE_STEPS[self.target.metric]).astype(np.int64)


def out_of_reach(target: QualityTarget, due: float, made: str) -> Refused:
    """Why a stream is lossless: the target, the required score, and the one reached."""
    limit = f" of the {due:.2f} that the originals allow" if due < target.score else ""
    return Refused(f"{target} is out of reach: {made}{limit}")
