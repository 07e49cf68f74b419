"""Finding and running an ffmpeg that computes VMAF."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import ScoringError

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


@dataclass(frozen=True)
class Ffmpeg:
    """An ffmpeg that has libvmaf.

    Attributes:
        path: The program.
    """

    path: str

    @cached_property
    def version(self) -> str:
        """Its version, as it reports it."""
        first = _ask(self.path, "-version").partition("\n")[0]
        found = re.match(r"ffmpeg version (\S+)", first)
        return found[1] if found else first


def find_ffmpeg() -> Ffmpeg:
    """Find an ffmpeg with libvmaf: the one of the package imageio-ffmpeg, or one on the PATH.

    Raises:
        ScoringError: There is none; says how to get one.
    """
    for path in (_packaged(), shutil.which("ffmpeg")):
        if path and _can_score(path):
            return Ffmpeg(path)
    raise ScoringError(f"{_MISSING}.")


def _packaged() -> str | None:
    try:
        import imageio_ffmpeg
    except ImportError:
        return None
    with suppress(RuntimeError):  # it has no program for this machine
        return str(imageio_ffmpeg.get_ffmpeg_exe())
    return None


def _can_score(path: str) -> bool:
    # options of libvmaf 2 and later; older ones need the models as files
    return bool(re.search(r"^ +model +<string>", _ask(path, "-h", "filter=libvmaf"), re.MULTILINE))


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


@contextmanager
def scoring_process(
    ffmpeg: Ffmpeg, *, width: int, height: int, pixel_format: str, threads: int
) -> Iterator[VmafProcess]:
    """An ffmpeg that scores the frames written to it; it ends with the block.

    Args:
        ffmpeg: The program.
        width: Columns of a frame, even.
        height: Rows of a frame, even.
        pixel_format: ``yuv420p`` or ``yuv420p10le``.
        threads: For libvmaf.

    Raises:
        ScoringError: It cannot be started.
    """
    with tempfile.TemporaryDirectory(prefix="mp4ds-") as name:
        folder = Path(name)
        with (folder / "stderr").open("wb") as stderr:
            command = _command(ffmpeg.path, width, height, pixel_format, threads)
            try:
                process = subprocess.Popen(
                    command,
                    cwd=folder,  # a name without a path needs no escapes in a filter
                    stdin=subprocess.PIPE,
                    stdout=subprocess.DEVNULL,
                    stderr=stderr,
                    start_new_session=True,  # Ctrl-C is for the one that ends it
                )
            except OSError as error:
                raise ScoringError(f"{ffmpeg.path} cannot be run: {error.strerror}.") from None
            try:
                yield VmafProcess(process, folder)
            finally:
                _end(process)


def _command(path: str, width: int, height: int, pixel_format: str, threads: int) -> list[str]:
    # one picture with the decoded frame over its original: one pipe, and no frame goes astray
    graph = (
        f"[0:v]split[above][below];[above]crop={width}:{height}:0:0:exact=1[decoded];"
        f"[below]crop={width}:{height}:0:{height}:exact=1[reference];"
        f"[decoded][reference]libvmaf=model=version={VMAF_MODEL}:n_threads={threads}"
        f":log_fmt=json:log_path={_LOG}"
    )
    given = ["-f", "rawvideo", "-pix_fmt", pixel_format, "-video_size", f"{width}x{2 * height}"]
    return [
        *(path, "-hide_banner", "-loglevel", "error"),
        *given,
        *("-framerate", "25", "-i", "pipe:0", "-filter_complex", graph, "-f", "null", "-"),
    ]


def _end(process: subprocess.Popen[bytes]) -> None:
    """End it if it is still running."""
    with suppress(OSError):
        _input(process).close()
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(_END_SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _input(process: subprocess.Popen[bytes]) -> IO[bytes]:
    if process.stdin is None:
        raise ValueError("the process was started without a pipe")
    return process.stdin


class VmafProcess:
    """A running ffmpeg. See `scoring_process`."""

    def __init__(self, process: subprocess.Popen[bytes], folder: Path) -> None:
        self._process = process
        self._folder = folder

    def write(self, reference: tuple[NDArray[Any], ...], decoded: tuple[NDArray[Any], ...]) -> None:
        """Write the next frame and its original.

        Raises:
            ScoringError: It has ended; says with what.
        """
        try:
            for above, below in zip(decoded, reference, strict=True):
                for plane in (above, below):
                    _input(self._process).write(np.ascontiguousarray(plane).data)
        except OSError:
            self._process.wait()
            raise self._failure() from None

    def finish(self) -> NDArray[np.float64]:
        """VMAF of each frame, after the last one.

        Raises:
            ScoringError: It failed; says with what.
        """
        try:
            _input(self._process).close()
        except OSError:
            self._process.wait()
            raise self._failure() from None
        if self._process.wait():
            raise self._failure()
        try:
            log = json.loads((self._folder / _LOG).read_bytes())
            return np.array([frame["metrics"]["vmaf"] for frame in log["frames"]], np.float64)
        except (OSError, ValueError, KeyError, TypeError):
            raise self._failure() from None

    def _failure(self) -> ScoringError:
        lines = (self._folder / "stderr").read_text(errors="replace").strip().splitlines()
        said = f": {lines[-1].strip()}" if lines else ""
        return ScoringError(f"libvmaf failed (code {self._process.returncode}){said}.")
