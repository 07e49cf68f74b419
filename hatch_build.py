"""Compiles src/mp4ds/video/colour.c where there is a C compiler; numpy does its work elsewhere.

With MP4DS_PURE=1 in the environment nothing is compiled, and the wheel is for any platform.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

# Code for several processors, as far as the compiler and its linker can put it in one library.
_PROCESSORS = (
    ['-DPROCESSORS="arch=x86-64-v4","arch=x86-64-v3","arch=x86-64-v2","default"'],
    ['-DPROCESSORS="avx2","ssse3","default"'],
    [],
)


class CompileColours(BuildHookInterface):  # type: ignore[type-arg]
    """Puts the library beside its source; wheels with it are for one platform, any Python."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """See hatchling."""
        if self.target_name != "wheel":
            return
        source = Path(self.root, "src/mp4ds/video/colour.c")
        library = source.with_name("_colour.so")
        if os.environ.get("MP4DS_PURE", "0") not in ("", "0"):
            return
        platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        compiler = shlex.split(sysconfig.get_config_var("CC") or "cc")[:1]
        for processors in _PROCESSORS:
            options = ["-O3", "-shared", "-fPIC", *_architectures(platform), *processors]
            try:
                done = subprocess.run(
                    [*compiler, *options, "-o", str(library), str(source)], capture_output=True
                )
            except OSError:
                break
            if done.returncode == 0:
                build_data["artifacts"].append("src/mp4ds/video/_colour.so")
                build_data["pure_python"] = False
                build_data["tag"] = f"py3-none-{platform}"
                return
        library.unlink(missing_ok=True)
        self.app.display_warning(
            "mp4ds: colour.c could not be compiled (is there a C compiler?), so numpy makes the "
            "colours of lossy videos, the same ones in a multiple of the time"
        )


def _architectures(platform: str) -> list[str]:
    """What a Mac's compiler is to compile for: what the wheel's tag promises."""
    if not platform.startswith("macosx"):
        return []
    machines = [one for one in ("arm64", "x86_64") if platform.endswith((one, "universal2"))]
    return [word for machine in machines for word in ("-arch", machine)]
