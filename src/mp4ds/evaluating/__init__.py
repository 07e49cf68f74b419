"""Settings of encoders, tried on clips of a recording: quality, size and time.

Each camera gives a short clip, which is encoded as `mp4ds pack` would encode it with every
setting of a grid, decoded, and compared with what the encoder was given. What was measured is
kept in the folder of the evaluation, so that the same call goes on where it was interrupted.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from mp4ds._version import __version__
from mp4ds.errors import SourceError
from mp4ds.evaluating.camera import CameraTrial
from mp4ds.evaluating.clips import Unfit
from mp4ds.evaluating.engines import Engines
from mp4ds.evaluating.files import write_files
from mp4ds.evaluating.options import (
    EvaluateOptions,
    Setting,
    Target,
    check_options,
    grid_of,
)
from mp4ds.evaluating.results import (
    CameraEvaluation,
    Cell,
    DataSet,
    EvaluateProgress,
    Evaluation,
    RateRow,
    Recommendation,
    StorageRow,
)
from mp4ds.evaluating.sources import Camera, Source, open_source
from mp4ds.evaluating.tables import recommend
from mp4ds.evaluating.trials import Trials
from mp4ds.evaluating.work import versions_of
from mp4ds.outputs import check_place, work_folder, write_synced
from mp4ds.owned import refuse_not_ours
from mp4ds.plan import FileNames, Selection
from mp4ds.remote import remote
from mp4ds.scoring import Ffmpeg, ScoringError, find_ffmpeg
from mp4ds.video import check_hardware

__all__ = [
    "CameraEvaluation",
    "Cell",
    "DataSet",
    "EvaluateOptions",
    "EvaluateProgress",
    "Evaluation",
    "RateRow",
    "Recommendation",
    "Setting",
    "StorageRow",
    "Target",
    "evaluate",
]

_FOLDERS = ("cells", "pictures", "plots")
_WORK = "work-"
_NOTE_NAME = "mp4ds_evaluation.json"  # in folders that an evaluation has made


def evaluate(
    source: Path | str,
    options: EvaluateOptions | None = None,
    *,
    output: Path | str | None = None,
    progress: Callable[[EvaluateProgress], None] | None = None,
) -> Evaluation:
    """Try a grid of encoder settings on clips of a recording's cameras.

    Args:
        source: A bag, rosbag2 folder, MCAP, dataset, video, or folder of images; or a URL.
        options: How.
        output: Folder of the results; None: ``NAME_evaluation`` in the current folder. Results
            that are there already are used.
        progress: Called when something was done.

    Returns:
        What was found; the folder has it as tables, plots and a page.

    Raises:
        SourceError: The source cannot be read, or has no camera that could be tried.
        OptionError: An option is wrong.
        HardwareError: An encoder is asked for that this machine has not.
        TargetError: The folder may not be used.
        ScoringError: There is no libvmaf, and the target is one of VMAF; or no setting could be
            tried.
        ClusterError: The cluster does not answer, or was lost; what was measured is kept.
        RemoteError: A store or web server fails.
        OSError: The disk refused.
    """
    chosen = options or EvaluateOptions()
    check_options(chosen)
    grid = grid_of(chosen)
    if not chosen.cluster:  # else others encode
        for codec in grid.presets:
            check_hardware(codec)
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
                except Unfit as reason:
                    result.left_out[camera.topic] = str(reason)
        _refuse_none(result)
        rated = [(camera.cells, camera.reachable) for camera in result.cameras]
        result.recommended = recommend(rated, chosen.wanted)
        result = replace(result, tried=trials.tried, known=trials.known)
        write_files(result, chosen)
    return result


def _ffmpeg(target: Target) -> Ffmpeg | None:
    try:
        return find_ffmpeg()
    except ScoringError as error:
        if target.metric == "vmaf":
            raise ScoringError(
                f"{error} Or give a target of another metric, such as --target psnr_y=42."
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
    """A folder for what is not kept, within that of the evaluation.

    It has a new name each time: workers of a cluster may still be at a trial of a run that was
    interrupted, and must not take another clip for theirs.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_synced(folder / _NOTE_NAME, json.dumps({"mp4ds": __version__}).encode())
    for name in _FOLDERS:
        (folder / name).mkdir(exist_ok=True)
    with work_folder(folder, _WORK) as work:
        yield work


def _origin(source: Source) -> int:
    """Log time at which the source begins, as far as its cameras tell, nanoseconds."""
    return min((int(camera.times[0]) for camera in source.cameras if len(camera.times)), default=0)


def _selected(source: Source, options: EvaluateOptions) -> Iterator[Camera]:
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
