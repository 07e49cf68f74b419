"""A dataset as a recording: read to be packed again or restored, sliced, copied, salvaged."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.formats import RECORDING_SUFFIXES, open_reader
from mp4ds.bags.latched import take_slice
from mp4ds.bags.protocols import WHOLE, BagReader, RecordingSlice, stats_of
from mp4ds.dataset.concat import concat
from mp4ds.dataset.dataset import Dataset
from mp4ds.dataset.messages import MessagesFile, MessageSource, Part, recorded_format
from mp4ds.dataset.stream import Layer, Stream, open_stream
from mp4ds.errors import (
    FormatError,
    OptionError,
    Refused,
    SourceError,
    SourceNotFoundError,
    VersionError,
    advising,
)
from mp4ds.files.outputs import digest_file
from mp4ds.files.urls import location, remote
from mp4ds.format.fields import FORMAT_VERSION, MESSAGES_NAME
from mp4ds.format.manifest import About, EarlierDataset, Manifest, StreamEntry, Verbatim
from mp4ds.format.sidecars import COPY_AGAIN, MANIFEST_NAME, load_manifest, verify_file
from mp4ds.messages.serializations import calibration_topics, is_camera
from mp4ds.options import SliceOptions
from mp4ds.records import Channel, ChannelStats, Excerpt, Loss, Message, Record, Schema
from mp4ds.video.codecs import VISUAL


class DatasetReader(BagReader):
    """The recording held by a dataset.

    Args:
        dataset: The dataset; closed with the reader.
        advice: What errors of a damaged dataset tell the user to do.

    Attributes:
        sources: Replacement sources for messages of videos; see `Dataset.records`.
        begin: Where the slice that it holds was cut, after which its own slices are counted.
    """

    def __init__(self, dataset: Dataset, *, advice: str = "") -> None:
        self._dataset = dataset
        self._advice = advice
        self.sources: Mapping[Part, MessageSource] = {}
        self.path = dataset.path
        self.profile = dataset.profile
        self.begin = dataset.slice_start
        self._read = self._messages = self._bytes = 0
        if manifest := dataset.manifest:
            self.format = manifest.format
            self.library = manifest.library
            absent = {video.file for one in dataset.streams if (video := one.absent)}
            names = [MANIFEST_NAME, *(entry.name for entry in manifest.files)]
            self.files = [self.path / name for name in names if name not in absent]
            self._messages = manifest.messages
            self._bytes = sum(entry.size for entry in manifest.files)
        else:
            self.format = "mcap"
            self.files = [item for one in dataset.streams for item in one.files]

    @property
    def channels(self) -> Sequence[Channel]:
        """All channels."""
        return self._dataset.channels

    @property
    def unused_schemas(self) -> Sequence[Schema]:
        """Definitions that no channel refers to."""
        return self._dataset.messages_file.unused_schemas

    @property
    def position(self) -> int:
        """Bytes of its files in proportion to the messages read."""
        return self._bytes * self._read // max(1, self._messages)

    @cached_property
    def is_indexed(self) -> bool:
        """Whether the messages of each channel are in the order of their log times."""
        return self._dataset.is_in_time

    def _records(self, excerpt: Excerpt) -> Iterator[Record]:
        """Its records, decoded; without those that an excerpt lacks."""
        self._read = 0
        with advising(self._advice) if self._advice else nullcontext():
            for record in self._decoded(excerpt):
                yield record
                self._read += isinstance(record, Message)

    def _decoded(self, excerpt: Excerpt) -> Iterator[Record]:
        start, end, dataset = excerpt.start, excerpt.end, self._dataset
        topics = None
        if excerpt.topics is not None or excerpt.without:
            topics = frozenset(
                item.topic for item in self.channels if excerpt.has_topic(item.topic)
            )
        if (start is None and end is None) or not self.is_indexed:
            span = replace(excerpt, topics=None)  # sources may give messages of other topics
            yield from filter(span.has, dataset.records(self.sources, topics=topics))
            return
        if excerpt.others:
            yield from dataset.messages_file.others()
        if excerpt.has_messages:
            yield from dataset.records(self.sources, start=start, end=end, topics=topics)

    @cached_property
    def _recorded_times(self) -> Mapping[int, NDArray[np.int64]]:
        return self._dataset.times()

    def _times(self) -> Mapping[int, NDArray[np.int64]]:
        """Log times by channel id, nanoseconds, from the sidecars."""
        return self._recorded_times

    def _stats(self) -> Mapping[int, ChannelStats]:
        """Counts and spans of the log times, whether they are in order or not."""
        return stats_of(self._recorded_times)

    def close(self) -> None:
        """Close the dataset."""
        self._dataset.close()


_BEST_JPEG = 100  # of the messages of a transcoded stream that is packed again


def dataset_at(path: Path) -> Path | None:
    """The folder of a dataset that is to be repacked; None for a recording."""
    folder = path.parent if path.name == MANIFEST_NAME else path
    if folder.suffix in RECORDING_SUFFIXES:  # saves a request for URLs
        return None
    try:
        return folder if (folder / MANIFEST_NAME).is_file() else None
    except OSError:
        return None  # opening it will say why


def open_source(path: Path) -> BagReader:
    """Open a recording, or a dataset that is to be repacked."""
    folder = dataset_at(path)
    if folder is None:
        return open_reader(path)
    with advising(COPY_AGAIN):
        dataset = Dataset(folder, jpeg_quality=_BEST_JPEG)
        dataset.verify_sidecars()
    return DatasetReader(dataset, advice=COPY_AGAIN)


def slice_of(
    dataset: Dataset, asked: SliceOptions, selected: Callable[[str], bool]
) -> RecordingSlice:
    """A slice of a dataset, with latched messages of selected topics if requested.

    Raises:
        OptionError: It is empty, or a time is not valid.
        SourceError: There are no messages.
    """
    if not asked.is_slice:
        return WHOLE
    reader = DatasetReader(dataset)
    take_slice(reader, asked, selected)
    return reader.slice


def copy_part(
    dataset: Dataset,
    folder: Path,
    *,
    part: RecordingSlice = WHOLE,
    selected: Callable[[str], bool] = lambda _: True,
    about: About | None = None,
) -> None:
    """Copy a dataset, or a part of it, into one derived from it; see `concat`.

    Args:
        dataset: A folder made by `mp4ds pack`.
        folder: The folder to fill, empty.
        part: What to copy.
        selected: Whether a topic is to be copied.
        about: Description of the recording; None to keep the dataset's.

    Raises:
        Refused: It cannot be copied; says why.
        FormatError: It is damaged.
    """
    old = dataset.manifest
    if old is None:
        raise Refused("it is a single video, not a dataset")
    if part != WHOLE:
        dataset.verify_lossy_videos(selected)
    earlier = EarlierDataset(
        name=dataset.path.name,
        profile=old.profile,
        sha256=digest_file(dataset.path / MANIFEST_NAME)[1],
    )
    is_view = any(one.layer == "view" and selected(one.topic) for one in dataset.streams)
    changes = {
        "profile": VISUAL if is_view else old.profile,
        "about": about or old.about,
        "sources": [source.within(part.span) for source in old.sources],
        "derived_from": [*old.derived_from, earlier],
        "redactions": [
            entry.proving(selected if part == WHOLE and not is_view else lambda _: False)
            for entry in old.redactions
        ],
    }
    concat([dataset], folder, part=part, selected=selected, changes=changes)


@contextmanager
def sliced(
    dataset: Dataset, part: RecordingSlice, folder: Path, selected: Callable[[str], bool]
) -> Iterator[Dataset]:
    """A temporary dataset of a slice; the dataset itself if the slice is all of it.

    Args:
        dataset: A folder made by `mp4ds pack`.
        part: The slice.
        folder: Where to make it.
        selected: Whether a topic has to be in it; those that share a stream with it are, too.

    Raises:
        OptionError: It cannot be cut out.
        FormatError: The dataset is damaged.
        OSError: The disk could not be written.
    """
    if part == WHOLE:
        yield dataset
        return
    path = folder / "slice" / dataset.path.name
    path.mkdir(parents=True)
    try:
        kept = with_shared(dataset, selected).__contains__
        copy_part(dataset, path, part=part, selected=kept)
    except Refused as reason:
        raise OptionError(
            f"{dataset.path} cannot be sliced: {reason}. Pack the slice first (mp4ds pack with the "
            "same times), and use that."
        ) from None
    try:
        with Dataset(path, jpeg_quality=dataset.jpeg_quality) as opened:
            yield opened
    finally:
        shutil.rmtree(path.parent, ignore_errors=True)


def with_shared(dataset: Dataset, selected: Callable[[str], bool]) -> set[str]:
    """The selected topics, and those that share a stream with them."""
    kept = {channel.topic for channel in dataset.channels if selected(channel.topic)}
    shared = [set(stream.topics) for stream in dataset.streams]
    while more := [own for own in shared if own & kept and not own <= kept]:
        kept.update(*more)
    return kept


# ---------------------------------------------------------------- damaged

_FORMAT = re.compile(rb"^format: (bag|rosbag2|mcap)\r?$", re.MULTILINE)
_ALTERED = "does not match its SHA-256"


HOW_TO_SALVAGE = (
    "`mp4ds validate --deep` finds all damage, and `mp4ds unpack --salvage` restores what can be "
    "read."
)
"""What to do about a damaged dataset."""


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
        The dataset, and what is lost by files that cannot be read at all, and of messages.mcap.

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
    if not folder.is_dir():
        dataset = Dataset(folder, layer=layer)
        dataset.is_salvaged = True
        return dataset, []
    manifest: Manifest | None = None
    losses: list[Loss] = []
    try:
        manifest = load_manifest(folder / MANIFEST_NAME)
        entries: dict[str, StreamEntry | None] = {one.sidecar: one for one in manifest.streams}
    except VersionError:
        raise
    except FormatError as error:
        problem = f"{error.problem}; the other files tell what the dataset holds"
        losses.append(Loss(MANIFEST_NAME, None, None, problem, 0))
        names = sorted(path.name for path in folder.glob("*.yaml"))
        entries = {name: None for name in names if name != MANIFEST_NAME}
    streams: list[Stream] = []
    for name, entry in entries.items():
        try:
            streams.append(open_stream(folder / name, layer))
        except VersionError:
            raise
        except FormatError as error:
            losses += _lost_sidecar(name, entry, selected, error.problem)
            continue
        topics = tuple(streams[-1].topics)
        try:
            if manifest is not None and any(map(selected, topics)):
                verify_file(folder / name, manifest.file(name))
        except FormatError as error:
            problem = f"{error.problem}: what has no digests, such as calibrations, may be altered"
            losses.append(Loss(name, None, None, problem, 0, topics))
    file, lost = _salvaged_messages(folder / MESSAGES_NAME, manifest)
    losses += [one for one in lost if not one.topics or any(map(selected, one.topics))]
    if not streams and file.path is None:
        raise FormatError("file-missing", folder, "has no file that can be read")
    dataset = Dataset.of(folder, manifest or _rebuilt(folder, streams, file), streams, file)
    dataset.is_salvaged = True
    return dataset, losses


def _lost_sidecar(
    name: str, entry: StreamEntry | None, selected: Callable[[str], bool], problem: str
) -> list[Loss]:
    """What is lost of selected topics by a sidecar that cannot be read."""
    if entry is None:
        return [Loss(name, None, None, problem)]
    if selected(entry.topic):
        return [Loss(name, None, None, problem, entry.frames, (entry.topic,))]
    if any(map(selected, calibration_topics(entry.topic))):
        return [Loss(name, None, None, f"{problem}; it may have had calibrations")]
    return []


def _salvaged_messages(path: Path, manifest: Manifest | None) -> tuple[MessagesFile, list[Loss]]:
    """messages.mcap as far as it can be read, and what is lost of it."""
    file = MessagesFile(path)
    with suppress(FormatError):  # it is read below as far as possible
        if manifest is not None:
            verify_file(path, manifest.file(path.name))
            return file, []
    try:
        file = MessagesFile(path, salvage=True)
        _ = file.counts  # reads it once
    except FormatError as error:
        return MessagesFile(None), [Loss(MESSAGES_NAME, None, None, error.problem)]
    losses = list(file.losses)
    if not losses and manifest is not None:
        problem = f"{_ALTERED}, although all its records can be read: some may be altered"
        losses.append(Loss(MESSAGES_NAME, None, None, problem, 0))
    return file, losses


def _rebuilt(folder: Path, streams: Sequence[Stream], file: MessagesFile) -> Manifest:
    """What the manifest said, as far as the other files tell."""
    path = folder / MANIFEST_NAME
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
