"""Streams that are to have a score: the crf to begin with, and the track that keeps it."""

from __future__ import annotations

import shutil
import tempfile
from array import array
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.plan import Target
from mp4ds.scoring import SMALLEST, largest_crf
from mp4ds.sidecar import Quality as Measured
from mp4ds.stamps import TIMESCALE
from mp4ds.streams.crf_control import FALLS, CrfControl
from mp4ds.streams.look import Seen, StreamKey
from mp4ds.streams.tracks import (
    OutOfReach,
    PicturePlan,
    StreamSettings,
    TargetPlan,
    picture_facts,
)
from mp4ds.streams.windows import WindowCoder, window_frames
from mp4ds.video import join_segments
from mp4ds.video.codecs import LEAST_CRF, MAX_CRF

_MOST_SEARCHED = 5  # encodings of the samples
_USUAL_RATE = 30.0


def target_plan(
    plan: PicturePlan,
    target: Target,
    key: StreamKey,
    runs: Iterable[Iterable[Seen]],
    settings: StreamSettings,
    rate: float | None,
) -> TargetPlan:
    """Look for the crf with which samples of a stream have a score.

    Args:
        plan: How the stream is made; with the crf to try first.
        target: The score.
        key: Of the stream.
        runs: Consecutive messages of it from one or several places, at least one message.
        settings: How to encode.
        rate: Frames per second, where known.

    Raises:
        OutOfReach: No crf gives it.
        EncoderRefusedError: The encoder does not take such pictures.
        ScoringError: VMAF cannot be computed.
    """
    coder = _coder(plan, target, key, settings, rate)
    if min(coder.coded_size) < SMALLEST:
        raise OutOfReach(f"images with less than {SMALLEST} rows or columns have no {target}")
    with tempfile.TemporaryDirectory(prefix="mp4ds-") as folder:
        crf = _start_crf(coder, runs, int(plan.recipe.options["crf"]), Path(folder))
    recipe = replace(plan.recipe, options={**plan.recipe.options, "crf": str(crf)})
    return TargetPlan(plan.layout, recipe, str(target), exact=False, target=target)


def _coder(
    plan: PicturePlan, target: Target, key: StreamKey, settings: StreamSettings, rate: float | None
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


def _start_crf(coder: WindowCoder, runs: Iterable[Iterable[Seen]], guess: int, folder: Path) -> int:
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
            raise OutOfReach(_far_off(target, due, f"crf {crf} gives {known[crf]:.2f}"))
        return crf
    finally:
        for spool in spools:
            spool.close()


def _far_off(target: Target, due: float, made: str) -> str:
    """Why a stream is lossless: a score, what is due at least, and what there is."""
    limit = f" of the {due:.2f} that its originals allow" if due < target.score else ""
    return f"{target} is out of reach: {made}{limit}"


class TargetTrack:
    """See `Track`.

    The frames of a window are kept on disk as planes. When it is full it is encoded, decoded and
    scored, and encoded again with a lower crf until it is good enough. The windows' videos are
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

    def refuses(self, seen: Seen) -> str | None:
        """See `Track.refuses`."""
        if seen.pixels is None:
            return "it has no pixels"
        return self._plan.layout.refuses(seen.pixels)

    def write(self, seen: Seen, tick: int) -> None:
        """See `Track.write`.

        Raises:
            OutOfReach: A window cannot have the score.
        """
        if seen.pixels is not None:
            self._spool.append(self._maker.make(self._plan.layout.to_picture(seen.pixels)))
            self._ticks.append(tick)
        if len(self._spool) == self._most:
            self._finish_window()

    def _finish_window(self) -> None:
        """Encode the window until it is good enough.

        Raises:
            OutOfReach: It is not with any crf.
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
            raise OutOfReach(_far_off(target, due, f"{made}{tried[least]:.2f}"))
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
            OutOfReach: A window cannot have the score.
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
