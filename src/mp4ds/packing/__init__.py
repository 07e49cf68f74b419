"""Source -> dataset: one pass over a recording, images into videos, all the rest verbatim."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

from mp4ds.bags import open_sources
from mp4ds.errors import OptionError, SourceError, WriteError
from mp4ds.outputs import staged
from mp4ds.packing.packer import Packer
from mp4ds.packing.report import PackOptions, PackProgress, PackSummary, TopicSummary
from mp4ds.plan import parse_quality
from mp4ds.sidecar import MANIFEST_NAME
from mp4ds.video import check_codec

__all__ = ["PackOptions", "PackProgress", "PackSummary", "TopicSummary", "is_dataset", "pack"]


def pack(
    sources: Sequence[Path | str] | Path | str,
    dataset: Path | str,
    options: PackOptions | None = None,
    *,
    progress: Callable[[PackProgress], None] | None = None,
) -> PackSummary:
    """Pack a recording into a dataset.

    Args:
        sources: A bag, rosbag2 folder or MCAP file, or several that belong together.
        dataset: The folder to make.
        options: How; the default loses nothing.
        progress: Called several times a second.

    Returns:
        What became of each topic.

    Raises:
        SourceError: The recording cannot be read. Nothing is left behind.
        TargetError: The dataset may not be written there.
        WriteError: The disk refused. Nothing is left behind.
        OptionError: An option is wrong.
    """
    chosen = options or PackOptions()
    paths = [Path(sources)] if isinstance(sources, (str, Path)) else [Path(p) for p in sources]
    target = Path(os.path.abspath(dataset))  # noqa: PTH100 - keeps links, unlike resolve()
    quality = parse_quality(chosen.quality)
    if chosen.transcode and quality.lossless:
        raise OptionError(
            "--transcode goes with a lossy --quality, such as visual: without loss, a JPEG file "
            "is smaller than any video of its pixels."
        )
    check_codec(chosen.codec, chosen.preset, lossless=quality.lossless)
    with (
        open_sources(paths) as reader,
        staged(target, force=chosen.force, replaceable=is_dataset, sources=paths) as folder,
    ):
        folder.mkdir()
        try:
            return Packer(reader, folder, chosen, quality, progress).run(target)
        except OSError as error:
            if isinstance(error, SourceError) or error.errno is None:
                raise
            raise WriteError(target, error) from error


def is_dataset(path: Path) -> bool:
    """Whether a folder is one that pack made, or empty, and may be replaced when asked."""
    return path.is_dir() and ((path / MANIFEST_NAME).is_file() or not any(path.iterdir()))
