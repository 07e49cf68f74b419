"""Compares encoder settings on clips of a recording: quality, size and time.

A short clip of each camera is encoded as `mp4ds pack` would, with every setting of a grid, decoded,
and compared with the encoder's input.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
from contextlib import ExitStack, closing, suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from mp4ds._version import __version__
from mp4ds.errors import OptionError, Refused, ScoringError, SourceError, counted
from mp4ds.files.outputs import listed_names, local_target, staged, write_listing
from mp4ds.files.urls import location
from mp4ds.format.sidecars import FileNames
from mp4ds.options import LONG, Parsed, TopicOptions, force, jobs, option, parse_words, what
from mp4ds.plugins.evaluating.page import write_files
from mp4ds.plugins.evaluating.trials import (
    PICTURES,
    Camera,
    CameraEvaluation,
    Cell,
    Clip,
    Evaluation,
    Setting,
    chosen,
    make_clip,
    mean_score,
    open_cameras,
    recommend,
    try_setting,
)
from mp4ds.processes import ProcessExecutor, failure_of
from mp4ds.video.codecs import (
    AV1,
    LOSSY_GOP,
    MAX_CRF,
    QualityTarget,
    check_codec,
    check_pyav,
    codec_name,
    parse_quality,
)
from mp4ds.video.encoder import tool_versions
from mp4ds.video.scores import ffmpeg_version, find_ffmpeg, scores_of, summary_of

_DEFAULT_PRESETS = {
    **dict.fromkeys(AV1, ("6", "8")),
    "h264": ("medium",),
    "h265": ("medium",),
}
_MOST_CELLS = 10_000
_MOST = 1_000_000  # seconds
_CRF = re.compile(r"(?P<first>[0-9]{1,4})(:(?P<last>[0-9]{1,4})(:(?P<step>[0-9]{1,4}))?)?")


def _parse_crfs(value: str | Sequence[str | int]) -> tuple[int, ...]:
    """The values of ``18``, ``16:25``, ``16:25:3`` and ``18,20``."""
    found: set[int] = set()
    for text in map(str, parse_words(value)):
        match = _CRF.fullmatch(text.strip())
        step = int(match["step"] or 1) if match else 0
        if match is None or step == 0:
            raise OptionError(f"{text!r} is not valid. Use a value such as 18, 16:25 or 16:25:3.")
        first = int(match["first"])
        found.update(range(first, int(match["last"] or first) + 1, step))
    if not found or min(found) < 1 or max(found) > max(MAX_CRF.values()):
        raise OptionError(f"{value!r} has values outside 1 to {max(MAX_CRF.values())}.")
    return tuple(sorted(found))


def _parse_target(value: str | QualityTarget) -> QualityTarget:
    """The score of ``vmaf=99.5``, ``psnr=42`` or ``ssim=0.98``."""
    target = value if isinstance(value, QualityTarget) else None
    if isinstance(value, str):
        with suppress(OptionError):  # whose sentence is for more than scores
            target = parse_quality(value).target
    if target is None:
        raise OptionError(
            f"{value!r} is not a score: use vmaf=99.5 (below 100), psnr=42 (dB, below 60) or "
            "ssim=0.98 (below 1)."
        )
    return target


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions(TopicOptions):
    """How to evaluate."""

    codecs: Parsed[Sequence[str]] = option(
        "Codecs of `mp4ds pack` to try: av1, av1-10bit, h264, h265.",
        "av1,h264,h265",
        parse=parse_words,
    )
    crf: Parsed[Sequence[int]] = option(
        "crf values to try, such as 16:25, 16:25:3 or 16,20,24.", "16:25:3", parse=_parse_crfs
    )
    presets: Parsed[Sequence[str]] = option(
        "Presets, such as 6,8,medium; each is tried with the codecs that have it.",
        (),
        parse=parse_words,
    )
    start: float | None = what(
        "Where the clips start; default: in the middle.", metavar="SECONDS", least=0, most=_MOST
    )
    frames: int = what("Frames per clip.", 150, least=1)
    target: Parsed[QualityTarget] = option(
        "Score to reach, such as vmaf=99.5, psnr=42 or ssim=0.98.",
        "vmaf=99.5",
        parse=_parse_target,
    )
    force: bool = force()
    gop: int = option("Maximum key frame interval in frames.", LOSSY_GOP, least=1, most=100_000)
    threads: int | None = option(
        "Threads per encoder; default: all cores.", panel=LONG, least=1, most=1024
    )
    jobs: int = jobs("Settings tried in parallel; use 1 for accurate times.", 1)


def settings_of(options: EvaluateOptions) -> list[Setting]:
    """The requested grid; a codec is not tried with a crf that it does not have.

    Raises:
        OptionError: There is no such codec, preset or crf, or too many of them.
        Mp4dsError: As for `check_pyav`.
    """
    check_pyav()
    codecs = list(dict.fromkeys(map(codec_name, options.codecs)))
    wrong = [codec for codec in codecs if codec not in MAX_CRF]
    if wrong or not codecs:
        raise OptionError(f"`codecs` {', '.join(wrong)!r}: use some of {', '.join(MAX_CRF)}.")
    presets: dict[str, Sequence[str]] = {}
    for codec in codecs:
        own = [preset for preset in dict.fromkeys(options.presets) if _has(codec, preset)]
        presets[codec] = own or _DEFAULT_PRESETS[codec]
    for preset in options.presets:
        if not any(preset in own for own in presets.values()):
            raise OptionError(f"`presets` {preset!r} is not a preset of {', '.join(codecs)}.")
    settings = [
        Setting(codec, preset, crf, options.gop)
        for codec in codecs
        for preset in presets[codec]
        for crf in options.crf
        if crf <= MAX_CRF[codec]
    ]
    if not 0 < len(settings) <= _MOST_CELLS:
        raise OptionError(
            f"{len(settings)} settings were asked for; give `codecs`, `presets` and `crf` "
            f"that make 1 to {_MOST_CELLS}."
        )
    return settings


def _has(codec: str, preset: str) -> bool:
    try:
        check_codec(codec, preset, lossless=False)
    except OptionError:
        return False
    return True


# ---------------------------------------------------------------- evaluation

_SHORT = 30  # frames
_CEILING_MARGIN = 0.2  # of VMAF: what is closer to the ceiling is indistinguishable from noise


def evaluate(
    source: Path | str,
    options: EvaluateOptions | None = None,
    *,
    output: Path | str | None = None,
    progress: Callable[[str, float | None], None] | None = None,
) -> Evaluation:
    """Compare a grid of encoder settings on clips of a recording's cameras.

    Args:
        source: A bag, rosbag2 folder, MCAP, dataset, or video; or a URL.
        options: How.
        output: Folder of the results; None: ``NAME_evaluation`` in the current folder. Those of
            another evaluation are replaced.
        progress: Called now and then with a phrase, and the share of settings done.

    Returns:
        The results; the folder has them as tables, plots and a page.

    Raises:
        SourceError: The source cannot be read, or has no camera that could be tried.
        OptionError: An option is wrong.
        TargetError: The folder cannot be used.
        ScoringError: The target is a VMAF score but libvmaf is missing; or no setting could be
            tried.
        RemoteError: A store or web server fails.
        OSError: It cannot be written.
    """
    options = options or EvaluateOptions()
    goal, settings, place = options.target, settings_of(options), location(source)
    ffmpeg = None
    try:
        ffmpeg = find_ffmpeg()
    except ScoringError as error:
        if goal.metric == "vmaf":
            raise ScoringError(
                f"{error} Or choose another metric, such as `target` psnr=42."
            ) from None
    name = output or f"{place.name if place.is_dir() else place.stem}_evaluation"
    target = local_target(name)
    with ExitStack() as stack:
        found, left_out = stack.enter_context(open_cameras(place))
        options.selected.check([*(camera.topic for camera in found), *left_out])
        wanted = (camera for camera in found if options.selected(camera.topic))
        cameras = sorted(wanted, key=lambda camera: camera.topic)
        origin = min((int(camera.times[0]) for camera in found), default=0)
        vmaf = ffmpeg_version(ffmpeg) if ffmpeg else "none"
        versions = {**tool_versions(), "mp4ds": __version__, "vmaf": vmaf}
        result = Evaluation(place, target, [], left_out, versions)
        names = FileNames()
        made = stack.enter_context(
            staged(target, force=options.force, owned=listed_names, sources=[place])
        )
        (made / PICTURES).mkdir(parents=True)
        for number, camera in enumerate(cameras):

            def tell(what: str, share: float, number: int = number) -> None:
                if progress is not None:
                    topic = cameras[number].topic
                    progress(f"{topic}: {what}", (number + share) / len(cameras))

            try:
                tell("reading", 0)
                indices = chosen(camera.times, origin, options.frames, options.start)
                name = names.name_for(camera.topic)
                one = _evaluated(camera, indices, made, name, options, settings, ffmpeg, tell)
                result.cameras.append(one)
            except Refused as reason:
                left_out[camera.topic] = str(reason)
        if not result.cameras:
            reasons = "; ".join(f"{topic} {reason}" for topic, reason in left_out.items())
            why = f": {reasons}" if reasons else ""
            raise SourceError(place, f"has no camera to try settings on{why}")
        rated = [(camera.cells, camera.reachable) for camera in result.cameras]
        result.recommended = recommend(rated, goal)
        result.tried = sum(len(camera.cells) for camera in result.cameras)
        write_files(result, made, asdict(options))
        write_listing(made)
    return result


# ---------------------------------------------------------------- one camera


def _evaluated(
    camera: Camera,
    indices: list[int],
    made: Path,
    name: str,
    options: EvaluateOptions,
    settings: Sequence[Setting],
    ffmpeg: str | None,
    tell: Callable[[str, float], None],
) -> CameraEvaluation:
    """Try all settings on a camera.

    Args:
        camera: The camera.
        indices: Numbers of the images of the clip.
        made: The folder of the evaluation.
        name: For names of its files.
        options: How.
        settings: The grid.
        ffmpeg: Computes VMAF; None for no VMAF.
        tell: Called with what is done, and the share of it.

    Raises:
        Refused: The camera's images are not usable.
        ScoringError: No setting could be tried.
    """
    goal, has_vmaf = options.target, ffmpeg is not None
    threads = options.threads or max(1, (os.cpu_count() or 1) // options.jobs)
    truth = f"{PICTURES}/{name}-original.png"
    cells: list[Cell] = []
    failures: dict[str, list[str]] = {}
    with TemporaryDirectory(dir=made.parent) as work:
        folder = Path(work)
        clip = make_clip(camera, indices, folder)
        with closing(clip.open(folder)) as frames:
            picture = clip.picture(frames.frame(clip.detail_frame), clip.recipe)
            (made / truth).write_bytes(picture)
            # without which the scores of settings say little
            scores = scores_of(frames, frames, ffmpeg=ffmpeg, threads=threads)
        ceiling = {metric: summary_of(values) for metric, values in scores.items()}
        reachable = goal.score
        if goal.metric == "vmaf":
            reachable = min(reachable, ceiling["vmaf"].mean - _CEILING_MARGIN)
        attempt = partial(try_setting, clip, threads=threads, has_vmaf=has_vmaf)
        with ProcessExecutor(options.jobs) as executor:
            calls = {}
            for setting in settings:
                shown = made / PICTURES / f"{name}-{setting.name.replace(' ', '-')}.png"
                calls[executor.submit(attempt, setting, folder, shown)] = setting
            for done, _ in enumerate(as_completed(calls), 1):
                tell(f"{done} of {len(calls)} settings", done / len(calls))
        for call, setting in calls.items():
            if error := call.exception():
                failures.setdefault(str(failure_of(error)), []).append(setting.name)
            else:
                cells.append(call.result())
        if not cells:
            why = next(iter(failures))
            raise ScoringError(f"{camera.topic}: no setting could be tried. {why}")
        notes = [f"not tried: {', '.join(names)}: {why}" for why, names in failures.items()]
        notes += _notes(clip, cells, goal, reachable, camera.lossy, options.jobs)
        return CameraEvaluation(
            topic=camera.topic,
            name=name,
            clip=clip,
            ceiling=ceiling,
            target=goal,
            reachable=reachable,
            cells=cells,
            recommended=recommend([(cells, reachable)], goal),
            ground_truth=truth,
            notes=notes,
        )


def _notes(
    clip: Clip, cells: Sequence[Cell], goal: QualityTarget, reachable: float, lossy: str, jobs: int
) -> list[str]:
    """What is worth knowing about the figures."""
    best = max(cells, key=lambda cell: mean_score(cell.scores, goal))
    reached = mean_score(best.scores, goal)
    notes = {
        f"its images are already lossy ({lossy}): scores measure the distance from these, not "
        "from what the camera saw": bool(lossy),
        f"the clip scored against itself has {goal.metric} {reachable + _CEILING_MARGIN:.2f}, so "
        f"the target is {_CEILING_MARGIN} below that, {reachable:.2f} instead of "
        f"{goal.score:g}": reachable < goal.score,
        f"no setting reaches {goal.metric} {reachable:.2f}; the best is {best.setting.name} with "
        f"{reached:.2f}: try a lower --crf": reached < reachable,
        f"left out of the clip: {counted(clip.left_out, 'image')} of a different size or "
        "encoding, or that cannot be read": clip.left_out > 0,
        f"a clip of {clip.frames} frames says little: give more --frames": clip.frames < _SHORT,
        "times were measured with several settings running at once": jobs > 1,
    }
    return [note for note, applies in notes.items() if applies]
