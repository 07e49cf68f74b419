"""Streams that have to reach a score: their windows are encoded, scored, and re-encoded."""

from __future__ import annotations

import shutil
import tempfile
from array import array
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import Refused
from mp4ds.format.models import SCORE_STEPS
from mp4ds.format.models import Quality as Measured
from mp4ds.messages.layouts import Layout
from mp4ds.packing.inspection import CameraMessage, StreamKey
from mp4ds.packing.tracks import PicturePlan, StreamSettings, TargetPlan, picture_facts
from mp4ds.plan import QualityTarget
from mp4ds.times import TIMESCALE
from mp4ds.video.codecs import LEAST_CRF, MAX_CRF, Recipe
from mp4ds.video.encoder import VideoEncoder, coded_size
from mp4ds.video.packets import join_segments
from mp4ds.video.planes import PLANES_FORMAT, PlaneMaker, Planes, PlaneSpool, decoded_planes
from mp4ds.video.scores import SMALLEST, Ffmpeg, find_ffmpeg, largest_crf, scores_of

FALLS = {"vmaf": 0.3, "psnr": 0.4, "ssim": 0.001}
"""Metric -> about how much it drops per crf step, near typical targets."""

_MOST_UP = 8  # maximum crf increase from one window to the next
_RANGE = 4  # factor by which the fall of scores may differ from the assumed one
# of the tolerance: a window that exceeds the target by more is re-encoded with fewer bits
_LAVISH = 0.5
_MOST_TRIMS = 2  # times
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
    """

    def __init__(
        self, start: int, smallest: int, largest: int, tolerance: float, fall: float
    ) -> None:
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


# ---------------------------------------------------------------- windows

_FRAMES = 60  # of a window, or one group of pictures if that is longer
_MOST_FRAMES = 240


def window_frames(gop: int) -> int:
    """Frames of a window: whole groups of pictures, so that windows cost no more key frames.

    Args:
        gop: Maximum key frame interval, frames.
    """
    return min(max(1, _FRAMES // gop) * gop, _MOST_FRAMES)


@dataclass(frozen=True)
class WindowCoder:
    """Encodes and scores windows.

    Attributes:
        recipe: Codec and options; the crf varies.
        layout: How images become pictures.
        size: Columns and rows of an image.
        target: The target, whose metric is measured.
        gop: Maximum key frame interval, frames.
        threads: Of the encoder, and of libvmaf.
        rate: Frames per second, if known.
    """

    recipe: Recipe
    layout: Layout
    size: tuple[int, int]
    target: QualityTarget
    gop: int
    threads: int
    rate: float | None

    @cached_property
    def coded_size(self) -> tuple[int, int]:
        """Columns and rows of a coded picture."""
        return coded_size(self.recipe, *self.layout.picture_size(*self.size))

    @cached_property
    def ffmpeg(self) -> Ffmpeg | None:
        """The ffmpeg that computes VMAF, if that is the metric.

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
            replace(self.recipe, options={**self.recipe.options, "crf": str(crf)}),
            picture_format=PLANES_FORMAT,
            width=width,
            height=height,
            gop=self.gop,
            threads=self.threads,
            rate=self.rate,
        ) as encoder:
            for planes, tick in zip(frames, ticks, strict=True):
                encoder.write(planes, tick - ticks[0])
        return self._scores(frames, decoded_planes(path))

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


# ---------------------------------------------------------------- target

_MOST_SEARCHED = 5  # encodings of the samples
_USUAL_RATE = 30.0


def target_plan(
    plan: PicturePlan,
    target: QualityTarget,
    key: StreamKey,
    runs: Iterable[Iterable[CameraMessage]],
    settings: StreamSettings,
    rate: float | None,
) -> TargetPlan:
    """Find the crf at which samples of a stream reach a score.

    Args:
        plan: Plan of the stream, with the crf to try first.
        target: The score.
        key: Of the stream.
        runs: Runs of its consecutive messages from one or several places, at least one message.
        settings: How to encode.
        rate: Frames per second, if known.

    Raises:
        Refused: No crf reaches it.
        EncoderRefusedError: The encoder does not support such pictures.
        ScoringError: VMAF cannot be computed.
    """
    coder = _coder(plan, target, key, settings, rate)
    if min(coder.coded_size) < SMALLEST:
        raise Refused(f"images with less than {SMALLEST} rows or columns have no {target}")
    with tempfile.TemporaryDirectory(prefix="mp4ds-") as folder:
        crf = _start_crf(coder, runs, int(plan.recipe.options["crf"]), Path(folder))
    recipe = replace(plan.recipe, options={**plan.recipe.options, "crf": str(crf)})
    return TargetPlan(plan.layout, recipe, str(target), exact=False, target=target)


def _coder(
    plan: PicturePlan,
    target: QualityTarget,
    key: StreamKey,
    settings: StreamSettings,
    rate: float | None,
) -> WindowCoder:
    return WindowCoder(
        plan.recipe,
        plan.layout,
        (key.width, key.height),
        target,
        gop=settings.gop,
        threads=settings.threads,
        rate=rate,
    )


def _start_crf(
    coder: WindowCoder, runs: Iterable[Iterable[CameraMessage]], guess: int, folder: Path
) -> int:
    maker, target = coder.maker(), coder.target
    least = LEAST_CRF[coder.recipe.codec]
    spools = []
    try:
        for number, run in enumerate(runs):
            spools.append(coder.spool(folder / f"{number}.yuv"))
            for seen in run:
                if seen.pixels is not None:
                    spools[-1].append(maker.make(coder.layout.to_picture(seen.pixels)))
        filled = [spool for spool in spools if len(spool)]
        due = float(np.mean([coder.reachable(spool) for spool in filled]))

        known: dict[int, float] = {}

        def score(crf: int) -> float:
            video = folder / "sample.mp4"
            step = round(TIMESCALE / (coder.rate or _USUAL_RATE)) or 1
            found = []
            for spool in filled:
                ticks = range(0, len(spool) * step, step)
                found.append(coder.mean(coder.encode(spool, ticks, crf, video)))
            known[crf] = float(np.mean(found))
            return known[crf]

        crf, reached, _ = largest_crf(
            score,
            due,
            guess=guess,
            largest=MAX_CRF[coder.recipe.codec],
            smallest=least,
            fall=FALLS[target.metric],
            most=_MOST_SEARCHED,
        )
        # a few frames have less VMAF than many, compared with their originals too: where they fall
        # a little short, the first window tells
        if not reached and crf == least and known[crf] < due - target.tolerance:
            raise _out_of_reach(target, due, f"crf {crf} gives {known[crf]:.2f}")
        return crf
    finally:
        for spool in spools:
            spool.close()


def _out_of_reach(target: QualityTarget, due: float, made: str) -> Refused:
    """Why a stream is lossless: the target, the required score, and the one reached."""
    limit = f" of the {due:.2f} that the originals allow" if due < target.score else ""
    return Refused(f"{target} is out of reach: {made}{limit}")


class TargetTrack:
    """See `Track`.

    The frames of a window are kept on disk as planes. When it is full it is encoded, decoded and
    scored, and re-encoded with a lower crf until it is good enough. The windows' videos are
    joined at the end.
    """

    def __init__(
        self,
        plan: TargetPlan,
        path: Path,
        key: StreamKey,
        settings: StreamSettings,
        rate: float | None,
    ) -> None:
        self._plan = plan
        self.note = plan.note
        self._path = path
        self._coder = _coder(plan, plan.target, key, settings, rate)
        self._maker = self._coder.maker()
        self._most = window_frames(settings.gop)
        self._control = CrfControl(
            int(plan.recipe.options["crf"]),
            LEAST_CRF[plan.recipe.codec],
            MAX_CRF[plan.recipe.codec],
            plan.target.tolerance,
            FALLS[plan.target.metric],
        )
        self._folder = path.with_name(f".{path.stem}.windows")
        self._folder.mkdir()
        self._spool = self._coder.spool(self._folder / "frames.yuv")
        self._ticks = array("q")
        self._segments: list[Path] = []
        self._scores: list[NDArray[np.int64]] = []
        self._reencoded = self._limited = 0

    def refuses(self, seen: CameraMessage) -> str | None:
        """See `Track.refuses`."""
        if seen.pixels is None:
            return "it has no pixels"
        return self._plan.layout.refuses(seen.pixels)

    def write(self, seen: CameraMessage, tick: int) -> None:
        """See `Track.write`.

        Raises:
            Refused: A window cannot reach the score.
        """
        if seen.pixels is not None:
            self._spool.append(self._maker.make(self._plan.layout.to_picture(seen.pixels)))
            self._ticks.append(tick)
        if len(self._spool) == self._most:
            self._finish_window()

    def _finish_window(self) -> None:
        """Encode the window until it is good enough.

        Raises:
            Refused: No crf is good enough.
        """
        coder, control, target = self._coder, self._control, self._plan.target
        spool, due = self._spool, target.score
        frames = len(spool)
        ticks = self._ticks[-frames:]
        number = len(self._segments)
        found: dict[int, NDArray[np.int64]] = {}
        tried: dict[int, float] = {}
        crf: int | None = control.crf
        while crf is not None:
            found[crf] = coder.encode(spool, ticks, crf, self._segment(number, crf))
            tried[crf] = coder.mean(found[crf])
            if len(tried) == 1 and control.accepted(tried, due, frames) is None:
                due = coder.reachable(spool)
            crf = control.next(tried, due, frames)
        kept = control.accepted(tried, due, frames)
        if kept is None:
            first, least = len(self._ticks) - frames, min(tried)
            made = f"crf {least} gives frames {first} to {first + frames - 1} of a part "
            raise _out_of_reach(target, due, f"{made}{tried[least]:.2f}")
        control.keep(tried, kept, due, frames)
        for crf in tried.keys() - {kept}:
            self._segment(number, crf).unlink()
        self._segments.append(self._segment(number, kept))
        self._scores.append(found[kept])
        self._reencoded += len(tried) > 1
        self._limited += due < target.score
        spool.clear()

    def _segment(self, number: int, crf: int) -> Path:
        return self._folder / f"{number:06}-{crf}.mp4"

    def close(self) -> None:
        """See `Track.close`.

        Raises:
            Refused: A window cannot reach the score.
        """
        try:
            if len(self._spool):
                self._finish_window()
            join_segments(self._segments, self._ticks, self._path)
        finally:
            self.abandon()

    def abandon(self) -> None:
        """See `Track.abandon`."""
        self._spool.close()
        shutil.rmtree(self._folder, ignore_errors=True)

    def describe(self) -> dict[str, Any]:
        """See `Track.describe`."""
        coder = self._coder
        options = {**self._plan.recipe.options, "g": str(coder.gop)}
        return {
            **picture_facts(self._plan, coder.coded_size, options),
            "quality": Measured.from_scores(
                self._plan.target,
                np.concatenate(self._scores),
                worst_window=min(map(coder.mean, self._scores)),
                windows=len(self._scores),
                reencoded=self._reencoded,
                limited=self._limited,
            ),
        }
