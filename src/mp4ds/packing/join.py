"""Joins separately packed parts of a recording: video segments, columns, messages."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.mcap import McapReader
from mp4ds.bags.mcap_write import McapWriter
from mp4ds.bags.protocols import BagReader, write_record
from mp4ds.dataset.rebuild import columns_model, digests_model
from mp4ds.errors import FormatError, SourceError
from mp4ds.files.outputs import digest_file
from mp4ds.format.fields import (
    MAX_CAMERA_INFOS,
    MAX_FRAMES,
    MAX_VARIANTS,
    Columns,
    Digests,
    exceeds_padding,
)
from mp4ds.format.models import (
    FACTS,
    Calibration,
    CameraInfo,
    Header,
    Quality,
    StreamSidecar,
    video_facts,
)
from mp4ds.format.sidecars import dump_document
from mp4ds.packing.manifest import PartRecord, PartStream, declare_rest
from mp4ds.plan import FileNames
from mp4ds.records import Attachment, Channel, Message, MetadataRecord
from mp4ds.times import PresentationClock
from mp4ds.video.mp4 import read_sample_entry
from mp4ds.video.packets import join_segments

_ModelT = TypeVar("_ModelT")


class StreamJoin:
    """Collects the segments of one stream, in order.

    Args:
        sidecar: Of the first segment, for which `add` must still be called.
        video: Its video.
    """

    def __init__(self, sidecar: StreamSidecar, video: Path) -> None:
        self._first = sidecar
        self._entry = read_sample_entry(video)
        self._identity = _identity(sidecar)
        self._videos: list[Path] = []
        self._digests: list[NDArray[np.uint64]] = []
        self._columns = _JoinedColumns()
        self._headers = _Numbered[Header]()
        self._infos = _JoinedColumns()
        self._calibrations = _Numbered[Calibration]()
        self._info: CameraInfo | None = None
        self._qualities: list[tuple[Quality, int]] = []

    def takes(self, sidecar: StreamSidecar, video: Path) -> bool:
        """Whether a segment continues this stream.

        Raises:
            VideoError: Its video is damaged.
        """
        info = sidecar.camera_info
        if _identity(sidecar) != self._identity or not self._headers.has_room(sidecar.headers):
            return False
        if exceeds_padding(head.padding for head in (*self._headers.items, *sidecar.headers)):
            return False
        if len(self._columns) + sidecar.frames > MAX_FRAMES:
            return False
        if self._entry.differences(read_sample_entry(video)):
            return False  # JPEG files may differ in chroma subsampling
        if info is None or self._info is None:
            return True
        return (
            info.channel == self._info.channel
            and info.wire == self._info.wire
            and self._calibrations.has_room(info.calibrations)
            and len(self._infos) + info.messages <= MAX_CAMERA_INFOS
        )

    def add(
        self, sidecar: StreamSidecar, video: Path, *, ordinal: int, info_ordinal: int = 0
    ) -> None:
        """Add a segment accepted by `takes`.

        Args:
            sidecar: Of the segment.
            video: Its video.
            ordinal: Messages of the channel before those that the segment was made from.
            info_ordinal: The same of the calibration channel.
        """
        self._videos.append(video)
        variants = self._headers.add(sidecar.headers)
        self._columns.add(sidecar.columns, sidecar.frames, variants, ordinal)
        if sidecar.digests is not None:
            self._digests.append(sidecar.digests.decode(sidecar.frames))
        if sidecar.video.quality is not None:
            self._qualities.append((sidecar.video.quality, sidecar.frames))
        info = sidecar.camera_info
        if info is not None and info.columns is not None:
            self._info = self._info or info
            variants = self._calibrations.add(info.calibrations)
            self._infos.add(info.columns, info.messages, variants, info_ordinal)

    def finish(self, stem: str, folder: Path) -> StreamSidecar:
        """Write the video.

        Args:
            stem: Its file name, without extension.
            folder: Where.

        Returns:
            The sidecar, not written yet.

        Raises:
            VideoError: A segment is damaged.
            OSError: It cannot be written.
        """
        path = folder / f"{stem}.mp4"
        columns = self._columns.to_model()
        join_segments(self._videos, self._columns.ticks(), path)
        made = video_facts(path, self._first.video.codec)
        if self._qualities:
            made["quality"] = Quality.joined(self._qualities)
        return self._first.model_copy(
            update={
                "frames": len(self._columns),
                "headers": self._headers.items,
                "video": self._first.video.model_copy(update=made),
                "camera_info": self._camera_info(),
                "columns": columns,
                "digests": self._digests_model(),
            }
        )

    def _camera_info(self) -> CameraInfo | None:
        if self._info is None:
            return None
        return self._info.model_copy(
            update={
                "messages": len(self._infos),
                "calibrations": self._calibrations.items,
                "columns": self._infos.to_model(),
            }
        )

    def _digests_model(self) -> Digests | None:
        if not self._digests:
            return None
        return digests_model(np.concatenate(self._digests).tolist())


def _identity(sidecar: StreamSidecar) -> tuple[object, ...]:
    """What all segments of a stream have in common."""
    video = sidecar.video.model_dump(exclude={*FACTS, "quality"})
    return (
        *(sidecar.profile, sidecar.stamps, sidecar.channel, sidecar.wire, sidecar.body),
        *(sidecar.image, video, sidecar.digests is None, sidecar.video.quality is None),
        *(name in sidecar.columns.names() for name in ("seq", "pts")),
    )


class _Numbered(Generic[_ModelT]):
    """Distinct models, by the number of their first appearance."""

    def __init__(self) -> None:
        self.items: list[_ModelT] = []
        self._numbers: dict[str, int] = {}

    def has_room(self, models: Sequence[_ModelT]) -> bool:
        new = {key for key in map(_key, models) if key not in self._numbers}
        return len(self.items) + len(new) <= MAX_VARIANTS

    def add(self, models: Sequence[_ModelT]) -> NDArray[np.int64]:
        """The number of each here, shape (len(models),)."""
        numbers = np.empty(len(models), np.int64)
        for place, model in enumerate(models):
            key = _key(model)
            if key not in self._numbers:
                self._numbers[key] = len(self.items)
                self.items.append(model)
            numbers[place] = self._numbers[key]
        return numbers


def _key(model: object) -> str:
    # by its text, in which 0.0 and -0.0 differ, and NaNs are equal
    return repr(model)


class _JoinedColumns:
    """Columns of segments, one after another."""

    def __init__(self) -> None:
        self._columns: dict[str, list[NDArray[np.int64]]] = {}
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def add(self, columns: Columns, count: int, variants: NDArray[np.int64], ordinal: int) -> None:
        values = {name: getattr(columns, name).decode(count) for name in columns.names()}
        values.setdefault("publish_time", values["log_time"])
        values.setdefault("sequence", np.zeros(count, np.int64))
        values["variant"] = variants[values.get("variant", np.zeros(count, np.int64))]
        values["ordinal"] = values.get("ordinal", np.arange(count)) + ordinal
        for name, array in values.items():
            self._columns.setdefault(name, []).append(array)
        self._count += count

    def _joined(self) -> dict[str, NDArray[np.int64]]:
        return {name: np.concatenate(arrays) for name, arrays in self._columns.items()}

    def to_model(self) -> Columns:
        return columns_model(self._joined())

    def ticks(self) -> list[int]:
        clock = PresentationClock()
        joined = self._joined()
        return list(map(clock.tick, joined["stamp"].tolist(), joined["log_time"].tolist()))


# ---------------------------------------------------------------- parts


@dataclass
class _Counts:
    """Messages in earlier parts, by channel id and by topic."""

    channels: dict[int, int] = field(default_factory=dict)
    topics: dict[str, int] = field(default_factory=dict)


class Assembler:
    """Joins parts.

    Args:
        reader: The recording, indexed.
        selected: Whether a topic is packed.
        folder: The folder to fill, empty.
        threads: Streams to join in parallel.
    """

    def __init__(
        self,
        reader: BagReader,
        selected: Callable[[str], bool],
        folder: Path,
        *,
        threads: int = 1,
    ) -> None:
        self._reader = reader
        self._selected = selected
        self._threads = threads
        self._whole = PartRecord(folder)
        self._counts = _Counts()
        self._channels: dict[object, list[Channel]] = {}  # by identity: several may be equal
        for channel in reader.channels:
            self._channels.setdefault(channel.identity, []).append(channel)
        self._joins: dict[object, list[StreamJoin]] = {}
        self._order: list[tuple[StreamSidecar, StreamJoin]] = []
        self._chains: dict[str, list[PartRecord]] = {}

    def add(self, part: PartRecord, chain: str) -> None:
        """Take the next part.

        Args:
            part: In time order within its chain.
            chain: Identifies parts that follow each other without overlapping.

        Raises:
            FormatError: A file of it is damaged.
        """
        part.check_counts(self._reader.channels)
        for stream in part.streams:
            self._add_stream(part, stream)
        self._chains.setdefault(chain, []).append(part)
        whole, counts = self._whole, self._counts
        whole.saw(part.span or ())
        whole.left_out.update(part.left_out)
        whole.skipped.update(part.skipped)
        whole.transforms.extend(part.transforms)
        for channel, count in part.counts.items():
            counts.channels[channel] = counts.channels.get(channel, 0) + count
        for name, topic in part.topics.items():
            before = counts.topics.get(name, 0)
            counts.topics[name] = before + topic.messages
            if name in whole.topics:
                whole.topics[name].extend(topic, before)
            else:
                whole.topics[name] = topic

    def _add_stream(self, part: PartRecord, stream: PartStream) -> None:
        sidecar = stream.sidecar
        video = part.folder / sidecar.video.file
        if digest_file(video) != (sidecar.video.size, sidecar.video.sha256):
            raise _rotten(part, video)
        joins = self._joins.setdefault(sidecar.channel.to_record(0).identity, [])
        join = next((join for join in joins if join.takes(sidecar, video)), None)
        if join is None:
            join = StreamJoin(sidecar, video)
            joins.append(join)
            self._order.append((sidecar, join))
        info = sidecar.camera_info
        join.add(
            sidecar,
            video,
            ordinal=self._before(sidecar.channel.to_record(0)),
            info_ordinal=self._before(info.channel.to_record(0)) if info else 0,
        )

    def _before(self, channel: Channel) -> int:
        alike = self._channels[channel.identity]
        return sum(self._counts.channels.get(item.id, 0) for item in alike)

    def finish(self, report: Callable[[str], None] = lambda _: None) -> PartRecord:
        """Write everything but the manifest.

        Args:
            report: Called with the name of each file when it is started.

        Raises:
            SourceError: The parts do not match the recording's index.
            OSError: It cannot be written.
        """
        self._check_counts()
        names = FileNames()
        whole = self._whole
        named = [names.name_for(first.channel.topic) for first, _ in self._order]

        def write(number: int) -> PartStream:
            (stem, is_renamed), join = named[number], self._order[number][1]
            report(f"{stem}.mp4")
            sidecar = join.finish(stem, whole.folder)
            (whole.folder / f"{stem}.yaml").write_bytes(dump_document(sidecar))
            return PartStream(stem, sidecar, is_renamed)

        # copying and hashing run without Python's lock
        with ThreadPoolExecutor(self._threads) as threads:
            whole.streams.extend(threads.map(write, range(len(named))))
        report(whole.messages_path.name)
        self._write_messages()
        return whole

    def _check_counts(self) -> None:
        """Refuse parts that together lack messages: an index is wrong."""
        stats = self._reader.stats()
        for channel in self._reader.channels:
            found = self._counts.channels.get(channel.id, 0)
            if self._selected(channel.topic) and channel.id in stats:
                due = stats[channel.id].count
                if found != due:
                    raise SourceError(
                        self._reader.path,
                        f"is damaged: its index lists {due} messages on {channel.topic}, but "
                        f"{found} were found",
                    )

    def _write_messages(self) -> None:
        whole = self._whole
        with McapWriter(whole.messages_path, profile=self._reader.profile) as writer:
            chains = [self._records(parts) for parts in self._chains.values()]
            for record in heapq.merge(*chains, key=_time_of):
                write_record(writer, record)
            declare_rest(whole, self._reader, self._selected, writer)

    def _records(
        self, parts: Sequence[PartRecord]
    ) -> Iterator[Message | Attachment | MetadataRecord]:
        for part in parts:
            try:
                with McapReader(part.messages_path) as reader:
                    for record in reader.records():
                        if isinstance(record, Message):
                            channel = self._channels[record.channel.identity][0]
                            yield record.of_channel(channel)
                        else:
                            yield record
            except SourceError:
                raise _rotten(part, part.messages_path) from None


def _rotten(part: PartRecord, path: Path) -> FormatError:
    """The error for a part's file that changed after it was written; the part is made again."""
    part.forget()
    return FormatError(
        "checksum-mismatch",
        path,
        "was damaged after it was written; run the same command again to redo this part",
    )


def _time_of(record: Message | Attachment | MetadataRecord) -> int:
    return record.log_time if isinstance(record, Message) else 0
