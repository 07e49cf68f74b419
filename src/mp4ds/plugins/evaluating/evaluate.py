"""Compares encoder settings on clips of a recording: quality, size and time.

A short clip of each camera is encoded as `mp4ds pack` would, with every setting of a grid, decoded,
and compared with the encoder's input. Results are kept in the evaluation's folder, so that the same
call resumes where it was interrupted.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mp4ds._version import __version__
from mp4ds.errors import Refused, ScoringError, SourceError
from mp4ds.files.outputs import check_place, refuse_not_ours, work_folder, write_synced
from mp4ds.files.urls import remote
from mp4ds.plan import FileNames, Selection
from mp4ds.plugins.evaluating.clips import (
    Clip,
    EvaluatedCamera,
    EvaluatedSource,
    chosen,
    chosen_at_rate,
    clip_seconds,
    make_clip,
    open_source,
)
from mp4ds.plugins.evaluating.options import (
    EvaluateOptions,
    Grid,
    ScoreGoal,
    Setting,
    check_options,
    first_guess,
    grid_of,
)
from mp4ds.plugins.evaluating.page import write_files
from mp4ds.plugins.evaluating.results import (
    CEILING_MARGIN,
    CameraEvaluation,
    Cell,
    DataSet,
    EvaluateProgress,
    Evaluation,
    RateRow,
    StorageRow,
    reachable_score,
    recommend,
    score_of,
    storage,
)
from mp4ds.plugins.evaluating.trials import ClipPlace, Engines, Failure, Found, Trials, versions_of
from mp4ds.video.codecs import MAX_CRF
from mp4ds.video.libvmaf import VMAF_MODEL, Ffmpeg, find_ffmpeg
from mp4ds.video.scores import largest_crf

_NEAR = 1.05  # rates that differ by less count as equal
_SHORT = 30  # frames
_MODEL_ROWS = 1080


class CameraTrial:
    """The trial of one camera.

    Args:
        camera: The camera.
        name: Name for its files.
        options: How.
        grid: What to try.
        trials: What runs it.
        work: Folder for clips.
        report: Called when something was done.
    """

    def __init__(
        self,
        camera: EvaluatedCamera,
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
        self.known = 0  # settings with results of an earlier run

    def run(self, origin: int) -> CameraEvaluation:
        """Try all settings.

        Args:
            origin: Log time at which the source begins, nanoseconds.

        Raises:
            Refused: The camera's images are not usable.
            ScoringError: No setting could be tried.
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
        self.known = sum(not self._trials.is_new(place, cell.setting) for cell in cells)
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
        if self._camera.lossy:
            self._notes.append(
                f"its images are already lossy ({self._camera.lossy}): scores measure the "
                "distance from these, not from what the camera saw"
            )
        if reachable < target.score:
            self._notes.append(
                f"the clip scored against itself has {target.metric} "
                f"{reachable + CEILING_MARGIN:.2f}, so the target is {CEILING_MARGIN} below that, "
                f"{reachable:.2f} instead of {target.score:g}"
            )
        if all(score_of(cell, target) < reachable for cell in cells):
            best = max(cells, key=lambda cell: score_of(cell, target))
            self._notes.append(
                f"no setting reaches {target.metric} {reachable:.2f}; the best is "
                f"{best.setting.name} with {score_of(best, target):.2f}: try a lower --crf"
            )
        if clip.other_frames:
            self._notes.append(
                f"{clip.other_frames} images in the clip have a different size or encoding, or "
                "cannot be read, and are left out"
            )
        if self._camera.is_jpeg:
            self._notes.append(
                "was recorded as JPEG files, which `mp4ds pack --transcode` re-encodes"
            )
        if clip.frames < _SHORT:
            self._notes.append(f"a clip of {clip.frames} frames says little: give more --frames")
        if clip.height > _MODEL_ROWS and "vmaf" in cells[0].scores:
            self._notes.append(
                f"{VMAF_MODEL} is made for {_MODEL_ROWS} rows; it is used for {clip.height} rows "
                "too, instead of the 4K model, so that cameras are comparable"
            )
        if options.jobs > 1 or options.cluster:
            self._notes.append("times were measured with several settings running at once")
        machines = sorted({cell.machine for cell in cells} - {""})
        if len(machines) > 1:
            self._notes.append(
                f"times were measured on {len(machines)} machines, {', '.join(machines)}, and are "
                "comparable only if these are alike"
            )

    # ------------------------------------------------------------ rates

    def _rates(self) -> list[RateRow]:
        rows = []
        for rate in sorted(set(self._options.rates)):
            own = self._camera.rate
            if own is None or rate > own * _NEAR:
                self._notes.append(
                    f"has fewer than {rate:g} images per second: not tried at this rate"
                )
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
            self._notes.append("has no frame rate, so no storage estimate is given")
            return None
        return DataSet(self._options.streams or 1, self._options.hours or 1.0, rate)

    def _count(self, done: int) -> None:
        self._done = done
        self._tell("trying settings")

    def _tell(self, what: str) -> None:
        if self._report is not None:
            self._report(EvaluateProgress(self._camera.topic, what, self._done, self._total))


def _measured(found: dict[Setting | None, Found], setting: Setting | None) -> dict[str, Any]:
    """The measurements of a setting.

    Raises:
        ScoringError: There are none; says why.
    """
    values = found[setting]
    if isinstance(values, Failure):
        raise ScoringError(values.sentence)
    return values


# ---------------------------------------------------------------- evaluate

_FOLDERS = ("cells", "pictures", "plots")
_WORK = "work-"
_NOTE_NAME = "mp4ds_evaluation.json"  # marks folders made by an evaluation


def evaluate(
    source: Path | str,
    options: EvaluateOptions | None = None,
    *,
    output: Path | str | None = None,
    progress: Callable[[EvaluateProgress], None] | None = None,
) -> Evaluation:
    """Compare a grid of encoder settings on clips of a recording's cameras.

    Args:
        source: A bag, rosbag2 folder, MCAP, dataset, video, or folder of images; or a URL.
        options: How.
        output: Folder of the results; None: ``NAME_evaluation`` in the current folder. Existing
            results are reused.
        progress: Called when something was done.

    Returns:
        The results; the folder has them as tables, plots and a page.

    Raises:
        SourceError: The source cannot be read, or has no camera that could be tried.
        OptionError: An option is wrong.
        TargetError: The folder cannot be used.
        ScoringError: The target is a VMAF score but libvmaf is missing; or no setting could be
            tried.
        ClusterError: The cluster does not respond, or was lost; results so far are kept.
        RemoteError: A store or web server fails.
        OSError: It cannot be written.
    """
    chosen = options or EvaluateOptions()
    check_options(chosen)
    grid = grid_of(chosen)
    engines = Engines(chosen, len(grid.settings()) + 1)
    versions = versions_of(_ffmpeg(chosen.wanted))
    with open_source(source, fps=chosen.fps) as found:
        folder = _folder(found.path, output)
        with _work_in(folder) as work, engines:
            trials = Trials(
                folder, work, engines, versions=versions, threads=chosen.encoder_threads
            )
            result = Evaluation(found.path, folder, [], dict(found.left_out), versions)
            names = FileNames()
            origin = _origin(found)
            for camera in _selected(found, chosen):
                name, _ = names.name_for(camera.topic)
                trial = CameraTrial(camera, name, chosen, grid, trials, work, progress)
                try:
                    result.cameras.append(trial.run(origin))
                    result.known += trial.known
                except Refused as reason:
                    result.left_out[camera.topic] = str(reason)
        _refuse_none(result)
        rated = [(camera.cells, camera.reachable) for camera in result.cameras]
        result.recommended = recommend(rated, chosen.wanted)
        result.tried = sum(len(camera.cells) for camera in result.cameras) - result.known
        write_files(result, chosen)
    return result


def _ffmpeg(target: ScoreGoal) -> Ffmpeg | None:
    try:
        return find_ffmpeg()
    except ScoringError as error:
        if target.metric == "vmaf":
            raise ScoringError(
                f"{error} Or choose another metric, such as `target` psnr_y=42."
            ) from None
        return None


def _folder(source: Path, output: Path | str | None) -> Path:
    name = output or f"{source.name if source.is_dir() else source.stem}_evaluation"
    target = Path(os.path.abspath(name))  # noqa: PTH100 - keeps links, unlike resolve()
    sources = [] if remote(source) else [source]
    check_place(target, sources)
    if os.path.lexists(target) and not _is_evaluation(target):
        refuse_not_ours(target, None)
    return target


def _is_evaluation(path: Path) -> bool:
    if any((path / name).is_symlink() for name in _FOLDERS):
        return False
    return path.is_dir() and ((path / _NOTE_NAME).is_file() or not any(path.iterdir()))


@contextmanager
def _work_in(folder: Path) -> Iterator[Path]:
    """A folder for temporary files, inside that of the evaluation.

    It has a new name each time: cluster workers may still be running a trial of an interrupted run,
    and must not mistake another clip for theirs.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_synced(folder / _NOTE_NAME, json.dumps({"mp4ds": __version__}).encode())
    for name in _FOLDERS:
        (folder / name).mkdir(exist_ok=True)
    with work_folder(folder, _WORK) as work:
        yield work


def _origin(source: EvaluatedSource) -> int:
    """Log time at which the source begins, judging by its cameras, nanoseconds."""
    return min((int(camera.times[0]) for camera in source.cameras if len(camera.times)), default=0)


def _selected(source: EvaluatedSource, options: EvaluateOptions) -> Iterator[EvaluatedCamera]:
    selection = Selection(options.topics, options.exclude)
    selection.check([*(camera.topic for camera in source.cameras), *source.left_out])
    return (
        camera
        for camera in sorted(source.cameras, key=lambda item: item.topic)
        if selection(camera.topic) and len(camera.times)
    )


def _refuse_none(result: Evaluation) -> None:
    if result.cameras:
        return
    reasons = "; ".join(f"{topic} {reason}" for topic, reason in result.left_out.items())
    raise SourceError(
        result.source, f"has no camera to try settings on{f': {reasons}' if reasons else ''}"
    )
