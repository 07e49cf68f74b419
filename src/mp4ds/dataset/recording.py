"""A dataset as a recording: read to be packed again or restored, sliced, copied."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.formats import RECORDING_SUFFIXES, open_reader
from mp4ds.bags.latched import take_slice
from mp4ds.bags.protocols import WHOLE, BagReader, RecordingSlice, stats_of
from mp4ds.dataset.concat import concat
from mp4ds.dataset.dataset import Dataset
from mp4ds.dataset.messages import MessageSource, Part
from mp4ds.errors import OptionError, Refused, advising
from mp4ds.files.outputs import digest_file
from mp4ds.format.manifest import About, EarlierDataset
from mp4ds.format.sidecars import COPY_AGAIN, MANIFEST_NAME
from mp4ds.options import Slice
from mp4ds.records import Channel, ChannelStats, Excerpt, Message, Record, Schema
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


def slice_of(dataset: Dataset, asked: Slice, selected: Callable[[str], bool]) -> RecordingSlice:
    """A slice of a dataset, with latched messages of selected topics if requested.

    Raises:
        OptionError: It is empty, or a time is not valid.
        SourceError: There are no messages.
    """
    if not asked:
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
        kept = _with_shared(dataset, selected).__contains__
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


def _with_shared(dataset: Dataset, selected: Callable[[str], bool]) -> set[str]:
    """The selected topics, and those that share a stream with them."""
    kept = {channel.topic for channel in dataset.channels if selected(channel.topic)}
    shared = [set(stream.topics) for stream in dataset.streams]
    while more := [own for own in shared if own & kept and not own <= kept]:
        kept.update(*more)
    return kept
