"""Cuts a dataset out of another: packets are copied, nothing is encoded."""

from __future__ import annotations

import heapq
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.latched import latched_before
from mp4ds.bags.mcap_write import McapWriter
from mp4ds.bags.protocols import write_record
from mp4ds.bags.slices import in_span
from mp4ds.dataset.dataset import Dataset
from mp4ds.dataset.rebuild import DecodedColumns, columns_model, digests_model, within
from mp4ds.dataset.stream import Stream
from mp4ds.errors import OptionError, Refused, VideoError
from mp4ds.files.outputs import digest_file
from mp4ds.format.fields import FORMAT_VERSION, MESSAGES_NAME, Columns
from mp4ds.format.manifest import (
    About,
    EarlierDataset,
    FileEntry,
    Manifest,
    StreamEntry,
    TimeRange,
    Verbatim,
)
from mp4ds.format.models import CameraInfo, ChannelModel, StreamSidecar, video_facts
from mp4ds.format.sidecars import MANIFEST_NAME, dump_document, verify_file
from mp4ds.options import Slice
from mp4ds.records import EVERYTHING, Channel, Excerpt, Message
from mp4ds.times import PresentationClock
from mp4ds.video.packets import cut_segment

Integers = NDArray[np.int64]
_BLOCK = 2**20
_NO_TIMES = np.empty(0, np.int64)


def span_in(dataset: Dataset, asked: Slice) -> Excerpt:
    """A slice as a span of a dataset's times.

    Raises:
        OptionError: It is empty, or a time is not valid.
    """
    if not asked:
        return EVERYTHING
    if dataset.manifest is not None:
        told = dataset.manifest.time_range
        span = (told.start, told.end) if told else None
    else:
        times = [one for one in dataset.times().values() if len(one)]
        span = (min(int(one[0]) for one in times), max(int(one[-1]) for one in times))
    if span is None:
        raise OptionError(f"{dataset.path} has no messages to take a slice of.")
    first, last = span
    first = max(first, dataset.slice_start or first)
    return Excerpt(*asked.times(first, last, dataset.path))


def latched_at(
    dataset: Dataset, span: Excerpt, asked: Slice, selected: Callable[[str], bool]
) -> tuple[Sequence[Message], Sequence[str]]:
    """Latched messages from before a slice if requested, on selected topics, and those left out."""
    start = span.start
    if start is None or not asked.latched:
        return (), ()
    channels = [channel for channel in dataset.channels if selected(channel.topic)]
    return latched_before(channels, lambda topics, frames: dataset.before(start, topics, frames))


@contextmanager
def sliced(
    dataset: Dataset,
    asked: Slice,
    folder: Path,
    selected: Callable[[str], bool],
    latched: Sequence[Message] = (),
) -> Iterator[Dataset]:
    """A temporary dataset of a slice; the dataset itself if no slice is given.

    Args:
        dataset: A folder made by `mp4ds pack`.
        asked: The slice.
        folder: Where to make it.
        selected: Whether a topic has to be in it; those that share a stream with it are, too.
        latched: Messages from before the slice that it has, too.

    Raises:
        OptionError: It is empty, or cannot be cut out.
        FormatError: The dataset is damaged.
        OSError: The disk could not be written.
    """
    if not asked:
        yield dataset
        return
    path = folder / "slice" / dataset.path.name
    path.mkdir(parents=True)
    try:
        kept = _with_shared(dataset, selected).__contains__
        span = span_in(dataset, asked)
        copy_part(dataset, path, span=span, latched=latched, selected=kept)
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


def copy_part(
    dataset: Dataset,
    folder: Path,
    *,
    span: Excerpt = EVERYTHING,
    latched: Sequence[Message] = (),
    selected: Callable[[str], bool] = lambda _: True,
    about: About | None = None,
) -> Manifest:
    """Copy what was recorded in a span of log time, on some topics.

    Frames before the span that belong to the group of pictures in which it begins are also in the
    new video, hidden by its edit list (spec, "The video").

    Args:
        dataset: A folder made by `mp4ds pack`.
        folder: The folder to fill, empty.
        span: What to copy; its topics are ignored.
        latched: The messages from before it that are copied, too.
        selected: Whether a topic is to be copied.
        about: Description of the recording; None to keep the dataset's.

    Returns:
        The new manifest, already written.

    Raises:
        Refused: It cannot be copied; says why. Nothing was written.
        FormatError: A file does not match its dataset.
        OSError: The disk could not be written.
    """
    latched = [message for message in latched if selected(message.channel.topic)]
    part = _Part(dataset, folder, span, latched, selected)
    part.check()
    return part.write(about)


@dataclass(frozen=True)
class _Cut:
    """A stream of the slice.

    Attributes:
        stream: Of the dataset.
        images: Numbers of the frames to copy.
        infos: Numbers of the calibrations to copy.
    """

    stream: Stream
    images: Integers
    infos: Integers

    @property
    def has_all(self) -> bool:
        """Whether the whole video is copied."""
        return len(self.images) == len(self.stream)


class _Part:
    def __init__(
        self,
        dataset: Dataset,
        folder: Path,
        span: Excerpt,
        latched: Sequence[Message],
        selected: Callable[[str], bool],
    ) -> None:
        if dataset.manifest is None:
            raise Refused("it is a single video, not a dataset")
        self._old = dataset.manifest
        self._dataset = dataset
        self._folder = folder
        self._span = span
        self._latched = latched
        self._early = Counter(message.channel.identity for message in latched)
        self._selected = selected
        self._is_slice = span.start is not None or span.end is not None
        self._cuts = [self._cut(stream) for stream in dataset.streams]
        self._copied: list[str] = []  # names of files copied as a whole

    def _cut(self, stream: Stream) -> _Cut:
        info, columns = stream.sidecar.camera_info, stream.camera_info_columns
        infos: Integers = np.empty(0, np.int64)
        if info and columns and self._selected(info.channel.topic):
            infos = self._numbers(columns)
        has_images = self._selected(stream.topic)
        images = self._numbers(stream.columns) if has_images else np.empty(0, np.int64)
        return _Cut(stream, images, infos)

    def _numbers(self, columns: DecodedColumns) -> Integers:
        """Numbers of the messages in the span."""
        start, end = self._span.start, self._span.end
        is_in = np.ones(len(columns.log_time), np.bool_)
        if start is not None:
            is_in &= columns.log_time >= start
        if end is not None:
            is_in &= columns.log_time < end
        return np.flatnonzero(is_in).astype(np.int64)

    def check(self) -> None:
        """Refuse what cannot be copied.

        Raises:
            Refused: Says why.
        """
        if self._is_slice and not self._dataset.is_in_time:
            raise Refused("its messages are not ordered by log time")
        for cut in self._cuts:
            info = cut.stream.sidecar.camera_info
            if (
                info
                and info.messages
                and self._selected(info.channel.topic) != self._selected(cut.stream.topic)
            ):
                raise Refused(f"{cut.stream.topic} and {info.channel.topic} share one stream")
            if np.any(np.diff(cut.images) != 1):
                raise Refused(f"frames of {cut.stream.topic} are not ordered by time")

    def write(self, about: About | None) -> Manifest:
        """Write all files, the manifest last."""
        dataset, folder, old = self._dataset, self._folder, self._old
        dataset.verify_sidecars(self._selected)
        made = self._write_streams()
        self._write_messages(folder / MESSAGES_NAME)
        digests = {
            sidecar.video.file: (sidecar.video.size or 0, sidecar.video.sha256 or "")
            for _, sidecar in made
        }
        for name in (MESSAGES_NAME, *(name for name, _ in made)):
            digests[name] = digest_file(folder / name)
        for name in self._copied:
            verify_file(dataset.path / name, old.file(name), found=digests[name])
        times = [in_span(one, self._span) for one in self._times.values()]
        times.append(np.sort(np.array([item.log_time for item in self._latched], np.int64)))
        times = [one for one in times if len(one)]
        left_out = [item.topic for item in dataset.channels if not self._selected(item.topic)]
        manifest = old.model_copy(
            update={
                "mp4ds": FORMAT_VERSION,
                "about": about or old.about,
                "sources": [source.within(self._span) for source in old.sources],
                "derived_from": [
                    *old.derived_from,
                    EarlierDataset(
                        name=dataset.path.name,
                        profile=old.profile,
                        sha256=digest_file(dataset.path / MANIFEST_NAME)[1],
                    ),
                ],
                "messages": sum(map(len, times)),
                "topics_left_out": list(dict.fromkeys([*old.topics_left_out, *left_out])),
                "time_range": TimeRange(
                    start=min(int(one[0]) for one in times),
                    end=max(int(one[-1]) for one in times),
                )
                if times
                else None,
                "streams": [
                    StreamEntry(
                        topic=sidecar.channel.topic,
                        sidecar=name,
                        video=sidecar.video.file,
                        frames=sidecar.frames,
                    )
                    for name, sidecar in made
                ],
                "verbatim": self._verbatim(),
                "files": [
                    FileEntry(name=name, size=size, sha256=sha256)
                    for name, (size, sha256) in sorted(digests.items())
                ],
            }
        )
        (folder / MANIFEST_NAME).write_bytes(dump_document(manifest))
        return manifest

    def _verbatim(self) -> list[Verbatim]:
        """Camera messages in messages.mcap, by topic, with the known reasons."""
        old = self._old
        if not self._is_slice:
            return [item for item in old.verbatim if self._selected(item.topic)]
        found = []
        for topic in dict.fromkeys(item.topic for item in old.verbatim):
            reasons = [item.reason for item in old.verbatim if item.topic == topic]
            times = np.sort(np.concatenate([_NO_TIMES, *self._times_of(topic)]))
            recorded = self._dataset.recorded_times(topic)
            inside = in_span(recorded, self._span)
            if self._selected(topic) and len(inside):
                first = int(np.searchsorted(in_span(times, self._span), inside[0]))
                entry = Verbatim(
                    topic=topic, messages=len(inside), first=first, reason="; or ".join(reasons)
                )
                found.append(entry)
        return found

    def _times_of(self, topic: str) -> list[Integers]:
        times = self._dataset.times()
        channels = [item for item in self._dataset.channels if item.topic == topic]
        return [times[item.id] for item in channels if item.id in times]

    # ------------------------------------------------------------ videos

    def _write_streams(self) -> list[tuple[str, StreamSidecar]]:
        made = []
        for cut in self._cuts:
            if len(cut.images):
                sidecar = self._write_video(cut)
                name = cut.stream.path.name
                (self._folder / name).write_bytes(dump_document(sidecar))
                made.append((name, sidecar))
        return made

    def _write_video(self, cut: _Cut) -> StreamSidecar:
        stream, numbers = cut.stream, cut.images
        sidecar, video = stream.sidecar, stream.sidecar.video
        path = self._folder / stream.video_path.name
        if cut.has_all:
            self._copy(path.name)
        else:
            frames = range(int(numbers[0]), int(numbers[-1]) + 1)
            cut_segment(stream.video_path, video.codec, frames, self._ticks(cut), path)
        changes = video_facts(path, video.codec)
        if cut.has_all and video.sha256 not in (None, changes["sha256"]):
            raise VideoError(
                "hash-mismatch",
                stream.video_path,
                "does not match the SHA-256 in its sidecar",
            )
        if video.quality is not None:
            changes["quality"] = video.quality.of(numbers, len(stream))
        digests = None
        if sidecar.digests is not None:
            digests = digests_model(sidecar.digests.decode(len(stream))[numbers].tolist())
        columns, kinds = self._columns(stream.columns, numbers, sidecar.channel)
        return sidecar.model_copy(
            update={
                "mp4ds": FORMAT_VERSION,
                "frames": len(numbers),
                "headers": [sidecar.headers[kind] for kind in kinds],
                "video": video.model_copy(update=changes),
                "camera_info": self._camera_info(cut),
                "columns": columns,
                "digests": digests,
            }
        )

    @staticmethod
    def _ticks(cut: _Cut) -> Sequence[int]:
        clock, columns = PresentationClock(), cut.stream.columns
        stamps, times = columns.stamp[cut.images], columns.log_time[cut.images]
        return list(map(clock.tick, stamps.tolist(), times.tolist()))

    def _camera_info(self, cut: _Cut) -> CameraInfo | None:
        info, columns = cut.stream.sidecar.camera_info, cut.stream.camera_info_columns
        if info is None or columns is None or not len(cut.infos):
            return None
        found, kinds = self._columns(columns, cut.infos, info.channel)
        return info.model_copy(
            update={
                "messages": len(cut.infos),
                "calibrations": [info.calibrations[kind] for kind in kinds],
                "columns": found,
            }
        )

    def _columns(
        self, columns: DecodedColumns, numbers: Integers, channel: ChannelModel
    ) -> tuple[Columns, list[int]]:
        """Columns of some messages, and the numbers of their variants."""
        values = {
            name: getattr(columns, name)[numbers]
            for name in Columns.model_fields
            if getattr(columns, name) is not None
        }
        kinds, values["variant"] = np.unique(values["variant"], return_inverse=True)
        values["ordinal"] = values["ordinal"] - self._before(channel)
        return columns_model(values), kinds.tolist()

    # ------------------------------------------------------------ messages

    @cached_property
    def _times(self) -> dict[tuple[object, ...], Integers]:
        """Sorted log times of the copied messages, by channel identity."""
        times = self._dataset.times()
        found: dict[tuple[object, ...], list[Integers]] = {}
        for channel in self._dataset.channels:  # several may be equal
            if self._selected(channel.topic):
                found.setdefault(channel.identity, []).append(times.get(channel.id, _NO_TIMES))
        return {key: np.sort(np.concatenate(arrays)) for key, arrays in found.items()}

    def _before(self, channel: ChannelModel) -> int:
        """How many messages of a channel come before the span and are left out."""
        if self._span.start is None:
            return 0
        identity = channel.to_record(0).identity
        before = int(np.searchsorted(self._times[identity], self._span.start))
        return before - self._early[identity]

    def _write_messages(self, path: Path) -> None:
        dataset = self._dataset
        if not self._is_slice and all(self._selected(item.topic) for item in dataset.channels):
            self._copy(path.name)
            return
        in_videos: set[tuple[object, ...]] = set()
        for cut in self._cuts:
            if len(cut.images):
                in_videos.add(cut.stream.sidecar.channel.to_record(0).identity)
            info = cut.stream.sidecar.camera_info
            if info and len(cut.images) and len(cut.infos):
                in_videos.add(info.channel.to_record(0).identity)
        with McapWriter(path, profile=dataset.profile) as writer:
            for record in chain(dataset.other_records(), self._verbatim_messages()):
                write_record(writer, record)
            for channel in dataset.channels:
                if self._selected(channel.topic) and channel.identity not in in_videos:
                    writer.add_channel(channel)
            for schema in dataset.unused_schemas:
                writer.add_schema(schema)

    def _verbatim_messages(self) -> Iterator[Message]:
        """The messages for messages.mcap, by log time.

        Includes the calibrations of streams without frames in the span.
        """
        topics = {item.topic for item in self._dataset.channels if self._selected(item.topic)}
        recorded = self._dataset.recorded_messages(replace(self._span, topics=frozenset(topics)))
        channels = {channel.identity: channel for channel in self._dataset.channels}
        orphans = [self._orphans(cut, channels) for cut in self._cuts if not len(cut.images)]
        found = heapq.merge(recorded, *orphans, key=lambda message: message.log_time)
        return chain(self._latched, found)

    def _orphans(self, cut: _Cut, channels: dict[tuple[object, ...], Channel]) -> Iterator[Message]:
        info = cut.stream.sidecar.camera_info
        if info is None or not len(cut.infos):
            return iter(())
        channel = channels[info.channel.to_record(0).identity]
        found = cut.stream.camera_info_messages(channel, within(self._span))
        return (message for _, message in found)

    def _copy(self, name: str) -> None:
        """Copy a whole file, which may be at a URL; the copy is compared with the manifest."""
        with (self._dataset.path / name).open("rb") as file, (self._folder / name).open("wb") as to:
            shutil.copyfileobj(file, to, _BLOCK)
        self._copied.append(name)
