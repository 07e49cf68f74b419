"""Windows of a stream that have to reach a score.

A window is kept on disk as planes, encoded, decoded and scored, and encoded again with a lower crf
until it is good enough.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass
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
from mp4ds.video.pixels import (
    PLANES_FORMAT,
    PictureConverter,
    Planes,
    PlaneSpool,
    decoded_planes,
    to_planes,
)
from mp4ds.video.scores import SMALLEST, find_ffmpeg, scores_of

Scores = NDArray[np.int64]
"""Of frames, in steps of the metric (`SCORE_STEPS`)."""

_FALLS = {"vmaf": 0.3, "psnr": 0.4, "ssim": 0.001}
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
        coding: How images are encoded, with the crf of the first window.
        target: The score to reach.
        most_trims: How many tries there are at most where one with fewer bits may do.

    Attributes:
        crf: That of the next window.
        due: The required score of the current one.
        tried: Crf -> the mean score of its frames, in the order of the tries.
    """

    def __init__(
        self, coding: Coding, target: QualityTarget, most_trims: int = _MOST_TRIMS
    ) -> None:
        codec = coding.recipe.codec
        self.crf = coding.crf
        self._smallest, self._largest = LEAST_CRF[codec], MAX_CRF[codec]
        self._tolerance, self._most_trims = target.tolerance, most_trims
        self._assumed = self._fall = _FALLS[target.metric]
        self._surplus = 0.0  # over all frames

    def begin(self, due: float, frames: int) -> None:
        """Begin a window of so many frames."""
        self.due, self._frames = due, frames
        self.tried: dict[int, float] = {}

    @property
    def accepted(self) -> int | None:
        """The largest crf of those tried that is good enough; None if none is."""
        least = self._least - _NOISE
        return max((crf for crf, mean in self.tried.items() if mean >= least), default=None)

    @property
    def _least(self) -> float:
        return self.due - min(self._tolerance, self._surplus / self._frames)

    def next(self) -> int | None:
        """The crf to re-encode the window with; None if no further try is needed."""
        tried = self.tried
        if len(tried) > 1:
            (crf, mean), (other, its_mean) = list(tried.items())[-2:]
            found = (its_mean - mean) / (crf - other)
            self._fall = min(max(found, self._assumed / _RANGE), self._assumed * _RANGE)
        best = self.accepted
        if best is None:
            crf, mean = min(tried.items())
            # doubled each time: a scene whose scores do not rise comes to an end soon; but a half
            # at the most, as small crf differ more
            step = max(ceil((self._least - mean) / self._fall), 1 << (len(tried) - 1))
            better = max(self._smallest, crf // 2, crf - step)
            return better if better < crf else None
        surplus = tried[best] - self.due
        if surplus <= _LAVISH * self._tolerance or len(tried) > self._most_trims:
            return None
        refused = min((crf for crf in tried if crf > best), default=self._largest + 1)
        smaller = min(best + int(surplus / self._fall), refused - 1)
        return smaller if smaller > best else None

    def keep(self, crf: int) -> None:
        """Accept the window as encoded with a crf, and choose the crf of the next one."""
        surplus = self.tried[crf] - self.due
        self._surplus = max(0.0, self._surplus + surplus * self._frames)
        room = (self.due - self._least) / 2  # keep half in reserve
        up = int((surplus + room) / self._fall)
        self.crf = min(crf + min(max(up, 0), _MOST_UP), self._largest)


# ---------------------------------------------------------------- windows

_FRAMES = 60  # of a window, or one group of pictures if that is longer
_MOST_FRAMES = 240
_USUAL_RATE = 30.0


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

    @property
    def frames(self) -> int:
        """Of a window: whole groups of pictures, so that windows cost no more key frames."""
        gop = self.coding.gop
        return min(max(1, _FRAMES // gop) * gop, _MOST_FRAMES)

    @cached_property
    def coded_size(self) -> tuple[int, int]:
        """Columns and rows of a coded picture."""
        return coded_size(self.coding.recipe, *self.coding.layout.picture_size(*self.size))

    @cached_property
    def _ffmpeg(self) -> str | None:
        """The ffmpeg that computes VMAF, if that is the metric."""
        return find_ffmpeg() if self.target.metric == "vmaf" else None

    @cached_property
    def _converter(self) -> PictureConverter:
        return PictureConverter()

    def keep(self, seen: CameraMessage, spool: PlaneSpool) -> None:
        """Add the planes of an image to a spool."""
        if seen.pixels is not None:
            layout = self.coding.layout
            picture = layout.to_picture(seen.pixels)
            spool.append(to_planes(picture, layout.pixel_format, self._converter))

    def _encode(self, frames: PlaneSpool, ticks: Sequence[int], crf: int, path: Path) -> Scores:
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
            EncoderRefusedError: The encoder does not support such pictures.
            ScoringError: A score cannot be computed.
        """
        target, control = self.target, CrfControl(self.coding, self.target, _MOST_TRIMS_OF_FIRST)
        if min(self.coded_size) < SMALLEST:
            raise Refused(f"images with less than {SMALLEST} rows or columns have no {target}")
        step = round(TIMESCALE / (self.rate or _USUAL_RATE)) or 1
        with (
            tempfile.TemporaryDirectory(prefix="mp4ds-") as name,
            closing(PlaneSpool(Path(name, "frames.yuv"), *self.coded_size)) as spool,
        ):
            for seen in samples:
                self.keep(seen, spool)
            ticks = range(0, len(spool) * step, step)
            self.tries(control, spool, ticks, lambda _: Path(name, "sample.mp4"))
        crf = control.accepted
        if crf is None:
            crf, mean = min(control.tried.items())
            # a few frames have less VMAF than many, compared with their originals too: where they
            # fall a little short, the first window tells
            if mean < control.due - target.tolerance:
                raise self.out_of_reach(control, f"crf {crf} gives ")
        return crf

    def tries(
        self,
        control: CrfControl,
        frames: PlaneSpool,
        ticks: Sequence[int],
        place: Callable[[int], Path],
    ) -> dict[int, Scores]:
        """Encode a window until it is good enough, or no crf is.

        Args:
            control: Chooses each crf.
            frames: The window's frames, at least one.
            ticks: When each is shown, increasing.
            place: The video to make with a crf.

        Returns:
            Crf -> the scores of the frames.

        Raises:
            EncoderRefusedError: The encoder does not support such pictures.
            ScoringError: libvmaf failed.
            OSError: It cannot be written.
        """
        control.begin(self.target.score, len(frames))
        scores: dict[int, Scores] = {}
        crf: int | None = control.crf
        while crf is not None:
            scores[crf] = self._encode(frames, ticks, crf, place(crf))
            control.tried[crf] = self.mean(scores[crf])
            if len(scores) == 1 and control.accepted is None and self._ffmpeg is not None:
                # VMAF underrates still scenes, even compared with themselves
                ceiling = self.mean(self._scores(frames, frames))
                control.due = min(control.due, ceiling - self.target.tolerance)
            crf = control.next()
        return scores

    def mean(self, scores: Scores) -> float:
        """The mean of scores given in steps."""
        return float(np.mean(scores)) / SCORE_STEPS[self.target.metric]

    def _scores(self, frames: PlaneSpool, decoded: Iterable[Planes]) -> Scores:
        metric = "psnr_y" if self.target.metric == "psnr" else self.target.metric
        # motion in the first frame is measured with the second
        before = frames.frame(1) if self._ffmpeg is not None and len(frames) > 1 else None
        found = scores_of(
            frames, decoded, [metric], ffmpeg=self._ffmpeg, threads=self.threads, before=before
        )[metric]
        return np.rint(found * SCORE_STEPS[self.target.metric]).astype(np.int64)

    def out_of_reach(self, control: CrfControl, made: str) -> Refused:
        """Why a stream is lossless: what was made of a window with the smallest crf tried."""
        due = control.due
        limit = f" of the {due:.2f} that the originals allow" if due < self.target.score else ""
        mean = control.tried[min(control.tried)]
        return Refused(f"{self.target} is out of reach: {made}{mean:.2f}{limit}")
