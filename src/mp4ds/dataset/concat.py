"""Puts datasets that follow one another together: packets are copied, nothing is encoded.

A copy or a slice is made in the same way: of one dataset, of which a span and topics are chosen.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.mcap import McapWriter
from mp4ds.bags.protocols import in_span, write_record
from mp4ds.dataset.channels import by_time
from mp4ds.dataset.columns import DecodedColumns, within
from mp4ds.dataset.dataset import Dataset
from mp4ds.dataset.segments import JoinedStream, Segment, copy_file
from mp4ds.dataset.stream import Stream
from mp4ds.errors import Refused
from mp4ds.files.outputs import digest_file
from mp4ds.format.fields import (
    FORMAT_VERSION,
    MESSAGES_NAME,
)
from mp4ds.format.manifest import (
    FileEntry,
    LossEntry,
    Manifest,
    StreamEntry,
    TimeRange,
    Verbatim,
    static_transforms,
)
from mp4ds.format.models import (
    ChannelModel,
    StreamSidecar,
)
from mp4ds.format.sidecars import MANIFEST_NAME, dump_document, verify_file
from mp4ds.messages.transforms import Transform, TransformCollector
from mp4ds.plan import FileNames
from mp4ds.records import (
    EVERYTHING,
    MAX_REASONS,
    OTHER_REASONS,
    Channel,
    Excerpt,
    Message,
    bounded,
)

Integers = NDArray[np.int64]
_Identity = tuple[object, ...]
_AT_ONCE = 4  # more would only wait for the disk
_NO_TIMES = np.empty(0, np.int64)


def concat(
    datasets: Sequence[Dataset],
    folder: Path,
    *,
    span: Excerpt = EVERYTHING,
    latched: Sequence[Message] = (),
    selected: Callable[[str], bool] = lambda _: True,
    changes: dict[str, Any] | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> tuple[Manifest, list[StreamSidecar]]:
    """Make one dataset of several that follow one another, or a copy of one or of a part of it.

    All that is read is checked: whole files against their manifest, what is cut out of a file
    against its digests. Frames before the span that belong to the group of pictures in which it
    begins are also in the new video, hidden by its edit list (spec, "The video").

    Args:
        datasets: Folders made by `mp4ds pack`, at least one. Streams that agree in all that a
            sidecar tells once are joined. Those of which messages overlap in time have no topic
            in common.
        folder: The folder to fill, empty.
        span: What to copy of the only dataset; its topics are ignored.
        latched: Its messages from before the span that are copied, too.
        selected: Whether a topic is to be copied.
        changes: Fields of the manifest that differ from those of the first dataset.
        report: Called with the name of each file when it is begun, perhaps in another thread.

    Returns:
        The new manifest and sidecars, already written.

    Raises:
        Refused: It cannot be copied; says why. Nothing was written.
        FormatError: A file does not match its dataset.
        OSError: The disk could not be written.
    """
    latched = [message for message in latched if selected(message.channel.topic)]
    parts = [_Part(dataset, span, latched, selected) for dataset in datasets]
    for part in parts:
        part.check()
    return _Concat(parts, folder, report).write(changes or {})


class _Part:
    """What is copied of a dataset."""

    def __init__(
        self,
        dataset: Dataset,
        span: Excerpt,
        latched: Sequence[Message],
        selected: Callable[[str], bool],
    ) -> None:
        if dataset.manifest is None:
            raise Refused("it is a single video, not a dataset")
        self.dataset = dataset
        self.manifest = dataset.manifest
        self.span = span
        self.latched = latched
        self.selected = selected
        self.is_slice = span.start is not None or span.end is not None
        self._early = Counter(message.channel.identity for message in latched)
        self.segments = [self._segment(stream) for stream in dataset.streams]

    def _segment(self, stream: Stream) -> Segment:
        infos: Integers = _NO_TIMES
        if stream.infos and self.selected(stream.infos.channel.topic):
            infos = self._numbers(stream.infos.columns)
        images = self._numbers(stream.columns) if self.selected(stream.topic) else _NO_TIMES
        return Segment(self.dataset, stream, images, infos)

    def _numbers(self, columns: DecodedColumns) -> Integers:
        """Numbers of the messages in the span."""
        start, end = self.span.start, self.span.end
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
        if self.is_slice and not self.dataset.is_in_time:
            raise Refused("its messages are not ordered by log time")
        for segment in self.segments:
            topics = segment.stream.topics
            if len(set(map(self.selected, topics))) > 1:
                raise Refused(f"{' and '.join(topics)} share one stream")
            if np.any(np.diff(segment.images) != 1):
                raise Refused(f"frames of {topics[0]} are not ordered by time")

    @cached_property
    def times(self) -> dict[_Identity, Integers]:
        """Sorted log times of all messages on selected topics, by channel identity."""
        times = self.dataset.times()
        found: dict[_Identity, list[Integers]] = {}
        for channel in self.dataset.channels:  # several may be equal
            if self.selected(channel.topic):
                found.setdefault(channel.identity, []).append(times.get(channel.id, _NO_TIMES))
        return {key: np.sort(np.concatenate(arrays)) for key, arrays in found.items()}

    def count(self, identity: _Identity) -> int:
        """How many messages of a channel are copied."""
        times = self.times.get(identity, _NO_TIMES)
        return len(in_span(times, self.span)) + self._early[identity]

    def before(self, identity: _Identity) -> int:
        """How many messages of a channel come before the span and are left out."""
        if self.span.start is None:
            return 0
        return int(np.searchsorted(self.times[identity], self.span.start)) - self._early[identity]

    def messages(self, topic: str) -> int:
        """How many messages of a topic are copied."""
        identities = {item.identity for item in self.dataset.channels if item.topic == topic}
        return sum(map(self.count, identities))

    @property
    def has_all_topics(self) -> bool:
        """Whether every topic is copied."""
        return all(self.selected(channel.topic) for channel in self.dataset.channels)

    @property
    def left_out(self) -> list[str]:
        """Topics that are not copied, or were left out before."""
        own = [item.topic for item in self.dataset.channels if not self.selected(item.topic)]
        return [*self.manifest.topics_left_out, *own]

    @cached_property
    def range(self) -> tuple[int, int] | None:
        """Log times of the first and the last message copied, ns."""
        times = [in_span(one, self.span) for one in self.times.values()]
        times.append(np.sort(np.array([item.log_time for item in self.latched], np.int64)))
        times = [one for one in times if len(one)]
        if not times:
            return None
        return min(int(one[0]) for one in times), max(int(one[-1]) for one in times)

    def verbatim(self) -> list[Verbatim]:
        """Camera messages in messages.mcap, by topic, with the known reasons."""
        old = self.manifest.verbatim
        if not self.is_slice:
            return [item for item in old if self.selected(item.topic)]
        found = []
        for topic in dict.fromkeys(item.topic for item in old):
            reasons = [item.reason for item in old if item.topic == topic]
            times = np.sort(np.concatenate([_NO_TIMES, *self._times_of(topic)]))
            inside = in_span(self.dataset.recorded_times(topic), self.span)
            if self.selected(topic) and len(inside):
                first = int(np.searchsorted(in_span(times, self.span), inside[0]))
                entry = Verbatim(
                    topic=topic, messages=len(inside), first=first, reason="; or ".join(reasons)
                )
                found.append(entry)
        return found

    def _times_of(self, topic: str) -> list[Integers]:
        times = self.dataset.times()
        channels = [item for item in self.dataset.channels if item.topic == topic]
        return [times[item.id] for item in channels if item.id in times]

    def verbatim_messages(self) -> Iterator[Message]:
        """The messages for messages.mcap, by log time.

        Includes the calibrations of streams without frames in the span.
        """
        topics = {item.topic for item in self.dataset.channels if self.selected(item.topic)}
        recorded = self.dataset.recorded_messages(replace(self.span, topics=frozenset(topics)))
        orphans = [self._orphans(one) for one in self.segments if not len(one.images)]
        found = by_time(recorded, *orphans)
        return chain(self.latched, found)

    def _orphans(self, segment: Segment) -> Iterator[Message]:
        infos = segment.stream.infos
        if infos is None or not len(segment.infos):
            return iter(())
        channels = {channel.identity: channel for channel in self.dataset.channels}
        found = infos.messages(channels[infos.channel.identity], within(self.span))
        return (message for _, message in found)


class _Concat:
    """See `concat`."""

    def __init__(self, parts: Sequence[_Part], folder: Path, report: Callable[[str], None]) -> None:
        self._parts = parts
        self._folder = folder
        self._report = report
        self._copied: list[str] = []  # names of files copied as a whole
        self._messages = Counter[_Identity]()  # copied, by channel
        self._channels: dict[tuple[int, int], Channel] = {}  # by number of the part, and id there
        self._streams: list[JoinedStream] = []
        for number, part in enumerate(parts):
            for segment in part.segments:
                if len(segment.images):
                    self._add(segment, part)
            for identity in part.times:
                self._messages[identity] += part.count(identity)
            self._add_channels(number, part)

    @property
    def _is_one(self) -> bool:
        return len(self._parts) == 1

    def _add(self, segment: Segment, part: _Part) -> None:
        channels = [
            segment.stream.channel,
            *([segment.stream.infos.channel] if segment.stream.infos else []),
        ]
        offsets = [self._messages[one.identity] - part.before(one.identity) for one in channels]
        segment = replace(segment, offsets=(offsets[0], offsets[-1]))
        joined = next((joined for joined in self._streams if joined.takes(segment)), None)
        if joined is None:
            self._streams.append(JoinedStream(segment))
        else:
            joined.add(segment)

    def _add_channels(self, number: int, part: _Part) -> None:
        """Map channels of a part to those that equal them; in a recording, several may be equal."""
        known = {channel.identity: channel for channel in reversed(self._channels.values())}
        next_id = 1 + max((channel.id for channel in self._channels.values()), default=0)
        for channel in part.dataset.channels:
            if part.selected(channel.topic):
                same = known.get(channel.identity) if number else channel
                if same is None:
                    same = replace(channel, id=next_id)
                    known[channel.identity] = same
                    next_id += 1
                self._channels[number, channel.id] = same

    def write(self, changes: dict[str, Any]) -> tuple[Manifest, list[StreamSidecar]]:
        """Write all files, the manifest last."""
        parts = self._parts
        for part in parts:
            part.dataset.verify_sidecars(part.selected)
            if not self._is_one:
                part.dataset.verify_messages()
        made = self._write_streams()
        self._report(MESSAGES_NAME)
        transforms = self._write_messages([sidecar for _, sidecar in made])
        digests = {
            sidecar.video.file: (sidecar.video.size or 0, sidecar.video.sha256 or "")
            for _, sidecar in made
        }
        for name in (MESSAGES_NAME, *(name for name, _ in made)):
            digests[name] = digest_file(self._folder / name)
        for name in self._copied:
            source = parts[0]
            path = source.dataset.path / name
            verify_file(path, source.manifest.file(name), found=digests[name])
        ranges = [found for part in parts if (found := part.range)]
        losses = [entry.to_record() for part in parts for entry in part.manifest.losses]
        old = parts[0].manifest
        manifest = old.model_copy(
            update={
                "mp4ds": FORMAT_VERSION,
                "messages": sum(self._messages.values()),
                "losses": list(map(LossEntry.from_record, bounded(losses))),
                "topics_left_out": list(dict.fromkeys(chain(*(part.left_out for part in parts)))),
                "time_range": TimeRange(
                    start=min(start for start, _ in ranges), end=max(end for _, end in ranges)
                )
                if ranges
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
                "transforms": old.transforms
                if self._is_one
                else static_transforms([sidecar for _, sidecar in made], transforms),
                "verbatim": self._verbatim(),
                "files": [
                    FileEntry(name=name, size=size, sha256=sha256)
                    for name, (size, sha256) in sorted(digests.items())
                ],
                **changes,
            }
        )
        (self._folder / MANIFEST_NAME).write_bytes(dump_document(manifest))
        return manifest, [sidecar for _, sidecar in made]

    def _verbatim(self) -> list[Verbatim]:
        """Camera messages in messages.mcap, by topic and reason."""
        found: dict[tuple[str, str], Verbatim] = {}
        earlier = Counter[str]()
        for part in self._parts:
            for entry in part.verbatim():
                known = sum(topic == entry.topic for topic, _ in found)
                key = (entry.topic, entry.reason)
                if key not in found and not self._is_one and known >= MAX_REASONS:
                    key = (entry.topic, OTHER_REASONS)
                first, messages = entry.first + earlier[entry.topic], entry.messages
                if key in found:
                    first, messages = found[key].first, found[key].messages + messages
                found[key] = Verbatim(topic=key[0], messages=messages, first=first, reason=key[1])
            for topic in {channel.topic for channel in part.dataset.channels}:
                earlier[topic] += part.messages(topic)
        return list(found.values())

    # ------------------------------------------------------------ videos

    def _write_streams(self) -> list[tuple[str, StreamSidecar]]:
        names = FileNames()
        stems = [
            first.video_path.stem if self._is_one else names.name_for(first.topic)[0]
            for first in (stream.first for stream in self._streams)
        ]
        if self._is_one:
            whole = (stream for stream in self._streams if stream.segments[0].has_all)
            self._copied += [stream.first.video_path.name for stream in whole]

        def write(stem: str, stream: JoinedStream) -> tuple[str, StreamSidecar]:
            self._report(f"{stem}.mp4")
            sidecar = stream.write(stem, self._folder)
            (self._folder / f"{stem}.yaml").write_bytes(dump_document(sidecar))
            return f"{stem}.yaml", sidecar

        # copying and hashing run without Python's lock
        with ThreadPoolExecutor(_AT_ONCE) as threads:
            return list(threads.map(write, stems, self._streams))

    # ------------------------------------------------------------ messages

    def _write_messages(self, sidecars: Sequence[StreamSidecar]) -> Iterable[Transform]:
        """Write messages.mcap; returns the static transforms, unless it was merely copied."""
        part, path = self._parts[0], self._folder / MESSAGES_NAME
        if self._is_one and not part.is_slice and part.has_all_topics:
            copy_file(part.dataset.path / MESSAGES_NAME, path)
            self._copied.append(MESSAGES_NAME)
            return ()
        in_videos: set[_Identity] = set()
        for sidecar in sidecars:
            in_videos.add(_identity_of(sidecar.channel))
            if sidecar.camera_info:
                in_videos.add(_identity_of(sidecar.camera_info.channel))
        collector = TransformCollector()
        with McapWriter(path, profile=part.dataset.profile) as writer:
            others = (part.dataset.other_records() for part in self._parts)
            for record in chain(chain.from_iterable(others), self._recorded_messages()):
                write_record(writer, record)
                if isinstance(record, Message):
                    collector.add(record.channel, record.data)
            for channel in self._channels.values():
                if channel.identity not in in_videos:
                    writer.add_channel(channel)
            for part in self._parts:
                for schema in part.dataset.unused_schemas:
                    writer.add_schema(schema)
        return collector.transforms

    def _recorded_messages(self) -> Iterator[Message]:
        """The messages for messages.mcap, by log time."""
        chains: list[list[int]] = []  # of parts that do not overlap, of which one is read at a time
        ends: list[int] = []
        for number, part in enumerate(self._parts):
            begin, end = part.range or (0, 0)
            place = next((i for i, before in enumerate(ends) if before <= begin), len(chains))
            if place == len(chains):
                chains.append([])
                ends.append(end)
            chains[place].append(number)
            ends[place] = end

        def messages(numbers: Sequence[int]) -> Iterator[Message]:
            for number in numbers:
                for message in self._parts[number].verbatim_messages():
                    yield message.of_channel(self._channels[number, message.channel.id])

        return by_time(*map(messages, chains))


def _identity_of(channel: ChannelModel) -> _Identity:
    return channel.to_record(0).identity
