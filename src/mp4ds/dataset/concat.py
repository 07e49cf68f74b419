"""Puts datasets that follow one another together: packets are copied, nothing is encoded.

A copy or a slice is made in the same way: of one dataset, of which a span and topics are chosen.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.mcap import McapWriter
from mp4ds.bags.protocols import WHOLE, RecordingSlice, in_span, merged, write_record
from mp4ds.dataset.dataset import Dataset
from mp4ds.dataset.messages import Part, by_time
from mp4ds.dataset.stream import Stream
from mp4ds.errors import Refused, VideoError
from mp4ds.files.outputs import digest_file
from mp4ds.format.fields import (
    FORMAT_VERSION,
    MAX_CAMERA_INFOS,
    MAX_FRAMES,
    MAX_VARIANTS,
    MESSAGES_NAME,
    Columns,
    DecodedColumns,
    Quality,
    columns_model,
    digests_model,
    exceeds_padding,
    within,
)
from mp4ds.format.manifest import (
    FileEntry,
    LossEntry,
    StreamEntry,
    TimeRange,
    Verbatim,
    static_transforms,
)
from mp4ds.format.models import (
    FACTS,
    Calibration,
    CameraInfo,
    Header,
    StreamSidecar,
    exact_name,
    video_facts,
)
from mp4ds.format.sidecars import MANIFEST_NAME, FileNames, dump_document, verify_file
from mp4ds.messages.transforms import Transform, TransformCollector
from mp4ds.records import (
    EVERYTHING,
    MAX_REASONS,
    OTHER_REASONS,
    Channel,
    Message,
    bounded,
)
from mp4ds.times import PresentationClock
from mp4ds.video.mp4 import SampleEntry
from mp4ds.video.packets import cut_segment, entry_of, join_segments

Integers = NDArray[np.int64]
_Identity = tuple[object, ...]
_AT_ONCE = 4  # more would only wait for the disk
_NONE = np.empty(0, np.int64)


def concat(
    datasets: Sequence[Dataset],
    folder: Path,
    *,
    part: RecordingSlice = WHOLE,
    selected: Callable[[str], bool] = lambda _: True,
    others: bool = True,
    changes: dict[str, Any] | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> None:
    """Make one dataset of several that follow one another, or a copy of one or of a part of it.

    All that is read is checked: whole files against their manifest, what is cut out of a file
    against its digests. Frames before the span that belong to the group of pictures in which it
    begins are also in the new video, hidden by its edit list (spec, "The video").

    Args:
        datasets: Folders made by `mp4ds pack`, at least one. Streams that agree in all that a
            sidecar tells once are joined. Those of which messages overlap in time have no topic
            in common.
        folder: The folder to fill, empty.
        part: What to copy of the only dataset; the topics of its span are ignored.
        selected: Whether a topic is to be copied.
        others: Whether attachments and metadata records are.
        changes: Fields of the manifest that differ from those of the first dataset.
        report: Called with the name of each file when it is begun, perhaps in another thread.

    Raises:
        Refused: It cannot be copied; says why. Nothing was written.
        FormatError: A file does not match its dataset.
        OSError: The disk could not be written.
    """
    sources: list[_Source] = []
    earlier = Counter[_Identity]()
    for dataset in datasets:
        sources.append(_Source(dataset, part, selected, earlier))
        earlier.update(sources[-1].counts)
    streams: list[_JoinedStream] = []
    for segment in chain(*(source.segments for source in sources)):
        if segment.images:
            joined = next((stream for stream in streams if stream.takes(segment)), None)
            if joined is None:
                streams.append(_JoinedStream(segment))
            else:
                joined.add(segment)
    for source in sources:
        source.dataset.verify_sidecars(selected)
        if len(sources) > 1:
            source.dataset.verify_messages()
    made = _write_streams(streams, folder, report, is_one=len(sources) == 1)
    report(MESSAGES_NAME)
    path = folder / MESSAGES_NAME
    transforms = _write_messages(sources, path, list(made.values()), others=others)
    old = sources[0].manifest
    ranges = [source.range for source in sources if source.range]
    losses = [entry.to_record() for source in sources for entry in source.manifest.losses]
    update = {
        **contents(folder, made),
        "messages": earlier.total(),
        "losses": list(map(LossEntry.from_record, bounded(losses))),
        "topics_left_out": list(dict.fromkeys(chain(*(one.left_out for one in sources)))),
        "time_range": TimeRange(start=min(ranges)[0], end=max(end for _, end in ranges))
        if ranges
        else None,
        "verbatim": _verbatim(sources),
    }
    if transforms is not None:
        update["transforms"] = static_transforms(list(made.values()), transforms)
    manifest = old.model_copy(update={**update, **(changes or {})})
    (folder / MANIFEST_NAME).write_bytes(dump_document(manifest))


def contents(folder: Path, sidecars: Mapping[str, StreamSidecar]) -> dict[str, Any]:
    """The fields of a manifest that list the files of a folder.

    Args:
        folder: Holds all of them.
        sidecars: By their names.
    """
    files = {
        video.file: (video.size or 0, video.sha256 or "")
        for sidecar in sidecars.values()
        for video in sidecar.videos
    }
    files |= {name: digest_file(folder / name) for name in (MESSAGES_NAME, *sidecars)}
    return {
        "mp4ds": FORMAT_VERSION,
        "streams": [StreamEntry.of(name, sidecar) for name, sidecar in sidecars.items()],
        "files": [
            FileEntry(name=name, size=size, sha256=sha256)
            for name, (size, sha256) in sorted(files.items())
        ],
    }


# ---------------------------------------------------------------- what is copied


@dataclass(frozen=True, eq=False)
class _Rows:
    """What is copied of the columns of images, or of calibrations.

    Attributes:
        columns: Of all of them.
        numbers: Of those that are copied.
        models: The headers of the images, or the calibrations, which variants are numbers of.
        offset: What is added to their ordinals.
    """

    columns: DecodedColumns
    numbers: Integers
    models: Sequence[Any]
    offset: int

    def __len__(self) -> int:
        return len(self.numbers)

    @cached_property
    def used_models(self) -> list[Any]:
        """Those of what is copied."""
        kinds = np.unique(self.columns.variant[self.numbers])
        return [self.models[kind] for kind in kinds.tolist()]


@dataclass(frozen=True, eq=False)
class _Segment:
    """What is copied of a stream.

    Attributes:
        source: The dataset.
        stream: Of the dataset.
        images: Which images.
        infos: Which calibrations; None if the stream has no messages with any.
    """

    source: _Source
    stream: Stream
    images: _Rows
    infos: _Rows | None


class _Source:
    """What is copied of a dataset.

    Args:
        dataset: The dataset.
        part: The slice of it.
        selected: Whether a topic is to be copied.
        earlier: How many messages of each channel come before, from other datasets.

    Attributes:
        counts: How many messages are copied, by channel.
        segments: What is copied of each stream.

    Raises:
        Refused: It cannot be copied; says why.
    """

    def __init__(
        self,
        dataset: Dataset,
        part: RecordingSlice,
        selected: Callable[[str], bool],
        earlier: Mapping[_Identity, int],
    ) -> None:
        if dataset.manifest is None:
            raise Refused("it is a single video, not a dataset")
        self.dataset = dataset
        self.manifest = dataset.manifest
        self.selected = selected
        self.is_slice = part.span != EVERYTHING
        if self.is_slice and not dataset.is_in_time:
            raise Refused("its messages are not ordered by log time")
        self.span = part.span
        self.latched = [message for message in part.latched if selected(message.channel.topic)]
        self.channels = [item for item in dataset.channels if selected(item.topic)]
        times = dataset.times({channel.topic for channel in self.channels})
        by_identity: dict[_Identity, list[Integers]] = {}
        for channel in self.channels:  # several may be equal
            by_identity.setdefault(channel.identity, []).append(times.get(channel.id, _NONE))
        self._times = {key: np.sort(np.concatenate(own)) for key, own in by_identity.items()}
        early = Counter(message.channel.identity for message in self.latched)
        self.counts = {
            key: len(in_span(own, self.span)) + early[key] for key, own in self._times.items()
        }
        # what is added to the ordinals of a channel, of which messages before the span are left out
        self._offsets = {
            key: earlier.get(key, 0) + early[key] - int(np.searchsorted(own, self.span.start))
            if self.span.start is not None
            else earlier.get(key, 0)
            for key, own in self._times.items()
        }
        self.segments: list[_Segment] = []
        for stream in dataset.streams:
            if len(set(map(selected, stream.topics))) > 1:
                raise Refused(f"{' and '.join(stream.topics)} share one stream")
            if selected(stream.topic):
                images = self._rows(stream, stream.sidecar.headers)
                if np.any(np.diff(images.numbers) != 1):
                    raise Refused(f"frames of {stream.topic} are not ordered by time")
                infos = stream.infos
                rows = self._rows(infos, infos.info.calibrations) if infos else None
                self.segments.append(_Segment(self, stream, images, rows))

    def _rows(self, part: Part, models: Sequence[Any]) -> _Rows:
        """The messages in the span."""
        numbers = np.fromiter(within(self.span)(part.columns), np.int64)
        return _Rows(part.columns, numbers, models, self._offsets[part.channel.identity])

    @property
    def left_out(self) -> list[str]:
        """Topics that are not copied, or were left out before."""
        own = [item.topic for item in self.dataset.channels if not self.selected(item.topic)]
        return [*self.manifest.topics_left_out, *own]

    @cached_property
    def range(self) -> tuple[int, int] | None:
        """Log times of the first and the last message copied, ns."""
        times = [in_span(one, self.span) for one in self._times.values()]
        times.append(np.array([item.log_time for item in self.latched], np.int64))
        found = np.concatenate(times)
        return (int(found.min()), int(found.max())) if len(found) else None

    def verbatim(self) -> list[Verbatim]:
        """Camera messages in messages.mcap, by topic, with the known reasons."""
        old = [item for item in self.manifest.verbatim if self.selected(item.topic)]
        if not self.is_slice:
            return old
        found, file = [], self.dataset.messages_file
        for topic in dict.fromkeys(item.topic for item in old):
            ids = [item.id for item in file.channels if item.topic == topic]
            inside = in_span(file.times_of(ids), self.span)
            if len(inside):
                own = [times for identity, times in self._times.items() if identity[0] == topic]
                times = in_span(np.sort(np.concatenate([_NONE, *own])), self.span)
                first = int(np.searchsorted(times, inside[0]))
                reason = "; or ".join(item.reason for item in old if item.topic == topic)
                found.append(
                    Verbatim(topic=topic, messages=len(inside), first=first, reason=reason)
                )
        return found

    def recorded_messages(self) -> Iterator[Message]:
        """The messages for messages.mcap, by log time.

        Includes the calibrations of streams without frames in the span.
        """
        topics = frozenset(channel.topic for channel in self.channels)
        recorded = self.dataset.recorded_messages(replace(self.span, topics=topics))
        channels = {channel.identity: channel for channel in self.channels}
        orphans = [
            infos.messages(channels[infos.channel.identity], within(self.span))
            for segment in self.segments
            if (infos := segment.stream.infos) and segment.infos and not segment.images
        ]
        calibrations = [(message for _, message in messages) for messages in orphans]
        return chain(self.latched, by_time(recorded, *calibrations))


def _verbatim(sources: Sequence[_Source]) -> list[Verbatim]:
    """Camera messages in messages.mcap, by topic and reason."""
    found: dict[tuple[str, str], Verbatim] = {}
    earlier = Counter[str]()
    for source in sources:
        for entry in source.verbatim():
            known = sum(topic == entry.topic for topic, _ in found)
            key = (entry.topic, entry.reason)
            if key not in found and len(sources) > 1 and known >= MAX_REASONS:
                key = (entry.topic, OTHER_REASONS)
            first, messages = entry.first + earlier[entry.topic], entry.messages
            if key in found:
                first, messages = found[key].first, found[key].messages + messages
            found[key] = Verbatim(topic=key[0], messages=messages, first=first, reason=key[1])
        for (topic, *_), count in source.counts.items():
            earlier[str(topic)] += count
    return list(found.values())


# ---------------------------------------------------------------- videos


def _write_streams(
    streams: Sequence[_JoinedStream], folder: Path, report: Callable[[str], None], *, is_one: bool
) -> dict[str, StreamSidecar]:
    """Write videos and sidecars; the sidecars are returned by their names."""
    names = FileNames()
    firsts = [stream.first for stream in streams]
    stems = [first.path.stem if is_one else names.name_for(first.topic) for first in firsts]

    def write(stem: str, stream: _JoinedStream) -> tuple[str, StreamSidecar]:
        report(f"{stem}.mp4")
        sidecar = stream.write(stem, folder)
        (folder / f"{stem}.yaml").write_bytes(dump_document(sidecar))
        return f"{stem}.yaml", sidecar

    # copying and hashing run without Python's lock
    with ThreadPoolExecutor(_AT_ONCE) as threads:
        return dict(threads.map(write, stems, streams))


class _JoinedStream:
    """A stream of the new dataset: segments, in order."""

    def __init__(self, first: _Segment) -> None:
        self.segments: list[_Segment] = []
        self._identity = _common(first.stream.sidecar)
        self._entries = _entries(first.stream)
        # by their text, in which 0.0 and -0.0 differ, and NaNs are equal
        self._headers: dict[str, Header] = {}
        self._calibrations: dict[str, Calibration] = {}
        self._frames = self._infos = 0
        self._info: CameraInfo | None = None
        self.add(first)

    @property
    def first(self) -> Stream:
        """The stream that it begins with."""
        return self.segments[0].stream

    def takes(self, segment: _Segment) -> bool:
        """Whether a segment continues this stream.

        Raises:
            VideoError: Its video is damaged.
        """
        stream, sidecar = segment.stream, segment.stream.sidecar
        if sidecar.channel != self.first.sidecar.channel:
            return False  # most often: the rest takes longer to compare
        if segment.source is self.segments[-1].source or _common(sidecar) != self._identity:
            return False
        if stream.hides_frames or self.first.hides_frames:
            return False  # what a slice hides refers to nothing in another segment
        headers = [*self._headers.values(), *segment.images.used_models]
        if exceeds_padding(head.padding for head in headers):
            return False
        if not _has_room(self._headers, segment.images.used_models):
            return False
        if self._frames + len(segment.images) > MAX_FRAMES:
            return False
        pairs = zip(self._entries, _entries(stream), strict=True)
        if any(own.differences(other) for own, other in pairs):
            return False  # JPEG files may differ in chroma subsampling
        info = sidecar.camera_info
        if info is None or self._info is None:
            return True
        return (
            info.channel == self._info.channel
            and info.wire == self._info.wire
            and _has_room(self._calibrations, segment.infos.used_models if segment.infos else ())
            and self._infos + len(segment.infos or ()) <= MAX_CAMERA_INFOS
        )

    def add(self, segment: _Segment) -> None:
        """Add the first segment, or one that it `takes`."""
        self.segments.append(segment)
        self._frames += len(segment.images)
        for header in segment.images.used_models:
            self._headers.setdefault(repr(header), header)
        info = segment.stream.sidecar.camera_info
        if info is not None and (not info.messages or segment.infos):
            self._info = self._info or info
            self._infos += len(segment.infos or ())
            for calibration in segment.infos.used_models if segment.infos else ():
                self._calibrations.setdefault(repr(calibration), calibration)

    @cached_property
    def _columns(self) -> dict[str, Integers]:
        return _joined([part.images for part in self.segments], self._headers)

    def write(self, stem: str, folder: Path) -> StreamSidecar:
        """Write the videos; the sidecar is returned.

        Raises:
            VideoError: A segment is damaged.
            OSError: It cannot be written.
        """
        first = self.first
        for part in self.segments if len(self.segments) > 1 else ():
            part.stream.verify_video()
        names = [f"{stem}.mp4"]
        if first.sidecar.view:
            names.insert(0, exact_name(*names))
        facts, *of_view = (self._write_video(folder / name, n) for n, name in enumerate(names))
        view = first.sidecar.view
        qualities = [
            (quality.of(part.images.numbers, len(part.stream)), len(part.images))
            for part in self.segments
            if (quality := part.stream.sidecar.video.quality) is not None
        ]
        if qualities:
            alone = len(qualities) == 1
            facts["quality"] = qualities[0][0] if alone else Quality.joined(qualities)
        digests = [
            own.decode(len(part.stream))[part.images.numbers]
            for part in self.segments
            if (own := part.stream.sidecar.digests) is not None
        ]
        return first.sidecar.model_copy(
            update={
                "mp4ds": FORMAT_VERSION,
                "frames": self._frames,
                "headers": list(self._headers.values()),
                "video": first.sidecar.video.model_copy(update=facts),
                "view": view and view.model_copy(update=of_view[0]),
                "camera_info": self._camera_info(),
                "columns": columns_model(self._columns),
                "digests": digests_model(np.concatenate(digests).tolist()) if digests else None,
            }
        )

    def _write_video(self, path: Path, number: int) -> dict[str, Any]:
        """Write the video, or the view as number 1, from those of the segments.

        Returns:
            What the sidecar tells of the file.
        """
        videos = [part.stream.videos[number] for part in self.segments]
        (source, old), part = videos[0], self.segments[0]
        is_whole = len(videos) == 1 and len(part.images) == len(part.stream)
        if len(videos) > 1:
            join_segments([own for own, _ in videos], self._ticks(), path)
        elif is_whole:
            _copy_file(source, path)
        else:
            numbers = part.images.numbers
            frames = range(int(numbers[0]), int(numbers[-1]) + 1)
            cut_segment(source, frames, self._ticks(), path)
        facts = video_facts(path, old.codec)
        if is_whole:
            if old.sha256 not in (None, facts["sha256"]):
                raise VideoError(
                    "hash-mismatch", source, "does not match the SHA-256 in its sidecar"
                )
            entry = part.source.manifest.file(source.name)
            verify_file(source, entry, found=(facts["size"], facts["sha256"]))
        return facts

    def _ticks(self) -> list[int]:
        """When each frame is shown."""
        clock = PresentationClock()
        stamps, log_times = self._columns["stamp"], self._columns["log_time"]
        return list(map(clock.tick, stamps.tolist(), log_times.tolist()))

    def _camera_info(self) -> CameraInfo | None:
        if self._info is None or not self._infos:
            return self._info  # with calibrations that no message told
        rows = [part.infos for part in self.segments if part.infos]
        columns = _joined(rows, self._calibrations)
        return self._info.model_copy(
            update={
                "messages": self._infos,
                "calibrations": list(self._calibrations.values()),
                "columns": columns_model(columns),
            }
        )


def _entries(stream: Stream) -> list[SampleEntry]:
    return [entry_of(path) for path, _ in stream.videos]


def _has_room(known: Mapping[str, object], models: Iterable[object]) -> bool:
    """Whether there would not be too many with some more."""
    return len(known.keys() | set(map(repr, models))) <= MAX_VARIANTS


def _joined(rows: Sequence[_Rows], models: Mapping[str, object]) -> dict[str, Integers]:
    """The columns of rows, one after another, whose variants are numbers of the models."""
    numbers = {key: number for number, key in enumerate(models)}
    columns: dict[str, list[Integers]] = {}
    for part in rows:
        for name in Columns.model_fields:
            if (array := getattr(part.columns, name)) is not None:
                columns.setdefault(name, []).append(array[part.numbers])
        # those that are not used have no number
        kinds = np.array([numbers.get(repr(model), 0) for model in part.models], np.int64)
        columns["variant"][-1] = kinds[columns["variant"][-1]]
        columns["ordinal"][-1] = columns["ordinal"][-1] + part.offset
    return {name: np.concatenate(arrays) for name, arrays in columns.items()}


_OWN = {"mp4ds", "frames", "headers", "video", "view", "camera_info", "columns", "digests"}


def _common(sidecar: StreamSidecar) -> tuple[object, ...]:
    """What all segments of a stream have in common."""
    info, columns = sidecar.camera_info, sidecar.columns
    optional = (sidecar.digests, sidecar.video.quality, columns.seq, columns.pts)
    return (
        sidecar.model_dump(exclude=_OWN),
        [video.model_dump(exclude={*FACTS, "quality"}) for video in sidecar.videos],
        [value is None for value in optional],
        info if info and not info.messages else None,  # nothing tells when one applied
    )


def _copy_file(path: Path, to: Path) -> None:
    """Copy a file, which may be at a URL."""
    with path.open("rb") as source, to.open("wb") as target:
        shutil.copyfileobj(source, target, 2**20)


# ---------------------------------------------------------------- messages


def _write_messages(
    sources: Sequence[_Source], path: Path, sidecars: Sequence[StreamSidecar], *, others: bool
) -> Sequence[Transform] | None:
    """Write messages.mcap; returns the static transforms of several datasets."""
    first = sources[0]
    dataset = first.dataset
    if len(sources) == 1 and not first.is_slice and len(first.channels) == len(dataset.channels):
        _copy_file(dataset.path / MESSAGES_NAME, path)
        verify_file(
            dataset.path / MESSAGES_NAME,
            first.manifest.file(MESSAGES_NAME),
            found=digest_file(path),
        )
        return None
    in_videos = identities(sidecars)
    collector = TransformCollector()
    channels = _channels(sources)

    def messages(number: int) -> Iterator[Message]:
        for message in sources[number].recorded_messages():
            yield message.of_channel(channels[number][message.channel.id])

    starts = [source.range[0] if source.range else 0 for source in sources]
    with McapWriter(path, profile=dataset.profile) as writer:
        kept = (source.dataset.messages_file.others() for source in sources if others)
        for record in chain(chain.from_iterable(kept), merged(starts, messages)):
            write_record(writer, record)
            if isinstance(record, Message):
                collector.add(record.channel, record.data)
        for channel in chain(*(known.values() for known in channels)):
            if channel.identity not in in_videos:
                writer.add_channel(channel)
        for source in sources:
            for schema in source.dataset.messages_file.unused_schemas:
                writer.add_schema(schema)
    return collector.transforms if len(sources) > 1 else None


def identities(sidecars: Iterable[StreamSidecar]) -> set[tuple[object, ...]]:
    """The channels whose messages are in videos, or sidecars."""
    return {
        model.to_record(0).identity
        for sidecar in sidecars
        for model in (sidecar.channel, sidecar.camera_info and sidecar.camera_info.channel)
        if model
    }


def _channels(sources: Sequence[_Source]) -> list[dict[int, Channel]]:
    """For each dataset, the new channel by the id of its own.

    Channels of later datasets become those that equal them; in a recording, several may be equal.
    """
    found = [{channel.id: channel for channel in sources[0].channels}]
    known = {channel.identity: channel for channel in reversed(sources[0].channels)}
    next_id = 1 + max(found[0], default=0)
    for source in sources[1:]:
        made = {}
        for channel in source.channels:
            if channel.identity not in known:
                known[channel.identity] = replace(channel, id=next_id)
                next_id += 1
            made[channel.id] = known[channel.identity]
        found.append(made)
    return found
