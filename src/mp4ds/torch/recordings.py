"""Which samples there are: the frames of datasets, matched between their cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.dataset import Stream, Video, open_dataset
from mp4ds.errors import OptionError
from mp4ds.remote import location, spelled
from mp4ds.sidecar import MANIFEST_NAME, load_manifest
from mp4ds.sync import synchronize

Paths = Path | str | Sequence[Path | str]
"""Datasets: folders, videos beside their sidecars, or URLs of such."""

RESERVED = ("stamp_ns", "index", "dataset")
"""Keys of a sample that no topic may have."""


@dataclass(frozen=True, slots=True)
class Source:
    """A camera of a recording.

    Attributes:
        topic: Of its images.
        name: Of its file, without ending.
        place: Path or URL of the sidecar, or of a video that has none.
        frames: Number of its frames.
    """

    topic: str
    name: str
    place: str
    frames: int


@dataclass(frozen=True, slots=True)
class Recording:
    """The samples of one dataset, in order: its rows.

    Attributes:
        path: As the user named it.
        sources: Its cameras, in the order of the topics.
        matches: Frame numbers, int64 of shape (rows, cameras); None: row n is frame n of the only
            camera.
        unmatched: Frame numbers that are in no row, by topic.
    """

    path: str
    sources: tuple[Source, ...]
    matches: NDArray[np.int64] | None
    unmatched: dict[str, NDArray[np.int64]]

    @property
    def rows(self) -> int:
        """Number of its samples."""
        return self.sources[0].frames if self.matches is None else len(self.matches)

    def frames(self, rows: NDArray[np.int64], camera: int) -> NDArray[np.int64]:
        """Frame numbers of rows in a camera; the same shape."""
        return rows if self.matches is None else self.matches[rows, camera]


class Collection:
    """The samples of several datasets, one after the other.

    Of a dataset with one camera only the manifest is read; to match several, their stamps.

    Args:
        paths: The datasets.
        topics: Topics or names of streams; None: those of the first dataset. All must have them.
        sync_tolerance_ns: How far header stamps of a match may be apart, nanoseconds.

    Raises:
        OptionError: A topic is not there, or there is no sample.
        FormatError: A manifest or sidecar breaks a rule of the format.
        SourceError: A path is no dataset.
    """

    def __init__(
        self, paths: Paths, *, topics: Sequence[str] | None, sync_tolerance_ns: int
    ) -> None:
        given = [paths] if isinstance(paths, (str, Path)) else list(paths)
        if not given:
            raise OptionError("There are no datasets: the list of paths is empty.")
        if isinstance(topics, str):
            raise OptionError(f"topics is a list of topics, such as [{topics!r}].")
        if sync_tolerance_ns < 0:
            raise OptionError(
                f"sync_tolerance_ns is {sync_tolerance_ns}, and must not be negative."
            )
        known = _sources(given[0])
        self.topics = tuple(topics) if topics is not None else tuple(s.topic for s in known)
        _check_topics(self.topics, given[0])
        self.recordings = [
            self._recording(path, known if number == 0 else _sources(path), sync_tolerance_ns)
            for number, path in enumerate(given)
        ]
        if not self.starts[-1]:
            raise OptionError(
                f"{given[0]}: no frames of {', '.join(self.topics)} have header stamps within "
                f"{sync_tolerance_ns} ns of each other. Give a larger sync_tolerance_ns."
            )

    @cached_property
    def starts(self) -> NDArray[np.int64]:
        """Number of the first sample of each recording, and of the end; int64."""
        return np.cumsum([0, *(recording.rows for recording in self.recordings)], dtype=np.int64)

    def locate(self, samples: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Recording and row of each sample number, of 0 <= number < ``starts[-1]``."""
        recordings = np.searchsorted(self.starts, samples, side="right") - 1
        return recordings.astype(np.int64), samples - self.starts[recordings]

    def _recording(self, path: Path | str, sources: list[Source], tolerance_ns: int) -> Recording:
        chosen = tuple(_choose(sources, topic, path) for topic in self.topics)
        if len(chosen) == 1:
            return Recording(str(path), chosen, None, {chosen[0].topic: np.empty(0, np.int64)})
        stamps = {}
        for topic, source in zip(self.topics, chosen, strict=True):
            stream = open_source(source)
            stamps[topic] = stream.stamps
            stream.close()
        sync = synchronize(stamps, tolerance_ns=tolerance_ns)
        return Recording(str(path), chosen, sync.indices, sync.unmatched)


def open_source(source: Source, *, fast_colour: bool = False) -> Stream | Video:
    """The stream or video of a camera; others of its dataset are not touched.

    Args:
        source: Which.
        fast_colour: See `mp4ds.Dataset`.

    Raises:
        FormatError: It breaks a rule of the format.
    """
    path = location(source.place)
    if path.suffix == ".yaml":
        return Stream(path, fast_colour=fast_colour)
    return open_dataset(path, fast_colour=fast_colour).videos[0]


def _sources(path: Path | str) -> list[Source]:
    """The cameras of a dataset; the manifest tells them without the sidecars."""
    folder = location(path)
    if folder.name == MANIFEST_NAME:
        folder = folder.parent
    if (folder / MANIFEST_NAME).exists():
        entries = load_manifest(folder / MANIFEST_NAME).streams
        places = [folder / entry.sidecar for entry in entries]
        return [
            Source(entry.topic, place.stem, spelled(place), entry.frames)
            for entry, place in zip(entries, places, strict=True)
        ]
    with open_dataset(path) as dataset:
        return [Source(s.topic, s.path.stem, spelled(s.path), len(s)) for s in dataset]


def _check_topics(topics: Sequence[str], path: Path | str) -> None:
    if not topics:
        raise OptionError(f"{path}: has no camera, or no topics were chosen.")
    twice = [topic for topic in topics if topics.count(topic) > 1]
    if twice:
        raise OptionError(
            f"{path}: {twice[0]} stands twice among the topics. If it has several streams, choose "
            "one by the name of its file."
        )
    taken = [topic for topic in topics if topic in RESERVED]
    if taken:
        raise OptionError(f"{path}: a topic named {taken[0]!r} cannot be a key of a sample.")


def _choose(sources: list[Source], topic: str, path: Path | str) -> Source:
    found = [s for s in sources if topic in (s.topic, s.name)]
    if not found:
        known = ", ".join(dict.fromkeys(s.topic for s in sources)) or "none"
        raise OptionError(f"{path}: has no stream {topic!r}; there are: {known}.")
    if len(found) > 1:
        names = ", ".join(s.name for s in found)
        raise OptionError(
            f"{path}: {topic} changes its size or encoding and has {len(found)} streams; choose "
            f"one of {names}."
        )
    return found[0]
