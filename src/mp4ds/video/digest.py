"""What a sidecar tells of a finished video's bytes, found in one pass over the file."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from mp4ds.coded.structure import RECORDED_CODECS, StructureRecorder, Structures
from mp4ds.errors import VideoError
from mp4ds.outputs import digest_file
from mp4ds.video.samples import SampleTable, Unindexed, read_sample_table

_BLOCK = 2**20


@dataclass(frozen=True, eq=False)
class VideoDigest:
    """Of a whole file.

    Attributes:
        size: Bytes.
        sha256: Hexadecimal.
        structures: What its frames refer to, where that is known.
    """

    size: int
    sha256: str
    structures: Structures | None


def digest_video(path: Path, codec: str) -> VideoDigest:
    """Hash a video, and find what its frames refer to in the same bytes.

    Memory is one packet, and the video's index.

    Args:
        path: An mp4.
        codec: Name in the registry.

    Raises:
        OSError: It cannot be read.
    """
    table = _table(path) if codec in RECORDED_CODECS else None
    if table is None:
        return VideoDigest(*digest_file(path), None)
    recorder = StructureRecorder(codec, table.configuration)
    digest = hashlib.sha256()
    size = 0
    with path.open("rb") as file:
        number = 0
        for is_packet, data in _parts(file, table):
            digest.update(data)
            size += len(data)
            if is_packet:
                recorder.add(data, key=bool(table.sync[number]))
                number += 1
    return VideoDigest(size, digest.hexdigest(), recorder.finish())


def packets_in_groups(path: Path) -> NDArray[np.int64]:
    """How many packets each group of pictures of a video has, shape (groups,).

    Raises:
        VideoError: Its index is damaged.
        Unindexed: Its index is not read.
        OSError: It cannot be read.
    """
    with path.open("rb") as file:
        return packets_of_groups(read_sample_table(file, path.stat().st_size, str(path)))


def packets_of_groups(table: SampleTable) -> NDArray[np.int64]:
    """How many packets each group of pictures has, shape (groups,)."""
    return np.diff(np.append(np.flatnonzero(table.sync), len(table.sync)))


def _table(path: Path) -> SampleTable | None:
    """The index of a video whose packets follow each other; None if that is not known."""
    try:
        with path.open("rb") as file:
            table = read_sample_table(file, path.stat().st_size, str(path))
    except (VideoError, Unindexed):
        return None
    ends = table.places + table.sizes
    return table if np.all(table.places[1:] >= ends[:-1]) else None


def _parts(file: BinaryIO, table: SampleTable) -> Iterator[tuple[bool, bytes]]:
    """All bytes of a file: its packets, and blocks of what is between them."""
    place = 0
    for start, size in zip(table.places.tolist(), table.sizes.tolist(), strict=True):
        while place < start:
            data = file.read(min(_BLOCK, start - place))
            if not data:
                return  # it became shorter meanwhile
            place += len(data)
            yield False, data
        yield True, file.read(size)
        place += size
    while data := file.read(_BLOCK):
        yield False, data
