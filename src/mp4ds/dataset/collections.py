"""Many datasets: found below a folder or by a pattern."""

from __future__ import annotations

import glob
from collections.abc import Sequence
from pathlib import Path

from mp4ds.errors import SourceError, SourceNotFoundError
from mp4ds.files.sources import refuse_unfinished
from mp4ds.files.urls import RemotePath, location
from mp4ds.format.sidecars import MANIFEST_NAME

Paths = str | Path | Sequence[str | Path]
"""A path or several."""


def datasets_in(paths: Paths) -> list[Path]:
    """The datasets given by paths, in the same order.

    Args:
        paths: Datasets, sidecars, videos; folders of datasets, at any depth; patterns such as
            ``drives/*``; or URLs, but not URL patterns.

    Raises:
        SourceNotFoundError: A path does not exist, or a pattern matches nothing.
        SourceError: A folder has no dataset in it or below it.
    """
    several = [paths] if isinstance(paths, (str, Path, RemotePath)) else paths
    return [dataset for path in several for dataset in _datasets_at(location(path))]


def _datasets_at(path: Path) -> list[Path]:
    if path.exists():
        return _below(path)
    # Path.glob takes no absolute patterns
    matches = sorted(glob.glob(str(path))) if glob.has_magic(str(path)) else []  # noqa: PTH207
    folders = [Path(match) for match in matches if Path(match).is_dir()]
    if not folders:
        raise SourceNotFoundError(path)
    found: list[Path] = []
    for folder in folders:
        try:
            found += _below(folder)
        except SourceError:
            continue  # a pattern matches other folders, too
    if not found:
        raise SourceError(path, "matches no dataset", "Give folders made by `mp4ds pack`.")
    return found


def _below(path: Path) -> list[Path]:
    if path.name == MANIFEST_NAME:
        return [path.parent]
    if not path.is_dir() or (path / MANIFEST_NAME).is_file():
        return [path]
    refuse_unfinished(path)
    found = sorted(manifest.parent for manifest in path.rglob(MANIFEST_NAME))
    # names that begin with a dot are being made
    found = [one for one in found if not _is_hidden(one, path)]
    if not found:
        raise SourceError(
            path,
            f"holds no dataset: there is no {MANIFEST_NAME} in it or below it",
            "Give a folder made by `mp4ds pack`.",
        )
    return found


def _is_hidden(dataset: Path, folder: Path) -> bool:
    if isinstance(dataset, RemotePath):
        return False
    return any(part.startswith(".") for part in dataset.relative_to(folder).parts)
