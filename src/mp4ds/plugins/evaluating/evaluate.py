"""Compares encoder settings on clips of a recording: quality, size and time.

A short clip of each camera is encoded as `mp4ds pack` would, with every setting of a grid, decoded,
and compared with the encoder's input. Results are kept in the evaluation's folder, so that the same
call resumes where it was interrupted.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from mp4ds._version import __version__
from mp4ds.errors import Refused, ScoringError, SourceError, counted
from mp4ds.files.outputs import check_place, refuse_not_ours, work_folder, write_synced
from mp4ds.files.urls import location, remote
from mp4ds.messages.encodings import ENCODINGS
from mp4ds.packing.engine import Engine, ProcessEngine
from mp4ds.plan import FileNames, Selection, visual_setting
from mp4ds.plugins.cluster import ClusterEngine, Connection, check_address
from mp4ds.plugins.evaluating.cameras import JPEG, Camera, open_cameras
from mp4ds.plugins.evaluating.clips import Clip, chosen, chosen_at_rate, make_clip
from mp4ds.plugins.evaluating.options import EvaluateOptions, ScoreGoal, Setting, settings_of
from mp4ds.plugins.evaluating.page import PLOTS, write_files
from mp4ds.plugins.evaluating.results import (
    CEILING_MARGIN,
    CameraEvaluation,
    Cell,
    Evaluation,
    RateRow,
    StorageRow,
    reachable_score,
    recommend,
    score_of,
)
from mp4ds.plugins.evaluating.trials import (
    CELLS,
    PICTURES,
    Trial,
    command,
    plain_recipe,
    run_task,
    try_out,
    versions_of,
)
from mp4ds.video.codecs import AV1, MAX_CRF
from mp4ds.video.images import jpeg_bytes
from mp4ds.video.libvmaf import VMAF_MODEL, Ffmpeg, find_ffmpeg
from mp4ds.video.planes import rgb_of
from mp4ds.video.scores import ScoreSummary, largest_crf

_NEAR = 1.05  # rates that differ by less count as equal
_SHORT = 30  # frames
_MODEL_ROWS = 1080
_JPEG_FRAMES = 20
_DAY = 86_400
_FOLDERS = (CELLS, PICTURES, PLOTS)
_WORK = "work-"
_NOTE_NAME = "mp4ds_evaluation.json"  # marks folders made by an evaluation

Progress = Callable[[str, float | None], None]


def evaluate(
    source: Path | str,
    options: EvaluateOptions | None = None,
    *,
    output: Path | str | None = None,
    progress: Progress | None = None,
) -> Evaluation:
    """Compare a grid of encoder settings on clips of a recording's cameras.

    Args:
        source: A bag, rosbag2 folder, MCAP, dataset, video, or folder of images; or a URL.
        options: How.
        output: Folder of the results; None: ``NAME_evaluation`` in the current folder. Existing
            results are reused.
        progress: Called now and then with a phrase, and the share of settings done.

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
    asked = options or EvaluateOptions()
    target, settings = asked.wanted, settings_of(asked)
    if asked.cluster:
        check_address(asked.cluster)
    place, versions = location(source), versions_of(_ffmpeg(target))
    with open_cameras(place, asked.fps) as (found, left_out):
        cameras = [camera for camera in found if len(camera.times)]
        cameras = _selected(cameras, left_out, asked)
        # judging by its cameras
        origin = min((int(camera.times[0]) for camera in found if len(camera.times)), default=0)
        result = Evaluation(place, _folder(place, output), [], left_out, versions)
        names = FileNames()
        with _work_in(result.output) as work, _engine(asked, len(settings) + 1) as engine:
            for number, camera in enumerate(cameras):

                def tell(what: str, share: float, number: int = number) -> None:
                    if progress is not None:
                        topic = cameras[number].topic
                        progress(f"{topic}: {what}", (number + share) / len(cameras))

                name, _ = names.name_for(camera.topic)
                run = _CameraRun(camera, name, settings, asked, result, work, engine, tell)
                try:
                    result.cameras.append(run.evaluate(origin))
                except Refused as reason:
                    left_out[camera.topic] = str(reason)
        if not result.cameras:
            reasons = "; ".join(f"{topic} {reason}" for topic, reason in left_out.items())
            why = f": {reasons}" if reasons else ""
            raise SourceError(place, f"has no camera to try settings on{why}")
        rated = [(camera.cells, camera.reachable) for camera in result.cameras]
        result.recommended = recommend(rated, target)
        write_files(result, asked)
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


def _selected(
    cameras: Sequence[Camera], left_out: dict[str, str], options: EvaluateOptions
) -> list[Camera]:
    selection = Selection(options.topics, options.exclude)
    selection.check([*(camera.topic for camera in cameras), *left_out])
    wanted = (camera for camera in cameras if selection(camera.topic))
    return sorted(wanted, key=lambda camera: camera.topic)


def _folder(source: Path, output: Path | str | None) -> Path:
    name = output or f"{source.name if source.is_dir() else source.stem}_evaluation"
    target = Path(os.path.abspath(name))  # noqa: PTH100 - keeps links, unlike resolve()
    check_place(target, [] if remote(source) else [source])
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


@contextmanager
def _engine(options: EvaluateOptions, most: int) -> Iterator[Engine]:
    """What runs up to so many trials at a time."""
    if options.cluster is None:
        yield ProcessEngine(command, options.jobs)
        return
    with Connection(options.cluster, most) as connection:
        yield ClusterEngine(run_task, connection)


# ---------------------------------------------------------------- one camera


@dataclass
class _CameraRun:
    """The trials of one camera.

    Attributes:
        camera: The camera.
        name: For names of files.
        settings: What to try.
        options: Of the evaluation.
        result: Of the evaluation; what was tried is counted there.
        work: Folder for temporary files.
        engine: Runs the trials.
        tell: Called with what is done, and the share of it.
        notes: What is worth knowing.
    """

    camera: Camera
    name: str
    settings: Sequence[Setting]
    options: EvaluateOptions
    result: Evaluation
    work: Path
    engine: Engine
    tell: Callable[[str, float], None]
    notes: list[str] = field(default_factory=list)

    def evaluate(self, origin: int) -> CameraEvaluation:
        """Try all settings.

        Args:
            origin: Log time at which the source begins, nanoseconds.

        Raises:
            Refused: The camera's images are not usable.
            ScoringError: No setting could be tried.
        """
        self.tell("reading", 0)
        target = self.options.wanted
        indices = chosen(self.camera.times, origin, self.options)
        with self._clip(indices, self.camera.rate) as trial:
            ceiling = self._ceiling(trial)
            reachable = reachable_score(target, ceiling)
            cells = self._cells(trial)
            found = CameraEvaluation(
                topic=self.camera.topic,
                name=self.name,
                clip=trial.clip,
                ceiling=ceiling,
                target=target,
                reachable=reachable,
                cells=cells,
                recommended=recommend([(cells, reachable)], target),
                ground_truth=trial.picture,
                notes=self.notes,
            )
            self.notes += _notes(found, self.camera.lossy, self.options)
            if self.camera.rate is not None:
                self._estimate(found, trial.work, self.camera.rate)
        found.rates = list(self._rates())
        return found

    @contextmanager
    def _clip(self, indices: list[int], rate: float | None) -> Iterator[Trial]:
        """A clip, as a trial that encodes nothing."""
        # a folder of its own: a worker taken for lost may still be reading the clip before it
        with TemporaryDirectory(dir=self.work, ignore_cleanup_errors=True) as folder:
            yield Trial(
                camera=self.name,
                clip=make_clip(self.camera, indices, rate, Path(folder)),
                setting=None,
                threads=self.options.encoder_threads,
                versions=self.result.versions,
                work=Path(folder),
                output=self.result.output,
            )

    def _ceiling(self, trial: Trial) -> dict[str, ScoreSummary]:
        """The scores of a clip against itself, without which others are useless.

        Raises:
            ScoringError: It cannot be scored.
        """
        ((_, found, _),) = try_out([trial], self.engine)
        if not isinstance(found, dict):
            raise ScoringError(str(found))
        return found

    def _cells(self, trial: Trial) -> list[Cell]:
        cells: list[Cell] = []
        failures: dict[str, list[str]] = {}
        trials = [replace(trial, setting=setting) for setting in self.settings]

        def count(done: int) -> None:
            self.tell(f"{done} of {len(trials)} settings", done / len(trials))

        for tried, found, is_known in try_out(trials, self.engine, count):
            if isinstance(found, Cell):
                cells.append(found)
                self.result.known += is_known
                self.result.tried += not is_known
            elif tried.setting is not None:
                failures.setdefault(str(found), []).append(tried.setting.name)
        if not cells:
            reason = next(iter(failures))
            raise ScoringError(f"{self.camera.topic}: no setting could be tried. {reason}")
        for sentence, names in failures.items():
            self.notes.append(f"not tried: {', '.join(names)}: {sentence}")
        return cells

    def _estimate(self, found: CameraEvaluation, work: Path, rate: float) -> None:
        """Estimate the cost of storing a data set, in several forms."""
        streams, hours, clip = self.options.streams or 1, self.options.hours or 1.0, found.clip
        frames = streams * hours * 3600 * rate
        found.data_set = (
            f"{counted(streams, 'camera')} for {hours:g} hour{'s' * (hours != 1)} "
            f"at {rate:.2f} Hz, {frames:.0f} frames"
        )
        encoding, (width, height) = ENCODINGS[clip.encoding], clip.image_size
        best = max(found.cells, key=lambda cell: score_of(cell, found.target)).setting
        setting = found.recommended[0].setting if found.recommended else best
        cell = next(cell for cell in found.cells if cell.setting == setting)
        sizes = {
            "raw": float(encoding.size(width * encoding.pixel_bytes, height)),
            "YUV 4:4:4": 3.0 * width * height,
            "RGB": 3.0 * width * height,
            **{f"JPEG {quality}": _jpeg_bytes(clip, work, quality) for quality in (90, 75)},
            setting.name: cell.frame_bytes,
        }
        rows = [StorageRow(form, size, size * frames / 1e9) for form, size in sizes.items()]
        days = frames / clip.frames / _DAY
        ours = replace(
            rows[-1], days=cell.encode_seconds * days, cpu_days=cell.encode_cpu_seconds * days
        )
        found.storage = [*rows[:-1], ours]

    def _rates(self) -> Iterator[RateRow]:
        first, own = self.settings[0], self.camera.rate
        presets = dict.fromkeys(item.preset for item in self.settings if item.codec == first.codec)
        for rate in sorted(set(self.options.rates)):
            if own is None or rate > own * _NEAR:
                self.notes.append(
                    f"has fewer than {rate:g} images per second: not tried at this rate"
                )
                continue
            self.tell(f"looking for the crf at {rate:g} Hz", 1)
            indices = chosen_at_rate(self.camera.times, rate, self.options.frames)
            with self._clip(indices, min(rate, own)) as trial:
                for preset in presets:
                    yield self._rate_row(trial, rate, replace(first, preset=preset))

    def _rate_row(self, trial: Trial, rate: float, setting: Setting) -> RateRow:
        target, ceiling = self.options.wanted, self._ceiling(trial)
        cells: dict[int, Cell] = {}

        def score(crf: int) -> float:
            tried = replace(trial, setting=replace(setting, crf=crf))
            ((_, found, _),) = try_out([tried], self.engine)
            if not isinstance(found, Cell):
                raise ScoringError(str(found))
            cells[crf] = found
            return score_of(found, target)

        usual, _ = visual_setting(rate)  # for AV1
        crf, reached, _ = largest_crf(
            score,
            reachable_score(target, ceiling),
            guess=usual if setting.codec in AV1 else usual - 2,
            largest=MAX_CRF[setting.codec],
        )
        return RateRow(rate, trial.clip.frames, cells[crf], reached, ceiling[target.metric].mean)


def _jpeg_bytes(clip: Clip, work: Path, quality: int) -> float:
    """Mean bytes of JPEG files of some frames of a clip."""
    recipe, is_grey = plain_recipe(clip), clip.picture_format == "gray"
    numbers = np.unique(np.linspace(0, clip.frames - 1, _JPEG_FRAMES).round().astype(int))
    with closing(clip.open(work)) as frames:
        pictures = (rgb_of(frames.frame(number), recipe) for number in numbers.tolist())
        sizes = [jpeg_bytes(picture, quality, is_grey=is_grey) for picture in pictures]
    return sum(sizes) / len(sizes)


def _notes(found: CameraEvaluation, lossy: str, options: EvaluateOptions) -> list[str]:
    """What is worth knowing about the figures."""
    clip, metric, reachable = found.clip, found.target.metric, found.reachable
    best = max(found.cells, key=lambda cell: score_of(cell, found.target))
    reached, machines = score_of(best, found.target), sorted({c.machine for c in found.cells})
    notes = {
        f"its images are already lossy ({lossy}): scores measure the distance from these, not "
        "from what the camera saw": bool(lossy),
        f"the clip scored against itself has {metric} {reachable + CEILING_MARGIN:.2f}, so the "
        f"target is {CEILING_MARGIN} below that, {reachable:.2f} instead of "
        f"{found.target.score:g}": reachable < found.target.score,
        f"no setting reaches {metric} {reachable:.2f}; the best is {best.setting.name} with "
        f"{reached:.2f}: try a lower --crf": reached < reachable,
        f"left out of the clip: {counted(clip.left_out, 'image')} of a different size or "
        "encoding, or that cannot be read": clip.left_out > 0,
        "was recorded as JPEG files, which `mp4ds pack --transcode` re-encodes": lossy == JPEG,
        f"a clip of {clip.frames} frames says little: give more --frames": clip.frames < _SHORT,
        f"{VMAF_MODEL} is made for {_MODEL_ROWS} rows; it is used for {clip.size[1]} rows too, "
        "instead of the 4K model, so that cameras are comparable": (
            clip.size[1] > _MODEL_ROWS and "vmaf" in best.scores
        ),
        "times were measured with several settings running at once": (
            options.jobs > 1 or bool(options.cluster)
        ),
        f"times were measured on {len(machines)} machines, {', '.join(machines)}, and are "
        "comparable only if these are alike": len(machines) > 1,
        "has no frame rate, so no storage estimate is given": clip.rate is None,
    }
    return [note for note, applies in notes.items() if applies]
