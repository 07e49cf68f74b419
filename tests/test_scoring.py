"""Scores of frames, beside those of libraries that share no code with them."""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import stat
import subprocess
import sys
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from mp4ds.errors import ScoringError
from mp4ds.video.scores import (
    VMAF_MODEL,
    YuvFrame,
    find_ffmpeg,
    scores_of,
)
from waiting import WATCHDOG_S, until

FRAMES = 8
SIZES = [(64, 48), (160, 120), (322, 242)]

needs_vmaf = pytest.mark.skipif(
    importlib.util.find_spec("imageio_ffmpeg") is None, reason="needs imageio-ffmpeg"
)


def scene_of(rows: int, columns: int) -> NDArray[np.float64]:
    """Something like a wall: patches of all sizes with soft edges, 0 to 1."""
    rng = np.random.default_rng(1)
    found = np.zeros((rows, columns))
    for cells in (3, 9, 27, 81):
        coarse = rng.random((cells, cells))
        x, y = np.linspace(0, cells - 1, columns), np.linspace(0, cells - 1, rows)
        across = np.array([np.interp(x, np.arange(cells), line) for line in coarse])
        found += np.array([np.interp(y, np.arange(cells), line) for line in across.T]).T
    return found / 4


def clip(
    size: tuple[int, int], *, bits: int = 8, frames: int = FRAMES, noise: float = 0.0
) -> list[YuvFrame]:
    """A scene that moves; what noise there is differs from call to call of other strength."""
    columns, rows = size
    scene = scene_of(rows, columns + frames)
    rng = np.random.default_rng(int(noise * 1000) + 2)
    peak, kind = 2**bits - 1, np.uint8 if bits == 8 else np.uint16
    found: list[YuvFrame] = []
    for number in range(frames):
        luma = scene[:, number : number + columns]
        planes = [luma, luma[::2, ::2], 1 - luma[::2, ::2]]
        noisy = [plane + noise * rng.standard_normal(plane.shape) for plane in planes]
        y, u, v = (np.clip(plane * peak, 0, peak).astype(kind) for plane in noisy)
        found.append((y, u, v))
    return found


def raw(path: Path, frames: list[YuvFrame]) -> Path:
    path.write_bytes(b"".join(plane.tobytes() for frame in frames for plane in frame))
    return path


def pixel_format(bits: int) -> str:
    return "yuv420p" if bits == 8 else "yuv420p10le"


def filtered(
    program: str,
    folder: Path,
    decoded: Path,
    original: Path,
    size: tuple[int, int],
    bits: int,
    graph: str,
) -> None:
    """Run a filter of two videos in files, as its manual has it."""
    given = ["-f", "rawvideo", "-pix_fmt", pixel_format(bits), "-s", f"{size[0]}x{size[1]}"]
    command = [
        program, "-loglevel", "error",
        *given, "-i", str(decoded), *given, "-i", str(original),
        "-lavfi", graph, "-f", "null", "-",
    ]  # fmt: skip
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


# ---------------------------------------------------------------- against others


@needs_vmaf
@pytest.mark.parametrize("bits", [8, 10])
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_vmaf_is_that_of_files(size: tuple[int, int], bits: int, tmp_path: Path) -> None:
    """Frames go to libvmaf through pipes; here they are videos in files."""
    ours, original, made = find_ffmpeg(), clip(size, bits=bits), clip(size, bits=bits, noise=0.03)
    scores = scores_of(original, made, ffmpeg=ours)["vmaf"]
    files = raw(tmp_path / "made", made), raw(tmp_path / "original", original)
    graph = f"libvmaf=model=version={VMAF_MODEL}:log_fmt=json:log_path=log.json"
    filtered(ours, tmp_path, *files, size, bits, graph)
    frames = json.loads((tmp_path / "log.json").read_text())["frames"]
    theirs = np.array([frame["metrics"]["vmaf"] for frame in frames])
    assert 0 < scores.min() <= scores.max() < 100  # of neither bound
    assert np.abs(scores - theirs).max() < 0.01


@needs_vmaf
@pytest.mark.parametrize("bits", [8, 10])
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_psnr_and_ssim_are_those_of_ffmpeg(
    size: tuple[int, int], bits: int, tmp_path: Path
) -> None:
    original, made = clip(size, bits=bits), clip(size, bits=bits, noise=0.03)
    scores = scores_of(original, made)
    filtered(
        find_ffmpeg(), tmp_path,
        raw(tmp_path / "made", made), raw(tmp_path / "original", original), size, bits,
        "[0][1]psnr=stats_file=psnr.log[m];[m][1]ssim=stats_file=ssim.log",
    )  # fmt: skip
    for name, file, key, step in (
        ("psnr_y", "psnr", "psnr_y", 0.01),
        ("psnr_cb", "psnr", "psnr_u", 0.01),
        ("psnr_cr", "psnr", "psnr_v", 0.01),
        ("ssim", "ssim", "Y", 2e-6),
    ):
        lines = (tmp_path / f"{file}.log").read_text().splitlines()
        words = [dict(word.split(":") for word in line.split() if ":" in word) for line in lines]
        theirs = np.array([float(word[key]) for word in words])
        assert len(theirs) == FRAMES
        assert np.abs(scores[name] - theirs).max() <= step, name


# ---------------------------------------------------------------- what is scored


@needs_vmaf
def test_memory_is_that_of_a_few_frames() -> None:
    size, frames = (320, 240), 60
    frame_bytes = size[0] * size[1] * 3 // 2

    def generated(offset: int) -> Iterator[YuvFrame]:
        rng = np.random.default_rng(offset)
        for _ in range(frames):
            y = rng.integers(0, 255, (size[1], size[0]), np.uint8)
            yield y, y[::2, ::2], y[1::2, ::2]

    ours = find_ffmpeg()
    tracemalloc.start()
    try:
        scores_of(generated(1), generated(2), ffmpeg=ours)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < frames * frame_bytes  # SSIM alone needs some planes of 64 bits


# ---------------------------------------------------------------- what goes wrong


def program(folder: Path, script: str) -> str:
    path = folder / "ffmpeg"
    path.write_text(f"#!{sys.executable}\n{script}")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return str(path)


@pytest.mark.parametrize(
    ("script", "said"),
    [
        ("import sys; sys.exit('first\\nthe last line')", "the last line"),
        ("import sys; sys.stdin.buffer.read(); sys.exit('no such model')", "no such model"),
        ("import sys; sys.stdin.buffer.read()", "libvmaf failed"),
        ("", "cannot be run"),
        (
            "import sys; sys.stdin.buffer.read()\n"
            "open('vmaf.json', 'w').write('{\"frames\": [{\"metrics\": {\"vmaf\": 1}}]}')",
            "scored 1 of 8 frames",
        ),
    ],
)
def test_a_process_that_fails(script: str, said: str, tmp_path: Path) -> None:
    frames = clip((322, 242))  # more than a pipe holds
    ffmpeg = program(tmp_path, script) if script else str(tmp_path / "none")
    with pytest.raises(ScoringError, match=said):
        scores_of(frames, frames, ffmpeg=ffmpeg)


@pytest.mark.parametrize("on_path", [False, True])
def test_an_ffmpeg_without_libvmaf_is_not_taken(
    on_path: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    if on_path:
        program(tmp_path, "print(\"Unknown filter 'libvmaf'.\")")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ScoringError, match=r"pip install 'mp4ds\[vmaf\]'"):
        find_ffmpeg()


_ENDLESS = """
import itertools, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # where the tests are run in background
sys.path.insert(0, {tests!r})
from test_scoring import clip
from mp4ds.video.scores import find_ffmpeg, scores_of
ffmpeg = find_ffmpeg()
print("ready", flush=True)
frames = itertools.cycle(clip((64, 48)))
scores_of(frames, itertools.cycle(clip((64, 48))), ffmpeg=ffmpeg)
"""


def children_of(pid: int) -> list[int]:
    done = subprocess.run(
        ["ps", "-o", "pid=", "--ppid", str(pid)], capture_output=True, check=False
    )
    return [int(word) for word in done.stdout.split()]


@needs_vmaf
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="needs /proc")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_no_process_outlives_an_interrupted_one(number: signal.Signals) -> None:
    script = _ENDLESS.format(tests=str(Path(__file__).parent))
    with subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline().strip() == b"ready"
        children: list[int] = []
        until(lambda: children.extend(children_of(process.pid)) or children)
        os.kill(process.pid, number)
        try:
            process.wait(WATCHDOG_S)
        finally:
            process.kill()  # leaving waits for it
    until(lambda: not any(map(runs, children)))


def runs(pid: int) -> bool:
    try:
        return ") Z " not in Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False
