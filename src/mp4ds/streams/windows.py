"""Windows of a stream: encoded as its video is, decoded, and scored."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.layouts import Layout
from mp4ds.plan import Target
from mp4ds.scoring import Ffmpeg, find_ffmpeg, psnr_scores, ssim_scores, vmaf_scores
from mp4ds.sidecar.quality import SCORE_STEPS
from mp4ds.video import Recipe, VideoEncoder
from mp4ds.video.encoder import coded_size
from mp4ds.video.planes import PLANES_FORMAT, PlaneMaker, Planes, decoded_planes
from mp4ds.video.spool import PlaneSpool

_FRAMES = 60  # of a window, or as many as are of one group of pictures, where that is longer
_MOST_FRAMES = 240


def window_frames(gop: int) -> int:
    """Frames of a window: whole groups of pictures, so that windows cost no more key frames.

    Args:
        gop: Most frames from one key frame to the next.
    """
    return min(max(1, _FRAMES // gop) * gop, _MOST_FRAMES)


@dataclass(frozen=True)
class WindowCoder:
    """Encodes and scores windows.

    Attributes:
        recipe: Codec and options; the crf is another one each time.
        layout: How images become pictures.
        size: Columns and rows of an image.
        target: Its metric is measured.
        gop: Most frames from one key frame to the next.
        threads: Of the encoder, and of libvmaf.
        rate: Frames per second, where known.
    """

    recipe: Recipe
    layout: Layout
    size: tuple[int, int]
    target: Target
    gop: int
    threads: int
    rate: float | None

    @cached_property
    def coded_size(self) -> tuple[int, int]:
        """Columns and rows of a coded picture."""
        return coded_size(self.recipe, *self.layout.picture_size(*self.size))

    @cached_property
    def ffmpeg(self) -> Ffmpeg | None:
        """What computes VMAF, where that is the metric.

        Raises:
            ScoringError: There is none; says how to get one.
        """
        return find_ffmpeg() if self.target.metric == "vmaf" else None

    def maker(self) -> PlaneMaker:
        """Makes planes of pictures."""
        return PlaneMaker(self.layout.pixel_format)

    def spool(self, path: Path) -> PlaneSpool:
        """Keeps planes in a file."""
        return PlaneSpool(path, *self.coded_size)

    def encode(
        self, frames: PlaneSpool, ticks: Sequence[int], crf: int, path: Path
    ) -> NDArray[np.int64]:
        """Encode a window.

        Args:
            frames: Those of the window, at least one.
            ticks: When each is shown, increasing.
            crf: Constant rate factor.
            path: The video to make.

        Returns:
            The scores of its frames, in steps of the metric (`SCORE_STEPS`).

        Raises:
            EncoderRefusedError: The codec does not take such pictures.
            ScoringError: libvmaf failed.
            OSError: The disk refused.
        """
        width, height = self.coded_size
        encoder = VideoEncoder(
            path,
            replace(self.recipe, options={**self.recipe.options, "crf": str(crf)}),
            picture_format=PLANES_FORMAT,
            width=width,
            height=height,
            gop=self.gop,
            threads=self.threads,
            rate=self.rate,
        )
        try:
            for planes, tick in zip(frames, ticks, strict=True):
                encoder.write(planes, tick - ticks[0])
        except BaseException:
            encoder.abandon()
            raise
        encoder.close()
        return self._scores(frames, decoded_planes(path))

    def reachable(self, frames: PlaneSpool) -> float:
        """The score to ask of a window: the target, or less where that is beyond it.

        VMAF takes what is at rest for less than it is, even beside itself.

        Raises:
            ScoringError: libvmaf failed.
        """
        target = self.target
        if target.metric != "vmaf":
            return target.score
        ceiling = self.mean(self._scores(frames, frames))
        return min(target.score, ceiling - target.tolerance)

    def mean(self, scores: NDArray[np.int64]) -> float:
        """The mean of scores that are told in steps."""
        return float(np.mean(scores)) / SCORE_STEPS[self.target.metric]

    def _scores(self, frames: PlaneSpool, decoded: Iterable[Planes]) -> NDArray[np.int64]:
        if self.ffmpeg is not None:
            # what moves in the first frame is told by the second
            before = frames.frame(1) if len(frames) > 1 else None
            found = vmaf_scores(
                frames, decoded, ffmpeg=self.ffmpeg, threads=self.threads, before=before
            )
        else:
            measure = psnr_scores if self.target.metric == "psnr" else ssim_scores
            found = measure(frames, decoded)
        return np.rint(found * SCORE_STEPS[self.target.metric]).astype(np.int64)
