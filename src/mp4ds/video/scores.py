"""How much decoded frames differ from their originals: VMAF, PSNR and SSIM of each frame.

PSNR and SSIM are computed here. VMAF is computed by libvmaf in an ffmpeg process: that of the
optional package imageio-ffmpeg, or one on the PATH.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import ScoringError

Plane = NDArray[Any]
"""Samples of one plane, uint8 or uint16, shape (rows, columns)."""

MAX_PSNR = {8: 60.0, 10: 72.0}
"""PSNR of identical planes by bits of a sample, dB: libvmaf's bound, so that it is a number."""

_WEIGHTS = (0.01, 0.03)  # of the constants that keep SSIM's quotients from 0 / 0
_BLOCK = 4  # side of the blocks of which four make a window


def psnr(reference: Plane, decoded: Plane, *, bits: int = 8) -> float:
    """Peak signal-to-noise ratio of a plane, dB, at most `MAX_PSNR`.

    Args:
        reference: The original.
        decoded: Of the same shape and type.
        bits: Of a sample: 8 or 10.
    """
    difference = reference.astype(np.int32) - decoded
    error = float(np.mean(np.square(difference, dtype=np.int64)))
    if not error:
        return MAX_PSNR[bits]
    peak = 2**bits - 1
    return min(10 * float(np.log10(peak * peak / error)), MAX_PSNR[bits])


def ssim(reference: Plane, decoded: Plane, *, bits: int = 8) -> float:
    """Structural similarity of a plane: 1 where both are the same.

    The mean over windows of 8 x 8 samples at steps of 4, as in ffmpeg's ssim.

    Args:
        reference: The original, at least 8 samples high and wide.
        decoded: Of the same shape and type.
        bits: Of a sample: 8 or 10.
    """
    rows, columns = (side // _BLOCK * _BLOCK for side in reference.shape)
    # without incomplete blocks, and of integers wide enough for squares
    a, b = (plane[:rows, :columns].astype(np.int64) for plane in (reference, decoded))
    sum_a, sum_b = _window_sums(a), _window_sums(b)
    squares = _window_sums(a * a + b * b)
    products = _window_sums(a * b)
    count = (2 * _BLOCK) ** 2
    peak = 2**bits - 1
    # of sums over a window instead of means: by its count, or its count and count - 1
    c1 = int((_WEIGHTS[0] * peak) ** 2 * count + 0.5)
    c2 = int((_WEIGHTS[1] * peak) ** 2 * count * (count - 1) + 0.5)
    sums = sum_a * sum_a + sum_b * sum_b
    variances = count * squares - sums
    covariance = count * products - sum_a * sum_b
    luminance = (2.0 * sum_a * sum_b + c1) / (sums + c1)
    structure = (2.0 * covariance + c2) / (variances + c2)
    return float(np.mean(luminance * structure))


def _window_sums(values: NDArray[np.int64]) -> NDArray[np.int64]:
    rows, columns = values.shape
    blocks = values.reshape(rows // _BLOCK, _BLOCK, columns // _BLOCK, _BLOCK).sum(axis=(1, 3))
    pairs = blocks[:, :-1] + blocks[:, 1:]
    found: NDArray[np.int64] = pairs[:-1] + pairs[1:]
    return found


# ---------------------------------------------------------------- scores

METRICS = ("vmaf", "psnr_y", "psnr_cb", "psnr_cr", "ssim")
"""What is scored: VMAF 0 to 100, PSNR of each plane in dB, SSIM of the luma."""


@dataclass(frozen=True, slots=True)
class ScoreSummary:
    """A summary of the scores of a clip's frames.

    Attributes:
        mean: Arithmetic mean.
        harmonic_mean: As in libvmaf, of the scores plus 1, minus 1: bad frames weigh more.
        percentile_5: 5 % of the frames are worse.
        minimum: Of the worst frame.
    """

    mean: float
    harmonic_mean: float
    percentile_5: float
    minimum: float


def summary_of(values: NDArray[np.float64]) -> ScoreSummary:
    """Summarise the scores of frames.

    Args:
        values: One per frame, at least one; none below -1.
    """
    return ScoreSummary(
        mean=float(np.mean(values)),
        harmonic_mean=float(1 / np.mean(1 / (values + 1)) - 1),
        percentile_5=float(np.percentile(values, 5)),
        minimum=float(np.min(values)),
    )


# ---------------------------------------------------------------- libvmaf

VMAF_MODEL = "vmaf_v0.6.1"
"""For a screen of 1080 rows. That for 4K is not used, whatever the size: scores of cameras of
different sizes would not compare."""

_ASK_SECONDS = 30
_END_SECONDS = 5
_LOG = "vmaf.json"
_MISSING = (
    "VMAF needs an ffmpeg with libvmaf. Install one with pip install 'mp4ds[vmaf]', or put one "
    "on the PATH"
)


def find_ffmpeg() -> str:
    """Find an ffmpeg with libvmaf: the one of the package imageio-ffmpeg, or one on the PATH.

    Raises:
        ScoringError: There is none; says how to get one.
    """
    for path in (_packaged(), shutil.which("ffmpeg")):
        # options of libvmaf 2 and later; older ones need the models as files
        if path and re.search(r"(?m)^ +model +<string>", _ask(path, "-h", "filter=libvmaf")):
            return path
    raise ScoringError(f"{_MISSING}.")


def ffmpeg_version(path: str) -> str:
    """The version of an ffmpeg, as it reports it."""
    first = _ask(path, "-version").partition("\n")[0]
    found = re.match(r"ffmpeg version (\S+)", first)
    return found[1] if found else first


def _packaged() -> str | None:
    # it may not be installed, or have no program for this machine
    with suppress(ImportError, RuntimeError):
        import imageio_ffmpeg

        return str(imageio_ffmpeg.get_ffmpeg_exe())
    return None


def _ask(path: str, *arguments: str) -> str:
    with suppress(OSError, subprocess.TimeoutExpired):
        done = subprocess.run(
            [path, "-hide_banner", *arguments],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=_ASK_SECONDS,
            check=False,
        )
        return done.stdout.decode(errors="replace")
    return ""


class VmafProcess:
    """An ffmpeg that scores the frames written to it. A context manager, which ends it.

    Args:
        path: The program.
        width: Columns of a frame, even.
        height: Rows of a frame, even.
        pixel_format: ``yuv420p`` or ``yuv420p10le``.
        threads: For libvmaf.

    Raises:
        ScoringError: It cannot be started.
    """

    def __init__(
        self, path: str, *, width: int, height: int, pixel_format: str, threads: int
    ) -> None:
        # one picture with the decoded frame over its original: one pipe, and no frame goes astray
        graph = (
            f"[0:v]split[above][below];[above]crop={width}:{height}:0:0:exact=1[decoded];"
            f"[below]crop={width}:{height}:0:{height}:exact=1[reference];"
            f"[decoded][reference]libvmaf=model=version={VMAF_MODEL}:n_threads={threads}"
            f":log_fmt=json:log_path={_LOG}"
        )
        size = f"{width}x{2 * height}"
        command = [
            *(path, "-hide_banner", "-loglevel", "error"),
            *("-f", "rawvideo", "-pix_fmt", pixel_format, "-video_size", size),
            *("-framerate", "25", "-i", "pipe:0", "-filter_complex", graph, "-f", "null", "-"),
        ]
        self._temporary = tempfile.TemporaryDirectory(prefix="mp4ds-")
        self._folder = Path(self._temporary.name)
        with (self._folder / "stderr").open("wb") as stderr:
            try:
                self._process: Any = subprocess.Popen(
                    command,
                    cwd=self._folder,  # a name without a path needs no escapes in a filter
                    stdin=subprocess.PIPE,
                    stdout=subprocess.DEVNULL,
                    stderr=stderr,
                    start_new_session=True,  # Ctrl-C is for the one that ends it
                )
            except OSError as error:
                self._temporary.cleanup()
                raise ScoringError(f"{path} cannot be run: {error.strerror}.") from None

    def write(self, reference: tuple[NDArray[Any], ...], decoded: tuple[NDArray[Any], ...]) -> None:
        """Write the next frame and its original.

        Raises:
            ScoringError: It has ended; says with what.
        """
        try:
            for above, below in zip(decoded, reference, strict=True):
                for plane in (above, below):
                    self._process.stdin.write(np.ascontiguousarray(plane).data)
        except OSError:
            raise self._failure() from None

    def finish(self) -> NDArray[np.float64]:
        """VMAF of each frame, after the last one.

        Raises:
            ScoringError: It failed; says with what.
        """
        try:
            self._process.stdin.close()
            if not self._process.wait():
                log = json.loads((self._folder / _LOG).read_bytes())
                return np.array([frame["metrics"]["vmaf"] for frame in log["frames"]], np.float64)
        except (OSError, ValueError, KeyError, TypeError):
            pass
        raise self._failure()

    def _failure(self) -> ScoringError:
        code = self._process.wait()
        lines = (self._folder / "stderr").read_text(errors="replace").strip().splitlines()
        said = f": {lines[-1].strip()}" if lines else ""
        return ScoringError(f"libvmaf failed (code {code}){said}.")

    def __enter__(self) -> VmafProcess:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError):
            self._process.stdin.close()
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(_END_SECONDS)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._temporary.cleanup()


# ---------------------------------------------------------------- scoring

YuvFrame = tuple[NDArray[Any], NDArray[Any], NDArray[Any]]
"""Luma and two chroma planes of half its width and height: uint8, or uint16 with 10 bits used."""

_FORMATS = {np.dtype(np.uint8): ("yuv420p", 8), np.dtype(np.uint16): ("yuv420p10le", 10)}
SMALLEST = 16
"""Samples of a side; libvmaf and SSIM cannot score less."""


# metric -> how it is measured, and of which plane
_OF_PLANES: Mapping[str, tuple[Callable[..., float], int]] = {
    "psnr_y": (psnr, 0),
    "psnr_cb": (psnr, 1),
    "psnr_cr": (psnr, 2),
    "ssim": (ssim, 0),
}


def scores_of(
    reference: Iterable[YuvFrame],
    decoded: Iterable[YuvFrame],
    metrics: Sequence[str] = METRICS,
    *,
    ffmpeg: str | None = None,
    threads: int = 1,
    before: YuvFrame | None = None,
) -> dict[str, NDArray[np.float64]]:
    """Compare each frame with its original; only one pair is in memory at a time.

    Args:
        reference: The originals, at least one, all of one size, with even width and height.
        decoded: As many frames, of the same size and type.
        metrics: Some of `METRICS`.
        ffmpeg: From `find_ffmpeg`; None: VMAF is left out.
        threads: Of libvmaf.
        before: The original before the first one, for libvmaf's motion feature: without it, the
            first frame counts as still and scores lower.

    Returns:
        Scores of each frame by metric, shape (frames,).

    Raises:
        ScoringError: They are too small, or libvmaf failed.
    """
    pairs = zip(reference, decoded, strict=True)
    first = next(pairs)
    (height, width), (pixel_format, bits) = first[0][0].shape, _FORMATS[first[0][0].dtype]
    if min(height, width) < SMALLEST:
        raise ScoringError(
            f"Frames of {width}x{height} are not scored: sides are {SMALLEST} or more."
        )
    by_plane = [name for name in metrics if name in _OF_PLANES]
    measured: list[list[float]] = []
    with ExitStack() as stack:
        process = None
        if ffmpeg is not None and "vmaf" in metrics:
            opened = VmafProcess(
                ffmpeg, width=width, height=height, pixel_format=pixel_format, threads=threads
            )
            process = stack.enter_context(opened)
            if before is not None:
                process.write(before, before)
        for original, made in chain([first], pairs):
            if process is not None:
                process.write(original, made)
            measures = (_OF_PLANES[name] for name in by_plane)
            measured.append([one(original[at], made[at], bits=bits) for one, at in measures])
        vmaf = process.finish()[before is not None :] if process is not None else None
    found = dict(zip(by_plane, np.array(measured, np.float64).T, strict=True))
    if vmaf is None:
        return found
    if len(vmaf) != len(measured):
        raise ScoringError(f"libvmaf scored {len(vmaf)} of {len(measured)} frames.")
    return {"vmaf": vmaf, **found}
