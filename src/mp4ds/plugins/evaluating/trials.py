"""Tries settings on clips, each in its own process, and keeps the measurements."""

from __future__ import annotations

import hashlib
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from mp4ds._version import __version__
from mp4ds.errors import EncoderRefusedError, Mp4dsError
from mp4ds.files.outputs import is_seen, write_synced
from mp4ds.packing.engine import Engine, ProcessEngine, serve
from mp4ds.plugins.evaluating.clips import TICKS, Clip
from mp4ds.plugins.evaluating.options import Setting
from mp4ds.plugins.evaluating.results import Cell
from mp4ds.video.codecs import Recipe, recipe_for
from mp4ds.video.encoder import VideoEncoder, tool_versions
from mp4ds.video.images import png_file
from mp4ds.video.libvmaf import Ffmpeg, find_ffmpeg
from mp4ds.video.planes import PLANES_FORMAT, Planes, decoded_planes, packet_sizes, rgb_of
from mp4ds.video.scores import Scorer, ScoreSummary

CELLS, PICTURES = "cells", "pictures"
"""The folders of an evaluation for measurements, and for the details shown."""

Found = Cell | dict[str, ScoreSummary] | str
"""The measurements of a setting; for the clip as it is, its scores; or why there are none."""

_ENLARGED = 2
_NO_VMAF = "none"
_DIGITS = 12  # of a digest in a name


@dataclass(frozen=True)
class Trial:
    """A setting to try on a clip.

    Attributes:
        camera: Name of the camera, for names of files.
        clip: The clip.
        setting: How to encode; None: score the clip against itself, which gives its ceiling.
        threads: Of the encoder and of libvmaf.
        versions: The versions to use; see `versions_of`.
        work: The folder with the files of the clip.
        output: The folder of the evaluation.
    """

    camera: str
    clip: Clip
    setting: Setting | None
    threads: int
    versions: dict[str, str]
    work: Path
    output: Path

    @property
    def name(self) -> str:
        """Name of its files: the same for the same measurement, in another run too."""
        key = _TRIAL.dump_json(self, exclude={"work", "output"})
        what = self.setting.name.replace(" ", "-") if self.setting else "original"
        return f"{self.camera}-{what}-{hashlib.sha256(key).hexdigest()[:_DIGITS]}"

    @property
    def picture(self) -> str:
        """Name of the PNG file of the detail, in the folder of the evaluation."""
        return f"{PICTURES}/{self.name}.png"

    def found(self) -> Found | None:
        """What was found; None if it is not all there."""
        try:
            found = _FOUND.validate_json((self.output / CELLS / f"{self.name}.json").read_bytes())
        except (OSError, ValidationError):
            return None
        is_shown = isinstance(found, str) or (self.output / self.picture).is_file()
        is_right = isinstance(found, dict) == (self.setting is None)
        return found if is_right and is_shown else None

    def keep(self, found: Found) -> None:
        """Keep what was found.

        Raises:
            OSError: It cannot be written.
        """
        text = _FOUND.dump_json(found, indent=1)
        write_synced(self.output / CELLS / f"{self.name}.json", text)


_FOUND: TypeAdapter[Found] = TypeAdapter(Found)
_TRIAL = TypeAdapter(Trial)


def try_out(
    trials: Sequence[Trial], engine: Engine, on_done: Callable[[int], None] = lambda _: None
) -> Iterator[tuple[Trial, Found, bool]]:
    """Run trials, except for those with existing results.

    Args:
        trials: Different ones.
        engine: Runs them.
        on_done: Called with the number of trials done.

    Yields:
        Each in turn, what was found, and whether that was before.

    Raises:
        ClusterError: The cluster does not answer, or was lost.
    """
    known: dict[str, Found] = {}
    tasks: dict[tuple[str, ...], Trial] = {}
    for trial in trials:
        if found := trial.found():
            known[trial.name] = found
            continue
        job = trial.work / f"{trial.name}.job"
        write_synced(job, _TRIAL.dump_json(trial))
        tasks[(str(job),)] = trial
    on_done(len(known))
    new: dict[str, Found] = {}
    with closing(engine.run(list(tasks), lambda *_: None)) as outcomes:
        for outcome in outcomes:
            trial = tasks[outcome.task]
            new[trial.name] = outcome.error[1] if outcome.error else _seen(trial)
            on_done(len(known) + len(new))
    for trial in trials:
        yield trial, (known | new)[trial.name], trial.name in known


def _seen(trial: Trial) -> Found:
    folder = trial.output / CELLS
    is_seen(lambda: trial.found() is not None, folder, trial.output / PICTURES)
    missing = f"its result did not appear in {folder}; all machines must share this folder."
    return trial.found() or missing


# ---------------------------------------------------------------- in a process


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


def plain_recipe(clip: Clip) -> Recipe:
    """One that says how the colours of a clip are coded."""
    return recipe_for(clip.picture_format, lossless=False, crf=1)


def run(trial: Trial) -> None:
    """Encode, decode, score, and keep what was found.

    Raises:
        Mp4dsError: Different versions are installed here, or libvmaf failed.
        OSError: It cannot be written.
    """
    ffmpeg = None if trial.versions["vmaf"] == _NO_VMAF else find_ffmpeg()
    _check_versions(versions_of(ffmpeg), trial.versions)
    found: Found
    with (
        closing(trial.clip.open(trial.work)) as frames,
        tempfile.TemporaryDirectory(dir=trial.work) as folder,
    ):
        if trial.setting is None:
            figures, recipe = {}, plain_recipe(trial.clip)
            decoded: Iterable[Planes] = frames
        else:
            codec, preset, crf = trial.setting.codec, trial.setting.preset, trial.setting.crf
            form = trial.clip.picture_format
            recipe = recipe_for(form, lossless=False, codec=codec, crf=crf, preset=preset)
            video = Path(folder, "video.mp4")
            try:
                figures = _encoded(trial, trial.setting, recipe, video)
            except EncoderRefusedError as error:
                trial.keep(str(error))
                return
            decoded = decoded_planes(video)
        shown: list[Planes] = []

        def watched() -> Iterator[Planes]:
            for number, planes in enumerate(decoded):
                if number == trial.clip.detail_frame:
                    y, u, v = (plane.copy() for plane in trial.clip.detail_of(planes))
                    shown.append((y, u, v))
                yield planes

        found = Scorer(ffmpeg, threads=trial.threads).score(frames, watched()).summaries()
    if trial.setting is not None:
        found = Cell(setting=trial.setting, scores=found, picture=trial.picture, **figures)
    rgb = rgb_of(shown[0], recipe).repeat(_ENLARGED, axis=0).repeat(_ENLARGED, axis=1)
    write_synced(trial.output / trial.picture, png_file(rgb))
    trial.keep(found)


def _check_versions(here: dict[str, str], wanted: dict[str, str]) -> None:
    others = [
        f"{name} {here.get(name, 'none')} instead of {version}"
        for name, version in wanted.items()
        if here.get(name) != version
    ]
    if others:
        raise Mp4dsError(
            f"versions differ between machines: {', '.join(others)}. Install the same."
        )


def _encoded(trial: Trial, setting: Setting, recipe: Recipe, video: Path) -> dict[str, Any]:
    """Encode the clip as `mp4ds pack` does, and decode it; returns the figures of a `Cell`."""
    clip = trial.clip
    ticks = np.load(trial.work / TICKS).tolist()
    with closing(clip.open(trial.work)) as frames:
        for _ in frames:
            pass  # so that the encoder does not wait for a disk or network
        wall, cpu = time.perf_counter(), time.process_time()
        with VideoEncoder(
            video,
            recipe,
            picture_format=PLANES_FORMAT,
            width=frames.width,
            height=frames.height,
            gop=setting.gop,
            threads=trial.threads,
            rate=clip.rate,
        ) as encoder:
            for planes, tick in zip(frames, ticks, strict=True):
                encoder.write(planes, tick)
    seconds, encoded = time.perf_counter() - wall, time.process_time()
    for _ in decoded_planes(video):
        pass
    decode_seconds = time.process_time() - encoded
    sizes = packet_sizes(video)
    frame_bytes = sizes.frame_bytes(setting.gop)
    return {
        "encode_seconds": seconds,
        "encode_cpu_seconds": encoded - cpu,
        "encode_fps": clip.frames / max(1e-9, seconds),
        "decode_fps": clip.frames / max(1e-9, decode_seconds),
        "size": sizes.total,
        "frame_bytes": frame_bytes,
        "kbps": frame_bytes * clip.frames / clip.seconds * 8 / 1000,
        "whole_bytes": frame_bytes * clip.source_frames,
        "whole_seconds": seconds / clip.frames * clip.source_frames,
        "machine": socket.gethostname(),
    }


def _outcome(job: str) -> dict[str, Any]:
    try:
        run(_TRIAL.validate_json(Path(job).read_bytes()))
    except MemoryError:
        return {"error": ("MemoryError", "out of memory; try fewer `jobs` or `frames`")}
    except (Mp4dsError, OSError) as error:
        return {"error": (type(error).__name__, str(error))}
    return {"done": True}


if __name__ == "__main__":
    serve(_outcome)
