"""One setting tried on one clip, in a process of its own, so that its CPU time is its own.

``python -m mp4ds.evaluating.work JOB`` reads what to do from a file, and writes what it measured
into another one, which appears when it is whole.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mp4ds.errors import Mp4dsError
from mp4ds.evaluating.clips import ClipFile, detail_of
from mp4ds.evaluating.options import Setting
from mp4ds.outputs import write_synced
from mp4ds.scoring import Ffmpeg, Scorer, Scores
from mp4ds.video import Recipe, VideoEncoder, recipe_for
from mp4ds.video.planes import (
    PLANES_FORMAT,
    Planes,
    decoded_planes,
    packet_sizes,
    rgb_of,
)
from mp4ds.video.stills import png_file

_ENLARGED = 2


@dataclass(frozen=True, slots=True)
class Trial:
    """What a process is to do.

    Attributes:
        clip: File of the clip.
        result: File to make.
        picture: PNG file to make of the detail.
        setting: How to encode; None: the clip is scored as it is, which is its ceiling.
        threads: Of the encoder and of libvmaf.
        ffmpeg: What computes VMAF; None: it is left out.
    """

    clip: str
    result: str
    picture: str
    setting: Setting | None
    threads: int
    ffmpeg: str | None

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


def run(trial: Trial) -> None:
    """Encode, decode, score, and write what was measured.

    Raises:
        Mp4dsError: The encoder does not take such frames, or libvmaf failed.
        OSError: The disk refused.
    """
    clip = ClipFile(Path(trial.clip))
    measured: dict[str, Any] = {}
    if trial.setting is None:
        scores, shown = _scored(trial, clip, iter(clip))
        recipe = _recipe(clip, Setting("av1", "8", 1))
    else:
        recipe = _recipe(clip, trial.setting)
        video = Path(trial.result).with_suffix(".mp4")
        try:
            measured = _encoded(clip, recipe, trial, video)
            scores, shown = _scored(trial, clip, decoded_planes(video))
        finally:
            video.unlink(missing_ok=True)
    measured["scores"] = {name: asdict(value) for name, value in scores.summaries().items()}
    write_synced(Path(trial.picture), _picture(shown, recipe))
    write_synced(Path(trial.result), json.dumps(measured, indent=1).encode())


def _recipe(clip: ClipFile, setting: Setting) -> Recipe:
    return recipe_for(
        clip.clip.picture_format,
        lossless=False,
        codec=setting.codec,
        crf=setting.crf,
        preset=setting.preset,
    )


def _encoded(clip: ClipFile, recipe: Recipe, trial: Trial, video: Path) -> dict[str, Any]:
    """Encode the clip as `mp4ds pack` does, and decode it; what that took."""
    facts, gop = clip.clip, trial.setting.gop if trial.setting else 1
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


def _scored(trial: Trial, clip: ClipFile, frames: Iterator[Planes]) -> tuple[Scores, Planes]:
    """The scores of frames, and the detail of one of them."""
    shown: list[Planes] = []

    def watched() -> Iterator[Planes]:
        for number, planes in enumerate(frames):
            if number == clip.clip.detail_frame:
                y, u, v = (plane.copy() for plane in detail_of(planes, clip.clip))
                shown.append((y, u, v))
            yield planes

    ffmpeg = Ffmpeg(trial.ffmpeg) if trial.ffmpeg else None
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
