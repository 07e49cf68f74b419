"""A dataset of what is there of a recording that was cut off, by its journal."""

from __future__ import annotations

import os
import stat
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.mcap_records import MAGIC
from mp4ds.bags.mcap_write import McapWriter
from mp4ds.bags.protocols import Format, write_record
from mp4ds.bags.salvage.mcap import McapSalvage
from mp4ds.dataset.checks import validate
from mp4ds.dataset.rebuild import columns_model
from mp4ds.errors import Mp4dsError, SourceError
from mp4ds.files.outputs import begins_with, is_mine, staged
from mp4ds.files.sources import JOURNAL_NAME
from mp4ds.format.fields import MESSAGES_NAME
from mp4ds.format.manifest import About
from mp4ds.format.models import CameraInfo
from mp4ds.format.sidecars import dump_document
from mp4ds.messages.serializations import is_calibration, is_camera
from mp4ds.messages.transforms import TransformCollector
from mp4ds.packing.calibrations import Calibrations
from mp4ds.packing.journal import FRAME_COLUMNS, Notes, StreamNote
from mp4ds.packing.manifest import (
    Origin,
    PartRecord,
    PartStream,
    dataset_files,
    summarize,
    write_manifest,
)
from mp4ds.packing.options import PackSummary
from mp4ds.packing.writer import stream_sidecar
from mp4ds.records import Channel, Loss, Message, MetadataRecord
from mp4ds.video.packets import copy_fragments

CUT_OFF = "the recording was cut off; what came in its last two seconds may be missing"
DAMAGED = "damaged here; frames recorded after this cannot be recovered"
CUT_OFF_AS_IT_WAS = "stored as it was when the recording was cut off"


def recover(
    folder: Path, target: Path, *, force: bool = False, about: About | None = None
) -> PackSummary:
    """Make the dataset of a recording that was cut off; nothing is encoded anew.

    The folder may come from anybody: what its journal says is checked, and what belongs to another
    user is not read.

    Args:
        folder: Where the recording was made; it stays as it is.
        target: The dataset.
        force: Replace an existing one.
        about: Description of the recording.

    Raises:
        SourceError: It is being recorded, its journal is damaged, or it belongs to another user.
        TargetError: The dataset may not be written there.
        WriteError: The disk refused.
    """
    if not is_mine(folder.stat(), folder.absolute().parent):
        raise _foreign(folder)
    files = _Files(folder)
    notes = Notes.read(files.at(JOURNAL_NAME))
    with staged(target, force=force, owned=dataset_files, sources=[folder]) as made:
        made.mkdir()
        origin, facts = Origin(about=about), notes.facts
        try:
            part = _Recovery(files, made, notes).run()
            recorded = _Recorded(facts.format, facts.profile)
            write_manifest(part, recorded, origin, facts.quality)
            problems = validate(made)
        except Mp4dsError:
            raise
        except ValueError:  # a model refused what the journal says
            raise SourceError(notes.path, "is damaged") from None
        if problems:
            raise SourceError(notes.path, f"is damaged: {problems[0].message}")
        return summarize(part, target, files.bytes, origin)


class _Files:
    """The files of the folder that are read.

    Args:
        folder: Their folder.
    """

    def __init__(self, folder: Path) -> None:
        self.bytes = 0
        self._folder = folder

    def at(self, name: str) -> Path:
        """The path of a file, which need not exist.

        Raises:
            SourceError: It is not an ordinary file of this user.
        """
        path = self._folder / name
        if os.path.lexists(path):
            found = path.lstat()
            if not stat.S_ISREG(found.st_mode):
                problem = "is a symbolic link" if path.is_symlink() else "is not a regular file"
                raise SourceError(path, problem, "Put the recorder's own file in its place.")
            if not is_mine(found, self._folder):
                raise _foreign(path)
            self.bytes += found.st_size
        return path


def _foreign(path: Path) -> SourceError:
    remedy = "If you trust it, salvage a copy of the folder that you own."
    return SourceError(path, "belongs to another user", remedy)


@dataclass(frozen=True)
class _Recorded:
    """See `mp4ds.packing.manifest.Recorded`."""

    format: Format
    profile: str
    library: str = ""


@dataclass
class _Stream:
    """A stream whose video is there. See `CalibratedStream`."""

    note: StreamNote
    channel: Channel
    columns: dict[str, NDArray[Any]]
    camera_info: CameraInfo | None = None


class _Recovery:
    """See `recover`."""

    def __init__(self, files: _Files, made: Path, notes: Notes) -> None:
        self._files = files
        self._notes = notes
        self._part = PartRecord(made)
        self._by_identity = {channel.identity: channel for channel in notes.channels.values()}
        self._kept: Counter[int] = Counter()  # camera messages that are not in videos, by channel

    def run(self) -> PartRecord:
        """Make videos, messages and sidecars."""
        part = self._part
        for channel in self._by_identity.values():
            part.topic(channel)
        streams = [stream for note in self._notes.streams if (stream := self._stream(note))]
        with McapWriter(part.messages_path, profile=self._notes.facts.profile) as writer:
            self._copy(writer)
            self._calibrate(streams, writer)
            in_videos = {stream.channel.id for stream in streams}
            for channel in self._by_identity.values():
                if channel.id not in in_videos:
                    writer.add_channel(channel)
        for channel in filter(is_camera, self._by_identity.values()):
            self._number([item for item in streams if item.channel.id == channel.id], channel)
        part.streams = [self._finished(stream) for stream in streams]
        end = part.span[1] if part.span else None
        if self._notes.is_damaged:
            size = self._notes.path.stat().st_size - self._notes.end
            part.losses.append(Loss(JOURNAL_NAME, self._notes.end, size, DAMAGED, start=end))
        part.losses.append(Loss(JOURNAL_NAME, None, None, CUT_OFF, start=end))
        return part

    def _stream(self, note: StreamNote) -> _Stream | None:
        """The frames of a stream that are in its video and in the journal; None without any."""
        noted = self._notes.frames[note.stem]
        values = {name: np.array(column) for name, column in zip(FRAME_COLUMNS, noted, strict=True)}
        name = f"{note.stem}.mp4"
        source, target = self._files.at(name), self._part.folder / name
        packets, ticks = self._notes.packets[note.stem], values["tick"].tolist()
        frames = copy_fragments(source, note.video["codec"], ticks, packets, target)
        if not frames:
            return None
        channel = self._notes.channels[note.channel]
        stream = _Stream(note, channel, {name: column[:frames] for name, column in values.items()})
        topic = self._part.topic(channel)
        topic.messages += frames
        topic.frames += frames
        topic.raw_bytes += int(stream.columns["size"].sum())
        self._part.saw(stream.columns["log_time"].tolist())
        return stream

    def _copy(self, writer: McapWriter) -> None:
        """The messages that were kept as they came; calibrations are taken from the journal."""
        path, part = self._files.at(MESSAGES_NAME), self._part
        if not (path.is_file() and path.stat().st_size and begins_with(path, MAGIC)):
            return  # nothing of it reached the disk
        transforms = TransformCollector()
        with McapSalvage(path, is_alone=False) as reader:
            for record in reader.records():
                if isinstance(record, MetadataRecord):
                    writer.add_metadata(record)
                if not isinstance(record, Message) or is_calibration(record.channel):
                    continue
                channel = self._known(record.channel)
                self._saw(channel, record)
                self._kept[channel.id] += is_camera(channel)
                transforms.add(channel, record.data)
                write_record(writer, record.of_channel(channel))
            part.losses.extend(reader.losses)
        part.transforms = transforms.transforms

    def _known(self, channel: Channel) -> Channel:
        """A channel of messages.mcap under the id that the journal has for it."""
        own = replace(channel, id=-1 - len(self._by_identity))
        return self._by_identity.setdefault(channel.identity, own)

    def _saw(self, channel: Channel, message: Message) -> None:
        topic = self._part.topic(channel)
        topic.messages += 1
        topic.raw_bytes += len(message.data)
        self._part.saw([message.log_time])

    def _calibrate(self, streams: Sequence[_Stream], writer: McapWriter) -> None:
        calibrations = Calibrations(
            list(self._notes.channels.values()),
            (),
            self._notes.pairs,
            topic_of=self._part.topic,
            keep=partial(write_record, writer),
        )
        for stream in streams:
            calibrations.adopt(stream)
        for message in self._notes.calibrations():
            self._saw(message.channel, message)
            calibrations.take(message)
        calibrations.finish()

    def _number(self, streams: Sequence[_Stream], channel: Channel) -> None:
        """Number the messages of a camera channel that are there without gaps."""
        noted, count = self._notes.verbatim[channel.id], self._kept[channel.id]
        every = [item for note in self._notes.streams for item in self._ordinals(note, channel)]
        end = max([-1, *every, *(ordinal for ordinal, _ in noted)]) + 1
        unnoted = range(end, end + max(0, count - len(noted)))
        kept = np.array([*(ordinal for ordinal, _ in noted[:count]), *unnoted], np.int64)
        there = np.sort(np.concatenate([kept, *(one.columns["ordinal"] for one in streams)]))
        if not np.all(there[1:] > there[:-1]):
            raise SourceError(self._notes.path, f"is damaged: {channel.topic} has a message twice")
        for stream in streams:
            stream.columns["ordinal"] = np.searchsorted(there, stream.columns["ordinal"])
        topic, places = self._part.topic(channel), np.searchsorted(there, kept).tolist()
        for (_, reason), place in zip(noted, places, strict=False):
            topic.count_verbatim(reason, place)
        for place in places[len(noted) :]:
            topic.count_verbatim(CUT_OFF_AS_IT_WAS, place)

    def _ordinals(self, note: StreamNote, channel: Channel) -> Sequence[int]:
        """Places of a stream's frames among all messages of a channel; none of another's."""
        if note.channel != channel.id:
            return ()
        return self._notes.frames[note.stem][FRAME_COLUMNS.index("ordinal")]

    def _finished(self, stream: _Stream) -> PartStream:
        note, folder = stream.note, self._part.folder
        columns = dict(stream.columns)
        digests = columns["digest"]
        not_there = {"tick", "digest", "size"}
        not_there |= set() if note.has_seq else {"seq"}
        not_there |= set() if note.has_pts else {"pts"}
        columns = {name: column for name, column in columns.items() if name not in not_there}
        sidecar = stream_sidecar(
            note,
            stream.channel,
            folder / f"{note.stem}.mp4",
            headers=self._notes.headers[note.stem][: int(columns["variant"].max()) + 1],
            camera_info=stream.camera_info,
            columns=columns_model(columns),
            frames=len(digests),
            digests=digests.tolist(),
        )
        (folder / f"{note.stem}.yaml").write_bytes(dump_document(sidecar))
        return PartStream(note.stem, sidecar)
