"""PyAV's FFmpeg for torchcodec, if the system has none.

``LD_LIBRARY_PATH=$(python -m mp4ds.torch.ffmpeg) python train.py``
"""

from __future__ import annotations

import os
import re
import sys
from importlib.metadata import files, version
from pathlib import Path

from mp4ds.errors import Mp4dsError, OptionError

_NAME = re.compile(r"(lib(?:av|sw)[a-z]+)-[0-9a-f]+(\.so\.[0-9]+)[0-9.]*")


def link_libraries() -> Path:
    """Make a folder in the user's cache in which PyAV's libraries have their usual names.

    Returns:
        The folder, for ``LD_LIBRARY_PATH``.

    Raises:
        OptionError: PyAV does not bundle libraries.
    """
    parts = [part for part in files("av") or () if part.parent.name == "av.libs"]
    names = {part.name: Path(str(part.locate())).resolve() for part in parts}
    if not names:
        raise OptionError("This PyAV does not bundle shared libraries (.so).")
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(cache) / "mp4ds" / f"ffmpeg-av{version('av')}"
    folder.mkdir(parents=True, exist_ok=True)
    for name, path in names.items():
        match = _NAME.fullmatch(name)
        # they look for each other in their own folder, by their actual names
        for link in (name, *([match[1] + match[2]] if match else [])):
            place = folder / link
            if place.is_symlink() and place.readlink() == path:
                continue
            place.unlink(missing_ok=True)
            place.symlink_to(path)
    return folder


if __name__ == "__main__":
    try:
        sys.stdout.write(f"{link_libraries()}\n")
    except (Mp4dsError, OSError) as error:
        sys.exit(f"mp4ds: {error}")
