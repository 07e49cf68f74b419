"""The evaluation of one camera: its clip, the grid, its rates, and what they come to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from mp4ds.evaluating.clips import (
    Clip,
    chosen,
    chosen_at_rate,
    clip_seconds,
    make_clip,
)
from mp4ds.evaluating.options import (
    EvaluateOptions,
    Grid,
    Setting,
    first_guess,
)
from mp4ds.evaluating.results import (
    CameraEvaluation,
    Cell,
    DataSet,
    EvaluateProgress,
    RateRow,
    StorageRow,
)
from mp4ds.evaluating.sources import Camera
from mp4ds.evaluating.tables import (
    CEILING_MARGIN,
    reachable_score,
    recommend,
    score_of,
    storage,
)
from mp4ds.evaluating.trials import ClipPlace, Failure, Found, Trials
from mp4ds.scoring import VMAF_MODEL, ScoringError, largest_crf
from mp4ds.video.codecs import MAX_CRF

_NEAR = 1.05  # rates that differ by less are the same
_SHORT = 30  # frames
_MODEL_ROWS = 1080


class CameraTrial:
    """The trial of one camera.

    Args:
        camera: Which.
        name: Of its files.
        options: How.
        grid: What to try.
        trials: What runs it.
        work: Folder for clips.
        report: Told when something was done.
    """

    def __init__(
        self,
        camera: Camera,
        name: str,
        options: EvaluateOptions,
        grid: Grid,
        trials: Trials,
        work: Path,
        report: Callable[[EvaluateProgress], None] | None,
    ) -> None:
        self._camera = camera
        self._name = name
        self._options = options
        self._target = options.wanted
        self._grid = grid
        self._trials = trials
        self._work = work
        self._report = report
        self._notes: list[str] = []
        self._done = 0
        self._total = len(grid.settings())

    def run(self, origin: int) -> CameraEvaluation:
        """Try all settings.

        Args:
            origin: Log time at which the source begins, nanoseconds.

        Raises:
            Unfit: The camera's images are of no use.
            ScoringError: Nothing could be tried.
        """
        self._tell("reading")
        place = self._clip(chosen(self._camera.times, origin, self._options), self._camera.rate)
        try:
            return self._evaluated(place)
        finally:
            place.path.unlink(missing_ok=True)

    def _evaluated(self, place: ClipPlace) -> CameraEvaluation:
        clip, target = place.clip, self._target
        settings = self._grid.settings()
        measured = self._trials.run(place, [None, *settings], self._count)
        ceiling = _measured(measured, None)["scores"]
        reachable = reachable_score(target, ceiling[target.metric].mean)
        cells = self._cells(place, {item: measured[item] for item in settings})
        self._note(clip, reachable, cells)
        recommended = recommend([(cells, reachable)], target)
        rates = self._rates()
        data_set = self._data_set()
        rows: Sequence[StorageRow] = ()
        if data_set is not None:
            best = max(cells, key=lambda cell: score_of(cell, target))
            wanted = recommended[0].setting if recommended else best.setting
            shown = next(cell for cell in cells if cell.setting == wanted)
            rows = storage(clip, place.path, shown, data_set)
        return CameraEvaluation(
            topic=clip.topic,
            name=self._name,
            encoding=clip.encoding,
            size=clip.image_size,
            rate=self._camera.rate,
            frames=clip.frames,
            start=clip.start,
            seconds=clip_seconds(clip),
            source_frames=clip.source_frames,
            raw_bytes=clip.raw_bytes,
            ceiling=ceiling,
            target=target,
            reachable=reachable,
            cells=cells,
            recommended=recommended,
            rates=rates,
            data_set=data_set,
            storage=rows,
            ground_truth=self._trials.picture(place, None),
            notes=self._notes,
        )

    def _clip(self, indices: list[int], rate: float | None, suffix: str = "") -> ClipPlace:
        path = self._work / f"{self._name}{suffix}.yuv"
        return ClipPlace(make_clip(self._camera, indices, rate, path), path, self._name)

    def _cells(self, place: ClipPlace, measured: dict[Setting | None, Found]) -> list[Cell]:
        found = list(self._trials.cells(place, measured))
        cells = [item for item in found if isinstance(item, Cell)]
        failures = [item for item in found if isinstance(item, Failure)]
        if not cells:
            raise ScoringError(
                f"{self._camera.topic}: no setting could be tried. {failures[0].sentence}"
            )
        told: dict[str, list[str]] = {}
        for item in failures:
            told.setdefault(item.sentence, []).append(item.setting.name if item.setting else "")
        for sentence, names in told.items():
            self._notes.append(f"not tried: {', '.join(names)}: {sentence}")
        return cells

    def _note(self, clip: Clip, reachable: float, cells: Sequence[Cell]) -> None:
        target, options = self._target, self._options
        if reachable < target.score:
            self._notes.append(
                f"the clip beside itself has {target.metric} {reachable + CEILING_MARGIN:.2f}: "
                f"the target is {CEILING_MARGIN} less, {reachable:.2f} instead of {target.score:g}"
            )
        if all(score_of(cell, target) < reachable for cell in cells):
            best = max(cells, key=lambda cell: score_of(cell, target))
            self._notes.append(
                f"no setting reaches {target.metric} {reachable:.2f}; the best one is "
                f"{best.setting.name} with {score_of(best, target):.2f}: try a smaller --crf"
            )
        if clip.other_frames:
            self._notes.append(
                f"{clip.other_frames} images within the clip are of another size or encoding, or "
                "cannot be read, and are left out of it"
            )
        if self._camera.is_jpeg:
            self._notes.append("was recorded as JPEG files, which mp4ds pack --transcode encodes")
        if clip.frames < _SHORT:
            self._notes.append(f"a clip of {clip.frames} frames tells little: give more --frames")
        if clip.height > _MODEL_ROWS and "vmaf" in cells[0].scores:
            self._notes.append(
                f"{VMAF_MODEL} is a model of {_MODEL_ROWS} rows; it is used for {clip.height}, "
                "too, and not the one for 4K, so that cameras compare"
            )
        if options.jobs > 1 or options.cluster:
            self._notes.append("times are those of settings that were tried side by side")
        machines = sorted({cell.machine for cell in cells} - {""})
        if len(machines) > 1:
            self._notes.append(
                f"times are those of {len(machines)} machines, {', '.join(machines)}, and compare "
                "as far as these are alike"
            )

    # ------------------------------------------------------------ rates

    def _rates(self) -> list[RateRow]:
        rows = []
        for rate in sorted(set(self._options.rates)):
            own = self._camera.rate
            if own is None or rate > own * _NEAR:
                self._notes.append(f"has no {rate:g} images per second: not tried at this rate")
                continue
            self._tell(f"looking for the crf at {rate:g} Hz")
            indices = chosen_at_rate(self._camera.times, rate, self._options.frames)
            place = self._clip(indices, min(rate, own), f"-{rate:g}hz")
            try:
                codec, presets = next(iter(self._grid.presets.items()))
                rows += [self._rate_row(place, rate, codec, preset) for preset in presets]
            finally:
                place.path.unlink(missing_ok=True)
        return rows

    def _rate_row(self, place: ClipPlace, rate: float, codec: str, preset: str) -> RateRow:
        target = self._target
        original = _measured(self._trials.run(place, [None]), None)
        ceiling = original["scores"][target.metric].mean
        cells: dict[int, Cell] = {}

        def score(crf: int) -> float:
            setting = Setting(codec, preset, crf, self._grid.gop)
            measured = self._trials.run(place, [setting])
            _measured(measured, setting)
            (cells[crf],) = (
                cell for cell in self._trials.cells(place, measured) if isinstance(cell, Cell)
            )
            return score_of(cells[crf], target)

        crf, reached, tried = largest_crf(
            score,
            reachable_score(target, ceiling),
            guess=first_guess(codec, rate),
            largest=MAX_CRF[codec],
        )
        cell = cells[crf]
        return RateRow(
            rate=rate,
            frames=place.clip.frames,
            setting=cell.setting,
            reached=reached,
            score=score_of(cell, target),
            frame_bytes=cell.frame_bytes,
            frame_seconds=cell.encode_seconds / place.clip.frames,
            kbps=cell.frame_bytes * rate * 8 / 1000,
            ceiling=ceiling,
            tried=tried,
        )

    # ------------------------------------------------------------ the rest

    def _data_set(self) -> DataSet | None:
        rate = self._camera.rate
        if rate is None:
            self._notes.append("has no rate, so that nothing is said of hours of it")
            return None
        return DataSet(self._options.streams or 1, self._options.hours or 1.0, rate)

    def _count(self, done: int) -> None:
        self._done = done
        self._tell("trying settings")

    def _tell(self, what: str) -> None:
        if self._report is not None:
            self._report(EvaluateProgress(self._camera.topic, what, self._done, self._total))


def _measured(found: dict[Setting | None, Found], setting: Setting | None) -> dict[str, Any]:
    """What was measured with a setting.

    Raises:
        ScoringError: Nothing was; says why.
    """
    values = found[setting]
    if isinstance(values, Failure):
        raise ScoringError(values.sentence)
    return values
