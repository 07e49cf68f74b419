"""What a sidecar says of its video's file; all else says how it was made."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mp4ds.coded.structure import Structures
from mp4ds.errors import FormatError, VideoError
from mp4ds.sidecar import References, Video
from mp4ds.video import digest_video, packets_in_groups

FACTS = ("file", "size", "sha256", "references")
"""Keys of `mp4ds.sidecar.Video`."""


def video_facts(path: Path, codec: str) -> dict[str, Any]:
    """The values of `FACTS` for a finished video, which is read once.

    Args:
        path: The video.
        codec: Name in the registry.

    Raises:
        OSError: It cannot be read.
    """
    found = digest_video(path, codec)
    structures = found.structures
    useful = structures is not None and not structures.is_plain
    references = References.from_structures(structures) if structures and useful else None
    return dict(zip(FACTS, (path.name, found.size, found.sha256, references), strict=True))


def wrong_facts(path: Path, video: Video, *, deep: bool) -> Iterator[FormatError]:
    """What a sidecar says of its video's file and is not so.

    Args:
        path: The video, which is there.
        video: What its sidecar says.
        deep: Also read the whole file.

    Raises:
        OSError: It cannot be read.
    """
    size = path.stat().st_size
    if video.size is not None and size != video.size:
        yield VideoError(
            "size-mismatch", path, f"has {size} bytes where its sidecar says {video.size}"
        )
        return
    references = video.references
    due: Structures | None = None
    try:
        due = _structures(path, references) if references else None
    except VideoError:
        pass  # told when it is opened, if others cannot read it either
    except FormatError as error:
        yield error
        return
    if not deep or (video.sha256 is None and due is None):
        return
    found = digest_video(path, video.codec)
    if video.sha256 not in (None, found.sha256):
        yield VideoError("hash-mismatch", path, "does not have the SHA-256 that its sidecar says")
    elif due is not None and (problem := _difference(due, found.structures)):
        yield _unfit(path, problem)


def _structures(path: Path, references: References) -> Structures:
    """What references say of a video.

    Raises:
        VideoError: Its index is damaged.
        FormatError: They are not of that video.
    """
    try:
        structures = references.decode(packets_in_groups(path))
        structures.check()
    except FormatError:
        raise
    except ValueError as error:
        raise _unfit(path, str(error)) from None
    return structures


def _difference(told: Structures, found: Structures | None) -> str:
    if found is None or len(found.groups) != len(told.groups):
        return "its packets do not tell any"
    numbers = {text: number for number, text in enumerate(found.texts)}
    as_found = np.array([numbers.get(text, -1) for text in told.texts])
    wrong = np.flatnonzero(as_found[told.groups] != found.groups)
    return f"the packets of its group of pictures {wrong[0]} tell others" if len(wrong) else ""


def _unfit(path: Path, problem: str) -> FormatError:
    return FormatError(
        "references-invalid", path, f"does not fit the references in its sidecar: {problem}"
    )
