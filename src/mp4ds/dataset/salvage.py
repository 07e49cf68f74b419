"""What can be read of a damaged dataset, and what is lost of it."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mp4ds.dataset.dataset import Dataset
from mp4ds.dataset.messages import MessagesFile, recorded_format
from mp4ds.dataset.stream import Layer, Stream, open_stream
from mp4ds.errors import FormatError, SourceError, SourceNotFoundError, VersionError
from mp4ds.files.urls import location, remote
from mp4ds.format.fields import FORMAT_VERSION, MESSAGES_NAME
from mp4ds.format.manifest import FileEntry, Manifest, StreamEntry, Verbatim
from mp4ds.format.sidecars import MANIFEST_NAME, load_manifest, verify_file
from mp4ds.messages.serializations import calibration_topics, is_camera
from mp4ds.records import Loss

_FORMAT = re.compile(rb"^format: (bag|rosbag2|mcap)\r?$", re.MULTILINE)
_ALTERED = "does not match its SHA-256"


HOW_TO_SALVAGE = (
    "`mp4ds validate --deep` finds all damage, and `mp4ds unpack --salvage` restores what can be "
    "read."
)
"""What to do about a damaged dataset."""


# ---------------------------------------------------------------- opening


def open_selected(
    path: Path | str,
    selected: Callable[[str], bool],
    *,
    layer: Layer | None = None,
    verify_messages: bool = False,
) -> Dataset:
    """Open a dataset; damage to files with nothing of the selected topics is noted, and no error.

    Args:
        path: See `Dataset`.
        selected: Whether a topic is wanted.
        layer: See `Dataset`.
        verify_messages: Compare messages.mcap with its SHA-256, too.

    Raises:
        SourceNotFoundError: The path does not exist.
        FormatError: It is damaged, and selected topics have, or may have, something to lose.
    """
    try:
        dataset = Dataset(path, layer=layer)
        _ = dataset.channels  # opens messages.mcap
        if verify_messages:
            dataset.verify_messages()
        return dataset
    except VersionError:
        raise
    except FormatError as error:
        try:
            dataset, losses = open_damaged(path, selected=selected, layer=layer)
        except (SourceError, FormatError):
            raise error from None
        # nothing vouches for what is still there of a damaged messages.mcap
        file = dataset.messages_file
        there = [
            item.topic for item in file.channels if file.is_salvaged and file.counts.get(item.id)
        ]
        lost = (loss for loss in losses if loss.file != MESSAGES_NAME or loss.messages != 0)
        if any(map(selected, there)) or any(lost):
            raise
        dataset.damage = f"damaged, but not needed for the selected topics: {error}"
        return dataset


def open_damaged(
    path: Path | str,
    *,
    selected: Callable[[str], bool],
    layer: Layer | None = None,
) -> tuple[Dataset, list[Loss]]:
    """A dataset, some files of which cannot be read. What can be read of its videos: see `examine`.

    Args:
        path: See `Dataset`.
        selected: Whether a topic is wanted; damage to others is not reported.
        layer: See `Dataset`.

    Returns:
        The dataset, and what is lost by such files and of messages.mcap.

    Raises:
        SourceNotFoundError: The path does not exist.
        SourceError: It is at a URL.
        FormatError: Nothing of it can be read, or a newer version wrote it.
    """
    place = location(path)
    if remote(place):
        raise SourceError(place, "cannot be salvaged from a remote location", "Download it first.")
    if not place.exists():
        raise SourceNotFoundError(place)
    folder = place.parent if place.name == MANIFEST_NAME else place
    if folder.is_dir():
        opening = _Opening(folder, selected, layer)
        return opening.dataset(), opening.losses
    dataset = Dataset(folder, layer=layer)
    dataset.is_salvaged = True
    return dataset, []


def examine(stream: Stream) -> list[Loss]:
    """Find the frames of a stream that can be read; from then on it only reads these.

    If the video matches its SHA-256, nothing is decoded.

    Returns:
        What is lost of the others.
    """
    count = len(stream)
    try:
        _ = stream.rebuilder
    except FormatError as error:
        stream.sound = np.zeros(count, np.bool_)
        name, topics, ends = stream.video_path.name, (stream.topic,), (0, count - 1)
        return [Loss(name, None, None, error.what, count, topics, *_span(stream), ends)]
    is_hashed = all(video.sha256 for video in stream.sidecar.videos)
    altered = [path for path, _ in stream.altered_videos()]
    if is_hashed and not altered:
        return []
    name = (altered or [stream.video_path])[0].name
    sound = np.ones(count, np.bool_)
    losses, times = [], stream.log_times
    for damage, first, last in stream.damages():
        sound[first : last + 1] = False
        span, ends = (int(times[first]), int(times[last])), (first, last)
        lost, topics = last - first + 1, (stream.topic,)
        losses.append(Loss(name, None, None, damage.what, lost, topics, *span, ends))
    if stream.sidecar.digests is None and sound.any() and is_hashed:
        problem = f"{_ALTERED}, and frames of a lossy video have no digests: some may be altered"
        losses.append(Loss(name, None, None, problem, 0, (stream.topic,)))
    stream.sound = sound
    return losses


def _span(stream: Stream) -> tuple[int | None, int | None]:
    """Log times of the first and the last frame of a stream whose video is missing or too short.

    The digests show that there were as many frames as the sidecar says: each takes its space there.
    """
    sidecar = stream.sidecar
    try:
        if sidecar.digests is None:
            return None, None
        sidecar.digests.decode(sidecar.frames)
        times = sidecar.columns.log_time.decode(sidecar.frames)
    except ValueError:
        return None, None
    return int(times[0]), int(times[-1])


class _Opening:
    """The files of a damaged folder.

    Attributes:
        losses: What is lost by files that cannot be read at all, and of messages.mcap.
    """

    def __init__(self, folder: Path, selected: Callable[[str], bool], layer: Layer | None) -> None:
        self._folder = folder
        self._selected = selected
        self._layer: Layer | None = layer
        self.losses: list[Loss] = []

    def dataset(self) -> Dataset:
        """The dataset."""
        manifest: Manifest | None = None
        try:
            manifest = load_manifest(self._folder / MANIFEST_NAME)
        except VersionError:
            raise
        except FormatError as error:
            problem = f"{error.problem}; the other files tell what the dataset holds"
            self.losses.append(Loss(MANIFEST_NAME, None, None, problem, 0))
        if manifest is not None:
            entries = {entry.sidecar: entry for entry in manifest.streams}
            streams = [self._stream(name, entry, manifest) for name, entry in entries.items()]
        else:
            names = sorted(path.name for path in self._folder.glob("*.yaml"))
            streams = [self._stream(name, None, None) for name in names if name != MANIFEST_NAME]
        file = self._messages(manifest)
        there = [stream for stream in streams if stream is not None]
        if not there and file.path is None:
            raise FormatError("file-missing", self._folder, "has no file that can be read")
        manifest = manifest or self._rebuilt(there, file)
        dataset = Dataset.of(self._folder, manifest, there, file)
        dataset.is_salvaged = True
        return dataset

    def _compare(self, path: Path, entry: FileEntry | None, topics: Sequence[str]) -> None:
        """Note that a sidecar that can be read is not the one that was packed."""
        try:
            verify_file(path, entry)
        except FormatError as error:
            problem = f"{error.problem}: what has no digests, such as calibrations, may be altered"
            self.losses.append(Loss(path.name, None, None, problem, 0, tuple(topics)))

    def _stream(
        self, name: str, entry: StreamEntry | None, manifest: Manifest | None
    ) -> Stream | None:
        path = self._folder / name
        try:
            stream = open_stream(path, self._layer)
            if manifest is not None and any(map(self._selected, stream.topics)):
                self._compare(path, manifest.file(name), stream.topics)
            return stream
        except VersionError:
            raise
        except FormatError as error:
            if entry is None:
                self.losses.append(Loss(name, None, None, error.problem))
            elif self._selected(entry.topic):
                frames, topics = entry.frames, (entry.topic,)
                self.losses.append(Loss(name, None, None, error.problem, frames, topics))
            elif any(map(self._selected, calibration_topics(entry.topic))):
                problem = f"{error.problem}; it may have had calibrations"
                self.losses.append(Loss(name, None, None, problem))
            return None

    def _messages(self, manifest: Manifest | None) -> MessagesFile:
        path = self._folder / MESSAGES_NAME
        file = MessagesFile(path)
        try:
            if manifest is not None:
                file.verify(manifest)
                return file
        except FormatError:
            pass  # it is read below as far as possible
        try:
            salvaged = MessagesFile(path, salvage=True)
            _ = salvaged.counts  # reads it once
        except FormatError as error:
            self.losses.append(Loss(MESSAGES_NAME, None, None, error.problem))
            return MessagesFile(None)
        losses = list(salvaged.losses)
        if not losses and manifest is not None:
            problem = f"{_ALTERED}, although all its records can be read: some may be altered"
            losses.append(Loss(MESSAGES_NAME, None, None, problem, 0))
        self.losses += [
            loss for loss in losses if not loss.topics or any(map(self._selected, loss.topics))
        ]
        return salvaged

    def _rebuilt(self, streams: list[Stream], file: MessagesFile) -> Manifest:
        """What the manifest said, as far as the other files tell."""
        path = self._folder / MANIFEST_NAME
        found = _FORMAT.search(path.read_bytes()) if path.is_file() else None
        told: Any = found[1].decode() if found else recorded_format(file)
        return Manifest(
            mp4ds=FORMAT_VERSION,
            kind="dataset",
            profile=streams[0].sidecar.profile if streams else "lossless",
            format=told,
            recording_profile=file.profile,
            sources=[],
            messages=0,
            streams=[StreamEntry.of(stream.path.name, stream.sidecar) for stream in streams],
            verbatim=[
                Verbatim(topic=item.topic, messages=number, first=0, reason="not known")
                for item in file.channels
                if is_camera(item) and (number := file.counts.get(item.id, 0))
            ],
            files=[],
        )
