"""Changes of the files of a dataset, after which their checksums fit again."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mp4ds import yamlio

Document = dict[str, Any]
Change = Callable[[Document], None]


def load(path: Path) -> Document:
    return yamlio.load(path.read_bytes(), str(path))


def changed(path: Path, change: Change) -> None:
    """Change a sidecar or manifest, so that its checksum fits again."""
    document = load(path)
    change(document)
    path.write_bytes(yamlio.dump(document))


def digest(path: Path) -> Document:
    """What a manifest says of a file."""
    data = path.read_bytes()
    return {"name": path.name, "size": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def agreed(folder: Path) -> None:
    """Let the manifest say what the files are now, so that only the contradiction is left."""

    def change(manifest: Document) -> None:
        manifest["files"] = [digest(folder / entry["name"]) for entry in manifest["files"]]

    changed(folder / "dataset.yaml", change)


def flip(path: Path, place: float = 0.5) -> None:
    """Change a bit, at a share of the file's length."""
    data = bytearray(path.read_bytes())
    data[int(place * len(data))] ^= 0x10
    path.write_bytes(data)
