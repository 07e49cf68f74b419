"""A dataset, opened: its streams, their frames, and every message of the recording again."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import overload

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.mcap import McapReader
from mp4ds.errors import FormatError, OptionError, SourceNotFoundError
from mp4ds.layouts import Pixels
from mp4ds.records import Channel, Message, Record, Schema
from mp4ds.sidecar import (
    MANIFEST_NAME,
    MESSAGES_NAME,
    Calibration,
    Manifest,
    StreamSidecar,
    load_manifest,
    load_stream,
)
from mp4ds.streams import CameraInfoRebuilder, ImageRebuilder
from mp4ds.streams.rebuild import message_at
from mp4ds.video import VideoDecoder


@dataclass(frozen=True)
class Frame:
    """One image of a stream.

    Attributes:
        data: Pixels in the recorded encoding, shape (H, W) or (H, W, C), uint8 or uint16.
        index: Number of the frame in its stream.
        stamp_ns: Header stamp, nanoseconds.
        log_time_ns: When it was recorded, nanoseconds.
        frame_id: Coordinate frame.
        encoding: ROS image encoding of `data`.
        intrinsics: The calibration, or None where the recording has none.
    """

    data: Pixels
    index: int
    stamp_ns: int
    log_time_ns: int
    frame_id: str
    encoding: str
    intrinsics: Calibration | None


class Stream:
    """One camera topic (of one geometry), as a sequence of frames.

    ``len(stream)``, ``stream[i]``, ``stream[-1]`` and iteration work as on a list; frames are
    decoded when asked for. Not to be shared between threads or over a fork.

    Args:
        path: The sidecar; the video is beside it.

    Raises:
        FormatError: The sidecar or its video breaks a rule of the format.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.sidecar: StreamSidecar = load_stream(path)
        self._decoder: VideoDecoder | None = None

    @property
    def topic(self) -> str:
        """Topic of the images."""
        return self.sidecar.channel.topic

    @property
    def video_path(self) -> Path:
        """The stream's video."""
        return self.path.parent / self.sidecar.video.file

    @cached_property
    def rebuilder(self) -> ImageRebuilder:
        """Makes the stream's messages; checks the columns when first used."""
        try:
            size = self.video_path.stat().st_size
        except OSError as error:
            raise FormatError(
                "file-missing", self.video_path, f"cannot be read: {error.strerror}"
            ) from None
        if self.sidecar.frames > size:  # a coded frame takes a byte at least
            raise FormatError(
                "frame-count", self.path, f"claims {self.sidecar.frames} frames in {size} bytes"
            )
        return ImageRebuilder(self.sidecar, str(self.path))

    @property
    def stamps(self) -> NDArray[np.int64]:
        """Header stamps, nanoseconds, shape (frames,)."""
        return self.rebuilder.columns.stamp

    @property
    def log_times(self) -> NDArray[np.int64]:
        """Log times, nanoseconds, shape (frames,)."""
        return self.rebuilder.columns.log_time

    @property
    def calibrations(self) -> Sequence[Calibration]:
        """All calibrations, in the order in which they were first seen."""
        return self.sidecar.camera_info.calibrations if self.sidecar.camera_info else []

    @cached_property
    def _info(self) -> CameraInfoRebuilder | None:
        info = self.sidecar.camera_info
        return CameraInfoRebuilder(info, str(self.path)) if info and info.messages else None

    def intrinsics_at(self, index: int) -> Calibration | None:
        """The calibration that held when a frame was recorded: the last before it, else the first.

        Args:
            index: 0 <= index < frames.
        """
        if not self.calibrations:
            return None
        if self._info is None:
            return self.calibrations[0]
        columns = self._info.columns
        place = np.searchsorted(columns.log_time, self.log_times[index], side="right")
        return self.calibrations[int(columns.variant[max(int(place) - 1, 0)])]

    def open_video(self, *, sequential: bool) -> VideoDecoder:
        """A decoder of its own for the stream's pictures.

        Raises:
            VideoError: The video cannot be read, or is not what the sidecar says.
        """
        video = self.sidecar.video
        return VideoDecoder(
            self.video_path,
            codec=video.codec,
            coded_size=(video.width, video.height),
            frames=self.sidecar.frames,
            picture_format=self.rebuilder.picture_format,
            picture_size=self.rebuilder.picture_size,
            matrix=video.matrix,
            full_range=video.full_range,
            sequential=sequential,
        )

    def __len__(self) -> int:
        return self.sidecar.frames

    @overload
    def __getitem__(self, index: int) -> Frame: ...

    @overload
    def __getitem__(self, index: slice) -> list[Frame]: ...

    def __getitem__(self, index: int | slice) -> Frame | list[Frame]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        number = index + len(self) if index < 0 else index
        if not 0 <= number < len(self):
            raise IndexError(f"{self.topic} has {len(self)} frames, and no frame {index}")
        if self._decoder is None:
            self._decoder = self.open_video(sequential=False)
        return self._frame(number, self._decoder.picture(number))

    def __iter__(self) -> Iterator[Frame]:
        with self.open_video(sequential=True) as decoder:
            for index, picture in enumerate(decoder.pictures()):
                yield self._frame(index, picture)

    def _frame(self, index: int, picture: Pixels) -> Frame:
        columns = self.rebuilder.columns
        return Frame(
            data=self.rebuilder.pixels(picture),
            index=index,
            stamp_ns=int(columns.stamp[index]),
            log_time_ns=int(columns.log_time[index]),
            frame_id=self.sidecar.headers[int(columns.variant[index])].frame_id,
            encoding=self.sidecar.image.encoding,
            intrinsics=self.intrinsics_at(index),
        )

    def messages(self, channel: Channel) -> Iterator[tuple[int, Message]]:
        """The image messages, each with its place among the channel's messages.

        Args:
            channel: The channel to make them on.

        Raises:
            FormatError: A frame does not decode, or a message does not match its digest.
        """
        rebuilder = self.rebuilder
        with self.open_video(sequential=True) as decoder:
            for index, picture in enumerate(decoder.pictures()):
                payload = rebuilder.payload(index, picture)
                ordinal = int(rebuilder.columns.ordinal[index])
                yield ordinal, message_at(rebuilder.columns, index, channel, payload)

    @property
    def camera_info_log_times(self) -> NDArray[np.int64]:
        """Log times of the CameraInfo messages, nanoseconds."""
        return self._info.columns.log_time if self._info else np.empty(0, np.int64)

    def camera_info_messages(self, channel: Channel) -> Iterator[tuple[int, Message]]:
        """The CameraInfo messages, each with its place among the channel's messages."""
        return self._info.messages(channel) if self._info else iter(())

    def close(self) -> None:
        """Close the video, if it is open."""
        if self._decoder is not None:
            self._decoder.close()
            self._decoder = None


class Dataset:
    """A folder that `mp4ds pack` made, or one video with its sidecar.

    ``dataset["/topic"]`` is a topic's stream, ``dataset.streams`` are all of them.

    Args:
        path: The folder, a manifest, a sidecar, or a video beside its sidecar.

    Raises:
        SourceNotFoundError: There is nothing.
        FormatError: A file breaks a rule of the format.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        if not self.path.exists():
            raise SourceNotFoundError(self.path)
        if self.path.name == MANIFEST_NAME:
            self.path = self.path.parent
        self.manifest: Manifest | None = None
        if self.path.is_dir():
            self.manifest = load_manifest(self.path / MANIFEST_NAME)
            sidecars = [self.path / entry.sidecar for entry in self.manifest.streams]
        else:
            sidecars = [self.path.with_suffix(".yaml") if self.path.suffix == ".mp4" else self.path]
        self.streams: list[Stream] = [Stream(sidecar) for sidecar in sidecars]

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
            for _ in reader.records():
                pass
            return list(reader.unused_schemas)

    @property
    def _messages_path(self) -> Path | None:
        return self.path / MESSAGES_NAME if self.manifest else None

    @property
    def recorded_count(self) -> int | None:
        """Messages in messages.mcap as far as its index tells."""
        if self._messages_path is None:
            return 0
        with McapReader(self._messages_path) as reader:
            return sum(item.count for item in reader.stats().values())

    def recorded_records(self) -> Iterator[Record]:
        """Everything in messages.mcap, in file order."""
        if self._messages_path is not None:
            with McapReader(self._messages_path) as reader:
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
            sources = [(stream.sidecar.channel, stream.messages, stream.log_times)]
            info = stream.sidecar.camera_info
            if info and info.messages:
                times = stream.camera_info_log_times
                sources.append((info.channel, stream.camera_info_messages, times))
            for model, messages, times in sources:
                key = model.to_record(0).identity
                if key not in groups:
                    channel = model.to_record(first_id + len(groups))
                    recorded = [c for c in self._recorded if c.identity == key]
                    groups[key] = _ChannelGroup(channel, [], [], {c.id for c in recorded})
                groups[key].parts.append(messages)
                groups[key].times.append(times)
        return list(groups.values())

    @cached_property
    def _verbatim_channels(self) -> list[Channel]:
        split = {channel_id for group in self._groups for channel_id in group.recorded_ids}
        return [channel for channel in self._recorded if channel.id not in split]

    def records(self) -> Iterator[Record]:
        """Everything that was recorded, merged by log time; each channel in its own order.

        Raises:
            FormatError: A frame does not decode, or a message does not match its digest.
        """
        parts = [self._verbatim_records(), *(self._group_messages(g) for g in self._groups)]
        return heapq.merge(*parts, key=_time_of)

    def times(self) -> dict[int, NDArray[np.int64]]:
        """Sorted log times of every message, nanoseconds, by channel id; decodes no frame."""
        found: dict[int, list[NDArray[np.int64]]] = {}
        if self._messages_path is not None:
            with McapReader(self._messages_path) as reader:
                found = {key: [times] for key, times in reader.times().items()}
        for group in self._groups:
            parts = [found.pop(key) for key in group.recorded_ids if key in found]
            found[group.channel.id] = [*sum(parts, []), *group.times]
        return {key: np.sort(np.concatenate(arrays)) for key, arrays in found.items() if arrays}

    def _verbatim_records(self) -> Iterator[Record]:
        wanted = {channel.id for channel in self._verbatim_channels}
        for record in self.recorded_records():
            if not isinstance(record, Message) or record.channel.id in wanted:
                yield record

    def _group_messages(self, group: _ChannelGroup) -> Iterator[Message]:
        """One channel's messages from all its places, in the channel's order."""
        merged = heapq.merge(*(part(group.channel) for part in group.parts), key=lambda m: m[0])
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


_MessageSource = Callable[[Channel], Iterator[tuple[int, Message]]]


@dataclass
class _ChannelGroup:
    """A channel with messages in videos, and its channels in messages.mcap if any."""

    channel: Channel
    parts: list[_MessageSource]
    times: list[NDArray[np.int64]]
    recorded_ids: set[int]


def _time_of(record: Record) -> int:
    return getattr(record, "log_time", 0)


def open_dataset(path: Path | str) -> Dataset:
    """Open a dataset, or one video with its sidecar. See `Dataset`."""
    return Dataset(path)
