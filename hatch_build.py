"""Compiles src/mp4ds/video/colour.c where there is a C compiler; numpy does its work elsewhere.

With MP4DS_PURE=1 in the environment nothing is compiled, and the wheel is for any platform.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import subprocess
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

# Code for several processors, as far as the compiler and its linker can put it in one library.
_PROCESSORS = (
    ['-DPROCESSORS="arch=x86-64-v4","arch=x86-64-v3","arch=x86-64-v2","default"'],
    ['-DPROCESSORS="avx2","ssse3","default"'],
    [],
)
_LIBRARY = "_colour.so"


class CompileColours(BuildHookInterface):  # type: ignore[type-arg]
    """Compiles the library into the wheel, which is then for one platform, any Python."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """See hatchling."""
        if self.target_name != "wheel" or os.environ.get("MP4DS_PURE", "0") not in ("", "0"):
            return
        source = Path(self.root, "src/mp4ds/video/colour.c")
        self._scratch = tempfile.TemporaryDirectory(prefix="mp4ds-build-")
        # an editable install runs from the checkout, which no other build changes
        folder = source.parent if version == "editable" else Path(self._scratch.name)
        platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        if not _compiled(source, folder / _LIBRARY, platform):
            self.app.display_warning(
                "mp4ds: colour.c could not be compiled (is there a C compiler?), so numpy makes "
                "the colours of lossy videos, the same ones in a multiple of the time"
            )
            return
        if version != "editable":
            build_data["force_include"][str(folder / _LIBRARY)] = f"mp4ds/video/{_LIBRARY}"
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{platform}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """See hatchling."""
        if hasattr(self, "_scratch"):
            self._scratch.cleanup()
        if __spec__ is not None and __spec__.cached:  # Python compiled this file into the checkout
            Path(__spec__.cached).unlink(missing_ok=True)
            with contextlib.suppress(OSError):  # there are others
                Path(__spec__.cached).parent.rmdir()


def _compiled(source: Path, library: Path, platform: str) -> bool:
    """Whether a library could be made of a source; none is left otherwise."""
    compiler = shlex.split(sysconfig.get_config_var("CC") or "cc")[:1]
    for processors in _PROCESSORS:
        options = ["-O3", "-shared", "-fPIC", *_architectures(platform), *processors]
        command = [*compiler, *options, "-o", str(library), str(source)]
        try:
            if subprocess.run(command, capture_output=True).returncode == 0:
                return True
        except OSError:
            break
    library.unlink(missing_ok=True)
    return False


def _architectures(platform: str) -> list[str]:
    """What a Mac's compiler is to compile for: what the wheel's tag promises."""
    if not platform.startswith("macosx"):
        return []
    machines = [one for one in ("arm64", "x86_64") if platform.endswith((one, "universal2"))]
    return [word for machine in machines for word in ("-arch", machine)]
