"""One setting tried on one clip, in a process of its own, so that its CPU time is its own.

``python -m mp4ds.evaluating.work JOB`` reads what to do from a file, and writes what it measured
into another one, which appears when it is whole. A trial may be run twice at the same time, as it
is when a cluster takes its worker for lost: results are the same but for the times.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mp4ds._version import __version__
from mp4ds.engine import ProcessEngine
from mp4ds.errors import Mp4dsError
from mp4ds.evaluating.clips import Clip, ClipFile, detail_of
from mp4ds.evaluating.options import Setting
from mp4ds.outputs import write_synced
from mp4ds.scoring import Ffmpeg, Scorer, Scores, find_ffmpeg, vmaf_bytes
from mp4ds.video import Recipe, VideoEncoder, encoder_bytes, recipe_for, tool_versions
from mp4ds.video.encoder import EncoderRefusedError
from mp4ds.video.planes import (
    PLANES_FORMAT,
    Planes,
    decoded_planes,
    packet_sizes,
    rgb_of,
)
from mp4ds.video.stills import png_file

REFUSED = "refused"
"""Key of a result that says why the encoder does not take such frames."""

_ENLARGED = 2
_NO_VMAF = "none"
_PROCESS_BYTES = 200 * 2**20  # the interpreter, libraries, and frames that are compared


@dataclass(frozen=True, slots=True)
class Trial:
    """What a process is to do.

    Attributes:
        clip: File of the clip.
        result: File to make.
        picture: PNG file to make of the detail.
        setting: How to encode; None: the clip is scored as it is, which is its ceiling.
        threads: Of the encoder and of libvmaf.
        versions: What it is to be tried with; see `versions_of`.
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
        """What `to_json` made."""
        values = json.loads(text)
        setting = values.pop("setting")
        return cls(setting=Setting(**setting) if setting else None, **values)


def command(task: tuple[str, ...]) -> list[str]:
    """The command line that runs a task: the file of a `Trial`."""
    return [sys.executable, "-m", "mp4ds.evaluating.work", *task]


def run_task(job: str) -> None:
    """Run a task on a worker of a cluster, in a process of its own as on this machine.

    Args:
        job: The file of a `Trial`.

    Raises:
        Mp4dsError: It failed; says why.
    """
    if not Path(job).is_file():
        raise Mp4dsError(
            f"{job} is not there: all machines must share the folder of the evaluation."
        )
    for outcome in ProcessEngine(command, 1).run([(job,)], lambda *_: None):
        if outcome.error is not None:
            raise Mp4dsError(outcome.error[1])


def task_bytes(clip: Clip, settings: Sequence[Setting | None], threads: int) -> int:
    """Upper estimate of the memory of the largest of some trials.

    Args:
        clip: What they encode.
        settings: How.
        threads: Of the encoder and of libvmaf.
    """
    size = clip.width, clip.height
    encoders = [encoder_bytes(_recipe(clip, item), *size, threads) for item in settings if item]
    # what an encoder took is not all given back before frames are scored
    return _PROCESS_BYTES + max(encoders, default=0) + vmaf_bytes(*size, threads)


def versions_of(ffmpeg: Ffmpeg | None) -> dict[str, str]:
    """Versions of what makes videos and scores here: with others, results may be others.

    Args:
        ffmpeg: What computes VMAF; None: nothing.
    """
    vmaf = ffmpeg.version if ffmpeg else _NO_VMAF
    return {**tool_versions(), "mp4ds": __version__, "vmaf": vmaf}


def run(trial: Trial) -> None:
    """Encode, decode, score, and write what was measured.

    Raises:
        Mp4dsError: Other versions are installed here, or libvmaf failed.
        OSError: The disk refused.
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
    """What computes VMAF here.

    Raises:
        Mp4dsError: Versions are not those that were asked for, or there is no libvmaf.
    """
    ffmpeg = None if versions["vmaf"] == _NO_VMAF else find_ffmpeg()
    here = versions_of(ffmpeg)
    others = [
        f"{name} {here.get(name, 'none')} instead of {version}"
        for name, version in versions.items()
        if here.get(name) != version
    ]
    if others:
        raise Mp4dsError(f"there are other versions: {', '.join(others)}. Install the same.")
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
    """Encode the clip as `mp4ds pack` does, and decode it; what that took."""
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
    """Nobody waits for the result any more: what is written under a final name is whole."""
    while os.read(sys.stdin.fileno(), 4096):
        pass
    os._exit(1)


def _main() -> None:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        run(Trial.from_json(Path(sys.argv[1]).read_bytes()))
    except MemoryError:
        _tell({"error": ("MemoryError", "out of memory; try fewer --jobs or --frames")})
    except (Mp4dsError, OSError) as error:
        _tell({"error": (type(error).__name__, str(error))})
    else:
        _tell({"done": True})


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError):
        _main()
