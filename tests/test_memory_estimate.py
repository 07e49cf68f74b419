"""The estimate of an encoder's memory against what encoders take, in processes of their own."""

from __future__ import annotations

import itertools
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from each import each
from mp4ds.errors import OptionError
from mp4ds.messages.arrangements import CHROMA_SHIFTS
from mp4ds.video.codecs import Recipe, recipe_for
from mp4ds.video.trial import encoder_bytes, svt_level

BENCHMARK = Path(__file__).parents[1] / "benchmarks" / "encoder_memory.py"
MEASURED = [  # case, threads, frames that fill what the encoder looks ahead
    ("x264 gray", 1, 16),
    ("x264 rgb", 8, 16),
    ("ffv1 rgb", 2, 8),
    ("svt 8", 2, 120),
    ("x264 medium", 2, 70),
    ("x265 medium", 1, 40),
]
MEASURED_SLOWLY = [
    *((f"x264 {kind}", 8, 30) for kind in ("gray", "gray10", "4:2:0", "4:2:2", "4:4:4")),
    *((f"x265 {kind}", 4, 40) for kind in ("gray10", "gray12", "medium")),
    *((f"ffv1 {kind}", 1, 12) for kind in ("gray", "gray10", "gray16", "4:2:0", "rgba")),
    *((f"ffv1 {kind}", 4, 12) for kind in ("gbr10", "gbr16", "gbra16")),
    ("svt 4", 1, 120),
    ("svt 6", 4, 160),
    ("x264 slow", 1, 90),
]
WIDTH, HEIGHT = 640, 480
MACHINES = 4_000_000  # bytes by which machines differ, whatever the pictures

ASKED = {  # codec, picture format, lossless, preset
    "x264 gray": ("h264", "gray", True, None),
    "x264 gray10": ("h264", "gray10le", True, None),
    "x264 4:2:0": ("h264", "yuv420p", True, None),
    "x264 4:2:2": ("h264", "yuv422p", True, None),
    "x264 4:4:4": ("h264", "yuv444p", True, None),
    "x264 rgb": ("h264", "rgb24", True, None),
    "x264 medium": ("h264", "rgb24", False, "medium"),
    "x264 slow": ("h264", "rgb24", False, "slow"),
    "x265 gray10": ("h265", "gray10le", True, None),
    "x265 gray12": ("h265", "gray12le", True, None),
    "x265 medium": ("h265", "rgb24", False, "medium"),
    "ffv1 gray": ("ffv1", "gray", True, None),
    "ffv1 gray10": ("ffv1", "gray10le", True, None),
    "ffv1 gray16": ("ffv1", "gray16le", True, None),
    "ffv1 4:2:0": ("ffv1", "yuv420p", True, None),
    "ffv1 rgb": ("ffv1", "rgb24", True, None),
    "ffv1 rgba": ("ffv1", "rgba", True, None),
    "ffv1 gbr10": ("ffv1", "gbrp10le", True, None),
    "ffv1 gbr16": ("ffv1", "gbrp16le", True, None),
    "ffv1 gbra16": ("ffv1", "gbrap16le", True, None),
    "svt 4": ("av1", "rgb24", False, "4"),
    "svt 6": ("av1", "rgb24", False, "6"),
    "svt 8": ("av1", "rgb24", False, "8"),
    "svt 6, 10 bits": ("av1-10bit", "rgb24", False, "6"),
}

GRAYS = [f"gray{bits}le" for bits in (10, 12, 14, 16)]
PLANAR = [f"gbr{a}p{bits}le" for a in ("", "a") for bits in (10, 12, 14, 16)]
FORMATS = ["gray", *GRAYS, "rgb24", "bgr24", "rgba", "bgra", *PLANAR, *CHROMA_SHIFTS]
X26X = ["ultrafast", "superfast", "veryfast", "faster", "fast", "medium", "slow", "slower"]
PRESETS = {  # from the one that keeps the least to the one that keeps the most
    "h264": [*X26X, "veryslow"],
    "h265": [*X26X, "veryslow"],
    "av1": [str(number) for number in range(13, -1, -1)],
    "av1-10bit": [str(number) for number in range(13, -1, -1)],
    "ffv1": [],
}


def recipe(codec: str, picture_format: str, lossless: bool, preset: str | None) -> Recipe | None:
    try:
        return recipe_for(
            picture_format,
            lossless=lossless,
            codec=codec,
            crf=None if lossless else 20,
            preset=preset,
        )
    except OptionError:
        return None


def recipes() -> Iterator[Any]:
    for codec, picture_format, lossless in itertools.product(PRESETS, FORMATS, (True, False)):
        for preset in (None, *PRESETS[codec]):
            if found := recipe(codec, picture_format, lossless, preset):
                kind = "lossless" if lossless else "lossy"
                name = f"{codec}-{picture_format}-{kind}-{preset or 'default'}"
                yield pytest.param(found, id=name)


def measured(case: str, threads: int, frames: int) -> int:
    """Bytes of the resident memory's peak above what there was before the encoder."""
    asked = {"name": case, "size": [WIDTH, HEIGHT], "threads": threads, "frames": frames}
    asked |= {"gop": 60, "noise": 1.0}
    command = [sys.executable, str(BENCHMARK), "--child", json.dumps(asked)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return int(json.loads(done.stdout.splitlines()[-1])["peak"])


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@each(
    ("case", "threads", "frames"),
    [*MEASURED, *(pytest.param(*row, marks=pytest.mark.slow) for row in MEASURED_SLOWLY)],
    one_in=3,
)
def test_estimate_is_above_what_is_taken_but_not_far(case: str, threads: int, frames: int) -> None:
    found = recipe(*ASKED[case])
    assert found
    estimate = encoder_bytes(found, WIDTH, HEIGHT, threads=threads)
    taken = measured(case, threads, frames)
    assert taken <= estimate <= 1.6 * taken + MACHINES


@each("found", list(recipes()))
def test_every_recipe_is_known_and_grows_with_pictures_and_threads(found: Recipe) -> None:
    sizes = [(1, 1), (64, 48), (640, 480), (2448, 2048), (8192, 8192)]
    for (width, height), threads in itertools.product(sizes, (1, 2, 8)):
        estimate = encoder_bytes(found, width, height, threads)
        assert estimate > 3 * width * height  # at least a picture, its coded form, and a reference
        assert estimate <= encoder_bytes(found, width, height, threads + 1)
        assert estimate < encoder_bytes(found, width + 16, height, threads)
        assert estimate < encoder_bytes(found, width, height + 16, threads)


@each(
    ("codec", "lossless"),
    [
        ("h264", True),
        ("h264", False),
        ("h265", True),
        ("h265", False),
        ("av1", False),
        ("av1-10bit", False),
    ],
)
def test_presets_that_keep_more_are_not_estimated_lower(codec: str, lossless: bool) -> None:
    for size in ((640, 480), (2448, 2048)):
        estimates = [
            encoder_bytes(found, *size, threads=1)
            for preset in PRESETS[codec]
            if (found := recipe(codec, "gray10le" if lossless else "rgb24", lossless, preset))
        ]
        assert estimates == sorted(estimates)
        assert lossless or estimates[0] < estimates[-1]


def test_more_bits_and_more_samples_take_more() -> None:
    def estimate(picture_format: str, codec: str = "ffv1") -> int:
        found = recipe(codec, picture_format, True, None)
        assert found
        return encoder_bytes(found, 1440, 1080, threads=1)

    ffv1 = [estimate(name) for name in ("gray", "gray10le", "gray16le", "gbrp16le", "gbrap16le")]
    h264 = [estimate(name, "h264") for name in ("gray", "yuv420p", "yuv422p", "yuv444p")]
    assert ffv1 == sorted(set(ffv1))
    assert h264 == sorted(set(h264))


def test_threads_beyond_the_highest_level_take_no_more_of_svt() -> None:
    found = recipe("av1", "rgb24", False, None)
    assert found
    estimates = [encoder_bytes(found, 1440, 1080, threads=threads) for threads in range(1, 9)]
    assert estimates[:6] == sorted(set(estimates[:6]))
    assert estimates[5:] == 3 * [estimates[5]]
    assert [svt_level(threads) for threads in (0, 1, 6, 7, 128)] == [1, 1, 6, 6, 6]


def test_workers_of_x265_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    found = recipe("h265", "rgb24", False, None)
    assert found
    estimates = []
    for cores in (1, 64, None):
        monkeypatch.setattr("os.cpu_count", lambda cores=cores: cores)
        estimates.append(encoder_bytes(found, 640, 480, threads=1))
    assert estimates[1] - estimates[0] == 63 * 6_000_000
    assert estimates[2] == estimates[0]
