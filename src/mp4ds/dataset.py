"""A dataset, opened: its streams, and every message of the recording again."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.mcap import McapReader
from mp4ds.errors import FormatError, OptionError, SourceError, SourceNotFoundError
from mp4ds.outputs import digest_file
from mp4ds.records import Channel, Message, Record, Schema
from mp4ds.remote import location
from mp4ds.sidecar import (
    MANIFEST_NAME,
    MESSAGES_NAME,
    Manifest,
    load_manifest,
)
from mp4ds.streams import Frame, Stream
from mp4ds.streams.rebuild import DecodedColumns

__all__ = ["Dataset", "Frame", "ImageChannel", "Stream", "open_dataset"]

MessageSource = Callable[[Channel], Iterator[tuple[int, Message]]]
"""Gives messages of a channel, each with its place among the channel's messages."""


@dataclass(frozen=True)
class ImageChannel:
    """A channel with images in videos.

    Attributes:
        channel: As in `Dataset.channels`.
        streams: Its streams; each holds some of its messages.
        recorded: Number of its messages that are in messages.mcap.
    """

    channel: Channel
    streams: list[Stream]
    recorded: int


class Dataset:
    """A folder that `mp4ds pack` made, or one video with its sidecar.

    ``dataset["/topic"]`` is a topic's stream, ``"/topic" in dataset`` tells whether there is
    one, and iteration gives all streams.

    Args:
        path: The folder, a manifest, a sidecar, or a video beside its sidecar; or its URL.
        jpeg_quality: Of the JPEG files that messages of transcoded streams get, 1 to 100.

    Raises:
        SourceNotFoundError: There is nothing.
        SourceError: What is there is no dataset.
        FormatError: A file breaks a rule of the format.
    """

    def __init__(self, path: Path | str, *, jpeg_quality: int = 95) -> None:
        self.path = location(path)
        if not self.path.exists():
            raise SourceNotFoundError(self.path)
        if self.path.name == MANIFEST_NAME:
            self.path = self.path.parent
        self.manifest: Manifest | None = None
        holds_one = (self.path / MANIFEST_NAME).exists()
        if not holds_one and self.path.suffix not in (".yaml", ".yml", ".mp4"):
            raise SourceError(
                self.path,
                "is no dataset",
                "Give a folder that `mp4ds pack` made, or a sidecar beside its video.",
            )
        if self.path.is_dir():
            self.manifest = load_manifest(self.path / MANIFEST_NAME)
            sidecars = [self.path / entry.sidecar for entry in self.manifest.streams]
        else:
            sidecars = [self.path.with_suffix(".yaml") if self.path.suffix == ".mp4" else self.path]
        self.streams: list[Stream] = [
            Stream(sidecar, jpeg_quality=jpeg_quality) for sidecar in sidecars
        ]

    @property
    def topics(self) -> list[str]:
        """Topics that have a stream."""
        return list(dict.fromkeys(stream.topic for stream in self.streams))

    def __getitem__(self, topic: str) -> Stream:
        found = [stream for stream in self.streams if topic in (stream.topic, stream.path.stem)]
        if not found:
            known = ", ".join(self.topics) or "none"
            raise KeyError(f"{self.path} has no stream {topic!r}; there are: {known}")
        if len(found) > 1:
            stems = ", ".join(stream.path.stem for stream in found)
            raise OptionError(
                f"{topic} changes its size or encoding and has {len(found)} streams; "
                f"choose one of {stems}"
            )
        return found[0]

    def __contains__(self, topic: object) -> bool:
        return any(topic in (stream.topic, stream.path.stem) for stream in self.streams)

    def __iter__(self) -> Iterator[Stream]:
        return iter(self.streams)

    def __len__(self) -> int:
        return len(self.streams)

    @property
    def profile(self) -> str:
        """MCAP profile of the recording: ``ros1``, ``ros2`` or another."""
        if self.manifest:
            return self.manifest.recording_profile
        return "ros1" if self.streams[0].sidecar.wire == "ros1" else "ros2"

    @cached_property
    def channels(self) -> list[Channel]:
        """All channels of the recording."""
        return [*self._verbatim_channels, *(group.channel for group in self._groups)]

    @cached_property
    def unused_schemas(self) -> list[Schema]:
        """Definitions of the recording that no channel refers to."""
        if self._messages_path is None:
            return []
        with McapReader(self._messages_path) as reader:
            return list(reader.unused_schemas)

    @cached_property
    def _messages_path(self) -> Path | None:
        return self.path / MESSAGES_NAME if self.manifest else None

    @property
    def recorded_count(self) -> int | None:
        """Messages in messages.mcap as far as its index tells."""
        return sum(self._recorded_counts().values())

    def _recorded_counts(self) -> dict[int, int]:
        """Messages in messages.mcap by channel id."""
        if self._messages_path is None:
            return {}
        with McapReader(self._messages_path) as reader:
            return {key: item.count for key, item in reader.stats().items()}

    def verify_messages(self) -> None:
        """Compare messages.mcap with its SHA-256: not all that it holds has a checksum of its own.

        Raises:
            FormatError: ``file-missing`` or ``hash-mismatch``.
        """
        if self._messages_path is None or self.manifest is None:
            return
        if not self._messages_path.is_file():
            raise FormatError("file-missing", self._messages_path, "does not exist")
        entry = next((item for item in self.manifest.files if item.name == MESSAGES_NAME), None)
        if entry is None or digest_file(self._messages_path)[1] != entry.sha256:
            raise FormatError(
                "hash-mismatch",
                self._messages_path,
                "does not have the SHA-256 that the manifest says",
            )

    def recorded_records(self) -> Iterator[Record]:
        """Everything in messages.mcap, in file order."""
        if self._messages_path is not None:
            with McapReader(self._messages_path, in_file_order=True) as reader:
                yield from reader.records()

    @cached_property
    def _recorded(self) -> list[Channel]:
        if self._messages_path is None:
            return []
        if not self._messages_path.is_file():
            raise FormatError("file-missing", self._messages_path, "does not exist")
        with McapReader(self._messages_path) as reader:
            return list(reader.channels)

    @cached_property
    def _groups(self) -> list[_ChannelGroup]:
        groups: dict[tuple[object, ...], _ChannelGroup] = {}
        first_id = 1 + max((channel.id for channel in self._recorded), default=0)
        for stream in self.streams:
            images = _Part(stream.messages, stream.rebuilder.columns, stream)
            sources = [(stream.sidecar.channel, images)]
            info, columns = stream.sidecar.camera_info, stream.camera_info_columns
            if info and columns:
                sources.append((info.channel, _Part(stream.camera_info_messages, columns)))
            for model, part in sources:
                key = model.to_record(0).identity
                if key not in groups:
                    channel = model.to_record(first_id + len(groups))
                    recorded = [c for c in self._recorded if c.identity == key]
                    groups[key] = _ChannelGroup(channel, [], {c.id for c in recorded})
                groups[key].parts.append(part)
        return list(groups.values())

    @cached_property
    def _verbatim_channels(self) -> list[Channel]:
        split = {channel_id for group in self._groups for channel_id in group.recorded_ids}
        return [channel for channel in self._recorded if channel.id not in split]

    def image_channels(self) -> list[ImageChannel]:
        """The channels that have images in videos."""
        recorded = self._recorded_counts()
        found = []
        for group in self._groups:
            streams = [part.stream for part in group.parts if part.stream is not None]
            if streams:
                count = sum(recorded.get(key, 0) for key in group.recorded_ids)
                found.append(ImageChannel(group.channel, streams, count))
        return found

    def records(self, sources: Mapping[Path, MessageSource] | None = None) -> Iterator[Record]:
        """Everything that was recorded, merged by log time; each channel in its own order.

        Args:
            sources: What gives the messages of a stream, by the path of its sidecar; those of
                the others are as recorded.

        Raises:
            FormatError: A frame does not decode, or a message does not match its digest.
        """
        groups = (self._group_messages(group, sources or {}) for group in self._groups)
        return heapq.merge(self._verbatim_records(), *groups, key=_time_of)

    def times(self) -> dict[int, NDArray[np.int64]]:
        """Sorted log times of every message, nanoseconds, by channel id; decodes no frame."""
        found: dict[int, list[NDArray[np.int64]]] = {}
        if self._messages_path is not None:
            with McapReader(self._messages_path) as reader:
                found = {key: [times] for key, times in reader.times().items()}
        for group in self._groups:
            recorded = [found.pop(key)[0] for key in group.recorded_ids if key in found]
            found[group.channel.id] = [
                *recorded,
                *(part.columns.log_time for part in group.parts),
            ]
        return {key: np.sort(np.concatenate(arrays)) for key, arrays in found.items() if arrays}

    def gaps(self) -> Iterator[tuple[str, str]]:
        """Topics of which the columns say that messages are missing, and what is missing.

        The places that a channel's columns leave free are those of its messages in
        messages.mcap, so these must be as many.
        """
        if self._messages_path is None:
            return
        recorded = self._recorded_counts()
        for group in self._groups:
            places = np.concatenate([part.columns.ordinal for part in group.parts])
            total = len(places) + sum(recorded.get(key, 0) for key in group.recorded_ids)
            if len(np.unique(places)) < len(places):
                yield group.channel.topic, "two messages have the same place"
            elif places.max() >= total:
                yield group.channel.topic, f"has {total} messages and one of number {places.max()}"

    def _verbatim_records(self) -> Iterator[Record]:
        wanted = {channel.id for channel in self._verbatim_channels}
        for record in self.recorded_records():
            if not isinstance(record, Message) or record.channel.id in wanted:
                yield record

    def _group_messages(
        self, group: _ChannelGroup, sources: Mapping[Path, MessageSource]
    ) -> Iterator[Message]:
        """One channel's messages from all its places, in the channel's order."""
        parts = [
            sources.get(part.stream.path, part.messages) if part.stream else part.messages
            for part in group.parts
        ]
        merged = heapq.merge(*(part(group.channel) for part in parts), key=lambda pair: pair[0])
        recorded = self._recorded_messages(group)
        due = 0
        for ordinal, message in merged:
            while due < ordinal and self.manifest:  # a pair alone has only its own messages
                verbatim = next(recorded, None)
                if verbatim is None:
                    raise FormatError(
                        "messages-missing",
                        self.path,
                        f"message {due} of topic {group.channel.topic} is in no file",
                    )
                yield verbatim
                due += 1
            yield message
            due += 1
        yield from recorded

    def _recorded_messages(self, group: _ChannelGroup) -> Iterator[Message]:
        if not group.recorded_ids:
            return
        for record in self.recorded_records():
            if isinstance(record, Message) and record.channel.id in group.recorded_ids:
                yield replace(record, channel=group.channel)

    def close(self) -> None:
        """Close all videos."""
        for stream in self.streams:
            stream.close()

    def __enter__(self) -> Dataset:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@dataclass(frozen=True)
class _Part:
    """Messages of a channel that belong to one video: what makes them, and their columns.

    Attributes:
        stream: Whose images they are; None for calibrations.
    """

    messages: MessageSource
    columns: DecodedColumns
    stream: Stream | None = None


@dataclass(frozen=True)
class _ChannelGroup:
    """A channel with messages in videos, and its channels in messages.mcap if any."""

    channel: Channel
    parts: list[_Part]
    recorded_ids: set[int]


def _time_of(record: Record) -> int:
    return getattr(record, "log_time", 0)


def open_dataset(path: Path | str) -> Dataset:
    """Open a dataset, or one video with its sidecar. See `Dataset`."""
    return Dataset(path)
