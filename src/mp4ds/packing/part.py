"""What the packing of a part of a recording leaves: the files of its streams, and a record."""

from __future__ import annotations

import stat
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from mp4ds.errors import FormatError
from mp4ds.outputs import write_synced
from mp4ds.packing.kept import dump_kept, load_kept
from mp4ds.packing.report import TopicSummary
from mp4ds.records import Channel, Loss
from mp4ds.sidecar import (
    MESSAGES_NAME,
    LossEntry,
    StaticTransform,
    StreamSidecar,
    TimeRange,
    load_stream,
    of_types,
)
from mp4ds.wire.transforms import Transform

RECORD_NAME = "part.json"


@dataclass(frozen=True, slots=True)
class PartStream:
    """A stream of a part, or of a whole recording.

    Attributes:
        stem: File name of its video and sidecar, without ending.
        sidecar: Its sidecar.
        is_renamed: Whether another stream had taken its plain name.
    """

    stem: str
    sidecar: StreamSidecar
    is_renamed: bool = False


@dataclass
class Part:
    """What was packed of a recording into a folder, but for the manifest.

    Attributes:
        folder: Where the files are.
        files: Names of those that were saved.
        topics: What became of each topic, in the order of the recording.
        counts: Messages read by channel id.
        streams: In the order in which they began.
        span: Log times of the first and last message, ns; None without messages.
        left_out: Topics left out on request.
        skipped: What the source holds and no dataset can: a phrase -> how many.
        transforms: Static transforms, the latest of each child frame.
        losses: What could not be read of a damaged recording.
    """

    folder: Path
    topics: dict[str, TopicSummary] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    streams: list[PartStream] = field(default_factory=list)
    span: tuple[int, int] | None = None
    left_out: dict[str, None] = field(default_factory=dict)
    skipped: dict[str, int] = field(default_factory=dict)
    transforms: list[Transform] = field(default_factory=list)
    losses: list[Loss] = field(default_factory=list)
    files: list[str] = field(default_factory=list)

    @property
    def messages_path(self) -> Path:
        """Its messages.mcap."""
        return self.folder / MESSAGES_NAME

    def topic(self, channel: Channel) -> TopicSummary:
        """The summary of a channel's topic."""
        if channel.topic not in self.topics:
            self.topics[channel.topic] = TopicSummary(channel.topic, channel.type_name)
        return self.topics[channel.topic]

    def saw(self, times: Iterable[int]) -> None:
        """Widen the span to hold log times."""
        for time in times:
            start, end = self.span or (time, time)
            self.span = (min(start, time), max(end, time))

    def save(self) -> None:
        """Write the record; the part is whole then."""
        record = {
            "topics": [asdict(topic) for topic in self.topics.values()],
            "counts": {str(key): count for key, count in self.counts.items()},
            "streams": [stream.stem for stream in self.streams],
            "span": self.span,
            "left_out": list(self.left_out),
            "skipped": self.skipped,
            "transforms": [asdict(transform) for transform in self.transforms],
            "losses": [asdict(loss) for loss in self.losses],
            "files": {
                path.name: path.stat().st_size
                for path in sorted(self.folder.iterdir())
                if path.name != RECORD_NAME
            },
        }
        write_synced(self.folder / RECORD_NAME, dump_kept(record))

    def forget(self) -> None:
        """Let it no longer count as whole, so that it is made again."""
        (self.folder / RECORD_NAME).unlink(missing_ok=True)

    @classmethod
    def load(cls, folder: Path) -> Part:
        """Read what `save` wrote.

        Raises:
            FormatError: It is gone or damaged.
        """
        record = read_record(folder)
        if record is None:
            raise _damaged(folder)
        try:
            return cls._of(folder, of_types(_Record, record))
        except ValueError as error:
            (folder / RECORD_NAME).unlink(missing_ok=True)  # to be made again
            if isinstance(error, FormatError):
                raise
            raise _damaged(folder) from None

    @classmethod
    def _of(cls, folder: Path, record: _Record) -> Part:
        if not record.files.keys() >= {f"{stem}.yaml" for stem in record.streams}:
            raise ValueError("a stream without a file")
        sidecars = [load_stream(folder / f"{stem}.yaml") for stem in record.streams]
        names = {MESSAGES_NAME, *(f"{stem}.yaml" for stem in record.streams)}
        if record.files.keys() != names | {sidecar.video.file for sidecar in sidecars}:
            raise ValueError("a file of no stream")
        part = cls(
            folder=folder,
            topics={topic.topic: topic for topic in record.topics},
            counts=record.counts,
            streams=[PartStream(*pair) for pair in zip(record.streams, sidecars, strict=True)],
            span=record.span,
            left_out=dict.fromkeys(record.left_out),
            skipped=record.skipped,
            transforms=record.transforms,
            losses=record.losses,
            files=list(record.files),
        )
        if part.span:  # what no manifest takes is damage, too, and the part is made again
            TimeRange(start=part.span[0], end=part.span[1])
        for loss in part.losses:
            LossEntry.from_record(loss)
        for transform in part.transforms:
            StaticTransform.from_record(transform)
        return part

    def check_counts(self, channels: Iterable[Channel]) -> None:
        """Refuse a record that counts messages otherwise by topic than by channel.

        Args:
            channels: All of the recording.

        Raises:
            FormatError: It does; the part is made again.
        """
        found: Counter[str] = Counter()
        for channel in channels:
            found[channel.topic] += self.counts.get(channel.id, 0)
        told = {name: topic.messages for name, topic in self.topics.items() if topic.messages}
        if told != {name: count for name, count in found.items() if count}:
            self.forget()
            raise _damaged(self.folder)


@dataclass(frozen=True, slots=True)
class _Record:
    """What the record of a part holds."""

    topics: list[TopicSummary]
    counts: dict[int, int]
    streams: list[str]
    span: tuple[int, int] | None
    left_out: list[str]
    skipped: dict[str, int]
    transforms: list[Transform]
    losses: list[Loss]
    files: dict[str, int]


def _damaged(folder: Path) -> FormatError:
    return FormatError("file-missing", folder, "is gone, or damaged since it was made")


def read_record(folder: Path) -> dict[str, Any] | None:
    """The record of a part; None where the part is not whole: a file is missing or cut short."""
    try:
        record: dict[str, Any] = load_kept((folder / RECORD_NAME).read_bytes())
        topics = record.setdefault("topics", [])
        is_counted = all(
            isinstance(t["messages"], int) and isinstance(t["raw_bytes"], int) for t in topics
        )
        if is_counted and all(_is_whole(folder, *item) for item in record["files"].items()):
            return record
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        pass
    return None


def _is_whole(folder: Path, name: str, size: int) -> bool:
    found = (folder / name).lstat()
    return "/" not in name and stat.S_ISREG(found.st_mode) and found.st_size == size
