"""Tries settings on clips, each in its own process, and keeps the measurements."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import signal
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mp4ds._version import __version__
from mp4ds.errors import EncoderRefusedError, Mp4dsError, ScoringError
from mp4ds.files.outputs import is_seen, write_synced
from mp4ds.packing.engine import Engine, Outcome, ProcessEngine
from mp4ds.plugins.evaluating.clips import Clip, ClipFile, clip_seconds, detail_of
from mp4ds.plugins.evaluating.options import EvaluateOptions, Setting
from mp4ds.plugins.evaluating.results import Cell
from mp4ds.video.codecs import Recipe, recipe_for
from mp4ds.video.encoder import VideoEncoder, tool_versions
from mp4ds.video.images import png_file
from mp4ds.video.libvmaf import Ffmpeg, find_ffmpeg
from mp4ds.video.planes import PLANES_FORMAT, Planes, decoded_planes, packet_sizes, rgb_of
from mp4ds.video.scores import Scorer, Scores, ScoreSummary

REFUSED = "refused"
"""Key of a result that says why the encoder refused the frames."""

_ENLARGED = 2
_NO_VMAF = "none"
_PROCESS_BYTES = 200 * 2**20  # the interpreter, libraries, and frames being compared


@dataclass(frozen=True, slots=True)
class Trial:
    """The job of a process.

    Attributes:
        clip: File of the clip.
        result: File to make.
        picture: PNG file to make of the detail.
        setting: How to encode; None: score the clip against itself, which gives its ceiling.
        threads: Of the encoder and of libvmaf.
        versions: The versions to use; see `versions_of`.
    """

    clip: str
    result: str
    picture: str
    setting: Setting | None
    threads: int
    versions: dict[str, str]

    def to_json(self) -> bytes:
        """As text."""
        return json.dumps(asdict(self)).encode()

    @classmethod
    def from_json(cls, text: bytes) -> Trial:
        """The inverse of `to_json`."""
        values = json.loads(text)
        setting = values.pop("setting")
        return cls(setting=Setting(**setting) if setting else None, **values)


def command(task: tuple[str, ...]) -> list[str]:
    """The command line that runs a task: the file of a `Trial`."""
    return [sys.executable, "-m", "mp4ds.plugins.evaluating.trials", *task]


def run_task(job: str) -> None:
    """Run a task on a cluster worker, in a separate process as on this machine.

    Args:
        job: The file of a `Trial`.

    Raises:
        Mp4dsError: It failed; says why.
    """
    if not Path(job).is_file():
        raise Mp4dsError(f"{job} does not exist: all machines must share the evaluation's folder.")
    for outcome in ProcessEngine(command, 1).run([(job,)], lambda *_: None):
        if outcome.error is not None:
            raise Mp4dsError(outcome.error[1])


def versions_of(ffmpeg: Ffmpeg | None) -> dict[str, str]:
    """Versions of the software that makes videos and scores here: others may give other results.

    Args:
        ffmpeg: Computes VMAF; None for no VMAF.
    """
    vmaf = ffmpeg.version if ffmpeg else _NO_VMAF
    return {**tool_versions(), "mp4ds": __version__, "vmaf": vmaf}


def run(trial: Trial) -> None:
    """Encode, decode, score, and write the measurements.

    Raises:
        Mp4dsError: Different versions are installed here, or libvmaf failed.
        OSError: It cannot be written.
    """
    ffmpeg = _ffmpeg(trial.versions)
    clip = ClipFile(Path(trial.clip))
    measured: dict[str, Any] = {"machine": socket.gethostname()}
    if trial.setting is None:
        recipe = _recipe(clip.clip, Setting("av1", "8", 1))
        scores, shown = _scored(trial, clip, ffmpeg, iter(clip))
    else:
        recipe = _recipe(clip.clip, trial.setting)
        with tempfile.TemporaryDirectory(dir=Path(trial.clip).parent) as folder:
            video = Path(folder, "video.mp4")
            try:
                measured.update(_encoded(clip, recipe, trial, video))
            except EncoderRefusedError as error:
                _write(Path(trial.result), {REFUSED: str(error)})
                return
            scores, shown = _scored(trial, clip, ffmpeg, decoded_planes(video))
    measured["scores"] = {name: asdict(value) for name, value in scores.summaries().items()}
    write_synced(Path(trial.picture), _picture(shown, recipe))
    _write(Path(trial.result), measured)


def _write(path: Path, values: dict[str, Any]) -> None:
    write_synced(path, json.dumps(values, indent=1).encode())


def _ffmpeg(versions: dict[str, str]) -> Ffmpeg | None:
    """The ffmpeg that computes VMAF here.

    Raises:
        Mp4dsError: Versions differ from those requested, or libvmaf is missing.
    """
    ffmpeg = None if versions["vmaf"] == _NO_VMAF else find_ffmpeg()
    here = versions_of(ffmpeg)
    others = [
        f"{name} {here.get(name, 'none')} instead of {version}"
        for name, version in versions.items()
        if here.get(name) != version
    ]
    if others:
        raise Mp4dsError(
            f"versions differ between machines: {', '.join(others)}. Install the same."
        )
    return ffmpeg


def _recipe(clip: Clip, setting: Setting) -> Recipe:
    return recipe_for(
        clip.picture_format,
        lossless=False,
        codec=setting.codec,
        crf=setting.crf,
        preset=setting.preset,
    )


def _encoded(clip: ClipFile, recipe: Recipe, trial: Trial, video: Path) -> dict[str, Any]:
    """Encode the clip as `mp4ds pack` does, and decode it; returns the cost."""
    facts, gop = clip.clip, trial.setting.gop if trial.setting else 1
    clip.fetch()
    wall, cpu = time.perf_counter(), time.process_time()
    encoder = VideoEncoder(
        video,
        recipe,
        picture_format=PLANES_FORMAT,
        width=facts.width,
        height=facts.height,
        gop=gop,
        threads=trial.threads,
        rate=facts.rate,
    )
    try:
        for planes, tick in zip(clip, facts.ticks, strict=True):
            encoder.write(planes, tick)
    except BaseException:
        encoder.abandon()
        raise
    encoder.close()
    encode_seconds, encode_cpu = time.perf_counter() - wall, time.process_time() - cpu
    cpu = time.process_time()
    for _ in decoded_planes(video):
        pass
    decode_cpu = time.process_time() - cpu
    sizes = packet_sizes(video)
    return {
        "encode_seconds": encode_seconds,
        "encode_cpu_seconds": encode_cpu,
        "decode_cpu_seconds": decode_cpu,
        "size": sizes.total,
        "frame_bytes": sizes.frame_bytes(gop),
    }


def _scored(
    trial: Trial, clip: ClipFile, ffmpeg: Ffmpeg | None, frames: Iterator[Planes]
) -> tuple[Scores, Planes]:
    """The scores of frames, and the detail of one of them."""
    shown: list[Planes] = []

    def watched() -> Iterator[Planes]:
        for number, planes in enumerate(frames):
            if number == clip.clip.detail_frame:
                y, u, v = (plane.copy() for plane in detail_of(planes, clip.clip))
                shown.append((y, u, v))
            yield planes

    scores = Scorer(ffmpeg, threads=trial.threads).score(clip, watched())
    return scores, shown[0]


def _picture(detail: Planes, recipe: Recipe) -> bytes:
    rgb = rgb_of(detail, recipe)
    return png_file(rgb.repeat(_ENLARGED, axis=0).repeat(_ENLARGED, axis=1))


def _tell(values: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(values) + "\n")
    sys.stdout.flush()


def _end_with_parent() -> None:
    """Exit when nobody waits for the result any more: files with final names are complete."""
    while os.read(sys.stdin.fileno(), 4096):
        pass
    os._exit(1)


def _main() -> None:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        run(Trial.from_json(Path(sys.argv[1]).read_bytes()))
    except MemoryError:
        _tell({"error": ("MemoryError", "out of memory; try fewer `jobs` or `frames`")})
    except (Mp4dsError, OSError) as error:
        _tell({"error": (type(error).__name__, str(error))})
    else:
        _tell({"done": True})


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError):
        _main()


# ---------------------------------------------------------------- engines


class Engines:
    """Makes engines, which share one connection to a cluster. A context manager that ends it.

    Args:
        options: Of the evaluation.
        most: Maximum number of parallel trials.

    Raises:
        OptionError: There is no such cluster, or a package is missing.
    """

    def __init__(self, options: EvaluateOptions, most: int) -> None:
        self._jobs = options.jobs
        self._stack = ExitStack()
        self._connection = None
        if options.cluster:
            from mp4ds.plugins.cluster import Connection

            self._connection = self._stack.enter_context(Connection(options.cluster, most))

    def engine(self) -> Engine:
        """An engine for trials."""
        if self._connection is None:
            return ProcessEngine(command, self._jobs)
        from mp4ds.plugins.cluster import ClusterEngine

        return ClusterEngine(run_task, self._connection)

    def __enter__(self) -> Engines:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()


# ---------------------------------------------------------------- trials

_SHORT = 12  # digits of a digest in a name
_MEASURED = (
    *("encode_seconds", "encode_cpu_seconds", "decode_cpu_seconds"),
    *("size", "frame_bytes"),
)


@dataclass(frozen=True, slots=True)
class Failure:
    """A setting that could not be tried.

    Attributes:
        setting: The setting.
        sentence: Why.
    """

    setting: Setting | None
    sentence: str


Found = dict[str, Any] | Failure
"""The measurements of a setting, or why there are none."""


@dataclass(frozen=True)
class ClipPlace:
    """A clip and where its frames are.

    Attributes:
        clip: Its description.
        path: Its file.
        name: Of its camera, for names of files.
    """

    clip: Clip
    path: Path
    name: str


class Trials:
    """The trials of one evaluation.

    Args:
        folder: Where results are kept, in ``cells`` and ``pictures``.
        work: Folder for temporary files.
        engines: Run them.
        versions: Of the software that makes videos and scores; if they change, everything is
            measured again.
        threads: Of an encoder.
    """

    def __init__(
        self,
        folder: Path,
        work: Path,
        engines: Engines,
        *,
        versions: dict[str, str],
        threads: int,
    ) -> None:
        self._folder = folder
        self._work = work
        self._engines = engines
        self._versions = versions
        self._threads = threads
        self._made: set[Path] = set()

    def is_new(self, place: ClipPlace, setting: Setting) -> bool:
        """Whether a setting was tried in this run, not in an earlier one."""
        return self._result(place, setting) in self._made

    def run(
        self,
        place: ClipPlace,
        settings: Sequence[Setting | None],
        on_done: Callable[[int], None] = lambda _: None,
    ) -> dict[Setting | None, Found]:
        """Try settings on a clip, except for those with existing results.

        Args:
            place: The clip.
            settings: Each once; None scores the clip as it is.
            on_done: Called with the number of settings done, not counting None.

        Returns:
            The measurements by setting, or why there are none.

        Raises:
            ScoringError: The clip could not be scored against itself, which makes the others
                useless.
            ClusterError: The cluster does not answer, or was lost.
        """
        found: dict[Setting | None, Found] = {}
        tasks: dict[tuple[str, ...], Setting | None] = {}
        for setting in settings:
            known = self._read(place, setting)
            if known is not None:
                found[setting] = known
                continue
            job = self._work / f"{self._name(place, setting)}.job"
            write_synced(job, self._trial(place, setting).to_json())
            tasks[(str(job),)] = setting
        on_done(len(found.keys() - {None}))
        engine = self._engines.engine()
        with closing(engine.run(list(tasks), lambda *_: None)) as outcomes:
            for outcome in outcomes:
                setting = tasks[outcome.task]
                found[setting] = self._found(place, setting, outcome)
                on_done(len(found.keys() - {None}))
        return found

    def _found(self, place: ClipPlace, setting: Setting | None, outcome: Outcome) -> Found:
        """The outcome of a trial.

        Raises:
            ScoringError: It failed, and the others are useless without it.
        """
        sentence = outcome.error[1] if outcome.error else ""
        if not sentence and not self._is_seen(place, setting):
            folder = self._folder / "cells"
            sentence = (
                f"its result did not appear in {folder}; all machines must share this folder."
            )
        result = None if sentence else self._read(place, setting)
        if result is not None:
            self._made.add(self._result(place, setting))
            return result
        if setting is None:
            raise ScoringError(sentence)
        return Failure(setting, sentence)

    def _is_seen(self, place: ClipPlace, setting: Setting | None) -> bool:
        folders = self._folder / "cells", self._folder / "pictures"
        return is_seen(lambda: self._read(place, setting) is not None, *folders)

    def _trial(self, place: ClipPlace, setting: Setting | None) -> Trial:
        return Trial(
            clip=str(place.path),
            result=str(self._result(place, setting)),
            picture=str(self._folder / self.picture(place, setting)),
            setting=setting,
            threads=self._threads,
            versions=self._versions,
        )

    def _name(self, place: ClipPlace, setting: Setting | None) -> str:
        key = {
            "clip": place.clip.digest,
            "format": place.clip.picture_format,
            "rate": place.clip.rate,
            "setting": asdict(setting) if setting else None,
            "threads": self._threads,
            "versions": self._versions,
        }
        digest = hashlib.sha256(json.dumps(key, sort_keys=True).encode()).hexdigest()[:_SHORT]
        what = setting.name.replace(" ", "-") if setting else "original"
        return f"{place.name}-{what}-{digest}"

    def _result(self, place: ClipPlace, setting: Setting | None) -> Path:
        return self._folder / "cells" / f"{self._name(place, setting)}.json"

    def picture(self, place: ClipPlace, setting: Setting | None) -> str:
        """Name of a PNG file of a clip's detail, in the folder."""
        return f"pictures/{self._name(place, setting)}.png"

    def _read(self, place: ClipPlace, setting: Setting | None) -> Found | None:
        """Earlier measurements, if complete."""
        try:
            values = json.loads(self._result(place, setting).read_bytes())
            if REFUSED in values:
                return Failure(setting, str(values[REFUSED]))
            scores = {name: ScoreSummary(**score) for name, score in values["scores"].items()}
            # otherwise not encoded
            figures = [values[name] for name in _MEASURED] if setting else []
            figures += [figure for score in scores.values() for figure in asdict(score).values()]
            if not all(isinstance(figure, (int, float)) for figure in figures):
                return None
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return None
        if not (self._folder / self.picture(place, setting)).is_file():
            return None
        return {**values, "scores": scores}

    def cells(
        self, place: ClipPlace, measured: dict[Setting | None, Found]
    ) -> Iterator[Cell | Failure]:
        """What was measured, made into figures."""
        for setting, values in measured.items():
            if isinstance(values, Failure):
                yield values
            elif setting is not None:
                yield self._cell(place, setting, values)

    def _cell(self, place: ClipPlace, setting: Setting, values: dict[str, Any]) -> Cell:
        clip = place.clip
        seconds, frame_bytes = values["encode_seconds"], values["frame_bytes"]
        rate = clip.frames / clip_seconds(clip)
        return Cell(
            setting=setting,
            encode_seconds=seconds,
            encode_cpu_seconds=values["encode_cpu_seconds"],
            decode_fps=clip.frames / max(1e-9, values["decode_cpu_seconds"]),
            size=values["size"],
            frame_bytes=frame_bytes,
            kbps=frame_bytes * rate * 8 / 1000,
            encode_fps=clip.frames / max(1e-9, seconds),
            scores=values["scores"],
            picture=self.picture(place, setting),
            whole_bytes=frame_bytes * clip.source_frames,
            whole_seconds=seconds / clip.frames * clip.source_frames,
            machine=str(values.get("machine", "")),
        )
